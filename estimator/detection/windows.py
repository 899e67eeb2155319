"""Light in windows: what stands where stars are expected, without a look at the rest of the frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.core.arrays import Floats, Ints
from estimator.core.jit import jit
from estimator.core.types import NO_PRIORS, Blobs, FramePriors
from estimator.detection.background import at, filtered, sky
from estimator.detection.classify import judged
from estimator.detection.detect import prepared

GROW_SIGMA = 3.0


def in_windows(
    image: NDArray, centre_px: Floats, half_px: float, threshold_sigma: float, hints: FramePriors = NO_PRIORS
) -> Blobs:
    """The brightest blob of each window, brightest first: its peak stands `threshold_sigma` above the local sky.

    image : (H, W) real;  centre_px : (N, 2) middles of square windows of half a side `half_px`
    A blob is the eight-connected pixels above 3 sigma of the 3x3-filtered image about its peak; it may reach beyond
    its window. Two windows that hold one blob have it once. Raises ImageError where there is nothing to look at.
    """
    image = prepared(image)
    background = sky(image)
    level, noise = background.level, background.noise
    rows = np.ascontiguousarray(centre_px, dtype=float)
    boxes, sums, count = _brightest(image, rows, half_px, level, noise, threshold_sigma)
    boxes, sums = boxes[:count], sums[:count]
    order = np.argsort(-sums[:, 1], kind="stable")
    boxes, sums = boxes[order], sums[order]
    flux = sums[:, 1]
    blobs = Blobs(
        boxes,
        sums[:, 2:4] / flux[:, None],
        flux,
        sums[:, 4],
        sums[:, 0].astype(np.int64),
        background,
        np.zeros(count, np.int64),
    )
    return judged(image, blobs, hints)


@jit
def _brightest(
    image: NDArray, centre_px: Floats, half_px: float, level: Floats, noise: Floats, threshold_sigma: float
) -> tuple[Ints, Floats, int]:
    """Boxes (N, 4), sums (N, 5: area, flux, flux x, flux y, peak) and how many there are."""
    height, width = image.shape
    boxes, sums, count = np.empty((len(centre_px), 4), np.int64), np.zeros((len(centre_px), 5)), 0
    for n in range(len(centre_px)):
        x0, x1 = _span(centre_px[n, 0], half_px, width)
        y0, y1 = _span(centre_px[n, 1], half_px, height)
        best, at_x, at_y = threshold_sigma, -1, -1
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                spread = at(noise, height, width, y, x)
                above = (filtered(image, y, x) - at(level, height, width, y, x)) / max(spread, 1e-12)
                if above > best:
                    best, at_x, at_y = above, x, y
        new = at_x >= 0
        for m in range(count):
            inside = boxes[m, 0] <= at_x <= boxes[m, 2] and boxes[m, 1] <= at_y <= boxes[m, 3]
            new = new and not inside
        if new:
            _grow(image, at_x, at_y, level, noise, boxes[count], sums[count])
            count += sums[count, 1] > 0
    return boxes, sums, count


@jit
def _span(middle_px: float, half_px: float, size: int) -> tuple[int, int]:
    """First and last pixel of a window along an axis; none where its middle is NaN."""
    low, high = middle_px - half_px, middle_px + half_px
    if not (high > -1 and low < size):
        return 0, -1
    return int(max(low, 0.0)), int(min(high, size - 1.0))


@jit
def _grow(image: NDArray, x: int, y: int, level: Floats, noise: Floats, box: NDArray, total: NDArray) -> None:
    """Collect the pixels connected to a peak; at most 4096 of them."""
    height, width = image.shape
    stack, seen = [(x, y)], {(x, y)}
    box[0], box[1], box[2], box[3] = x, y, x, y
    total[:] = 0.0
    while len(stack) > 0 and len(seen) < 4096:
        px, py = stack.pop()
        light = image[py, px] - at(level, height, width, py, px)
        total[0] += 1
        total[1] += light
        total[2] += light * px
        total[3] += light * py
        total[4] = max(total[4], float(image[py, px]))
        box[0], box[1] = min(box[0], px), min(box[1], py)
        box[2], box[3] = max(box[2], px), max(box[3], py)
        for qy in range(max(py - 1, 0), min(py + 2, height)):
            for qx in range(max(px - 1, 0), min(px + 2, width)):
                if (qx, qy) in seen:
                    continue
                above = filtered(image, qy, qx) - at(level, height, width, qy, qx)
                if above > GROW_SIGMA * at(noise, height, width, qy, qx):
                    seen.add((qx, qy))
                    stack.append((qx, qy))
