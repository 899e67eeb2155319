"""Simulated survey of an LED dome with the vehicle's own camera: render frames, identify LEDs, adjust, and check.

The vehicle is held still at many attitudes and takes a frame at each; the IMU gives the attitude to about half a
degree. At first the detections are matched to LEDs with the IMU attitude. Its error shifts all lights of a frame
together by more than the LED spacing, so the most likely common shift is found first (`dome_survey_naming`). Then
`estimator.calibration.dome_survey.survey` adjusts LED positions, lever arm, lens and attitudes together by least
squares. Identification and adjustment are repeated with the improved values, ROUNDS times. The result is a `DomeMap`,
the file that `tracker.map` reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.calibration import dome_survey
from estimator.calibration.dome_survey import DomeFrame, DomeSurvey
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.core.errors import InputError
from skysim.core.quantities.units import quantity
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Frame, Truth
from skysim.experiments.configs import with_config
from skysim.experiments.dome_survey_naming import (
    CalibrationPrior,
    Correspondences,
    SurveyFrame,
    SurveyUncertainty,
    match_by_imu,
    match_by_survey,
)
from skysim.scene.scene import Scene
from skysim.scene.sections.light import DomeConfig
from skysim.simulation import exposure
from skysim.simulation.testbed import Testbed
from skysim.tracking import onboard_model
from skysim.tracking import settings as tracker_settings
from skysim.tracking.dome_map_file import DomeMap

STREAM_KEYS = {"attitudes": 101, "imu": 102, "checks": 103}  # distinct from those in core/random_streams.py
# Lights that a frame must share with others: two determine its attitude; a misidentified patch board accounts for six.
MIN_SHARED_LEDS = (3, 8)

# Minimum rms angle between an LED's rays for its distance: twice the minimum that the adjustment requires.
MIN_RAY_ANGLE_RAD = 2 * dome_survey.CROSSING_RAD

# Options: unit, quantity, example, minimum and maximum. The LED error must be > 0, because it weights the map.
UNCERTAINTY_OPTIONS = {
    "imu_sigma": ("rad", "plane angle", '"0.5 deg"', 0.0, 0.1),
    "led_sigma": ("m", "length", '"2 mm"', 1e-6, 0.1),
    "lever_sigma": ("m", "length", '"5 mm"', 0.0, 0.1),
    "focal_error": ("", "share", '"1%" or "0.01"', -0.1, 0.1),
}

ROUNDS = 3  # rounds of identification and adjustment; from the second on with the adjusted values


def survey_uncertainty(imu_sigma: str, led_sigma: str, lever_sigma: str, focal_error: str) -> SurveyUncertainty:
    """Parse the quantities of the command line. Raises InputError for an invalid or out-of-range value."""
    texts, values = (imu_sigma, led_sigma, lever_sigma, focal_error), []
    for text, (name, (unit, description, example, low, high)) in zip(texts, UNCERTAINTY_OPTIONS.items(), strict=True):
        option = f"--{name.replace('_', '-')}"
        try:
            value = quantity(unit, description, example)(text)
        except ValueError as error:
            raise InputError(f"{option}: {error}") from None
        values.append(value)
        if not low <= value <= high:
            raise InputError(f"{option} {text}: allowed: {low:g} to {high:g}{unit and f' {unit}'}")
    return SurveyUncertainty(*values)


def calibration_prior(testbed: Testbed) -> CalibrationPrior:
    """The onboard model of the tracker of a test bed. Raises InputError for a scene without a dome."""
    light = testbed.scene.light
    if not isinstance(light, DomeConfig):
        raise InputError(f"light.kind: a survey needs LEDs, not {light.kind}; allowed: dome")
    return CalibrationPrior(
        onboard_model.assumed_camera(testbed.scene),
        onboard_model.assumed_dome(testbed.scene, light, testbed.sources),
        onboard_model.assumed_lever(testbed.scene, testbed.mount),
        testbed.scene.tracker.centroid_sigma_px,
    )


def with_survey_errors(scene: Scene, uncertainty: SurveyUncertainty) -> Scene:
    """The scene with the onboard model before a survey: errors of this size, drawn with `tracker.survey.seed`."""
    focal_length_m = scene.camera.focal_length_m * (1 + uncertainty.focal_error)
    return with_onboard_model(scene, uncertainty.led_sigma_m, uncertainty.lever_sigma_m, focal_length_m, None)


def with_map(scene: Scene, path: str) -> Scene:
    """The scene whose tracker uses the map file of a surveyed dome, and no other onboard errors."""
    return with_onboard_model(scene, 0.0, 0.0, None, path)


def with_onboard_model(
    scene: Scene, led_sigma_m: float, lever_sigma_m: float, focal_length_m: float | None, path: str | None
) -> Scene:
    """The scene whose tracker has survey errors of this size, and assumes this focal length or map file."""
    scene = with_config(scene, "tracker.survey", led_sigma_m=led_sigma_m, lever_sigma_m=lever_sigma_m)
    return with_config(scene, "tracker", assumed_focal_length_m=focal_length_m, assumed_camera_body_m=None, map=path)


def stop_attitudes(scene: Scene, stream_name: str, count: int, tilt_deg: float) -> Rotation:
    """Random lab_from_body at `count` stops: tilt uniform in solid angle up to tilt_deg, yaw uniform.

    stream_name : random stream, a key of STREAM_KEYS. Raises InputError if the tilt exceeds the vehicle's tilt stop.
    """
    stop_deg = scene.vehicle.tilt_stop_deg if scene.vehicle.mount == "air_bearing" else 90.0
    if not 0 < tilt_deg <= stop_deg:
        raise InputError(f"--tilt {tilt_deg:g}: allowed: above 0, up to {stop_deg:g} degrees, the vehicle's stop")
    rng = random_stream(scene.seed, STREAM_KEYS[stream_name])
    tilt = np.arccos(rng.uniform(np.cos(np.radians(tilt_deg)), 1, count))
    azimuth, yaw = rng.uniform(0, 2 * np.pi, (2, count))
    rotation_vectors = np.column_stack([tilt * np.cos(azimuth), tilt * np.sin(azimuth), np.zeros(count)])
    return Rotation.from_rotvec(rotation_vectors) * Rotation.from_euler("z", yaw[:, None])


def render_stops(testbed: Testbed, lab_from_body: Rotation, first: int = 0) -> Iterator[tuple[Frame, Truth]]:
    """Render a frame at each attitude with the vehicle at rest. `first` is the index of the first frame, which also
    selects its noise."""
    for n, attitude in enumerate(lab_from_body):
        yield exposure.render_frame(testbed.at_rest(attitude, first + n), first + n)


def take_survey_frames(
    testbed: Testbed, prior: CalibrationPrior, uncertainty: SurveyUncertainty, count: int, tilt_deg: float
) -> Iterator[SurveyFrame]:
    """Detections and IMU attitude at each of `count` random stops."""
    lab_from_body = stop_attitudes(testbed.scene, "attitudes", count, tilt_deg)
    measured = imu_attitudes(testbed.scene, lab_from_body, uncertainty.imu_sigma_rad)
    settings = tracker_settings.assumed_settings(testbed.scene)
    for (frame, _), body_from_lab in zip(render_stops(testbed, lab_from_body), measured, strict=True):
        yield SurveyFrame(detect_lights(settings, prior.camera, frame.image_dn), body_from_lab)


def imu_attitudes(scene: Scene, lab_from_body: Rotation, sigma_rad: float) -> Rotation:
    """body_from_lab at each stop from an IMU with independent Gaussian errors about each body axis."""
    error_rad = sigma_rad * random_stream(scene.seed, STREAM_KEYS["imu"]).standard_normal((len(lab_from_body), 3))
    return Rotation.from_rotvec(error_rad) * lab_from_body.inv()


# --- the survey ---------------------------------------------------------------------------------------------


def run_survey(
    frames: Sequence[SurveyFrame],
    prior: CalibrationPrior,
    uncertainty: SurveyUncertainty,
    fit_distortion: bool = False,
    watch: Callable[[float, float], None] | None = None,
) -> DomeSurvey:
    """Survey LEDs, lever arm, lens and attitudes from all frames, starting from `prior` with errors of `uncertainty`.

    fit_distortion : fit k1, k2, p1, p2 as well. A narrow field hardly determines them, and they correlate with the
        focal length: on the AFIT dome its sigma grows from 10 to 80 px, while the attitude does not change
    watch(rounds done, rounds) is called after each round of identification and adjustment
    Raises InputError if the frames do not determine the unknowns.
    """
    survey, floor_px = None, prior.floor_px
    matches = [match_by_imu(frame, prior, uncertainty) for frame in frames]
    for completed in range(ROUNDS):
        if survey:
            adjusted_prior = CalibrationPrior(survey.camera, survey.leds, survey.lever, floor_px)
            # The attitudes are adjusted now, so only the map's and the residual error remain in the predictions.
            map_px = led_sigma_m(survey, uncertainty) * adjusted_prior.px_per_m
            sigma_px = np.hypot(map_px, max(survey.rms_px, floor_px))
            tied = np.flatnonzero(survey.tied).tolist()
            frames = [replace(frames[k], body_from_lab=survey.body_from_lab[k]) for k in tied]
            matches = [match_by_survey(frame, adjusted_prior, sigma_px) for frame in frames]
            # Keep the map from before the survey: it enters each adjustment as a measurement.
            prior = replace(adjusted_prior, leds=prior.leds)
        frames, survey = adjust_connected(frames, matches, prior, uncertainty, fit_distortion)
        if watch:
            watch(completed + 1, ROUNDS)
    assert survey, "there is a round"
    return survey


def adjust_connected(
    frames: Sequence[SurveyFrame],
    matches: Sequence[Correspondences],
    prior: CalibrationPrior,
    uncertainty: SurveyUncertainty,
    fit_distortion: bool,
) -> tuple[list[SurveyFrame], DomeSurvey]:
    """Adjust the largest group of connected frames. Returns its frames and the survey.

    A frame may be connected only by misidentified lights. The adjustment rejects these and then fails, so it is tried
    again with a larger minimum number of shared lights (MIN_SHARED_LEDS). Raises InputError if the last attempt fails.
    """
    visible = led_visibility(frames, matches, prior)
    for min_shared in MIN_SHARED_LEDS:
        selected = largest_connected_group(visible, min_shared)
        dome_frames = [dome_frame(frames[k], matches[k], prior.floor_px) for k in selected]
        try:
            # A robust loss, and the prior map as a measurement.
            survey = dome_survey.survey(
                dome_frames,
                prior.leds,
                prior.lever,
                prior.camera,
                fit_distortion=fit_distortion,
                loss="cauchy",
                leds_sigma_m=uncertainty.led_sigma_m,
            )
        except ValueError as error:
            if min_shared == MIN_SHARED_LEDS[-1]:
                raise InputError(str(error)) from None
        else:
            break
    return [frames[k] for k in selected], survey


def led_visibility(
    frames: Sequence[SurveyFrame], matches: Sequence[Correspondences], prior: CalibrationPrior
) -> NDArray[np.bool_]:
    """(F, N) mask of the LEDs in each frame, without LEDs whose rays are nearly parallel in all frames.

    Such an LED, seen from camera positions close together, has no measurable distance and connects no frames.
    """
    visible = np.zeros((len(matches), len(prior.leds.id)), dtype=bool)
    for row, match in zip(visible, matches, strict=True):
        row[match.led] = True
    # RMS spread of the camera positions over the frames that show an LED, as an angle seen from the nearest LED.
    arm_m = prior.lever.camera_body_m
    camera_m = np.array([frame.body_from_lab.inv().apply(arm_m) for frame in frames])
    count = np.maximum(visible.sum(axis=0), 1)[:, None]
    spread_m2 = np.sum((visible.T @ camera_m**2) / count - ((visible.T @ camera_m) / count) ** 2, axis=1)
    angle_rad = np.sqrt(np.maximum(spread_m2, 0)) * prior.px_per_m / prior.camera.focal_px
    return visible & (angle_rad > MIN_RAY_ANGLE_RAD)


def largest_connected_group(visible: NDArray[np.bool_], min_shared: int) -> list[int]:
    """Indices of the largest group of frames connected by shared LEDs.

    visible : (F, N) mask of the LEDs in each frame
    min_shared : minimum number of LEDs that a frame shares with the rest of the group

    Frames outside the group have an undetermined position relative to it, which `dome_survey.survey` rejects. A group
    grows from the frame with the most LEDs, adding connected frames until none is left.
    """
    n_frames = len(visible)
    remaining, best = np.ones(n_frames, dtype=bool), np.zeros(n_frames, dtype=bool)
    while remaining.any():
        group = np.zeros(n_frames, dtype=bool)
        group[np.argmax(remaining * (1 + visible.sum(axis=1)))] = True
        # Add frames that share enough LEDs with the group until it no longer grows.
        while True:
            group_leds = visible[group].any(axis=0)
            grown = group | (remaining & ((visible & group_leds).sum(axis=1) >= min_shared))
            if (grown == group).all():
                break
            group = grown
        remaining &= ~group
        best = group if group.sum() > best.sum() else best
    return np.flatnonzero(best).tolist()


def led_sigma_m(survey: DomeSurvey, uncertainty: SurveyUncertainty) -> Floats:
    """(N,) standard deviation of each LED's position, RMS of three axes; that before the survey if not surveyed."""
    variance_m2 = np.einsum("nii->n", survey.led_covariance_m2) / 3
    return np.sqrt(np.where(survey.surveyed, variance_m2, uncertainty.led_sigma_m**2))


def lens_sigma(survey: DomeSurvey) -> Floats:
    """(8,) standard deviations of focal_px, center x and y, k1, k2, p1, p2, k3; 0 for those not fitted."""
    fitted = np.sqrt(np.maximum(np.diag(survey.lens_covariance), 0))
    return np.concatenate([fitted, np.zeros(8 - len(fitted))])


def dome_map(survey: DomeSurvey, uncertainty: SurveyUncertainty) -> DomeMap:
    """The map file of a survey for the tracker: surveyed LEDs, lever arm, lens, and their standard deviations."""
    surveyed = survey.surveyed
    focal_sigma_px, x_sigma_px, y_sigma_px, *k_sigma = lens_sigma(survey).tolist()
    return DomeMap(
        id=survey.leds.id[surveyed],
        position_m=survey.leds.position_m[surveyed],
        sigma_m=led_sigma_m(survey, uncertainty)[surveyed],
        camera_body_m=survey.lever.camera_body_m,
        lever_sigma_m=float(np.sqrt(np.trace(survey.lever_covariance_m2) / 3)),
        size_px=(survey.camera.width_px, survey.camera.height_px),
        focal_px=survey.camera.focal_px,
        focal_sigma_px=focal_sigma_px,
        center_px=survey.camera.center_px,
        center_sigma_px=(x_sigma_px, y_sigma_px),
        distortion=survey.camera.distortion,
        distortion_sigma=tuple(k_sigma),
    )


def detect_lights(settings: Settings, camera: Camera, image_dn: NDArray[Any]) -> Centroids:
    """Centroids of an image; none if the tracker would reject it."""
    try:
        return detect_and_centroid(image_dn, camera, settings, Clock())
    except ImageError:
        return Centroids.empty()


def dome_frame(frame: SurveyFrame, match: Correspondences, floor_px: float) -> DomeFrame:
    """Input frame of the adjustment: matched detections with their LEDs, and the start attitude."""
    sigma_px = np.hypot(frame.lights.sigma_px[match.light], floor_px)
    return DomeFrame(match.led, frame.lights.xy_px[match.light], sigma_px, frame.body_from_lab)
