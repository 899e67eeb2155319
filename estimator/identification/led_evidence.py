"""Bayes factor of a candidate attitude under an LED dome, from matched and missing LEDs.

`evaluate` projects the LEDs at a candidate attitude, matches them to the detections, refines the attitude, and returns
log10 of the Bayes factor ("dex"): the probability of the detections if the attitude is true, over that if they are
distributed at random over the sensor.

    dex = sum_k log10( N(residual_k) / rho ) + sum_k light_dex_k       positions and brightness of the matches
        + log10( (2 pi)^(n/2) / sqrt(det info) / V )                   attitude and focal length
        + log10 B(matched + 1, missing + 1)                            counts of matched and missing LEDs

N is the Gaussian of a residual, rho the density of detections, info the n x n Fisher information of the fit, and V the
prior volume of attitudes that see the dome, times the width of the range of an uncertain focal length.

Unlike stars, LEDs are near: the projection includes the lever from the bearing to the camera's entrance pupil. If the
focal length is uncertain, it is refined with the attitude: `focal_ratio` is the true one over the assumed one.

The steps of `evaluate`; the same numbers return as comments in the code:

1. Match the LEDs around to the detections, within the error of the pair's attitude (`_match`).
2. Fit attitude and focal ratio to the matches by one Gauss-Newton step (`_fit`).
3. Match again, within the errors of the detections alone, and count the missing LEDs.
4. Compute the evidence (`_evidence`). Steps 2 to 4 are done twice.
"""

from math import exp, log, log10, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.core import least_squares, vectors
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.vectors import Vector
from estimator.identification.chance import (
    GATE_SIGMA,
    MIN_EVIDENCE_MATCHES,
    counts_dex,
    middle,
    separation,
)
from estimator.identification.led_detections import LedDetections, light_dex
from estimator.identification.led_index import DomeIndex


class LedHypothesis(NamedTuple):
    """A candidate attitude with its matches and its evidence.

    Attributes
    ----------
    observed, star
        (K,) rows of the matched detections and of their LEDs
    R_cam_from_lab
        (3, 3) rotation from the lab frame to camera axes
    dex
        log10 of the Bayes factor
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    R_cam_from_lab: Floats
    dex: float


@jit
def same_identification(first: LedHypothesis, second: LedHypothesis) -> bool:
    """Whether two hypotheses agree: more than half of the matches of the smaller one are also in the other."""
    common = 0
    for n in range(len(first.observed)):
        for m in range(len(second.observed)):
            common += (
                first.observed[n] == second.observed[m] and first.star[n] == second.star[m]
            )
    return 2 * common > min(len(first.observed), len(second.observed))


@jit
def evaluate(
    detections: LedDetections,
    dome: DomeIndex,
    R_cam_from_lab: Floats,
    center: int,
    a: int,
    b: int,
    focal_ratio: float = 1.0,
) -> LedHypothesis:
    """Match, fit and score the attitude of a pair of detections: the module's steps 1 to 4.

    Parameters
    ----------
    R_cam_from_lab
        (3, 3) candidate attitude, changed in place by the fit
    center
        Row of the LED whose neighborhood is matched
    a, b
        Rows of the pair's detections
    focal_ratio
        Focal ratio of the pair, if it is uncertain

    Returns
    -------
    LedHypothesis
        Its evidence is -inf if fewer than MIN_EVIDENCE_MATCHES LEDs match, or if the focal length is out of its range
    """
    # 1. Match.
    # Error of the pair's attitude, in units of a detection's variance: 1/2 from the midpoint (added to the detection's
    # own 1), and 2 / separation^2 from the direction, per squared distance from the midpoint; a focal length from the
    # pair adds the same along that distance.
    midpoint = middle(detections.tangent, a, b)
    direction_variance = 2 / separation(detections.tangent, a, b) ** 2
    observed, star, missing = _match(
        detections,
        dome,
        R_cam_from_lab,
        focal_ratio,
        center,
        midpoint,
        1.5,
        direction_variance,
    )
    for _ in range(2):
        dex = -np.inf
        # Too few matches determine no attitude.
        if len(observed) < MIN_EVIDENCE_MATCHES:
            break
        # 2. Fit; the range of the focal ratio has a margin, as the fit is noisy.
        info, focal_ratio = _fit(
            detections, dome, R_cam_from_lab, focal_ratio, observed, star
        )
        if abs(focal_ratio - 1) > 1.2 * detections.focal_uncertainty + 1e-12:
            break
        # 3. Match again.
        observed, star, missing = _match(
            detections, dome, R_cam_from_lab, focal_ratio, center, midpoint, 1.0, 0.0
        )
        # 4. The evidence.
        dex = _evidence(
            detections, dome, R_cam_from_lab, focal_ratio, observed, star, missing, info
        )
    if len(observed) < MIN_EVIDENCE_MATCHES:
        dex = -np.inf
    return LedHypothesis(observed, star, R_cam_from_lab, dex)


@jit
def _vector_from_pupil(dome: DomeIndex, R_cam_from_lab: Floats, star: int) -> Vector:
    """Vector from the camera's entrance pupil to an LED, in camera axes, m."""
    x, y, z = vectors.rotate(R_cam_from_lab, vectors.row(dome.position_m, star))
    return x - dome.pupil_m[0], y - dome.pupil_m[1], z - dome.pupil_m[2]


@jit
def _match(
    detections: LedDetections,
    dome: DomeIndex,
    R_cam_from_lab: Floats,
    focal_ratio: float,
    center: int,
    midpoint: tuple[float, float],
    base_variance: float,
    direction_variance: float,
) -> tuple[NDArray, NDArray, int]:
    """Match each LED near `center` to its nearest detection within the gate, one LED for each detection: steps 1 and 3.

    The squared gate is GATE_SIGMA^2 (base_variance + direction_variance d^2), d the distance from `midpoint`.

    Parameters
    ----------
    center, midpoint
        Row of an LED, which is matched with its neighbors in the pair index, and (x, y) of the pair, tangents
    base_variance, direction_variance
        Error of the attitude and of the detection, in units of the detection's variance

    Returns
    -------
    observed, star
        (K,) rows of the detections and of the LEDs
    missing
        Number of missing LEDs: predicted well inside the field, or rivals for a detection that a nearer LED keeps
    """
    left, right, top, bottom = dome.field_tan
    first = dome.pairs.first
    count = missing = 0
    observed = np.empty(len(detections.ray), np.int64)
    star = np.empty_like(observed)
    distances2 = np.empty(len(observed))
    # The LED `center` itself, then its neighbors in the pair index: all LEDs that can share a field with it.
    for entry in range(first[center] - 1, first[center + 1]):
        s = center if entry < first[center] else dome.pairs.neighbor[entry]
        qx, qy, qz = _vector_from_pupil(dome, R_cam_from_lab, s)
        if qz <= 0:
            continue
        x = focal_ratio * qx / qz
        y = focal_ratio * qy / qz
        # A field widened by a tenth.
        if not (1.1 * left < x < 1.1 * right and 1.1 * top < y < 1.1 * bottom):
            continue
        offset2 = (x - midpoint[0]) ** 2 + (y - midpoint[1]) ** 2
        gate2 = GATE_SIGMA**2 * (base_variance + direction_variance * offset2)
        best, distance2 = _nearest_detection(
            detections.tangent, detections.sigma, x, y, gate2
        )
        if best < 0:
            # A missing LED counts only well inside the field.
            missing += left < x < right and top < y < bottom
            continue
        # The slot of an earlier match of the same detection, or a new one at the end.
        slot = 0
        while slot < count and observed[slot] != best:
            slot += 1
        if slot < count:
            missing += 1  # two LEDs match one detection: the farther one is missing
            if distance2 >= distances2[slot]:
                continue
        observed[slot] = best
        star[slot] = s
        distances2[slot] = distance2
        count = max(count, slot + 1)
    return observed[:count], star[:count], missing


@jit
def _nearest_detection(
    tangent: Floats, sigma: Floats, x: float, y: float, distance2: float
) -> tuple[int, float]:
    """Nearest detection to (x, y) and its squared distance, in units of the detection's variance; -1 if none is nearer.

    Parameters
    ----------
    distance2
        Greatest squared distance
    """
    best = -1
    for n in range(len(sigma)):
        residual2 = (tangent[n, 0] - x) ** 2 + (tangent[n, 1] - y) ** 2
        if residual2 < distance2 * sigma[n] ** 2:
            best = n
            distance2 = residual2 / sigma[n] ** 2
    return best, distance2


@jit
def _fit(
    detections: LedDetections,
    dome: DomeIndex,
    R_cam_from_lab: Floats,
    focal_ratio: float,
    observed: NDArray,
    star: NDArray,
) -> tuple[Floats, float]:
    """One Gauss-Newton step of R_cam_from_lab about the bearing, in place, with exact near-field projection: step 2.

    With b = R P and q = b - r (r the pupil), an LED's tangent is t = f q_xy / q_z. For R <- exp([w]) R it changes by
    d . (w x b) = w . (b x d), d its gradient with respect to q:

        d of t_x = f (1 / q_z, 0, -q_x / q_z^2),   d of t_y = f (0, 1 / q_z, -q_y / q_z^2)

    An uncertain focal length multiplies all tangents: its logarithm is the fourth unknown, with the derivative t.

    Parameters
    ----------
    observed, star
        (K,) rows of the matched detections and of their LEDs

    Returns
    -------
    info
        (3, 3) or (4, 4) Fisher information of w, in camera axes, and of log focal_ratio
    focal_ratio
        The new focal ratio
    """
    count = 4 if detections.focal_uncertainty > 0 else 3
    info = np.zeros((count, count))
    factor = np.empty((count, count))
    step = np.zeros(count)
    slopes = np.empty(4)
    for k in range(len(observed)):
        q = _vector_from_pupil(dome, R_cam_from_lab, star[k])
        bx = q[0] + dome.pupil_m[0]
        by = q[1] + dome.pupil_m[1]
        bz = q[2] + dome.pupil_m[2]
        weight = 1 / detections.sigma[observed[k]] ** 2
        for axis in range(2):
            # Components of d, then of b x d.
            by_component = focal_ratio / q[2]
            by_depth = -focal_ratio * q[axis] / q[2] ** 2
            slopes[0] = by * by_depth - axis * bz * by_component
            slopes[1] = (1 - axis) * bz * by_component - bx * by_depth
            slopes[2] = axis * bx * by_component - (1 - axis) * by * by_component
            slopes[3] = focal_ratio * q[axis] / q[2]
            # The residual, and its contribution to the gradient and to the information.
            residual = detections.tangent[observed[k], axis] - slopes[3]
            for i in range(count):
                step[i] += weight * slopes[i] * residual
                for j in range(count):
                    info[i, j] += weight * slopes[i] * slopes[j]
    # Solve for the step and apply it.
    _factorize(info, factor)
    least_squares.cholesky_solve(factor, step)
    vectors.rotate_in_place(step, R_cam_from_lab)
    return info, focal_ratio * exp(step[3]) if count == 4 else focal_ratio


@jit
def _factorize(info: Floats, factor: Floats) -> float:
    """Cholesky factor of a square matrix, in the lower triangle of `factor`; returns the root of the determinant.

    The root is 0 for a singular matrix.
    """
    # Copy the lower triangle, then factorize the copy.
    for i in range(len(info)):
        for j in range(i + 1):
            factor[i, j] = info[i, j]
    if not least_squares.cholesky(factor):
        return 0.0
    # det info = (product of the factor's diagonal)^2
    root = 1.0
    for i in range(len(info)):
        root *= factor[i, i]
    return root


@jit
def _evidence(
    detections: LedDetections,
    dome: DomeIndex,
    R_cam_from_lab: Floats,
    focal_ratio: float,
    observed: NDArray,
    star: NDArray,
    missing: int,
    info: Floats,
) -> float:
    """log10 of the Bayes factor of an attitude over detections at random positions (see the module's equation): step 4.

    The counts have a uniform prior on the fraction of dead LEDs. By Markov's inequality, random detections reach x
    dex at any attitude in at most one of 10^x frames.

    All patch boards have the same pattern, so that further matches on one board are not independent: the second LED
    of a board counts at most a factor of 10 (it fixes the orientation of the lattice), each further one at most a
    factor of 2 (it is lit or not).

    Parameters
    ----------
    observed, star
        (K,) rows of the matched detections and of their LEDs
    missing
        Number of missing LEDs
    info
        Fisher information of the fit
    """
    density = len(detections.ray) / dome.field_area
    group = dome.pairs.group
    # Attitude and focal length.
    root_det = _factorize(info, np.empty_like(info))
    total = (
        len(info) / 2 * log10(2 * pi)
        - log10(max(root_det, 1e-150))
        - log10(dome.prior_volume)
    )
    if detections.focal_uncertainty > 0:
        total -= log10(2 * detections.focal_uncertainty)
    for k in range(len(observed)):
        qx, qy, qz = _vector_from_pupil(dome, R_cam_from_lab, star[k])
        variance = detections.sigma[observed[k]] ** 2
        x = detections.tangent[observed[k], 0]
        y = detections.tangent[observed[k], 1]
        residual2 = (x - focal_ratio * qx / qz) ** 2 + (y - focal_ratio * qy / qz) ** 2
        # Position and brightness of a match.
        match_dex = -residual2 / variance / 2 / log(10.0) - log10(2 * pi * variance * density)
        match_dex += light_dex(detections, dome, observed[k], star[k])
        # A further match on one board counts less; log10 2 = 0.3.
        same_board = 0
        for m in range(k):
            same_board += group[star[m]] == group[star[k]]
        if same_board > 0:
            match_dex = min(match_dex, 1.0 if same_board == 1 else 0.3)
        total += match_dex
    return total + counts_dex(len(observed), missing)
