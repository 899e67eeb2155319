"""Apparent directions of catalog stars against astropy's SkyCoord and hand calculations."""

import datetime

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import GCRS, Distance, SkyCoord
from astropy.time import Time
from astropy.utils import iers
from scipy.spatial.transform import Rotation

from skysim.core.constants import SPEED_OF_LIGHT_AU_DAY
from skysim.core.time import J2000_JD, tt_days
from skysim.sources import catalog
from skysim.sources import stars as star_sources
from skysim.sources.catalog import Catalog
from skysim.sources.photometry import Band, star_flux_e_s_m2

MAS_RAD = np.pi / 180 / 3.6e6
ARCSEC_RAD = 1000 * MAS_RAD
DATES = [
    datetime.datetime(1995, 1, 3),
    datetime.datetime(2016, 6, 21, 7, 30),
    datetime.datetime(2027, 10, 9),
]


@pytest.fixture(scope="module")
def stars() -> Catalog:
    return catalog.read("hipparcos_hp6.5")


def star(**fields: float) -> Catalog:
    """One artificial star; angles in radians, at 2000.0."""
    zero = np.zeros(1)
    names = [name for name in Catalog.__slots__ if name not in ("hip", "epoch_jyear")]
    arrays = {name: zero + fields.get(name, 0.0) for name in names}
    return Catalog(hip=np.array([1]), **arrays, epoch_jyear=2000.0)


def separation_rad(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2)


@pytest.mark.parametrize("date", DATES)
def test_apparent_places_match_skycoord(stars: Catalog, date: datetime.datetime) -> None:
    # Stars whose parallax is known: SkyCoord needs a distance for space motion.
    near = stars.take(stars.parallax_rad > 1 * MAS_RAD)
    with (
        iers.conf.set_temp("auto_download", False),
        iers.conf.set_temp("iers_degraded_accuracy", "ignore"),
    ):
        icrs = SkyCoord(
            ra=near.ra_rad * u.rad,
            dec=near.dec_rad * u.rad,
            pm_ra_cosdec=near.pm_ra_rad_yr * u.rad / u.yr,
            pm_dec=near.pm_dec_rad_yr * u.rad / u.yr,
            distance=Distance(parallax=near.parallax_rad * u.rad),
            radial_velocity=np.zeros(len(near)) * u.km / u.s,
            obstime=Time(near.epoch_jyear, format="jyear", scale="tdb"),
        )
        time = Time(date, scale="utc")
        oracle = icrs.apply_space_motion(new_obstime=time).transform_to(GCRS(obstime=time))
    wanted = oracle.cartesian.xyz.value.T
    wanted = wanted / np.linalg.norm(wanted, axis=1, keepdims=True)
    off = separation_rad(star_sources.apparent(near, date), wanted) / MAS_RAD
    assert len(near) > 7000
    # 0.03 mas in 1995 is the fixed leap seconds; 1 mas allows for a star that the Sun is near to.
    assert np.percentile(off, 99) < 0.05
    assert off.max() < 1


def test_annual_aberration_is_an_ellipse_of_20_5_arcsec() -> None:
    # The constant of aberration is 20.4955"; perihelion and the Sun's own motion add or take 0.35" and 0.01".
    pole = star(
        ra_rad=np.radians(270.0), dec_rad=np.radians(66.56)
    )  # the pole of the ecliptic
    days = [datetime.datetime(2021, 1, 1) + datetime.timedelta(days=5 * n) for n in range(73)]
    straight = np.array(
        [np.cos(np.radians(66.56)) * np.array([0, -1, 0]) + [0, 0, np.sin(np.radians(66.56))]]
    )
    off = (
        np.array(
            [separation_rad(star_sources.apparent(pole, day), straight)[0] for day in days]
        )
        / ARCSEC_RAD
    )
    assert off.max() == pytest.approx(20.4955 + 0.34, abs=0.03)
    assert off.min() == pytest.approx(20.4955 - 0.34, abs=0.03)


def test_aberration_shifts_a_star_toward_the_direction_of_motion() -> None:
    # By hand: at right angles to the motion the star moves by v/c toward it; 7.6 km/s is 5.23".
    ahead = np.array([0.0, 0.0, 7600.0])
    still = star_sources.apparent(star(), DATES[1])[0]
    moving = star_sources.apparent(star(), DATES[1], ahead)[0]
    assert (moving - still)[2] / ARCSEC_RAD == pytest.approx(
        7600 / 299792458 / ARCSEC_RAD, rel=1e-3
    )
    assert abs((moving - still)[1]) / ARCSEC_RAD < 0.001  # second order in v/c


def test_alpha_centauri_s_parallax_is_three_quarters_of_an_arcsecond() -> None:
    # The nearest star's parallax: its place with and without one differs by 0.75" at most in a year.
    place = {"ra_rad": np.radians(219.9), "dec_rad": np.radians(-60.83)}
    days = [
        datetime.datetime(2020, 1, 1) + datetime.timedelta(days=10 * n) for n in range(37)
    ]
    shift = [
        separation_rad(
            star_sources.apparent(star(**place, parallax_rad=0.75 * ARCSEC_RAD), day),
            star_sources.apparent(star(**place), day),
        )[0]
        / ARCSEC_RAD
        for day in days
    ]
    assert max(shift) == pytest.approx(0.75, abs=0.02)


def test_proper_motion_is_along_the_parallel_and_the_meridian() -> None:
    # 1"/yr of mu_alpha cos(delta) for 20 years is 20" eastward, at declination 60 as at the equator.
    date = datetime.datetime(2020, 1, 1, 12)
    place = {"ra_rad": 0.0, "dec_rad": np.radians(60.0)}
    still = star_sources.apparent(star(**place), date)[0]
    east = star_sources.apparent(star(**place, pm_ra_rad_yr=ARCSEC_RAD), date)[0] - still
    north = star_sources.apparent(star(**place, pm_dec_rad_yr=ARCSEC_RAD), date)[0] - still
    # 0.01": aberration itself changes by 1e-4 of the 20", and 20 years of 365.25 days end half a day off.
    np.testing.assert_allclose(east / ARCSEC_RAD, [0, 20, 0], rtol=0, atol=0.01)
    np.testing.assert_allclose(
        north / ARCSEC_RAD, [-20 * np.sin(np.radians(60)), 0, 20 * 0.5], rtol=0, atol=0.01
    )


def test_the_sun_deflects_stars_outward() -> None:
    # 1.75" at the limb falls as 1/tan(half the elongation): 4.07 mas at 90 degrees. In March the Sun is at x.
    date = datetime.datetime(2021, 3, 20, 9, 37)  # the equinox, Astronomical Almanac
    pole = star(dec_rad=np.pi / 2)
    sun_side = star_sources.apparent(pole, date)[0]
    _helio, bary = star_sources.erfa.epv00(J2000_JD, tt_days(date))
    beta = bary["v"] / SPEED_OF_LIGHT_AU_DAY
    unbent = star_sources.erfa.ab(
        np.array([0.0, 0.0, 1.0]), beta, 1.0, np.sqrt(1 - beta @ beta)
    )
    assert (unbent - sun_side)[0] / MAS_RAD == pytest.approx(4.07, abs=0.1)


def test_pixels_at_the_vernal_equinox_match_a_hand_calculation() -> None:
    # Looking along X with north (Z) up, east (Y) is left: x = -Y, y = -Z, z = X.
    matrix = star_sources.cam_from_icrs(0.0, 0.0, 0.0).as_matrix()
    np.testing.assert_allclose(
        matrix, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], rtol=0, atol=1e-15
    )


def test_pixels_of_a_rolled_camera_match_a_hand_calculation() -> None:
    # Up at position angle 90 is east: y = -Y; then north is to the right: x = +Z.
    matrix = star_sources.cam_from_icrs(0.0, 0.0, 90.0).as_matrix()
    np.testing.assert_allclose(matrix, [[0, 0, 1], [0, -1, 0], [1, 0, 0]], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("ra_deg", "dec_deg"), [(83.8, -5.4), (0.1, 45.0), (359.9, -70.0), (200.0, 89.0)]
)
def test_north_is_up_and_east_is_left(ra_deg: float, dec_deg: float) -> None:
    cam = star_sources.cam_from_icrs(ra_deg, dec_deg, 0.0)

    def look(ra: float, dec: float) -> np.ndarray:
        ra, dec = np.radians([ra, dec])
        return cam.apply([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])

    # 1e-15: rounding of the unit vectors.
    np.testing.assert_allclose(look(ra_deg, dec_deg), [0, 0, 1], rtol=0, atol=1e-15)
    north = look(ra_deg, dec_deg + 0.1)
    east = look(ra_deg + 0.1, dec_deg)
    np.testing.assert_allclose(north[:2], [0, -np.sin(np.radians(0.1))], rtol=0, atol=1e-15)
    assert east[0] < 0
    assert abs(east[1]) < 0.1 * abs(east[0])


@pytest.mark.parametrize("roll_deg", [-120.0, 30.0, 250.0])
def test_roll_is_the_position_angle_of_up(roll_deg: float) -> None:
    ra_deg = 150.0
    dec_deg = 35.0
    up_icrs = (
        star_sources.cam_from_icrs(ra_deg, dec_deg, roll_deg).inv().apply([0.0, -1e-6, 1.0])
    )
    center = SkyCoord(ra_deg, dec_deg, unit="deg")
    toward = SkyCoord(*up_icrs, representation_type="cartesian").represent_as("unitspherical")
    angle = center.position_angle(SkyCoord(toward.lon, toward.lat)).deg
    # 1e-5 degree: the position angle of an arc 1e-6 rad long.
    assert (angle - roll_deg + 180) % 360 - 180 == pytest.approx(0, abs=1e-5)


def test_sources_are_lit_points_at_infinity_in_lab_axes(stars: Catalog) -> None:
    lab_from_icrs = Rotation.from_euler("zyx", [0.3, -1.1, 2.0])
    seen = star_sources.sources(
        stars, DATES[1], 2.0, lab_from_icrs, Band.from_efficiency(0.5)
    )
    kept = stars.take(stars.v_mag <= 2.0)
    assert len(seen) == len(kept) > 40
    np.testing.assert_array_equal(seen.id, kept.hip)
    np.testing.assert_array_equal(seen.place[:, 3], 0)
    # 1e-14: rounding of a rotation there and back.
    np.testing.assert_allclose(
        lab_from_icrs.inv().apply(seen.place[:, :3]),
        star_sources.apparent(kept, DATES[1]),
        rtol=0,
        atol=1e-14,
    )
    np.testing.assert_array_equal(seen.period_s, seen.on_s)
    np.testing.assert_array_equal(seen.magnitude, kept.v_mag)
    strength = star_flux_e_s_m2(kept.v_mag, kept.b_v, kept.v_i, Band.from_efficiency(0.5))
    np.testing.assert_array_equal(seen.strength, strength)


def test_sources_are_as_bright_as_their_magnitude_and_color(stars: Catalog) -> None:
    """In half of all photons of 400-1000 nm, against the reference's 5.62e10 photons/s/m² of a G2 star at V = 0."""
    seen = star_sources.sources(
        stars, DATES[1], 2.0, Rotation.identity(), Band.from_efficiency(0.5)
    )
    relative = {
        int(hip): strength / (0.5 * 5.62e10 * 10 ** (-0.4 * v_mag))
        for hip, strength, v_mag in zip(seen.id, seen.strength, seen.magnitude, strict=True)
    }
    assert relative[71683] == pytest.approx(1, abs=0.03)  # alpha Centauri A, G2
    assert (
        relative[32349] < 0.9
    )  # Sirius: white, so fewer photons in the red beside the same V
    assert relative[27989] > 1.5  # Betelgeuse


def test_a_limit_brighter_than_every_star_gives_no_source(stars: Catalog) -> None:
    assert (
        len(
            star_sources.sources(
                stars, DATES[0], -5.0, Rotation.identity(), Band.from_efficiency(0.5)
            )
        )
        == 0
    )
