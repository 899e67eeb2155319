"""The pass over the frame: which pixels stand out, as runs, and the runs that touch, as blobs."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.core.arrays import Floats, Ints
from estimator.core.jit import jit
from estimator.detection.background import at, filtered, filtered_row, summing

Ints32 = NDArray[np.int32]  # half the memory where there are millions of runs
FIRST_RUNS = 2048  # how many the first pass has room for
# Columns of a blob's sums. STRONG counts the pixels above the higher threshold, TOP is the highest filtered light.
AREA, STRONG, FLUX, X, Y, PEAK, TOP, TOP_X, TOP_Y = range(9)
SUMS = 9
STRETCH = 64  # pixels that are looked at closely if one of them is bright
ONE_TAP = np.zeros((1, 2), np.int64)


def runs_above(image: NDArray, threshold: Floats, taps: Ints | None = None) -> Ints32:
    """(N, 3) y, first x and last x of the runs whose filtered light is above a grid's bilinear threshold.

    Every row is filtered and compared in whole vectors with a bound that is nowhere above the threshold; only the
    stretches of pixels in which one exceeds the bound are looked at closely.
    taps : (K, 2) x, y offsets over which the filtered image is averaged, for streaks; None for round stars
    """
    kind = summing(image.dtype, image.max() if image.dtype == np.uint16 else np.inf)
    if taps is None:
        taps, wide = ONE_TAP, kind
    else:
        wide = np.float64 if kind == np.float64 else np.int32
    reach, width = int(np.abs(taps).max()), image.shape[1]
    sums, ring = np.empty(width + 2, kind), np.empty((2 * reach + 1, width + 2 * reach), wide)
    room = FIRST_RUNS
    while True:
        runs = np.empty((room, 3), np.int32)
        count = _scan(image, threshold, taps, sums, ring, runs)
        if count <= room:
            return runs[:count]
        room = count


@jit
def _scan(image: NDArray, threshold: Floats, taps: Ints, sums: NDArray, ring: NDArray, runs: Ints32) -> int:
    """Fill `runs`; how many there are, which may be more than fit. `ring` has room for the rows that taps reach."""
    height, width = image.shape
    reach, scale = len(ring) // 2, 16.0 * len(taps)
    room = max(width, STRETCH)  # a narrow frame fills no stretch: the rest is dark
    bounds, lights = np.zeros(room, ring.dtype), np.zeros(room, ring.dtype)
    bound, line = bounds[:width], lights[:width]
    mask = np.zeros(STRETCH, np.uint8)
    eights = mask.view(np.uint64)
    count, cell, ready = 0, -1, 0
    for y in range(height):
        cell = _bounds(threshold, height, y, cell, scale, bound)
        if reach == 0:
            filtered_row(image, y, sums, line)
        else:
            while ready < min(y + reach + 1, height):
                _padded_row(image, ready, reach, sums, ring[ready % len(ring)])
                ready += 1
            _line(ring, taps, y, height, line)
        for first in range(0, width, STRETCH):
            start = max(min(first, width - STRETCH), 0)  # the last one begins where it is whole
            part, least = lights[start : start + STRETCH], bounds[start : start + STRETCH]
            hit = False
            for i in range(STRETCH):  # a number known to the compiler: a handful of vectors
                hit |= part[i] > least[i]
            if not hit:
                continue
            for i in range(STRETCH):
                mask[i] = part[i] > least[i]
            for k in range(len(eights)):
                if eights[k] == 0:
                    continue
                for i in range(8 * k, 8 * k + 8):
                    x = start + i
                    if mask[i] and x >= first and line[x] > scale * at(threshold, height, width, y, x):
                        count = _extend(runs, count, y, x)
    return count


@jit
def _line(ring: NDArray, taps: Ints, y: int, height: int, out: NDArray) -> None:
    """Sum of the filtered rows at the taps about a row."""
    reach, width = len(ring) // 2, len(out)
    out[:] = 0
    for k in range(len(taps)):
        source = ring[min(max(y + taps[k, 1], 0), height - 1) % len(ring)]
        part = source[reach + taps[k, 0] : reach + taps[k, 0] + width]
        for x in range(width):
            out[x] += part[x]


@jit
def _padded_row(image: NDArray, y: int, reach: int, sums: NDArray, out: NDArray) -> None:
    """16 times the filtered row, its ends repeated."""
    inner = out[reach : len(out) - reach]
    filtered_row(image, y, sums, inner)
    out[:reach], out[len(out) - reach :] = inner[0], inner[-1]


@jit
def _extend(runs: Ints32, count: int, y: int, x: int) -> int:
    """Lengthen the last run or begin another."""
    if 0 < count <= len(runs) and runs[count - 1, 0] == y and runs[count - 1, 2] == x - 1:
        runs[count - 1, 2] = x
        return count
    if count < len(runs):
        runs[count, 0], runs[count, 1], runs[count, 2] = y, x, x
    return count + 1


@jit
def _bounds(threshold: Floats, height: int, y: int, cell: int, scale: float, bound: NDArray) -> int:
    """`scale` times the least threshold of the bilinear cell about every pixel of a row; the row's cell.

    Nothing is done while the row is in the cell of the row before.
    """
    rows, columns = threshold.shape
    width = len(bound)
    v = min(max((y + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
    mine = min(int(v), max(rows - 2, 0))
    if mine == cell:
        return cell
    below = min(mine + 1, rows - 1)
    for column in range(max(columns - 1, 1)):
        beside = min(column + 1, columns - 1)
        upper = min(threshold[mine, column], threshold[mine, beside])
        least = min(upper, min(threshold[below, column], threshold[below, beside]))
        if bound.itemsize == 8:
            value = scale * least
        elif bound.itemsize == 4:
            value = floor(min(max(scale * least, -2e9), 2e9))
        else:  # integer sums are above a number if they are above its floor
            value = floor(min(max(scale * least, 0.0), 65535.0))
        # From one tile centre to the next; the outermost reach to the frame's edge.
        first = 0 if column == 0 else int((column + 0.5) * width / columns)
        last = width if column >= columns - 2 else int((column + 1.5) * width / columns)
        bound[first:last] = value
    return mine


@jit
def labelled(runs: Ints32) -> tuple[Ints32, int]:
    """Which blob each run belongs to, eight-connected, numbered from 0 in raster order; and how many blobs.

    Runs of neighbouring rows are met pairwise from left to right; those that touch share a root (union-find).
    """
    count = len(runs)
    parent = np.arange(count, dtype=np.int32)
    start = end = 0  # the runs of the row above
    k = 0
    while k < count:
        y, first = runs[k, 0], k
        while k < count and runs[k, 0] == y:
            k += 1
        if end > start and runs[start, 0] == y - 1:
            i, j = start, first
            while i < end and j < k:
                if runs[i, 1] <= runs[j, 2] + 1 and runs[j, 1] <= runs[i, 2] + 1:
                    _join(parent, i, j)
                if runs[i, 2] < runs[j, 2]:
                    i += 1
                else:
                    j += 1
        start, end = first, k
    blob = np.empty(count, np.int32)
    blobs = 0
    for n in range(count):  # a root comes before all that hang on it
        root = _find(parent, n)
        if root == n:
            blob[n] = blobs
            blobs += 1
        else:
            blob[n] = blob[root]
    return blob, blobs


@jit
def _find(parent: Ints32, n: int) -> int:
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


@jit
def _join(parent: Ints32, a: int, b: int) -> None:
    a, b = _find(parent, a), _find(parent, b)
    if a != b:
        parent[max(a, b)] = min(a, b)


@jit
def summed(
    image: NDArray, level: Floats, strong: Floats, runs: Ints32, blob: Ints32, blobs: int
) -> tuple[Ints32, Floats]:
    """(blobs, 4) boxes and (blobs, SUMS) sums over every blob's pixels; see the columns' names."""
    height, width = image.shape
    boxes = np.empty((blobs, 4), np.int32)
    boxes[:, :2], boxes[:, 2:] = max(height, width), -1
    sums = np.zeros((blobs, SUMS))
    sums[:, PEAK], sums[:, TOP] = -np.inf, -np.inf
    for n in range(len(runs)):
        y, x0, x1 = runs[n]
        box, mine = boxes[blob[n]], sums[blob[n]]
        box[0], box[1] = min(box[0], x0), min(box[1], y)
        box[2], box[3] = max(box[2], x1), max(box[3], y)
        mine[AREA] += x1 - x0 + 1
        for x in range(x0, x1 + 1):
            sky = at(level, height, width, y, x)
            smooth = filtered(image, y, x)
            light = image[y, x] - sky
            mine[FLUX] += light
            mine[X] += light * x
            mine[Y] += light * y
            mine[PEAK] = max(mine[PEAK], float(image[y, x]))
            if smooth - sky > mine[TOP]:
                mine[TOP], mine[TOP_X], mine[TOP_Y] = smooth - sky, x, y
            if smooth > at(strong, height, width, y, x):
                mine[STRONG] += 1
    return boxes, sums


@jit
def ranked(
    boxes: Ints | Ints32, sums: Floats, least_area: float, grown_area: float, grown_light: float, most: int
) -> tuple[Ints, Floats, Floats, Floats, Ints, int]:
    """Boxes, (x, y), flux, peak and area of the `most` brightest that count, and how many count.

    Those count that have `least_area` pixels above the higher threshold, or `grown_area` pixels in all whose light
    is `grown_light` times the root of their number.
    """
    rows, count = np.empty(len(sums), np.int64), 0
    for n in range(len(sums)):
        area, light = sums[n, AREA], sums[n, FLUX]
        whole = area >= grown_area and light >= grown_light * sqrt(area)
        if light > 0 and (sums[n, STRONG] >= least_area or whole):
            rows[count] = n
            count += 1
    rows = rows[:count]
    rows = rows[np.argsort(-sums[rows, FLUX], kind="mergesort")][:most]
    xy = np.empty((len(rows), 2))
    for k in range(len(rows)):
        xy[k, 0], xy[k, 1] = sums[rows[k], X] / sums[rows[k], FLUX], sums[rows[k], Y] / sums[rows[k], FLUX]
    box = boxes[rows].astype(np.int64)
    return box, xy, sums[rows, FLUX], sums[rows, PEAK], sums[rows, AREA].astype(np.int64), count
