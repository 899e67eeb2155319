"""Connected components: thresholding of the filtered frame into runs, and labeling of connected runs as blobs.

A run is a row's sequence of adjacent pixels above the threshold.

1. `runs_above` filters each row and compares it with the threshold.
2. `label_runs` joins the runs that touch (eight-connected) by union-find.
3. `accumulate_blobs` sums flux, moments and bounding box of each blob over its runs.
4. `brightest_blobs` selects the blobs that are significant, brightest first.

Memory and time of steps 2 to 4 depend on the number of bright pixels, not on the size of the frame.

The threshold varies over the frame: it is a tile grid, interpolated bilinearly. Interpolating it at every pixel would
dominate the cost. So each row is first compared, in vector instructions, with a lower bound that is constant within a
grid cell (the smallest of the cell's four corners); the exact threshold is computed only for pixels above the bound.
"""

from math import floor

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Floats, Ints, Ints32
from estimator.core.jit import inlined, jit
from estimator.core.vectors import set_row
from estimator.detection.background import (
    accumulator_type,
    filtered,
    filtered_row,
    interpolate,
)

FIRST_RUNS = 2048  # capacity of the first pass; a second pass follows if there are more runs
# Columns of a blob's sums: number of pixels; number of pixels above the higher threshold; sums of I, I x and I y;
# largest pixel; largest filtered value above the sky, and its x and y.
AREA, STRONG, FLUX, X, Y, PEAK, TOP, TOP_X, TOP_Y = range(9)
SUMS = 9
CHUNK_PX = 64  # pixels that are tested together; only chunks with a bright pixel are examined further
ONE_TAP = np.zeros((1, 2), np.int64)


def runs_above(image: NDArray, threshold: Floats, taps: Ints | None = None) -> Ints32:
    """Return (N, 3) y, first x and last x of the runs whose filtered value is above the threshold grid.

    Parameters
    ----------
    threshold
        (rows, columns) values on tile centers, interpolated bilinearly
    taps
        (K, 2) x, y offsets over which the filtered image is averaged, for streaks; None for
        round stars
    """
    sum_type = accumulator_type(
        image.dtype, image.max() if image.dtype == np.uint16 else np.inf
    )
    if taps is None:
        taps = ONE_TAP
        ring_type = sum_type
    else:
        ring_type = np.float64 if sum_type == np.float64 else np.int32
    reach = int(np.abs(taps).max())
    width = image.shape[1]
    sums = np.empty(width + 2, sum_type)
    ring = np.empty((2 * reach + 1, width + 2 * reach), ring_type)
    # The scan counts all runs, so that a second pass has room for them.
    capacity = FIRST_RUNS
    while True:
        runs = np.empty((capacity, 3), np.int32)
        count = _scan(image, threshold, taps, sums, ring, runs)
        if count <= capacity:
            return runs[:count]
        capacity = count


@jit
def _scan(
    image: NDArray, threshold: Floats, taps: Ints, sums: NDArray, ring: NDArray, runs: Ints32
) -> int:
    """Fill `runs` and return the number of runs, which may exceed its capacity.

    For each row:

    1. Compute the lower bounds of the threshold (`_lower_bounds`).
    2. Filter the row, and average it along the taps.
    3. Compare chunks of pixels with the bounds.
    4. Compare the pixels above their bound with the exact threshold, and add them to the runs.

    Parameters
    ----------
    ring
        Circular buffer of 2 reach + 1 filtered rows, so that each row is filtered only once
    """
    height, width = image.shape
    reach = len(ring) // 2
    scale = 16.0 * len(taps)
    padded = max(width, CHUNK_PX)  # a frame narrower than a chunk is padded with zeros
    bounds = np.zeros(padded, ring.dtype)
    values = np.zeros(padded, ring.dtype)
    bound = bounds[:width]
    row = values[:width]
    mask = np.zeros(CHUNK_PX, np.uint8)
    # Plain 0 and -1 would be literal types, for which numba compiles every called function once more.
    count = np.int64(0)
    cell = np.int64(-1)
    ready = np.int64(0)
    for y in range(height):
        # 1. Lower bounds
        cell = _lower_bounds(threshold, height, y, cell, scale, bound)
        # 2. Filtered row
        if reach == 0:
            filtered_row(image, y, sums, row)
        else:
            while ready < min(y + reach + 1, height):
                _padded_row(image, ready, reach, sums, ring[ready % len(ring)])
                ready += 1
            _sum_taps(ring, taps, y, height, row)
        for first in range(0, width, CHUNK_PX):
            # The last chunk overlaps the one before, to be of full length.
            start = max(min(first, width - CHUNK_PX), 0)
            chunk = values[start : start + CHUNK_PX]
            chunk_bounds = bounds[start : start + CHUNK_PX]
            # 3. The loop has a constant length, so that the compiler unrolls it into vector instructions.
            hit = False
            for i in range(CHUNK_PX):
                hit |= chunk[i] > chunk_bounds[i]
            if not hit:
                continue
            for i in range(CHUNK_PX):
                mask[i] = chunk[i] > chunk_bounds[i]
            # 4. Exact threshold
            count = _add_pixels(
                mask, start, first, row, threshold, scale, height, y, runs, count
            )
    return int(count)


@inlined
def _add_pixels(
    mask: NDArray,
    start: int,
    first: int,
    row: NDArray,
    threshold: Floats,
    scale: float,
    height: int,
    y: int,
    runs: Ints32,
    count: int,
) -> int:
    """Add the pixels of a chunk that are above the exact threshold to the runs; return the number of runs.

    Parameters
    ----------
    mask
        (CHUNK_PX,) whether each pixel is above its lower bound
    start, first
        First pixel of the chunk, and the first that the chunk before does not hold
    row
        Filtered row y, `scale` times its values
    """
    # Eight mask bytes are tested as one integer, to skip dark pixels quickly.
    words = mask.view(np.uint64)
    for k in range(len(words)):
        if words[k] == 0:
            continue
        for i in range(8 * k, 8 * k + 8):
            x = start + i
            if (
                mask[i]
                and x >= first
                and row[x] > scale * interpolate(threshold, height, len(row), y, x)
            ):
                count = _extend(runs, count, y, x)
    return count


@inlined
def _sum_taps(ring: NDArray, taps: Ints, y: int, height: int, out: NDArray) -> None:
    """Sum the filtered rows over the taps around row y; rows beyond the frame repeat its edge."""
    reach = len(ring) // 2
    width = len(out)
    out[:] = 0
    for k in range(len(taps)):
        source = ring[min(max(y + taps[k, 1], 0), height - 1) % len(ring)]
        shifted = source[reach + taps[k, 0] : reach + taps[k, 0] + width]
        for x in range(width):
            out[x] += shifted[x]


@inlined
def _padded_row(image: NDArray, y: int, reach: int, sums: NDArray, out: NDArray) -> None:
    """Write 16 times the filtered row to `out`, padded at both ends by repeating the end values."""
    inner = out[reach : len(out) - reach]
    filtered_row(image, y, sums, inner)
    out[len(out) - reach :] = inner[-1]
    out[:reach] = inner[0]


@inlined
def _extend(runs: Ints32, count: int, y: int, x: int) -> int:
    """Extend the last run by pixel (y, x), or begin a new run; return the number of runs."""
    if 0 < count <= len(runs) and runs[count - 1, 0] == y and runs[count - 1, 2] == x - 1:
        runs[count - 1, 2] = x
        return count
    if count < len(runs):
        set_row(runs, count, (y, x, x))
    return count + 1


@inlined
def _lower_bounds(
    threshold: Floats, height: int, y: int, cell: int, scale: float, bound: NDArray
) -> int:
    """Fill `bound` with `scale` times the smallest threshold of each pixel's grid cell; return the row's cell row.

    A bilinear interpolation is never below the smallest of its four corners. If the row is in the same cell row as the
    previous row (`cell`), the bounds are still valid and nothing is computed.
    """
    rows, columns = threshold.shape
    width = len(bound)
    # The cell row as in `background.interpolate`
    v = min(max((y + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
    cell_row = min(int(v), max(rows - 2, 0))
    if cell_row == cell:
        return cell
    below = min(cell_row + 1, rows - 1)
    for column in range(max(columns - 1, 1)):
        beside = min(column + 1, columns - 1)
        upper = min(threshold[cell_row, column], threshold[cell_row, beside])
        least = min(upper, min(threshold[below, column], threshold[below, beside]))
        if bound.itemsize == 8:
            value = scale * least
        elif bound.itemsize == 4:
            value = floor(min(max(scale * least, -2e9), 2e9))
        else:  # an integer exceeds a number exactly if it exceeds its floor
            value = floor(min(max(scale * least, 0.0), 65535.0))
        # A cell extends from one tile center to the next, x + 1/2 = (column + 1/2) width / columns; the outermost ones
        # extend to the frame's edge.
        first = 0 if column == 0 else round((column + 0.5) * width / columns)
        last = width if column >= columns - 2 else round((column + 1.5) * width / columns)
        bound[first:last] = value
    return cell_row


@jit
def label_runs(runs: Ints32) -> tuple[Ints32, int]:
    """Return the blob number of each run, from 0 in raster order, and the number of blobs.

    Two runs of adjacent rows are connected if they overlap or touch at a corner.

    1. Merge the runs of the row above (i) and of this row (j) like two sorted lists, always advancing the one that ends
       first, so that every touching pair occurs once.
    2. Join each pair in a union-find forest. A root is the first run of its blob in raster order.
    3. Number the roots in raster order, and give every run the number of its root.
    """
    count = len(runs)
    parent = np.arange(count, dtype=np.int32)
    start = end = 0  # the runs of the row above
    k = 0
    while k < count:
        y = runs[k, 0]
        first = k
        while k < count and runs[k, 0] == y:
            k += 1
        # 1. Merge with the row above, if that has runs.
        if end > start and runs[start, 0] == y - 1:
            i = start
            j = first
            while i < end and j < k:
                # 2. Join runs that touch.
                if runs[i, 1] <= runs[j, 2] + 1 and runs[j, 1] <= runs[i, 2] + 1:
                    _join(parent, i, j)
                if runs[i, 2] < runs[j, 2]:
                    i += 1
                else:
                    j += 1
        start = first
        end = k
    # 3. A root precedes all other runs of its blob, so that its number is known.
    blob = np.empty(count, np.int32)
    blobs = 0
    for n in range(count):
        root = _find(parent, n)
        if root == n:
            blob[n] = blobs
            blobs += 1
        else:
            blob[n] = blob[root]
    return blob, blobs


@jit
def _find(parent: Ints32, n: int) -> int:
    """Return the root of a run's tree."""
    # Path halving: each node visited is linked to its grandparent, which keeps the trees flat.
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


@jit
def _join(parent: Ints32, a: int, b: int) -> None:
    """Join the trees of two runs; the earlier root becomes the root of both, as `label_runs` requires."""
    a = _find(parent, a)
    b = _find(parent, b)
    if a != b:
        parent[max(a, b)] = min(a, b)


@jit
def accumulate_blobs(
    image: NDArray, level: Floats, strong: Floats, runs: Ints32, blob: Ints32, blobs: int
) -> tuple[Ints32, Floats]:
    """Return (blobs, 4) bounding boxes and (blobs, SUMS) sums over each blob's pixels, in the columns AREA to TOP_Y.

    Parameters
    ----------
    level, strong
        Grids of the sky level and of the higher threshold
    runs, blob, blobs
        Runs of `runs_above`, the blob number of each, and the number of blobs, as of `label_runs`
    """
    height, width = image.shape
    boxes = np.empty((blobs, 4), np.int32)
    boxes[:, :2] = max(height, width)
    boxes[:, 2:] = -1
    sums = np.zeros((blobs, SUMS))
    sums[:, PEAK] = -np.inf
    sums[:, TOP] = -np.inf
    for n in range(len(runs)):
        y, x0, x1 = runs[n]
        total = sums[blob[n]]
        for x in range(x0, x1 + 1):
            sky = interpolate(level, height, width, y, x)
            smooth = filtered(image, y, x)
            _add(image, sky, y, x, boxes[blob[n]], total)
            if smooth - sky > total[TOP]:
                total[TOP] = smooth - sky
                total[TOP_X] = x
                total[TOP_Y] = y
            if smooth > interpolate(strong, height, width, y, x):
                total[STRONG] += 1
    return boxes, sums


@jit
def brightest_blobs(
    boxes: Ints | Ints32,
    sums: Floats,
    min_strong_px: float,
    min_total_px: float,
    min_flux_per_root_px: float,
    max_blobs: int,
) -> tuple[Ints, Floats, Floats, Floats, Ints, int]:
    """Return boxes, (x, y), flux, peak and area of the `max_blobs` brightest accepted blobs, and the number accepted.

    A blob is accepted if it has `min_strong_px` pixels above the higher threshold, or if its total is significant: at
    least `min_total_px` pixels in all, with a flux of at least `min_flux_per_root_px` sqrt(area). Its position is
    (sum(I x), sum(I y)) / sum(I).
    """
    area = sums[:, AREA]
    flux = sums[:, FLUX]
    significant = (area >= min_total_px) & (flux >= min_flux_per_root_px * np.sqrt(area))
    strong = sums[:, STRONG] >= min_strong_px
    accepted = np.flatnonzero((flux > 0) & (strong | significant))
    # The brightest of the accepted blobs; those of equal flux keep their order.
    order = np.argsort(-flux[accepted], kind="mergesort")
    rows = accepted[order[:max_blobs]]
    kept = sums[rows]
    flux = kept[:, FLUX].copy()
    xy = kept[:, X : Y + 1] / kept[:, FLUX : FLUX + 1]
    area_px = kept[:, AREA].astype(np.int64)
    return (
        boxes[rows].astype(np.int64),
        xy,
        flux,
        kept[:, PEAK].copy(),
        area_px,
        len(accepted),
    )


@jit
def _add(
    image: NDArray, sky: float, y: int, x: int, box: Ints | Ints32, total: Floats
) -> None:
    """Add a pixel to the box and to the sums of a blob."""
    box[0], box[1] = min(box[0], x), min(box[1], y)
    box[2], box[3] = max(box[2], x), max(box[3], y)
    light = image[y, x] - sky
    total[AREA] += 1
    total[FLUX] += light
    total[X] += light * x
    total[Y] += light * y
    total[PEAK] = max(total[PEAK], float(image[y, x]))


@jit
def flood_fill(
    image: NDArray,
    level: Floats,
    threshold: Floats,
    smooth: bool,
    y: int,
    x: int,
    assigned: NDArray,
    stack: NDArray,
    box: Ints,
    total: Floats,
) -> None:
    """Sum the pixels above a threshold grid that are connected to (y, x) by sides or corners, and mark them `assigned`.

    This is the recursive centroiding of the SHEFEX-2 paper with an explicit stack instead of recursion.

    Parameters
    ----------
    level
        Grid of the sky level
    smooth
        Whether the filtered image is compared with the threshold, else the image
    assigned
        (H, W) whether a pixel belongs to an object
    stack
        (M, 2) buffer: the object ends at M pixels
    """
    height, width = image.shape
    box[:] = x, y, x, y
    total[:] = 0.0
    total[PEAK] = -np.inf
    # The stack holds the pixels of the object: those that are summed, then those that are not yet.
    stack[0] = y, x
    assigned[y, x] = 1
    count = 1
    summed = 0
    while summed < count:
        v, u = stack[summed]
        summed += 1
        _add(image, interpolate(level, height, width, v, u), v, u, box, total)
        # Its eight neighbors, inside the image
        for b in range(max(v - 1, 0), min(v + 2, height)):
            for a in range(max(u - 1, 0), min(u + 2, width)):
                if assigned[b, a] or count == len(stack):
                    continue
                value = filtered(image, b, a) if smooth else float(image[b, a])
                if value > interpolate(threshold, height, width, b, a):
                    assigned[b, a] = 1
                    stack[count] = b, a
                    count += 1
