"""Spatial grid for searches by direction: the cube [-1, 1]^3 about the unit sphere, divided into cells.

A counting sort lists the stars cell after cell. A search within a chord visits the cells that intersect the box of that
half-width about the direction; cells adjacent in z are adjacent in the list, so each (x, y) column is one loop.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Floats
from estimator.core.jit import jit

MAX_SIDE = 64  # 64^3 cells: a table of a megabyte


class Cells(NamedTuple):
    """Stars by the cell of the cube [-1, 1]^3 that holds their direction. A named tuple, for compiled code.

    side  : cells along an edge
    first : (side^3 + 1,) first entry of each cell in `row`;  row : (N,) rows of the vectors, cell after cell
    """

    side: int
    first: NDArray[np.int32]
    row: NDArray[np.int32]


def build(vectors: Floats) -> Cells:
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
def nearest(cells: Cells, vectors: Floats, x: float, y: float, z: float, chord: float) -> int:
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
