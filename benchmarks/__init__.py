"""Benchmarks of skysim and the estimator against the best peer, timed in the same run.

`python -m benchmarks` prints what `measure` returns. Each area is a module with a function of that name, which is
imported when it is used, as some are programs of their own.
"""

from __future__ import annotations

import importlib
from typing import Any

AREAS = (
    "instrument",
    "detect",
    "identify",
    "attitude",
    "dynamics",
    "start",
    "rolling",
    "rate",
    "nees",
    "photographs",
    "lost_in_space",
    "frames",
    "sky",
    "codes",
    "scale",
    "lab",
)


def measure(area: str) -> list[dict[str, Any]]:
    """The results of one area: {name, value, unit, peer, peer_value, ratio, bar, met}."""
    rows: list[dict[str, Any]] = importlib.import_module(f"benchmarks.{area}").measure()
    return rows
