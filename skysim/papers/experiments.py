"""All experiments by id, and doing one."""

from __future__ import annotations

import time
from collections.abc import Callable

from skysim import BadInput
from skysim.papers import (
    afit_attitude,
    afit_bump,
    afit_leds,
    afit_surface,
    afit_test1,
    afit_test2,
    afit_test3,
    apl,
    nps,
    oled,
    ptase,
    ptase_sky,
    ptase_ui,
    shefex_camera,
    shefex_catalogue,
    shefex_id,
    shefex_nights,
)
from skysim.papers.compare import Ask, Found, Reproduction, compare
from skysim.papers.published import experiments

Run = Callable[[Ask], Found]

EXPERIMENTS: dict[str, Run] = {
    "afit-table-1": afit_surface.flat,
    "afit-figs-30-46": afit_leds.leds,
    "afit-table-2": afit_test1.nine,
    "afit-table-3-5": afit_test2.dome,
    "afit-table-6-9": afit_test3.calibration,
    "afit-table-10-15": afit_attitude.attitudes,
    "afit-bump": afit_bump.bump,
    "nps": nps.trials,
    "apl": apl.fibres,
    "oled": oled.dome,
    "ptase-table-1": ptase.table_1,
    "ptase-table-2": ptase_sky.ground,
    "ptase-ui": ptase_ui.functions,
    "shefex-fig-2": shefex_camera.control,
    "shefex-fig-3": shefex_camera.scans,
    "shefex-figs-4-5": shefex_catalogue.catalogues,
    "shefex-figs-7-10": shefex_id.figures,
    "shefex-nights": shefex_nights.nights,
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
