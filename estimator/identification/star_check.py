"""Quick check of an attitude that a pair of detections determines: have the other detections a star nearby?

`trial` prepares the check for a pair. It computes the gates, from the errors of the detections and of the pair's
attitude, and the number of matches without which the evidence cannot suffice. `quick_check` then looks up one detection
after another, at each attitude of the pair.
"""

from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import nearest
from estimator.core import vectors
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.identification.chance import (
    GATE_SIGMA,
    attitude_dex,
    middle,
    required_matches,
    squared_separation,
)
from estimator.identification.star_detections import Detections, field_area, ray


@jit
def trial(
    detections: Detections, a: int, b: int, min_dex: float
) -> tuple[Floats, NDArray[np.int64], int]:
    """What the quick check of an attitude by two detections needs.

    Parameters
    ----------
    a, b
        Rows of the two detections
    min_dex
        Least evidence of interest, log10

    Returns
    -------
    gates
        (N,) matching radius of each detection, tangents
    order
        (N - 2,) rows of the other detections
    required
        Number of matches, the pair included, without which the evidence cannot reach `min_dex`
    """
    gates = pair_gates(detections, a, b)
    order = other_detections(len(gates), a, b)
    pair_dex = attitude_dex(
        detections.tangent, detections.sigma, a, b, 8 * pi * pi, detections.focal_uncertainty
    )
    required = required_matches(detections.sigma, field_area(detections), pair_dex, min_dex)
    return gates, order, required


@jit
def pair_gates(detections: Detections, a: int, b: int) -> Floats:
    """Matching radius of each detection at the attitude of a pair: its own error and that of the attitude.

        gate_n = GATE_SIGMA sqrt(s_n^2 + (sa^2 + sb^2) / 4 + (sa^2 + sb^2) d_n^2 / D^2)

    The second term is the variance of the pair's midpoint. The third is that of its direction, and of its relative
    length (for an uncertain focal length), which grows with the squared distance d_n from the midpoint; D is the
    separation.

    Returns
    -------
    Floats
        (N,) tangents
    """
    tangent = detections.tangent
    x, y = middle(tangent, a, b)
    pair_variance = detections.sigma[a] ** 2 + detections.sigma[b] ** 2
    direction_variance = pair_variance / squared_separation(tangent, a, b)
    out = np.empty(len(detections.sigma))
    for n in range(len(out)):
        distance2 = (tangent[n, 0] - x) ** 2 + (tangent[n, 1] - y) ** 2
        # The detection's variance, that of the midpoint, and that of the direction at this distance.
        out[n] = GATE_SIGMA * sqrt(
            detections.sigma[n] ** 2 + pair_variance / 4 + direction_variance * distance2
        )
    return out


@jit
def other_detections(total: int, a: int, b: int) -> NDArray[np.int64]:
    """Rows of all N detections but a and b: (N - 2,)."""
    rows = np.arange(total)
    return rows[(rows != a) & (rows != b)]


@jit
def quick_check(
    tangent: Floats,
    vectors_ref: Floats,
    cell_first: NDArray,
    cell_star: NDArray,
    side: int,
    R_ref_from_cam: Floats,
    focal_ratio: float,
    gates: Floats,
    order: NDArray,
    required: int,
) -> tuple[int, bool]:
    """Look up detections at an attitude, until it is clear whether enough of them have a star nearby.

    Parameters
    ----------
    tangent
        (N, 2) detections, tangents
    vectors_ref, cell_first, cell_star, side
        Fields of the sky index (see `nearest`)
    R_ref_from_cam
        (3, 3) candidate attitude
    focal_ratio
        Ratio of the true to the assumed focal length
    gates
        (N,) matching radius of each detection
    order
        Rows of the detections that are not matched yet, in the order of the look-ups
    required
        Number of matches wanted, with those that are matched already

    Returns
    -------
    lookups
        Number of detections looked up
    fits
        Whether `required` is reached
    """
    remaining = len(order)
    count = len(gates) - remaining
    for step in range(remaining):
        if count + remaining - step < required:
            return step, False
        # The star nearest to the detection's direction in the catalog's frame.
        n = order[step]
        x, y, z = vectors.rotate(R_ref_from_cam, ray(tangent, n, focal_ratio))
        star, _ = nearest(vectors_ref, cell_first, cell_star, side, x, y, z, gates[n])
        count += star >= 0
        if count >= required:
            return step + 1, True
    return remaining, count >= required
