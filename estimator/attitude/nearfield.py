"""Attitude from stars at a finite distance: a camera on a lever arm about a known centre, under lights at known places.

Six methods of one signature, from the one that takes the lights for stars to the exact one, which knows that the
camera can only turn about the bearing centre. Each takes

rays_cam      : (N, 3) unit vectors in camera axes
sigma_rad     : (N,) their standard deviation per axis; for the methods of OF_TANGENTS, that of their tangents
position_m    : (N, 3) where the lights of these rays are, in the lab frame
leds, lever   : the believed surface and the believed place of the camera
body_from_lab : the attitude to start from; infinity and thesis need none

and gives body_from_lab with its (3, 3) covariance in body axes, rad^2: that of the rays' noise alone. It leaves out
every error of what is believed and the method's own bias, which noise-free rays show. All raise ValueError where no
attitude follows.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, check_lever, on_sphere, on_surface, project
from estimator.attitude.solvers import quest
from estimator.core.arrays import Floats

__all__ = [
    "SOLVERS",
    "LedMap",
    "Lever",
    "check_lever",
    "fitted_sigma_rad",
    "on_sphere",
    "on_surface",
    "project",
]


def rotation_only(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> tuple[Rotation, Floats]:
    """The exact solve: body_from_lab and its (3, 3) covariance in body axes, from N >= 2 rays and their lights.

    Minimises the tangent-plane residual of q = b - r, b = A P, with A <- exp([w]) A and the Jacobian
    J_i = D(q) (-[b_i]x), D = [[1/q_z, 0, -q_x/q_z^2], [0, 1/q_z, -q_y/q_z^2]] by Gauss-Newton in camera axes.
    The surface is not used: only where the lights are, and that the camera turns about the bearing centre.
    Raises ValueError where it does not converge, or where the lights leave a turn unknown.
    """
    measured = rays_cam[:, :2] / rays_cam[:, 2:]
    weight = np.repeat(1 / sigma_rad, 2)
    cam_from_body = lever.cam_from_body
    for _ in range(30):
        b = cam_from_body.apply(body_from_lab.apply(position_m))
        q = b - cam_from_body.apply(lever.camera_body_m)
        jacobian = _jacobian(b, q) * weight[:, None]
        residual = (measured - q[:, :2] / q[:, 2:]).ravel() * weight
        step, _, rank, _ = np.linalg.lstsq(jacobian, residual, rcond=None)
        if rank < 3:
            raise ValueError(f"{len(rays_cam)} lights leave a turn unknown; two apart are needed")
        body_from_lab = cam_from_body.inv() * Rotation.from_rotvec(step) * cam_from_body * body_from_lab
        if np.linalg.norm(step) < 1e-15:
            break
    if not np.linalg.norm(step) < 1e-9:
        raise ValueError(f"the rotation-only solve still moved by {np.linalg.norm(step):.1e} rad")
    covariance_cam = np.linalg.inv(jacobian.T @ jacobian)
    return body_from_lab, _in_body_axes(covariance_cam, lever)


def _tangent_slopes(q: Floats) -> Floats:
    """(N, 2, 3) derivative of the tangents (q_x / q_z, q_y / q_z) by q."""
    inverse_z = 1 / q[:, 2]
    zero = np.zeros_like(inverse_z)
    d_x = np.column_stack([inverse_z, zero, -q[:, 0] * inverse_z**2])
    d_y = np.column_stack([zero, inverse_z, -q[:, 1] * inverse_z**2])
    return np.stack([d_x, d_y], axis=1)


def _jacobian(b: Floats, q: Floats) -> Floats:
    """(2 N, 3) derivative of the tangents of q = b - r by a small rotation w of b: dq = w x b."""
    # d . (w x b) = w . (b x d)
    return np.cross(b[:, None, :], _tangent_slopes(q)).reshape(-1, 3)


def _in_body_axes(covariance_cam: np.ndarray, lever: Lever) -> Floats:
    R_body_from_cam = lever.cam_from_body.inv().as_matrix()
    return R_body_from_cam @ covariance_cam @ R_body_from_cam.T


def _wahba(point_body_m: Floats, reach_m: Floats, sigma_rad: Floats, position_m: Floats) -> Rotation:
    """body_from_lab from points in body axes and in the lab, by their directions from the bearing centre.

    A ray's error, sigma at the camera, moves the point by sigma * reach and its direction by that over its radius.
    """
    radius = np.linalg.norm(point_body_m, axis=1)
    target = position_m / np.linalg.norm(position_m, axis=1, keepdims=True)
    return quest(point_body_m / radius[:, None], target, sigma_rad * reach_m / radius)


def _wahba_covariance(
    body_from_lab: Rotation,
    point_body_m: Floats,
    reach_m: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    rays_body: Floats,
    slope_m: Floats,
    gain_m: Floats | float = 0.0,
) -> Floats:
    """(3, 3) covariance in body axes of what _wahba finds, by the noise of the rays that the points came from.

    slope_m : (N, 3, 3) dp/du, how a point p moves with its ray u
    gain_m  : (N, 3) how far p moves along u with the attitude, where the method places it by the attitude

    At Wahba's least the torques balance, sum(k a x d) = 0 with a = A P / |P|, d = p / |p|, weight k. Their change
    by noise and by the turn w that answers it is zero too:
    sum(k [(a.d) I - a d']) w = sum(k a x (I - d d') dp / |p|), dp = slope du + u (gain . w). Derived here.
    """
    radius = np.linalg.norm(point_body_m, axis=1)
    d = point_body_m / radius[:, None]
    a = body_from_lab.apply(position_m / np.linalg.norm(position_m, axis=1, keepdims=True))
    weight = (radius / (sigma_rad * reach_m)) ** 2
    sideways = np.eye(3) - np.einsum("ni,nj->nij", d, d)
    # Columns: the torque of a point's shift along each axis.
    torque = np.cross(a[:, None, :], np.swapaxes(sideways, 1, 2)).swapaxes(1, 2)
    torque *= (weight / radius)[:, None, None]
    pull = np.einsum("nij,nj->ni", torque, rays_body)
    stiffness = np.eye(3) * (weight * np.sum(a * d, axis=1)).sum() - (weight[:, None] * a).T @ d
    stiffness -= pull.T @ (gain_m * np.ones_like(pull))
    across_ray = np.eye(3) - np.einsum("ni,nj->nij", rays_body, rays_body)
    turn = np.linalg.solve(stiffness, torque @ slope_m @ across_ray) * sigma_rad[:, None, None]
    return np.einsum("nij,nkj->ik", turn, turn)


def infinity(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> tuple[Rotation, Floats]:
    """Stars at infinity: the rays themselves for directions from the bearing centre, Wahba.

    What a flight tracker does under a dome. From the camera, M nearer, the pattern is R / (R - M) larger: it fits
    about its middle, and that is as far out of place as it is off the boresight. Bias .52 degree cross on AFIT's dome
    with five LEDs, at every tilt (reference, section 5).
    """
    rays = lever.cam_from_body.inv().apply(rays_cam)
    at_infinity = np.ones(len(rays))
    body_from_lab = _wahba(rays, at_infinity, sigma_rad, position_m)
    slope = np.tile(np.eye(3), (len(rays), 1, 1))
    return body_from_lab, _wahba_covariance(
        body_from_lab, rays, at_infinity, sigma_rad, position_m, rays, slope
    )


def thesis_points(rays_cam: Floats, leds: LedMap, lever: Lever, sine: bool = False) -> tuple[Floats, float]:
    """AFIT's vectors to the lights (Padro 2012, eqs 43-44): (N, 3) points in camera axes, m, and R - M, m.

    R is the believed surface's height over the bearing, M the camera's distance from the bearing along the boresight.
    sine : put the slip right, (x, y) = (R - M) sin a: then the point lies on its ray, R - M from the camera
    Raises ValueError where eq. 44 has no root.
    """
    boresight_body = lever.cam_from_body.inv().apply([0.0, 0.0, 1.0])
    height_m = on_surface(np.array([[0.0, 0.0, 1.0]]), np.zeros(3), leds)[0, 2]
    reach_m = float(height_m - lever.camera_body_m @ boresight_body)
    across_m = reach_m * (rays_cam[:, :2] if sine else rays_cam[:, :2] / rays_cam[:, 2:])
    along2_m2 = reach_m**2 - np.sum(across_m**2, axis=1)
    if not (reach_m > 0 and np.all(along2_m2 > 0)):
        raise ValueError(
            f"eq. 44 has no root: a ray is 45 deg off the boresight, or R - M is {reach_m:.3f} m"
        )
    return np.column_stack([across_m, np.sqrt(along2_m2)]), reach_m


def thesis(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> tuple[Rotation, Floats]:
    """AFIT's vectors: each light on a sphere of radius R - M about the camera, carried to the bearing; Wahba.

    Across the boresight a light is where its ray meets a plane R - M away, (x, y) = (R - M) tan a, as the image is
    calibrated; along it z = sqrt((R - M)^2 - x^2 - y^2); the camera's place is added, and angles are taken about
    the bearing (Padro 2012, eqs 43-45, with his x, y, z for z, x, y here). The slip of tan for sin is his
    (reference 1.2, item 11) and gives the bias: .0036 degree cross on AFIT's dome, .07 under a flat at 30 degrees.
    """
    point_cam, reach_m = thesis_points(rays_cam, leds, lever)
    across_m = point_cam[:, :2]
    # dp by the tangents, then the tangents by the ray.
    by_tangent = np.zeros((len(rays_cam), 3, 2))
    by_tangent[:, [0, 1], [0, 1]] = reach_m
    by_tangent[:, 2, :] = -reach_m * across_m / point_cam[:, 2:]
    R_body_from_cam = lever.cam_from_body.inv().as_matrix()
    slope = R_body_from_cam @ by_tangent @ _tangent_slopes(rays_cam) @ R_body_from_cam.T
    point = point_cam @ R_body_from_cam.T + lever.camera_body_m
    reach = np.full(len(rays_cam), reach_m)
    body_from_lab = _wahba(point, reach, sigma_rad, position_m)
    rays = rays_cam @ R_body_from_cam.T
    return body_from_lab, _wahba_covariance(body_from_lab, point, reach, sigma_rad, position_m, rays, slope)


def tappe(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> tuple[Rotation, Floats]:
    """NPS's distances: each light as far along its ray as the last attitude puts it, Wahba, again.

    R_0 + alpha_i b_i = A beta_i r_i with alpha_i = |A P_i - R_0| (Tappe, by Padro 2012, eq. 33). Tappe stopped after
    one attitude, or five; here it goes on until it stands still. The error of a distance moves a point along its ray,
    almost along its direction: an update leaves about M / R times the square of the field's half-angle of the error.
    The fixed point is the truth: no bias.
    """
    rays = lever.cam_from_body.inv().apply(rays_cam)
    for _ in range(UPDATES):
        reach = np.linalg.norm(body_from_lab.apply(position_m) - lever.camera_body_m, axis=1)
        point = lever.camera_body_m + reach[:, None] * rays
        better = _wahba(point, reach, sigma_rad, position_m)
        moved = (better * body_from_lab.inv()).magnitude()
        body_from_lab = better
        if moved < STILL_RAD:
            break
    slope = reach[:, None, None] * np.eye(3)
    gain = np.cross(point, rays)
    return body_from_lab, _wahba_covariance(
        body_from_lab, point, reach, sigma_rad, position_m, rays, slope, gain
    )


# Updates of an attitude that places its own points, and the turn below which they end.
UPDATES = 20
STILL_RAD = 1e-13


def ray_on_surface(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> tuple[Rotation, Floats]:
    """Bring each ray onto the believed ellipsoid at the last attitude, solve Wahba about the centre, repeat.

    Its bias is the surface's: an LED off the believed ellipsoid, or one whose ray meets it obliquely.
    """
    rays = lever.cam_from_body.inv().apply(rays_cam)
    for _ in range(UPDATES):
        origin = body_from_lab.inv().apply(lever.camera_body_m)
        met = on_surface(body_from_lab.inv().apply(rays), origin, leds)
        if np.isnan(met).any():
            raise ValueError("a ray misses the believed surface")
        point = body_from_lab.apply(met)
        reach = np.linalg.norm(point - lever.camera_body_m, axis=1)
        placed_by, body_from_lab = body_from_lab, _wahba(point, reach, sigma_rad, position_m)
        if (body_from_lab * placed_by.inv()).magnitude() < STILL_RAD:
            break
    normal = placed_by.apply((met - leds.centre_m) / leds.semi_axes_m**2)  # of any length
    slant = normal / np.sum(normal * rays, axis=1, keepdims=True)
    # Held to the surface, p moves by reach (du - u slant.du); the surface turns with w, p along u by slant.(w x p).
    slope = reach[:, None, None] * (np.eye(3) - np.einsum("ni,nj->nij", rays, slant))
    return body_from_lab, _wahba_covariance(
        body_from_lab, point, reach, sigma_rad, position_m, rays, slope, np.cross(point, slant)
    )


def pnp(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> tuple[Rotation, Floats]:
    """Six degrees of freedom: attitude and place from N >= 4 rays, as if nothing held the camera to the bearing.

    OpenCV's Levenberg-Marquardt from the believed place (a small pattern seen face on fits about as well turned over;
    a start from nothing, SQPnP, took that fit in 5 % of trials without noise), then Gauss-Newton with halved steps,
    which weighs the rays: residual and D as in rotation_only, q = b + t, b = A (P - mean P), unknowns w and t.
    A small pattern moved aside looks almost as one turned: knowing the bearing is worth a thousand in cross
    (reference, section 5). Its covariance is of first order; where a pattern is seen face on and the noise reaches
    the turned-over fit, errors are not Gaussian. Raises ValueError for lights in a line and where it does not settle.
    """
    if len(rays_cam) < 4:
        raise ValueError(f"{len(rays_cam)} lights leave the camera's place unknown; 4 are needed")
    measured = rays_cam[:, :2] / rays_cam[:, 2:]
    middle_m = position_m.mean(axis=0)
    pattern_m = position_m - middle_m
    believed_shift_m = lever.cam_from_body.apply(body_from_lab.apply(middle_m) - lever.camera_body_m)
    cam_from_lab, shift_m = _opencv_pnp(
        pattern_m, measured, lever.cam_from_body * body_from_lab, believed_shift_m
    )
    weight = np.repeat(1 / sigma_rad, 2)
    cam_from_lab, covariance_cam = _weighed(pattern_m, measured, cam_from_lab, shift_m, weight)
    return lever.cam_from_body.inv() * cam_from_lab, _in_body_axes(covariance_cam, lever)


def _weighed(
    pattern_m: Floats, measured: Floats, cam_from_lab: Rotation, shift_m: Floats, weight: Floats
) -> tuple[Rotation, np.ndarray]:
    """Gauss-Newton to the least of the weighted residual, steps halved till it falls; (3, 3) covariance of the turn."""
    residual, jacobian = _six_slopes(pattern_m, measured, cam_from_lab, shift_m, weight)
    for _ in range(100):
        step, _, rank, _ = np.linalg.lstsq(jacobian, residual, rcond=None)
        if rank < 6:
            raise ValueError(
                "the lights leave the camera's place unknown: they are in a line or at one point"
            )
        before = residual @ residual
        for _ in range(12):
            better = Rotation.from_rotvec(step[:3]) * cam_from_lab, shift_m + step[3:]
            residual, jacobian = _six_slopes(pattern_m, measured, *better, weight)
            if residual @ residual <= before:
                break
            step = step / 2
        cam_from_lab, shift_m = better
        if np.linalg.norm(step) < 1e-12:
            break
    if not np.linalg.norm(step) < 1e-6:
        raise ValueError(f"the 6-DoF solve still moved by {np.linalg.norm(step):.1e} rad and m")
    return cam_from_lab, np.linalg.inv(jacobian.T @ jacobian)[:3, :3]


def _six_slopes(
    pattern_m: Floats, measured: Floats, cam_from_lab: Rotation, shift_m: Floats, weight: Floats
) -> tuple[Floats, Floats]:
    """Weighted residual (2 N,) of the tangents and its Jacobian (2 N, 6) by a small turn and a shift."""
    b = cam_from_lab.apply(pattern_m)
    q = b + shift_m
    jacobian = np.hstack([_jacobian(b, q), _tangent_slopes(q).reshape(-1, 3)])
    return (measured - q[:, :2] / q[:, 2:]).ravel() * weight, jacobian * weight[:, None]


def _opencv_pnp(
    pattern_m: Floats, tangent: Floats, cam_from_lab: Rotation, shift_m: Floats
) -> tuple[Rotation, Floats]:
    """cam_from_lab and the shift in camera axes, (3,), from points and their tangents and a start."""
    start = cam_from_lab.as_rotvec()[:, None], np.array(shift_m)[:, None]
    try:
        found, rotvec, shift = cv2.solvePnP(
            pattern_m, tangent, np.eye(3), None, *start, True, cv2.SOLVEPNP_ITERATIVE
        )
    except cv2.error as error:
        raise ValueError(f"OpenCV finds no place for the camera: {error.err}") from None
    if not found:
        raise ValueError("OpenCV finds no place for the camera")
    return Rotation.from_rotvec(np.ravel(rotvec)), np.ravel(shift)


NearSolver = Callable[..., tuple[Rotation, Floats]]
SOLVERS: dict[str, NearSolver] = {
    "rotation_only": rotation_only,
    "ray_on_surface": ray_on_surface,
    "infinity": infinity,
    "thesis": thesis,
    "tappe": tappe,
    "pnp": pnp,
}
OF_TANGENTS = ("rotation_only", "pnp")  # they fit a ray's (x/z, y/z), in which a pixel is as wide everywhere


def fitted_sigma_rad(solver: str, rays_cam: Floats, pixel_rad: Floats) -> Floats:
    """(N,) error per axis of what a method fits, from that of the pixels over the focal length.

    At an angle a off the boresight a ray turns by cos^2 a of a tangent's change along the radius and by cos a across:
    its error is the rms of both.
    """
    if solver in OF_TANGENTS:
        return pixel_rad
    cosine = rays_cam[:, 2]
    return pixel_rad * np.sqrt((cosine**2 + cosine**4) / 2)
