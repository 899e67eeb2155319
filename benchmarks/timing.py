"""Rows of results: two sides timed in turn, a value beside its bar, a value alone.

A row is {name, value, unit, peer, peer_value, ratio, bar, met}; `met` is None without a bar.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def versus(
    name: str,
    ours: Callable[[], Any],
    peer_name: str,
    peer: Callable[[], Any] | None,
    bar: float | None = None,
    repeats: int = 30,
) -> dict[str, Any]:
    """One result: milliseconds of both sides, and the speed ratio (peer's time / our time).

    The minimum over the repeats counts, because other load on the machine only adds time.

    bar : minimum ratio to meet, or None. peer : None if it is not installed.
    """
    sides = [ours] + ([peer] if peer else [])
    for side in sides:
        side()
    spent: list[list[float]] = [[] for _ in sides]
    for _ in range(repeats):
        for side, times in zip(sides, spent, strict=True):
            side()  # refill the caches, which the other side has used
            begin = time.perf_counter()
            side()
            times.append(1e3 * (time.perf_counter() - begin))
    mine = min(spent[0])
    theirs = min(spent[1]) if peer else None
    ratio = theirs / mine if theirs else None
    met = None if bar is None or ratio is None else ratio >= bar
    label = peer_name if peer else f"{peer_name} (not installed)"
    return {
        "name": name,
        "value": mine,
        "unit": "ms",
        "peer": label,
        "peer_value": theirs,
        "ratio": ratio,
        "bar": bar,
        "met": met,
    }


def verdict(
    name: str, value: float, unit: str, what: str, bar: float, least: bool = False
) -> dict[str, Any]:
    """One result without a peer: a value and its maximum `bar`, or its minimum if `least`."""
    return {
        "name": name,
        "value": value,
        "unit": unit,
        "peer": what,
        "peer_value": None,
        "ratio": None,
        "bar": bar,
        "met": value >= bar if least else value <= bar,
    }


def figure(name: str, value: float, unit: str, what: str = "") -> dict[str, Any]:
    """One result without a bar; `what` says what it is of."""
    return verdict(name, float(value), unit, what, 0.0) | {"bar": None, "met": None}
