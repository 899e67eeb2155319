"""Run trials on a Dask cluster. Its scheduler assigns chunks to workers, and reassigns those of a lost worker.

Scheduler and workers need this version of skysim. Each worker should be a process with one numerical thread:
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
from skysim.experiments.study.execution.engines import AHEAD, Chunk, Chunks, failed_row, split_chunk, timed
from skysim.experiments.study.plan import TrialSpec
from skysim.experiments.study.setups import code_version
from skysim.experiments.study.trials import Row, Segment

try:
    from distributed import Client, Future, KilledWorker, WorkerPlugin, as_completed
    from distributed.comm import get_address_host_port
except ImportError:
    raise InputError(
        "engine: dask is not installed; allowed: pip install 'skysim[dask]', or another engine"
    ) from None

WAIT_S = 10.0  # timeout for a reply

LOOK_S = 5.0  # interval between queries of the cluster's thread count, because workers join and leave

WANTED = "allowed: a scheduler's address, such as tcp://10.0.0.1:8786"


class Flight(NamedTuple):
    """A submitted chunk, and whether it is the only one in flight."""

    chunk: Chunk
    alone: bool


def connect(scheduler: str) -> Client:
    """Connect to a cluster and check that it has workers of this code version. Raises InputError with one line."""
    try:
        if get_address_host_port(scheduler)[1] > 65535:
            raise ValueError("no such port")
    except ValueError as error:
        raise InputError(f"scheduler: {scheduler!r}: {error}; {WANTED}") from None
    # Silence the long logs of distributed; errors are reported here in one line.
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
    """Raise InputError if a cluster has no workers, or a worker has another code version."""
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
    """Number of trials that the cluster runs at a time."""
    return int(sum(client.nthreads().values()))


def run(client: Client, recipe: TrialSpec, chunks: Chunks) -> Iterator[list[Row]]:
    """See `Engine`; the client is closed at the end. Raises InputError if the connection to the scheduler is lost."""
    name, flying = f"skysim-{uuid4().hex}", dict[Future, Flight]()
    try:
        client.register_plugin(Told(name, recipe, code_version()), name)
        yield from coming(client, name, recipe, chunks, flying)
    except (CancelledError, OSError):
        raise InputError("scheduler: it was lost; what came is kept; allowed: skysim study resume") from None
    finally:
        # The connection itself may have failed, and a lost scheduler needs no cleanup.
        with suppress(CancelledError, OSError, RuntimeError, ValueError):
            if client.status == "running":
                client.cancel(list(flying))
                client.unregister_worker_plugin(name)
        client.close()


def coming(
    client: Client, name: str, recipe: TrialSpec, chunks: Chunks, flying: dict[Future, Flight]
) -> Iterator[list[Row]]:
    """Yield rows as chunks complete. `flying` maps futures to their chunks.

    Dask gives up a task (KilledWorker) after several of its workers died, whether the task was the cause or was only
    queued there. The trials of such a chunk are therefore retried one at a time with nothing else in flight, and a
    trial that is given up again is recorded as failed.
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
                yield [failed_row(recipe, flight.chunk[0])]
            else:
                suspects.extend(split_chunk(flight.chunk))
        else:
            chunks.took(flight.chunk, seconds)
            yield rows


def packed(chunk: Chunk) -> str:
    """A chunk as JSON text, because Dask searches other arguments for its task keys. Floats round-trip exactly."""
    rows = [(one.point, one.settings, one.first, one.replicates.start, one.replicates.stop) for one in chunk]
    return json.dumps(rows, default=str)  # YAML dates become text, which scenes accept


def unpacked(text: str) -> Chunk:
    """The chunk in a text made by `packed`."""
    rows = json.loads(text)
    return tuple(Segment(point, settings, first, range(*which)) for point, settings, first, *which in rows)


# On the workers.

RECIPES: dict[str, TrialSpec] = {}  # recipe of each run that this worker serves


class Told(WorkerPlugin):
    """Worker plugin that gives every worker a run's recipe, including workers that join later."""

    def __init__(self, name: str, recipe: TrialSpec, code: str) -> None:
        self.name, self.recipe, self.code = name, recipe, code

    def setup(self, worker: Any) -> None:
        """Store the recipe on the worker. Raises InputError if the worker's code version is not that of the run."""
        if code_version() != self.code:
            raise InputError(f"{worker.address} has skysim {code_version()}, the run {self.code}")
        cv2.setNumThreads(1)
        RECIPES[self.name] = self.recipe

    def teardown(self, worker: Any) -> None:
        """Remove the recipe from the worker."""
        RECIPES.pop(self.name, None)


def remembered(name: str, text: str) -> tuple[list[Row], float]:
    """`timed` with the run's recipe on this worker. Raises InputError if `Told.setup` rejected it."""
    if name not in RECIPES:
        raise InputError(
            f"scheduler: a worker that came later has skysim {code_version()}; allowed: one code"
        )
    return timed(RECIPES[name], unpacked(text))


class Dask:
    """Engine that uses an existing Dask cluster. A task that loses its worker is run by another.

    scheduler : its address, such as tcp://10.0.0.1:8786

    Raises InputError if the scheduler does not respond or a worker has another code version.
    """

    name = "dask"

    def __init__(self, scheduler: str) -> None:
        self.scheduler, self.client = scheduler, connect(scheduler)
        self.workers = threads(self.client)

    def run(self, recipe: TrialSpec, chunks: Chunks) -> Iterator[list[Row]]:
        """See `Engine`."""
        if self.client.status != "running":  # a previous run closed it
            self.client = connect(self.scheduler)
        yield from run(self.client, recipe, chunks)

    def close(self) -> None:
        """See `Engine`."""
        self.client.close()
