"""Truth against estimate. Pure functions."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.types import Floats

WRONG_RAD = np.radians(10 / 60)  # PTASE's bar for a wrong attitude: ten arc-minutes


def cross_and_roll_rad(cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation) -> tuple[float, float]:
    """Attitude error split in two: across the boresight (>= 0) and about it (signed).

    The error rotation in camera axes, estimate after truth undone, as a rotation vector: hypot of its x and y,
    and its z.
    """
    x, y, z = (cam_from_ref_estimate * cam_from_ref_truth.inv()).as_rotvec()
    return float(np.hypot(x, y)), float(z)


def is_wrong(cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation) -> bool:
    """Whether an answer is worse than none: off by over ten arc-minutes in rotation angle."""
    return bool((cam_from_ref_estimate * cam_from_ref_truth.inv()).magnitude() > WRONG_RAD)


def normalised_error_squared(
    cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation, covariance_rad2: Floats
) -> float:
    """NEES: e^T P^-1 e, chi-square with three degrees of freedom where the covariance is true."""
    error = (cam_from_ref_estimate * cam_from_ref_truth.inv()).as_rotvec()
    return float(error @ np.linalg.solve(covariance_rad2, error))
