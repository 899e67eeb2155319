"""Attitudes at which the vehicle is held for a survey: by a plan, or random."""

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
