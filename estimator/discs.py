"""One lamp as a disc with a blurred edge, by least squares."""

from __future__ import annotations

from math import erfc, exp, hypot, pi, sqrt

import numba
import numpy as np
from numpy.typing import NDArray

from estimator import leastsquares
from estimator.moments import foreign, neighbours
from estimator.skylevel import FILTERED_NOISE, at
from estimator.types import Floats, Ints

MARGIN_PX = 4
SMALLEST_PX = 2.0  # radius of a disc that its edge's blur leaves flat in the middle
SETTLED_PX = 1e-6
MODEL_PX = 0.004  # what a square pixel at a curved edge differs from the model: without noise, at 5 and 10 px
# Parameters: middle, radius, the edge's width, brightness, sky.
X, Y, RADIUS, EDGE, BRIGHT, SKY = range(6)


@numba.njit(cache=True)
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
    """(N, 5) x, y, sigma of the place, flux, radius; NaN for what is no disc."""
    height, width = image.shape
    out = np.full((len(xy), 5), np.nan)
    near = np.empty(len(xy), np.int64)
    p = np.empty(6)
    for n in range(len(xy)):
        p[X], p[Y] = xy[n]
        p[RADIUS] = sqrt(area[n] / pi)
        if p[RADIUS] < SMALLEST_PX:
            continue
        x0, y0 = boxes[n, 0] - MARGIN_PX, boxes[n, 1] - MARGIN_PX
        x1, y1 = boxes[n, 2] + MARGIN_PX, boxes[n, 3] + MARGIN_PX
        if x0 < 0 or y0 < 0 or x1 >= width or y1 >= height:
            continue
        others = near[: neighbours(boxes, n, x0, y0, x1, y1, near)]
        sky = at(level, height, width, xy[n, 1], xy[n, 0])
        sigma = at(noise, height, width, xy[n, 1], xy[n, 0]) / FILTERED_NOISE
        p[EDGE], p[BRIGHT], p[SKY] = 1.0, flux[n] / area[n], sky
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

    A lamp is no perfect disc: where the residuals are larger than the noise, the covariance grows with them.
    """
    x0, y0, x1, y1 = window
    start_x, start_y, start_radius = p[X], p[Y], p[RADIUS]
    normal, gradient, slope = np.empty((6, 6)), np.empty(6), np.empty(6)
    moved, misfit, pixels = np.inf, 0.0, 0
    for _ in range(40):
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
        if pixels < 12 or not leastsquares.factorise(normal):
            return
        leastsquares.solve(normal, gradient)
        moved = max(abs(gradient[X]), abs(gradient[Y]))
        scale = min(1.0, 1 / max(moved, abs(gradient[RADIUS]), 4 * abs(gradient[EDGE]), 1e-300))
        p += scale * gradient
        p[EDGE] = min(max(p[EDGE], 0.25), 0.6 * p[RADIUS])
        if hypot(p[X] - start_x, p[Y] - start_y) > start_radius / 2 or p[BRIGHT] <= 0:
            return
        if not start_radius / 2 < p[RADIUS] < 2 * start_radius:
            return
        if max(moved, abs(gradient[RADIUS])) < SETTLED_PX:
            break
    if moved > 1e-3:
        return
    xx, yy, _ = leastsquares.place_covariance(normal, slope)
    out[0], out[1], out[4] = p[X], p[Y], p[RADIUS]
    grown = (xx + yy) / 2 * leastsquares.misfit_factor(misfit, pixels - 6)
    out[2] = sqrt(grown + MODEL_PX**2)
    # The whole light of a blurred disc: pi (R^2 + w^2), the edge being symmetric about R.
    out[3] = p[BRIGHT] * pi * (p[RADIUS] ** 2 + p[EDGE] ** 2)


@numba.njit(cache=True)
def _model(p: Floats, x: float, y: float, slope: Floats) -> float:
    """Light of the disc at a pixel, A erfc((r - R) / (w sqrt 2)) / 2, and its slopes by the six parameters.

    Exact for a straight edge blurred by a Gaussian; w^2 is the optics' sigma^2 and the pixel's 1/12.
    """
    dx, dy = x - p[X], y - p[Y]
    r = max(hypot(dx, dy), 1e-9)
    off, w = r - p[RADIUS], p[EDGE]
    shape = erfc(off / (w * sqrt(2.0))) / 2
    bell = p[BRIGHT] * exp(-off * off / (2 * w * w)) / (w * sqrt(2 * pi))
    slope[X], slope[Y] = bell * dx / r, bell * dy / r
    slope[RADIUS], slope[EDGE] = bell, bell * off / w
    slope[BRIGHT], slope[SKY] = shape, 1.0
    return p[BRIGHT] * shape
