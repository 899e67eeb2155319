"""Index of star quads by a code that does not depend on the scale: for a camera whose focal length is uncertain.

A quad is four stars. A and B are the two farthest apart; m is the bisector of their directions, n the normal A x B and
w the third axis, which points from B to A. The code of the quad is the place of C and D on these axes, in units of the
chord L between A and B (after Lang et al. 2010, Astron. J. 139, 1782, who use the circle over A and B):

    (C.w / L, C.n / L, D.w / L, D.n / L)

A wrong focal length multiplies all small angles by the same factor, and leaves the code unchanged. The same four stars
must always have the same code (`arrange`): A and B are exchanged if the sum of the first and the third number would be
negative, and C is the one with the smaller first number.

1. Choose stars that are bright for their surroundings, PER_CIRCLE in a circle as high as the field, so that the
   brightest detections of a frame are among them everywhere in the sky (`_locally_bright`).
2. List the chosen neighbors of each chosen star (`_neighbors`).
3. Form all quads of neighbors, and their codes (`_quads`).
4. Sort them into the cells of a grid of four dimensions (`_grid_cells`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import SkyIndex, cell_of, counting_sort
from estimator.core import vectors
from estimator.core.checks import Floats
from estimator.core.jit import jit

PER_CIRCLE = 10  # stars of quads in a circle as high as the field
# Greatest and least distance of A and B, in units of the field's height.
LONGEST = 0.75
SHORTEST = 0.15
NEIGHBORS = 60  # greatest number of stars near one star that are combined with it
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

    star: NDArray[np.int32]
    code: Floats
    first: NDArray[np.int32]


def build(sky: SkyIndex, height_rad: float) -> QuadIndex:
    """Build the index of the stars and pairs of `sky` for fields of the given height: the module's steps."""
    # 1. and 2. Chosen stars and their neighbors.
    chosen = _locally_bright(
        sky.pair, sky.first, sky.bin_rad, height_rad / 2, len(sky.vectors)
    )
    neighbor, first = _neighbors(
        sky.pair, sky.first, sky.bin_rad, LONGEST * height_rad, chosen
    )
    total = 1
    found = np.empty((0, 4), np.int32)
    code = np.empty((0, 4))
    # 3. Quads: the first pass only counts them.
    while total > len(found):
        found = np.empty((total, 4), np.int32)
        code = np.empty((total, 4))
        total = _quads(sky.vectors, neighbor, first, SHORTEST * height_rad, found, code)
    # 4. Cells.
    cells, order = counting_sort(_grid_cells(code[:total]), SIDE**4)
    return QuadIndex(found[order], code[order], cells)


@jit
def _locally_bright(
    pair: NDArray, first: NDArray, bin_rad: float, radius_rad: float, count: int
) -> NDArray[np.bool_]:
    """Step 1: (count,) whether each star, sorted by brightness, has fewer than PER_CIRCLE brighter ones around it."""
    brighter = np.zeros(count, np.int64)
    for p in range(first[cell_of(radius_rad / bin_rad, len(first) - 1)]):
        # The greater row is the fainter star.
        brighter[max(pair[p, 0], pair[p, 1])] += 1
    return brighter < PER_CIRCLE


@jit
def _neighbors(
    pair: NDArray, first: NDArray, bin_rad: float, reach_rad: float, chosen: NDArray
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Step 2: the chosen stars within reach of each chosen star.

    Returns
    -------
    neighbor, start
        The neighbors of star s are neighbor[start[s] : start[s + 1]], by increasing angle up to the width of a bin
    """
    end = first[cell_of(reach_rad / bin_rad, len(first) - 1)]
    start = np.zeros(len(chosen) + 1, np.int64)
    # Count the neighbors of each star, add the counts up, and fill the lists.
    for p in range(end):
        if chosen[pair[p, 0]] and chosen[pair[p, 1]]:
            start[pair[p, 0] + 1] += 1
            start[pair[p, 1] + 1] += 1
    for s in range(len(chosen)):
        start[s + 1] += start[s]
    neighbor = np.empty(start[-1], np.int32)
    free = start.copy()
    for p in range(end):
        i = pair[p, 0]
        j = pair[p, 1]
        if chosen[i] and chosen[j]:
            neighbor[free[i]] = j
            neighbor[free[j]] = i
            free[i] += 1
            free[j] += 1
    return neighbor, start


@jit
def _quads(
    xyz: Floats,
    neighbor: NDArray,
    start: NDArray,
    shortest_rad: float,
    found: NDArray,
    code: Floats,
) -> int:
    """Step 3: find all quads of neighbors, and their codes.

    Parameters
    ----------
    xyz
        (N, 3) unit vectors of the stars
    shortest_rad
        Least distance of A and B
    found, code
        (Q, 4) rows and codes of the quads, written in place; no more than the arrays hold

    Returns
    -------
    int
        Number of quads
    """
    total = 0
    frame = np.empty((3, 3))
    near = np.empty(NEIGHBORS, np.int64)
    place = np.empty((NEIGHBORS, 2))
    for a in range(len(start) - 1):
        # A and B.
        for entry in range(start[a], start[a + 1]):
            b = neighbor[entry]
            star_a = vectors.row(xyz, a)
            star_b = vectors.row(xyz, b)
            length = vectors.chord(star_a, star_b)
            if b < a or length < shortest_rad:
                continue
            vectors.pair_frame(star_a, star_b, frame)
            candidates = neighbor[start[a] : min(start[a + 1], start[a] + NEIGHBORS)]
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
                        found[total, 0] = a
                        found[total, 1] = b
                        found[total, 2] = near[k]
                        found[total, 3] = near[m]
                        code[total, 0] = place[k, 0]
                        code[total, 1] = place[k, 1]
                        code[total, 2] = place[m, 0]
                        code[total, 3] = place[m, 1]
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
            place[count, 0], place[count, 1] = in_frame(frame, star_c, length)
            count += 1
    return count


@jit
def in_frame(frame: Floats, star: vectors.Vector, length: float) -> tuple[float, float]:
    """A star's coordinates along B to A and across, in chords of A and B; `frame` is that of `vectors.pair_frame`."""
    along = frame[0, 2] * star[0] + frame[1, 2] * star[1] + frame[2, 2] * star[2]
    across = frame[0, 1] * star[0] + frame[1, 1] * star[1] + frame[2, 1] * star[2]
    return along / length, across / length


@jit
def arrange(code: Floats, star: NDArray) -> None:
    """Bring a quad's code (4,) and its stars A, B, C, D (4,) into the module's order, in place."""
    # Exchange A and B: half a turn.
    if code[0] + code[2] < 0:
        for k in range(4):
            code[k] = -code[k]
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
def _grid_cells(code: Floats) -> NDArray[np.int64]:
    """(Q,) number of the cell of each code (Q, 4) in the grid of SIDE^4 cells."""
    cell = np.zeros(len(code), np.int64)
    for n in range(len(code)):
        for axis in range(4):
            cell[n] = cell[n] * SIDE + code_cell(code[n, axis], axis)
    return cell
