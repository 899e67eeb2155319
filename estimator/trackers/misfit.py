"""Errors that exceed the model: a solution's matches, lens and covariance where its residuals are too great.

The claimed centroid errors may be too small, and the lens may have drifted from its calibration. Both show in the
chi-square of the residuals, but only in part: matches beyond the gate are lost. The errors are therefore multiplied by
the factor that the residuals tell and the field is matched again, as long as the evidence rises (`widened`). Then the
focal length and the first radial distortion coefficient are fitted with the attitude (`with_lens`), and what the
residuals still exceed multiplies the covariance (`least_squares.variance_factor`).
"""

from __future__ import annotations

from dataclasses import replace
from math import log, log10, sqrt
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.systematic import geometry
from estimator.attitude.wahba import matrix_of
from estimator.catalog.sky_index import SkyIndex
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
)
from estimator.identification.star_evidence import Solution

TELLING = 1.5  # variance factor above which matches and lens are tried anew
DOUBTFUL = 0.7  # reduced chi-square above which greater errors are tried, also where every centroid is matched
TRIED = 2.0 ** np.arange(7)  # factors of the variances
PRIOR_WRONG_DEX = log10(
    (1 - PRIOR_RIGHT) / PRIOR_RIGHT / (len(TRIED) - 1)
)  # of each, beside the claimed errors
LENS_MATCHES = 6  # least number of matches for a fit of the lens
# standard deviations: relative focal length, distortion at the corner
FOCAL_PRIOR = 0.01
CORNER_PRIOR = 0.01
LENS_ROUNDS = 4
SHEAR_CHANCE = 1e-4  # probability of random residuals that look sheared


def variance_of(residual: Floats, parameters: int) -> float:
    """Factor of the claimed variances by (K, 2) residuals in standard deviations, after a fit of some parameters."""
    return variance_factor(float(np.sum(residual**2)), max(residual.size - parameters, 1))


@jit
def widened(
    solution: Solution, R_cam_from_ref: Floats, detections: Detections, sky: SkyIndex
) -> tuple[Solution, float]:
    """The solution with the errors of most evidence, and the expected factor of the variances over all that were tried.

    The gates hide how great the errors are, so that each factor has its own matches; their Bayes factors, with the
    prior of `least_squares.variance_factor`, are their weights. The covariance is multiplied by the factor.

    Parameters
    ----------
    detections
        With the errors of the model, and the focal uncertainty with which the solution was
        found
    """
    gates = gates_of(detections, 1.5 * sqrt(TRIED[-1]))
    ratio = solution.focal_ratio
    if (
        star_evidence.count_near(
            detections.tangent, sky, R_cam_from_ref, ratio, solution.observed, gates
        )
        == 0
    ):
        return _scaled(solution, 4 if detections.focal_uncertainty > 0 else 3)
    best = solution
    chosen = 0
    best_dex = solution.dex
    dex = np.empty(len(TRIED))
    dex[0] = solution.dex
    for n in range(1, len(TRIED)):
        wide = changed(detections, len(detections.sigma), TRIED[n], detections.focal_uncertainty)
        found = star_evidence.evaluate(
            wide, sky, R_cam_from_ref.copy(), ratio, gates_of(wide, 1.5), -np.inf
        )
        dex[n] = found.dex + PRIOR_WRONG_DEX
        if dex[n] > best_dex:
            best = star_evidence.build_solution(wide, sky, found)
            chosen = n
            best_dex = dex[n]
    variance = _mean_factor(dex, best_dex)
    return with_errors(best, variance / TRIED[chosen], best.chi2, best.dex), variance


@jit
def _mean_factor(dex: Floats, best_dex: float) -> float:
    """Mean of the factors TRIED, weighted by their Bayes factors."""
    total = weights = 0.0
    for n in range(len(TRIED)):
        weight = 10 ** (dex[n] - best_dex)
        total += weight * TRIED[n]
        weights += weight
    return total / weights


@jit
def _scaled(solution: Solution, parameters: int) -> tuple[Solution, float]:
    """As `widened`, where no factor changes the matches.

    With n matches, p parameters and the variances times v, chi-square is divided by v, the density of each match by v,
    and the posterior's volume is multiplied by v^(p/2).
    """
    count = len(solution.star)
    dex = np.empty(len(TRIED))
    best = 0
    chi2 = solution.chi2 * max(2 * count - parameters, 1)
    for n in range(len(TRIED)):
        gain_dex = chi2 / 2 / log(10.0) * (1 - 1 / TRIED[n]) + (parameters / 2 - count) * log10(
            TRIED[n]
        )
        dex[n] = solution.dex + gain_dex + (PRIOR_WRONG_DEX if n else 0.0)
        best = n if dex[n] > dex[best] else best
    variance = _mean_factor(dex, dex[best])
    best_dex = dex[best] - (PRIOR_WRONG_DEX if best else 0.0)
    return with_errors(solution, variance, solution.chi2 / TRIED[best], best_dex), variance


@jit
def with_errors(solution: Solution, factor: float, chi2: float, dex: float) -> Solution:
    """The solution with its covariance times a factor, and another chi-square and evidence."""
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
    lights: FlatCentroids, sensor: Sensor, stars: SkyIndex, max_detections: int, max_checks: int
) -> tuple[Solution, float]:
    """Search centroids of a calibrated camera by pairs, and match and scale anew where the residuals are doubtful.

    Returns the solution of `search.lost_in_space`, and the factor of the variances: that of `widened`, 1 without doubt.
    It is 0 where the residuals are so great that the calibration may be wrong: the solution is then as it was found.
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
    """Whether the residuals of a solution exceed their errors by more than three standard deviations of chi-square."""
    return solution.chi2 > 1 + 3 / sqrt(max(len(solution.star), 1))


class Refit(NamedTuple):
    """A solution with the errors and the lens that its residuals tell.

    Attributes
    ----------
    solution
        With the covariance multiplied by `variance`
    camera
        With the fitted lens
    variance
        Factor of the claimed variances
    sheared
        Whether the field is stretched or sheared, as by a rolling shutter: its attitude is none
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
    """The solution matched, fitted and scaled anew by its residuals.

    Parameters
    ----------
    detections
        With the errors of the model, and the focal uncertainty with which the solution was
        found
    camera
        Of the solution
    xy_px
        (N, 2) centroids
    variance
        Factor of the variances if the solution has been matched anew (`widened`); else 0
    """
    if not variance:
        R_cam_from_ref = matrix_of(tuple(solution.cam_from_ref_xyzw.tolist()))
        solution, variance = widened(solution, R_cam_from_ref, detections, sky)
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

    Gauss-Newton steps of the tangents t: t changes by J w with a small rotation w, by t with the logarithm of the focal
    length, and by |t|^2 t with the coefficient. Both have normal priors about the calibration. Each round drops matches
    beyond GATE_SIGMA of the errors that the last one found. The covariance is that of the attitude, whatever the lens.
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
        seen = cam_from_ref.apply(vectors_ref)
        view = geometry(seen, seen)
        radial = view.tangent * np.sum(view.tangent**2, axis=1)[:, None]
        slopes = whiten @ np.concatenate(
            [view.jacobian, view.tangent[:, :, None], radial[:, :, None]], axis=2
        )
        residual = (whiten @ (lens.tangents(xy_px) - view.tangent)[:, :, None])[:, :, 0]
        kept = slopes[keep].reshape(-1, 5)
        count = int(keep.sum())
        normal = kept.T @ kept / variance + prior
        step = np.linalg.solve(normal, kept.T @ residual[keep].ravel() / variance - prior @ change)
        change[3:] += step[3:]
        cam_from_ref = Rotation.from_rotvec(step[:3]) * cam_from_ref
        lens = _lens_of(camera, *change[3:])
        distance2 = np.sum((residual - slopes @ step) ** 2, axis=1)
        chi2 = float(distance2[keep].sum())
        found = variance_factor(chi2, 2 * count - 5)
        near = distance2 <= GATE_SIGMA**2 * found
        if near.sum() < LENS_MATCHES:
            break
        keep = near
        variance = found
    sheared = _is_sheared(
        whiten[keep], view.tangent[keep], slopes[keep], (residual - slopes @ step)[keep]
    )
    left = lens.tangents(xy_px[keep]) - _tangents(cam_from_ref.apply(vectors_ref[keep]))
    fitted = solution._replace(
        observed=solution.observed[keep],
        star=solution.star[keep],
        cam_from_ref_xyzw=cam_from_ref.as_quat(),
        covariance_rad2=np.linalg.inv(kept.T @ kept / variance + prior)[:3, :3],
        rms=float(np.sqrt(np.mean(left**2))),
        chi2=chi2 / (2 * count - 5),
    )
    return Refit(fitted, lens, variance, sheared)


def _is_sheared(whiten: Floats, tangent: Floats, slopes: Floats, residual: Floats) -> bool:
    """Whether a stretch (x, -y) and a shear (y, x) of the field explain the residuals of K matches.

    By an F-test, whatever the errors: with m degrees of freedom left, random residuals keep no more than the share q of
    their chi-square with the probability q^(m/2).
    """
    x, y = tangent.T
    change = np.stack([np.stack([x, -y], axis=1), np.stack([y, x], axis=1)], axis=2)
    design = np.concatenate([slopes, whiten @ change], axis=2).reshape(-1, 7)
    errors = residual.ravel()
    solved, _, _, _ = np.linalg.lstsq(design, errors, rcond=None)
    share = np.sum((errors - design @ solved) ** 2) / np.sum(errors**2)
    return bool(share ** ((len(errors) - 7) / 2) < SHEAR_CHANCE)


def _tangents(seen_cam: Floats) -> Floats:
    return np.asarray(seen_cam[:, :2] / seen_cam[:, 2:])


def _lens_of(camera: Camera, log_focal: float, k1: float) -> Camera:
    """The camera with its log focal length and first distortion coefficient changed."""
    focal_px = camera.focal_px * float(np.exp(log_focal))
    distortion = (camera.distortion[0] + float(k1), *camera.distortion[1:])
    return replace(camera, focal_px=focal_px, distortion=distortion)


# Errors of catalog stars with a companion: a double star is not where its catalog entry is.


# Of the entries of Hipparcos to V = 5.75: their distances from the center of light of Gaia's stars within 40".
SHARE = np.array([0.86, 0.08, 0.04, 0.02])
ERROR_RAD = np.array([0.0, 0.3, 1.0, 4.0]) * ARCSEC_RAD
MIN_STARS = 4  # a star and three others
ROUNDS = 4
CHANGED = 0.9  # share of a star's information below which the field is fitted again


def are_small(sigma_rad: Floats) -> bool:
    """Whether the errors of all centroids are greater than those of any companion, so that none can show."""
    return bool(sigma_rad.min(initial=np.inf) > ERROR_RAD.max())


def with_companions(
    solution: Solution, detections: Detections, sky: SkyIndex
) -> tuple[Solution, Detections]:
    """The solution and its detections, with the errors of the stars whose residuals tell of a companion.

    Unchanged where every centroid's own error is greater than any companion's.
    """
    if len(solution.star) < MIN_STARS or are_small(detections.sigma):
        return solution, detections
    best = solution
    changed = detections
    for _ in range(ROUNDS):
        seen = Rotation.from_quat(best.cam_from_ref_xyzw).apply(sky.vectors[best.star])
        view = geometry(seen, seen)
        residual = detections.tangent[best.observed] - best.focal_ratio * view.tangent
        own, used = (information_of(one.weight[best.observed]) for one in (detections, changed))
        alone, spread = prediction_by_others(residual, view.jacobian, used)
        mean = mean_information(own, alone, spread)
        before = changed.weight[best.observed]
        weight = detections.weight.copy()
        sigma = detections.sigma.copy()
        weight[best.observed] = mean[:, [0, 1, 0], [0, 1, 1]]
        sigma[best.observed] = 1 / np.sqrt(np.linalg.eigvalsh(mean)[:, 0])
        if np.min(weight[best.observed][:, :2] / before[:, :2]) > CHANGED:
            break
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
    """(K, 2) residuals of stars from the attitude of all others, and (K, 2, 2) the covariances of what these predict.

    With the information N of the attitude and J' W J that of one star, the attitude without it moves by
    -(N - J' W J)^-1 J' W r.

    Parameters
    ----------
    residual, jacobian, information
        (K, 2), (K, 2, 3) and (K, 2, 2) of the attitude that fits them all
    """
    weighted = np.swapaxes(jacobian, 1, 2) @ information
    each = weighted @ jacobian
    others = each.sum(axis=0) - each
    size = np.sqrt(np.einsum("kii->ki", others))
    scaled = others / (size[:, :, None] * size[:, None, :]) + 1e-9 * np.eye(3)
    covariance = np.linalg.inv(scaled) / (size[:, :, None] * size[:, None, :])
    moved = (covariance @ weighted @ residual[:, :, None])[:, :, 0]
    alone = residual + np.einsum("kij,kj->ki", jacobian, moved)
    return alone, jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)


def mean_information(information: Floats, residual: Floats, spread: Floats) -> Floats:
    """(K, 2, 2) mean inverse covariances of stars by their residuals (K, 2) from what the others predict.

    Parameters
    ----------
    information, spread
        (K, 2, 2) of the centroid alone, and covariance of the prediction
    """
    excess = ERROR_RAD[:, None, None, None] ** 2 * np.eye(2)
    covariance = np.linalg.inv(information) + excess
    total = covariance + spread
    distance2 = np.einsum("ki,jkim,km->jk", residual, np.linalg.inv(total), residual)
    log_density = np.log(SHARE)[:, None] - 0.5 * np.log(np.linalg.det(total)) - 0.5 * distance2
    probability = np.exp(log_density - log_density.max(axis=0))
    probability /= probability.sum(axis=0)
    return np.asarray(
        np.einsum("jk,jkim->kim", probability, np.linalg.inv(covariance)), dtype=float
    )
