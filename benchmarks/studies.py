"""Studies on two cores: trials per second including the store, speedup by a second worker, overhead per trial.

`python -m benchmarks.studies` (OPENBLAS_NUM_THREADS=1, on an idle machine). There is no peer; each result is compared
with a fixed target (bar).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import verdict
from skysim.experiments.study import study_file
from skysim.experiments.study.execution import engines, runner, store
from skysim.experiments.study.execution.engines import Chunks, Job, Pool
from skysim.experiments.study.execution.trials import Row

STUDY = """
schema: 1
title: how fast studies are
scene: shefex2
seed: 1
trial: {trial}
factors: {{{factor}}}
replicates: {replicates}
responses: [identified]
"""
CENTROIDS = {
    "trial": "{kind: centroids, noise_px: 0.1, lights: 15}",
    "factor": "strays: {key: trial.false_lights, values: [0, 5]}",
    "replicates": 5000,
}
FRAMES = {
    "trial": "{kind: frames}",
    "factor": "rate: {key: trial.rate_deg_s, values: [0, 0.1]}",
    "replicates": 500,
}
WARM_UP = 0.2  # fraction of the trials after which every worker has its scene and full chunks


class TimedPool:
    """A pool that records each batch. batches : (arrival time, number of trials, seconds spent in trials) by batch."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self.name = pool.name
        self.workers = pool.workers
        self.batches: list[tuple[float, int, float]] = []

    def run(self, job: Job, chunks: Chunks) -> Iterator[list[Row]]:
        """See `engines.Engine`."""
        for rows in self.pool.run(job, chunks):
            self.batches.append((time.perf_counter(), len(rows), sum(row.seconds for row in rows)))
            yield rows


@dataclass(frozen=True)
class StudyTime:
    """Time of a study.

    total_s     : from loading the file to closing the store, including start and end of the processes
    rate        : trials per second after the first SETTLED of them
    overhead_ms : worker time per trial that was not spent in the trial itself
    """

    total_s: float
    rate: float
    overhead_ms: float


def run_study(settings: dict[str, Any], workers: int) -> StudyTime:
    """Run a study with a pool in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.yaml"
        path.write_text(STUDY.format(**settings))
        pool = TimedPool(engines.Pool(workers))
        begin = time.perf_counter()
        study = study_file.load(path)
        with store.writing(path.with_suffix(".sqlite")) as database:
            runner.prepare_store(study, database, False)
            progress = runner.run(study, database, pool)
        total_s = time.perf_counter() - begin
    if (progress.done, progress.failed) != (study.trials, 0):
        raise RuntimeError(
            f"{progress.done} of {study.trials} trials are in, {progress.failed} of them failed"
        )
    when_s, count, worked_s = np.array(pool.batches).T
    late = np.cumsum(count) > WARM_UP * study.trials
    first = int(np.argmax(late))  # the timed window starts at its end
    window_s = when_s[-1] - when_s[first]
    trials = count[first + 1 :].sum()
    beside_s = workers * window_s - worked_s[first + 1 :].sum()
    return StudyTime(total_s, trials / window_s, 1e3 * beside_s / trials)


def measure() -> list[dict[str, Any]]:
    """Results of the studies benchmark; the first pool is started cold, as for a user."""
    points = run_study(CENTROIDS, 2)
    frames = run_study(FRAMES, 2)
    alone = {"centroids": run_study(CENTROIDS, 1), "frames": run_study(FRAMES, 1)}
    both = {"centroids": points, "frames": frames}
    ratios = [
        verdict(
            f"{name}: two workers over one",
            both[name].rate / one.rate,
            "x",
            f"{one.rate:.0f}/s of one",
            1.8,
            True,
        )
        for name, one in alone.items()
    ]
    return [
        verdict(
            "10,000 centroid trials with the store",
            points.total_s,
            "s",
            f"then {points.rate:.0f}/s",
            5.0,
        ),
        verdict(
            "1,000 EC655 frame trials with the store",
            frames.total_s,
            "s",
            f"then {frames.rate:.0f}/s",
            20.0,
        ),
        *ratios,
        verdict(
            "overhead a trial of a pool of two", points.overhead_ms, "ms", "centroid trials", 1.0
        ),
    ]


if __name__ == "__main__":
    for one in measure():
        outcome = "met" if one["met"] else "MISSED"
        print(
            f"{one['name']:40s} {one['value']:8.3g} {one['unit']:3s} bar {one['bar']:4.3g} {outcome:7s} {one['peer']}"
        )
