"""Attitude and angular rate together, from matched lights of a rolling shutter, each with the time of its row.

Light i, at P_i in the reference frame, is seen at the delay t_i of its row along q_i = exp(-[w] t_i) A P_i - r: the
attitude A is that at mid-exposure of the middle row, w the camera's rate and r its lever arm. Gauss-Newton fits both to
the tangents of all lights but outliers, to the chords of their streaks (`rate`) and to a prior of the rate. A tangent's
residual has the Jacobian J_i exp(-[w] t_i) by a small rotation of A, and -t_i J_i by the rate; its error is that of
`motion.at_middle_row`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.nearfield import tangent_jacobian
from estimator.attitude.rate import (
    aligned,
    chords,
    covariance_of,
    error_gain,
    inliers,
    inverses,
    streak_factor,
)
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids, RateEstimate

MAX_STEPS = 25
CONVERGED_RAD = 1e-12
FREE_STEPS = 15  # after which outliers stay what they are: at its limit a light may turn one with every second step


class Fit(NamedTuple):
    """Solution of `fit`: the attitude at the middle row, and the rate."""

    cam_from_ref: Rotation
    rate: RateEstimate


class _Rows(NamedTuple):
    """Residuals (M, 2), their slopes (M, 2, 6) by a small rotation and the rate, their information (M, 2, 2)."""

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
    """Fit attitude and rate to K centroids and the places (K, 3) of their lights, from a start of both.

    Parameters
    ----------
    place_ref
        Unit vectors of stars, or LEDs from the bearing, m
    lever_cam_m
        (3,) the camera's arm, in camera axes; zeros for stars
    exposure_s
        None: the streaks are not used

    Raises
    ------
    ValueError
        If the lights do not determine the attitude, or if the fit does not converge.
    """
    cam_from_ref, rate = start
    delay_s = camera.row_delays_s(centroids.xy_px)
    prior_information = np.linalg.inv(prior.covariance_rad2_s2)
    keep: list[NDArray[np.bool_]] = []
    for n in range(MAX_STEPS):
        normal = np.zeros((6, 6))
        gradient = np.zeros(6)
        turn = Rotation.from_rotvec(-delay_s[:, None] * rate)
        place = turn.apply(cam_from_ref.apply(place_ref))
        jacobian = tangent_jacobian(place, place - lever_cam_m).reshape(-1, 2, 3)
        rows = [_place_rows(camera, centroids, place - lever_cam_m, jacobian, turn, rate)]
        if exposure_s is not None and centroids.streak_px is not None:
            rows.append(_streak_rows(camera, centroids, jacobian, rate, exposure_s))
        if n < FREE_STEPS:
            keep = [inliers(residual, information) for residual, _, information in rows]
        for (residual, slopes, information), kept in zip(rows, keep, strict=True):
            weighted = np.swapaxes(slopes, 1, 2) @ information * kept[:, None, None]
            normal += np.sum(weighted @ slopes, axis=0)
            gradient += np.einsum("nij,nj->i", weighted, residual)
        normal[3:, 3:] += prior_information
        gradient[3:] += prior_information @ (prior.rate_rad_s - rate)
        # Columns are scaled: a rate and an angle have different sizes.
        size = np.sqrt(np.diag(normal))
        if not np.all(size > 0) or np.linalg.cond(normal / np.outer(size, size)) > 1e12:
            raise ValueError(f"{len(centroids)} lights do not determine attitude and rate")
        step = np.linalg.solve(normal / np.outer(size, size), gradient / size) / size
        cam_from_ref = Rotation.from_rotvec(step[:3]) * cam_from_ref
        rate = rate + step[3:]
        if np.linalg.norm(step[:3]) < CONVERGED_RAD:
            break
    if not np.linalg.norm(step[:3]) < 1e-8:
        raise ValueError(
            f"attitude and rate: not converged, last step {np.linalg.norm(step[:3]):.1e} rad"
        )
    return Fit(cam_from_ref, RateEstimate(rate, np.asarray(np.linalg.inv(normal)[3:, 3:], float)))


def _place_rows(
    camera: Camera,
    centroids: Centroids,
    ray: Floats,
    jacobian: Floats,
    turn: Rotation,
    rate: Floats,
) -> _Rows:
    """Residuals of the tangents from those of predicted rays (K, 3), each at the time of its row."""
    delay_s = camera.row_delays_s(centroids.xy_px)
    gain = error_gain(camera, -jacobian @ rate)
    error_rad2 = gain @ covariance_of(centroids) @ np.swapaxes(gain, 1, 2) / camera.focal_px**2
    slopes = np.concatenate(
        [jacobian @ turn.as_matrix(), -delay_s[:, None, None] * jacobian], axis=2
    )
    return _Rows(
        camera.tangents(centroids.xy_px) - ray[:, :2] / ray[:, 2:], slopes, inverses(error_rad2)
    )


def _streak_rows(
    camera: Camera, centroids: Centroids, jacobian: Floats, rate: Floats, exposure_s: float
) -> _Rows:
    """Residuals of the streaks' chords, each with the sign nearer to the rate."""
    assert centroids.streak_px is not None
    seen = np.isfinite(centroids.streak_px[:, 0])
    chord, information = chords(camera, centroids.take(seen))
    jacobian = jacobian[seen]
    by_rate = -exposure_s * streak_factor(camera, -jacobian @ rate)[:, None, None] * jacobian
    residual = aligned(chord, information, by_rate @ rate) - by_rate @ rate
    return _Rows(residual, np.concatenate([0 * by_rate, by_rate], axis=2), information)


def rate_covariance_rad2(
    camera: Camera, centroids: Centroids, jacobian: Floats, covariance_rad2_s2: Floats
) -> Floats:
    """(3, 3) covariance of an attitude by the error of the rate with which its K lights were put at the middle row.

    An error of the rate moves the tangents by t_i J_i times it, which weighted least squares takes for a rotation.

    Parameters
    ----------
    centroids
        As they are found, with total errors
    jacobian
        (K, 2, 3) of the tangents by a small rotation
    """
    information = camera.focal_px**2 * np.linalg.inv(covariance_of(centroids))
    weighted = np.swapaxes(jacobian, 1, 2) @ information
    delay_s = camera.row_delays_s(centroids.xy_px)[:, None, None]
    gain = np.linalg.solve(
        np.sum(weighted @ jacobian, axis=0), np.sum(weighted @ jacobian * delay_s, axis=0)
    )
    return np.asarray(gain @ covariance_rad2_s2 @ gain.T)
