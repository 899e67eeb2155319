"""Star or not: what a blob's shape and surroundings tell."""

from __future__ import annotations

from dataclasses import replace
from enum import IntFlag

import numba
import numpy as np
from numpy.typing import NDArray

from estimator.hints import Hints
from estimator.skylevel import FILTERED_NOISE, at, filtered, median
from estimator.types import Blobs, Floats, Ints

# Light of the four neighbours over the middle pixel's: .5 of a centred Gaussian of 0.4 px, 0 of a spike.
SHARPEST = 0.25
LARGEST_SHARE = 0.05  # of the frame's shorter side: no star is that wide, the Moon and a tree are
ROUGHEST = 4.0  # times the frame's own noise
CLEAR_SIGMA = 10.0  # of a pixel: light whose shape can be told
VOTERS = 15  # of the brightest blobs that say whether the frame is smeared
STREAK_PX, TRACK_PX = 6.0, 6.0  # lines that are no accident of noise, no pair of stars, no soft focus


class Flag(IntFlag):
    """What is odd about a blob.

    SATURATED : a pixel is full: still a star, less well placed
    HOT       : one pixel, sharper than any optics: a defect or a hit by a particle
    TRACK     : a line that the other blobs do not share: a particle, a satellite
    HUGE      : the Moon, a lamp, the horizon
    TEXTURE   : in a part of the frame much rougher than the rest: trees, clouds
    """

    SATURATED = 1
    HOT = 2
    TRACK = 4
    HUGE = 8
    TEXTURE = 16


NO_STAR = Flag.HOT | Flag.TRACK | Flag.HUGE | Flag.TEXTURE


def judged(image: NDArray, blobs: Blobs, hints: Hints) -> Blobs:
    """The blobs with their flags, and with the streak (dx, dy) that the frame's stars share, if any.

    A blob's streak is told by its second moments: those of a uniform line of length L exceed across by L^2 / 12. As
    a line has no sign, lines are compared as L^2 (cos 2a, sin 2a).
    """
    if not len(blobs):
        return replace(blobs, streak_px=hints.streak_px)
    background = blobs.background
    shape = _shapes(image, blobs.box_px, background.level, background.noise)
    middle, sides, width2, lines = shape[:, 0], shape[:, 1], shape[:, 2], shape[:, 3:5]
    streak_px = hints.streak_px
    shared = _shared(lines) if streak_px is None else _doubled(streak_px)
    if streak_px is None and np.hypot(*shared) > STREAK_PX**2 and len(blobs) >= 3:
        streak_px = _halved(shared)
    long2 = np.hypot(lines[:, 0] - shared[0], lines[:, 1] - shared[1])
    noise = at_all(background.noise, image.shape, blobs.xy_px)
    step = FILTERED_NOISE * (image.dtype.kind in "iu")
    ordinary = max(median(background.noise), step)
    side = np.max(blobs.box_px[:, 2:] - blobs.box_px[:, :2], axis=1) + 1
    allowed = max(LARGEST_SHARE * min(image.shape) + np.sqrt(np.hypot(*shared)), 16)
    sharp = sides + 6 * noise / FILTERED_NOISE < SHARPEST * middle
    track = (long2 > TRACK_PX**2) & (width2 < 4 * median(width2)) & (long2 > 12 * 4 * width2)
    if streak_px is not None:  # no star is a spike there, and a faint streak has the shape of its noise
        sharp[:] = False
        track &= middle > CLEAR_SIGMA * noise / FILTERED_NOISE
    flag = Flag.SATURATED * (blobs.peak >= hints.saturation)
    flag |= Flag.HOT * sharp | Flag.TRACK * track | Flag.HUGE * ((side > allowed) & ~track)
    flag |= Flag.TEXTURE * (noise > ROUGHEST * ordinary)
    return replace(blobs, flag=flag.astype(np.int64), streak_px=streak_px)


def _shared(lines: Floats) -> Floats:
    """(2,) the line, as L^2 (cos 2a, sin 2a), that most of the brightest blobs share; 0 where they do not agree."""
    voters = lines[:VOTERS]
    shared = np.array([median(voters[:, 0]), median(voters[:, 1])])
    apart = np.hypot(voters[:, 0] - shared[0], voters[:, 1] - shared[1])
    agree = np.mean(apart < 0.5 * np.hypot(*shared)) > 0.6
    return shared if agree else np.zeros(2)


def _doubled(streak_px: tuple[float, float]) -> Floats:
    x, y = streak_px
    return np.array([x * x - y * y, 2 * x * y])


def _halved(line: Floats) -> tuple[float, float]:
    length, angle = np.sqrt(np.hypot(*line)), np.arctan2(line[1], line[0]) / 2
    return float(length * np.cos(angle)), float(length * np.sin(angle))


@numba.njit(cache=True)
def at_all(grid: Floats, shape: tuple[int, int], xy: Floats) -> Floats:
    """(N,) a grid's values at pixels."""
    out = np.empty(len(xy))
    for n in range(len(xy)):
        out[n] = at(grid, shape[0], shape[1], xy[n, 1], xy[n, 0])
    return out


@numba.njit(cache=True)
def _shapes(image: NDArray, boxes: Ints, level: Floats, noise: Floats) -> Floats:
    """(N, 5) a blob's greatest pixel above the sky, the sum of its four neighbours, the variance across its longer
    axis, and 12 (xx - yy, 2 xy) of the pixels whose filtered light is above 3 sigma: L^2 (cos 2a, sin 2a).
    """
    height, width = image.shape
    out = np.zeros((len(boxes), 5))
    for n in range(len(boxes)):
        x0, y0, x1, y1 = boxes[n]
        total = x_sum = y_sum = xx = yy = xy = 0.0
        top, top_x, top_y = -np.inf, x0, y0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                sky = at(level, height, width, y, x)
                light = image[y, x] - sky
                if light > top:
                    top, top_x, top_y = light, x, y
                if light > 0 and filtered(image, y, x) - sky > 3 * at(noise, height, width, y, x):
                    u, v = x - x0, y - y0
                    total += light
                    x_sum += light * u
                    y_sum += light * v
                    xx += light * u * u
                    yy += light * v * v
                    xy += light * u * v
        sky = at(level, height, width, top_y, top_x)
        out[n, 0] = top
        for a, b in ((top_x - 1, top_y), (top_x + 1, top_y), (top_x, top_y - 1), (top_x, top_y + 1)):
            out[n, 1] += float(image[min(max(b, 0), height - 1), min(max(a, 0), width - 1)]) - sky
        if total > 0:
            xx, yy = xx / total - (x_sum / total) ** 2, yy / total - (y_sum / total) ** 2
            xy = xy / total - x_sum * y_sum / total**2
            apart = np.sqrt((xx - yy) ** 2 + 4 * xy * xy)
            out[n, 2] = (xx + yy - apart) / 2
            out[n, 3], out[n, 4] = 12 * (xx - yy), 24 * xy
    return out
