"""Stellar Attitude Acquisition, the angle method of Boeing and of AFIT's thesis: a pair, then a direct match.

Needelman, Li & Wu 2005, cited by Padro 2012, sections 2.4.2 to 2.4.5 and 3.6.4. A primary pair of observed stars is
assumed to be each catalog pair of the same angle; each assumption gives an attitude, at which all other stars are
matched, and a cost in squared standard deviations. The assumption of the least cost is accepted if its match is
significant and no contradicting assumption is nearly as good. `saa_search` has the compiled steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from estimator.attitude.solvers import quest
from estimator.catalog.pair_buckets import PairCatalog, candidates
from estimator.catalog.pair_index import PairIndex, pair_range
from estimator.core.arrays import Floats, Ints
from estimator.core.errors import ImageError
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.identification.options import Options
from estimator.identification.published.saa_search import (
    Gates,
    Primary,
    SearchInput,
    add_contradictions,
    build_primary,
    gate_rad,
    match_assumptions,
    triad,
)

# Further pairs whose assumptions the best one must beat. If half of the pairs are of true stars, the true assumption is
# missed by all ten with probability 1e-3.
RIVAL_PAIRS = 10
MAX_ASSUMPTIONS = 100_000  # 16 MB of matches at 40 observed stars


def saa(
    vectors_cam: Floats, index: PairIndex | PairCatalog, tolerance_rad: float, **options: Any
) -> StarMatch | None:
    """SAA (Needelman, Li & Wu 2005; Padro 2012, 2.4.2): two bright stars, all pairs like them, all other stars.

    vectors_cam   : (N, 3) observed unit vectors, brightest first
    index         : pairs in buckets, or a k-vector index
    tolerance_rad : of a direction, 3 epsilon_position
    options       : those of `Options`: magnitudes are used if the index has them too; epsilon_sep_rad is
        sqrt(2) / 3 of the tolerance if None; max_triangles is the limit of observed pairs
    Steps 2 to 8 of 2.4.2, except that the search does not stop at the first assumption that passes: with the
    assumptions of ten more pairs, the best must be significant (1e-5), and 1e5 times as likely as the next one that
    identifies a star differently. Otherwise returns None. A lattice of LEDs that is not in the catalog is sometimes
    identified as one that is.
    """
    settings = Options(**options)
    settings.require_known_focal("saa")
    count = len(vectors_cam)
    if count < MIN_MATCHES:
        return None
    sep_rad = (
        np.sqrt(2) / 3 * tolerance_rad
        if settings.epsilon_sep_rad is None
        else settings.epsilon_sep_rad
    )
    if not min(sep_rad, tolerance_rad, settings.epsilon_mag) > 0:
        raise ImageError(
            f"saa: tolerance {tolerance_rad}, epsilons {sep_rad} and {settings.epsilon_mag}; allowed: more than 0"
        )
    gates = Gates(float(sep_rad), tolerance_rad / 3, settings.epsilon_mag, settings.stretch)
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
    return pool.best_match()


class AssumptionPool:
    """All assumptions tried, in the order of the pairs, and the best of them.

    Each assumption has (N,) the catalog's row for each observed star (-1: none), its cost in squared standard
    deviations, and the number of stars matched beside the pair.
    """

    def __init__(
        self, stars: SearchInput, field_tan: tuple[float, float, float, float], missed_dex: float
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
            self.p, self.missing = _chance_statistics(
                self.stars, primary, star[best], self.field_tan
            )
            # A new best: all earlier assumptions are compared with it again.
            self._contradictions = np.array([0.0, 0.0, np.inf])
            for earlier in self.assumptions:
                add_contradictions(*earlier, self.star, self._contradictions)
        else:
            add_contradictions(*assumed, self.star, self._contradictions)

    @property
    def log10_chance(self) -> float:
        """log10 of the expected number of chance matches as good as the best one; 0 with too few matches.

        On a lattice false assumptions match often; their match rate is measured on those that contradict the best.
        """
        trials = len(self.star) - 2
        hits = int((self.star >= 0).sum()) - 2
        if hits + 2 < MIN_MATCHES:
            return 0.0
        count, matches, _ = self._contradictions
        match_rate = matches / count / trials if count else 0.0
        tail = log10_tail(trials, hits, max(self.p, match_rate))
        return tail + self.missed_dex * self.missing + float(np.log10(self.count))

    def best_match(self) -> StarMatch | None:
        """The best assumption, or None if it is not significant or a contradicting one is nearly as likely."""
        chance = self.log10_chance
        margin = -2 * np.log(10) * ACCEPT_LOG10_CHANCE
        count, _, rival_cost = self._contradictions
        if chance > ACCEPT_LOG10_CHANCE or (count and rival_cost < self.cost + margin):
            return None
        observed = np.flatnonzero(self.star >= 0)
        star = self.star[observed].astype(np.int64)
        cam_from_ref = quest(
            self.stars.vectors_cam[observed], self.stars.vectors[star], np.ones(len(star))
        )
        return StarMatch(observed, star, cam_from_ref, chance)


def _test_pairs(pool: AssumptionPool, index: PairIndex | PairCatalog, settings: Options) -> None:
    """Add the assumptions of pair after pair, until the pool's best is significant and has beaten RIVAL_PAIRS more.

    One pair is not enough: if noise moves A or B out of a gate, the truth is not among its assumptions.
    """
    stars = pool.stars
    remaining = settings.max_triangles
    budget = min(settings.max_checks // len(stars.vectors_cam), MAX_ASSUMPTIONS)
    max_rad = index.max_rad if isinstance(index, PairCatalog) else index.max_angle_rad
    find_pairs = candidates if isinstance(index, PairCatalog) else pair_range
    for a, b, angle in _primary_pairs(stars, settings.base_stars, max_rad):
        gate = gate_rad(stars.gates, angle)
        begin, end = find_pairs(index, angle - gate, angle + gate)
        if remaining == 0 or pool.count + end - begin > budget:
            break
        remaining -= 1
        primary = build_primary(stars, a, b)
        pool.add(primary, match_assumptions(stars, primary, index.pair[begin:end]))
        # Once the best is significant, only RIVAL_PAIRS more pairs are tried.
        if remaining >= RIVAL_PAIRS and pool.log10_chance <= ACCEPT_LOG10_CHANCE:
            remaining = RIVAL_PAIRS


def _primary_pairs(
    stars: SearchInput, base_stars: int, max_rad: float
) -> Iterator[tuple[int, int, float]]:
    """Step 2: pairs of observed stars, the brightest first, far enough apart to determine the roll; and their angle."""
    base = min(base_stars, len(stars.vectors_cam))
    gates = stars.gates
    chord = np.linalg.norm(stars.vectors_cam[:base, None] - stars.vectors_cam[:base], axis=2)
    angles = 2 * np.arcsin(np.minimum(chord / 2, 1.0))
    for rank_sum in range(
        1, 2 * base - 2
    ):  # sum of the two rows: the brightest pairs have the least
        for a in range(max(rank_sum - base + 1, 0), (rank_sum + 1) // 2):
            angle = float(angles[a, rank_sum - a])
            if 4 * 3 * gates.separation_rad < angle <= max_rad + gate_rad(gates, angle):
                yield a, rank_sum - a, angle


def _chance_statistics(
    stars: SearchInput, primary: Primary, star: Ints, field_tan: tuple[float, float, float, float]
) -> tuple[float, float]:
    """Chance statistics of an assumption's attitude.

    Returns the mean probability that an observed star finds a partner by chance, from the number of catalog stars of
    similar brightness in a field of uniform density and the area of the gates, and the number of catalog stars that
    are predicted in the field and not matched.
    """
    pair = star[primary.rows]
    R_cam_from_ref = primary.triad.T @ triad(stars.vectors[pair[0]], stars.vectors[pair[1]])
    predicted = stars.vectors @ R_cam_from_ref.T
    left, right, top, bottom = field_tan
    x, y, z = predicted.T
    field = (z > 0) & (x > left * z) & (x < right * z) & (y > top * z) & (y < bottom * z)
    from_midpoint_rad = 2 * np.arcsin(
        np.minimum(np.linalg.norm(predicted - primary.midpoint, axis=1) / 2, 1.0)
    )
    rows = np.flatnonzero(field & (from_midpoint_rad < primary.reach_rad))
    rows = rows[(rows != pair[0]) & (rows != pair[1])]
    difference_mag = np.abs(stars.magnitude_cam[primary.others][:, None] - stars.magnitude[rows])
    # NaN > x is False: an unknown magnitude passes.
    similar = len(rows) - (difference_mag > 3 * stars.gates.magnitude).sum(axis=1)
    cap_sr = 2 * np.pi * (1 - np.cos(primary.reach_rad))
    p = float(np.mean(1 - np.exp(-similar * primary.area_sr / cap_sr)))
    return p, max(int(field.sum()) - int((star >= 0).sum()), 0)
