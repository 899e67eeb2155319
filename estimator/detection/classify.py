"""Blob classification: flag blobs that are not stars, from their shape and their surroundings.

The shape is described by second moments. A uniform line of length L has a variance along it that exceeds the variance
across it by L^2 / 12, so 12 (xx - yy, 2 xy) = L^2 (cos 2a, sin 2a) gives length and direction a. In this form a line
and its reverse are equal, and lines are averaged and compared as plain vectors. If most of the brightest blobs agree on
one line, the frame is smeared (a streak); a line that differs from the others is a particle track or a satellite.
"""

from __future__ import annotations

from dataclasses import replace
from enum import IntFlag
from math import atan2, cos, hypot, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.core.arrays import Floats, Ints
from estimator.core.jit import jit
from estimator.core.types import Blobs, FramePriors
from estimator.detection.background import FILTERED_NOISE, filtered, interpolate, median

# Sum of the four neighbors over the central pixel: about .5 for a centered Gaussian of sigma 0.4 px, 0 for a spike.
SHARPEST = 0.25
LARGEST_SHARE = 0.05  # of the frame's shorter side: no star is that wide; the Moon and trees are
ROUGHEST = 4.0  # local noise over the frame's median noise
CLEAR_SIGMA = 10.0  # of a pixel: bright enough for its shape to be significant
VOTERS = 15  # number of brightest blobs that decide whether the frame is smeared
STREAK_PX, TRACK_PX = 6.0, 6.0  # shortest lines not explained by noise, a pair of stars or defocus


class Flag(IntFlag):
    """Anomalies of a blob.

    SATURATED : a pixel is saturated: still a star, with a less accurate position
    HOT       : a single pixel, sharper than the optics allow: a defect or a particle hit
    TRACK     : a line that the other blobs do not share: a particle or a satellite
    HUGE      : too large for a star: the Moon, a lamp, the horizon
    TEXTURE   : in a part of the frame much noisier than the rest: trees, clouds
    """

    SATURATED = 1
    HOT = 2
    TRACK = 4
    HUGE = 8
    TEXTURE = 16


NO_STAR = Flag.HOT | Flag.TRACK | Flag.HUGE | Flag.TEXTURE
SATURATED, HOT, TRACK, HUGE, TEXTURE = (int(flag) for flag in Flag)  # plain integers for compiled code


def classify(image: NDArray, blobs: Blobs, hints: FramePriors) -> Blobs:
    """Return the blobs with their flags, and with the streak (dx, dy) that the frame's stars share, if any.

    The streak is that of the hints if given, otherwise the one that most of the brightest blobs share.
    """
    if not len(blobs):
        return replace(blobs, streak_px=hints.streak_px)
    background = blobs.background
    shape = _shapes(image, blobs.box_px, background.level, background.noise)
    streak_px = hints.streak_px
    if streak_px is None:
        shared = _shared(shape[:, 3:])
        if shared[0] ** 2 + shared[1] ** 2 > STREAK_PX**4 and len(blobs) >= 3:
            streak_px = _halved(shared)
    else:
        shared = _doubled(streak_px)
    flag = _flags(
        shape,
        blobs.box_px,
        blobs.xy_px,
        blobs.peak,
        background.noise,
        image.shape,
        shared,
        streak_px is not None,
        hints.saturation,
        FILTERED_NOISE * (image.dtype.kind in "iu"),
    )
    return Blobs(
        blobs.box_px, blobs.xy_px, blobs.flux, blobs.peak, blobs.area_px, background, flag, streak_px
    )


@jit
def _flags(
    shape: Floats,
    boxes: Ints,
    xy: Floats,
    peak: Floats,
    noise: Floats,
    size: tuple[int, int],
    shared: tuple[float, float],
    smeared: bool,
    saturation: float,
    step: float,
) -> Ints:
    """Return the (N,) flags of each blob, from its row of `_shapes` and the line shared by the blobs.

    shared : shared line as L^2 (cos 2a, sin 2a);  smeared : whether the frame has streaks
    step   : floor of the noise, from quantization
    """
    height, width = size
    ordinary, narrow = max(median(noise), step), median(shape[:, 2])
    allowed = max(LARGEST_SHARE * min(height, width) + sqrt(hypot(shared[0], shared[1])), 16.0)
    flag = np.zeros(len(shape), np.int64)
    for n in range(len(shape)):
        middle, sides, width2, line_x, line_y = shape[n]
        here = interpolate(noise, height, width, xy[n, 1], xy[n, 0])
        pixel_noise = here / FILTERED_NOISE
        long2 = hypot(line_x - shared[0], line_y - shared[1])
        # 6 pixel_noise: three sigma of the sum of four pixels.
        sharp = sides + 6 * pixel_noise < SHARPEST * middle
        # A track differs from the shared line, is narrow, and is at least twice as long as wide (in rms).
        track = long2 > TRACK_PX**2 and width2 < 4 * narrow and long2 > 12 * 4 * width2
        if smeared:  # no star is a spike there, and noise dominates the shape of a faint streak
            sharp = False
            track = track and middle > CLEAR_SIGMA * pixel_noise
        side = max(boxes[n, 2] - boxes[n, 0], boxes[n, 3] - boxes[n, 1]) + 1
        flag[n] |= SATURATED if peak[n] >= saturation else 0
        flag[n] |= HOT if sharp else 0
        flag[n] |= TRACK if track else 0
        flag[n] |= HUGE if side > allowed and not track else 0
        flag[n] |= TEXTURE if here > ROUGHEST * ordinary else 0
    return flag


@jit
def _shared(lines: Floats) -> tuple[float, float]:
    """Return the line, as L^2 (cos 2a, sin 2a), shared by over 60 % of the brightest blobs, or (0, 0)."""
    voters = lines[:VOTERS]
    x, y = median(voters[:, 0]), median(voters[:, 1])
    agree = 0
    for n in range(len(voters)):
        agree += hypot(voters[n, 0] - x, voters[n, 1] - y) < 0.5 * hypot(x, y)
    return (x, y) if agree > 0.6 * len(voters) else (0.0, 0.0)


def _doubled(streak_px: tuple[float, float]) -> tuple[float, float]:
    # (dx, dy) to L^2 (cos 2a, sin 2a).
    x, y = streak_px
    return float(x * x - y * y), float(2 * x * y)


def _halved(line: tuple[float, float]) -> tuple[float, float]:
    # L^2 (cos 2a, sin 2a) to (dx, dy).
    length, angle = sqrt(hypot(*line)), atan2(line[1], line[0]) / 2
    return length * cos(angle), length * sin(angle)


@jit
def _shapes(image: NDArray, boxes: Ints, level: Floats, noise: Floats) -> Floats:
    """Return (N, 5): the shape of each blob.

    Columns: the largest pixel above the sky, the sum of its four neighbors above the sky, the variance across the
    longer axis, and 12 (xx - yy, 2 xy) = L^2 (cos 2a, sin 2a). The moments use the pixels whose filtered value is above
    3 sigma.
    """
    height, width = image.shape
    out = np.zeros((len(boxes), 5))
    for n in range(len(boxes)):
        x0, y0, x1, y1 = boxes[n]
        total = x_sum = y_sum = xx = yy = xy = 0.0
        top, top_x, top_y = -np.inf, x0, y0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                sky = interpolate(level, height, width, y, x)
                light = image[y, x] - sky
                if light > top:
                    top, top_x, top_y = light, x, y
                if light > 0 and filtered(image, y, x) - sky > 3 * interpolate(noise, height, width, y, x):
                    u, v = x - x0, y - y0
                    total += light
                    x_sum += light * u
                    y_sum += light * v
                    xx += light * u * u
                    yy += light * v * v
                    xy += light * u * v
        sky = interpolate(level, height, width, top_y, top_x)
        out[n, 0] = top
        for a, b in ((top_x - 1, top_y), (top_x + 1, top_y), (top_x, top_y - 1), (top_x, top_y + 1)):
            out[n, 1] += float(image[min(max(b, 0), height - 1), min(max(a, 0), width - 1)]) - sky
        if total > 0:
            xx, yy = xx / total - (x_sum / total) ** 2, yy / total - (y_sum / total) ** 2
            xy = xy / total - x_sum * y_sum / total**2
            # The variance across is the smaller eigenvalue of the matrix of second moments.
            apart = np.sqrt((xx - yy) ** 2 + 4 * xy * xy)
            out[n, 2] = (xx + yy - apart) / 2
            out[n, 3], out[n, 4] = 12 * (xx - yy), 24 * xy
    return out
