"""The on-board stars laid out for the search: pairs by their angle, and every star by where it stands."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.spatial_grid import cell_of
from estimator.core.arrays import Floats
from estimator.core.errors import ImageError
from estimator.core.jit import jit

PAIRS_A_BIN = 8
STARS_A_CELL = 0.5
MAG_STEP = 0.1
MAG_BLUR = 0.25  # by which the histogram of magnitudes is smoothed
# A face of the cube reaches so far beyond its 45 degrees that no gate to .05 rad needs another face.
EDGE = 1.2


class Sky(NamedTuple):
    """A plain tuple, so that compiled code can take it.

    vectors : (N, 3) unit vectors, brightest star first
    pair    : (P, 2) rows of stars, by bins of the angle between them
    first   : (B + 1,) pairs first[k] to first[k + 1] are k to k + 1 times bin_rad apart
    mag     : (N,) magnitudes, growing;  share : their density a magnitude, from mag[0] on in steps of MAG_STEP
    cell_first, cell_star : stars cell_star[cell_first[c]] onwards stand in cell c; there are side x side cells on each
        face of a cube about the observer (gnomonic projection)
    """

    vectors: Floats
    pair: NDArray[np.int32]
    first: NDArray[np.int32]
    bin_rad: float
    mag: Floats
    share: Floats
    cell_first: NDArray[np.int32]
    cell_star: NDArray[np.int32]
    side: int

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        return sum(part.nbytes for part in self if isinstance(part, np.ndarray))


def sky_of(vectors: Floats, mag: Floats, max_angle_rad: float) -> Sky:
    """Lay out (N, 3) unit vectors, brightest first, with all pairs up to an angle. Raises ImageError without any."""
    sky = unpaired(vectors, mag)
    vectors = sky.vectors
    order = np.argsort(vectors[:, 2])
    max_angle_rad = min(max_angle_rad, np.pi)
    one_bin = np.zeros(1, np.int64)
    _pairs(vectors, order, max_angle_rad, max_angle_rad * (1 + 1e-9), one_bin, np.empty((0, 2), np.int32))
    total = int(one_bin[0])
    if total < 3:
        raise ImageError(
            f"{total} pairs of stars within {np.degrees(max_angle_rad):.2f} deg are no pattern; allowed: 3 or more"
        )
    bins = max(total // PAIRS_A_BIN, 1)
    bin_rad = max_angle_rad * (1 + 1e-9) / bins
    count = np.zeros(bins, np.int64)
    _pairs(vectors, order, max_angle_rad, bin_rad, count, np.empty((0, 2), np.int32))
    first = np.concatenate([[0], np.cumsum(count)])
    pair = np.empty((total, 2), np.int32)
    _pairs(vectors, order, max_angle_rad, bin_rad, first[:-1].copy(), pair)
    return sky._replace(pair=pair, first=first.astype(np.int32), bin_rad=bin_rad)


def unpaired(vectors: Floats, mag: Floats) -> Sky:
    """Lay out (N, 3) unit vectors, brightest first, without pairs: to find what stands in a place."""
    vectors, mag = np.ascontiguousarray(vectors, dtype=float), np.ascontiguousarray(mag, dtype=float)
    side = max(int(np.sqrt(len(vectors) / STARS_A_CELL / 6)), 1)
    no_pairs = np.empty((0, 2), np.int32), np.zeros(2, np.int32), np.pi
    return Sky(vectors, *no_pairs, mag, _share(mag), *_cells(vectors, side), side)


def _share(mag: Floats) -> Floats:
    """Density of sorted magnitudes a magnitude, smoothed by MAG_BLUR."""
    reach = 4 * MAG_BLUR
    edges = np.arange(mag[0] - reach, mag[-1] + reach + MAG_STEP, MAG_STEP)
    count = np.histogram(mag, edges)[0] / len(mag) / MAG_STEP
    kernel = np.exp(-(np.arange(-reach, reach + MAG_STEP / 2, MAG_STEP) ** 2) / 2 / MAG_BLUR**2)
    smooth = np.convolve(count, kernel / kernel.sum(), mode="same")
    return np.maximum(smooth[round(reach / MAG_STEP) :], 1e-4)


@jit
def _pairs(
    vectors: Floats,
    order: NDArray,
    max_angle_rad: float,
    bin_rad: float,
    place: NDArray,
    pair: NDArray,
) -> None:
    """Every pair up to an angle, by a sweep along z: counted by bins where there is no room for it, else put there."""
    reach = 2 * np.sin(max_angle_rad / 2)
    for one in range(len(order)):
        i = order[one]
        for other in range(one + 1, len(order)):
            j = order[other]
            dz = vectors[j, 2] - vectors[i, 2]
            if dz > reach:
                break
            dx, dy = vectors[j, 0] - vectors[i, 0], vectors[j, 1] - vectors[i, 1]
            chord2 = dx * dx + dy * dy + dz * dz
            if chord2 > reach * reach:
                continue
            # The half-chord keeps small angles exact where arccos of a dot product would lose half the digits.
            number = int(2 * np.arcsin(min(sqrt(chord2) / 2, 1.0)) / bin_rad)
            if len(pair):
                pair[place[number], 0], pair[place[number], 1] = i, j
            place[number] += 1


def _cells(vectors: Floats, side: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Stars by cells; one near the border of a face is on the neighbouring face too."""
    cell, star = [], []
    for axis in range(3):
        for sign in (1, -1):
            along = sign * vectors[:, axis]
            flat = np.roll(vectors, -axis, axis=1)[:, 1:] / np.maximum(along, 1e-9)[:, None]
            here = np.flatnonzero((along > 0) & (np.abs(flat).max(axis=1) < EDGE))
            column, row = ((flat[here] + EDGE) * side / (2 * EDGE)).astype(np.int64).T
            cell.append(((2 * axis + (sign < 0)) * side + row) * side + column)
            star.append(here)
    number = np.concatenate(cell)
    order = np.argsort(number, kind="stable")
    first = np.searchsorted(number[order], np.arange(6 * side * side + 1))
    return first.astype(np.int32), np.concatenate(star)[order].astype(np.int32)


@jit
def nearest(
    vectors: Floats,
    cell_first: NDArray,
    cell_star: NDArray,
    side: int,
    x: float,
    y: float,
    z: float,
    gate: float,
) -> tuple[int, float]:
    """The star nearest to a unit vector within .05 rad or less, and the square of its distance; -1 if there is none.

    The first four are a Sky's: passing it whole would cost more than the search.
    """
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, inverse = (0 if x > 0 else 1), 1 / ax
        u, v = y * inverse, z * inverse
    elif ay >= az:
        face, inverse = (2 if y > 0 else 3), 1 / ay
        u, v = z * inverse, x * inverse
    else:
        face, inverse = (4 if z > 0 else 5), 1 / az
        u, v = x * inverse, y * inverse
    scale = side / (2 * EDGE)
    # A tangent grows by no more than 1 + u^2 + v^2 times the angle, and a little for the angle's own size.
    reach = gate * (1 + u * u + v * v) * (1 + 4 * gate)
    left, right = cell_of((u - reach + EDGE) * scale, side), cell_of((u + reach + EDGE) * scale, side - 1)
    top, bottom = cell_of((v - reach + EDGE) * scale, side), cell_of((v + reach + EDGE) * scale, side - 1)
    best, closest = -1, gate * gate
    for row in range(top, bottom + 1):
        line = (face * side + row) * side
        for place in range(cell_first[line + left], cell_first[line + right + 1]):
            star = cell_star[place]
            dx, dy, dz = vectors[star, 0] - x, vectors[star, 1] - y, vectors[star, 2] - z
            off2 = dx * dx + dy * dy + dz * dz
            if off2 < closest:
                best, closest = star, off2
    return best, closest
