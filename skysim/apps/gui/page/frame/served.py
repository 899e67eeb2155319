"""A frame as the browser gets it: pixels, whole or as many as the screen has, with display limits, histogram and marks.

While frames follow one another the browser asks for reduced ones: handling a million pixels takes it longer than a
frame lasts. Limits and histogram are those of the whole frame, so the picture does not change when it comes to rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from astropy.visualization import ZScaleInterval
from nicegui import json
from numpy.typing import NDArray

from skysim.results import stretch

LIMITS = ("automatic", "zscale", "min to max", "manual")  # of the display; the last are set in the browser
BINS = 80  # of the histogram
QUARTILE_SIGMA = 1.4826  # of a normal distribution, over the distance from quartile to median
AXIS_MARGIN = 0.3  # on either side of it, in units of its axis
ZSCALE_SAMPLES = 1000  # pixels, as in IRAF
LOUPE_PX = 11  # most rows and columns in the loupe
HEADER_BYTES = 16  # of `worker.pixels.encoded`


@dataclass(frozen=True)
class ServedFrame:
    """A frame of a tab.

    encoded : pixels, see `worker.pixels.encoded`;  size_px : (width, height)
    saturation_dn : from which a pixel is saturated
    fields : what frame.js needs beside the pixels: pointing, marks, contents of live fields
    """

    encoded: bytes
    size_px: tuple[int, int]
    saturation_dn: float
    fields: Mapping[str, Any]

    def response(self, width_px: int, limits: str, near_px: tuple[int, int] | None = None) -> bytes:
        """Header, pixels, fields as JSON, and the length of these as an unsigned integer of 32 bits. So a frame comes
        with its marks, and little goes over the websocket, whose messages are compiled as code.

        width_px : of the screen, 0 for all pixels;  limits : one of LIMITS
        near_px : upper left one of the pixels in the loupe, which come unchanged beside reduced ones
        """
        levels = self.levels
        pixels = reduced(levels, width_px, self.saturation_level) if 0 < width_px < self.size_px[0] else levels
        fields: dict[str, Any] = {"size": self.size_px, "grid": pixels.shape[::-1], **self.fields}
        fields |= {"limits": limits_of(levels, limits), "histogram": histogram(levels)}
        fields["saturation"] = self.saturation_dn if math.isfinite(self.saturation_dn) else None
        if near_px:
            x, y = near_px
            fields["near"] = {"x": x, "y": y, "levels": levels[y:, x:][:LOUPE_PX, :LOUPE_PX].tolist()}
        text = json.dumps(fields).encode()
        return b"".join((self.encoded[:HEADER_BYTES], pixels.tobytes(), text, len(text).to_bytes(4, "little")))

    @property
    def levels(self) -> NDArray:
        """(H, W) the pixels as integers, of 8 or 16 bits."""
        width, height = self.size_px
        kind = np.uint8 if len(self.encoded) - HEADER_BYTES == width * height else np.uint16
        return np.frombuffer(self.encoded, kind, offset=HEADER_BYTES).reshape(height, width)

    @property
    def saturation_level(self) -> float:
        """The least saturated integer."""
        offset, step = np.frombuffer(self.encoded, float, 2)
        return float((self.saturation_dn - offset) / step)


def reduced(levels: NDArray, width_px: int, saturation: float) -> NDArray:
    """The image with fewer pixels, each the mean over its area; one that covers a saturated pixel is saturated."""
    height, width = levels.shape
    size = width_px, max(round(height * width_px / width), 1)
    mean = cv2.resize(levels, size, interpolation=cv2.INTER_AREA)
    if levels.max() >= saturation:
        share = cv2.resize((levels >= saturation).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        mean[share > 0] = levels.max()
    return np.ascontiguousarray(mean)


def limits_of(levels: NDArray, name: str) -> tuple[float, float]:
    """Black and white level by name."""
    if name == "zscale":
        samples = levels.ravel()[:: max(1, levels.size // ZSCALE_SAMPLES)][:ZSCALE_SAMPLES]
        low, high = ZScaleInterval().get_limits(samples)
        return float(low), float(high)
    if name == "min to max":
        return float(levels.min()), float(levels.max())
    return stretch.display_levels(levels)


def histogram(levels: NDArray) -> dict[str, Any]:
    """Counts of a sample of the pixels, in BINS of an axis that is an inverse hyperbolic sine about the sky, in units
    of its scatter: linear there, logarithmic for stars.

    sky, scatter : of the axis;  range : least and greatest value of all pixels, over which it reaches
    """
    sample = levels[:: 2 * stretch.SAMPLE_STRIDE, :: stretch.SAMPLE_STRIDE].astype(float)
    low, high = float(levels.min()), float(levels.max())
    below, sky = np.percentile(sample, (25, 50))
    scatter = max(QUARTILE_SIGMA * float(sky - below), 1.0)
    first, last = np.arcsinh((np.array([low, high]) - sky) / scatter)
    ends = first - AXIS_MARGIN, last + AXIS_MARGIN
    counts, _ = np.histogram(np.arcsinh((sample - sky) / scatter), BINS, ends)
    return {"range": (low, high), "sky": float(sky), "scatter": scatter, "counts": counts.tolist()}
