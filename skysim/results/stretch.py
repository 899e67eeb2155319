"""Convert frames to 8-bit images for display, and encode them as JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.core.constants import SIGMA_PER_MAD

CURVES: dict[str, Any] = {
    "square root": np.sqrt,
    "linear": lambda fraction: fraction,
    "logarithm": lambda fraction: np.log1p(200 * fraction) / np.log1p(200),
}
SAMPLE_STRIDE = 8  # stride in rows and columns of the sample for the sky statistics


@dataclass(frozen=True, slots=True)
class FrameStatistics:
    """Statistics of a frame: sky median, sky standard deviation and peak, all in DN; number of saturated pixels."""

    sky_dn: float
    scatter_dn: float
    peak_dn: float
    saturated: int


def display_levels(image: NDArray) -> tuple[float, float]:
    """Black and white levels in DN: the sky (30th percentile), and the 99.9th percentile or, if that is higher,
    a quarter of the way from the sky to the brightest pixel."""
    low, high = np.percentile(image[::SAMPLE_STRIDE, ::SAMPLE_STRIDE], (30, 99.9))
    return float(low), max(float(high), float(low + 0.25 * (image.max() - low)))


def to_8bit(
    image: NDArray, curve: str, levels_dn: tuple[float, float] | None = None
) -> NDArray[np.uint8]:
    """(H, W) uint8 image, stretched from the black level to the white level by one of CURVES.

    levels_dn : black and white levels, for example of another frame; by default those of `display_levels`

    A uint16 frame is mapped through a lookup table, which is faster than evaluating the curve at each pixel.
    """
    low, high = levels_dn or display_levels(image)
    top = low + max(high - low, 1.0)  # at least 1 DN, to avoid division by zero in a flat frame
    if image.dtype != np.uint16:
        return (255 * CURVES[curve](np.clip((image - low) / (top - low), 0, 1))).astype(np.uint8)
    levels = np.arange(int(image.max()) + 1)
    return (255 * CURVES[curve](np.clip((levels - low) / (top - low), 0, 1))).astype(np.uint8)[
        image
    ]


def frame_statistics(image: NDArray, saturation_dn: float) -> FrameStatistics:
    """Sky median and standard deviation from a sample of the pixels; peak and saturation count from all of them.

    Stars are excluded from the standard deviation by a clip at five sigma, with sigma = 1.4826 x the median absolute
    deviation (exact for a Gaussian). The limit is at least 3 DN, because in digitized frames the median and the
    deviation are integers and the deviation can be 0.
    """
    sample = image[:: 2 * SAMPLE_STRIDE, ::SAMPLE_STRIDE].astype(float)
    sky = float(np.median(sample))
    deviation = np.abs(sample - sky)
    background = sample[deviation <= max(5 * SIGMA_PER_MAD * float(np.median(deviation)), 3.0)]
    peak = float(image.max())
    saturated = int(np.count_nonzero(image >= saturation_dn)) if peak >= saturation_dn else 0
    return FrameStatistics(sky, float(background.std()), peak, saturated)


def reduce_width(image: NDArray[np.uint8], max_width_px: int) -> NDArray[np.uint8]:
    """The image reduced to at most `max_width_px` columns; area averaging, so that no star is skipped."""
    height, width = image.shape[:2]
    if width <= max_width_px:
        return image
    size = max_width_px, max(round(height * max_width_px / width), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(gray: NDArray[np.uint8]) -> bytes:
    """The image as JPEG bytes for the browser."""
    return bytes(cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, 88])[1])
