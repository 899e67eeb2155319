"""Execution engines: this process (Serial) or a pool of processes (Pool); `dask_engine` adds a Dask cluster.

All engines produce identical rows. What they run is a `Job`: trials of a study (`trials.TrialJob`), or other work
that is divided into numbered items.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

from skysim.core.errors import InputError
from skysim.experiments.study.execution import workers
from skysim.experiments.study.execution.trials import Segment, code_version, divided

AHEAD = 1  # chunks queued for each worker in addition to the one it runs
MAX_ATTEMPTS = 3  # attempts of a trial whose worker dies
# Raised by the start of a worker: it died, or before it the fork server.
BROKEN = (BrokenProcessPool, EOFError, OSError)
DIED = f"its worker process died, {MAX_ATTEMPTS} times"

Chunk = tuple[Segment, ...]
Batches = Iterator[list[Any]]  # rows, as chunks complete
TimedRows = tuple[list[Any], float]  # rows of a chunk, and the seconds it took


class Job(Protocol):
    """Work on the items of a chunk: a frozen value that is sent to the workers."""

    def run(self, chunk: Chunk) -> list[Any]:
        """The rows of a chunk, one per item."""

    def failed(self, segment: Segment, error: str) -> Any:
        """The row of an item, alone in its segment, that repeatedly killed its worker."""


class Chunks(Protocol):
    """Source of work: `next` returns the next chunk (empty at the end); `report_time` takes run times, to size it."""

    def next(self) -> Chunk: ...
    def report_time(self, chunk: Chunk, seconds: float) -> None: ...


class Engine(Protocol):
    """Runs chunks of trials. Chunks complete in any order; the rows of a chunk come together."""

    name: str
    workers: int

    def run(self, job: Job, chunks: Chunks) -> Batches: ...

    def close(self) -> None:
        """Release the resources kept between runs."""


class Serial:
    """Runs one trial after another in this process."""

    name = "serial"
    workers = 1

    def run(self, job: Job, chunks: Chunks) -> Batches:
        while chunk := chunks.next():
            rows, seconds = run_timed(job, chunk)
            chunks.report_time(chunk, seconds)
            yield rows

    def close(self) -> None:
        """Nothing is kept between runs."""


class Pool:
    """Pool of processes on this machine. Each caches the scenes and indices it has built, also between runs.

    If a worker dies, the pool is restarted and the trials in flight are retried one at a time, because it is not known
    which of them killed it. A trial that is alone in flight when its worker dies, MAX_ATTEMPTS times, is recorded
    as failed.
    """

    name = "pool"

    def __init__(self, count: int | None = None) -> None:
        self.workers = count or cores()
        self._pool: ProcessPoolExecutor | None = None
        self._job: Job | None = None

    def run(self, job: Job, chunks: Chunks) -> Batches:
        """Yield rows as chunks complete; retries first, each alone in flight.

        Rows of chunks that are complete at the same time come together, so that the store takes one transaction for
        them: the more workers wait for it, the fewer transactions.
        """
        retries: deque[Chunk] = deque()
        deaths: Counter[int] = Counter()  # by trial
        in_flight: dict[Future[TimedRows], Chunk] = {}
        try:
            while True:
                rows = list[Any]()
                try:
                    pool = self._pool_for(job)
                    # A retried trial is alone in flight, so that a worker's death can be attributed to it.
                    capacity = self.workers * (1 + AHEAD) if not retries else 1
                    while len(in_flight) < capacity and (
                        chunk := retries.popleft() if retries else chunks.next()
                    ):
                        try:
                            in_flight[pool.submit(run_chunk, chunk)] = chunk
                        except BROKEN:
                            # A worker died while the caller stored rows.
                            retries.appendleft(chunk)
                            raise BrokenProcessPool from None
                    if not in_flight:
                        return
                    finished = wait(in_flight, return_when=FIRST_COMPLETED).done
                    for future in [one for one in finished if one.exception() is None]:
                        more, seconds = future.result()
                        chunks.report_time(in_flight.pop(future), seconds)
                        rows += more
                    for future in finished:
                        future.result()  # raises if its worker died
                except BrokenProcessPool:
                    self._kill()
                    # Count a death only for a trial that was alone in flight; otherwise the culprit is unknown.
                    lost = [one for chunk in in_flight.values() for one in split_chunk(chunk)]
                    in_flight.clear()
                    deaths.update(single[0].first for single in lost if len(lost) == 1)
                    for single in lost:
                        if deaths[single[0].first] == MAX_ATTEMPTS:
                            rows.append(job.failed(single[0], DIED))
                        else:
                            retries.append(single)
                if rows:
                    yield rows
        except BaseException:  # the caller stops, or an error of the job
            self._kill()
            raise

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None

    def _pool_for(self, job: Job) -> ProcessPoolExecutor:
        """The pool of the previous run if it was started with this job, otherwise a new one."""
        if job != self._job:
            self.close()
        if self._pool is None:
            self._pool = start_pool(self.workers, job)
            self._job = job
        return self._pool

    def _kill(self) -> None:
        """Kill the pool at once; trials that are not in the store are run again."""
        if self._pool is not None:
            for process in list((self._pool._processes or {}).values()):
                process.kill()
            self._pool.shutdown(cancel_futures=True)
        self._pool = None


def run_timed(job: Job, chunk: Chunk) -> TimedRows:
    """Rows of a chunk and the seconds it took on the worker."""
    start_s = time.perf_counter()
    return job.run(chunk), time.perf_counter() - start_s


def split_chunk(chunk: Chunk) -> Iterator[Chunk]:
    """Split a chunk into chunks of one trial each."""
    for segment in chunk:
        yield from ((single,) for single in divided(segment, 1))


def cores() -> int:
    """Number of cores that this process may use."""
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1
    )


# Worker processes.

JOB: list[Job] = []  # the job of this worker process


def start_pool(count: int, job: Job) -> ProcessPoolExecutor:
    """Start a pool of single-threaded processes that have imported everything a trial needs. Raises InputError."""
    pool = ProcessPoolExecutor(count, workers.start_fork_server(), initialize_worker, (job,))
    try:
        for future in [pool.submit(code_version) for _ in range(count)]:
            future.result()
    except BROKEN:
        raise InputError(
            "workers", f"{count} processes do not start", "fewer, or engine serial"
        ) from None
    return pool


def initialize_worker(job: Job) -> None:
    """Initialize a worker: ignore Ctrl-C, which the parent handles, and exit when the parent ends, even by kill -9."""
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    JOB[:] = [job]
    threading.Thread(target=exit_with_parent, daemon=True).start()


def exit_with_parent() -> None:
    """Wait until the parent process ends, then exit."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def run_chunk(chunk: Chunk) -> TimedRows:
    """`run_timed` with the job with which this worker was started."""
    return run_timed(JOB[0], chunk)
