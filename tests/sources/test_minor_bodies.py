"""Jupiter's moons, Ceres and Vesta: places and magnitudes against other ephemerides and published oppositions."""

from __future__ import annotations

import datetime

import erfa
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord, get_constellation
from scipy.integrate import quad

from skysim.core.constants import AU_KM
from skysim.core.time import J2000_JD, TT_MINUS_TAI_S, tai_minus_utc_s
from skysim.scene import loader
from skysim.scene.sections.light import BodiesConfig
from skysim.scene.sections.vehicle import SiteConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import build_lab
from skysim.sources import bodies, body_discs, ephemeris
from skysim.sources.bodies import BODIES, MINOR, bodies_from
from skysim.sources.photometry import SUN, Band

GEOCENTER = SiteConfig()
BAND = Band.from_efficiency(0.5)
ALL = BodiesConfig(minor=True)
# Jupiter's equatorial radius, and its north pole (IAU WGCCRE 2015).
EQUATOR_KM = 71_492.0
POLE = np.array([-0.0146, -0.4304, 0.9025])


def at_tt(jd: float) -> datetime.datetime:
    """UTC of a Julian date of Terrestrial Time."""
    tt = datetime.datetime(2000, 1, 1, 12) + datetime.timedelta(days=jd - J2000_JD)
    utc = tt - datetime.timedelta(seconds=TT_MINUS_TAI_S + 30)
    return tt - datetime.timedelta(seconds=TT_MINUS_TAI_S + tai_minus_utc_s(utc))


def seen(name: str, jd: float) -> ephemeris.Place:
    return ephemeris.place(name, ephemeris.observe_from(at_tt(jd), GEOCENTER))


# JPL's JUP365 by Horizons: places from Jupiter's center in km, ICRF, of Io, Europa, Ganymede and Callisto at JD (TDB).
HORIZONS = {
    2442045.0: [
        (124198, 364638, 175744),
        (-603555, 269495, 121158),
        (238877, -943578, -444133),
        (1860112, -176269, -58245),
    ],
    2447545.0: [
        (391657, 139770, 72810),
        (177366, 584882, 286651),
        (-1054655, -154761, -85868),
        (-1834690, -418241, -224460),
    ],
    2452545.0: [
        (-127567, 363459, 171086),
        (267068, 561366, 265883),
        (-791977, 656058, 303744),
        (1181035, 1309812, 636730),
    ],
    2456545.0: [
        (-96652, 372551, 176297),
        (-594943, -273669, -140827),
        (-1048708, 208352, 84746),
        (756832, -1558176, -724000),
    ],
    2461045.0: [
        (340400, -227314, -103059),
        (21697, -610547, -287062),
        (-988268, 380697, 166750),
        (-1828095, 462023, 190500),
    ],
    2466545.0: [
        (20344, -381785, -181871),
        (-656584, -128832, -68316),
        (463170, 865742, 422269),
        (1862021, 139625, 92970),
    ],
    2471545.0: [
        (419556, -21133, -3440),
        (-659711, -67856, -48581),
        (1043797, 193800, 111970),
        (-1441037, -1106612, -541347),
    ],
    2475545.0: [
        (418050, -45285, -14689),
        (558764, -346981, -158746),
        (786331, 647874, 321984),
        (-509954, 1638887, 762411),
    ],
}


@pytest.mark.parametrize("jd", HORIZONS)
def test_jupiter_s_moons_are_where_jpl_has_them(jd: float) -> None:
    """Within 900 km, 0.3" as seen from the Earth."""
    shipped = ephemeris.load_ephemeris()
    for name, expected_km in zip(ephemeris.GALILEAN, HORIZONS[jd], strict=True):
        found_km = shipped.position_km(name, jd)
        assert np.linalg.norm(found_km - expected_km) < 900


# Meeus, Astronomical Algorithms, chapter 44, example b (Lieske's E2x3), and the same by PyMeeus 0.5.12 at other dates:
# X to the west and Y to the north of Jupiter's center along its equator, in equatorial radii.
MEEUS = {
    2448972.500685: [(-3.4502, 0.2137), (7.4418, 0.2753), (1.2011, 0.5900), (7.0720, 1.0290)],
    2452865.8: [(-5.6148, -0.0088), (-5.6948, 0.0050), (14.0426, -0.0239), (7.7413, -0.2239)],
    2460319.2: [(1.0447, -0.3049), (-9.3501, -0.1086), (9.5719, 0.5923), (19.4786, 0.9120)],
}


@pytest.mark.parametrize("jd", MEEUS)
def test_jupiter_s_moons_are_where_meeus_has_them(jd: float) -> None:
    """Lieske's older theory is within 0.025 radii, 0.5"; example a, by the low-accuracy method, is within 0.08 of b."""
    jupiter = seen("jupiter", jd)
    north = POLE - (POLE @ jupiter.direction) * jupiter.direction
    north /= np.linalg.norm(north)
    west = np.cross(jupiter.direction, north)
    radius_rad = EQUATOR_KM / jupiter.distance_km
    for name, (x, y) in zip(ephemeris.GALILEAN, MEEUS[jd], strict=True):
        away = seen(name, jd).direction - jupiter.direction
        assert away @ west / radius_rad == pytest.approx(x, abs=0.025)
        assert away @ north / radius_rad == pytest.approx(y, abs=0.025)


# Apparent geocentric right ascension and declination of date in degrees, and V, by the Swiss Ephemeris (seas_18.se1).
SWISS = {
    ("ceres", 2444239.5): (11.8758152, -4.4567065, 8.8431),
    ("ceres", 2454250.5): (28.4123763, 3.2736320, 9.2594),
    ("ceres", 2459278.5): (7.1727054, -5.1440278, 9.1359),
    ("ceres", 2473400.5): (180.3318903, 9.0272042, 8.7746),
    ("vesta", 2444239.5): (33.5994023, 6.0828723, 7.5621),
    ("vesta", 2454250.5): (248.4745187, -14.0581284, 5.4315),
    ("vesta", 2459278.5): (169.8371885, 16.0497067, 6.0374),
    ("vesta", 2473400.5): (62.9083042, 12.3255941, 6.766),
}


@pytest.mark.parametrize(("name", "jd"), SWISS)
def test_asteroids_are_where_the_swiss_ephemeris_has_them(name: str, jd: float) -> None:
    """Its orbits were integrated from other elements; phase angles are up to 21 deg."""
    at = seen(name, jd)
    x, y, z = erfa.pnm06a(jd, 0.0) @ at.direction
    ra_deg, dec_deg, v_mag = SWISS[name, jd]
    assert body_discs.magnitude(name, at, jd) == pytest.approx(v_mag, abs=0.005)
    off_deg = (np.degrees(np.arctan2(y, x)) - ra_deg + 180) % 360 - 180
    assert abs(off_deg) * np.cos(np.radians(dec_deg)) * 3600 < 1.0
    assert abs(np.degrees(np.arcsin(z)) - dec_deg) * 3600 < 1.0


# Published oppositions: date, V, constellation (versions of Astropy spell Ophiuchus differently).
OPPOSITIONS = [
    ("vesta", "2007-05-31", 5.4, "Ophiu"),
    ("vesta", "2011-08-05", 5.6, "Capricornus"),
    ("vesta", "2018-06-19", 5.3, "Sagittarius"),
    ("ceres", "2014-04-15", 7.0, "Virgo"),
]


@pytest.mark.parametrize(("name", "date", "v_mag", "constellation"), OPPOSITIONS)
def test_oppositions_of_asteroids_are_as_published(
    name: str, date: str, v_mag: float, constellation: str
) -> None:
    observer = ephemeris.observe_from(datetime.datetime.fromisoformat(date), GEOCENTER)
    at = ephemeris.place(name, observer)
    assert body_discs.magnitude(name, at, observer.tt_jd) == pytest.approx(v_mag, abs=0.1)
    ra, dec = erfa.c2s(at.direction)
    assert get_constellation(SkyCoord(ra * u.rad, dec * u.rad)).startswith(constellation)
    # Opposite to the Sun within a day, in which they move apart by 1.3 deg.
    turned = erfa.ecm06(observer.tt_jd, 0.0)
    sun = turned @ ephemeris.place("sun", observer).direction
    x, y, _ = turned @ at.direction
    apart_deg = np.degrees(np.arctan2(y, x) - np.arctan2(sun[1], sun[0])) % 360
    assert apart_deg == pytest.approx(180, abs=1.3)


@pytest.mark.parametrize("slope", [0.0, 0.15, 0.32])
def test_magnitudes_by_h_and_g_have_the_authors_phase_integral(slope: float) -> None:
    """q = 2 int phi sin(a) da = 0.290 + 0.684 G (Bowell et al. 1989), within 3 %; at phase 0 V(1, 0) is H."""
    assert body_discs.asteroid(0.0, 3.2, slope) == pytest.approx(3.2)

    def integrand(phase_rad: float) -> float:
        fainter = body_discs.asteroid(np.degrees(phase_rad), 0.0, slope)
        return 2 * 10 ** (-0.4 * fainter) * np.sin(phase_rad)

    assert quad(integrand, 0, np.pi)[0] == pytest.approx(0.290 + 0.684 * slope, rel=0.03)


@pytest.mark.parametrize(
    ("name", "v_mag"),
    # At the mean opposition: Astronomical Almanac, section F.
    [("io", 5.02), ("europa", 5.29), ("ganymede", 4.61), ("callisto", 5.65)],
)
def test_jupiter_s_moons_have_their_mean_magnitudes(name: str, v_mag: float) -> None:
    away = np.array([1.0, 0.0, 0.0])
    at = ephemeris.lit_place(away, 5.203 * AU_KM * away, 4.203 * AU_KM * away)
    assert body_discs.magnitude(name, at, J2000_JD) == pytest.approx(v_mag, abs=0.02)


@pytest.mark.parametrize(
    ("name", "b_v"), [("europa", 0.87), ("ganymede", 0.83), ("callisto", 0.86)]
)
def test_their_color_is_the_measured_one(name: str, b_v: float) -> None:
    """Morrison 1982, Satellites of Jupiter, table 3.1."""
    blue, visual, *_ = BODIES[name].albedo
    assert SUN[0] + 2.5 * np.log10(visual / blue) == pytest.approx(b_v, abs=0.03)


def test_minor_bodies_are_shown_by_their_own_key() -> None:
    assert set(bodies.chosen(ALL)) - set(bodies.chosen(BodiesConfig())) == set(MINOR)
    assert not set(bodies.chosen(BodiesConfig())) & set(MINOR)
    # Their numbers are no reflections' or satellites'.
    assert len(bodies.NAMES) == len(BODIES)
    assert max(bodies.NAMES) < 10_000_000


def hidden_and_shown() -> tuple[datetime.datetime, datetime.datetime]:
    """Times at which Io is in the middle of Jupiter's disc's far side, and beside the disc."""
    start = datetime.datetime(2012, 12, 3)
    nearest = {}
    for hour in np.arange(0.0, 43.0, 0.25):
        time = start + datetime.timedelta(hours=float(hour))
        by_name = {
            light.name: light
            for light in bodies_from(ALL, ephemeris.observe_from(time, GEOCENTER), BAND)
        }
        io = by_name["io"].place
        jupiter = by_name["jupiter"].place
        off = np.linalg.norm(io.direction - jupiter.direction) / by_name["jupiter"].radius_rad
        behind = io.distance_km > jupiter.distance_km
        nearest[time] = off if behind else np.inf
    behind = min(nearest, key=nearest.__getitem__)
    beside = min(nearest, key=lambda time: abs(nearest[time] - 4))
    assert nearest[behind] < 0.7
    return behind, beside


def test_a_moon_behind_jupiter_does_not_shine() -> None:
    """Frames of both times: Io is in the truth beside the disc alone, and the image has its light."""
    found = []
    light_e = []
    for time in hidden_and_shown():
        keys = {
            "start_time": time.isoformat(),
            "background": "[]",
            "light.bodies": "{minor: true, sun: false, moon: false}",
            "motion.start": "{ra_deg: 67.0, dec_deg: 21.0, roll_deg: 0}",
            "motion.rate_deg_s": "[0, 0, 0]",
        }
        lab = build_lab(loader.load("shefex2", keys))
        _, image = render_at_rest(lab.camera, lab.start)
        row = image.sources.id == BODIES["io"].id
        found.append(bool(row.any()))
        light_e.append(float(image.sources.electrons[row].sum()))
        assert BODIES["callisto"].id in image.sources.id
    assert found == [False, True]
    assert light_e[1] > 100
