"""Attitude error metrics, and statistics over many trials with confidence intervals. Pure functions.

A statistic is named by a string (`response`), for example `cross_arcsec_p95` or `coverage_5`. Each is computed from
the columns of a table of trials and returned with a 95% confidence interval: Wilson's interval for proportions, the
percentile bootstrap for means and RMS (of many values a faster one, `bootstrap_of_many`), and order statistics for
quantiles. That of a mean NEES is of a chi-square variable. Clopper and Pearson's exact bounds are used
where a claim must hold: that an event never occurs (or always), or that a proportion is on one side of a limit.
"""

import bisect
import math
import re
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Array, Floats

WRONG_RAD = np.radians(10 / 60)  # limit of PTASE for a wrong attitude: ten arcminutes
WRONG_AS_CLAIMED_RAD = np.radians(1)  # limit for an error that the covariance allows
# Probability with which a correct covariance allows an error that is counted as overconfident.
OVERCONFIDENCE_PROBABILITY = 1e-8
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
# Probabilities below the ends of an interval.
TAILS = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
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
    low: float = math.nan
    high: float = math.nan
    trials: int = 0
    needs: int = 0


NO_VALUE = Summary(math.nan)


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
    # The memory of a batch is that of two million values.
    batch = max(1, 2_000_000 // len(values))
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
        Summary(value, trials=count, needs=2 - count)
        if count < 2
        else Summary(value, value, value, count)
    )


def mean_of(values: Floats, function: Callable[[Any], Any] = np.positive) -> Summary:
    """A function of the mean with its bootstrap interval: of `resampled`, or beyond MANY_VALUES `bootstrap_of_many`.

    The draws are those of `resampled`: a resample's sum is that of the values times how often it draws each, and the
    seed is fixed, so these numbers are the same for all samples of a size.
    """
    count = len(values)
    if count > MANY_VALUES:
        found = bootstrap_of_many(values)
        value, low, high = map(float, function(found[:3]))
        return found._replace(value=value, low=low, high=high)
    value = float(function(np.mean(values)))
    if count < 2 or np.ptp(values) == 0:
        return without_resampling(values, value)
    means = function(values @ resampling_counts(count) / count)
    low, high = np.quantile(means, TAILS).tolist()
    return Summary(value, low, high, count)


@lru_cache(maxsize=64)
def resampling_counts(count: int) -> Array[np.uint8]:
    """(count, RESAMPLES) how often each resample has drawn each value."""
    drawn = random_stream(1).integers(0, count, (RESAMPLES, count))
    drawn += count * np.arange(RESAMPLES)[:, None]
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
    weights, normal = resampling_draws()
    weights = weights[:, : len(extremes)]
    left = np.maximum(count - weights.sum(axis=1), 0)
    middle = float(np.mean(others))
    scatter = float(np.std(others)) * np.sqrt(left) * normal
    means = middle + (weights @ (extremes - middle) + scatter) / count
    low, high = np.quantile(means, TAILS).tolist()
    return Summary(mean, low, high, count)


@lru_cache(maxsize=1)
def resampling_draws() -> tuple[Floats, Floats]:
    """(RESAMPLES, EXTREMES) counts and (RESAMPLES,) normal variables of `bootstrap_of_many`; the seed is fixed."""
    rng = random_stream(2)
    counts = rng.poisson(1.0, (RESAMPLES, EXTREMES)).astype(float)
    return counts, rng.standard_normal(RESAMPLES)


def quantile(values: Floats, probability: float) -> Summary:
    """The quantile at the given probability with a distribution-free interval between two order statistics.

    Too few values have no interval; `needs` is how many more it takes: 59 in all for the 95% quantile.
    """
    count = len(values)
    value = float(np.quantile(values, probability)) if count else math.nan
    ranks = quantile_ranks(count, probability)
    if ranks is None:
        needs = values_for_quantile(probability) - count
        return Summary(value, trials=count, needs=needs)
    low, high = np.partition(values, ranks)[list(ranks)].tolist()
    return Summary(value, low, high, count)


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


def tolerance_limit(values: Floats, probability: float) -> Summary:
    """The upper tolerance limit: with CONFIDENCE at least this share of all values is below it, whatever their law.

    It is the least order statistic X_(s) that exceeds the quantile q with CONFIDENCE (Wilks 1941; David & Nagaraja
    2003, section 7.2),

        P(X_(s) >= q) = B(s - 1),    B the distribution function of Bin(n, p),

    of 59 values the largest at 95 % ("95/95"), of 93 the second largest. Fewer have none: NaN, and `needs`.
    """
    count = len(values)
    rank = int(scipy.stats.binom.ppf(CONFIDENCE, count, probability))  # s - 1
    limit = float(np.sort(np.append(values, np.nan))[rank])  # NaN is the last
    needs = max(trials_needed(1 - probability) - count, 0)
    return Summary(limit, trials=count, needs=needs)


def rms(values: Floats) -> Any:
    """sqrt(mean(x^2)) along the last axis."""
    return np.sqrt(np.mean(np.square(values), axis=-1))


def sample_std(values: Floats, axis: int = -1) -> Any:
    """Standard deviation of a sample, with n - 1."""
    return np.std(values, axis=axis, ddof=min(1, values.shape[axis] - 1))


# Responses: statistics over trials. Each trial is a row; the columns are arrays, NaN where it has no such value.

Columns = Mapping[str, Array]
DEFAULT_COVERAGE = 5  # "5 stars everywhere" (Padro 2012)
Response = Callable[[Columns], Summary]

QUANTILES = {"median": 0.5, "p90": 0.9, "p95": 0.95, "p99": 0.99}
# Others by their digits: p997 is the quantile at 0.997, tol99 the tolerance limit of 99 %.
QUANTILE = re.compile(r"(?:p|tol)(?!0+$)(\d{2,5})$")
# The ending of a response name such as `cross_arcsec_p95`.
STATISTICS: dict[str, Callable[[Floats], Summary]] = {
    "mean": mean_of,
    "rms": lambda values: mean_of(np.square(values), np.sqrt),
    "sd": lambda values: resampled(values, sample_std),
    **{name: partial(quantile, probability=share) for name, share in QUANTILES.items()},
    "tol95": partial(tolerance_limit, probability=0.95),
    "worst": lambda values: Summary(float(np.max(values)), trials=len(values)),
    "least": lambda values: Summary(float(np.min(values)), trials=len(values)),
}
# Quantities that only flights have.
FLIGHT_QUANTITIES = (
    "availability",
    "filter_arcsec",
    "filter_worst_arcsec",
    "drift_arcsec",
    "pointing_arcsec",
    "pointing_worst_arcsec",
    "saturated_s",
    "exposure_ms",
)
# The beginning of a response name. Errors are taken as magnitudes.
QUANTITIES: dict[str, Callable[[Columns], Array]] = {
    "cross_arcsec": lambda c: np.hypot(c["x_arcsec"], c["y_arcsec"]),
    "roll_arcsec": lambda c: np.abs(c["roll_arcsec"]),
    "angle_arcsec": lambda c: np.sqrt(
        c["x_arcsec"] ** 2 + c["y_arcsec"] ** 2 + c["roll_arcsec"] ** 2
    ),
    **{
        name: itemgetter(name)
        for name in (
            "nees",
            "stars",
            "detected",
            "matched",
            "centroid_px",
            "lights_detected",
            "false_detections",
            "streak_px",
            *FLIGHT_QUANTITIES,
            "angles_compared",
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


def proportion_of_frames(hits: Array, frames: Array) -> Summary:
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
    share = float(np.sum(c["wrong_matches"][known]) / matches)
    return Summary(share, trials=round(matches))


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
WITHIN = re.compile(r"right_within(?:_(?:cross|roll|angle)_arcsec_\d+(?:\.\d+)?)+$")
LIMIT = re.compile(r"((?:cross|roll|angle)_arcsec)_([\d.]+)")
OVER = re.compile(r"(\w+)_over_(\d[\d.e+-]*)$")


def right_within(name: str, c: Columns) -> Array:
    """(N,) whether each trial is solved in all frames, none of them wrong, with errors up to the limits in a name."""
    right = (c["frames"] > 0) & (c["solved"] == c["frames"]) & (c["wrong"] == 0)
    within = [QUANTITIES[error](c) <= float(limit) for error, limit in LIMIT.findall(name)]
    return np.all([right, *within], axis=0)


def response(name: str, where: str = "response") -> Response:
    """The function that computes the named statistic from the columns of trials. Raises InputError for other names.

    otherwise a quantity and a statistic: stars_least, cross_arcsec_p95 (over all solutions, wrong ones included)

    Returns
    -------
    identified, wrong, refused
        Proportions of the frames: solved and not wrong (`is_wrong`), wrong, without a solution
    ambiguous
        Proportion of the frames refused because another attitude fits the lights as well (LEDs only)
    misidentified
        Proportion of the frames solved with a light that is matched with a wrong star or LED
    misled
        Proportion of the frames that are misidentified and have an error that the covariance does not allow
    mismatched
        Proportion of the matches that are wrong, of all frames; without an interval
    roll_noise
        Proportion of the frames solved with the right lights and a roll error beyond ten arcminutes that the tracker's
        covariance allows
    overconfident
        Proportion of the solutions with an error far outside their covariance
    failed
        Proportion of the trials that raised an exception
    right_within_cross_arcsec_10, right_within_cross_arcsec_10_roll_arcsec_60
        Proportion of the trials that are solved, not wrong, and have errors up to the limits (of a flight: all frames,
        and the RMS errors)
    cross_arcsec_over_60
        Proportion of the values of a quantity that are above a limit
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
    if WITHIN.match(name):
        return lambda c: proportion(np.sum(right_within(name, c)), np.sum(c["frames"] > 0))
    quantity, statistic = split_name(name)
    if (quantity, statistic) == ("nees", "mean"):
        return mean_nees
    summary_of = statistic_of(statistic)
    if quantity not in QUANTITIES or summary_of is None:
        raise InputError(
            where,
            f"unknown response {name!r}",
            f"{', '.join(PROPORTIONS)}, coverage, coverage_N, {', '.join(DEFAULT_STATISTICS)}, or one of"
            f" {', '.join(QUANTITIES)} with _{', _'.join(STATISTICS)}, or right_within_cross_arcsec_10 or"
            " cross_arcsec_over_60 with limits",
        )

    def summarize(columns: Columns) -> Summary:
        values = QUANTITIES[quantity](columns)
        values = values[np.isfinite(values)].astype(float)
        return summary_of(values) if len(values) else NO_VALUE

    return summarize


def statistic_of(name: str) -> Callable[[Floats], Summary] | None:
    """The statistic with a name such as mean, p95, tol99 or over_60; None if there is none."""
    probability = probability_of(name)
    if probability is not None:
        function = tolerance_limit if name.startswith("tol") else quantile
        return partial(function, probability=probability)
    if name.startswith("over_"):
        return lambda values: proportion(np.sum(values > float(name[5:])), len(values))
    return STATISTICS.get(name)


def probability_of(statistic: str) -> float | None:
    """The probability of a quantile or a tolerance limit: 0.95 of p95 and tol95; None of other statistics."""
    match = QUANTILE.match(statistic)
    return float(f"0.{match[1]}") if match else QUANTILES.get(statistic)


def split_name(name: str) -> tuple[str, str]:
    """Quantity and statistic of a response such as `cross_arcsec_p95`; empty quantity for a proportion."""
    if name in DEFAULT_STATISTICS:
        return name, DEFAULT_STATISTICS[name]
    if match := OVER.match(name):
        return match[1], f"over_{match[2]}"
    quantity, _, statistic = name.rpartition("_")
    return quantity, statistic


def is_proportion(name: str) -> bool:
    """Whether a response is a proportion between 0 and 1."""
    limited = any(kind.match(name) for kind in (COVERAGE, WITHIN, OVER))
    return limited or name in PROPORTIONS or split_name(name)[0] == "availability"
