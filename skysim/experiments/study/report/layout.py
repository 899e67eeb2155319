"""Contents of a study's figures: which figures to draw, their axes, series, grid cells and captions.

`figures` draws what this module selects. Points of the designs in SAMPLED_DESIGNS and of optimizations are scattered:
no two share a level, so they are not grouped by level but shown as points, with running medians where there are many.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from skysim.core.types import Bools, Floats, Ints
from skysim.experiments.study.plan import Curve, Figure, Heat, Search
from skysim.experiments.study.table import (
    Axis,
    PointRows,
    PointTable,
    format_level,
    has_few_values,
    label,
)
from skysim.experiments.study.thresholds import thresholds_of
from skysim.results import metrics

# Maximum number of x values for error bars; with more, intervals are drawn as a band.
MAX_X_WITH_BARS = 12
# Sampled points with error bars; with more, a running median is drawn.
MAX_POINTS_WITH_BARS = 60
# Maximum number of lines in an automatic curve; with more levels it becomes a heat map.
MOST_LINES = 7
MOST_FIGURES = 24  # maximum number of automatic figures
# Minimum ratio of largest to smallest response for an automatic logarithmic axis.
LOG_RESPONSE_RATIO = 30
FAR_RATIO = 30  # interval bounds below the smallest value / FAR_RATIO do not extend a logarithmic axis


class Series(NamedTuple):
    """A line of a curve: its label and (N,) x, values and interval bounds, ascending in x.

    Attributes
    ----------
    values
        Number of trials with a value
    few
        Whether they are few of the point's trials (`has_few_values`)
    """

    label: str
    x: Floats
    value: Floats
    low: Floats
    high: Floats
    values: Ints
    few: Bools


class Grid(NamedTuple):
    """A heat map: its axes and (Y, X) values, NaN where there is no value.

    Attributes
    ----------
    values
        (Y, X) number of trials with a value
    few
        Whether they are few of the point's trials (`has_few_values`)
    """

    x: Axis
    y: Axis
    value: Floats
    values: Ints
    few: Bools


class Panel(NamedTuple):
    """One response of an optimization: (N,) values and interval bounds by candidate, and its constraint bounds."""

    label: str
    value: Floats
    low: Floats
    high: Floats
    bounds: list[float]


def draws_medians(lines: PointTable, x_axis: Axis, count: int) -> bool:
    """Whether medians are drawn instead of intervals: sampled points that are many or share a non-numeric axis."""
    return lines.study.is_sampled and (count > MAX_POINTS_WITH_BARS or not x_axis.numeric)


# Selection of figures and of their points.


def figures(lines: PointTable) -> list[Figure]:
    """The figures of the study file; if it has none, automatic figures of the responses, about MOST_FIGURES at most.

    With sampled points and with one factor at a time, each response is drawn against each factor. Otherwise it is
    drawn against the first numeric factor, with a line for each level of a second factor, or as a heat map over both
    if there would be too many lines.
    """
    study = lines.study
    if study.figures or not lines:
        return list(study.figures)
    varied = list(lines.varied)
    if not varied:
        return []
    pairs: list[tuple[str, str | None, str]]
    if study.is_sampled or study.design.kind == "one_at_a_time":
        pairs = [(one, None, y) for y in study.responses for one in varied]
    else:
        x = next((name for name in varied if lines.axes[name].numeric), varied[0])
        by = next((name for name in varied if name != x), None)
        pairs = [(x, by, y) for y in study.responses]
    # If there are too many figures, show fewer responses, each with all of its figures.
    most = max(
        MOST_FIGURES * len(study.responses) // len(pairs), 1
    )  # number of responses to show
    return [
        automatic_figure(x, by, y, lines) for x, by, y in pairs if y in study.responses[:most]
    ]


def automatic_figure(x: str, by: str | None, y: str, lines: PointTable) -> Figure:
    """An automatic figure: a curve, or a heat map if `by` has more than MOST_LINES levels."""
    values = np.array([line.responses[y].value for line in lines])
    values = values[np.isfinite(values)]
    least = values.min(initial=np.inf)
    log = bool(0 < least < values.max(initial=0.0) / LOG_RESPONSE_RATIO)
    if by is not None and len(lines.axes[by].levels) > MOST_LINES:
        return Heat(kind="heat", x=x, y=by, value=y, log=log)
    return Curve(kind="curve", x=x, y=y, by=by, log=log)


def series(lines: PointTable, figure: Curve) -> list[Series]:
    """The series of a curve, one for each level of `by`; for a sampled `by`, one for each of GROUPS equal groups."""
    x_axis = lines.axes[figure.x]
    found = []
    for name, group in lines.groups(figure).items():
        if not group:
            continue
        ordered = sorted(group, key=x_axis.at)
        x = np.array(list(map(x_axis.at, ordered)))
        value, low, high, count, _ = np.array(
            [line.responses[figure.y] for line in ordered]
        ).T
        few = np.array([has_few_values(line, figure.y) for line in ordered])
        found.append(Series(name, x, value, low, high, count.astype(int), few))
    return found


def grid(lines: PointTable, figure: Heat) -> Grid:
    """The axes and cell values of a heat map."""
    x = lines.axes[figure.x]
    y = lines.axes[figure.y]
    columns, rows = ([one.coordinate(level) for level in one.levels] for one in (x, y))
    shape = len(rows), len(columns)
    value = np.full(shape, np.nan)
    count = np.zeros(shape, int)
    few = np.zeros(shape, bool)
    for line in lines.shown_in(figure):
        cell = rows.index(y.at(line)), columns.index(x.at(line))
        value[cell] = line.responses[figure.value].value
        count[cell] = line.responses[figure.value].trials
        few[cell] = has_few_values(line, figure.value)
    return Grid(x, y, value, count, few)


def limits(
    values: Sequence[Floats], bounds: Sequence[Floats], log: bool, share: bool
) -> tuple[float, float]:
    """Axis limits that include all values and all finite interval bounds, with padding.

    A proportion has the limits 0 and 1, so that the figures of a study can be compared by eye. On a logarithmic axis
    nonpositive numbers, and bounds far below the smallest value (FAR_RATIO), are left out.
    """
    if share and not log:
        return -0.03, 1.03
    both = (np.concatenate([*arrays, np.empty(0)]) for arrays in (values, bounds))
    inner, outer = (one[np.isfinite(one) & ((one > 0) | (not log))] for one in both)
    if log:
        outer = outer[
            outer > (inner.min() if len(inner) else outer.max(initial=0.0)) / FAR_RATIO
        ]
    numbers = np.concatenate([inner, outer])
    if not len(numbers):
        return (0.1, 1.0) if log else (0.0, 1.0)
    low = float(numbers.min())
    high = float(numbers.max())
    if log:
        pad = max((high / low) ** 0.06, 1.15 if high > 2 * low else 1.5)
        return low / pad, high * pad
    # Start at zero if the values come near it.
    low = 0.0 if 0 < low < 0.4 * high else low
    pad = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - (pad if low else pad / 2), high + pad


def expected_value(name: str) -> float | None:
    """The value of a response if the tracker's claims are true, to be drawn as a line: 3 for the mean NEES."""
    return 3.0 if metrics.split_name(name) == ("nees", "mean") else None


# Candidates of an optimization.


def panels(lines: PointRows, search: Search, costs: Mapping[int, float]) -> dict[str, Panel]:
    """One panel per objective, constrained response and cost; by name."""
    found = {}
    for name in dict.fromkeys([*search.responses, "cost"]):
        summaries = [
            line.responses.get(name, metrics.Summary(costs.get(line.point, np.nan)))[:3]
            for line in lines
        ]
        bounds = [
            bound
            for one in search.constraints
            if one.response == name
            for bound in (one.at_least, one.at_most)
            if bound is not None
        ]
        title = label(name)
        for goal in search.objectives:
            if goal.response == name:
                title += f", {goal.better} is better"
        value, low, high = np.array(summaries, dtype=float).reshape(-1, 3).T
        found[name] = Panel(title, value, low, high, bounds)
    return found


# Captions.


def caption(figure: Figure, lines: PointTable) -> str:
    """Caption of a figure: its axes, the fixed levels, the number of trials per point, and the markers used."""
    value = figure.response
    shown = lines.shown_in(figure)
    text = f"{caption_title(figure)}{fixed_text(figure, lines)}"
    summaries = [line.responses[value] for line in shown]
    counts = [one.trials for one in summaries if one.trials]
    if not counts:
        return f"{text}. No trial of it is in yet."
    most = f" to {max(counts)}" if max(counts) > min(counts) else ""
    text += f". n = {min(counts)}{most} a point"
    mark = "Dotted"
    if isinstance(figure, Curve):
        mark = "Hollow, without a line"
        text += curve_note(figure, lines, summaries) + "."
        if thresholds_of(figure, lines):
            text += " Dashed: a limit; ticks and bars: where it is crossed, each end at 95 %."
        if (expected := expected_value(value)) is not None:
            text += f" Dotted: {expected:g}, where the claimed errors are true."
    else:
        text += "."
    if any(has_few_values(line, value) for line in shown):
        text += f" {mark}: few of the point's trials have a value (n of them), and these are the easy ones."
    if figure.log and any(one.value <= 0 < one.high for one in summaries):
        text += " Triangles: none was seen, and so much at most."
    return text


def caption_title(figure: Figure) -> str:
    """The title of a figure: its quantity and its factors."""
    if isinstance(figure, Curve):
        return f"{figure.y} against {figure.x}" + (f" by {figure.by}" if figure.by else "")
    if isinstance(figure, Heat):
        return f"{figure.value} against {figure.x} and {figure.y}"
    return f"{figure.value} by direction" + (f" and {figure.by}" if figure.by else "")


def fixed_text(figure: Figure, lines: PointTable) -> str:
    """The levels of varied factors that a figure keeps fixed, as ", at leds = 900"; empty if there are none."""
    fixed = lines.fixed_levels(figure).items()
    at = ", ".join(
        f"{name} = {format_level(one)}" for name, one in fixed if name in lines.varied
    )
    return f", at {at}" if at else ""


def curve_note(figure: Curve, lines: PointTable, summaries: Sequence[metrics.Summary]) -> str:
    """The meaning of the lines and bars of a curve."""
    x_axis = lines.axes[figure.x]
    if draws_medians(lines, x_axis, len(summaries)):
        return f"; lines: {'running medians' if x_axis.numeric else 'medians'} of the points"
    if np.isnan([one.low for one in summaries]).all():
        return ""
    text = f"; intervals of {100 * metrics.CONFIDENCE:g} %"
    needs = max(one.needs for one in summaries)
    return text + (f", none where a point needs up to {needs} more trials" if needs else "")
