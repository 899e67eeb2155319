"""A two-axis mount: azimuth and elevation, their limits, gimbal lock, resolution and backlash."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.dynamics.profile_samples import Samples
from skysim.dynamics.two_axis import on_gimbals
from skysim.scene import loader
from skysim.scene.sections.vehicle import GimbalsConfig
from skysim.simulation.flight import Flight
from skysim.simulation.lab import build_lab, with_parts

MOUNT = "two_axis_mount"
T_S = np.arange(0, 11.05, 0.1)


def commanded(azimuth_deg: Floats, elevation_deg: Floats, roll_deg: float = 0.0) -> Samples:
    """Samples of these angles, one each 0.1 s, from line 2 of a file on."""
    places = np.arange(2, 2 + len(azimuth_deg))
    angles = np.column_stack([azimuth_deg, elevation_deg, np.full(len(places), roll_deg)])
    attitude = Rotation.from_euler("ZYX", angles, degrees=True)
    t_s = 0.1 * np.arange(len(places))
    return Samples("a.csv", "line", places, t_s, "lab", "body", attitude)


def angles_deg(samples: Samples) -> Floats:
    """(2, N) azimuths and elevations between -90 and 90 deg."""
    return samples.a_from_b.as_euler("ZYX", degrees=True)[:, :2].T


def matrix(azimuth: float, elevation: float) -> Floats:
    """Rz(azimuth) Ry(elevation), written out."""
    c, s = math.cos(azimuth), math.sin(azimuth)
    Rz = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = math.cos(elevation), math.sin(elevation)
    return np.asarray(Rz @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))


def test_the_motion_is_rz_of_azimuth_ry_of_elevation_with_the_rates_of_both_axes() -> None:
    """In body axes the rate is (-azimuth' sin(elevation), elevation', azimuth' cos(elevation))."""
    phase = 2 * math.pi * T_S / 11
    table = {
        "t_s": T_S,
        "azimuth_deg": 170 + 6 * np.sin(phase),
        "elevation_deg": 48 + 4 * np.cos(phase),
    }
    exact = {"resolution_arcsec": "0", "backlash_arcsec": "0"}
    scene = loader.load(MOUNT, {f"vehicle.gimbals.{key}": v for key, v in exact.items()})
    scene, parts = with_parts(scene, profile=table)
    flown = Flight(build_lab(scene, parts), parts).simulate_motion().trajectory()
    for t in 0.0, 2.2, 5.17, 9.9:
        w = 2 * math.pi / 11
        azimuth, elevation = np.radians([170 + 6 * math.sin(w * t), 48 + 4 * math.cos(w * t)])
        turn, tilt = np.radians([6 * w * math.cos(w * t), -4 * w * math.sin(w * t)])
        error = Rotation.from_matrix(matrix(azimuth, elevation)).inv() * flown.attitude_at(t)
        assert error.magnitude() < 0.1 * ARCSEC_RAD
        rate = [-turn * math.sin(elevation), tilt, turn * math.cos(elevation)]
        assert flown.rate_at(t) == pytest.approx(rate, abs=2e-5)


def test_a_perfect_mount_takes_each_attitude_even_with_the_boresight_at_zenith_or_horizon() -> (
    None
):
    asked = commanded(np.linspace(100, 250, 61), np.linspace(-90, 90, 61))
    taken = on_gimbals(asked, GimbalsConfig(azimuth_deg=(0, 360)))
    assert (taken.a_from_b.inv() * asked.a_from_b).magnitude().max() < 1e-12


def test_an_axis_rests_after_a_reversal_until_its_play_is_used_up() -> None:
    """There and back the same command leaves the axis apart by the play."""
    there = np.linspace(0, 1, 51)
    asked = commanded(np.concatenate([there, there[::-1]]), np.full(102, 40.0))
    azimuth = angles_deg(on_gimbals(asked, GimbalsConfig(backlash_arcsec=36)))[0]
    assert azimuth[25] == pytest.approx(there[25] - 0.005, abs=1e-9)
    assert azimuth[101 - 25] - azimuth[25] == pytest.approx(36 / 3600, abs=1e-9)
    assert azimuth[51] == azimuth[50]


def test_angles_are_whole_steps_of_the_resolution() -> None:
    rng = np.random.default_rng(4)
    asked = commanded(np.cumsum(rng.random(40)), 40 + rng.random(40))
    steps = angles_deg(on_gimbals(asked, GimbalsConfig(resolution_arcsec=36))) / 0.01
    assert np.abs(steps - steps.round()).max() < 1e-6
    assert np.abs(steps * 0.01 - angles_deg(asked)).max() <= 0.005 + 1e-9


LEVEL = np.full(5, 40.0)


@pytest.mark.parametrize(
    ("samples", "told"),
    [
        (
            commanded(np.arange(5), LEVEL, 1.0),
            "from any of a two-axis mount.*azimuth_deg, el",
        ),
        (commanded(np.arange(5) + 177, LEVEL), r"line 6.*azimuth 181 deg.*-180 to 180"),
        (commanded(np.arange(5), LEVEL + 51), "elevation 91 deg.*-90 to 90"),
        (commanded(np.arange(5) * 4, LEVEL), "azimuth at 40 deg/s, at elevation 40 deg"),
    ],
)
def test_what_no_two_axis_mount_can_do_is_refused(samples: Samples, told: str) -> None:
    with pytest.raises(InputError, match=told):
        on_gimbals(samples, GimbalsConfig())


def past_zenith(miss_deg: float) -> tuple[Floats, Floats]:
    """Azimuth and elevation of a light that passes the zenith at this distance, at 1 deg/s."""
    along = np.radians(np.linspace(-2, 2, 41))
    x, y, z = np.sin(along), np.full(41, math.radians(miss_deg)), np.cos(along)
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(np.hypot(x, y), z))


def test_beside_the_zenith_the_azimuth_needs_the_rate_over_the_sine_of_the_elevation() -> (
    None
):
    """1 deg/s at 1 deg from the zenith is 57 deg/s of azimuth; at 0.1 deg the mount is told to be in gimbal lock."""
    config = GimbalsConfig(rate_limit_deg_s=58)
    on_gimbals(commanded(*past_zenith(1.0)), config)
    with pytest.raises(InputError, match="0 is gimbal lock"):
        on_gimbals(commanded(*past_zenith(1.0)), GimbalsConfig(rate_limit_deg_s=56))
    with pytest.raises(
        InputError, match=r"azimuth at \d+ deg/s, at elevation 0\.1.*gimbal lock"
    ):
        on_gimbals(commanded(*past_zenith(0.1)), config)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"motion.control": "pid"}, "vehicle.gimbals: mount two_axis.*prescribed"),
        ({"vehicle.gimbals": "null"}, "vehicle.gimbals: mount two_axis has them"),
        ({"vehicle.mount": "free"}, "vehicle.gimbals: mount two_axis has them"),
    ],
)
def test_a_mount_needs_gimbals_and_a_profile(changes: dict[str, str], told: str) -> None:
    with pytest.raises(InputError, match=told):
        loader.load(MOUNT, changes)
