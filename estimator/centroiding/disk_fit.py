"""Disk fit of one nearby LED: a uniform disk with a blurred edge, by weighted least squares.

The model of a pixel at distance r from the center is sky + A erfc((r - R) / (w sqrt 2)) / 2: a disk of radius R with an
edge blurred by a Gaussian of width w. Gauss-Newton solves for center, R, w, A and sky (`_fit`). Only the pixels at the
edge determine the position, so saturated pixels inside can be left out.
"""

from math import erfc, exp, hypot, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.centroiding.moments import belongs_to_neighbor, neighbors
from estimator.core import least_squares
from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.detection.background import FILTERED_NOISE, interpolate

MARGIN_PX = 4  # around a blob's box
MIN_RADIUS_PX = 2.0  # of the smallest disk that has a flat center despite its blurred edge
MAX_ITERATIONS = 40
# Model error at a curved edge of square pixels, measured without noise at radii of 5 and 10 px.
MODEL_PX = 0.004
# Parameters: center, radius, edge width, brightness, sky.
X, Y, RADIUS, EDGE, BRIGHTNESS, SKY = range(6)


@jit
def fit_all(
    image: NDArray,
    xy: Floats,
    flux: Floats,
    area: Ints,
    boxes: Ints,
    level: Floats,
    noise: Floats,
    gain_e_dn: float,
    saturation: float,
) -> Floats:
    """Fit every blob: (N, 5) x, y, sigma of the position, flux, radius; NaN if it is not a disk."""
    height, width = image.shape
    out = np.full((len(xy), 5), np.nan)
    p = np.empty(6)
    for n in range(len(xy)):
        p[X], p[Y] = xy[n]
        p[RADIUS] = sqrt(area[n] / pi)
        if p[RADIUS] < MIN_RADIUS_PX:
            continue
        # The window must be inside the image.
        x0 = boxes[n, 0] - MARGIN_PX
        y0 = boxes[n, 1] - MARGIN_PX
        x1 = boxes[n, 2] + MARGIN_PX
        y1 = boxes[n, 3] + MARGIN_PX
        if x0 < 0 or y0 < 0 or x1 >= width or y1 >= height:
            continue
        neighbor_rows = neighbors(boxes, n, x0, y0, x1, y1)
        sky = interpolate(level, height, width, xy[n, 1], xy[n, 0])
        sigma = interpolate(noise, height, width, xy[n, 1], xy[n, 0]) / FILTERED_NOISE
        # Initial values: the radius of a disk of the blob's area, and the mean brightness.
        p[EDGE] = 1.0
        p[BRIGHTNESS] = flux[n] / area[n]
        p[SKY] = sky
        # Pixels that are neither saturated nor of another blob
        capacity = (x1 - x0 + 1) * (y1 - y0 + 1)
        pixels = np.empty((3, capacity))
        count = 0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if image[y, x] < saturation and not belongs_to_neighbor(
                    boxes, neighbor_rows, n, x, y
                ):
                    pixels[0, count] = x
                    pixels[1, count] = y
                    pixels[2, count] = image[y, x]
                    count += 1
        if count >= 12:  # twice the number of parameters
            rows = np.ones((7, count))  # those of the sky stay 1
            weight = np.empty(count)
            _fit(pixels[:, :count], sigma, gain_e_dn, rows, weight, p, out[n])
    return out


@jit
def _fit(
    pixels: Floats,
    noise: float,
    gain_e_dn: float,
    rows: Floats,
    weight: Floats,
    p: Floats,
    out: Floats,
) -> None:
    """Fit one disk by Gauss-Newton, starting from `p`; leave `out` NaN if it does not converge near its start.

    1. Compute derivatives, residuals and weights at every pixel (`_rows`).
    2. Solve the normal equations for the step.
    3. Apply the step, shortened to at most a pixel, and give up far from the start.
    4. At convergence, read the position's covariance from the inverse normal matrix. An LED is not a perfect disk:
       where the residuals exceed the noise, the covariance is inflated.

    Parameters
    ----------
    pixels
        (3, K) x, y and value of the pixels used
    noise
        Standard deviation of a pixel of the sky
    rows, weight
        Work arrays for `_rows`
    p
        (6,) parameters, updated in place
    out
        (5,) x, y, sigma, flux, radius
    """
    count = pixels.shape[1]
    start_x = p[X]
    start_y = p[Y]
    start_radius = p[RADIUS]
    normal = np.empty((7, 7))
    step = np.empty(6)
    for _ in range(MAX_ITERATIONS):
        # 1. Derivatives
        _rows(pixels, noise, gain_e_dn, p, rows, weight)
        # 2. Step
        least_squares.normal_equations(rows, weight, count, normal)
        fall = least_squares.step(normal, step)
        if not fall >= 0:  # a singular matrix gives NaN
            return
        largest_step = max(abs(step[X]), abs(step[Y]), abs(step[RADIUS]))
        # 3. At most one pixel per step, and a quarter of a pixel in the edge's width.
        scale = min(1.0, 1 / max(largest_step, 4 * abs(step[EDGE]), 1e-300))
        p += scale * step
        p[EDGE] = min(max(p[EDGE], 0.25), 0.6 * p[RADIUS])
        if hypot(p[X] - start_x, p[Y] - start_y) > start_radius / 2 or p[BRIGHTNESS] <= 0:
            return
        if not start_radius / 2 < p[RADIUS] < 2 * start_radius:
            return
        # 4. Convergence
        if largest_step < least_squares.CONVERGED_PX or fall < least_squares.CONVERGED_CHI2:
            _write_disk(normal, p, count, step, out)
            return


@jit
def _write_disk(factor: Floats, p: Floats, pixels: int, column: Floats, out: Floats) -> None:
    """Write x, y, sigma of the position, flux and radius of a disk; `column` (6,) is a work array."""
    xx, yy, _ = least_squares.position_covariance(factor, column)
    variance = (xx + yy) / 2 * least_squares.misfit_factor(factor[6, 6], pixels - 6)
    # Total flux of a blurred disk: A pi (R^2 + w^2), as the edge is symmetric about R.
    flux = p[BRIGHTNESS] * pi * (p[RADIUS] ** 2 + p[EDGE] ** 2)
    out[:] = p[X], p[Y], sqrt(variance + MODEL_PX**2), flux, p[RADIUS]


@jit
def _rows(
    pixels: Floats, noise: float, gain_e_dn: float, p: Floats, rows: Floats, weight: Floats
) -> None:
    """Fill the model's derivatives by the six parameters, the residual and the weight of every pixel.

    With d = r - R, the model is A q(d), q = erfc(d / (w sqrt 2)) / 2, and -dq/dd = exp(-d^2 / 2 w^2) / (w sqrt(2 pi)).
    It is exact for a straight edge blurred by a Gaussian; w^2 is the optics' sigma^2 plus the pixel's 1/12. A pixel's
    weight is 1 / (noise^2 + A q / gain).
    """
    brightness = p[BRIGHTNESS]
    w = p[EDGE]
    for k in range(pixels.shape[1]):
        dx = pixels[0, k] - p[X]
        dy = pixels[1, k] - p[Y]
        r = max(hypot(dx, dy), 1e-9)
        d = r - p[RADIUS]
        profile = erfc(d / (w * sqrt(2.0))) / 2
        # Derivative by the radius; those by the center are its components along the radius.
        slope = brightness * exp(-d * d / (2 * w * w)) / (w * sqrt(2 * pi))
        rows[X, k] = slope * dx / r
        rows[Y, k] = slope * dy / r
        rows[RADIUS, k] = slope
        rows[EDGE, k] = slope * d / w
        rows[BRIGHTNESS, k] = profile
        rows[6, k] = pixels[2, k] - p[SKY] - brightness * profile
        weight[k] = 1 / (noise * noise + max(brightness * profile, 0.0) / gain_e_dn + 1e-9)
