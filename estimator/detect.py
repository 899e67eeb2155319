"""Which pixels are light: background, threshold, connected blobs."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from estimator.types import Background, BadImage, Blobs, Floats

TILE_PX = 64
MAX_BLOBS = 20_000

Detector = Callable[..., Blobs]


def local(image: NDArray, threshold_sigma: float = 5.0, min_area_px: int = 3, max_blobs: int = 200) -> Blobs:
    """Blobs that stand `threshold_sigma` above the local sky after a 3x3 binomial filter.

    The filter [1 2 1] x [1 2 1] / 16 is close to the matched filter of a star of sigma 0.7 px, and its noise
    is measured on the filtered image itself, so that correlated noise (JPEG, demosaicing) counts as it is.
    image : (H, W), any real dtype. Raises BadImage where there is nothing to look at.
    """
    check(image)
    image = native(image)
    background = sky(image)
    return gather(image, background, threshold_sigma * background.noise, min_area_px, max_blobs)


def threshold(
    image: NDArray, threshold_sigma: float = 5.0, min_area_px: int = 3, max_blobs: int = 200
) -> Blobs:
    """Blobs above one level for the whole frame: its median plus `threshold_sigma` times its noise."""
    check(image)
    image = native(image)
    background = sky(image)
    level, noise = np.median(background.level), np.median(background.noise)
    flat = Background(np.full((1, 1), level), np.full((1, 1), noise), max(image.shape))
    return gather(image, flat, threshold_sigma * flat.noise, min_area_px, max_blobs)


DETECTORS: dict[str, Detector] = {"local": local, "threshold": threshold}


def check(image: NDArray) -> None:
    """Raise BadImage with one line unless the image is a plain, finite, uneven (H, W) array of real numbers."""
    if image.dtype.kind not in "buif":
        raise BadImage(f"pixels of type {image.dtype} are no brightness; allowed: integers and floats")
    if image.ndim != 2:
        raise BadImage(f"an image of shape {image.shape} is not monochrome; allowed: (height, width)")
    check_size(image)
    low, high = image.min(), image.max()
    if not (np.isfinite(low) and np.isfinite(high)):
        raise BadImage("the image holds NaN or infinite pixels; allowed: finite values")
    if low == high:
        raise BadImage(f"the frame is empty: every pixel is {low}")


def native(image: NDArray) -> NDArray:
    """The image in a type that compiled code takes: FITS files are big-endian, masks are boolean."""
    kind = {"b": "uint8", "f": "float32" if image.itemsize == 2 else "float64"}.get(image.dtype.kind)
    if kind and image.itemsize not in (4, 8):
        return image.astype(kind)
    return image.astype(image.dtype.newbyteorder("="), copy=False)


def check_size(image: NDArray) -> None:
    """Raise BadImage for an image too small to hold a star field."""
    if min(image.shape) < 16:
        raise BadImage(f"{image.shape[1]}x{image.shape[0]} pixels are too few; allowed: 16x16 and more")


def sky(image: NDArray, tile_px: int = TILE_PX) -> Background:
    """Median and scaled median absolute deviation of the filtered image, tile by tile.

    The noise has a floor of what quantisation leaves in a flat patch, lest a dark JPEG have none.
    """
    tile_px = min(tile_px, *image.shape)
    level, noise = _tiles(image, tile_px)
    step = 1.0 if np.issubdtype(image.dtype, np.integer) else 0.0
    return Background(level, np.maximum(noise, 0.375 * step / np.sqrt(12)), tile_px)


def gather(image: NDArray, background: Background, above: Floats, min_area_px: int, max_blobs: int) -> Blobs:
    """Label what is more than `above` (on the background's grid) over the level, and keep the brightest."""
    boxes, sums, count = _label(image, background.level, above, MAX_BLOBS)
    if count < 0:
        raise BadImage(f"over {MAX_BLOBS} blobs: the frame is noise or texture, not a star field")
    boxes, sums = boxes[:count], sums[:count]
    kept = np.flatnonzero((sums[:, 0] >= min_area_px) & (sums[:, 1] > 0))
    kept = kept[np.argsort(-sums[kept, 1], kind="stable")][:max_blobs]
    flux = sums[kept, 1]
    xy = sums[kept, 2:4] / flux[:, None]
    return Blobs(boxes[kept], xy, flux, sums[kept, 4], sums[kept, 0].astype(np.int64), background)


@numba.njit(cache=True)
def _filtered(image: NDArray, y: int, x: int) -> float:
    """The 3x3 binomial filter at one pixel; edges repeat their last row or column."""
    height, width = image.shape
    up, down = max(y - 1, 0), min(y + 1, height - 1)
    left, right = max(x - 1, 0), min(x + 1, width - 1)
    total = 4.0 * image[y, x]
    total += 2.0 * (float(image[up, x]) + image[down, x] + image[y, left] + image[y, right])
    total += float(image[up, left]) + image[up, right] + image[down, left] + image[down, right]
    return total / 16.0


@numba.njit(cache=True)
def _tiles(image: NDArray, tile_px: int) -> tuple[Floats, Floats]:
    """Median and 1.4826 MAD of every tile, from a quarter of its pixels."""
    height, width = image.shape
    rows, columns = max(height // tile_px, 1), max(width // tile_px, 1)
    level, noise = np.empty((rows, columns)), np.empty((rows, columns))
    for row in range(rows):
        y0 = row * height // rows
        y1 = (row + 1) * height // rows
        for column in range(columns):
            x0 = column * width // columns
            x1 = (column + 1) * width // columns
            values = np.empty(((y1 - y0 + 1) // 2) * ((x1 - x0 + 1) // 2))
            n = 0
            for y in range(y0, y1, 2):
                for x in range(x0, x1, 2):
                    values[n] = _filtered(image, y, x)
                    n += 1
            middle = np.median(values[:n])
            level[row, column] = middle
            noise[row, column] = 1.4826 * np.median(np.abs(values[:n] - middle))
    return level, noise


@numba.njit(cache=True)
def at(grid: Floats, height: int, width: int, y: float, x: float) -> float:
    """Bilinear value of a tile grid at a pixel; constant beyond the outermost tile centres."""
    rows, columns = grid.shape
    v = min(max((y + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
    u = min(max((x + 0.5) * columns / width - 0.5, 0.0), columns - 1.0)
    row, column = min(int(v), max(rows - 2, 0)), min(int(u), max(columns - 2, 0))
    below, beside = min(row + 1, rows - 1), min(column + 1, columns - 1)
    fv, fu = v - row, u - column
    top = grid[row, column] * (1 - fu) + grid[row, beside] * fu
    bottom = grid[below, column] * (1 - fu) + grid[below, beside] * fu
    return top * (1 - fv) + bottom * fv


@numba.njit(cache=True)
def _row(grid: Floats, height: int, width: int, y: int, out: Floats) -> None:
    """`at` for every pixel of a row: the rows blended once, then one straight line from tile to tile."""
    rows, columns = grid.shape
    v = min(max((y + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
    row = min(int(v), max(rows - 2, 0))
    below = min(row + 1, rows - 1)
    line = grid[row] * (1 - (v - row)) + grid[below] * (v - row)
    for x in range(width):
        u = min(max((x + 0.5) * columns / width - 0.5, 0.0), columns - 1.0)
        column = min(int(u), max(columns - 2, 0))
        out[x] = line[column] + (line[min(column + 1, columns - 1)] - line[column]) * (u - column)


@numba.njit(cache=True)
def _vertical(image: NDArray, y: int, out: Floats) -> None:
    """Column sums 1 2 1 about a row, with one more at either end: the first half of `_filtered`."""
    height, width = image.shape
    up, down = max(y - 1, 0), min(y + 1, height - 1)
    for x in range(width):
        out[x + 1] = float(image[up, x]) + 2.0 * image[y, x] + image[down, x]
    out[0], out[width + 1] = out[1], out[width]


@numba.njit(cache=True)
def _find(parent: NDArray, label: int) -> int:
    while parent[label] != label:
        parent[label] = parent[parent[label]]
        label = parent[label]
    return label


@numba.njit(cache=True)
def _label(image: NDArray, level: Floats, above: Floats, limit: int) -> tuple[NDArray, Floats, int]:
    """Eight-connected blobs in one raster pass, with union-find over provisional labels.

    Returns boxes (limit, 4), sums (limit, 5: area, flux, flux x, flux y, peak) and how many; -1 if too many.
    """
    height, width = image.shape
    parent = np.empty(8 * limit, np.int64)
    boxes = np.empty((8 * limit, 4), np.int64)
    sums = np.zeros((8 * limit, 5))
    previous, current = np.zeros(width + 2, np.int64), np.zeros(width + 2, np.int64)
    labels = 1
    column_sums = np.empty(width + 2)
    sky_row, above_row = np.empty(width), np.empty(width)
    for y in range(height):
        current[:] = 0
        _row(level, height, width, y, sky_row)
        _row(above, height, width, y, above_row)
        _vertical(image, y, column_sums)
        for x in range(width):
            smooth = (column_sums[x] + 2 * column_sums[x + 1] + column_sums[x + 2]) / 16.0
            if smooth - sky_row[x] <= above_row[x]:
                continue
            mine = 0
            for other in (current[x], previous[x], previous[x + 1], previous[x + 2]):
                if other == 0:
                    continue
                root = _find(parent, other)
                if mine == 0:
                    mine = root
                elif root != mine:
                    parent[max(root, mine)] = min(root, mine)
                    mine = min(root, mine)
            if mine == 0:
                if labels == 8 * limit:
                    return boxes, sums, -1
                mine = labels
                parent[mine] = mine
                boxes[mine] = (x, y, x, y)
                sums[mine, 4] = image[y, x]
                labels += 1
            current[x + 1] = mine
            excess = image[y, x] - sky_row[x]
            sums[mine, 0] += 1
            sums[mine, 1] += excess
            sums[mine, 2] += excess * x
            sums[mine, 3] += excess * y
            sums[mine, 4] = max(sums[mine, 4], image[y, x])
            boxes[mine, 0] = min(boxes[mine, 0], x)
            boxes[mine, 2] = max(boxes[mine, 2], x)
            boxes[mine, 3] = y
        previous, current = current, previous
    return _merge(parent, boxes, sums, labels, limit)


@numba.njit(cache=True)
def _merge(
    parent: NDArray, boxes: NDArray, sums: Floats, labels: int, limit: int
) -> tuple[NDArray, Floats, int]:
    """Fold every provisional label into its root and close the ranks."""
    for label in range(labels - 1, 0, -1):
        root = _find(parent, label)
        if root == label:
            continue
        sums[root, :4] += sums[label, :4]
        sums[root, 4] = max(sums[root, 4], sums[label, 4])
        boxes[root, 0] = min(boxes[root, 0], boxes[label, 0])
        boxes[root, 1] = min(boxes[root, 1], boxes[label, 1])
        boxes[root, 2] = max(boxes[root, 2], boxes[label, 2])
        boxes[root, 3] = max(boxes[root, 3], boxes[label, 3])
    count = 0
    for label in range(1, labels):
        if parent[label] == label:
            if count == limit:
                return boxes, sums, -1
            boxes[count] = boxes[label]
            sums[count] = sums[label]
            count += 1
    return boxes, sums, count
