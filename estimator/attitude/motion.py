"""Motion of the images of a turning camera: velocities, the rows' times of a rolling shutter, a frame at one time.

A camera that turns at the rate w, in its own axes, sees a place b from the bearing move as db/dt = -w x b. The ray is
that of q = b - r, with r the lever arm; a star is infinitely far, b = q. The tangents (q_x / q_z, q_y / q_z) move by
-J w, with J the Jacobian of `nearfield.tangent_jacobian`.

In a rolling shutter row y is exposed tau (y - y_mid) after the middle row. An image that moves at v px/s is found where
it is at mid-exposure of the row where it is found. This is exact for a constant v and an image that is symmetric about
its center. Its streak of an exposure T is longer than in a global shutter if it moves with the readout:
v T / (1 - v_y tau).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import on_sphere
from estimator.attitude.nearfield import tangent_jacobian
from estimator.core.arrays import Floats
from estimator.core.camera import Camera
from estimator.core.types import Centroids, RateEstimate


class Sight(NamedTuple):
    """Where the lights are that a camera sees.

    lever_cam_m : (3,) the camera from the bearing, in camera axes
    radius_m    : distance of the lights from the bearing: of all, or (N,) of each
    """

    lever_cam_m: Floats
    radius_m: Floats | float

    def take(self, which: NDArray[Any]) -> Sight:
        """The sight of some of the lights, by mask or index."""
        return (
            self._replace(radius_m=self.radius_m[which])
            if isinstance(self.radius_m, np.ndarray)
            else self
        )


STARS = Sight(np.zeros(3), 1.0)  # without a lever arm the distance has no effect


def places_cam(rays_cam: Floats, sight: Sight) -> Floats:
    """(N, 3) places of lights from the bearing, in camera axes, from their rays (N, 3).

    Raises ValueError if the camera is farther from the bearing than a light.
    """
    return on_sphere(rays_cam, sight.lever_cam_m, sight.radius_m)


def tangent_motion(rays_cam: Floats, sight: Sight = STARS) -> Floats:
    """(N, 2, 3) derivative of the tangents' velocity, 1/s, by the rate of the camera. Errors as `places_cam`."""
    place = places_cam(rays_cam, sight)
    return -tangent_jacobian(place, place - sight.lever_cam_m).reshape(-1, 2, 3)


def center_streak_px(camera: Camera, rate: RateEstimate, exposure_s: float) -> tuple[float, float]:
    """(dx, dy) of the streak of a star at the boresight over an exposure."""
    dx, dy = (
        camera.focal_px
        * exposure_s
        * tangent_motion(np.array([[0.0, 0.0, 1.0]]))[0]
        @ rate.rate_rad_s
    )
    return float(dx), float(dy)


def streak_factor(camera: Camera, velocity_tan_s: Floats) -> Floats:
    """(N,) length of streaks of a velocity (N, 2) in tangents/s, over that in a global shutter: 1 / (1 - v_y tau)."""
    return np.asarray(1 / (1 - camera.focal_px * camera.row_time_s * velocity_tan_s[:, 1]))


def at_middle_row(
    camera: Camera, centroids: Centroids, rate: RateEstimate, sight: Sight = STARS
) -> Centroids:
    """The centroids where they are at mid-exposure of the middle row, as in a global shutter.

    Each ray's place is turned by exp([w] t), t its row's delay. The position depends on the row in which it is found,
    so that its error e becomes (I - tau v e_y') e. The rate's covariance is added to each, as if it were independent.
    """
    if not camera.row_time_s:
        return centroids
    xy_px = centroids.xy_px
    delay_s = camera.row_delays_s(centroids.xy_px)
    rays = camera.rays(xy_px)
    place = places_cam(rays, sight)
    moved_px = camera.pixels(
        Rotation.from_rotvec(delay_s[:, None] * rate.rate_rad_s).apply(place) - sight.lever_cam_m
    )
    moved_px = np.where(np.isfinite(moved_px), moved_px, xy_px)
    motion = tangent_motion(rays, sight)
    gain = error_gain(camera, motion @ rate.rate_rad_s)
    covariance_px2 = gain @ covariance_of(centroids) @ np.swapaxes(gain, 1, 2)
    by_rate = camera.focal_px * motion * delay_s[:, None, None]
    covariance_px2 += by_rate @ rate.covariance_rad2_s2 @ np.swapaxes(by_rate, 1, 2)
    sigma_px = np.sqrt(np.trace(covariance_px2, axis1=1, axis2=2) / 2)
    return replace(centroids, xy_px=moved_px, sigma_px=sigma_px, covariance_px2=covariance_px2)


def error_gain(camera: Camera, velocity_tan_s: Floats) -> Floats:
    """(N, 2, 2) I - tau v e_y': error of a light's position at the middle row by that of its centroid."""
    gain = np.tile(np.eye(2), (len(velocity_tan_s), 1, 1))
    gain[:, :, 1] -= camera.focal_px * camera.row_time_s * velocity_tan_s
    return gain


def covariance_of(centroids: Centroids) -> Floats:
    """(N, 2, 2) covariance of each centroid, px^2."""
    if centroids.covariance_px2 is not None:
        return centroids.covariance_px2
    return np.asarray(centroids.sigma_px[:, None, None] ** 2 * np.eye(2))
