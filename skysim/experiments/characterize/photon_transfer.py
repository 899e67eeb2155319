"""The photon transfer fit: gain, read noise, nonlinearity, black level, and rates of light and dark current.

Light of a steady lamp and dark current give a pixel, in the time t, N = (R + D) t electrons on average, with the
variance N. With the conversion K (DN per electron) its mean signal is x = K N; an amplifier whose gain falls with the
signal changes it to x (1 - c x). A level's mean and its temporal variance over the pixels are then

    mean = o + x - c x^2,    variance = (1 - 2 c x)^2 (K x + r^2) + 1/12,

with the black level o, the read noise r in DN, and 1/12 DN^2 of the converter's rounding (Janesick 2007, Photon
Transfer, ch. 5; EMVA 1288, release 4.0 Linear, has the law without c). Darks (R = 0) and flats follow one law and
are fitted at once by weighted least squares, with a rate D for each temperature. Differences between the means of two
frames that their noise does not explain are the lamp's flicker. The light of a flat's level has an unknown relative
error, fitted with the flicker, or the greater scatter of the levels about the law, as its prior: a lamp may drift from
level to level and be steady within a pair.

Only levels up to FIT_RANGE of the saturation are fitted, as EMVA 1288 does for the photon transfer curve. In a
saturated level the variance collapses: it grows up to the turnover and falls to the read noise beyond it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import special
from scipy.optimize import brentq, least_squares

from skysim.core.constants import MAD_PER_SIGMA
from skysim.core.types import Array, Bools, Floats, Ints, Singles, median
from skysim.results.metrics import SIGMAS, TAILS

# A measured number with its interval.


STEP = 1e-4  # step of the numerical derivatives, in standard deviations


class Estimate(NamedTuple):
    """A value, its standard error, and its 95 % interval."""

    value: float
    sigma: float
    low: float
    high: float

    @classmethod
    def normal(cls, value: float, sigma: float) -> Estimate:
        """A normal estimate: value ± 1.96 sigma."""
        half = SIGMAS * sigma
        return cls(*map(float, (value, sigma, value - half, value + half)))

    @classmethod
    def lognormal(cls, value: float, sigma: float) -> Estimate:
        """An estimate of a positive number whose logarithm is normal, such as a standard deviation."""
        factor = math.exp(min(SIGMAS * sigma / value, 50.0)) if value > 0 else 1.0
        return cls(*map(float, (value, sigma, value / factor, value * factor)))

    @classmethod
    def logistic(cls, logit: float, sigma: float) -> Estimate:
        """An estimate of a fraction whose logit is normal."""
        low, value, high = (
            float(special.expit(logit + sign * SIGMAS * sigma)) for sign in (-1, 0, 1)
        )
        return cls(value, value * (1 - value) * float(sigma), low, high)

    @classmethod
    def root(cls, variance: float, sigma: float) -> Estimate:
        """The square root of a variance with its standard error; the interval begins at 0 if the variance does."""
        value = math.sqrt(max(variance, 0.0))
        low, high = (
            math.sqrt(max(variance + sign * SIGMAS * sigma, 0.0)) for sign in (-1, 1)
        )
        error = float(sigma) / (2 * value) if value else high / SIGMAS
        return cls(value, error, low, high)


DIGITS = 5  # significant digits of an interval, or so many that its width has two


def interval_digits(low: float, high: float) -> int:
    """Significant digits with which the ends of an interval show its width."""
    if not high > low:
        return DIGITS
    size, width = (
        math.floor(math.log10(one)) for one in (max(abs(low), abs(high)), high - low)
    )
    return max(DIGITS, size - width + 2)


def interval_text(low: float, high: float) -> str:
    """An interval in words."""
    digits = interval_digits(low, high)
    return f"{low:.{digits}g} to {high:.{digits}g}"


def slopes(function: Callable[[Floats], Any], at: Floats, step: Floats) -> Floats:
    """(K, ...) derivatives by K parameters, by central differences; 0 for a parameter without a step."""
    rises = [function(at + one) - function(at - one) for one in np.diag(step)]
    return np.array([rise / (2 * one or 1.0) for rise, one in zip(rises, step, strict=True)])


def propagate(
    function: Callable[[Floats], float], at: Floats, covariance: Floats
) -> Estimate:
    """The normal estimate of a function of parameters, by central differences."""
    slope = slopes(function, at, STEP * np.sqrt(np.diag(covariance)))
    sigma = math.sqrt(max(float(slope @ covariance @ slope), 0.0))
    return Estimate.normal(function(at), sigma)


def median_and_spread(values: Floats) -> tuple[float, float]:
    """Median and robust standard deviation."""
    middle = median(values)
    return middle, median(np.abs(values - middle)) / MAD_PER_SIGMA


def blocks(image: Array, side: int) -> Array:
    """(rows, side, columns, side) square blocks of an image; incomplete ones at the right and below are cut off."""
    rows, columns = (size // side for size in image.shape)
    return image[: rows * side, : columns * side].reshape(rows, side, columns, side)


# Frames of one exposure, reduced to two mean frames and the temporal variance of every pixel.


TRIM = 5.0  # interquartile ranges from the median within which pixels are averaged
SAMPLES = 100_000  # number of pixels from which the quartiles are computed


class TransferPoints(NamedTuple):
    """L levels as input of the fit, (L,) each: mean and temporal variance over the pixels with their standard errors.

    Attributes
    ----------
    lit
        1 for a flat, 0 for a dark
    dark
        Index of the temperature of its dark current
    difference_dn2
        Mean square of the difference of the frames of a pair, averaged over the frame
    """

    exposure_s: Floats
    lit: Ints
    dark: Ints
    mean_dn: Floats
    mean_sigma_dn: Floats
    variance_dn2: Floats
    variance_sigma_dn2: Floats
    difference_dn2: Floats


@dataclass(eq=False)
class Level:
    """Frames of one exposure time and temperature, added one after the other: no more than one of them is in memory.

    Attributes
    ----------
    medians
        Median of each frame, and its file
    pairs
        Number of complete pairs
    greatest_dn
        Greatest number of all pixels
    first
        A frame that waits for the second one of its pair
    sums
        (3, H, W) sums over the pairs: first frames, second frames, squares of their differences
    square_dn2
        Sum over the pairs of the square of the difference, averaged over the frame
    """

    exposure_s: float
    temperature_c: float | None
    medians: list[tuple[float, Path]] = field(default_factory=list)
    pairs: int = 0
    greatest_dn: int = 0
    first: Array | None = None
    sums: Any = 0
    square_dn2: float = 0.0

    def add(self, frame: Array) -> None:
        """Add a frame of digital numbers; every second one completes a pair, and an odd last one is left out."""
        if self.first is None:
            self.first = frame
            return
        difference = self.first.astype(np.float32) - frame
        offset_dn = trimmed_mean(difference)
        difference -= np.float32(offset_dn)
        pair = np.stack([self.first, frame, np.square(difference)])
        self.sums += pair
        self.greatest_dn = max(self.greatest_dn, int(pair[:2].max()))
        self.square_dn2 += offset_dn**2
        self.pairs += 1
        self.first = None

    @property
    def count(self) -> int:
        """Number of frames, even."""
        return 2 * self.pairs

    @property
    def halves_dn(self) -> Singles:
        """(2, H, W) means of the first and of the second frames of the pairs."""
        return self.sums[:2] / np.float32(self.pairs)

    @property
    def mean_dn(self) -> Floats:
        """(H, W) mean of all frames."""
        return self.halves_dn.mean(axis=0, dtype=np.float64)

    @property
    def variance_dn2(self) -> Singles:
        """(H, W) temporal variance of every pixel."""
        return self.sums[2] / np.float32(self.count)

    def point(self, used: Bools, lit: int = 0, dark: int = 0) -> TransferPoints:
        """The level as one point, by its used pixels.

        Standard errors are empirical, from the scatter of the pixels' variances, since hot pixels have more noise.
        """
        variance = self.variance_dn2[used].astype(np.float64)
        values = (
            self.exposure_s,
            lit,
            dark,
            self.halves_dn[:, used].mean(dtype=np.float64),
            math.sqrt(variance.mean() / self.count / variance.size),
            variance.mean(),
            variance.std() / np.sqrt(variance.size),
            self.square_dn2 / self.pairs,
        )
        return TransferPoints(*np.atleast_1d(*values))


def trimmed_mean(difference: Singles) -> float:
    """Mean of the pixels within TRIM interquartile ranges of the median, which excludes those that a particle hit."""
    low, middle, high = np.quantile(
        difference.ravel()[:: max(difference.size // SAMPLES, 1)], (0.25, 0.5, 0.75)
    )
    inside = np.abs(difference - np.float32(middle)) <= TRIM * (high - low) + 1
    return float(difference[inside].mean(dtype=np.float64))


ROUNDING_DN2 = 1 / 12  # variance of a rounding error, uniform over one number
FIT_RANGE = 0.7
SIGNIFICANT = 2.0  # standard errors above which flicker and drift are significant
LEAST_DRIFT = 1e-7
COLLAPSED = 0.5  # a level beyond the turnover is saturated if its variance is below this fraction of the greatest
GAIN, CURVATURE, READ, BLACK, LIGHT, FIRST_DARK = range(6)  # places of the parameters


def exposures_s(levels: Sequence[Level]) -> Floats:
    """(L,) exposure times."""
    return np.array([one.exposure_s for one in levels])


class Transfer(NamedTuple):
    """The fit.

    Attributes
    ----------
    values
        K in DN/e-, c in 1/DN, r^2 in DN^2, o in DN, K R in DN/s, and K D in DN/s for each
        temperature
    covariance
        Covariance of the values
    flicker
        Relative standard deviation of the light from frame to frame
    misfit
        Chi-square over its degrees of freedom
    points
        The levels that were fitted
    drift
        Relative standard deviation of the light from level to level if it exceeds that of the flicker, else 0
    """

    values: Floats
    covariance: Floats
    flicker: float
    misfit: float
    points: TransferPoints
    drift: float = 0.0

    @property
    def gain_e_dn(self) -> Estimate:
        return propagate(lambda p: 1 / p[GAIN], self.values, self.covariance)

    @property
    def read_noise_e(self) -> Estimate:
        """Read noise of the sensor alone, without rounding."""
        found = propagate(lambda p: p[READ] / p[GAIN] ** 2, self.values, self.covariance)
        return Estimate.root(found.value, found.sigma)

    @property
    def offset_dn(self) -> Estimate:
        return Estimate.normal(self.values[BLACK], math.sqrt(self.covariance[BLACK, BLACK]))

    def linear_dn(self, signal_dn: Floats) -> Floats:
        """The signal x that a linear amplifier would give, from the measured x (1 - c x)."""
        return linear_dn(signal_dn, float(self.values[CURVATURE]))


def linear_dn(signal_dn: Floats, curvature: float) -> Floats:
    """The lower root x of s = x - c x^2, in a form that is exact for c = 0; the top of the parabola beyond it."""
    root = np.sqrt(np.maximum(1 - 4 * curvature * signal_dn, 0.0))
    return 2 * signal_dn / (1 + root)


def model(
    points: TransferPoints, values: Floats, light: Floats | float = 1.0
) -> tuple[Floats, Floats]:
    """Means and variances of the levels. `light`: that of each level, relative to the lamp's mean."""
    rate = points.lit * light * values[LIGHT] + values[FIRST_DARK + points.dark]
    x = rate * points.exposure_s
    slope = 1 - 2 * values[CURVATURE] * rate * points.exposure_s
    mean = values[BLACK] + x - values[CURVATURE] * x**2
    return mean, slope**2 * (values[GAIN] * x + values[READ]) + ROUNDING_DN2


def fit(points: TransferPoints, flicker: float) -> Transfer:
    """Fit levels of darks and flats with the relative flicker of the lamp from `lamp_flicker`.

    If the flats' means scatter about the law by more than noise and flicker, by SIGNIFICANT sigmas of chi-square, the
    drift is such that chi-square is the expected one, times the square of the ratio of the normal to Student's 95 %
    limit: a drift from few levels is uncertain, and the intervals are normal.
    """
    # Flicker of the mean of a pair, the fewest frames of a level.
    steady = flicker / math.sqrt(2)
    found, excess = fit_levels(points, flicker, steady)
    # The lamp's rate and the curvature are fitted.
    freedom = int(points.lit.sum()) - 2
    if excess <= freedom + SIGNIFICANT * math.sqrt(2 * freedom):
        return found

    def too_small(log: float) -> float:
        return fit_levels(points, flicker, math.exp(log))[1] - expected

    expected = freedom * (SIGMAS / special.stdtrit(freedom, TAILS[1])) ** 2
    least = math.log(max(steady, LEAST_DRIFT))
    if too_small(least) <= 0 or too_small(0.0) >= 0:
        return found
    drift = math.exp(brentq(too_small, least, 0.0, xtol=0.01))
    return fit_levels(points, flicker, drift)[0]._replace(drift=drift)


def fit_levels(
    points: TransferPoints, flicker: float, scatter: float
) -> tuple[Transfer, float]:
    """The fit with a relative standard deviation of the light of the levels, and chi-square of the flats' means."""
    mean = points.mean_dn
    lit = points.lit > 0
    start = start_values(points)
    size = len(start)

    def residuals(values: Floats) -> Floats:
        light = np.ones(len(mean))
        light[lit] += scatter * values[size:]
        expected_mean, expected_variance = model(points, values[:size], light)
        return np.concatenate(
            [
                values[size:],
                (mean - expected_mean) / points.mean_sigma_dn,
                (points.variance_dn2 - expected_variance) / points.variance_sigma_dn2,
            ]
        )

    scale = np.maximum(np.abs(start), 1e-9)
    scale[CURVATURE] = 0.01 / max(np.ptp(mean), 1.0)
    # The errors of the light are in units of their prior's standard deviation.
    levels = np.count_nonzero(lit)
    scale = np.append(scale, np.ones(levels))
    start = np.append(start, np.zeros(levels))
    found = least_squares(
        lambda p: residuals(p * scale), start / scale, x_scale="jac", method="lm", xtol=1e-12
    )
    covariance = np.linalg.inv(found.jac.T @ found.jac) * np.outer(scale, scale)
    misfit = 2 * found.cost / max(2 * len(mean) - size, 1)
    values = (found.x * scale)[:size]
    transfer = Transfer(values, covariance[:size, :size], flicker, misfit, points)
    light, means = np.split(found.fun[: levels + len(mean)], [levels])
    return transfer, float(np.sum(light**2) + np.sum(means[lit] ** 2))


def start_values(points: TransferPoints) -> Floats:
    """Start values: slope of the variance against the mean over all levels, and rates from the longest exposures."""
    mean = points.mean_dn
    variance = points.variance_dn2
    darkest = int(np.argmin(mean))
    brightest = int(np.argmax(mean))
    gain = (variance[brightest] - variance[darkest]) / max(
        mean[brightest] - mean[darkest], 1e-9
    )
    black = mean[darkest]
    rate = (mean - black) / points.exposure_s
    rates = np.zeros(1 + points.dark.max())
    unlit = points.lit == 0
    np.fmax.at(rates, points.dark[unlit], rate[unlit])  # NaN: 0 DN in 0 s
    return np.array(
        [
            gain,
            0.0,
            max(variance[darkest] - ROUNDING_DN2, 0.01),
            black,
            rate[brightest],
            *rates,
        ]
    )


def saturated(points: TransferPoints) -> Bools:
    """(L,) whether each flat is beyond the turnover of the variance, with a variance that has collapsed."""
    variance = points.variance_dn2
    brighter = points.exposure_s > points.exposure_s[np.argmax(variance)]
    return brighter & (variance < COLLAPSED * variance.max())


def lamp_flicker(points: TransferPoints, black_dn: float, pixels: int) -> float:
    """Relative flicker from frame to frame, from differences between the means of a pair that noise does not explain.

    The frames of a pair are independent, so the mean square difference is 2 (flicker signal)^2 + 2 variance / pixels.
    A flicker that is not above its own error by SIGNIFICANT sigmas is set to 0: otherwise half of all steady lamps
    would have one.
    """
    signal = points.mean_dn - black_dn
    noise = 2 * points.variance_dn2 / pixels
    excess = (points.difference_dn2 - noise) / (2 * signal**2)
    chance = math.sqrt(2 / len(signal)) * math.sqrt(np.mean((noise / (2 * signal**2)) ** 2))
    mean = float(np.mean(excess))
    return math.sqrt(mean) if mean > SIGNIFICANT * chance else 0.0
