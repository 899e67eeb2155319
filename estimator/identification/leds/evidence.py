"""Bayes factor of a candidate attitude under an LED dome, from matched and missing LEDs.

`prove` projects the LEDs at a candidate attitude, matches them to the detections, refines the attitude, and returns
log10 of the Bayes factor ("dex") of this attitude over detections at random positions; see `_evidence` for its terms.
Unlike stars, LEDs are near: the projection includes the lever from the bearing to the camera's entrance pupil.
"""

from __future__ import annotations

from math import lgamma, log, log10, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.core import vectors
from estimator.core.arrays import Floats
from estimator.core.jit import jit
from estimator.core.vectors import Vector
from estimator.identification.leds.index import Sight

GATE = 3.5  # matching radius in standard deviations: it loses one true match in 450
LEAST = 3  # matches needed for a solution


class Lights(NamedTuple):
    """The detections of one frame, in camera axes.

    ray     : (N, 3) unit;  tangent : (N, 2) x / z and y / z;  sigma : (N,) total standard deviation of each tangent
    usual   : (N, 3) unit vector from the bearing to the point where the ray meets the sphere of the median LED radius
    rise    : (N, 3) derivative of `usual` with respect to that radius, 1 / m
    """

    ray: Floats
    tangent: Floats
    sigma: Floats
    usual: Floats
    rise: Floats


class Guess(NamedTuple):
    """A hypothesis: matched rows of detections and LEDs (K,), R_cam_from_lab (3, 3), log10 of the Bayes factor."""

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    matrix: Floats
    dex: float


@jit
def apart(tangent: Floats, a: int, b: int) -> float:
    """Distance between two detections, in tangents."""
    return sqrt((tangent[a, 0] - tangent[b, 0]) ** 2 + (tangent[a, 1] - tangent[b, 1]) ** 2)


@jit
def alike(one: Guess, other: Guess) -> bool:
    """Whether two hypotheses agree: more than half of the matches of the smaller one are also in the other."""
    common = 0
    for n in range(len(one.observed)):
        for m in range(len(other.observed)):
            common += one.observed[n] == other.observed[m] and one.star[n] == other.star[m]
    return 2 * common > min(len(one.observed), len(other.observed))


@jit
def prove(lights: Lights, sight: Sight, matrix: Floats, centre: int, a: int, b: int) -> Guess:
    """Evaluate the attitude of a pair of detections a, b: match, fit and match again (twice), compute the evidence.

    matrix : R_cam_from_lab, changed in place by the fit;  centre : row of the LED whose neighborhood is matched
    The evidence is -inf if fewer than LEAST LEDs match.
    """
    # Error of the pair's attitude, in units of a detection's variance: 1/2 from its midpoint (beside the detection's
    # own 1), and 2 / separation^2 per squared distance from the midpoint from its direction.
    middle = (lights.tangent[a] + lights.tangent[b]) / 2
    turning = 2 / apart(lights.tangent, a, b) ** 2
    observed, star, missed = _match(lights, sight, matrix, centre, middle, 1.5, turning)
    dex = -np.inf
    for _ in range(2):
        if len(observed) < LEAST:
            return Guess(observed, star, matrix, -np.inf)
        info = _fit(lights, sight, matrix, observed, star)
        observed, star, missed = _match(lights, sight, matrix, centre, middle, 1.0, 0.0)
        dex = _evidence(lights, sight, matrix, observed, star, missed, info)
    return Guess(observed, star, matrix, dex if len(observed) >= LEAST else -np.inf)


@jit
def _seen_from_pupil(sight: Sight, matrix: Floats, star: int) -> Vector:
    """Vector from the camera's entrance pupil to an LED, in camera axes, m."""
    x, y, z = vectors.row(sight.position_m, star)
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z - sight.pupil_m[0],
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z - sight.pupil_m[1],
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z - sight.pupil_m[2],
    )


@jit
def _match(
    lights: Lights, sight: Sight, matrix: Floats, centre: int, middle: Floats, own: float, turning: float
) -> tuple[NDArray, NDArray, int]:
    """Match each LED near `centre` to its nearest detection within the gate, one LED for each detection.

    The gate is GATE standard deviations; its variance is own + turning * (distance from `middle`)^2, times the
    detection's. Returns rows of detections, rows of LEDs, and the number of missing LEDs: predicted well inside the
    field, or rivals for a detection that a nearer LED keeps. With `brightest_first` only LEDs brighter than the
    faintest match count as missing.
    """
    left, right, top, bottom = sight.field_tan
    first = sight.pairs.first
    count, missed, total = 0, 0, len(lights.ray)
    unseen = np.empty(first[centre + 1] - first[centre] + 1, np.int64)
    observed, star, gap = np.empty(total, np.int64), np.empty(total, np.int64), np.empty(total)
    # The LED `centre` itself, then its neighbors in the pair index: all LEDs that can share a field with it.
    for step in range(first[centre] - 1, first[centre + 1]):
        s = centre if step < first[centre] else sight.pairs.neighbour[step]
        qx, qy, qz = _seen_from_pupil(sight, matrix, s)
        if not (
            qz > 0 and 1.1 * left * qz < qx < 1.1 * right * qz and 1.1 * top * qz < qy < 1.1 * bottom * qz
        ):
            continue
        x, y = qx / qz, qy / qz
        spread = own + turning * ((x - middle[0]) ** 2 + (y - middle[1]) ** 2)
        best, nearest = -1, GATE**2 * spread
        for n in range(total):
            off = (lights.tangent[n, 0] - x) ** 2 + (lights.tangent[n, 1] - y) ** 2
            if off < nearest * lights.sigma[n] ** 2:
                best, nearest = n, off / lights.sigma[n] ** 2
        if best < 0:
            if left < x < right and top < y < bottom:
                unseen[missed] = s
                missed += 1
            continue
        place = 0
        while place < count and observed[place] != best:
            place += 1
        if place == count:
            observed[count], star[count], gap[count] = best, s, nearest
            count += 1
            continue
        unseen[missed] = s  # two LEDs match one detection: the farther one is missing
        if nearest < gap[place]:
            unseen[missed], star[place], gap[place] = star[place], s, nearest
        missed += 1
    if sight.brightest_first and count > 0:
        missed = np.sum(unseen[:missed] < star[:count].max())
    return observed[:count], star[:count], missed


@jit
def _fit(lights: Lights, sight: Sight, matrix: Floats, observed: NDArray, star: NDArray) -> Floats:
    """One Gauss-Newton step of the attitude about the bearing (matrix, in place), with exact near-field projection.

    With b = R P, q = b - r (r the pupil) and R <- exp([w]) R, a tangent changes by d . (w x b) = w . (b x d), d its
    gradient with respect to q. Returns the (3, 3) Fisher information of w, in camera axes.
    """
    info, pull, row = np.zeros((3, 3)), np.zeros(3), np.empty(3)
    for k in range(len(observed)):
        q = _seen_from_pupil(sight, matrix, star[k])
        bx, by, bz = q[0] + sight.pupil_m[0], q[1] + sight.pupil_m[1], q[2] + sight.pupil_m[2]
        weight = 1 / lights.sigma[observed[k]] ** 2
        for axis in range(2):
            slope, deeper = 1 / q[2], -q[axis] / q[2] ** 2
            row[0] = by * deeper - axis * bz * slope
            row[1] = (1 - axis) * bz * slope - bx * deeper
            row[2] = axis * bx * slope - (1 - axis) * by * slope
            residual = lights.tangent[observed[k], axis] - q[axis] / q[2]
            for i in range(3):
                pull[i] += weight * row[i] * residual
                for j in range(3):
                    info[i, j] += weight * row[i] * row[j]
    vectors.turn(np.linalg.solve(info, pull), matrix)
    return info


@jit
def _evidence(
    lights: Lights,
    sight: Sight,
    matrix: Floats,
    observed: NDArray,
    star: NDArray,
    missed: int,
    info: Floats,
) -> float:
    """log10 of the Bayes factor of this attitude over detections at random positions.

    Each match contributes N(residual) / rho, rho the density of detections on the sensor. The counts of matched (m)
    and missing (k) LEDs contribute B(m + 1, k + 1), a uniform prior on the fraction of dead LEDs. The attitude
    contributes (2 pi)^1.5 / sqrt(det info) over the prior volume (Laplace's approximation). By Markov's inequality,
    random detections reach 10^x for any attitude in at most one of 10^x frames.

    All patch boards have the same pattern, so that further matches on one board are not independent: the second LED of
    a board counts at most a factor of 10 (it fixes the orientation of the lattice), each further one at most a factor
    of 2 (it is lit or not).
    """
    density, group = len(lights.ray) / sight.area, sight.pairs.group
    total = 1.5 * log10(2 * pi) - 0.5 * log10(max(np.linalg.det(info), 1e-300)) - log10(sight.volume)
    for k in range(len(observed)):
        qx, qy, qz = _seen_from_pupil(sight, matrix, star[k])
        variance = lights.sigma[observed[k]] ** 2
        x, y = lights.tangent[observed[k]]
        off = (x - qx / qz) ** 2 + (y - qy / qz) ** 2
        worth = -off / variance / 2 / log(10.0) - log10(2 * pi * variance * density)
        before = 0
        for m in range(k):
            before += group[star[m]] == group[star[k]]
        if before > 0:
            worth = min(worth, 1.0 if before == 1 else 0.3)
        total += worth
    lit = float(len(observed))
    return total + (lgamma(lit + 1) + lgamma(missed + 1.0) - lgamma(lit + missed + 2)) / log(10.0)
