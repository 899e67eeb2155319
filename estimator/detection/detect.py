"""Blob detection: background, threshold, connected components and classification.

Each detector takes a frame and returns `Blobs`. `default` is a matched filter: the frame is correlated with an
approximation of the star's image (the 3x3 binomial filter, averaged along the streak for smeared stars) and compared
with a threshold in units of the filtered noise. The other detectors follow published trackers, for comparison.

Every detector has the parameters

- `image`: (H, W) array of any real type;
- `threshold_sigma`: threshold above the sky, in units of the noise;
- `min_area_px`: least number of pixels above the threshold;
- `max_blobs`: largest number of blobs that are returned;
- `priors`: prior information about the frame: streak, saturation;

and raises ImageError for an image that cannot be used (see `check_image`).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from estimator.core.checks import Floats, Ints, Ints32, Step, native, number, of_type
from estimator.core.errors import ImageError
from estimator.core.types import NO_PRIORS, Background, Blobs, FramePriors
from estimator.detection import classify
from estimator.detection.background import (
    FILTERED_NOISE,
    estimate_background,
    is_steep,
    median,
)
from estimator.detection.components import (
    accumulate_blobs,
    brightest_blobs,
    label_runs,
    runs_above,
)
from estimator.detection.shefex_detection import maximum_scan, sequential_scan

MAX_BLOBS = 20_000
GROW_SIGMA = 3.5  # lower threshold, down to which a blob extends
SPARE = 4  # blobs classified per blob returned, so that hot pixels and tracks do not replace stars
MIN_GROWN_PX = 8  # smallest area of a blob that is significant only as a whole
# With fewer stars than FEW_STARS, faint streaks of SEARCH_LENGTH_PX are searched in DIRECTIONS directions.
FEW_STARS = 8
DIRECTIONS = 8
SEARCH_LENGTH_PX = 10.0
# Shortest and longest streaks for which longer filters are tried: shorter ones come from a rotation about the field,
# and texture grows to any length.
SHORTEST_PX = 2.0
MAX_GROWN_PX = 64
# Length of the next filter over the last streak, and the growth of the streak that justifies it.
LONGER = 1.5
LENGTHENED = 1.15
# A blob this large is not a faint streak, and a line filter finds many in its noise
LARGE_PX = 150
# Longest streak that has a filter: a longer one spreads the star too thinly
MAX_STREAK_PX = 1024
# Largest difference of the streaks at the corners, from a roll, for which one filter serves all of them.
MAX_TURN_PX = 4.0
# Least area of a streak: noise averaged along a line is correlated, so that several pixels exceed the threshold.
MIN_STREAK_AREA_PX = 5
THESIS_AREA_PX = 50

Detector = Callable[..., Blobs]  # (image, threshold_sigma, min_area_px, max_blobs, priors)


def default(
    image: NDArray,
    threshold_sigma: float = 5.0,
    min_area_px: int = 3,
    max_blobs: int = 200,
    priors: FramePriors = NO_PRIORS,
) -> Blobs:
    """Detect round and smeared stars above the local sky by matched filters, with two thresholds (hysteresis).

    Round stars: the binomial filter [1 2 1] x [1 2 1] / 16 is close to the matched filter of sigma 0.7 px. A blob is a
    set of connected pixels above 3.5 sigma. It is accepted if `min_area_px` of them are above `threshold_sigma`, or if
    its total flux is significant by one sigma more than that. The low threshold prevents that noise breaks a faint
    streak into pieces.

    Smeared stars: the filtered image is averaged along the streak (dx, dy), which improves the signal-to-noise ratio by
    the square root of its length.

    1. If the priors have the streak (from the gyro), detect with the filter along it.
    2. Otherwise detect with the round filter. If the brightest blobs share a streak, detect again with the filter
       along it. Streaks longer than MAX_STREAK_PX keep the round filter.
    3. If few stars were found, search for faint streaks in several directions (`detect_faint_streaks`).
    4. Lengthen the filter as long as the streak grows (`in_full_length`).
    5. Return the brightest blobs that may be stars, and of the others (`classify`) as many as there is room for.
    """
    image = prepare_image(image, threshold_sigma, min_area_px, max_blobs)
    of_type("priors", priors, FramePriors)
    blobs = _classified(image, threshold_sigma, min_area_px, SPARE * max_blobs, priors)
    if len(blobs) <= max_blobs:
        return blobs
    # The brightest that may be stars, and as many others as there is room for
    star = blobs.flag & classify.NO_STAR & priors.reject == 0
    kept = star & (np.cumsum(star) <= max_blobs)
    room = max_blobs - np.count_nonzero(kept)
    return blobs.take(kept | (~star & (np.cumsum(~star) <= room)))


def _classified(
    image: NDArray,
    threshold_sigma: float,
    min_area_px: int,
    max_blobs: int,
    priors: FramePriors,
) -> Blobs:
    """Return the brightest blobs with their flags: steps 1 to 4 of `default`."""
    background = estimate_background(image)
    # A roll that makes the streaks differ by more at the corners leaves no filter that fits them all.
    largest_turn_rad = MAX_TURN_PX / np.hypot(*image.shape) * 2
    known = priors.streak_px is not None and abs(priors.turn_rad) <= largest_turn_rad
    # 1. Known streak
    if known and 2 <= max(map(abs, priors.streak_px or ())) <= MAX_STREAK_PX:
        return _classified_streaks(image, background, threshold_sigma, max_blobs, priors)
    # 2. Round filter
    above = threshold_sigma * background.noise
    blobs = detect_blobs(image, background, above, min_area_px, max_blobs, GROW_SIGMA)
    blobs = classify.classify(image, blobs, priors)
    if blobs.streak_px is None:
        # 3. Round stars or too few. With very few stars, the others may be streaks too faint for the round filter.
        stars = int(np.count_nonzero(blobs.flag & classify.NO_STAR & priors.reject == 0))
        large = np.any(blobs.area_px >= LARGE_PX)
        if priors.streak_px is not None or stars >= FEW_STARS or large:
            return blobs
        if is_steep(*background):
            return blobs
        faint = detect_faint_streaks(image, background, threshold_sigma, max_blobs, priors)
        if len(faint) <= stars + 1:
            return blobs
        streaks = classify.classify(image, faint, priors)
    else:
        longest_px = max(map(abs, blobs.streak_px))
        if abs(blobs.turn_rad) > largest_turn_rad or longest_px > MAX_STREAK_PX:
            return blobs
        # The bright blobs have revealed the streak: detect again with the filter along it.
        along = replace(priors, streak_px=blobs.streak_px, turn_rad=blobs.turn_rad)
        streaks = _classified_streaks(image, background, threshold_sigma, max_blobs, along)
    # 4. Longer filters
    return in_full_length(image, streaks, threshold_sigma, max_blobs, priors)


def _classified_streaks(
    image: NDArray,
    background: Background,
    threshold_sigma: float,
    max_blobs: int,
    along: FramePriors,
) -> Blobs:
    """Return the blobs with their flags, detected with the filter along a streak."""
    streaks = detect_streaks(image, background, threshold_sigma, max_blobs, along)
    return classify.classify(image, streaks, along)


def flat_background(image: NDArray) -> Background:
    """Return one level and noise for the whole frame: the medians over the tiles."""
    grids = estimate_background(image)
    return Background(*(np.full((1, 1), median(grid)) for grid in grids))


def _local(
    background: Callable[[NDArray], Background],
    image: NDArray,
    threshold_sigma: float = 5.0,
    min_area_px: int = 3,
    max_blobs: int = 200,
    priors: FramePriors = NO_PRIORS,
) -> Blobs:
    """Detect blobs `threshold_sigma` above the local sky, or one for the frame, after a 3x3 binomial filter."""
    image = prepare_image(image, threshold_sigma, min_area_px, max_blobs)
    sky = background(image)
    return detect_blobs(image, sky, threshold_sigma * sky.noise, min_area_px, max_blobs)


local = partial(_local, estimate_background)
"""Detect blobs `threshold_sigma` above the local sky after a 3x3 binomial filter."""

components = partial(_local, flat_background)
"""Detect blobs above a global threshold: the frame's median sky plus `threshold_sigma` times its noise."""


def thesis(
    image: NDArray,
    threshold_sigma: float = 5.0,
    min_area_px: int = 3,
    max_blobs: int = 200,
    priors: FramePriors = NO_PRIORS,
) -> Blobs:
    """Detect blobs of at least 50 pixels above a share of full scale (Padro 2012, sections 3.4.1.3 and 3.7).

    The share is the priors' intensity_threshold: 4 % in the thesis's tests, 2 to 25 % in its preliminary ones. Full
    scale is the saturation in the priors, otherwise the maximum of the integer type. `threshold_sigma` and
    `min_area_px` are ignored.

    Raises
    ------
    ImageError
        For an image that cannot be used, for floats of unknown scale, and for a dark frame above the threshold.
    """
    check_pixel_type(image)
    pixel = image.dtype
    image = prepare_image(image, threshold_sigma, min_area_px, max_blobs)
    of_type("priors", priors, FramePriors)
    full_scale = priors.saturation
    if not np.isfinite(full_scale):
        if pixel.kind != "u":
            raise ImageError(
                f"pixels of type {pixel} have no full scale; allowed: unsigned integers, or a known saturation"
            )
        full_scale = float(np.iinfo(pixel).max)
    flat = flat_background(image)
    threshold = priors.intensity_threshold * full_scale
    if flat.level[0, 0] >= threshold:
        raise ImageError(
            f"the black level of {flat.level[0, 0]:.0f} is above the threshold of"
            f" {100 * priors.intensity_threshold:g} % of {full_scale:.0f}, that is {threshold:.0f}: lower the camera's"
            " offset or the background, or set another detector"
        )
    # The thesis thresholds raw pixels. We threshold the filtered image, whose contour around a plateau of 50 pixels is
    # within a pixel of the raw one.
    return detect_blobs(image, flat, threshold - flat.level, THESIS_AREA_PX, max_blobs)


def _scan(
    scan: Callable[..., tuple[Ints, Floats]],
    image: NDArray,
    threshold_sigma: float = 5.0,
    min_area_px: int = 3,
    max_blobs: int = 200,
    priors: FramePriors = NO_PRIORS,
) -> Blobs:
    """Run one of SHEFEX's scans and convert its table to Blobs."""
    image = prepare_image(image, threshold_sigma, min_area_px, max_blobs)
    # One level for the frame, and the noise of a raw pixel
    flat = flat_background(image)
    level = float(flat.level[0, 0])
    noise = float(flat.noise[0, 0]) / FILTERED_NOISE
    boxes, sums = scan(image, level, level + threshold_sigma * noise, min_area_px, max_blobs)
    return to_blobs(boxes, sums, 0, max_blobs, flat)


sequential = partial(_scan, sequential_scan)
"""Detect by SHEFEX-2's sequential scan: one pass over the frame that inserts each object into a sorted table.

The table holds the `max_blobs` brightest objects so far. An object is a set of eight-connected pixels above a global
threshold, sky + `threshold_sigma` times a raw pixel's noise (reference: the SHEFEX-2 paper, fig. 3 right).
"""

maximum = partial(_scan, maximum_scan)
"""Detect by SHEFEX-2's alternative scan: search the whole frame for its largest pixel, once per object.

The source is the SHEFEX-2 paper, fig. 3 left.
"""

DETECTORS: dict[str, Detector] = {
    "default": default,
    "local": local,
    "components": components,
    "threshold": components,
    "sequential": sequential,
    "maximum": maximum,
    "thesis": thesis,
}


def prepare_image(
    image: NDArray, threshold_sigma: float = 5.0, min_area_px: int = 3, max_blobs: int = 200
) -> NDArray:
    """Check a detector's image and parameters, and convert the image to a type that compiled code accepts."""
    number("detector: threshold_sigma", threshold_sigma, 1e-9, 1e9, "finite, above 0")
    number("detector: min_area_px", min_area_px, 1, 1e9, "whole, 1 or more", True)
    number("detector: max_blobs", max_blobs, 1, 1e9, "whole, 1 or more", True)
    check_image(image)
    return to_native(image)


def check_image(image: NDArray) -> None:
    """Raise ImageError unless the image is a finite, non-constant (H, W) array of real numbers."""
    check_monochrome(image)
    check_size(image)
    # A sample of the pixels is quicker than all of them.
    some = image[::97, ::89]
    if image.dtype.kind != "f" and some.min() != some.max():
        return  # integers are finite, and the sample shows that the image is not constant
    low = image.min()
    high = image.max()
    if not (np.isfinite(low) and np.isfinite(high)):
        raise ImageError("the image holds NaN or infinite pixels; allowed: finite values")
    if low == high:
        raise ImageError(f"the frame is empty: every pixel is {low}")


def check_pixel_type(image: object) -> None:
    """Raise ImageError unless the image is an array of real numbers."""
    if not isinstance(image, np.ndarray):
        raise ImageError(
            f"the image is a {type(image).__name__}; allowed: a numpy array, (height, width)"
        )
    if image.dtype.kind not in "buif":
        raise ImageError(
            f"pixels of type {image.dtype} are not real numbers; allowed: integers and floats"
        )


def check_monochrome(image: NDArray) -> None:
    """Raise ImageError unless the image is an (H, W) array of real numbers."""
    check_pixel_type(image)
    if image.ndim != 2:
        raise ImageError(
            f"an image of shape {image.shape}; allowed: monochrome, (height, width)"
        )


def to_native(image: NDArray) -> NDArray:
    """Convert the image, without loss, to one of the three types for which the loops are compiled.

    uint16 stays as it is; uint8 and masks become uint16, other integers int32 if their values fit, all else float64.
    For each further type, order of the axes or byte order the loops would be compiled again, for half a minute; FITS
    files, for example, are big-endian.
    """
    kind = image.dtype.kind
    size = image.itemsize
    if kind in "bu" and size <= 2:
        return native("the image", image, np.uint16)
    limits = np.iinfo(np.int32)
    fits_int32 = kind == "i" and size <= 4
    if kind in "iu" and not fits_int32:
        fits_int32 = bool(limits.min <= image.min() and image.max() <= limits.max)
    return native("the image", image, np.int32 if fits_int32 else np.float64)


def in_row_order(image: NDArray) -> NDArray:
    """Return the image as compiled loops need it: rows in order, native bytes, its own type; a copy only if needed.

    The caller converts a frame once, before the stages that would each do it again.

    Raises
    ------
    ImageError
        For an array that holds no real numbers.
    """
    check_pixel_type(image)
    return native("the image", image, image.dtype.newbyteorder("="))


def check_size(image: NDArray) -> None:
    """Raise ImageError for an image too small to hold a star field."""
    if min(image.shape) < 16:
        raise ImageError(
            f"{image.shape[1]}x{image.shape[0]} pixels are too few; allowed: 16x16 and more"
        )


def replace_bad_pixels(image: NDArray, bad_px: Ints) -> NDArray:
    """Return a copy of the image with each bad pixel, (K, 2) x and y, replaced by the median of its good neighbors.

    The map comes from dark frames taken on the ground. The neighbors are those within one pixel, otherwise within two;
    without any good one the pixel gets the frame's median.

    Raises
    ------
    ImageError
        For a map that reaches beyond the frame.
    """
    repaired = image.copy()
    height, width = image.shape
    x, y = np.asarray(bad_px).reshape(-1, 2).T
    if len(x) and not (
        x.min() >= 0 and x.max() < width and y.min() >= 0 and y.max() < height
    ):
        raise ImageError(
            f"the bad-pixel map reaches beyond the frame of {width}x{height} pixels"
        )
    bad = np.zeros(image.shape, bool)
    bad[y, x] = True
    # A wider neighborhood only if the near one has no good pixel
    for column, row in zip(x.tolist(), y.tolist(), strict=True):
        for reach in (1, 2):
            near = np.s_[
                max(row - reach, 0) : row + reach + 1,
                max(column - reach, 0) : column + reach + 1,
            ]
            good = image[near][~bad[near]]
            if len(good):
                break
        repaired[row, column] = np.median(good if len(good) else image[::8, ::8])
    return repaired


def detect_blobs(
    image: NDArray,
    background: Background,
    above: Floats,
    min_area_px: int,
    max_blobs: int,
    grow_sigma: float | None = None,
) -> Blobs:
    """Detect blobs more than `above` (on the background's grid) over the level, and return the brightest.

    With `grow_sigma` a blob extends down to that many sigma. It is accepted if `min_area_px` of its pixels exceed
    `above`, or if its flux is significant: flux / (pixel noise sqrt(area)) is at least one more than the threshold in
    sigma.
    """
    # Connected pixels above the lower threshold; pixels above the higher one are counted.
    strong_level = background.level + above
    grow_level = strong_level
    if grow_sigma is not None:
        grow_level = background.level + np.minimum(above, grow_sigma * background.noise)
    runs = runs_above(image, grow_level)
    boxes, sums = accumulate_blobs(
        image, background.level, strong_level, runs, *label_runs(runs)
    )
    if grow_sigma is None:
        return to_blobs(boxes, sums, min_area_px, max_blobs, background)
    # The threshold plus one sigma, in units of the image for one raw pixel
    min_flux = (median(above) + median(background.noise)) / FILTERED_NOISE
    grown_px = max(min_area_px, MIN_GROWN_PX)
    return to_blobs(boxes, sums, min_area_px, max_blobs, background, grown_px, min_flux)


def detect_streaks(
    image: NDArray,
    background: Background,
    threshold_sigma: float,
    max_blobs: int,
    priors: FramePriors,
) -> Blobs:
    """Detect streaks of the priors' (dx, dy) in the filtered image, averaged along the streak.

    The noise of the average is computed for white noise passed through both filters. The response to a streak is
    symmetric about the streak's center and twice as long as the streak, so the box is set around the center with the
    size of the streak.
    """
    assert priors.streak_px is not None
    # Threshold in units of the noise after both filters
    taps = line_taps(priors.streak_px)
    above = threshold_sigma * noise_factor(taps) / FILTERED_NOISE * background.noise
    limit = background.level + above
    runs = runs_above(image, limit, taps)
    boxes, sums = accumulate_blobs(image, background.level, limit, runs, *label_runs(runs))
    blobs = to_blobs(
        boxes, sums, MIN_STREAK_AREA_PX, max_blobs, background, MIN_STREAK_AREA_PX, 0.0
    )
    # Boxes of the streak's size
    half = np.abs(priors.streak_px) / 2 + 1
    edge = np.array(image.shape[::-1]) - 1
    low = np.clip(blobs.xy_px - half, 0, edge)
    high = np.clip(blobs.xy_px + half, 0, edge)
    blobs.box_px[:] = np.rint(np.concatenate([low, high], axis=1))
    return blobs


def detect_faint_streaks(
    image: NDArray,
    background: Background,
    threshold_sigma: float,
    max_blobs: int,
    priors: FramePriors,
) -> Blobs:
    """Search for streaks without a prior: return the blobs of that line filter, out of DIRECTIONS, that finds most.

    Taking the best of several directions increases the number of false detections; the threshold is therefore raised
    by half a sigma.
    """
    candidates = []
    for angle in np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        x = SEARCH_LENGTH_PX * float(np.cos(angle))
        y = SEARCH_LENGTH_PX * float(np.sin(angle))
        along = FramePriors((x, y), priors.saturation)
        found = detect_streaks(image, background, threshold_sigma + 0.5, max_blobs, along)
        candidates.append(found)
    return max(candidates, key=len)


def in_full_length(
    image: NDArray, found: Blobs, threshold_sigma: float, max_blobs: int, priors: FramePriors
) -> Blobs:
    """Return the streaks detected with longer and longer filters, as long as the streak that they share grows.

    Noise breaks a long faint streak into pieces with centers anywhere along it, so that a frame's first streak is too
    short; pieces of streaks that the border cuts off do not touch it. A longer filter finds longer pieces.

    1. Detect with a filter LONGER times the last streak.
    2. Classify the blobs without a prior, which gives a new streak; stop unless that is LENGTHENED.
    3. Detect with the filter of the last streak, since a longer one joins neighbors.
    """
    first = found
    while found.streak_px is not None:
        # 1. Longer filter
        length_px = np.hypot(*found.streak_px)
        x, y = LONGER * np.array(found.streak_px)
        if length_px < SHORTEST_PX or max(abs(x), abs(y)) > MAX_GROWN_PX:
            break
        longer = replace(priors, streak_px=(float(x), float(y)), turn_rad=found.turn_rad)
        again = detect_streaks(image, found.background, threshold_sigma, max_blobs, longer)
        # 2. New streak
        again = classify.classify(image, again, priors)
        if again.streak_px is None or np.hypot(*again.streak_px) <= LENGTHENED * length_px:
            break
        found = again
    if found is first:
        return found
    # 3. Last detection
    along = replace(priors, streak_px=found.streak_px, turn_rad=found.turn_rad)
    return _classified_streaks(image, found.background, threshold_sigma, max_blobs, along)


def line_taps(streak_px: Step) -> Ints:
    """Return the (K, 2) pixel offsets of a line centered on 0, one per pixel along its longer axis."""
    count = max(round(max(map(abs, streak_px))), 1) | 1
    along = (np.arange(count) - count // 2) / count
    return np.rint(along[:, None] * np.array(streak_px)).astype(np.int64)


def noise_factor(taps: Ints) -> float:
    """Return the factor by which the binomial filter and the mean over the taps reduce the deviation of white noise.

    It is the root of the sum of squares of the combined kernel.
    """
    reach = int(np.abs(taps).max()) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    np.add.at(kernel, tuple((taps + reach).T), 1 / len(taps))
    for axis in (0, 1):
        kernel = kernel / 2 + (np.roll(kernel, 1, axis) + np.roll(kernel, -1, axis)) / 4
    return float(np.sqrt(np.sum(kernel**2)))


def to_blobs(
    boxes: Ints | Ints32,
    sums: Floats,
    min_area_px: int,
    max_blobs: int,
    background: Background,
    min_total_px: int = 0,
    min_flux_per_root_px: float = np.inf,
) -> Blobs:
    """Return the brightest accepted blobs (see `brightest_blobs`) as Blobs, without flags.

    Raises
    ------
    ImageError
        For more than MAX_BLOBS accepted blobs.
    """
    box, xy, flux, peak, area, count = brightest_blobs(
        boxes, sums, min_area_px, min_total_px, min_flux_per_root_px, max_blobs
    )
    if count > MAX_BLOBS:
        raise ImageError(
            f"over {MAX_BLOBS} blobs: the frame is noise or texture, not a star field"
        )
    highest_px = int((box[:, 3] - box[:, 1]).max(initial=0))
    flag = np.zeros(len(flux), np.int64)
    return Blobs(box, xy, flux, peak, area, background, flag, highest_px=highest_px)
