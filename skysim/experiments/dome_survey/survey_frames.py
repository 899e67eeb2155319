"""Frames of a survey: the lights of each and the IMU's attitude, rendered at planned stops or read from files."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.calibration import survey_plan
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.core.constants import MAD_PER_SIGMA
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Bools, Floats, Frame, Ints, Truth, around_z, frozen
from skysim.experiments.dome_survey.survey_prior import CalibrationPrior
from skysim.scene.scene import Scene
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab
from skysim.tracking import factory, onboard_model

# Attitudes at which the vehicle is held for a survey: by a plan, or random.


CANDIDATES = 1000  # number of random attitudes among which a plan chooses
# Distinct from those in core/random_streams.py.
STREAM_KEYS = {
    "attitudes": 101,
    "imu": 102,
    "checks": 103,
    "candidates": 104,
    "noise": 105,
    "domes": 106,
}


def stop_attitudes(scene: Scene, stream_name: str, count: int, tilt_deg: float) -> Rotation:
    """Random lab_from_body at `count` stops: tilt uniform in solid angle up to tilt_deg, yaw uniform.

    Parameters
    ----------
    stream_name
        Random stream, a key of STREAM_KEYS

    Raises
    ------
    InputError
        If the tilt exceeds the vehicle's tilt stop.
    """
    stop_deg = scene.vehicle.tilt_stop_deg if scene.vehicle.mount == "air_bearing" else 90.0
    if not 0 < tilt_deg <= stop_deg:
        raise InputError(
            "survey.tilt_deg",
            f"{tilt_deg:g}",
            f"above 0, up to {stop_deg:g} degrees, the vehicle's stop",
        )
    rng = random_stream(scene.seed, STREAM_KEYS[stream_name])
    tilt = np.arccos(rng.uniform(np.cos(np.radians(tilt_deg)), 1, count))
    azimuth, yaw = rng.uniform(0, 2 * np.pi, (2, count))
    return Rotation.from_rotvec(around_z(tilt, azimuth, 0.0)) * Rotation.from_euler(
        "z", yaw[:, None]
    )


def planned_stops(
    scene: Scene,
    model: survey_plan.SurveyModel,
    margin_px: float,
    count: int,
    tilt_deg: float,
    held: Rotation | None = None,
    seen: Bools | None = None,
) -> Rotation:
    """lab_from_body at up to `count` stops that reduce the errors most, best first (`survey_plan.choose`).

    Parameters
    ----------
    margin_px
        Margin of the chip in which an image would be incomplete
    held, seen
        body_from_lab of frames taken before, and the LEDs identified in them

    Raises
    ------
    InputError
        If no attitude shows enough LEDs.
    """
    candidates = stop_attitudes(scene, "candidates", CANDIDATES, tilt_deg).inv()
    shown = model.visible(candidates, margin_px)
    chosen = survey_plan.choose(model, candidates, shown, count, held, seen)
    if not chosen:
        raise InputError(
            "survey",
            f"no attitude within {tilt_deg:g} degrees shows {survey_plan.MIN_SHARED} LEDs",
            "more LEDs, or a wider field",
        )
    return candidates[chosen].inv()


ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")


def from_angles(roll_pitch_yaw_deg: Floats) -> Rotation:
    """lab_from_body of (F, 3) roll, pitch and yaw."""
    return Rotation.from_euler("ZYX", roll_pitch_yaw_deg[:, ::-1], degrees=True)


def from_rows(rows: Sequence[Mapping[str, float]]) -> Rotation:
    """lab_from_body of rows with ANGLES."""
    return from_angles(np.array([[row[name] for name in ANGLES] for row in rows]))


NOISE_FRAMES = 4  # number of frames from which the noise of a centroid is determined
MIN_LIGHTS = 10
LEAST_NOISE_PX = 1e-4
SAME_LIGHT_PX = 2.0  # greatest distance of a centroid from the true image


@frozen
class SurveyFrame:
    """One frame of a survey: its detections, and the vehicle's attitude from the IMU or a previous adjustment.

    Attributes
    ----------
    index
        Number of the frame, from 0, which determines the light of coded LEDs
    """

    lights: Centroids
    body_from_lab: Rotation
    index: int


def render_stops(
    lab: Lab, lab_from_body: Rotation, first: int = 0
) -> Iterator[tuple[Frame, Truth]]:
    """Render a frame at each attitude with the vehicle at rest.

    `first` is the index of the first frame; the index of a frame also selects its noise.
    """
    for n, attitude in enumerate(lab_from_body):
        yield render_at_rest(lab.camera, attitude, first + n)


def take_frames(
    lab: Lab, lab_from_body: Rotation
) -> Iterator[tuple[Frame, Truth, Centroids]]:
    """Each frame at these stops, with its truth and its detections."""
    settings = factory.assumed_settings(lab.scene)
    camera = onboard_model.assumed_camera(lab.scene)
    for frame, truth in render_stops(lab, lab_from_body):
        yield frame, truth, detect_lights(settings, camera, frame.image_dn)


def centroid_noise_px(lab: Lab, tilt_deg: float) -> float:
    """Standard deviation of a centroid's coordinates, robust, from the true images in NOISE_FRAMES simulated frames.

    Raises
    ------
    InputError
        If the frames show too few lights.
    """
    errors = []
    for _, truth, lights in take_frames(
        lab, stop_attitudes(lab.scene, "noise", NOISE_FRAMES, tilt_deg)
    ):
        if len(truth.sources.id) and len(lights):
            distance_px, nearest = cKDTree(truth.sources.flux_xy_px).query(lights.xy_px)
            same = distance_px < SAME_LIGHT_PX
            errors.append((lights.xy_px - truth.sources.flux_xy_px[nearest])[same])
    error_px = np.concatenate([*errors, np.zeros((0, 2))])
    if len(error_px) < MIN_LIGHTS:
        raise InputError(
            "survey",
            f"{len(error_px)} lights in {NOISE_FRAMES} frames",
            f"{MIN_LIGHTS} or more: brighter LEDs, more of them, or a longer exposure",
        )
    return max(float(np.median(np.abs(error_px))) / MAD_PER_SIGMA, LEAST_NOISE_PX)


def imu_attitudes(scene: Scene, lab_from_body: Rotation, sigma_rad: float) -> Rotation:
    """body_from_lab at each stop from an IMU with independent Gaussian errors about each body axis."""
    error_rad = sigma_rad * random_stream(scene.seed, STREAM_KEYS["imu"]).standard_normal(
        (len(lab_from_body), 3)
    )
    return Rotation.from_rotvec(error_rad) * lab_from_body.inv()


def detect_lights(settings: Settings, camera: Camera, image_dn: NDArray[Any]) -> Centroids:
    """Centroids of an image; none if the tracker would reject it."""
    try:
        return detect_and_centroid(image_dn, camera, settings, Clock())
    except ImageError:
        return Centroids.empty()


# Identification of the LEDs in the frames.


GATE_SIGMAS = 3.5  # gate of a two-dimensional error; Gaussian noise exceeds it once in 450
# Number of central lights that are paired with every LED to find the common shift.
ANCHOR_LIGHTS = 10


class Correspondences(NamedTuple):
    """Correspondences: rows of a frame's detections, and rows of the map's LEDs that they are matched to."""

    light: Ints
    led: Ints


def prediction_sigmas_px(
    prior: CalibrationPrior, map_px: Floats | None = None
) -> tuple[float, Floats]:
    """Standard deviations per coordinate in pixels: of the common shift of a frame, and (N,) of each LED individually.

    The attitude error across the boresight and the lever arm error shift all lights alike. An attitude error also moves
    the camera: it turns the direction of an LED at the distance R from the center of rotation and d from the camera by
    R / d times the error. The LED position error, and the errors of roll and focal length (evaluated at the image
    corner, where they are largest), shift each light differently.

    Parameters
    ----------
    map_px
        (N,) standard deviation of each LED's place; as known before a survey if None
    """
    camera = prior.camera
    uncertainty = prior.uncertainty
    corner_px = np.hypot(camera.width_px, camera.height_px) / 2
    common = (
        np.hypot(uncertainty.imu_sigma_rad * prior.nearest_m, uncertainty.lever_sigma_m)
        * prior.px_per_m
    )
    roll_and_scale = corner_px * np.hypot(uncertainty.imu_sigma_rad, uncertainty.focal_error)
    if map_px is None:
        map_px = np.full(len(prior.leds.id), uncertainty.led_sigma_m * prior.px_per_m)
    return float(common), np.hypot(map_px, roll_and_scale)


def match_by_imu(
    frame: SurveyFrame,
    prior: CalibrationPrior,
    map_px: Floats | None = None,
) -> Correspondences:
    """Match detections to LEDs with the IMU attitude and the declared errors: common shift first, then assignment.

    Parameters
    ----------
    map_px
        See `prediction_sigmas_px`
    """
    common_px, individual_px = prediction_sigmas_px(prior, map_px)
    predicted = prior.pixels(frame.body_from_lab)
    margin_px = GATE_SIGMAS * (common_px + float(individual_px.max()))
    visible = np.flatnonzero(prior.camera.contains(predicted, -margin_px))
    detected = frame.lights.xy_px
    if not len(visible) or not len(detected):
        return Correspondences(*np.zeros((2, 0), np.int64))
    predicted = predicted[visible]
    individual_px = individual_px[visible]
    shift = common_shift_px(
        detected, predicted, common_px, individual_px, prior.camera.center_px
    )
    light, led = assign_lights(detected, predicted + shift, GATE_SIGMAS * individual_px)
    return Correspondences(light, visible[led])


def common_shift_px(
    detected_px: Floats,
    predicted_px: Floats,
    common_px: float,
    individual_px: Floats,
    center_px: tuple[float, float],
) -> Floats:
    """(2,) most likely common shift of (P, 2) predictions onto (S, 2) detections, pixels.

    Candidates are the shifts that move a prediction onto one of the ANCHOR_LIGHTS detections nearest to the image
    center, where a roll error displaces least. The cost of a shift t is -2 ln of its likelihood,
    |t|^2 / common_px^2 + sum_i min(d_i^2 / s_i^2 + 4 ln(s_i / s), GATE_SIGMAS^2), where d_i is the distance of
    detection i from the nearest shifted prediction, s_i its individual_px and s the greatest of all. The best candidate
    is refined by the mean residual of the detections in the gate, weighted by 1 / s_i^2.
    """
    inner = np.argsort(np.linalg.norm(detected_px - center_px, axis=1))[:ANCHOR_LIGHTS]
    candidates = (detected_px[inner, None] - predicted_px).reshape(-1, 2)
    limit_px = GATE_SIGMAS * np.hypot(common_px, individual_px.max())
    candidates = candidates[np.linalg.norm(candidates, axis=1) < limit_px]
    candidates = np.vstack([np.zeros((1, 2)), candidates])  # no shift is also a candidate
    distance_px, nearest = cKDTree(predicted_px).query(detected_px - candidates[:, None])
    sigma_px = individual_px[nearest]
    cost = np.minimum(
        (distance_px / sigma_px) ** 2 + 4 * np.log(sigma_px / individual_px.max()),
        GATE_SIGMAS**2,
    )
    best = int(np.argmin(np.sum(candidates**2, axis=1) / common_px**2 + np.sum(cost, axis=1)))
    is_close = cost[best] < GATE_SIGMAS**2
    if not is_close.any():
        return candidates[best]
    led = nearest[best, is_close]
    return np.average(
        detected_px[is_close] - predicted_px[led], axis=0, weights=individual_px[led] ** -2.0
    )


def assign_lights(
    detected_px: Floats, predicted_px: Floats, gate_px: Floats
) -> tuple[Ints, Ints]:
    """Optimal one-to-one assignment of (S, 2) detections to (P, 2) predictions with (P,) gates; returns their rows.

    It minimizes the sum of min(distance / gate, 1)^2. Pairs beyond their gate are left out.
    """
    distance = np.linalg.norm(detected_px[:, None] - predicted_px, axis=2) / gate_px
    # Clipping at the gate keeps detections without a counterpart from pulling the other pairs apart.
    rows, column = linear_sum_assignment(np.minimum(distance, 1.0) ** 2)
    inside = distance[rows, column] < 1
    return rows[inside].astype(np.int64), column[inside].astype(np.int64)


def match_by_survey(
    frame: SurveyFrame, prior: CalibrationPrior, sigma_px: Floats
) -> Correspondences:
    """Match detections to LEDs with the attitudes and map of an adjustment.

    Parameters
    ----------
    sigma_px
        (N,) standard deviation of each LED's predicted coordinates
    """
    predicted = prior.pixels(frame.body_from_lab)
    visible = np.flatnonzero(
        prior.camera.contains(predicted, -GATE_SIGMAS * float(sigma_px.max()))
    )
    light, led = assign_lights(
        frame.lights.xy_px, predicted[visible], GATE_SIGMAS * sigma_px[visible]
    )
    return Correspondences(light, visible[led])
