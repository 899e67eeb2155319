"""The page's SLURM job and Kubernetes pods, run here without either."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]
import pytest
import yaml

from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.experiments.study import plan
from skysim.experiments.study.execution import runner, workers
from skysim.experiments.study.execution.trials import code_version
from tests.helpers.clusters import ENVIRONMENT, STUDY, Cluster, cluster_of, on_dask, study
from tests.helpers.study_stores import contents, done

PAGE = (ROOT / "docs/howto/cluster.md").read_text(encoding="utf-8")
SMALL = ("replicates: 150", "replicates: 20")


def block(begin: str) -> str:
    """The page's code block that starts with this text."""
    (found,) = re.findall(rf"```\w+\n({re.escape(begin)}.*?)```", PAGE, re.S)
    return str(found)


@pytest.fixture(scope="module")
def plan_(tmp_path_factory: pytest.TempPathFactory) -> plan.Plan:
    return study(tmp_path_factory.mktemp("study"), STUDY.replace(*SMALL))


@pytest.fixture(scope="module")
def serial_contents(plan_: plan.Plan, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("serial") / "study.sqlite"
    done(plan_, path)
    return contents(path)


@contextmanager
def processes(
    *commands: list[str], **options: Any
) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Commands that run in the background, without this environment's thread limits."""
    environment = {
        key: value for key, value in ENVIRONMENT.items() if key not in workers.ONE_THREAD
    }
    environment["PATH"] = os.pathsep.join(
        [str(Path(sys.executable).parent), environment["PATH"]]
    )
    started = [subprocess.Popen(one, **{"env": environment, **options}) for one in commands]
    try:
        yield started
    finally:
        for process in started:
            for one in (
                psutil.Process(process.pid).children(recursive=True)
                if process.poll() is None
                else ()
            ):
                one.kill()
            process.kill()
            process.wait(10)


def threads_of_worker(dask_worker: Any) -> dict[str, str | None]:
    return {name: os.environ.get(name) for name in workers.ONE_THREAD}


@pytest.mark.long
def test_a_slurm_job_runs_a_study(
    plan_: plan.Plan, serial_contents: str, tmp_path: Path
) -> None:
    """The script that dask-jobqueue makes from the page's lines, run by bash, to which SBATCH lines are comments."""
    pytest.importorskip("dask_jobqueue")
    session: dict[str, Any] = {}
    exec(block("from dask_jobqueue").replace("print(slurm.job_script())", ""), session)
    slurm = session["slurm"]
    try:
        script = slurm.job_script()
        directives = [line for line in script.splitlines() if line.startswith("#SBATCH")]
        for expected in ("-p short", "-t 04:00:00", "--cpus-per-task=16", "-n 1"):
            assert f"#SBATCH {expected}" in directives
        assert "--nworkers 16" in script
        assert "--nthreads 1" in script
        here = script.replace("--nworkers 16", "--nworkers 2").replace(
            "source .venv/bin/activate", "true"
        )
        (tmp_path / "job.sh").write_text(here)
        with processes(["bash", "job.sh"], cwd=tmp_path):
            engine = on_dask(Cluster(slurm.scheduler_address, []), 2)
            assert (
                list(engine.client.run(threads_of_worker).values())
                == [dict.fromkeys(workers.ONE_THREAD, "1")] * 2
            )
            done(plan_, tmp_path / "slurm.sqlite", engine)
    finally:
        slurm.close()
    assert contents(tmp_path / "slurm.sqlite") == serial_contents


def manifests() -> dict[tuple[str, str], Any]:
    found = list(yaml.safe_load_all(block("# dask.yaml")))
    return {(one["kind"], one["metadata"]["name"]): one for one in found}


def test_pods_find_each_other() -> None:
    """Labels, ports and the scheduler's name agree, and a worker has as many cores as numerical threads: one."""
    every = manifests()
    assert len(every) == 3
    service = every["Service", "skysim-scheduler"]["spec"]
    for name in ("skysim-scheduler", "skysim-worker"):
        deployment = every["Deployment", name]["spec"]
        assert (
            deployment["selector"]["matchLabels"]
            == deployment["template"]["metadata"]["labels"]
            == {"app": name}
        )
    scheduler, worker = (
        every["Deployment", f"skysim-{name}"]["spec"]["template"]["spec"]["containers"][0]
        for name in ("scheduler", "worker")
    )
    assert service["selector"] == {"app": "skysim-scheduler"}
    port = service["ports"][0]["port"]
    assert scheduler["args"][3] == str(port)
    assert scheduler["ports"] == [{"containerPort": port}]
    assert f"tcp://skysim-scheduler:{port}" in worker["args"]
    threads = {one["name"]: one["value"] for one in worker["env"]}
    assert threads.items() <= dict.fromkeys(workers.ONE_THREAD, "1").items()
    assert "NUMBA_NUM_THREADS" in threads
    assert worker["resources"]["limits"]["cpu"] == "1"
    assert scheduler["image"] == worker["image"]


@pytest.mark.long
def test_the_commands_of_the_pods_run_a_study(
    plan_: plan.Plan, serial_contents: str, tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    every = manifests()
    port = "18788"
    commands = [
        every["Deployment", name]["spec"]["template"]["spec"]["containers"][0]["args"]
        for name in ("skysim-scheduler", "skysim-worker", "skysim-worker")
    ]
    here = [
        [word.replace("skysim-scheduler", "127.0.0.1").replace("8786", port) for word in one]
        for one in commands
    ]
    with processes(*here, cwd=tmp_path):
        done(
            plan_,
            tmp_path / "pods.sqlite",
            on_dask(Cluster(f"tcp://127.0.0.1:{port}", []), 2),
        )
    assert contents(tmp_path / "pods.sqlite") == serial_contents


@pytest.mark.long
def test_a_hanging_worker_is_abandoned(
    plan_: plan.Plan, serial_contents: str, tmp_path: Path
) -> None:
    """A worker stopped by a signal does not answer; another repeats its trials, and none is stored twice."""
    patience = {"DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "3s"}
    for cluster in cluster_of(tmp_path, "--no-nanny", count=2, environment=patience):
        engine = on_dask(cluster, 2)
        hung = cluster.workers[:1]

        def hang(
            progress: runner.Progress, hung: list[subprocess.Popen[bytes]] = hung
        ) -> None:
            if progress.now >= 5 and hung:
                hung.pop().send_signal(signal.SIGSTOP)

        assert done(plan_, tmp_path / "hung.sqlite", engine, watch=hang).done == plan_.trials
        assert not hung
    assert contents(tmp_path / "hung.sqlite") == serial_contents


class Replies:
    """A client whose workers give these replies."""

    def __init__(self, replies: dict[str, Any]) -> None:
        self.replies = replies

    def wait_for_workers(self, *_: Any) -> None:
        """Return at once: the workers are present."""

    def run(self, *_: Any, **__: Any) -> dict[str, Any]:
        return self.replies


def test_a_worker_that_is_lost_before_a_run_does_not_end_it() -> None:
    """A worker of another version ends the run, as does a run without replying workers."""
    pytest.importorskip("distributed")
    from distributed.comm import CommClosedError

    from skysim.experiments.study.execution import dask_engine as engine

    lost = CommClosedError("Stream is closed")
    version = code_version()
    engine.check_workers(Replies({"first": lost, "second": version}), "tcp://here:1")
    with pytest.raises(InputError, match="no worker of tcp://here:1 replies"):
        engine.check_workers(Replies({"first": lost}), "tcp://here:1")
    with pytest.raises(InputError, match="worker second cannot run trials: no file"):
        engine.check_workers(
            Replies({"first": version, "second": FileNotFoundError("no file")}),
            "tcp://here:1",
        )
    with pytest.raises(InputError, match=f"worker second has skysim 0; allowed: {version}"):
        engine.check_workers(Replies({"first": lost, "second": "0"}), "tcp://here:1")
