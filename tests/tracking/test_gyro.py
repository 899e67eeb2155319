"""The rate of a frame that the tracker gets from the flight's gyros."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.scene.loader import load
from skysim.simulation.flight import open_flight, simulate_motion
from skysim.simulation.lab import exposure_window
from skysim.tracking.navigation import latest, rate_of_frame, sigma_rad_s

FLIGHT = {
    "vehicle.imu": "{}",
    "camera.shutter": "{kind: rolling, row_time: '80 us'}",
    "motion.rate_deg_s": "[1.5, 1.0, 0.3]",
    "exposure.frames": "4",
}


@pytest.mark.slow
@pytest.mark.parametrize("gyro", [False, True])
def test_the_tracker_of_a_flight_gets_the_gyro_s_rate(gyro: bool) -> None:
    """An LN-200 tells the rate to a few seconds of arc a second; the frame alone to some hundred."""
    flight = open_flight(load("shefex2", FLIGHT | {"tracker.gyro": str(gyro).lower()}))
    sigma = []
    error = []
    for shot in flight.shots():
        rate = shot.report.attitude.rate
        assert rate is not None
        sigma.append(np.degrees(np.sqrt(np.trace(rate.covariance_rad2_s2))))
        error.append(np.degrees(np.linalg.norm(rate.rate_rad_s - shot.truth.rate_cam_rad_s)))
    assert (max(sigma) < 0.01) == gyro
    assert np.max(error) < 4 * np.max(sigma)


@pytest.mark.slow
def test_the_rate_of_a_frame_does_not_depend_on_the_buffer_of_samples() -> None:
    """The rate at the frame's due time needs neither later samples nor those that a flight drops."""
    scene = load("shefex2", FLIGHT | {"tracker.gyro": "true"})
    flight = open_flight(scene)
    shots = list(flight.shots())
    forgetful = list(open_flight(scene, keeps_history=False).shots())
    samples = flight.imu_samples()
    mount = flight.lab.camera.mount
    assert samples is not None
    assert scene.vehicle.imu is not None
    assert len(shots) == len(forgetful) == 4
    for shot, other in zip(shots, forgetful, strict=True):
        window = exposure_window(scene, shot.frame.index)
        after = rate_of_frame(samples, window, scene.vehicle.imu, mount)
        rates = [shot.rate, other.rate, after]
        np.testing.assert_allclose(
            np.ptp([rate.rate_rad_s for rate in rates], axis=0), 0, rtol=0, atol=1e-9
        )
        solved = [one.report.attitude.rate.rate_rad_s for one in (shot, other)]
        np.testing.assert_allclose(solved[0], solved[1], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_rate_has_a_correct_covariance_and_is_absent_if_saturated() -> None:
    """Its error over the units of production: squared, over the claim, 3 in the mean (biases and noise are normal)."""
    nees = []
    for unit in range(40):
        scene = load(
            "shefex2",
            FLIGHT | {"vehicle.imu": f"{{hardware_seed: {unit}}}", "seed": str(unit)},
        )
        flight = simulate_motion(scene)
        config = scene.vehicle.imu
        samples = flight.imu_samples()
        mount = flight.lab.camera.mount
        assert config is not None
        assert samples is not None
        _, truth = flight.render(0)
        window = exposure_window(scene, 0)
        rate = rate_of_frame(samples, window, config, mount)
        assert rate is not None
        error = rate.rate_rad_s - truth.rate_cam_rad_s
        nees.append(error @ np.linalg.solve(rate.covariance_rad2_s2, error))
    assert 1.5 < np.mean(nees) < 4.5
    full = replace(samples, saturated=samples.saturated | (abs(samples.t_s - 0.12) < 0.01))
    assert rate_of_frame(full, window, config, mount) is None
    assert rate_of_frame(full, exposure_window(scene, 2), config, mount) is not None
    assert rate_of_frame(samples, window._replace(open_s=99.0), config, mount) is None
    assert (
        sigma_rad_s(config, 1.0, 0.05)
        > sigma_rad_s(config, 0.0, 0.05)
        > sigma_rad_s(config, 0.0, 5.0)
    )


def test_old_samples_are_dropped() -> None:
    samples = simulate_motion(load("shefex2", FLIGHT)).imu_samples()
    assert samples is not None
    pieces = [replace(samples, t_s=np.array([t_s])) for t_s in (0.0, 0.5, 1.0)]
    assert latest(pieces, 0.6) == pieces[1:]
    assert latest(pieces, np.inf) == pieces


def test_a_gyro_requires_an_imu() -> None:
    with pytest.raises(InputError, match=r"tracker\.gyro: requires the section vehicle\.imu"):
        load("shefex2", {"tracker.gyro": "true"})
