"""Who does the trials: this process, a pool of processes, or a Dask cluster. All make the same, row for row."""

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
from skysim.experiments.study.plan import Recipe
from skysim.experiments.study.setups import code_version, seed_of
from skysim.experiments.study.trials import FAILED, Row, Segment, work

AHEAD = 1  # chunks that wait for each worker beside the one at hand

TRIES = 3  # of a trial whose worker dies

Chunk = tuple[Segment, ...]


class Chunks(Protocol):
    """Work to be handed out: the next chunk, or none; and how long one took, by which the next are sized."""

    def next(self) -> Chunk: ...
    def took(self, chunk: Chunk, seconds: float) -> None: ...


class Engine(Protocol):
    """Does chunks of trials; rows come in any order, each chunk's at once."""

    name: str
    workers: int

    def run(self, recipe: Recipe, chunks: Chunks) -> Iterator[list[Row]]: ...

    def close(self) -> None:
        """Let go of what is kept from one run to the next."""


class Serial:
    """One trial after another in this process."""

    name, workers = "serial", 1

    def run(self, recipe: Recipe, chunks: Chunks) -> Iterator[list[Row]]:
        """See `Engine`."""
        while chunk := chunks.next():
            rows, seconds = timed(recipe, chunk)
            chunks.took(chunk, seconds)
            yield rows

    def close(self) -> None:
        """See `Engine`."""


class Pool:
    """Processes of this machine. Each builds a scene and its index once and keeps them, from one run to the next.

    Where one dies, the pool is begun anew and the trials at hand are tried one by one; one that was alone when its
    worker died, TRIES times, is put down as failed.
    """

    name = "pool"

    def __init__(self, count: int | None = None) -> None:
        self.workers = count or cores()
        self._pool: ProcessPoolExecutor | None = None
        self._recipe: Recipe | None = None

    def run(self, recipe: Recipe, chunks: Chunks) -> Iterator[list[Row]]:
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
                at_hand = [one for chunk in flying.values() for one in singly(chunk)]
                deaths.update(one[0].first for one in at_hand if len(at_hand) == 1)
                for one in at_hand:
                    if deaths[one[0].first] == TRIES:
                        yield [dead(recipe, one[0])]
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

    def _ready(self, recipe: Recipe) -> ProcessPoolExecutor:
        """The pool of the run before, if it was begun with this recipe; else a new one."""
        if recipe != self._recipe:
            self.close()
        if self._pool is None:
            self._pool, self._recipe = started(self.workers, recipe), recipe
        return self._pool

    def _kill(self) -> None:
        """End the pool at once: what is not in the store is done again."""
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
        """Rows as they come, suspects first and each of them alone. `flying` has what is at hand."""
        while True:
            room = self.workers * (1 + AHEAD) if not suspects else 1
            while len(flying) < room and (chunk := suspects.popleft() if suspects else chunks.next()):
                try:
                    flying[pool.submit(remembered, chunk)] = chunk
                except BrokenProcessPool:  # a worker died while rows were kept
                    suspects.appendleft(chunk)
                    raise
                room = room if not suspects else 1
            if not flying:
                return
            for future in wait(flying, return_when=FIRST_COMPLETED).done:
                rows, seconds = future.result()
                chunks.took(flying.pop(future), seconds)
                yield rows


def timed(recipe: Recipe, chunk: Chunk) -> tuple[list[Row], float]:
    """A chunk's rows, and the seconds that it took where it was done."""
    begin_s = time.perf_counter()
    return work(recipe, chunk), time.perf_counter() - begin_s


def singly(chunk: Chunk) -> Iterator[Chunk]:
    """A chunk's trials, each a chunk."""
    for segment in chunk:
        for n, replicate in enumerate(segment.replicates):
            alone = range(replicate, replicate + 1)
            yield (segment._replace(first=segment.first + n, replicates=alone),)


def dead(recipe: Recipe, segment: Segment) -> Row:
    """The row of a trial that kills its workers."""
    replicate = segment.replicates[0]
    seed, why = seed_of(recipe, segment.point, replicate), f"its worker process died, {TRIES} times"
    return Row(segment.first, segment.point, replicate, seed, "", code_version(), FAILED, why, 0.0)


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# Worker processes.

RECIPE: list[Recipe] = []  # a worker's


def started(count: int, recipe: Recipe) -> ProcessPoolExecutor:
    """A pool whose processes have imported all that a trial takes and have one thread each."""
    pool = ProcessPoolExecutor(count, workers.warm(), begin, (recipe,))
    try:
        for one in [pool.submit(code_version) for _ in range(count)]:
            one.result()
    except BrokenProcessPool:
        raise InputError(
            f"--workers: {count} processes cannot start; allowed: fewer, or --engine serial"
        ) from None
    return pool


def begin(recipe: Recipe) -> None:
    """A worker's first act. Ctrl-C is its parent's affair, and it ends when that does, even by -9."""
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    RECIPE[:] = [recipe]
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """Wait for the parent's end."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def remembered(chunk: Chunk) -> tuple[list[Row], float]:
    """`timed`, by the recipe that this worker was begun with."""
    return timed(RECIPE[0], chunk)
