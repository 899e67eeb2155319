"""Statistics of samples with 95% confidence intervals: proportions, means, quantiles. Pure functions.

Intervals: Wilson's for proportions, the percentile bootstrap for means and RMS, and order statistics for quantiles.
Clopper and Pearson's exact bounds are used where a claim must hold: that an event never occurs, or that a proportion
is on one side of a limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy

from skysim.core.random_streams import random_stream
from skysim.core.types import Floats

CONFIDENCE = 0.95
SIGMAS = float(scipy.special.ndtri((1 + CONFIDENCE) / 2))  # half of the interval of a normal variable, in sigmas
RESAMPLES = 999
RANK_SIGMAS = 12  # ranks farther from their mean have a probability below 1e-30


class Summary(NamedTuple):
    """A statistic and its confidence interval at CONFIDENCE, NaN if it has none.

    trials : number of values;  needs : how many more values an interval requires, 0 if more would not give one
    """

    value: float
    low: float
    high: float
    trials: int
    needs: int = 0


NO_VALUE = Summary(math.nan, math.nan, math.nan, 0)


def exact(value: float) -> Summary:
    """Summary of a deterministic value: an interval of zero width."""
    return Summary(float(value), float(value), float(value), 1)


def proportion(hits: Any, total: Any) -> Summary:
    """The proportion hits / total with Wilson's interval (Wilson 1927), which is valid at 0 and at 1 too."""
    if total < 1:
        return NO_VALUE
    value, z2 = float(hits / total), SIGMAS**2
    scale = 1 + z2 / total
    middle = (value + z2 / (2 * total)) / scale
    half = SIGMAS / scale * math.sqrt(value * (1 - value) / total + z2 / (4 * total**2))
    low, high = (middle - half if hits else 0.0), (middle + half if hits < total else 1.0)
    return Summary(value, low, high, int(total))


@lru_cache(maxsize=4096)
def exact_bounds(hits: int, total: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """One-sided bounds of a proportion, each at this confidence (Clopper & Pearson 1934).

    The upper one is the p for which hits or fewer of total have the probability 1 - confidence, the lower one
    likewise for hits or more; quantiles of beta distributions. With hits = 0 the upper bound is
    1 - (1 - confidence)^(1 / total): at 95 % about 3 / total.
    """
    error = 1 - confidence
    low = float(scipy.stats.beta.ppf(error, hits, total - hits + 1)) if hits else 0.0
    high = float(scipy.stats.beta.isf(error, hits + 1, total - hits)) if hits < total else 1.0
    return low, high


def resampled(values: Floats, statistic: Callable[..., Any]) -> Summary:
    """A mean or similar statistic with the percentile bootstrap interval (Efron 1979); the resampling seed is fixed.

    Equal values have an interval of zero width; a single value has none.
    """
    value = float(statistic(values))
    if len(values) < 2:
        return Summary(value, math.nan, math.nan, len(values), 2 - len(values))
    if np.ptp(values) == 0:
        return Summary(value, value, value, len(values))
    batch = max(1, 2_000_000 // len(values))  # limits the memory of a batch to two million values
    result = scipy.stats.bootstrap(
        (values,),
        statistic,
        n_resamples=RESAMPLES,
        batch=batch,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=random_stream(1),
    )
    low, high = map(float, result.confidence_interval)
    return Summary(value, low, high, len(values))


def quantile(values: Floats, probability: float) -> Summary:
    """The quantile at the given probability with a distribution-free interval between two order statistics.

    Too few values have no interval; `needs` is how many more it takes: 59 in all for the 95% quantile.
    """
    count, value = len(values), float(np.quantile(values, probability))
    ranks = quantile_ranks(count, probability)
    if ranks is None:
        return Summary(value, math.nan, math.nan, count, values_for_quantile(probability) - count)
    low, high = np.partition(values, ranks)[list(ranks)]
    return Summary(value, float(low), float(high), count)


@lru_cache(maxsize=4096)
def quantile_ranks(count: int, probability: float) -> tuple[int, int] | None:
    """Ranks r < s, from 0, of the two order statistics between which the quantile is with CONFIDENCE; None if none are.

    The number of values below the quantile q is binomial, so that (David & Nagaraja 2003, section 7.1)

        P(X_(r) <= q <= X_(s)) >= B(s - 1) - B(r - 1),    ranks from 1, B the distribution function of Bin(n, p).

    Of all pairs of sufficient confidence this is the one with the fewest values between them, and of these the one
    whose two tails differ least.
    """
    middle, spread = count * probability, math.sqrt(count * probability * (1 - probability))
    first = max(int(middle - RANK_SIGMAS * spread) - 1, 0)
    last = min(int(middle + RANK_SIGMAS * spread) + 2, count - 1)
    below = scipy.stats.binom.cdf(np.arange(first, last + 1), count, probability)  # B(r - 1) of each rank r, from 1
    best: tuple[float, float, int, int] | None = None
    for low, tail in enumerate(below):
        high = int(np.searchsorted(below, tail + CONFIDENCE - 1e-12))
        if high == len(below):
            break
        candidate = (high - low, abs(tail - (1 - below[high])), first + low, first + high)
        best = min(best, candidate) if best else candidate
    return None if best is None else best[2:]


@lru_cache(maxsize=64)
def values_for_quantile(probability: float) -> int:
    """Fewest values for which `quantile` has an interval: the least n with 1 - p^n - (1 - p)^n >= CONFIDENCE.

    Smallest and largest value then enclose the quantile. At p = 0.95 it is 59: the largest of 59 values alone exceeds
    the 95% quantile with a probability of 95 % (Wilks 1941).
    """
    count = 1
    while 1 - probability**count - (1 - probability) ** count < CONFIDENCE:
        count += 1
    return count


def extremum(values: Floats, reduce: Callable[[Floats], Any]) -> Summary:
    """The largest or smallest value of these trials, without an interval."""
    return Summary(float(reduce(values)), math.nan, math.nan, len(values))


def rms(values: Floats, axis: int = -1) -> Any:
    """sqrt(mean(x^2)) along the last axis."""
    return np.sqrt(np.mean(np.square(values), axis=axis))
