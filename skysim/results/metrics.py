"""Truth against estimate, and what many trials come to, with its interval. Pure functions."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Floats

WRONG_RAD = np.radians(10 / 60)  # PTASE's bar for a wrong attitude: ten arc-minutes


def cross_and_roll_rad(cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation) -> tuple[float, float]:
    """Attitude error split in two: across the boresight (>= 0) and about it (signed).

    The error rotation in camera axes, estimate after truth undone, as a rotation vector: hypot of its x and y,
    and its z.
    """
    x, y, z = (cam_from_ref_estimate * cam_from_ref_truth.inv()).as_rotvec()
    return float(np.hypot(x, y)), float(z)


def is_wrong(cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation) -> bool:
    """Whether an answer is worse than none: off by over ten arc-minutes in rotation angle."""
    return bool((cam_from_ref_estimate * cam_from_ref_truth.inv()).magnitude() > WRONG_RAD)


def normalised_error_squared(
    cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation, covariance_rad2: Floats
) -> float:
    """NEES: e^T P^-1 e, chi-square with three degrees of freedom where the covariance is true."""
    error = (cam_from_ref_estimate * cam_from_ref_truth.inv()).as_rotvec()
    return float(error @ np.linalg.solve(covariance_rad2, error))


# What many trials come to. A trial's outcome is a row; the columns are arrays, NaN where a trial has no such figure.

Columns = Mapping[str, NDArray[Any]]
CONFIDENCE = 0.95
RESAMPLES = 999
BEYOND = 1e-8  # of answers may be so far off by chance
FEWEST_STARS = 5  # "5 stars everywhere" (Padro 2012)


class Summary(NamedTuple):
    """A figure, its interval at CONFIDENCE (NaN where there is none) and over how many trials."""

    value: float
    low: float
    high: float
    trials: int


NOTHING = Summary(float("nan"), float("nan"), float("nan"), 0)
Response = Callable[[Columns], Summary]


def exact(value: float) -> Summary:
    """A figure that no chance had a part in."""
    return Summary(float(value), float(value), float(value), 1)


def share(hits: Any, of: Any) -> Summary:
    """hits / of with Wilson's interval (Wilson 1927), which holds at no hits and at none missed too."""
    if of < 1:
        return NOTHING
    found = scipy.stats.binomtest(int(hits), int(of)).proportion_ci(CONFIDENCE, "wilson")
    return Summary(float(hits / of), float(found.low), float(found.high), int(of))


def resampled(values: Floats, statistic: Callable[..., Any]) -> Summary:
    """A mean or the like, with the bootstrap's percentile interval (Efron 1979); always the same resamples."""
    value = float(statistic(values))
    if len(values) < 2 or np.ptp(values) == 0:
        return Summary(
            value, value if len(values) > 1 else np.nan, value if len(values) > 1 else np.nan, len(values)
        )
    batch = max(1, 2_000_000 // len(values))
    found = scipy.stats.bootstrap(
        (values,),
        statistic,
        n_resamples=RESAMPLES,
        batch=batch,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(1),
    )
    low, high = map(float, found.confidence_interval)
    return Summary(value, low, high, len(values))


def quantile(values: Floats, part: float) -> Summary:
    """A quantile with the interval between two of the ordered values that the binomial distribution gives (Conover
    1999, section 3.2): of no assumption; an end is infinite where there are too few values for it."""
    low, high = scipy.stats.quantile_test(values, p=part).confidence_interval(CONFIDENCE)
    ends = (float(low) if np.isfinite(low) else -np.inf, float(high) if np.isfinite(high) else np.inf)
    return Summary(float(np.quantile(values, part)), *ends, len(values))


def extreme(values: Floats, which: Callable[[Floats], Any]) -> Summary:
    """The worst or the least: of these trials, without an interval."""
    return Summary(float(which(values)), float("nan"), float("nan"), len(values))


def rms(values: Floats, axis: int = -1) -> Any:
    """sqrt(mean(x^2)) along the last axis."""
    return np.sqrt(np.mean(np.square(values), axis=axis))


# What a response such as `cross_arcsec_p95` ends in.
STATISTICS: dict[str, Callable[[Floats], Summary]] = {
    "mean": lambda values: resampled(values, np.mean),
    "rms": lambda values: resampled(values, rms),
    "median": lambda values: quantile(values, 0.5),
    "p90": lambda values: quantile(values, 0.9),
    "p95": lambda values: quantile(values, 0.95),
    "p99": lambda values: quantile(values, 0.99),
    "worst": lambda values: extreme(values, np.max),
    "least": lambda values: extreme(values, np.min),
}
# And what it begins with. Errors count by their size.
FIGURES: dict[str, Callable[[Columns], NDArray[Any]]] = {
    "cross_arcsec": lambda c: np.hypot(c["x_arcsec"], c["y_arcsec"]),
    "roll_arcsec": lambda c: np.abs(c["roll_arcsec"]),
    "angle_arcsec": lambda c: np.sqrt(c["x_arcsec"] ** 2 + c["y_arcsec"] ** 2 + c["roll_arcsec"] ** 2),
    **{
        name: lambda c, name=name: np.asarray(c[name])  # type: ignore[misc]
        for name in (
            *("nees", "stars", "detected", "matched", "availability"),
            *("filter_arcsec", "filter_worst_arcsec", "drift_arcsec", "time_ms"),
        )
    },
}


def overconfident(c: Columns) -> Summary:
    """Answers farther off than their covariance allows once in 10^8: wrong names, or errors not known of."""
    answered = np.isfinite(c["nees"]) & (c["frames"] == 1)  # a flight's NEES is a mean
    return share(np.sum(c["nees"][answered] > scipy.stats.chi2.isf(BEYOND, 3)), np.sum(answered))


def of_frames(hits: NDArray[Any], frames: NDArray[Any]) -> Summary:
    """A share of all frames. Those of a flight are like one another, so there the interval is of so many flights."""
    told = share(np.sum(hits), np.sum(frames))
    if not len(frames) or np.max(frames) <= 1:
        return told
    flights = int(np.sum(frames > 0))
    alike = share(round(told.value * flights), flights)
    return told._replace(low=min(alike.low, told.value), high=max(alike.high, told.value), trials=flights)


SHARES: dict[str, Response] = {
    "overconfident": overconfident,
    "identified": lambda c: of_frames(c["solved"] - c["wrong"], c["frames"]),
    "wrong": lambda c: of_frames(c["wrong"], c["frames"]),
    "refused": lambda c: of_frames(c["frames"] - c["solved"], c["frames"]),
    "failed": lambda c: share(np.sum(c["frames"] == 0), len(c["frames"])),
}
COVERAGE = re.compile(r"coverage(?:_(\d+))?$")


def response(name: str, where: str = "response") -> Response:
    """What makes a figure of trials' columns, by its name. Raises InputError for a name that is none.

    overconfident : share of the answers farther off than they claim
    identified, wrong, refused : shares of the frames: right within ten arc-minutes, wrong, neither
    failed     : share of the trials that raised
    coverage_N : share of the trials with at least N lights in the field, 5 if left out
    else a figure and a statistic: stars_least, cross_arcsec_p95 (of all answers, wrong ones too)
    """
    if name in SHARES:
        return SHARES[name]
    if told := COVERAGE.match(name):
        least = int(told[1] or FEWEST_STARS)
        return lambda c: share(np.sum(c["stars"][c["frames"] > 0] >= least), np.sum(c["frames"] > 0))
    figure, _, statistic = name.rpartition("_")
    if figure not in FIGURES or statistic not in STATISTICS:
        raise InputError(
            f"{where}: {name!r} is none of {', '.join(SHARES)}, coverage, coverage_N, or one of {', '.join(FIGURES)}"
            f" with _{', _'.join(STATISTICS)}"
        )

    def summarised(columns: Columns) -> Summary:
        values = FIGURES[figure](columns)
        values = values[np.isfinite(values)].astype(float)
        return STATISTICS[statistic](values) if len(values) else NOTHING

    return summarised
