"""A small dome and a camera under it, for the tests of the survey's plan and faults."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, on_surface, project
from estimator.calibration.survey_plan import SurveyModel
from estimator.core.camera import Camera
from estimator.core.checks import Floats

CAMERA = Camera(640, 480, 900.0, (319.5, 239.5))
AXES_M = np.array([0.99, 0.99, 0.73])
CENTER_M = np.array([0.0, 0.0, 0.49])
NOISE_PX = 0.05
LIST_SIGMA_M = 0.002


def leds(count: int, half_deg: float = 40.0) -> LedMap:
    """LEDs on a golden spiral over the cap of an ellipsoid, seen from the bearing."""
    n = np.arange(count) + 0.5
    z = 1 - n / count * (1 - np.cos(np.radians(half_deg)))
    turn = n * np.pi * (3 - np.sqrt(5))
    along = np.column_stack(
        [np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z]
    )
    place_m = on_surface(
        along, np.zeros(3), LedMap(np.arange(0), np.zeros((0, 3)), CENTER_M, AXES_M)
    )
    return LedMap(np.arange(count), place_m, CENTER_M, AXES_M)


def model(count: int) -> SurveyModel:
    """The assumed dome."""
    lever = Lever(np.array([0.02, -0.03, 0.38]), Rotation.from_euler("z", 20, degrees=True))
    return SurveyModel(CAMERA, leds(count), lever, NOISE_PX, LIST_SIGMA_M)


def attitudes(rng: np.random.Generator, count: int, tilt_deg: float = 25.0) -> Rotation:
    """body_from_lab with tilts uniform over the cap and any yaw."""
    tilt = np.arccos(rng.uniform(np.cos(np.radians(tilt_deg)), 1, count))
    about = rng.uniform(0, 2 * np.pi, count)
    lean = Rotation.from_rotvec(
        tilt[:, None] * np.column_stack([np.cos(about), np.sin(about), 0 * about])
    )
    return (lean * Rotation.from_euler("z", rng.uniform(0, 2 * np.pi, count)[:, None])).inv()


def pixels(of: SurveyModel, place_m: Floats, attitude: Rotation) -> Floats:
    """(N, 2) pixels of LEDs at these places; those behind the camera get pixels far outside."""
    return np.nan_to_num(project(attitude, place_m, of.lever, of.camera), nan=-1e9)
