"""Frames of one exposure, reduced to two mean frames and to the mean and temporal variance of their pixels.

Frames are taken in pairs a, b. Half the variance of a - b is the temporal variance of a pixel, without its fixed
pattern and with an unbiased mean, as EMVA 1288 (release 4.0 Linear) measures it too. The mean of a - b over the frame
is subtracted, so that a flicker of the lamp does not count as noise. Means of the a and of the
b frames are kept apart: their noise is independent, so the covariance of anything computed from the two is that of the
fixed pattern alone, without a correction for noise.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.core.types import Floats

Mask = NDArray[np.bool_]
# interquartile ranges, and pixels from which these are taken
TRIM = 5.0
SAMPLES = 100_000


class Moments(NamedTuple):
    """Mean and temporal variance over the pixels of a level, in DN, with their standard errors."""

    mean_dn: float
    mean_sigma_dn: float
    variance_dn2: float
    variance_sigma_dn2: float


@dataclass(frozen=True, slots=True)
class Level:
    """Frames of one exposure time and temperature.

    count  : frames, an even number;  greatest_dn, least_dn : of all pixels
    first_dn, second_dn : (H, W) means of the first and of the second frames of the pairs
    variance_dn2 : (H, W) temporal variance of every pixel, from count / 2 pairs
    difference_dn2 : mean square of the difference of the frames of a pair, averaged over the frame
    """

    exposure_s: float
    temperature_c: float | None
    count: int
    first_dn: NDArray[np.float32]
    second_dn: NDArray[np.float32]
    variance_dn2: NDArray[np.float32]
    difference_dn2: float
    least_dn: int
    greatest_dn: int

    @property
    def mean_dn(self) -> Floats:
        """(H, W) mean of all frames."""
        return (self.first_dn.astype(np.float64) + self.second_dn) / 2

    def moments(self, used: Mask) -> Moments:
        """Mean and variance over the used pixels. Standard errors are empirical, from the scatter of the pixels'
        variances, since hot pixels have more noise."""
        variance = self.variance_dn2[used].astype(np.float64)
        mean = (
            self.first_dn[used].mean(dtype=np.float64) + self.second_dn[used].mean(dtype=np.float64)
        ) / 2
        return Moments(
            float(mean),
            float(np.sqrt(variance.mean() / self.count / variance.size)),
            float(variance.mean()),
            float(variance.std() / np.sqrt(variance.size)),
        )


class LevelBuilder:
    """Adds frames of one size to a level, one after the other, so that no more than one is in memory."""

    def __init__(self) -> None:
        self.frames = 0
        self.first: NDArray | None = None
        self.sums: list[NDArray[np.float32]] = []
        self.difference_dn2 = 0.0
        self.least_dn = np.iinfo(np.int64).max
        self.greatest_dn = 0

    def add(self, frame: NDArray) -> None:
        """Add a frame of digital numbers; every second one completes a pair."""
        self.frames += 1
        if self.first is None:
            self.first = frame
            return
        difference = self.first.astype(np.float32) - frame
        offset_dn = trimmed_mean(difference)
        difference -= np.float32(offset_dn)
        np.square(difference, out=difference)
        self.sums = self.sums or [np.zeros(frame.shape, np.float32) for _ in range(3)]
        for total, one in zip(self.sums, (self.first, frame, difference), strict=True):
            total += one
        self.least_dn = min(self.least_dn, int(self.first.min()), int(frame.min()))
        self.greatest_dn = max(self.greatest_dn, int(self.first.max()), int(frame.max()))
        self.difference_dn2 += offset_dn**2
        self.first = None

    def level(self, exposure_s: float, temperature_c: float | None) -> Level:
        """The level of the pairs so far, of which there must be one; an odd last frame is left out."""
        pairs = self.frames // 2
        first, second, squares = (
            total / np.float32(divisor)
            for total, divisor in zip(self.sums, (pairs, pairs, 2 * pairs), strict=True)
        )
        drift_dn2 = self.difference_dn2 / pairs
        return Level(
            *(exposure_s, temperature_c, 2 * pairs),
            *(first, second, squares),
            *(drift_dn2, self.least_dn, self.greatest_dn),
        )


def trimmed_mean(difference: NDArray[np.float32]) -> float:
    """Mean of the pixels within TRIM interquartile ranges of the median: without those that a particle hit."""
    low, middle, high = np.quantile(
        difference.ravel()[:: max(difference.size // SAMPLES, 1)], (0.25, 0.5, 0.75)
    )
    inside = np.abs(difference - np.float32(middle)) <= TRIM * (high - low) + 1
    return float(difference[inside].mean(dtype=np.float64))


def level(exposure_s: float, temperature_c: float | None, frames: Iterable[NDArray]) -> Level:
    """The level of some frames, two at least."""
    builder = LevelBuilder()
    for frame in frames:
        builder.add(frame)
    return builder.level(exposure_s, temperature_c)
