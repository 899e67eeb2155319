"""Gauge freedoms of the dome survey (rotation of the lab frame, scale) and the constraints that fix them.

No pixel changes if the lab frame rotates or if all lengths are scaled; see estimator/calibration/dome_survey.py. The
start map fixes the rotation (in the least-squares sense) and the scale: `transform` transforms a solution to this
gauge; `constraints` linearizes its four constraints for the covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.bundle_adjustment import Bundle
from estimator.core.checks import Floats


def transform(fitted: Bundle) -> Bundle:
    """Return the bundle rotated and scaled onto its start map; its pixels do not change.

    1. Find the rotation G of the lab frame onto the start map.
    2. Find the scale s onto the start map.
    3. Apply them: x <- s G x, A <- A G^T, r <- s r.
    """
    # 1. Rotation
    position_m = fitted.position_m
    start_m = fitted.map_m
    rotation = Rotation.align_vectors(start_m, position_m)[0].as_matrix()
    # 2. Scale. It makes the survey's projection on the start map equal to the start map's own sum of squares,
    # sum(x_0 . s G x) = sum(x_0 . x_0): the linear constraint that `constraints` uses.
    scale = np.sum(start_m**2) / np.sum(start_m * (position_m @ rotation.T))
    # 3. Transformed bundle
    return replace(
        fitted,
        position_m=scale * position_m @ rotation.T,
        R_body_from_lab=fitted.R_body_from_lab @ rotation.T,
        camera_body_m=scale * fitted.camera_body_m,
    )


def constraints(fitted: Bundle) -> tuple[Floats, Floats]:
    """Return the four constraints, linearized: (3 n, 4) for the positions and (R, 4) for the other unknowns."""
    start_m = fitted.map_m
    by_led = np.zeros((len(start_m), 3, 4))
    # Rotation: sum((e x x_0) . dx) = 0 about each axis e.
    for axis, e in enumerate(np.eye(3)):
        by_led[:, :, axis] = np.cross(e, start_m)
    # Scale: sum(x_0 . dx) = 0.
    by_led[:, :, 3] = start_m
    rest = 3 * len(fitted.R_body_from_lab) + 3 + fitted.free_lens
    return by_led.reshape(-1, 4), np.zeros((rest, 4))
