"""Planar and spherical triangles: a triangle of stars is known by its area and its polar moment.

Cole & Crassidis 2006 (J. Guidance 29, 64-71) and 2004 (AIAA 2004-5389), as told by Padro 2012, section 2.4.1, figs 14
and 15. Both numbers are the same in any frame. Three unit vectors have the sides a, b and c: chords of a planar
triangle, arcs of a spherical one.

    planar       A = sqrt(s (s - a) (s - b) (s - c)),  s = (a + b + c) / 2    J = A (a^2 + b^2 + c^2) / 36
    spherical    A = 2 arctan(v / (1 + cos a + cos b + cos c))                J = sum of theta^2 dA over small triangles

v is the triple product of the three vectors; this A equals L'Huilier's, 4 arctan sqrt(tan(s / 2) tan((s - a) / 2) ...).
theta is the arc from the center of the triangle to that of a small one. An error of a direction of standard deviation
sigma across each axis gives, to first order in the planar triangle's sides, with Q = a^2 + b^2 + c^2,

    sigma_A^2 = sigma^2 Q / 4        sigma_J^2 = sigma^2 Q (Q^2 + 144 A^2) / 5184

1. Take a triangle of observed stars, the brightest first (`search`).
2. Find the catalog triangles whose A and J differ by less than three standard deviations. A, J and the longest side
   L determine the planar triangle: Q = 36 J / A, Q / 3 <= L^2 <= (Q + sqrt(Q^2 - 48 A^2)) / 3, and the shortest side
   follows. So the pairs of these L and their neighbors are searched (`_catalog_triangles`), in place of the papers'
   list of all triangles by area.
3. A and J do not say which star is which: the sides do, and the handedness must agree (`_corners`).
4. Match the whole field at the triangle's attitude. The papers pivot to triangles with a common side until one
   candidate is left; this is the same test with all stars at once.
5. Accept the best match if it is significant, and no contradicting one is nearly as good, as on a lattice. Else take
   another triangle of observed stars.
"""

from functools import partial
from math import atan2, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.pair_index import PairIndex, neighbor_range, pair_range
from estimator.core.checks import Floats
from estimator.core.jit import inlined, jit
from estimator.core.types import StarMatch
from estimator.core.vectors import dot, norm
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES
from estimator.identification.direct_match import (
    DirectMatch,
    angle,
    match_field,
    no_match,
    smart_triangles,
    to_star_match,
    triple,
)
from estimator.identification.published.master_star import contradict
from estimator.identification.solver_options import Options

SPLIT = 4  # small triangles along each side of a spherical one
# Relative margin of Q and the sides in step 2: spherical triangles of equal A and J are planar ones of A and J that
# differ by less, if their sides are up to 0.6 rad.
CURVATURE = 0.005
MIN_SIDE_TOLERANCES = 6.0  # least side of a triangle, in tolerances


class TriangleOptions(NamedTuple):
    """Search parameters.

    Attributes
    ----------
    tolerance_rad, stretch
        Tolerance of a direction, three standard deviations, and relative tolerance of an angle (see `Options`)
    triangles, checks, base
        Limits of the effort (see `Options`)
    spherical
        Whether triangles are spherical
    """

    tolerance_rad: float
    stretch: float
    triangles: int
    checks: int
    base: int
    spherical: bool


def triangle(
    spherical: bool,
    vectors_cam: Floats,
    index: PairIndex,
    tolerance_rad: float,
    **options: Any,
) -> StarMatch | None:
    """Identify stars by triangles of equal area and polar moment (see the module's steps).

    Parameters
    ----------
    spherical
        Whether triangles are spherical
    vectors_cam
        (N, 3) observed unit vectors, brightest first
    index
        Catalog of the stars and pairs
    tolerance_rad
        Tolerance of a direction, three standard deviations
    options
        Keywords of `Options`; magnitudes are not used

    Returns
    -------
    StarMatch | None
        None if no match is significant, or if a contradicting match is nearly as good

    Raises
    ------
    ImageError
        Unless the tolerance is positive and the focal length known.
    """
    settings = Options(**options)
    name = "spherical_triangle" if spherical else "planar_triangle"
    settings.require_known_focal(name)
    settings.require_tolerance(name, tolerance_rad)
    count = len(vectors_cam)
    if count < MIN_MATCHES:
        return None
    parameters = TriangleOptions(
        tolerance_rad,
        settings.stretch,
        settings.max_triangles,
        settings.max_checks,
        min(settings.base_stars, count),
        spherical,
    )
    return to_star_match(search(np.ascontiguousarray(vectors_cam), index, parameters))


planar_triangle = partial(triangle, False)
spherical_triangle = partial(triangle, True)


@jit
def search(rays: Floats, index: PairIndex, options: TriangleOptions) -> DirectMatch:
    """The compiled search: steps 1 to 5; the empty match if none is accepted."""
    tried = np.zeros(2, np.int64)  # catalog triangles, angles compared
    # 1. Triangles in an order in which one false star costs little.
    for corners in smart_triangles(options.base)[: options.triangles]:
        if tried[1] >= options.checks:
            break
        match = _catalog_triangles(rays, index, corners, options, tried)
        if match.log10_chance <= ACCEPT_LOG10_CHANCE:
            return match
    return no_match()


@inlined
def _catalog_triangles(
    rays: Floats, index: PairIndex, corners: NDArray, options: TriangleOptions, tried: NDArray
) -> DirectMatch:
    """Steps 2 to 5 for one observed triangle."""
    corners = _corners(rays, corners)
    p, q, r = corners
    longest = angle(rays[p], rays[q])
    shortest = angle(rays[p], rays[r])
    best = no_match()
    if (
        shortest < MIN_SIDE_TOLERANCES * options.tolerance_rad
        or longest > index.max_angle_rad
    ):
        return best
    # 2. The gates of A and J, and the sides that they allow.
    planar_area, moment = planar_features(rays[p], rays[q], rays[r])
    area = planar_area
    square = 36 * moment / area
    gate_area = options.tolerance_rad * sqrt(square) / 2 + 2 * options.stretch * area
    gate_moment = options.tolerance_rad * sqrt(square * (square**2 + 144 * area**2)) / 72
    gate_moment += 4 * options.stretch * moment
    margin = gate_area / area + gate_moment / moment + CURVATURE * options.spherical
    greatest = square + sqrt(max(square**2 - 48 * area**2, 0.0) + 2 * margin * square**2)
    begin, end = pair_range(
        index,
        (1 - margin) * sqrt(square / 3),
        min((1 + margin) * sqrt(greatest / 3), index.max_angle_rad),
    )
    handedness = triple(rays[p], rays[q], rays[r])
    if options.spherical:
        area = spherical_area(rays[p], rays[q], rays[r])
        moment = spherical_moment(rays[p], rays[q], rays[r])
    rival = 0.0
    for n in range(begin, end):
        if tried[1] >= options.checks:
            break
        low, high = _shortest_side(index.angle_rad[n], planar_area, square, margin)
        if low > high:
            continue
        for flip in range(2):
            a = index.pair[n, flip]
            b = index.pair[n, 1 - flip]
            first, last = neighbor_range(index, a, low, high)
            tried[1] += 1 + last - first
            for c in index.neighbor[first:last]:
                u = index.vectors[a]
                v = index.vectors[b]
                w = index.vectors[c]
                # 3. The handedness; the sides are those of the pair and of the neighbor.
                if handedness * triple(u, v, w) <= 0:
                    continue
                if not _agrees(
                    u, v, w, area, moment, gate_area, gate_moment, options.spherical
                ):
                    continue
                # 4. The direct match.
                tried[0] += 1
                match = match_field(
                    rays,
                    index,
                    corners,
                    np.array([a, b, c]),
                    options.tolerance_rad,
                    options.stretch,
                    tried[0],
                )
                if len(match.observed) and contradict(best, match):
                    rival = min(rival, max(best.log10_chance, match.log10_chance))
                if match.log10_chance < best.log10_chance:
                    best = match
    # 5. A repetitive pattern has another match as good: the best must be 1e5 times less likely by chance.
    return best if rival > best.log10_chance - ACCEPT_LOG10_CHANCE else no_match()


@inlined
def _corners(rays: Floats, corners: NDArray) -> NDArray:
    """The corners in the order: that of the longest and the shortest side, the longest's other one, the third."""
    ordered = corners.copy()
    # The longest side has the first two corners.
    if angle(rays[ordered[0]], rays[ordered[2]]) > angle(rays[ordered[0]], rays[ordered[1]]):
        ordered[1], ordered[2] = ordered[2], ordered[1]
    if angle(rays[ordered[1]], rays[ordered[2]]) > angle(rays[ordered[0]], rays[ordered[1]]):
        ordered[0], ordered[2] = ordered[2], ordered[0]
    # The shortest has the first and the third.
    if angle(rays[ordered[1]], rays[ordered[2]]) < angle(rays[ordered[0]], rays[ordered[2]]):
        ordered[0], ordered[1] = ordered[1], ordered[0]
    return ordered


@inlined
def _shortest_side(
    longest: float, area: float, square: float, margin: float
) -> tuple[float, float]:
    """Interval of the shortest side of triangles of the area A, Q and the longest side L.

    The third corner has the height h = 2 A / L and the foot x beside the middle of L: from b^2 + c^2 = Q - L^2 follow
    x^2 = Q / 2 - 3 L^2 / 4 - h^2 and c^2 = (L / 2 - x)^2 + h^2. The interval is empty if no x^2 within the margin is
    positive.
    """
    height = 2 * area / longest
    foot2 = square / 2 - 0.75 * longest**2 - height**2
    spread = 2 * margin * square
    if foot2 < -spread:
        return 1.0, 0.0
    nearest = max(longest / 2 - sqrt(foot2 + spread), 0.0)
    farthest = longest / 2 - sqrt(max(foot2 - spread, 0.0))
    low = (1 - margin) * sqrt(nearest**2 + height**2)
    return low, (1 + margin) * sqrt(farthest**2 + height**2)


@jit
def _agrees(
    u: Floats,
    v: Floats,
    w: Floats,
    area: float,
    moment: float,
    gate_area: float,
    gate_moment: float,
    spherical: bool,
) -> bool:
    """Whether area and polar moment of a triangle are within the gates."""
    if not spherical:
        found = planar_features(u, v, w)
        return abs(found[0] - area) <= gate_area and abs(found[1] - moment) <= gate_moment
    if abs(spherical_area(u, v, w) - area) > gate_area:
        return False
    return abs(spherical_moment(u, v, w) - moment) <= gate_moment


@jit
def planar_features(u: Floats, v: Floats, w: Floats) -> tuple[float, float]:
    """Area and polar moment of the planar triangle of three unit vectors, with Heron's area from squared sides."""
    a2 = 2 - 2 * dot(v, w)
    b2 = 2 - 2 * dot(u, w)
    c2 = 2 - 2 * dot(u, v)
    area = sqrt(max(4 * a2 * b2 - (a2 + b2 - c2) ** 2, 0.0)) / 4
    return area, area * (a2 + b2 + c2) / 36


@jit
def spherical_area(u: Floats, v: Floats, w: Floats) -> float:
    """Area (the excess) of a spherical triangle, sr."""
    cosines = dot(u, v) + dot(u, w) + dot(v, w)
    return 2 * atan2(abs(triple(u, v, w)), 1 + cosines)


@jit
def spherical_moment(u: Floats, v: Floats, w: Floats) -> float:
    """Polar moment of a spherical triangle about its center, sr rad^2: the sum of theta^2 dA over SPLIT^2 triangles.

    The small triangles' own planar moments are added (Steiner), so that few of them are enough.
    """
    center = _unit(u + v + w)
    total = 0.0
    for i in range(SPLIT):
        for j in range(SPLIT - i):
            # The triangle of corner (i, j), and the one between it and the next row.
            for upper in range(2 if i + j < SPLIT - 1 else 1):
                x = _node(u, v, w, i + 1, j)
                y = _node(u, v, w, i, j + 1)
                z = _node(u, v, w, i + upper, j + upper)
                middle = _unit(x + y + z)
                own = planar_features(x, y, z)[1]
                total += angle(center, middle) ** 2 * spherical_area(x, y, z) + own
    return total


@jit
def _node(u: Floats, v: Floats, w: Floats, i: int, j: int) -> Floats:
    """The direction i steps of SPLIT from u to v and j steps to w."""
    node = u + (v - u) * (i / SPLIT) + (w - u) * (j / SPLIT)
    return _unit(node)


@jit
def _unit(u: Floats) -> Floats:
    """The unit vector along u."""
    return u / norm(u)
