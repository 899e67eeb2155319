"""Fialho's triangle method, PTASE's identifier in its four versions: candidate lists, a triplet, the direct match.

Fialho & Saotome 2005, section 3.5: "In the first step it tries to match a triangle of observed stars (the three
brightest stars above a minimum magnitude and with a minimum angular distance) with a triangle of catalogued stars"
from a list of candidates for each; then the rest are matched at the attitude that the triplet gives, and it counts if
"greater than a minimum threshold (e.g, half the number of observed stars)"; else the search goes on. The paper names
four improvements since alg_ide_mf1_1 of 2003 and says what mf1_2 has; mf1_3 is inferred to lie between 2 and 4:

    mf1_1  the basic algorithm: every list from the whole catalog
    mf1_2  lists "assembled in an optimized way", and a prior direction of the optical axis
    mf1_3  another triangle of observed stars if the first fails: false stars are tolerated
    mf1_4  also returns mean and variance of the identified stars' magnitude errors

The paper does not say what "optimized" means. Here the first list is a range of the catalog, which is sorted by
magnitude, and the other lists are the neighbors of its stars at the observed angles. Two tests are added in all
versions: the match must be significant against chance, and the triangles must have the same handedness. As in the
paper, the first triplet that passes is the solution; for a repetitive catalog, such as a lattice of LEDs, use `saa`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.pair_index import PairIndex, alike, around
from estimator.core.arrays import Floats
from estimator.core.errors import ImageError
from estimator.core.jit import jit
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES
from estimator.identification.direct_match import Found, angle, answer, nothing, settled, triple
from estimator.identification.options import Options

GATE_SIGMAS = 3.0  # of a magnitude: three stars pass with 0.9973^3 = 99.2 %, the paper's 99.12 +- 0.25 %
LEAST_ANGLE = 0.1  # of the field's diagonal, between the stars of a triangle; the paper gives no value
SHARE_BASIC, SHARE_FALSE_STARS = 0.5, 0.3  # fraction of stars that must match: basic, with false stars


@dataclass(frozen=True, slots=True)
class MagnitudeMatch(StarMatch):
    """A match with the mean and the variance of observed minus catalog magnitude; NaN if magnitudes are unknown.

    Fialho, Lopes & Saotome 2005 use these to calibrate a sensor's magnitude offset.
    """

    offset_mag: float = float("nan")
    variance_mag2: float = float("nan")


class Rules(NamedTuple):
    """Search parameters. A named tuple, because numba can compile functions that take one.

    tolerance_rad, stretch : tolerance of a direction; that of an angle is sqrt(2) times it plus stretch times the angle
    gate_mag     : tolerance of a magnitude
    triangles, checks, base : as in `Options`: limits of observed triangles and of angles compared, number of stars
    share        : fraction of the observed stars that must match
    optimised    : assemble the lists from neighbors
    x, y, z, chord : prior boresight, and the greatest squared chord of a candidate from it
    """

    tolerance_rad: float
    stretch: float
    gate_mag: float
    triangles: int
    checks: int
    base: int
    share: float
    optimised: bool
    x: float
    y: float
    z: float
    chord: float


def rules(tolerance_rad: float, asked: Options, share: float, optimised: bool, falls_back: bool) -> Rules:
    """Search parameters from options. Raises ImageError unless the tolerance and the magnitude error are positive."""
    if not min(tolerance_rad, asked.epsilon_mag) > 0:
        raise ImageError(
            f"fialho: tolerance {tolerance_rad} rad, magnitude error {asked.epsilon_mag}; allowed: more than 0"
        )
    hinted = asked.boresight_ref is not None
    x, y, z = asked.boresight_ref if asked.boresight_ref is not None else (0.0, 0.0, 1.0)
    chord = 4 * np.sin(min(asked.within_rad, np.pi) / 2) ** 2 if hinted else 5.0
    return Rules(
        tolerance_rad,
        asked.stretch,
        GATE_SIGMAS * asked.epsilon_mag,
        asked.max_triangles if falls_back else 1,
        asked.max_checks,
        asked.base_stars,
        share,
        optimised,
        float(x),
        float(y),
        float(z),
        float(chord),
    )


def fialho_1(vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any) -> StarMatch | None:
    """The basic algorithm: one triangle, each list from the whole catalog, no boresight prior. See `fialho_4`."""
    asked = Options(**options)
    bare = rules(tolerance_rad, asked, SHARE_BASIC, False, False)
    return answer(_found(vectors_cam, index, asked, bare._replace(chord=5.0)))


def fialho_2(vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any) -> StarMatch | None:
    """One triangle with optimized lists, near the prior boresight if there is one. See `fialho_4`."""
    asked = Options(**options)
    return answer(
        _found(
            vectors_cam,
            index,
            asked,
            rules(tolerance_rad, asked, SHARE_BASIC, True, False),
        )
    )


def fialho_3(vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any) -> StarMatch | None:
    """Several triangles with optimized lists, near the prior boresight if there is one. See `fialho_4`."""
    asked = Options(**options)
    return answer(
        _found(
            vectors_cam,
            index,
            asked,
            rules(tolerance_rad, asked, SHARE_FALSE_STARS, True, True),
        )
    )


def fialho_4(
    vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any
) -> MagnitudeMatch | None:
    """Fialho's triangle method, latest version: as the third, and returns the errors of the magnitudes.

    vectors_cam   : (N, 3) observed unit vectors, brightest first
    tolerance_rad : of a direction; that of an angle is sqrt(2) times it, plus `stretch` times the angle
    options       : those of `Options`: `magnitude`, if the index has magnitudes too, shortens the lists;
        `boresight_ref` and `within_rad` are the prior boresight: candidates are within that angle of it, which must
        therefore include half the field's diagonal beside the error of the prior
    Returns None if too few stars match, or if the match is not significant (1e-5 expected by chance).
    """
    asked = Options(**options)
    found = _found(
        vectors_cam,
        index,
        asked,
        rules(tolerance_rad, asked, SHARE_FALSE_STARS, True, True),
    )
    match = answer(found)
    if match is None:
        return None
    off = asked.light(len(vectors_cam))[match.observed] - index.magnitude[match.star]
    variance = float(np.var(off, ddof=1))
    return MagnitudeMatch(
        match.observed, match.star, match.cam_from_ref, match.log10_chance, float(off.mean()), variance
    )


Fialho = Callable[..., StarMatch | None]
VERSIONS: dict[str, Fialho] = {
    "fialho_1": fialho_1,
    "fialho_2": fialho_2,
    "fialho_3": fialho_3,
    "fialho_4": fialho_4,
}


def _found(vectors_cam: Floats, index: PairIndex, asked: Options, by: Rules) -> Found:
    asked.fixed_focal("fialho")
    if len(vectors_cam) < MIN_MATCHES:
        return nothing()
    return search(np.ascontiguousarray(vectors_cam), asked.light(len(vectors_cam)), index, by)


@jit
def search(seen: Floats, light: Floats, index: PairIndex, by: Rules) -> Found:
    """Compiled search over observed triangles: the brightest first, then others, with all stars changing soon.

    seen, light : (N, 3) unit vectors, brightest first, and their (N,) magnitudes, NaN if unknown
    Returns the rows of the observed stars and of the catalog, R_cam_from_ref, and log10 of the expected number of
    chance matches; it is a solution only if that is at most ACCEPT_LOG10_CHANCE.
    """
    tried = np.zeros(2, np.int64)  # triplets, angles compared
    least, base = LEAST_ANGLE * index.max_angle_rad, min(by.base, len(seen))
    corners = _brightest(seen, base, least)
    if corners[0] < 0:
        return nothing()
    found = triplets(seen, light, index, corners, by, tried)
    if found[3] <= ACCEPT_LOG10_CHANCE:
        return found
    count = 1
    for dj in range(1, base - 1):
        for dk in range(1, base - dj):
            for i in range(base - dj - dk):
                if count >= by.triangles or tried[1] >= by.checks:
                    return nothing()
                another = np.array([i, i + dj, i + dj + dk])
                if (another == corners).all() or _closest(seen, another) < least:
                    continue
                found = triplets(seen, light, index, another, by, tried)
                if found[3] <= ACCEPT_LOG10_CHANCE:
                    return found
                count += 1
    return nothing()


@jit
def _closest(seen: Floats, corners: NDArray) -> float:
    """The least angle between any two of three stars."""
    i, j, k = corners
    return min(angle(seen[i], seen[j]), angle(seen[i], seen[k]), angle(seen[j], seen[k]))


@jit
def _brightest(seen: Floats, base: int, least_rad: float) -> NDArray:
    """Rows of the three brightest stars that are at least least_rad apart; -1 if there are none."""
    for i in range(base):
        for j in range(i + 1, base):
            if angle(seen[i], seen[j]) < least_rad:
                continue
            for k in range(j + 1, base):
                corners = np.array([i, j, k])
                if _closest(seen, corners) >= least_rad:
                    return corners
    return np.full(3, -1)


@jit
def triplets(
    seen: Floats, light: Floats, index: PairIndex, corners: NDArray, by: Rules, tried: NDArray
) -> Found:
    """Test every triplet of candidates that fits an observed triangle by direct match, until one is accepted."""
    sides = np.array(
        [
            angle(seen[corners[0]], seen[corners[1]]),
            angle(seen[corners[0]], seen[corners[2]]),
            angle(seen[corners[1]], seen[corners[2]]),
        ]
    )
    if sides.max() > index.max_angle_rad:
        return nothing()
    slack = sqrt(2.0) * by.tolerance_rad + by.stretch * sides
    if by.optimised:
        return _by_neighbours(seen, light, index, corners, sides, slack, by, tried)
    return _by_lists(seen, light, index, corners, sides, slack, by, tried)


@jit
def _accepted(
    seen: Floats, index: PairIndex, corners: NDArray, stars: NDArray, by: Rules, tried: int
) -> Found:
    """The second step: the direct match of one triplet; empty if too few stars match or it is not significant."""
    found = settled(seen, index, corners, stars, by.tolerance_rad, by.stretch, tried)
    if len(found[0]) <= by.share * len(seen) or found[3] > ACCEPT_LOG10_CHANCE:
        return nothing()
    return found


@jit
def _candidate(index: PairIndex, star: int, magnitude: float, by: Rules) -> bool:
    """Whether a star is within the magnitude gate and near enough to the prior boresight."""
    if abs(index.magnitude[star] - magnitude) > by.gate_mag:  # False for NaN: an unknown magnitude passes
        return False
    x, y, z = index.vectors[star]
    return (x - by.x) ** 2 + (y - by.y) ** 2 + (z - by.z) ** 2 <= by.chord


@jit
def _by_neighbours(
    seen: Floats,
    light: Floats,
    index: PairIndex,
    corners: NDArray,
    sides: Floats,
    slack: Floats,
    by: Rules,
    tried: NDArray,
) -> Found:
    """The optimized assembly: the first list is a range of the sorted catalog, the others its stars' neighbors."""
    # For each candidate a of the first star: collect candidates b of the second at the angle of side 0, then test each
    # candidate c of the third at the angle of side 1 against all of them.
    handed = triple(seen[corners[0]], seen[corners[1]], seen[corners[2]])
    second = np.empty(len(index.vectors), np.int64)
    begin, end = alike(index, light[corners[0]], by.gate_mag)
    for a in range(begin, end):
        if tried[1] >= by.checks:
            break
        tried[1] += 1
        if not _candidate(index, a, light[corners[0]], by):
            continue
        count = 0
        place = around(index, a, sides[0] - slack[0])
        while place < index.first[a + 1] and index.separation_rad[place] <= sides[0] + slack[0]:
            if _candidate(index, index.neighbour[place], light[corners[1]], by):
                second[count] = index.neighbour[place]
                count += 1
            place += 1
            tried[1] += 1
        if count == 0:
            continue
        place = around(index, a, sides[1] - slack[1])
        while place < index.first[a + 1] and index.separation_rad[place] <= sides[1] + slack[1]:
            c = index.neighbour[place]
            place += 1
            tried[1] += count
            if not _candidate(index, c, light[corners[2]], by):
                continue
            for b in second[:count]:
                if abs(angle(index.vectors[b], index.vectors[c]) - sides[2]) > slack[2]:
                    continue
                if handed * triple(index.vectors[a], index.vectors[b], index.vectors[c]) <= 0:
                    continue
                tried[0] += 1
                found = _accepted(seen, index, corners, np.array([a, b, c]), by, tried[0])
                if found[3] <= ACCEPT_LOG10_CHANCE:
                    return found
    return nothing()


@jit
def _list(index: PairIndex, magnitude: float, by: Rules) -> NDArray:
    """Candidates for one star, from the whole catalog."""
    out, count = np.empty(len(index.vectors), np.int64), 0
    for star in range(len(index.vectors)):
        if _candidate(index, star, magnitude, by):
            out[count] = star
            count += 1
    return out[:count]


@jit
def _by_lists(
    seen: Floats,
    light: Floats,
    index: PairIndex,
    corners: NDArray,
    sides: Floats,
    slack: Floats,
    by: Rules,
    tried: NDArray,
) -> Found:
    """The basic assembly: three lists, each from the whole catalog, and every triplet of them."""
    first, second, third = (
        _list(index, light[corners[0]], by),
        _list(index, light[corners[1]], by),
        _list(index, light[corners[2]], by),
    )
    handed = triple(seen[corners[0]], seen[corners[1]], seen[corners[2]])
    vectors = index.vectors
    for a in first:
        if tried[1] >= by.checks:
            break
        for b in second:
            tried[1] += 1
            if abs(angle(vectors[a], vectors[b]) - sides[0]) > slack[0]:
                continue
            for c in third:
                tried[1] += 1
                if abs(angle(vectors[a], vectors[c]) - sides[1]) > slack[1]:
                    continue
                if abs(angle(vectors[b], vectors[c]) - sides[2]) > slack[2]:
                    continue
                if handed * triple(vectors[a], vectors[b], vectors[c]) <= 0:
                    continue
                tried[0] += 1
                found = _accepted(seen, index, corners, np.array([a, b, c]), by, tried[0])
                if found[3] <= ACCEPT_LOG10_CHANCE:
                    return found
    return nothing()
