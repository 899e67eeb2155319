"""Frames of a survey: the lights of each and the IMU's attitude, rendered at planned stops or read from files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.core.constants import MAD_PER_SIGMA
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Frame, Truth
from skysim.experiments.dome_survey.stops import STREAM_KEYS, stop_attitudes
from skysim.scene.scene import Scene
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab
from skysim.tracking import onboard_model
from skysim.tracking import settings as tracker_settings

NOISE_FRAMES = 4  # by which the noise of a centroid is determined
MIN_LIGHTS = 10
LEAST_NOISE_PX = 1e-4
SAME_LIGHT_PX = 2.0  # greatest distance of a centroid from the true image


@dataclass(frozen=True, slots=True)
class SurveyFrame:
    """One frame of a survey: its detections, and the vehicle's attitude from the IMU or a previous adjustment.

    index : number of the frame, from 0, which tells what coded LEDs show
    """

    lights: Centroids
    body_from_lab: Rotation
    index: int = 0


def render_stops(
    lab: Lab, lab_from_body: Rotation, first: int = 0
) -> Iterator[tuple[Frame, Truth]]:
    """Render a frame at each attitude with the vehicle at rest. `first` is the index of the first frame, which also
    selects its noise."""
    for n, attitude in enumerate(lab_from_body):
        yield render_at_rest(lab.camera, attitude, first + n)


def take_frames(lab: Lab, lab_from_body: Rotation) -> Iterator[tuple[Frame, Truth, Centroids]]:
    """Each frame at these stops, with its truth and its detections."""
    settings = tracker_settings.assumed_settings(lab.scene)
    camera = onboard_model.assumed_camera(lab.scene)
    for frame, truth in render_stops(lab, lab_from_body):
        yield frame, truth, detect_lights(settings, camera, frame.image_dn)


def centroid_noise_px(lab: Lab, tilt_deg: float) -> float:
    """Standard deviation of a centroid's coordinates, robust, from the true images in NOISE_FRAMES simulated frames.

    Raises InputError if they show too few lights.
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
