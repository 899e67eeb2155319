"""Fork server of the process pool: it imports everything a trial needs once, and workers are forked from it."""

import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext

from skysim.core.guarded import SAFE_PATH

ONE_THREAD = (
    "NUMBA_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
)
SETTINGS = dict.fromkeys((*ONE_THREAD, SAFE_PATH), "1")


def start_fork_server() -> ForkServerContext:
    """Start the fork server, with one numerical thread per worker. Returns at once; the imports run in parallel."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["skysim.experiments.study.execution.trials"])
    with one_thread():
        forkserver.ensure_running()
    return context


@contextmanager
def one_thread() -> Iterator[None]:
    """Context in which started processes use one numerical thread each; there is already one worker per core.

    They inherit the environment variables, also that the working directory is not on the import path.
    """
    previous = {name: os.environ.get(name) for name in SETTINGS}
    os.environ.update(SETTINGS)
    # They inherit the mask: Ctrl-C, which a terminal sends to all, would end their imports with a traceback.
    resource_tracker.ensure_running()  # unblocks the signal
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in previous.items():
            del os.environ[name]
            if value is not None:
                os.environ[name] = value
