"""95 % intervals: confidence interval of a mean, prediction interval of one draw, bootstrap of functions of means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.special import stdtrit

from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.results import metrics
from skysim.results.metrics import CONFIDENCE, RESAMPLES, Summary


def confidence_interval(values: Sequence[float] | Floats) -> Summary:
    """The mean with Student's confidence interval: mean +- t s / sqrt(n)."""
    return prediction_interval(values, own_variance=0.0)


def prediction_interval(
    values: Sequence[float] | Floats, count: int = 0, own_variance: float = 1.0
) -> Summary:
    """The mean with Student's prediction interval: mean +- t s sqrt(1 + 1 / n), t for n - 1 degrees of freedom.

    For a published number that is itself a single draw.
    count : number of independent draws, if fewer than the values
    own_variance : of the predicted draw in units of s^2, in place of 1
    """
    draws = np.asarray(values, float)
    count = count or len(draws)
    mean = float(np.mean(draws))
    half = float(
        stdtrit(count - 1, 0.975) * np.std(draws, ddof=1) * np.sqrt(own_variance + 1 / count)
    )
    return symmetric_interval(mean, half, count)


def symmetric_interval(value: float, half: float, trials: int) -> Summary:
    """value +- half."""
    return Summary(value, value - half, value + half, trials)


def percent(summary: Summary) -> Summary:
    """A fraction with its interval in percent."""
    return Summary(100 * summary.value, 100 * summary.low, 100 * summary.high, summary.trials)


def sample_std(values: Floats, axis: int = -1) -> Any:
    """Standard deviation with divisor n - 1."""
    return np.std(values, axis=axis, ddof=1)


def bootstrap_interval(values: Floats, statistic: Callable[..., Any]) -> Summary:
    """A statistic with its bootstrap percentile interval, widened for small samples (see `widen_interval`)."""
    return widen_interval(metrics.resampled(values, statistic))


def widen_interval(summary: Summary) -> Summary:
    """Widen a bootstrap interval about its value by (t / 1.96) sqrt(n / (n - 1)), t for n - 1 degrees of freedom.

    The percentile bootstrap of n values uses the standard deviation with divisor n and the normal quantile, so it is
    too narrow by this factor for small n.
    """
    if summary.trials < 2:
        return summary
    factor = (
        stdtrit(summary.trials - 1, 0.975) / 1.96 * np.sqrt(summary.trials / (summary.trials - 1))
    )
    low, high = (
        summary.value + factor * (end - summary.value) for end in (summary.low, summary.high)
    )
    return summary._replace(low=float(low), high=float(high))


def bootstrap_of_means(columns: Floats, statistic: Callable[[Floats], Any]) -> Summary:
    """A function of K column means, with its bootstrap percentile interval over the N rows; NaNs are left out.

    columns : (N, K);  statistic : of (..., K) means, shape (...)
    """
    finite = np.isfinite(columns)
    filled = np.where(finite, columns, 0.0)
    rows = len(columns)
    # A resample only needs how often it draws each row, so the means of all resamples are one matrix product.
    weight = random_stream(1).multinomial(rows, np.full(rows, 1 / rows), RESAMPLES)
    with np.errstate(invalid="ignore"):
        resampled = statistic((weight @ filled) / (weight @ finite))
    value = float(statistic(filled.sum(axis=0) / finite.sum(axis=0)))
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.nanpercentile(resampled, [tail, 100 - tail])
    return widen_interval(Summary(value, min(float(low), value), max(float(high), value), rows))
