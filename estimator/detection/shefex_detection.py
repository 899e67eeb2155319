"""SHEFEX-2's two scans of a frame: one sequential pass with a sorted table, or a repeated search for the maximum.

Both scans threshold the raw pixels at one level for the frame and collect each object by flood fill (the SHEFEX-2
paper, fig. 3). The sequential scan passes over the frame once and inserts each object into a table sorted by
brightness, which keeps the brightest. The maximum scan searches the largest pixel of the whole frame, removes its
object, and begins again: one pass for each object.
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.detection.components import AREA, FLUX, SUMS, flood_fill


@jit
def _table_of(
    image: NDArray,
    level: float,
    threshold: float,
    min_area_px: int,
    table_size: int,
    again: bool,
) -> tuple[Ints, Floats]:
    """Return boxes (N, 4) and sums (N, SUMS) of the N <= table_size objects of a scan, brightest first.

    1. Find the next pixel above the threshold that does not belong to an object yet: in one raster pass, or if the
       frame is searched `again` for each object, the largest. The latter ends when the table is full, which then holds
       the objects with the highest peaks.
    2. Sum all pixels connected to it: a new object.
    3. Skip it if it is too small, or fainter than all objects of a full table.
    4. Insert it into the table by intensity; the faintest one drops out.
    """
    width = image.shape[1]
    grid = np.full((1, 1), level)
    limit = np.full((1, 1), threshold)
    assigned = np.zeros(image.shape, np.uint8)
    stack = np.empty((image.size, 2), np.int32)
    boxes = np.empty((table_size, 4), np.int64)
    sums = np.zeros((table_size, SUMS))
    box = np.empty(4, np.int64)
    object_sums = np.empty(SUMS)
    count = 0
    pixel = 0
    while pixel < image.size and not (again and count == table_size):
        # 1. Pixel
        top = threshold
        found = -1
        while pixel < image.size and (again or found < 0):
            y, x = divmod(pixel, width)
            if image[y, x] > top and not assigned[y, x]:
                top = float(image[y, x])
                found = pixel
            pixel += 1
        if found < 0:
            break
        pixel = 0 if again else pixel
        # 2. Object
        y, x = divmod(found, width)
        flood_fill(image, grid, limit, False, y, x, assigned, stack, box, object_sums)
        # 3. Size and brightness
        if object_sums[AREA] < min_area_px or (
            count == table_size and object_sums[FLUX] <= sums[count - 1, FLUX]
        ):
            continue
        # 4. Table
        count = _insert(boxes, sums, count, box, object_sums)
    return boxes[:count], sums[:count]


sequential_scan = partial(_table_of, again=False)
"""Scan once; of more objects than the table holds it keeps the brightest."""

maximum_scan = partial(_table_of, again=True)
"""Search the whole frame for its largest remaining pixel before each object."""


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
