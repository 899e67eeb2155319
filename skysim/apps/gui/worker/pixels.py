"""A frame's pixels for the browser: all of them as numbers, or as many shades as its screen has pixels.

While frames follow one another the browser gets shades: it takes longer than a frame to receive and color a million
numbers. Limits and histogram are those of the whole frame, so the picture does not change when the motion ends and all
pixels arrive.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from astropy.visualization import ZScaleInterval
from numpy.typing import NDArray

from skysim.apps.gui.messages import Display, Pixels
from skysim.core.constants import SIGMA_PER_MAD
from skysim.core.types import Record
from skysim.results import plots

LEVELS = 2**16 - 1
# Shade of saturated pixels, and number of the other shades.
SATURATED = 255
SHADES = 255
WORTHWHILE = (
    0.95  # fraction of the frame's columns on the screen above which all pixels are sent
)
BINS = 80  # number of bins of the histogram
AXIS_MARGIN = 0.3  # margin on either side of the histogram, in units of its axis
ZSCALE_SAMPLES = 1000  # number of sampled pixels, as in IRAF
LOUPE_PX = 11  # maximum number of rows and columns in the loupe


class PixelLevels(NamedTuple):
    """An image as unsigned integers n: pixel = offset + step n.

    Attributes
    ----------
    integers
        (H, W) unsigned integers of 8 or 16 bits
    """

    integers: NDArray
    offset: float = 0.0
    step: float = 1.0

    def data(self) -> bytes:
        """Offset and step as float64, then the integers."""
        return np.array([self.offset, self.step]).tobytes() + self.integers.tobytes()


def levels_of(image: NDArray) -> PixelLevels:
    """The levels of an image.

    Integers of 8 and 16 bits are exact; other numbers are rounded to 65,535 steps between the least and the greatest.
    """
    if image.dtype in (np.uint8, np.uint16):
        return PixelLevels(image)
    low = float(image.min())
    high = float(image.max())
    step = (high - low) / LEVELS or 1.0
    return PixelLevels(np.rint((image - low) / step).astype(np.uint16), low, step)


def pixels_for(
    display: Display, levels: PixelLevels, saturation_dn: float, number: int = 0
) -> Pixels:
    """The pixels of an image for the browser.

    They are its levels with their offset and step, or shades if the screen has fewer columns than the image.

    Parameters
    ----------
    saturation_dn
        Value from which a pixel is saturated
    number
        Number of the image in its worker
    """
    integers = levels.integers
    (height, width) = integers.shape
    limits = limits_of(levels, display.limits)
    saturation = (saturation_dn - levels.offset) / levels.step
    # The columns of the screen that the image fills; 0 if all pixels are needed.
    scale = min(display.screen_px[0] / width, display.screen_px[1] / height)
    columns = math.floor(width * scale + 0.5)
    shaded = 0 < columns < WORTHWHILE * width
    drawn = (
        shades(integers, columns, limits, saturation, display.curve) if shaded else integers
    )
    fields: Record = {
        "size": (width, height),
        "grid": drawn.shape[::-1],
        "shaded": shaded,
        "limits": limits,
        "histogram": histogram(integers),
        "saturation": saturation_dn if math.isfinite(saturation_dn) else None,
    }
    if display.near_px:
        x, y = display.near_px
        fields["near"] = {
            "x": x,
            "y": y,
            "levels": integers[y:, x:][:LOUPE_PX, :LOUPE_PX].tolist(),
        }
    return Pixels(levels._replace(integers=drawn).data(), fields, display, number)


def shades(
    integers: NDArray,
    columns: int,
    limits: tuple[float, float],
    saturation: float,
    curve: str,
) -> NDArray[np.uint8]:
    """The image in fewer columns: the mean over each area, from 0 (black) to SHADES - 1 (white).

    An area with a saturated pixel is SATURATED.
    """
    height, width = integers.shape
    rows = max(round(height * columns / width), 1)
    low, high = limits
    fraction = np.clip(
        (np.arange(int(integers.max()) + 1) - low) / max(high - low, 1e-9), 0, 1
    )
    table = np.rint((SHADES - 1) * plots.CURVES[curve](fraction)).astype(np.uint8)
    mean = cv2.resize(integers, (columns, rows), interpolation=cv2.INTER_AREA)
    shaded = np.take(table, mean)
    if len(table) > saturation:
        # A pixel is smaller than an area, so its corners lie in all areas that it overlaps.
        y, x = np.divmod(np.flatnonzero(integers >= saturation), width)
        for row in (y * rows // height, ((y + 1) * rows - 1) // height):
            for column in (x * columns // width, ((x + 1) * columns - 1) // width):
                shaded[row, column] = SATURATED
    return shaded


def limits_of(levels: PixelLevels, limits: str | tuple[float, float]) -> tuple[float, float]:
    """Black and white level by name, or from values in DN."""
    integers = levels.integers
    if not isinstance(limits, str):
        low, high = ((dn - levels.offset) / levels.step for dn in limits)
        return low, high
    if limits == "zscale":
        samples = integers.ravel()[:: max(1, integers.size // ZSCALE_SAMPLES)][
            :ZSCALE_SAMPLES
        ]
        low, high = ZScaleInterval().get_limits(samples)
        return float(low), float(high)
    if limits == "min to max":
        return float(integers.min()), float(integers.max())
    return plots.display_levels(integers)


def histogram(integers: NDArray) -> Record:
    """Counts of a sample of the pixels in BINS bins.

    The axis is an inverse hyperbolic sine about the sky, in units of the sky's scatter: linear there, logarithmic for
    stars.

    Returns
    -------
    sky, scatter
        Median and scatter of the sky, which define the axis
    range
        Least and greatest value of all pixels, the range of the axis
    """
    sample = integers[:: 2 * plots.SAMPLE_STRIDE, :: plots.SAMPLE_STRIDE].astype(float)
    low = float(integers.min())
    high = float(integers.max())
    below, sky = np.percentile(sample, (25, 50))
    scatter = max(SIGMA_PER_MAD * float(sky - below), 1.0)
    first, last = np.arcsinh((np.array([low, high]) - sky) / scatter)
    ends = first - AXIS_MARGIN, last + AXIS_MARGIN
    counts, _ = np.histogram(np.arcsinh((sample - sky) / scatter), BINS, ends)
    return {"range": (low, high), "sky": float(sky), "scatter": scatter, "counts": counts}
