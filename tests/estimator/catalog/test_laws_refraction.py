"""Laws of refraction as the tracker undoes it, and against ERFA."""

from __future__ import annotations

import datetime

import erfa
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from scipy.spatial.transform import Rotation

from estimator.catalog import refraction
from estimator.catalog.refraction import SiteAir
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids
from tests.helpers.laws import SEEDS, law, units

ARCSEC = erfa.DAS2R
DATES = some.datetimes(datetime.datetime(1950, 1, 1), datetime.datetime(2060, 1, 1))


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a - b, axis=-1)


@law(refraction.raised, refraction.lowered, SiteAir.seen, SiteAir.without_air)
@given(rng=SEEDS, pressure_hpa=some.floats(300, 1100), temperature_c=some.floats(-60, 45))
def test_lowering_undoes_the_raising_by_refraction(
    rng: np.random.Generator, pressure_hpa: float, temperature_c: float
) -> None:
    constants = refraction.refraction_constants(pressure_hpa, temperature_c, 6e-7)
    directions = units(rng, 200)
    zenith = units(rng, 1)[0]
    up = refraction.raised(directions, zenith, *constants)
    high = up @ zenith > np.sin(np.radians(6.0))
    assert (up @ zenith >= directions @ zenith - 1e-15).all()
    np.testing.assert_allclose(
        refraction.lowered(up, zenith, *constants)[high], directions[high], rtol=0, atol=1e-9
    )
    # In a vertical plane.
    np.testing.assert_allclose(np.cross(up, directions) @ zenith, 0, rtol=0, atol=1e-12)
    air = SiteAir(50.0, 8.0, "2012-06-24T23:00", pressure_hpa, temperature_c)
    seen = air.seen(directions, 100.0)
    np.testing.assert_allclose(
        seen, refraction.raised(directions, air.zenith(100.0), *constants), rtol=0, atol=1e-15
    )
    high = seen @ air.zenith(100.0) > np.sin(np.radians(6.0))
    np.testing.assert_allclose(
        air.without_air(seen, 100.0)[high], directions[high], rtol=0, atol=1e-9
    )
    none = SiteAir(50.0, 8.0, "2012-06-24T23:00", 0.0)
    np.testing.assert_allclose(none.seen(directions, 0.0), directions, rtol=0, atol=1e-15)


@law(refraction.solve_through_air)
@given(rng=SEEDS, t_s=some.sampled_from([0.0, 0.5, 60.0, 3600.0]))
def test_lights_are_moved_to_where_the_air_of_the_epoch_would_show_them(
    rng: np.random.Generator, t_s: float
) -> None:
    camera = Camera(640, 480, 900.0, (319.5, 239.5))
    air = SiteAir(50.0, 8.0, "2012-06-24T23:00")
    zenith = air.zenith(t_s)
    up = Rotation.align_vectors([[0.0, 0.0, 1.0]], [zenith])[0]
    cam_from_ref = Rotation.from_rotvec([rng.uniform(0, 1), 0.0, 0.0]) * up
    lights = Centroids(rng.uniform(0, 479, (9, 2)), np.full(9, 0.1), np.ones(9))
    given_px = []

    def solve(centroids: Centroids) -> Attitude:
        given_px.append(centroids.xy_px)
        return Attitude("solved", cam_from_ref)

    refraction.solve_through_air(solve, camera, air, t_s, lights)
    assert given_px[0] is lights.xy_px
    assert len(given_px) == (3 if t_s > 1 else 1)
    seen = cam_from_ref.inv().apply(camera.rays(lights.xy_px))
    moved = cam_from_ref.inv().apply(camera.rays(given_px[-1]))
    if t_s > 1:
        without = [air.without_air(seen, t_s), air.without_air(moved, 0.0)]
        np.testing.assert_allclose(*without, rtol=0, atol=1e-9)
    refused = refraction.solve_through_air(lambda _: Attitude("no"), camera, air, t_s, lights)
    assert refused.status == "no"


@law(refraction.refraction_constants)
@given(some.floats(500, 1060), some.floats(-20, 30), some.floats(4.5e-7, 1e-6))
def test_refraction_matches_erfa(
    pressure_hpa: float, temperature_c: float, wavelength_m: float
) -> None:
    """SOFA's A and B, of dry air: within 0.2" down to 15 degrees."""
    ours = refraction.refraction_constants(pressure_hpa, temperature_c, wavelength_m)
    theirs = erfa.refco(pressure_hpa, temperature_c, 0.0, wavelength_m * 1e6)
    tangent = np.tan(np.radians([30.0, 45.0, 60.0, 75.0]))
    ours_rad, theirs_rad = (a * tangent + b * tangent**3 for a, b in (ours, theirs))
    assert (np.abs(ours_rad - theirs_rad) < 0.2 * ARCSEC).all()


@law(refraction.zenith_icrs, SiteAir.zenith)
@given(DATES, some.floats(-90, 90), some.floats(-180, 180), some.floats(-1e5, 1e5))
def test_the_zenith_matches_erfa(
    utc: datetime.datetime, latitude: float, longitude: float, t_s: float
) -> None:
    """By precession and nutation of IAU 2006/2000A and the Earth rotation angle, of UTC for UT1 in both."""
    days = (utc - datetime.datetime(2000, 1, 1, 12)) / datetime.timedelta(
        days=1
    ) + t_s / 86400
    theta = erfa.era00(erfa.DJ00, days) + np.radians(longitude)
    lat = np.radians(latitude)
    up = np.array([np.cos(lat) * np.cos(theta), np.cos(lat) * np.sin(theta), np.sin(lat)])
    wanted = up @ erfa.c2i06a(erfa.DJ00, days + 69.184 / 86400)
    ours = SiteAir(latitude, longitude, utc).zenith(t_s)
    assert apart(ours, wanted) < 25 * ARCSEC
    np.testing.assert_allclose(
        ours, refraction.zenith_icrs(days, lat, np.radians(longitude)), rtol=0, atol=1e-9
    )
    zone = datetime.timezone(datetime.timedelta(hours=-3))
    aware = SiteAir(latitude, longitude, utc.replace(tzinfo=datetime.UTC).astimezone(zone))
    np.testing.assert_allclose(aware.zenith(t_s), ours, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"latitude_deg": 91.0}, "latitude_deg"),
        ({"pressure_hpa": -1.0}, "pressure_hpa"),
        ({"wavelength_m": 2.9e-7}, "wavelength_m"),
        ({"epoch": "now"}, "date"),
    ],
)
def test_bad_air_is_refused(change: dict, name: str) -> None:
    with pytest.raises(ImageError, match=name):
        SiteAir(
            **{"latitude_deg": 50.0, "longitude_deg": 8.0, "epoch": "2012-06-24T23:00"}
            | change
        )


def edlen_1966(wavelength_um: float) -> float:
    """n - 1 of standard air, at 15 deg C (Edlen 1966, Metrologia 2, 71), within 1e-8 of the formula of 1953."""
    per_um2 = wavelength_um**-2
    return 1e-8 * (8342.13 + 2406030 / (130 - per_um2) + 15997 / (38.9 - per_um2))


@pytest.mark.parametrize("wavelength_um", [0.35, 0.45, 0.6, 0.9, 2.0])
@pytest.mark.parametrize(("pressure_hpa", "temperature_c"), [(1013.25, 15.0), (700.0, -20.0)])
def test_the_constants_of_refraction_follow_from_the_refractivity(
    wavelength_um: float, pressure_hpa: float, temperature_c: float
) -> None:
    """In proportion to the density, with air whose scale height is 0.001254 of the Earth's radius at 0 deg C."""
    t_k = 273.15 + temperature_c
    g = edlen_1966(wavelength_um) * pressure_hpa / 1013.25 * 288.15 / t_k
    beta = 0.001254 * t_k / 273.15
    found = refraction.refraction_constants(pressure_hpa, temperature_c, 1e-6 * wavelength_um)
    expected = g * (1 - beta), -g * (beta - g / 2)
    np.testing.assert_allclose(found, expected, rtol=6e-5)


@pytest.mark.parametrize("centuries", [-0.5, -0.2, 0.12, 0.3, 0.6])
def test_precession_is_that_of_1976_and_sidereal_time_that_of_1982(centuries: float) -> None:
    """By ERFA's, whose cubic terms are below 0.02" in these years."""
    days = 36525 * centuries + 0.3
    latitude = np.radians(41.0)
    longitude = np.radians(-77.0)
    theta = erfa.gmst82(erfa.DJ00, days) + longitude
    of_date = erfa.s2c(theta, latitude)
    wanted = erfa.pmat76(erfa.DJ00, days).T @ of_date
    ours = refraction.zenith_icrs(days, latitude, longitude)
    assert apart(ours, wanted) < 0.03 * ARCSEC


def test_a_star_is_lowered_by_its_apparent_zenith_distance_up_to_85_degrees() -> None:
    """A tan z + B tan^3 z; below, where the formula fails, as at 85 degrees; nothing at the zenith."""
    a_rad, b_rad = 2.8e-4, -3e-7
    zenith = np.array([0.0, 0.0, 1.0])
    z_deg = np.array([0.0, 10.0, 60.0, 84.9, 85.0, 86.0, 89.0])
    z = np.radians(z_deg)
    seen = np.column_stack([np.sin(z), 0 * z, np.cos(z)])
    found = refraction.lowered(seen, zenith, a_rad, b_rad)
    tangent = np.tan(np.minimum(z, np.radians(85.0)))
    true = z + a_rad * tangent + b_rad * tangent**3
    np.testing.assert_allclose(
        found, np.column_stack([np.sin(true), 0 * z, np.cos(true)]), rtol=0, atol=1e-12
    )
    # Back again, to what six rounds leave: below 85 degrees to the true place's own rounding.
    again = refraction.raised(found[:5], zenith, a_rad, b_rad)
    np.testing.assert_allclose(again, seen[:5], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("t_s", "solutions"), [(0.99, 1), (1.01, 3), (-0.99, 1), (-1.01, 3)])
def test_the_air_of_a_second_ago_is_the_same(t_s: float, solutions: int) -> None:
    """After it, two corrections."""
    camera = Camera(640, 480, 900.0, (319.5, 239.5))
    air = SiteAir(50.0, 8.0, "2012-06-24T23:00")
    up = Rotation.align_vectors([[0.0, 0.0, 1.0]], [air.zenith(t_s)])[0]
    tried = []

    def solve(centroids: Centroids) -> Attitude:
        tried.append(centroids)
        return Attitude("solved", up)

    lights = Centroids(np.full((3, 2), 100.0), np.full(3, 0.1), np.ones(3))
    refraction.solve_through_air(solve, camera, air, t_s, lights)
    assert len(tried) == solutions
