"""Result tables of a study: one line per point with every response and its interval, and one row per trial."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy

from skysim.core.errors import InputError, check_name
from skysim.core.random_streams import random_stream
from skysim.core.types import Array, Bools, Floats, Record
from skysim.experiments.study.execution.store import Store
from skysim.experiments.study.factors import (
    Distribution,
    Factor,
    Levels,
    Point,
    Range,
    Value,
    split_quantity,
)
from skysim.experiments.study.plan import Figure, Plan, Study, Threshold
from skysim.results import metrics
from skysim.results.files.row_parts import Rows, subset
from skysim.results.metrics import Columns, Summary

LONG_QUANTITY = re.compile(r"(-?\d*\.\d{4,}(?:e[-+]?\d+)?)(\s\S.*)$")
ROUNDING = 1e-9  # a smaller response is the rounding error of 0
MIN_VALUES = 5  # a response with fewer values, from more trials, has few


class PointRow(NamedTuple):
    """One point: its number, factor levels, the responses computed from its trials, and the number of its trials."""

    point: int
    levels: Record
    responses: dict[str, Summary]
    trials: int = 0


PointRows = Sequence[PointRow]


def table(store: Store, responses: Sequence[str]) -> list[PointRow]:
    """One row for every point of a store; responses of points without trials are NaN."""
    functions = {name: metrics.response(name) for name in responses}
    rows = []
    for number, point in enumerate(store.points()):
        columns = store.point_columns(number)
        responses_ = {name: response(columns) for name, response in functions.items()}
        rows.append(PointRow(number, point.levels, responses_, len(columns["trial"])))
    return rows


def pooled(plan: Plan, store: Store) -> Columns:
    """The columns of one trial at each point of an lhs or sobol design with few replicates; else empty.

    A point alone has too few trials for a statistic, and the points are draws from the factors. Trials of a point share
    its levels, so one of them counts, and paired trials share their noise.
    """
    study = plan.study
    each = study.replicates
    if (
        study.paired
        or study.optimize
        or each >= MIN_VALUES
        or study.design.kind not in ("lhs", "sobol")
    ):
        return {}
    columns = store.point_columns(*range(len(plan.points)))
    return subset(columns, columns["trial"] % each == columns["point"] % each)


def pooled_row(plan: Plan, columns: Columns, responses: Sequence[str]) -> PointRow:
    """The row of pooled trials, as a point; its levels stand for all."""
    found = {name: metrics.response(name)(columns) for name in responses}
    return PointRow(0, plan.points[0].levels, found, len(columns["trial"]))


def quantities(responses: Sequence[str]) -> list[str]:
    """The quantities of the responses, without proportions."""
    split = (metrics.split_name(name)[0] for name in responses)
    return [name for name in dict.fromkeys(split) if name in metrics.QUANTITIES]


def rank_correlations(plan: Plan, columns: Columns) -> list[tuple[str, str, Summary]]:
    """Spearman's correlation of each quantity with each numeric factor over pooled trials, the strongest first.

    The interval is tanh(atanh r +- z sqrt((1 + r^2 / 2) / (n - 3))) (Bonett & Wright 2000), for all correlations
    together; none of fewer than FEWEST trials, or of equal values.
    """
    lines = without_responses(plan.study, plan.points)
    numeric = [name for name, one in lines.axes.items() if one.numeric]
    pairs = list(itertools.product(quantities(plan.study.responses), numeric))
    found = []
    for quantity, name in pairs:
        y = metrics.QUANTITIES[quantity](columns)
        known = np.isfinite(y)
        count = int(known.sum())
        if count < metrics.FEWEST or np.ptp(y[known]) == 0:
            continue
        x = [lines.axes[name].at(lines[n]) for n in columns["point"][known]]
        r = float(scipy.stats.spearmanr(x, y[known]).statistic)
        half = metrics.joint_sigmas(len(pairs)) * math.sqrt((1 + r**2 / 2) / (count - 3))
        low, high = np.tanh(np.arctanh(np.clip(r, -1, 1)) + np.array([-half, half])).tolist()
        found.append((quantity, name, Summary(r, low, high, count)))
    return sorted(found, key=lambda one: -abs(one[2].value))


def has_few_values(row: PointRow, response: str) -> bool:
    """Whether few of a point's trials have a value of a response: less than half of them, or less than MIN_VALUES.

    The error of a solution, for example, is known for solved trials alone; if few are solved, they are the easy ones.
    """
    values = row.responses[response].trials
    return 0 < values < max(row.trials / 2, min(MIN_VALUES, row.trials))


def select_responses(lines: PointTable, responses: Sequence[str]) -> PointTable:
    """The points with only these responses."""
    return lines.with_rows(
        one._replace(responses={name: one.responses[name] for name in responses})
        for one in lines
    )


def format_level(value: Any) -> str:
    """Text of a factor's level, numbers rounded to four digits."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    match = LONG_QUANTITY.match(str(value))
    if match:  # a sampled quantity with a unit
        return f"{float(match[1]):.4g}{match[2]}"
    return str(value)


def format_summary(summary: Summary) -> str:
    """Text of a statistic with its interval, or with the number of further values that it needs to have one."""
    if np.isnan(summary.value):
        return f"needs {summary.needs} more values" if summary.needs else "-"
    value, low, high = (0.0 if abs(one) < ROUNDING else one for one in summary[:3])
    if summary.needs:
        return f"{value:.3g} (needs {summary.needs} more values)"
    if np.isnan(low) or low == high:
        return f"{value:.3g}"
    return f"{value:.3g} ({low:.3g}..{high:.3g})"


def format_response(row: PointRow, name: str) -> str:
    """Text of a response, with the number of values where few of the point's trials have one."""
    text = format_summary(row.responses[name])
    return f"{text} n={row.responses[name].trials}" if has_few_values(row, name) else text


def to_columns(rows: PointRows) -> dict[str, list[Any]]:
    """The rows as columns: point, factors, and value, low, high and trial count of each response."""
    columns: dict[str, list[Any]] = {"point": [one.point for one in rows]}
    if not rows:
        return columns
    for name in rows[0].levels:
        columns[name] = [one.levels[name] for one in rows]
    for name in rows[0].responses:
        for field in Summary._fields:
            key = name if field == "value" else f"{name}_{field}"
            columns[key] = [getattr(one.responses[name], field) for one in rows]
    return columns


def trial_columns(store: Store) -> Rows:
    """All trials: the columns of the store, and a column for the levels of each factor."""
    return with_levels(store.columns(), level_columns(store))


def level_columns(store: Store) -> dict[str, Array]:
    """(P,) levels of each factor by point: numbers, or texts."""
    points = store.points()
    names = points[0].levels if points else {}
    return {name: to_array([one.levels[name] for one in points]) for name in names}


def to_array(levels: Sequence[Any]) -> Array:
    """Levels of a factor as an array; as texts if numpy has no type for them."""
    plain = [format_level(one) if isinstance(one, list) else one for one in levels]
    array = np.array(plain)
    if array.dtype != object:
        return array
    return np.array([one if one is None else str(one) for one in levels], object)


def with_levels(rows: Rows, levels: dict[str, Array]) -> Rows:
    """Rows of trials, and the levels of their points."""

    def column(name: str) -> Array:
        return levels[name][rows["point"]] if name in levels else rows[name]

    return Rows((*rows, *levels), [column], [rows.starts[-1]])


# Error budget: Sobol indices of the attitude error for each factor (Sobol 1993).


OFF = ("off", "none", "no", "exact", "false", "0")
AXES = {"cross_arcsec": ("x_arcsec", "y_arcsec"), "roll_arcsec": ("roll_arcsec",)}
RESAMPLES = 200


class Index(NamedTuple):
    """Contribution of a factor to one error: its indices, and rms_arcsec, the error due to this factor alone.

    rms_arcsec is the standard deviation of the error times the square root of the first-order index.
    """

    factor: str
    response: str
    first: Summary
    total: Summary
    rms_arcsec: float


def is_off(level: Value) -> bool:
    """Whether a level switches a cause of errors off: zero, false, or a name in OFF."""
    return same(level, 0) or format_level(level).partition(" ")[0].lower() in OFF


def switches_causes(study: Study) -> bool:
    """Whether the factors are causes of errors, each off or on, in a design with levels."""
    levels = [
        [is_off(one) for one, _ in factor.options()] for factor in study.factors.values()
    ]
    return not study.is_sampled and all(sorted(one) == [False, True] for one in levels)


# (3, 2, D) first and total indices of each factor: values, low ends, high ends; their count; variance about one axis.
Estimate = tuple[Floats, int, float]


def switched_causes(plan: Plan, outputs: Floats) -> Estimate:
    """The part of each cause, and of the rest, in the mean square m of (S, P) errors with all causes on.

    Its first index is what it adds alone, its total one what goes without it,

        (m({i}) - m({})) / m(all),    (m(all) - m(all but i)) / m(all),

    which are equal if the errors are independent and the tracker weights lights alike. NaN without these points;
    without that of all causes m(all) is m({}) + sum of m({i}) - m({}). The intervals are of the percentile bootstrap
    over replicates, none of fewer than MIN_VALUES.
    """
    squares = outputs**2 if len(outputs) else np.full((1, len(plan.points)), np.nan)
    count = len(squares)
    drawn = random_stream(1).integers(count, size=(RESAMPLES, count))
    means = np.concatenate([[squares.mean(axis=0)], squares[drawn].mean(axis=1)])
    points = np.array(
        [[not is_off(one) for one in each.levels.values()] for each in plan.points]
    )

    def mean(on: Bools) -> Floats:
        """(1 + RESAMPLES,) mean square with some causes on; NaN without this point."""
        there = np.all(points == on, axis=1)
        return means @ there / (there.sum() or np.nan)

    one = np.eye(len(points[0]), dtype=bool)
    none = mean(np.zeros(len(one), bool))
    alone = [mean(on) - none for on in one]
    every = mean(np.ones(len(one), bool))
    if np.isnan(every).any():
        every = none + sum(alone)
    without = [every - mean(~on) for on in one]
    shares = np.array([[*alone, none], [*without, np.nan * none]]) / every
    ends = np.quantile(shares[..., 1:], metrics.TAILS, axis=-1)
    ends[...] = ends if count >= MIN_VALUES else np.nan
    return np.array([shares[..., 0], *ends]), count, every[0]


def indices(plan: Plan, store: Store) -> list[Index]:
    """Indices of every factor for the cross-boresight and roll errors. Raises InputError for another design."""
    kind = plan.study.design.kind
    estimate = switched_causes if switches_causes(plan.study) else response_indices
    if estimate is response_indices and (kind != "saltelli" or plan.study.optimize):
        raise InputError("design.kind", kind, "saltelli, without optimize, for Sobol indices")
    found = []
    for response, axes in AXES.items():
        values, count, variance = estimate(plan, complete_outputs(plan, store, axes))
        # The variance of the cross-boresight error is the sum of the variances about its two axes.
        sigma_arcsec = math.sqrt(variance * len(axes))
        names = [*plan.study.factors, "the rest"]
        for name, both in zip(names, values.T.tolist(), strict=False):
            first, total = (Summary(value, low, high, count) for value, low, high in both)
            rms_arcsec = sigma_arcsec * math.sqrt(max(first.value, 0.0))
            found.append(Index(name, response, first, total, rms_arcsec))
    return found


def response_indices(plan: Plan, outputs: Floats) -> Estimate:
    """Indices of every factor for (S, P) errors; NaN if no replicate is complete."""
    width = len(plan.study.factors)
    if not len(outputs):
        return np.full((3, 2, width), np.nan), 0, np.nan
    # (S, N) errors at A and at B, and (D, S, N) at A with one column of B: points are in the order A, B, AB_1 .. AB_D.
    count = len(plan.points) // (width + 2)
    blocks = outputs.reshape(len(outputs), width + 2, count)
    a = blocks[:, 0]
    b = blocks[:, 1]
    ab = blocks[:, 2:].transpose(1, 0, 2)
    estimate = generalized(a, b, ab)
    rng = random_stream(1)
    # Resample rows of A, B and AB together, so that each resample is a valid Saltelli sample.
    selections = rng.integers(count, size=(RESAMPLES, count))
    resampled = [generalized(a[:, rows], b[:, rows], ab[:, :, rows]) for rows in selections]
    ends = np.quantile(resampled, metrics.TAILS, axis=0)
    variance = np.var(np.concatenate([a, b], axis=1), axis=1).mean()
    return np.array([estimate, *ends]), count, variance


def complete_outputs(plan: Plan, store: Store, axes: tuple[str, ...]) -> Floats:
    """(S, P) errors at the points: S outputs, one per axis and replicate.

    A replicate is left out if any of its trials has no solution or is not done yet.
    """
    each = plan.study.replicates
    columns = store.columns()
    values = np.full((len(axes), plan.trials), np.nan)
    values[:, columns["trial"]] = [columns[name] for name in axes]
    # Trial number = point * replicates + replicate.
    by_point = values.reshape(len(axes), len(plan.points), each)
    outputs = by_point.transpose(0, 2, 1).reshape(len(axes) * each, -1)
    return outputs[np.isfinite(outputs).all(axis=1)]


def generalized(a: Floats, b: Floats, ab: Floats) -> Floats:
    """(2, D) first-order and total indices, averaged over the outputs with their variances as weights.

    The estimators are those of Saltelli et al. (2010), from SciPy. Outputs without variance have weight zero.
    """
    estimate = scipy.stats.sobol_indices(func={"f_A": a, "f_B": b, "f_AB": ab}, n=a.shape[1])
    weight = np.var(np.concatenate([a, b], axis=1), axis=1)
    if weight.sum() == 0:
        return np.zeros((2, len(ab)))
    varying = weight > 0
    both = (estimate.first_order, estimate.total_order)
    # SciPy drops the axis of a single output.
    indices = [index.reshape(len(a), -1) for index in both]
    return np.stack([weight[varying] @ index[varying] / weight.sum() for index in indices])


# Factors of a study as axes, and the points of a figure or a threshold.


GROUPS = 4  # number of groups into which a sampled factor `by` is divided
LOG_FACTOR_RATIO = 10  # minimum ratio of last to first level for a logarithmic factor axis
UNITS = {
    "_deg_s": "deg/s",
    "_arcsec": "arcsec",
    "_deg": "deg",
    "_mag": "mag",
    "_px": "px",
    "_um": "um",
    "_mm": "mm",
    "_ms": "ms",
    "_hz": "Hz",
    "_m": "m",
    "_s": "s",
}
Shown = Figure | Threshold


class Axis(NamedTuple):
    """A factor as an axis: label and levels, ascending if they are numbers of one unit, else in the study's order."""

    label: str
    levels: list[Value]
    numeric: bool
    log: bool
    factor: str

    def coordinate(self, one: Value) -> float:
        """Coordinate of a level on the axis: its numeric value, or its index if levels are not numeric."""
        if self.numeric:
            return split_quantity(one)[0]
        return float(next(n for n, other in enumerate(self.levels) if same(one, other)))

    @property
    def unit(self) -> str:
        """The unit after a space; empty if there is none."""
        unit = self.label.partition(" [")[2].rstrip("]")
        return f" {unit}" if unit else ""

    def at(self, line: PointRow) -> float:
        """Coordinate of a point on the axis."""
        return self.coordinate(line.levels[self.factor])

    def tick_label(self, one: Value) -> str:
        """Tick text of a level; a number is written without its unit, which is in the axis label."""
        if not self.numeric:
            return format_level(one)
        number = self.coordinate(one)
        return f"{number:.6g}" if number == int(number) else f"{number:.3g}"


# Names and axes.


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
    stem, _, statistic = name.rpartition("_")
    tail = f" {statistic}"
    if not stem or metrics.statistic_of(statistic) is None:
        stem, tail = name, ""
    ending = next((ending for ending in UNITS if stem.endswith(ending)), "")
    unit = unit or UNITS.get(ending, "")
    text = stem.removesuffix(ending).replace("_", " ") + tail
    if unit:
        return f"{text} [{unit}]"
    return f"{text} [share]" if metrics.is_proportion(name) else text


def axis(name: str, factor: Factor, levels: list[Value]) -> Axis:
    """The axis of a factor, with the levels at which there are points."""
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
        return Axis(label(name, own_unit or unit), levels, True, log, name)
    order = [one for one, _ in factor.options()]

    def place(level: Value) -> int:
        return next((n for n, one in enumerate(order) if same(level, one)), len(order))

    levels.sort(key=place)
    has_text = any(isinstance(one, str | bool) for one in levels)
    return Axis(label(name, "" if has_text else unit), levels, False, False, name)


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
    steps = np.diff(numbers / numbers[-1])
    ratios = np.diff(np.log(numbers))
    return bool(np.std(ratios) / np.mean(ratios) < np.std(steps) / np.mean(steps))


# The points of a study.


class PointTable(list[PointRow]):
    """Points of a study, as the lines of a table."""

    def __init__(self, study: Study, rows: Iterable[PointRow]) -> None:
        super().__init__(rows)
        self.study = study

    def with_rows(self, rows: Iterable[PointRow]) -> PointTable:
        """Some points of the same study, or points with other responses."""
        return PointTable(self.study, rows)

    @cached_property
    def axes(self) -> dict[str, Axis]:
        """The axis of each factor."""
        return {
            name: axis(name, factor, distinct(line.levels[name] for line in self))
            for name, factor in self.study.factors.items()
        }

    @cached_property
    def varied(self) -> dict[str, Axis]:
        """The axes of the factors with more than one level among the points."""
        return {name: one for name, one in self.axes.items() if len(one.levels) > 1}

    def place(self, line: PointRow) -> str:
        """The levels of a point that vary: "leds = 900, rate = 8 deg/s"."""
        levels = [(one, line.levels[name]) for name, one in self.varied.items()]
        return ", ".join(
            f"{one.factor} = {format_level(level)}{'' if isinstance(level, str) else one.unit}"
            for one, level in levels
        )

    def fixed_levels(self, shown: Shown) -> dict[str, Value]:
        """The levels at which a figure or threshold keeps factors fixed.

        They are those of its `where`, and the first level of the other factors that it does not show. Sampled points
        share no levels, so only `where` applies to them. Raises InputError if `where` names an unknown factor or level.
        """
        self.check_levels(shown.where)
        if self.study.is_sampled:
            return dict(shown.where)
        shown_factors = set(shown.axes.values())
        return {
            name: shown.where.get(name, factor.options()[0][0])
            for name, factor in self.study.factors.items()
            if name not in shown_factors or name in shown.where
        }

    def check_levels(self, levels: Mapping[str, Value]) -> None:
        """Raise InputError for an unknown factor, or a level at which there is no point."""
        for name, level in levels.items():
            check_name("where", "factor", name, self.study.factors)
            available = distinct(line.levels[name] for line in self)
            if not any(same(level, one) for one in available):
                allowed = ", ".join(map(format_level, available[:20]))
                raise InputError(f"where.{name}", f"unknown level {level!r}", allowed)

    def at(self, levels: Mapping[str, Value]) -> list[PointRow]:
        """The points at these levels. Raises InputError for an unknown factor or level."""
        self.check_levels(levels)
        return [
            line
            for line in self
            if all(same(line.levels[name], one) for name, one in levels.items())
        ]

    def shown_in(self, shown: Shown) -> list[PointRow]:
        """The points of a figure or threshold."""
        return self.at(self.fixed_levels(shown))

    def groups(self, shown: Shown) -> dict[str, list[PointRow]]:
        """The points of a figure or threshold by the level of its `by`; under "" if it has none."""
        lines = self.shown_in(shown)
        name = shown.axes.get("by")
        if name is None:
            return {"": lines}
        by = self.axes[name]
        # A sampled factor has about as many levels as points: its sorted points are divided into GROUPS equal groups.
        if self.study.is_sampled and by.numeric and len(by.levels) > 2 * GROUPS:
            ordered = sorted(lines, key=by.at)
            bounds = [round(n * len(ordered) / GROUPS) for n in range(GROUPS + 1)]
            parts = [ordered[begin:end] for begin, end in itertools.pairwise(bounds)]
            return {
                f"{by.at(part[0]):.3g} to {by.at(part[-1]):.3g}": part
                for part in parts
                if part
            }
        return {
            by.tick_label(one): [line for line in lines if same(line.levels[name], one)]
            for one in by.levels
        }


def without_responses(study: Study, points: Iterable[Point]) -> PointTable:
    """The points of a study without their trials."""
    return PointTable(
        study, (PointRow(n, point.levels, {}) for n, point in enumerate(points))
    )
