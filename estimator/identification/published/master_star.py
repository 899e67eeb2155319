"""NPS TAS-2's identifier: the angles of a master star to all others, and the catalogue star with most of them.

Tappe 2009 as told by Padro 2012, sections 2.7.2 and 3.2: "star separation angles were measured only with respect to the
brightest star in the image, or the 'master star'", and "star matches were made based solely on the most commonly
reoccurring angle matches associated with the master stars from the cataloged and tracked images", within 500 arcsec,
of nine stars. That alone cannot tell a pattern from its mirror image, nor a match from luck: here the names that the
angles leave open are settled by an attitude, and the match must be beyond chance.
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
    """How a search is done: tolerances as in `Options`, the magnitude's gate, masters in turn, angles compared."""

    tolerance_rad: float
    stretch: float
    gate_mag: float
    masters: int
    checks: int


def master_star(
    vectors_cam: Floats, index: PairIndex, tolerance_rad: float, masters: int = 1, **options: Any
) -> StarMatch | None:
    """NPS's master star: the catalogue star that repeats most of the angles which the brightest star has to others.

    vectors_cam   : (N, 3) observed unit vectors, brightest first;  tolerance_rad : of a direction
    masters       : how many of the brightest are tried in turn. NPS's one fails where it is false or not listed, or
        where another is as bright (the thesis's criticism)
    options       : those of `Options`; with magnitudes, candidates are those like the master
    The candidates are ranked by how many of the observed angles they repeat, and the direct match proves each that
    repeats as many as the best or one less: its angle to a second star fixes an attitude. Returns None rather than a
    guess: where chance does as well, and where a lattice leaves two answers.
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
    """The compiled identifier: rows of the observed and the catalogue's stars, R_cam_from_ref, log10 of the chance."""
    tried = np.zeros(2, np.int64)  # assumed pairs, angles compared
    for master in range(by.masters):
        begin, end = alike(index, light[master], by.gate_mag)
        repeated = np.zeros(end - begin, np.int64)
        for candidate in range(begin, end):
            repeated[candidate - begin] = _repeated(seen, index, master, candidate, by, tried)
        if len(repeated) == 0 or repeated.max() < MIN_MATCHES - 1:
            continue
        best, rival = nothing(), np.zeros(1)
        for candidate in np.flatnonzero(repeated >= repeated.max() - 1) + begin:
            best = _proved(seen, index, master, candidate, by, tried, best, rival)
            if tried[1] >= by.checks:
                break
        if best[3] <= ACCEPT_LOG10_CHANCE:
            # A pattern that repeats itself has another answer as good: 1e5 times as likely is told apart.
            return best if rival[0] > best[3] - ACCEPT_LOG10_CHANCE else nothing()
    return nothing()


@jit
def _contradict(one: Found, other: Found) -> bool:
    """Whether two matches give an observed star different names."""
    for n in range(len(one[0])):
        for m in range(len(other[0])):
            if one[0][n] == other[0][m] and one[1][n] != other[1][m]:
                return True
    return False


@jit
def _repeated(seen: Floats, index: PairIndex, master: int, candidate: int, by: Rules, tried: NDArray) -> int:
    """How many of the master's angles the candidate has to stars of its own."""
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
    """The better of `best` and the direct matches at the attitudes that the master and one more star can give.

    The farthest star, for its leverage; if it is false or missing, one of the next three will do. `rival` keeps the
    least chance of those that contradict the best.
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
