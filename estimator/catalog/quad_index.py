"""Index of star quads by a code that does not depend on the scale: for a camera whose focal length is uncertain.

A quad is four stars. A and B are the two farthest apart; m is the bisector of their directions, n the normal A x B and
w the third axis, which points from B to A. The code of the quad is the place of C and D on these axes, in units of the
chord L between A and B (after Lang et al. 2010, Astron. J. 139, 1782, who use the circle over A and B):

    (C.w / L, C.n / L, D.w / L, D.n / L)

A wrong focal length multiplies all small angles by the same factor, and leaves the code unchanged. The same four stars
must always have the same code (`arrange`): A and B are exchanged if the sum of the first and the third number would be
negative, and C is the one with the smaller first number.

1. Choose stars that are bright for their surroundings, PER_CIRCLE in a circle as high as the field, so that the
   brightest detections of a frame are among them everywhere in the sky (`_locally_bright`). The number of quads grows
   with its fourth power and with the number of circles that cover the sky: it is smaller for narrow fields, so that
   there are no more quads than in MOST_CIRCLES.
2. Form all quads of a chosen star and its chosen neighbors, and their codes (`_quads`).
3. Sort them into the cells of a grid of four dimensions (`_grid_cells`).

Aberration is conformal: it multiplies the angles of a small field by one factor, up to 1 +- 10^-4, and changes a code
by 10^-4 of the field's size. Proper motions do change it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import (
    Cells,
    SkyIndex,
    build_grid,
    cell_of,
    chord_of,
    counting_sort,
    within,
)
from estimator.core import vectors
from estimator.core.checks import Floats, Ints, Ints32
from estimator.core.jit import jit

# Stars of quads in a circle as high as the field; the least number, and the number of circles that reduces it.
PER_CIRCLE = 10
LEAST_PER_CIRCLE = 6
MOST_CIRCLES = 3000  # of 820 quads each, measured with PER_CIRCLE stars
# Greatest and least distance of A and B, in units of the field's height.
LONGEST = 0.75
SHORTEST = 0.15
NEIGHBORS = (
    60  # greatest number of stars near one star that are combined with it, the brightest
)
SIDE = 20  # cells along each of the four axes
# Bounds of the coordinates along B to A and across: C and D are nearer to A and to B than A is to B.
ALONG = 0.5
ACROSS = 0.87


class QuadIndex(NamedTuple):
    """Quads by the cell of their code. A named tuple, so that compiled code accepts it.

    Attributes
    ----------
    star
        (Q, 4) rows of the sky index: A, B, C, D
    code
        (Q, 4) codes
    first
        (SIDE^4 + 1,) quads first[k] to first[k + 1] are in cell k
    """

    star: Ints32
    code: NDArray[np.float32]
    first: Ints32


def build(sky: SkyIndex, height_rad: float) -> QuadIndex:
    """Build the index of the stars of `sky` for fields of the given height: the module's steps."""
    # 1. Chosen stars.
    # 16 / height^2 circles cover the sky.
    share = min(MOST_CIRCLES * height_rad * height_rad / 16, 1.0)
    count = max(PER_CIRCLE * share**0.25, LEAST_PER_CIRCLE)
    cells = Cells(sky.side, sky.cell_first, sky.cell_star)
    row = _locally_bright(cells, sky.vectors, chord_of(height_rad / 2), count)
    chosen = sky.vectors[row]
    cells = build_grid(chosen)
    # 2. Quads: the first pass only counts them.
    total = 0
    bounds = chord_of(LONGEST * height_rad), SHORTEST * height_rad
    for _ in range(2):
        found = np.empty((total, 4), np.int32)
        code = np.empty((total, 4), np.float32)
        total = _quads(chosen, cells, *bounds, found, code)
    # 3. Cells.
    first, order = counting_sort(_grid_cells(code), SIDE**4)
    return QuadIndex(row[found[order]], code[order], first)


@jit
def _locally_bright(cells: Cells, xyz: Floats, radius: float, count: float) -> Ints32:
    """Step 1: rows of the stars, sorted by brightness, with fewer than `count` brighter ones within a chord."""
    near = np.empty(len(xyz), np.int64)
    chosen = np.empty(len(xyz), np.bool_)
    for n in range(len(xyz)):
        found = within(cells, xyz, *vectors.row(xyz, n), radius, near)
        # The smaller row is the brighter star.
        chosen[n] = np.sum(near[:found] < n) < count
    return np.flatnonzero(chosen).astype(np.int32)


@jit
def _quads(
    xyz: Floats,
    cells: Cells,
    longest: float,
    shortest: float,
    found: NDArray,
    code: NDArray,
) -> int:
    """Step 2: find all quads of neighbors, and their codes.

    Parameters
    ----------
    xyz, cells
        (N, 3) unit vectors of the stars, brightest first, and their grid
    longest, shortest
        Greatest and least chord of A and B
    found, code
        (Q, 4) rows and codes of the quads, written in place; no more than the arrays hold

    Returns
    -------
    int
        Number of quads
    """
    total = 0
    frame = np.empty((3, 3))
    around = np.empty(len(xyz), np.int64)
    near = np.empty(NEIGHBORS, np.int64)
    place = np.empty((NEIGHBORS, 2))
    for a in range(len(xyz)):
        star_a = vectors.row(xyz, a)
        reached = within(cells, xyz, *star_a, longest, around)
        candidates = np.sort(around[:reached])[:NEIGHBORS]
        # A and B.
        for b in candidates:
            star_b = vectors.row(xyz, b)
            length = vectors.chord(star_a, star_b)
            if b < a or length < shortest:
                continue
            vectors.pair_frame(star_a, star_b, frame)
            count = _stars_between(xyz, candidates, a, b, frame, near, place)
            # Pairs C, D of these stars.
            for k in range(count):
                for m in range(k):
                    if (
                        vectors.chord(vectors.row(xyz, near[k]), vectors.row(xyz, near[m]))
                        >= length
                    ):
                        continue
                    if total < len(found):
                        found[total] = a, b, near[k], near[m]
                        code[total, :2] = place[k]
                        code[total, 2:] = place[m]
                        arrange(code[total], found[total])
                    total += 1
    return total


@jit
def _stars_between(
    xyz: Floats,
    candidates: NDArray,
    a: int,
    b: int,
    frame: Floats,
    near: NDArray,
    place: Floats,
) -> int:
    """Return the number of candidates whose distances from A and from B are both less than the distance A B.

    Writes the rows of these stars to `near`, and their coordinates in the frame of A and B to `place`.
    """
    star_a = vectors.row(xyz, a)
    star_b = vectors.row(xyz, b)
    length = vectors.chord(star_a, star_b)
    count = 0
    for c in candidates:
        star_c = vectors.row(xyz, c)
        farther = max(vectors.chord(star_a, star_c), vectors.chord(star_b, star_c))
        if farther < length and c != b:
            near[count] = c
            place[count] = in_frame(frame, star_c, length)
            count += 1
    return count


@jit
def in_frame(frame: Floats, star: vectors.Vector, length: float) -> tuple[float, float]:
    """A star's coordinates along B to A and across, in chords of A and B; `frame` is that of `vectors.pair_frame`."""
    return vectors.dot(frame[:, 2], star) / length, vectors.dot(frame[:, 1], star) / length


@jit
def arrange(code: NDArray, star: NDArray) -> None:
    """Bring a quad's code (4,) and its stars A, B, C, D (4,) into the module's order, in place."""
    # Exchange A and B: half a turn.
    if code[0] + code[2] < 0:
        code[:] = -code
        star[0], star[1] = star[1], star[0]
    # Exchange C and D.
    if code[0] > code[2]:
        code[0], code[2] = code[2], code[0]
        code[1], code[3] = code[3], code[1]
        star[2], star[3] = star[3], star[2]


@jit
def code_cell(value: float, axis: int) -> int:
    """The cell of a code's coordinate along its axis."""
    bound = ACROSS if axis % 2 else ALONG
    return cell_of((value + bound) * (SIDE / (2 * bound)), SIDE - 1)


@jit
def _grid_cells(code: NDArray) -> Ints:
    """(Q,) number of the cell of each code (Q, 4) in the grid of SIDE^4 cells."""
    cell = np.zeros(len(code), np.int64)
    for n in range(len(code)):
        for axis in range(4):
            cell[n] = cell[n] * SIDE + code_cell(code[n, axis], axis)
    return cell
