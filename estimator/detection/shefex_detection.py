"""SHEFEX-2's two scans of a frame: one sequential pass with a sorted table, or a repeated search for the maximum.

Both scans threshold the raw pixels at one level for the frame and collect each object by flood fill (the SHEFEX-2
paper, fig. 3). The sequential scan passes over the frame once and inserts each object into a table sorted by
brightness, which keeps the brightest. The maximum scan searches the largest pixel of the whole frame, removes its
object, and begins again: one pass for each object.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.detection.components import AREA, FLUX, PEAK, SUMS, X, Y


@jit
def sequential_scan(
    image: NDArray, level: float, threshold: float, min_area_px: int, table_size: int
) -> tuple[Ints, Floats]:
    """Return boxes (N, 4) and sums (N, SUMS) of the N <= table_size brightest objects, brightest first.

    In one raster pass, for each pixel above the threshold that does not belong to an object yet:

    1. Sum all pixels connected to it: a new object.
    2. Skip it if it is too small, or fainter than all objects of a full table.
    3. Insert it into the table by intensity; the faintest one drops out.
    """
    height, width = image.shape
    assigned = np.zeros(image.shape, np.uint8)
    stack = np.empty((image.size, 2), np.int32)
    boxes = np.empty((table_size, 4), np.int64)
    sums = np.zeros((table_size, SUMS))
    box = np.empty(4, np.int64)
    object_sums = np.empty(SUMS)
    count = 0
    for y in range(height):
        for x in range(width):
            if image[y, x] <= threshold or assigned[y, x]:
                continue
            # 1. Object
            _flood_fill(image, level, threshold, y, x, assigned, stack, box, object_sums)
            # 2. Size and brightness
            if object_sums[AREA] < min_area_px or (
                count == table_size and object_sums[FLUX] <= sums[count - 1, FLUX]
            ):
                continue
            # 3. Table
            count = _insert(boxes, sums, count, box, object_sums)
    return boxes[:count], sums[:count]


@jit
def maximum_scan(
    image: NDArray, level: float, threshold: float, min_area_px: int, table_size: int
) -> tuple[Ints, Floats]:
    """Scan as `sequential_scan`, but search the whole frame for the largest remaining pixel before each object.

    The scan ends when that pixel is below the threshold or the table is full; the table then holds the objects with the
    highest peaks.
    """
    height, width = image.shape
    assigned = np.zeros(image.shape, np.uint8)
    stack = np.empty((image.size, 2), np.int32)
    boxes = np.empty((table_size, 4), np.int64)
    sums = np.zeros((table_size, SUMS))
    box = np.empty(4, np.int64)
    object_sums = np.empty(SUMS)
    count = 0
    while count < table_size:
        # Largest pixel that belongs to no object yet
        top = threshold
        top_y = -1
        top_x = -1
        for y in range(height):
            for x in range(width):
                if image[y, x] > top and not assigned[y, x]:
                    top = float(image[y, x])
                    top_y = y
                    top_x = x
        if top_y < 0:
            break
        _flood_fill(image, level, threshold, top_y, top_x, assigned, stack, box, object_sums)
        if object_sums[AREA] >= min_area_px:
            count = _insert(boxes, sums, count, box, object_sums)
    return boxes[:count], sums[:count]


@jit
def _flood_fill(
    image: NDArray,
    level: float,
    threshold: float,
    y: int,
    x: int,
    assigned: NDArray,
    stack: NDArray,
    box: Ints,
    object_sums: Floats,
) -> None:
    """Sum all pixels above the threshold connected to (y, x) by sides or corners, and mark them in `assigned`.

    This is the paper's recursive centroiding with an explicit stack instead of recursion.
    """
    height, width = image.shape
    box[0] = x
    box[1] = y
    box[2] = x
    box[3] = y
    object_sums[:] = 0.0
    object_sums[PEAK] = -np.inf
    # The stack holds pixels that are assigned but not summed yet.
    stack[0, 0] = y
    stack[0, 1] = x
    assigned[y, x] = 1
    depth = 1
    while depth:
        depth -= 1
        v = stack[depth, 0]
        u = stack[depth, 1]
        light = image[v, u] - level
        object_sums[AREA] += 1
        object_sums[FLUX] += light
        object_sums[X] += light * u
        object_sums[Y] += light * v
        object_sums[PEAK] = max(object_sums[PEAK], float(image[v, u]))
        box[0], box[1] = min(box[0], u), min(box[1], v)
        box[2], box[3] = max(box[2], u), max(box[3], v)
        # Its eight neighbors, inside the image
        for b in range(max(v - 1, 0), min(v + 2, height)):
            for a in range(max(u - 1, 0), min(u + 2, width)):
                if image[b, a] > threshold and not assigned[b, a]:
                    assigned[b, a] = 1
                    stack[depth, 0] = b
                    stack[depth, 1] = a
                    depth += 1


@jit
def _insert(boxes: Ints, sums: Floats, count: int, box: Ints, object_sums: Floats) -> int:
    """Insert an object into the table by intensity; return the number of objects in it."""
    # Move the fainter objects down; the last of a full table drops out.
    k = min(count, len(sums) - 1)
    while k > 0 and sums[k - 1, FLUX] < object_sums[FLUX]:
        sums[k] = sums[k - 1]
        boxes[k] = boxes[k - 1]
        k -= 1
    sums[k] = object_sums
    boxes[k] = box
    return min(count + 1, len(sums))
