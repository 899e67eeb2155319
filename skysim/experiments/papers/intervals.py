"""Intervals of 95 %: of a mean of normal draws, of one draw more, of what is made of several means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.special import stdtrit

from skysim.core.types import Floats
from skysim.results import metrics
from skysim.results.metrics import CONFIDENCE, RESAMPLES, Summary


def mean_of(values: Sequence[float] | Floats) -> Summary:
    """The mean and Student's interval: mean +- t s / sqrt(n)."""
    return about_mean(values, 0.0)


def another(values: Sequence[float] | Floats, count: int = 0) -> Summary:
    """The mean and where one more draw is: mean +- t s sqrt(1 + 1 / n). For a published number that is itself one.

    count : of draws that are independent, where they are fewer than the values
    """
    return about_mean(values, 1.0, count)


def about_mean(values: Sequence[float] | Floats, own: float, count: int = 0) -> Summary:
    """mean +- t s sqrt(own + 1 / n) with t of n - 1 degrees of freedom."""
    drawn = np.asarray(values, float)
    count, middle = count or len(drawn), float(np.mean(drawn))
    reach = float(stdtrit(count - 1, 0.975) * np.std(drawn, ddof=1) * np.sqrt(own + 1 / count))
    return Summary(middle, middle - reach, middle + reach, count)


def resampled(values: Floats, statistic: Callable[..., Any]) -> Summary:
    """A mean or the like with the bootstrap's interval, made as much wider as a few values ask for."""
    return widened(metrics.resampled(values, statistic))


def widened(told: Summary) -> Summary:
    """The bootstrap of n values leaves out a factor sqrt(n / (n - 1)), and that t is longer than the normal's 1.96."""
    if told.trials < 2:
        return told
    factor = stdtrit(told.trials - 1, 0.975) / 1.96 * np.sqrt(told.trials / (told.trials - 1))
    low, high = (told.value + factor * (end - told.value) for end in (told.low, told.high))
    return told._replace(low=float(low), high=float(high))


def of_means(columns: Floats, statistic: Callable[[Floats], Any]) -> Summary:
    """A figure of K columns' means, with the bootstrap's percentile interval over the N rows; NaNs are left out.

    columns : (N, K);  statistic : of (..., K) means, shape (...)
    """
    there = np.isfinite(columns)
    filled = np.where(there, columns, 0.0)
    rows = len(columns)
    weight = np.random.default_rng(1).multinomial(rows, np.full(rows, 1 / rows), RESAMPLES)
    with np.errstate(invalid="ignore"):
        found = statistic((weight @ filled) / (weight @ there))
    value = float(statistic(filled.sum(axis=0) / there.sum(axis=0)))
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.nanpercentile(found, [tail, 100 - tail])
    return widened(Summary(value, min(float(low), value), max(float(high), value), rows))
