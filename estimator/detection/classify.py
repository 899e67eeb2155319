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
from estimator.detection.captions import find_captions

# Sum of the four neighbors over the central pixel: about .5 for a centered Gaussian of sigma 0.4 px, 0 for a spike.
MIN_NEIGHBOR_RATIO = 0.25
MAX_SIZE_FRACTION = 0.05  # of the frame's shorter side: no star is that wide; the Moon and trees are
MAX_NOISE_RATIO = 4.0  # local noise over the frame's median noise
CLEAR_SIGMA = 10.0  # of a pixel: bright enough for its shape to be significant
VOTING_BLOBS = 15  # number of brightest blobs that decide whether the frame is smeared
VOTES = 0.6  # share of them that must agree
SAME_STREAKS, MIN_BROKEN_PX = 3, 12.0  # where streaks break up: least number of whole ones, and their least length
# Shortest streak that most of the brightest blobs share, and shortest line of one blob: shorter ones are explained by
# noise or, of one blob, by a pair of stars or defocus.
MIN_STREAK_PX, MIN_TRACK_PX = 2.0, 6.0
# Of a line from the shared one, relative to it: the streaks of one frame differ in length and direction by rotation and
# distortion, and the ends of bright ones are seen farther out.
SAME_LINE = 0.5


class Flag(IntFlag):
    """Anomalies of a blob.

    SATURATED : a pixel is saturated: still a star, with a less accurate position
    HOT       : a single pixel, sharper than the optics allow: a defect or a particle hit
    TRACK     : a line that the other blobs do not share: a particle or a satellite
    HUGE      : too large for a star: the Moon, a lamp, the horizon
    TEXTURE   : in a part of the frame much noisier than the rest: trees, clouds
    TEXT      : of a line of text that is burned into the picture
    """

    SATURATED = 1
    HOT = 2
    TRACK = 4
    HUGE = 8
    TEXTURE = 16
    TEXT = 32


NO_STAR = Flag.HOT | Flag.TRACK | Flag.HUGE | Flag.TEXTURE | Flag.TEXT
SATURATED, HOT, TRACK, HUGE, TEXTURE, TEXT = (int(flag) for flag in Flag)  # plain integers for compiled code


def classify(image: NDArray, blobs: Blobs, priors: FramePriors) -> Blobs:
    """Return the blobs with their flags, and with the streak (dx, dy) that the frame's stars share, if any.

    The streak is that of the priors if given, otherwise the one that most of the brightest blobs share.
    """
    if not len(blobs):
        return replace(blobs, streak_px=priors.streak_px)
    background = blobs.background
    shape = _shapes(image, blobs.box_px, background.level, background.noise)
    text = find_captions(blobs.box_px, blobs.peak)
    streak_px = priors.streak_px
    if streak_px is None:
        common_line = _common_line(shape[~text, 3:])
        if common_line[0] ** 2 + common_line[1] ** 2 > MIN_STREAK_PX**4 and len(blobs) >= 3:
            streak_px = _half_angle(common_line)
    else:
        common_line = _double_angle(streak_px)
    flag = _flags(
        shape,
        blobs.box_px,
        blobs.xy_px,
        blobs.peak,
        background.noise,
        image.shape,
        common_line,
        streak_px is not None,
        priors.saturation,
        FILTERED_NOISE * (image.dtype.kind in "iu"),
    )
    return replace(blobs, flag=flag | TEXT * text, streak_px=streak_px)


def moments(image: NDArray, blobs: Blobs) -> Floats:
    """Return the (N, 3) second moments of each blob, px^2: xx - yy, 2 xy and xx + yy."""
    background = blobs.background
    _, _, across, x, y = _shapes(image, blobs.box_px, background.level, background.noise).T
    return np.column_stack([x / 12, y / 12, 2 * across + np.hypot(x, y) / 12])


@jit
def _flags(
    shape: Floats,
    boxes: Ints,
    xy: Floats,
    peak: Floats,
    noise: Floats,
    size: tuple[int, int],
    common_line: tuple[float, float],
    smeared: bool,
    saturation: float,
    step: float,
) -> Ints:
    """Return the (N,) flags of each blob, from its row of `_shapes` and the line shared by the blobs.

    common_line: shared line as L^2 (cos 2a, sin 2a);  smeared : whether the frame has streaks
    step   : floor of the noise, from quantization
    """
    height, width = size
    typical_noise, typical_width2 = max(median(noise), step), median(shape[:, 2])
    shared2 = hypot(common_line[0], common_line[1])
    max_side = max(MAX_SIZE_FRACTION * min(height, width) + sqrt(shared2), 16.0)
    flag = np.zeros(len(shape), np.int64)
    for n in range(len(shape)):
        peak_light, neighbor_light, width2, line_x, line_y = shape[n]
        local_noise = interpolate(noise, height, width, xy[n, 1], xy[n, 0])
        pixel_noise = local_noise / FILTERED_NOISE
        diff2 = hypot(line_x - common_line[0], line_y - common_line[1])
        # 6 pixel_noise: three sigma of the sum of four pixels.
        spike = neighbor_light + 6 * pixel_noise < MIN_NEIGHBOR_RATIO * peak_light
        # A track differs from the shared line, is narrow, and is at least twice as long as wide (in rms).
        track = diff2 > max(MIN_TRACK_PX**2, SAME_LINE * shared2)
        track = track and width2 < 4 * typical_width2 and diff2 > 12 * 4 * width2
        if smeared:  # noise dominates the shape of a faint streak
            track = track and peak_light > CLEAR_SIGMA * pixel_noise
        side = max(boxes[n, 2] - boxes[n, 0], boxes[n, 3] - boxes[n, 1]) + 1
        flag[n] |= SATURATED if peak[n] >= saturation else 0
        flag[n] |= HOT if spike else 0
        flag[n] |= TRACK if track else 0
        flag[n] |= HUGE if side > max_side and not track else 0
        flag[n] |= TEXTURE if local_noise > MAX_NOISE_RATIO * typical_noise else 0
    return flag


@jit
def _common_line(lines: Floats) -> tuple[float, float]:
    """Return the line, as L^2 (cos 2a, sin 2a), shared by over 60 % of the brightest blobs, or (0, 0).

    Long faint streaks break up into pieces. If there is no such line, it is therefore that of the brightest blob with
    SAME_STREAKS like it and over 60 % that are parallel to it and no longer.
    """
    voting = lines[:VOTING_BLOBS]
    x, y = median(voting[:, 0]), median(voting[:, 1])
    if _count_same(voting, x, y) > VOTES * len(voting):
        return x, y
    for k in range(len(voting)):
        x, y = voting[k]
        square = hypot(x, y)
        if square < MIN_BROKEN_PX**2 or _count_same(voting, x, y) < SAME_STREAKS:
            continue
        parallel = 0
        for n in range(len(voting)):
            along, across = voting[n, 0] * x + voting[n, 1] * y, voting[n, 1] * x - voting[n, 0] * y
            parallel += abs(across) < SAME_LINE * along < SAME_LINE * (1 + SAME_LINE) * square**2
        if parallel > VOTES * len(voting):
            return x, y
    return 0.0, 0.0


@jit
def _count_same(lines: Floats, x: float, y: float) -> int:
    """Number of lines that are like one."""
    same = 0
    for n in range(len(lines)):
        same += hypot(lines[n, 0] - x, lines[n, 1] - y) < SAME_LINE * hypot(x, y)
    return same


def _double_angle(streak_px: tuple[float, float]) -> tuple[float, float]:
    # (dx, dy) to L^2 (cos 2a, sin 2a).
    x, y = streak_px
    return float(x * x - y * y), float(2 * x * y)


def _half_angle(line: tuple[float, float]) -> tuple[float, float]:
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
        peak_light, peak_x, peak_y = -np.inf, x0, y0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                sky = interpolate(level, height, width, y, x)
                light = image[y, x] - sky
                if light > peak_light:
                    peak_light, peak_x, peak_y = light, x, y
                if light > 0 and filtered(image, y, x) - sky > 3 * interpolate(noise, height, width, y, x):
                    dx, dy = x - x0, y - y0
                    total += light
                    x_sum += light * dx
                    y_sum += light * dy
                    xx += light * dx * dx
                    yy += light * dy * dy
                    xy += light * dx * dy
        sky = interpolate(level, height, width, peak_y, peak_x)
        out[n, 0] = peak_light
        for a, b in ((peak_x - 1, peak_y), (peak_x + 1, peak_y), (peak_x, peak_y - 1), (peak_x, peak_y + 1)):
            out[n, 1] += float(image[min(max(b, 0), height - 1), min(max(a, 0), width - 1)]) - sky
        if total > 0:
            xx, yy = xx / total - (x_sum / total) ** 2, yy / total - (y_sum / total) ** 2
            xy = xy / total - x_sum * y_sum / total**2
            # The variance across is the smaller eigenvalue of the matrix of second moments.
            eigenvalue_gap = np.sqrt((xx - yy) ** 2 + 4 * xy * xy)
            out[n, 2] = (xx + yy - eigenvalue_gap) / 2
            out[n, 3], out[n, 4] = 12 * (xx - yy), 24 * xy
    return out
