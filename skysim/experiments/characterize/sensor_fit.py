"""A sensor from its levels of darks and flats: every parameter of the detector with its interval."""

import math
from collections.abc import Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np

from skysim.core.types import Bools, Floats, joined, median, taken
from skysim.experiments.characterize import fixed_pattern, photon_transfer
from skysim.experiments.characterize.photon_transfer import (
    BLACK,
    CURVATURE,
    FIRST_DARK,
    GAIN,
    READ,
    ROUNDING_DN2,
    Estimate,
    Level,
    Transfer,
    TransferPoints,
    exposures_s,
    median_and_spread,
    propagate,
)

Levels = Sequence[Level]
Temperatures = Sequence[float | None]  # None: unknown
# Standard deviations above the median dark, beyond which pixels are left out of the photon transfer.
HOT_SIGMAS = 20.0
HIT_SIGMAS = 8.0  # difference between the halves of a pixel's frames beyond which a particle has hit it


class MeasuredSensor(NamedTuple):
    """The parameters of a sensor from its frames.

    Attributes
    ----------
    estimates
        By key of `camera.detector`, in its units
    remarks
        What remains unknown, one line each
    dark
        Distribution of the dark current, None if it is below the noise
    flats
        All levels, including those that were not fitted
    saturation_dn
        Digital number of a saturated pixel, or of the brightest flat
    """

    estimates: dict[str, Estimate]
    remarks: list[str]
    transfer: Transfer
    dark: fixed_pattern.DarkCurrent | None
    dark_temperature_c: float | None
    flats: TransferPoints
    linearity_error: float
    saturation_dn: float


def characterize(darks: Levels, flats: Levels) -> MeasuredSensor:
    """Every parameter from levels of darks and flats that have passed the checks of `frame_files`.

    The dark current is stated at the darks' temperature that is nearest to that of the flats.
    """
    usable = usable_pixels(darks)
    temperatures = sorted(
        {one.temperature_c for one in darks},
        key=lambda one: -math.inf if one is None else one,
    )
    own = nearest_index(temperatures, flats[0].temperature_c)
    flat_points = joined([one.point(usable, 1, own) for one in flats])
    transfer, fitted = fitted_transfer(darks, flats, temperatures, flat_points, usable)
    estimates = {"gain_e_dn": transfer.gain_e_dn, "read_noise_e": transfer.read_noise_e}
    found = MeasuredSensor(
        estimates,
        [],
        transfer,
        None,
        temperatures[own],
        flat_points,
        linearity_error(flat_points, transfer),
        float(flat_points.mean_dn.max()),
    )
    full_well(found)
    chosen = best_temperature(temperatures, darks, transfer, own)
    at_it = [one for one in darks if one.temperature_c == temperatures[chosen]]
    planes = fixed_pattern.dark_planes(at_it, transfer)
    rates = transfer.values[FIRST_DARK:]
    # Of the dark currents of the same pixels at the two temperatures.
    ratio = 1.0 if own == chosen else float(max(rates[own], 0.0) / max(rates[chosen], 1e-12))
    dark = dark_parameters(found, at_it, planes, own, ratio)
    doubling(found, temperatures)
    estimates["prnu"] = fixed_pattern.prnu(fitted, transfer, planes, ratio, usable)
    columns = fixed_pattern.column_offset(planes[0], usable, 1 / transfer.values[GAIN])
    estimates["column_offset_e"] = columns
    # The columns are a sample: the mean of as many columns of another chip differs by their scatter.
    scatter_dn = columns.value * transfer.values[GAIN] / math.sqrt(usable.shape[1])
    black = transfer.offset_dn
    estimates["offset_dn"] = Estimate.normal(black.value, math.hypot(black.sigma, scatter_dn))
    if transfer.drift:
        found.remarks.append(
            f"lamp: the flats scatter by {100 * transfer.drift:.2g} % about the law, more than the frames of a pair"
            " differ; drift and a nonlinearity of another law look alike; allowed: a steadier lamp, or more flats"
        )
    return found._replace(dark=dark)


def fitted_transfer(
    darks: Levels,
    flats: Levels,
    temperatures: Temperatures,
    flat_points: TransferPoints,
    usable: Bools,
) -> tuple[Transfer, list[Level]]:
    """The photon transfer of all darks and of the flats below saturation, and these flats."""
    dark_points = joined(
        [one.point(usable, 0, temperatures.index(one.temperature_c)) for one in darks]
    )
    black_dn = float(dark_points.mean_dn.min())
    signal = flat_points.mean_dn - black_dn
    below = signal <= photon_transfer.FIT_RANGE * signal.max()
    fitted = list(compress(flats, below))
    lit = taken(flat_points, below)
    flicker = photon_transfer.lamp_flicker(lit, black_dn, int(usable.sum()))
    return photon_transfer.fit(joined([dark_points, lit]), flicker), fitted


def usable_pixels(darks: Levels) -> Bools:
    """Pixels that no particle has hit, and that are not hot in any dark.

    Hot pixels are more than HOT_SIGMAS robust standard deviations above the median.
    """
    usable = np.ones(darks[0].mean_dn.shape, bool)
    for one in darks:
        mean = one.mean_dn
        middle, spread = median_and_spread(mean)
        usable &= (mean < middle + HOT_SIGMAS * max(spread, 0.5)) & steady_pixels(
            one, median(one.variance_dn2)
        )
    return usable


def steady_pixels(one: Level, variance_dn2: float | Floats) -> Bools:
    """Pixels whose means over the two halves of the frames agree within HIT_SIGMAS: no particle has hit them.

    Each half is the mean of count / 2 frames, so their difference has the variance 4 variance_dn2 / count.
    """
    return np.ptp(one.halves_dn, axis=0) <= HIT_SIGMAS * np.sqrt(
        4 * np.maximum(variance_dn2, 0.2) / one.count
    )


def nearest_index(temperatures: Temperatures, temperature_c: float | None) -> int:
    """Index of the darks' temperature that is nearest to a temperature; 0 if one of them is unknown."""
    if temperature_c is None or temperatures[0] is None:
        return 0
    return int(
        np.argmin([abs(one - temperature_c) for one in temperatures if one is not None])
    )


def best_temperature(
    temperatures: Temperatures, darks: Levels, transfer: Transfer, own: int
) -> int:
    """Index of the temperature at which the dark charge grows most from the shortest to the longest dark frame.

    A dark current within its error has no ratio to another: without any beyond it, `own`, if it has two exposures.
    """
    sigma = np.sqrt(np.diag(transfer.covariance))

    def signal(index: int) -> tuple[float, float, float]:
        times = [one.exposure_s for one in darks if one.temperature_c == temperatures[index]]
        span_s = max(times) - min(times)
        rate = float(transfer.values[FIRST_DARK + index])
        known = rate if rate > 3 * sigma[FIRST_DARK + index] else 0.0
        return known * span_s, (index == own) * span_s, span_s

    return max(range(len(temperatures)), key=signal)


def full_well(found: MeasuredSensor) -> None:
    """Add full well and nonlinearity to the findings.

    Full well is the charge at which the signal no longer grows with the exposure. Nonlinearity is the relative loss of
    signal there, c x of the fit.
    """
    transfer = found.transfer
    full = taken(found.flats, photon_transfer.saturated(found.flats))
    if not full.mean_dn.size:
        full = taken(found.flats, np.argsort(-found.flats.mean_dn, kind="stable")[:1])
        found.remarks.append(
            f"full well: the flats end at {full.mean_dn[0]:.0f} DN, before the variance turns; allowed: flats to twice"
            f" the longest exposure, {full.exposure_s[0]:.3g} s"
        )
    values = np.append(transfer.values, full.mean_dn.mean())
    covariance = np.zeros((len(values), len(values)))
    covariance[:-1, :-1] = transfer.covariance
    covariance[-1, -1] = np.mean(full.mean_sigma_dn**2)

    def signal(p: Floats) -> float:
        return float(photon_transfer.linear_dn(np.array(p[-1] - p[BLACK]), p[CURVATURE]))

    well = propagate(lambda p: signal(p) / p[GAIN], values, covariance)
    missing = propagate(lambda p: p[CURVATURE] * signal(p), values, covariance)
    found.estimates.update({"full_well_e": well, "nonlinearity": missing})


def dark_parameters(
    found: MeasuredSensor,
    darks: Levels,
    planes: fixed_pattern.Planes,
    own: int,
    ratio: float,
) -> fixed_pattern.DarkCurrent | None:
    """Add dark current, DSNU and hot pixels to the findings, from the rates of the pixels in darks of one temperature.

    Parameters
    ----------
    own
        Index of the temperature for which the dark current is stated
    ratio
        Dark current at that temperature over the dark current of these darks
    """
    transfer = found.transfer
    _, pixel_rates, weights = planes
    gain = transfer.values[GAIN]
    read = transfer.values[READ] + ROUNDING_DN2
    black = transfer.values[BLACK]
    steady = np.logical_and.reduce(
        [
            steady_pixels(one, read + gain * np.maximum(one.mean_dn - black, 0.0))
            for one in darks
        ]
    )
    rates = pixel_rates.mean(axis=0)[steady]
    counts = np.array([one.count for one in darks])
    times = exposures_s(darks)
    noise = fixed_pattern.RateNoise(
        float(np.sum(weights**2 * read / counts)),
        float(np.sum(weights**2 * gain * times / counts)),
    )
    top_dn = max(one.greatest_dn for one in darks)
    full_dn = np.array(0.98 * top_dn)
    greatest = float(transfer.linear_dn(full_dn - black) / times.max())
    # A pixel that saturates in the longest dark has a greater rate than the line through its darks.
    longest = max(darks, key=lambda one: one.exposure_s)
    rates[longest.mean_dn[steady] >= full_dn] = greatest
    relative = math.sqrt(transfer.covariance[GAIN, GAIN]) / gain

    def in_electrons(one: Estimate) -> Estimate:
        value = ratio * one.value / gain
        return Estimate.lognormal(value, value * math.hypot(one.sigma / one.value, relative))

    dark = None
    if fixed_pattern.is_resolved(rates, noise):
        dark = fixed_pattern.fit(rates, noise, greatest)
        found.estimates.update(dark_e_s=in_electrons(dark.mean), dsnu=dark.dsnu)
        fraction = dark.hot_pixels
        hot = dark.hot
    else:
        unresolved(found, own, rates, noise, float(times.max()))
        # A few hot pixels change no median.
        fraction, hot = fixed_pattern.hot_tail(rates, noise, greatest)
    found.estimates["hot_pixels"] = fraction
    if hot is not None:
        found.estimates["hot_e_s"] = in_electrons(hot)
    return dark


def unresolved(
    found: MeasuredSensor,
    own: int,
    rates: Floats,
    noise: fixed_pattern.RateNoise,
    longest_s: float,
) -> None:
    """Add the mean dark current alone, if its scatter over the pixels is below the noise; remark what it needs."""
    transfer = found.transfer
    dark = propagate(
        lambda p: p[FIRST_DARK + own] / p[GAIN], transfer.values, transfer.covariance
    )
    found.estimates["dark_e_s"] = dark
    mean = median(rates)
    if mean > 0 and mean**2 > noise.reading:
        variance, error = fixed_pattern.own_variance(rates, noise)
        found.estimates["dsnu"] = Estimate.root(variance / mean**2, error / mean**2)
        return
    noise_e_s = math.sqrt(noise.reading) / transfer.values[GAIN]
    needed = "much longer exposures"
    if dark.value > 3 * dark.sigma:
        needed = f"{longest_s * noise_e_s / dark.value:.2g} s or more"
    found.remarks.append(
        f"DSNU: the scatter of the dark current, {dark.value:.2g} e-/s, is below the noise of"
        f" {longest_s:g} s; allowed: darks of {needed}"
    )


def doubling(found: MeasuredSensor, temperatures: Temperatures) -> None:
    """Add the temperature step that doubles the dark current: ln 2 over the slope of ln D, by a weighted line.

    The same pixels are compared at all temperatures, so their scatter does not matter.
    """
    known = [one for one in temperatures if one is not None]
    if len(known) < 2:
        found.remarks.append(
            "doubling temperature: darks at one temperature; allowed: two, 5 K apart or more"
        )
        return
    rates = found.transfer.values[FIRST_DARK:]
    covariance = found.transfer.covariance[FIRST_DARK:, FIRST_DARK:]
    if np.any(rates <= 0):
        found.remarks.append(
            "doubling temperature: no dark current at one of the temperatures; allowed: longer darks"
        )
        return
    weight = np.linalg.inv(covariance / np.outer(rates, rates))
    design = np.column_stack([np.ones(len(known)), np.array(known) - known[0]])
    normal = np.linalg.inv(design.T @ weight @ design)
    _, slope = normal @ design.T @ weight @ np.log(rates)
    value = math.log(2) / slope
    sigma = value / slope * math.sqrt(normal[1, 1])
    found.estimates["dark_doubling_c"] = Estimate.normal(value, sigma)


def linearity_error(flats: TransferPoints, transfer: Transfer) -> float:
    """Mean relative deviation of the signal from a line through the levels at 5 to 95 % of the saturation.

    The line is fitted with relative weights (EMVA 1288, release 4.0 Linear: the linearity error LE).
    """
    signal = flats.mean_dn - transfer.values[BLACK]
    inside = (signal > 0.05 * signal.max()) & (signal < 0.95 * signal.max())
    if inside.sum() < 3:
        return math.nan
    x = flats.exposure_s[inside]
    y = signal[inside]
    slope, intercept = np.polyfit(x, y, 1, w=1 / y)
    line = intercept + slope * x
    return float(np.mean(np.abs(y - line) / line))
