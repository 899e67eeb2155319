"""Execution engines: this process (Serial) or a pool of processes (Pool); `dask_engine` adds a Dask cluster.

All engines produce identical rows.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Protocol

from skysim.core.errors import InputError
from skysim.experiments.study.execution import workers
from skysim.experiments.study.plan import TrialSpec
from skysim.experiments.study.setups import code_version, seed_of
from skysim.experiments.study.trials import FAILED, Row, Segment, work

AHEAD = 1  # chunks queued for each worker in addition to the one it runs

TRIES = 3  # attempts of a trial whose worker dies

Chunk = tuple[Segment, ...]


class Chunks(Protocol):
    """Source of work: `next` returns the next chunk (empty at the end); `took` reports run times, to size chunks."""

    def next(self) -> Chunk: ...
    def took(self, chunk: Chunk, seconds: float) -> None: ...


class Engine(Protocol):
    """Runs chunks of trials. Chunks complete in any order; the rows of a chunk come together."""

    name: str
    workers: int

    def run(self, recipe: TrialSpec, chunks: Chunks) -> Iterator[list[Row]]: ...

    def close(self) -> None:
        """Release the resources kept between runs."""


class Serial:
    """Runs one trial after another in this process."""

    name, workers = "serial", 1

    def run(self, recipe: TrialSpec, chunks: Chunks) -> Iterator[list[Row]]:
        """See `Engine`."""
        while chunk := chunks.next():
            rows, seconds = timed(recipe, chunk)
            chunks.took(chunk, seconds)
            yield rows

    def close(self) -> None:
        """See `Engine`."""


class Pool:
    """Pool of processes on this machine. Each caches the scenes and indices it has built, also between runs.

    If a worker dies, the pool is restarted and the trials in flight are retried one at a time, because it is not known
    which of them killed it. A trial that is alone in flight when its worker dies, TRIES times, is recorded as failed.
    """

    name = "pool"

    def __init__(self, count: int | None = None) -> None:
        self.workers = count or cores()
        self._pool: ProcessPoolExecutor | None = None
        self._recipe: TrialSpec | None = None

    def run(self, recipe: TrialSpec, chunks: Chunks) -> Iterator[list[Row]]:
        """See `Engine`."""
        suspects: deque[Chunk] = deque()
        deaths: Counter[int] = Counter()  # by trial
        done = False
        while not done:
            flying: dict[Future[tuple[list[Row], float]], Chunk] = {}
            try:
                yield from self._until_one_dies(self._ready(recipe), chunks, suspects, flying)
                done = True
            except BrokenProcessPool:
                # Count a death only for a trial that was alone in flight; otherwise the culprit is unknown.
                at_hand = [one for chunk in flying.values() for one in split_chunk(chunk)]
                deaths.update(one[0].first for one in at_hand if len(at_hand) == 1)
                for one in at_hand:
                    if deaths[one[0].first] == TRIES:
                        yield [failed_row(recipe, one[0])]
                    else:
                        suspects.append(one)
            finally:
                if not done:
                    self._kill()

    def close(self) -> None:
        """See `Engine`."""
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None

    def _ready(self, recipe: TrialSpec) -> ProcessPoolExecutor:
        """The pool of the previous run if it was started with this recipe, otherwise a new one."""
        if recipe != self._recipe:
            self.close()
        if self._pool is None:
            self._pool, self._recipe = started(self.workers, recipe), recipe
        return self._pool

    def _kill(self) -> None:
        """Kill the pool at once; trials that are not in the store are run again."""
        if self._pool is not None:
            for process in list((self._pool._processes or {}).values()):
                process.kill()
            self._pool.shutdown(cancel_futures=True)
        self._pool = None

    def _until_one_dies(
        self,
        pool: ProcessPoolExecutor,
        chunks: Chunks,
        suspects: deque[Chunk],
        flying: dict[Future[tuple[list[Row], float]], Chunk],
    ) -> Iterator[list[Row]]:
        """Yield rows as chunks complete; suspects first, each alone in flight. `flying` maps futures to their chunks.

        Raises BrokenProcessPool if a worker dies; `flying` then holds the chunks that were lost.
        """
        while True:
            # A suspect runs with nothing else in flight, so that a worker's death can be attributed to it.
            room = self.workers * (1 + AHEAD) if not suspects else 1
            while len(flying) < room and (chunk := suspects.popleft() if suspects else chunks.next()):
                try:
                    flying[pool.submit(run_chunk, chunk)] = chunk
                except BrokenProcessPool:  # a worker died while the caller stored rows
                    suspects.appendleft(chunk)
                    raise
                room = room if not suspects else 1
            if not flying:
                return
            for future in wait(flying, return_when=FIRST_COMPLETED).done:
                rows, seconds = future.result()
                chunks.took(flying.pop(future), seconds)
                yield rows


def timed(recipe: TrialSpec, chunk: Chunk) -> tuple[list[Row], float]:
    """Rows of a chunk and the seconds it took on the worker."""
    begin_s = time.perf_counter()
    return work(recipe, chunk), time.perf_counter() - begin_s


def split_chunk(chunk: Chunk) -> Iterator[Chunk]:
    """Split a chunk into chunks of one trial each."""
    for segment in chunk:
        for n, replicate in enumerate(segment.replicates):
            alone = range(replicate, replicate + 1)
            yield (segment._replace(first=segment.first + n, replicates=alone),)


def failed_row(recipe: TrialSpec, segment: Segment) -> Row:
    """The row of a trial that repeatedly killed its worker."""
    replicate = segment.replicates[0]
    seed, why = seed_of(recipe, segment.point, replicate), f"its worker process died, {TRIES} times"
    return Row(segment.first, segment.point, replicate, seed, "", code_version(), FAILED, why, 0.0)


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# Worker processes.

RECIPE: list[TrialSpec] = []  # the recipe of this worker process


def started(count: int, recipe: TrialSpec) -> ProcessPoolExecutor:
    """Start a pool of single-threaded processes that have imported everything a trial needs. Raises InputError."""
    pool = ProcessPoolExecutor(count, workers.warm(), begin, (recipe,))
    try:
        for one in [pool.submit(code_version) for _ in range(count)]:
            one.result()
    except BrokenProcessPool:
        raise InputError(
            f"--workers: {count} processes cannot start; allowed: fewer, or --engine serial"
        ) from None
    return pool


def begin(recipe: TrialSpec) -> None:
    """Initialize a worker: ignore Ctrl-C, which the parent handles, and exit when the parent ends, even by kill -9."""
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    RECIPE[:] = [recipe]
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """Wait until the parent process ends, then exit."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def run_chunk(chunk: Chunk) -> tuple[list[Row], float]:
    """`timed` with the recipe with which this worker was started."""
    return timed(RECIPE[0], chunk)
