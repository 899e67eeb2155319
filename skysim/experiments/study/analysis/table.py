"""Result tables of a study: one line per point with every response and its interval, and one row per trial."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.experiments.study.designs import Point
from skysim.experiments.study.store import Store
from skysim.results import metrics
from skysim.results.metrics import Columns, Summary

LONG = re.compile(r"(-?\d*\.\d{4,}(?:e[-+]?\d+)?)(\s\S.*)$")


class Line(NamedTuple):
    """One point: its number, factor levels, and the responses computed from its trials."""

    point: int
    levels: dict[str, Any]
    responses: dict[str, Summary]


def table(store: Store, responses: Sequence[str]) -> list[Line]:
    """One line for every point of a store; responses of points without trials are NaN."""
    asked = {name: metrics.response(name) for name in responses}
    return [line(number, point, store.of_point(number), asked) for number, point in enumerate(store.points())]


def asked(lines: Sequence[Line], responses: Sequence[str]) -> list[Line]:
    """The lines with only these responses."""
    return [one._replace(responses={name: one.responses[name] for name in responses}) for one in lines]


def line(number: int, point: Point, columns: Columns, asked: dict[str, metrics.Response]) -> Line:
    """The line of one point."""
    return Line(number, point.levels, {name: response(columns) for name, response in asked.items()})


def cells(lines: Sequence[Line]) -> tuple[list[str], list[list[str]]]:
    """Column heads and cell texts of a table, such as `0.97 (0.95..0.98)`."""
    if not lines:
        return [], []
    heads = ["point", *lines[0].levels, *lines[0].responses]
    told = [
        [str(one.point), *map(level, one.levels.values()), *map(figure, one.responses.values())]
        for one in lines
    ]
    return heads, told


def level(value: Any) -> str:
    """Text of a factor's level, numbers rounded to four digits."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str) and (told := LONG.match(value)):  # a sampled quantity with a unit
        return f"{float(told[1]):.4g}{told[2]}"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def figure(summary: Summary) -> str:
    """Text of a statistic with its interval, if it has one."""
    if np.isnan(summary.value):
        return "-"
    if np.isnan(summary.low) or summary.low == summary.high:
        return f"{summary.value:.3g}"
    return f"{summary.value:.3g} ({summary.low:.3g}..{summary.high:.3g})"


def flat(lines: Sequence[Line]) -> dict[str, list[Any]]:
    """The lines as columns: point, factors, and value, low, high and trial count of each response."""
    columns: dict[str, list[Any]] = {"point": [one.point for one in lines]}
    for name in lines[0].levels if lines else ():
        columns[name] = [one.levels[name] for one in lines]
    for name in lines[0].responses if lines else ():
        for part in Summary._fields:
            key = name if part == "value" else f"{name}_{part}"
            columns[key] = [getattr(one.responses[name], part) for one in lines]
    return columns


def everything(store: Store) -> dict[str, NDArray[Any]]:
    """All trials: the columns of the store, and a column for the levels of each factor."""
    columns, points = store.columns(), store.points()
    for name in points[0].levels if points else ():
        levels = [points[number].levels[name] for number in columns["point"]]
        columns[name] = np.array([level(one) if isinstance(one, list) else one for one in levels])
    return columns
