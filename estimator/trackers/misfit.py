"""Errors that exceed the model: a solution's matches, lens and covariance where its residuals are too great.

The claimed centroid errors may be too small, and the lens may have drifted from its calibration. Both show in the
chi-square of the residuals, but only in part: matches beyond the gate are lost. The errors are therefore multiplied by
the factor that the residuals tell and the field is matched again, as long as the evidence rises (`widened`). Then the
focal length and the first radial distortion coefficient are fitted with the attitude (`with_lens`), and what the
residuals still exceed multiplies the covariance (`least_squares.variance_factor`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.systematic import geometry
from estimator.catalog.sky_index import SkyIndex
from estimator.core.arrays import Floats
from estimator.core.camera import Camera
from estimator.core.least_squares import PRIOR_RIGHT, variance_factor
from estimator.identification.chance import GATE_SIGMA
from estimator.identification.stars import evidence
from estimator.identification.stars.evidence import Detections, Solution

TELLING = 1.2  # variance factor above which matches and lens are tried anew
DOUBTFUL = 1.0  # reduced chi-square above which greater errors are tried
TRIED = 2.0 ** np.arange(7)  # factors of the variances
PRIOR_WRONG = (1 - PRIOR_RIGHT) / (len(TRIED) - 1)
LENS_MATCHES = 6  # least number of matches for a fit of the lens
FOCAL_PRIOR, CORNER_PRIOR = 0.01, 0.01  # standard deviations: relative focal length, distortion at the corner
LENS_ROUNDS = 4


def degrees_of_freedom(solution: Solution, free_focal: bool) -> int:
    """Two for each match, less those of the attitude and of a free focal length."""
    return max(2 * len(solution.star) - (4 if free_focal else 3), 1)


def scale_of(solution: Solution, free_focal: bool, assumed: float = 1.0) -> float:
    """Factor of the claimed variances by the residuals of a solution, which assumed another factor."""
    dof = degrees_of_freedom(solution, free_focal)
    return variance_factor(assumed * solution.chi2 * dof, dof)


def variance_of(residual: Floats, parameters: int) -> float:
    """Factor of the claimed variances by (K, 2) residuals in standard deviations, after a fit of some parameters."""
    return variance_factor(float(np.sum(residual**2)), max(residual.size - parameters, 1))


def scaled(detections: Detections, variance: float) -> Detections:
    """The detections with their variances multiplied."""
    return detections._replace(sigma=np.sqrt(variance) * detections.sigma, weight=detections.weight / variance)


def widened(solution: Solution, detections: Detections, sky: SkyIndex) -> tuple[Solution, float]:
    """The solution with the errors of most evidence, and the expected factor of the variances over all that were tried.

    The gates hide how great the errors are, so that each factor has its own matches; their Bayes factors, with the
    prior of `least_squares.variance_factor`, are their weights.
    detections : with the errors of the model, and the focal uncertainty with which the solution was found
    """
    if solution.chi2 < DOUBTFUL:
        return solution, 1.0
    tried = [solution, *(_matched(solution, scaled(detections, variance), sky) for variance in TRIED[1:])]
    dex = np.array([one.dex for one in tried]) + np.log10([PRIOR_RIGHT, *(len(TRIED) - 1) * [PRIOR_WRONG]])
    best = int(np.argmax(dex))
    weight = 10 ** (dex - dex[best])
    variance = float(weight @ TRIED / weight.sum())
    covariance = tried[best].covariance_rad2 * (variance / TRIED[best])
    return tried[best]._replace(covariance_rad2=covariance), variance


def _matched(solution: Solution, detections: Detections, sky: SkyIndex) -> Solution:
    """A solution matched and fitted again with other errors."""
    R = Rotation.from_quat(solution.cam_from_ref_xyzw).as_matrix()
    gates = 1.5 * GATE_SIGMA * detections.sigma
    found = evidence.evaluate(detections, sky, R, solution.focal_ratio, gates, -np.inf)
    return evidence.build_solution(detections, sky, found)


class Refit(NamedTuple):
    """A solution with the errors and the lens that its residuals tell.

    solution : with the covariance multiplied by `variance`
    camera   : with the fitted lens;  variance : factor of the claimed variances
    """

    solution: Solution
    camera: Camera
    variance: float


def refit(
    solution: Solution, detections: Detections, sky: SkyIndex, camera: Camera, xy_px: Floats, fit_lens: bool
) -> Refit:
    """The solution as it is if its residuals agree with the model; else matched, fitted and scaled anew.

    detections : with the errors of the model, and the focal uncertainty with which the solution was found
    camera     : of the solution;  xy_px : (N, 2) centroids
    """
    free_focal = detections.focal_uncertainty > 0
    solution, variance = widened(solution, detections, sky)
    if fit_lens and variance >= TELLING and len(solution.star) >= LENS_MATCHES:
        return with_lens(solution, detections, sky, camera, xy_px, variance)
    return Refit(solution, camera, variance)


def with_lens(
    solution: Solution, detections: Detections, sky: SkyIndex, camera: Camera, xy_px: Floats, variance: float
) -> Refit:
    """Fit attitude, focal length and the first radial distortion coefficient to the matches of a solution.

    Gauss-Newton steps of the tangents t: t changes by J w with a small rotation w, by t with the logarithm of the focal
    length, and by |t|^2 t with the coefficient. Both have normal priors about the calibration. Each round drops matches
    beyond GATE_SIGMA of the errors that the last one found. The covariance is that of the attitude, whatever the lens.
    """
    cam_from_ref, keep = Rotation.from_quat(solution.cam_from_ref_xyzw), np.ones(len(solution.star), bool)
    xx, yy, xy = detections.weight[solution.observed].T
    weight = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    vectors_ref, xy_px = sky.vectors[solution.star], xy_px[solution.observed]
    corner2 = float(np.max(np.sum(detections.field.reshape(2, 2) ** 2, axis=0)) + np.min(detections.field**2))
    prior = np.diag([0.0, 0.0, 0.0, 1 / FOCAL_PRIOR**2, (corner2 / CORNER_PRIOR) ** 2])
    lens, change = camera, np.zeros(5)
    for _ in range(LENS_ROUNDS):
        seen = cam_from_ref.apply(vectors_ref)
        view = geometry(seen, seen)
        residual = lens.tangents(xy_px) - view.tangent
        r2 = np.sum(view.tangent**2, axis=1)
        slopes = np.concatenate(
            [view.jacobian, view.tangent[:, :, None], (r2[:, None] * view.tangent)[:, :, None]], axis=2
        )
        weighted = np.einsum("kij,kia->kaj", weight, slopes) * (keep / variance)[:, None, None]
        normal = np.einsum("kaj,kjb->ab", weighted, slopes) + prior
        step = np.linalg.solve(normal, np.einsum("kaj,kj->a", weighted, residual) - prior @ change)
        change = change + np.concatenate([np.zeros(3), step[3:]])
        cam_from_ref = Rotation.from_rotvec(step[:3]) * cam_from_ref
        lens = lens_of(camera, change)
        left = residual - slopes @ step
        distance2 = np.einsum("ki,kij,kj->k", left, weight, left)
        dof = max(2 * int(keep.sum()) - 5, 1)
        found = variance_factor(float(distance2[keep].sum()), dof)
        covariance = np.linalg.inv(normal)[:3, :3]
        near = distance2 <= GATE_SIGMA**2 * found
        if near.sum() < LENS_MATCHES:
            break
        keep, variance = near, found
    rms = float(np.sqrt(np.mean(left[keep] ** 2)))
    found_solution = solution._replace(
        observed=solution.observed[keep],
        star=solution.star[keep],
        cam_from_ref_xyzw=cam_from_ref.as_quat(),
        covariance_rad2=covariance,
        rms=rms,
        chi2=float(distance2[keep].sum()) / dof,
    )
    return Refit(found_solution, lens, variance)


def lens_of(camera: Camera, change: Floats) -> Camera:
    """The camera with its log focal length and first distortion coefficient changed by the last two elements."""
    k1, *others = camera.distortion
    return replace(
        camera, focal_px=camera.focal_px * float(np.exp(change[3])), distortion=(k1 + float(change[4]), *others)
    )
