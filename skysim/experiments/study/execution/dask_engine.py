"""Run trials on a Dask cluster. Its scheduler assigns chunks to workers, and reassigns those of a lost worker.

Scheduler and workers need this version of skysim. Each worker should be a process with one numerical thread:
`OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 dask worker ADDRESS --nworkers 8 --nthreads 1`
"""

import json
import logging
import time
from collections import deque
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any
from uuid import uuid4

import cv2

from skysim.core.errors import InputError
from skysim.experiments.study.execution.engines import (
    AHEAD,
    DIED,
    Batches,
    Chunk,
    Chunks,
    Job,
    run_timed,
    split_chunk,
)
from skysim.experiments.study.execution.trials import Segment, code_version

try:
    from distributed import Client, Future, KilledWorker, WorkerPlugin, as_completed
    from distributed.comm import CommClosedError, get_address_host_port
except ImportError:
    raise InputError(
        "engine", "dask is not installed", "pip install 'skysim[dask]', or another engine"
    ) from None

WAIT_S = 10.0  # timeout for a reply
IDLE_S = 60.0  # for which a cluster may have no worker
POLL_S = 5.0  # interval between queries of the cluster's thread count, because workers join and leave
Submission = tuple[Chunk, bool]  # a submitted chunk, and whether it is the only one in flight
ADDRESS = "a scheduler's address, such as tcp://10.0.0.1:8786"


def connect(scheduler: str) -> Client:
    """Connect to a cluster and check that it has workers of this code version. Raises InputError with one line."""
    try:
        if get_address_host_port(scheduler)[1] > 65535:
            raise ValueError("port above 65535")
    except ValueError as error:
        raise InputError("scheduler", f"{scheduler!r}: {error}", ADDRESS) from None
    # Silence the long logs of distributed, whose client has a level of its own; errors are reported here in one line.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(scheduler, timeout=WAIT_S, set_as_default=False, name="skysim")
    except (OSError, ImportError, RuntimeError):
        raise InputError(
            "scheduler", f"no reply from {scheduler} within {WAIT_S:.0f} s", ADDRESS
        ) from None
    try:
        check_workers(client, scheduler)
    except BaseException:
        client.close()
        raise
    return client


def check_workers(client: Client, scheduler: str) -> None:
    """Raise InputError if a cluster has no workers, or a worker has another code version.

    A worker that is lost meanwhile does not matter: if it comes back, `JobPlugin` checks its version.
    """
    started = f"one started with dask worker {scheduler}"
    silent = InputError("scheduler", f"no worker of {scheduler} replies", started)
    try:
        client.wait_for_workers(1, WAIT_S)
        versions = client.run(code_version, on_error="return")
    except OSError:
        raise silent from None
    replies = {
        worker: code
        for worker, code in versions.items()
        if not isinstance(code, CommClosedError)
    }
    if not replies:
        raise silent
    for worker, code in replies.items():
        if isinstance(code, Exception):
            raise InputError(
                "scheduler",
                f"worker {worker} cannot run trials: {code}",
                "a worker with this skysim",
            )
        if code != code_version():
            raise InputError(
                "scheduler",
                f"worker {worker} has skysim {code}",
                f"{code_version()}, the version here",
            )


def thread_count(client: Client) -> int:
    """Number of trials that the cluster runs at a time."""
    return int(sum(client.nthreads().values()))


def collect_rows(
    client: Client, name: str, job: Job, chunks: Chunks, in_flight: dict[Future, Submission]
) -> Batches:
    """Yield rows as chunks complete; chunks that complete together are joined. `in_flight` maps futures to chunks.

    Dask gives up a task (KilledWorker) after several of its workers died, whether the task was the cause or was only
    queued there. The trials of such a chunk are therefore retried one at a time with nothing else in flight, and a
    trial that is given up again is recorded as failed.
    """
    retries: deque[Chunk] = deque()
    completed = as_completed(loop=client.loop, with_results=True, raise_errors=False)
    capacity = 0
    polled_s = -POLL_S
    while True:
        if time.monotonic() - polled_s >= POLL_S:
            capacity = max(thread_count(client), 1) * (1 + AHEAD)
            polled_s = time.monotonic()
        alone = bool(retries)
        # An empty chunk is the end.
        source = iter(retries.popleft if alone else chunks.next, ())
        room = (1 if alone else capacity) - len(in_flight)
        new = list(islice(source, max(room, 0)))
        # One message submits all, and results arrive in the background: a round trip for each would limit the speed.
        futures = (
            client.map(
                run_encoded, [name] * len(new), list(map(encode_chunk, new)), pure=False
            )
            if new
            else []
        )
        in_flight |= {
            future: (chunk, alone) for future, chunk in zip(futures, new, strict=True)
        }
        completed.update(futures)
        if not in_flight:
            return
        rows: list[Any] = []
        wait_for_results(client, completed)
        for future, result in completed.next_batch():
            chunk, was_alone = in_flight.pop(future)
            if future.status == "finished":
                chunks.report_time(chunk, result[1])
                rows += result[0]
                continue
            try:
                future.result()  # raises, without a message to the cluster
            except KilledWorker:
                if was_alone:
                    rows.append(job.failed(chunk[0], DIED))
                else:
                    retries.extend(split_chunk(chunk))
        if rows:
            yield rows


def wait_for_results(client: Client, completed: as_completed) -> None:
    """Return once a chunk is completed. Raises InputError if the cluster has had no worker for IDLE_S.

    The scheduler keeps the chunks of lost workers for others, which may never come.
    """
    seen_s = polled_s = time.monotonic()
    while not completed.has_ready():
        time.sleep(0.002)
        if time.monotonic() - polled_s >= min(POLL_S, IDLE_S):
            polled_s = time.monotonic()
            if thread_count(client):
                seen_s = polled_s
            if polled_s - seen_s >= IDLE_S:
                raise InputError(
                    "scheduler",
                    f"no worker for {IDLE_S:.0f} s, finished trials are stored",
                    "to resume with new workers",
                )


def encode_chunk(chunk: Chunk) -> str:
    """A chunk as JSON text, because Dask searches other arguments for its task keys. Floats round-trip exactly."""
    rows = [
        (one.point, one.settings, one.first, one.replicates.start, one.replicates.stop)
        for one in chunk
    ]
    return json.dumps(rows, default=str)  # YAML dates become text, which scenes accept


def decode_chunk(text: str) -> Chunk:
    """The chunk in a text made by `encode_chunk`."""
    rows = json.loads(text)
    return tuple(
        Segment(point, settings, first, range(*replicates))
        for point, settings, first, *replicates in rows
    )


# On the workers.

JOBS: dict[str, Job] = {}  # job of each run that this worker serves


@dataclass(eq=False)
class JobPlugin(WorkerPlugin):
    """Worker plugin that gives every worker a run's job, including workers that join later."""

    name: str
    job: Job
    code: str

    def setup(self, worker: Any) -> None:
        """Store the job on the worker. Raises InputError if its code version differs from the run's."""
        if code_version() != self.code:
            raise InputError("", f"{worker.address} has skysim {code_version()}", self.code)
        cv2.setNumThreads(1)
        JOBS[self.name] = self.job

    def teardown(self, worker: Any) -> None:
        """Remove the job from the worker."""
        JOBS.pop(self.name, None)


def run_encoded(name: str, text: str) -> tuple[list[Any], float]:
    """`run_timed` with the run's job on this worker. Raises InputError if `JobPlugin.setup` rejected it."""
    if name not in JOBS:
        raise InputError(
            "scheduler", f"a new worker has skysim {code_version()}", "the version of the run"
        )
    return run_timed(JOBS[name], decode_chunk(text))


class Dask:
    """Engine that uses an existing Dask cluster. A task that loses its worker is run by another.

    Attributes
    ----------
    scheduler
        Address of the scheduler, such as tcp://10.0.0.1:8786

    Raises
    ------
    InputError
        If the scheduler does not respond or a worker has another code version.
    """

    name = "dask"

    def __init__(self, scheduler: str) -> None:
        self.scheduler = scheduler
        self.client = connect(scheduler)
        self.workers = thread_count(self.client)

    def run(self, job: Job, chunks: Chunks) -> Batches:
        """See `Engine`; the client is closed at the end. Raises InputError if the scheduler's connection is lost."""
        if self.client.status != "running":  # a previous run closed it
            self.client = connect(self.scheduler)
        client = self.client
        name = f"skysim-{uuid4().hex}"
        in_flight = dict[Future, Submission]()
        try:
            client.register_plugin(JobPlugin(name, job, code_version()), name)
            yield from collect_rows(client, name, job, chunks, in_flight)
        except (CancelledError, OSError):
            problem = "connection lost, finished trials are stored"
            raise InputError("scheduler", problem, "to resume the study") from None
        finally:
            # The connection itself may have failed, and a lost scheduler needs no cleanup.
            with suppress(CancelledError, OSError, RuntimeError, ValueError):
                if client.status == "running":
                    client.cancel(list(in_flight))
                    client.unregister_worker_plugin(name)
            client.close()

    def close(self) -> None:
        self.client.close()
