"""Other centroids of a picture that was refused: of its halves, without its clouds, and with its pixels binned.

Trees, roofs and street lamps are at one side of a picture, and there may be more of their lights than stars: one half
may show the sky alone. Clouds and twilight change the sky within a tile of the detector's background, which takes that
for noise; a top-hat filter removes all that is larger than stars. All retries together add no more than some
thousandths to the accepted chance of a false match, as each has EXTRA_TRIES times the bar; they use the quick searches.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.detection.background import estimate_background
from estimator.detection.detect import to_native
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.apps.plate_solver import binned

EXTRA_TRIES = 1000
MIN_LIGHTS = 10  # in a half: fewer were searched in all combinations with the others
EFFORTS, MORE_EFFORTS = 1, 2  # searches of a half; of the upper one, the likeliest, and of a binned picture
UNEVEN = 2.0  # least ratio of the 90 % to the 10 % quantile of the noise of the background's tiles
TOPHAT_PX = 15  # wider than a sharp star
FLAT = "its stars were found without its clouds"
HALF = "its stars were found in its {} half alone"
BINNED = "its lights are large: they were found in the picture binned {0}x{0}"


def retries(pixels: NDArray, centroids: Centroids, settings: Settings) -> Iterator[tuple[str, int, Centroids]]:
    """What is tried, the number of searches, and the centroids in pixels of the picture."""
    yield from halves(pixels, centroids, "")
    flat = without_clouds(pixels, settings)
    if len(flat):
        yield FLAT, EFFORTS, flat
        yield from halves(pixels, flat, f"{FLAT}, ")
    for factor, large in binned.large_lights(pixels, settings):
        yield BINNED.format(factor), MORE_EFFORTS, large


def halves(pixels: NDArray, centroids: Centroids, note: str) -> Iterator[tuple[str, int, Centroids]]:
    """The halves of a picture, as `retries`; `note` is put before what is tried."""
    middle = (np.array(pixels.shape[::-1]) - 1) / 2
    right, low = (centroids.xy_px > middle).T
    for side, inside in (("upper", ~low), ("lower", low), ("left", ~right), ("right", right)):
        if MIN_LIGHTS <= np.count_nonzero(inside) < len(centroids):
            yield note + HALF.format(side), MORE_EFFORTS if side == "upper" else EFFORTS, centroids.take(inside)


def without_clouds(pixels: NDArray, settings: Settings) -> Centroids:
    """The centroids of a picture without what is wider than stars; none if its noise is even."""
    noise = estimate_background(to_native(pixels)).noise
    if np.quantile(noise, 0.9) < UNEVEN * np.quantile(noise, 0.1):
        return Centroids.empty()
    light = cv2.GaussianBlur(binned.bin_pixels(pixels, 1), (0, 0), 0.5)
    flat = cv2.morphologyEx(light, cv2.MORPH_TOPHAT, np.ones((TOPHAT_PX, TOPHAT_PX), np.uint8))
    try:
        camera = Camera.from_fov(pixels.shape[1], pixels.shape[0], 1.0)  # only its size is used
        return detect_and_centroid(flat, camera, settings, Clock())
    except ImageError:
        return Centroids.empty()
