"""All experiments by id, and doing one."""

from __future__ import annotations

import time
from collections.abc import Callable

from skysim import BadInput
from skysim.papers import afit_surface
from skysim.papers.compare import Ask, Found, Reproduction, compare
from skysim.papers.published import experiments

Run = Callable[[Ask], Found]

EXPERIMENTS: dict[str, Run] = {
    "afit-table-1": afit_surface.flat,
}


def named(ids: list[str]) -> list[str]:
    """The ids that are asked for, `all` for every one. Raises BadInput."""
    if ids == ["all"]:
        return list(experiments())
    for id in ids:
        if id not in EXPERIMENTS:
            raise BadInput(f"{id}: no such experiment; allowed: all, or any of {', '.join(EXPERIMENTS)}")
    return list(dict.fromkeys(ids))


def reproduce(id: str, ask: Ask) -> Reproduction:
    """Do one experiment and compare."""
    begin = time.perf_counter()
    found = EXPERIMENTS[id](ask)
    return compare(id, experiments()[id], found, time.perf_counter() - begin)
