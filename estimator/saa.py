"""Stellar Attitude Acquisition, the angle method of Boeing and of AFIT's thesis: a pair, then a direct match.

Needelman, Li & Wu 2005 as told by Padro 2012, sections 2.4.2 to 2.4.6 and 3.6.4. The pair catalogue holds no angles,
only which two stars: pairs lie in buckets of equal width in angle, unsorted within, and a table says where each
bucket begins. That halves the memory and needs no search; a few pairs too many are looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimator.attitude import quest
from estimator.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.index import PairIndex, between
from estimator.types import BadImage, Floats, Ints, StarMatch

ARCSEC_RAD = np.pi / 648_000
WIDTH_RAD = 100 * ARCSEC_RAD  # the thesis's (section 3.7.3)
# What an observed star without a partner costs, in squared standard deviations; a bad partner costs no more. Four
# of them: a match lost to noise or to a reflection is then as likely as one in three thousand.
UNMATCHED = 16.0
CHALLENGES = (
    10  # pairs that the best assumption must stand against; of two true stars each time in two, 1e-3 is left
)


class PairCatalogue(NamedTuple):
    """Stars, and pairs of them in buckets of angle.

    vectors   : (N, 3) unit;  magnitude : (N,) any scale
    pair      : (P, 2) rows, bucket after bucket, unsorted within
    table     : (M + 1,) where each bucket begins in `pair`; the last entry is P
    max_rad   : upper end of the last bucket; bucket i of 0 .. M - 1 begins at max_rad - (M - i) width_rad
    """

    vectors: Floats
    magnitude: Floats
    pair: NDArray[np.int32]
    table: Ints
    max_rad: float
    width_rad: float


def bucketed(
    vectors: Floats,
    magnitude: Floats,
    width_rad: float = WIDTH_RAD,
    range_rad: tuple[float, float] | None = None,
    magnitudes: tuple[float, float] = (-np.inf, np.inf),
) -> PairCatalogue:
    """Every pair of (N, 3) unit vectors whose angle and whose two magnitudes (N,) are in range (section 2.4.6).

    range_rad : of the angles, both ends included; that of the pairs there are if left out
    Buckets are counted back from the greatest angle. Raises BadImage where there is no pair.
    """
    vectors = np.ascontiguousarray(vectors, dtype=float)
    if not width_rad > 0:
        raise BadImage(f"bucket width {width_rad} rad: allowed is more than 0")
    low, high = range_rad or (0.0, np.pi)
    # A hair wider than the range, which the exact angles then cut.
    chord = 2 * np.sin(min(high, np.pi) / 2) + 1e-12
    pair = cKDTree(vectors).query_pairs(chord, output_type="ndarray").astype(np.int32)
    angle = _angle(vectors[pair[:, 0]], vectors[pair[:, 1]])
    shines = (magnitude >= magnitudes[0]) & (magnitude <= magnitudes[1])
    kept = (angle >= low) & (angle <= high) & shines[pair].all(axis=1)
    pair, angle = pair[kept], angle[kept]
    if not len(pair):
        raise BadImage(f"no pair of stars from {np.degrees(low):.3f} to {np.degrees(high):.3f} deg")
    if range_rad is None:
        low, high = float(angle.min()), float(angle.max())
    # A range of whole buckets is one bucket more by rounding, but for the 1e-9.
    buckets = max(int(np.ceil((high - low) / width_rad - 1e-9)), 1)
    bucket = bucket_of(angle, high, width_rad, buckets)
    table = np.concatenate([[0], np.cumsum(np.bincount(bucket, minlength=buckets))])
    pair = np.ascontiguousarray(pair[np.argsort(bucket, kind="stable")])
    return PairCatalogue(vectors, np.asarray(magnitude, float), pair, table, float(high), width_rad)


def bucket_of(angle_rad: Floats, max_rad: float, width_rad: float, buckets: int) -> Ints:
    """Which bucket, 0 .. buckets - 1, each angle belongs to; what lies outside goes to the first or the last.

    Each step of it grows with the angle, in floating point too: an angle inside a gate is in a bucket between
    those of the gate's ends, whatever is rounded.
    """
    number = np.floor(buckets - (max_rad - np.asarray(angle_rad)) / width_rad)
    return np.clip(number, 0, buckets - 1).astype(np.int64)


def candidates(catalogue: PairCatalogue, low_rad: float, high_rad: float) -> tuple[int, int]:
    """Half-open range of pairs that holds every angle in [low, high], and a bucket's rest at either end.

    From the bucket with the greatest lower end below `low` to before that with the least above `high` (eq. 12).
    """
    buckets = len(catalogue.table) - 1
    ends = np.array([low_rad, high_rad])
    first, last = bucket_of(ends, catalogue.max_rad, catalogue.width_rad, buckets)
    return int(catalogue.table[first]), int(catalogue.table[last + 1])


class Gates(NamedTuple):
    """One standard deviation of what is compared: an angle, a place's angle, a magnitude. Gates are three of them.

    stretch : added to the gate of an angle, times the angle;  field_tan, missed_dex : as in `saa`
    """

    separation_rad: float
    position_rad: float
    magnitude: float
    stretch: float
    field_tan: tuple[float, float, float, float]
    missed_dex: float


class Search(NamedTuple):
    """What is compared with what: observed stars, brightest first, the catalogue's, and how near is near.

    seen, vectors : (N, 3), (M, 3) unit vectors, camera and reference;  seen_mag, magnitude : zeros where unknown
    """

    seen: Floats
    seen_mag: Floats
    vectors: Floats
    magnitude: Floats
    pairs: PairIndex | PairCatalogue
    gates: Gates


class Primary(NamedTuple):
    """The primary pair A, B, and where it leaves the other stars X.

    rows, triad : (2,) of the observed stars, (3, 3) see `_triad`;  middle : (3,) unit, halfway
    others      : (X,) rows;  vectors : (X, 3) theirs;  corner_rad : (2, X) their angles from A and from B
    sigma_rad, radius_rad : (X,) deviation of their predicted places and its gate;  area_sr : (X,) what all gates leave
    """

    rows: Ints
    triad: Floats
    middle: Floats
    others: Ints
    vectors: Floats
    corner_rad: Floats
    sigma_rad: Floats
    radius_rad: Floats
    area_sr: Floats


class Hypothesis(NamedTuple):
    """An assumed pair with what the direct match made of it.

    star       : (N,) the catalogue's row for each observed star, -1 for none
    cost       : of all observed stars, in squared standard deviations
    p          : how likely an even field gives an observed star a partner
    missed_dex : what the stars that should have been in the field and were not cost
    """

    star: Ints
    cost: float
    p: float
    missed_dex: float


def saa(
    vectors_cam: Floats,
    index: PairIndex | PairCatalogue,
    tolerance_rad: float,
    stretch: float = 0.0,
    zooms: bool = False,
    max_triangles: int = 300,
    max_checks: int = 100_000,
    base_stars: int = 20,
    missed_dex: float = 0.0,
    field_tan: tuple[float, float, float, float] = (-1.0, 1.0, -1.0, 1.0),
    magnitude: Floats | None = None,
    epsilon_mag: float = np.inf,
    epsilon_sep_rad: float | None = None,
) -> StarMatch | None:
    """SAA (Needelman, Li & Wu 2005; Padro 2012, 2.4.2): two bright stars, all pairs like them, all other stars.

    vectors_cam   : (N, 3) observed unit vectors, brightest first;  magnitude : (N,) theirs, in the index's scale
    index         : pairs in buckets; or a k-vector, which has no magnitudes
    tolerance_rad : 3 epsilon_position: of a direction
    epsilon_sep_rad, epsilon_mag : one standard deviation; an angle's is sqrt(2) / 3 of the tolerance if left out
    stretch, base_stars, missed_dex, field_tan : as for identify.pyramid;  zooms : must be off, angles are all it has
    max_triangles, max_checks : observed pairs tried, and assumptions, before giving up
    Steps 2 to 8 of 2.4.2, but that it does not stop at the first assumption that passes: of all those of ten more
    pairs, the best must be beyond chance (1e-5), and 1e5 times as likely as the next that names a star otherwise.
    Where it is not, the answer is None. A lattice that is not in the catalogue is sometimes taken for one that is.
    """
    if zooms:
        raise BadImage("saa: the focal length is uncertain; allowed: a calibrated camera, or pyramid")
    if len(vectors_cam) < MIN_MATCHES:
        return None
    sep_rad = np.sqrt(2) / 3 * tolerance_rad if epsilon_sep_rad is None else epsilon_sep_rad
    if not min(sep_rad, tolerance_rad, epsilon_mag) > 0:
        raise BadImage(
            f"saa: tolerance {tolerance_rad}, epsilons {sep_rad} and {epsilon_mag}; allowed: more than 0"
        )
    gates = Gates(sep_rad, tolerance_rad / 3, epsilon_mag, stretch, field_tan, missed_dex)
    if isinstance(index, PairCatalogue) and magnitude is not None:
        magnitudes = magnitude, index.magnitude
    else:
        magnitudes = np.zeros(len(vectors_cam)), np.zeros(len(index.vectors))
    search = Search(vectors_cam, magnitudes[0], index.vectors, magnitudes[1], index, gates)
    return _search(search, base_stars, max_triangles, max_checks)


def _search(search: Search, base_stars: int, max_pairs: int, max_checks: int) -> StarMatch | None:
    """Every assumption of pair after pair in one pool, until its best has stood against CHALLENGES more pairs.

    If noise carries A or B out of a gate, the truth is not among a pair's assumptions: one pair is not enough.
    """
    pool: list[Hypothesis] = []
    left = max_pairs
    for a, b in _primary_pairs(search, base_stars):
        assumed = _assumptions(search, a, b)
        if left == 0 or len(pool) + len(assumed) > max_checks:
            break
        left -= 1
        primary = _primary(search, a, b)
        pool += [_direct_match(search, primary, stars) for stars in assumed]
        if left >= CHALLENGES and _proved(pool):
            left = CHALLENGES
    proved = _proved(pool)
    if proved is None:
        return None
    best, chance = proved
    slack = -2 * np.log(10) * ACCEPT_LOG10_CHANCE
    if (np.array([h.cost for h in pool])[_contradict(pool, best)] < best.cost + slack).any():
        return None
    observed = np.flatnonzero(best.star >= 0)
    star = best.star[observed]
    cam_from_ref = quest(search.seen[observed], search.vectors[star], np.ones(len(star)))
    return StarMatch(observed, star, cam_from_ref, chance)


def _proved(pool: list[Hypothesis]) -> tuple[Hypothesis, float] | None:
    """The best hypothesis and log10 of how often chance does as well in such a search, if that is below 1e-5.

    On a lattice a false assumption finds partners often: how often is measured on those that contradict the best.
    """
    if not pool:
        return None
    best = min(pool, key=lambda h: h.cost)
    trials, hits = len(best.star) - 2, int((best.star >= 0).sum()) - 2
    lost = [(pool[n].star >= 0).sum() - 2 for n in np.flatnonzero(_contradict(pool, best))]
    share = float(np.mean(lost)) / trials if lost else 0.0
    chance = log10_tail(trials, hits, max(best.p, share)) + best.missed_dex + float(np.log10(len(pool)))
    return (best, chance) if hits + 2 >= MIN_MATCHES and chance <= ACCEPT_LOG10_CHANCE else None


def _contradict(pool: list[Hypothesis], best: Hypothesis) -> NDArray[np.bool_]:
    """Which hypotheses give an observed star another name than the best does."""
    star = np.array([h.star for h in pool])
    return ((star >= 0) & (best.star >= 0) & (star != best.star)).any(axis=1)


def _angle(u: Floats, v: Floats) -> Floats:
    """Angles between unit vectors, along the last axis, by the half-chord: exact when small."""
    return 2 * np.arcsin(np.minimum(np.linalg.norm(u - v, axis=-1) / 2, 1.0))


def _primary_pairs(search: Search, base_stars: int) -> Iterator[tuple[int, int]]:
    """Step 2: pairs of observed stars, the brightest first, far enough apart to fix a roll."""
    base, pairs, gates = min(base_stars, len(search.seen)), search.pairs, search.gates
    high = pairs.max_rad if isinstance(pairs, PairCatalogue) else pairs.max_angle_rad
    for both in range(1, 2 * base - 2):
        for a in range(max(both - base + 1, 0), (both + 1) // 2):
            angle = float(_angle(search.seen[a], search.seen[both - a]))
            if 4 * 3 * gates.separation_rad < angle <= high + _gate(gates, angle):
                yield a, both - a


def _gate(gates: Gates, angle_rad: Any) -> Any:
    return 3 * gates.separation_rad + gates.stretch * angle_rad


def _assumptions(search: Search, a: int, b: int) -> Ints:
    """Steps 3, 4 and 7: (K, 2) catalogue rows that A and B may be, either way round."""
    angle = float(_angle(search.seen[a], search.seen[b]))
    gate = _gate(search.gates, angle)
    pairs, low, high = search.pairs, angle - gate, angle + gate
    begin, end = (
        candidates(pairs, low, high) if isinstance(pairs, PairCatalogue) else between(pairs, low, high)
    )
    pair = pairs.pair[begin:end].astype(np.int64)
    # The ends of a bucket, or of the k-vector's step, hold pairs outside the gate.
    apart = _angle(search.vectors[pair[:, 0]], search.vectors[pair[:, 1]])
    pair = pair[np.abs(apart - angle) <= gate]
    stars = np.concatenate([pair, pair[:, ::-1]])
    off = np.abs(search.magnitude[stars] - search.seen_mag[[a, b]])
    return stars[(off <= 3 * search.gates.magnitude).all(axis=1)]


def _triad(a: Floats, b: Floats) -> Floats:
    """Rows: unit vectors along a + b, a - b and their cross product.

    To carry one pair's onto another's is Wahba's best rotation for two stars of equal weight."""
    rows = np.array([a + b, a - b, np.cross(b, a)])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _primary(search: Search, row_a: int, row_b: int) -> Primary:
    """What the direct match needs of the pair, whatever it is assumed to be.

    The thesis's position gate is 3 epsilon_position everywhere; Needelman's epsilon_position(S) knows that a pair
    b apart turns by sqrt(2) sigma / b and shifts by sigma / sqrt(2) with its noise sigma: at d from its middle
    sigma^2 (1 + 1/2 + 2 d^2 / b^2), which is what is used here.
    """
    gates, rows = search.gates, np.array([row_a, row_b])
    a, b = search.seen[rows]
    others = np.delete(np.arange(len(search.seen)), rows)
    x, middle = search.seen[others], (a + b) / np.linalg.norm(a + b)
    from_middle, corner_rad = _angle(x, middle), np.array([_angle(x, a), _angle(x, b)])
    sigma_rad = gates.position_rad * np.sqrt(1.5 + 2 * (from_middle / _angle(a, b)) ** 2)
    radius_rad = 3 * sigma_rad + gates.stretch * from_middle
    # Two rings about A and B cross at the angle that X sees them under: a rhombus.
    sides = np.maximum(corner_rad.prod(axis=0), 1e-20)
    sine = np.linalg.norm(np.cross(a - x, b - x), axis=1) / sides
    rhombus = 4 * _gate(gates, corner_rad).prod(axis=0) / np.maximum(sine, 1e-9)
    area_sr = np.minimum(np.pi * radius_rad**2, rhombus)
    return Primary(rows, _triad(a, b), middle, others, x, corner_rad, sigma_rad, radius_rad, area_sr)


def _direct_match(search: Search, primary: Primary, stars: Ints) -> Hypothesis:
    """Steps 5 and 6: the pair's attitude, the stars that it predicts, and which of them are there."""
    gates, others = search.gates, primary.others
    R_cam_from_ref = primary.triad.T @ _triad(*search.vectors[stars])
    predicted = search.vectors @ R_cam_from_ref.T
    left, right, top, bottom = gates.field_tan
    x, y, z = predicted.T
    field = (z > 0) & (x > left * z) & (x < right * z) & (y > top * z) & (y < bottom * z)
    reach_rad = _angle(search.seen, primary.middle).max() + _gate(gates, 0.0)
    near = field & (_angle(predicted, primary.middle) < reach_rad)
    near[stars] = False
    rows = np.flatnonzero(near)
    light = _magnitude_cost(search, others, rows)
    cost, position = _costs(search, primary, stars, rows, predicted[rows])
    hit, partner, spent = _each_once(light + cost, position)
    total = spent.sum() + UNMATCHED * (len(others) - len(hit)) + _pair_cost(search, primary.rows, stars)
    # By chance: the stars of like brightness that an even field would have within the gates.
    cap_sr = 2 * np.pi * (1 - np.cos(reach_rad))
    alike = np.isfinite(light).sum(axis=1)
    p = float(np.mean(1 - np.exp(-alike * primary.area_sr / cap_sr)))
    missed_dex = gates.missed_dex * max(int(field.sum()) - len(hit) - 2, 0)
    star = np.full(len(search.seen), -1)
    star[primary.rows], star[others[hit]] = stars, rows[partner]
    return Hypothesis(star, float(total), p, missed_dex)


def _costs(
    search: Search, primary: Primary, stars: Ints, rows: Ints, predicted: Floats
) -> tuple[Floats, Floats]:
    """(X, n) squared deviations of the angles to A and to B, infinite outside a gate; (X, n) those of position.

    Conditions 2 to 4 of section 2.4.5; rows and predicted are the n catalogue stars and where they should be seen.
    """
    off_rad = _angle(primary.vectors[:, None], predicted)
    cost = np.where(off_rad <= primary.radius_rad[:, None], 0.0, np.inf)
    for angle, star in zip(primary.corner_rad, stars, strict=True):
        slip = np.abs(angle[:, None] - _angle(search.vectors[rows], search.vectors[star]))
        inside = slip <= _gate(search.gates, angle)[:, None]
        cost += np.where(inside, (slip / search.gates.separation_rad) ** 2, np.inf)
    return cost, (off_rad / primary.sigma_rad[:, None]) ** 2


def _magnitude_cost(search: Search, others: Ints, rows: Ints) -> Floats:
    """(X, n) squared deviations of magnitude, infinite beyond three; 0 where none are known."""
    off = (search.seen_mag[others][:, None] - search.magnitude[rows]) / search.gates.magnitude
    return np.where(np.abs(off) <= 3, off**2, np.inf)


def _pair_cost(search: Search, pair: Ints, stars: Ints) -> float:
    """Squared deviations of the primary pair itself, each star's no more than one without a partner has."""
    slip = _angle(*search.seen[pair]) - _angle(*search.vectors[stars])
    magnitudes = np.diag(_magnitude_cost(search, pair, stars))
    return float((slip / search.gates.separation_rad) ** 2 + np.minimum(magnitudes, UNMATCHED).sum())


def _each_once(cost: Floats, position: Floats) -> tuple[Ints, Ints, Floats]:
    """Which observed stars have a partner, its column, and the cost; a star that two want goes to the cheaper.

    Position settles what the angles to two stars cannot tell: a star from its mirror image in their line.
    """
    if not cost.size:
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    nearest = (cost + position).argmin(axis=1)
    least = cost[np.arange(len(cost)), nearest]
    by_cost = np.argsort(least, kind="stable")
    _, first = np.unique(nearest[by_cost], return_index=True)
    hit = np.sort(by_cost[first])
    hit = hit[np.isfinite(least[hit])]
    return hit, nearest[hit], np.minimum(least[hit], UNMATCHED)
