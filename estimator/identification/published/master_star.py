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

from estimator.catalog.pair_index import PairIndex, first_neighbor, magnitude_range
from estimator.core.checks import Floats, ImageError
from estimator.core.jit import jit
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES
from estimator.identification.direct_match import (
    DirectMatch,
    angle,
    match_field,
    no_match,
    to_star_match,
)
from estimator.identification.solver_options import Options


class MasterStarOptions(NamedTuple):
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

    The candidates are ranked by how many of the observed angles they have. Each candidate with as many as the best, or
    one less, is tested by direct match: its angle to a second star determines an attitude. Returns None if the match
    is not significant, or if a contradicting match is nearly as good, as on a lattice.

    Parameters
    ----------
    vectors_cam
        (N, 3) observed unit vectors, brightest first
    tolerance_rad
        Of a direction
    masters
        Number of brightest stars to try as master. NPS's single master fails if it is false or
        not in the catalog, or if another star is as bright (the thesis's criticism)
    options
        Those of `Options`; with magnitudes, candidates are within the magnitude gate of the
        master
    """
    settings = Options(**options)
    settings.require_known_focal("master_star")
    if not tolerance_rad > 0:
        raise ImageError(f"master_star: tolerance {tolerance_rad} rad; allowed: more than 0")
    count = len(vectors_cam)
    if count < MIN_MATCHES:
        return None
    parameters = MasterStarOptions(
        tolerance_rad,
        settings.stretch,
        3 * settings.epsilon_mag,
        min(masters, count),
        settings.max_checks,
    )
    rays = np.ascontiguousarray(vectors_cam)
    return to_star_match(search(rays, settings.magnitudes(count), index, parameters))


@jit
def search(
    rays: Floats, magnitudes: Floats, index: PairIndex, options: MasterStarOptions
) -> DirectMatch:
    """Compiled search: rows of the observed stars and of the catalog, R_cam_from_ref, log10 of the chance."""
    tried = np.zeros(2, np.int64)  # assumed pairs, angles compared
    for master in range(options.masters):
        begin, end = magnitude_range(index, magnitudes[master], options.gate_mag)
        angle_counts = np.zeros(end - begin, np.int64)
        for candidate in range(begin, end):
            angle_counts[candidate - begin] = _count_angles(
                rays, index, master, candidate, options, tried
            )
        if len(angle_counts) == 0 or angle_counts.max() < MIN_MATCHES - 1:
            continue
        best = no_match()
        rival = np.zeros(1)
        # One angle less than the best is allowed: a false candidate can have an additional angle by chance.
        for candidate in np.flatnonzero(angle_counts >= angle_counts.max() - 1) + begin:
            best = _best_match(rays, index, master, candidate, options, tried, best, rival)
            if tried[1] >= options.checks:
                break
        if best.log10_chance <= ACCEPT_LOG10_CHANCE:
            # A repetitive pattern has another match as good. The best must be 1e5 times less likely by chance.
            return best if rival[0] > best.log10_chance - ACCEPT_LOG10_CHANCE else no_match()
    return no_match()


@jit
def _contradict(first: DirectMatch, second: DirectMatch) -> bool:
    """Whether two matches identify an observed star differently."""
    for n in range(len(first.observed)):
        for m in range(len(second.observed)):
            if first.observed[n] == second.observed[m] and first.star[n] != second.star[m]:
                return True
    return False


@jit
def _count_angles(
    rays: Floats,
    index: PairIndex,
    master: int,
    candidate: int,
    options: MasterStarOptions,
    tried: NDArray,
) -> int:
    """Number of the master's angles that the candidate has to any of its neighbors."""
    count = 0
    for n in range(len(rays)):
        if n == master:
            continue
        side = angle(rays[master], rays[n])
        tolerance = sqrt(2.0) * options.tolerance_rad + options.stretch * side
        place = first_neighbor(index, candidate, side - tolerance)
        tried[1] += 1
        count += (
            place < index.first[candidate + 1] and index.separation_rad[place] <= side + tolerance
        )
    return count


@jit
def _best_match(
    rays: Floats,
    index: PairIndex,
    master: int,
    candidate: int,
    options: MasterStarOptions,
    tried: NDArray,
    best: DirectMatch,
    rival: Floats,
) -> DirectMatch:
    """The better of `best` and the direct matches at the attitudes from the master and a second star.

    The second star is the farthest from the master, for its leverage, and each of the next three, in case it is false
    or not in the catalog. rival : (1,) least chance of a match that contradicts the best, updated in place.
    """
    sides = np.array([angle(rays[master], rays[n]) for n in range(len(rays))])
    for n in np.argsort(-sides)[: min(4, len(rays) - 1)]:
        tolerance = sqrt(2.0) * options.tolerance_rad + options.stretch * sides[n]
        place = first_neighbor(index, candidate, sides[n] - tolerance)
        while (
            place < index.first[candidate + 1]
            and index.separation_rad[place] <= sides[n] + tolerance
        ):
            stars = np.array([candidate, index.neighbor[place]], np.int64)
            place += 1
            tried[0] += 1
            tried[1] += len(rays)
            pair = np.array([master, n])
            match = match_field(
                rays, index, pair, stars, options.tolerance_rad, options.stretch, tried[0]
            )
            if len(match.observed) and _contradict(best, match):
                rival[0] = min(rival[0], max(best.log10_chance, match.log10_chance))
            if match.log10_chance < best.log10_chance:
                best = match
    return best
