"""A frame for the eye: stretched by a table, packed as JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

CURVES: dict[str, Any] = {
    "square root": np.sqrt,
    "linear": lambda share: share,
    "logarithm": lambda share: np.log1p(200 * share) / np.log1p(200),
}
SAMPLED = 8  # every so many rows and columns tell the sky


@dataclass(frozen=True, slots=True)
class Facts:
    """A frame's numbers: median and scatter of its sky, its brightest pixel, in DN; how many pixels are saturated."""

    sky_dn: float
    scatter_dn: float
    peak_dn: float
    saturated: int


def span(image: NDArray) -> tuple[float, float]:
    """What is black in a frame and what is white: the sky, and a quarter of the way to the brightest pixel."""
    low, high = np.percentile(image[::SAMPLED, ::SAMPLED], (30, 99.9))
    return float(low), max(float(high), float(low + 0.25 * (image.max() - low)))


def stretched(
    image: NDArray, curve: str, bright: float = 1.0, between: tuple[float, float] | None = None
) -> NDArray[np.uint8]:
    """(H, W) of 8 bits, from the sky to near the brightest pixel.

    bright  : how much brighter than usual faint light is shown
    between : black and white, where they are another frame's; the frame's own if left out
    """
    low, high = between or span(image)
    top = low + max((high - low) / bright, 1.0)
    if image.dtype != np.uint16:
        return (255 * CURVES[curve](np.clip((image - low) / (top - low), 0, 1))).astype(np.uint8)
    levels = np.arange(int(image.max()) + 1)
    return (255 * CURVES[curve](np.clip((levels - low) / (top - low), 0, 1))).astype(np.uint8)[image]


def facts(image: NDArray, saturation_dn: float) -> Facts:
    """The sky by a sample: its median, and the scatter of what is near it, stars left out; peak and saturation by all.

    Near is within five sigma by the median deviation (Gauss: 1.4826), and no less than 3 DN: both are whole numbers.
    """
    sample = image[:: 2 * SAMPLED, ::SAMPLED].astype(float)
    sky = float(np.median(sample))
    off = np.abs(sample - sky)
    near = sample[off <= max(5 * 1.4826 * float(np.median(off)), 3.0)]
    peak = float(image.max())
    full = int(np.count_nonzero(image >= saturation_dn)) if peak >= saturation_dn else 0
    return Facts(sky, float(near.std()), peak, full)


def fitted(grey: NDArray[np.uint8], widest_px: int) -> NDArray[np.uint8]:
    """No wider than that: each pixel the mean of those that it stands for, so that no star is left out."""
    height, width = grey.shape
    if width <= widest_px:
        return grey
    size = widest_px, max(round(height * widest_px / width), 1)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(grey: NDArray[np.uint8]) -> bytes:
    """Packed for the way to the browser."""
    return bytes(cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 88])[1])
