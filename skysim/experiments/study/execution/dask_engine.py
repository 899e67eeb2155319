"""Trials on a Dask cluster: its scheduler hands chunks to the workers it has, and hands out again what a lost one had.

Scheduler and workers need this same skysim. A worker is best a process of one thread, its numerics too:
`OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 dask worker ADDRESS --nworkers 8 --nthreads 1`
"""

from __future__ import annotations

import json
import logging
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import suppress
from typing import Any, NamedTuple
from uuid import uuid4

import cv2

from skysim.core.errors import InputError
from skysim.experiments.study.execution.engines import AHEAD, Chunk, Chunks, dead, singly, timed
from skysim.experiments.study.plan import Recipe
from skysim.experiments.study.setups import code_version
from skysim.experiments.study.trials import Row, Segment

try:
    from distributed import Client, Future, KilledWorker, WorkerPlugin, as_completed
    from distributed.comm import get_address_host_port
except ImportError:
    raise InputError(
        "engine: dask is not installed; allowed: pip install 'skysim[dask]', or another engine"
    ) from None

WAIT_S = 10.0  # for an answer

LOOK_S = 5.0  # after which the cluster is asked again how many threads it has: workers come and go

WANTED = "allowed: a scheduler's address, such as tcp://10.0.0.1:8786"


class Flight(NamedTuple):
    """A chunk that the cluster has, and whether it has no other."""

    chunk: Chunk
    alone: bool


def connect(scheduler: str) -> Client:
    """A cluster that answers, has workers, and of this code. Raises InputError with one line where it does not."""
    try:
        if get_address_host_port(scheduler)[1] > 65535:
            raise ValueError("no such port")
    except ValueError as error:
        raise InputError(f"scheduler: {scheduler!r}: {error}; {WANTED}") from None
    # What goes wrong is told in one line here, not in pages there.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client = Client(scheduler, timeout=WAIT_S, set_as_default=False, name="skysim")
    except (OSError, ImportError, RuntimeError):
        raise InputError(
            f"scheduler: nobody answers at {scheduler} within {WAIT_S:.0f} s; {WANTED}"
        ) from None
    try:
        agree(client, scheduler)
    except BaseException:
        client.close()
        raise
    return client


def agree(client: Client, scheduler: str) -> None:
    """Raises InputError where a cluster has no workers, or one has other code."""
    try:
        client.wait_for_workers(1, WAIT_S)
        found = client.run(code_version, on_error="return")
    except OSError:
        raise InputError(
            f"scheduler: {scheduler} has no worker that answers; allowed: dask worker {scheduler}"
        ) from None
    for worker, code in found.items():
        if isinstance(code, Exception):
            raise InputError(
                f"scheduler: worker {worker} cannot do trials: {code}; allowed: this skysim there"
            )
        if code != code_version():
            raise InputError(
                f"scheduler: worker {worker} has skysim {code}, this is {code_version()}; allowed: one code"
            )


def threads(client: Client) -> int:
    """How many trials the cluster does at a time."""
    return int(sum(client.nthreads().values()))


def run(client: Client, recipe: Recipe, chunks: Chunks) -> Iterator[list[Row]]:
    """See `Engine`; the client is closed at the end. Raises InputError where the scheduler is lost."""
    name, flying = f"skysim-{uuid4().hex}", dict[Future, Flight]()
    try:
        client.register_plugin(Told(name, recipe, code_version()), name)
        yield from coming(client, name, recipe, chunks, flying)
    except (CancelledError, OSError):
        raise InputError("scheduler: it was lost; what came is kept; allowed: skysim study resume") from None
    finally:
        # The link may be what failed, and a lost scheduler has nothing to tidy.
        with suppress(CancelledError, OSError, RuntimeError, ValueError):
            if client.status == "running":
                client.cancel(list(flying))
                client.unregister_worker_plugin(name)
        client.close()


def coming(
    client: Client, name: str, recipe: Recipe, chunks: Chunks, flying: dict[Future, Flight]
) -> Iterator[list[Row]]:
    """Rows as they come. `flying` has what is at hand.

    Dask gives up a task after a few dead workers, be it the cause or only in line there; so each trial of such a chunk
    is tried with nothing else at hand, and one that is given up then is put down as failed.
    """
    suspects: deque[Chunk] = deque()
    landed, room, looked = as_completed(loop=client.loop), 0, -LOOK_S
    while True:
        if time.monotonic() - looked >= LOOK_S:
            room, looked = max(threads(client), 1) * (1 + AHEAD), time.monotonic()
        alone = bool(suspects)
        while len(flying) < (1 if alone else room) and (
            chunk := suspects.popleft() if alone else chunks.next()
        ):
            future = client.submit(remembered, name, packed(chunk), pure=False)
            flying[future] = Flight(chunk, alone)
            landed.add(future)
        if not flying:
            return
        future = next(landed)
        flight = flying.pop(future)
        try:
            rows, seconds = future.result()
        except KilledWorker:
            if flight.alone:
                yield [dead(recipe, flight.chunk[0])]
            else:
                suspects.extend(singly(flight.chunk))
        else:
            chunks.took(flight.chunk, seconds)
            yield rows


def packed(chunk: Chunk) -> str:
    """A chunk as text: in anything else Dask would look for its own keys. Floats come back bit for bit."""
    rows = [(one.point, one.settings, one.first, one.replicates.start, one.replicates.stop) for one in chunk]
    return json.dumps(rows, default=str)  # a moment of YAML's as its text, which scenes take too


def unpacked(text: str) -> Chunk:
    """What was `packed`."""
    rows = json.loads(text)
    return tuple(Segment(point, settings, first, range(*which)) for point, settings, first, *which in rows)


# On the workers.

RECIPES: dict[str, Recipe] = {}  # of the runs that this worker serves


class Told(WorkerPlugin):
    """Tells a run's recipe to every worker once, also to those that come later."""

    def __init__(self, name: str, recipe: Recipe, code: str) -> None:
        self.name, self.recipe, self.code = name, recipe, code

    def setup(self, worker: Any) -> None:
        """Learn it. Raises InputError where this worker's code is not the run's."""
        if code_version() != self.code:
            raise InputError(f"{worker.address} has skysim {code_version()}, the run {self.code}")
        cv2.setNumThreads(1)
        RECIPES[self.name] = self.recipe

    def teardown(self, worker: Any) -> None:
        """Forget it."""
        RECIPES.pop(self.name, None)


def remembered(name: str, text: str) -> tuple[list[Row], float]:
    """`timed`, by the recipe that this worker was told. Raises InputError where it refused that."""
    if name not in RECIPES:
        raise InputError(
            f"scheduler: a worker that came later has skysim {code_version()}; allowed: one code"
        )
    return timed(RECIPES[name], unpacked(text))


class Dask:
    """An existing Dask cluster. A task that loses its worker is done by another.

    scheduler : its address, such as tcp://10.0.0.1:8786. Raises InputError where nobody answers, or with other code.
    """

    name = "dask"

    def __init__(self, scheduler: str) -> None:
        self.scheduler, self.client = scheduler, connect(scheduler)
        self.workers = threads(self.client)

    def run(self, recipe: Recipe, chunks: Chunks) -> Iterator[list[Row]]:
        """See `Engine`."""
        if self.client.status != "running":  # a run before has closed it
            self.client = connect(self.scheduler)
        yield from run(self.client, recipe, chunks)

    def close(self) -> None:
        """See `Engine`."""
        self.client.close()
