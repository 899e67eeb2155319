"""Thresholds of a study: where along a factor a proportion crosses a limit, with an interval.

The only assumption on the proportion is that it rises or falls along the factor. The estimate is the place where its
isotonic fit, linear between the levels, crosses the limit. The interval goes from the last level that is certainly on
one side of the limit to the first level that is certainly on the other, so more levels between the two shorten it.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import starmap
from typing import NamedTuple

import numpy as np
import scipy

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.experiments.study.plan import Curve, Threshold
from skysim.experiments.study.table import Axis, PointRows, PointTable
from skysim.results import metrics
from skysim.results.requirements import MET, NOT_MET, NOT_SHOWN, Judgment, judge, requirement

MOST_TRIALS = 1_000_000  # greatest number of trials that is advised
MISFIT_PROBABILITY = 1e-3  # probability that a monotonic curve deviates from its isotonic fit by more than is accepted


class Crossing(NamedTuple):
    """Where a proportion crosses a limit along a factor.

    Attributes
    ----------
    value
        The estimate; -inf or inf if it is beyond the levels, NaN if the proportion neither
        rises nor falls
    low, high
        Its ends, each at CONFIDENCE; -inf or inf where no level is certain
    rising
        Whether the proportion rises along the factor
    between
        The two levels between which it crosses, if there are too few trials for a better
        estimate (`too_few`); None otherwise
    needs
        For each open end that more trials would close: a level, and the approximate total of
        trials that it needs
    """

    value: float
    low: float
    high: float
    rising: bool
    between: tuple[float, float] | None = None
    needs: tuple[tuple[float, int], ...] = ()


# Estimation.


def crossing(
    x: Floats, hits: Floats, trials: Floats, limit: float, log: bool = False
) -> Crossing:
    """Where a monotonic proportion crosses a limit, from (L,) hits of (L,) trials at (L,) ascending levels.

    The isotonic fit is the maximum-likelihood estimate of a monotonic curve (Ayer et al. 1955). The interval's ends
    are found by fixed-sequence tests (Maurer, Hothorn & Lehmacher 1995): from the side where the proportion is above
    the limit, level after level as long as its exact lower bound (Clopper & Pearson 1934) is; from the other side
    likewise with upper bounds. A wrong end requires a wrong test at the first level beyond the true crossing, so each
    end is wrong with a probability of at most 5 %, for any monotonic curve, as is every claim (`metrics.exact_bounds`).

    Parameters
    ----------
    log
        Interpolate between the levels in the logarithm of x
    """
    falls, rises = (isotonic(hits / trials, trials, rising) for rising in (False, True))
    rising = log_likelihood(hits, trials, rises) > log_likelihood(hits, trials, falls)
    best = rises if rising else falls
    saturated = log_likelihood(hits, trials, hits / trials)
    deviance = 2 * (saturated - log_likelihood(hits, trials, best))
    if deviance > scipy.stats.chi2.isf(MISFIT_PROBABILITY, max(len(x) - 1, 1)):
        return Crossing(math.nan, -math.inf, math.inf, rising)
    # In the order in which the proportion falls, `above` and `below` are certain levels.
    x, hits, trials, fit = (one[::-1] if rising else one for one in (x, hits, trials, best))
    sign = -1.0 if rising else 1.0
    places = np.log(x) if log else x
    value = sign * math.inf
    between = None
    below = np.flatnonzero(fit < limit)
    if len(below) and not below[0]:
        value = -value
    elif len(below):
        n = int(below[0])
        share = (fit[n - 1] - limit) / (fit[n - 1] - fit[n])
        value = float(places[n - 1] + share * (places[n] - places[n - 1]))
        value = math.exp(value) if log else value
        if too_few(trials, limit):
            first, second = sorted(x[n - 1 : n + 1].tolist())
            between = first, second
    above, beneath = certain_levels(x, hits, trials, limit)
    ends = (
        -sign * math.inf if above is None else above,
        sign * math.inf if beneath is None else beneath,
    )
    needs = []
    for end in [end for end, level in ((0, above), (-1, beneath)) if level is None]:
        share = float(fit[end])
        certain = (1 - limit, 0, 1 - share) if end == 0 else (limit, 0, share)
        if 0 < (count := metrics.trials_needed(*certain)) <= MOST_TRIALS:
            needs.append((float(x[end]), count))
    return Crossing(value, min(ends), max(ends), rising, between, tuple(needs))


def too_few(trials: Floats, limit: float) -> bool:
    """Whether one trial is more than the distance of the limit from 0 or 1: no proportion then is near the limit."""
    return bool(trials.min() < 1 / min(limit, 1 - limit))


def isotonic(proportion: Floats, weight: Floats, rising: bool) -> Floats:
    """(L,) isotonic fit of proportions, by pooling adjacent violators."""
    return scipy.optimize.isotonic_regression(proportion, weights=weight, increasing=rising).x


def log_likelihood(hits: Floats, trials: Floats, proportion: Floats) -> float:
    """Binomial log-likelihood of proportions, without the term that does not depend on them."""
    hit = scipy.special.xlogy(hits, proportion)
    missed = scipy.special.xlogy(trials - hits, 1 - proportion)
    return float(np.sum(hit + missed))


def certain_levels(
    x: Floats, hits: Floats, trials: Floats, limit: float
) -> tuple[float | None, float | None]:
    """The last level that is certainly above the limit and the first that is certainly below it, by fixed sequences.

    Parameters
    ----------
    x
        (L,) levels in the order in which the proportion falls
    """
    counts = np.column_stack([x, hits, trials]).tolist()
    above = beneath = None
    for place, count, total in counts:
        if metrics.exact_bounds(count, total)[0] < limit:
            break
        above = place
    for place, count, total in reversed(counts):
        if metrics.exact_bounds(count, total)[1] >= limit:
            break
        beneath = place
    return above, beneath


# Requirements of a study.


def judged(require: Mapping[str, float], lines: PointRows) -> list[list[Judgment]]:
    """The judgments of each requirement at all points; a "not met" holds at 95 % for all points together."""
    return [
        [judge(one, line.responses[one.response], points=len(lines)) for line in lines]
        for one in starmap(requirement, require.items())
    ]


def decisive(found: Sequence[Judgment]) -> tuple[int, str]:
    """The point that decides on a requirement at all points, and at how many of them it has the same answer."""
    order = (MET, NOT_SHOWN, NOT_MET)
    keys = [(order.index(one.answer), one.needs, one.misses) for one in found]
    worst = keys.index(max(keys))
    same = sum(key[0] == keys[worst][0] for key in keys)
    if len(found) == 1:
        return worst, ""
    return worst, f" at {'all' if same == len(found) else f'{same} of'} {len(found)} points"


def requirement_text(found: Sequence[Judgment], lines: PointTable) -> str:
    """Whether a requirement is met at all points, in a sentence with the point that decides."""
    worst, where = decisive(found)
    return (
        found[worst].text(f"{where}, most at {lines.place(lines[worst])}" if where else "")
        + "."
    )


# Thresholds of a study.


def check(threshold: Threshold, where: str, lines: PointTable) -> None:
    """Raise InputError if the response is not a proportion, or the factor has no numeric levels."""
    name = threshold.response
    if not metrics.is_proportion(name):
        raise InputError(
            f"{where}.response", f"{name} is no proportion", "identified, coverage_4, ..."
        )
    if lines.study.is_sampled:
        raise InputError(
            where, "points are sampled, without levels", "design factorial or one_at_a_time"
        )
    axis = lines.axes[threshold.along]
    if not axis.numeric or len(axis.levels) < 2:
        raise InputError(
            f"{where}.along",
            f"{threshold.along} has no two numeric levels",
            "a factor with numbers",
        )


def thresholds_of(curve: Curve, lines: PointTable) -> list[Threshold]:
    """The study's thresholds of a curve's response, along its x, at its levels."""
    levels = lines.fixed_levels(curve)
    shown = (curve.y, curve.x, curve.by)
    return [
        one
        for one in lines.study.thresholds
        if (one.response, one.along, one.by) == shown and lines.fixed_levels(one) == levels
    ]


def crossings(threshold: Threshold, lines: PointTable) -> dict[str, Crossing | None]:
    """The crossing for each level of `by`, by its label, or by "" without `by`; None without trials at two levels."""
    axis = lines.axes[threshold.along]
    return {
        label: group_crossing(threshold, group, axis)
        for label, group in lines.groups(threshold).items()
    }


def group_crossing(threshold: Threshold, lines: PointRows, axis: Axis) -> Crossing | None:
    """The crossing along one series of points; None without trials at two levels."""
    summaries = [(axis.at(line), line.responses[threshold.response]) for line in lines]
    rows = [
        (x, round(one.value * one.trials), one.trials) for x, one in summaries if one.trials
    ]
    if len(rows) < 2:
        return None
    x, hits, trials = np.array(sorted(rows), dtype=float).T
    return crossing(x, hits, trials, threshold.limit, axis.log)


def sentences(threshold: Threshold, lines: PointTable) -> list[str]:
    """The threshold in words, one sentence for each level of `by`."""
    axis = lines.axes[threshold.along]
    by = threshold.by
    unit = lines.axes[by].unit if by is not None else ""
    return [
        (f"{by} = {label}{unit}: " if label else "") + describe(one, threshold, axis)
        for label, one in crossings(threshold, lines).items()
    ]


def describe(found: Crossing | None, threshold: Threshold, axis: Axis) -> str:
    """A crossing in words, such as "identified falls below 95 % at rate = 6.2 deg/s (95 %: below 8)"."""
    response = threshold.response
    limit = f"{100 * threshold.limit:g} %"
    name = threshold.along
    if found is None:
        return f"{response} has no trials at two levels of {name} yet."
    unit = axis.unit
    if math.isnan(found.value):
        return f"{response} neither rises nor falls along {name}, so no level of it is a threshold."
    first, last = (axis.coordinate(one) for one in (axis.levels[0], axis.levels[-1]))
    crosses = f"{response} {'reaches' if found.rising else 'falls below'} {limit}"
    if math.isinf(found.value):
        everywhere = (found.value > 0) != found.rising
        text = f"{response} is {'at least' if everywhere else 'below'} {limit} at all levels of {name}, "
        text += f"{first:.4g} to {last:.4g}{unit}"
    elif found.between:
        text = f"{crosses} between {name} = {found.between[0]:.4g} and {found.between[1]:.4g}{unit}"
    else:
        text = f"{crosses} at {name} = {found.value:.3g}{unit}"
    return f"{text} ({interval_text(found, name, unit)})."


def interval_text(found: Crossing, name: str, unit: str) -> str:
    """The interval of a crossing in words, with the total of trials that an open end needs."""
    counts = " and ".join(
        f"about {trials:,} trials at {name} = {level:.4g}{unit}"
        for level, trials in found.needs
    )
    needs = f"; needs {counts}" if counts else ""
    both = math.isfinite(found.low) and math.isfinite(found.high)
    each = f"{'each end at ' * both}{100 * metrics.CONFIDENCE:g} %"
    return f"{each}: {span(found)}{needs}"


def span(found: Crossing) -> str:
    """The interval of a crossing; an open end is named."""
    low, high = found.low, found.high
    if math.isfinite(low) and math.isfinite(high):
        return f"{low:.4g} to {high:.4g}"
    if math.isfinite(low):
        return f"above {low:.4g}"
    return f"below {high:.4g}" if math.isfinite(high) else "no level is certain"


def brief(threshold: Threshold, lines: PointTable) -> str:
    """The threshold in one sentence with its intervals, all levels of `by` together; "" without trials."""
    unit = lines.axes[threshold.along].unit
    found = [
        (f" ({label})" if label else "", one)
        for label, one in crossings(threshold, lines).items()
        if one is not None
    ]
    if not found:
        return ""
    limit = f"{100 * threshold.limit:g} %"
    at = [
        f"{one.between[0]:.4g} to {one.between[1]:.4g}{unit}{label}"
        if one.between
        else f"{one.value:.3g}{unit}{label} ({span(one)})"
        for label, one in found
        if math.isfinite(one.value)
    ]
    beyond = [
        (label, (one.value > 0) != one.rising)
        for label, one in found
        if math.isinf(one.value)
    ]
    parts = []
    if at:
        crosses = "reaches" if any(one.rising for _, one in found) else "falls below"
        parts.append(
            f"{threshold.response} {crosses} {limit} at {threshold.along} = {', '.join(at)}"
        )
    for text, everywhere in ((f"at least {limit}", True), (f"below {limit}", False)):
        if labels := [label for label, every in beyond if every == everywhere]:
            subject = "" if parts else f"{threshold.response} is "
            parts.append(f"{subject}{text} at all levels{','.join(labels)}")
    return "; ".join(parts) + "." if parts else ""
