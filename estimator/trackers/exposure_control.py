"""Automatic exposure control of SHEFEX-2's camera (Samaan & Theil 2011, section 3.1 and fig. 2).

Two flags decide. `saturated`: the mean of the frame is above a reference, for example because a bright body shines into
the lens; or at least four objects have more than one saturated pixel each, so that a single planet does not shorten the
exposure. `no_stars`: there are fewer than four objects, too few to identify. A step is 2 ms.

    saturated                shorter by a step
    not saturated, no_stars  longer by a step
    neither                  unchanged

`saturated` has priority: glare also hides stars, and a longer exposure would make it worse.
"""

import math

import numpy as np
from numpy.typing import NDArray

from estimator.core import checks
from estimator.core.checks import Ints, frozen
from estimator.core.errors import ImageError
from estimator.core.jit import jit
from estimator.detection.detect import check_pixel_type, to_native

# The camera's own range and increment (table 1).
CAMERA_SHORTEST_S = 10e-6
CAMERA_LONGEST_S = 10.0
INCREMENT_S = 1e-6


@frozen
class Control:
    """Parameters of the control. The defaults are the paper's; it does not state mean_dn.

    Attributes
    ----------
    mean_dn
        Reference mean; a frame with a larger mean is saturated
    shortest_s, longest_s
        Limits of the exposure time; 50 ms is the paper's on-board limit, for a smear of 4.5 px at
        2 deg/s
    step_s
        Change of the exposure time from frame to frame
    min_stars
        Least number of objects; with fewer the flag no_stars is set
    overexposed_objects, saturated_px
        A frame is saturated if at least overexposed_objects objects have more than saturated_px
        saturated pixels each

    Raises
    ------
    ValueError
        For limits outside of the camera's range or for invalid numbers.
    """

    mean_dn: float
    shortest_s: float = CAMERA_SHORTEST_S
    longest_s: float = 0.05
    step_s: float = 0.002
    min_stars: int = 4
    overexposed_objects: int = 4
    saturated_px: int = 1

    def __post_init__(self) -> None:
        for name in ("mean_dn", "shortest_s", "longest_s", "step_s"):
            checks.of_type(
                f"exposure: {name}", getattr(self, name), float, int, np.floating, np.integer
            )
        for name in ("min_stars", "overexposed_objects", "saturated_px"):
            checks.number(
                f"exposure: {name}", getattr(self, name), 0, 1e9, "whole, 0 or more", True
            )
        if not CAMERA_SHORTEST_S <= self.shortest_s <= self.longest_s <= CAMERA_LONGEST_S:
            raise ValueError(
                f"exposure: limits of {self.shortest_s:g} s and {self.longest_s:g} s; allowed: "
                f"{CAMERA_SHORTEST_S:g} s to {CAMERA_LONGEST_S:g} s, the shortest first"
            )
        if not INCREMENT_S <= self.step_s < math.inf:
            raise ValueError(
                f"exposure: step_s is {self.step_s}; allowed: {INCREMENT_S:g} s or more"
            )
        if math.isnan(self.mean_dn):
            raise ValueError("exposure: mean_dn is NaN; allowed: a mean, inf for none")


@frozen
class Observation:
    """Measurements of one frame for the exposure control.

    Attributes
    ----------
    mean_dn
        Mean of all pixels
    stars
        Number of objects from centroiding
    overexposed
        Number of objects with more than `Control.saturated_px` saturated pixels
    """

    mean_dn: float
    stars: int
    overexposed: int


@frozen
class NextExposure:
    """Next exposure time, and the flags of the frame on which it is based."""

    time_s: float
    saturated: bool = False
    no_stars: bool = False


def step(state: NextExposure, observation: Observation, control: Control) -> NextExposure:
    """Return the next exposure from one frame's measurements, within the limits and in whole microseconds."""
    saturated = (
        observation.mean_dn > control.mean_dn
        or observation.overexposed >= control.overexposed_objects
    )
    no_stars = observation.stars < control.min_stars
    direction = -1 if saturated else int(no_stars)
    target_s = INCREMENT_S * round((state.time_s + direction * control.step_s) / INCREMENT_S)
    time_s = min(max(target_s, control.shortest_s), control.longest_s)
    return NextExposure(time_s, saturated, no_stars)


def observe(
    image: NDArray, box_px: Ints, saturation_dn: float, control: Control
) -> Observation:
    """Measure a frame for the exposure control.

    Parameters
    ----------
    image
        (H, W) frame
    box_px
        (N, 4) x0, y0, x1, y1 of the objects, both ends included, as in Blobs
    saturation_dn
        Least value of a saturated pixel

    Raises
    ------
    ImageError
        For boxes outside of the image.
    """
    checks.of_type("exposure: control", control, Control)
    check_pixel_type(image)
    if image.ndim != 2:
        raise ImageError(
            f"exposure: an image of shape {image.shape}; allowed: monochrome, (height, width)"
        )
    saturation_dn = checks.number(
        "exposure: saturation_dn", saturation_dn, -math.inf, math.inf, "a number"
    )
    boxes = checks.native("exposure: box_px", box_px, np.int64)
    if boxes.size % 4:
        raise ImageError(f"exposure: box_px has shape {boxes.shape}; allowed: (N, 4)")
    boxes = boxes.reshape(-1, 4)
    height, width = image.shape
    x0, y0, x1, y1 = boxes.T
    if not ((x0 >= 0) & (y0 >= 0) & (x1 < width) & (y1 < height)).all():
        raise ImageError(
            f"exposure: an object's box reaches beyond the image of {width}x{height} pixels"
        )
    mean, overexposed = _measure(to_native(image), boxes, saturation_dn, control.saturated_px)
    return Observation(mean, len(boxes), overexposed)


@jit
def _measure(
    image: NDArray, box_px: Ints, saturation_dn: float, allowed: int
) -> tuple[float, int]:
    """Return the mean of the frame, and the number of boxes with more than `allowed` saturated pixels."""
    # Mean: the sum of the rows' sums
    total = 0.0
    for y in range(image.shape[0]):
        row = 0.0
        for x in range(image.shape[1]):
            row += image[y, x]
        total += row
    overexposed = 0
    for n in range(len(box_px)):
        x0, y0, x1, y1 = box_px[n]
        saturated = image[y0 : y1 + 1, x0 : x1 + 1] >= saturation_dn
        overexposed += int(np.count_nonzero(saturated)) > allowed
    return total / image.size, overexposed
