"""Boeing's pair catalog: star pairs grouped into buckets of separation, without storing the separations.

Needelman, Li & Wu 2005, as described by Padro 2012, section 2.4.6. Buckets have equal width in angle, pairs within a
bucket are unsorted, and a table gives the first pair of each bucket. A lookup computes the bucket numbers of the two
ends of the range, without a search, and leaving out the angles halves the memory. The price: the range returned is
rounded outwards to whole buckets, so the caller has to check a few pairs too many.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimator.catalog import spatial_grid
from estimator.catalog.spatial_grid import Cells
from estimator.core.arrays import Floats, Ints
from estimator.core.constants import ARCSEC_RAD
from estimator.core.errors import ImageError
from estimator.core.jit import jit

BUCKET_WIDTH_RAD = 100 * ARCSEC_RAD  # from the thesis (Padro 2012, section 3.7.3)


class PairCatalog(NamedTuple):
    """Stars, and their pairs in buckets of separation.

    vectors   : (N, 3) unit;  magnitude : (N,) any scale
    pair      : (P, 2) star rows, bucket after bucket, unsorted within a bucket
    table     : (M + 1,) first pair of each bucket; the last entry is P
    max_rad   : upper end of the last bucket; bucket i of 0 .. M - 1 begins at max_rad - (M - i) width_rad
    cells     : the stars by direction; Boeing sorts them by declination instead
    """

    vectors: Floats
    magnitude: Floats
    pair: NDArray[np.int32]
    table: Ints
    max_rad: float
    width_rad: float
    cells: Cells


def build_pair_catalog(
    vectors: Floats,
    magnitude: Floats,
    width_rad: float = BUCKET_WIDTH_RAD,
    range_rad: tuple[float, float] | None = None,
    magnitudes: tuple[float, float] = (-np.inf, np.inf),
) -> PairCatalog:
    """Build the catalog of pairs of (N, 3) unit vectors whose angle and magnitudes (N,) are in range (section 2.4.6).

    range_rad : range of angles, both ends included; if omitted, that of the pairs found
    Buckets are counted back from the largest angle. Raises ImageError where there is no pair.
    """
    vectors = np.ascontiguousarray(vectors, dtype=float)
    if not width_rad > 0:
        raise ImageError(f"bucket width {width_rad} rad; allowed: more than 0")
    low, high = range_rad or (0.0, np.pi)
    # Search slightly beyond the range, then select by the exact angles.
    chord = 2 * np.sin(min(high, np.pi) / 2) + 1e-12
    pair = cKDTree(vectors).query_pairs(chord, output_type="ndarray").astype(np.int32)
    angle = 2 * np.arcsin(np.linalg.norm(vectors[pair[:, 0]] - vectors[pair[:, 1]], axis=1) / 2)
    in_magnitude_range = (magnitude >= magnitudes[0]) & (magnitude <= magnitudes[1])
    selected = (angle >= low) & (angle <= high) & in_magnitude_range[pair].all(axis=1)
    pair = pair[selected]
    angle = angle[selected]
    if not len(pair):
        raise ImageError(
            f"no pair of stars from {np.degrees(low):.3f} to {np.degrees(high):.3f} deg"
        )
    if range_rad is None:
        low = float(angle.min())
        high = float(angle.max())
    # The 1e-9 keeps rounding from adding a bucket where the range is a whole number of buckets.
    buckets = max(int(np.ceil((high - low) / width_rad - 1e-9)), 1)
    bucket = bucket_of(angle, high, width_rad, buckets)
    table = np.concatenate([[0], np.cumsum(np.bincount(bucket, minlength=buckets))])
    pair = np.ascontiguousarray(pair[np.argsort(bucket, kind="stable")])
    magnitude = np.ascontiguousarray(magnitude, dtype=float)
    return PairCatalog(
        vectors, magnitude, pair, table, float(high), width_rad, spatial_grid.build(vectors)
    )


@jit
def bucket_of(angle_rad: Floats, max_rad: float, width_rad: float, buckets: int) -> Ints:
    """Return the bucket, 0 .. buckets - 1, of each angle; angles outside go to the first or the last bucket.

    Each operation is monotonic in the angle, in floating point too. An angle between two limits is therefore always in
    a bucket between those of the limits, whatever the rounding.
    """
    number = np.floor(buckets - (max_rad - angle_rad) / width_rad)
    return np.clip(number, 0, buckets - 1).astype(np.int64)


@jit
def candidates(catalog: PairCatalog, low_rad: float, high_rad: float) -> tuple[int, int]:
    """Return the half-open range of pairs that holds every angle in [low, high], rounded out to whole buckets.

    It begins at the last bucket whose lower end is below `low` and ends before the first one above `high` (eq. 12).
    """
    buckets = len(catalog.table) - 1
    limits = np.array([low_rad, high_rad])
    first, last = bucket_of(limits, catalog.max_rad, catalog.width_rad, buckets)
    return catalog.table[first], catalog.table[last + 1]
