"""Gaussian fit of one star: a Gaussian integrated over each pixel, by weighted least squares.

The model of a pixel is I = sky + F gx gy, where gx and gy are the integrals of a one-dimensional Gaussian over the
pixel's width and height,

    gx = [erf((x - x0 + 1/2) / (sigma sqrt 2)) - erf((x - x0 - 1/2) / (sigma sqrt 2))] / 2.

Gauss-Newton solves for x0, y0, F, sigma and sky (`_fit`). The weights are the inverse variances of the current model,
so they are updated in each iteration. The covariance is the inverse normal matrix, inflated by the reduced chi-square
where the model does not fit.
"""

from math import erf, exp, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.core import least_squares
from estimator.core.checks import Floats, Ints
from estimator.core.jit import inlined, jit
from estimator.detection.background import FILTERED_NOISE, interpolate

# Half-width of the window, and its largest value, for a saturated star.
HALF_WINDOW_PX = 3
MAX_HALF_WINDOW_PX = 10
# Limits of sigma that a 7x7 window can resolve.
MIN_SIGMA_PX = 0.2
MAX_SIGMA_PX = 3.0
INITIAL_SIGMA_PX = 0.8  # initial sigma of the first star
MAX_ITERATIONS = 40
# Parameters: center, flux, width, sky.
X, Y, FLUX, WIDTH, SKY = range(5)


@jit
def fit_all(
    image: NDArray,
    xy: Floats,
    flux: Floats,
    boxes: Ints,
    peak: Floats,
    level: Floats,
    noise: Floats,
    gain_e_dn: float,
    saturation: float,
) -> Floats:
    """Fit every blob: (N, 4) x, y, sigma of the position, flux; NaN if it is not a single Gaussian.

    The fit of each star starts from the width of the star before, as the optics are the same.
    """
    height, width = image.shape
    out = np.full((len(xy), 4), np.nan)
    side = 2 * MAX_HALF_WINDOW_PX + 1
    rows = np.empty((6, side * side))
    weight = np.empty(side * side)
    edges = np.empty((6, side + 1))
    rows[SKY] = 1.0
    p = np.empty(5)
    start_sigma_px = INITIAL_SIGMA_PX
    for n in range(len(xy)):
        half = HALF_WINDOW_PX
        if peak[n] >= saturation:  # only the wings are usable: enlarge the window
            long_side = max(boxes[n, 2] - boxes[n, 0], boxes[n, 3] - boxes[n, 1])
            half = min(max(long_side // 2 + 2, HALF_WINDOW_PX), MAX_HALF_WINDOW_PX)
        left = round(xy[n, 0]) - half
        top = round(xy[n, 1]) - half
        side = 2 * half + 1
        if left < 0 or top < 0 or left + side > width or top + side > height:
            continue
        # Initial values, in coordinates of the window
        window = image[top : top + side, left : left + side]
        sigma = interpolate(noise, height, width, xy[n, 1], xy[n, 0]) / FILTERED_NOISE
        p[X] = xy[n, 0] - left
        p[Y] = xy[n, 1] - top
        p[WIDTH] = start_sigma_px
        p[SKY] = interpolate(level, height, width, xy[n, 1], xy[n, 0])
        if _fit(window, sigma, gain_e_dn, saturation, rows, weight, edges, p, out[n]):
            start_sigma_px = p[WIDTH]
            out[n, 0] += left
            out[n, 1] += top
        # On the plateau of a disk the fit finds a weak star on a bright sky.
        if not out[n, 3] > flux[n] / 2:
            out[n] = np.nan
    return out


@jit
def _fit(
    window: NDArray,
    noise: float,
    gain_e_dn: float,
    saturation: float,
    rows: Floats,
    weight: Floats,
    edges: Floats,
    p: Floats,
    out: Floats,
) -> bool:
    """Fit one Gaussian by Gauss-Newton, starting from `p`; return False if it does not converge within its window.

    1. Compute derivatives, residuals and weights at every pixel (`_rows`).
    2. Solve the normal equations for the step.
    3. Apply the step, shortened to at most half a pixel, and give up far from the start.
    4. At convergence, read the position's covariance from the inverse normal matrix. Where the model does not fit (two
       stars in one window) the residuals inflate it.

    Parameters
    ----------
    window
        (side, side) pixels around the star
    noise
        Standard deviation of a pixel of the sky
    rows, weight, edges
        Work arrays for `_rows`
    p
        (5,) parameters in coordinates of the window, updated in place
    out
        (4,) x, y, sigma of the position, flux
    """
    start_x = p[X]
    start_y = p[Y]
    normal = np.empty((6, 6))
    step = np.empty(5)
    p[FLUX] = max(window.sum() - window.size * p[SKY], 1e-9)
    for _ in range(MAX_ITERATIONS):
        # 1. Derivatives
        pixels = _rows(window, noise, gain_e_dn, saturation, p, rows, weight, edges)
        # 2. Step
        least_squares.normal_equations(rows, weight, window.size, normal)
        fall = least_squares.step(normal, step)
        if not fall >= 0:  # a singular matrix gives NaN
            return False
        largest_step = max(abs(step[X]), abs(step[Y]), abs(step[WIDTH]))
        # 3. Steps of more than half a pixel are shortened: the model is too nonlinear for them.
        scale = min(1.0, 0.5 / max(largest_step, 1e-300))
        p += scale * step
        if abs(p[X] - start_x) > 2 or abs(p[Y] - start_y) > 2 or p[FLUX] <= 0:
            return False
        p[WIDTH] = min(max(p[WIDTH], MIN_SIGMA_PX), MAX_SIGMA_PX)
        # 4. Convergence; a width at its limit is no solution.
        if largest_step < least_squares.CONVERGED_PX or fall < least_squares.CONVERGED_CHI2:
            if not MIN_SIGMA_PX < p[WIDTH] < MAX_SIGMA_PX:
                return False
            _write_star(normal, p, pixels, step, out)
            return True
    return False


@inlined
def _write_star(factor: Floats, p: Floats, pixels: int, column: Floats, out: Floats) -> None:
    """Write x, y, sigma of the position and flux of a star; `column` (5,) is a work array."""
    xx, yy, _ = least_squares.position_covariance(factor, column)
    inflation = least_squares.misfit_factor(factor[5, 5], pixels - 5)
    out[0] = p[X]
    out[1] = p[Y]
    out[2] = sqrt((xx + yy) / 2 * inflation)
    out[3] = p[FLUX]


@jit
def _rows(
    window: NDArray,
    noise: float,
    gain_e_dn: float,
    saturation: float,
    p: Floats,
    rows: Floats,
    weight: Floats,
    edges: Floats,
) -> int:
    """Fill the model's derivatives, the residuals and the weights at every pixel; return the number of pixels used.

    A pixel's weight is 1 / (noise^2 + F gx gy / gain); it is 0 for a saturated pixel.
    """
    side = len(window)
    flux = p[FLUX]
    used = window.size
    # Integrals over the columns and rows, and their derivatives by the center and by sigma
    gx, dgx, sgx, gy, dgy, sgy = edges
    _cells(side, p[X], p[WIDTH], gx, dgx, sgx)
    _cells(side, p[Y], p[WIDTH], gy, dgy, sgy)
    for j in range(side):
        block = rows[:, j * side : (j + 1) * side]
        block_weight = weight[j * side : (j + 1) * side]
        pixel_row = window[j]
        flux_y = flux * gy[j]
        slope_y = flux * dgy[j]
        widening_y = flux * sgy[j]
        # The product rule for F gx gy
        for i in range(side):
            model = flux_y * gx[i]
            block[X, i] = flux_y * dgx[i]
            block[Y, i] = slope_y * gx[i]
            block[FLUX, i] = gy[j] * gx[i]
            block[WIDTH, i] = flux_y * sgx[i] + widening_y * gx[i]
            block[5, i] = pixel_row[i] - p[SKY] - model
            # The 1e-9 keeps the weights finite in the sky of a noise-free image.
            block_weight[i] = 1 / (noise * noise + (model + 1e-9 * flux) / gain_e_dn)
        # A loop of its own, so that the compiler can vectorize the first one.
        for i in range(side):
            if pixel_row[i] >= saturation:
                block_weight[i] = 0.0
                used -= 1
    return used


@jit
def _cells(
    count: int, center: float, sigma: float, fraction: Floats, slope: Floats, widening: Floats
) -> None:
    """Integrate a 1-D Gaussian over each pixel; also its derivatives with respect to the center and to sigma.

    With t = (edge - center) / sigma and the density b(t), a pixel's fraction is [erf(t / sqrt 2) / 2] from its low to
    its high edge; its derivative by the center is (b_low - b_high) / sigma, and by sigma
    (t_low b_low - t_high b_high) / sigma. Adjacent pixels share an edge, so erf and exp are computed once per edge.
    """
    scale = 1 / sigma
    low = (-0.5 - center) * scale
    low_sum = erf(low * sqrt(0.5)) / 2
    low_bell = exp(-low * low / 2) / sqrt(2 * pi)
    for k in range(count):
        high = low + scale
        high_sum = erf(high * sqrt(0.5)) / 2
        high_bell = exp(-high * high / 2) / sqrt(2 * pi)
        fraction[k] = high_sum - low_sum
        slope[k] = (low_bell - high_bell) * scale
        widening[k] = (low * low_bell - high * high_bell) * scale
        low = high
        low_sum = high_sum
        low_bell = high_bell
