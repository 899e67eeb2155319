"""The truth of a frame that moves in its exposure: the mean attitude is what the images show."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats, Trajectory, Truth
from skysim.results import metrics
from skysim.results.scoring import Score
from skysim.scene import loader
from skysim.simulation.exposure import render_frame
from skysim.simulation.flight import open_flight
from skysim.simulation.lab import Lab, build_lab, exposure_window

EXPOSURE_S = 0.02
ABOUT_CAM = np.array([0.0, 1.0, 0.0])
VIBRATION = "[{kind: line, frequency_hz: 80, rms_arcsec: [5, 5, 5]}]"


@pytest.fixture(scope="module")
def lab() -> Lab:
    return build_lab(loader.load("shefex2", {"exposure.time": f"{EXPOSURE_S} s"}))


def rendered(lab: Lab, angle_rad: Floats, rate_rad_s: Floats, since_s: Floats) -> Truth:
    """The truth of a frame in which the camera turns about ABOUT_CAM, at times since mid-exposure."""
    window = exposure_window(lab.scene, 0)
    axis = lab.camera.mount.cam_from_body.inv().apply(ABOUT_CAM)
    path = lab.start * Rotation.from_rotvec(np.outer(angle_rad, axis))
    middle_s = window.middle_s
    motion = Trajectory(middle_s + since_s, path, np.outer(rate_rad_s, axis))
    return render_frame(lab.camera, motion, 0)[1]


def turned_cam_rad(truth: Truth) -> Floats:
    """The mean attitude relative to that at mid-exposure: a rotation vector of the camera in its own axes."""
    return (truth.cam_from_lab * truth.mean_cam_from_lab.inv()).as_rotvec()


def dense_s() -> Floats:
    return np.linspace(-0.6, 0.6, 1201) * EXPOSURE_S


def test_a_constant_rate_has_its_mean_at_mid_exposure(lab: Lab) -> None:
    rate = np.radians(3.0)
    t_s = dense_s()
    truth = rendered(lab, rate * t_s, np.full_like(t_s, rate), t_s)
    assert np.abs(turned_cam_rad(truth)).max() < 1e-12
    np.testing.assert_allclose(
        truth.mean_rate_cam_rad_s, rate * ABOUT_CAM, rtol=0, atol=1e-12
    )


def test_an_acceleration_turns_the_mean_by_a_t2_over_24(lab: Lab) -> None:
    """The integral of a t^2 / 2 over an exposure T, divided by T; 158 deg/s^2 in 20 ms are 9.5 arcsec."""
    acceleration = np.radians(158.0)
    t_s = dense_s()
    truth = rendered(lab, acceleration * t_s**2 / 2, acceleration * t_s, t_s)
    expected = acceleration * EXPOSURE_S**2 / 24 * ABOUT_CAM
    np.testing.assert_allclose(turned_cam_rad(truth), expected, rtol=0, atol=1e-9)
    # The renderer's mean images are where the mean attitude projects the stars of the images at mid-exposure.
    optics = lab.camera.optics
    pinhole = optics.camera
    across = (truth.sources.xy_px - pinhole.center_px) / pinhole.focal_px
    vectors = np.column_stack([across, np.ones(len(across))])
    np.testing.assert_allclose(
        optics.project(vectors), truth.sources.xy_px, rtol=0, atol=1e-9
    )
    moved_px = optics.project(
        (truth.mean_cam_from_lab * truth.cam_from_lab.inv()).apply(vectors)
    )
    shift_px = truth.sources.flux_xy_px - truth.sources.xy_px
    assert len(shift_px) > 20
    assert np.abs(shift_px).max() > 0.1
    np.testing.assert_allclose(
        moved_px - truth.sources.xy_px, shift_px, rtol=0, atol=0.02 * np.abs(shift_px).max()
    )


@pytest.mark.parametrize("phase", [0.0, 0.7, np.pi / 2])
def test_a_vibration_has_the_mean_of_its_sine(lab: Lab, phase: float) -> None:
    """The mean of A sin(w t + p) over -T/2 to T/2 is A sin(p) sin(w T / 2) / (w T / 2)."""
    amplitude = 5 * ARCSEC_RAD
    omega = 2 * np.pi * 80.0
    t_s = dense_s()
    truth = rendered(
        lab,
        amplitude * np.sin(omega * t_s + phase),
        amplitude * omega * np.cos(omega * t_s + phase),
        t_s,
    )
    half = omega * EXPOSURE_S / 2
    mean = amplitude * np.sin(phase) * np.sin(half) / half
    # Minus: the truth's mean relative to that at mid-exposure, sin(p).
    expected = (mean - amplitude * np.sin(phase)) * ABOUT_CAM
    np.testing.assert_allclose(turned_cam_rad(truth), expected, rtol=0, atol=1e-3 * amplitude)
    rate = 2 * amplitude * np.cos(phase) * np.sin(half) / EXPOSURE_S
    np.testing.assert_allclose(
        truth.mean_rate_cam_rad_s, rate * ABOUT_CAM, rtol=0, atol=1e-3 * amplitude * omega
    )


@pytest.mark.slow
def test_a_vibration_within_the_exposure_is_no_error_of_the_tracker() -> None:
    """5 arcsec at 80 Hz in exposures of 10 ms: the errors against mid-exposure have a NEES of 58, not of 3."""
    scene = loader.load(
        "shefex2",
        {
            "motion.jitter": VIBRATION,
            "motion.rate_deg_s": "[0, 0, 0]",
            "exposure.time": "10 ms",
        },
    )
    at_middle = []
    scored = []
    with open_flight(scene) as flight:
        for shot in flight.shots():
            one = Score(shot)
            solution = one.attitude
            assert solution.cam_from_ref is not None
            assert solution.covariance_rad2 is not None
            truths = shot.truth.cam_from_lab, shot.truth.mean_cam_from_lab
            for truth, found in zip(truths, (at_middle, scored), strict=True):
                found.append(
                    metrics.normalized_error_squared(
                        solution.cam_from_ref, truth, solution.covariance_rad2
                    )
                )
            error = (solution.cam_from_ref * shot.truth.mean_cam_from_lab.inv()).magnitude()
            assert one.error_arcsec == pytest.approx(error / ARCSEC_RAD)
    # The mean of 40 values of chi-square with 3 degrees of freedom: within 4 sigma of 3.
    assert np.mean(scored) == pytest.approx(3, abs=4 * np.sqrt(6 / len(scored)))
    assert np.mean(at_middle) > 20
