"""Gauge freedoms of the dome survey (rotation of the lab frame, scale) and the constraints that fix them.

No pixel changes if the lab frame rotates or if all lengths are scaled; see estimator/calibration/dome_survey.py.
The start map (in the least-squares sense) or the attitude of one reference frame fixes the rotation; one known length
or the start map fixes the scale. `Gauge.transform` transforms a solution to the gauge; `Gauge.constraints` linearizes
the four constraints for the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.bundle_adjustment import Bundle
from estimator.calibration.survey_subset import Subset
from estimator.core.checks import Floats


@dataclass(frozen=True, slots=True)
class Gauge:
    """Constraints that fix the rotation and the scale of the lab frame.

    Attributes
    ----------
    length
        Rows of two lights and the distance between them in m, which fixes the scale; None: the
        start map's mean size fixes it
    frame
        Row of the reference frame, which fixes the rotation; None: the start map's mean
        orientation fixes it
    map_m, R_body_from_lab
        (N, 3) and (F, 3, 3) start values of positions and attitudes

    Raises
    ------
    ValueError
        For rows outside of the map or the frames.
    """

    length: tuple[int, int, float] | None
    frame: int | None
    map_m: Floats
    R_body_from_lab: Floats

    def __post_init__(self) -> None:
        count = len(self.map_m)
        frames = len(self.R_body_from_lab)
        if self.length is not None:
            i, j, meters = self.length
            if not (0 <= i < count and 0 <= j < count and i != j and 0 < meters < np.inf):
                raise ValueError(
                    f"survey: known_length is {self.length}; allowed: two different rows below {count}, above 0 m"
                )
        if self.frame is not None and not 0 <= self.frame < frames:
            raise ValueError(
                f"survey: reference_frame is {self.frame}; allowed: 0 to {frames - 1}"
            )

    @property
    def is_map(self) -> bool:
        """Whether the start map alone fixes rotation and scale."""
        return self.length is None and self.frame is None

    def check(self, subset: Subset) -> None:
        """Raise ValueError if the gauge uses a light or a frame that is not surveyed."""
        if self.length is not None:
            self._length_rows(subset)
        if self.frame is not None:
            self._reference_row(subset)

    def transform(self, fitted: Bundle, subset: Subset) -> Bundle:
        """Return the bundle rotated and scaled to satisfy the gauge; its pixels do not change.

        1. Find the rotation G of the lab frame: onto the start map, or to the reference frame's start attitude.
        2. Find the scale s: from the known length, or from the start map.
        3. Apply them: x <- s G x, A <- A G^T, r <- s r.
        """
        # 1. Rotation
        position_m = fitted.position_m
        start = self.map_m[subset.led]
        if self.frame is None:
            rotation = Rotation.align_vectors(start, position_m)[0].as_matrix()
        else:
            fitted_attitude = fitted.R_body_from_lab[self._reference_row(subset)]
            rotation = self.R_body_from_lab[self.frame].T @ fitted_attitude
        # 2. Scale. Without a length it makes the survey's projection on the start map equal to the start map's own
        # sum of squares, sum(x_0 . s G x) = sum(x_0 . x_0): the linear constraint that `constraints` uses.
        if self.length is None:
            scale = np.sum(start**2) / np.sum(start * (position_m @ rotation.T))
        else:
            i, j = self._length_rows(subset)
            scale = self.length[2] / np.linalg.norm(position_m[i] - position_m[j])
        # 3. Transformed bundle
        return replace(
            fitted,
            position_m=scale * position_m @ rotation.T,
            R_body_from_lab=fitted.R_body_from_lab @ rotation.T,
            camera_body_m=scale * fitted.camera_body_m,
            map_sigma_m=scale * fitted.map_sigma_m,
        )

    def constraints(self, fitted: Bundle, subset: Subset) -> tuple[Floats, Floats]:
        """Return the four constraints, linearized: (3 n, 4) for the positions and (R, 4) for the other unknowns."""
        start = self.map_m[subset.led]
        by_led = np.zeros((len(start), 3, 4))
        by_rest = np.zeros((3 * len(subset.frame) + 3 + fitted.free_lens, 4))
        # Rotation: sum((e x x_0) . dx) = 0 about each axis e, or no rotation of the reference frame.
        if self.frame is None:
            for axis, e in enumerate(np.eye(3)):
                by_led[:, :, axis] = np.cross(e, start)
        else:
            first = 3 * self._reference_row(subset)
            by_rest[first : first + 3, :3] = np.eye(3)
        # Scale: sum(x_0 . dx) = 0, or no change of the known length.
        if self.length is None:
            by_led[:, :, 3] = start
        else:
            i, j = self._length_rows(subset)
            direction = (fitted.position_m[i] - fitted.position_m[j]) / self.length[2]
            by_led[i, :, 3] = direction
            by_led[j, :, 3] = -direction
        return by_led.reshape(-1, 4), by_rest

    def _length_rows(self, subset: Subset) -> tuple[int, int]:
        """Return the subset's rows of the known length's two lights. Raises ValueError if one is not surveyed."""
        assert self.length is not None
        for row in self.length[:2]:
            if row not in subset.led:
                raise ValueError(
                    f"survey: known_length ends at LED row {row}, which is not surveyed"
                )
        i, j = np.searchsorted(subset.led, self.length[:2])
        return int(i), int(j)

    def _reference_row(self, subset: Subset) -> int:
        """Return the subset's row of the reference frame. Raises ValueError if it is not surveyed."""
        if self.frame is None or self.frame not in subset.frame:
            raise ValueError(
                f"survey: reference_frame {self.frame} sees fewer than two surveyed LEDs"
            )
        return int(np.searchsorted(subset.frame, self.frame))


def align_attitudes(ours: Rotation, theirs: Rotation) -> tuple[Rotation, Rotation]:
    """Return the constant rotations of body and lab between simultaneous attitudes: theirs = left * ours * right.

    `left` is their_body_from_our_body (so cam_from_their_body = cam_from_our_body * left.inv()), and `right` is
    our_lab_from_their_lab. Gauss-Newton minimizes the sum of squares of the residuals, the rotation vectors of
    theirs (left ours right)^-1:

    1. Start from left = I and the mean of ours^-1 theirs as right.
    2. Linearize: the residual changes by -w_left - R(left ours) w_right for small rotations of both.
    3. Solve by least squares. If all attitudes rotate about one axis, a rotation can be divided between the two; the
       minimum-norm step is taken.
    4. Rotate both, until the step is negligible.
    """
    # 1. Start
    left = Rotation.identity()
    right = (ours.inv() * theirs).mean()
    for _ in range(50):
        # 2. Residuals and Jacobian
        predicted_left = left * ours
        residual = (theirs * (predicted_left * right).inv()).as_rotvec()
        by_left = np.tile(np.eye(3), (len(residual), 1, 1))
        jacobian = np.concatenate([by_left, predicted_left.as_matrix()], axis=2)
        # 3. Step, of minimum norm
        step = np.linalg.lstsq(jacobian.reshape(-1, 6), residual.ravel(), rcond=1e-9)[0]
        # 4. Update
        left = Rotation.from_rotvec(step[:3]) * left
        right = Rotation.from_rotvec(step[3:]) * right
        if np.linalg.norm(step) < 1e-14:
            break
    return left, right
