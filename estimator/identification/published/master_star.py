"""NPS TAS-2's identifier: the angles of a master star to all others, and the catalog star that has most of them.

Tappe 2009, cited by Padro 2012, sections 2.7.2 and 3.2: "star separation angles were measured only with respect to the
brightest star in the image, or the 'master star'", and "star matches were made based solely on the most commonly
reoccurring angle matches associated with the master stars from the cataloged and tracked images", within 500 arcsec,
of nine stars. This test alone cannot distinguish a pattern from its mirror image, or a true match from a chance one.
Steps 3 and 4 are therefore added:

1. Take the brightest star as the master. Candidates are the catalog stars of its brightness (`search`).
2. Count how many of the master's angles each candidate has (`_count_angles`).
3. Test the candidates with as many as the best one, or one less: the angle to a second star determines an attitude,
   at which the whole field is matched (`_best_match`).
4. Accept the best match if it is significant, and no contradicting match is nearly as good, as on a lattice. The
   acceptance `thesis` takes it without this test.
"""

from math import sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.pair_index import PairIndex, magnitude_range, neighbor_range
from estimator.core.checks import Floats
from estimator.core.jit import inlined, jit
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

SECONDS = 4  # greatest number of second stars that are tried with a candidate


class MasterStarOptions(NamedTuple):
    """Search parameters.

    Attributes
    ----------
    tolerance_rad, stretch
        Tolerance of a direction, and relative tolerance of an angle (see `Options`)
    gate_mag
        Greatest difference of the magnitudes of the master and a candidate
    checks
        Greatest number of angles compared
    by_paper
        Whether the best match is accepted without step 4
    """

    tolerance_rad: float
    stretch: float
    gate_mag: float
    checks: int
    by_paper: bool = False


def master_star(
    vectors_cam: Floats,
    index: PairIndex,
    tolerance_rad: float,
    **options: Any,
) -> StarMatch | None:
    """Identify stars by NPS's master-star method (see the module's steps).

    It fails if the master is false or not in the catalog, or if another star is as bright (the thesis's criticism).

    Parameters
    ----------
    vectors_cam
        (N, 3) observed unit vectors, brightest first
    index
        Catalog of the stars and pairs
    tolerance_rad
        Tolerance of a direction
    options
        Keywords of `Options`; with magnitudes, candidates are within the magnitude gate of the master

    Returns
    -------
    StarMatch | None
        None if the match is not significant, or if a contradicting match is nearly as good

    Raises
    ------
    ImageError
        Unless the tolerance is positive.
    """
    settings = Options(**options)
    settings.require_known_focal("master_star")
    settings.require_tolerance("master_star", tolerance_rad)
    count = len(vectors_cam)
    if count < MIN_MATCHES:
        return None
    parameters = MasterStarOptions(
        tolerance_rad,
        settings.stretch,
        3 * settings.epsilon_mag,
        settings.max_checks,
        settings.by_paper,
    )
    rays = np.ascontiguousarray(vectors_cam)
    match = search(rays, settings.magnitudes(count), index, parameters)
    return to_star_match(match, settings.by_paper)


@jit
def search(
    rays: Floats, magnitudes: Floats, index: PairIndex, options: MasterStarOptions
) -> DirectMatch:
    """The compiled search: steps 1 to 4.

    Parameters
    ----------
    rays, magnitudes
        (N, 3) unit vectors, brightest first, and their (N,) magnitudes, NaN if unknown

    Returns
    -------
    DirectMatch
        Empty if no match is accepted
    """
    tried = np.zeros(2, np.int64)  # assumed pairs, angles compared
    # 1. Candidates of the master's brightness.
    begin, end = magnitude_range(index, magnitudes[0], options.gate_mag)
    # 2. The number of the master's angles that each of them has.
    angle_counts = np.zeros(end - begin, np.int64)
    for candidate in range(begin, end):
        angle_counts[candidate - begin] = _count_angles(
            rays, index, candidate, options, tried
        )
    if len(angle_counts) == 0 or angle_counts.max() < MIN_MATCHES - 1:
        return no_match()
    # 3. Test the best candidates by direct match.
    best = no_match()
    rival = np.zeros(1)
    # One angle less than the best is allowed: a false candidate can have an additional angle by chance.
    for candidate in np.flatnonzero(angle_counts >= angle_counts.max() - 1) + begin:
        best = _best_match(rays, index, candidate, options, tried, best, rival)
        if tried[1] >= options.checks:
            break
    if options.by_paper:
        return best
    # 4. A repetitive pattern has another match as good: the best must be 1e5 times less likely by chance.
    chance = best.log10_chance
    if chance > ACCEPT_LOG10_CHANCE or rival[0] <= chance - ACCEPT_LOG10_CHANCE:
        return no_match()
    return best


@jit
def contradict(first: DirectMatch, second: DirectMatch) -> bool:
    """Whether two matches identify an observed star differently."""
    for n in range(len(first.observed)):
        for m in range(len(second.observed)):
            if first.observed[n] == second.observed[m] and first.star[n] != second.star[m]:
                return True
    return False


@inlined
def _count_angles(
    rays: Floats,
    index: PairIndex,
    candidate: int,
    options: MasterStarOptions,
    tried: NDArray,
) -> int:
    """Number of the master's angles that the candidate has to any of its neighbors."""
    count = 0
    for n in range(1, len(rays)):
        side = angle(rays[0], rays[n])
        tolerance = sqrt(2.0) * options.tolerance_rad + options.stretch * side
        # Catalog stars at this angle from the candidate; one is enough.
        begin, end = neighbor_range(index, candidate, side - tolerance, side + tolerance)
        tried[1] += 1
        count += end > begin
    return count


@inlined
def _best_match(
    rays: Floats,
    index: PairIndex,
    candidate: int,
    options: MasterStarOptions,
    tried: NDArray,
    best: DirectMatch,
    rival: Floats,
) -> DirectMatch:
    """The better of `best` and the direct matches at the attitudes from the master and a second star: step 3.

    The second star is the farthest from the master, for its leverage, and each of the next three, in case it is
    false. Lights at an angle that the candidate does not have are not tried, since more than three false lights may be
    farther, as with hot pixels.

    Parameters
    ----------
    candidate
        Row of the catalog star that is taken for the master
    tried
        (2,) assumed pairs and angles compared so far, increased in place
    best
        Best match so far
    rival
        (1,) least chance of a match that contradicts the best, updated in place
    """
    sides = np.array([angle(rays[0], rays[n]) for n in range(len(rays))])
    # Stars at the angle of the second star from the candidate.
    seconds = 0
    for n in np.argsort(-sides)[:-1]:
        tolerance = sqrt(2.0) * options.tolerance_rad + options.stretch * sides[n]
        begin, end = neighbor_range(
            index, candidate, sides[n] - tolerance, sides[n] + tolerance
        )
        seconds += end > begin
        if seconds > SECONDS:
            break
        for second in index.neighbor[begin:end]:
            stars = np.array([candidate, second], np.int64)
            tried[0] += 1
            tried[1] += len(rays)
            # The attitude of the master and the second star, matched to the whole field.
            pair = np.array([0, n])
            match = match_field(
                rays, index, pair, stars, options.tolerance_rad, options.stretch, tried[0]
            )
            # The worse of two matches that contradict each other is a rival.
            if len(match.observed) and contradict(best, match):
                rival[0] = min(rival[0], max(best.log10_chance, match.log10_chance))
            if match.log10_chance < best.log10_chance:
                best = match
    return best
