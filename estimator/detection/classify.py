"""Blob classification: flag blobs that are not stars, from their shape and their surroundings.

The shape is described by second moments. A uniform line of length L has a variance along it that exceeds the variance
across it by L^2 / 12, so 12 (xx - yy, 2 xy) = L^2 (cos 2a, sin 2a) gives length and direction a. In this form a line
and its reverse are equal, and lines are averaged and compared as plain vectors. `classify` takes these steps:

1. Measure the shape of each blob (`_shapes`).
2. Find lines of text that are burned into the picture (`find_captions`).
3. Find the streak that the frame's stars share (`_common_line`): most of the brightest blobs agree on one line.
4. Find a field of streaks (`_field`). Where the camera rolls about its boresight the streaks differ:
   v(x) = t + w J (x - c) with J (x, y) = (-y, x). Any two of them, each up to its sign, give t and w; if most of the
   brightest blobs agree on such a field, it is the frame's.
5. Flag each blob by its shape, its line and its surroundings (`_flags`): a line that differs from the frame's streak is
   a particle track or a satellite.
6. Flag the pieces into which a faint track breaks (`_join_tracks`).
"""

from dataclasses import replace
from enum import IntFlag
from math import atan2, cos, hypot, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Bools, Floats, Ints, Step
from estimator.core.jit import jit
from estimator.core.types import Blobs, FramePriors
from estimator.detection.background import FILTERED_NOISE, filtered, interpolate

Line = tuple[float, float]  # L^2 (cos 2a, sin 2a) of a streak of length L and direction a
Field = tuple[float, float, float]  # streak (dx, dy) at the image's center, and turn

# Text burned into a picture: dates, names of cameras, exposure times.

MIN_HEIGHT_PX = 7  # smallest letters that are searched for
MIN_LETTERS = 5
# Largest difference of the tops and of the base lines of letters, over their height; of their peaks, relative.
SAME_HEIGHT = 0.2
SAME_PEAK = 0.15
GAP = 1.5  # largest gap between neighbors over the height: a space between words
UNEQUAL_WIDTH = 1.25  # least ratio of the widest to the narrowest letter
MARGIN = 0.5  # margin around a line of text over the height


def find_captions(boxes: Ints, peak: Floats) -> Bools:
    """Return (N,) whether a blob belongs to a line of text, from the blobs' boxes (x0, y0, x1, y1) and peaks.

    A line of text is a chain of blobs side by side on one base line that are equally high and equally bright, and
    differ in width, as letters do and disks or streaks do not. What is between them (points, hyphens, parts of letters)
    belongs to it.

    1. Grow a line from each blob that is high enough for a letter (`_line_of_text`).
    2. Accept it if it has enough letters of different widths.
    3. Mark its letters, and the smaller blobs within its box and a margin.
    """
    out = np.zeros(len(boxes), bool)
    heights = boxes[:, 3] - boxes[:, 1]
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    for n in np.flatnonzero(heights + 1 >= MIN_HEIGHT_PX).tolist():
        if out[n]:
            continue
        # 1. Line of text
        letters = _line_of_text(boxes, peak, n)
        # 2. Letters
        width = boxes[letters, 2] - boxes[letters, 0] + 1
        if len(letters) < MIN_LETTERS or width.max() < UNEQUAL_WIDTH * width.min():
            continue
        # 3. Marks
        margin = MARGIN * (heights[n] + 1)
        low = boxes[letters, :2].min(axis=0) - margin
        high = boxes[letters, 2:].max(axis=0) + margin
        beside = np.all((low < middle) & (middle < high), axis=1)
        out |= beside & (heights < 2 * (heights[n] + 1))
        out[letters] = True
    return out


def _line_of_text(boxes: Ints, peak: Floats, first: int) -> Ints:
    """Return the rows of the blobs that form a line of text with its letter `first`.

    1. Select the blobs of the same height, near the line, and equally bright.
    2. Divide them at wide gaps, and take the part with the first letter.
    """
    # 1. Equal blobs
    x0, top, x1, base = boxes.T
    height = base[first] - top[first] + 1
    near_px = max(SAME_HEIGHT * height, 1.5)
    like = (np.abs(top - top[first]) <= near_px) & (np.abs(base - base[first]) <= near_px)
    like &= np.abs(peak - peak[first]) <= SAME_PEAK * np.abs(peak[first])
    # 2. Gaps
    rows = np.flatnonzero(like)
    rows = rows[np.argsort(x0[rows], kind="stable")]
    wide = x0[rows[1:]] - np.maximum.accumulate(x1[rows])[:-1] > GAP * height
    part = np.concatenate([[0], np.cumsum(wide)])
    return rows[part == part[rows == first]]


# Classification.

# Least sum of the four neighbors over the central pixel: about .5 for a centered Gaussian of sigma 0.4 px, 0 for a
# spike.
MIN_NEIGHBOR_RATIO = 0.25
# Largest width of a star over the frame's shorter side; the Moon and trees are wider.
MAX_SIZE_FRACTION = 0.05
LARGE = 0.125  # area of a box over the frame's whose shape is not measured
MAX_NOISE_RATIO = 4.0  # largest local noise over the frame's median noise
CLEAR_SIGMA = 10.0  # peak in sigmas of a pixel that makes a blob's shape significant
VOTING_BLOBS = 15  # number of brightest blobs that decide whether the frame is smeared
VOTES = 0.6  # share of them that must agree
SAME_TURNED = 5  # least number of streaks that show a roll; two determine it
# Where streaks break up: least number of whole ones, and their least length.
SAME_STREAKS = 3
MIN_BROKEN_PX = 12.0
# Shortest streak that most of the brightest blobs share, and shortest line of one blob. Noise explains shorter ones, or
# for one blob a pair of stars or defocus.
MIN_STREAK_PX = 2.0
MIN_TRACK_PX = 6.0
# Largest difference of a line from the shared one, relative to it: the streaks of one frame differ in length and
# direction by rotation and distortion, and the ends of bright ones are detected farther out.
SAME_LINE = 0.5
# A faint track breaks into pieces: blobs of at least MIN_PIECE_PX on one straight line, within PIECE_OFF_PX of it and
# within an angle whose double has the cosine PARALLEL (20 degrees). Three of them, or two with a whole track, are one.
MIN_PIECE_PX = 3.0
PIECE_OFF_PX = 1.5
PARALLEL = 0.77
MIN_PIECES = 3
MAX_PIECES = 200


class Flag(IntFlag):
    """Anomalies of a blob.

    Attributes
    ----------
    SATURATED
        A pixel is saturated: still a star, with a less accurate position
    HOT
        A single pixel, sharper than the optics allow: a defect or a particle hit
    TRACK
        A line that the other blobs do not share: a particle or a satellite
    HUGE
        Too large for a star: the Moon, a lamp, the horizon
    TEXTURE
        In a part of the frame much noisier than the rest: trees, clouds
    TEXT
        Part of a line of text that is burned into the picture
    """

    SATURATED = 1
    HOT = 2
    TRACK = 4
    HUGE = 8
    TEXTURE = 16
    TEXT = 32


NO_STAR = Flag.HOT | Flag.TRACK | Flag.HUGE | Flag.TEXTURE | Flag.TEXT
# Plain integers for compiled code.
SATURATED, HOT, TRACK, HUGE, TEXTURE, TEXT = (int(flag) for flag in Flag)


def classify(image: NDArray, blobs: Blobs, priors: FramePriors) -> Blobs:
    """Return the blobs with their flags, and with the streak (dx, dy) that the frame's stars share, if any.

    Streak and turn are those of the priors if given, otherwise those that most of the brightest blobs share. The
    numbered steps are those of the module.
    """
    if not len(blobs):
        return replace(blobs, streak_px=priors.streak_px)
    # 1. Shapes
    shape = _shapes(image, blobs.box_px, *blobs.background)
    # 2. Text, in photographs. Streaks of a known length have boxes of one height, as letters do.
    text = np.zeros(len(blobs), bool)
    streak_px = priors.streak_px
    turn_rad = priors.turn_rad
    if streak_px is None:
        if priors.reject & TEXT:
            text = find_captions(blobs.box_px, blobs.peak)
        # 3. and 4. Shared streaks. Columns of readout smear are no streaks: a blob across half the frame does not vote.
        x0, y0, x1, y1 = blobs.box_px.T
        votes = ~text & (x1 - x0 < image.shape[1] / 2) & (y1 - y0 < image.shape[0] / 2)
        lines = shape[votes, 3:]
        center = ((image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2)
        x, y, turn_rad = _field(lines, blobs.xy_px[votes], center, _common_line(lines))
        if turn_rad != 0 or (hypot(x, y) > MIN_STREAK_PX and len(blobs) >= 3):
            streak_px = x, y
    else:
        x, y = streak_px
    # 5. Flags; integers have quantization noise at least.
    flag = _flags(
        shape,
        blobs.box_px,
        blobs.xy_px,
        blobs.peak,
        blobs.background.noise,
        image.shape,
        (x, y, turn_rad),
        streak_px is not None,
        priors.saturation,
        FILTERED_NOISE * (image.dtype.kind in "iu"),
    )
    # 6. Pieces of a track. In a smeared frame they would be pieces of streaks.
    if streak_px is None:
        _join_tracks(flag, shape, blobs.xy_px)
    return replace(blobs, flag=flag | TEXT * text, streak_px=streak_px, turn_rad=turn_rad)


def streaks_px(blobs: Blobs, shape: tuple[int, ...], streak_px: Step) -> Floats:
    """Return the (N, 2) streak of each blob: v(x) = t + w J (x - c), with the streak t at the image's center c."""
    x, y = (blobs.xy_px - np.array([shape[1] - 1, shape[0] - 1]) / 2).T
    return np.array(streak_px) + blobs.turn_rad * np.column_stack([-y, x])


def moments(image: NDArray, blobs: Blobs) -> Floats:
    """Return the (N, 3) second moments of each blob, px^2: xx - yy, 2 xy and xx + yy."""
    _, _, across, x, y = _shapes(image, blobs.box_px, *blobs.background).T
    # xx + yy is the sum of the eigenvalues: twice the smaller one, and their difference.
    return np.column_stack([x / 12, y / 12, 2 * across + np.hypot(x, y) / 12])


@jit
def _flags(
    shape: Floats,
    boxes: Ints,
    xy: Floats,
    peak: Floats,
    noise: Floats,
    size: tuple[int, int],
    field: Field,
    smeared: bool,
    saturation: float,
    step: float,
) -> Ints:
    """Return the (N,) flags of each blob, from its row of `_shapes` and the streaks shared by the blobs.

    Parameters
    ----------
    shape
        (N, 5) rows of `_shapes`
    size
        Height and width of the image
    field
        Shared streak (dx, dy) at the center, and turn
    smeared
        Whether the frame has streaks
    step
        Least noise, from quantization
    """
    height, width = size
    typical_noise = max(np.median(noise), step)
    typical_width2 = np.median(shape[:, 2])
    center = (width - 1) / 2, (height - 1) / 2
    flag = np.zeros(len(shape), np.int64)
    for n in range(len(shape)):
        peak_light, neighbor_light, width2, line_x, line_y = shape[n]
        local_noise = interpolate(noise, height, width, xy[n, 1], xy[n, 0])
        pixel_noise = local_noise / FILTERED_NOISE
        shared_x, shared_y = _line_at(field, xy[n, 0] - center[0], xy[n, 1] - center[1])
        # Squared lengths of the shared streak at the blob, and of the difference from it
        shared2 = hypot(shared_x, shared_y)
        diff2 = hypot(line_x - shared_x, line_y - shared_y)
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
        max_side = max(MAX_SIZE_FRACTION * min(height, width) + sqrt(shared2), 16.0)
        flag[n] |= HUGE if side > max_side and not track else 0
        flag[n] |= TEXTURE if local_noise > MAX_NOISE_RATIO * typical_noise else 0
    return flag


@jit
def _join_tracks(flag: Ints, shape: Floats, xy: Floats) -> None:
    """Flag the pieces into which a faint track breaks, in place.

    1. Select the pieces: blobs that are longer than wide.
    2. For each two pieces, check that both are parallel to the line through them.
    3. Count the pieces on that line; one that is a track by itself counts twice.
    4. Flag them if there are MIN_PIECES or more.

    Round stars have no direction, so among the few blobs with one the chance that three agree is below 1e-3.
    """
    # 1. Pieces
    piece = np.empty(MAX_PIECES, np.int64)
    count = 0
    for n in range(len(shape)):
        length2 = hypot(shape[n, 3], shape[n, 4])
        if (
            length2 > max(MIN_PIECE_PX**2, 12 * shape[n, 2])
            and not flag[n] & (HOT | HUGE)
            and count < MAX_PIECES
        ):
            piece[count] = n
            count += 1
    for i in range(count):
        for j in range(i):
            a = piece[i]
            b = piece[j]
            x = xy[b, 0] - xy[a, 0]
            y = xy[b, 1] - xy[a, 1]
            # 2. Directions
            if not (_along(shape[a], x, y) and _along(shape[b], x, y)):
                continue
            # 3. Number of pieces on the line
            weight = 0
            for k in range(count):
                if _on_line(shape[piece[k]], xy[piece[k]], xy[a], x, y):
                    weight += 2 if flag[piece[k]] & TRACK else 1
            if weight < MIN_PIECES:
                continue
            # 4. Flags
            for k in range(count):
                if _on_line(shape[piece[k]], xy[piece[k]], xy[a], x, y):
                    flag[piece[k]] |= TRACK


@jit
def _along(shape: Floats, x: float, y: float) -> bool:
    """Return whether a blob's line is parallel to a vector."""
    # The cosine of twice the angle between them
    line_x, line_y = _double_angle(x, y)
    along = shape[3] * line_x + shape[4] * line_y
    return along > PARALLEL * hypot(shape[3], shape[4]) * (x * x + y * y)


@jit
def _on_line(shape: Floats, xy: Floats, start: Floats, x: float, y: float) -> bool:
    """Return whether a blob is on a line from a start along a vector, and parallel to it."""
    off = (xy[0] - start[0]) * y - (xy[1] - start[1]) * x
    return abs(off) < PIECE_OFF_PX * hypot(x, y) and _along(shape, x, y)


@jit
def _common_line(lines: Floats) -> Line:
    """Return the line, as L^2 (cos 2a, sin 2a), that over 60 % of the brightest blobs share, or (0, 0).

    1. Take the median line if over 60 % are like it.
    2. Otherwise take the line of the brightest blob that SAME_STREAKS are like, and to which over 60 % are parallel and
       no longer: long faint streaks break up into pieces.
    """
    # 1. Median
    voting = lines[:VOTING_BLOBS]
    x = np.median(voting[:, 0])
    y = np.median(voting[:, 1])
    if _count_same(voting, x, y) > VOTES * len(voting):
        return x, y
    # 2. Broken streaks
    for k in range(len(voting)):
        x, y = voting[k]
        if hypot(x, y) < MIN_BROKEN_PX**2 or _count_same(voting, x, y) < SAME_STREAKS:
            continue
        if _count_pieces(voting, x, y) > VOTES * len(voting):
            return x, y
    return 0.0, 0.0


@jit
def _count_pieces(lines: Floats, x: float, y: float) -> int:
    """Return the number of lines that are parallel to the line (x, y) and no longer."""
    along = lines[:, 0] * x + lines[:, 1] * y
    across = np.abs(lines[:, 1] * x - lines[:, 0] * y)
    longest = (1 + SAME_LINE) * (x * x + y * y)
    return int(np.count_nonzero((across < SAME_LINE * along) & (along < longest)))


@jit
def _count_same(lines: Floats, x: float, y: float) -> int:
    """Return the number of lines that differ from the line (x, y) by less than SAME_LINE of it."""
    off = np.hypot(lines[:, 0] - x, lines[:, 1] - y)
    return int(np.count_nonzero(off < SAME_LINE * hypot(x, y)))


@jit
def _field(lines: Floats, xy: Floats, center: tuple[float, float], line: Line) -> Field:
    """Return the streak (dx, dy) at the center and the turn that most of the brightest blobs share.

    1. Take the common line without a turn, if no blob would be a track then.
    2. Otherwise search the field that agrees with most blobs (`_agreement`), among the fields through any two of them,
       each streak with both signs. It must agree with more blobs than the common line, with over 60 %, and with no
       fewer than there are pieces of a long line.

    Parameters
    ----------
    lines, xy
        (N, 2) lines L^2 (cos 2a, sin 2a) and positions of the blobs, brightest first
    line
        Common line
    """
    # 1. Common line
    count = min(len(lines), VOTING_BLOBS)
    tracks = 0
    dx, dy = _half_angle(line)
    best = dx, dy, 0.0
    for n in range(count):
        diff2 = hypot(lines[n, 0] - line[0], lines[n, 1] - line[1])
        tracks += diff2 > max(MIN_TRACK_PX**2, SAME_LINE * hypot(line[0], line[1]))
    if not tracks:
        return best
    # 2. Fields through two blobs
    best_score = max(int(_agreement(lines, xy, center, best)[0]), int(VOTES * count)) + 1.0
    if hypot(dx, dy) >= MIN_BROKEN_PX:
        best_score = max(best_score, float(_count_pieces(lines[:count], line[0], line[1])))
    for m in range(count):
        first = _half_angle((lines[m, 0], lines[m, 1]))
        for n in range(m + 1, count):
            x, y = _half_angle((lines[n, 0], lines[n, 1]))
            for second in ((x, y), (-x, -y)):
                field = _field_of_two(xy[m], first, xy[n], second, center)
                score, streaks = _agreement(lines, xy, center, field)
                if score > best_score and streaks >= SAME_TURNED:
                    best = field
                    best_score = score
    return best


@jit
def _field_of_two(
    start: Floats,
    first: Step,
    end: Floats,
    second: Step,
    center: tuple[float, float],
) -> Field:
    """Return the field (dx, dy, turn) of two streaks at two places by least squares.

    The turn w follows from their difference, w J (x2 - x1), and the streak t at the center from their mean.
    """
    x = end[0] - start[0]
    y = end[1] - start[1]
    turn = ((second[1] - first[1]) * x - (second[0] - first[0]) * y) / max(x * x + y * y, 1.0)
    mean_x = (start[0] + end[0]) / 2 - center[0]
    mean_y = (start[1] + end[1]) / 2 - center[1]
    return (
        (first[0] + second[0]) / 2 + turn * mean_y,
        (first[1] + second[1]) / 2 - turn * mean_x,
        turn,
    )


@jit
def _agreement(
    lines: Floats, xy: Floats, center: tuple[float, float], field: Field
) -> tuple[float, int]:
    """Return the score of a field, and how many of the blobs that agree with it are streaks.

    The score is the number of the brightest blobs that agree with the field's streaks. Its fraction, below 1, is larger
    for smaller differences.
    """
    score = 0.0
    streaks = 0
    count = min(len(lines), VOTING_BLOBS)
    for n in range(count):
        x, y = _line_at(field, xy[n, 0] - center[0], xy[n, 1] - center[1])
        square = hypot(x, y)
        off = hypot(lines[n, 0] - x, lines[n, 1] - y) / (
            SAME_LINE * square + MIN_STREAK_PX**2
        )
        if off < 1:
            score += 1 + (1 - off) / (count + 1)
            streaks += hypot(lines[n, 0], lines[n, 1]) > MIN_STREAK_PX**2
    return score, streaks


@jit
def _line_at(field: Field, x: float, y: float) -> Line:
    """Return the line L^2 (cos 2a, sin 2a) of a field's streak at (x, y) from the center."""
    return _double_angle(field[0] - field[2] * y, field[1] + field[2] * x)


@jit
def _double_angle(x: float, y: float) -> Line:
    """Return L^2 (cos 2a, sin 2a) of a streak (dx, dy)."""
    return x * x - y * y, 2 * x * y


@jit
def _half_angle(line: Line) -> Step:
    """Return the streak (dx, dy), up to its sign, of a line L^2 (cos 2a, sin 2a)."""
    length = sqrt(hypot(line[0], line[1]))
    angle = atan2(line[1], line[0]) / 2
    return length * cos(angle), length * sin(angle)


@jit
def _shapes(image: NDArray, boxes: Ints, level: Floats, noise: Floats) -> Floats:
    """Return the shape of each blob, (N, 5).

    The columns are the largest pixel above the sky, the sum of its four neighbors above the sky, the variance across
    the longer axis, and 12 (xx - yy, 2 xy) = L^2 (cos 2a, sin 2a). With the light I, xx = sum(I x^2) / sum(I) -
    (sum(I x) / sum(I))^2, and likewise yy and xy, over the pixels whose filtered value is above 3 sigma.
    """
    height, width = image.shape
    out = np.zeros((len(boxes), 5))
    for n in range(len(boxes)):
        x0, y0, x1, y1 = boxes[n]
        if (x1 - x0) * (y1 - y0) > LARGE * image.size:
            continue  # it is too large for a star or a streak
        total = x_sum = y_sum = xx = yy = xy = 0.0
        peak_light = -np.inf
        peak_x = x0
        peak_y = y0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                sky = interpolate(level, height, width, y, x)
                light = image[y, x] - sky
                if light > peak_light:
                    peak_light = light
                    peak_x = x
                    peak_y = y
                if light > 0 and filtered(image, y, x) - sky > 3 * interpolate(
                    noise, height, width, y, x
                ):
                    dx = x - x0
                    dy = y - y0
                    total += light
                    x_sum += light * dx
                    y_sum += light * dy
                    xx += light * dx * dx
                    yy += light * dy * dy
                    xy += light * dx * dy
        # Peak and its four neighbors
        sky = interpolate(level, height, width, peak_y, peak_x)
        out[n, 0] = peak_light
        for a, b in (
            (peak_x - 1, peak_y),
            (peak_x + 1, peak_y),
            (peak_x, peak_y - 1),
            (peak_x, peak_y + 1),
        ):
            out[n, 1] += (
                float(image[min(max(b, 0), height - 1), min(max(a, 0), width - 1)]) - sky
            )
        # Central moments
        if total > 0:
            xx = xx / total - (x_sum / total) ** 2
            yy = yy / total - (y_sum / total) ** 2
            xy = xy / total - x_sum * y_sum / total**2
            # The variance across is the smaller eigenvalue of the matrix of second moments.
            eigenvalue_gap = np.sqrt((xx - yy) ** 2 + 4 * xy * xy)
            out[n, 2] = (xx + yy - eigenvalue_gap) / 2
            out[n, 3] = 12 * (xx - yy)
            out[n, 4] = 24 * xy
    return out
