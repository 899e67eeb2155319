"""Where each blob is, to a fraction of a pixel."""

from __future__ import annotations

from collections.abc import Callable
from math import erf, exp, pi, sqrt

import numba
import numpy as np
from numpy.typing import NDArray

from estimator.detect import at, native
from estimator.types import Blobs, Centroids, Floats

Centroider = Callable[..., Centroids]

MARGIN_PX = 4
FIT_HALF_PX = 3
NARROWEST_PX, WIDEST_PX = 0.2, 3.0  # sigma that a window of 7x7 can tell


def cog(image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0) -> Centroids:
    """Centre of gravity of the light above the sky in the blob's box and a margin around it.

    x = sum(I x) / sum(I), with var(x) = sum((I / g + noise^2) (x - x_mean)^2) / sum(I)^2 for a gain of g
    electrons a unit. A pixel that lies nearer to another blob's box is left out.
    """
    return _measured(
        _cog(native(image), blobs.box_px, blobs.background.level, blobs.background.noise, gain_e_dn)
    )


def gaussian_fit(image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0) -> Centroids:
    """Least-squares fit of a Gaussian integrated over each pixel: x, y, flux, sigma and the sky under it.

    Gauss-Newton on a 7x7 window around the blob's middle. The model is I = b + F gx gy with
    gx = [erf((x - x0 + 1/2) / (sigma sqrt 2)) - erf((x - x0 - 1/2) / (sigma sqrt 2))] / 2, and a pixel weighs
    1 / (noise^2 + F gx gy / g) for a gain of g electrons a unit: with equal weights a bright star is placed
    4/3 times worse than the photons allow. A blob that the model does not fit (no convergence, larger than
    the window) keeps its centre of gravity.
    """
    fallback = cog(image, blobs, gain_e_dn)
    fitted = _fit_all(native(image), blobs.xy_px, blobs.flux, blobs.background.noise, gain_e_dn)
    good = np.isfinite(fitted[:, 0])
    xy = np.where(good[:, None], fitted[:, :2], fallback.xy_px)
    sigma = np.where(good, fitted[:, 2], fallback.sigma_px)
    return Centroids(xy, sigma, np.where(good, fitted[:, 3], fallback.flux))


CENTROIDERS: dict[str, Centroider] = {"cog": cog, "gaussian_fit": gaussian_fit}


def _measured(rows: Floats) -> Centroids:
    return Centroids(np.ascontiguousarray(rows[:, :2]), rows[:, 2].copy(), rows[:, 3].copy())


@numba.njit(cache=True)
def _cog(image: NDArray, boxes: NDArray, level: Floats, noise: Floats, gain_e_dn: float) -> Floats:
    height, width = image.shape
    out = np.empty((len(boxes), 4))
    for n in range(len(boxes)):
        x0, y0 = max(boxes[n, 0] - MARGIN_PX, 0), max(boxes[n, 1] - MARGIN_PX, 0)
        x1, y1 = min(boxes[n, 2] + MARGIN_PX, width - 1), min(boxes[n, 3] + MARGIN_PX, height - 1)
        near = _neighbours(boxes, n, x0, y0, x1, y1)
        flux = sx = sy = 0.0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if _foreign(boxes, near, n, x, y):
                    continue
                light = image[y, x] - at(level, height, width, y, x)
                flux += light
                sx += light * x
                sy += light * y
        if flux == 0:  # as much darkness as light: it is nowhere
            out[n] = np.nan, np.nan, np.nan, 0.0
            continue
        cx, cy = sx / flux, sy / flux
        # The noise grid is that of the filtered image; one pixel's is 1 / 0.375 of it for white noise.
        sigma2 = (at(noise, height, width, cy, cx) / 0.375) ** 2
        spread = 0.0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if _foreign(boxes, near, n, x, y):
                    continue
                light = max(image[y, x] - at(level, height, width, y, x), 0.0)
                spread += (light / gain_e_dn + sigma2) * ((x - cx) ** 2 + (y - cy) ** 2) / 2
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = cx, cy, sqrt(spread) / flux, flux
    return out


@numba.njit(cache=True)
def _neighbours(boxes: NDArray, n: int, x0: int, y0: int, x1: int, y1: int) -> NDArray:
    """The other blobs whose boxes reach into a window."""
    near = np.empty(len(boxes), np.int64)
    count = 0
    for m in range(len(boxes)):
        apart = boxes[m, 0] > x1 or boxes[m, 2] < x0 or boxes[m, 1] > y1 or boxes[m, 3] < y0
        if m != n and not apart:
            near[count] = m
            count += 1
    return near[:count]


@numba.njit(cache=True)
def _foreign(boxes: NDArray, near: NDArray, n: int, x: int, y: int) -> bool:
    mine = _apart(boxes[n], x, y)
    nearest = mine
    for m in near:
        nearest = min(nearest, _apart(boxes[m], x, y))
    return nearest < mine


@numba.njit(cache=True)
def _apart(box: NDArray, x: int, y: int) -> float:
    """Squared distance of a pixel from a box; 0 inside."""
    dx = max(box[0] - x, 0, x - box[2])
    dy = max(box[1] - y, 0, y - box[3])
    return dx * dx + dy * dy


@numba.njit(cache=True)
def _fit_all(image: NDArray, xy: Floats, flux: Floats, noise: Floats, gain_e_dn: float) -> Floats:
    out = np.full((len(xy), 4), np.nan)
    height, width = image.shape
    for n in range(len(xy)):
        pixel_noise = at(noise, height, width, xy[n, 1], xy[n, 0]) / 0.375
        _fit(image, xy[n, 0], xy[n, 1], pixel_noise, gain_e_dn, out[n])
        if not out[n, 3] > flux[n] / 2:
            out[n] = np.nan  # a window on the plateau of a disc sees a little light on a bright sky
    return out


@numba.njit(cache=True)
def _fit(image: NDArray, x0: float, y0: float, noise: float, gain_e_dn: float, out: Floats) -> None:
    """One Gaussian by Gauss-Newton; leaves `out` NaN where it does not settle inside its window."""
    height, width = image.shape
    left, top = round(x0) - FIT_HALF_PX, round(y0) - FIT_HALF_PX
    side = 2 * FIT_HALF_PX + 1
    if left < 0 or top < 0 or left + side > width or top + side > height:
        return
    low = float(image[top, left])
    total = 0.0
    for y in range(top, top + side):
        for x in range(left, left + side):
            low = min(low, float(image[y, x]))
            total += image[y, x]
    p = np.array([x0, y0, max(total - side * side * low, 1e-9), 0.8, low])
    normal, gradient = np.zeros((5, 5)), np.zeros(5)
    settled = False
    for _ in range(60):
        normal[:], gradient[:] = 0.0, 0.0
        for y in range(top, top + side):
            gy, dgy, sgy = _cell(y - p[1], p[3])
            for x in range(left, left + side):
                gx, dgx, sgx = _cell(x - p[0], p[3])
                rest = image[y, x] - p[4] - p[2] * gx * gy
                # The 1e-9 keeps a noise-free image's sky from weighing infinitely much.
                weight = 1 / (noise**2 + (gx * gy + 1e-9) * p[2] / gain_e_dn)
                slope = (p[2] * dgx * gy, p[2] * gx * dgy, gx * gy, p[2] * (sgx * gy + gx * sgy), 1.0)
                for i in range(5):
                    gradient[i] += weight * slope[i] * rest
                    for j in range(5):
                        normal[i, j] += weight * slope[i] * slope[j]
        for i in range(5):
            normal[i, i] *= 1 + 1e-12
        if abs(np.linalg.det(normal)) < 1e-300:
            return
        step = np.linalg.solve(normal, gradient)
        scale = min(1.0, 0.5 / max(abs(step[0]), abs(step[1]), abs(step[3]), 1e-300))
        p += scale * step
        p[3] = min(max(p[3], NARROWEST_PX), WIDEST_PX)
        if abs(p[0] - x0) > 2 or abs(p[1] - y0) > 2 or p[2] <= 0:
            return
        if max(abs(step[0]), abs(step[1])) < 1e-12:
            settled = True
            break
    if not settled and max(abs(step[0]), abs(step[1])) > 1e-6:
        return
    if p[3] <= NARROWEST_PX or p[3] >= WIDEST_PX:
        return
    # The weights are the inverse variances, so the normal matrix is Fisher's: its inverse is Cramer and Rao's.
    covariance = np.linalg.inv(normal)
    out[0], out[1], out[3] = p[0], p[1], p[2]
    out[2] = sqrt((covariance[0, 0] + covariance[1, 1]) / 2)


@numba.njit(cache=True)
def _cell(offset: float, sigma: float) -> tuple[float, float, float]:
    """Share of a 1-D Gaussian in a pixel `offset` from its middle; its slopes by centre and by sigma."""
    high, low = (offset + 0.5) / sigma, (offset - 0.5) / sigma
    share = (erf(high / sqrt(2.0)) - erf(low / sqrt(2.0))) / 2
    bell_high, bell_low = exp(-high * high / 2) / sqrt(2 * pi), exp(-low * low / 2) / sqrt(2 * pi)
    return share, (bell_low - bell_high) / sigma, (low * bell_low - high * bell_high) / sigma
