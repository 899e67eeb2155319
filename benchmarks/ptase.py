"""PTASE's Monte Carlo simulation (Fialho & Saotome 2005, table 1) and the time of a thousand runs.

`python -m benchmarks.ptase [RUNS] [SEED]` prints success, errors and time of RUNS random attitudes for each version of
their identifier: field of 20 x 20 degrees, noise of 3 arcsec per axis and 0.25 mag, true stars only. The paper does
not state its limiting magnitude. Its errors correspond to about 17 stars per field, which V < 5.1 gives; V < 6 is the
naked-eye limit. One core; the time includes simulation of the field, identification and attitude.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from benchmarks.timing import verdict
from skysim.experiments.papers.ptase_monte_carlo import catalog, run_version, simulate, version

PAPER = "mf1_2 in the paper: 99.12 +- .25 %, 4.79 (its Frobenius norm 6.77 / sqrt 2), 4.69 +- .14, .962 +- .013"
PAPER_S = 24.06
BAR_S = 0.3


def table_row(name: str, limit_mag: float, runs: int, seed: int) -> str:
    """One table line: success, wrong attitudes, mean errors, and seconds per 1000 runs."""
    known = catalog(limit_mag)
    by = version(name)
    simulate(known, by, 2, seed)
    begin = time.perf_counter()
    done = run_version(known, by, runs, seed)
    spent_s = 1000 / runs * (time.perf_counter() - begin)
    means = " ".join(f"{values.mean():7.3f}" for values in done.right[1:])
    return f"{name:9s} V < {limit_mag:3.1f} {100 * done.solved / runs:8.2f} {done.wrong:6d} {means} {spent_s:10.3f}"


def measure() -> list[dict[str, Any]]:
    """Time of 1000 runs of the version that the paper timed, with V < 6: the minimum of five."""
    known = catalog(6.0)
    by = version("fialho_2")
    simulate(known, by, 2, 1)
    spent_s = []
    for _ in range(5):
        begin = time.perf_counter()
        simulate(known, by, 1000, 1)
        spent_s.append(time.perf_counter() - begin)
    return [
        verdict(
            "1000 PTASE runs, V < 6", min(spent_s), "s", f"paper: {PAPER_S} s at 450 MHz", BAR_S
        )
    ]


if __name__ == "__main__":
    runs, seed = (int(one) for one in (sys.argv[1:] + ["10000", "1"][len(sys.argv) - 1 :]))
    print(f"{'':17s}  found %  wrong   angle    roll    axis  s per 1000 (arcsec, means)")
    for limit_mag in (5.1, 6.0):
        for name in ("fialho_1", "fialho_2", "fialho_3", "fialho_4"):
            print(table_row(name, limit_mag, runs, seed), flush=True)
    print(PAPER)
