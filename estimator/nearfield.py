"""Stars at a finite distance: a camera on a lever arm about a known centre, under lights at known places.

Inter-star angles are not invariant there. A ray is first brought onto the believed surface, which gives angles
about the bearing centre that are; the attitude is then solved exactly from the pixels, knowing that the camera
can only turn about that centre.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude import covariance, quest
from estimator.camera import Camera
from estimator.types import BadImage, Floats, Ints


@dataclass(frozen=True, slots=True)
class LedMap:
    """The believed dome: where its LEDs are and how its inside is shaped, in the lab frame.

    id         : (N,)
    position_m : (N, 3)
    centre_m, semi_axes_m : (3,) the ellipsoid x'A x' = 1 that the LEDs sit on
    board      : (N,) which LEDs share a patch board, whose lattice is every board's; None where each is by itself
    """

    id: Ints
    position_m: Floats
    centre_m: Floats
    semi_axes_m: Floats
    board: Ints | None = None


@dataclass(frozen=True, slots=True)
class Lever:
    """The believed place of the camera on the vehicle.

    camera_body_m : (3,) entrance pupil in the body frame;  cam_from_body : rotation
    """

    camera_body_m: Floats
    cam_from_body: Rotation


def on_sphere(rays_body: Floats, camera_body_m: Floats, radius_m: float) -> Floats:
    """(N, 3) points where rays from the camera meet a sphere about the bearing centre, in the body frame.

    |c + s u| = R gives s = -c.u + sqrt((c.u)^2 - c.c + R^2). No attitude is needed: a sphere looks the same
    from every one. Raises ValueError if the camera is outside the sphere.
    """
    along = rays_body @ camera_body_m
    under_root = along**2 - camera_body_m @ camera_body_m + radius_m**2
    if radius_m <= np.linalg.norm(camera_body_m):
        raise ValueError(
            f"the camera, {np.linalg.norm(camera_body_m)} m out, is not inside radius {radius_m} m"
        )
    return camera_body_m + (-along + np.sqrt(under_root))[:, None] * rays_body


def on_surface(rays_lab: Floats, origin_lab_m: Floats, leds: LedMap) -> Floats:
    """(N, 3) points where rays meet the believed ellipsoid from inside, in the lab frame; NaN where they miss.

    With scaled coordinates w = (x - centre) / semi_axes the surface is |w| = 1: a quadratic in the distance.
    """
    start = (origin_lab_m - leds.centre_m) / leds.semi_axes_m
    along = rays_lab / leds.semi_axes_m
    a = np.sum(along**2, axis=1)
    b = along @ start
    root = b**2 - a * (start @ start - 1)
    distance = np.where(root >= 0, (-b + np.sqrt(np.maximum(root, 0))) / a, np.nan)
    return origin_lab_m + distance[:, None] * rays_lab


def project(body_from_lab: Rotation, position_m: Floats, lever: Lever, camera: Camera) -> Floats:
    """(N, 2) pixels of lights at (N, 3) lab places; NaN behind the camera."""
    in_body = body_from_lab.apply(position_m) - lever.camera_body_m
    return camera.pixels(lever.cam_from_body.apply(in_body))


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
    R_body_from_cam = cam_from_body.inv().as_matrix()
    return body_from_lab, R_body_from_cam @ covariance_cam @ R_body_from_cam.T


def _jacobian(b: Floats, q: Floats) -> Floats:
    """(2 N, 3) derivative of the tangents of q = b - r by a small rotation w of b: dq = w x b."""
    inverse_z = 1 / q[:, 2]
    zero = np.zeros_like(inverse_z)
    d_x = np.column_stack([inverse_z, zero, -q[:, 0] * inverse_z**2])
    d_y = np.column_stack([zero, inverse_z, -q[:, 1] * inverse_z**2])
    # d . (w x b) = w . (b x d)
    rows = np.stack([np.cross(b, d_x), np.cross(b, d_y)], axis=1)
    return rows.reshape(-1, 3)


def ray_on_surface(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> tuple[Rotation, Floats]:
    """Bring each ray onto the believed ellipsoid at the last attitude, solve Wahba about the centre, repeat.

    Same arguments and results as rotation_only. Its error is the surface's: an LED off the believed ellipsoid,
    or one whose ray meets it obliquely. The covariance is that of Wahba's problem with the ray's angular error
    carried to the bearing centre by the ratio of the distances.
    """
    distance = np.ones(len(rays_cam))
    for _ in range(20):
        lab_from_cam = body_from_lab.inv() * lever.cam_from_body.inv()
        origin = body_from_lab.inv().apply(lever.camera_body_m)
        met = on_surface(lab_from_cam.apply(rays_cam), origin, leds)
        if np.isnan(met).any():
            raise ValueError("a ray misses the believed surface")
        in_body = body_from_lab.apply(met)
        radius = np.linalg.norm(in_body, axis=1)
        distance = np.linalg.norm(in_body - lever.camera_body_m, axis=1) / radius
        target = position_m / np.linalg.norm(position_m, axis=1, keepdims=True)
        better = quest(in_body / radius[:, None], target, sigma_rad * distance)
        moved = (better * body_from_lab.inv()).magnitude()
        body_from_lab = better
        if moved < 1e-13:
            break
    unit = in_body / radius[:, None]
    return body_from_lab, covariance(unit, sigma_rad * distance)


NearSolver = Callable[..., tuple[Rotation, Floats]]
SOLVERS: dict[str, NearSolver] = {"rotation_only": rotation_only, "ray_on_surface": ray_on_surface}


def check_lever(leds: LedMap, lever: Lever) -> None:
    """Raise BadImage unless the lever arm reaches less far than the nearest LED."""
    nearest = np.linalg.norm(leds.position_m, axis=1).min()
    reach = np.linalg.norm(lever.camera_body_m)
    if reach >= nearest:
        raise BadImage(
            f"the camera is believed {reach:.3f} m from the bearing, the nearest LED {nearest:.3f} m"
        )
