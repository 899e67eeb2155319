"""Other centroids of a refused picture: of its halves, without its clouds, of trails, and of binned pixels.

Trees, roofs and street lamps are at one side of a picture and may have more lights than there are stars; one half may
show only sky. Clouds and twilight vary within a tile of the detector's background, which takes this variation for
noise; a top-hat filter removes everything larger than stars. Noise breaks faint star trails into pieces; the streak
found in binned pixels joins them. Each retry counts as EXTRA_TRIES tries, so all retries together, twenty at most, add
no more than two hundredths to the accepted chance of a false match. They use the quick searches.
"""

from collections.abc import Iterator
from dataclasses import replace
from math import hypot
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.attitude.rate import covariance_of
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.detection.background import estimate_background
from estimator.detection.classify import NO_STAR
from estimator.detection.detect import DETECTORS, to_native
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid

# Centroids of a picture whose stars are large: out of focus, or blurred by motion.


FACTORS = (8, 4, 2)  # sides of the binned squares; the most reduced picture is the fastest
MIN_SIDE_PX = 200  # least side of a binned picture
# Number of the brightest lights of the binned picture, and their least median area; a sharp star has 10 pixels.
BRIGHTEST = 12
MIN_AREA_PX = 30
MAX_SIGMA_PX = 20.0  # greatest error that `Centroids.check_values` allows


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
            yield factor, enlarged(centroids_of(small, settings), factor, settings)
        except ImageError:  # there are no lights, or thousands
            continue


def bin_pixels(image: NDArray, factor: int) -> NDArray[np.uint16]:
    """The means of squares of pixels, scaled to 16 bits; incomplete squares at the right and below are cut off."""
    height, width = (side // factor for side in image.shape)
    light = image[: height * factor, : width * factor].astype(np.float32)
    small = cv2.resize(light, (width, height), interpolation=cv2.INTER_AREA)
    low = float(small.min())
    high = float(small.max())
    return np.rint((small - low) * (65535 / max(high - low, 1e-30))).astype(np.uint16)


def enlarged(centroids: Centroids, factor: int, settings: Settings) -> Centroids:
    """Centroids of a binned picture in pixels of the original; the floor of their errors is in binned pixels."""
    floor_px = settings.searched_sigma_px
    out = replace(
        centroids,
        xy_px=factor * centroids.xy_px + (factor - 1) / 2,
        sigma_px=factor * np.hypot(centroids.sigma_px, floor_px),
        covariance_px2=factor**2 * (covariance_of(centroids) + floor_px**2 * np.eye(2)),
        streak_px=None,
        streak_covariance_px2=None,
    )
    return out.take(out.sigma_px < MAX_SIGMA_PX)


def centroids_of(
    pixels: NDArray, settings: Settings, streak_px: tuple[float, float] | None = None
) -> Centroids:
    """The centroids of a picture, along a streak if one is given."""
    # The detection uses only the camera's size.
    camera = Camera.from_fov(pixels.shape[1], pixels.shape[0], 1.0)
    return detect_and_centroid(pixels, camera, settings, Clock(), streak_px)


EXTRA_TRIES = 1000
MIN_LIGHTS = (
    10  # least lights of a half; fewer were searched in all combinations with the others
)
# Number of searches of a half, and of the upper half (the likeliest) and of other centroids.
EFFORTS = 1
MORE_EFFORTS = 2
UNEVEN = (
    2.0  # least ratio of the 90 % to the 10 % quantile of the noise of the background's tiles
)
TOPHAT_PX = 15  # width of the filter, more than that of a sharp star
# Sides of the binned squares. Trails shorter than MIN_TRAIL_PX are found without binning.
TRAIL_FACTORS = (3, 2, 4)
MIN_TRAIL_PX = 10.0
# Streak for sharp stars, because remains of the edges of trees are parallel, as streaks are.
ROUND = (0.0, 0.0)
FLAT_SIGMA_PX = (
    0.25  # least error of their centroids: JPEG has removed faint light beside clouds
)
FLAT = "its stars were found without its clouds"
HALF = "its stars were found in its {} half alone"
TRAILED = "its stars are trails, some too faint to be seen as one in single pixels"
BINNED = "its lights are large: they were found in the picture binned {0}x{0}"


class Retry(NamedTuple):
    """A note on what is tried, the number of searches, the centroids; `upper_half` as in `solver.Solver`."""

    note: str
    efforts: int
    centroids: Centroids
    upper_half: bool = False


def retries(pixels: NDArray, centroids: Centroids, settings: Settings) -> Iterator[Retry]:
    """Yield the retries of a picture; `centroids` are those of the refused attempt, in the unchanged picture."""
    yield from halves(pixels, centroids, "")
    flat = without_clouds(pixels, settings)
    if len(flat):
        yield Retry(FLAT, EFFORTS, flat)
        yield from halves(pixels, flat, f"{FLAT}, ")
    for trailed in trails(pixels, settings):
        yield Retry(TRAILED, MORE_EFFORTS, trailed)
    for factor, large in large_lights(pixels, settings):
        yield Retry(BINNED.format(factor), MORE_EFFORTS, large)


def halves(pixels: NDArray, centroids: Centroids, note: str) -> Iterator[Retry]:
    """The halves of a picture as retries; `note` is put before their own notes."""
    middle = (np.array(pixels.shape[::-1]) - 1) / 2
    right, low = (centroids.xy_px > middle).T
    for side, inside in (("upper", ~low), ("lower", low), ("left", ~right), ("right", right)):
        if MIN_LIGHTS <= np.count_nonzero(inside) < len(centroids):
            efforts = MORE_EFFORTS if side == "upper" else EFFORTS
            part = centroids.take(inside)
            yield Retry(note + HALF.format(side), efforts, part)
            if side == "upper":
                yield Retry(note + HALF.format(side), efforts, part, upper_half=True)


def trails(pixels: NDArray, settings: Settings) -> Iterator[Centroids]:
    """The centroids of star trails, detected along the streak that the picture's binned blobs share.

    Noise breaks a long faint trail into pieces. Most blobs then are pieces, and their common streak is too short. The
    mean of n^2 pixels has n times the signal-to-noise ratio, so the trail is one piece there. With its streak the
    detector adds up the light along each trail in the original pixels.
    """
    for factor in TRAIL_FACTORS:
        try:
            blobs = DETECTORS[settings.detector](
                bin_pixels(pixels, factor), settings.threshold_sigma
            )
            x, y = factor * np.array(blobs.streak_px or ROUND)
            if hypot(x, y) >= MIN_TRAIL_PX:
                yield centroids_of(pixels, settings, (x, y))
        except ImageError:
            continue


def without_clouds(pixels: NDArray, settings: Settings) -> Centroids:
    """The centroids of a picture from which all that is wider than stars is removed; none if its noise is uniform."""
    noise = estimate_background(to_native(pixels)).noise
    if np.quantile(noise, 0.9) < UNEVEN * np.quantile(noise, 0.1):
        return Centroids.empty()
    light = cv2.GaussianBlur(bin_pixels(pixels, 1), (0, 0), 0.5)
    flat = cv2.morphologyEx(
        light, cv2.MORPH_TOPHAT, np.ones((TOPHAT_PX, TOPHAT_PX), np.uint8)
    )
    try:
        # The edges of trees add about as many lights as there are stars.
        more = replace(settings, max_blobs=2 * settings.max_blobs)
        found = centroids_of(flat, more, ROUND)
        return replace(found, sigma_px=np.hypot(found.sigma_px, FLAT_SIGMA_PX))
    except ImageError:
        return Centroids.empty()
