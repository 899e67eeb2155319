"""Attitude error metrics, and the responses of studies: named statistics over many trials. Pure functions.

A response is named by a string (`response`), for example `cross_arcsec_p95` or `coverage_5`. It is computed from the
columns of a table of trials and returned with a 95% confidence interval (`skysim.results.statistics`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError, unknown_name
from skysim.core.types import Floats
from skysim.results.statistics import NO_VALUE, Summary, extremum, proportion, quantile, resampled, rms

WRONG_RAD = np.radians(10 / 60)  # limit of PTASE for a wrong attitude: ten arcminutes
WRONG_AS_CLAIMED_RAD = np.radians(1)  # limit for an error that the tracker's covariance allows
OVERCONFIDENCE_PROBABILITY = 1e-8  # with which a correct covariance allows an error counted as overconfident
OVERCONFIDENT_NEES = float(scipy.special.chdtri(3, OVERCONFIDENCE_PROBABILITY))


def cross_and_roll_rad(cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation) -> tuple[float, float]:
    """Cross-boresight (>= 0) and roll (signed) components of the attitude error, rad.

    The error is cam_from_ref_estimate * cam_from_ref_truth^-1 as a rotation vector in camera axes, with the boresight
    along z. Cross-boresight is hypot(x, y), roll is z.
    """
    x, y, z = (cam_from_ref_estimate * cam_from_ref_truth.inv()).as_rotvec()
    return float(np.hypot(x, y)), float(z)


def is_wrong(error_rad: float, nees: float = np.inf) -> bool:
    """Whether an attitude is worse than none: off by more than ten arcminutes, and by more than the tracker claims.

    error_rad : the rotation angle between estimate and truth
    nees      : `normalized_error_squared` of the estimate; infinite without a covariance

    A few LEDs of an imperfect survey give a roll that is uncertain by many arcminutes. If the covariance allows the
    error (chi-square with three degrees of freedom, probability 1e-8), the limit is one degree.
    """
    return bool(error_rad > (WRONG_RAD if nees > OVERCONFIDENT_NEES else WRONG_AS_CLAIMED_RAD))


def normalized_error_squared(
    cam_from_ref_estimate: Rotation, cam_from_ref_truth: Rotation, covariance_rad2: Floats
) -> float:
    """NEES: e^T P^-1 e, with e the error rotation vector in camera axes.

    Chi-square distributed with three degrees of freedom if the covariance is correct.
    """
    error = (cam_from_ref_estimate * cam_from_ref_truth.inv()).as_rotvec()
    return float(error @ np.linalg.solve(covariance_rad2, error))


# Statistics over many trials. Each trial is a row; the columns are arrays, NaN where a trial has no such value.

Columns = Mapping[str, NDArray[Any]]
DEFAULT_COVERAGE = 5  # "5 stars everywhere" (Padro 2012)
Response = Callable[[Columns], Summary]

# The ending of a response name such as `cross_arcsec_p95`.
STATISTICS: dict[str, Callable[[Floats], Summary]] = {
    "mean": lambda values: resampled(values, np.mean),
    "rms": lambda values: resampled(values, rms),
    "median": lambda values: quantile(values, 0.5),
    "p90": lambda values: quantile(values, 0.9),
    "p95": lambda values: quantile(values, 0.95),
    "p99": lambda values: quantile(values, 0.99),
    "worst": lambda values: extremum(values, np.max),
    "least": lambda values: extremum(values, np.min),
}
# The beginning of a response name. Errors are taken as magnitudes.
QUANTITIES: dict[str, Callable[[Columns], NDArray[Any]]] = {
    "cross_arcsec": lambda c: np.hypot(c["x_arcsec"], c["y_arcsec"]),
    "roll_arcsec": lambda c: np.abs(c["roll_arcsec"]),
    "angle_arcsec": lambda c: np.sqrt(c["x_arcsec"] ** 2 + c["y_arcsec"] ** 2 + c["roll_arcsec"] ** 2),
    **{
        name: lambda c, name=name: np.asarray(c[name])  # type: ignore[misc]
        for name in (
            *("nees", "stars", "detected", "matched", "centroid_px", "streak_px", "availability"),
            *("filter_arcsec", "filter_worst_arcsec", "drift_arcsec", "time_ms"),
        )
    },
}


MORE_IS_BETTER = ("stars", "detected", "matched", "availability")  # quantities; of others less is better
# Quantities that are responses by themselves, with the statistic that this name stands for.
DEFAULT_STATISTICS = {"nees": "mean", "centroid_px": "rms", "streak_px": "median"}


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
    hits, frames = hits[known], frames[known]
    summary = proportion(np.sum(hits), np.sum(frames))
    if not len(frames) or np.max(frames) <= 1:
        return summary
    runs = int(np.sum(frames > 0))
    of_runs = proportion(round(summary.value * runs), runs)
    low, high = min(of_runs.low, summary.value), max(of_runs.high, summary.value)
    return summary._replace(low=low, high=high, trials=runs)


PROPORTIONS: dict[str, Response] = {
    "overconfident": overconfident,
    "identified": lambda c: proportion_of_frames(c["solved"] - c["wrong"], c["frames"]),
    "wrong": lambda c: proportion_of_frames(c["wrong"], c["frames"]),
    "refused": lambda c: proportion_of_frames(c["frames"] - c["solved"], c["frames"]),
    "ambiguous": lambda c: proportion_of_frames(c["ambiguous"], c["frames"]),
    "misidentified": lambda c: proportion_of_frames(c["misidentified"], c["frames"]),
    "roll_noise": lambda c: proportion_of_frames(c["roll_noise"], c["frames"]),
    "failed": lambda c: proportion(np.sum(c["frames"] == 0), len(c["frames"])),
}
COVERAGE = re.compile(r"coverage(?:_(\d+))?$")


def response(name: str, where: str = "response") -> Response:
    """The function that computes the named statistic from the columns of trials. Raises InputError for other names.

    identified, wrong, refused : proportions of the frames: solved and not wrong (`is_wrong`), wrong, without a solution
    ambiguous     : proportion of the frames refused because another attitude fits the lights as well (LEDs only)
    misidentified : proportion of the frames solved with a light that is matched with a wrong star or LED
    roll_noise    : proportion of the frames solved with the right lights and a roll error beyond ten arcminutes that
                    the tracker's covariance allows
    overconfident : proportion of the solutions with an error far outside their covariance
    failed        : proportion of the trials that raised an exception
    coverage_N    : proportion of the trials with at least N sources in the field of view; N is 5 if omitted
    otherwise a quantity and a statistic: stars_least, cross_arcsec_p95 (over all solutions, wrong ones included)
    nees, centroid_px, streak_px : nees_mean, centroid_px_rms, streak_px_median
    """
    if name in PROPORTIONS:
        return PROPORTIONS[name]
    if match := COVERAGE.match(name):
        least = int(match[1] or DEFAULT_COVERAGE)
        return lambda c: proportion(np.sum(c["stars"][c["frames"] > 0] >= least), np.sum(c["frames"] > 0))
    quantity, statistic = split_name(name)
    if quantity not in QUANTITIES or statistic not in STATISTICS:
        raise InputError(
            f"{where}: {unknown_name('response', name, PROPORTIONS)}, coverage, coverage_N,"
            f" {', '.join(DEFAULT_STATISTICS)}, or one of"
            f" {', '.join(QUANTITIES)} with _{', _'.join(STATISTICS)}"
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
    return name in PROPORTIONS or bool(COVERAGE.match(name)) or split_name(name)[0] == "availability"
