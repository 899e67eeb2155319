"""The sky under the stars: its level and noise on a coarse grid, from a sparse sample of the frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.core.arrays import Floats
from estimator.core.jit import jit
from estimator.core.types import Background

TILE_PX = 64
SAMPLE_ROWS = 6  # of a tile: some 370 filtered pixels, of which 130 are independent
STARTERS = 33  # pixels that the robust start looks at
CLIP_SIGMA = 3.0
CLIPPED_VARIANCE = 0.9733  # of a Gaussian cut off at 3 sigma: 1 - 6 phi(3) / (2 Phi(3) - 1)
FILTERED_NOISE = 0.375  # white noise through the binomial filter keeps (1 + 4 + 1) / 16 of its deviation


def sky(image: NDArray, tile_px: int = TILE_PX) -> Background:
    """Mean and standard deviation of the 3x3-filtered image, tile by tile, without what stands out by 3 sigma.

    The start is a median and a scaled median absolute deviation of a few pixels; two rounds of clipping over more
    follow. The noise is that of the filtered image itself, so that correlated noise (JPEG, demosaicing) counts as
    it is. It has a floor of what quantisation leaves in a flat patch, lest a dark JPEG have none.
    """
    tile_px = min(tile_px, *image.shape)
    kind = summing(image.dtype)
    exact = (
        np.float64 if kind == np.float64 else np.float32
    )  # which holds 16 pixels of two bytes to the last digit
    level, noise = _tiles(image, tile_px, np.empty(image.shape[1], kind), np.empty(STARTERS, exact))
    step = 1.0 if image.dtype.kind in "iu" else 0.0
    return Background(level, np.maximum(noise, FILTERED_NOISE * step / np.sqrt(12)), tile_px)


def summing(pixel: np.dtype, greatest: float = np.inf) -> type:
    """The narrowest type that holds 16 times a pixel: narrow ones pass more pixels through a vector unit.

    greatest : of the pixels, where it is known: those of 12 bits fit a narrower type than their own tells
    """
    if pixel.kind not in "iu" or pixel.itemsize > 2:
        return np.float64
    return np.uint16 if pixel == np.uint8 or (pixel.kind == "u" and greatest < 4096) else np.int32


@jit
def filtered(image: NDArray, y: int, x: int) -> float:
    """The 3x3 binomial filter [1 2 1] x [1 2 1] / 16 at one pixel; edges repeat their last row or column."""
    height, width = image.shape
    up, down = max(y - 1, 0), min(y + 1, height - 1)
    left, right = max(x - 1, 0), min(x + 1, width - 1)
    total = 4.0 * image[y, x]
    total += 2.0 * (float(image[up, x]) + image[down, x] + image[y, left] + image[y, right])
    total += float(image[up, left]) + image[up, right] + image[down, left] + image[down, right]
    return total / 16.0


@jit
def filtered_row(image: NDArray, y: int, sums: NDArray, out: NDArray) -> None:
    """16 times a row of `filtered`, by way of column sums 1 2 1, one more at either end, in a buffer of theirs."""
    height, width = image.shape
    above, row, below = image[max(y - 1, 0)], image[y], image[min(y + 1, height - 1)]
    left, middle, right = sums[:width], sums[1 : width + 1], sums[2:]
    for x in range(width):
        middle[x] = above[x] + 2 * row[x] + below[x]
    sums[0], sums[width + 1] = sums[1], sums[width]
    for x in range(width):
        out[x] = left[x] + 2 * middle[x] + right[x]


@jit
def at(grid: Floats, height: int, width: int, y: float, x: float) -> float:
    """Bilinear value of a tile grid at a pixel; constant beyond the outermost tile centres."""
    rows, columns = grid.shape
    v, u = (y + 0.5) * rows / height - 0.5, (x + 0.5) * columns / width - 0.5
    # Not max(): of NaN, a place that is none, it makes NaN, and that a row beyond the grid.
    v, u = min(v if v > 0 else 0.0, rows - 1.0), min(u if u > 0 else 0.0, columns - 1.0)
    row, column = min(int(v), max(rows - 2, 0)), min(int(u), max(columns - 2, 0))
    below, beside = min(row + 1, rows - 1), min(column + 1, columns - 1)
    fv, fu = v - row, u - column
    top = grid[row, column] * (1 - fu) + grid[row, beside] * fu
    bottom = grid[below, column] * (1 - fu) + grid[below, beside] * fu
    return top * (1 - fv) + bottom * fv


@jit
def _tiles(image: NDArray, tile_px: int, smooth: NDArray, starters: NDArray) -> tuple[Floats, Floats]:
    """Level and noise of every tile from some of its rows; the last two are room, and tell the types to work in."""
    height, width = image.shape
    rows, columns = max(height // tile_px, 1), max(width // tile_px, 1)
    level, noise = np.empty((rows, columns)), np.empty((rows, columns))
    longest = width // columns + 1
    values, sums = (
        np.empty((columns, SAMPLE_ROWS * longest), starters.dtype),
        np.empty(width + 2, smooth.dtype),
    )
    for row in range(rows):
        y0, y1 = row * height // rows, (row + 1) * height // rows
        for k in range(SAMPLE_ROWS):
            filtered_row(image, y0 + (2 * k + 1) * (y1 - y0) // (2 * SAMPLE_ROWS), sums, smooth)
            for column in range(columns):
                x0, x1 = column * width // columns, (column + 1) * width // columns
                values[column, k * (x1 - x0) : (k + 1) * (x1 - x0)] = smooth[x0:x1]
        for column in range(columns):
            size = (column + 1) * width // columns - column * width // columns
            some = values[column, : SAMPLE_ROWS * size]
            middle, spread = _robust(some, starters)
            for _ in range(2):
                middle, spread = _clipped(some, middle, spread)
            level[row, column], noise[row, column] = middle / 16, spread / 16
    return level, noise


@jit
def median(values: Floats) -> float:
    """As numpy's, without its checks, which cost more than a short list."""
    return np.median(values)


@jit
def _robust(values: NDArray, starters: NDArray) -> tuple[float, float]:
    """Median and 1.4826 MAD of a few values spread evenly over all."""
    count = len(starters)
    for k in range(count):
        starters[k] = values[(2 * k + 1) * len(values) // (2 * count)]
    middle = _middle(starters)
    for k in range(count):
        starters[k] = abs(starters[k] - middle)
    return middle, 1.4826 * _middle(starters)


@jit
def _middle(values: NDArray) -> float:
    """Median of an odd number of values, by counting those below each: a few tens of them, without a branch."""
    half = len(values) // 2
    for value in values:
        below, up_to = np.int32(0), np.int32(0)
        for k in range(len(values)):
            below += np.int32(values[k] < value)
            up_to += np.int32(values[k] <= value)
        if below <= half < up_to:
            return value
    return values[0]


@jit(fastmath={"reassoc", "contract"})
def _clipped(values: NDArray, middle: float, spread: float) -> tuple[float, float]:
    """Mean and standard deviation of what lies within 3 sigma, the latter made good for the tails cut off."""
    number = values.dtype.type
    centre, reach, one = number(middle), number(CLIP_SIGMA * spread), number(1)
    count = total = squares = number(0)
    for i in range(len(values)):
        off = values[i] - centre
        kept = one if abs(off) <= reach else number(0)
        count += kept
        total += kept * off
        squares += kept * off * off
    if count < 1:
        return middle, spread
    mean = float(total) / count
    return float(centre) + mean, np.sqrt(max(float(squares) / count - mean * mean, 0.0) / CLIPPED_VARIANCE)
