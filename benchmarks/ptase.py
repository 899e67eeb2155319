"""PTASE's Monte Carlo simulation (Fialho & Saotome 2005, table 1) and how long a thousand runs take.

`python -m benchmarks.ptase [RUNS] [SEED]` prints, for each version of their identifier, success, errors and time of
RUNS random attitudes: 20 x 20 degrees, 3 arcsec per axis, 0.25 mag, stars of the catalogue itself. The paper leaves its
limiting magnitude out; its errors are those of some 17 stars a field, which V < 5.1 gives, and V < 6 is the naked
eye's limit. One core; drawing the field, identification and attitude are all in the time.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from benchmarks.timing import verdict
from skysim.experiments.papers.ptase.monte_carlo import catalogue, runs_of, simulate, version

PAPER = (
    "mf1_2 in the paper: 99.12 +- .25 %, 4.79 (its Frobenius norm 6.77 / sqrt 2), 4.69 +- .14, .962 +- .013"
)
PAPER_S, BAR_S = 24.06, 0.3


def table_row(name: str, limit_mag: float, runs: int, seed: int) -> str:
    """One line: success, wrong answers, mean errors, and seconds for 1000 runs."""
    known, by = catalogue(limit_mag), version(name)
    simulate(known, by, 2, seed)
    begin = time.perf_counter()
    done = runs_of(known, by, runs, seed)
    spent_s = 1000 / runs * (time.perf_counter() - begin)
    means = " ".join(f"{values.mean():7.3f}" for values in done.right[1:])
    return f"{name:9s} V < {limit_mag:3.1f} {100 * done.answered / runs:8.2f} {done.wrong:6d} {means} {spent_s:10.3f}"


def measure() -> list[dict[str, Any]]:
    """1000 runs of the version that the paper timed, to V < 6: the best of five."""
    known, by = catalogue(6.0), version("fialho_2")
    simulate(known, by, 2, 1)
    spent_s = []
    for _ in range(5):
        begin = time.perf_counter()
        simulate(known, by, 1000, 1)
        spent_s.append(time.perf_counter() - begin)
    return [verdict("1000 PTASE runs, V < 6", min(spent_s), "s", f"paper: {PAPER_S} s at 450 MHz", BAR_S)]


if __name__ == "__main__":
    runs, seed = (int(one) for one in (sys.argv[1:] + ["10000", "1"][len(sys.argv) - 1 :]))
    print(f"{'':17s}  found %  wrong   angle    roll    axis  s per 1000 (arcsec, means)")
    for limit_mag in (5.1, 6.0):
        for name in ("fialho_1", "fialho_2", "fialho_3", "fialho_4"):
            print(table_row(name, limit_mag, runs, seed), flush=True)
    print(PAPER)
