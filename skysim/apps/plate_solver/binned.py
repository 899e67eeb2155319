"""Centroids of a picture whose stars are large: out of focus, or blurred by motion.

The detector's filter suits stars of some pixels. A star of hundreds of pixels is broken up by noise, and a faint one is
not seen. Both are as the detector expects them where the pixels are added up in squares (binned). Only a picture whose
brightest lights are still large when it is binned is solved that way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.attitude.motion import covariance_of
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.detection.classify import NO_STAR
from estimator.detection.detect import DETECTORS
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid

FACTORS = (8, 4, 2)  # sides of the squares: the most reduced picture is the fastest
MIN_SIDE_PX = 200  # of a binned picture
# of so many lights of the binned picture the median area; a sharp star has 10
BRIGHTEST = 12
MIN_AREA_PX = 30
MAX_SIGMA_PX = 20.0  # that `Centroids.check_values` allows


def large_lights(image: NDArray, settings: Settings) -> Iterator[tuple[int, Centroids]]:
    """The sides of the squares for which a picture's lights are large, and the centroids in pixels of the picture."""
    for factor in FACTORS:
        if min(image.shape) < factor * MIN_SIDE_PX:
            continue
        small = bin_pixels(image, factor)
        try:
            found = DETECTORS[settings.detector](
                small, settings.threshold_sigma, settings.min_area_px
            )
            area_px = found.area_px[found.flag & NO_STAR == 0][:BRIGHTEST]
            if not len(area_px) or np.median(area_px) < MIN_AREA_PX:
                continue
            camera = camera_of(small)
            yield (
                factor,
                enlarged(detect_and_centroid(small, camera, settings, Clock()), factor, settings),
            )
        except ImageError:  # nothing is left, or there are thousands of lights
            continue


def bin_pixels(image: NDArray, factor: int) -> NDArray[np.uint16]:
    """The means of squares of pixels, spread over 16 bits; what is left over at the right and below is cut off."""
    height, width = (side // factor for side in image.shape)
    light = image[: height * factor, : width * factor].astype(np.float32)
    small = cv2.resize(light, (width, height), interpolation=cv2.INTER_AREA)
    low = float(small.min())
    high = float(small.max())
    return np.rint((small - low) * (65535 / max(high - low, 1e-30))).astype(np.uint16)


def enlarged(centroids: Centroids, factor: int, settings: Settings) -> Centroids:
    """Centroids of a binned picture in pixels of the picture itself; the floor of their errors is in binned pixels."""
    floor_px2 = settings.centroid_sigma_px**2 * np.eye(2)
    out = replace(
        centroids,
        xy_px=factor * centroids.xy_px + (factor - 1) / 2,
        sigma_px=factor * np.hypot(centroids.sigma_px, settings.centroid_sigma_px),
        covariance_px2=factor**2 * (covariance_of(centroids) + floor_px2),
        streak_px=None,
        streak_covariance_px2=None,
    )
    return out.take(out.sigma_px < MAX_SIGMA_PX)


def camera_of(pixels: NDArray) -> Camera:
    """A camera for the detection, which uses only its size."""
    return Camera.from_fov(pixels.shape[1], pixels.shape[0], 1.0)
