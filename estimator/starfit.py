"""One star as a Gaussian integrated over each pixel, by least squares."""

from __future__ import annotations

from math import erf, exp, pi, sqrt

import numba
import numpy as np
from numpy.typing import NDArray

from estimator import leastsquares
from estimator.skylevel import FILTERED_NOISE, at
from estimator.types import Floats, Ints

HALF_PX, WIDEST_HALF_PX = 3, 10  # of the window: of a star, and of one that fills its pixels
NARROWEST_PX, WIDEST_PX = 0.2, 3.0  # sigma that a window of 7x7 can tell
SETTLED_PX = 1e-5  # the next step of Newton's would be its square


@numba.njit(cache=True)
def fit_all(
    image: NDArray,
    xy: Floats,
    flux: Floats,
    boxes: Ints,
    peak: Floats,
    noise: Floats,
    gain_e_dn: float,
    saturation: float,
) -> Floats:
    """(N, 4) x, y, sigma of the place, flux; NaN for what is no single Gaussian."""
    out = np.full((len(xy), 4), np.nan)
    height, width = image.shape
    room = 2 * WIDEST_HALF_PX + 1
    cells = np.empty((6, room))
    normal, gradient, slope, p = np.empty((5, 5)), np.empty(5), np.empty(5), np.empty(5)
    for n in range(len(xy)):
        pixel_noise = at(noise, height, width, xy[n, 1], xy[n, 0]) / FILTERED_NOISE
        half = HALF_PX
        if peak[n] >= saturation:  # only its wings tell where it is
            side = max(boxes[n, 2] - boxes[n, 0], boxes[n, 3] - boxes[n, 1])
            half = min(max(side // 2 + 2, HALF_PX), WIDEST_HALF_PX)
        _fit(
            image,
            xy[n, 0],
            xy[n, 1],
            half,
            pixel_noise,
            gain_e_dn,
            saturation,
            cells,
            normal,
            gradient,
            slope,
            p,
            out[n],
        )
        if not out[n, 3] > flux[n] / 2:
            out[n] = np.nan  # a window on the plateau of a disc sees a little light on a bright sky
    return out


@numba.njit(cache=True)
def _fit(
    image: NDArray,
    x0: float,
    y0: float,
    half: int,
    noise: float,
    gain_e_dn: float,
    saturation: float,
    cells: Floats,
    normal: Floats,
    gradient: Floats,
    slope: Floats,
    p: Floats,
    out: Floats,
) -> None:
    """One Gaussian by Gauss-Newton; leaves `out` NaN where it does not settle inside its window.

    Two stars in one window are no star: the covariance grows with what the model leaves over.
    """
    height, width = image.shape
    side = 2 * half + 1
    left, top = round(x0) - half, round(y0) - half
    if left < 0 or top < 0 or left + side > width or top + side > height:
        return
    low, total = np.inf, 0.0
    for y in range(top, top + side):
        for x in range(left, left + side):
            low = min(low, float(image[y, x]))
            total += image[y, x]
    p[0], p[1], p[2], p[3], p[4] = x0, y0, max(total - side * side * low, 1e-9), 0.8, low
    gx, dgx, sgx, gy, dgy, sgy = cells
    moved, misfit, pixels = np.inf, 0.0, 0
    for _ in range(60):
        for k in range(side):
            gx[k], dgx[k], sgx[k] = _cell(left + k - p[0], p[3])
            gy[k], dgy[k], sgy[k] = _cell(top + k - p[1], p[3])
        normal[:], gradient[:] = 0.0, 0.0
        misfit, pixels = 0.0, 0
        for j in range(side):
            for i in range(side):
                value = float(image[top + j, left + i])
                if value >= saturation:
                    continue
                shape = gx[i] * gy[j]
                slope[0], slope[1] = p[2] * dgx[i] * gy[j], p[2] * gx[i] * dgy[j]
                slope[2], slope[3] = shape, p[2] * (sgx[i] * gy[j] + gx[i] * sgy[j])
                slope[4] = 1.0
                # The 1e-9 keeps a noise-free image's sky from weighing infinitely much.
                weight = 1 / (noise * noise + (shape + 1e-9) * p[2] / gain_e_dn)
                rest = value - p[4] - p[2] * shape
                leastsquares.add(normal, gradient, slope, rest, weight)
                misfit += weight * rest * rest
                pixels += 1
        if not leastsquares.factorise(normal):
            return
        leastsquares.solve(normal, gradient)
        moved = max(abs(gradient[0]), abs(gradient[1]))
        scale = min(1.0, 0.5 / max(moved, abs(gradient[3]), 1e-300))
        p += scale * gradient
        p[3] = min(max(p[3], NARROWEST_PX), WIDEST_PX)
        if abs(p[0] - x0) > 2 or abs(p[1] - y0) > 2 or p[2] <= 0:
            return
        if max(moved, abs(gradient[3])) < SETTLED_PX:
            break
    if moved > SETTLED_PX or p[3] <= NARROWEST_PX or p[3] >= WIDEST_PX:
        return
    xx, yy, _ = leastsquares.place_covariance(normal, slope)
    grown = leastsquares.misfit_factor(misfit, pixels - 5)
    out[0], out[1], out[2], out[3] = p[0], p[1], sqrt((xx + yy) / 2 * grown), p[2]


@numba.njit(cache=True)
def _cell(offset: float, sigma: float) -> tuple[float, float, float]:
    """Share of a 1-D Gaussian in a pixel `offset` from its middle; its slopes by centre and by sigma."""
    high, low = (offset + 0.5) / sigma, (offset - 0.5) / sigma
    share = (erf(high / sqrt(2.0)) - erf(low / sqrt(2.0))) / 2
    bell_high, bell_low = exp(-high * high / 2) / sqrt(2 * pi), exp(-low * low / 2) / sqrt(2 * pi)
    return share, (bell_low - bell_high) / sigma, (low * bell_low - high * bell_high) / sigma
