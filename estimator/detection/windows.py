"""Detection in windows: search for blobs only where stars are expected, without processing the rest of the frame.

It is used in tracking mode. For each window:

1. Find the peak: the largest filtered value above the sky, in units of the local noise (`_brightest`).
2. Collect the connected pixels above 3 sigma around it by flood fill (`_grow`).
"""

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.core.types import NO_PRIORS, Blobs, FramePriors
from estimator.detection.background import estimate_background, filtered, interpolate
from estimator.detection.classify import classify
from estimator.detection.detect import prepare_image

GROW_SIGMA = 3.0


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
    level = background.level
    noise = background.noise
    rows = np.ascontiguousarray(center_px, dtype=float)
    boxes, sums, count = _brightest(image, rows, half_px, level, noise, threshold_sigma)
    # Brightest first
    order = np.argsort(-sums[:count, 1], kind="stable")
    sums = sums[order]
    flux = sums[:, 1]
    blobs = Blobs(
        boxes[order],
        sums[:, 2:4] / flux[:, None],
        flux,
        sums[:, 4],
        sums[:, 0].astype(np.int64),
        background,
        np.zeros(count, np.int64),
    )
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
    """Return boxes (N, 4), sums (N, 5: area, flux, flux x, flux y, peak) and the number of blobs in the first rows."""
    height, width = image.shape
    # Lower bounds of the interpolated sky and noise, which suffice to reject most pixels.
    darkest = level.min()
    least = max(noise.min(), 1e-12)
    boxes = np.empty((len(center_px), 4), np.int64)
    sums = np.zeros((len(center_px), 5))
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
            _grow(image, at_x, at_y, level, noise, boxes[count], sums[count])
            count += sums[count, 1] > 0
    return boxes, sums, count


@jit
def _span(middle_px: float, half_px: float, size: int) -> tuple[int, int]:
    """Return first and last pixel of a window along an axis; (0, -1), an empty range, outside the frame and for NaN."""
    low = middle_px - half_px
    high = middle_px + half_px
    if not (high > -1 and low < size):
        return 0, -1
    return int(max(low, 0.0)), int(min(high, size - 1.0))


@jit
def _grow(
    image: NDArray, x: int, y: int, level: Floats, noise: Floats, box: NDArray, total: NDArray
) -> None:
    """Sum the pixels connected to a peak into `box` and `total` by flood fill, up to 4096 pixels."""
    height, width = image.shape
    # Pixels to be summed, and all pixels that have ever been among them
    stack = [(x, y)]
    visited = {(x, y)}
    box[0] = x
    box[1] = y
    box[2] = x
    box[3] = y
    total[:] = 0.0
    while len(stack) > 0 and len(visited) < 4096:
        px, py = stack.pop()
        light = image[py, px] - interpolate(level, height, width, py, px)
        total[0] += 1
        total[1] += light
        total[2] += light * px
        total[3] += light * py
        total[4] = max(total[4], float(image[py, px]))
        box[0], box[1] = min(box[0], px), min(box[1], py)
        box[2], box[3] = max(box[2], px), max(box[3], py)
        # Its eight neighbors, inside the image
        for qy in range(max(py - 1, 0), min(py + 2, height)):
            for qx in range(max(px - 1, 0), min(px + 2, width)):
                if (qx, qy) in visited:
                    continue
                above = filtered(image, qy, qx) - interpolate(level, height, width, qy, qx)
                if above > GROW_SIGMA * interpolate(noise, height, width, qy, qx):
                    visited.add((qx, qy))
                    stack.append((qx, qy))
