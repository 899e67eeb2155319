"""Add images of points and disks to a patch of pixels (compiled; most of the rendering time).

Every `add_*` adds `electrons` spread as an image centered on (x, y), in pixels of the patch (0-based, the integer is
the pixel's center), to the rows row0 <= j < row1 of a C-ordered float64 patch. Light outside of these rows or of
the patch is left out; the rows of a rolling shutter add up to the total. The tables come from
`skysim.camera.psf.kernel`. These loops set the rendering time, so they avoid divisions, branches and checks.
"""

from math import ceil, erf, floor, sqrt

import numpy as np
from numpy.typing import NDArray

from skysim.core.jit import jit
from skysim.core.types import Floats, Singles

PER_PX = 64  # entries of a radial table per pixel
REACH_SIGMA = 6.5  # 7e-10 of a Gaussian's light is beyond
LANES = 32  # buffers are multiples of this (four registers of eight), so that SIMD loops leave no remainder


@jit
def reached(
    patch: Floats, row0: int, row1: int, x: float, y: float, reach: float
) -> tuple[int, int, int, int]:
    """First column, last + 1, first row, last + 1 of the pixels within an image's reach, the patch and the rows."""
    height, width = patch.shape
    left = max(ceil(x - reach), 0)
    right = min(floor(x + reach) + 1, width)
    top = max(ceil(y - reach), row0, 0)
    bottom = min(floor(y + reach) + 1, row1, height)
    return left, right, top, bottom


@jit
def add_gaussian(
    patch: Floats, row0: int, row1: int, x: float, y: float, electrons: float, sigma_px: float
) -> None:
    """Add the exact fraction of a Gaussian in each pixel: the product of two differences of the error function.

    Phi(a, b) = (erf(b / (sigma sqrt 2)) - erf(a / (sigma sqrt 2))) / 2 between a pixel's edges, along x and along y.
    """
    reach = REACH_SIGMA * sigma_px + 0.5
    left, right, top, bottom = reached(patch, row0, row1, x, y, reach)
    if right <= left or bottom <= top:
        return
    scale = 1 / (sigma_px * sqrt(2.0))
    # Along x once: neighbors share an edge, so each error function is computed once.
    columns = np.empty(right - left)
    low = erf((left - 0.5 - x) * scale)
    for i in range(columns.size):
        high = erf((left + i + 0.5 - x) * scale)
        columns[i] = (high - low) * (electrons / 4)
        low = high
    # Along y, row by row.
    low = erf((top - 0.5 - y) * scale)
    for j in range(top, bottom):
        high = erf((j + 0.5 - y) * scale)
        fraction = high - low
        low = high
        row = patch[j, left:right]
        for i in range(columns.size):
            row[i] += fraction * columns[i]


@jit(fastmath=True)
def add_round(
    patch: Floats, row0: int, row1: int, x: float, y: float, electrons: float, radial: Singles
) -> None:
    """Add a round image seen by square pixels: T0(r) + T4(r) cos 4 theta + T8(r) cos 8 theta.

    With the powers r^4 and r^8 the cosines are polynomials of u = dx^2, v = dy^2,

        r^4 cos 4 theta = (u + v)^2 - 8 u v,    r^8 cos 8 theta = 2 (r^4 cos 4 theta)^2 - r^8,

    without division or trigonometry. Only the table look-up runs pixel by pixel, all else as SIMD over LANES pixels.

    Parameters
    ----------
    radial
        (R, 3, 5 or 7) at r = i / PER_PX: of T0 the value, the step to the next entry and Bessel's second difference (a
        parabola: linear interpolation would lose 1e-4 of a sharp image's light); then value and step of T4 / r^4 and
        of T8 / r^8, where needed
    """
    reach = (radial.shape[0] - 2) / PER_PX
    left, right, top, bottom = reached(patch, row0, row1, x, y, reach)
    if right <= left or bottom <= top:
        return
    # Buffers for one row of pixels, a multiple of LANES long.
    lanes = (right - left + LANES - 1) // LANES * LANES
    buffers = np.empty((4, lanes), np.float32)
    entry = np.empty(lanes, np.int32)
    u = buffers[0]
    f = buffers[1]
    c4 = buffers[2]
    c8 = buffers[3]
    for i in range(lanes):
        u[i] = (left + i - x) ** 2
    for j in range(top, bottom):
        v = np.float32((j - y) ** 2)
        # Only the pixels of this row that are within the circle of the image.
        half = sqrt(max(reach * reach - v, 0.0))
        # Unsigned: saves numba's check for negative indices.
        first = np.uint64(max(ceil(x - half) - left, 0))
        last = np.uint64(max(min(floor(x + half) + 1, right) - left, 0))
        row = patch[j, left:]
        # Table entries and angular factors of the whole row, then the sum for its pixels.
        table_entries(u, v, entry, f)
        if radial.shape[1] > 3:
            angular_factors(u, v, c4, c8)
        if radial.shape[1] == 3:
            for i in range(first, last):
                row[i] += electrons * interpolate_t0(radial, entry[i], f[i])
        elif radial.shape[1] == 5:
            for i in range(first, last):
                k = np.uint64(entry[i])
                t4 = radial[k, 3] + f[i] * radial[k, 4]
                row[i] += electrons * (interpolate_t0(radial, entry[i], f[i]) + c4[i] * t4)
        else:
            for i in range(first, last):
                k = np.uint64(entry[i])
                t4 = radial[k, 3] + f[i] * radial[k, 4]
                t8 = radial[k, 5] + f[i] * radial[k, 6]
                row[i] += electrons * (
                    interpolate_t0(radial, entry[i], f[i]) + c4[i] * t4 + c8[i] * t8
                )


@jit(fastmath=True)
def table_entries(u: Singles, v: float, entry: NDArray[np.int32], fraction: Singles) -> None:
    """Write the entry of the radial table for each pixel of a row, and the fraction past it."""
    for i in range(u.size):
        r = np.sqrt(u[i] + v) * np.float32(PER_PX)
        entry[i] = np.int32(r)
        fraction[i] = r - np.float32(entry[i])


@jit(fastmath=True)
def angular_factors(u: Singles, v: float, c4: Singles, c8: Singles) -> None:
    """Write r^4 cos 4 theta and r^8 cos 8 theta of each pixel of a row."""
    for i in range(u.size):
        r4 = (u[i] + v) * (u[i] + v)
        c4[i] = r4 - np.float32(8) * u[i] * v
        c8[i] = np.float32(2) * c4[i] * c4[i] - r4 * r4


@jit(fastmath=True)
def interpolate_t0(radial: Singles, entry: int, f: float) -> float:
    """T0 at a fraction f past an entry, by a parabola: t + f (step + (f - 1) second difference)."""
    k = np.uint64(entry)
    return radial[k, 0] + f * (radial[k, 1] + (f - np.float32(1)) * radial[k, 2])


@jit
def cubic(t: float) -> tuple[float, float, float, float]:
    """Lagrange's weights of the samples at -1, 0, 1, 2 for a position 0 <= t < 1."""
    a = t + 1
    b = t
    c = t - 1
    d = t - 2
    return -b * c * d / 6, a * c * d / 2, -a * b * d / 2, a * b * c / 6


@jit(fastmath=True)
def add_grid(
    patch: Floats, row0: int, row1: int, x: float, y: float, electrons: float, grid: Singles
) -> None:
    """Add an image of any shape from its tables at S x S sub-pixel positions, with cubic interpolation between them.

    All pixels of one image use the same sixteen weights, so the inner loop runs over contiguous pixels of a row. Each
    table adds up to 1, and so does every mixture.

    Parameters
    ----------
    grid
        (S + 3, S + 3, N, N): grid[q, p, j, i] is the fraction in pixel (i, j) of an image centered at
        ((p - 1) / S - 1/2, (q - 1) / S - 1/2) from the middle pixel
    """
    steps = grid.shape[0] - 3
    size = grid.shape[2]
    # Nearest pixel, and position in it in steps of 1 / S.
    center_x = floor(x + 0.5)
    center_y = floor(y + 0.5)
    phase_x = (x - center_x + 0.5) * steps
    phase_y = (y - center_y + 0.5) * steps
    # First of the four tables along either axis, and the weights of the cubics.
    p = min(int(phase_x), steps - 1)
    q = min(int(phase_y), steps - 1)
    wx0, wx1, wx2, wx3 = cubic(phase_x - p)
    wy = cubic(phase_y - q)
    half = size // 2
    left, right, top, bottom = reached(patch, row0, row1, center_x, center_y, half)
    if right <= left or bottom <= top:
        return
    sums = np.empty(right - left, np.float32)
    first = left - center_x + half
    last = right - center_x + half
    for j in range(top, bottom):
        sums[:] = 0
        # Four rows of tables, each mixed with four weights.
        for s in range(4):
            tables = grid[q + s, p : p + 4, j - center_y + half, first:last]
            w0 = np.float32(wy[s] * wx0)
            w1 = np.float32(wy[s] * wx1)
            w2 = np.float32(wy[s] * wx2)
            w3 = np.float32(wy[s] * wx3)
            for i in range(sums.size):
                sums[i] += (
                    w0 * tables[0, i]
                    + w1 * tables[1, i]
                    + w2 * tables[2, i]
                    + w3 * tables[3, i]
                )
        row = patch[j, left:right]
        for i in range(sums.size):
            row[i] += electrons * sums[i]
