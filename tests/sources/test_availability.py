"""Availability of a tracker in orbit against spherical trigonometry."""

from __future__ import annotations

import datetime

import numpy as np
import pytest

from skysim.core.constants import EARTH_RADIUS_M
from skysim.core.time import tt_jd
from skysim.scene.sections.surroundings import CircularOrbitConfig, ExclusionConfig
from skysim.sources import camera_orbit
from skysim.sources.camera_orbit import CircularOrbit, Pointing, place_spline, sample
from skysim.sources.ephemeris import load_ephemeris

START = datetime.datetime(2024, 3, 20, 3)
POLE = np.array([[0.0, 0.0, 1.0]])


@pytest.fixture
def sphere(monkeypatch: pytest.MonkeyPatch) -> CircularOrbit:
    """An equatorial orbit of 700 km about a round Earth without J2."""
    monkeypatch.setattr(camera_orbit, "EARTH_J2", 0.0)
    monkeypatch.setattr(camera_orbit, "TO_SPHERE", np.full(3, 1 / EARTH_RADIUS_M))
    return CircularOrbit(
        CircularOrbitConfig(kind="circular", altitude="700 km", inclination_deg=0.0)
    )


def revolution_s(orbit: CircularOrbit) -> np.ndarray:
    count = 20_000
    return (np.arange(count) + 0.5) * (2 * np.pi / orbit.rates_rad_s[0] / count)


@pytest.mark.parametrize("from_pole_deg", [70.0, 40.0, 100.0, 20.0])
@pytest.mark.parametrize("earth_deg", [10.0, 25.0])
def test_the_free_share_of_an_inertial_boresight_matches_trigonometry(
    sphere: CircularOrbit, from_pole_deg: float, earth_deg: float
) -> None:
    """cos(nadir angle) = -sin(b) cos(u) for a boresight at b from the orbit's pole; the Earth's radius is arcsin(R/r).

    It is free where that is below cos(arcsin(R/r) + limit): the fraction 1 - arccos(cos(...) / sin b) / pi.
    """
    tilt = np.radians(from_pole_deg)
    pointing = Pointing("inertial", np.array([np.sin(tilt), 0.0, np.cos(tilt)]))
    found = sample(sphere, START, revolution_s(sphere), pointing, POLE, 0.1)
    free = found.outside(ExclusionConfig(earth_deg=earth_deg, stars=0))["Earth"].mean()
    limit = np.cos(
        np.arcsin(EARTH_RADIUS_M / (EARTH_RADIUS_M + 700e3)) + np.radians(earth_deg)
    )
    expected = 1 - np.arccos(np.clip(limit / np.sin(tilt), -1, 1)) / np.pi
    assert free == pytest.approx(expected, abs=1e-3)


def test_a_boresight_off_the_zenith_keeps_its_angle_to_the_limb(
    sphere: CircularOrbit,
) -> None:
    found = sample(
        sphere,
        START,
        revolution_s(sphere)[::40],
        Pointing("zenith", POLE[0], 0.6, 1.1),
        POLE,
        0.1,
    )
    limb_deg = 180 - np.degrees(np.arcsin(EARTH_RADIUS_M / (EARTH_RADIUS_M + 700e3)) + 0.6)
    assert found.earth_deg == pytest.approx(np.full(500, limb_deg), abs=1e-6)


def test_the_sun_excludes_a_cone_over_the_year(sphere: CircularOrbit) -> None:
    """An orbit about the equator, zenith pointing, at the equinox: the Sun is within 90 degrees for half an orbit."""
    found = sample(
        sphere, START, revolution_s(sphere), Pointing("zenith", POLE[0]), POLE, 0.1
    )
    assert found.outside(ExclusionConfig(sun_deg=90, stars=0))["Sun"].mean() == pytest.approx(
        0.5, abs=1e-3
    )
    assert found.sun_deg.min() < 1.0


def test_stars_are_counted_in_the_field_and_above_the_limb(sphere: CircularOrbit) -> None:
    found = sample(
        sphere,
        START,
        revolution_s(sphere)[::40],
        Pointing("inertial", np.array([1.0, 0, 0])),
        POLE,
        2.1,
    )
    up = sample(
        sphere,
        START,
        revolution_s(sphere)[::40],
        Pointing("inertial", np.array([0, 0, 1.0])),
        POLE,
        0.01,
    )
    assert set(found.stars) == {0}  # so wide a field always has the limb in it
    assert set(up.stars) == {1}


@pytest.mark.parametrize("name", ["sun", "moon"])
def test_positions_between_nodes_match_the_ephemeris(name: str) -> None:
    spline = place_spline(name, START, 1e5)
    ephemeris = load_ephemeris()
    for t_s in (1234.0, 54321.0):
        jd = tt_jd(START) + t_s / 86400
        exact = 1e3 * (
            ephemeris.barycentric_km(name, jd) - ephemeris.position_km("earth", jd)
        )
        assert np.linalg.norm(spline(t_s) - exact) < 5e-8 * np.linalg.norm(exact)


def test_stars_are_counted_to_the_edge_of_the_field(sphere: CircularOrbit) -> None:
    """By their angles from an inertial boresight, of which the Earth hides nothing at this time."""
    axis = np.array([1.0, 0.0, 0.0])
    angle = np.array([0.0, 0.05, 0.2999, 0.3001, 0.5])
    stars = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    found = sample(
        sphere, START, np.array([0.0, 1.0]), Pointing("inertial", axis), stars, 0.3
    )
    assert found.stars.tolist() == [3, 3]


def test_a_boresight_is_outside_a_body_s_exclusion_only_beyond_its_own_angle() -> None:
    """Three times: within, at and beyond the limit of one body, while the others' limits are elsewhere."""
    near = np.array([-1.0, 0.0, 1.0])
    exclusion = ExclusionConfig(sun_deg=40, earth_deg=25, moon_deg=10, stars=5)
    found = camera_orbit.SkySamples(
        t_s=np.arange(3.0),
        sun_deg=40 + near,
        earth_deg=25 + near,
        moon_deg=10 + near,
        stars=np.array([4, 5, 6]),
    ).outside(exclusion)
    assert {body: ok.tolist() for body, ok in found.items()} == {
        "Sun": [False, False, True],
        "Earth": [False, False, True],
        "Moon": [False, False, True],
        "stars": [False, True, True],
    }
