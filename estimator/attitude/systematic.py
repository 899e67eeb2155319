"""Covariance of an attitude from errors that the weights of its solution do not describe.

The weights assume that each ray's error is independent and equal in all directions. Errors of a survey are neither: an
LED's position has a larger error along the line of sight of the surveying instrument than across it, and errors of the
instrument's set-up, of the surface or of the focal length are common to all rays.

The weighted least-squares solution is linear in small errors e_i of the tangents: the rotation is w = sum_i G_i e_i,
with G_i = S J_i^T / sigma_i^2 and S = [sum_i J_i^T J_i / sigma_i^2]^-1 (`response`). Its covariance is the sum of

- sum_i G_i C_i G_i^T for independent errors with covariances C_i (`from_independent`), and
- sum_m w_m w_m^T, w_m = sum_i G_i e_mi, for errors m that all rays share (`from_common`).
"""

from typing import NamedTuple

import numpy as np

from estimator.attitude.rotation_fit import tangent_gradients
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.vectors import lengths


class Geometry(NamedTuple):
    """Geometry of the K rays of a solution, in camera axes.

    Attributes
    ----------
    jacobian
        (K, 2, P) derivative of the tangents (x / z, y / z) by the unknowns: a small rotation, P = 3;
        and the logarithm of the focal length, P = 4, in `with_focal`
    gradient
        (K, 2, 3) derivative of the tangents by a displacement of the LED, 1/m, or by a change of a
        star's direction
    tangent
        (K, 2) tangents x / z and y / z
    """

    jacobian: Floats
    gradient: Floats
    tangent: Floats


def geometry(place_cam: Floats, ray_cam: Floats) -> Geometry:
    """Return the geometry of LEDs from their (K, 3) positions from the bearing and from the pupil, m, in camera axes.

    For stars both are the same unit vectors.
    """
    gradient = tangent_gradients(ray_cam)
    jacobian = np.cross(place_cam[:, None, :], gradient)  # d . (w x b) = w . (b x d)
    return Geometry(jacobian, gradient, ray_cam[:, :2] / ray_cam[:, 2:])


def with_focal(view: Geometry) -> Geometry:
    """Return the geometry of a fit whose fourth unknown is the logarithm of the focal length."""
    # The derivative of f (x / z) / f_0 by log f is the tangent itself.
    by_focal = view.tangent[:, :, None]
    return view._replace(jacobian=np.concatenate([view.jacobian, by_focal], axis=2))


def from_independent(view: Geometry, sigma_rad: Floats, covariance_rad2: Floats) -> Floats:
    """Return the (P, P) covariance of a least-squares solution from independent errors of the tangents.

    It is sum_i G_i C_i G_i^T = S (sum_i J_i^T C_i J_i / sigma_i^4) S, and S itself if C_i = sigma_i^2 I.

    Parameters
    ----------
    covariance_rad2
        (K, 2, 2) covariance C_i of each ray's tangents
    """
    gain = response(view, sigma_rad)
    return np.einsum("kai,kij,kbj->ab", gain, covariance_rad2, gain)


def from_common(view: Geometry, sigma_rad: Floats, error_rad: Floats) -> Floats:
    """Return the (P, P) covariance of a least-squares solution from M errors that all rays share.

    Parameters
    ----------
    error_rad
        (M, K, 2) change of the tangents by one standard deviation of each error
    """
    # w_m = sum_i G_i e_mi: the solution's change by one standard deviation of each error
    rotation = np.einsum("kai,mki->ma", response(view, sigma_rad), error_rad)
    return rotation.T @ rotation


def response(view: Geometry, sigma_rad: Floats) -> Floats:
    """Return G_i = S J_i^T / sigma_i^2, (K, P, 2): the solution's change by an error of each ray's tangents.

    P is 3; it is 4 for `with_focal`, where the last unknown is the logarithm of the focal length.
    """
    weighted = view.jacobian / sigma_rad[:, None, None] ** 2
    information = np.einsum("kia,kib->ab", weighted, view.jacobian)  # the inverse of S
    return np.linalg.solve(information, weighted.mT)


def residual_products(view: Geometry, sigma_rad: Floats, error_rad: Floats) -> Floats:
    """Return Q, (M, M): inner products of the weighted residuals that M common errors leave after the solution.

    Let the common errors have standard normal amplitudes, and every weighted tangent unit noise. The sum of squared
    residuals then has the mean 2 K - P + tr Q and the variance 2 (2 K - P) + 4 tr Q + 2 tr Q^2, with P unknowns.

    Parameters
    ----------
    error_rad
        (M, K, 2) change of the tangents by one standard deviation of each error
    """
    rows = 2 * len(sigma_rad)
    weighted = (error_rad / sigma_rad[:, None]).reshape(len(error_rad), rows).T
    jacobian = (view.jacobian / sigma_rad[:, None, None]).reshape(rows, -1)
    # The solution absorbs the part of an error that looks like a rotation; the rest is left in the residuals.
    absorbed = np.linalg.lstsq(jacobian, weighted, rcond=None)[0]
    left = weighted - jacobian @ absorbed
    return left.T @ left


def isotropic(sigma_rad: Floats) -> Floats:
    """Return the (K, 2, 2) covariances sigma_i^2 I of errors that are equal in all directions."""
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
    """Return the (3, 3) covariance of an attitude with all its errors, and the part that successive frames share.

    1. Map the least-squares solution's response to the solver's. With the covariances S = L L^T of the least-squares
       solution and L_0 L_0^T of the solver, the solver is taken to respond as A = L_0 L^-1 times that solution.
    2. Propagate the survey's errors, of each light and common ones, through the least-squares solution.
    3. Propagate the noise of one frame.

    Parameters
    ----------
    covariance_rad2
        (3, 3) covariance L_0 L_0^T of the solver, for independent errors of sigma_rad in all directions
    sigma_rad
        (K,) standard deviations on which the solver's weights are based
    noise_rad2
        (K, 2, 2) covariance of the tangents' noise in one frame
    own_rad2
        (K, 2, 2) covariance of the tangents from the survey of each light
    common_rad
        (M, K, 2) change of the tangents by one standard deviation of each error that all lights
        share
    fits_focal
        Whether the focal length was fitted with the attitude, from the same lights
    """
    # 1. Solver's response
    solver = np.linalg.cholesky(covariance_rad2)
    least_squares = from_independent(view, sigma_rad, isotropic(sigma_rad))
    adapt = solver @ np.linalg.inv(np.linalg.cholesky(least_squares))
    # 2. Errors that successive frames share
    fitted = with_focal(view) if fits_focal else view
    own = from_independent(fitted, sigma_rad, own_rad2)
    shared = (own + from_common(fitted, sigma_rad, common_rad))[:3, :3]
    # 3. Noise
    noise = from_independent(fitted, sigma_rad, noise_rad2)[:3, :3]
    return adapt @ (noise + shared) @ adapt.T, adapt @ shared @ adapt.T


def focal_error_px(camera: Camera, xy_px: Floats) -> Floats:
    """Return the (N,) position errors from the focal length: its relative sigma times the distance from the center."""
    distance_px = lengths(xy_px - camera.center_px)
    return camera.focal_sigma * distance_px


def focal_error_rad(rays_cam: Floats, camera: Camera) -> Floats:
    """Return the (N,) standard deviation of rays' tangents from the error of the focal length, rms of both axes."""
    tangent = lengths(rays_cam[:, :2] / rays_cam[:, 2:])
    return camera.focal_sigma * tangent / np.sqrt(2)


def with_focal_error(
    covariance_rad2: Floats,
    camera: Camera,
    seen_cam: Floats,
    sigma_rad: Floats,
    noise_px2: Floats,
) -> tuple[Floats, Floats]:
    """Return the (3, 3) covariance of an attitude with the focal length's error as common to all stars, and its part.

    Parameters
    ----------
    covariance_rad2
        (3, 3) covariance in which that error, `focal_error_px`, is independent from star to star
    seen_cam
        (K, 3) unit vectors of the stars in camera axes
    sigma_rad
        (K,) standard deviations on which the covariance is based
    noise_px2
        (K,) variances of the frame's noise alone
    """
    view = geometry(seen_cam, seen_cam)
    # The limit guards against rounding.
    noise_rad2 = np.maximum(noise_px2 / camera.focal_px**2, (0.01 * sigma_rad) ** 2)
    noise = isotropic(np.sqrt(noise_rad2))
    common = camera.focal_sigma * view.tangent[None]
    return with_survey(covariance_rad2, view, sigma_rad, noise, np.zeros_like(noise), common)
