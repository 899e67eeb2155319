"""Centroids by moments of the light: centre of gravity, weighted, and in a Gaussian window."""

from __future__ import annotations

from math import exp, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.core.arrays import Floats, Ints
from estimator.core.jit import jit
from estimator.detection.background import FILTERED_NOISE, at

MARGIN_PX = 4
LEAST_WINDOW_PX, MOST_WINDOW_PX = 0.6, 4.0  # sigma of the window
WINDOW_SHARE = (
    2.0  # the window's variance over the star's: faint and bright ones lose an eighth each, see below
)
SIZING, ROUNDS = 4, 60  # rounds in which the window takes the star's width, and at most


@jit
def gravity(image: NDArray, boxes: Ints, level: Floats, noise: Floats, gain_e_dn: float) -> Floats:
    """(N, 4) x, y, sigma of the place, flux, of the light in the box and a margin around it."""
    height, width = image.shape
    out = np.empty((len(boxes), 4))
    near = np.empty(len(boxes), np.int64)
    for n in range(len(boxes)):
        x0, y0 = max(boxes[n, 0] - MARGIN_PX, 0), max(boxes[n, 1] - MARGIN_PX, 0)
        x1, y1 = min(boxes[n, 2] + MARGIN_PX, width - 1), min(boxes[n, 3] + MARGIN_PX, height - 1)
        others = near[: neighbours(boxes, n, x0, y0, x1, y1, near)]
        flux = sx = sy = s_light = light_xx = light_x = light_y = 0.0
        pixels = px = py = pxx = 0.0
        ox, oy = (x0 + x1) / 2, (y0 + y1) / 2
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if foreign(boxes, others, n, x, y):
                    continue
                light = image[y, x] - at(level, height, width, y, x)
                u, v = x - ox, y - oy
                flux += light
                sx += light * u
                sy += light * v
                bright = max(light, 0.0)
                s_light += bright
                light_x += bright * u
                light_y += bright * v
                light_xx += bright * (u * u + v * v)
                pixels += 1
                px += u
                py += v
                pxx += u * u + v * v
        if flux == 0:  # as much darkness as light: it is nowhere
            out[n] = np.nan, np.nan, np.nan, 0.0
            continue
        cx, cy = sx / flux, sy / flux
        # Sums of (x - cx)^2 + (y - cy)^2 over the pixels, and weighted by their light.
        by_light = light_xx - 2 * (cx * light_x + cy * light_y) + (cx * cx + cy * cy) * s_light
        by_pixel = pxx - 2 * (cx * px + cy * py) + (cx * cx + cy * cy) * pixels
        sigma2 = (at(noise, height, width, cy + oy, cx + ox) / FILTERED_NOISE) ** 2
        spread = (by_light / gain_e_dn + sigma2 * by_pixel) / 2
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = (
            cx + ox,
            cy + oy,
            sqrt(max(spread, 0.0)) / abs(flux),
            flux,
        )
    return out


@jit
def squared(image: NDArray, boxes: Ints, level: Floats, noise: Floats, gain_e_dn: float) -> Floats:
    """(N, 4) x, y, sigma of the place, flux; each pixel weighs as its light squared."""
    height, width = image.shape
    out = np.empty((len(boxes), 4))
    near = np.empty(len(boxes), np.int64)
    for n in range(len(boxes)):
        x0, y0 = max(boxes[n, 0] - 1, 0), max(boxes[n, 1] - 1, 0)
        x1, y1 = min(boxes[n, 2] + 1, width - 1), min(boxes[n, 3] + 1, height - 1)
        others = near[: neighbours(boxes, n, x0, y0, x1, y1, near)]
        cx = cy = flux = weight = spread = wide = 0.0
        sigma2 = 0.0
        for turn in range(2):  # the place first, then its variance about it
            for y in range(y0, y1 + 1):
                for x in range(x0, x1 + 1):
                    if foreign(boxes, others, n, x, y):
                        continue
                    light = image[y, x] - at(level, height, width, y, x)
                    if turn == 0:
                        flux += light
                        light = max(light, 0.0)
                        weight += light * light
                        cx += light * light * x
                        cy += light * light * y
                        continue
                    light = max(light, 0.0)
                    away2 = ((x - cx) ** 2 + (y - cy) ** 2) / 2
                    wide += light * light * away2
                    spread += 4 * light * light * away2 * (light / gain_e_dn + sigma2)
            if turn == 0:
                if weight == 0:
                    break
                cx, cy = cx / weight, cy / weight
                sigma2 = (at(noise, height, width, cy, cx) / FILTERED_NOISE) ** 2
        if weight == 0:
            out[n] = np.nan, np.nan, np.nan, 0.0
            continue
        out[n, 0], out[n, 1], out[n, 3] = cx, cy, flux
        out[n, 2] = sqrt(spread / weight**2 + sampling_variance(wide / weight))
    return out


@jit
def windowed(
    image: NDArray, xy: Floats, boxes: Ints, level: Floats, noise: Floats, gain_e_dn: float
) -> Floats:
    """(N, 4) x, y, sigma of the place, flux, in a Gaussian window that has found its place and the star's width.

    With t the window's variance over the star's, the error exceeds the least possible by (t + 1)^2 / 4 t where the
    sky's noise rules, by (t + 1)^2 / t (t + 2) where the star's own does: 1.125 either way at t = 2. A narrower
    window also sees the star at too few pixels.
    """
    height, width = image.shape
    out = np.full((len(boxes), 4), np.nan)
    near = np.empty(len(boxes), np.int64)
    for n in range(len(boxes)):
        cx, cy = xy[n]
        s2 = 1.0
        sigma2 = (at(noise, height, width, cy, cx) / FILTERED_NOISE) ** 2
        for turn in range(ROUNDS):
            reach = 4 * sqrt(s2)
            x0, y0 = max(round(cx - reach), 0), max(round(cy - reach), 0)
            x1, y1 = min(round(cx + reach), width - 1), min(round(cy + reach), height - 1)
            others = near[: neighbours(boxes, n, x0, y0, x1, y1, near)]
            total = mx = my = m2 = spread = flux = 0.0
            for y in range(y0, y1 + 1):
                for x in range(x0, x1 + 1):
                    if foreign(boxes, others, n, x, y):
                        continue
                    light = image[y, x] - at(level, height, width, y, x)
                    u, v = x - cx, y - cy
                    w = exp(-(u * u + v * v) / (2 * s2))
                    total += w * light
                    mx += w * light * u
                    my += w * light * v
                    m2 += w * light * (u * u + v * v) / 2
                    spread += w * w * (u * u + v * v) / 2 * (max(light, 0.0) / gain_e_dn + sigma2)
                    flux += light
            # The window's own motion takes m2 / s2 of the slope of the first moment.
            slope = total - m2 / s2
            if not (total > 0 and slope > 0):
                break
            dx, dy = mx / slope, my / slope
            scale = min(1.0, 0.7 / max(abs(dx), abs(dy), 1e-300))
            cx, cy = cx + scale * dx, cy + scale * dy
            if abs(cx - xy[n, 0]) > 2 + sqrt(s2) or abs(cy - xy[n, 1]) > 2 + sqrt(s2):
                break
            if turn < SIZING:
                # The product of the window and a star of variance q has the variance 1 / (1/q + 1/s2).
                seen = m2 / total
                q = 1 / (1 / seen - 1 / s2) if 0 < seen < 0.95 * s2 else MOST_WINDOW_PX**2
                s2 = min(max(WINDOW_SHARE * q, LEAST_WINDOW_PX**2), MOST_WINDOW_PX**2)
            elif max(abs(dx), abs(dy)) < 1e-10:
                aliased = sampling_variance(m2 / total) * (total / slope) ** 2
                out[n, 0], out[n, 1], out[n, 3] = cx, cy, flux
                out[n, 2] = sqrt(spread / slope**2 + aliased)
                break
    return out


@jit
def sampling_variance(variance_px2: float) -> float:
    """Mean square of the S-curve of a Gaussian v seen at points only: its amplitude is 4 pi v exp(-2 pi^2 v).

    The first harmonic of Poisson's sum over the pixels of (x - c) exp(-(x - c)^2 / 2 v).
    """
    return (4 * pi * variance_px2 * exp(-2 * pi * pi * variance_px2)) ** 2 / 2


@jit
def neighbours(boxes: Ints, n: int, x0: int, y0: int, x1: int, y1: int, near: Ints) -> int:
    """Fill `near` with the other blobs whose boxes reach into a window; how many."""
    count = 0
    for m in range(len(boxes)):
        apart = boxes[m, 0] > x1 or boxes[m, 2] < x0 or boxes[m, 1] > y1 or boxes[m, 3] < y0
        if m != n and not apart:
            near[count] = m
            count += 1
    return count


@jit
def foreign(boxes: Ints, near: Ints, n: int, x: int, y: int) -> bool:
    """Whether a pixel lies nearer to another blob's box."""
    if len(near) == 0:
        return False
    mine = _apart(boxes[n], x, y)
    nearest = mine
    for m in near:
        nearest = min(nearest, _apart(boxes[m], x, y))
    return nearest < mine


@jit
def _apart(box: Ints, x: int, y: int) -> float:
    """Squared distance of a pixel from a box; 0 inside."""
    dx = max(box[0] - x, 0, x - box[2])
    dy = max(box[1] - y, 0, y - box[3])
    return dx * dx + dy * dy
