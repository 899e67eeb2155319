"""What goes where in a study's pictures: which figures there are, their axes, lines and cells, their captions."""

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

DRAWN = ("lhs", "sobol", "saltelli")  # designs whose points share no levels
BARS = 12  # places on an axis up to which intervals are bars, then bands
CROWD = 60  # drawn points up to which each has its bar; beyond, their running median is drawn
BANDS = 4  # of a drawn factor that tells lines apart
MOST_LINES = 7  # of a curve that no study file asked for; with more levels it is a heat map
MOST_FIGURES = 24  # that no study file asked for
RATIO = 10  # of the last level to the first, from which a factor may be shown by its logarithm
SPAN = 30  # of a response's values, from which a figure that no study file asked for has a logarithmic axis
FAR = 30  # times below the least value, an interval's end no longer stretches a logarithmic axis
UNITS = {"_deg_s": "deg/s", "_arcsec": "arcsec", "_deg": "deg", "_mag": "mag", "_px": "px", "_um": "um"}
UNITS |= {"_mm": "mm", "_ms": "ms", "_hz": "Hz", "_m": "m", "_s": "s"}


class Axis(NamedTuple):
    """A factor as an axis: its levels in order, ascending where they are numbers of one unit, else the study's."""

    label: str
    levels: list[Value]
    numeric: bool
    log: bool

    def place(self, one: Value) -> float:
        """Where a level stands: its number, or how many stand before it."""
        if self.numeric:
            return split(one)[0]
        return float(next(n for n, other in enumerate(self.levels) if same(one, other)))

    def told(self, one: Value) -> str:
        """What stands at a level; a number without its unit, which the label has."""
        if not self.numeric:
            return level(one)
        number = self.place(one)
        return f"{number:.6g}" if number == int(number) else f"{number:.3g}"


class Series(NamedTuple):
    """A line of a curve: what it is called and (N,) places, values and ends of their intervals, by place."""

    label: str
    x: Floats
    value: Floats
    low: Floats
    high: Floats


class Grid(NamedTuple):
    """A heat map: its axes and (Y, X) values, NaN where nothing is known."""

    x: Axis
    y: Axis
    value: Floats


class Panel(NamedTuple):
    """What a search looked at: (N,) values by candidate and ends of their intervals, and what they must not pass."""

    label: str
    value: Floats
    low: Floats
    high: Floats
    bounds: list[float]


# Names and axes.


def is_drawn(study: Study) -> bool:
    """Whether points lie anywhere, so that no two share their levels."""
    return study.optimise is not None or study.design.kind in DRAWN


def same(one: Value, other: Value) -> bool:
    """Whether two levels are one: 5 and 5.0 are, "5 m" and "5.0 m" too."""
    try:
        return split(one) == split(other)
    except ValueError:
        return bool(one == other)


def distinct(levels: Iterable[Value]) -> list[Value]:
    """Levels, each once."""
    return list({repr(one): one for one in levels}.values())


def label(name: str, unit: str = "") -> str:
    """A name for people, its unit in brackets: `cross_arcsec_p95` is "cross p95 [arcsec]"."""
    figure, _, statistic = name.rpartition("_")
    stem, tail = (figure, f" {statistic}") if statistic in metrics.STATISTICS else (name, "")
    ending = next((ending for ending in UNITS if stem.endswith(ending)), "")
    unit = unit or UNITS.get(ending, "")
    told = stem.removesuffix(ending).replace("_", " ") + tail
    return told + (f" [{unit}]" if unit else " [share]" if is_share(name) else "")


def is_share(name: str) -> bool:
    """Whether a response lies between 0 and 1."""
    return name in metrics.SHARES or bool(metrics.COVERAGE.match(name)) or name.startswith("availability_")


def axis(study: Study, lines: Sequence[Line], name: str) -> Axis:
    """A factor of a study as an axis, of the levels at which there are points."""
    factor, levels = study.factors[name], distinct(line.levels[name] for line in lines)
    key = "" if isinstance(factor, Levels) else factor.key or ""
    unit = next((unit for ending, unit in UNITS.items() if key.endswith(ending)), "")
    numbers, own = numbers_of(levels)
    if numbers is not None:
        levels = [levels[n] for n in np.argsort(numbers)]
        told = isinstance(factor, Range) and factor.scale == "log"
        told |= isinstance(factor, Distribution) and factor.distribution == "lognormal"
        even = isinstance(factor, Range | Distribution)  # in what they say themselves
        return Axis(label(name, own or unit), levels, True, told or (not even and by_ratio(np.sort(numbers))))
    order = [one for one, _ in factor.options()]
    levels.sort(key=lambda one: next((n for n, other in enumerate(order) if same(one, other)), len(order)))
    worded = any(isinstance(one, str | bool) for one in levels)
    return Axis(label(name, "" if worded else unit), levels, False, False)


def numbers_of(levels: Sequence[Value]) -> tuple[Floats | None, str]:
    """Levels as numbers of one unit, no two alike; None where they are not."""
    try:
        parts = [split(one) for one in levels]
    except ValueError:
        return None, ""
    numbers, units = np.array([number for number, _ in parts]), {unit for _, unit in parts}
    if len(units) != 1 or len(np.unique(numbers)) < len(numbers):
        return None, ""
    return numbers, units.pop()


def in_bands(across: Axis) -> bool:
    """Whether a line has so many places that its intervals are a band."""
    return across.numeric and len(across.levels) > BARS


def in_dots(study: Study, across: Axis, count: int) -> bool:
    """Whether drawn points are so many, or so close, that their medians are shown instead of intervals."""
    return is_drawn(study) and (count > CROWD or not across.numeric)


def by_ratio(numbers: Floats) -> bool:
    """Whether ascending numbers over a wide range step by ratios more evenly than by differences."""
    if len(numbers) < 4 or numbers[0] <= 0 or numbers[-1] < RATIO * numbers[0]:
        return False
    uneven = [np.std(steps) / np.mean(steps) for steps in (np.diff(np.log(numbers)), np.diff(numbers))]
    return bool(uneven[0] < uneven[1])


# Which figures, and of which points.


def figures(study: Study, lines: Sequence[Line]) -> list[Figure]:
    """The study file's; where it names none, sensible ones of every response, or of the first: MOST_FIGURES.

    Drawn points, and those of one factor at a time, against each factor; else against the first that is numeric,
    with a line for each level of another, or over both where those were too many lines.
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
    most = max(MOST_FIGURES * len(study.responses) // len(pairs), 1)  # responses, each with all its figures
    return [sensible(x, by, y, axes, lines) for x, by, y in pairs if y in study.responses[:most]]


def sensible(x: str, by: str | None, y: str, axes: Mapping[str, Axis], lines: Sequence[Line]) -> Figure:
    """A figure that no study file asked for."""
    values = np.array([line.responses[y].value for line in lines])
    values = values[np.isfinite(values)]
    log = bool(len(values) and values.min() > 0 and values.max() > SPAN * values.min())
    if by is not None and len(axes[by].levels) > MOST_LINES:
        return Heat(kind="heat", x=x, y=by, value=y, log=log)
    return Curve(kind="curve", x=x, y=y, by=by, log=log)


def held(figure: Figure, study: Study, lines: Sequence[Line]) -> dict[str, Value]:
    """The levels at which a figure holds factors: as its `where` says, else, of those it does not show, the first.

    Drawn points share no levels: there `where` alone holds. Raises InputError where it names what is not there.
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
    """The lines of the table that a figure shows."""
    levels = held(figure, study, lines)
    return [line for line in lines if all(same(line.levels[name], one) for name, one in levels.items())]


def series(lines: Sequence[Line], figure: Curve, study: Study) -> list[Series]:
    """The lines of a curve, one for each level of `by`; of a drawn `by`, for each of BANDS equal parts."""
    across, chosen = axis(study, lines, figure.x), kept(lines, figure, study)
    groups = {"": chosen}
    if figure.by is not None:
        groups = grouped(chosen, axis(study, lines, figure.by), figure.by, study)
    return [one_series(name, group, figure, across) for name, group in groups.items() if group]


def one_series(name: str, lines: Sequence[Line], figure: Curve, across: Axis) -> Series:
    """Some lines of the table as a line of a curve."""
    told = [(across.place(line.levels[figure.x]), *line.responses[figure.y][:3]) for line in lines]
    return Series(name, *np.array(sorted(told, key=lambda one: one[0]), dtype=float).T)


def grouped(lines: Sequence[Line], apart: Axis, name: str, study: Study) -> dict[str, list[Line]]:
    """Lines of the table by a factor's level, in the axis's order."""
    if is_drawn(study) and apart.numeric and len(apart.levels) > 2 * BANDS:
        ordered = sorted(lines, key=lambda line: apart.place(line.levels[name]))
        ends = [round(n * len(ordered) / BANDS) for n in range(BANDS + 1)]
        parts = [ordered[a:b] for a, b in itertools.pairwise(ends) if b > a]
        spans = [[apart.place(part[n].levels[name]) for n in (0, -1)] for part in parts]
        return {f"{low:.3g} to {high:.3g}": part for (low, high), part in zip(spans, parts, strict=True)}
    return {apart.told(one): [line for line in lines if same(line.levels[name], one)] for one in apart.levels}


def grid(lines: Sequence[Line], figure: Heat, study: Study) -> Grid:
    """The cells of a heat map."""
    x, y = axis(study, lines, figure.x), axis(study, lines, figure.y)
    columns = {x.place(one): n for n, one in enumerate(x.levels)}
    rows = {y.place(one): n for n, one in enumerate(y.levels)}
    value = np.full((len(rows), len(columns)), np.nan)
    for line in kept(lines, figure, study):
        place = rows[y.place(line.levels[figure.y])], columns[x.place(line.levels[figure.x])]
        value[place] = line.responses[figure.value].value
    return Grid(x, y, value)


def limits(values: Sequence[Floats], ends: Sequence[Floats], log: bool, share: bool) -> tuple[float, float]:
    """Of an axis that shows all values and what is finite of their intervals' ends, unless far below on a log axis."""
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
    low = 0.0 if 0 < low < 0.4 * high else low
    pad = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    low, high = low - (pad if low else pad / 2), high + pad
    return (max(low, -0.03), min(high, 1.03)) if share else (low, high)


# A search's candidates.


def panels(lines: Sequence[Line], search: Search, costs: Mapping[int, float] | None) -> dict[str, Panel]:
    """What a search looked at, by name: its objectives, what else it constrains, and costs where they are given."""
    names = [one.response for one in search.objectives] + [one.response for one in search.constraints]
    names += ["cost"] * (costs is not None)
    return {name: panel(name, lines, search, costs or {}) for name in dict.fromkeys(names)}


def panel(name: str, lines: Sequence[Line], search: Search, costs: Mapping[int, float]) -> Panel:
    """One response, or `cost`, by candidate."""
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


# Words.


def caption(figure: Figure, study: Study, lines: Sequence[Line]) -> str:
    """What a figure shows, what it holds, of how many values, and what its marks mean."""
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
    """Whether points differ in a factor."""
    return len(distinct(line.levels[name] for line in lines)) > 1
