"""Result tables of a study: one line per point with every response and its interval, and one row per trial."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.experiments.study.execution.store import Store
from skysim.results import metrics
from skysim.results.files.row_parts import Rows
from skysim.results.metrics import Summary

LONG_QUANTITY = re.compile(r"(-?\d*\.\d{4,}(?:e[-+]?\d+)?)(\s\S.*)$")


ROUNDING = 1e-9  # a smaller response is the rounding error of 0
MIN_VALUES = 5  # fewer values of more trials are few


class PointRow(NamedTuple):
    """One point: its number, factor levels, the responses computed from its trials, and the number of these."""

    point: int
    levels: dict[str, Any]
    responses: dict[str, Summary]
    trials: int = 0


Place = Callable[[PointRow], str]  # names a point in words


def table(store: Store, responses: Sequence[str]) -> list[PointRow]:
    """One row for every point of a store; responses of points without trials are NaN."""
    functions = {name: metrics.response(name) for name in responses}
    rows = []
    for number, point in enumerate(store.points()):
        columns = store.point_columns(number)
        responses_ = {name: response(columns) for name, response in functions.items()}
        rows.append(PointRow(number, point.levels, responses_, len(columns["trial"])))
    return rows


def has_few_values(row: PointRow, response: str) -> bool:
    """Whether few of a point's trials have a value of a response: less than half of them, or less than MIN_VALUES.

    The error of a solution, for example, is that of the solved trials alone, which are the easy ones where few are.
    """
    values = row.responses[response].trials
    return 0 < values < max(row.trials / 2, min(MIN_VALUES, row.trials))


def select_responses(rows: Sequence[PointRow], responses: Sequence[str]) -> list[PointRow]:
    """The rows with only these responses."""
    return [
        one._replace(responses={name: one.responses[name] for name in responses}) for one in rows
    ]


def cells(rows: Sequence[PointRow]) -> tuple[list[str], list[list[str]]]:
    """Column heads and cell texts of a table, such as `0.97 (0.95..0.98)`."""
    if not rows:
        return [], []
    texts = [
        [
            str(one.point),
            *map(format_level, one.levels.values()),
            *(format_response(one, name) for name in one.responses),
        ]
        for one in rows
    ]
    return ["point", *rows[0].levels, *rows[0].responses], texts


def format_level(value: Any) -> str:
    """Text of a factor's level, numbers rounded to four digits."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str) and (
        match := LONG_QUANTITY.match(value)
    ):  # a sampled quantity with a unit
        return f"{float(match[1]):.4g}{match[2]}"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def format_summary(summary: Summary) -> str:
    """Text of a statistic with its interval, or how many values more it needs to have one."""
    if np.isnan(summary.value):
        return "-"
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


def to_columns(rows: Sequence[PointRow]) -> dict[str, list[Any]]:
    """The rows as columns: point, factors, and value, low, high and trial count of each response."""
    columns: dict[str, list[Any]] = {"point": [one.point for one in rows]}
    for name in rows[0].levels if rows else ():
        columns[name] = [one.levels[name] for one in rows]
    for name in rows[0].responses if rows else ():
        for field in Summary._fields:
            key = name if field == "value" else f"{name}_{field}"
            columns[key] = [getattr(one.responses[name], field) for one in rows]
    return columns


def trial_columns(store: Store) -> Rows:
    """All trials: the columns of the store, and a column for the levels of each factor."""
    return with_levels(store.columns(), level_columns(store))


def level_columns(store: Store) -> dict[str, NDArray[Any]]:
    """(P,) levels of each factor by point: numbers, or texts."""
    points = store.points()
    return {
        name: to_array([one.levels[name] for one in points])
        for name in (points[0].levels if points else ())
    }


def to_array(levels: Sequence[Any]) -> NDArray[Any]:
    """Levels of a factor as an array; those that numpy has no type for as texts."""
    array = np.array([format_level(one) if isinstance(one, list) else one for one in levels])
    return (
        array
        if array.dtype != object
        else np.array([one if one is None else str(one) for one in levels], object)
    )


def with_levels(rows: Rows, levels: dict[str, NDArray[Any]]) -> Rows:
    """Rows of trials, and the levels of their points."""

    def column(name: str) -> NDArray[Any]:
        return levels[name][rows["point"]] if name in levels else rows[name]

    return Rows((*rows, *levels), [column], [rows.starts[-1]])
