"""Boeing's pair catalogue: which two stars are how far apart, in buckets of angle and without the angles.

Needelman, Li & Wu 2005 as told by Padro 2012, section 2.4.6. Pairs lie in buckets of equal width in angle, unsorted
within, and a table says where each bucket begins. That halves the memory and needs no search; a few pairs too many
are looked at.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimator.catalog import spatial_grid
from estimator.catalog.spatial_grid import Cells
from estimator.core.arrays import Floats, Ints
from estimator.core.errors import ImageError
from estimator.core.jit import jit

ARCSEC_RAD = np.pi / 648_000
WIDTH_RAD = 100 * ARCSEC_RAD  # the thesis's (section 3.7.3)


class PairCatalogue(NamedTuple):
    """Stars, and pairs of them in buckets of angle.

    vectors   : (N, 3) unit;  magnitude : (N,) any scale
    pair      : (P, 2) rows, bucket after bucket, unsorted within
    table     : (M + 1,) where each bucket begins in `pair`; the last entry is P
    max_rad   : upper end of the last bucket; bucket i of 0 .. M - 1 begins at max_rad - (M - i) width_rad
    cells     : the stars by direction, where Boeing sorts them by declination
    """

    vectors: Floats
    magnitude: Floats
    pair: NDArray[np.int32]
    table: Ints
    max_rad: float
    width_rad: float
    cells: Cells


def bucketed(
    vectors: Floats,
    magnitude: Floats,
    width_rad: float = WIDTH_RAD,
    range_rad: tuple[float, float] | None = None,
    magnitudes: tuple[float, float] = (-np.inf, np.inf),
) -> PairCatalogue:
    """Every pair of (N, 3) unit vectors whose angle and whose two magnitudes (N,) are in range (section 2.4.6).

    range_rad : of the angles, both ends included; that of the pairs there are if left out
    Buckets are counted back from the greatest angle. Raises ImageError where there is no pair.
    """
    vectors = np.ascontiguousarray(vectors, dtype=float)
    if not width_rad > 0:
        raise ImageError(f"bucket width {width_rad} rad: allowed is more than 0")
    low, high = range_rad or (0.0, np.pi)
    # A hair wider than the range, which the exact angles then cut.
    chord = 2 * np.sin(min(high, np.pi) / 2) + 1e-12
    pair = cKDTree(vectors).query_pairs(chord, output_type="ndarray").astype(np.int32)
    angle = 2 * np.arcsin(np.linalg.norm(vectors[pair[:, 0]] - vectors[pair[:, 1]], axis=1) / 2)
    shines = (magnitude >= magnitudes[0]) & (magnitude <= magnitudes[1])
    kept = (angle >= low) & (angle <= high) & shines[pair].all(axis=1)
    pair, angle = pair[kept], angle[kept]
    if not len(pair):
        raise ImageError(f"no pair of stars from {np.degrees(low):.3f} to {np.degrees(high):.3f} deg")
    if range_rad is None:
        low, high = float(angle.min()), float(angle.max())
    # A range of whole buckets is one bucket more by rounding, but for the 1e-9.
    buckets = max(int(np.ceil((high - low) / width_rad - 1e-9)), 1)
    bucket = bucket_of(angle, high, width_rad, buckets)
    table = np.concatenate([[0], np.cumsum(np.bincount(bucket, minlength=buckets))])
    pair = np.ascontiguousarray(pair[np.argsort(bucket, kind="stable")])
    light = np.ascontiguousarray(magnitude, dtype=float)
    return PairCatalogue(vectors, light, pair, table, float(high), width_rad, spatial_grid.build(vectors))


@jit
def bucket_of(angle_rad: Floats, max_rad: float, width_rad: float, buckets: int) -> Ints:
    """Which bucket, 0 .. buckets - 1, each angle belongs to; what lies outside goes to the first or the last.

    Each step of it grows with the angle, in floating point too: an angle inside a gate is in a bucket between
    those of the gate's ends, whatever is rounded.
    """
    number = np.floor(buckets - (max_rad - angle_rad) / width_rad)
    return np.clip(number, 0, buckets - 1).astype(np.int64)


@jit
def candidates(catalogue: PairCatalogue, low_rad: float, high_rad: float) -> tuple[int, int]:
    """Half-open range of pairs that holds every angle in [low, high], and a bucket's rest at either end.

    From the bucket with the greatest lower end below `low` to before that with the least above `high` (eq. 12).
    """
    buckets = len(catalogue.table) - 1
    ends = np.array([low_rad, high_rad])
    first, last = bucket_of(ends, catalogue.max_rad, catalogue.width_rad, buckets)
    return catalogue.table[first], catalogue.table[last + 1]
