"""Covariance of an attitude from errors that the weights of its solution do not describe.

The weights take every ray's error as independent, equal in all directions. Errors of a survey are neither: an LED's
place errs more along the surveying instrument's sight than across, and errors of the instrument's set-up, of the
surface or of the focal length are common to all rays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.attitude.nearfield import tangent_gradients, tangent_jacobian
from estimator.core.camera import Camera
from estimator.core.checks import Floats


class Geometry(NamedTuple):
    """K rays as a solution sees them, in camera axes.

    Attributes
    ----------
    jacobian
        (K, 2, 3) derivative of the tangents (x / z, y / z) by a small rotation; (K, 2, 4)
        `with_focal`
    gradient
        (K, 2, 3) derivative of the tangents by a displacement of the LED, 1/m; of a star's
        direction
    tangent
        (K, 2) x / z and y / z
    """

    jacobian: Floats
    gradient: Floats
    tangent: Floats


def geometry(place_cam: Floats, ray_cam: Floats) -> Geometry:
    """Geometry of LEDs at (K, 3) from the bearing and from the pupil, m; of stars both are unit vectors."""
    jacobian = tangent_jacobian(place_cam, ray_cam).reshape(-1, 2, 3)
    return Geometry(jacobian, tangent_gradients(ray_cam), ray_cam[:, :2] / ray_cam[:, 2:])


def with_focal(view: Geometry) -> Geometry:
    """The geometry of a fit of the rotation and the logarithm of the focal length, by which the tangents change."""
    return view._replace(jacobian=np.concatenate([view.jacobian, view.tangent[:, :, None]], axis=2))


def from_independent(view: Geometry, sigma_rad: Floats, covariance_rad2: Floats) -> Floats:
    """(P, P) covariance of a least-squares rotation from independent errors of the tangents, (K, 2, 2).

    With weights 1 / sigma^2 and the tangents' errors e_i the rotation errs by w = S sum_i J_i' e_i / sigma_i^2, S the
    inverse of sum_i J_i' J_i / sigma_i^2. For errors with covariances C_i that is S (sum_i J_i' C_i J_i / sigma_i^4) S;
    it is S itself if C_i = sigma_i^2 I.
    """
    gain = response(view, sigma_rad)
    return np.asarray(np.einsum("kai,kij,kbj->ab", gain, covariance_rad2, gain))


def from_common(view: Geometry, sigma_rad: Floats, error_rad: Floats) -> Floats:
    """(P, P) covariance of a least-squares rotation from M errors that all rays share.

    Parameters
    ----------
    error_rad
        (M, K, 2) change of the tangents by one standard deviation of each
    """
    rotation = np.einsum("kai,mki->ma", response(view, sigma_rad), error_rad)
    return np.asarray(rotation.T @ rotation)


def response(view: Geometry, sigma_rad: Floats) -> Floats:
    """(K, P, 2) rotation that an error of each ray's tangents causes in the weighted least-squares solution.

    P is 3, or 4 for `with_focal`, where the last number is of the focal length's logarithm.
    """
    weighted = view.jacobian / sigma_rad[:, None, None] ** 2
    information = np.einsum("kia,kib->ab", weighted, view.jacobian)
    return np.asarray(np.linalg.solve(information, np.moveaxis(weighted, 2, 1)))


def residual_products(view: Geometry, sigma_rad: Floats, error_rad: Floats) -> Floats:
    """(M, M) inner products of the weighted residuals that M common errors (M, K, 2) leave after the solution.

    With z standard normal and unit noise in every weighted tangent, the sum of squares has the mean 2 K - P + tr Q and
    the variance 2 (2 K - P) + 4 tr Q + 2 tr Q^2, Q these products, P the number of unknowns.
    """
    weighted = (error_rad / sigma_rad[:, None]).reshape(len(error_rad), 2 * len(sigma_rad))
    jacobian = (view.jacobian / sigma_rad[:, None, None]).reshape(2 * len(sigma_rad), -1)
    absorbed, _, _, _ = np.linalg.lstsq(jacobian, weighted.T, rcond=None)
    left = weighted.T - jacobian @ absorbed
    return np.asarray(left.T @ left)


def isotropic(sigma_rad: Floats) -> Floats:
    """(K, 2, 2) covariances of errors equal in all directions."""
    return sigma_rad[:, None, None] ** 2 * np.eye(2)


def with_survey(
    covariance_rad2: Floats,
    view: Geometry,
    sigma_rad: Floats,
    noise_rad2: Floats,
    own_rad2: Floats,
    common_rad: Floats,
    fits_focal: bool = False,
) -> tuple[Floats, Floats]:
    """The (3, 3) covariance of an attitude with its errors as they are, and the part that successive frames share.

    The errors are propagated through the least-squares solution of the tangents, whose covariance is S = L L'. A solver
    with the covariance L_0 L_0' is taken to respond as that solution does after the rotation L_0 L^-1.

    Parameters
    ----------
    covariance_rad2
        Of the solver, for independent errors of sigma_rad (K,), equal in all directions
    noise_rad2
        (K, 2, 2) of the tangents in one frame
    own_rad2
        Of each light's survey
    common_rad
        (M, K, 2) change of the tangents by one standard deviation of each error that all lights
        share
    fits_focal
        Whether the focal length was fitted with the attitude, from the same lights
    """
    solver = np.linalg.cholesky(covariance_rad2)
    least_squares = np.linalg.cholesky(from_independent(view, sigma_rad, isotropic(sigma_rad)))
    adapt = solver @ np.linalg.inv(least_squares)
    fitted = with_focal(view) if fits_focal else view
    shared = (
        from_independent(fitted, sigma_rad, own_rad2) + from_common(fitted, sigma_rad, common_rad)
    )[:3, :3]
    noise = from_independent(fitted, sigma_rad, noise_rad2)[:3, :3]
    return adapt @ (noise + shared) @ adapt.T, adapt @ shared @ adapt.T


def focal_error_px(camera: Camera, xy_px: Floats) -> Floats:
    """(N,) standard deviation of a calibrated focal length times the distance from the principal point."""
    return np.asarray(camera.focal_sigma * np.linalg.norm(xy_px - camera.center_px, axis=1))


def with_focal_error(
    covariance_rad2: Floats, camera: Camera, xy_px: Floats, seen_cam: Floats, sigma_rad: Floats
) -> tuple[Floats, Floats | None]:
    """The (3, 3) covariance of an attitude with the error of the focal length as it is, and that part alone.

    None in place of the part if the focal length is known exactly.

    Parameters
    ----------
    covariance_rad2
        With that error, `focal_error_px`, as independent from star to star
    xy_px, seen_cam
        (K, 2) centroids and (K, 3) unit vectors of their stars in camera axes
    sigma_rad
        (K,) on which the covariance is based
    """
    if not camera.focal_sigma:
        return covariance_rad2, None
    view = geometry(seen_cam, seen_cam)
    focal_rad = focal_error_px(camera, xy_px) / camera.focal_px
    noise = isotropic(np.sqrt(np.maximum(sigma_rad**2 - focal_rad**2, (0.01 * sigma_rad) ** 2)))
    common = camera.focal_sigma * view.tangent[None]
    return with_survey(covariance_rad2, view, sigma_rad, noise, np.zeros_like(noise), common)
