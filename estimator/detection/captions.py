"""Text burned into a picture: dates, names of cameras, exposure times.

A line of text is a chain of blobs side by side that stand on one base line, are equally high and equally bright, and
differ in width, as letters do and disks or streaks do not. What is between them (points, hyphens, rests of letters)
belongs to it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.core.arrays import Floats, Ints
from estimator.core.jit import jit

MIN_HEIGHT_PX = 7  # of letters; smaller ones are not read
MIN_LETTERS = 5
# greatest difference of their tops and base lines over the height; of brightness
SAME_HEIGHT = 0.2
SAME_PEAK = 0.15
GAP = 1.5  # greatest gap of neighbors over the height: a space between words
UNEQUAL_WIDTH = 1.25  # least ratio of the widest to the narrowest letter
MARGIN = 0.5  # of the height: around a line of text


@jit
def find_captions(boxes: Ints, peak: Floats) -> NDArray[np.bool_]:
    """Return (N,) whether a blob belongs to a line of text, from the blobs' boxes (x0, y0, x1, y1) and peaks."""
    out = np.zeros(len(boxes), np.bool_)
    letter = np.zeros(len(boxes), np.bool_)
    line = np.empty(4, np.int64)
    for n in range(len(boxes)):
        height = boxes[n, 3] - boxes[n, 1] + 1
        if out[n] or height < MIN_HEIGHT_PX:
            continue
        letter[:] = False
        letter[n] = True
        for side in range(4):
            line[side] = boxes[n, side]
        count, narrow, wide = _grow(boxes, peak, n, letter, line)
        if count < MIN_LETTERS or wide < UNEQUAL_WIDTH * narrow:
            continue
        margin = MARGIN * height
        for k in range(len(boxes)):
            x = (boxes[k, 0] + boxes[k, 2]) / 2
            y = (boxes[k, 1] + boxes[k, 3]) / 2
            beside = (
                line[0] - margin < x < line[2] + margin and line[1] - margin < y < line[3] + margin
            )
            out[k] |= letter[k] or (beside and boxes[k, 3] - boxes[k, 1] < 2 * height)
    return out


@jit
def _grow(
    boxes: Ints, peak: Floats, first: int, letter: NDArray, line: Ints
) -> tuple[int, int, int]:
    """Extend a line from its first letter, in place; return the number of letters and their extreme widths.

    letter : (N,) whether a blob is a letter of it;  line : (4,) its box
    """
    top = boxes[first, 1]
    base = boxes[first, 3]
    height = base - top + 1
    count = 1
    narrow = wide = boxes[first, 2] - boxes[first, 0] + 1
    near_px = max(SAME_HEIGHT * height, 1.5)
    found = True
    while found:
        found = False
        for m in range(len(boxes)):
            if letter[m] or abs(boxes[m, 1] - top) > near_px or abs(boxes[m, 3] - base) > near_px:
                continue
            if max(boxes[m, 0] - line[2], line[0] - boxes[m, 2]) > GAP * height:
                continue
            if abs(peak[m] - peak[first]) > SAME_PEAK * abs(peak[first]):
                continue
            letter[m] = True
            found = True
            count += 1
            line[0], line[1] = min(line[0], boxes[m, 0]), min(line[1], boxes[m, 1])
            line[2], line[3] = max(line[2], boxes[m, 2]), max(line[3], boxes[m, 3])
            width = boxes[m, 2] - boxes[m, 0] + 1
            narrow = min(narrow, width)
            wide = max(wide, width)
    return count, narrow, wide
