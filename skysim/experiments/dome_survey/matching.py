"""Identification of the LEDs in the frames of a dome survey.

The error of the IMU attitude shifts all lights of a frame together by more than the LED spacing. So `match_by_imu`
first finds the most likely common shift (`common_shift_px`), and then assigns detections to LEDs one to one. After an
adjustment the predictions are good, and `match_by_survey` assigns directly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from skysim.core.types import Floats
from skysim.experiments.dome_survey.survey_frames import SurveyFrame
from skysim.experiments.dome_survey.survey_prior import (CalibrationPrior, SurveyUncertainty)

Ints = NDArray[np.int64]
GATE_SIGMAS = 3.5  # sigmas of a two-dimensional error; Gaussian noise exceeds it once in 450
ANCHOR_LIGHTS = (
    10  # number of central lights that are paired with every LED to find the common shift
)


class Correspondences(NamedTuple):
    """Correspondences: rows of a frame's detections, and rows of the map's LEDs that they are matched to."""

    light: Ints
    led: Ints


def prediction_sigmas_px(
    prior: CalibrationPrior, uncertainty: SurveyUncertainty, map_px: Floats | None = None
) -> tuple[float, Floats]:
    """Standard deviations per coordinate in pixels: of the common shift of a frame, and (N,) of each LED individually.

    map_px : (N,) standard deviation of each LED's place; that of `uncertainty` if None

    The attitude error across the boresight and the lever arm error shift all lights alike. An attitude error moves the
    camera too: it turns the direction of an LED at the distance R from the center of rotation, d from the camera, by
    R / d of itself. The LED position error, and the roll and focal length errors (largest, and evaluated, at the image
    corner), act on each light differently.
    """
    camera = prior.camera
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
    uncertainty: SurveyUncertainty,
    map_px: Floats | None = None,
) -> Correspondences:
    """Match detections to LEDs with the IMU attitude and the declared errors: common shift first, then assignment.

    map_px : see `prediction_sigmas_px`
    """
    common_px, individual_px = prediction_sigmas_px(prior, uncertainty, map_px)
    predicted = prior.pixels(frame.body_from_lab)
    margin_px = GATE_SIGMAS * (common_px + float(individual_px.max()))
    visible = np.flatnonzero(prior.camera.contains(predicted, -margin_px))
    detected = frame.lights.xy_px
    if not len(visible) or not len(detected):
        return Correspondences(np.zeros(0, np.int64), np.zeros(0, np.int64))
    predicted = predicted[visible]
    individual_px = individual_px[visible]
    shift = common_shift_px(detected, predicted, common_px, individual_px, prior.camera.center_px)
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
    candidates = np.vstack([np.zeros((1, 2)), candidates])  # no shift is a candidate too
    distance_px, nearest = cKDTree(predicted_px).query(detected_px - candidates[:, None])
    sigma_px = individual_px[nearest]
    cost = np.minimum(
        (distance_px / sigma_px) ** 2 + 4 * np.log(sigma_px / individual_px.max()), GATE_SIGMAS**2
    )
    best = int(np.argmin(np.sum(candidates**2, axis=1) / common_px**2 + np.sum(cost, axis=1)))
    is_close = cost[best] < GATE_SIGMAS**2
    if not is_close.any():
        return candidates[best]
    led = nearest[best, is_close]
    return np.average(
        detected_px[is_close] - predicted_px[led], axis=0, weights=individual_px[led] ** -2.0
    )


def assign_lights(detected_px: Floats, predicted_px: Floats, gate_px: Floats) -> tuple[Ints, Ints]:
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

    sigma_px : (N,) standard deviation of each LED's predicted coordinates
    """
    predicted = prior.pixels(frame.body_from_lab)
    visible = np.flatnonzero(prior.camera.contains(predicted, -GATE_SIGMAS * float(sigma_px.max())))
    light, led = assign_lights(
        frame.lights.xy_px, predicted[visible], GATE_SIGMAS * sigma_px[visible]
    )
    return Correspondences(light, visible[led])
