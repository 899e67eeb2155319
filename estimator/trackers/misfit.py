"""Errors that exceed the model: a solution's matches and covariance where its residuals are too great.

The claimed centroid errors may be too small. This shows in the chi-square of the residuals, but only in part: matches
beyond the gate are lost. `widened` therefore multiplies the errors by several factors, matches the field again with
each, and keeps the factor of most evidence. `lens_fit` then fits the camera, where the residuals remain too great.

`with_companions` increases the errors of catalog stars whose residuals indicate a companion.
"""

from math import atan2, cos, log, log10, pi, sin, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.wahba import matrix_of
from estimator.catalog.sky_index import SkyIndex, nearest
from estimator.core import least_squares, vectors
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.constants import ARCSEC_RAD
from estimator.core.jit import jit
from estimator.core.least_squares import PRIOR_RIGHT
from estimator.identification import star_evidence, star_search
from estimator.identification.chance import GATE_SIGMA, least
from estimator.identification.star_detections import (
    Detections,
    FlatCentroids,
    Sensor,
    changed,
    detections_of,
    gates_of,
    information_of,
    ray,
)
from estimator.identification.star_evidence import Solution

TELLING = 1.5  # variance factor above which the lens is fitted
DOUBTFUL = 0.7  # reduced chi-square above which larger errors are tried, also where every centroid is matched
TRIED = 2.0 ** np.arange(11)  # factors of the variances that are tried
# log10 of the prior odds of each larger factor against the claimed errors.
PRIOR_WRONG_DEX = log10((1 - PRIOR_RIGHT) / PRIOR_RIGHT / (len(TRIED) - 1))
# A `Sensor` and a `SkyIndex` as plain tuples: numba takes three times as long to read named ones
Known = tuple[tuple[Any, ...], ...]
LENS_MATCHES = 6  # least number of matches for a fit of the lens


@jit
def widened(
    solution: Solution, R_cam_from_ref: Floats, detections: Detections, sky: SkyIndex
) -> tuple[Solution, float]:
    """Return the solution with the errors of most evidence, and the expected factor of the variances.

    Matches beyond the gates are lost, so each factor has its own matches.

    1. If no unmatched detection is near a star, no factor changes the matches: scale the evidence (`_scaled`).
    2. Otherwise match the field with each factor, and compute the evidence.
    3. The expected factor is the mean over all, weighted by their Bayes factors with the prior of
       `least_squares.variance_factor`. It multiplies the covariance.

    Parameters
    ----------
    detections
        Detections with the errors of the model, and with the focal uncertainty with which the
        solution was found
    """
    # 1. Detections near a star within the widest gates
    gates = gates_of(detections, 1.5 * sqrt(TRIED[-1]))
    ratio = solution.focal_ratio
    near = count_near(
        detections.tangent, sky, R_cam_from_ref, ratio, solution.observed, gates
    )
    if near == 0:
        return _scaled(solution, 4 if detections.focal_uncertainty > 0 else 3)
    # 2. Evidence of each factor
    best = solution
    chosen = 0
    best_dex = solution.dex
    dex = np.empty(len(TRIED))
    dex[0] = solution.dex
    for n in range(1, len(TRIED)):
        wide = changed(detections, TRIED[n], detections.focal_uncertainty)
        found = star_evidence.evaluate(
            wide, sky, R_cam_from_ref.copy(), ratio, gates_of(wide, 1.5), -np.inf
        )
        dex[n] = found.dex + PRIOR_WRONG_DEX
        if dex[n] > best_dex:
            best = star_evidence.build_solution(wide, sky, found)
            chosen = n
            best_dex = dex[n]
    # 3. Expected factor
    variance = _mean_factor(dex, best_dex)
    return with_errors(best, variance / TRIED[chosen], best.chi2, best.dex), variance


@jit
def count_near(
    tangent: Floats,
    sky: SkyIndex,
    R_cam_from_ref: Floats,
    focal_ratio: float,
    observed: NDArray,
    gates: Floats,
) -> int:
    """Number of detections that are not `observed` and have a star nearby.

    Parameters
    ----------
    observed
        (K,) rows of the matched detections, which are left out
    gates
        (N,) rad, greatest distance of a star; at most 0.05 is used
    """
    R_ref_from_cam = R_cam_from_ref.T.copy()
    count = 0
    matched = np.zeros(len(gates), np.bool_)
    matched[observed] = True
    for n in range(len(gates)):
        if matched[n]:
            continue
        # The star nearest to the detection's direction in the catalog's frame.
        x, y, z = vectors.rotate(R_ref_from_cam, ray(tangent, n, focal_ratio))
        gate = min(gates[n], 0.05)
        s, _ = nearest(sky.vectors, sky.cell_first, sky.cell_star, sky.side, x, y, z, gate)
        count += s >= 0
    return count


@jit
def _mean_factor(dex: Floats, best_dex: float) -> float:
    """Return the mean of the factors TRIED, weighted by their Bayes factors 10^dex."""
    weights = 10 ** (dex - best_dex)
    return np.sum(weights * TRIED) / np.sum(weights)


@jit
def _scaled(solution: Solution, parameters: int) -> tuple[Solution, float]:
    """Return the result of `widened` where no factor changes the matches.

    With n matches, p parameters and the variances times v, chi-square is divided by v, the density of each match by v,
    and the posterior's volume is multiplied by v^(p/2). The evidence gains
    chi2 / 2 (1 - 1 / v) + (p / 2 - n) ln v.
    """
    count = len(solution.star)
    chi2 = solution.chi2 * max(2 * count - parameters, 1)
    gain_dex = np.empty(len(TRIED))
    weighted_dex = np.empty(len(TRIED))
    for n in range(len(TRIED)):
        gain_dex[n] = chi2 / 2 / log(10.0) * (1 - 1 / TRIED[n])
        gain_dex[n] += (parameters / 2 - count) * log10(TRIED[n])
        weighted_dex[n] = gain_dex[n] + (PRIOR_WRONG_DEX if n else 0.0)
    best = np.argmax(weighted_dex)
    variance = _mean_factor(weighted_dex, weighted_dex[best])
    dex = solution.dex + gain_dex[best]
    return with_errors(solution, variance, solution.chi2 / TRIED[best], dex), variance


@jit
def with_errors(solution: Solution, factor: float, chi2: float, dex: float) -> Solution:
    """Return the solution with its covariance times a factor, and with another chi-square and evidence."""
    return Solution(
        solution.observed,
        solution.star,
        solution.cam_from_ref_xyzw,
        solution.covariance_rad2 * factor,
        solution.focal_ratio,
        solution.rms,
        chi2,
        dex,
    )


@jit
def identify(
    lights: FlatCentroids, known: Known, max_detections: int, max_checks: int
) -> tuple[Solution, float] | None:
    """Search centroids of a calibrated camera, and match the field again where the residuals are doubtful.

    Returns the solution of `star_search.lost_in_space` and the factor of the variances: that of `widened`, or 1 without
    doubt. The factor is 0 where the residuals are so large that the calibration may be wrong: the solution is then as
    it was found. Returns None, without a search, where companions are detectable: `with_companions` is then to look for
    them before the doubt.
    """
    sensor, sky = known
    detections = detections_of(lights, Sensor(*sensor), 0.0)
    if not are_small(detections.sigma):
        return None
    stars = SkyIndex(*sky)
    solution = star_search.lost_in_space(detections, stars, max_detections, max_checks)
    if residuals_too_great(solution) or solution.focal_ratio != 1:
        return solution, 0.0
    if not len(solution.star):
        return solution, 1.0
    # A few stars may fit by luck within gates that are too narrow for the others.
    if len(solution.star) == len(detections.sigma) and solution.chi2 < DOUBTFUL:
        return solution, 1.0
    return widened(solution, matrix_of(solution.cam_from_ref_xyzw), detections, stars)


@jit
def residuals_too_great(solution: Solution) -> bool:
    """Return whether a solution's reduced chi-square exceeds 1 by more than three standard deviations."""
    return solution.chi2 > 1 + 3 / sqrt(max(len(solution.star), 1))


class Refit(NamedTuple):
    """A solution with the errors and the lens that its residuals imply.

    Attributes
    ----------
    solution
        Solution with the covariance multiplied by `variance`
    camera
        Camera with the fitted lens
    variance
        Factor of the claimed variances
    sheared
        Whether the field is sheared, as by a rolling shutter: the attitude is then unusable
    detections
        Detections that the solution is of, with the errors of companions; None with a fitted camera
    """

    solution: Solution
    camera: Camera
    variance: float
    sheared: bool = False
    detections: Detections | None = None


# The least error of a centroid, however bright the star: of the pixels, the lens and the catalog.

# Floors that are considered, with equal probabilities of equal ratios
FLOORS_PX = np.geomspace(0.005, 1.28, 13)


@jit
def with_floor(
    solution: Solution,
    detections: Detections,
    sky: SkyIndex,
    searched_px: float,
    focal_px: float,
) -> tuple[Solution, float]:
    """Return the solution with the floor of the errors that its residuals imply, and the mean square of it, px^2.

    The variance of a residual along an axis is s_i + f^2, of the centroid's own noise and of a floor f that all share.
    Integrated over the attitude, with design J, W = 1 / (s + f^2) and N = J^T W J, the likelihood of the floor is

        L(f) = |W|^(1/2) |N|^(-1/2) exp(-(r^T W r - g^T N^-1 g) / 2),  g = J^T W r

    (restricted likelihood: H. D. Patterson & R. Thompson, Biometrika 58, 545 (1971)). With few stars the prior, even
    in ln f (Jeffreys), counts. The floor is averaged over, as in Gelman et al., Bayesian Data Analysis, section 3.2:

    1. Turn each match to the axes of its error ellipse: rows of J and r, and the variances without `searched_px`.
    2. For each of FLOORS_PX compute L, the step N^-1 g of the attitude and its covariance N^-1.
    3. Apply the mean step. Its covariance is the mean of N^-1 plus the scatter of the steps.

    Parameters
    ----------
    detections
        Detections with the errors of the search, whose floor is searched_px
    """
    # 1. Rows
    R = matrix_of(solution.cam_from_ref_xyzw)
    size = 4 if detections.focal_uncertainty > 0 else 3
    count = 2 * len(solution.star)
    rows = np.empty((size + 1, count))
    own_px2 = np.empty(count)
    for k in range(count):
        own_px2[k] = _principal_row(solution, detections, sky, R, k, focal_px, rows[:, k])
    own_px2 = np.maximum(own_px2 - searched_px**2, 0.0)
    # 2. Floors
    floors = len(FLOORS_PX)
    likelihood = np.empty(floors)
    step = np.empty((floors, size))
    inverse = np.empty((floors, size, size))
    normal = np.empty((size + 1, size + 1))
    for n in range(floors):
        weight = 1 / (own_px2 + FLOORS_PX[n] ** 2)
        least_squares.normal_equations(rows, weight, count, normal)
        fall = least_squares.step(normal, step[n])
        likelihood[n] = (np.sum(np.log(weight)) - normal[size, size] + fall) / 2
        for i in range(size):
            likelihood[n] -= log(normal[i, i])
            inverse[n, i] = 0.0
            inverse[n, i, i] = 1.0
            least_squares.cholesky_solve(normal, inverse[n, i])
    # 3. Means
    share = np.exp(likelihood - likelihood.max())
    share /= share.sum()
    mean = step.T @ share
    covariance_rad2 = np.zeros((3, 3))
    for n in range(floors):
        scatter = (step[n] - mean)[:3]
        covariance_rad2 += share[n] * (inverse[n, :3, :3] + np.outer(scatter, scatter))
    vectors.rotate_in_place(mean[:3], R)
    ratio = solution.focal_ratio * (np.exp(mean[3]) if size == 4 else 1.0)
    return Solution(
        solution.observed,
        solution.star,
        vectors.quaternion_xyzw(R),
        covariance_rad2,
        ratio,
        solution.rms,
        solution.chi2,
        solution.dex,
    ), np.sum(share * FLOORS_PX**2)


@jit
def _principal_row(
    solution: Solution,
    detections: Detections,
    sky: SkyIndex,
    R: Floats,
    k: int,
    focal_px: float,
    out: Floats,
) -> float:
    """Write slopes and residual along an axis of match k // 2's error ellipse, in pixels; return its variance, px^2."""
    f = solution.focal_ratio
    n = solution.observed[k // 2]
    x, y = star_evidence.project(sky.vectors, R, solution.star[k // 2])
    d_x = np.empty(4)
    d_y = np.empty(4)
    star_evidence.slopes(x, y, f, d_x, d_y)
    # Eigenvalues of the inverse covariance [xx xy; xy yy], and the direction of the first
    xx, yy, xy = vectors.row(detections.weight, n)
    gap = sqrt((xx - yy) ** 2 / 4 + xy * xy)
    angle = atan2(2 * xy, xx - yy) / 2 + (k % 2) * pi / 2
    a = cos(angle) * focal_px
    b = sin(angle) * focal_px
    for i in range(len(out) - 1):
        out[i] = a * d_x[i] + b * d_y[i]
    out[-1] = a * (detections.tangent[n, 0] - f * x) + b * (detections.tangent[n, 1] - f * y)
    return focal_px**2 / ((xx + yy) / 2 + (gap if k % 2 == 0 else -gap))


# Errors of catalog stars with a companion: a double star is not where its catalog entry is.

# Shares of the entries of Hipparcos to V = 5.75, and their errors along each axis: distances from the center of light
# of Gaia's stars within 40".
SHARE = np.array([0.86, 0.08, 0.04, 0.02])
ERROR_RAD = np.array([0.0, 0.3, 1.0, 4.0]) * ARCSEC_RAD
MIN_STARS = 4  # a star and three others
ROUNDS = 4
CHANGED = 0.9  # share of a star's information below which the field is fitted again


@jit
def are_small(sigma_rad: Floats) -> bool:
    """Return whether companions are undetectable: their greatest error is below the error of every centroid."""
    return least(sigma_rad) > ERROR_RAD[-1]


def with_companions(
    solution: Solution, detections: Detections, sky: SkyIndex
) -> tuple[Solution, Detections]:
    """Return the solution and its detections with larger errors for stars whose residuals indicate a companion.

    A catalog gives a double star the position of one component, of the center of light in another band, or of a mean
    epoch. Most entries are better than any centroid, but some are wrong by arcseconds. In a field with a bright double
    the attitude would follow it, and the covariance would not include that error. The share p_j of the stars has errors
    of c_j along each axis. Each round:

    1. Predict each star from all others: the residual r and the covariance P of the prediction
       (`prediction_by_others`).
    2. With the covariance S of the centroid, r has the density sum_j p_j N(0, S + P + c_j^2 I), which gives the
       posterior probabilities g_j. The star then has the information sum_j g_j (S + c_j^2 I)^-1 (`mean_information`).
    3. Fit the attitude again with this information; stop if it hardly changes, or if matches are lost.

    Both are unchanged where every centroid's own error is larger than any companion's.
    """
    if len(solution.star) < MIN_STARS or are_small(detections.sigma):
        return solution, detections
    best = solution
    changed = detections
    for _ in range(ROUNDS):
        # 1. Prediction by the other stars
        R_cam_from_ref = matrix_of(best.cam_from_ref_xyzw)
        x, y, z = R_cam_from_ref @ sky.vectors[best.star].T
        x /= z
        y /= z
        residual = detections.tangent[best.observed].T - best.focal_ratio * np.array([x, y])
        jacobian = np.array([[-x * y, 1 + x * x, -y], [-1 - y * y, x * y, x]])
        own, used = (
            information_of(one.weight[best.observed]).T for one in (detections, changed)
        )
        alone, spread = prediction_by_others(residual, jacobian, used)
        # 2. Mean information
        mean = mean_information(own, alone, spread)
        if np.min(np.diagonal(mean) / np.diagonal(used)) > CHANGED:
            break
        weight = detections.weight.copy()
        sigma = detections.sigma.copy()
        weight[best.observed] = mean[[0, 1, 0], [0, 1, 1]].T
        sigma[best.observed] = 1 / np.sqrt(np.linalg.eigvalsh(mean.T)[:, 0])
        # 3. New attitude
        tried = detections._replace(weight=weight, sigma=sigma)
        found = star_evidence.evaluate(
            tried, sky, R_cam_from_ref, best.focal_ratio, GATE_SIGMA * sigma, -np.inf
        )
        if len(found.star) < len(best.star):
            break
        best = star_evidence.build_solution(tried, sky, found)
        changed = tried
    return best, changed


def prediction_by_others(
    residual: Floats, jacobian: Floats, information: Floats
) -> tuple[Floats, Floats]:
    """Predict each star from all others: return its (2, K) residuals, and the predictions' (2, 2, K) covariances.

    N is the information of the attitude from all stars, J^T W J that of one star. Predicted by all, a star has the
    covariance H = J N^-1 J^T; without itself J (N - J^T W J)^-1 J^T = P = (H^-1 - W)^-1. The residual grows by P W r.

    Parameters
    ----------
    residual, jacobian, information
        (2, K) residuals r, (2, 3, K) Jacobians J and (2, 2, K) inverse covariances W, for the
        attitude that fits all stars
    """
    normal = np.einsum("aik,abk,bjk->ij", jacobian, information, jacobian)
    by_all = np.einsum("aik,ij,bjk->abk", jacobian, np.linalg.inv(normal), jacobian)
    spread = _inverse(_inverse(by_all) - information)
    return residual + np.einsum("abk,bck,ck->ak", spread, information, residual), spread


def mean_information(information: Floats, residual: Floats, spread: Floats) -> Floats:
    """Return sum_j g_j (S + c_j^2 I)^-1, (2, 2, K): mean inverse covariances of stars (`with_companions`).

    Parameters
    ----------
    information
        (2, 2, K) S^-1, inverse covariance of each centroid alone
    residual, spread
        (2, K) residuals r from the prediction by the others, and its (2, 2, K) covariance P
    """
    # S + c_j^2 I, and with the prediction's P: (2, 2, J, K)
    wide = _inverse(information)[:, :, None] + np.multiply.outer(
        np.eye(2), ERROR_RAD[:, None] ** 2
    )
    total = _inverse(wide + spread[:, :, None])
    distance2 = np.einsum("ak,abjk,bk->jk", residual, total, residual)
    # Posterior probabilities g_j, from ln p_j - ln det / 2 - r^T (S + P + c_j^2 I)^-1 r / 2
    log_det = np.linalg.slogdet(total.T)[1].T
    log_density = np.log(SHARE)[:, None] + (log_det - distance2) / 2
    probability = np.exp(log_density - log_density.max(axis=0))
    probability /= probability.sum(axis=0)
    return np.asarray(np.einsum("jk,abjk->abk", probability, _inverse(wide)))


def _inverse(matrix: Floats) -> Floats:
    """Return the inverses of (2, 2, ...) matrices: in a tenth of the time of `np.linalg.inv`."""
    (a, b), (c, d) = matrix
    return np.array([[d, -b], [-c, a]]) / (a * d - b * c)
