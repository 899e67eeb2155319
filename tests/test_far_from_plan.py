"""Flights far from the plan: blows beyond all limits, stops, failed integrations, flights of one tick."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Telemetry
from skysim.results import telemetry_report
from skysim.scene import loader
from skysim.simulation.flight import open_flight, simulate_motion

QUIET = "{time: 1 ms, rate_hz: 10, frames: 1, first: %s s}"


def off_deg(believed: Rotation | None, telemetry: Telemetry) -> np.ndarray:
    assert believed is not None
    return np.degrees((believed.inv() * telemetry.lab_from_body).magnitude())


@pytest.mark.long
@pytest.mark.parametrize(
    ("actuators", "more"),
    [
        ("ideal", {}),
        ("wheels", {"vehicle.wheels": "{torque_limit: 1 N m, speed_limit_rpm: 20000}"}),
    ],
)
def test_after_a_blow_beyond_the_torque_limit_the_vehicle_brakes_and_returns(
    actuators: str, more: dict[str, str]
) -> None:
    """80 deg/s about z: J w / T = 12.6 s at the least to stop, more than once round; home within four times that."""
    blow = (
        "[{kind: hold, duration: 1 s}, {kind: bump, rate_deg_s: [0, 0, 80], duration: 40 ms}]"
    )
    overrides = {
        "motion.maneuver": blow,
        "motion.control": f"{{actuators: {actuators}}}",
        "exposure": QUIET % 50,
        **more,
    }
    telemetry = simulate_motion(loader.load("afit_simsat", overrides)).telemetry()
    rate = np.degrees(np.linalg.norm(telemetry.rate_body_rad_s, axis=1))
    assert rate.max() > 75
    assert off_deg(telemetry.lab_from_ref, telemetry)[-1] < 0.01
    assert rate[-1] < 0.01


@pytest.mark.long
def test_steered_by_gyros_at_their_limit_the_vehicle_still_brakes() -> None:
    """After a blow to six times the gyros' limit and without a star tracker, it comes to rest at some attitude."""
    overrides = {
        "vehicle.imu": "{gyro: {rate_limit_deg_s: 10}}",
        "motion.control": "{feedback: imu}",
        "motion.maneuver": "[{kind: bump, rate_deg_s: [0, 0, 60], duration: 40 ms}]",
        "exposure": QUIET % 40,
    }
    telemetry = simulate_motion(loader.load("afit_simsat", overrides)).telemetry()
    assert np.degrees(np.linalg.norm(telemetry.rate_body_rad_s[-1])) < 0.05


def test_a_maneuver_beyond_the_tilt_stop_is_refused_before_the_flight() -> None:
    overrides = {
        "motion.maneuver": "[{kind: slew, roll_deg: 45, rate_deg_s: 10}]",
        "exposure": QUIET % 20,
    }
    with pytest.raises(
        InputError, match=r"motion.maneuver: tilt of 30\.\d deg at \d+\.\d+ s; allowed: up to"
    ):
        open_flight(loader.load("afit_simsat", overrides))


def test_a_flight_that_cannot_be_integrated_is_one_error_line_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    overrides = {
        "vehicle.disturbances": "{cable: {stiffness: 1e6 N m / rad}}",
        "vehicle.model": "vehicles/cubesat.xml",
        "exposure": QUIET % 0.3,
    }
    with pytest.raises(
        InputError, match="motion: not integrable at a step of 1 ms: MuJoCo warned before"
    ):
        simulate_motion(loader.load("afit_simsat", overrides))
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_navigator_drifts_by_the_gyros_apparent_bias() -> None:
    """Turning at a constant rate with scale errors, misalignments and a bias, and no noise: the integral of it."""
    overrides = {
        "vehicle.imu": "{gyro: {arw_deg_sqrt_h: 0, bias_deg_h: 0, turn_on_bias_deg_h: 20, scale_ppm: 500,"
        " misalignment_arcsec: 60, quantum_arcsec: 0}}",
        "motion.rate_deg_s": "[0, 0, 5]",
        "motion.control": "none",
        "motion.maneuver": "[]",
        "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
        "exposure": QUIET % 20,
    }
    telemetry = simulate_motion(loader.load("afit_simsat", overrides)).telemetry()
    assert telemetry.lab_from_imu is not None
    assert telemetry.bias_rad_s is not None
    off = (telemetry.lab_from_imu * telemetry.lab_from_body.inv()).as_rotvec()[-1]
    drift = (
        telemetry.lab_from_body.apply(telemetry.bias_rad_s)[:-1].sum(axis=0)
        * telemetry.period_s
    )
    assert np.linalg.norm(drift) > 1e-3
    np.testing.assert_allclose(off, drift, rtol=0, atol=2e-3 * np.linalg.norm(drift))


def test_a_flight_of_one_tick_has_a_report() -> None:
    overrides = {
        "vehicle.imu": "{}",
        "exposure": "{time: 1 ms, rate_hz: 10, frames: 1, first: 0 s}",
    }
    telemetry = simulate_motion(loader.load("afit_simsat", overrides)).telemetry()
    assert telemetry_report.summary(telemetry)["gyro_saturated_s"] == 0
