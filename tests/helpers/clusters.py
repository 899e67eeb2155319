"""A small study, and Dask clusters of real processes on loopback that run it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import psutil  # type: ignore[import-untyped]
import pytest

from skysim.core.paths import ROOT
from skysim.experiments.study import plan, study_file
from skysim.experiments.study.execution import workers

STUDY = """
schema: 1
title: strays
scene: shefex2
seed: 1
set: {light.limit_mag: 5.0}
trial: {kind: centroids, lights: 15}
factors: {strays: {key: trial.false_lights, values: [0, 5]}}
replicates: 150
paired: false
responses: [identified]
budget: {failures: 1000}
"""
# Of a process that imports the checkout, on one thread.
ENVIRONMENT = os.environ | dict.fromkeys(workers.ONE_THREAD, "1") | {"PYTHONPATH": str(ROOT)}


def study(folder: Path, text: str = STUDY) -> plan.Plan:
    path = folder / "strays.yaml"
    path.write_text(text)
    return study_file.load(path)


class Cluster(NamedTuple):
    """A scheduler and its workers on loopback."""

    address: str
    workers: list[subprocess.Popen[bytes]]


def cluster_of(
    folder: Path, *worker: str, count: int = 1, environment: dict[str, str] | None = None
) -> Iterator[Cluster]:
    """A real scheduler and `count` real worker processes; all end with the test."""
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    everyone = ["--host", "127.0.0.1", "--no-dashboard"]
    dask = [sys.executable, "-m"]
    commands = [[*dask, "distributed.cli.dask_scheduler", "--port", str(port), *everyone]]
    plan_ = [
        *dask,
        "distributed.cli.dask_worker",
        address,
        *everyone,
        "--nthreads",
        "1",
        *worker,
    ]
    commands += [[*plan_, "--local-directory", str(folder)]] * count
    with (folder / "log").open("wb") as log:
        processes = [
            subprocess.Popen(
                one, env=ENVIRONMENT | (environment or {}), stdout=log, stderr=log
            )
            for one in commands
        ]
        try:
            yield Cluster(address, processes[1:])
        finally:
            for process in reversed(processes):
                for one in (
                    psutil.Process(process.pid).children(recursive=True)
                    if process.poll() is None
                    else ()
                ):
                    one.kill()
                process.kill()
                process.wait(10)


def dask(address: str) -> Any:
    """The engine; its module takes the extra `dask`."""
    from skysim.experiments.study.execution.dask_engine import Dask

    return Dask(address)


def on_dask(cluster: Cluster, workers: int) -> Any:
    """The engine, once so many workers are there."""
    engine = dask(cluster.address)
    engine.client.wait_for_workers(workers, 20)
    return engine
