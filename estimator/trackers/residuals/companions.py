"""Errors of catalog stars with a companion: a double star is not where its catalog entry is.

A catalog gives a double star the place of one component, of the center of light in another band, or of a mean epoch.
Most entries are better than any centroid, but some are off by seconds of arc. In a field with a bright double the
attitude would follow it, and the covariance would not know. The share p_j of the stars has errors of c_j along each
axis. What the other stars predict for a star, with the covariance P, is compared with its centroid, of the covariance
S: the residual r from their fit has the density sum_j p_j N(0, S + P + c_j^2 I), which gives the posterior
probabilities g_j. The star then has the information sum_j g_j (S + c_j^2 I)^-1, and the attitude is fitted again.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.systematic import geometry
from estimator.catalog.sky_index import SkyIndex
from estimator.core.arrays import Floats
from estimator.core.constants import ARCSEC_RAD
from estimator.identification.chance import GATE_SIGMA
from estimator.identification.stars import evidence
from estimator.identification.stars.detections import Detections, information_of
from estimator.identification.stars.evidence import Solution

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
        found = evidence.evaluate(
            tried, sky, R_cam_from_ref, best.focal_ratio, GATE_SIGMA * sigma, -np.inf
        )
        if len(found.star) < len(best.star):
            break
        best = evidence.build_solution(tried, sky, found)
        changed = tried
    return best, changed


def prediction_by_others(
    residual: Floats, jacobian: Floats, information: Floats
) -> tuple[Floats, Floats]:
    """(K, 2) residuals of stars from the attitude of all others, and (K, 2, 2) the covariances of what these predict.

    residual, jacobian, information : (K, 2), (K, 2, 3) and (K, 2, 2) of the attitude that fits them all
    With the information N of the attitude and J' W J that of one star, the attitude without it moves by
    -(N - J' W J)^-1 J' W r.
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

    information, spread : (K, 2, 2) of the centroid alone, and covariance of the prediction
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
