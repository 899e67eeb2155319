"""Gray image of a color camera's frame, whose pixels have the red, green and blue filters of a Bayer mosaic.

The two missing colors of each pixel are the means of its neighbors of that color (bilinear demosaicing), and

    gray = 0.2989 R + 0.5870 G + 0.1140 B,

the luma of ITU-R BT.601, as MATLAB's `rgb2gray`. Away from the border the sum of a gray image over a light is that of
the raw pixels with the weights 4 WR, 2 WG, 4 WB, so that it follows the light's color. The noise of neighbors is
correlated; the background's noise is measured after a filter, which includes most of it.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from estimator.core import checks
from estimator.core.jit import jit
from estimator.detection.detect import prepare_image

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")  # of the first two pixels of the first two rows
# Weights of red, green and blue.
WR = 0.2989
WG = 0.5870
WB = 0.1140


def gray_from_bayer(image: NDArray, pattern: str, saturation: float = np.inf) -> NDArray:
    """Return the gray image of a raw frame (H, W), in its type by `to_native`; whole numbers are rounded.

    A saturated pixel keeps its value, as its color is unknown.

    Parameters
    ----------
    pattern
        One of PATTERNS
    saturation
        Least value of a saturated pixel

    Raises
    ------
    ImageError
        For an unknown pattern, and for an image that no detector takes.
    """
    checks.known("pattern", pattern, PATTERNS)
    image = prepare_image(image)
    red_y, red_x = divmod(pattern.index("R"), 2)
    gray = np.empty_like(image)
    _demosaic(image, red_y, red_x, float(saturation), image.dtype.kind != "f", gray)
    return gray


@jit(parallel=True)
def _demosaic(
    raw: NDArray, red_y: int, red_x: int, saturation: float, whole: bool, gray: NDArray
) -> None:
    """Write the gray image; beyond the border the pixels are mirrored, which keeps their colors."""
    height, width = raw.shape
    for y in numba.prange(height):
        up = raw[abs(y - 1)]
        row = raw[y]
        down = raw[y + 1 if y + 1 < height else y - 1]
        red_row = (y - red_y) % 2 == 0
        # Weights of the row's own color, red or blue, and of the other one.
        own, other = (WR, WB) if red_row else (WB, WR)
        for x in range(width):
            left = abs(x - 1)
            right = x + 1 if x + 1 < width else x - 1
            beside = 0.5 * (row[left] + row[right])
            above = 0.5 * (up[x] + down[x])
            if ((x - red_x) % 2 == 0) == red_row:
                corners = 0.25 * (up[left] + up[right] + down[left] + down[right])
                value = own * row[x] + WG * 0.5 * (beside + above) + other * corners
            else:
                value = WG * row[x] + own * beside + other * above
            if row[x] >= saturation:
                gray[y, x] = row[x]
            else:
                gray[y, x] = np.floor(value + 0.5) if whole else value
