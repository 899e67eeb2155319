"""Stellar Attitude Acquisition, the angle method of Boeing and of AFIT's thesis: a pair, then a direct match.

Needelman, Li & Wu 2005, cited by Padro 2012, sections 2.4.2 to 2.4.5 and 3.6.4. A primary pair of observed stars is
assumed to be each catalog pair of the same angle; each assumption gives an attitude, at which all other stars are
matched, and a cost in squared standard deviations. The assumption of the least cost is accepted if its match is
significant and no contradicting assumption is nearly as good. `saa_search` has the compiled steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.solvers import quest
from estimator.catalog.pair_index import PairCatalog, PairIndex, candidates, pair_range
from estimator.catalog.sky_index import Cells, within
from estimator.core.checks import Floats, ImageError, Ints
from estimator.core.jit import jit
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.identification.direct_match import angle
from estimator.identification.solver_options import Options

# SAA's steps 3 to 7, compiled: every assumption of a primary pair, and the direct match of each.
# See `saa`.


# Cost of an observed star without a partner, in squared standard deviations; a bad partner costs no more. 16 is four
# standard deviations: it corresponds to a probability of one in three thousand that a star has no partner.
UNMATCHED_COST = 16.0


class Gates(NamedTuple):
    """Standard deviations of an angle between stars, a direction, and a magnitude. A gate is three of them.

    Attributes
    ----------
    stretch
        Stretch * angle is added to the gate of an angle
    """

    separation_rad: float
    position_rad: float
    magnitude: float
    stretch: float


class SearchInput(NamedTuple):
    """The observed stars, brightest first, the catalog, and the gates.

    Attributes
    ----------
    vectors_cam, vectors
        (N, 3) observed unit vectors, camera axes;  (M, 3) of the catalog, reference axes
    magnitude_cam, magnitude
        (N,), (M,) their magnitudes, NaN if unknown
    cells
        Spatial grid of the catalog's directions
    """

    vectors_cam: Floats
    magnitude_cam: Floats
    vectors: Floats
    magnitude: Floats
    cells: Cells
    gates: Gates


class Primary(NamedTuple):
    """The primary pair A, B, and the geometry of the X other stars about it.

    Attributes
    ----------
    rows, triad
        (2,) rows of the observed stars;  (3, 3) see `triad`
    midpoint
        (3,) unit vector halfway
    others
        (X,) rows
    corner_rad, gate_rad
        (2, X) their angles from A and from B, and the gates of these
    sigma_rad, radius_rad
        (X,) standard deviation of the predicted position and its gate
    area_sr
        (X,) area inside all gates
    reach_rad
        Greatest angle of an observed star from the midpoint, with a gate added
    """

    rows: Ints
    triad: Floats
    midpoint: Floats
    others: Ints
    corner_rad: Floats
    gate_rad: Floats
    sigma_rad: Floats
    radius_rad: Floats
    area_sr: Floats
    reach_rad: float


@jit
def gate_rad(gates: Gates, angle_rad: float) -> float:
    """Tolerance of an angle: three standard deviations plus the stretch."""
    return 3 * gates.separation_rad + gates.stretch * angle_rad


@jit
def triad(a: Floats, b: Floats) -> Floats:
    """Rows: unit vectors along a + b, a - b and their cross product.

    The rotation that maps one pair's triad to another's is Wahba's solution for two stars of equal weight."""
    rows = np.empty((3, 3))
    rows[0] = a + b
    rows[1] = a - b
    rows[2, 0] = b[1] * a[2] - b[2] * a[1]
    rows[2, 1] = b[2] * a[0] - b[0] * a[2]
    rows[2, 2] = b[0] * a[1] - b[1] * a[0]
    for n in range(3):
        rows[n] /= np.sqrt(rows[n, 0] ** 2 + rows[n, 1] ** 2 + rows[n, 2] ** 2)
    return rows


@jit
def build_primary(stars: SearchInput, row_a: int, row_b: int) -> Primary:
    """The geometry that the direct match needs of an observed pair; it is the same for all its assumptions.

    The thesis's position gate is 3 epsilon_position everywhere. Needelman's epsilon_position(S) includes the error of
    the pair's attitude: with noise sigma, a pair of separation b rotates by sqrt(2) sigma / b and shifts by
    sigma / sqrt(2). At distance d from its middle the variance is sigma^2 (1 + 1/2 + 2 d^2 / b^2), which is used here.
    """
    gates = stars.gates
    vectors_cam = stars.vectors_cam
    a = vectors_cam[row_a]
    b = vectors_cam[row_b]
    count = len(vectors_cam) - 2
    midpoint = (a + b) / np.sqrt(np.sum((a + b) ** 2))
    base_rad = angle(a, b)
    reach_rad = 0.0
    others = np.empty(count, np.int64)
    corner = np.empty((2, count))
    gate = np.empty((2, count))
    sigma = np.empty(count)
    radius = np.empty(count)
    area = np.empty(count)
    k = 0
    for n in range(len(vectors_cam)):
        x = vectors_cam[n]
        from_midpoint_rad = angle(x, midpoint)
        reach_rad = max(reach_rad, from_midpoint_rad)
        if n in (row_a, row_b):
            continue
        others[k] = n
        corner[0, k] = angle(x, a)
        corner[1, k] = angle(x, b)
        gate[0, k] = gate_rad(gates, corner[0, k])
        gate[1, k] = gate_rad(gates, corner[1, k])
        sigma[k] = gates.position_rad * np.sqrt(1.5 + 2 * (from_midpoint_rad / base_rad) ** 2)
        radius[k] = 3 * sigma[k] + gates.stretch * from_midpoint_rad
        # The rings about A and B, of the gates' widths, cross at X in a rhombus; its angle is that of A and B seen
        # from X.
        sides = max(corner[0, k] * corner[1, k], 1e-20)
        sine = np.sqrt(np.sum(np.cross(a - x, b - x) ** 2)) / sides
        rhombus = 4 * gate[0, k] * gate[1, k] / max(sine, 1e-9)
        area[k] = min(np.pi * radius[k] ** 2, rhombus)
        k += 1
    rows = np.array([row_a, row_b])
    reach_rad += gate_rad(gates, 0.0)
    return Primary(
        rows, triad(a, b), midpoint, others, corner, gate, sigma, radius, area, reach_rad
    )


@jit
def magnitude_cost(stars: SearchInput, observed: int, star: int) -> float:
    """Squared deviation of a magnitude in standard deviations, inf beyond three; 0 if it is unknown."""
    deviation = (stars.magnitude_cam[observed] - stars.magnitude[star]) / stars.gates.magnitude
    if np.isnan(deviation):
        return 0.0
    return deviation * deviation if abs(deviation) <= 3 else np.inf


@jit
def match_assumptions(
    stars: SearchInput, primary: Primary, pairs: NDArray
) -> tuple[NDArray, Floats, Ints]:
    """Steps 3 to 7: every assumption from the catalog's (K, 2) pairs, in both orders.

    Returns for each assumption (N,) catalog rows of the observed stars (-1: none), the cost, and the number of matches
    beside the pair. Pairs outside the gate, at the ends of a bucket or of a k-vector step, are skipped.
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
        misfit = abs(angle(stars.vectors[pairs[p, 0]], stars.vectors[pairs[p, 1]]) - separation_rad)
        if misfit > gate:
            continue
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
            total = (misfit / stars.gates.separation_rad) ** 2 + cost_a + cost_b
            _partners(stars, primary, first, second, nearby, partner, partner_cost)
            matches[count] = _remove_duplicates(partner, partner_cost)
            for k in range(len(partner)):
                star[count, primary.others[k]] = partner[k]
                total += min(partner_cost[k], UNMATCHED_COST)
            cost[count] = total
            count += 1
    return star[:count], cost[:count], matches[:count]


@jit
def _partners(
    stars: SearchInput,
    primary: Primary,
    first: int,
    second: int,
    nearby: NDArray,
    partner: NDArray,
    partner_cost: Floats,
) -> None:
    """Steps 5 and 6: the pair's attitude, and for each other star its partner (-1: none) and its cost, in place.

    Section 2.4.5's four conditions: magnitude, position, and the angles to A and to B. The position distinguishes a
    star from its mirror image about the line A B, which the two angles cannot.
    """
    triad_ref = triad(stars.vectors[first], stars.vectors[second])
    R = np.empty((3, 3))  # R_ref_from_cam
    for i in range(3):
        for j in range(3):
            R[i, j] = (
                triad_ref[0, i] * primary.triad[0, j]
                + triad_ref[1, i] * primary.triad[1, j]
                + triad_ref[2, i] * primary.triad[2, j]
            )
    for k in range(len(primary.others)):
        u, v, w = stars.vectors_cam[primary.others[k]]
        x = R[0, 0] * u + R[0, 1] * v + R[0, 2] * w
        y = R[1, 0] * u + R[1, 1] * v + R[1, 2] * w
        z = R[2, 0] * u + R[2, 1] * v + R[2, 2] * w
        chord = 2 * np.sin(min(primary.radius_rad[k], np.pi) / 2)
        partner[k] = -1
        partner_cost[k] = UNMATCHED_COST
        least = np.inf
        for s in nearby[: within(stars.cells, stars.vectors, x, y, z, chord, nearby)]:
            if s in (first, second):
                continue
            cost = magnitude_cost(stars, primary.others[k], s)
            misfit_a = abs(primary.corner_rad[0, k] - angle(stars.vectors[s], stars.vectors[first]))
            misfit_b = abs(
                primary.corner_rad[1, k] - angle(stars.vectors[s], stars.vectors[second])
            )
            if misfit_a > primary.gate_rad[0, k] or misfit_b > primary.gate_rad[1, k]:
                continue
            cost += (misfit_a**2 + misfit_b**2) / stars.gates.separation_rad**2
            dx = stars.vectors[s, 0] - x
            dy = stars.vectors[s, 1] - y
            dz = stars.vectors[s, 2] - z
            # The position decides between several partners, but is not part of the assumption's cost.
            position_cost = (dx * dx + dy * dy + dz * dz) / primary.sigma_rad[k] ** 2
            if cost + position_cost < least:
                least = cost + position_cost
                partner[k] = s
                partner_cost[k] = cost


@jit
def _remove_duplicates(partner: NDArray, partner_cost: Floats) -> int:
    """If two observed stars have the same partner, the one of less cost keeps it; returns the number of matches."""
    count = 0
    for k in range(len(partner)):
        if partner[k] < 0:
            continue
        count += 1
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
    """Accumulate the assumptions that identify an observed star differently from the best one.

    Parameters
    ----------
    contradictions
        (3,) their number, the sum of their matches and their least cost, updated in place
    """
    for n in range(len(cost)):
        for m in range(len(best)):
            if star[n, m] >= 0 and best[m] >= 0 and star[n, m] != best[m]:
                contradictions[0] += 1
                contradictions[1] += matches[n]
                contradictions[2] = min(contradictions[2], cost[n])
                break


# Further pairs whose assumptions the best one must beat. If half of the pairs are of true stars, the true assumption is
# missed by all ten with probability 1e-3.
RIVAL_PAIRS = 10
MAX_ASSUMPTIONS = 100_000  # 16 MB of matches at 40 observed stars


def saa(
    vectors_cam: Floats, index: PairIndex | PairCatalog, tolerance_rad: float, **options: Any
) -> StarMatch | None:
    """SAA (Needelman, Li & Wu 2005; Padro 2012, 2.4.2): two bright stars, all pairs like them, all other stars.

    Steps 2 to 8 of 2.4.2, except that the search does not stop at the first assumption that passes: with the
    assumptions of ten more pairs, the best must be significant (1e-5), and 1e5 times as likely as the next one that
    identifies a star differently. Otherwise returns None. A lattice of LEDs that is not in the catalog is sometimes
    identified as one that is.

    Parameters
    ----------
    vectors_cam
        (N, 3) observed unit vectors, brightest first
    index
        Pairs in buckets, or a k-vector index
    tolerance_rad
        Of a direction, 3 epsilon_position
    options
        Those of `Options`: magnitudes are used if the index has them too; epsilon_sep_rad is
        sqrt(2) / 3 of the tolerance if None; max_triangles is the limit of observed pairs
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
    for a, b, angle_rad in _primary_pairs(stars, settings.base_stars, max_rad):
        gate = gate_rad(stars.gates, angle_rad)
        begin, end = find_pairs(index, angle_rad - gate, angle_rad + gate)
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
