"""Sky index for star identification: star pairs binned by separation, and stars binned by direction.

Pairs are sorted into bins of equal width in angle (a counting sort), so the candidates for a measured angle are the
pairs of a few adjacent bins. They are found by a sweep along z: with the stars sorted by z, only stars with |dz| up to
the maximum chord can form a pair.

Directions are binned on the six faces of a cube about the observer. A star is projected onto a face by the gnomonic
projection (u, v) = the two other components over the face's component, and each face is a grid of side x side cells.
The grid extends beyond the face's edges (|u|, |v| = 1) to FACE_HALF_WIDTH, so that a search around any direction needs
only the cells of one face; stars near an edge are therefore stored on more than one face.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Floats, ImageError
from estimator.core.jit import jit

# Spatial grid for searches by direction: the cube [-1, 1]^3 about the unit sphere, divided into
# cells.


MAX_SIDE = 64  # 64^3 cells: a table of a megabyte


class Cells(NamedTuple):
    """Stars by the cell of the cube [-1, 1]^3 that holds their direction. A named tuple, for compiled code.

    Attributes
    ----------
    side
        Cells along an edge
    first
        (side^3 + 1,) first entry of each cell in `row`
    row
        (N,) rows of the vectors, cell after cell
    """

    side: int
    first: NDArray[np.int32]
    row: NDArray[np.int32]


def build_grid(vectors: Floats) -> Cells:
    """Build the cells of (N, 3) unit vectors, with about one star in each cell that the sphere intersects.

    The sphere intersects about 4 pi / (2 / side)^2 = pi side^2 cells.
    """
    side = min(max(int(sqrt(len(vectors) / pi)), 2), MAX_SIDE)
    return Cells(side, *_sorted(vectors, side))


@jit
def _sorted(vectors: Floats, side: int) -> tuple[NDArray, NDArray]:
    """Sort the stars by cell (counting sort); returns the fields `first` and `row` of Cells."""
    first = np.zeros(side**3 + 1, np.int32)
    row = np.empty(len(vectors), np.int32)
    cell = np.empty(len(vectors), np.int64)
    for n in range(len(vectors)):
        x, y, z = vectors[n]
        cell[n] = (edge_cell(x, side) * side + edge_cell(y, side)) * side + edge_cell(z, side)
        first[cell[n] + 1] += 1
    for c in range(side**3):
        first[c + 1] += first[c]
    next_free = first[:-1].copy()
    for n in range(len(vectors)):
        row[next_free[cell[n]]] = n
        next_free[cell[n]] += 1
    return first, row


@jit
def cell_of(position: float, last: int) -> int:
    """Return the cell, 0 to last, of a coordinate in units of cells, clamped to the range; 0 for NaN.

    The clamp comes before the cast: casting NaN or a number too large for an integer is undefined.
    """
    if not position > 0:
        return 0
    return int(position) if position < last else last


@jit
def edge_cell(x: float, side: int) -> int:
    """Return the cell along an edge that holds a coordinate in [-1, 1]."""
    return cell_of((x + 1) / 2 * side, side - 1)


@jit
def within(
    cells: Cells, vectors: Floats, x: float, y: float, z: float, chord: float, out: NDArray
) -> int:
    """Count the stars within a straight-line distance `chord` of (x, y, z); writes the first len(out) rows to `out`."""
    count = 0
    side = cells.side
    for i in range(edge_cell(x - chord, side), edge_cell(x + chord, side) + 1):
        for j in range(edge_cell(y - chord, side), edge_cell(y + chord, side) + 1):
            low = (i * side + j) * side
            begin = cells.first[low + edge_cell(z - chord, side)]
            end = cells.first[low + edge_cell(z + chord, side) + 1]
            for entry in range(begin, end):
                s = cells.row[entry]
                dx = vectors[s, 0] - x
                dy = vectors[s, 1] - y
                dz = vectors[s, 2] - z
                if dx * dx + dy * dy + dz * dz <= chord * chord:
                    if count < len(out):
                        out[count] = s
                    count += 1
    return count


@jit
def nearest_in_grid(
    cells: Cells, vectors: Floats, x: float, y: float, z: float, chord: float
) -> int:
    """Return the row of the star nearest to (x, y, z) within a straight-line distance `chord`; -1 if there is none."""
    best = -1
    least2 = chord * chord
    side = cells.side
    for i in range(edge_cell(x - chord, side), edge_cell(x + chord, side) + 1):
        for j in range(edge_cell(y - chord, side), edge_cell(y + chord, side) + 1):
            low = (i * side + j) * side
            begin = cells.first[low + edge_cell(z - chord, side)]
            end = cells.first[low + edge_cell(z + chord, side) + 1]
            for entry in range(begin, end):
                s = cells.row[entry]
                dx = vectors[s, 0] - x
                dy = vectors[s, 1] - y
                dz = vectors[s, 2] - z
                distance2 = dx * dx + dy * dy + dz * dz
                if distance2 < least2:
                    best = s
                    least2 = distance2
    return best


PAIRS_PER_BIN = 8
STARS_PER_CELL = 0.5
MAG_STEP = 0.1
MAG_SMOOTHING = 0.25  # standard deviation of the Gaussian that smooths the histogram of magnitudes
# Half-width of a face's grid in tangents. It exceeds 1 (45 degrees) so that a gate up to 0.05 rad stays on one face.
FACE_HALF_WIDTH = 1.2


class SkyIndex(NamedTuple):
    """Stars, and pairs of the brightest, in bins. A named tuple, so that compiled code accepts it.

    Attributes
    ----------
    vectors
        (N, 3) unit vectors, brightest star first
    pair
        (P, 2) rows of stars, in bins of the angle between them
    first
        (B + 1,) pairs first[k] to first[k + 1] are separated by k to k + 1 times bin_rad
    mag
        (N,) magnitudes, increasing
    share
        Their density per magnitude, from mag[0] in steps of MAG_STEP
    cell_first, cell_star
        The stars of cell c are cell_star[cell_first[c] : cell_first[c + 1]]; each face of the
        cube has side x side cells
    cells
        The stars in the cells of `spatial_grid`, for wide searches
    """

    vectors: Floats
    pair: NDArray[np.int32]
    first: NDArray[np.int32]
    bin_rad: float
    mag: Floats
    density: Floats
    cell_first: NDArray[np.int32]
    cell_star: NDArray[np.int32]
    side: int
    cells: Cells

    @property
    def bytes(self) -> int:
        """Memory of the arrays, bytes."""
        return sum(array.nbytes for array in (*self, *self.cells) if isinstance(array, np.ndarray))


def build(
    vectors: Floats, mag: Floats, max_angle_rad: float, paired: int | None = None
) -> SkyIndex:
    """Build the index of (N, 3) unit vectors, brightest first, with all pairs up to an angle.

    Parameters
    ----------
    paired
        Number of brightest stars that form pairs; None: all. Raises ImageError for fewer than 3
        pairs.
    """
    sky = build_without_pairs(vectors, mag)
    vectors = sky.vectors[:paired]
    max_angle_rad = min(max_angle_rad, np.pi)
    by_z = np.argsort(vectors[:, 2])
    sorted_xyz = np.ascontiguousarray(vectors[by_z].T)
    # A uniform sky's pairs and a fifth more; a second sweep if these are not enough.
    expected = len(vectors) ** 2 * np.sin(max_angle_rad / 2) ** 2 / 2
    found = np.empty((0, 2), np.int32)
    half_chord = np.empty(0)
    total = int(1.2 * expected) + 1000
    while total > len(found):
        found = np.empty((total, 2), np.int32)
        half_chord = np.empty(total)
        total = _sweep(*sorted_xyz, 2 * np.sin(max_angle_rad / 2), found, half_chord)
    # The half-chord keeps small angles exact where arccos of a dot product would lose half the digits.
    angle_rad = np.minimum(
        half_chord[:total], 1.0, out=half_chord[:total]
    )  # in place: there may be millions
    angle_rad = np.multiply(np.arcsin(angle_rad, out=angle_rad), 2, out=angle_rad)
    pair, first, bin_rad = _sort_into_bins(
        by_z, found[:total], angle_rad, max_angle_rad * (1 + 1e-9)
    )
    if len(pair) < 3:
        raise ImageError(
            f"{len(pair)} pairs of stars within {np.degrees(max_angle_rad):.2f} deg are too few; allowed: 3 or more"
        )
    return sky._replace(pair=pair, first=first, bin_rad=bin_rad)


def build_without_pairs(vectors: Floats, mag: Floats) -> SkyIndex:
    """Build the index of (N, 3) unit vectors, brightest first, without pairs: for lookups by direction only."""
    vectors = np.ascontiguousarray(vectors, dtype=float)
    mag = np.ascontiguousarray(mag, dtype=float)
    side = max(int(np.sqrt(len(vectors) / STARS_PER_CELL / 6)), 1)
    empty_pairs = np.empty((0, 2), np.int32), np.zeros(2, np.int32), np.pi
    faces = _cells(vectors, side)
    cells = build_grid(vectors)
    return SkyIndex(vectors, *empty_pairs, mag, _magnitude_density(mag), *faces, side, cells)


def _magnitude_density(mag: Floats) -> Floats:
    """Return the density of sorted magnitudes per magnitude: a histogram smoothed by MAG_SMOOTHING."""
    reach = 4 * MAG_SMOOTHING
    edges = np.arange(mag[0] - reach, mag[-1] + reach + MAG_STEP, MAG_STEP)
    count = np.histogram(mag, edges)[0] / len(mag) / MAG_STEP
    kernel = np.exp(
        -(np.arange(-reach, reach + MAG_STEP / 2, MAG_STEP) ** 2) / 2 / MAG_SMOOTHING**2
    )
    smooth = np.convolve(count, kernel / kernel.sum(), mode="same")
    return np.maximum(smooth[round(reach / MAG_STEP) :], 1e-4)


@jit
def _sweep(
    x: Floats, y: Floats, z: Floats, reach: float, found: NDArray, half_chord: Floats
) -> int:
    """Find all pairs up to a chord among stars sorted by z, and their half-chords; return their number.

    No more than the arrays hold are stored: a greater number asks for another sweep.
    """
    total = 0
    for i in range(len(z)):
        for j in range(i + 1, len(z)):
            dz = z[j] - z[i]
            if dz > reach:
                break  # the stars are sorted by z: all further ones are out of reach too
            dx = x[j] - x[i]
            dy = y[j] - y[i]
            chord2 = dx * dx + dy * dy + dz * dz
            if chord2 > reach * reach:
                continue
            if total < len(half_chord):
                found[total, 0] = i
                found[total, 1] = j
                half_chord[total] = sqrt(chord2) / 2
            total += 1
    return total


@jit
def _sort_into_bins(
    row: NDArray, found: NDArray, angle_rad: Floats, end_rad: float
) -> tuple[NDArray[np.int32], NDArray[np.int32], float]:
    """Counting sort of pairs of `row`'s elements by angle: pairs, the first of each bin, and the bins' width."""
    bins = max(len(found) // PAIRS_PER_BIN, 1)
    bin_rad = end_rad / bins
    first = np.zeros(bins + 1, np.int32)
    for n in range(len(found)):
        first[int(angle_rad[n] / bin_rad) + 1] += 1
    for k in range(bins):
        first[k + 1] += first[k]
    pair = np.empty((len(found), 2), np.int32)
    next_free = first.copy()
    for n in range(len(found)):
        k = int(angle_rad[n] / bin_rad)
        pair[next_free[k], 0] = row[found[n, 0]]
        pair[next_free[k], 1] = row[found[n, 1]]
        next_free[k] += 1
    return pair, first, bin_rad


def _cells(vectors: Floats, side: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Sort the stars by cell; a star near the edge of a face is also on the neighboring face."""
    cell = []
    star = []
    for axis in range(3):
        for sign in (1, -1):
            along = sign * vectors[:, axis]
            gnomonic = np.roll(vectors, -axis, axis=1)[:, 1:] / np.maximum(along, 1e-9)[:, None]
            on_face = np.flatnonzero((along > 0) & (np.abs(gnomonic).max(axis=1) < FACE_HALF_WIDTH))
            cells = (gnomonic[on_face] + FACE_HALF_WIDTH) * side / (2 * FACE_HALF_WIDTH)
            column, row = cells.astype(np.int64).T
            cell.append(((2 * axis + (sign < 0)) * side + row) * side + column)
            star.append(on_face)
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
    """Return the star nearest to a unit vector and its squared chord; (-1, gate^2) if none is within the gate.

    The first four arguments are fields of a SkyIndex: passing the whole tuple would cost more than the search.

    Parameters
    ----------
    gate
        Radians, at most 0.05
    """
    # The largest component selects the face; the two others over it are the gnomonic coordinates.
    ax = abs(x)
    ay = abs(y)
    az = abs(z)
    if ax >= ay and ax >= az:
        face = 0 if x > 0 else 1
        inverse = 1 / ax
        u = y * inverse
        v = z * inverse
    elif ay >= az:
        face = 2 if y > 0 else 3
        inverse = 1 / ay
        u = z * inverse
        v = x * inverse
    else:
        face = 4 if z > 0 else 5
        inverse = 1 / az
        u = x * inverse
        v = y * inverse
    scale = side / (2 * FACE_HALF_WIDTH)
    # A gnomonic coordinate changes by at most (1 + u^2 + v^2) times the angle, to first order; the last factor bounds
    # the higher orders.
    reach = gate * (1 + u * u + v * v) * (1 + 4 * gate)
    left = cell_of((u - reach + FACE_HALF_WIDTH) * scale, side)
    right = cell_of((u + reach + FACE_HALF_WIDTH) * scale, side - 1)
    top = cell_of((v - reach + FACE_HALF_WIDTH) * scale, side)
    bottom = cell_of((v + reach + FACE_HALF_WIDTH) * scale, side - 1)
    best = -1
    closest2 = gate * gate
    for row in range(top, bottom + 1):
        # The cells of a row are contiguous in `cell_star`: one loop covers them.
        row_start = (face * side + row) * side
        for entry in range(cell_first[row_start + left], cell_first[row_start + right + 1]):
            star = cell_star[entry]
            dx = vectors[star, 0] - x
            dy = vectors[star, 1] - y
            dz = vectors[star, 2] - z
            distance2 = dx * dx + dy * dy + dz * dz
            if distance2 < closest2:
                best = star
                closest2 = distance2
    return best, closest2
