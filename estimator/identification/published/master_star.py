"""NPS TAS-2's identifier: the angles of a master star to all others, and the catalog star with most of them.

Tappe 2009, cited by Padro 2012, sections 2.7.2 and 3.2: "star separation angles were measured only with respect to the
brightest star in the image, or the 'master star'", and "star matches were made based solely on the most commonly
reoccurring angle matches associated with the master stars from the cataloged and tracked images", within 500 arcsec,
of nine stars. This test alone cannot distinguish a pattern from its mirror image, or a true match from a chance one.
Here the ambiguities of the angles are resolved with an attitude (direct match), and the match must be significant.
"""

from __future__ import annotations

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
from estimator.identification.direct_match import Found, angle, answer, nothing, settled
from estimator.identification.options import Options


class Rules(NamedTuple):
    """Search parameters: tolerances as in `Options`, magnitude gate, number of masters, limit of angles compared."""

    tolerance_rad: float
    stretch: float
    gate_mag: float
    masters: int
    checks: int


def master_star(
    vectors_cam: Floats, index: PairIndex, tolerance_rad: float, masters: int = 1, **options: Any
) -> StarMatch | None:
    """NPS's master-star method: find the catalog star that has most of the brightest star's angles to the others.

    vectors_cam   : (N, 3) observed unit vectors, brightest first;  tolerance_rad : of a direction
    masters       : number of brightest stars to try as master. NPS's single master fails if it is false or not in the
        catalog, or if another star is as bright (the thesis's criticism)
    options       : those of `Options`; with magnitudes, candidates are within the magnitude gate of the master
    The candidates are ranked by how many of the observed angles they have. Each candidate with as many as the best, or
    one less, is tested by direct match: its angle to a second star determines an attitude. Returns None if the match
    is not significant, or if a contradicting match is nearly as good, as on a lattice.
    """
    asked = Options(**options)
    asked.fixed_focal("master_star")
    if not tolerance_rad > 0:
        raise ImageError(f"master_star: tolerance {tolerance_rad} rad; allowed: more than 0")
    count = len(vectors_cam)
    if count < MIN_MATCHES:
        return None
    gate_mag = 3 * asked.epsilon_mag
    by = Rules(tolerance_rad, asked.stretch, gate_mag, min(masters, count), asked.max_checks)
    return answer(search(np.ascontiguousarray(vectors_cam), asked.light(count), index, by))


@jit
def search(seen: Floats, light: Floats, index: PairIndex, by: Rules) -> Found:
    """Compiled search: rows of the observed stars and of the catalog, R_cam_from_ref, log10 of the chance."""
    tried = np.zeros(2, np.int64)  # assumed pairs, angles compared
    for master in range(by.masters):
        begin, end = alike(index, light[master], by.gate_mag)
        repeated = np.zeros(end - begin, np.int64)
        for candidate in range(begin, end):
            repeated[candidate - begin] = _repeated(seen, index, master, candidate, by, tried)
        if len(repeated) == 0 or repeated.max() < MIN_MATCHES - 1:
            continue
        best, rival = nothing(), np.zeros(1)
        # One angle less than the best is allowed: a false candidate can have an additional angle by chance.
        for candidate in np.flatnonzero(repeated >= repeated.max() - 1) + begin:
            best = _proved(seen, index, master, candidate, by, tried, best, rival)
            if tried[1] >= by.checks:
                break
        if best[3] <= ACCEPT_LOG10_CHANCE:
            # A repetitive pattern has another match as good. The best must be 1e5 times less likely by chance.
            return best if rival[0] > best[3] - ACCEPT_LOG10_CHANCE else nothing()
    return nothing()


@jit
def _contradict(one: Found, other: Found) -> bool:
    """Whether two matches identify an observed star differently."""
    for n in range(len(one[0])):
        for m in range(len(other[0])):
            if one[0][n] == other[0][m] and one[1][n] != other[1][m]:
                return True
    return False


@jit
def _repeated(seen: Floats, index: PairIndex, master: int, candidate: int, by: Rules, tried: NDArray) -> int:
    """Number of the master's angles that the candidate has to any of its neighbors."""
    count = 0
    for n in range(len(seen)):
        if n == master:
            continue
        side = angle(seen[master], seen[n])
        slack = sqrt(2.0) * by.tolerance_rad + by.stretch * side
        place = around(index, candidate, side - slack)
        tried[1] += 1
        count += place < index.first[candidate + 1] and index.separation_rad[place] <= side + slack
    return count


@jit
def _proved(
    seen: Floats,
    index: PairIndex,
    master: int,
    candidate: int,
    by: Rules,
    tried: NDArray,
    best: Found,
    rival: Floats,
) -> Found:
    """The better of `best` and the direct matches at the attitudes from the master and a second star.

    The second star is the farthest from the master, for its leverage, and each of the next three, in case it is false
    or not in the catalog. rival : (1,) least chance of a match that contradicts the best, updated in place.
    """
    sides = np.array([angle(seen[master], seen[n]) for n in range(len(seen))])
    for n in np.argsort(-sides)[: min(4, len(seen) - 1)]:
        slack = sqrt(2.0) * by.tolerance_rad + by.stretch * sides[n]
        place = around(index, candidate, sides[n] - slack)
        while place < index.first[candidate + 1] and index.separation_rad[place] <= sides[n] + slack:
            stars = np.array([candidate, index.neighbour[place]], np.int64)
            place += 1
            tried[0] += 1
            tried[1] += len(seen)
            pair = np.array([master, n])
            found = settled(seen, index, pair, stars, by.tolerance_rad, by.stretch, tried[0])
            if len(found[0]) and _contradict(best, found):
                rival[0] = min(rival[0], max(best[3], found[3]))
            if found[3] < best[3]:
                best = found
    return best
