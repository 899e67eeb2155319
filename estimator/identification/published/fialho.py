"""Fialho's triangle, PTASE's identifier in its four versions: lists of candidates, a triplet, the direct match.

Fialho & Saotome 2005, section 3.5: "In the first step it tries to match a triangle of observed stars (the three
brightest stars above a minimum magnitude and with a minimum angular distance) with a triangle of catalogued stars"
from a list of candidates for each; then the rest are matched at the attitude that the triplet gives, and it counts if
"greater than a minimum threshold (e.g, half the number of observed stars)"; else the search goes on. The paper names
four improvements since alg_ide_mf1_1 of 2003 and says what mf1_2 has; mf1_3 is inferred to lie between 2 and 4:

    mf1_1  the basic algorithm: every list from the whole catalogue
    mf1_2  lists "assembled in an optimized way", and a hint of where the optical axis points
    mf1_3  another triangle of observed stars where the first fails: false stars are withstood
    mf1_4  also returns mean and variance of the identified stars' magnitude errors

What "optimized" is goes unpublished. Here the first list is a range of the catalogue, which is sorted by magnitude,
and the others are those of its neighbours that stand at the observed angle. Ours, and in all versions: the attitude
must be beyond chance, and triangles must have the same handedness, which no attitude could mend. As in the paper the
first triplet that passes is the answer: a catalogue that repeats itself, as a lattice of LEDs does, is for `saa`.
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
LEAST_ANGLE = 0.1  # of the field's diagonal, between the stars of a triangle; the paper's is unpublished
SHARE_BASIC, SHARE_FALSE_STARS = 0.5, 0.3  # of the observed stars that must match; with false stars fewer can


@dataclass(frozen=True, slots=True)
class MagnitudeMatch(StarMatch):
    """A match with what it says of the camera's magnitudes: mean and variance of observed less catalogued.

    What Fialho, Lopes & Saotome 2005 calibrate a sensor's magnitude offset with; NaN where magnitudes are unknown.
    """

    offset_mag: float = float("nan")
    variance_mag2: float = float("nan")


class Rules(NamedTuple):
    """How a search is done. A plain tuple, so that compiled code can take it.

    tolerance_rad, stretch : of a direction; of an angle sqrt(2) times it plus stretch times the angle
    gate_mag     : of a magnitude
    triangles, checks, base : as in `Options`: observed triangles, angles compared, among how many stars
    share        : of the observed stars must match
    optimised    : whether the lists are assembled from neighbours
    x, y, z, chord : the believed boresight, and the squared straight-line distance that candidates keep to it
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
    """The rules of a search. Raises ImageError for a tolerance or an error that is none."""
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
    """The basic algorithm: one triangle, each list from the whole catalogue, no hint. See `fialho_4`."""
    asked = Options(**options)
    bare = rules(tolerance_rad, asked, SHARE_BASIC, False, False)
    return answer(_found(vectors_cam, index, asked, bare._replace(chord=5.0)))


def fialho_2(vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any) -> StarMatch | None:
    """One triangle from optimised lists, about a believed boresight if there is one. See `fialho_4`."""
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
    """Triangle after triangle from optimised lists, about a believed boresight if there is one. See `fialho_4`."""
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
    """Fialho's triangle, latest version: as the third, and says how the magnitudes are off.

    vectors_cam   : (N, 3) observed unit vectors, brightest first
    tolerance_rad : of a direction; of an angle sqrt(2) times it, plus `stretch` times the angle
    options       : those of `Options`: `magnitude`, with an index that has them too, makes the lists short;
        `boresight_ref` and `within_rad` are the hint: candidates keep to that distance from the optical axis, so that
        it must hold half the field's diagonal beside the hint's error
    Returns None rather than a guess: where too few stars match or chance does as well in 1e5 such searches.
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
    """The compiled identifier: (N, 3) unit vectors brightest first and their (N,) magnitudes, NaN if unknown.

    Returns the rows of the observed and of the catalogue's stars, R_cam_from_ref, and log10 of the chance; it is
    an answer only where that is at most ACCEPT_LOG10_CHANCE.
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
    """The least angle between three stars."""
    i, j, k = corners
    return min(angle(seen[i], seen[j]), angle(seen[i], seen[k]), angle(seen[j], seen[k]))


@jit
def _brightest(seen: Floats, base: int, least_rad: float) -> NDArray:
    """Rows of the three brightest stars with a least distance between them; -1 where there are none."""
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
    """Every triplet of candidates like an observed triangle, and the direct match of each, until one is accepted."""
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
    """The second step: the direct match of one triplet, or nothing where its share of the stars is too small."""
    found = settled(seen, index, corners, stars, by.tolerance_rad, by.stretch, tried)
    if len(found[0]) <= by.share * len(seen) or found[3] > ACCEPT_LOG10_CHANCE:
        return nothing()
    return found


@jit
def _candidate(index: PairIndex, star: int, magnitude: float, by: Rules) -> bool:
    """Whether a star is bright enough, faint enough, and near enough to the believed boresight."""
    if abs(index.magnitude[star] - magnitude) > by.gate_mag:  # NaN is not
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
    """The optimised assembly: the first list is a range of the sorted catalogue, the others its neighbours."""
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
    """Candidates for one star, from the whole catalogue."""
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
    """The basic assembly: three lists, each from the whole catalogue, and every triplet of them."""
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
