"""Comparison of our results with published numbers; the verdict follows from the numbers alone.

A published number has a tolerance, which gives a band; ours has an interval of 95 %. The verdict is `agrees` if the
interval and the band overlap; `explained` if they overlap only after a named cause is simulated too (for instance a
fault of the paper's laboratory); else `disagrees`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.special import stdtrit

from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.papers.published import Experiment, PublishedRow
from skysim.results import metrics
from skysim.results.metrics import CONFIDENCE, RESAMPLES, Summary

Verdict = Literal["agrees", "explained", "disagrees"]
VERDICTS: tuple[Verdict, ...] = ("agrees", "explained", "disagrees")


@dataclass(frozen=True, slots=True)
class ExperimentOptions:
    """Options of an experiment.

    Attributes
    ----------
    quick
        Fewer trials, wider intervals
    seed
        Of all its random streams
    watch
        Progress callback, called with (completed, total)
    """

    quick: bool = False
    seed: int = 1
    watch: Callable[[float, float], None] = lambda completed, total: None

    def trials(self, full: int, quick: int) -> int:
        """Number of trials: `full`, or `quick` with the option quick."""
        return quick if self.quick else full


class Cause(NamedTuple):
    """A property of the paper's laboratory that our baseline lacks: its name, and our number with it simulated too."""

    name: str
    ours: Summary


class RowResult(NamedTuple):
    """Our number for a published row; a cause if the baseline alone does not reproduce it."""

    ours: Summary
    note: str = ""
    cause: Cause | None = None


Results = dict[
    str, RowResult | Summary
]  # by the key of the published row; a number alone needs no note


def with_cause(
    cause: str, statistic: Callable[[Any], Summary], ours: Any, theirs: Any, *, note: str = ""
) -> RowResult:
    """A statistic of our baseline's values, and of the values that were simulated with a cause too."""
    return RowResult(statistic(ours), note, Cause(cause, statistic(theirs)))


class FigureDrawing(NamedTuple):
    """A figure of our data: draw(figure) draws into an empty matplotlib figure of that size."""

    caption: str
    draw: Callable[[Any], None]
    size_in: tuple[float, float] = (7.4, 3.9)


class ExperimentResult(NamedTuple):
    """Results of an experiment: one for every published row, by key, and figures."""

    results: Mapping[str, RowResult | Summary]
    drawings: tuple[FigureDrawing, ...] = ()


class Comparison(NamedTuple):
    """One row of the table: published number, ours and the verdict."""

    id: str
    row: PublishedRow
    result: RowResult
    verdict: Verdict

    @property
    def note(self) -> str:
        """Remarks: our number with the cause, the weakness of the comparison, and notes of experiment and data."""
        cause = self.result.cause
        with_cause = f"with {cause.name}: {format_summary(cause.ours)}" if cause else ""
        notes = (with_cause, self.weakness, self.result.note, self.row.note)
        return "; ".join(note for note in notes if note)

    @property
    def weakness(self) -> str:
        """Why the interval leaves the verdict open, or "": it is wider than the band, or contains a one-sided bound."""
        cause = self.result.cause
        (low, high) = self.row.band
        if self.verdict == "disagrees":
            return ""
        ours = cause.ours if cause and self.verdict == "explained" else self.result.ours
        if low > -math.inf and high < math.inf:
            return (
                "interval wider than the tolerance"
                if ours.high - ours.low > high - low
                else ""
            )
        bound = low if low > -math.inf else high
        return "the bound is within the interval" if ours.low < bound < ours.high else ""

    def as_dict(self) -> dict[str, Any]:
        """For JSON. A bound is published as [least, most], an open end as null."""
        row = self.row
        ours = self.result.ours
        bounds = [row.at_least, row.at_most]
        return {
            "id": self.id,
            "quantity": row.quantity,
            "published": bounds if row.published is None else row.published,
            "ours": ours.value,
            "interval": [ours.low, ours.high],
            "tolerance": row.tolerance,
            "verdict": self.verdict,
            "note": self.note,
        }


@dataclass(frozen=True, slots=True)
class Reproduction:
    """A reproduced experiment: the published data, the comparison of each row, figures, and run time in seconds."""

    id: str
    published: Experiment
    comparisons: tuple[Comparison, ...]
    drawings: tuple[FigureDrawing, ...]
    seconds: float = field(compare=False)

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows by verdict, of rows with a derived number (`derived`), and of open verdicts (`open`)."""
        counts = dict.fromkeys((*VERDICTS, "derived", "open"), 0)
        for one in self.comparisons:
            counts[one.verdict] += 1
            counts["derived"] += one.row.derived
            counts["open"] += bool(one.weakness)
        return counts


def compare(
    id: str, published: Experiment, experiment: ExperimentResult, seconds: float
) -> Reproduction:
    """Compare every published row with our result.

    Raises
    ------
    ValueError
        If the experiment has no result for a row, or a result for a row that is not published.
    """
    if unmatched := published.rows.keys() ^ experiment.results.keys():
        raise ValueError(
            f"{id}: rows that are only published or only computed: {', '.join(sorted(unmatched))}"
        )
    comparisons = []
    for key, row in published.rows.items():
        ours = experiment.results[key]
        result = ours if isinstance(ours, RowResult) else RowResult(ours)
        comparisons.append(Comparison(id, row, result, verdict(row, result)))
    return Reproduction(id, published, tuple(comparisons), experiment.drawings, seconds)


def verdict(row: PublishedRow, result: RowResult) -> Verdict:
    """agrees: our interval overlaps the published number's band; explained: it does so only with the cause."""
    if intervals_overlap(row, result.ours):
        return "agrees"
    if result.cause and intervals_overlap(row, result.cause.ours):
        return "explained"
    return "disagrees"


def intervals_overlap(row: PublishedRow, ours: Summary) -> bool:
    """Return True if our interval (the number itself if it has none) and the row's band overlap."""
    low, high = row.band
    if math.isnan(ours.low):
        return low <= ours.value <= high
    return ours.low <= high and ours.high >= low


def format_with_source(row: PublishedRow) -> str:
    """Format the published number with its source; `derived` if the paper does not print it."""
    source = "; ".join(
        part for part in ("derived" if row.derived else "", row.source) if part
    )
    return f"{format_published(row)} ({source})" if source else format_published(row)


def format_summary(summary: Summary) -> str:
    """Format a number, with its interval if it has one."""
    if summary.low == summary.high or math.isnan(summary.low):
        return f"{summary.value:.4g}"
    return f"{summary.value:.4g} ({summary.low:.4g}..{summary.high:.4g})"


def format_published(row: PublishedRow) -> str:
    """Format the published number or its bounds, with the tolerance."""
    if row.published is not None:
        text = f"{row.published:.6g}"
    elif row.at_least is None:
        text = f"≤ {row.at_most:.6g}"
    elif row.at_most is None:
        text = f"≥ {row.at_least:.6g}"
    else:
        text = f"{row.at_least:.6g}..{row.at_most:.6g}"
    return f"{text} ± {row.tolerance:.3g}" if row.tolerance else text


# 95 % intervals: confidence interval of a mean, prediction interval of one draw, bootstrap of
# functions of means.


def confidence_interval(values: Sequence[float] | Floats) -> Summary:
    """The mean with Student's confidence interval: mean +- t s / sqrt(n)."""
    return prediction_interval(values, own_variance=0.0)


def prediction_interval(
    values: Sequence[float] | Floats, count: int = 0, own_variance: float = 1.0
) -> Summary:
    """The mean with Student's prediction interval: mean +- t s sqrt(1 + 1 / n), t for n - 1 degrees of freedom.

    For a published number that is itself a single draw.

    Parameters
    ----------
    count
        Number of independent draws, if fewer than the values
    own_variance
        Of the predicted draw in units of s^2, in place of 1
    """
    draws = np.asarray(values, float)
    count = count or len(draws)
    mean = float(np.mean(draws))
    std = np.std(draws, ddof=1) * np.sqrt(own_variance + 1 / count)
    return symmetric_interval(mean, float(stdtrit(count - 1, 0.975) * std), count)


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
    freedom = summary.trials - 1
    factor = float(stdtrit(freedom, 0.975) / 1.96 * np.sqrt(summary.trials / freedom))
    low = summary.value + factor * (summary.low - summary.value)
    high = summary.value + factor * (summary.high - summary.value)
    return summary._replace(low=low, high=high)


def bootstrap_of_means(columns: Floats, statistic: Callable[[Floats], Any]) -> Summary:
    """A function of K column means, with its bootstrap percentile interval over the N rows; NaNs are left out.

    Parameters
    ----------
    columns
        (N, K)
    statistic
        Of (..., K) means, shape (...)
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
    return widen_interval(
        Summary(value, min(float(low), value), max(float(high), value), rows)
    )
