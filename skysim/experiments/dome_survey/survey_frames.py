"""Frames of a survey: the lights of each and the IMU's attitude, rendered at planned stops or read from files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import numpy as np
from scipy.spatial.transform import Rotation
from estimator.calibration import survey_plan
from estimator.calibration.survey_plan import Mask, SurveyModel
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.scene.scene import Scene
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from estimator.core.camera import Camera
from estimator.core.checks import ImageError
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.core.constants import MAD_PER_SIGMA
from skysim.core.types import Frame, Truth
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab
from skysim.tracking import onboard_model
from skysim.tracking import factory as tracker_settings





# Attitudes at which the vehicle is held for a survey: by a plan, or random.


CANDIDATES = 1000  # random attitudes among which a plan chooses
# Distinct from those in core/random_streams.py.
STREAM_KEYS = {"attitudes": 101, "imu": 102, "checks": 103, "candidates": 104, "noise": 105}


def stop_attitudes(scene: Scene, stream_name: str, count: int, tilt_deg: float) -> Rotation:
    """Random lab_from_body at `count` stops: tilt uniform in solid angle up to tilt_deg, yaw uniform.

    stream_name : random stream, a key of STREAM_KEYS. Raises InputError if the tilt exceeds the vehicle's tilt stop.
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
    rotation_vectors = np.column_stack(
        [tilt * np.cos(azimuth), tilt * np.sin(azimuth), np.zeros(count)]
    )
    return Rotation.from_rotvec(rotation_vectors) * Rotation.from_euler("z", yaw[:, None])


def planned_stops(
    scene: Scene,
    model: SurveyModel,
    margin_px: float,
    count: int,
    tilt_deg: float,
    held: Rotation | None = None,
    seen: Mask | None = None,
) -> Rotation:
    """lab_from_body at up to `count` stops that reduce the errors most, in their order (`survey_plan.choose`).

    margin_px  : of the chip, where an image would be incomplete
    held, seen : body_from_lab of frames taken before, and the LEDs identified in them
    Raises InputError if no attitude shows enough LEDs.
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


def angles_deg(lab_from_body: Rotation) -> Floats:
    """(F, 3) roll, pitch and yaw, as a scene's `motion` has them: lab_from_body = Rz(yaw) Ry(pitch) Rx(roll)."""
    return np.asarray(lab_from_body.as_euler("ZYX", degrees=True)[:, ::-1])


def from_angles(roll_pitch_yaw_deg: Floats) -> Rotation:
    """lab_from_body of (F, 3) roll, pitch and yaw."""
    return Rotation.from_euler("ZYX", roll_pitch_yaw_deg[:, ::-1], degrees=True)


def from_rows(rows: Sequence[Mapping[str, float]]) -> Rotation:
    """lab_from_body of rows with roll_deg, pitch_deg and yaw_deg."""
    return from_angles(
        np.array([[row[f"{name}_deg"] for name in ("roll", "pitch", "yaw")] for row in rows])
    )


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


