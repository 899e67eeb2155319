"""All experiments by id, and the function that runs one."""

from __future__ import annotations

import time
from collections.abc import Callable

from skysim.core.errors import InputError
from skysim.experiments.papers import (
    shefex_camera,
    shefex_identification,
    shefex_nights,
    shefex_setup,
)
from skysim.experiments.papers.afit import (
    afit_surface,
    led_tests,
    test1,
    test2,
    test3,
    test3_attitude,
)
from skysim.experiments.papers.compare import (
    ExperimentOptions,
    ExperimentResult,
    Reproduction,
    compare,
)
from skysim.experiments.papers.published import experiments

ExperimentFunction = Callable[[ExperimentOptions], ExperimentResult]

EXPERIMENTS: dict[str, ExperimentFunction] = {
    "afit-table-1": afit_surface.table_1,
    "afit-figs-30-46": led_tests.led_tests,
    "afit-table-2": test1.table_2,
    "afit-table-3-5": test2.tables_3_to_5,
    "afit-table-6-9": test3.tables_6_to_9,
    "afit-table-10-15": test3_attitude.tables_10_to_15,
    "afit-bump": test3_attitude.bump,
    "shefex-fig-2": shefex_camera.exposure_control,
    "shefex-fig-3": shefex_camera.scan_times,
    "shefex-figs-4-5": shefex_setup.catalog_statistics,
    "shefex-figs-7-10": shefex_identification.figs_7_to_10,
    "shefex-nights": shefex_nights.night_results,
}


def check_ids(ids: list[str]) -> list[str]:
    """The requested ids without repeats; `all` for every experiment. Raises InputError for an unknown id."""
    if ids == ["all"]:
        return list(experiments())
    for id in ids:
        if id not in EXPERIMENTS:
            raise InputError("", f"unknown experiment '{id}'", f"all, {', '.join(EXPERIMENTS)}")
    return list(dict.fromkeys(ids))


def reproduce(id: str, options: ExperimentOptions) -> Reproduction:
    """Run one experiment and compare it with the published numbers."""
    begin = time.perf_counter()
    result = EXPERIMENTS[id](options)
    return compare(id, experiments()[id], result, time.perf_counter() - begin)
