"""Stellar Attitude Acquisition, the angle method of Boeing and of AFIT's thesis: a pair, then a direct match.

Needelman, Li & Wu 2005, cited by Padro 2012, sections 2.4.2 to 2.4.5 and 3.6.4. An assumption says that the two stars
of an observed pair are a certain catalog pair, in a certain order. The steps are those of section 2.4.2:

2. Take a primary pair A, B of observed stars, the brightest first (`_primary_pairs`).
3. Look up the catalog pairs of the same angle: the primary pair candidates (`_test_pairs`).
4. Assume that A, B are such a pair, if the magnitudes agree (`match_assumptions`).
5. The assumption determines an attitude (`triad`), which predicts the place of every other observed star.
6. Direct match (`_partners`): of the catalog stars within the gates of magnitude, place and the two angles to A and B,
   the one of least squared deviations is the partner of an observed star. The cost of the assumption is the sum of the
   squared deviations, with UNMATCHED_COST for a star without a partner.
7. Repeat steps 4 to 6 with the pair in the other order, then with the next catalog pair.
8. Repeat steps 3 to 7 with the next primary pair.

The thesis stops at the first assumption that passes. Here the assumption of least cost is accepted, if it is
significant, and 1e5 times as likely as any contradicting assumption of this and of RIVAL_PAIRS more pairs
(`AssumptionPool`). The acceptance `thesis` takes the assumption of least cost of the first primary pair that has one
with MIN_MATCHES stars, without these tests.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.solvers import quest
from estimator.catalog.pair_index import PairIndex, pair_range
from estimator.catalog.sky_index import within
from estimator.core import vectors
from estimator.core.checks import Floats, Ints
from estimator.core.errors import ImageError
from estimator.core.jit import inlined, jit
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.identification.direct_match import angle
from estimator.identification.published.primary_pair import (
    Gates,
    Primary,
    SearchInput,
    build_primary,
    gate_rad,
    triad,
)
from estimator.identification.solver_options import Options

# Cost of an observed star without a partner, in squared standard deviations; a bad partner costs no more. 16 is four
# standard deviations: it corresponds to a probability of one in three thousand that a star has no partner.
UNMATCHED_COST = 16.0
# Further pairs whose assumptions the best one must beat. If half of the pairs are of true stars, the true assumption is
# missed by all ten with probability 1e-3.
RIVAL_PAIRS = 10
MAX_ASSUMPTIONS = 100_000  # 16 MB of matches at 40 observed stars
# By the paper's rule a contradicting assumption must be this much less likely, and this share of the lights named.
TENFOLD = 10.0
MOST_LIGHTS = 2 / 3


@jit
def magnitude_cost(stars: SearchInput, observed: int, star: int) -> float:
    """Squared deviation of a magnitude in standard deviations, inf beyond three; 0 if a magnitude is unknown."""
    deviation = (
        stars.magnitude_cam[observed] - stars.magnitude[star]
    ) / stars.gates.magnitude
    if np.isnan(deviation):
        return 0.0
    return deviation * deviation if abs(deviation) <= 3 else np.inf


@jit
def match_assumptions(
    stars: SearchInput, primary: Primary, pairs: NDArray
) -> tuple[NDArray, Floats, Ints]:
    """Steps 4 to 7: every assumption from the catalog's pairs, in both orders.

    Parameters
    ----------
    pairs
        (P, 2) rows of the primary pair candidates; those outside of the gate are skipped

    Returns
    -------
    star
        (K, N) catalog rows of the observed stars in each assumption, -1 for none
    cost
        (K,) costs in squared standard deviations
    matches
        (K,) numbers of matches in addition to the pair
    """
    a, b = primary.rows
    separation_rad = angle(stars.vectors_cam[a], stars.vectors_cam[b])
    gate = gate_rad(stars.gates, separation_rad)
    count = 0
    star = np.empty((2 * len(pairs), len(stars.vectors_cam)), np.int32)
    cost = np.empty(2 * len(pairs))
    matches = np.empty(2 * len(pairs), np.int64)
    nearby = np.empty(len(stars.vectors), np.int64)
    partner = np.empty(len(primary.others), np.int64)
    partner_cost = np.empty(len(primary.others))
    for p in range(len(pairs)):
        # Skip pairs outside of the gate, which whole steps of the k-vector include.
        misfit = abs(
            angle(stars.vectors[pairs[p, 0]], stars.vectors[pairs[p, 1]]) - separation_rad
        )
        if misfit > gate:
            continue
        # 4. Assume the pair in this order; 7. then in the other one.
        for flip in range(2):
            first = pairs[p, flip]
            second = pairs[p, 1 - flip]
            cost_a = magnitude_cost(stars, a, first)
            cost_b = magnitude_cost(stars, b, second)
            if not np.isfinite(cost_a + cost_b):
                continue
            star[count] = -1
            star[count, a] = first
            star[count, b] = second
            # The cost of the pair: its angle and its two magnitudes.
            total = (misfit / stars.gates.separation_rad) ** 2 + cost_a + cost_b
            # 5. and 6. The attitude and the direct match; then the cost.
            _partners(stars, primary, first, second, nearby, partner, partner_cost)
            matches[count] = _remove_duplicates(partner, partner_cost)
            for k in range(len(partner)):
                star[count, primary.others[k]] = partner[k]
                total += min(partner_cost[k], UNMATCHED_COST)
            cost[count] = total
            count += 1
    return star[:count], cost[:count], matches[:count]


@inlined
def _partners(
    stars: SearchInput,
    primary: Primary,
    first: int,
    second: int,
    nearby: NDArray,
    partner: NDArray,
    partner_cost: Floats,
) -> None:
    """Steps 5 and 6: the pair's attitude, and the partner of each other star.

    Section 2.4.5 has four conditions: magnitude, position, and the angles to A and to B. The position distinguishes
    a star from its mirror image about the line A B, which the two angles cannot.

    Parameters
    ----------
    first, second
        Catalog rows of A and B
    nearby
        (M,) buffer for the rows of nearby stars
    partner, partner_cost
        (X,) row of each other star's partner (-1: none) and its cost, written in place
    """
    # 5. R_ref_from_cam maps the axes of the observed pair to those of the catalog pair.
    triad_ref = triad(stars.vectors[first], stars.vectors[second])
    R_ref_from_cam = np.empty((3, 3))
    vectors.multiply_transposed(triad_ref.T, primary.triad.T, R_ref_from_cam)
    # 6. Catalog stars near the predicted place.
    for k in range(len(primary.others)):
        x, y, z = vectors.rotate(
            R_ref_from_cam, vectors.row(stars.vectors_cam, primary.others[k])
        )
        chord = 2 * np.sin(min(primary.radius_rad[k], np.pi) / 2)
        partner[k] = -1
        partner_cost[k] = UNMATCHED_COST
        least = np.inf
        for s in nearby[: within(stars.cells, stars.vectors, x, y, z, chord, nearby)]:
            if s in (first, second):
                continue
            cost = magnitude_cost(stars, primary.others[k], s)
            # The angles to A and B.
            misfit_a = abs(
                primary.corner_rad[0, k] - angle(stars.vectors[s], stars.vectors[first])
            )
            misfit_b = abs(
                primary.corner_rad[1, k] - angle(stars.vectors[s], stars.vectors[second])
            )
            if misfit_a > primary.gate_rad[0, k] or misfit_b > primary.gate_rad[1, k]:
                continue
            cost += (misfit_a**2 + misfit_b**2) / stars.gates.separation_rad**2
            distance2 = vectors.squared_chord(vectors.row(stars.vectors, s), (x, y, z))
            # The position decides between several partners, but is not part of the assumption's cost.
            position_cost = distance2 / primary.sigma_rad[k] ** 2
            if cost + position_cost < least:
                least = cost + position_cost
                partner[k] = s
                partner_cost[k] = cost


@inlined
def _remove_duplicates(partner: NDArray, partner_cost: Floats) -> int:
    """Keep each catalog star for the observed star of least cost; return the number of matches."""
    count = 0
    for k in range(len(partner)):
        if partner[k] < 0:
            continue
        count += 1
        # An earlier observed star with the same partner: the one of greater cost loses it.
        for m in range(k):
            if partner[m] == partner[k]:
                loser = k if partner_cost[m] <= partner_cost[k] else m
                partner[loser] = -1
                partner_cost[loser] = UNMATCHED_COST
                count -= 1
                break
    return count


@jit
def add_contradictions(
    star: NDArray, cost: Floats, matches: NDArray, best: NDArray, contradictions: Floats
) -> None:
    """Count the assumptions that identify an observed star differently from the best one.

    Parameters
    ----------
    star, cost, matches
        Assumptions, as from `match_assumptions`
    best
        (N,) catalog rows of the observed stars in the best assumption
    contradictions
        (3,) their number, the sum of their matches and their least cost, updated in place
    """
    for n in range(len(cost)):
        for m in range(len(best)):
            # One star identified differently is enough.
            if star[n, m] >= 0 and best[m] >= 0 and star[n, m] != best[m]:
                contradictions[0] += 1
                contradictions[1] += matches[n]
                contradictions[2] = min(contradictions[2], cost[n])
                break


def saa(
    vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any
) -> StarMatch | None:
    """Identify stars by SAA (Needelman, Li & Wu 2005; Padro 2012, 2.4.2; see the module's steps).

    A lattice of LEDs that is not in the catalog is sometimes identified as one that is.

    Parameters
    ----------
    vectors_cam
        (N, 3) observed unit vectors, brightest first
    index
        Its magnitudes may be in any order
    tolerance_rad
        Tolerance of a direction, 3 epsilon_position
    options
        Keywords of `Options`: magnitudes are used if the index has them too; max_triangles is the limit of
        observed pairs

    Returns
    -------
    StarMatch | None
        None if no assumption is significant and clearly better than those that contradict it

    Raises
    ------
    ImageError
        Unless the tolerances are positive.
    """
    settings = Options(**options)
    settings.require_known_focal("saa")
    count = len(vectors_cam)
    if count < MIN_MATCHES:
        return None
    if not min(tolerance_rad, settings.epsilon_mag) > 0:
        raise ImageError(
            f"saa: tolerance {tolerance_rad}, epsilon {settings.epsilon_mag}; allowed: more than 0"
        )
    # The tolerance of a direction is three standard deviations; an angle has the errors of two.
    position_rad = tolerance_rad / 3
    sep_rad = float(np.sqrt(2) * position_rad)
    gates = Gates(sep_rad, position_rad, settings.epsilon_mag, settings.stretch)
    stars = SearchInput(
        np.ascontiguousarray(vectors_cam),
        settings.magnitudes(count),
        index.vectors,
        index.magnitude,
        index.cells,
        gates,
    )
    pool = AssumptionPool(stars, settings.field_tan, settings.missed_dex)
    _test_pairs(pool, index, settings)
    return pool.best_match(settings.by_paper)


class AssumptionPool:
    """All assumptions tried, in the order of the pairs, and the best of them.

    Attributes
    ----------
    assumptions
        The assumptions of each pair, as from `match_assumptions`
    count
        Number of assumptions
    cost, star
        Cost of the best one, and its (N,) catalog rows of the observed stars, -1 for none
    p
        Probability that an observed star finds a partner by chance, at the best attitude
    missing
        Number of catalog stars that the best attitude predicts and that are not matched
    """

    def __init__(
        self,
        stars: SearchInput,
        field_tan: tuple[float, float, float, float],
        missed_dex: float,
    ) -> None:
        self.stars = stars
        self.field_tan = field_tan
        self.missed_dex = missed_dex
        self.assumptions: list[tuple[Ints, Floats, Ints]] = []
        self.count = 0
        self.cost = np.inf
        self.star = np.full(len(stars.vectors_cam), -1, np.int32)
        self.p = 1.0
        self.missing = 0.0
        # Of the assumptions that contradict the best: count, sum of matches, least cost.
        self._contradictions = np.zeros(3)

    def add(self, primary: Primary, assumed: tuple[Ints, Floats, Ints]) -> None:
        """Add the assumptions of one more pair, and update the best one and those that contradict it."""
        star, cost, _ = assumed
        if not len(cost):
            return
        self.assumptions.append(assumed)
        self.count += len(cost)
        best = int(cost.argmin())
        if cost[best] < self.cost:
            self.cost = float(cost[best])
            self.star = star[best]
            self.p, self.missing = self._chance_statistics(primary)
            # A new best: all earlier assumptions are compared with it again.
            self._contradictions = np.array([0.0, 0.0, np.inf])
            for earlier in self.assumptions:
                add_contradictions(*earlier, self.star, self._contradictions)
        else:
            add_contradictions(*assumed, self.star, self._contradictions)

    def _chance_statistics(self, primary: Primary) -> tuple[float, float]:
        """Chance statistics of the best assumption's attitude.

        In a field of uniform density, n stars of similar brightness in the solid angle Omega give an area A at least
        one with the probability 1 - exp(-n A / Omega). A is the area of the gates of an observed star.

        Returns
        -------
        p
            Mean probability that an observed star finds a partner by chance
        missing
            Number of catalog stars that are predicted in the field and not matched
        """
        # Catalog stars in the field at the assumption's attitude.
        stars = self.stars
        pair = self.star[primary.rows]
        R_cam_from_ref = primary.triad.T @ triad(
            stars.vectors[pair[0]], stars.vectors[pair[1]]
        )
        predicted = stars.vectors @ R_cam_from_ref.T
        left, right, top, bottom = self.field_tan
        x, y, z = predicted.T
        field = (z > 0) & (x > left * z) & (x < right * z) & (y > top * z) & (y < bottom * z)
        from_midpoint_rad = 2 * np.arcsin(
            np.minimum(np.linalg.norm(predicted - primary.midpoint, axis=1) / 2, 1.0)
        )
        # Those that can be partners: within reach of the pair, and not of the pair itself.
        rows = np.flatnonzero(field & (from_midpoint_rad < primary.reach_rad))
        rows = rows[(rows != pair[0]) & (rows != pair[1])]
        # Of these, the number of similar brightness, for each observed star.
        difference_mag = np.abs(
            stars.magnitude_cam[primary.others][:, None] - stars.magnitude[rows]
        )
        # NaN > x is False: an unknown magnitude passes.
        similar = len(rows) - (difference_mag > 3 * stars.gates.magnitude).sum(axis=1)
        cap_sr = 2 * np.pi * (1 - np.cos(primary.reach_rad))
        p = float(np.mean(1 - np.exp(-similar * primary.area_sr / cap_sr)))
        return p, max(int(field.sum()) - self._matches, 0)

    @property
    def _matches(self) -> int:
        """Number of stars that the best assumption identifies."""
        return int((self.star >= 0).sum())

    @property
    def is_complete(self) -> bool:
        """Whether the best assumption identifies MIN_MATCHES stars."""
        return self._matches >= MIN_MATCHES

    @property
    def log10_chance(self) -> float:
        """log10 of the expected number of chance matches as good as the best one; 0 with too few matches.

        On a lattice, false assumptions match often. The match rate of those that contradict the best one is
        therefore measured, and the greater of it and of p counts.
        """
        # The pair defines the attitude: the other stars are trials.
        trials = len(self.star) - 2
        if not self.is_complete:
            return 0.0
        count, matches, _ = self._contradictions
        match_rate = matches / count / trials if count else 0.0
        tail = log10_tail(trials, self._matches - 2, max(self.p, match_rate))
        return tail + self.missed_dex * self.missing + float(np.log10(self.count))

    def best_match(self, by_paper: bool = False) -> StarMatch | None:
        """The best assumption, or None if it is not significant or a contradicting one is nearly as likely.

        By the paper's rule it needs only MIN_MATCHES stars, and its log10_chance is NaN. An assumption that a
        contradicting one equals, as on a lattice of equal lights, or that leaves many lights without a star is refused
        by this rule, too.
        """
        count, _, rival_cost = self._contradictions
        # A cost is -2 ln(likelihood): 1e5 times as likely is a cost smaller by 2 ln 1e5.
        if by_paper:
            chance = float("nan")
            is_alone = not count or rival_cost > self.cost + 2 * np.log(TENFOLD)
            is_significant = (
                self.is_complete and float(np.mean(self.star >= 0)) >= MOST_LIGHTS
            )
        else:
            chance = self.log10_chance
            margin = -2 * np.log(10) * ACCEPT_LOG10_CHANCE
            is_alone = not count or rival_cost >= self.cost + margin
            is_significant = chance <= ACCEPT_LOG10_CHANCE
        if not (is_significant and is_alone):
            return None
        # The attitude of all its matches
        observed = np.flatnonzero(self.star >= 0)
        star = self.star[observed].astype(np.int64)
        cam_from_ref = quest(
            self.stars.vectors_cam[observed], self.stars.vectors[star], np.ones(len(star))
        )
        return StarMatch(observed, star, cam_from_ref, chance)


def _test_pairs(pool: AssumptionPool, index: PairIndex, settings: Options) -> None:
    """Steps 2 to 8: add the assumptions of pair after pair to the pool.

    One pair is not enough: if noise moves A or B out of a gate, the truth is not among its assumptions. The search ends
    when the best assumption is significant and has competed with RIVAL_PAIRS more pairs.
    """
    stars = pool.stars
    remaining = settings.max_triangles
    budget = min(settings.max_checks // len(stars.vectors_cam), MAX_ASSUMPTIONS)
    # 2. Primary pairs; 3. their candidates.
    for a, b, angle_rad in _primary_pairs(stars, settings.base_stars, index.max_angle_rad):
        gate = gate_rad(stars.gates, angle_rad)
        begin, end = pair_range(index, angle_rad - gate, angle_rad + gate)
        if remaining == 0 or pool.count + end - begin > budget:
            break
        remaining -= 1
        # 4. to 7. Their assumptions.
        primary = build_primary(stars, a, b)
        pool.add(primary, match_assumptions(stars, primary, index.pair[begin:end]))
        if settings.by_paper and pool.is_complete:
            break
        # Once the best is significant, only RIVAL_PAIRS more pairs are tried.
        if remaining >= RIVAL_PAIRS and pool.log10_chance <= ACCEPT_LOG10_CHANCE:
            remaining = RIVAL_PAIRS


def _primary_pairs(
    stars: SearchInput, base_stars: int, max_rad: float
) -> Iterator[tuple[int, int, float]]:
    """Step 2: rows and angle of observed pairs, the brightest first, far enough apart to determine the roll."""
    base = min(base_stars, len(stars.vectors_cam))
    gates = stars.gates
    chord = np.linalg.norm(stars.vectors_cam[:base, None] - stars.vectors_cam[:base], axis=2)
    angles = 2 * np.arcsin(np.minimum(chord / 2, 1.0))
    # The sum of the two rows is least for the brightest pair.
    for rank_sum in range(1, 2 * base - 2):
        for a in range(max(rank_sum - base + 1, 0), (rank_sum + 1) // 2):
            angle = float(angles[a, rank_sum - a])
            if 4 * 3 * gates.separation_rad < angle <= max_rad + gate_rad(gates, angle):
                yield a, rank_sum - a, angle
