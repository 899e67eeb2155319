"""The pair index of the on-board catalog: a k-vector with neighbor lists.

`PairIndex` sorts star pairs by separation. The k-vector (Mortari 1997) finds all pairs with a separation in [low, high]
without a search:

1. A straight line z(k) = slope k + offset spans the sorted separations, from just below the smallest to just above the
   largest; kvector[k] is the number of pairs with a separation of at most z(k) (`k_vector`).
2. Inverting the line at `low` and `high` gives two values of k. The counts there are the ends of the range
   (`pair_range`).

The separations are nearly enough linear in their rank that the range holds only a few pairs too many. The neighbor
lists give the stars at a given separation from one star: for each star they hold the other stars of its pairs,
sorted by separation, and are searched by bisection (`neighbor_range`).
"""

from typing import NamedTuple

import numpy as np

from estimator.catalog import sky_index
from estimator.catalog.sky_index import Cells
from estimator.core.checks import Floats, Ints, Ints32
from estimator.core.errors import ImageError
from estimator.core.jit import jit


class PairIndex(NamedTuple):
    """Pairs of catalog stars closer than max_angle_rad. A named tuple, so that compiled code accepts it.

    Attributes
    ----------
    vectors
        (N, 3) unit vectors, brightest star first
    pair
        (P, 2) star rows, by increasing angle
    angle_rad
        (P,) angles of the pairs
    kvector
        (P + 2,) kvector[k] = number of pairs with angle <= slope k + offset (Mortari 1997)
    slope_rad, offset_rad
        Slope and offset of the line of the k-vector
    first
        (N + 1,) first entry of each star in `neighbor`
    neighbor
        (M,) rows of the neighbors, star after star, by increasing angle
    separation_rad
        (M,) angles of the neighbors from their star
    group
        (N,) label of each star's group (patch board); pairs within a group are left out of `pair`, as the pattern of a
        board repeats on every other board
    max_angle_rad
        Greatest angle of a pair
    magnitude
        (N,) increasing magnitudes in the camera's own scale; NaN if unknown
    cells
        Spatial grid of the stars' directions
    """

    vectors: Floats
    pair: Ints32
    angle_rad: Floats
    kvector: Ints
    slope_rad: float
    offset_rad: float
    first: Ints
    neighbor: Ints32
    separation_rad: Floats
    group: Ints
    max_angle_rad: float
    magnitude: Floats
    cells: Cells


def build(
    vectors: Floats,
    max_angle_rad: float,
    group: Ints | None = None,
    magnitude: Floats | None = None,
) -> PairIndex:
    """Index all pairs of (N, 3) unit vectors, brightest first, up to an angle.

    Parameters
    ----------
    group
        (N,) labels of stars not placed independently (LEDs of one patch board); if omitted, each star is its own group
    magnitude
        (N,) non-decreasing magnitudes; unknown if omitted

    Raises
    ------
    ImageError
        For fewer than 3 pairs, and for magnitudes that decrease or are not one for each star.
    """
    group = np.arange(len(vectors)) if group is None else np.asarray(group, np.int64)
    vectors = np.ascontiguousarray(vectors, dtype=float)
    magnitudes = (
        np.full(len(vectors), np.nan) if magnitude is None else np.asarray(magnitude, float)
    )
    if magnitudes.shape != (len(vectors),) or (np.diff(magnitudes) < 0).any():
        raise ImageError(
            f"magnitudes {magnitudes.shape} of {len(vectors)} stars; allowed: one for each, the brightest first"
        )
    # All pairs, sorted by angle.
    pair, angle = sky_index.close_pairs(vectors, max_angle_rad)
    order = np.argsort(angle, kind="stable")
    pair = np.ascontiguousarray(pair[order])
    angle = angle[order]
    # The neighbor lists keep pairs within a group.
    neighbor_lists = _neighbor_lists(pair, angle, len(vectors))
    independent = group[pair[:, 0]] != group[pair[:, 1]]
    pair = pair[independent]
    angle = angle[independent]
    if len(pair) < 3:
        raise ImageError(
            f"{len(pair)} pairs within {np.degrees(max_angle_rad):.2f} deg, not counting those of one patch board,"
            " are too few; allowed: 3 or more"
        )
    kvector, slope, offset = k_vector(angle)
    return PairIndex(
        vectors,
        pair,
        angle,
        kvector,
        slope,
        offset,
        *neighbor_lists,
        group,
        max_angle_rad,
        magnitudes,
        sky_index.build_grid(vectors),
    )


def _neighbor_lists(
    pair: Ints32, angle_rad: Floats, stars: int
) -> tuple[Ints, Ints32, Floats]:
    """The fields `first`, `neighbor` and `separation_rad` of PairIndex: each pair is in the lists of both its stars."""
    owner = np.concatenate([pair[:, 0], pair[:, 1]])
    other = np.concatenate([pair[:, 1], pair[:, 0]])
    both_angles = np.concatenate([angle_rad, angle_rad])
    by_owner = np.lexsort((both_angles, owner))
    first = np.searchsorted(owner[by_owner], np.arange(stars + 1))
    return first, other[by_owner], both_angles[by_owner]


def k_vector(angle_rad: Floats) -> tuple[Ints, float, float]:
    """The k-vector of sorted angles, with the slope and the offset of its line.

    The line runs from just below the smallest to just above the largest angle: z(k) = slope k + offset with
    k = 0 .. P + 1, and kvector[k] = #{angle <= z(k)}.

    Returns
    -------
    kvector
        (P + 2,) counts
    slope, offset
        Slope and offset of the line, rad
    """
    count = len(angle_rad)
    margin = max(1e-12, 1e-12 * angle_rad[-1])
    low = angle_rad[0] - margin
    high = angle_rad[-1] + margin
    slope = (high - low) / (count + 1)
    z = slope * np.arange(count + 2) + low
    return np.searchsorted(angle_rad, z, side="right"), float(slope), float(low)


@jit
def pair_range(index: PairIndex, low_rad: float, high_rad: float) -> tuple[int, int]:
    """The half-open range of pairs that holds every angle in [low, high].

    Mortari's formula, j_b = floor((low - q) / m) and j_t = ceil((high - q) / m) with the slope m and the offset q, may
    include one or two pairs outside the range at either end (SHEFEX's eq. 5 has the signs of the error and of q
    wrong). The range is widened by a thousandth of a step on each side, so that rounding cannot exclude an angle on
    a node of the line.
    """
    last = len(index.kvector) - 1
    k_low = int(np.floor((low_rad - index.offset_rad) / index.slope_rad - 1e-3))
    k_high = int(np.ceil((high_rad - index.offset_rad) / index.slope_rad + 1e-3))
    if k_high < 0 or k_low > last:
        return 0, 0
    begin = index.kvector[k_low] if k_low >= 0 else 0
    end = index.kvector[k_high] if k_high <= last else len(index.angle_rad)
    return begin, end


@jit
def magnitude_range(index: PairIndex, magnitude: float, gate: float) -> tuple[int, int]:
    """The half-open range of rows within `gate` of a magnitude; all rows if magnitude or gate is unknown."""
    if not np.isfinite(gate) or np.isnan(magnitude) or np.isnan(index.magnitude[0]):
        return 0, len(index.magnitude)
    begin = int(np.searchsorted(index.magnitude, magnitude - gate))
    return begin, int(np.searchsorted(index.magnitude, magnitude + gate, side="right"))


@jit
def neighbor_range(
    index: PairIndex, star: int, low_rad: float, high_rad: float
) -> tuple[int, int]:
    """The half-open range in `neighbor` of a star's neighbors at the angles [low, high]."""
    last = index.first[star + 1]
    begin = first_from(index.separation_rad, index.first[star], last, low_rad)
    end = first_from(index.separation_rad, begin, last, np.nextafter(high_rad, np.inf))
    return begin, end


@jit
def first_from(values: Floats, begin: int, end: int, least: float) -> int:
    """The first row in [begin, end) of sorted values that is at least `least`, by bisection; `end` if there is none."""
    return begin + int(np.searchsorted(values[begin:end], least))
