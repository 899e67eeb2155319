"""What every tracker shares: its settings, and the stages from a frame to its lights."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimator.camera import Camera, check_shape
from estimator.centroid import CENTROIDERS
from estimator.detect import DETECTORS
from estimator.types import Attitude, BadImage, Centroids, Floats

SATURATED = "the frame is saturated"


@dataclass(frozen=True, slots=True)
class Settings:
    """Which algorithm does each stage, and its thresholds.

    centroid_sigma_px : floor of a centroid's error, for what its own noise does not cover
    base_stars        : among how many of the brightest blobs patterns are sought
    field_stars       : how many catalogue stars a field should hold on average when patterns are sought
    """

    detector: str = "local"
    centroider: str = "cog"
    identifier: str = "default"
    solver: str = "quest"
    threshold_sigma: float = 5.0
    min_area_px: int = 3
    max_blobs: int = 100
    gain_e_dn: float = 1.0
    saturation: float = float("inf")
    centroid_sigma_px: float = 0.1
    base_stars: int = 20
    field_stars: float = 30.0
    missed_dex: float = 0.5


@dataclass(slots=True)
class Report:
    """One frame's answer with what it rests on: the centroids, and seconds spent by stage."""

    attitude: Attitude
    centroids: Centroids
    seconds: dict[str, float] = field(default_factory=dict)


class Clock:
    """Seconds between laps, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now


def see(image: NDArray, camera: Camera, settings: Settings, clock: Clock) -> Centroids:
    """Detect and centroid. Raises BadImage for a frame that cannot be one of this camera's."""
    check_shape(image.shape, camera)
    if np.isfinite(settings.saturation) and np.mean(image >= settings.saturation) > 0.5:
        raise BadImage(f"{SATURATED}: over half of its pixels are at {settings.saturation:g}")
    blobs = DETECTORS[settings.detector](
        image, settings.threshold_sigma, settings.min_area_px, settings.max_blobs
    )
    blobs = blobs.take(whole(blobs.box_px, camera))
    clock.lap("detect")
    centroids = CENTROIDERS[settings.centroider](image, blobs, settings.gain_e_dn)
    clock.lap("centroid")
    sound = camera.contains(centroids.xy_px) & np.isfinite(centroids.sigma_px) & (centroids.flux > 0)
    return centroids.take(sound)


def look(
    image: NDArray, camera: Camera, settings: Settings, solve: Callable[[Centroids, Clock], Attitude]
) -> Report:
    """A frame through all stages, timed."""
    clock = Clock()
    centroids = see(image, camera, settings, clock)
    return Report(solve(centroids, clock), centroids, clock.seconds)


def brightest(centroids: Centroids, settings: Settings) -> Centroids:
    """As many as identification looks at: twice those among which it seeks its patterns."""
    return centroids.take(np.arange(min(len(centroids), 2 * settings.base_stars)))


def direction_sigma_rad(centroids: Centroids, camera: Camera, settings: Settings) -> Floats:
    """(N,) error of a direction: the centroid's own, and the floor for what that does not cover."""
    return np.hypot(centroids.sigma_px, settings.centroid_sigma_px) / camera.focal_px


def whole(box_px: NDArray, camera: Camera) -> NDArray:
    """(N,) whether a blob's box keeps off the border: one cut off by it has its centre elsewhere."""
    x0, y0, x1, y1 = box_px.T
    return (x0 > 0) & (y0 > 0) & (x1 < camera.width_px - 1) & (y1 < camera.height_px - 1)
