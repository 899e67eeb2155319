"""Convert frames to 8-bit images for display, and encode them as JPEG."""

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
SAMPLED = 8  # stride in rows and columns of the sample for the sky statistics


@dataclass(frozen=True, slots=True)
class Facts:
    """Statistics of a frame: sky median, sky standard deviation and peak, all in DN; number of saturated pixels."""

    sky_dn: float
    scatter_dn: float
    peak_dn: float
    saturated: int


def span(image: NDArray) -> tuple[float, float]:
    """Black and white levels in DN: the sky (30th percentile), and the 99.9th percentile or, if that is higher,
    a quarter of the way from the sky to the brightest pixel."""
    low, high = np.percentile(image[::SAMPLED, ::SAMPLED], (30, 99.9))
    return float(low), max(float(high), float(low + 0.25 * (image.max() - low)))


def stretched(
    image: NDArray, curve: str, bright: float = 1.0, between: tuple[float, float] | None = None
) -> NDArray[np.uint8]:
    """(H, W) uint8 image, stretched from the black level to the white level by one of CURVES.

    bright  : gain; the white level is lowered by this factor so that faint sources appear brighter
    between : black and white levels in DN, for example of another frame; by default those of `span`

    A uint16 frame is mapped through a lookup table, which is faster than evaluating the curve at each pixel.
    """
    low, high = between or span(image)
    top = low + max((high - low) / bright, 1.0)  # at least 1 DN, to avoid division by zero in a flat frame
    if image.dtype != np.uint16:
        return (255 * CURVES[curve](np.clip((image - low) / (top - low), 0, 1))).astype(np.uint8)
    levels = np.arange(int(image.max()) + 1)
    return (255 * CURVES[curve](np.clip((levels - low) / (top - low), 0, 1))).astype(np.uint8)[image]


def facts(image: NDArray, saturation_dn: float) -> Facts:
    """Sky median and standard deviation from a sample of the pixels; peak and saturation count from all of them.

    Stars are excluded from the standard deviation by a clip at five sigma, with sigma = 1.4826 x the median absolute
    deviation (exact for a Gaussian). The limit is at least 3 DN, because in digitized frames the median and the
    deviation are integers and the deviation can be 0.
    """
    sample = image[:: 2 * SAMPLED, ::SAMPLED].astype(float)
    sky = float(np.median(sample))
    off = np.abs(sample - sky)
    near = sample[off <= max(5 * 1.4826 * float(np.median(off)), 3.0)]
    peak = float(image.max())
    full = int(np.count_nonzero(image >= saturation_dn)) if peak >= saturation_dn else 0
    return Facts(sky, float(near.std()), peak, full)


def fitted(grey: NDArray[np.uint8], widest_px: int) -> NDArray[np.uint8]:
    """The image reduced to at most `widest_px` columns; area averaging, so that no star is skipped."""
    height, width = grey.shape
    if width <= widest_px:
        return grey
    size = widest_px, max(round(height * widest_px / width), 1)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(grey: NDArray[np.uint8]) -> bytes:
    """The image as JPEG bytes for the browser."""
    return bytes(cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 88])[1])
