"""Exact centroids and streaks of lights before a camera with a rolling shutter that rotates at a constant rate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.rate import STARS, Sight
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids

CAMERA = Camera(
    1600,
    1200,
    3000.0,
    (810.0, 590.0),
    distortion=(-0.1, 0.05, 1e-3, 0.0, 0.0),
    row_time_s=80e-6,
)
EXPOSURE_S = 0.02
SIGMA_PX = 0.05
STREAK_SIGMA_PX = 0.1


@dataclass
class Moving:
    """A camera's attitude at the middle row and its rate, and the places of lights, by their pixels at that time."""

    cam_from_ref: Rotation
    rate_rad_s: Floats
    still_px: Floats
    sight: Sight = STARS
    camera: Camera = CAMERA

    @cached_property
    def place_ref(self) -> Floats:
        """(N, 3) unit vectors of stars, or places from the bearing."""
        rays = self.camera.rays(self.still_px)
        lever = self.sight.lever_cam_m
        along = rays @ lever
        distance = -along + np.sqrt(
            along**2 - lever @ lever + np.asarray(self.sight.radius_m) ** 2
        )
        return self.cam_from_ref.inv().apply(lever + distance[:, None] * rays)

    def pixels(self, t_s: Floats) -> Floats:
        """(N, 2) pixels of the lights, each at its own time."""
        turn = Rotation.from_rotvec(-np.outer(t_s, self.rate_rad_s))
        return self.camera.pixels(
            turn.apply(self.cam_from_ref.apply(self.place_ref)) - self.sight.lever_cam_m
        )

    def found_px(self, offset_s: float) -> Floats:
        """(N, 2) pixels of lights at a time after mid-exposure of their rows."""
        xy_px = self.still_px
        for _ in range(15):
            xy_px = self.pixels(self.camera.row_delays_s(xy_px) + offset_s)
        return xy_px

    def centroids(self, rng: np.random.Generator | None = None) -> Centroids:
        """Centroids and streaks of random sign, with errors if there is a generator."""
        xy_px = self.found_px(0.0)
        streak_px = self.found_px(EXPOSURE_S / 2) - self.found_px(-EXPOSURE_S / 2)
        signs = np.where(np.arange(len(xy_px)) % 2, -1.0, 1.0)[:, None]
        if rng is not None:
            xy_px = xy_px + SIGMA_PX * rng.standard_normal(xy_px.shape)
            streak_px = streak_px + STREAK_SIGMA_PX * rng.standard_normal(xy_px.shape)
        count = len(xy_px)
        covariance_px2 = np.tile(STREAK_SIGMA_PX**2 * np.eye(2), (count, 1, 1))
        sigma_px = np.full(count, SIGMA_PX)
        return Centroids(
            xy_px, sigma_px, np.ones(count), None, signs * streak_px, covariance_px2
        )


def moving(
    rng: np.random.Generator, rate_deg_s: Floats, count: int = 30, sight: Sight = STARS
) -> Moving:
    """Lights at random pixels of the chip."""
    still_px = rng.uniform([20, 20], [1580, 1180], (count, 2))
    return Moving(Rotation.random(rng=rng), np.radians(rate_deg_s), still_px, sight)
