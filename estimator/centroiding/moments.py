"""Centroids by moments of the light: center of gravity, light-weighted, and in a Gaussian window.

Each kernel sums the light above the interpolated sky and returns x, y, sigma and flux per blob, or NaN where the
position is undefined. `center_of_gravity` and `squared_light` use the blob's box and a margin, `gaussian_windowed` the
window. With the light I_i of pixel i, in units of the image, the pixel's variance is s_i^2 = I_i / g + n^2: photon
noise for a gain of g electrons per unit, and the sky's noise n. The position's variance is
var(x) = sum((dx/dI_i)^2 s_i^2). `sigma` is the root of the mean of var(x) and var(y).

The two weighted estimators also have a systematic error that depends on the position of the star within its pixel
(the S-curve), since they sample the profile at the pixel centers only; `sampling_variance` gives its mean square.
"""

from math import exp, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.detection.background import FILTERED_NOISE, interpolate

MARGIN_PX = 4  # around a blob's box
# Limits of the window's sigma.
MIN_WINDOW_PX = 0.6
MAX_WINDOW_PX = 4.0
# Ratio of the window's variance to the star's: the error is an eighth above the minimum, see `gaussian_windowed`.
WINDOW_VARIANCE_RATIO = 2.0
# Number of iterations that adapt the window's width, and largest number of all iterations.
SIZING_ITERATIONS = 4
MAX_ITERATIONS = 60


@jit
def center_of_gravity(
    image: NDArray, boxes: Ints, chosen: Ints, level: Floats, noise: Floats, gain_e_dn: float
) -> Floats:
    """Compute the center of gravity in K chosen boxes and a margin: (K, 4) x, y, sigma of the position, flux.

    With the light I_i above the sky at pixel x_i, and F = sum I_i,

        xbar = sum(I_i x_i) / F,    var(xbar) = sum(s_i^2 (x_i - xbar)^2) / F^2,    s_i^2 = max(I_i, 0) / g + n^2,

    as dxbar/dI_i = (x_i - xbar) / F. The same holds for y, and sigma^2 = (var(xbar) + var(ybar)) / 2. Pixels nearer to
    another blob's box are excluded.
    """
    return _weighted_mean(image, boxes, chosen, level, noise, gain_e_dn, MARGIN_PX, 1)


@jit
def squared_light(
    image: NDArray, boxes: Ints, chosen: Ints, level: Floats, noise: Floats, gain_e_dn: float
) -> Floats:
    """Compute the mean position in K chosen boxes, weighted by the squared light: (K, 4) x, y, sigma, flux.

    With the positive light I_i above the sky, W = sum I_i^2 and dc/dI_i = 2 I_i (x_i - c) / W,

        c = sum(I_i^2 x_i) / W,    var(c) = sum(4 I_i^2 (x_i - c)^2 (I_i / g + n^2)) / W^2 + sampling_variance.

    The sampling variance is that of the squared profile, whose variance is sum(I_i^2 (x_i - c)^2) / W.
    """
    return _weighted_mean(image, boxes, chosen, level, noise, gain_e_dn, 1, 2)


@jit
def _weighted_mean(
    image: NDArray,
    boxes: Ints,
    chosen: Ints,
    level: Floats,
    noise: Floats,
    gain_e_dn: float,
    margin: int,
    power: int,
) -> Floats:
    """Compute the mean position weighted by a power of the light, 1 or 2, in each chosen box and a margin."""
    height, width = image.shape
    out = np.zeros((len(chosen), 4))
    for k in range(len(chosen)):
        n = chosen[k]
        x0, y0, x1, y1 = _window(boxes[n], margin, width, height)
        neighbor_rows = neighbors(boxes, n, x0, y0, x1, y1)
        light = np.zeros((y1 - y0 + 1, x1 - x0 + 1))
        own = np.zeros_like(light)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if not belongs_to_neighbor(boxes, neighbor_rows, n, x, y):
                    light[y - y0, x - x0] = image[y, x] - interpolate(
                        level, height, width, y, x
                    )
                    own[y - y0, x - x0] = 1.0
        # Photon noise is that of the light itself, without the negative noise of the sky.
        positive = np.maximum(light, 0.0)
        share = light if power == 1 else positive**2
        total = share.sum()
        if total == 0:  # the mean is undefined
            out[k, :3] = np.nan
            continue
        across = np.arange(x0, x1 + 1)
        down = np.arange(y0, y1 + 1).reshape(-1, 1)
        cx = (share * across).sum() / total
        cy = (share * down).sum() / total
        # n^2 of one pixel at c; the mean of both coordinates' squared distances
        sigma2 = (interpolate(noise, height, width, cy, cx) / FILTERED_NOISE) ** 2
        distance2 = ((across - cx) ** 2 + (down - cy) ** 2) / 2
        slope2 = own if power == 1 else 4 * share  # of c, without the distance and W
        noise2 = slope2 * distance2 * (positive / gain_e_dn + sigma2)
        variance = noise2.sum() / total**2
        if power == 2:
            variance += sampling_variance((share * distance2).sum() / total)
        out[k, 0] = cx
        out[k, 1] = cy
        out[k, 2] = sqrt(variance)
        out[k, 3] = light.sum()
    return out


@jit
def _window(box: Ints, margin: int, width: int, height: int) -> tuple[int, int, int, int]:
    """Return a box (x0, y0, x1, y1) with a margin, cut at the image's edge."""
    x0 = max(box[0] - margin, 0)
    y0 = max(box[1] - margin, 0)
    return x0, y0, min(box[2] + margin, width - 1), min(box[3] + margin, height - 1)


@jit
def gaussian_windowed(
    image: NDArray, xy: Floats, boxes: Ints, level: Floats, noise: Floats, gain_e_dn: float
) -> Floats:
    """Compute the centroid in an adaptive Gaussian window: (N, 4) x, y, sigma of the position, flux.

    The center c solves f(c) = sum(w I (x - c)) = 0 with w = exp(-|x - c|^2 / 2 s^2). Newton's method repeats:

    1. Sum the moments in the window about c.
    2. Move c by f / sum(w I (1 - (x - c)^2 / s^2)): the divisor is -df/dc, as the window moves with c.
    3. In the first SIZING_ITERATIONS iterations, set s^2 to WINDOW_VARIANCE_RATIO times the star's variance.
    4. Stop when c no longer moves. With S the divisor and M = sum(w I),
       var(c) = sum(w^2 (x - c)^2 (I / g + n^2)) / S^2 + sampling_variance (M / S)^2.

    Rows are NaN where it does not converge.

    With t the window's variance over the star's, the error exceeds the minimum by a factor (t + 1)^2 / 4 t if the sky's
    noise dominates, and (t + 1)^2 / t (t + 2) if the star's photon noise dominates: 1.125 in both cases at t = 2. A
    narrower window also samples the star at too few pixels.
    """
    height, width = image.shape
    out = np.full((len(boxes), 4), np.nan)
    for n in range(len(boxes)):
        cx, cy = xy[n]
        s2 = 1.0
        sigma2 = (interpolate(noise, height, width, cy, cx) / FILTERED_NOISE) ** 2
        for iteration in range(MAX_ITERATIONS):
            # 1. Moments
            total, mx, my, second_moment, moment_variance, flux = _window_moments(
                image, boxes, n, level, cx, cy, s2, gain_e_dn, sigma2
            )
            # 2. Newton's step, of at most 0.7 px, with the mean of both coordinates' derivatives
            slope = total - second_moment / s2
            if not (total > 0 and slope > 0):
                break
            dx = mx / slope
            dy = my / slope
            scale = min(1.0, 0.7 / max(abs(dx), abs(dy), 1e-300))
            cx = cx + scale * dx
            cy = cy + scale * dy
            # Too far from the blob: another source
            if abs(cx - xy[n, 0]) > 2 + sqrt(s2) or abs(cy - xy[n, 1]) > 2 + sqrt(s2):
                break
            if iteration < SIZING_ITERATIONS:
                # 3. Window
                s2 = _window_variance(second_moment / total, s2)
            elif max(abs(dx), abs(dy)) < 1e-10:
                # 4. Converged
                sampling_error2 = (
                    sampling_variance(second_moment / total) * (total / slope) ** 2
                )
                sigma = sqrt(moment_variance / slope**2 + sampling_error2)
                out[n] = cx, cy, sigma, flux
                break
    return out


@jit
def _window_moments(
    image: NDArray,
    boxes: Ints,
    n: int,
    level: Floats,
    cx: float,
    cy: float,
    s2: float,
    gain_e_dn: float,
    sigma2: float,
) -> tuple[float, float, float, float, float, float]:
    """Sum the moments of blob n within four sigma of a window about (cx, cy): step 1 of `gaussian_windowed`.

    Parameters
    ----------
    s2, sigma2
        Variance of the window, and n^2 of one pixel

    Returns
    -------
    tuple[float, ...]
        M = sum(w I), sum(w I u) and sum(w I v); the mean of both coordinates' sum(w I u^2), and of their
        sum(w^2 u^2 (I / g + n^2)); and sum(I)
    """
    height, width = image.shape
    reach = 4 * sqrt(s2)
    x0 = max(round(cx - reach), 0)
    y0 = max(round(cy - reach), 0)
    x1 = min(round(cx + reach), width - 1)
    y1 = min(round(cy + reach), height - 1)
    neighbor_rows = neighbors(boxes, n, x0, y0, x1, y1)
    total = mx = my = second_moment = moment_variance = flux = 0.0
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            if belongs_to_neighbor(boxes, neighbor_rows, n, x, y):
                continue
            light = image[y, x] - interpolate(level, height, width, y, x)
            u = x - cx
            v = y - cy
            w = exp(-(u * u + v * v) / (2 * s2))
            total += w * light
            mx += w * light * u
            my += w * light * v
            second_moment += w * light * (u * u + v * v) / 2
            pixel_variance = max(light, 0.0) / gain_e_dn + sigma2
            moment_variance += w * w * (u * u + v * v) / 2 * pixel_variance
            flux += light
    return total, mx, my, second_moment, moment_variance, flux


@jit
def _window_variance(apparent: float, s2: float) -> float:
    """Return the variance of the next window, from a star's apparent one in a window of variance s2.

    A star of variance q has the apparent variance 1 / (1/q + 1/s2): solve for q.
    """
    variance = MAX_WINDOW_PX**2
    if 0 < apparent < 0.95 * s2:
        variance = 1 / (1 / apparent - 1 / s2)
    return min(max(WINDOW_VARIANCE_RATIO * variance, MIN_WINDOW_PX**2), MAX_WINDOW_PX**2)


@jit
def sampling_variance(variance_px2: float) -> float:
    """Return the mean square of the S-curve of a Gaussian of variance v that is sampled at the pixel centers.

    The S-curve's amplitude is A = 4 pi v exp(-2 pi^2 v), the first harmonic of the Poisson summation of
    (x - c) exp(-(x - c)^2 / 2 v) over the pixels; its mean square is A^2 / 2.
    """
    return (4 * pi * variance_px2 * exp(-2 * pi * pi * variance_px2)) ** 2 / 2


@jit
def neighbors(boxes: Ints, n: int, x0: int, y0: int, x1: int, y1: int) -> Ints:
    """Rows of the other blobs whose boxes overlap a window around blob n."""
    beside = (boxes[:, 0] <= x1) & (boxes[:, 2] >= x0)
    overlaps = beside & (boxes[:, 1] <= y1) & (boxes[:, 3] >= y0)
    overlaps[n] = False
    return np.flatnonzero(overlaps)


@jit
def belongs_to_neighbor(boxes: Ints, neighbor_rows: Ints, n: int, x: int, y: int) -> bool:
    """Return whether a pixel is closer to the box of another blob than to that of blob n."""
    if len(neighbor_rows) == 0:
        return False
    own = _distance2_to_box(boxes[n], x, y)
    nearest = own
    for m in neighbor_rows:
        nearest = min(nearest, _distance2_to_box(boxes[m], x, y))
    return nearest < own


@jit
def _distance2_to_box(box: Ints, x: int, y: int) -> float:
    """Return the squared distance of a pixel to a box (x0, y0, x1, y1); 0 inside."""
    dx = max(box[0] - x, 0, x - box[2])
    dy = max(box[1] - y, 0, y - box[3])
    return dx * dx + dy * dy
