"""Bayes factor of a candidate attitude from matched and missing stars.

`evaluate` matches the detections to the catalog stars that the candidate attitude projects next to them, fits the
attitude (and the focal length, if it is uncertain) to the matches, and returns log10 of the Bayes factor ("dex") of the
hypothesis "this attitude" over the hypothesis "the detections are distributed at random over the sensor":

    dex = sum_k log10( N(residual_k) / rho ) + sum_k log10( p(magnitude_k | star) / p(magnitude_k) )
          + log10( (2 pi)^(n/2) / sqrt(det info) / V ) + log10 B(matched + 1, missing + 1) - penalty

rho is the density of detections on the sensor and info the n x n Fisher information of the fit. V is the prior volume
of attitudes (8 pi^2) and focal lengths; the term with V is Laplace's approximation of the integral over them. By
Markov's inequality, random detections reach x dex for any attitude in at most one of 10^x frames.
"""

from __future__ import annotations

from math import log, log10, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.pair_index import first_from
from estimator.catalog.sky_index import (
    MAG_SMOOTHING,
    MAG_STEP,
    SkyIndex,
    cell_of,
    edge_cell,
    nearest,
)
from estimator.core import least_squares, vectors
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.least_squares import CONVERGED_CHI2
from estimator.identification.chance import GATE_SIGMA, MIN_EVIDENCE_MATCHES, counts_dex
from estimator.identification.star_detections import Detections, field_area, gates_of, ray

# Fraction of stars whose magnitude disagrees with the catalog: variable stars, doubles, an unusual passband.
MAG_OUTLIER_FRACTION = 0.05
# Penalty for unmatched detections brighter than the faintest match, for each one in excess of the number of matches.
UNMATCHED_PENALTY_DEX = 0.5
# Fraction of the field in which an unmatched source counts as missing; the border may cut it off.
INNER_FRACTION = 0.97


class Hypothesis(NamedTuple):
    """A hypothesis: candidate attitude, matches and evidence.

    Attributes
    ----------
    observed, star
        (K,) rows of detections and of stars
    R_cam_from_ref
        (3, 3)
    focal_ratio
        Ratio of the true to the assumed focal length
    info
        (4, 4) Fisher information of the small rotation in camera axes and of log focal_ratio
    dex
        log10 of the Bayes factor
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    R_cam_from_ref: Floats
    focal_ratio: float
    info: Floats
    dex: float


class Solution(NamedTuple):
    """The solution from all detections and stars.

    Attributes
    ----------
    observed, star
        (K,) rows of detections and of stars; empty if there is no solution
    cam_from_ref_xyzw
        (4,)
    covariance_rad2
        (3, 3) of the small rotation in camera axes
    focal_ratio
        Ratio of the true to the assumed focal length
    rms
        Of the residuals, tangents
    chi2
        Squared Mahalanobis distances of the matches per degree of freedom
    dex
        log10 of the Bayes factor
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    cam_from_ref_xyzw: Floats
    covariance_rad2: Floats
    focal_ratio: float
    rms: float
    chi2: float
    dex: float


@jit
def no_hypothesis() -> Hypothesis:
    """The empty hypothesis, with evidence -inf."""
    R_cam_from_ref = np.zeros((3, 3))
    info = np.zeros((4, 4))
    for n in range(4):
        info[n, n] = 1.0
        if n < 3:
            R_cam_from_ref[n, n] = 1.0
    return Hypothesis(
        np.empty(0, np.int64), np.empty(0, np.int64), R_cam_from_ref, 1.0, info, -np.inf
    )


@jit
def magnitude_density(sky: SkyIndex, mag: float) -> float:
    """Probability density of the catalog's magnitudes at `mag`, 1 / mag."""
    return sky.density[cell_of((mag - sky.mag[0]) / MAG_STEP, len(sky.density) - 1)]


@jit
def prior_volume_dex(detections: Detections) -> float:
    """log10 of the prior volume: 8 pi^2 of attitudes times the width of the interval of log focal_ratio."""
    width = 2 * detections.focal_uncertainty
    return log10(8 * pi * pi) + (log10(width) if width > 0 else 0.0)


@jit
def evaluate(
    detections: Detections,
    sky: SkyIndex,
    R_cam_from_ref: Floats,
    focal_ratio: float,
    gates: Floats,
    min_dex: float,
) -> Hypothesis:
    """Evaluate a candidate: match detections to stars, fit attitude and focal ratio (twice), compute the evidence.

    R_cam_from_ref is changed in place by the fit. Returns the empty hypothesis if fewer than
    MIN_EVIDENCE_MATCHES stars match, the focal ratio leaves its interval, or the evidence is below min_dex. The last
    test is made early with an upper bound of the evidence (exact matches, no missing star), which rejects most false
    candidates before the full evaluation. A fit that has converged is not
    repeated, nor are its matches.

    Parameters
    ----------
    gates
        (N,) rad, matching radius of each detection in the first round; later rounds use
        GATE_SIGMA
    """
    R = R_cam_from_ref
    info = np.zeros((4, 4))
    max_sigma = np.inf
    fall = np.inf
    observed = np.empty(0, np.int64)
    star = np.empty(0, np.int64)
    for iteration in range(3):
        before = observed, star
        observed, star = _match(detections, sky, R, focal_ratio, gates, max_sigma)
        gates = gates_of(detections, 1.0)
        max_sigma = GATE_SIGMA
        if len(observed) < MIN_EVIDENCE_MATCHES:
            return no_hypothesis()
        if iteration == 1 and min_dex > -np.inf:
            # `info` is that of the first fit; without the residuals the evidence is an upper bound.
            upper_bound_dex = _evidence(
                detections, sky, R, focal_ratio, observed, star, info, iteration > 1
            )
            if upper_bound_dex + counts_dex(len(observed), 0) < min_dex:
                return no_hypothesis()
        if fall < CONVERGED_CHI2 and _equal(observed, before[0]) and _equal(star, before[1]):
            break
        if iteration < 2:
            focal_ratio, fall = _fit(detections, sky, R, focal_ratio, observed, star, info)
            if abs(focal_ratio - 1) > 1.2 * detections.focal_uncertainty + 1e-12:
                return no_hypothesis()
            if iteration == 1 and fall < CONVERGED_CHI2:
                break
    # a literal True would be compiled as another type
    matched = len(observed)
    with_residuals = len(observed) > 0
    dex = _evidence(detections, sky, R, focal_ratio, observed, star, info, with_residuals)
    if dex + counts_dex(matched, 0) < min_dex:
        return no_hypothesis()
    dex += counts_dex(matched, _count_missing(detections, sky, R, focal_ratio, star))
    return Hypothesis(observed, star, R, focal_ratio, info, dex)


@jit
def _equal(first: NDArray, second: NDArray) -> bool:
    """Whether two lists of rows are equal."""
    same = len(first) == len(second)
    for n in range(min(len(first), len(second))):
        same = same and first[n] == second[n]
    return same


@jit
def _match(
    detections: Detections,
    sky: SkyIndex,
    R: Floats,
    focal_ratio: float,
    gates: Floats,
    max_sigma: float,
) -> tuple[NDArray, NDArray]:
    """Match each detection to its nearest star, within gates[n] rad and max_sigma standard deviations.

    If two detections match one star, the one with the smaller Mahalanobis distance keeps it. Returns the rows of the
    detections and of the stars.
    """
    total = len(detections.sigma)
    count = 0
    observed = np.empty(total, np.int64)
    star = np.empty(total, np.int64)
    distances2 = np.empty(total)
    R_ref_from_cam = R.T.copy()
    tangent = detections.tangent
    vectors_ref = sky.vectors
    cell_first = sky.cell_first
    cell_star = sky.cell_star
    side = sky.side
    for n in range(total):
        x, y, z = vectors.rotate(R_ref_from_cam, ray(tangent, n, focal_ratio))
        s, _ = nearest(vectors_ref, cell_first, cell_star, side, x, y, z, gates[n])
        if s < 0:
            continue
        distance2 = squared_mahalanobis(detections, sky, R, focal_ratio, n, s)
        if distance2 > max_sigma**2:
            continue
        slot = 0  # of an earlier match of the same star, or `count`
        while slot < count and star[slot] != s:
            slot += 1
        if slot == count:
            count += 1
        elif distance2 >= distances2[slot]:
            continue
        observed[slot] = n
        star[slot] = s
        distances2[slot] = distance2
    return observed[:count], star[:count]


@jit
def count_near(
    tangent: Floats,
    sky: SkyIndex,
    R_cam_from_ref: Floats,
    focal_ratio: float,
    observed: NDArray,
    gates: Floats,
) -> int:
    """Number of detections beside those `observed` that have a star within their gate (N,), at most 0.05 rad."""
    R_ref_from_cam = R_cam_from_ref.T.copy()
    count = 0
    matched = np.zeros(len(gates), np.bool_)
    for n in observed:
        matched[n] = True
    for n in range(len(gates)):
        if matched[n]:
            continue
        x, y, z = vectors.rotate(R_ref_from_cam, ray(tangent, n, focal_ratio))
        count += (
            nearest(
                sky.vectors, sky.cell_first, sky.cell_star, sky.side, x, y, z, min(gates[n], 0.05)
            )[0]
            >= 0
        )
    return count


@jit
def focal_gain_dex(detections: Detections, sky: SkyIndex, hypothesis: Hypothesis) -> float:
    """log10 of the Bayes factor of a free focal length over that of a hypothesis, with the same matches.

    The fall of chi-square by a step of the fit, and the posterior width of log focal_ratio over its prior width.
    """
    info = np.zeros((4, 4))
    R = hypothesis.R_cam_from_ref.copy()
    _, fall = _fit(
        detections, sky, R, hypothesis.focal_ratio, hypothesis.observed, hypothesis.star, info
    )
    cholesky_solve(info, np.zeros(4))
    return fall / 2 / log(10.0) + log10(
        sqrt(2 * pi) / info[3, 3] / (2 * detections.focal_uncertainty)
    )


@jit
def project(vectors_ref: Floats, R: Floats, star: int) -> vectors.Vector:
    """Project a star into camera axes: x / z, y / z, and z."""
    x, y, z = vectors.rotate(R, vectors.row(vectors_ref, star))
    return x / z, y / z, z


@jit
def squared_mahalanobis(
    detections: Detections, sky: SkyIndex, R: Floats, focal_ratio: float, detection: int, star: int
) -> float:
    """Squared Mahalanobis distance of a detection from a star's predicted image."""
    x, y, _ = project(sky.vectors, R, star)
    dx = detections.tangent[detection, 0] - focal_ratio * x
    dy = detections.tangent[detection, 1] - focal_ratio * y
    xx, yy, xy = vectors.row(detections.weight, detection)
    return xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy


@jit
def _fit(
    detections: Detections,
    sky: SkyIndex,
    R: Floats,
    focal_ratio: float,
    observed: NDArray,
    star: NDArray,
    info: Floats,
) -> tuple[float, float]:
    """One weighted Gauss-Newton step of the attitude R (in place) and of the focal ratio f.

    Returns the new ratio and the fall of chi-square, which is the squared length of the step in standard deviations.

    With t = f (x, y) / z and a small rotation q <- q + w x q, the derivative of t_x with respect to w is
    f (-x y / z^2, 1 + x^2 / z^2, -y / z), that of t_y is f (-1 - y^2 / z^2, x y / z^2, x / z), and that of t with
    respect to log f is t itself. The (4, 4) Fisher information is written to `info`.
    """
    f = focal_ratio
    count = 4 if detections.focal_uncertainty > 0 else 3
    info[:] = 0.0
    gradient = np.zeros(4)
    d_x = np.zeros(4)
    d_y = np.zeros(4)
    tangent = detections.tangent
    weight = detections.weight
    vectors_ref = sky.vectors
    for k in range(len(observed)):
        x, y, _ = project(vectors_ref, R, star[k])
        d_x[0] = -f * x * y
        d_x[1] = f * (1 + x * x)
        d_x[2] = -f * y
        d_x[3] = f * x
        d_y[0] = -f * (1 + y * y)
        d_y[1] = f * x * y
        d_y[2] = f * x
        d_y[3] = f * y
        xx, yy, xy = vectors.row(weight, observed[k])
        residual_x = tangent[observed[k], 0] - f * x
        residual_y = tangent[observed[k], 1] - f * y
        for i in range(count):
            weighted_x = d_x[i] * xx + d_y[i] * xy
            weighted_y = d_x[i] * xy + d_y[i] * yy
            gradient[i] += weighted_x * residual_x + weighted_y * residual_y
            for j in range(i + 1):
                info[i, j] += weighted_x * d_x[j] + weighted_y * d_y[j]
    factor = info[:count, :count].copy()
    step = cholesky_solve(factor, gradient[:count])
    for i in range(4):
        for j in range(i):
            info[j, i] = info[i, j]
    vectors.rotate_in_place(step[:3], R)
    fall = 0.0
    for i in range(count):
        fall += gradient[i] * step[i]
    return (f * np.exp(step[3]) if count == 4 else f), fall


@jit
def cholesky_solve(a: Floats, b: Floats) -> Floats:
    """Solve a x = b by Cholesky factorization; the lower triangle of `a` is replaced by its factor.

    Pivots are floored, so that a nearly singular matrix gives large but finite values.
    """
    x = b.copy()
    for i in range(len(b)):
        for j in range(i + 1):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] = sqrt(max(a[i, i], 1e-300)) if i == j else a[i, j] / a[j, j]
    least_squares.cholesky_solve(a, x)
    return x


@jit
def _count_missing(
    detections: Detections, sky: SkyIndex, R: Floats, focal_ratio: float, star: NDArray
) -> int:
    """Number of missing stars: well inside the field, not matched, and bright enough to be detected.

    Bright enough are stars as bright as the faintest matched one, and those to `detections.limit_mag`, if it is known.
    """
    field = detections.field * (INNER_FRACTION / focal_ratio)
    left, right, top, bottom = field
    matched = 0
    faintest = np.int64(0)
    if np.isfinite(detections.limit_mag):
        faintest = first_from(sky.mag, 0, len(sky.mag), detections.limit_mag) - 1
    for s in star:
        x, y, _ = project(sky.vectors, R, s)
        matched += left < x < right and top < y < bottom
        faintest = max(faintest, s)
    return _count_inside(sky, R, field, faintest) - matched


@jit
def _count_inside(sky: SkyIndex, R: Floats, field: Floats, faintest: int) -> int:
    """Number of stars inside a field (4,), up to a row: the stars are sorted by brightness."""
    left, right, top, bottom = field
    # Chord of the angle from the boresight to the farthest corner.
    corner2 = max(left * left, right * right) + max(top * top, bottom * bottom)
    chord = sqrt(2 - 2 / sqrt(1 + corner2))
    (bx, by, bz) = vectors.row(R, 2)
    side = sky.cells.side
    first = sky.cells.first
    row = sky.cells.row
    vectors_ref = sky.vectors
    inside = 0
    low = edge_cell(bz - chord, side)
    high = edge_cell(bz + chord, side) + 1
    for i in range(edge_cell(bx - chord, side), edge_cell(bx + chord, side) + 1):
        for j in range(edge_cell(by - chord, side), edge_cell(by + chord, side) + 1):
            column = (i * side + j) * side
            for entry in range(first[column + low], first[column + high]):
                if row[entry] > faintest:
                    continue
                x, y, z = vectors.rotate(R, vectors.row(vectors_ref, row[entry]))
                inside += left * z < x < right * z and top * z < y < bottom * z
    return inside


@jit
def _evidence(
    detections: Detections,
    sky: SkyIndex,
    R: Floats,
    focal_ratio: float,
    observed: NDArray,
    star: NDArray,
    info: Floats,
    with_residuals: bool,
) -> float:
    """log10 of the Bayes factor of this attitude over detections at random positions, without the term `counts_dex`.

    Each match contributes N(residual) / rho, rho the density of detections on the sensor, and the ratio of
    `_magnitude_ratio`. The attitude and the focal ratio contribute sqrt(2 pi)^n / sqrt(det info) over their prior
    volume (Laplace's approximation). Unmatched detections cost nothing as long as they are no more than the matches;
    each one above that, among the detections brighter than the faintest match, costs UNMATCHED_PENALTY_DEX.

    Parameters
    ----------
    with_residuals
        Include the residuals; without them the result is an upper bound for these matches
    """
    count = 4 if detections.focal_uncertainty > 0 else 3
    factor = info[:count, :count].copy()
    cholesky_solve(factor, np.zeros(count))
    total = 0.5 * count * log10(2 * pi) - prior_volume_dex(detections)
    for i in range(count):  # the product of the Cholesky factor's diagonal is sqrt(det info)
        total -= log10(factor[i, i])
    fraction_brighter = _fraction_brighter(sky, detections.mag)
    last = np.int64(0)
    for k in range(len(observed)):
        # Every number of false detections is equally probable a priori, so that n of them against n - m contribute the
        # ratio n! / (n - m)!: the density drops by one detection per match.
        density = (len(detections.sigma) - k) / field_area(detections)
        last = max(last, observed[k])
        xx, yy, xy = vectors.row(detections.weight, observed[k])
        ratio = _magnitude_ratio(detections, sky, observed[k], star[k], fraction_brighter)
        total += log10(ratio * sqrt(xx * yy - xy * xy) / (2 * pi * density))
        if with_residuals:
            distance2 = squared_mahalanobis(detections, sky, R, focal_ratio, observed[k], star[k])
            total -= distance2 / 2 / log(10.0)
    return total - UNMATCHED_PENALTY_DEX * max(last + 1 - 2.0 * len(observed), 0.0)


@jit
def _fraction_brighter(sky: SkyIndex, mag: Floats) -> float:
    """Fraction of the stars that are at least as bright as the faintest detection; 1 if magnitudes are unknown."""
    faintest = mag[0]
    for value in mag:
        faintest = max(faintest, value)
    if not np.isfinite(faintest):
        return 1.0
    return max(first_from(sky.mag, 0, len(sky.mag), faintest + MAG_SMOOTHING), 1) / len(sky.mag)


@jit
def _magnitude_ratio(
    detections: Detections, sky: SkyIndex, detection: int, star: int, fraction_brighter: float
) -> float:
    """Likelihood ratio of a detection's magnitude: given its star, over a random star as bright as these.

    A fraction MAG_OUTLIER_FRACTION of the stars is taken to have any magnitude, so that one outlier costs at most
    that factor. Returns 1 if the magnitude is unknown.
    """
    difference = detections.mag[detection] - sky.mag[star]
    if not np.isfinite(difference):
        return 1.0
    relative_density = magnitude_density(sky, detections.mag[detection]) / fraction_brighter
    likelihood = (
        np.exp(-0.5 * (difference / detections.mag_sigma) ** 2)
        / detections.mag_sigma
        / sqrt(2 * pi)
    )
    return MAG_OUTLIER_FRACTION + (1 - MAG_OUTLIER_FRACTION) * likelihood / relative_density


@jit
def build_solution(detections: Detections, stars: SkyIndex, hypothesis: Hypothesis) -> Solution:
    """The solution of a hypothesis, with attitude covariance and rms residual.

    The covariance is marginalized over the focal ratio if the focal length is uncertain.
    """
    covariance = np.zeros((3, 3))
    total = 0.0
    chi2 = 0.0
    count = 4 if detections.focal_uncertainty > 0 else 3
    for axis in range(3):
        unit = np.zeros(count)
        unit[axis] = 1.0
        column = cholesky_solve(hypothesis.info[:count, :count].copy(), unit)
        for k in range(3):
            covariance[axis, k] = column[k]
    for k in range(len(hypothesis.star)):
        observed = hypothesis.observed[k]
        star = hypothesis.star[k]
        chi2 += squared_mahalanobis(
            detections, stars, hypothesis.R_cam_from_ref, hypothesis.focal_ratio, observed, star
        )
        x, y, _ = project(stars.vectors, hypothesis.R_cam_from_ref, hypothesis.star[k])
        tx = detections.tangent[hypothesis.observed[k], 0]
        ty = detections.tangent[hypothesis.observed[k], 1]
        total += (tx - hypothesis.focal_ratio * x) ** 2 + (ty - hypothesis.focal_ratio * y) ** 2
    rms = sqrt(total / max(2 * len(hypothesis.star), 1))
    chi2 /= max(2 * len(hypothesis.star) - count, 1)
    xyzw = vectors.quaternion_xyzw(hypothesis.R_cam_from_ref)
    return Solution(
        hypothesis.observed,
        hypothesis.star,
        xyzw,
        covariance,
        hypothesis.focal_ratio,
        rms,
        chi2,
        hypothesis.dex,
    )
