"""Gauge freedoms of the dome survey (rotation of the lab frame, scale) and the constraints that fix them.

No pixel changes if the lab frame rotates or if all lengths are scaled; see estimator/calibration/dome_survey.py.
The rotation is fixed by the start map (least squares) or by the attitude of one reference frame, and the scale by one
known length or by the start map. `Gauge.onto` transforms a solution to the gauge; `Gauge.held` linearizes the four
constraints for the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.bundle_adjustment import Bundle, Sightings
from estimator.core.arrays import Floats, Ints


@dataclass(frozen=True, slots=True)
class Part:
    """The connected subset of lights, frames and sightings, renumbered from 0.

    led, frame, index : their rows in the full set of lights, frames and sightings
    """

    bundle: Bundle
    seen: Sightings
    led: Ints
    frame: Ints
    index: Ints

    def into(self, whole: Bundle, found: Bundle) -> Bundle:
        """The full bundle with the adjusted values of this subset inserted."""
        position, turned = whole.position_m.copy(), whole.R_body_from_lab.copy()
        position[self.led], turned[self.frame] = found.position_m, found.R_body_from_lab
        return replace(found, position_m=position, R_body_from_lab=turned, map_m=whole.map_m)


@dataclass(frozen=True, slots=True)
class Gauge:
    """The constraints that fix the rotation and the scale of the lab frame.

    length : rows of two lights and the distance between them in m; None: the start map's mean size
    frame  : row of the reference frame; None: the start map's mean orientation
    map_m, R_body_from_lab : (N, 3), (F, 3, 3) start values
    """

    length: tuple[int, int, float] | None
    frame: int | None
    map_m: Floats
    R_body_from_lab: Floats

    @classmethod
    def of(
        cls,
        length: tuple[int, int, float] | None,
        frame: int | None,
        map_m: Floats,
        R_body_from_lab: Floats,
    ) -> Gauge:
        """The requested gauge. Raises ValueError for rows outside of the map or the frames."""
        count = len(map_m)
        if length is not None:
            i, j, metres = length
            if not (0 <= i < count and 0 <= j < count and i != j and 0 < metres < np.inf):
                raise ValueError(
                    f"survey: known_length is {length}; allowed: two different rows below {count}, above 0 m"
                )
        if frame is not None and not 0 <= frame < len(R_body_from_lab):
            raise ValueError(f"survey: reference_frame is {frame}; allowed: 0 to {len(R_body_from_lab) - 1}")
        return cls(length, frame, map_m, R_body_from_lab)

    def check(self, part: Part) -> None:
        """Raise ValueError if the gauge uses a light or a frame that is not surveyed."""
        if self.length is not None:
            self._pair(part)
        if self.frame is not None:
            self._frame(part)

    def onto(self, found: Bundle, part: Part) -> Bundle:
        """The bundle rotated and scaled to satisfy the gauge; its pixels do not change."""
        place, start = found.position_m, self.map_m[part.led]
        if self.frame is None:
            turn = Rotation.align_vectors(start, place)[0].as_matrix()
        else:
            turn = self.R_body_from_lab[self.frame].T @ found.R_body_from_lab[self._frame(part)]
        if self.length is None:
            # The scale for which the survey's projection on the start map equals the start map's own sum of squares:
            # the linear constraint that `held` uses.
            grown = np.sum(start**2) / np.sum(start * (place @ turn.T))
        else:
            i, j = self._pair(part)
            grown = self.length[2] / np.linalg.norm(place[i] - place[j])
        return replace(
            found,
            position_m=grown * place @ turn.T,
            R_body_from_lab=found.R_body_from_lab @ turn.T,
            camera_body_m=grown * found.camera_body_m,
            map_sigma_m=grown * found.map_sigma_m,
        )

    def held(self, found: Bundle, part: Part) -> tuple[Floats, Floats]:
        """The gauge's four constraints, linearized: (3 n, 4) for the positions and (R, 4) for the other unknowns."""
        start = self.map_m[part.led]
        by_led = np.zeros((len(start), 3, 4))
        by_rest = np.zeros((3 * len(part.frame) + 3 + found.free_lens, 4))
        if self.frame is None:
            for axis, e in enumerate(np.eye(3)):
                by_led[:, :, axis] = np.cross(e, start)
        else:
            first = 3 * self._frame(part)
            by_rest[first : first + 3, :3] = np.eye(3)
        if self.length is None:
            by_led[:, :, 3] = start
        else:
            i, j = self._pair(part)
            along = (found.position_m[i] - found.position_m[j]) / self.length[2]
            by_led[i, :, 3], by_led[j, :, 3] = along, -along
        return by_led.reshape(-1, 4), by_rest

    def _pair(self, part: Part) -> tuple[int, int]:
        assert self.length is not None
        for end in self.length[:2]:
            if end not in part.led:
                raise ValueError(
                    f"survey: known_length ends at LED row {end}, which the frames do not survey"
                )
        i, j = np.searchsorted(part.led, self.length[:2])
        return int(i), int(j)

    def _frame(self, part: Part) -> int:
        if self.frame is None or self.frame not in part.frame:
            raise ValueError(f"survey: reference_frame {self.frame} sees fewer than two surveyed LEDs")
        return int(np.searchsorted(part.frame, self.frame))


def common_turns(ours: Rotation, theirs: Rotation) -> tuple[Rotation, Rotation]:
    """The constant rotations of body and lab between two sets of simultaneous attitudes: theirs = left * ours * right.

    left = theirs_body_from_our_body (so cam_from_their_body = cam_from_our_body * left.inv()), right =
    our_lab_from_their_lab. Least squares by Gauss-Newton on the rotation vectors of the residuals, starting from the
    mean rotation. If all attitudes rotate about one axis, a rotation can be divided between the two; the minimum-norm
    step is taken.
    """
    left, right = Rotation.identity(), (ours.inv() * theirs).mean()
    for _ in range(50):
        between = left * ours
        left_over = (theirs * (between * right).inv()).as_rotvec()
        by = np.concatenate([np.tile(np.eye(3), (len(left_over), 1, 1)), between.as_matrix()], axis=2)
        move = np.linalg.lstsq(by.reshape(-1, 6), left_over.ravel(), rcond=1e-9)[0]
        left, right = Rotation.from_rotvec(move[:3]) * left, Rotation.from_rotvec(move[3:]) * right
        if np.linalg.norm(move) < 1e-14:
            break
    return left, right
