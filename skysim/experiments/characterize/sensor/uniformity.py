"""Fixed pattern: of the black level by columns, and of the sensitivity (PRNU).

Means of the first and of the second frames of the pairs have independent noise, so that the covariance of the two over
the pixels is the variance of the pattern, without bias and without a correction for noise. (EMVA 1288, release
4.0 Linear, subtracts the temporal variance over the number of frames from the spatial variance: the same expectation.)
The smooth part of a flat is that of the light, and is divided out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skysim.core.types import Floats
from skysim.experiments.characterize.sensor.estimate import Estimate
from skysim.experiments.characterize.sensor.levels import Level, Mask
from skysim.experiments.characterize.sensor.photon_transfer import BLACK, Transfer

ORDER = 4  # of the polynomial that is the light's distribution
SAMPLE = 8  # rows and columns of a block, for the fit of the polynomial

Planes = tuple[
    Floats, Floats, Floats
]  # (H, W) at exposure 0 in DN, (H, W) rate in DN/s, (L,) weights of the rate


def dark_planes(darks: Sequence[Level], transfer: Transfer, half: str) -> Planes:
    """Line of every pixel against the exposure, by weighted least squares over the darks of one temperature.

    half : first_dn or second_dn
    """
    times = np.array([one.exposure_s for one in darks])
    weight = np.array(
        [one.count / one.moments(np.ones(one.first_dn.shape, bool)).variance_dn2 for one in darks]
    )
    weight /= weight.sum()
    middle = weight @ times
    spread = weight @ (times - middle) ** 2
    slopes = weight * (times - middle) / spread
    at_zero = weight - slopes * middle
    base = np.zeros(darks[0].first_dn.shape)
    rate = np.zeros(darks[0].first_dn.shape)
    for one, by_slope, by_zero in zip(darks, slopes, at_zero, strict=True):
        frame = transfer.linear_dn(getattr(one, half) - transfer.values[BLACK])
        base += by_zero * frame
        rate += by_slope * frame
    return base, rate, slopes


def column_offset(first: Floats, second: Floats, usable: Mask, gain_e_dn: float) -> Estimate:
    """Standard deviation of the columns' black levels, in electrons, from the two dark frames at exposure 0."""
    means = [
        np.where(usable, one, 0.0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1)
        for one in (first, second)
    ]
    a, b = (one - one.mean() for one in means)
    columns = len(a)
    product = a * b * columns / (columns - 1)
    variance = gain_e_dn**2 * product.mean()
    sigma = gain_e_dn**2 * product.std() / np.sqrt(columns)
    if variance > 3 * sigma:
        return Estimate.lognormal(float(np.sqrt(variance)), float(sigma / (2 * np.sqrt(variance))))
    return Estimate.root(float(variance), float(sigma))


def prnu(
    flats: Sequence[Level],
    transfer: Transfer,
    first: Planes,
    second: Planes,
    dark_ratio: float,
    usable: Mask,
) -> Estimate:
    """Relative standard deviation of the sensitivity, from the rate of every pixel in the light.

    dark_ratio : dark current at the flats' temperature over that of the darks
    """
    rates = [
        light_rate(flats, transfer, half, planes, dark_ratio)
        for half, planes in (("first_dn", first), ("second_dn", second))
    ]
    trend = smooth((rates[0] + rates[1]) / 2, usable)
    a, b = (one[usable] / trend[usable] - 1 for one in rates)
    product = (a - a.mean()) * (b - b.mean())
    return Estimate.root(float(product.mean()), float(product.std() / np.sqrt(product.size)))


def light_rate(
    flats: Sequence[Level], transfer: Transfer, half: str, dark: Planes, dark_ratio: float
) -> Floats:
    """Rate of every pixel in the light, DN/s, by weighted least squares through 0, without black level and dark."""
    base, rate, _ = dark
    times = np.array([one.exposure_s for one in flats])
    weight = np.array([one.count / one.variance_dn2.mean(dtype=np.float64) for one in flats])
    weight = weight * times / np.sum(weight * times**2)
    total = np.zeros(base.shape)
    for one, by in zip(flats, weight, strict=True):
        signal = transfer.linear_dn(getattr(one, half) - transfer.values[BLACK] - base)
        total += by * (signal - dark_ratio * one.exposure_s * rate)
    return total


def smooth(image: Floats, usable: Mask) -> Floats:
    """The polynomial in x and y of total order ORDER, fitted to means of blocks of usable pixels."""
    height, width = image.shape
    rows = height // SAMPLE * SAMPLE
    columns = width // SAMPLE * SAMPLE
    weight = usable[:rows, :columns].astype(np.float64)

    def blocks(plane: Floats) -> Floats:
        return (
            plane.reshape(rows // SAMPLE, SAMPLE, columns // SAMPLE, SAMPLE)
            .sum(axis=(1, 3))
            .ravel()
        )

    count = blocks(weight)
    y, x = np.mgrid[0:rows:SAMPLE, 0:columns:SAMPLE] + (SAMPLE - 1) / 2
    mean = blocks(weight * image[:rows, :columns]) / np.maximum(count, 1)
    terms = [(p, q) for p in range(ORDER + 1) for q in range(ORDER + 1 - p)]

    def powers(at: NDArray[Any], size: int) -> Floats:
        return np.stack([((2.0 * at - size) / size) ** p for p in range(ORDER + 1)])

    by_x = powers(x.ravel(), width)
    by_y = powers(y.ravel(), height)
    root = np.sqrt(count)
    design = np.column_stack([by_x[p] * by_y[q] for p, q in terms])
    found = np.linalg.lstsq(design * root[:, None], mean * root, rcond=None)[0]
    matrix = np.zeros((ORDER + 1, ORDER + 1))
    for (p, q), value in zip(terms, found, strict=True):
        matrix[p, q] = value
    by_row = powers(np.arange(height), height)
    by_column = powers(np.arange(width), width)
    return np.asarray(by_row.T @ matrix.T @ by_column, dtype=np.float64)
