"""How long to expose: SHEFEX-2's camera control (Samaan & Theil 2011, section 3.1 and fig. 2).

Two flags decide. `saturated`: the mean of the frame is above a reference, as where a bright body shines into the
lens; or at least four objects hold more than one saturated pixel each, so that one planet shortens nothing.
`no_stars`: fewer than four objects, too few to identify. A step is 2 ms.

    saturated                shorter by a step
    not saturated, no_stars  longer by a step
    neither                  unchanged

`saturated` comes first: in glare stars are lost too, and the chart's first purpose is not to expose longer then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.core.arrays import Ints
from estimator.core.errors import ImageError
from estimator.core.jit import jit

# The camera's own range and increment (table 1).
CAMERA_SHORTEST_S, CAMERA_LONGEST_S = 10e-6, 10.0
INCREMENT_S = 1e-6


@dataclass(frozen=True, slots=True)
class Control:
    """The chart's constants; the paper's, but for the reference mean, which it does not print.

    mean_dn     : the frame's mean above which it is no picture of stars
    longest_s   : 50 ms is the paper's on-board limit, for a smear of 4.5 px at 2 deg/s
    least_stars : fewer cannot be identified
    overexposed_objects, saturated_px : so many objects of more saturated pixels than that are too many

    Raises ValueError for limits outside of the camera's or numbers that are not usable.
    """

    mean_dn: float
    shortest_s: float = CAMERA_SHORTEST_S
    longest_s: float = 0.05
    step_s: float = 0.002
    least_stars: int = 4
    overexposed_objects: int = 4
    saturated_px: int = 1

    def __post_init__(self) -> None:
        if not CAMERA_SHORTEST_S <= self.shortest_s <= self.longest_s <= CAMERA_LONGEST_S:
            raise ValueError(
                f"exposure: limits of {self.shortest_s:g} s and {self.longest_s:g} s; allowed: "
                f"{CAMERA_SHORTEST_S:g} s to {CAMERA_LONGEST_S:g} s, the shortest first"
            )
        if not INCREMENT_S <= self.step_s < math.inf:
            raise ValueError(f"exposure: step_s is {self.step_s}; allowed: {INCREMENT_S:g} s or more")
        if math.isnan(self.mean_dn):
            raise ValueError("exposure: mean_dn is NaN; allowed: a mean, inf for none")


@dataclass(frozen=True, slots=True)
class Observation:
    """What the image processing says of one frame.

    mean_dn     : of all pixels
    stars       : how many objects the centroiding delivered
    overexposed : how many of them hold more than `Control.saturated_px` saturated pixels
    """

    mean_dn: float
    stars: int
    overexposed: int


@dataclass(frozen=True, slots=True)
class Exposure:
    """The exposure to take next, and the flags of the frame that it was decided on."""

    time_s: float
    saturated: bool = False
    no_stars: bool = False


def step(state: Exposure, seen: Observation, control: Control) -> Exposure:
    """Once through the chart: the next exposure, within the limits and in whole microseconds."""
    saturated = seen.mean_dn > control.mean_dn or seen.overexposed >= control.overexposed_objects
    no_stars = seen.stars < control.least_stars
    longer = -1 if saturated else int(no_stars)
    asked_s = INCREMENT_S * round((state.time_s + longer * control.step_s) / INCREMENT_S)
    time_s = min(max(asked_s, control.shortest_s), control.longest_s)
    return Exposure(time_s, saturated, no_stars)


def observe(image: NDArray, box_px: Ints, saturation_dn: float, control: Control) -> Observation:
    """Look at a frame for the chart.

    image  : (H, W); box_px : (N, 4) x0, y0, x1, y1 of the objects, both ends included, as Blobs has them
    saturation_dn : the value from which a pixel counts as saturated

    Raises ImageError for boxes beyond the image.
    """
    boxes = np.asarray(box_px, dtype=np.int64).reshape(-1, 4)
    height, width = image.shape
    x0, y0, x1, y1 = boxes.T
    if not ((x0 >= 0) & (y0 >= 0) & (x1 < width) & (y1 < height)).all():
        raise ImageError(f"exposure: an object's box reaches beyond the image of {width}x{height} pixels")
    mean, overexposed = _counted(image, boxes, float(saturation_dn), control.saturated_px)
    return Observation(mean, len(boxes), overexposed)


@jit
def _counted(image: NDArray, box_px: Ints, saturation_dn: float, allowed: int) -> tuple[float, int]:
    """Mean of the frame, and how many boxes hold more saturated pixels than allowed."""
    total = 0.0
    for y in range(image.shape[0]):
        row = 0.0
        for x in range(image.shape[1]):
            row += image[y, x]
        total += row
    overexposed = 0
    for n in range(len(box_px)):
        saturated = 0
        for y in range(box_px[n, 1], box_px[n, 3] + 1):
            for x in range(box_px[n, 0], box_px[n, 2] + 1):
                saturated += image[y, x] >= saturation_dn
        overexposed += saturated > allowed
    return total / image.size, overexposed
