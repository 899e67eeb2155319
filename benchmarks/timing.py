"""Fair clocks: both sides warmed up, then alternately timed, the median of each."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np


def versus(
    name: str,
    ours: Callable[[], Any],
    peer_name: str,
    peer: Callable[[], Any] | None,
    bar: float | None = None,
    repeats: int = 15,
) -> dict[str, Any]:
    """One result: median milliseconds of either side, and how many times faster than the peer we are.

    bar : the least ratio wanted; None where there is none. peer : None where it is not installed.
    """
    sides = [ours] + ([peer] if peer else [])
    for side in sides:
        side()
    spent: list[list[float]] = [[] for _ in sides]
    for _ in range(repeats):
        for side, times in zip(sides, spent, strict=True):
            begin = time.perf_counter()
            side()
            times.append(1e3 * (time.perf_counter() - begin))
    mine = float(np.median(spent[0]))
    theirs = float(np.median(spent[1])) if peer else None
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
