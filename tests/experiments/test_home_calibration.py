"""Calibration by the thesis's procedure (Padro 2012, 3.6): what is measured in an image, and steps against geometry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.calibration.home_position import Sighting
from estimator.core.camera import Camera
from skysim.core.errors import InputError
from skysim.experiments import home_calibration as home
from skysim.experiments.dome_survey.survey_frames import CalibrationPrior
from skysim.experiments.home_calibration import HeldFrame
from skysim.scene.loader import load

MM = 1e-3
CROSS_M = MM * np.array([[0, 0], [8, 0], [0, 8], [-8, 0], [0, -8.5]])
HEIGHT_M = 1.2192


@pytest.fixture(scope="module")
def known() -> CalibrationPrior:
    """A camera below the apex of a sphere about the bearing, with a cross of five LEDs."""
    place_m = np.column_stack([CROSS_M, np.full(5, HEIGHT_M)])
    leds = LedMap(np.arange(5), place_m, np.zeros(3), np.full(3, HEIGHT_M))
    lever = Lever(np.array([0.0, 0.0, 0.381]), Rotation.identity())
    camera = Camera(1600, 1200, 9000.0, (799.5, 599.5))
    return CalibrationPrior(camera, leds, lever, 0.0, 0.0, np.ones(5))


def seen_from(
    known: CalibrationPrior, lab_from_body: Rotation, imu: Rotation | None = None
) -> HeldFrame:
    """The frame of an attitude without noise, the lights in another order than the LEDs."""
    xy_px = project(lab_from_body.inv(), known.leds.position_m, known.lever, known.camera)
    order = [3, 0, 4, 2, 1]
    return HeldFrame(imu or lab_from_body, xy_px[order], np.arange(10.0, 15.0)[order])


def tilted(roll_deg: float, pitch_deg: float) -> Rotation:
    return Rotation.from_euler("xy", [roll_deg, pitch_deg], degrees=True)


def test_lights_are_regions_of_fifty_pixels_above_four_percent() -> None:
    """Mean gray level times area over the median area; 49 pixels, and pixels at the threshold, are no light."""
    image = np.zeros((200, 300), np.uint16)
    image[20:30, 40:50] = 100
    image[100:120, 40:60] = 50
    image[150:157, 200:207] = 200
    image[20:60, 200:240] = 10
    xy_px, magnitude = home.measure(image, load("afit_laboratory"))
    assert xy_px.tolist() == [[44.5, 24.5], [49.5, 109.5]]
    assert magnitude.tolist() == [100 * 100 / 250, 50 * 400 / 250]


def test_lights_are_named_although_the_imu_errs_by_the_spacing_of_the_leds(
    known: CalibrationPrior,
) -> None:
    frame = seen_from(known, tilted(0.3, -0.2), imu=tilted(0.3, 0.2))
    led, light = home.name_lights(known, frame)
    assert led.tolist() == [0, 1, 2, 3, 4]
    assert frame.magnitude[light].tolist() == [10, 11, 12, 13, 14]


def test_frames_in_motion_belong_to_no_stop(known: CalibrationPrior) -> None:
    pitches = [0, 0, 0, 0.5, 1.2, 2, 2, 2]
    frames = [seen_from(known, tilted(0, pitch)) for pitch in pitches]
    stops = [one.stop for one in home.sightings(known, frames)]
    assert stops == [0, 0, 0, 1, 1]


def test_four_clicks_find_the_focal_length(known: CalibrationPrior) -> None:
    """A tracker that believes 5 % less: the spacings of the first frame correct it, but for the dome's curvature."""
    frame = seen_from(known, Rotation.identity())
    led, light = home.name_lights(known, frame)
    first = Sighting(0, Rotation.identity(), led, frame.xy_px[light], frame.magnitude[light])
    believed = known._replace(camera=known.camera.zoomed(0.95))
    assert home.scaled(believed, first, 4).focal_px == pytest.approx(9000, rel=2e-4)


def test_pair_angles_are_those_of_equation_45() -> None:
    points = np.random.default_rng(3).normal(size=(4, 3))
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    wanted = np.arccos((unit @ unit.T)[np.triu_indices(4, 1)])
    assert home.pair_angles_rad(points) == pytest.approx(wanted)


def test_attitude_and_angles_of_noise_free_stops_are_true(known: CalibrationPrior) -> None:
    """Near the boresight eqs 43-44 are exact to second order: 0.02 deg and an arcsecond at 2 deg of tilt."""
    attitudes = [Rotation.identity()] * 3 + [tilted(1.5, 2.0)] * 3
    frames = [seen_from(known, one) for one in attitudes]
    found = home.calibrated(known, frames)
    numbers = home.statistics(found)
    assert numbers["distinct"] == 3
    assert [one["pairs"] for one in numbers["angles"]] == [4, 4, 2]
    assert np.abs(found.algorithm_deg - found.imu_deg).max() < 0.1
    wanted = np.degrees(8e-3 / HEIGHT_M) * 3600
    assert numbers["angles"][0]["mean"] == pytest.approx(wanted, rel=0.02)


def test_an_imu_error_at_one_of_two_stops_spreads_positions_by_half_of_it(
    known: CalibrationPrior,
) -> None:
    """Pooled over n frames at each stop, the deviation of two values d apart is d / 2 sqrt(2n / (2n - 1))."""
    error_deg = 0.2
    frames = [seen_from(known, Rotation.identity())] * 4
    frames += [seen_from(known, tilted(0, 1.0), imu=tilted(0, 1.0 + error_deg))] * 4
    found = home.calibrated(known, frames)
    moved_m = np.abs(np.diff(found.lab_m[[0, -1], :, 0], axis=0)).max()
    assert moved_m == pytest.approx(np.radians(error_deg) * HEIGHT_M, rel=0.1)
    assert found.catalog.epsilon_pos_m == pytest.approx(
        moved_m / 2 * np.sqrt(8 / 7), rel=0.02
    )


def test_too_few_frames_are_refused(known: CalibrationPrior) -> None:
    with pytest.raises(InputError, match="2 or more"):
        home.calibrated(known, [seen_from(known, tilted(0, 0))])


@pytest.mark.filterwarnings("error")
def test_a_single_stop_has_no_deviation_between_stops(known: CalibrationPrior) -> None:
    found = home.calibrated(known, [seen_from(known, Rotation.identity())] * 3)
    assert np.isnan(home.statistics(found)["difference_deg"]["sd"]).all()
