"""The on-board catalogue's pairs: a k-vector over all angles, and every star's neighbours by angle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimator.catalog import spatial_grid
from estimator.catalog.spatial_grid import Cells
from estimator.core.arrays import Floats
from estimator.core.errors import ImageError
from estimator.core.jit import jit


class PairIndex(NamedTuple):
    """Pairs of catalogue stars closer than max_angle_rad. A plain tuple, so that compiled code can take it.

    vectors   : (N, 3) unit vectors, brightest star first
    pair      : (P, 2) star rows, by growing angle;  angle_rad : (P,)
    kvector   : (P + 2,) kvector[k] = number of pairs with angle <= slope k + offset (Mortari 1997)
    slope_rad, offset_rad : the k-vector's line
    first     : (N + 1,) where each star's neighbours begin
    neighbour : their rows, by growing angle;  separation_rad : the angles
    group     : (N,) which stars were made as one; no pair is listed within a group, for its pattern repeats
    magnitude : (N,) growing, in the camera's own scale; NaN where it is not known
    cells     : the stars by direction
    """

    vectors: Floats
    pair: NDArray[np.int32]
    angle_rad: Floats
    kvector: NDArray[np.int64]
    slope_rad: float
    offset_rad: float
    first: NDArray[np.int64]
    neighbour: NDArray[np.int32]
    separation_rad: Floats
    group: NDArray[np.int64]
    max_angle_rad: float
    magnitude: Floats
    cells: Cells


def build(
    vectors: Floats,
    max_angle_rad: float,
    group: NDArray[np.int64] | None = None,
    magnitude: Floats | None = None,
) -> PairIndex:
    """Index all pairs of (N, 3) unit vectors up to an angle, brightest first. Raises ImageError where there are none.

    group     : (N,) labels of what is not placed independently (LEDs of one patch board); each its own if left out
    magnitude : (N,) never falling; unknown if left out
    """
    group = np.arange(len(vectors)) if group is None else np.asarray(group, np.int64)
    vectors = np.ascontiguousarray(vectors, dtype=float)
    light = np.full(len(vectors), np.nan) if magnitude is None else np.asarray(magnitude, float)
    if light.shape != (len(vectors),) or (np.diff(light) < 0).any():
        raise ImageError(
            f"magnitudes {light.shape} of {len(vectors)} stars; allowed: one for each, the brightest first"
        )
    chord = 2 * np.sin(min(max_angle_rad, np.pi) / 2)
    pair = cKDTree(vectors).query_pairs(chord, output_type="ndarray").astype(np.int32)
    # The half-chord keeps small angles exact where arccos of a dot product would lose half the digits.
    angle = 2 * np.arcsin(np.linalg.norm(vectors[pair[:, 0]] - vectors[pair[:, 1]], axis=1) / 2)
    order = np.argsort(angle, kind="stable")
    pair, angle = np.ascontiguousarray(pair[order]), angle[order]
    owner = np.concatenate([pair[:, 0], pair[:, 1]])
    other = np.concatenate([pair[:, 1], pair[:, 0]])
    both = np.concatenate([angle, angle])
    by_owner = np.lexsort((both, owner))
    first = np.searchsorted(owner[by_owner], np.arange(len(vectors) + 1))
    neighbour, separation = other[by_owner], both[by_owner]
    apart = group[pair[:, 0]] != group[pair[:, 1]]
    pair, angle = pair[apart], angle[apart]
    if len(pair) < 3:
        raise ImageError(
            f"{len(pair)} pairs within {np.degrees(max_angle_rad):.2f} deg, not counting those of one patch board,"
            " are no pattern; allowed: 3 or more"
        )
    kvector, slope, offset = line(angle)
    return PairIndex(
        vectors,
        pair,
        angle,
        kvector,
        slope,
        offset,
        first,
        neighbour,
        separation,
        group,
        max_angle_rad,
        light,
        spatial_grid.build(vectors),
    )


def line(angle_rad: Floats) -> tuple[NDArray[np.int64], float, float]:
    """The k-vector of sorted angles: counts below a line through just under the least and just over the greatest.

    z(k) = slope k + offset with k = 0 .. P + 1; count[k] = #{angle <= z(k)}.
    """
    count = len(angle_rad)
    margin = max(1e-12, 1e-12 * angle_rad[-1])
    low, high = angle_rad[0] - margin, angle_rad[-1] + margin
    slope = (high - low) / (count + 1)
    z = slope * np.arange(count + 2) + low
    return np.searchsorted(angle_rad, z, side="right"), float(slope), float(low)


@jit
def between(index: PairIndex, low_rad: float, high_rad: float) -> tuple[int, int]:
    """Half-open range of pairs that holds every angle in [low, high].

    Mortari's formula, j_b = floor((low - q) / m) and j_t = ceil((high - q) / m), may take in a neighbour or two
    at either end; SHEFEX's eq. 5 has the signs of the error and of q wrong. A thousandth of a step is added, for
    an angle that lies on a node of the line together with the range's end, and for the rounding of the two.
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
def alike(index: PairIndex, magnitude: float, gate: float) -> tuple[int, int]:
    """Half-open range of rows whose magnitude is within a gate of one; all of them where one is not known."""
    if not np.isfinite(gate) or np.isnan(magnitude) or np.isnan(index.magnitude[0]):
        return 0, len(index.magnitude)
    begin = int(np.searchsorted(index.magnitude, magnitude - gate))
    return begin, int(np.searchsorted(index.magnitude, magnitude + gate, side="right"))


@jit
def around(index: PairIndex, star: int, low_rad: float) -> int:
    """Place of a star's first neighbour at `low_rad` or farther, by bisection."""
    begin, end = index.first[star], index.first[star + 1]
    while begin < end:
        middle = (begin + end) // 2
        if index.separation_rad[middle] < low_rad:
            begin = middle + 1
        else:
            end = middle
    return begin
