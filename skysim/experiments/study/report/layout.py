"""Contents of a study's figures: which figures to draw, their axes, series, grid cells and captions.

`figures` draws what this module selects. Points of the designs in DRAWN and of optimizations are scattered: no two
share a level, so they are not grouped by level but shown as points, with running medians where there are many.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.experiments.study.analysis.table import Line, level
from skysim.experiments.study.factors import Distribution, Levels, Range, Value, split
from skysim.experiments.study.plan import Curve, Figure, Heat, Search, Study
from skysim.results import metrics

DRAWN = ("lhs", "sobol", "saltelli")  # sampled designs: no two points share a level
BARS = 12  # maximum number of x values for error bars; with more, intervals are drawn as a band
CROWD = 60  # maximum number of sampled points with error bars; with more, a running median is drawn
BANDS = 4  # number of groups into which a sampled factor `by` is divided
MOST_LINES = 7  # maximum number of lines in an automatic curve; with more levels it becomes a heat map
MOST_FIGURES = 24  # maximum number of automatic figures
RATIO = 10  # minimum ratio of last to first level for a logarithmic factor axis
SPAN = 30  # minimum ratio of largest to smallest response for a logarithmic axis of an automatic figure
FAR = 30  # interval bounds below the smallest value / FAR do not extend a logarithmic axis
UNITS = {"_deg_s": "deg/s", "_arcsec": "arcsec", "_deg": "deg", "_mag": "mag", "_px": "px", "_um": "um"}
UNITS |= {"_mm": "mm", "_ms": "ms", "_hz": "Hz", "_m": "m", "_s": "s"}


class Axis(NamedTuple):
    """A factor as an axis: label and levels, ascending if they are numbers of one unit, else in the study's order."""

    label: str
    levels: list[Value]
    numeric: bool
    log: bool

    def place(self, one: Value) -> float:
        """Coordinate of a level on the axis: its numeric value, or its index if levels are not numeric."""
        if self.numeric:
            return split(one)[0]
        return float(next(n for n, other in enumerate(self.levels) if same(one, other)))

    def told(self, one: Value) -> str:
        """Tick text of a level; a number is written without its unit, which is in the axis label."""
        if not self.numeric:
            return level(one)
        number = self.place(one)
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


def is_drawn(study: Study) -> bool:
    """Whether the points are sampled, so that no two share a level: a design in DRAWN, or an optimization."""
    return study.optimise is not None or study.design.kind in DRAWN


def same(one: Value, other: Value) -> bool:
    """Whether two levels are equal, as numbers where possible: 5 equals 5.0, and "5 m" equals "5.0 m"."""
    try:
        return split(one) == split(other)
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
    told = stem.removesuffix(ending).replace("_", " ") + tail
    return told + (f" [{unit}]" if unit else " [share]" if is_share(name) else "")


def is_share(name: str) -> bool:
    """Whether a response is a proportion between 0 and 1."""
    return name in metrics.SHARES or bool(metrics.COVERAGE.match(name)) or name.startswith("availability_")


def axis(study: Study, lines: Sequence[Line], name: str) -> Axis:
    """The axis of a factor, with the levels at which there are points."""
    factor, levels = study.factors[name], distinct(line.levels[name] for line in lines)
    key = "" if isinstance(factor, Levels) else factor.key or ""
    unit = next((unit for ending, unit in UNITS.items() if key.endswith(ending)), "")
    numbers, own = numbers_of(levels)
    if numbers is not None:
        levels = [levels[n] for n in np.argsort(numbers)]
        told = isinstance(factor, Range) and factor.scale == "log"
        told |= isinstance(factor, Distribution) and factor.distribution == "lognormal"
        # A range or distribution declares its own scale; explicit values are judged by their spacing.
        even = isinstance(factor, Range | Distribution)
        return Axis(label(name, own or unit), levels, True, told or (not even and by_ratio(np.sort(numbers))))
    order = [one for one, _ in factor.options()]
    levels.sort(key=lambda one: next((n for n, other in enumerate(order) if same(one, other)), len(order)))
    worded = any(isinstance(one, str | bool) for one in levels)
    return Axis(label(name, "" if worded else unit), levels, False, False)


def numbers_of(levels: Sequence[Value]) -> tuple[Floats | None, str]:
    """(N,) levels as numbers, and their unit. None unless all are numbers of the same unit and distinct."""
    try:
        parts = [split(one) for one in levels]
    except ValueError:
        return None, ""
    numbers, units = np.array([number for number, _ in parts]), {unit for _, unit in parts}
    if len(units) != 1 or len(np.unique(numbers)) < len(numbers):
        return None, ""
    return numbers, units.pop()


def in_bands(across: Axis) -> bool:
    """Whether intervals are drawn as a band: a numeric axis with more than BARS levels."""
    return across.numeric and len(across.levels) > BARS


def in_dots(study: Study, across: Axis, count: int) -> bool:
    """Whether medians are drawn instead of intervals: sampled points that are many or share a non-numeric axis."""
    return is_drawn(study) and (count > CROWD or not across.numeric)


def by_ratio(numbers: Floats) -> bool:
    """Whether ascending numbers suit a logarithmic axis.

    True if they are positive, extend over a ratio of at least RATIO, and their steps vary less as ratios than as
    differences (compared by the coefficient of variation).
    """
    if len(numbers) < 4 or numbers[0] <= 0 or numbers[-1] < RATIO * numbers[0]:
        return False
    uneven = [np.std(steps) / np.mean(steps) for steps in (np.diff(np.log(numbers)), np.diff(numbers))]
    return bool(uneven[0] < uneven[1])


# Selection of figures and of their points.


def figures(study: Study, lines: Sequence[Line]) -> list[Figure]:
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
    if is_drawn(study) or study.design.kind == "one_at_a_time":
        pairs = [(one, None, y) for y in study.responses for one in varied]
    else:
        x = next((name for name in varied if axes[name].numeric), varied[0])
        by = next((name for name in varied if name != x), None)
        pairs = [(x, by, y) for y in study.responses]
    # If there are too many figures, show fewer responses, each with all of its figures.
    most = max(MOST_FIGURES * len(study.responses) // len(pairs), 1)  # responses to show
    return [sensible(x, by, y, axes, lines) for x, by, y in pairs if y in study.responses[:most]]


def sensible(x: str, by: str | None, y: str, axes: Mapping[str, Axis], lines: Sequence[Line]) -> Figure:
    """An automatic figure: a curve, or a heat map if `by` has more than MOST_LINES levels."""
    values = np.array([line.responses[y].value for line in lines])
    values = values[np.isfinite(values)]
    log = bool(len(values) and values.min() > 0 and values.max() > SPAN * values.min())
    if by is not None and len(axes[by].levels) > MOST_LINES:
        return Heat(kind="heat", x=x, y=by, value=y, log=log)
    return Curve(kind="curve", x=x, y=y, by=by, log=log)


def held(figure: Figure, study: Study, lines: Sequence[Line]) -> dict[str, Value]:
    """The levels at which a figure keeps factors fixed: those of its `where`, and the first level of other factors
    that it does not show.

    Sampled points share no levels, so only `where` applies to them. Raises InputError if `where` names an unknown
    factor or level.
    """
    for name, wanted in figure.where.items():
        if name not in study.factors:
            raise InputError(f"figures.where: {name!r} is none of {', '.join(study.factors)}")
        there = distinct(line.levels[name] for line in lines)
        if not any(same(wanted, one) for one in there):
            raise InputError(
                f"figures.where.{name}: {wanted!r} is none of {', '.join(map(level, there[:20]))}"
            )
    if is_drawn(study):
        return dict(figure.where)
    shown = {figure.x, figure.by if isinstance(figure, Curve) else figure.y}
    return {
        name: figure.where.get(name, factor.options()[0][0])
        for name, factor in study.factors.items()
        if name not in shown or name in figure.where
    }


def kept(lines: Sequence[Line], figure: Figure, study: Study) -> list[Line]:
    """The table lines (points) that a figure shows."""
    levels = held(figure, study, lines)
    return [line for line in lines if all(same(line.levels[name], one) for name, one in levels.items())]


def series(lines: Sequence[Line], figure: Curve, study: Study) -> list[Series]:
    """The series of a curve, one for each level of `by`; for a sampled `by`, one for each of BANDS equal groups."""
    across, chosen = axis(study, lines, figure.x), kept(lines, figure, study)
    groups = {"": chosen}
    if figure.by is not None:
        groups = grouped(chosen, axis(study, lines, figure.by), figure.by, study)
    return [one_series(name, group, figure, across) for name, group in groups.items() if group]


def one_series(name: str, lines: Sequence[Line], figure: Curve, across: Axis) -> Series:
    """Some table lines as one series, ascending in x."""
    told = [(across.place(line.levels[figure.x]), *line.responses[figure.y][:3]) for line in lines]
    return Series(name, *np.array(sorted(told, key=lambda one: one[0]), dtype=float).T)


def grouped(lines: Sequence[Line], apart: Axis, name: str, study: Study) -> dict[str, list[Line]]:
    """Table lines grouped by the level of factor `name`, in the order of its axis `apart`."""
    # A sampled factor has about as many levels as points: divide the sorted points into BANDS groups of equal size.
    if is_drawn(study) and apart.numeric and len(apart.levels) > 2 * BANDS:
        ordered = sorted(lines, key=lambda line: apart.place(line.levels[name]))
        ends = [round(n * len(ordered) / BANDS) for n in range(BANDS + 1)]
        parts = [ordered[a:b] for a, b in itertools.pairwise(ends) if b > a]
        spans = [[apart.place(part[n].levels[name]) for n in (0, -1)] for part in parts]
        return {f"{low:.3g} to {high:.3g}": part for (low, high), part in zip(spans, parts, strict=True)}
    return {apart.told(one): [line for line in lines if same(line.levels[name], one)] for one in apart.levels}


def grid(lines: Sequence[Line], figure: Heat, study: Study) -> Grid:
    """The axes and cell values of a heat map."""
    x, y = axis(study, lines, figure.x), axis(study, lines, figure.y)
    columns = {x.place(one): n for n, one in enumerate(x.levels)}
    rows = {y.place(one): n for n, one in enumerate(y.levels)}
    value = np.full((len(rows), len(columns)), np.nan)
    for line in kept(lines, figure, study):
        place = rows[y.place(line.levels[figure.y])], columns[x.place(line.levels[figure.x])]
        value[place] = line.responses[figure.value].value
    return Grid(x, y, value)


def limits(values: Sequence[Floats], ends: Sequence[Floats], log: bool, share: bool) -> tuple[float, float]:
    """Axis limits that include all values and all finite interval bounds, with padding.

    On a logarithmic axis nonpositive numbers, and bounds far below the smallest value (FAR), are left out.
    """
    inner, outer = (np.concatenate([*arrays, np.empty(0)]) for arrays in (values, ends))
    inner, outer = inner[np.isfinite(inner)], outer[np.isfinite(outer)]
    if log:
        inner, outer = inner[inner > 0], outer[outer > 0]
        outer = outer[outer > (inner.min() if len(inner) else outer.max(initial=0.0)) / FAR]
    told = np.concatenate([inner, outer])
    if not len(told):
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(told.min()), float(told.max())
    if log:
        pad = max((high / low) ** 0.06, 1.15 if high > 2 * low else 1.5)
        return low / pad, high * pad
    # Start at zero if the values come near it.
    low = 0.0 if 0 < low < 0.4 * high else low
    pad = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    low, high = low - (pad if low else pad / 2), high + pad
    return (max(low, -0.03), min(high, 1.03)) if share else (low, high)


# Candidates of an optimization.


def panels(lines: Sequence[Line], search: Search, costs: Mapping[int, float] | None) -> dict[str, Panel]:
    """One panel per objective, constrained response and, if costs are given, cost; by name."""
    names = [one.response for one in search.objectives] + [one.response for one in search.constraints]
    names += ["cost"] * (costs is not None)
    return {name: panel(name, lines, search, costs or {}) for name in dict.fromkeys(names)}


def panel(name: str, lines: Sequence[Line], search: Search, costs: Mapping[int, float]) -> Panel:
    """The panel of one response, or of `cost`, over the candidates."""
    nothing = float("nan")
    if name == "cost":
        told: list[Any] = [(costs.get(line.point, nothing), nothing, nothing) for line in lines]
    else:
        told = [line.responses[name][:3] for line in lines]
    bounds = [
        bound
        for one in search.constraints
        if one.response == name
        for bound in (one.at_least, one.at_most)
        if bound is not None
    ]
    better = next((f", {one.better} is better" for one in search.objectives if one.response == name), "")
    value, low, high = np.array(told, dtype=float).reshape(-1, 3).T
    return Panel(label(name) + better, value, low, high, bounds)


# Captions.


def caption(figure: Figure, study: Study, lines: Sequence[Line]) -> str:
    """Caption of a figure: its axes, the fixed levels, the number of trials per point, and the markers used."""
    curve = isinstance(figure, Curve)
    value = figure.y if isinstance(figure, Curve) else figure.value
    other = (figure.by, "by") if isinstance(figure, Curve) else (figure.y, "and")
    told = f"{value} against {figure.x}" + (f" {other[1]} {other[0]}" if other[0] else "")
    levels = {name: one for name, one in held(figure, study, lines).items() if varies(lines, name)}
    told += f", at {', '.join(f'{name} = {level(one)}' for name, one in levels.items())}" if levels else ""
    shown = [line.responses[value] for line in kept(lines, figure, study)]
    counts = [one.trials for one in shown if one.trials]
    if not counts:
        return f"{told}. No trial of it is in yet."
    told += f". n = {min(counts)}" + (f" to {max(counts)}" if max(counts) > min(counts) else "") + " a point"
    ends = np.array([(one.low, one.high) for one in shown])
    if not curve or np.isnan(ends).all():
        return told + "."
    told += f"; intervals of {100 * metrics.CONFIDENCE:g} %."
    across = axis(study, lines, figure.x)
    if in_dots(study, across, len(shown)):
        return (
            told.partition(";")[0]
            + f"; lines: {'running medians' if across.numeric else 'medians'} of the points."
        )
    if np.isinf(ends).any():
        bands = in_bands(across) and not is_drawn(study)
        mark = "band that stops at its line" if bands else "bar that leaves the picture"
        told += f" A {mark} has no end there: too few trials."
    if figure.log and any(one.value <= 0 < one.high for one in shown):
        told += " Triangles: none was seen, and so much at most."
    return told


def varies(lines: Sequence[Line], name: str) -> bool:
    """Whether a factor has more than one level among the points."""
    return len(distinct(line.levels[name] for line in lines)) > 1
