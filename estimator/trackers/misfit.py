"""Errors that exceed the model: a solution's matches, lens and covariance where its residuals are too great.

The claimed centroid errors may be too small, and the lens may have drifted from its calibration. Both show in the
chi-square of the residuals, but only in part: matches beyond the gate are lost. `refit` therefore takes these steps:

1. Multiply the errors by several factors and match the field again with each; keep the factor of most evidence
   (`widened`).
2. Fit the focal length and the first radial distortion coefficient with the attitude (`with_lens`).
3. Multiply the covariance by the factor that the remaining residuals imply (`least_squares.variance_factor`).

`with_companions` increases the errors of catalog stars whose residuals indicate a companion.
"""

from dataclasses import replace
from math import log, log10, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.systematic import geometry
from estimator.attitude.wahba import matrix_of
from estimator.catalog.sky_index import SkyIndex, nearest
from estimator.core import vectors
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.constants import ARCSEC_RAD
from estimator.core.jit import jit
from estimator.core.least_squares import PRIOR_RIGHT, variance_factor
from estimator.identification import star_evidence, star_search
from estimator.identification.chance import GATE_SIGMA
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
TRIED = 2.0 ** np.arange(7)  # factors of the variances that are tried
# log10 of the prior odds of each larger factor against the claimed errors.
PRIOR_WRONG_DEX = log10((1 - PRIOR_RIGHT) / PRIOR_RIGHT / (len(TRIED) - 1))
LENS_MATCHES = 6  # least number of matches for a fit of the lens
# Prior standard deviations of the lens: relative focal length, and relative distortion at the corner.
FOCAL_PRIOR = 0.01
CORNER_PRIOR = 0.01
LENS_ROUNDS = 4
SHEAR_CHANCE = 1e-4  # probability of random residuals that look sheared


def variance_of(residual: Floats, parameters: int) -> float:
    """Return the factor of the claimed variances, from (K, 2) residuals in standard deviations after a fit.

    Parameters
    ----------
    parameters
        Number of parameters of the fit
    """
    return variance_factor(float(np.sum(residual**2)), max(residual.size - parameters, 1))


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
    for n in observed:
        matched[n] = True
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
    total = weights = 0.0
    for n in range(len(TRIED)):
        weight = 10 ** (dex[n] - best_dex)
        total += weight * TRIED[n]
        weights += weight
    return total / weights


@jit
def _scaled(solution: Solution, parameters: int) -> tuple[Solution, float]:
    """Return the result of `widened` where no factor changes the matches.

    With n matches, p parameters and the variances times v, chi-square is divided by v, the density of each match by v,
    and the posterior's volume is multiplied by v^(p/2). The evidence gains
    chi2 / 2 (1 - 1 / v) + (p / 2 - n) ln v.
    """
    count = len(solution.star)
    dex = np.empty(len(TRIED))
    best = 0
    chi2 = solution.chi2 * max(2 * count - parameters, 1)
    for n in range(len(TRIED)):
        gain_dex = chi2 / 2 / log(10.0) * (1 - 1 / TRIED[n]) + (
            parameters / 2 - count
        ) * log10(TRIED[n])
        dex[n] = solution.dex + gain_dex + (PRIOR_WRONG_DEX if n else 0.0)
        best = n if dex[n] > dex[best] else best
    variance = _mean_factor(dex, dex[best])
    best_dex = dex[best] - (PRIOR_WRONG_DEX if best else 0.0)
    return with_errors(solution, variance, solution.chi2 / TRIED[best], best_dex), variance


@jit
def with_errors(solution: Solution, factor: float, chi2: float, dex: float) -> Solution:
    """Return the solution with its covariance times a factor, and with another chi-square and evidence."""
    covariance_rad2 = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            covariance_rad2[i, j] = solution.covariance_rad2[i, j] * factor
    return Solution(
        solution.observed,
        solution.star,
        solution.cam_from_ref_xyzw,
        covariance_rad2,
        solution.focal_ratio,
        solution.rms,
        chi2,
        dex,
    )


@jit
def identify(
    lights: FlatCentroids,
    sensor: Sensor,
    stars: SkyIndex,
    max_detections: int,
    max_checks: int,
) -> tuple[Solution, float]:
    """Search centroids of a calibrated camera by pairs, and match the field again where the residuals are doubtful.

    Returns the solution of `star_search.lost_in_space` and the factor of the variances: that of `widened`, or 1 without
    doubt. The factor is 0 where the residuals are so large that the calibration may be wrong: the solution is then as
    it was found.
    """
    detections = detections_of(lights, sensor, 0.0)
    solution = star_search.lost_in_space(detections, stars, max_detections, max_checks)
    if residuals_too_great(solution) or solution.focal_ratio != 1:
        return solution, 0.0
    if not len(solution.star):
        return solution, 1.0
    # A few stars may fit by luck within gates that are too narrow for the others.
    if len(solution.star) == len(detections.sigma) and solution.chi2 < DOUBTFUL:
        return solution, 1.0
    x, y, z, w = solution.cam_from_ref_xyzw
    return widened(solution, matrix_of((x, y, z, w)), detections, stars)


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
        Whether the field is stretched or sheared, as by a rolling shutter: the attitude is then
        unusable
    """

    solution: Solution
    camera: Camera
    variance: float
    sheared: bool = False


def refit(
    solution: Solution,
    detections: Detections,
    sky: SkyIndex,
    camera: Camera,
    xy_px: Floats,
    fit_lens: bool,
    variance: float = 0.0,
) -> Refit:
    """Match, fit and scale a solution again by its residuals: the numbered steps of the module.

    Parameters
    ----------
    detections
        Detections with the errors of the model, and with the focal uncertainty with which the
        solution was found
    camera
        Camera of the solution
    xy_px
        (N, 2) centroids
    fit_lens
        Whether the lens may be fitted
    variance
        Factor of the variances if step 1 has been done (`widened`); else 0
    """
    # 1. Matches
    if not variance:
        R_cam_from_ref = matrix_of(tuple(solution.cam_from_ref_xyzw.tolist()))
        solution, variance = widened(solution, R_cam_from_ref, detections, sky)
    # 2. and 3. Lens
    if fit_lens and variance >= TELLING and len(solution.star) >= LENS_MATCHES:
        return with_lens(solution, detections, sky, camera, xy_px, variance)
    return Refit(solution, camera, variance)


def with_lens(
    solution: Solution,
    detections: Detections,
    sky: SkyIndex,
    camera: Camera,
    xy_px: Floats,
    variance: float,
) -> Refit:
    """Fit attitude, focal length and the first radial distortion coefficient to the matches of a solution.

    The tangents t change by J w with a small rotation w, by t with the logarithm of the focal length, and by |t|^2 t
    with the coefficient. The two lens parameters have normal priors about the calibration. Each round:

    1. Linearize, and divide residuals and slopes by their errors (whiten).
    2. Solve the normal equations of the five unknowns, and apply the step (Gauss-Newton).
    3. Compute the factor of the variances from the remaining residuals.
    4. Reject matches beyond GATE_SIGMA of these errors.

    The covariance is that of the attitude, with the lens unknown.
    """
    cam_from_ref = Rotation.from_quat(solution.cam_from_ref_xyzw)
    keep = np.ones(len(solution.star), bool)
    information = information_of(detections.weight[solution.observed])
    whiten = np.asarray(np.linalg.cholesky(information), dtype=float).swapaxes(1, 2)
    vectors_ref = sky.vectors[solution.star]
    xy_px = xy_px[solution.observed]
    corner2 = float(np.sum(np.square(detections.field[[0, 2]])))
    prior = np.diag([0.0, 0.0, 0.0, 1 / FOCAL_PRIOR**2, (corner2 / CORNER_PRIOR) ** 2])
    lens = camera
    change = np.zeros(5)
    for _ in range(LENS_ROUNDS):
        # 1. Linearization
        tangent, by_unknowns = _linearize(cam_from_ref.apply(vectors_ref))
        slopes = whiten @ by_unknowns
        residual = (whiten @ (lens.tangents(xy_px) - tangent)[:, :, None])[:, :, 0]
        # 2. Step
        kept = slopes[keep].reshape(-1, 5)
        count = int(keep.sum())
        normal = kept.T @ kept / variance + prior
        gradient = kept.T @ residual[keep].ravel() / variance - prior @ change
        step = np.linalg.solve(normal, gradient)
        change[3:] += step[3:]
        cam_from_ref = Rotation.from_rotvec(step[:3]) * cam_from_ref
        lens = _lens_of(camera, *change[3:])
        # 3. Factor of the variances
        distance2 = np.sum((residual - slopes @ step) ** 2, axis=1)
        chi2 = float(distance2[keep].sum())
        found = variance_factor(chi2, 2 * count - 5)
        # 4. Gate
        near = distance2 <= GATE_SIGMA**2 * found
        if near.sum() < LENS_MATCHES:
            break
        keep = near
        variance = found
    rest = (residual - slopes @ step)[keep]
    sheared = _is_sheared(whiten[keep], tangent[keep], slopes[keep], rest)
    left = lens.tangents(xy_px[keep]) - _tangents(cam_from_ref.apply(vectors_ref[keep]))
    covariance = np.linalg.inv(kept.T @ kept / variance + prior)
    fitted = solution._replace(
        observed=solution.observed[keep],
        star=solution.star[keep],
        cam_from_ref_xyzw=cam_from_ref.as_quat(),
        covariance_rad2=np.asarray(covariance[:3, :3], dtype=float),
        rms=float(np.sqrt(np.mean(left**2))),
        chi2=chi2 / (2 * count - 5),
    )
    return Refit(fitted, lens, variance, sheared)


def _linearize(seen_cam: Floats) -> tuple[Floats, Floats]:
    """Return the (K, 2) tangents of directions, and their (K, 2, 5) derivatives by the unknowns of `with_lens`."""
    view = geometry(seen_cam, seen_cam)
    radial = view.tangent * np.sum(view.tangent**2, axis=1)[:, None]
    by_unknowns = [view.jacobian, view.tangent[:, :, None], radial[:, :, None]]
    return view.tangent, np.concatenate(by_unknowns, axis=2)


def _is_sheared(whiten: Floats, tangent: Floats, slopes: Floats, residual: Floats) -> bool:
    """Return whether a stretch (x, -y) and a shear (y, x) of the field explain the residuals of K matches.

    This is an F-test, which does not depend on the size of the errors: with m degrees of freedom left, random residuals
    keep no more than the share q of their chi-square with the probability q^(m/2).
    """
    x, y = tangent.T
    change = np.stack([np.stack([x, -y], axis=1), np.stack([y, x], axis=1)], axis=2)
    design = np.concatenate([slopes, whiten @ change], axis=2).reshape(-1, 7)
    errors = residual.ravel()
    solved, _, _, _ = np.linalg.lstsq(design, errors, rcond=None)
    share = np.sum((errors - design @ solved) ** 2) / np.sum(errors**2)
    return bool(share ** ((len(errors) - 7) / 2) < SHEAR_CHANCE)


def _tangents(seen_cam: Floats) -> Floats:
    """Return the (K, 2) tangents (x / z, y / z) of (K, 3) vectors in camera axes."""
    return np.asarray(seen_cam[:, :2] / seen_cam[:, 2:])


def _lens_of(camera: Camera, log_focal: float, k1: float) -> Camera:
    """Return the camera with its log focal length and first distortion coefficient changed by these amounts."""
    focal_px = camera.focal_px * float(np.exp(log_focal))
    distortion = (camera.distortion[0] + float(k1), *camera.distortion[1:])
    return replace(camera, focal_px=focal_px, distortion=distortion)


# Errors of catalog stars with a companion: a double star is not where its catalog entry is.

# Shares of the entries of Hipparcos to V = 5.75, and their errors along each axis: distances from the center of light
# of Gaia's stars within 40".
SHARE = np.array([0.86, 0.08, 0.04, 0.02])
ERROR_RAD = np.array([0.0, 0.3, 1.0, 4.0]) * ARCSEC_RAD
MIN_STARS = 4  # a star and three others
ROUNDS = 4
CHANGED = 0.9  # share of a star's information below which the field is fitted again


def are_small(sigma_rad: Floats) -> bool:
    """Return whether companions are undetectable: their greatest error is below the error of every centroid."""
    return bool(sigma_rad.min(initial=np.inf) > ERROR_RAD.max())


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
        seen = Rotation.from_quat(best.cam_from_ref_xyzw).apply(sky.vectors[best.star])
        view = geometry(seen, seen)
        residual = detections.tangent[best.observed] - best.focal_ratio * view.tangent
        own, used = (
            information_of(one.weight[best.observed]) for one in (detections, changed)
        )
        alone, spread = prediction_by_others(residual, view.jacobian, used)
        # 2. Mean information
        mean = mean_information(own, alone, spread)
        before = changed.weight[best.observed]
        weight = detections.weight.copy()
        sigma = detections.sigma.copy()
        weight[best.observed] = mean[:, [0, 1, 0], [0, 1, 1]]
        sigma[best.observed] = 1 / np.sqrt(np.linalg.eigvalsh(mean)[:, 0])
        if np.min(weight[best.observed][:, :2] / before[:, :2]) > CHANGED:
            break
        # 3. New attitude
        tried = detections._replace(weight=weight, sigma=sigma)
        R_cam_from_ref = Rotation.from_quat(best.cam_from_ref_xyzw).as_matrix()
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
    """Predict each star from all others: return its (K, 2) residuals, and the predictions' (K, 2, 2) covariances.

    N is the information of the attitude from all stars, J^T W J that of one star. Without this star the attitude moves
    by -(N - J^T W J)^-1 J^T W r, and the star's predicted position has the covariance J (N - J^T W J)^-1 J^T.

    Parameters
    ----------
    residual, jacobian, information
        (K, 2) residuals r, (K, 2, 3) Jacobians J and (K, 2, 2) inverse covariances W, for the
        attitude that fits all stars
    """
    weighted = np.swapaxes(jacobian, 1, 2) @ information
    each = weighted @ jacobian
    others = each.sum(axis=0) - each
    # N - J^T W J, inverted with a unit diagonal and a small term against singular matrices
    size = np.sqrt(np.einsum("kii->ki", others))
    scaled = others / (size[:, :, None] * size[:, None, :]) + 1e-9 * np.eye(3)
    covariance = np.linalg.inv(scaled) / (size[:, :, None] * size[:, None, :])
    moved = (covariance @ weighted @ residual[:, :, None])[:, :, 0]
    alone = residual + np.einsum("kij,kj->ki", jacobian, moved)
    return alone, jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)


def mean_information(information: Floats, residual: Floats, spread: Floats) -> Floats:
    """Return sum_j g_j (S + c_j^2 I)^-1, (K, 2, 2): mean inverse covariances of stars (`with_companions`).

    Parameters
    ----------
    information
        (K, 2, 2) S^-1, inverse covariance of each centroid alone
    residual, spread
        (K, 2) residuals r from the prediction by the others, and its (K, 2, 2) covariance P
    """
    # S + c_j^2 I, and with the prediction's P
    excess = ERROR_RAD[:, None, None, None] ** 2 * np.eye(2)
    covariance = np.linalg.inv(information) + excess
    total = covariance + spread
    distance2 = np.einsum("ki,jkim,km->jk", residual, np.linalg.inv(total), residual)
    # Posterior probabilities g_j, from ln p_j - ln det / 2 - r^T (S + P + c_j^2 I)^-1 r / 2
    log_density = (
        np.log(SHARE)[:, None] - 0.5 * np.log(np.linalg.det(total)) - 0.5 * distance2
    )
    probability = np.exp(log_density - log_density.max(axis=0))
    probability /= probability.sum(axis=0)
    return np.asarray(
        np.einsum("jk,jkim->kim", probability, np.linalg.inv(covariance)), dtype=float
    )
