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
from estimator.catalog.pair_buckets import PairCatalogue, candidates
from estimator.catalog.pair_index import PairIndex, between
from estimator.core.arrays import Floats, Ints
from estimator.core.errors import ImageError
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.identification.options import Options
from estimator.identification.published.saa_search import (
    Gates,
    Primary,
    Sky,
    contradicting,
    gate_rad,
    matched,
    primary_of,
    triad,
)

# Further pairs whose assumptions the best one must beat. If half of the pairs are of true stars, the true assumption is
# missed by all ten with probability 1e-3.
CHALLENGES = 10
MOST_ASSUMPTIONS = 100_000  # 16 MB of matches at 40 observed stars


def saa(
    vectors_cam: Floats, index: PairIndex | PairCatalogue, tolerance_rad: float, **options: Any
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
    asked = Options(**options)
    asked.fixed_focal("saa")
    count = len(vectors_cam)
    if count < MIN_MATCHES:
        return None
    sep_rad = np.sqrt(2) / 3 * tolerance_rad if asked.epsilon_sep_rad is None else asked.epsilon_sep_rad
    if not min(sep_rad, tolerance_rad, asked.epsilon_mag) > 0:
        raise ImageError(
            f"saa: tolerance {tolerance_rad}, epsilons {sep_rad} and {asked.epsilon_mag}; allowed: more than 0"
        )
    gates = Gates(float(sep_rad), tolerance_rad / 3, asked.epsilon_mag, asked.stretch)
    sky = Sky(
        np.ascontiguousarray(vectors_cam),
        asked.light(count),
        index.vectors,
        index.magnitude,
        index.cells,
        gates,
    )
    pool = Pool(sky, asked.field_tan, asked.missed_dex)
    _fill(pool, index, asked)
    return pool.answer()


class Pool:
    """All assumptions tried, in the order of the pairs, and the best of them.

    Each assumption has (N,) the catalog's row for each observed star (-1: none), its cost in squared standard
    deviations, and the number of stars matched beside the pair.
    """

    def __init__(self, sky: Sky, field_tan: tuple[float, float, float, float], missed_dex: float) -> None:
        self.sky, self.field_tan, self.missed_dex = sky, field_tan, missed_dex
        self.tried: list[tuple[Ints, Floats, Ints]] = []
        self.count, self.cost, self.star = 0, np.inf, np.full(len(sky.seen), -1, np.int32)
        self.p, self.missed = 1.0, 0.0
        self._doubts = np.zeros(3)  # assumptions that contradict the best: count, sum of matches, least cost

    def add(self, primary: Primary, assumed: tuple[Ints, Floats, Ints]) -> None:
        """Add the assumptions of one more pair, and update the best one and those that contradict it."""
        star, cost, _ = assumed
        if not len(cost):
            return
        self.tried.append(assumed)
        self.count += len(cost)
        best = int(cost.argmin())
        if cost[best] < self.cost:
            self.cost, self.star = float(cost[best]), star[best]
            self.p, self.missed = _by_chance(self.sky, primary, star[best], self.field_tan)
            # A new best: all earlier assumptions are compared with it again.
            self._doubts = np.array([0.0, 0.0, np.inf])
            for one in self.tried:
                contradicting(*one, self.star, self._doubts)
        else:
            contradicting(*assumed, self.star, self._doubts)

    @property
    def log10_chance(self) -> float:
        """log10 of the expected number of chance matches as good as the best one; 0 with too few matches.

        On a lattice false assumptions match often; their match rate is measured on those that contradict the best.
        """
        trials, hits = len(self.star) - 2, int((self.star >= 0).sum()) - 2
        if hits + 2 < MIN_MATCHES:
            return 0.0
        share = self._doubts[1] / self._doubts[0] / trials if self._doubts[0] else 0.0
        tail = log10_tail(trials, hits, max(self.p, share))
        return tail + self.missed_dex * self.missed + float(np.log10(self.count))

    def answer(self) -> StarMatch | None:
        """The best assumption, or None if it is not significant or a contradicting one is nearly as likely."""
        chance = self.log10_chance
        slack = -2 * np.log(10) * ACCEPT_LOG10_CHANCE
        if chance > ACCEPT_LOG10_CHANCE or (self._doubts[0] and self._doubts[2] < self.cost + slack):
            return None
        observed = np.flatnonzero(self.star >= 0)
        star = self.star[observed].astype(np.int64)
        cam_from_ref = quest(self.sky.seen[observed], self.sky.vectors[star], np.ones(len(star)))
        return StarMatch(observed, star, cam_from_ref, chance)


def _fill(pool: Pool, index: PairIndex | PairCatalogue, asked: Options) -> None:
    """Add the assumptions of pair after pair, until the pool's best is significant and has beaten CHALLENGES more.

    One pair is not enough: if noise moves A or B out of a gate, the truth is not among its assumptions.
    """
    sky, left = pool.sky, asked.max_triangles
    budget = min(asked.max_checks // len(sky.seen), MOST_ASSUMPTIONS)
    high_rad = index.max_rad if isinstance(index, PairCatalogue) else index.max_angle_rad
    find = candidates if isinstance(index, PairCatalogue) else between
    for a, b, angle in _primary_pairs(sky, asked.base_stars, high_rad):
        gate = gate_rad(sky.gates, angle)
        begin, end = find(index, angle - gate, angle + gate)
        if left == 0 or pool.count + end - begin > budget:
            break
        left -= 1
        primary = primary_of(sky, a, b)
        pool.add(primary, matched(sky, primary, index.pair[begin:end]))
        # Once the best is significant, only CHALLENGES more pairs are tried.
        if left >= CHALLENGES and pool.log10_chance <= ACCEPT_LOG10_CHANCE:
            left = CHALLENGES


def _primary_pairs(sky: Sky, base_stars: int, high_rad: float) -> Iterator[tuple[int, int, float]]:
    """Step 2: pairs of observed stars, the brightest first, far enough apart to determine the roll; and their angle."""
    base, gates = min(base_stars, len(sky.seen)), sky.gates
    apart = np.linalg.norm(sky.seen[:base, None] - sky.seen[:base], axis=2)
    angles = 2 * np.arcsin(np.minimum(apart / 2, 1.0))
    for both in range(1, 2 * base - 2):  # sum of the two rows: the brightest pairs have the least
        for a in range(max(both - base + 1, 0), (both + 1) // 2):
            angle = float(angles[a, both - a])
            if 4 * 3 * gates.separation_rad < angle <= high_rad + gate_rad(gates, angle):
                yield a, both - a, angle


def _by_chance(
    sky: Sky, primary: Primary, star: Ints, field_tan: tuple[float, float, float, float]
) -> tuple[float, float]:
    """Chance statistics of an assumption's attitude.

    Returns the mean probability that an observed star finds a partner by chance, from the number of catalog stars of
    similar brightness in a field of uniform density and the area of the gates, and the number of catalog stars that
    are predicted in the field and not matched.
    """
    pair = star[primary.rows]
    R_cam_from_ref = primary.triad.T @ triad(sky.vectors[pair[0]], sky.vectors[pair[1]])
    predicted = sky.vectors @ R_cam_from_ref.T
    left, right, top, bottom = field_tan
    x, y, z = predicted.T
    field = (z > 0) & (x > left * z) & (x < right * z) & (y > top * z) & (y < bottom * z)
    from_middle = 2 * np.arcsin(np.minimum(np.linalg.norm(predicted - primary.middle, axis=1) / 2, 1.0))
    rows = np.flatnonzero(field & (from_middle < primary.reach_rad))
    rows = rows[(rows != pair[0]) & (rows != pair[1])]
    off = np.abs(sky.light[primary.others][:, None] - sky.magnitude[rows])
    alike = len(rows) - (off > 3 * sky.gates.magnitude).sum(axis=1)  # NaN > x is False: unknown passes
    cap_sr = 2 * np.pi * (1 - np.cos(primary.reach_rad))
    p = float(np.mean(1 - np.exp(-alike * primary.area_sr / cap_sr)))
    return p, max(int(field.sum()) - int((star >= 0).sum()), 0)
