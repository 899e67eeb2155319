"""Background estimation: sky level and noise on a coarse grid, from a sparse sample of the frame.

The frame is divided into tiles of about 64x64 pixels. For each tile (`_tiles`):

1. Sample a few rows after a 3x3 binomial filter [1 2 1] x [1 2 1] / 16, the filter that the detector uses too.
2. Start from the median and the scaled median absolute deviation of a few samples, which stars hardly disturb.
3. Refine both by two rounds of sigma clipping at 3 sigma over all samples of the tile. The variance of the clipped
   samples is divided by that of a Gaussian truncated at 3 sigma.

Between the tile centers level and noise are interpolated bilinearly (`interpolate`).

The noise is measured on the filtered image. For white noise it is FILTERED_NOISE times the noise of a raw pixel.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from estimator.core.checks import Floats
from estimator.core.constants import SIGMA_PER_MAD
from estimator.core.jit import inlined, jit
from estimator.core.types import Background, Blobs, FramePriors

TILE_PX = 64
SAMPLE_ROWS = (
    6  # sampled per tile: some 370 filtered pixels, of which about 130 are independent
)
INITIAL_SAMPLES = (
    33  # samples of the robust initial estimate; odd, as `_median_by_counting` needs
)
CLIP_SIGMA = 3.0
# Variance of a unit Gaussian truncated at 3 sigma: 1 - 6 phi(3) / (2 Phi(3) - 1).
CLIPPED_VARIANCE = 0.9733
# Share of the tiles beside which the level changes by more than the noise in a steep sky
STEEP = 0.05
# Bins of pixels, and squares of bins, in which a steep sky is measured; the share of saturated bins in them
BIN_PX = 4
WINDOW = 5
CROWDED = 0.5
TINY = 1e-6
HIGH = 0.125  # height of a blob over the frame's that may be a column of readout smear
SMEAR_ROWS = 128  # rows from which the smear of a column is estimated
FLOAT_STEPS = 65535  # quantization steps assumed over the range of an image of floats
# Ratio of the standard deviations of white noise after and before the binomial filter: (1 + 4 + 1) / 16.
FILTERED_NOISE = 0.375


def estimate_background(image: NDArray) -> Background:
    """Estimate the sigma-clipped mean and standard deviation of the 3x3-filtered image, tile by tile.

    The noise is measured on the filtered image itself, so correlated noise (JPEG, demosaicing) is included. Its least
    value is the quantization noise, step / sqrt(12), as a dark JPEG can have tiles without any noise. The step is 1 for
    integers, and that of 16 bits over the range of an image of floats, a dynamic range that no sensor exceeds. In a
    simulated frame without noise a threshold below that would join stars by the wings of their images and by readout
    smear.
    """
    tile_px = min(TILE_PX, *image.shape)
    sum_type = accumulator_type(image.dtype)
    # float32 represents 16 times a 16-bit pixel exactly.
    sample_type = np.float64 if sum_type == np.float64 else np.float32
    samples: NDArray = np.empty(INITIAL_SAMPLES, sample_type)
    level, noise = _tiles(image, tile_px, np.empty(image.shape[1], sum_type), samples)
    step = 1.0 if image.dtype.kind in "iu" else float(image.max() - image.min()) / FLOAT_STEPS
    return Background(level, np.maximum(noise, FILTERED_NOISE * step / np.sqrt(12)))


def accumulator_type(pixel: np.dtype, greatest: float = np.inf) -> type:
    """Return the narrowest type that holds 16 times a pixel: narrow types process more pixels per vector instruction.

    Parameters
    ----------
    pixel
        Type of the pixels
    greatest
        Largest pixel value, if known: 12-bit pixels stored in 16 bits fit a narrower type than
        their own type suggests
    """
    if pixel.kind not in "iu" or pixel.itemsize > 2:
        return np.float64
    return (
        np.uint16
        if pixel == np.uint8 or (pixel.kind == "u" and greatest < 4096)
        else np.int32
    )


def cleaned(
    detect: Callable[..., Blobs], image: NDArray, priors: FramePriors, *options: Any
) -> tuple[NDArray, Blobs]:
    """Return the blobs that a detector finds, and their image without a steep sky and without readout smear.

    1. If the sky is steep, subtract a finer model of it (`flattened`).
    2. If there are high blobs, as the columns of bright stars, subtract the smear (`without_smear`).
    """
    blobs = detect(image, *options, priors)
    # 1. Sky
    if is_steep(*blobs.background):
        image = flattened(image, priors.saturation)
        blobs = detect(image, *options, priors)
    # 2. Smear
    if blobs.highest_px > HIGH * len(image):
        image, equal = without_smear(image, priors.saturation)
        blobs = blobs if equal is image else detect(equal, *options, priors)
    return image, blobs


@jit
def is_steep(level: Floats, noise: Floats) -> bool:
    """Return whether the level changes by more than the noise from one tile to the next in a part of the frame."""
    height, width = level.shape
    steep = 0
    for y in range(1, height):
        for x in range(1, width):
            change = abs(level[y, x] - level[y - 1, x]) + abs(level[y, x] - level[y, x - 1])
            steep += change > noise[y, x]
    return steep > STEEP * (height - 1) * (width - 1)


def flattened(image: NDArray, saturation: float) -> NDArray:
    """Return the image with a level sky, in its own type: twilight is too steep and too curved for tiles.

    1. Average bins of BIN_PX, and take the means M over squares of WINDOW bins. They are wrong by the curvature of the
       sky, 2 M - M M is not.
    2. Replace the light of stars, CLIP_SIGMA above it, by this sky, and average again.
    3. Subtract the sky. Where more than CROWDED of the bins are saturated there is none to measure: such squares become
       dark, and all that are as near as the means reach.
    """
    # 1. Means
    height, width = image.shape
    padding = ((0, -height % BIN_PX), (0, -width % BIN_PX))
    light = np.pad(image, padding, mode="edge").astype(np.float32)
    bins = light.reshape(len(light) // BIN_PX, BIN_PX, -1, BIN_PX).mean(axis=(1, 3))
    mean = partial(scipy.ndimage.uniform_filter, size=WINDOW, mode="nearest")
    once = mean(bins)
    sky = 2 * once - mean(once)
    # 2. Stars
    excess = bins - sky
    star = excess > CLIP_SIGMA * np.sqrt(np.maximum(mean(excess * excess), 0.0))
    once = mean(np.where(star, sky, bins))
    # 3. Difference
    excess = _excess(light, (2 * once - mean(once)).astype(float))[:height, :width]
    top = min(saturation, float(image.max()))
    full = mean((bins >= top).astype(float)) > CROWDED
    dark = mean(mean(full.astype(float))) > TINY
    excess[image >= saturation] = saturation
    dark = np.kron(dark, np.ones((BIN_PX, BIN_PX), bool))[:height, :width]
    y, x = np.nonzero(dark)
    noise = (
        FILTERED_NOISE / 2 * np.quantile(np.abs(excess[~dark][::7]), 0.95) if len(y) else 0.0
    )
    excess[y, x] = noise * (-1.0) ** (y // BIN_PX + x // BIN_PX)
    excess -= min(float(excess.min()), 0.0)
    return (excess if image.dtype.kind == "f" else np.rint(excess)).astype(image.dtype)


@jit
def _excess(light: NDArray, sky: Floats) -> NDArray:
    """Return an image less the grid of its sky."""
    height, width = light.shape
    out = np.empty_like(light)
    for y in range(height):
        for x in range(width):
            out[y, x] = light[y, x] - interpolate(sky, height, width, y, x)
    return out


def without_smear(image: NDArray, saturation: float) -> tuple[NDArray, NDArray]:
    """Return the image without the columns of its readout smear, and the same with equal noise in all columns.

    A chip that is read out under light adds to each pixel the same share of its column's light: a bright star has a
    trail over the whole frame, which joins the blobs of its column. Its photon noise remains when it is subtracted,
    and a detector with one threshold finds blobs in it.

    1. Average the middle three quarters of the values of each column, which stars do not reach, in SMEAR_ROWS rows.
    2. Compare it with the median of its neighbors. The column is smeared where it is brighter by more than CLIP_SIGMA.
    3. Subtract the difference d. Whole numbers become floor((y + 1) d) - floor(y d) at row y, which is d in the mean.
       Saturated pixels are left.
    4. Divide the contrast of a smeared column by the ratio of its deviation to that of the median column.
    """
    # 1. Columns
    height = len(image)
    rows = np.sort(image[:: max(height // SMEAR_ROWS, 1)], axis=0)
    tail = len(rows) // 8
    column = rows[tail : len(rows) - tail].mean(axis=0)
    noise = rows[tail : len(rows) - tail].std(axis=0)
    # 2. Smear
    base = scipy.ndimage.median_filter(column, TILE_PX + 1, mode="nearest")
    excess = column - base
    smeared = excess > CLIP_SIGMA * SIGMA_PER_MAD * np.median(np.abs(excess))
    if not smeared.any():
        return image, image
    # 3. Difference
    light = image[:, smeared]
    less = np.tile(excess[smeared], (height, 1))
    if image.dtype.kind != "f":
        less = np.diff(np.floor(np.cumsum(less, axis=0)), axis=0, prepend=0.0)
    less[light >= saturation] = 0.0
    plain = image.copy()
    plain[:, smeared] = light = np.maximum(light - less, image.min())
    # 4. Noise
    equal = plain.copy()
    contrast = np.minimum(np.median(noise) / np.maximum(noise[smeared], 1e-9), 1.0)
    even = np.rint(base[smeared] + contrast * (light - base[smeared]))
    equal[:, smeared] = np.where(light >= saturation, light, even)
    return plain, equal


@jit
def filtered(image: NDArray, y: int, x: int) -> float:
    """Return the 3x3 binomial filter [1 2 1] x [1 2 1] / 16 at one pixel; the edge rows and columns are repeated."""
    height, width = image.shape
    total = 0.0
    for down in range(-1, 2):
        row = image[min(max(y + down, 0), height - 1)]
        for right in range(-1, 2):
            share = (2 - abs(down)) * (2 - abs(right))
            total += share * float(row[min(max(x + right, 0), width - 1)])
    return total / 16.0


@jit
def filtered_row(image: NDArray, y: int, sums: NDArray, out: NDArray) -> None:
    """Write 16 times a row of `filtered` to `out`.

    The filter is separable: the vertical [1 2 1] sums go to the buffer `sums` (width + 2, padded by one column at
    either end), and the horizontal pass reads them.
    """
    height, width = image.shape
    above = image[max(y - 1, 0)]
    row = image[y]
    below = image[min(y + 1, height - 1)]
    left = sums[:width]
    middle = sums[1 : width + 1]
    right = sums[2:]
    # Vertical sums, padded by their end values
    for x in range(width):
        middle[x] = above[x] + 2 * row[x] + below[x]
    sums[0], sums[width + 1] = sums[1], sums[width]
    for x in range(width):
        out[x] = left[x] + 2 * middle[x] + right[x]


@jit
def interpolate(grid: Floats, height: int, width: int, y: float, x: float) -> float:
    """Interpolate a tile grid bilinearly at a pixel; constant beyond the outermost tile centers."""
    rows, columns = grid.shape
    v = (y + 0.5) * rows / height - 0.5
    u = (x + 0.5) * columns / width - 0.5
    # Not max(): it would pass on a NaN position, whose cast is an index outside the grid.
    v = min(v if v > 0 else 0.0, rows - 1.0)
    u = min(u if u > 0 else 0.0, columns - 1.0)
    row = min(int(v), max(rows - 2, 0))
    column = min(int(u), max(columns - 2, 0))
    below = min(row + 1, rows - 1)
    beside = min(column + 1, columns - 1)
    fv = v - row
    fu = u - column
    top = grid[row, column] * (1 - fu) + grid[row, beside] * fu
    bottom = grid[below, column] * (1 - fu) + grid[below, beside] * fu
    return top * (1 - fv) + bottom * fv


@jit
def _tiles(
    image: NDArray, tile_px: int, smooth: NDArray, samples: NDArray
) -> tuple[Floats, Floats]:
    """Compute level and noise of every tile, (rows, columns) each: the numbered steps of the module.

    Parameters
    ----------
    smooth, samples
        Buffers; their types select those of the computation
    """
    height, width = image.shape
    rows = max(height // tile_px, 1)
    columns = max(width // tile_px, 1)
    level = np.empty((rows, columns))
    noise = np.empty((rows, columns))
    longest = width // columns + 1
    values = np.empty((columns, SAMPLE_ROWS * longest), samples.dtype)
    sums = np.empty(width + 2, smooth.dtype)
    for row in range(rows):
        y0 = row * height // rows
        y1 = (row + 1) * height // rows
        # 1. Rows at even distances, filtered once for all tiles side by side
        for k in range(SAMPLE_ROWS):
            filtered_row(
                image, y0 + (2 * k + 1) * (y1 - y0) // (2 * SAMPLE_ROWS), sums, smooth
            )
            for column in range(columns):
                x0 = column * width // columns
                x1 = (column + 1) * width // columns
                source = smooth[x0:x1]
                sampled = values[column, k * (x1 - x0) : (k + 1) * (x1 - x0)]
                # Assigning a slice would take longer to compile than all the rest.
                for x in range(len(source)):
                    sampled[x] = source[x]
        for column in range(columns):
            size = (column + 1) * width // columns - column * width // columns
            tile_values = values[column, : SAMPLE_ROWS * size]
            # 2. Median and deviation
            middle, spread = _robust_estimate(tile_values, samples)
            # 3. Sigma clipping
            for _ in range(2):
                middle, spread = _clip(tile_values, middle, spread)
            # `filtered_row` gives 16 times the filtered values.
            level[row, column] = middle / 16
            noise[row, column] = spread / 16
    return level, noise


@jit
def median(values: Floats) -> float:
    """Return the median of an array without NaN; outside of compiled code, NumPy's checks would take longer."""
    return float(np.median(values))


@inlined
def _robust_estimate(values: NDArray, samples: NDArray) -> tuple[float, float]:
    """Return median and 1.4826 MAD (a Gaussian's sigma) of len(samples) of the values, at even distances."""
    count = len(samples)
    for k in range(count):
        samples[k] = values[(2 * k + 1) * len(values) // (2 * count)]
    middle = _median_by_counting(samples)
    for k in range(count):
        samples[k] = abs(samples[k] - middle)
    return middle, SIGMA_PER_MAD * _median_by_counting(samples)


@jit
def _median_by_counting(values: NDArray) -> float:
    """Return the median of an odd number of values: that with at most half below it, and more than half up to it.

    Counting takes quadratic time but has no branches; for a few tens of values it is faster than sorting.
    """
    half = len(values) // 2
    for value in values:
        below = np.int32(0)
        up_to = np.int32(0)
        for k in range(len(values)):
            below += np.int32(values[k] < value)
            up_to += np.int32(values[k] <= value)
        if below <= half < up_to:
            return value
    return values[0]


@jit(fastmath={"reassoc", "contract"})
def _clip(values: NDArray, middle: float, spread: float) -> tuple[float, float]:
    """Return mean and standard deviation of the values within 3 sigma; the latter corrected for the truncated tails."""
    real = values.dtype.type
    center = real(middle)
    reach = real(CLIP_SIGMA * spread)
    one = real(1)
    count = total = squares = real(0)
    # Rejected values are added with weight 0 instead of skipped: without a branch the loop vectorizes.
    for i in range(len(values)):
        deviation = values[i] - center
        weight = one if abs(deviation) <= reach else real(0)
        count += weight
        total += weight * deviation
        squares += weight * deviation * deviation
    if count < 1:
        return middle, spread
    mean = float(total) / count
    variance = max(float(squares) / count - mean * mean, 0.0)
    return float(center) + mean, np.sqrt(variance / CLIPPED_VARIANCE)
