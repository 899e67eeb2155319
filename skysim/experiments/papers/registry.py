"""All experiments by id, and the function that runs one."""

from __future__ import annotations

import time
from collections.abc import Callable

from skysim.core.errors import InputError
from skysim.experiments.papers.afit import attitude, bump, leds, surface, test1, test2, test3
from skysim.experiments.papers.compare import Ask, Found, Reproduction, compare
from skysim.experiments.papers.other_domes import apl, nps, oled
from skysim.experiments.papers.ptase import ground, monte_carlo
from skysim.experiments.papers.published import experiments
from skysim.experiments.papers.shefex import camera, catalog, identification, nights

Run = Callable[[Ask], Found]

EXPERIMENTS: dict[str, Run] = {
    "afit-table-1": surface.flat,
    "afit-figs-30-46": leds.leds,
    "afit-table-2": test1.nine,
    "afit-table-3-5": test2.dome,
    "afit-table-6-9": test3.calibration,
    "afit-table-10-15": attitude.attitudes,
    "afit-bump": bump.bump,
    "nps": nps.trials,
    "apl": apl.fibres,
    "oled": oled.dome,
    "ptase-table-1": monte_carlo.table_1,
    "ptase-table-2": ground.ground,
    "shefex-fig-2": camera.control,
    "shefex-fig-3": camera.scans,
    "shefex-figs-4-5": catalog.catalogues,
    "shefex-figs-7-10": identification.figures,
    "shefex-nights": nights.nights,
}


def named(ids: list[str]) -> list[str]:
    """The requested ids without repeats; `all` for every experiment. Raises InputError for an unknown id."""
    if ids == ["all"]:
        return list(experiments())
    for id in ids:
        if id not in EXPERIMENTS:
            raise InputError(f"{id}: no such experiment; allowed: all, or any of {', '.join(EXPERIMENTS)}")
    return list(dict.fromkeys(ids))


def reproduce(id: str, ask: Ask) -> Reproduction:
    """Run one experiment and compare it with the published numbers."""
    begin = time.perf_counter()
    found = EXPERIMENTS[id](ask)
    return compare(id, experiments()[id], found, time.perf_counter() - begin)
