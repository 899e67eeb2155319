"""Contents of a study's figures: which figures to draw, their axes, series, grid cells and captions.

`figures` draws what this module selects. Points of the designs in SAMPLED_DESIGNS and of optimizations are scattered:
no two share a level, so they are not grouped by level but shown as points, with running medians where there are many.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.experiments.study.analysis.table import PointRow, format_level
from skysim.experiments.study.factors import Distribution, Levels, Range, Value, split_quantity
from skysim.experiments.study.plan import Curve, Figure, Heat, Search, Study
from skysim.results import metrics, statistics

SAMPLED_DESIGNS = ("lhs", "sobol", "saltelli")  # sampled designs: no two points share a level
MAX_X_WITH_BARS = 12  # maximum number of x values for error bars; with more, intervals are drawn as a band
MAX_POINTS_WITH_BARS = 60  # sampled points with error bars; with more, a running median is drawn
GROUPS = 4  # number of groups into which a sampled factor `by` is divided
MOST_LINES = 7  # maximum number of lines in an automatic curve; with more levels it becomes a heat map
MOST_FIGURES = 24  # maximum number of automatic figures
LOG_FACTOR_RATIO = 10  # minimum ratio of last to first level for a logarithmic factor axis
LOG_RESPONSE_RATIO = 30  # minimum ratio of largest to smallest response for an automatic logarithmic axis
FAR_RATIO = 30  # interval bounds below the smallest value / FAR_RATIO do not extend a logarithmic axis
UNITS = {"_deg_s": "deg/s", "_arcsec": "arcsec", "_deg": "deg", "_mag": "mag", "_px": "px", "_um": "um"}
UNITS |= {"_mm": "mm", "_ms": "ms", "_hz": "Hz", "_m": "m", "_s": "s"}


class Axis(NamedTuple):
    """A factor as an axis: label and levels, ascending if they are numbers of one unit, else in the study's order."""

    label: str
    levels: list[Value]
    numeric: bool
    log: bool

    def coordinate(self, one: Value) -> float:
        """Coordinate of a level on the axis: its numeric value, or its index if levels are not numeric."""
        if self.numeric:
            return split_quantity(one)[0]
        return float(next(n for n, other in enumerate(self.levels) if same(one, other)))

    def tick_label(self, one: Value) -> str:
        """Tick text of a level; a number is written without its unit, which is in the axis label."""
        if not self.numeric:
            return format_level(one)
        number = self.coordinate(one)
        return f"{number:.6g}" if number == int(number) else f"{number:.3g}"


class Series(NamedTuple):
    """A line of a curve: its label and (N,) x, values and interval bounds, ascending in x."""

    label: str
    x: Floats
    value: Floats
    low: Floats
    high: Floats


class Grid(NamedTuple):
    """A heat map: its axes and (Y, X) values, NaN where there is no value."""

    x: Axis
    y: Axis
    value: Floats


class Panel(NamedTuple):
    """One response of an optimization: (N,) values and interval bounds by candidate, and its constraint bounds."""

    label: str
    value: Floats
    low: Floats
    high: Floats
    bounds: list[float]


# Names and axes.


def is_sampled(study: Study) -> bool:
    """Whether the points are sampled, so that no two share a level: a design in SAMPLED_DESIGNS, or an optimization."""
    return study.optimize is not None or study.design.kind in SAMPLED_DESIGNS


def same(one: Value, other: Value) -> bool:
    """Whether two levels are equal, as numbers where possible: 5 equals 5.0, and "5 m" equals "5.0 m"."""
    try:
        return split_quantity(one) == split_quantity(other)
    except ValueError:
        return bool(one == other)


def distinct(levels: Iterable[Value]) -> list[Value]:
    """The levels without duplicates, in order of first appearance."""
    return list({repr(one): one for one in levels}.values())


def label(name: str, unit: str = "") -> str:
    """Readable name with its unit in brackets: `cross_arcsec_p95` becomes "cross p95 [arcsec]"."""
    figure, _, statistic = name.rpartition("_")
    stem, tail = (figure, f" {statistic}") if statistic in metrics.STATISTICS else (name, "")
    ending = next((ending for ending in UNITS if stem.endswith(ending)), "")
    unit = unit or UNITS.get(ending, "")
    text = stem.removesuffix(ending).replace("_", " ") + tail
    return text + (f" [{unit}]" if unit else " [share]" if is_share(name) else "")


def is_share(name: str) -> bool:
    """Whether a response is a proportion between 0 and 1."""
    return metrics.is_proportion(name)


def axis(study: Study, lines: Sequence[PointRow], name: str) -> Axis:
    """The axis of a factor, with the levels at which there are points."""
    factor, levels = study.factors[name], distinct(line.levels[name] for line in lines)
    key = "" if isinstance(factor, Levels) else factor.key or ""
    unit = next((unit for ending, unit in UNITS.items() if key.endswith(ending)), "")
    numbers, own_unit = as_numbers(levels)
    if numbers is not None:
        levels = [levels[n] for n in np.argsort(numbers)]
        # A range or distribution declares its own scale; explicit values are judged by their spacing.
        if isinstance(factor, Range):
            log = factor.scale == "log"
        elif isinstance(factor, Distribution):
            log = factor.distribution == "lognormal"
        else:
            log = suits_log_scale(np.sort(numbers))
        return Axis(label(name, own_unit or unit), levels, True, log)
    order = [one for one, _ in factor.options()]
    levels.sort(key=lambda one: next((n for n, other in enumerate(order) if same(one, other)), len(order)))
    has_text = any(isinstance(one, str | bool) for one in levels)
    return Axis(label(name, "" if has_text else unit), levels, False, False)


def as_numbers(levels: Sequence[Value]) -> tuple[Floats | None, str]:
    """(N,) levels as numbers, and their unit. None unless all are numbers of the same unit and distinct."""
    try:
        parts = [split_quantity(one) for one in levels]
    except ValueError:
        return None, ""
    numbers, units = np.array([number for number, _ in parts]), {unit for _, unit in parts}
    if len(units) != 1 or len(np.unique(numbers)) < len(numbers):
        return None, ""
    return numbers, units.pop()


def draws_bands(x_axis: Axis) -> bool:
    """Whether intervals are drawn as a band: a numeric axis with more than MAX_X_WITH_BARS levels."""
    return x_axis.numeric and len(x_axis.levels) > MAX_X_WITH_BARS


def draws_medians(study: Study, x_axis: Axis, count: int) -> bool:
    """Whether medians are drawn instead of intervals: sampled points that are many or share a non-numeric axis."""
    return is_sampled(study) and (count > MAX_POINTS_WITH_BARS or not x_axis.numeric)


def suits_log_scale(numbers: Floats) -> bool:
    """Whether ascending numbers suit a logarithmic axis.

    True if they are positive, extend over a ratio of at least LOG_FACTOR_RATIO, and their steps vary less as ratios
    than as differences (compared by the coefficient of variation).
    """
    if len(numbers) < 4 or numbers[0] <= 0 or numbers[-1] < LOG_FACTOR_RATIO * numbers[0]:
        return False
    variation = [np.std(steps) / np.mean(steps) for steps in (np.diff(np.log(numbers)), np.diff(numbers))]
    return bool(variation[0] < variation[1])


# Selection of figures and of their points.


def figures(study: Study, lines: Sequence[PointRow]) -> list[Figure]:
    """The figures of the study file; if it has none, automatic figures of the responses, about MOST_FIGURES at most.

    With sampled points and with one factor at a time, each response is drawn against each factor. Otherwise it is
    drawn against the first numeric factor, with a line for each level of a second factor, or as a heat map over both
    if there would be too many lines.
    """
    if study.figures or not lines:
        return list(study.figures)
    axes = {name: axis(study, lines, name) for name in study.factors}
    varied = [name for name, one in axes.items() if len(one.levels) > 1]
    if not varied:
        return []
    pairs: list[tuple[str, str | None, str]]
    if is_sampled(study) or study.design.kind == "one_at_a_time":
        pairs = [(one, None, y) for y in study.responses for one in varied]
    else:
        x = next((name for name in varied if axes[name].numeric), varied[0])
        by = next((name for name in varied if name != x), None)
        pairs = [(x, by, y) for y in study.responses]
    # If there are too many figures, show fewer responses, each with all of its figures.
    most = max(MOST_FIGURES * len(study.responses) // len(pairs), 1)  # responses to show
    return [automatic_figure(x, by, y, axes, lines) for x, by, y in pairs if y in study.responses[:most]]


def automatic_figure(x: str, by: str | None, y: str, axes: Mapping[str, Axis], lines: Sequence[PointRow]) -> Figure:
    """An automatic figure: a curve, or a heat map if `by` has more than MOST_LINES levels."""
    values = np.array([line.responses[y].value for line in lines])
    values = values[np.isfinite(values)]
    log = bool(len(values) and values.min() > 0 and values.max() > LOG_RESPONSE_RATIO * values.min())
    if by is not None and len(axes[by].levels) > MOST_LINES:
        return Heat(kind="heat", x=x, y=by, value=y, log=log)
    return Curve(kind="curve", x=x, y=y, by=by, log=log)


def fixed_levels(figure: Figure, study: Study, lines: Sequence[PointRow]) -> dict[str, Value]:
    """The levels at which a figure keeps factors fixed: those of its `where`, and the first level of other factors
    that it does not show.

    Sampled points share no levels, so only `where` applies to them. Raises InputError if `where` names an unknown
    factor or level.
    """
    for name, level in figure.where.items():
        if name not in study.factors:
            raise InputError(f"figures.where: unknown factor {name!r}; allowed: {', '.join(study.factors)}")
        available = distinct(line.levels[name] for line in lines)
        if not any(same(level, one) for one in available):
            allowed = ", ".join(map(format_level, available[:20]))
            raise InputError(f"figures.where.{name}: unknown level {level!r}; allowed: {allowed}")
    if is_sampled(study):
        return dict(figure.where)
    shown = {figure.x, figure.by if isinstance(figure, Curve) else figure.y}
    return {
        name: figure.where.get(name, factor.options()[0][0])
        for name, factor in study.factors.items()
        if name not in shown or name in figure.where
    }


def shown_points(lines: Sequence[PointRow], figure: Figure, study: Study) -> list[PointRow]:
    """The table lines (points) that a figure shows."""
    levels = fixed_levels(figure, study, lines)
    return [line for line in lines if all(same(line.levels[name], one) for name, one in levels.items())]


def series(lines: Sequence[PointRow], figure: Curve, study: Study) -> list[Series]:
    """The series of a curve, one for each level of `by`; for a sampled `by`, one for each of GROUPS equal groups."""
    x_axis, chosen = axis(study, lines, figure.x), shown_points(lines, figure, study)
    groups = {"": chosen}
    if figure.by is not None:
        groups = group_points(chosen, axis(study, lines, figure.by), figure.by, study)
    found = []
    for name, group in groups.items():
        rows = [(x_axis.coordinate(line.levels[figure.x]), *line.responses[figure.y][:3]) for line in group]
        if rows:
            found.append(Series(name, *np.array(sorted(rows, key=lambda row: row[0]), dtype=float).T))
    return found


def group_points(lines: Sequence[PointRow], group_axis: Axis, name: str, study: Study) -> dict[str, list[PointRow]]:
    """Table lines grouped by the level of factor `name`, in the order of its axis `group_axis`."""
    # A sampled factor has about as many levels as points: divide the sorted points into GROUPS groups of equal size.
    if is_sampled(study) and group_axis.numeric and len(group_axis.levels) > 2 * GROUPS:
        ordered = sorted(lines, key=lambda line: group_axis.coordinate(line.levels[name]))
        bounds = [round(n * len(ordered) / GROUPS) for n in range(GROUPS + 1)]
        parts = [ordered[a:b] for a, b in itertools.pairwise(bounds) if b > a]
        spans = [[group_axis.coordinate(part[n].levels[name]) for n in (0, -1)] for part in parts]
        return {f"{low:.3g} to {high:.3g}": part for (low, high), part in zip(spans, parts, strict=True)}
    return {
        group_axis.tick_label(one): [line for line in lines if same(line.levels[name], one)]
        for one in group_axis.levels
    }


def grid(lines: Sequence[PointRow], figure: Heat, study: Study) -> Grid:
    """The axes and cell values of a heat map."""
    x, y = axis(study, lines, figure.x), axis(study, lines, figure.y)
    columns, rows = ({one.coordinate(level): n for n, level in enumerate(one.levels)} for one in (x, y))
    value = np.full((len(rows), len(columns)), np.nan)
    for line in shown_points(lines, figure, study):
        cell = rows[y.coordinate(line.levels[figure.y])], columns[x.coordinate(line.levels[figure.x])]
        value[cell] = line.responses[figure.value].value
    return Grid(x, y, value)


def limits(values: Sequence[Floats], bounds: Sequence[Floats], log: bool, share: bool) -> tuple[float, float]:
    """Axis limits that include all values and all finite interval bounds, with padding.

    On a logarithmic axis nonpositive numbers, and bounds far below the smallest value (FAR_RATIO), are left out.
    """
    inner, outer = (np.concatenate([*arrays, np.empty(0)]) for arrays in (values, bounds))
    inner, outer = inner[np.isfinite(inner)], outer[np.isfinite(outer)]
    if log:
        inner, outer = inner[inner > 0], outer[outer > 0]
        outer = outer[outer > (inner.min() if len(inner) else outer.max(initial=0.0)) / FAR_RATIO]
    numbers = np.concatenate([inner, outer])
    if not len(numbers):
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(numbers.min()), float(numbers.max())
    if log:
        pad = max((high / low) ** 0.06, 1.15 if high > 2 * low else 1.5)
        return low / pad, high * pad
    # Start at zero if the values come near it.
    low = 0.0 if 0 < low < 0.4 * high else low
    pad = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    low, high = low - (pad if low else pad / 2), high + pad
    return (max(low, -0.03), min(high, 1.03)) if share else (low, high)


# Candidates of an optimization.


def panels(lines: Sequence[PointRow], search: Search, costs: Mapping[int, float] | None) -> dict[str, Panel]:
    """One panel per objective, constrained response and, if costs are given, cost; by name."""
    names = dict.fromkeys(search.responses + ["cost"] * (costs is not None))
    return {name: panel(name, lines, search, costs or {}) for name in names}


def panel(name: str, lines: Sequence[PointRow], search: Search, costs: Mapping[int, float]) -> Panel:
    """The panel of one response, or of `cost`, over the candidates."""
    nan = float("nan")
    if name == "cost":
        summaries: list[Any] = [(costs.get(line.point, nan), nan, nan) for line in lines]
    else:
        summaries = [line.responses[name][:3] for line in lines]
    ends = [(one.at_least, one.at_most) for one in search.constraints if one.response == name]
    bounds = [bound for pair in ends for bound in pair if bound is not None]
    better = next((f", {one.better} is better" for one in search.objectives if one.response == name), "")
    value, low, high = np.array(summaries, dtype=float).reshape(-1, 3).T
    return Panel(label(name) + better, value, low, high, bounds)


# Captions.


def caption(figure: Figure, study: Study, lines: Sequence[PointRow]) -> str:
    """Caption of a figure: its axes, the fixed levels, the number of trials per point, and the markers used."""
    if isinstance(figure, Curve):
        value, text = figure.y, f"{figure.y} against {figure.x}" + (f" by {figure.by}" if figure.by else "")
    else:
        value, text = figure.value, f"{figure.value} against {figure.x} and {figure.y}"
    varied = {name for name in study.factors if len(distinct(line.levels[name] for line in lines)) > 1}
    fixed = fixed_levels(figure, study, lines).items()
    at = ", ".join(f"{name} = {format_level(one)}" for name, one in fixed if name in varied)
    text += f", at {at}" if at else ""
    shown = [line.responses[value] for line in shown_points(lines, figure, study)]
    counts = [one.trials for one in shown if one.trials]
    if not counts:
        return f"{text}. No trial of it is in yet."
    text += f". n = {min(counts)}" + (f" to {max(counts)}" if max(counts) > min(counts) else "") + " a point"
    bounds = np.array([(one.low, one.high) for one in shown])
    if isinstance(figure, Heat) or np.isnan(bounds).all():
        return text + "."
    text += f"; intervals of {100 * statistics.CONFIDENCE:g} %."
    x_axis = axis(study, lines, figure.x)
    if draws_medians(study, x_axis, len(shown)):
        return text.partition(";")[0] + f"; lines: {'running medians' if x_axis.numeric else 'medians'} of the points."
    if np.isinf(bounds).any():
        bands = draws_bands(x_axis) and not is_sampled(study)
        mark = "band that stops at its line" if bands else "bar that leaves the picture"
        text += f" A {mark} has no end there: too few trials."
    if figure.log and any(one.value <= 0 < one.high for one in shown):
        text += " Triangles: none was seen, and so much at most."
    return text
