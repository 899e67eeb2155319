"""What came of a study: a line a point with every response and its interval; and all trials for other tools."""

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
    """One point: its number, the factors' levels there, and what was asked of its trials."""

    point: int
    levels: dict[str, Any]
    responses: dict[str, Summary]


def table(store: Store, responses: Sequence[str]) -> list[Line]:
    """Every point of a store, those without a trial yet too: their figures are NaN."""
    asked = {name: metrics.response(name) for name in responses}
    return [line(number, point, store.of_point(number), asked) for number, point in enumerate(store.points())]


def asked(lines: Sequence[Line], responses: Sequence[str]) -> list[Line]:
    """The lines with these of their responses alone."""
    return [one._replace(responses={name: one.responses[name] for name in responses}) for one in lines]


def line(number: int, point: Point, columns: Columns, asked: dict[str, metrics.Response]) -> Line:
    """One point's line."""
    return Line(number, point.levels, {name: response(columns) for name, response in asked.items()})


def cells(lines: Sequence[Line]) -> tuple[list[str], list[list[str]]]:
    """Heads and lines of a table for people: `0.97 (0.95..0.98)`."""
    if not lines:
        return [], []
    heads = ["point", *lines[0].levels, *lines[0].responses]
    told = [
        [str(one.point), *map(level, one.levels.values()), *map(figure, one.responses.values())]
        for one in lines
    ]
    return heads, told


def level(value: Any) -> str:
    """A factor's level in a table."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str) and (told := LONG.match(value)):  # a quantity that was drawn
        return f"{float(told[1]):.4g}{told[2]}"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def figure(summary: Summary) -> str:
    """A figure with its interval where it has one."""
    if np.isnan(summary.value):
        return "-"
    if np.isnan(summary.low) or summary.low == summary.high:
        return f"{summary.value:.3g}"
    return f"{summary.value:.3g} ({summary.low:.3g}..{summary.high:.3g})"


def flat(lines: Sequence[Line]) -> dict[str, list[Any]]:
    """The lines as columns: point, factors, and of each response its value, low, high and count."""
    columns: dict[str, list[Any]] = {"point": [one.point for one in lines]}
    for name in lines[0].levels if lines else ():
        columns[name] = [one.levels[name] for one in lines]
    for name in lines[0].responses if lines else ():
        for part in Summary._fields:
            key = name if part == "value" else f"{name}_{part}"
            columns[key] = [getattr(one.responses[name], part) for one in lines]
    return columns


def everything(store: Store) -> dict[str, NDArray[Any]]:
    """All trials: the columns of the store, and each factor's level beside them."""
    columns, points = store.columns(), store.points()
    for name in points[0].levels if points else ():
        levels = [points[number].levels[name] for number in columns["point"]]
        columns[name] = np.array([level(one) if isinstance(one, list) else one for one in levels])
    return columns
