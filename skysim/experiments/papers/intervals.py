"""95 % intervals: confidence interval of a mean, prediction interval of one draw, bootstrap of functions of means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.special import stdtrit

from skysim.core.types import Floats
from skysim.results import metrics
from skysim.results.metrics import CONFIDENCE, RESAMPLES, Summary


def mean_of(values: Sequence[float] | Floats) -> Summary:
    """The mean with Student's confidence interval: mean +- t s / sqrt(n)."""
    return about_mean(values, 0.0)


def another(values: Sequence[float] | Floats, count: int = 0) -> Summary:
    """The mean with Student's prediction interval: mean +- t s sqrt(1 + 1 / n).

    For a published number that is itself a single draw.
    count : number of independent draws, if fewer than the values
    """
    return about_mean(values, 1.0, count)


def about_mean(values: Sequence[float] | Floats, own: float, count: int = 0) -> Summary:
    """mean +- t s sqrt(own + 1 / n), t for n - 1 degrees of freedom. own : 0 confidence, 1 prediction interval"""
    drawn = np.asarray(values, float)
    count, middle = count or len(drawn), float(np.mean(drawn))
    reach = float(stdtrit(count - 1, 0.975) * np.std(drawn, ddof=1) * np.sqrt(own + 1 / count))
    return Summary(middle, middle - reach, middle + reach, count)


def resampled(values: Floats, statistic: Callable[..., Any]) -> Summary:
    """A statistic with its bootstrap percentile interval, widened for small samples (see `widened`)."""
    return widened(metrics.resampled(values, statistic))


def widened(told: Summary) -> Summary:
    """Widen a bootstrap interval about its value by (t / 1.96) sqrt(n / (n - 1)), t for n - 1 degrees of freedom.

    The percentile bootstrap of n values uses the standard deviation with divisor n and the normal quantile, so it is
    too narrow by this factor for small n.
    """
    if told.trials < 2:
        return told
    factor = stdtrit(told.trials - 1, 0.975) / 1.96 * np.sqrt(told.trials / (told.trials - 1))
    low, high = (told.value + factor * (end - told.value) for end in (told.low, told.high))
    return told._replace(low=float(low), high=float(high))


def of_means(columns: Floats, statistic: Callable[[Floats], Any]) -> Summary:
    """A function of K column means, with its bootstrap percentile interval over the N rows; NaNs are left out.

    columns : (N, K);  statistic : of (..., K) means, shape (...)
    """
    there = np.isfinite(columns)
    filled = np.where(there, columns, 0.0)
    rows = len(columns)
    # A resample only needs how often it draws each row, so the means of all resamples are one matrix product.
    weight = np.random.default_rng(1).multinomial(rows, np.full(rows, 1 / rows), RESAMPLES)
    with np.errstate(invalid="ignore"):
        found = statistic((weight @ filled) / (weight @ there))
    value = float(statistic(filled.sum(axis=0) / there.sum(axis=0)))
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.nanpercentile(found, [tail, 100 - tail])
    return widened(Summary(value, min(float(low), value), max(float(high), value), rows))
