"""Frames that cannot be what they are taken for: darks with light, flats that are not flat, too few of either."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple
import numpy as np
from scipy import ndimage
from skysim.core.constants import MAD_PER_SIGMA
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.experiments.characterize.frame_files import (Setting, Stack, describe)
from skysim.experiments.characterize.photon_transfer import (Level, Mask)
from skysim.experiments.characterize.photon_transfer import FIT_RANGE



LEAST_LEVELS = (
    4  # of flats that are not saturated: three rates and a curvature, with one to test them
)
MEDIAN_SIGMAS = (
    0.5  # greatest difference of a dark's median from the others, in standard deviations of a pixel
)
MAX_ZEROS = 1e-3  # of a dark's pixels
BLOCK = 32  # pixels: side of the blocks whose medians show structure
MAX_DARK_RANGE = 2.0  # of the blocks' medians, in standard deviations of a pixel
MAX_FLAT_RANGE = 0.3  # of the light over the frame, relative to its mean
BRIGHT = 0.2  # signal over the brightest, from which on a flat must be flat
MAX_PAIR_CHANGE = 0.03  # of the light from frame to frame, relative
# of a bright pixel, of a spot, and spots beyond those by chance
SPOT_SIGMAS = 12.0
SPOT_PIXELS = 4
MAX_SPOTS = 3
POLYPLETS = 110  # figures of four squares that touch by sides or corners, fixed (OEIS A006770)


class Place(NamedTuple):
    """Where a frame is brightest and darkest, in words."""

    brightest: str
    darkest: str


def check_darks(darks: Stack) -> None:
    """Raise InputError unless these are darks of two exposures or more: equal medians, no structure, no stars."""
    for setting, medians in darks.medians.items():
        level = level_of(darks, setting)
        noise_dn = math.sqrt(float(np.median(level.variance_dn2)) + 1)
        middle = float(np.median([median for median, _ in medians]))
        worst, path = max(medians)
        if worst - middle > max(MEDIAN_SIGMAS * noise_dn, 1.0):
            raise InputError(
                path,
                f"not dark: median {worst:g} DN, the other frames of {describe(setting)} {middle:g} DN",
                "darks with the lens capped",
            )
    for level in darks.levels:
        check_dark(darks, level)
    times = {one.exposure_s for one in darks.levels}
    if len(times) < 2:
        only = times.pop()
        raise InputError(
            darks.folder,
            f"darks of {only:g} s only",
            f"two exposures or more: add 4 of the shortest and 4 of {max(10 * only, 10):g} s",
        )


def level_of(stack: Stack, setting: Setting) -> Level:
    """The level of a setting."""
    return next(
        one for one in stack.levels if Setting(one.exposure_s, one.temperature_c) == setting
    )


def check_dark(darks: Stack, level: Level) -> None:
    """Raise InputError for a level of darks that is cut off at 0, equal frame by frame, or has structure or stars."""
    folder = darks.folder
    which = f"the darks of {describe(Setting(level.exposure_s, level.temperature_c))}"
    mean = level.mean_dn
    noise_dn = math.sqrt(float(np.median(level.variance_dn2)))
    zeros = float(np.mean(mean < 1))
    if zeros > MAX_ZEROS:
        raise InputError(
            folder,
            f"{which} have {100 * zeros:.2g} % of the pixels at 0 DN",
            "a higher black level",
        )
    if not level.variance_dn2.any():
        raise InputError(
            folder, f"{which} are equal in every pixel", "frames of their own, no copies"
        )
    noise_dn = max(noise_dn, 0.3)
    medians = block_medians(mean)
    if (extent := float(np.ptp(medians))) > MAX_DARK_RANGE * noise_dn:
        place = extremes(medians)
        raise InputError(
            folder,
            f"{which} are not dark: {extent:.3g} DN brighter at the {place.brightest} than at the {place.darkest}",
            f"{MAX_DARK_RANGE * noise_dn:.2g} DN: cap the lens, cover the window",
        )
    # Hot pixels are single, but for those that touch by chance; images of stars cover several pixels. A track of a
    # particle is in one half of the frames.
    both = np.minimum(level.first_dn, level.second_dn)
    bright = both > np.median(mean) + SPOT_SIGMAS * max(
        spread(mean), noise_dn / math.sqrt(level.count)
    )
    labels, _ = ndimage.label(bright, np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())[1:]
    by_chance = POLYPLETS * bright.mean() ** SPOT_PIXELS * bright.size
    if (touching := int((sizes >= SPOT_PIXELS).sum())) > MAX_SPOTS + by_chance:
        y, x = ndimage.center_of_mass(bright, labels, int(np.argmax(sizes)) + 1)
        raise InputError(
            folder,
            f"{which} are not dark: {touching} spots of {SPOT_PIXELS} pixels or more, the largest at x {x:.0f},"
            f" y {y:.0f}",
            "darks with the lens capped",
        )


def check_flats(flats: Stack, usable: Mask, black_dn: float) -> None:
    """Raise InputError unless these are flats of LEAST_LEVELS levels or more below saturation, flat and steady."""
    signals = np.array([float(one.mean_dn[usable].mean()) - black_dn for one in flats.levels])
    times = np.array([one.exposure_s for one in flats.levels])
    top = signals.max()
    below = (signals < FIT_RANGE * top) & (signals > 0.01 * top)
    if signals.min() > 0.95 * top and times.max() > 1.2 * times.min():
        raise InputError(
            flats.folder,
            f"all saturated, at {top + black_dn:.0f} DN",
            f"{LEAST_LEVELS} levels or more below: exposures shorter than {times.min():.3g} s",
        )
    if below.sum() < LEAST_LEVELS:
        lacking = LEAST_LEVELS - int(below.sum())
        longest = float(times[signals >= top].min())
        raise InputError(
            flats.folder,
            f"{int(below.sum())} levels from 1 to {100 * FIT_RANGE:.0f} % of the brightest",
            f"{LEAST_LEVELS} or more: add pairs at {lacking} exposures from {0.05 * longest:.2g} to"
            f" {0.6 * longest:.2g} s",
        )
    for one, signal in zip(flats.levels, signals, strict=True):
        which = f"the flats of {describe(Setting(one.exposure_s, one.temperature_c))}"
        if not one.variance_dn2.any() and signal < 0.95 * top:
            raise InputError(
                flats.folder, f"{which} are equal in every pixel", "frames of their own, no copies"
            )
        change = math.sqrt(one.difference_dn2) / signal if signal > 0.02 * top else 0.0
        if change > MAX_PAIR_CHANGE:
            raise InputError(
                flats.folder,
                f"{which} differ by {100 * change:.2g} % from frame to frame",
                f"{100 * MAX_PAIR_CHANGE:g} %: a steady lamp, warmed up, on direct current",
            )
        if BRIGHT * top < signal < FIT_RANGE * top:
            check_flat(flats.folder, which, block_medians(one.mean_dn) - black_dn)


def check_flat(folder: Path, which: str, medians: Floats) -> None:
    """Raise InputError for a flat whose blocks' medians differ too much."""
    extent = float(np.ptp(medians) / medians.mean())
    if extent > MAX_FLAT_RANGE:
        place = extremes(medians)
        raise InputError(
            folder,
            f"{which} are not flat: {100 * extent:.0f} % brighter at the {place.brightest} than at the {place.darkest}",
            f"{100 * MAX_FLAT_RANGE:.0f} %: an integrating sphere or a diffuser, no lens",
        )


def spread(image: Floats) -> float:
    """Robust standard deviation of the pixels."""
    return float(np.median(np.abs(image - np.median(image)))) / MAD_PER_SIGMA


def block_medians(image: Floats) -> Floats:
    """Medians of square blocks, BLOCK pixels wide or smaller, so that there are nine at least."""
    side = max(min(BLOCK, *(size // 3 for size in image.shape)), 1)
    rows, columns = (size // side for size in image.shape)
    blocks = image[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return np.asarray(np.median(blocks, axis=(1, 3)))


def extremes(medians: Floats) -> Place:
    """Words for the places of the greatest and of the least block."""

    def word(index: int) -> str:
        row, column = np.unravel_index(index, medians.shape)
        vertical = ("top", "middle", "bottom")[int(3 * row / medians.shape[0])]
        horizontal = ("left", "center", "right")[int(3 * column / medians.shape[1])]
        return (
            "center"
            if (vertical, horizontal) == ("middle", "center")
            else f"{vertical} {horizontal}"
        )

    return Place(word(int(np.argmax(medians))), word(int(np.argmin(medians))))


