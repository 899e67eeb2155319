"""Attitude error metrics, and statistics over many trials with confidence intervals. Pure functions.

A statistic is named by a string (`response`), for example `cross_arcsec_p95` or `coverage_5`. Each is computed from
the columns of a table of trials and returned with a 95% confidence interval: Wilson's interval for proportions, the
percentile bootstrap for means and RMS (of many values a faster one, `bootstrap_of_many`), and order statistics for
quantiles. That of a mean NEES is of a chi-square variable. Clopper and Pearson's exact bounds are used
where a claim must hold: that an event never occurs (or always), or that a proportion is on one side of a limit.
"""

from __future__ import annotations

import bisect
import math
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats

WRONG_RAD = np.radians(10 / 60)  # limit of PTASE for a wrong attitude: ten arcminutes
WRONG_AS_CLAIMED_RAD = np.radians(
    1
)  # limit for an error that the tracker's covariance allows
OVERCONFIDENCE_PROBABILITY = (
    1e-8  # with which a correct covariance allows an error counted as overconfident
)
OVERCONFIDENT_NEES = float(chdtri(3, OVERCONFIDENCE_PROBABILITY))


def cross_and_roll_rad(
    cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation
) -> tuple[float, float]:
    """Cross-boresight (>= 0) and roll (signed) components of the attitude error, rad.

    The error is cam_from_ref_estimate * cam_from_ref_truth^-1 as a rotation vector in camera axes, with the boresight
    along z. Cross-boresight is hypot(x, y), roll is z.
    """
    x, y, z = (cam_from_ref_estimate * cam_from_ref_truth.inv()).as_rotvec()
    return float(np.hypot(x, y)), float(z)


def is_wrong(error_rad: float, nees: float = np.inf) -> bool:
    """Whether an attitude is worse than none: off by more than ten arcminutes, and by more than the tracker claims.

    A few LEDs of an imperfect survey give a roll that is uncertain by many arcminutes. If the covariance allows the
    error (chi-square with three degrees of freedom, probability 1e-8), the limit is one degree.

    Parameters
    ----------
    error_rad
        The rotation angle between estimate and truth
    nees
        `normalized_error_squared` of the estimate; infinite without a covariance
    """
    return bool(
        error_rad > (WRONG_RAD if nees > OVERCONFIDENT_NEES else WRONG_AS_CLAIMED_RAD)
    )


def normalized_error_squared(
    cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation, covariance_rad2: Floats
) -> float:
    """NEES: e^T P^-1 e, with e the error rotation vector in camera axes.

    Chi-square distributed with three degrees of freedom if the covariance is correct.
    """
    error = (cam_from_ref_estimate * cam_from_ref_truth.inv()).as_rotvec()
    return float(error @ np.linalg.solve(covariance_rad2, error))


# Statistics of a sample.

CONFIDENCE = 0.95
TAILS = (
    (1 - CONFIDENCE) / 2,
    (1 + CONFIDENCE) / 2,
)  # probabilities below the ends of an interval
# Half of the interval of a normal variable, in sigmas.
SIGMAS = float(scipy.special.ndtri((1 + CONFIDENCE) / 2))
MOST_TRIALS = 10**9  # greatest number of trials that `trials_needed` considers
FEWEST = 30  # values of which a verdict is given; with fewer its interval may be too narrow
RESAMPLES = 999
MANY_VALUES = 2000  # beyond, the bootstrap is `bootstrap_of_many`
EXTREMES = 50  # values that it draws one by one, at most
RANK_SIGMAS = 12  # ranks farther from their mean have a probability below 1e-30


def joint_sigmas(count: int) -> float:
    """SIGMAS for intervals at CONFIDENCE of so many statistics together (Bonferroni 1936)."""
    return float(scipy.special.ndtri(1 - TAILS[0] / count))


class Summary(NamedTuple):
    """A statistic and its confidence interval at CONFIDENCE, NaN if it has none.

    Attributes
    ----------
    trials
        Number of values
    needs
        How many more values an interval requires, 0 if more would not give one
    """

    value: float
    low: float
    high: float
    trials: int
    needs: int = 0


NO_VALUE = Summary(math.nan, math.nan, math.nan, 0)


def proportion(hits: Any, total: Any) -> Summary:
    """The proportion hits / total with Wilson's interval (Wilson 1927).

    At 0 and at 1 there is one end only: the exact one-sided bound (`exact_bounds`), which every claim that an event
    never occurs uses too.
    """
    if total < 1:
        return NO_VALUE
    if hits in (0, total):
        return Summary(float(hits / total), *exact_bounds(int(hits), int(total)), int(total))
    value = float(hits / total)
    z2 = SIGMAS**2
    scale = 1 + z2 / total
    middle = (value + z2 / (2 * total)) / scale
    half = SIGMAS / scale * math.sqrt(value * (1 - value) / total + z2 / (4 * total**2))
    return Summary(value, middle - half, middle + half, int(total))


@lru_cache(maxsize=4096)
def exact_bounds(
    hits: float, total: float, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """One-sided bounds of a proportion, each at this confidence (Clopper & Pearson 1934).

    The upper one is the p for which hits or fewer of total have the probability 1 - confidence, the lower one
    likewise for hits or more; quantiles of beta distributions. With hits = 0 the upper bound is
    1 - (1 - confidence)^(1 / total): at 95 % about 3 / total.
    """
    error = 1 - confidence
    low = float(scipy.stats.beta.ppf(error, hits, total - hits + 1)) if hits else 0.0
    high = float(scipy.stats.beta.isf(error, hits + 1, total - hits)) if hits < total else 1.0
    return low, high


def trials_needed(limit: float, events: float = 0, share: float = 0.0) -> int:
    """Fewest trials n, with events + share n events, whose exact upper bound of their proportion is at most `limit`.

    Without an event it is n = ln(1 - CONFIDENCE) / ln(1 - limit), rounded up. 0 if MOST_TRIALS are too few.
    """

    def certain(count: int) -> bool:
        return exact_bounds(events + share * count, count)[1] <= limit

    if not certain(MOST_TRIALS):
        return 0
    return bisect.bisect_left(range(MOST_TRIALS), True, lo=1, key=certain)


def resampled(values: Floats, statistic: Callable[..., Any]) -> Summary:
    """A statistic with the percentile bootstrap interval (Efron 1979); the resampling seed is fixed.

    Equal values have an interval of zero width; a single value has none.
    """
    value = float(statistic(values))
    if len(values) < 2 or np.ptp(values) == 0:
        return without_resampling(values, value)
    batch = max(
        1, 2_000_000 // len(values)
    )  # limits the memory of a batch to two million values
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


def without_resampling(values: Floats, value: float) -> Summary:
    """The summary of fewer than two values, or of equal ones."""
    count = len(values)
    return (
        Summary(value, math.nan, math.nan, count, 2 - count)
        if count < 2
        else Summary(value, value, value, count)
    )


def mean_of(values: Floats) -> Summary:
    """The mean with its bootstrap interval: that of `resampled`, or beyond MANY_VALUES of `bootstrap_of_many`."""
    return (
        bootstrap_of_few(values) if len(values) <= MANY_VALUES else bootstrap_of_many(values)
    )


def rms_of(values: Floats) -> Summary:
    """The RMS likewise: the root of the mean of the squares, and of the ends of its interval."""
    if len(values) <= MANY_VALUES:
        return bootstrap_of_few(np.square(values), np.sqrt)
    squares = bootstrap_of_many(np.square(values))
    return Summary(
        math.sqrt(squares.value),
        math.sqrt(squares.low),
        math.sqrt(squares.high),
        squares.trials,
    )


def bootstrap_of_few(values: Floats, function: Callable[[Any], Any] = np.positive) -> Summary:
    """A function of the mean, with the interval of `resampled` from the same draws.

    A resample's sum is that of the values times how often it draws each, and the seed is fixed, so these numbers are
    the same for all samples of a size.
    """
    count = len(values)
    value = float(function(np.mean(values)))
    if count < 2 or np.ptp(values) == 0:
        return without_resampling(values, value)
    low, high = np.quantile(function(values @ resampling_counts(count) / count), TAILS)
    return Summary(value, float(low), float(high), count)


@lru_cache(maxsize=64)
def resampling_counts(count: int) -> NDArray[np.uint8]:
    """(count, RESAMPLES) how often each resample has drawn each value."""
    drawn = (
        random_stream(1).integers(0, count, (RESAMPLES, count))
        + count * np.arange(RESAMPLES)[:, None]
    )
    counts = np.bincount(drawn.ravel(), minlength=RESAMPLES * count)
    return np.ascontiguousarray(counts.reshape(RESAMPLES, count).T, dtype=np.uint8)


def bootstrap_of_many(values: Floats) -> Summary:
    """The mean of many values with the percentile bootstrap interval, in a time of one pass over them.

    A resample takes value i w_i times, with multinomial counts of sum n. Those of the EXTREMES values farthest from the
    mean, or of fewer if others are as far, are drawn: for n >> EXTREMES they are independent Poisson variables of mean
    1 (Hanley & MacGibbon 2006). The sum over the others, of mean m and standard deviation s, is normal by the central
    limit theorem, since these have no outliers. So the mean of a resample is

        m + (sum_i w_i (x_i - m) + s sqrt(n - sum_i w_i) z) / n,    i over the extremes, z standard normal.

    Few wrong attitudes with errors of degrees among many of arcseconds thus have the skew interval of the bootstrap,
    which the normal interval of the mean misses.
    """
    count = len(values)
    mean = float(np.mean(values))
    distance = np.abs(values - mean)
    inner = distance <= np.partition(distance, count - EXTREMES)[count - EXTREMES]
    others = values[inner]
    extremes = values[~inner]
    middle = float(np.mean(others))
    spread = float(np.std(others))
    weights, normal = resampling_draws()
    weights = weights[:, : len(extremes)]
    left = np.maximum(count - weights.sum(axis=1), 0)
    means = middle + (weights @ (extremes - middle) + spread * np.sqrt(left) * normal) / count
    low, high = np.quantile(means, TAILS)
    return Summary(mean, float(low), float(high), count)


@lru_cache(maxsize=1)
def resampling_draws() -> tuple[Floats, Floats]:
    """(RESAMPLES, EXTREMES) counts and (RESAMPLES,) normal variables of `bootstrap_of_many`; the seed is fixed."""
    rng = random_stream(2)
    return rng.poisson(1.0, (RESAMPLES, EXTREMES)).astype(float), rng.standard_normal(
        RESAMPLES
    )


def quantile(values: Floats, probability: float) -> Summary:
    """The quantile at the given probability with a distribution-free interval between two order statistics.

    Too few values have no interval; `needs` is how many more it takes: 59 in all for the 95% quantile.
    """
    count = len(values)
    value = float(np.quantile(values, probability)) if count else math.nan
    ranks = quantile_ranks(count, probability)
    if ranks is None:
        return Summary(
            value, math.nan, math.nan, count, values_for_quantile(probability) - count
        )
    low, high = np.partition(values, ranks)[list(ranks)]
    return Summary(value, float(low), float(high), count)


@lru_cache(maxsize=4096)
def quantile_ranks(count: int, probability: float) -> tuple[int, int] | None:
    """Ranks r < s, from 0, of the two order statistics between which the quantile is with CONFIDENCE; None if none are.

    The number of values below the quantile q is binomial, so that (David & Nagaraja 2003, section 7.1)

        P(X_(r) <= q <= X_(s)) >= B(s - 1) - B(r - 1),    ranks from 1, B the distribution function of Bin(n, p).

    Among the pairs of sufficient confidence the result has the fewest values between its ranks; among equal ones, its
    two tails differ least.
    """
    middle = count * probability
    spread = math.sqrt(count * probability * (1 - probability))
    first = max(int(middle - RANK_SIGMAS * spread) - 1, 0)
    last = min(int(middle + RANK_SIGMAS * spread) + 2, count - 1)
    # B(r - 1) of each rank r, from 1.
    below = scipy.stats.binom.cdf(np.arange(first, last + 1), count, probability)
    highs = np.searchsorted(below, below + (CONFIDENCE - 1e-12))
    lows = np.flatnonzero(highs < len(below))
    if not len(lows):
        return None
    highs = highs[lows]
    best = np.lexsort((np.abs(below[lows] - (1 - below[highs])), highs - lows))[0]
    return first + int(lows[best]), first + int(highs[best])


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


def sample_std(values: Floats, axis: int = -1) -> Any:
    """Standard deviation of a sample, with n - 1."""
    return np.std(values, axis=axis, ddof=min(1, values.shape[axis] - 1))


# Responses: statistics over trials. Each trial is a row; the columns are arrays, NaN where it has no such value.

Columns = Mapping[str, NDArray[Any]]
DEFAULT_COVERAGE = 5  # "5 stars everywhere" (Padro 2012)
Response = Callable[[Columns], Summary]

QUANTILES = {"median": 0.5, "p90": 0.9, "p95": 0.95, "p99": 0.99}
# The ending of a response name such as `cross_arcsec_p95`.
STATISTICS: dict[str, Callable[[Floats], Summary]] = {
    "mean": mean_of,
    "rms": rms_of,
    "sd": lambda values: resampled(values, sample_std),
    **{
        name: lambda values, share=share: quantile(values, share)  # type: ignore[misc]
        for name, share in QUANTILES.items()
    },
    "worst": lambda values: extremum(values, np.max),
    "least": lambda values: extremum(values, np.min),
}
# The beginning of a response name. Errors are taken as magnitudes.
QUANTITIES: dict[str, Callable[[Columns], NDArray[Any]]] = {
    "cross_arcsec": lambda c: np.hypot(c["x_arcsec"], c["y_arcsec"]),
    "roll_arcsec": lambda c: np.abs(c["roll_arcsec"]),
    "angle_arcsec": lambda c: np.sqrt(
        c["x_arcsec"] ** 2 + c["y_arcsec"] ** 2 + c["roll_arcsec"] ** 2
    ),
    **{
        name: lambda c, name=name: np.asarray(c[name])  # type: ignore[misc]
        for name in (
            "nees",
            "stars",
            "detected",
            "matched",
            "centroid_px",
            "lights_detected",
            "false_detections",
            "streak_px",
            "availability",
            "filter_arcsec",
            "filter_worst_arcsec",
            "drift_arcsec",
            "pointing_arcsec",
            "pointing_worst_arcsec",
            "saturated_s",
            "angles_compared",
            "exposure_ms",
            "time_ms",
            "detect_ms",
            "computer_ms",
        )
    },
}


# Quantities of which more is better; of all others, less.
MORE_IS_BETTER = ("stars", "detected", "lights_detected", "matched", "availability")
# Quantities that are responses by themselves, with the statistic that this name stands for.
DEFAULT_STATISTICS = {"nees": "mean", "centroid_px": "rms", "streak_px": "median"}


# Share of the variance by one survey from which trials that share it cannot tell whether claims are true: its three
# angles are one draw, so that a mean NEES errs by about this share.
ONE_SURVEY = 0.1


def mean_nees(c: Columns) -> Summary:
    """The mean NEES with an interval that covers it for few trials too: f mean / E is chi-square with f degrees.

    A true covariance has f = 3 for each solution. Where attitudes differ, or the solutions of a flight are correlated,
    the n trials vary more: f = 2 n mean^2 / s^2 (Satterthwaite 1946), if it is less.
    """
    known = np.isfinite(c["nees"])
    values = c["nees"][known]
    count = len(values)
    if count < 2:
        return without_resampling(values, float(values[0])) if count else NO_VALUE
    mean = float(np.mean(values))
    freedom = 3 * float(np.sum(c["solved"][known]))
    if spread := float(np.var(values, ddof=1)):
        freedom = min(freedom, 2 * count * mean**2 / spread)
    low, high = (mean * freedom / chdtri(freedom, TAILS)).tolist()
    return Summary(mean, low, high, count)


def overconfident(c: Columns) -> Summary:
    """Proportion of the solutions whose NEES exceeds the chi-square limit at probability 1e-8.

    Causes are wrong identifications and errors that the covariance does not model.
    """
    # For a trial of many frames the column holds a mean NEES, which has another distribution.
    solved = np.isfinite(c["nees"]) & (c["frames"] == 1)
    return proportion(np.sum(c["nees"][solved] > OVERCONFIDENT_NEES), np.sum(solved))


def proportion_of_frames(hits: NDArray[Any], frames: NDArray[Any]) -> Summary:
    """A proportion of all frames.

    The frames of one simulated run are correlated. Where trials have many frames, the interval is therefore that of
    as many independent samples as there are runs, widened if necessary to include the value.
    """
    known = np.isfinite(hits)  # an external tracker does not say which lights it identified
    hits = hits[known]
    frames = frames[known]
    summary = proportion(np.sum(hits), np.sum(frames))
    if not len(frames) or np.max(frames) <= 1:
        return summary
    runs = int(np.sum(frames > 0))
    of_runs = proportion(round(summary.value * runs), runs)
    low = min(of_runs.low, summary.value)
    high = max(of_runs.high, summary.value)
    return summary._replace(low=low, high=high, trials=runs)


def frames_with(name: str) -> Response:
    """The proportion of the frames that a column counts."""
    return lambda c: proportion_of_frames(c[name], c["frames"])


def mismatched(c: Columns) -> Summary:
    """Proportion of all matches of lights with stars or LEDs that are wrong.

    Matches of one frame are not independent, so it has no interval.
    """
    known = np.isfinite(c["wrong_matches"]) & np.isfinite(c["matched"])
    # `matched` is a mean over the frames of a flight.
    matches = np.sum(c["matched"][known] * c["frames"][known])
    if not matches:
        return NO_VALUE
    return Summary(
        float(np.sum(c["wrong_matches"][known]) / matches), math.nan, math.nan, round(matches)
    )


PROPORTIONS: dict[str, Response] = {
    "overconfident": overconfident,
    "identified": lambda c: proportion_of_frames(c["solved"] - c["wrong"], c["frames"]),
    "wrong": frames_with("wrong"),
    "refused": lambda c: proportion_of_frames(c["frames"] - c["solved"], c["frames"]),
    "ambiguous": frames_with("ambiguous"),
    "misidentified": frames_with("misidentified"),
    "misled": frames_with("misled"),
    "mismatched": mismatched,
    "roll_noise": frames_with("roll_noise"),
    "failed": lambda c: proportion(np.sum(c["frames"] == 0), len(c["frames"])),
}
COVERAGE = re.compile(r"coverage(?:_(\d+))?$")


def response(name: str, where: str = "response") -> Response:
    """The function that computes the named statistic from the columns of trials. Raises InputError for other names.

    otherwise a quantity and a statistic: stars_least, cross_arcsec_p95 (over all solutions, wrong ones included)

    Returns
    -------
    identified, wrong, refused
        Proportions of the frames: solved and not wrong (`is_wrong`), wrong, without a solution
    ambiguous
        Proportion of the frames refused because another attitude fits the lights as well (LEDs
        only)
    misidentified
        Proportion of the frames solved with a light that is matched with a wrong star or LED
    misled
        Proportion of the frames that are misidentified and have an error that the covariance
        does not allow
    mismatched
        Proportion of the matches that are wrong, of all frames; without an interval
    roll_noise
        Proportion of the frames solved with the right lights and a roll error beyond ten
        arcminutes that the tracker's covariance allows
    overconfident
        Proportion of the solutions with an error far outside their covariance
    failed
        Proportion of the trials that raised an exception
    coverage_N
        Proportion of the trials with at least N sources in the field of view; N is 5 if omitted
    nees, centroid_px, streak_px
        nees_mean, centroid_px_rms, streak_px_median
    """
    if name in PROPORTIONS:
        return PROPORTIONS[name]
    if match := COVERAGE.match(name):
        least = int(match[1] or DEFAULT_COVERAGE)
        return lambda c: proportion(
            np.sum(c["stars"][c["frames"] > 0] >= least), np.sum(c["frames"] > 0)
        )
    quantity, statistic = split_name(name)
    if (quantity, statistic) == ("nees", "mean"):
        return mean_nees
    if quantity not in QUANTITIES or statistic not in STATISTICS:
        raise InputError(
            where,
            f"unknown response {name!r}",
            f"{', '.join(PROPORTIONS)}, coverage, coverage_N, {', '.join(DEFAULT_STATISTICS)}, or one of"
            f" {', '.join(QUANTITIES)} with _{', _'.join(STATISTICS)}",
        )

    def summarize(columns: Columns) -> Summary:
        values = QUANTITIES[quantity](columns)
        values = values[np.isfinite(values)].astype(float)
        return STATISTICS[statistic](values) if len(values) else NO_VALUE

    return summarize


def split_name(name: str) -> tuple[str, str]:
    """Quantity and statistic of a response such as `cross_arcsec_p95`; empty quantity for a proportion."""
    if name in DEFAULT_STATISTICS:
        return name, DEFAULT_STATISTICS[name]
    quantity, _, statistic = name.rpartition("_")
    return quantity, statistic


def is_proportion(name: str) -> bool:
    """Whether a response is a proportion between 0 and 1."""
    return (
        name in PROPORTIONS
        or bool(COVERAGE.match(name))
        or split_name(name)[0] == "availability"
    )
