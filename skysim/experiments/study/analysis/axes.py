"""Factors of a study as axes, and which of its points a figure or a threshold is about."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from skysim.core.errors import InputError, unknown_name
from skysim.core.types import Floats
from skysim.experiments.study.analysis.table import (PointRow, format_level)
from skysim.experiments.study.factors import (Distribution, Levels, Range, Value, split_quantity)
from skysim.experiments.study.plan import Figure, Study, Threshold
from skysim.results import metrics

SAMPLED_DESIGNS = ("lhs", "sobol", "saltelli")  # sampled designs: no two points share a level
GROUPS = 4  # number of groups into which a sampled factor `by` is divided
LOG_FACTOR_RATIO = 10  # minimum ratio of last to first level for a logarithmic factor axis
UNITS = {
    "_deg_s": "deg/s",
    "_arcsec": "arcsec",
    "_deg": "deg",
    "_mag": "mag",
    "_px": "px",
    "_um": "um",
}
UNITS |= {"_mm": "mm", "_ms": "ms", "_hz": "Hz", "_m": "m", "_s": "s"}
Shown = Figure | Threshold


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
    factor = study.factors[name]
    levels = distinct(line.levels[name] for line in lines)
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
    levels.sort(
        key=lambda one: next((n for n, other in enumerate(order) if same(one, other)), len(order))
    )
    has_text = any(isinstance(one, str | bool) for one in levels)
    return Axis(label(name, "" if has_text else unit), levels, False, False)


def unit_of(axis: Axis) -> str:
    """The unit of an axis after a space; empty if it has none."""
    unit = axis.label.partition(" [")[2].rstrip("]")
    return f" {unit}" if unit else ""


def as_numbers(levels: Sequence[Value]) -> tuple[Floats | None, str]:
    """(N,) levels as numbers, and their unit. None unless all are numbers of the same unit and distinct."""
    try:
        parts = [split_quantity(one) for one in levels]
    except ValueError:
        return None, ""
    numbers = np.array([number for number, _ in parts])
    units = {unit for _, unit in parts}
    if len(units) != 1 or len(np.unique(numbers)) < len(numbers):
        return None, ""
    return numbers, units.pop()


def suits_log_scale(numbers: Floats) -> bool:
    """Whether ascending numbers suit a logarithmic axis.

    True if they are positive, extend over a ratio of at least LOG_FACTOR_RATIO, and their steps vary less as ratios
    than as differences (compared by the coefficient of variation).
    """
    if len(numbers) < 4 or numbers[0] <= 0 or numbers[-1] < LOG_FACTOR_RATIO * numbers[0]:
        return False
    variation = [
        np.std(steps) / np.mean(steps) for steps in (np.diff(np.log(numbers)), np.diff(numbers))
    ]
    return bool(variation[0] < variation[1])


# Selection of points.


def fixed_levels(shown: Shown, study: Study, lines: Sequence[PointRow]) -> dict[str, Value]:
    """The levels at which a figure or threshold keeps factors fixed: those of its `where`, and the first level of
    other factors that it does not show.

    Sampled points share no levels, so only `where` applies to them. Raises InputError if `where` names an unknown
    factor or level.
    """
    check_levels(shown.where, study, lines)
    if is_sampled(study):
        return dict(shown.where)
    axes = set(shown.axes.values())
    return {
        name: shown.where.get(name, factor.options()[0][0])
        for name, factor in study.factors.items()
        if name not in axes or name in shown.where
    }


def shown_points(lines: Sequence[PointRow], shown: Shown, study: Study) -> list[PointRow]:
    """The table lines (points) that a figure or threshold is about."""
    return points_at(lines, study, fixed_levels(shown, study, lines))


def check_levels(levels: Mapping[str, Value], study: Study, lines: Sequence[PointRow]) -> None:
    """Raise InputError for an unknown factor, or a level at which there is no point."""
    for name, level in levels.items():
        if name not in study.factors:
            raise InputError("where", *unknown_name("factor", name, study.factors))
        available = distinct(line.levels[name] for line in lines)
        if not any(same(level, one) for one in available):
            allowed = ", ".join(map(format_level, available[:20]))
            raise InputError(f"where.{name}", f"unknown level {level!r}", allowed)


def points_at(
    lines: Sequence[PointRow], study: Study, levels: Mapping[str, Value]
) -> list[PointRow]:
    """The table lines (points) at these levels. Raises InputError for an unknown factor or level."""
    check_levels(levels, study, lines)
    return [
        line for line in lines if all(same(line.levels[name], one) for name, one in levels.items())
    ]


def group_points(
    lines: Sequence[PointRow], group_axis: Axis, name: str, study: Study
) -> dict[str, list[PointRow]]:
    """Table lines grouped by the level of factor `name`, in the order of its axis `group_axis`."""
    # A sampled factor has about as many levels as points: divide the sorted points into GROUPS groups of equal size.
    if is_sampled(study) and group_axis.numeric and len(group_axis.levels) > 2 * GROUPS:
        ordered = sorted(lines, key=lambda line: group_axis.coordinate(line.levels[name]))
        bounds = [round(n * len(ordered) / GROUPS) for n in range(GROUPS + 1)]
        parts = [ordered[a:b] for a, b in itertools.pairwise(bounds) if b > a]
        spans = [[group_axis.coordinate(part[n].levels[name]) for n in (0, -1)] for part in parts]
        return {
            f"{low:.3g} to {high:.3g}": part for (low, high), part in zip(spans, parts, strict=True)
        }
    return {
        group_axis.tick_label(one): [line for line in lines if same(line.levels[name], one)]
        for one in group_axis.levels
    }
