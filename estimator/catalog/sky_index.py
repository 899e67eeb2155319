"""Sky index for star identification: star pairs binned by separation, and stars binned by direction.

Pairs (`add_pairs`) are sorted into bins of equal width in angle, so that the candidates for a measured angle are those
of a few adjacent bins:

1. Find all pairs (`close_pairs`).
2. Sort them into bins (`counting_sort`).

Stars are binned by direction (`Cells`): the cube [-1, 1]^3 about the unit sphere is divided into cells, for searches
within any angle (`within`, `nearest`). The stars are listed cell after cell. A search within a chord visits the cells
that meet the box of that half-width about the direction. Cells adjacent in z are adjacent in the list, so that each
(x, y) column is one loop.
"""

from math import pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimator.core.checks import Floats, Ints32
from estimator.core.errors import ImageError
from estimator.core.jit import jit
from estimator.core.vectors import lengths, row, squared_chord

# Spatial grid for searches by direction: the cube [-1, 1]^3 about the unit sphere, divided into cells.

MAX_SIDE = 128  # 128^3 cells: a table of eight megabytes
STARS_PER_CELL = 0.25  # of the cells that the sphere meets: measured, fastest for circles in one part of the sky
# Fields all over the sky are matched fastest with few cells, whose table stays in the processor's cache: measured.
STARS_PER_SKY_CELL = 2.0


class Cells(NamedTuple):
    """Stars by the cell of the cube [-1, 1]^3 that holds their direction. A named tuple, for compiled code.

    Attributes
    ----------
    side
        Number of cells along an edge
    first
        (side^3 + 1,) first entry of each cell in `row`
    row
        (N,) rows of the vectors, cell after cell
    """

    side: int
    first: Ints32
    row: Ints32


def build_grid(vectors: Floats, per_cell: float = STARS_PER_CELL) -> Cells:
    """Build the cells of (N, 3) unit vectors, with `per_cell` in each cell that the sphere meets, or more.

    The sphere meets about 4 pi / (2 / side)^2 = pi side^2 cells.
    """
    side = min(max(int(sqrt(len(vectors) / pi / per_cell)), 2), MAX_SIDE)
    return Cells(side, *counting_sort(_cube_cells(vectors, side), side**3))


@jit
def _cube_cells(vectors: Floats, side: int) -> Ints32:
    """(N,) number of the cell of each unit vector (N, 3); cells adjacent in z have successive numbers."""
    cell = np.empty(len(vectors), np.int32)
    for n in range(len(vectors)):
        x, y, z = vectors[n]
        cell[n] = (edge_cell(x, side) * side + edge_cell(y, side)) * side + edge_cell(z, side)
    return cell


@jit
def counting_sort(cell: NDArray, cells: int) -> tuple[Ints32, Ints32]:
    """Sort N things by their cell, in a time proportional to N; the order within a cell is kept.

    Parameters
    ----------
    cell
        (N,) number of each thing's cell, 0 to cells - 1

    Returns
    -------
    first
        (cells + 1,) the things of cell c are order[first[c] : first[c + 1]]
    order
        (N,) rows of the things, cell after cell
    """
    first = np.zeros(cells + 1, np.int32)
    order = np.empty(len(cell), np.int32)
    # Count the things of each cell, add the counts up, and fill the cells.
    for c in cell:
        first[c + 1] += 1
    for c in range(cells):
        first[c + 1] += first[c]
    free = first.copy()
    for n in range(len(cell)):
        order[free[cell[n]]] = n
        free[cell[n]] += 1
    return first, order


@jit
def cell_of(position: float, last: int) -> int:
    """The cell, 0 to last, of a coordinate in units of cells, clamped to the range; 0 for NaN.

    The clamp comes before the cast: casting NaN or a number too large for an integer is undefined.
    """
    if not position > 0:
        return 0
    return int(position) if position < last else last


@jit
def edge_cell(x: float, side: int) -> int:
    """The cell along an edge that holds a coordinate in [-1, 1]."""
    return cell_of((x + 1) / 2 * side, side - 1)


@jit
def within(
    cells: Cells, vectors: Floats, x: float, y: float, z: float, chord: float, out: NDArray
) -> int:
    """Find the stars within a straight-line distance `chord` of (x, y, z).

    Parameters
    ----------
    out
        Rows of the stars, as many as it holds, are written to it

    Returns
    -------
    int
        Number of stars
    """
    count = 0
    side = cells.side
    for i in range(edge_cell(x - chord, side), edge_cell(x + chord, side) + 1):
        for j in range(edge_cell(y - chord, side), edge_cell(y + chord, side) + 1):
            low = (i * side + j) * side
            begin = cells.first[low + edge_cell(z - chord, side)]
            end = cells.first[low + edge_cell(z + chord, side) + 1]
            for entry in range(begin, end):
                s = cells.row[entry]
                if squared_chord(row(vectors, s), (x, y, z)) <= chord * chord:
                    if count < len(out):
                        out[count] = s
                    count += 1
    return count


@jit
def nearest(
    vectors: Floats,
    cell_first: NDArray,
    cell_row: NDArray,
    side: int,
    x: float,
    y: float,
    z: float,
    gate: float,
) -> tuple[int, float]:
    """The star nearest to a unit vector within a gate.

    Parameters
    ----------
    cell_first, cell_row, side
        Fields of `Cells`: passing the whole tuple would cost more than the search
    x, y, z
        Unit vector in the catalog's frame
    gate
        Greatest straight-line distance

    Returns
    -------
    star, distance2
        Row of the star and its squared distance; -1 and gate^2 if none is within the gate
    """
    best = -1
    closest2 = gate * gate
    for i in range(edge_cell(x - gate, side), edge_cell(x + gate, side) + 1):
        for j in range(edge_cell(y - gate, side), edge_cell(y + gate, side) + 1):
            low = (i * side + j) * side
            begin = cell_first[low + edge_cell(z - gate, side)]
            end = cell_first[low + edge_cell(z + gate, side) + 1]
            for entry in range(begin, end):
                s = cell_row[entry]
                distance2 = squared_chord(row(vectors, s), (x, y, z))
                if distance2 < closest2:
                    best = s
                    closest2 = distance2
    return best, closest2


# Sky index: star pairs binned by separation, and stars by direction.
PAIRS_PER_BIN = 8
MOST_PAIRS = 2e6  # of a uniform sky: fewer stars are paired for more
PART = 2**16  # pairs whose angles are computed at once
MAG_STEP = 0.1
MAG_SMOOTHING = (
    0.25  # standard deviation of the Gaussian that smooths the histogram of magnitudes
)


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
    bin_rad
        Width of a bin
    mag
        (N,) magnitudes, increasing
    density
        Density of the magnitudes, 1 / mag, from mag[0] in steps of MAG_STEP
    cell_first, cell_star, side
        `Cells` of the stars: first, row, side
    """

    vectors: Floats
    pair: Ints32
    first: Ints32
    bin_rad: float
    mag: Floats
    density: Floats
    cell_first: Ints32
    cell_star: Ints32
    side: int


def build(vectors: Floats, mag: Floats) -> SkyIndex:
    """Build the index of (N, 3) unit vectors, brightest first, and (N,) magnitudes; without pairs (`add_pairs`)."""
    vectors = np.ascontiguousarray(vectors, dtype=float)
    mag = np.ascontiguousarray(mag, dtype=float)
    no_pairs = np.empty((0, 2), np.int32), np.zeros(2, np.int32), np.pi
    side, first, row = build_grid(vectors, STARS_PER_SKY_CELL)
    return SkyIndex(vectors, *no_pairs, mag, _smoothed_histogram(mag), first, row, side)


def add_pairs(sky: SkyIndex, max_angle_rad: float, paired: int | None = None) -> SkyIndex:
    """Return the index with all pairs up to an angle.

    Parameters
    ----------
    max_angle_rad
        Greatest angle of a pair
    paired
        Number of brightest stars that form pairs; None: all. Fewer do if there would be more than MOST_PAIRS

    Raises
    ------
    ImageError
        For fewer than 3 pairs.
    """
    max_angle_rad = min(max_angle_rad, np.pi)
    # 1. Find the pairs.
    pair, angle_rad = close_pairs(_paired(sky.vectors[:paired], max_angle_rad), max_angle_rad)
    # 2. Sort them into bins; the width leaves the greatest angle in the last bin, whatever the rounding.
    bins = max(len(pair) // PAIRS_PER_BIN, 1)
    bin_rad = max_angle_rad * (1 + 1e-9) / bins
    first, order = counting_sort((angle_rad / bin_rad).astype(np.int32), bins)
    if len(pair) < 3:
        raise ImageError(
            f"{len(pair)} pairs of stars within {np.degrees(max_angle_rad):.2f} deg are too few; allowed: 3 or more"
        )
    return sky._replace(pair=pair[order], first=first, bin_rad=bin_rad)


def count_pairs(vectors: Floats, max_angle_rad: float) -> int:
    """The number of pairs that `add_pairs` would add for (N, 3) unit vectors, counted without storing them."""
    tree = cKDTree(_paired(vectors, max_angle_rad))
    return (tree.count_neighbors(tree, chord_of(max_angle_rad)) - tree.n) // 2


def _paired(vectors: Floats, max_angle_rad: float) -> Floats:
    """The first, brightest, of (N, 3) unit vectors: those that form pairs up to an angle."""
    # A uniform sky of N stars has N^2 / 2 pairs, the share sin^2(angle / 2) of them up to an angle.
    share = (chord_of(max_angle_rad) / 2) ** 2 / 2
    if len(vectors) ** 2 * share > MOST_PAIRS:
        vectors = vectors[: int(np.sqrt(MOST_PAIRS / share))]
    return vectors


def chord_of(angle_rad: float) -> float:
    """Chord of an angle; that of half a turn for greater ones."""
    return float(2 * np.sin(min(angle_rad, np.pi) / 2))


def close_pairs(vectors: Floats, max_angle_rad: float) -> tuple[Ints32, Floats]:
    """The (P, 2) rows of all pairs of (N, 3) unit vectors up to an angle, and their (P,) angles."""
    longest = chord_of(max_angle_rad)
    pair = cKDTree(vectors).query_pairs(longest, output_type="ndarray").astype(np.int32)
    # The half-chord keeps small angles exact where arccos of a dot product would lose half the digits. Part by part, as
    # the vectors of all pairs would take six times the memory of the pairs.
    angle_rad = [
        2 * np.arcsin(np.minimum(lengths(vectors[part[:, 0]] - vectors[part[:, 1]]) / 2, 1.0))
        for part in np.array_split(pair, 1 + len(pair) // PART)
    ]
    return pair, np.concatenate(angle_rad)


def _smoothed_histogram(mag: Floats) -> Floats:
    """Density of sorted magnitudes, 1 / mag: a histogram smoothed by a Gaussian of MAG_SMOOTHING."""
    reach = 4 * MAG_SMOOTHING
    edges = np.arange(mag[0] - reach, mag[-1] + reach + MAG_STEP, MAG_STEP)
    count = np.histogram(mag, edges)[0] / len(mag) / MAG_STEP
    kernel = np.exp(
        -(np.arange(-reach, reach + MAG_STEP / 2, MAG_STEP) ** 2) / 2 / MAG_SMOOTHING**2
    )
    smooth = np.convolve(count, kernel / kernel.sum(), mode="same")
    return np.maximum(smooth[round(reach / MAG_STEP) :], 1e-4)


@jit
def magnitude_density(sky: SkyIndex, mag: float) -> float:
    """Probability density of the catalog's magnitudes at `mag`, 1 / mag."""
    return sky.density[cell_of((mag - sky.mag[0]) / MAG_STEP, len(sky.density) - 1)]
