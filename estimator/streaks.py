"""One smeared star as a line segment blurred by a Gaussian, by least squares."""

from __future__ import annotations

from math import cos, erf, exp, hypot, pi, sin, sqrt

import numba
import numpy as np
from numpy.typing import NDArray

from estimator import leastsquares
from estimator.moments import foreign, neighbours
from estimator.skylevel import FILTERED_NOISE, at
from estimator.types import Floats, Ints

MARGIN_PX, WIDEST_PX = 4, 96  # of the window about the streak
SHORTEST_PX = 1.5  # of a streak whose length and direction the light still tells
SETTLED_PX = 1e-6
# Parameters: middle, flux, length, direction, width, sky.
X, Y, FLUX, LENGTH, ANGLE, WIDTH, SKY = range(7)


@numba.njit(cache=True)
def fit_all(
    image: NDArray,
    xy: Floats,
    boxes: Ints,
    level: Floats,
    noise: Floats,
    streak: tuple[float, float],
    gain_e_dn: float,
    saturation: float,
) -> Floats:
    """(N, 8) x, y, flux, dx, dy, and xx, yy, xy of the middle's covariance; NaN for what is no single streak."""
    height, width = image.shape
    out = np.full((len(xy), 8), np.nan)
    near = np.empty(len(xy), np.int64)
    p = np.empty(7)
    for n in range(len(xy)):
        half_x, half_y = int(abs(streak[0]) / 2) + MARGIN_PX, int(abs(streak[1]) / 2) + MARGIN_PX
        x0, y0 = round(xy[n, 0]) - half_x, round(xy[n, 1]) - half_y
        x1, y1 = x0 + 2 * half_x, y0 + 2 * half_y
        if x0 < 0 or y0 < 0 or x1 >= width or y1 >= height or max(half_x, half_y) > WIDEST_PX:
            continue
        others = near[: neighbours(boxes, n, x0, y0, x1, y1, near)]
        sky = at(level, height, width, xy[n, 1], xy[n, 0])
        sigma = at(noise, height, width, xy[n, 1], xy[n, 0]) / FILTERED_NOISE
        p[X], p[Y] = xy[n]
        p[FLUX] = 0.0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if not foreign(boxes, others, n, x, y):
                    p[FLUX] += image[y, x] - sky
        p[LENGTH], p[ANGLE] = hypot(streak[0], streak[1]), np.arctan2(streak[1], streak[0])
        p[WIDTH], p[SKY] = 0.9, sky
        if p[FLUX] > 0:
            window = (x0, y0, x1, y1)
            _fit(image, window, boxes, others, n, sigma, gain_e_dn, saturation, p, out[n])
    return out


@numba.njit(cache=True)
def _fit(
    image: NDArray,
    window: tuple[int, int, int, int],
    boxes: Ints,
    others: Ints,
    n: int,
    noise: float,
    gain_e_dn: float,
    saturation: float,
    p: Floats,
    out: Floats,
) -> None:
    """Gauss-Newton from `p`; leaves `out` NaN where it does not settle inside its window.

    Two streaks that cross are no streak: the covariance grows with what the model leaves over.
    """
    x0, y0, x1, y1 = window
    start_x, start_y, start_length = p[X], p[Y], p[LENGTH]
    normal, gradient, slope = np.empty((7, 7)), np.empty(7), np.empty(7)
    moved, misfit, pixels = np.inf, 0.0, 0
    for _ in range(60):
        normal[:], gradient[:] = 0.0, 0.0
        misfit, pixels = 0.0, 0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if image[y, x] >= saturation or foreign(boxes, others, n, x, y):
                    continue
                model = _model(p, float(x), float(y), slope)
                weight = 1 / (noise * noise + max(model, 0.0) / gain_e_dn + 1e-9)
                rest = image[y, x] - p[SKY] - model
                leastsquares.add(normal, gradient, slope, rest, weight)
                misfit += weight * rest * rest
                pixels += 1
        if not leastsquares.factorise(normal):
            return
        leastsquares.solve(normal, gradient)
        moved = max(abs(gradient[X]), abs(gradient[Y]), abs(gradient[LENGTH]))
        turned = abs(gradient[ANGLE]) * p[LENGTH] / 2
        scale = min(1.0, 1 / max(moved, turned, 2 * abs(gradient[WIDTH]), 1e-300))
        p += scale * gradient
        p[WIDTH] = min(max(p[WIDTH], 0.3), 4.0)
        if abs(p[X] - start_x) + abs(p[Y] - start_y) > 2 + start_length / 2:
            return
        if p[FLUX] <= 0 or not SHORTEST_PX < p[LENGTH] < 2 * start_length + 4:
            return
        if moved < SETTLED_PX:
            break
    if moved > 1e-3:
        return
    out[0], out[1], out[2] = p[X], p[Y], p[FLUX]
    out[3], out[4] = p[LENGTH] * cos(p[ANGLE]), p[LENGTH] * sin(p[ANGLE])
    out[5], out[6], out[7] = leastsquares.place_covariance(normal, slope)
    out[5:] *= leastsquares.misfit_factor(misfit, pixels - 7)


@numba.njit(cache=True)
def _model(p: Floats, x: float, y: float, slope: Floats) -> float:
    """Light of the streak at a pixel, and its slopes by the seven parameters.

    F / L * [erf((u + L/2) / (w sqrt 2)) - erf((u - L/2) / (w sqrt 2))] / 2 * exp(-v^2 / 2 w^2) / (w sqrt(2 pi)) at u
    along and v across. The pixel's own width is in w: w^2 = sigma^2 + 1/12.
    """
    along_x, along_y = cos(p[ANGLE]), sin(p[ANGLE])
    length, w = p[LENGTH], p[WIDTH]
    u = (x - p[X]) * along_x + (y - p[Y]) * along_y
    v = (y - p[Y]) * along_x - (x - p[X]) * along_y
    head, tail = u + length / 2, u - length / 2
    bell_head = exp(-head * head / (2 * w * w)) / (w * sqrt(2 * pi))
    bell_tail = exp(-tail * tail / (2 * w * w)) / (w * sqrt(2 * pi))
    along = (erf(head / (w * sqrt(2.0))) - erf(tail / (w * sqrt(2.0)))) / 2
    across = exp(-v * v / (2 * w * w)) / (w * sqrt(2 * pi))
    unit = along * across / length
    by_u = (bell_head - bell_tail) * across / length
    by_v = -v / (w * w) * unit
    flux = p[FLUX]
    slope[X] = -flux * (along_x * by_u - along_y * by_v)
    slope[Y] = -flux * (along_y * by_u + along_x * by_v)
    slope[FLUX] = unit
    slope[LENGTH] = flux * ((bell_head + bell_tail) / 2 * across / length - unit / length)
    slope[ANGLE] = flux * (v * by_u - u * by_v)
    by_w_along = -(head * bell_head - tail * bell_tail) / w * across / length
    slope[WIDTH] = flux * (by_w_along + unit * (v * v / (w * w * w) - 1 / w))
    slope[SKY] = 1.0
    return flux * unit
