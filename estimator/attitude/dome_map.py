"""What is believed of a dome and of the camera under it: lights at known places on a known surface, on a lever arm.

Inter-star angles are not invariant there. A ray brought onto the believed surface gives angles about the bearing
centre that are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.arrays import Floats, Ints
from estimator.core.camera import Camera
from estimator.core.errors import ImageError


@dataclass(frozen=True, slots=True)
class LedMap:
    """The believed dome: where its LEDs are and how its inside is shaped, in the lab frame.

    id         : (N,)
    position_m : (N, 3)
    centre_m, semi_axes_m : (3,) the ellipsoid x'A x' = 1 that the LEDs sit on
    board      : (N,) which LEDs share a patch board, whose lattice is every board's; None where each is by itself
    sigma_m    : standard deviation of a place along each axis
    """

    id: Ints
    position_m: Floats
    centre_m: Floats
    semi_axes_m: Floats
    board: Ints | None = None
    sigma_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Lever:
    """The believed place of the camera on the vehicle.

    camera_body_m : (3,) entrance pupil in the body frame;  cam_from_body : rotation
    sigma_m       : standard deviation of the pupil's place along each axis
    """

    camera_body_m: Floats
    cam_from_body: Rotation
    sigma_m: float = 0.0


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


def check_lever(leds: LedMap, lever: Lever) -> None:
    """Raise ImageError unless the lever arm reaches less far than the nearest LED."""
    nearest = np.linalg.norm(leds.position_m, axis=1).min()
    reach = np.linalg.norm(lever.camera_body_m)
    if reach >= nearest:
        raise ImageError(
            f"the camera is believed {reach:.3f} m from the bearing, the nearest LED {nearest:.3f} m"
        )
