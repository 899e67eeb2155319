"""One laboratory for AFIT's three tests: a joint fit to Tables 2, 3, 4 and 7 (Padro 2012), as section 3.7 says.

`python docs/site/afit_fit.py` prints the parameters with their intervals, chi-square by table, and how
well other exposures do. The scene scenes/papers/afit_laboratory.yaml has the result.

The model of a light in an image: a disk of radius R blurred by a Gaussian, that is proportional to the time for which
its LED was on during the exposure, clipped where a pixel is full; on it Gaussian noise s. Of a pixel of level p above
the threshold t the probability and the mean gray level are, with u = (p - t) / s,

    P = Phi(u),    E = p P + s phi(u),

so that a light's area and summed gray level have means and variances by sums over pixels. The LEDs of a board are lit
one after another, each for its part of a slot of 1 ms; the exposure begins at a random phase of the cycle, whose pulses
it may cut. The magnitude is the summed gray level over the median area of the lights in the image. Steps:

1. Light of every LED at PHASES phases of the cycle.
2. Area and sum of its image, with noise drawn once (common random numbers).
3. Mean and standard deviation of the magnitudes, of Test 1 by LED in descending order.
4. Residuals: means to 2 %, deviations to a factor of 1.25, LEDs to 8 % of each other; least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq, least_squares
from scipy.special import ndtr

from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import SIGMAS

PHASES = 600
SLOT_MS = 1.0
THRESHOLD_GRAY = 0.04 * 255
OVERSAMPLING = 4
MEAN_ERROR = 0.02
DEVIATION_ERROR = np.log(1.25)
LED_ERROR = 0.08
NAMES = ("exposure", "level", "full", "noise", "radius", "blur", "short pulse")
UNITS = ("ms", "gray/ms", "gray", "gray", "px", "px", "us")
START = np.array([18.1, 80.0, 190.0, 3.8, 11.4, 1.4, 76.0])
LOW = np.array([9.0, 10.0, 150.0, 0.3, 4.0, 0.3, 20.0])
HIGH = np.array([110.0, 800.0, 255.0, 8.0, 20.0, 5.0, 200.0])
# A frame of 60 Hz, and those that Table 2 alone allows.
OTHERS_MS = (16.7, 27.3, 36.4, 55.0, 100.0)
CHI2_95 = 3.84
FARTHEST_MS = 1.0  # of an end of the interval from the best exposure


class Board(NamedTuple):
    """A test: its LEDs' slots, pulses in ms (NaN: the short pulse), slots of the cycle, and the published numbers."""

    slot: Floats
    pulse_ms: Floats
    slots: int
    mean: Floats
    deviation: Floats


def rows(id: str, name: str, keys: Sequence[object]) -> Floats:
    """Published numbers of rows NAME_KEY; NaN for a row with bounds only."""
    published = experiments()[id].rows
    return np.array([published[f"{name}_{key}"].published for key in keys], dtype=float)


@cache
def boards() -> list[Board]:
    """The three tests, from data/published."""
    short = np.nan
    id = "afit-table-3-5"
    pair_mean = [rows(id, name, (1, 2, 3)).mean() for name in ("bright", "dim")]
    pair_deviation = [rows(id, name, (1, 2, 3)).mean() for name in ("sd_bright", "sd_dim")]
    nine = range(1, 10)
    five = range(1, 6)
    return [
        Board(
            np.arange(9.0),
            np.ones(9),
            9,
            rows("afit-table-2", "mean", nine),
            rows("afit-table-2", "sd", nine),
        ),
        Board(
            np.array([0.0, 4.0]),
            np.array([1.0, short]),
            9,
            np.array(pair_mean),
            np.array(pair_deviation),
        ),
        Board(
            np.arange(5.0),
            np.array([1.0, 0.5, 0.4, 0.2, short]),
            5,
            rows("afit-table-6-9", "magnitude", five),
            rows("afit-table-6-9", "magnitude_sd", five),
        ),
    ]


@cache
def noise_draws() -> Floats:
    """(3, 9, 2, PHASES) standard normal draws for the lights of the tests, the same at every step of the fit."""
    return random_stream(3).standard_normal((3, 9, 2, PHASES))


def blob_moments(
    full: float, noise: float, radius_px: float, blur_px: float
) -> tuple[Floats, ...]:
    """Moments of a light's image at the levels of a grid.

    The levels, mean and variance of the area and of the summed gray level, and their covariance.
    """
    half_px = int(radius_px + 5 * blur_px + 3)
    side = np.arange(-half_px * OVERSAMPLING, half_px * OVERSAMPLING + 1) / OVERSAMPLING
    distance_px = np.hypot(side[:, None], side)
    disk = np.clip((radius_px - distance_px) * OVERSAMPLING + 0.5, 0.0, 1.0)
    shape = gaussian_filter(disk, blur_px * OVERSAMPLING)[
        ::OVERSAMPLING, ::OVERSAMPLING
    ].ravel()
    level = np.concatenate([[0.0], np.geomspace(8, 1500, 80)])
    gray = np.minimum(level[:, None] * shape, full)
    above = (gray - THRESHOLD_GRAY) / noise
    lit = gray > 1.0  # others are noise beside the light
    probability = ndtr(above) * lit
    density = np.exp(-0.5 * above**2) / np.sqrt(2 * np.pi) * lit
    mean = gray * probability + noise * density
    square = (gray**2 + noise**2) * probability + noise * density * (gray + THRESHOLD_GRAY)
    return (
        level,
        probability.sum(axis=1),
        (probability * (1 - probability)).sum(axis=1),
        mean.sum(axis=1),
        (square - mean**2).sum(axis=1),
        (mean * (1 - probability)).sum(axis=1),
    )


def lit_ms(board: Board, pulse_ms: Floats, exposure_ms: float) -> Floats:
    """Step 1: (N, PHASES) time for which each LED is on in an exposure that begins at a phase of the cycle."""
    cycle_ms = board.slots * SLOT_MS
    begin = (np.arange(PHASES) + 0.5) / PHASES * cycle_ms

    def until(time_ms: Floats) -> Floats:
        """Light since the time 0."""
        cycles, rest_ms = np.divmod(time_ms, cycle_ms)
        pulse = pulse_ms[:, None]
        return cycles * pulse + np.clip(rest_ms - board.slot[:, None] * SLOT_MS, 0.0, pulse)

    return until(begin + exposure_ms) - until(begin)


def magnitudes(board: Board, laboratory: Floats, led: Floats, noise: Floats) -> Floats:
    """Steps 1 and 2: (N, PHASES) magnitudes of a board.

    Parameters
    ----------
    laboratory
        Values of NAMES
    led
        (N,) light of each LED relative to the level
    noise
        (N, 2, PHASES) standard normal draws
    """
    exposure_ms, level, full, sigma, radius_px, blur_px, short_us = laboratory
    pulse_ms = np.where(np.isnan(board.pulse_ms), short_us * 1e-3, board.pulse_ms)
    light = level * led[:, None] * lit_ms(board, pulse_ms, exposure_ms)
    grid, *tables = blob_moments(full, sigma, radius_px, blur_px)
    area, area_variance, total, total_variance, covariance = (
        np.interp(light, grid, table) for table in tables
    )
    # Area and sum are correlated normal variables.
    area_sigma = np.sqrt(area_variance)
    slope = covariance / np.maximum(area_sigma, 1e-9)
    rest = np.sqrt(np.maximum(total_variance - slope**2, 0.0))
    areas = area + area_sigma * noise[:, 0]
    totals = total + slope * noise[:, 0] + rest * noise[:, 1]
    return totals / np.median(areas, axis=0)


def residuals(values: Floats) -> list[Floats]:
    """Steps 3 and 4: residuals in standard deviations: means and deviations of each test, then the LEDs.

    Parameters
    ----------
    values
        Laboratory, then the logarithms of the LEDs of all tests
    """
    laboratory, leds = np.split(values, [len(NAMES)])
    found = []
    first = 0
    for board, draws in zip(boards(), noise_draws(), strict=True):
        count = len(board.slot)
        led = np.exp(leds[first : first + count])
        first += count
        magnitude = magnitudes(board, laboratory, led, draws[:count])
        found.append((magnitude.mean(axis=1) / board.mean - 1) / MEAN_ERROR)
        found.append(np.log(magnitude.std(axis=1) / board.deviation) / DEVIATION_ERROR)
    return [*found, leds / LED_ERROR]


class Fit(NamedTuple):
    """Fitted values with their covariance, and chi-square by part of the residuals."""

    values: Floats
    covariance: Floats
    chi2: list[float]


def fit(start: Floats, fixed: int | None = None) -> Fit:
    """Least squares from a start; `fixed` is the index of a value that keeps its start."""
    free = np.array([n for n in range(len(start)) if n != fixed])
    leds = len(start) - len(NAMES)
    low = np.concatenate([LOW, np.full(leds, -0.5)])[free]
    high = np.concatenate([HIGH, np.full(leds, 0.5)])[free]
    scale = np.concatenate([START, np.full(leds, LED_ERROR)])[free]

    def all_values(some: Floats) -> Floats:
        values = start.copy()
        values[free] = some
        return values

    solution = least_squares(
        lambda some: np.concatenate(residuals(all_values(some))),
        np.clip(start[free], low * 1.001, high * 0.999),
        x_scale=scale,
        diff_step=3e-4,
        max_nfev=100,
        bounds=(low, high),
    )
    covariance = np.zeros((len(start), len(start)))
    covariance[np.ix_(free, free)] = np.linalg.pinv(solution.jac.T @ solution.jac)
    values = all_values(solution.x)
    return Fit(values, covariance, [float(part @ part) for part in residuals(values)])


def start_values(exposure_ms: float) -> Floats:
    """Start of a fit: START with the same light in another exposure, and LEDs as Table 2 ranks them."""
    laboratory = START.copy()
    laboratory[1] *= START[0] / exposure_ms
    laboratory[0] = exposure_ms
    ranks = boards()[0].mean
    return np.concatenate([laboratory, 0.8 * np.log(ranks / ranks.mean()), np.zeros(7)])


def exposure_interval(best: Fit) -> tuple[float, float]:
    """Exposures at which chi-square, minimized over all other values, is 3.84 above the best, to 5 us."""

    def excess(exposure_ms: float) -> float:
        values = best.values.copy()
        values[0] = exposure_ms
        return sum(fit(values, fixed=0).chi2) - sum(best.chi2) - CHI2_95

    middle_ms = float(best.values[0])
    ends = (middle_ms - FARTHEST_MS, middle_ms + FARTHEST_MS)
    low_ms, high_ms = (brentq(excess, middle_ms, end_ms, xtol=0.005) for end_ms in ends)
    return low_ms, high_ms


def describe(best: Fit, interval_ms: tuple[float, float]) -> list[str]:
    """Lines that say the parameters with 95 % intervals and chi-square by table."""
    half = SIGMAS * np.sqrt(np.diag(best.covariance))
    lines = [
        f"exposure: {best.values[0]:.2f} ms ({interval_ms[0]:.2f}..{interval_ms[1]:.2f})"
    ]
    for n in range(1, len(NAMES)):
        lines.append(f"{NAMES[n]}: {best.values[n]:.4g} ± {half[n]:.2g} {UNITS[n]}")
    leds = np.exp(best.values[len(NAMES) :])
    lines.append(f"LEDs of Test 2: {leds[9:11].round(3)}; of Test 3: {leds[11:].round(3)}")
    parts = (
        "Table 2 means",
        "deviations",
        "Table 3",
        "Table 4",
        "Table 7 means",
        "deviations",
        "LEDs",
    )
    chi2 = ", ".join(
        f"{name} {value:.1f}" for name, value in zip(parts, best.chi2, strict=True)
    )
    count = sum(len(board.mean) for board in boards()) * 2
    lines.append(f"chi-square {sum(best.chi2):.1f} of {count} numbers: {chi2}")
    return lines


def main() -> None:
    """Fit, and print the result and the alternatives."""
    best = fit(start_values(float(START[0])))
    print("\n".join(describe(best, exposure_interval(best))))
    for exposure_ms in OTHERS_MS:
        other = fit(start_values(exposure_ms), fixed=0)
        print(f"exposure {exposure_ms:g} ms: chi-square {sum(other.chi2):.1f}")


if __name__ == "__main__":
    main()
