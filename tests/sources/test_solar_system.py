"""Sun, Moon and planets: places, magnitudes and discs against published numbers and analytic laws."""

from __future__ import annotations

import datetime

import erfa
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import EarthLocation
from astropy.time import Time
from astropy.utils import iers
from scipy.optimize import brentq

from skysim.core.time import J2000_JD, TT_MINUS_TAI_S, tai_minus_utc_s, tt_jd
from skysim.scene.sections.light import BodiesConfig
from skysim.scene.sections.vehicle import SiteConfig
from skysim.sources import bodies, body_discs, ephemeris
from skysim.sources.bodies import BODIES, bodies_from
from skysim.sources.photometry import SUN, Band, star_flux_e_s_m2

GEOCENTER = SiteConfig()
ARCSEC_RAD = erfa.DAS2R
BAND = Band.from_efficiency(0.5)


def dynamical(text: str) -> datetime.datetime:
    """UTC of a moment of Terrestrial Time."""
    tt = datetime.datetime.fromisoformat(text)
    utc = tt - datetime.timedelta(seconds=TT_MINUS_TAI_S + 30)
    return tt - datetime.timedelta(seconds=TT_MINUS_TAI_S + tai_minus_utc_s(utc))


def of_date(direction: np.ndarray, tt_jd: float) -> tuple[float, float]:
    """Right ascension and declination in degrees, true equator and equinox of date (IAU 2006/2000A)."""
    x, y, z = erfa.pnm06a(tt_jd, 0.0) @ direction
    return np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arcsin(z))


# Apparent geocentric places of date in degrees at 0h TT, by Skyfield 1.55 with DE421.
SKYFIELD = {
    "venus": ("1992-12-20", (316.1727389, -18.8880116)),
    "sun": ("1992-10-13", (198.3781339, -7.7838113)),
    "moon": ("1992-04-12", (134.6879147, 13.7684491)),
}


@pytest.mark.parametrize("name", SKYFIELD)
def test_solar_system_positions_match_skyfield(name: str) -> None:
    date, (ra_deg, dec_deg) = SKYFIELD[name]
    seen = ephemeris.observe_from(dynamical(date), GEOCENTER)
    ra, dec = of_date(ephemeris.place(name, seen).direction, seen.tt_jd)
    assert abs(ra - ra_deg) * np.cos(np.radians(dec)) * 3600 < 0.01
    assert abs(dec - dec_deg) * 3600 < 0.01


def test_the_moon_s_distance_and_phase_match_skyfield() -> None:
    """Skyfield 1.55 with DE421: 368,405.543 km, phase angle 69.0819 degrees, bright limb at 285.044 degrees."""
    seen = ephemeris.observe_from(dynamical("1992-04-12"), GEOCENTER)
    moon = ephemeris.place("moon", seen)
    geometric_km = ephemeris.load_ephemeris().position_km("moon", seen.tt_jd)
    assert np.linalg.norm(geometric_km) == pytest.approx(368405.543, abs=0.01)
    # Skyfield's with 20" of aberration.
    assert np.degrees(moon.phase_rad) == pytest.approx(69.0819, abs=0.006)
    of_date_axes = erfa.pnm06a(seen.tt_jd, 0.0)
    direction = of_date_axes @ moon.direction
    toward_sun = of_date_axes @ moon.toward_sun
    east = np.cross([0.0, 0.0, 1.0], direction)
    north = np.cross(direction, east)
    assert np.degrees(
        np.arctan2(toward_sun @ east, toward_sun @ north)
    ) % 360 == pytest.approx(285.044, abs=0.01)


def test_the_earth_s_velocity_matches_erfa() -> None:
    """Positions of the ephemeris, differenced over a day, against ERFA's own theory; and the Sun against its place."""
    for jd in np.linspace(2441400.5, 2487400.5, 15):
        one, other = (
            ephemeris.load_ephemeris().position_km("earth", jd + half)
            for half in (0.05, -0.05)
        )
        heliocentric, barycentric = erfa.epv00(jd, 0.0)
        km_s = (one - other) / (0.1 * 86400)
        assert np.linalg.norm(km_s - barycentric["v"] * ephemeris.AU_KM / 86400) < 1e-4
        sun_km = ephemeris.load_ephemeris().position_km("sun", jd)
        from_sun_km = ephemeris.load_ephemeris().position_km("earth", jd) - sun_km
        assert np.linalg.norm(from_sun_km - heliocentric["p"] * ephemeris.AU_KM) < 100


@pytest.mark.parametrize("name", sorted(set(ephemeris.load_ephemeris().series)))
def test_the_ephemeris_is_continuous_between_intervals(name: str) -> None:
    shipped = ephemeris.load_ephemeris()
    days = shipped.series[name].days
    joint_jd = shipped.first_jd + days * np.arange(1, 8)
    tolerance_km = 0.05 if name == "moon" else 70
    for jd in joint_jd:
        before, at, after = (shipped.position_km(name, jd + dt) for dt in (-1e-4, 0.0, 1e-4))
        assert np.linalg.norm(before + after - 2 * at) < tolerance_km


def test_a_site_s_position_matches_astropy() -> None:
    """Position within 1 m but for polar motion (9 m), velocity within 1 mm/s."""
    site = SiteConfig(latitude_deg=-22.9, longitude_deg=-43.2, height="2400 m")
    where = EarthLocation.from_geodetic(-43.2 * u.deg, -22.9 * u.deg, 2400 * u.m)
    for date in (datetime.datetime(1987, 3, 1, 7), datetime.datetime(2012, 6, 22, 21)):
        with iers.conf.set_temp("auto_download", False):
            position, velocity = where.get_gcrs_posvel(Time(date, scale="utc"))
        position_m, velocity_m_s = ephemeris.site_in_gcrs(date, tt_jd(date), site)
        assert np.linalg.norm(position_m - position.xyz.to_value(u.m)) < 15
        assert np.linalg.norm(velocity_m_s - velocity.xyz.to_value(u.m / u.s)) < 2e-3


def test_the_moon_is_displaced_by_its_parallax() -> None:
    """From a site where it is on the horizon it is lower by asin(r / d), up to a degree; from below it, not at all."""
    date = datetime.datetime(2012, 6, 24, 21)
    moon = ephemeris.place("moon", ephemeris.observe_from(date, GEOCENTER))
    furthest = 0.0
    for longitude_deg in range(0, 360, 5):
        site = SiteConfig(latitude_deg=0.0, longitude_deg=longitude_deg)
        seen = ephemeris.observe_from(date, site)
        position_m, _ = ephemeris.site_in_gcrs(date, seen.tt_jd, site)
        from_site = ephemeris.place("moon", seen)
        up = position_m / np.linalg.norm(position_m)
        turned = np.arctan2(
            np.linalg.norm(np.cross(from_site.direction, moon.direction)),
            from_site.direction @ moon.direction,
        )
        sine = np.linalg.norm(position_m) / 1e3 / moon.distance_km
        zenith = np.arccos(from_site.direction @ up)
        assert turned == pytest.approx(np.arcsin(sine * np.sin(zenith)), abs=3 * ARCSEC_RAD)
        furthest = max(furthest, turned)
    assert np.degrees(furthest) > 0.9


@pytest.mark.parametrize("name", ["moon", "mercury", "mars", "jupiter", "neptune"])
def test_light_leaves_a_body_its_travel_time_earlier(name: str) -> None:
    """By Brent's method: the time at which the body was as far as light has gone since; places agree to 0.1 km."""
    shipped = ephemeris.load_ephemeris()
    for jd in (2456100.5, 2458849.5, 2460600.5):
        observer = ephemeris.ObserverPlace(
            jd,
            shipped.position_km("earth", jd),
            np.zeros(3),
            ephemeris.GcrsState(*np.zeros((2, 3))),
        )

        def to_body_km(
            delay_s: float, seen: ephemeris.ObserverPlace = observer
        ) -> np.ndarray:
            left_jd = seen.tt_jd - delay_s / 86400
            return shipped.barycentric_km(name, left_jd) - seen.position_km

        delay_s = brentq(
            lambda s, to=to_body_km: np.linalg.norm(to(s)) - 299792.458 * s,
            0.0,
            20000.0,
            xtol=1e-9,
        )
        found_km = ephemeris.place(name, observer).to_body_km
        assert np.linalg.norm(found_km - to_body_km(delay_s)) < 0.1


# The authors' own test values, Mallama & Hilton 2018, file Ap_Mag_Output_V3: au from Sun and observer, degrees, V.
PUBLISHED = [
    ("mercury", 0.310295423552, 1.32182643625754, 1.1677, -2.477),
    ("mercury", 0.413629222334, 0.92644808718613, 90.1662, 0.181),
    ("mercury", 0.448947624811, 0.56004973217883, 178.7284, 7.167),
    ("venus", 0.722722540169, 1.71607489554051, 1.3232, -3.917),
    ("venus", 0.721480714554, 0.37762511206278, 124.1348, -4.916),
    ("venus", 0.726166592736, 0.28889582420642, 179.1845, -3.090),
    ("jupiter", 5.446231815414, 6.44985867459088, 0.2446, -1.667),
    ("jupiter", 4.957681473205, 3.95393078136013, 0.3431, -2.934),
]


def lit(
    name: str, sun_au: float, observer_au: float, phase_deg: float, latitude_deg: float = 0.0
) -> ephemeris.Place:
    """A body seen at a phase angle, Sun and observer at a latitude above its equator."""
    pole = np.array([0.0, 0.0, 1.0])
    if name in body_discs.POLES_DEG:
        ra, dec = np.radians(body_discs.POLES_DEG[name])
        pole = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.cross(pole, [1.0, 0.0, 0.0])
    east /= np.linalg.norm(east)
    across = np.cross(east, pole)
    b = np.radians(latitude_deg)
    half = np.radians(phase_deg) / 2
    outward = np.cos(b) * east + np.sin(b) * pole
    to_sun, to_observer = (
        np.cos(half) * outward + sign * np.sin(half) * across for sign in (1, -1)
    )
    from_sun_km = -to_sun * sun_au * ephemeris.AU_KM
    to_body_km = -to_observer * observer_au * ephemeris.AU_KM
    return ephemeris.lit_place(-to_observer, from_sun_km, to_body_km)


@pytest.mark.parametrize(("name", "sun_au", "observer_au", "phase_deg", "v_mag"), PUBLISHED)
def test_planetary_magnitudes_match_the_authors_examples(
    name: str, sun_au: float, observer_au: float, phase_deg: float, v_mag: float
) -> None:
    at = lit(name, sun_au, observer_au, phase_deg)
    assert np.degrees(at.phase_rad) == pytest.approx(phase_deg, abs=1e-9)
    assert body_discs.magnitude(name, at, J2000_JD) == pytest.approx(v_mag, abs=6e-4)


def test_magnitudes_of_uranus_and_neptune_match_the_authors_examples() -> None:
    """The same file; its latitudes of Uranus are planetographic."""
    year = 365.25
    for latitude_deg, sun_au, observer_au, v_mag in (
        (20.285, 18.321003215845, 17.3229728525108, 5.381),
        (0.995, 20.096361095266, 21.0888470145276, 6.025),
    ):
        flattened = (1 - body_discs.URANUS_FLATTENING) ** 2
        planetocentric = np.degrees(np.arctan(np.tan(np.radians(latitude_deg)) * flattened))
        at = lit("uranus", sun_au, observer_au, 0.05, planetocentric)
        assert body_discs.magnitude("uranus", at, J2000_JD) == pytest.approx(v_mag, abs=1e-3)
    for years, sun_au, observer_au, phase_deg, v_mag in (
        (-29.1, 30.322109867761, 31.3091610098214, 0.0549, 7.997),
        (-9.68, 30.207767693725, 29.8172370857530, 1.7741, 7.827),
    ):
        at = lit("neptune", sun_au, observer_au, phase_deg)
        assert body_discs.magnitude("neptune", at, J2000_JD + years * year) == pytest.approx(
            v_mag, abs=1e-3
        )


@pytest.mark.parametrize("latitude_deg", [10.0, 45.0, -70.0])
def test_the_latitude_of_uranus_is_that_of_the_normal_to_its_ellipsoid(
    latitude_deg: float,
) -> None:
    """ERFA's geodetic latitude of the point below the observer; 8.4e-4 mag a degree (Mallama & Hilton 2018)."""
    at = lit("uranus", 1.0, 1.0, 0.0, latitude_deg)
    level = lit("uranus", 1.0, 1.0, 0.0)
    brighter = body_discs.uranus(0.0, level, J2000_JD) - body_discs.uranus(0.0, at, J2000_JD)
    # Scaled from the center to the surface of the ellipsoid with the equatorial radius 1.
    flattening = body_discs.URANUS_FLATTENING
    b = np.radians(latitude_deg)
    surface = np.array([np.cos(b), 0.0, np.sin(b)])
    surface /= np.hypot(np.cos(b), np.sin(b) / (1 - flattening))
    _, normal_rad, _ = erfa.gc2gde(1.0, flattening, surface)
    assert brighter / 8.4e-4 == pytest.approx(abs(np.degrees(normal_rad)), abs=1e-6)


def test_open_rings_make_saturn_brighter() -> None:
    """Edge on -8.914, at 26.7 degrees -8.914 - (1.825 + 0.378) sin 26.7 at opposition; unlit rings give none."""
    unit = [
        body_discs.magnitude("saturn", lit("saturn", 1.0, 1.0, 0.0, b), J2000_JD)
        for b in (0.0, 26.7)
    ]
    assert unit == pytest.approx(
        [-8.914, -8.914 - 2.203 * np.sin(np.radians(26.7))], abs=1e-6
    )
    at = lit("saturn", 1.0, 1.0, 0.0, 5.0)
    from_below = ephemeris.lit_place(-at.direction, at.from_sun_km, -at.to_body_km)
    assert body_discs.saturn(0.0, from_below, J2000_JD) == pytest.approx(-8.914)


def test_moon_and_sun_at_their_mean_distances() -> None:
    assert body_discs.moon_magnitude(384400.0, 1.0, 0.0) == pytest.approx(-12.73)
    assert body_discs.moon_magnitude(384400.0, 1.0, 90.0) == pytest.approx(-10.13, abs=0.01)
    sun = lit("sun", 1.0, 1.0, 0.0)
    assert body_discs.magnitude("sun", sun, J2000_JD) == pytest.approx(-26.74)


def test_earthshine_has_its_measured_brightness() -> None:
    """The earthlit disc of a thin crescent is some 10 mag fainter than the full Moon; that of a full one is dark."""
    thin = lit("moon", 1.0, body_discs.MOON_KM / ephemeris.AU_KM, 150.0)
    sunlit = body_discs.magnitude("moon", thin, J2000_JD)
    earthlit = sunlit - 2.5 * np.log10(body_discs.earthshine_fraction(thin))
    assert -3.5 < earthlit < -1.5
    full = lit("moon", 1.0, body_discs.MOON_KM / ephemeris.AU_KM, 0.0)
    assert body_discs.earthshine_fraction(full) < 1e-5  # the Earth is new


@pytest.mark.parametrize("phase_deg", [0.0, 40.0, 90.0, 140.0])
def test_a_lambert_sphere_has_lambert_s_phase_and_center(phase_deg: float) -> None:
    """Light (sin a + (pi - a) cos a) / pi of full; by symmetry the light's center lies on the line toward the Sun."""
    a = np.radians(phase_deg)
    x, y = np.meshgrid(*2 * (np.linspace(-1, 1, 801),))
    mu = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    light = np.where(mu > 0, np.maximum(x * np.sin(a) + mu * np.cos(a), 0.0), 0.0)
    full = np.where(mu > 0, mu, 0.0)
    assert light.sum() / full.sum() == pytest.approx(
        (np.sin(a) + (np.pi - a) * np.cos(a)) / np.pi, abs=1e-3
    )
    xy, share = body_discs.disc_elements(body_discs.DiscSurface(body_discs.LAMBERT, a))
    assert share.sum() == pytest.approx(1.0)
    assert share @ xy == pytest.approx([(light * x).sum() / light.sum(), 0.0], abs=2e-3)


def lattice(
    surface: body_discs.DiscSurface, across: int = 200
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    axis = (np.arange(across) + 0.5) * (2 / across) - 1
    x, y = np.meshgrid(axis, axis)
    return x, y, body_discs.light_map(surface, axis)


def test_the_full_moon_is_uniform_and_the_half_moon_ends_at_the_terminator() -> None:
    x, y, share = lattice(body_discs.DiscSurface(body_discs.LOMMEL_SEELIGER, 0.0))
    inside = np.hypot(x, y) < 0.98
    assert np.ptp(share[inside]) < 1e-9 * share.max()
    for phase_deg in (60.0, 90.0, 120.0):
        x, y, share = lattice(
            body_discs.DiscSurface(body_discs.LOMMEL_SEELIGER, np.radians(phase_deg))
        )
        terminator = -np.cos(np.radians(phase_deg)) * np.sqrt(np.maximum(1 - y**2, 0))
        assert (share[x < terminator - 0.01] == 0).all()
        assert (share[(x > terminator + 0.01) & (np.hypot(x, y) < 0.99)] > 0).all()


def test_earthshine_lights_the_whole_disc() -> None:
    x, y, share = lattice(body_discs.DiscSurface(body_discs.LOMMEL_SEELIGER, np.pi / 2, 0.01))
    dark = (x < -0.02) & (np.hypot(x, y) < 0.98)
    assert np.ptp(share[dark]) < 1e-9 * share[dark].max()
    assert share[dark].sum() == pytest.approx(
        0.01 / 1.01 * dark.sum() / (np.hypot(x, y) < 1).sum(), rel=1e-3
    )


def test_the_sun_s_limb_is_dark() -> None:
    """Its mean brightness is 0.30 + 2/3 0.93 - 1/2 0.23 of the center's."""
    _, _, share = lattice(body_discs.DiscSurface(body_discs.LIMB_DARKENED, 0.0))
    mean = share.sum() / (np.pi / 4 * 200**2)
    assert mean / share[100, 100] == pytest.approx(0.30 + 0.62 - 0.115, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "b_v"),
    # Mallama, Krobusek & Pavlov 2017, table 3; the Moon's of color index catalogs.
    [
        ("mercury", 0.97),
        ("venus", 0.70),
        ("mars", 1.36),
        ("jupiter", 0.86),
        ("saturn", 1.07),
        ("uranus", 0.50),
        ("neptune", 0.39),
        ("moon", 0.92),
    ],
)
def test_albedos_have_the_measured_colors(name: str, b_v: float) -> None:
    """B-V is the Sun's and 2.5 log10 of the albedo in V over that in B."""
    blue, visual, *_ = BODIES[name].albedo
    assert SUN[0] + 2.5 * np.log10(visual / blue) == pytest.approx(b_v, abs=0.013)


def test_reflected_light_follows_the_albedo() -> None:
    """A gray body has a G2 star's electrons; at one wavelength a body has that times p / p(V), 0.18 for Uranus in I."""
    gray = bodies.reflected_flux_e_s_m2(3.0, (0.2, 0.2, 0.2, 0.2), BAND)
    assert gray == pytest.approx(float(star_flux_e_s_m2(3.0, *SUN, BAND)), rel=1e-4)
    uranus = BODIES["uranus"].albedo
    for wavelength_m, albedo in zip(bodies.BANDS_M, uranus, strict=True):
        line = Band(wavelength_m + np.array([-1e-9, 0.0, 1e-9]), np.array([0.0, 1.0, 0.0]))
        ratio = bodies.reflected_flux_e_s_m2(0.0, uranus, line) / float(
            bodies.reflected_flux_e_s_m2(0.0, bodies.WHITE, line)
        )
        assert ratio == pytest.approx(albedo / uranus[1], rel=0.01)


def test_the_light_of_all_bodies_is_their_magnitudes() -> None:
    lights = bodies_from(
        BodiesConfig(minor=True),
        ephemeris.observe_from(datetime.datetime(2012, 6, 24, 21), GEOCENTER),
        BAND,
    )
    assert {light.name for light in lights} == set(BODIES)
    distances = [light.place.distance_km for light in lights]
    assert distances == sorted(distances, reverse=True)
    by_name = {light.name: light for light in lights}
    sun = by_name["sun"]
    moon = by_name["moon"]
    ratio = moon.flux_e_s_m2 / (1 + moon.earthshine) / sun.flux_e_s_m2
    # The Moon is redder than the Sun, so it is brighter in a band beyond V than its magnitude says.
    assert 0.0 < moon.magnitude - sun.magnitude + 2.5 * np.log10(ratio) < 0.25
    assert sun.truth().phase_deg == pytest.approx(0, abs=1e-9)
    assert 2 * sun.radius_rad / ARCSEC_RAD == pytest.approx(1888, abs=5)  # near aphelion
