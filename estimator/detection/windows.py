"""Detection in windows: search for blobs only where stars are expected, without processing the rest of the frame.

It is used in tracking mode. For each window:

1. Find the peak: the largest filtered value above the sky, in units of the local noise (`_brightest`).
2. Collect the connected pixels above 3 sigma around it by flood fill (`flood_fill`).
"""

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.core.types import NO_PRIORS, Blobs, FramePriors
from estimator.detection.background import estimate_background, filtered, interpolate
from estimator.detection.classify import classify
from estimator.detection.components import FLUX, SUMS, flood_fill
from estimator.detection.detect import prepare_image, to_blobs

GROW_SIGMA = 3.0
MAX_AREA_PX = 4096  # largest area of a blob


def in_windows(
    image: NDArray,
    center_px: Floats,
    half_px: float,
    threshold_sigma: float,
    priors: FramePriors = NO_PRIORS,
) -> Blobs:
    """Detect the brightest blob of each window with a peak `threshold_sigma` above the local sky; brightest first.

    A blob is the set of eight-connected pixels above 3 sigma of the 3x3-filtered image around its peak; it may extend
    beyond its window. A blob found in two windows is returned once.

    Parameters
    ----------
    image
        (H, W) real numbers
    center_px
        (N, 2) centers of square windows of half-width `half_px`

    Raises
    ------
    ImageError
        For an image that cannot be used.
    """
    image = prepare_image(image)
    # The background is a sparse sample of the frame; only the windows are read in full.
    background = estimate_background(image)
    rows = np.ascontiguousarray(center_px, dtype=float)
    boxes, sums, count = _brightest(image, rows, half_px, *background, threshold_sigma)
    blobs = to_blobs(boxes[:count], sums[:count], 0, len(rows), background)
    return classify(image, blobs, priors)


@jit
def _brightest(
    image: NDArray,
    center_px: Floats,
    half_px: float,
    level: Floats,
    noise: Floats,
    threshold_sigma: float,
) -> tuple[Ints, Floats, int]:
    """Return boxes (N, 4), sums (N, SUMS) and the number of blobs in the first rows."""
    height, width = image.shape
    # Lower bounds of the interpolated sky and noise, which suffice to reject most pixels.
    darkest = level.min()
    least = max(noise.min(), 1e-12)
    boxes = np.empty((len(center_px), 4), np.int64)
    sums = np.zeros((len(center_px), SUMS))
    grow = level + GROW_SIGMA * noise
    assigned = np.zeros(image.shape, np.uint8)
    stack = np.empty((MAX_AREA_PX, 2), np.int32)
    count = 0
    for n in range(len(center_px)):
        x0, x1 = _span(center_px[n, 0], half_px, width)
        y0, y1 = _span(center_px[n, 1], half_px, height)
        # 1. Peak
        best = threshold_sigma
        at_x = -1
        at_y = -1
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                light = filtered(image, y, x)
                if light - darkest <= best * least:
                    continue
                spread = max(interpolate(noise, height, width, y, x), 1e-12)
                above = (light - interpolate(level, height, width, y, x)) / spread
                if above > best:
                    best = above
                    at_x = x
                    at_y = y
        # A peak inside the box of an earlier blob is taken to be that blob.
        new = at_x >= 0
        for m in range(count):
            inside = boxes[m, 0] <= at_x <= boxes[m, 2] and boxes[m, 1] <= at_y <= boxes[m, 3]
            new = new and not inside
        # 2. Connected pixels
        if new:
            flood_fill(
                image,
                level,
                grow,
                True,
                at_y,
                at_x,
                assigned,
                stack,
                boxes[count],
                sums[count],
            )
            count += sums[count, FLUX] > 0
    return boxes, sums, count


@jit
def _span(middle_px: float, half_px: float, size: int) -> tuple[int, int]:
    """Return first and last pixel of a window along an axis; (0, -1), an empty range, outside the frame and for NaN."""
    low = middle_px - half_px
    high = middle_px + half_px
    if not (high > -1 and low < size):
        return 0, -1
    return int(max(low, 0.0)), int(min(high, size - 1.0))
