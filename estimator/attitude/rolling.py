"""Attitude and angular rate together, from matched lights of a rolling shutter, each with the time of its row.

Light i, at P_i in the reference frame, is seen at the delay t_i of its row along q_i = exp(-[w] t_i) A P_i - r. The
attitude A is that at mid-exposure of the middle row, w is the camera's rate and r its lever arm. Gauss-Newton fits A
and w to three kinds of data: the tangents of all lights but outliers, the chords of their streaks (`rate`), and a prior
of the rate. The Jacobian of a tangent is J_i exp(-[w] t_i) by a small rotation of A, and -t_i J_i by the rate. Its
error is that of `rate.error_gain`.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.rate import (
    aligned,
    chords,
    covariance_of,
    error_gain,
    inliers,
    inverses,
    streak_factor,
)
from estimator.attitude.systematic import geometry
from estimator.core.camera import Camera
from estimator.core.checks import Bools, Floats
from estimator.core.types import Centroids, RateEstimate

MAX_STEPS = 25
CONVERGED_RAD = 1e-12
# After these steps the outliers are fixed: a light at the limit could otherwise change sides in every second step.
FREE_STEPS = 15


class Fit(NamedTuple):
    """Solution of `fit`: the attitude at mid-exposure of the middle row, and the rate."""

    cam_from_ref: Rotation
    rate: RateEstimate


class _Rows(NamedTuple):
    """Residuals (M, 2), their slopes (M, 2, 6) by a small rotation and the rate, and inverse covariances (M, 2, 2)."""

    residual: Floats
    slopes: Floats
    information: Floats


def fit(
    camera: Camera,
    centroids: Centroids,
    place_ref: Floats,
    lever_cam_m: Floats,
    start: tuple[Rotation, Floats],
    prior: RateEstimate,
    exposure_s: float | None = None,
) -> Fit:
    """Fit attitude and rate to K centroids and their lights, from initial values of both.

    Each step of Gauss-Newton:

    1. Predict each light at the time of its row; form the residuals of tangents and streaks, and their slopes.
    2. Reject outliers (`rate.inliers`), in the first FREE_STEPS steps.
    3. Sum the normal equations of the six unknowns, and add the prior of the rate.
    4. Solve them; rotate the attitude and add the change of the rate.

    Parameters
    ----------
    place_ref, lever_cam_m
        (K, 3) positions of LEDs from the bearing, m, and (3,) position of the camera from it, in camera axes; unit
        vectors of stars, and zeros
    start, prior
        Initial cam_from_ref and (3,) rate in camera axes, rad/s, and the prior of the rate
    exposure_s
        Exposure time; None: the streaks are not used

    Raises
    ------
    ValueError
        If the lights do not determine the attitude, or if the fit does not converge.
    """
    cam_from_ref, rate = start
    delay_s = camera.row_delays_s(centroids.xy_px)
    prior_information = np.linalg.inv(prior.covariance_rad2_s2)
    keep: list[Bools] = []
    for n in range(MAX_STEPS):
        # 1. q = exp(-[w] t) A P - r of each light; residuals and slopes
        turn = Rotation.from_rotvec(-delay_s[:, None] * rate)
        place = turn.apply(cam_from_ref.apply(place_ref))
        rows = _rows(camera, centroids, place, lever_cam_m, turn, rate, exposure_s)
        # 2. Outliers
        if n < FREE_STEPS:
            keep = [inliers(residual, information) for residual, _, information in rows]
        # 3. Normal equations
        normal, gradient = _normal_equations(rows, keep)
        normal[3:, 3:] += prior_information
        gradient[3:] += prior_information @ (prior.rate_rad_s - rate)
        # 4. Step
        step = _solve(normal, gradient, len(centroids))
        cam_from_ref = Rotation.from_rotvec(step[:3]) * cam_from_ref
        rate = rate + step[3:]
        length_rad = np.linalg.norm(step[:3])
        if length_rad < CONVERGED_RAD:
            break
    if not length_rad < 1e-8:
        raise ValueError(f"attitude and rate: not converged, last step {length_rad:.1e} rad")
    rate_covariance = np.asarray(np.linalg.inv(normal)[3:, 3:], float)
    return Fit(cam_from_ref, RateEstimate(rate, rate_covariance))


def _rows(
    camera: Camera,
    centroids: Centroids,
    place: Floats,
    lever_cam_m: Floats,
    turn: Rotation,
    rate: Floats,
    exposure_s: float | None,
) -> list[_Rows]:
    """Return the rows of the tangents and, with an exposure time, of the streaks.

    Those of the tangents are measured minus those of the (K, 3) rays predicted at the times of their rows.
    """
    jacobian, _, tangent = geometry(place, place - lever_cam_m)
    delay_s = camera.row_delays_s(centroids.xy_px)
    # Covariance of the residuals: a centroid's error also shifts the time at which it is predicted.
    gain = error_gain(camera, -jacobian @ rate)
    error_rad2 = gain @ covariance_of(centroids) @ gain.mT / camera.focal_px**2
    # Slopes: J exp(-[w] t) by the rotation, -t J by the rate
    by_rotation = jacobian @ turn.as_matrix()
    by_rate = -delay_s[:, None, None] * jacobian
    residual = camera.tangents(centroids.xy_px) - tangent
    slopes = np.concatenate([by_rotation, by_rate], axis=2)
    rows = [_Rows(residual, slopes, inverses(error_rad2))]
    if exposure_s is not None and centroids.streak_px is not None:
        # Measured minus predicted chords, the measured with the nearer sign
        seen = np.isfinite(centroids.streak_px[:, 0])
        chord, information = chords(camera, centroids.take(seen))
        # A chord is -T J w times the rolling shutter's factor; the attitude does not change it to first order.
        jacobian = jacobian[seen]
        factor = streak_factor(camera, -jacobian @ rate)[:, None, None]
        by_rate = -exposure_s * factor * jacobian
        predicted = by_rate @ rate
        residual = aligned(chord, information, predicted) - predicted
        slopes = np.concatenate([0 * by_rate, by_rate], axis=2)
        rows.append(_Rows(residual, slopes, information))
    return rows


def _normal_equations(rows: list[_Rows], keep: list[Bools]) -> tuple[Floats, Floats]:
    """Return the (6, 6) normal matrix and the (6,) gradient of the rows that are kept."""
    normal = np.zeros((6, 6))
    gradient = np.zeros(6)
    for (residual, slopes, information), kept in zip(rows, keep, strict=True):
        weighted = slopes.mT @ information * kept[:, None, None]
        normal += np.sum(weighted @ slopes, axis=0)
        gradient += np.einsum("nij,nj->i", weighted, residual)
    return normal, gradient


def _solve(normal: Floats, gradient: Floats, lights: int) -> Floats:
    """Return the (6,) step. Raises ValueError for a singular matrix.

    The unknowns are scaled by the roots of the diagonal: a rate and an angle have different sizes.
    """
    size = np.sqrt(np.diag(normal))
    sizes = np.outer(size, size)
    if not np.all(size > 0) or np.linalg.cond(normal / sizes) > 1e12:
        raise ValueError(f"{lights} lights do not determine attitude and rate")
    return np.linalg.solve(normal / sizes, gradient / size) / size


def rate_covariance_rad2(
    camera: Camera, centroids: Centroids, jacobian: Floats, covariance_rad2_s2: Floats
) -> Floats:
    """Return the (3, 3) covariance, rad^2, that the rate's error adds to an attitude from centroids at the middle row.

    An error dw of the rate, with which K lights were moved to the middle row, moves their tangents by t_i J_i dw.
    Weighted least squares takes that for the rotation G dw, G = sum(J_i^T W_i J_i)^-1 sum(t_i J_i^T W_i J_i). The
    covariance is G C G^T, with C that of the rate.

    Parameters
    ----------
    centroids
        Centroids as found, before they are moved, with total errors
    jacobian
        (K, 2, 3) derivative J_i of the tangents by a small rotation
    covariance_rad2_s2
        (3, 3) covariance C of the rate
    """
    information = camera.focal_px**2 * np.linalg.inv(covariance_of(centroids))  # W
    products = jacobian.mT @ information @ jacobian  # J^T W J
    delay_s = camera.row_delays_s(centroids.xy_px)[:, None, None]
    gain = np.linalg.solve(np.sum(products, axis=0), np.sum(products * delay_s, axis=0))
    return gain @ covariance_rad2_s2 @ gain.T
