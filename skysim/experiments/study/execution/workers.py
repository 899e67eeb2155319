"""The process that a pool's workers are forked from: it imports all that a trial takes while others read files."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext

ONE_THREAD = ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def warm() -> ForkServerContext:
    """Begin that process, with one thread for each of its children, and return at once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["skysim.experiments.study.trials"])
    with one_thread():
        forkserver.ensure_running()
    return context


def one_thread() -> AbstractContextManager[None]:
    """An environment for what is begun in it: as many workers as cores have no use for threads."""
    return environment(dict.fromkeys(ONE_THREAD, "1"))


@contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """What is begun in it has these variables."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            del os.environ[name]
            if value is not None:
                os.environ[name] = value
