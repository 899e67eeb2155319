"""One star as a Gaussian integrated over each pixel, by least squares."""

from __future__ import annotations

from math import erf, exp, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.core import least_squares
from estimator.core.arrays import Floats, Ints
from estimator.core.jit import jit
from estimator.detection.background import FILTERED_NOISE, at

HALF_PX, WIDEST_HALF_PX = 3, 10  # of the window: of a star, and of one that fills its pixels
NARROWEST_PX, WIDEST_PX = 0.2, 3.0  # sigma that a window of 7x7 can tell
USUAL_PX = 0.8  # sigma that the first star starts from
ROUNDS = 40
# Parameters: middle, flux, width, sky.
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
    """(N, 4) x, y, sigma of the place, flux; NaN for what is no single Gaussian.

    Each star starts from the width of the one before: the optics are the same.
    """
    height, width = image.shape
    out = np.full((len(xy), 4), np.nan)
    side = 2 * WIDEST_HALF_PX + 1
    rows, weight, edges = np.empty((6, side * side)), np.empty(side * side), np.empty((6, side + 1))
    rows[SKY] = 1.0
    p, usual_px = np.empty(5), USUAL_PX
    for n in range(len(xy)):
        half = HALF_PX
        if peak[n] >= saturation:  # only its wings tell where it is
            longer = max(boxes[n, 2] - boxes[n, 0], boxes[n, 3] - boxes[n, 1])
            half = min(max(longer // 2 + 2, HALF_PX), WIDEST_HALF_PX)
        left, top = round(xy[n, 0]) - half, round(xy[n, 1]) - half
        side = 2 * half + 1
        if left < 0 or top < 0 or left + side > width or top + side > height:
            continue
        window = image[top : top + side, left : left + side]
        sigma = at(noise, height, width, xy[n, 1], xy[n, 0]) / FILTERED_NOISE
        p[X], p[Y] = xy[n, 0] - left, xy[n, 1] - top
        p[WIDTH], p[SKY] = usual_px, at(level, height, width, xy[n, 1], xy[n, 0])
        if _fit(window, sigma, gain_e_dn, saturation, rows, weight, edges, p, out[n]):
            usual_px = p[WIDTH]
            out[n, 0] += left
            out[n, 1] += top
        if not out[n, 3] > flux[n] / 2:
            out[n] = np.nan  # a window on the plateau of a disc sees a little light on a bright sky
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
    """One Gaussian by Gauss-Newton from `p`; False where it does not settle inside its window.

    Two stars in one window are no star: the covariance grows with what the model leaves over.
    """
    start_x, start_y = p[X], p[Y]
    normal, move = np.empty((6, 6)), np.empty(5)
    p[FLUX] = max(window.sum() - window.size * p[SKY], 1e-9)
    for _ in range(ROUNDS):
        pixels = _rows(window, noise, gain_e_dn, saturation, p, rows, weight, edges)
        least_squares.normal_equations(rows, weight, window.size, normal)
        fall = least_squares.step(normal, move)
        if not fall >= 0:
            return False
        moved = max(abs(move[X]), abs(move[Y]), abs(move[WIDTH]))
        p += min(1.0, 0.5 / max(moved, 1e-300)) * move
        if abs(p[X] - start_x) > 2 or abs(p[Y] - start_y) > 2 or p[FLUX] <= 0:
            return False
        p[WIDTH] = min(max(p[WIDTH], NARROWEST_PX), WIDEST_PX)
        if moved < least_squares.SETTLED_PX or fall < least_squares.SETTLED_CHI2:
            if not NARROWEST_PX < p[WIDTH] < WIDEST_PX:
                return False
            xx, yy, _ = least_squares.place_covariance(normal, move)
            grown = least_squares.misfit_factor(normal[5, 5], pixels - 5)
            out[0], out[1], out[2], out[3] = p[X], p[Y], sqrt((xx + yy) / 2 * grown), p[FLUX]
            return True
    return False


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
    """The model's slopes at every pixel of the window, what it leaves over, and the weights; how many count."""
    side, flux, pixels = len(window), p[FLUX], window.size
    gx, dgx, sgx, gy, dgy, sgy = edges
    _cells(side, p[X], p[WIDTH], gx, dgx, sgx)
    _cells(side, p[Y], p[WIDTH], gy, dgy, sgy)
    for j in range(side):
        part = rows[:, j * side : (j + 1) * side]
        heavy, line = weight[j * side : (j + 1) * side], window[j]
        share, slope, widening = flux * gy[j], flux * dgy[j], flux * sgy[j]
        for i in range(side):
            light = share * gx[i]
            part[X, i], part[Y, i], part[FLUX, i] = share * dgx[i], slope * gx[i], gy[j] * gx[i]
            part[WIDTH, i] = share * sgx[i] + widening * gx[i]
            part[5, i] = line[i] - p[SKY] - light
            # The 1e-9 keeps a noise-free image's sky from weighing infinitely much.
            heavy[i] = 1 / (noise * noise + (light + 1e-9 * flux) / gain_e_dn)
        for i in range(side):
            if line[i] >= saturation:
                heavy[i] = 0.0
                pixels -= 1
    return pixels


@jit
def _cells(count: int, middle: float, sigma: float, share: Floats, slope: Floats, widening: Floats) -> None:
    """Share of a 1-D Gaussian in each pixel; its slopes by the middle and by sigma. From edge to edge."""
    scale = 1 / sigma
    low = (-0.5 - middle) * scale
    low_sum, low_bell = erf(low * sqrt(0.5)) / 2, exp(-low * low / 2) / sqrt(2 * pi)
    for k in range(count):
        high = low + scale
        high_sum, high_bell = erf(high * sqrt(0.5)) / 2, exp(-high * high / 2) / sqrt(2 * pi)
        share[k] = high_sum - low_sum
        slope[k] = (low_bell - high_bell) * scale
        widening[k] = (low * low_bell - high * high_bell) * scale
        low, low_sum, low_bell = high, high_sum, high_bell
