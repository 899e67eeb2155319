"""Pyramid star identification (Mortari, Samaan & Junkins 2001), verified by the direct match of the whole field.

A triangle of observed stars is compared with catalog triangles through the k-vector index. A fourth star whose angles
to all three corners fit makes a pyramid; the direct match then tests its attitude on all stars. With an uncertain
focal length each triangle also estimates it, from the ratio of the catalog's to the observed perimeter.
"""

from __future__ import annotations

from math import sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.pair_index import PairIndex, around, between
from estimator.core.arrays import Floats
from estimator.core.jit import jit
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES
from estimator.identification.direct_match import Found, angle, answer, nothing, settled, triple
from estimator.identification.options import Options


class Rules(NamedTuple):
    """Search parameters. A named tuple, because numba can compile functions that take one.

    tolerance, stretch, zooms, triangles, checks, base, missed_dex : as in `Options`
    left, right, top, bottom : tangents of the sensor's edges from the boresight
    """

    tolerance: float
    stretch: float
    zooms: bool
    triangles: int
    checks: int
    base: int
    missed_dex: float
    left: float
    right: float
    top: float
    bottom: float


def pyramid(vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any) -> StarMatch | None:
    """Pyramid (Mortari, Samaan & Junkins 2001): a triangle, a fourth star, then the whole field.

    vectors_cam   : (N, 3) observed unit vectors, brightest first
    tolerance_rad : of a direction; that of an angle is sqrt(2) times it, plus `stretch` times the angle
    options       : those of `Options`; magnitudes are not used
    The three catalog stars are from different groups of the index (patch boards). Observed triangles are tried in the
    paper's `smart` order, which changes all three stars soon, so that one false star costs little. A pyramid is only a
    hypothesis: its attitude must match so many observed stars that, over all hypotheses tried, less than 1e-5 matches
    this good are expected by chance. Otherwise returns None.
    """
    asked = Options(**options)
    if len(vectors_cam) < MIN_MATCHES:
        return None
    rules = Rules(
        tolerance_rad,
        asked.stretch,
        asked.zooms,
        asked.max_triangles,
        asked.max_checks,
        min(asked.base_stars, len(vectors_cam)),
        asked.missed_dex,
        *asked.field_tan,
    )
    return answer(_search(np.ascontiguousarray(vectors_cam), index, rules))


@jit
def _search(seen: Floats, index: PairIndex, rules: Rules) -> Found:
    """Try the triangles (i, i + dj, i + dj + dk) in the smart order; return the first significant match."""
    tried = np.zeros(3, np.int64)  # observed triangles, hypotheses, checks
    for dj in range(1, rules.base - 1):
        for dk in range(1, rules.base - dj):
            for i in range(rules.base - dj - dk):
                corners = np.array([i, i + dj, i + dj + dk])
                found = _triangle(seen, index, corners, rules, tried)
                if found[3] < ACCEPT_LOG10_CHANCE:
                    return found
                tried[0] += 1
                if tried[0] >= rules.triangles or tried[2] >= rules.checks:
                    return nothing()
    return nothing()


@jit
def _triangle(seen: Floats, index: PairIndex, corners: NDArray, rules: Rules, tried: NDArray) -> Found:
    """Test every catalog triangle that fits an observed one in its sides and its handedness; needs a fourth star."""
    i, j, k = corners
    ij, ik, jk = angle(seen[i], seen[j]), angle(seen[i], seen[k]), angle(seen[j], seen[k])
    t_ij, t_ik, t_jk = sqrt(2.0) * rules.tolerance + rules.stretch * np.array([ij, ik, jk])
    if min(ij, ik, jk) < 4 * t_ij or max(ij, ik, jk) > index.max_angle_rad:
        return nothing()
    # If the three sides agree on one focal length, only the lens distortion remains of the stretch.
    tight = rules.stretch / 3 if rules.zooms else rules.stretch
    handed = triple(seen[i], seen[j], seen[k])
    # Catalog pairs (a, b) for side ij, in both orders; then neighbors c of a for side ik; then side jk is tested.
    begin, end = between(index, ij - t_ij, ij + t_ij)
    for p in range(begin, end):
        if tried[2] >= rules.checks:
            break
        side = index.angle_rad[p]
        if abs(side - ij) > t_ij:
            continue
        for flip in range(2):
            a, b = index.pair[p, flip], index.pair[p, 1 - flip]
            place = around(index, a, ik - t_ik)
            while place < index.first[a + 1] and index.separation_rad[place] <= ik + t_ik:
                c, near = index.neighbour[place], index.separation_rad[place]
                place += 1
                tried[2] += 1
                if index.group[c] == index.group[a] or index.group[c] == index.group[b]:
                    continue
                far = angle(index.vectors[b], index.vectors[c])
                if abs(far - jk) > t_jk:
                    continue
                if handed * triple(index.vectors[a], index.vectors[b], index.vectors[c]) <= 0:
                    continue
                # One zoom for all three sides: here the assumed over the true focal length.
                zoom = (side + near + far) / (ij + ik + jk) if rules.zooms else 1.0
                slip = max(
                    abs(side - zoom * ij) - tight * ij,
                    abs(near - zoom * ik) - tight * ik,
                    abs(far - zoom * jk) - tight * jk,
                )
                if slip > sqrt(2.0) * rules.tolerance:
                    continue
                tried[1] += 1
                zoomed = _zoomed(seen, zoom) if rules.zooms else seen
                found = _pyramid(zoomed, index, corners, np.array([a, b, c]), rules, tight, tried)
                if found[3] < ACCEPT_LOG10_CHANCE:
                    return found
    return nothing()


@jit
def _pyramid(
    seen: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    rules: Rules,
    stretch: float,
    tried: NDArray,
) -> Found:
    """Find a fourth star that fits a triangle; if there is one, return the direct match."""
    for r in range(rules.base):
        tried[2] += 1
        if r == corners[0] or r == corners[1] or r == corners[2]:
            continue
        reach = angle(seen[corners[0]], seen[r])
        slack = sqrt(2.0) * rules.tolerance + stretch * reach
        place = around(index, stars[0], reach - slack)
        while place < index.first[stars[0] + 1] and index.separation_rad[place] <= reach + slack:
            d = index.neighbour[place]
            place += 1
            fits = True
            for corner in range(1, 3):
                side = angle(seen[corners[corner]], seen[r])
                slip = abs(angle(index.vectors[stars[corner]], index.vectors[d]) - side)
                fits = fits and slip <= sqrt(2.0) * rules.tolerance + stretch * side
            if fits:
                tried[2] += len(seen) * (index.first[stars[0] + 1] - index.first[stars[0]])
                return _prove(seen, index, corners, stars, rules, stretch, tried[1])
    return nothing()


@jit
def _zoomed(seen: Floats, zoom: float) -> Floats:
    """The directions with their tangents multiplied by zoom: those for a focal length shorter by that factor."""
    out = np.empty_like(seen)
    for n in range(len(seen)):
        x, y = seen[n, 0] / seen[n, 2] * zoom, seen[n, 1] / seen[n, 2] * zoom
        length = sqrt(x * x + y * y + 1)
        out[n, 0], out[n, 1], out[n, 2] = x / length, y / length, 1 / length
    return out


@jit
def _prove(
    seen: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    rules: Rules,
    stretch: float,
    hypotheses: int,
) -> Found:
    """The direct match of the whole field, with a penalty of missed_dex for each catalog star that is missing."""
    observed, star, matrix, chance = settled(
        seen, index, corners, stars, rules.tolerance, stretch, hypotheses
    )
    if len(observed) and rules.missed_dex > 0:
        missed = max(_expected(index, stars[0], matrix, rules) - len(observed), 0)
        chance += rules.missed_dex * missed
    return observed, star, matrix, chance


@jit
def _expected(index: PairIndex, centre: int, matrix: Floats, rules: Rules) -> int:
    """Number of catalog stars in the field at an attitude; `centre` is a star whose neighbors are tested."""
    count = 0
    begin, end = index.first[centre], index.first[centre + 1]
    for place in range(begin - 1, end):
        s = centre if place < begin else index.neighbour[place]
        x, y, z = matrix @ index.vectors[s]
        inside = z > 0 and rules.left * z < x < rules.right * z and rules.top * z < y < rules.bottom * z
        count += inside
    return count
