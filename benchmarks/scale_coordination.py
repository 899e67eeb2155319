"""How many chunks a second the study's own process can hand out, collect and store: 64 workers on one machine.

A worker is a thread whose trials do nothing but last a known time, so one machine
can have as many as a cluster. One chunk is one trial. The shorter the trials, the more chunks complete in a second,
until the process that coordinates them is the limit: chunk queue, engine, and the store's transaction.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.timing import verdict
from skysim.experiments.study import study_file
from skysim.experiments.study.execution import engines, runner, store
from skysim.experiments.study.execution.engines import Chunk, Chunks, Engine, Job
from skysim.experiments.study.execution.outcomes import FIELDS, Outcome
from skysim.experiments.study.execution.trials import Row, Segment

WORKERS = 64
SOLVED = Outcome(
    "solved",
    1,
    1,
    **{name: 1 / (3 + n) for n, name in enumerate(FIELDS[4:]) if name != "ambiguous"},
)
LENGTHS_S = (1.0, 0.3, 0.1, 0.03, 0.01)
RUN_S = 4.0  # of one measurement, at least
STUDY = """
schema: 1
title: coordination
scene: shefex2
seed: 1
trial: {{kind: centroids, noise_px: 0.1}}
factors: {{strays: {{key: trial.false_lights, values: [0]}}}}
replicates: {trials}
responses: [identified]
"""


@dataclass(frozen=True)
class TimedJob:
    """A job whose chunks last a known time."""

    seconds: float

    def run(self, chunk: Chunk) -> list[Row]:
        """Wait, and return rows as large as real ones."""
        time.sleep(self.seconds)
        return [
            row_of(segment, n) for segment in chunk for n in range(len(segment.replicates))
        ]

    def failed(self, segment: Segment, error: str) -> Row:
        """The row of a trial that failed."""
        return row_of(segment, 0)._replace(error=error)


def row_of(segment: Segment, n: int) -> Row:
    """The row of a solved trial, with a number in every column."""
    number = segment.first + n
    return Row(
        number,
        segment.point,
        segment.replicates[n],
        2**62 - number,
        "0" * 16,
        "0" * 16,
        SOLVED,
        None,
        0.0,
    )


class ThreadPool(engines.Pool):
    """The pool of studies with threads in the place of processes."""

    def _pool_for(self, job: Job) -> Any:
        engines.JOB[:] = [job]
        self._pool = self._pool or ThreadPoolExecutor(self.workers)  # type: ignore[assignment]
        return self._pool


class SingleTrials:
    """Chunks of one trial each, however short it is. begin_s : when the first was asked for"""

    def __init__(self, chunks: Chunks) -> None:
        self.chunks = chunks
        self.begin_s = 0.0

    def next(self) -> Chunk:
        """See `engines.Chunks`."""
        self.begin_s = self.begin_s or time.perf_counter()
        return self.chunks.next()

    def report_time(self, chunk: Chunk, seconds: float) -> None:
        """The size stays one."""


class Coordinated:
    """An engine that runs a TimedJob in the place of trials, and takes the time from the first to the last."""

    def __init__(self, engine: Engine, seconds: float) -> None:
        self.engine = engine
        self.job = TimedJob(seconds)
        self.name = engine.name
        self.workers = engine.workers
        self.seconds = 0.0
        self.cpu_s = 0.0

    def run(self, job: Job, chunks: Chunks) -> Iterator[list[Row]]:
        """See `engines.Engine`."""
        single = SingleTrials(chunks)
        begin_cpu_s = time.process_time()
        yield from self.engine.run(self.job, single)
        self.seconds = time.perf_counter() - single.begin_s
        self.cpu_s = time.process_time() - begin_cpu_s

    def close(self) -> None:
        """See `engines.Engine`."""
        self.engine.close()


class Pace(NamedTuple):
    """Chunks stored in a second, and the CPU time of one in this process, which holds Dask's scheduler too."""

    hertz: float
    cpu_ms: float


def pace(engine: Engine, workers: int, seconds: float, rounds: int = 4) -> Pace:
    """The pace of chunks that last so many seconds; every worker has so many of them, or RUN_S."""
    trials = int(max(RUN_S / seconds, rounds) * workers)
    timed = Coordinated(engine, seconds)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.yaml"
        path.write_text(STUDY.format(trials=trials))
        study = study_file.load(path)
        with store.writing(path.with_suffix(".sqlite")) as database:
            runner.prepare_store(study, database, False)
            progress = runner.run(study, database, timed)
            stored = database.counts()["done"]
    if not progress.done == stored == trials:
        raise RuntimeError(f"{stored} of {trials} trials are stored")
    return Pace(trials / timed.seconds, 1e3 * timed.cpu_s / trials)


def storing(rows: int = 20_000, block: int = 1000) -> list[dict[str, Any]]:
    """Rows that the store takes in a second, and what they occupy on the disk."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.sqlite"
        with store.writing(path) as database:
            segments = [
                Segment(0, {}, first, range(first, first + block))
                for first in range(0, rows, block)
            ]
            blocks = [TimedJob(0.0).run((segment,)) for segment in segments]
            begin = time.process_time()
            for one in blocks:
                database.add(one)
            hertz = rows / (time.process_time() - begin)
        size = path.stat().st_size / rows
    return [
        verdict(
            f"rows stored in a second, {block} at a time", hertz, "/s", "of CPU", 5000.0, True
        ),
        verdict("bytes of a row in the store", size, "B", "solved", 500.0),
    ]


@contextmanager
def threads() -> Iterator[Engine]:
    """The pool of this machine, with threads."""
    pool = ThreadPool(WORKERS)
    yield pool
    pool.close()


@contextmanager
def dask(workers: int = WORKERS) -> Iterator[Engine]:
    """A Dask cluster: threads of two processes as workers; scheduler and client are here."""
    from distributed import LocalCluster

    from skysim.experiments.study.execution.dask_engine import Dask

    options = {"n_workers": 2, "threads_per_worker": workers // 2, "dashboard_address": None}
    with LocalCluster(**options) as cluster:
        engine = Dask(cluster.scheduler_address)
        yield engine
        engine.close()


ENGINES: dict[str, Callable[[], Any]] = {"pool": threads, "dask": dask}


def curve(name: str) -> list[tuple[float, Pace]]:
    """The pace by the length of a chunk in seconds, until coordination halves what the workers could do."""
    found: list[tuple[float, Pace]] = []
    with ENGINES[name]() as engine:
        for seconds in LENGTHS_S:
            found.append((seconds, pace(engine, WORKERS, seconds)))
            if found[-1][1].hertz < 0.5 * WORKERS / seconds:
                break
    return found


def measure() -> list[dict[str, Any]]:
    """Rows stored in a second, and the highest rate of chunks of each engine with all rates of its curve."""
    rows = storing()
    for name in ENGINES:
        found = curve(name)
        told = ", ".join(
            f"{one.hertz:.0f}/s of {WORKERS / seconds:.0f}/s" for seconds, one in found
        )
        hertz = max(one.hertz for _, one in found)
        cpu_ms = min(one.cpu_ms for _, one in found)
        rows.append(
            verdict(
                f"{name}: chunks a second, {WORKERS} workers", hertz, "/s", told, 2000.0, True
            )
        )
        rows.append(verdict(f"{name}: CPU of coordination", cpu_ms, "ms", "a chunk", 0.5))
    return rows
