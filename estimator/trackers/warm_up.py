"""Compilation before the flight: frames of the tracker's own lights, drawn here, on which every stage runs once.

numba compiles a function for the types of its first call, which takes seconds, and keeps the code on disk. The frames
reach every compiled function of a tracker: round lights and streaks, dim and bright ones for both widths of the
detector's sums, a square that no model fits, too few lights, and a mirrored sky, for which every search runs to its
end.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import DTypeLike, NDArray

from estimator.core.camera import Camera
from estimator.core.checks import Floats, Step
from estimator.core.errors import ImageError
from estimator.detection.detect import to_native

SKY = 100.0
NOISE = 2.0
# Peaks of the brightest light: 12-bit pixels have narrower sums than 16-bit ones.
DIM = 1500.0
BRIGHT = 6000.0
SPOT_SIGMA_PX = 1.0
REACH_PX = 6
STREAK_PX = (7.0, 4.0)
MAX_SPOTS = 40


def loop_type(dtype: DTypeLike) -> np.dtype:
    """Return the type of pixels for which the loops are compiled: that of `to_native` for an image of this type."""
    try:
        return to_native(np.zeros((1, 1), dtype)).dtype
    except (TypeError, ImageError):
        raise ImageError(
            f"warm_up: dtype is {dtype!r}; allowed: the type of the frames' pixels, numbers"
        ) from None


def draw(
    camera: Camera, xy_px: Floats, peak: Floats, dtype: np.dtype, streak_px: Step = (0.0, 0.0)
) -> NDArray:
    """Return a frame with Gaussian spots over sky and noise.

    Parameters
    ----------
    xy_px, peak
        (N, 2) positions and (N,) peak light of the spots
    dtype
        Type of the pixels
    streak_px
        (dx, dy) along which each spot is smeared
    """
    image = np.random.Generator(np.random.PCG64(1)).normal(
        SKY, NOISE, (camera.height_px, camera.width_px)
    )
    steps = np.linspace(-0.5, 0.5, 1 + 2 * int(np.hypot(*streak_px)))[:, None] * np.array(
        streak_px
    )
    for middle_px, light in zip(xy_px, peak, strict=True):
        for x_px, y_px in middle_px + steps:
            left = max(int(x_px) - REACH_PX, 0)
            top = max(int(y_px) - REACH_PX, 0)
            part = image[top : int(y_px) + REACH_PX, left : int(x_px) + REACH_PX]
            across = np.arange(part.shape[1]) + left - x_px
            down = np.arange(part.shape[0]) + top - y_px
            squares = across**2 + down[:, None] ** 2
            part += light / np.sqrt(len(steps)) * np.exp(-squares / (2 * SPOT_SIGMA_PX**2))
    return image.astype(dtype)


def run(
    camera: Camera,
    xy_px: Floats,
    light: Floats,
    dtype: DTypeLike,
    look: Callable[[NDArray, Step | None], object],
) -> None:
    """Call `look(image, streak_px)` on every kind of frame of lights at (N, 2) pixels with (N,) relative brightness."""
    kind = loop_type(dtype)
    spots = slice(0, MAX_SPOTS)
    xy_px = xy_px[spots]
    light = np.maximum(light[spots] / light.max(), 0.05)
    dim, bright = (draw(camera, xy_px, peak * light, kind) for peak in (DIM, BRIGHT))
    smeared = draw(camera, xy_px, DIM * light, kind, STREAK_PX)
    square = bright.copy()
    y = camera.height_px // 2
    x = camera.width_px // 2
    square[y - 5 : y + 5, x - 5 : x + 5] = BRIGHT
    few = draw(camera, xy_px[:2], DIM * light[:2], kind, STREAK_PX)
    mirrored = np.ascontiguousarray(dim[:, ::-1])
    two_skies = np.maximum(dim, mirrored)
    for image in (dim, bright, few, smeared, mirrored, two_skies):
        look(image, None)
    look(square, (0.0, 0.0))
    look(smeared, STREAK_PX)
