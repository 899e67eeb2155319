"""Benchmarks of skysim and the estimator against the best peer, timed in the same run.

`python -m benchmarks` prints what `measure` returns.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from benchmarks import attitude, detect, dynamics, identify, instrument, nees, photographs, rate, rolling, start


def _later(module: str) -> Callable[[], list[dict[str, Any]]]:
    """`measure` of a module that is also a program of its own, and is therefore imported when it is used."""
    return lambda: importlib.import_module(f"benchmarks.{module}").measure()


AREAS: dict[str, Callable[[], list[dict[str, Any]]]] = {
    "instrument": instrument.measure,
    "detect": detect.measure,
    "identify": identify.measure,
    "attitude": attitude.measure,
    "dynamics": dynamics.measure,
    "start": start.measure,
    "rolling": rolling.measure,
    "rate": rate.measure,
    "nees": nees.measure,
    "photographs": photographs.measure,
    "lost_in_space": _later("lost_in_space"),
    "frames": _later("frames"),
}


def measure(area: str) -> list[dict[str, Any]]:
    """The results of one area: {name, value, unit, peer, peer_value, ratio, bar, met}."""
    return AREAS[area]()
