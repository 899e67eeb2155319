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

1. Match the LEDs of the field to the detections, within the error of the pair's attitude (`_match`).
2. Fit attitude and focal ratio to the matches by one Gauss-Newton step (`_fit`).
3. Match again, within the errors of the detections alone, and count the missing LEDs. Steps 2 and 3 are done twice.
4. Compute the evidence (`_evidence`).

Under a dense dome a near pair determines no attitude for the whole field. The LEDs near `center` are matched and
fitted twice before, within the errors of the pair and then of the first fit. A part with more missing LEDs than matches
is none.
"""

from math import exp, log, log10, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import within
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
def shared_matches(
    first: LedHypothesis, second: LedHypothesis, lights: int
) -> tuple[int, int]:
    """Numbers of lights that two hypotheses both match, and that they match to the same LED."""
    star = np.full(lights, -1)
    star[first.observed] = first.star
    both = same = 0
    for n in range(len(second.observed)):
        other = star[second.observed[n]]
        both += other >= 0
        same += other == second.star[n]
    return both, same


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
        Row of the first LED of the pair, whose neighborhood is matched first under a dense dome
    a, b
        Rows of the pair's detections
    focal_ratio
        Focal ratio of the pair, if it is uncertain

    Returns
    -------
    LedHypothesis
        Its evidence is -inf if too few LEDs match, or if the focal length is out of its range
    """
    # Error of the pair's attitude, in units of a detection's variance: 1/2 from the midpoint (added to the detection's
    # own 1), and 2 / separation^2 from the direction, per squared distance from the midpoint; a focal length from the
    # pair adds the same along that distance.
    midpoint = middle(detections.tangent, a, b)
    direction_variance = 2 / separation(detections.tangent, a, b) ** 2
    base_variance = 1.5
    dense = len(dome.near) > 0
    leds = _field(dome, R_cam_from_lab)
    for step in range(4 if dense else 3):
        # The first two matches under a dense dome are those of a part.
        part = dense and step < 2
        if part:
            leds = dome.near[center]
        elif step == 2:
            leds = _field(dome, R_cam_from_lab)
        # 1. and 3. Match.
        observed, star, missing = _match(
            detections,
            dome,
            R_cam_from_lab,
            focal_ratio,
            leds,
            midpoint,
            base_variance,
            direction_variance,
        )
        # Too few matches determine no attitude, or no part.
        if len(observed) < max(MIN_EVIDENCE_MATCHES, part * missing):
            return LedHypothesis(observed, star, R_cam_from_lab, -np.inf)
        if step == 2 + dense:
            break
        # 2. Fit; the range of the focal ratio has a margin, as the fit is noisy.
        info, focal_ratio = _fit(
            detections, dome, R_cam_from_lab, focal_ratio, observed, star
        )
        if abs(focal_ratio - 1) > 1.2 * detections.focal_uncertainty + 1e-12:
            return LedHypothesis(observed, star, R_cam_from_lab, -np.inf)
        # The error of a part's fit, as above, is 1 / K and 1 / (sum of squared distances), that of the field's small.
        base_variance = 1 + 2 * part / len(observed)
        offset = detections.tangent[observed] - np.array(midpoint)
        direction_variance = part / np.sum(offset**2)
    # 4. The evidence.
    dex = _evidence(
        detections, dome, R_cam_from_lab, focal_ratio, observed, star, missing, info
    )
    return LedHypothesis(observed, star, R_cam_from_lab, dex)


@jit
def _field(dome: DomeIndex, R_cam_from_lab: Floats) -> NDArray[np.int64]:
    """Rows of the LEDs in the field, and of some around it."""
    index = dome.pairs
    leds = np.empty(len(index.vectors), np.int64)
    # The third row of the rotation is the boresight.
    x, y, z = vectors.row(R_cam_from_lab, 2)
    return leds[: within(index.cells, index.vectors, x, y, z, dome.reach, leds)]


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
    leds: NDArray[np.int64],
    midpoint: tuple[float, float],
    base_variance: float,
    direction_variance: float,
) -> tuple[NDArray, NDArray, int]:
    """Match each of (K,) LEDs to its nearest detection within the gate, one LED for each detection: steps 1 and 3.

    The squared gate is GATE_SIGMA^2 (base_variance + direction_variance d^2), d the distance from `midpoint`.

    Parameters
    ----------
    leds, midpoint
        Rows of the LEDs, and (x, y) of the pair, tangents
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
    total = len(detections.ray)
    missing = 0
    star = np.full(total, -1)
    distances2 = np.full(total, np.inf)
    across = detections.tangent[:, 0]
    widest = detections.sigma.max()
    for s in leds:
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
        begin = 0
        end = total
        # Lights are sorted from left to right under a dense dome.
        if len(dome.near) > 0:
            reach = sqrt(gate2) * widest
            begin = int(np.searchsorted(across, x - reach))
            end = int(np.searchsorted(across, x + reach))
        best, distance2 = _nearest_detection(
            detections.tangent[begin:end], detections.sigma[begin:end], x, y, gate2
        )
        if best < 0:
            # A missing LED counts only well inside the field.
            missing += left < x < right and top < y < bottom
            continue
        # Two LEDs match one detection: the farther one is missing.
        best += begin
        missing += star[best] >= 0
        if distance2 < distances2[best]:
            star[best] = s
            distances2[best] = distance2
    observed = np.flatnonzero(star >= 0)
    return observed, star[observed], missing


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
