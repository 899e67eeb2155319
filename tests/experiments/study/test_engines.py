"""Any engine leaves the store of one process, row for row, even if workers die on the way."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil  # type: ignore[import-untyped]
import pytest

import skysim.experiments.study.execution
from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.experiments.study import plan
from skysim.experiments.study.execution import engines, runner, store, trials
from skysim.experiments.study.execution.engines import Engine
from tests.helpers.clusters import (
    ENVIRONMENT,
    STUDY,
    Cluster,
    cluster_of,
    dask,
    on_dask,
    study,
)
from tests.helpers.study_stores import contents, done

# What `python -c` runs in a process of its own: a study on a pool, begun or gone on with, that tells how far it is.
DRIVER = """
import sys
from pathlib import Path
from skysim.experiments.study import study_file
from skysim.experiments.study.execution import store
from skysim.experiments.study.execution import engines, runner
study_plan = study_file.load(sys.argv[1])
with store.writing(Path(sys.argv[2])) as kept:
    runner.prepare_store(study_plan, kept, kept.counts()["done"] > 0)
    runner.run(study_plan, kept, engines.Pool(int(sys.argv[3])), lambda progress: print(progress.done, flush=True))
"""


@pytest.fixture(scope="module")
def plan_(tmp_path_factory: pytest.TempPathFactory) -> plan.Plan:
    return study(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def serial_contents(plan_: plan.Plan) -> str:
    """Contents of the store of one uninterrupted process."""
    path = plan_.path.with_name("whole.sqlite")
    assert done(plan_, path, engines.Serial()).failed == 0
    return contents(path)


# A pool.


@pytest.mark.slow
def test_a_refused_trial_keeps_its_seed_and_reason_and_the_rest_is_done(
    tmp_path: Path,
) -> None:
    """One level's scene file vanishes after the study was checked: its trials fail, in a pool as in one process."""
    lost = tmp_path / "lost.yaml"
    lost.write_text((ROOT / "scenes" / "shefex2.yaml").read_text())
    plan_ = study(
        tmp_path,
        STUDY.replace(
            "trial.false_lights, values: [0, 5]", "scene, values: [lost.yaml, shefex2]"
        ),
    )
    lost.unlink()
    paths = [tmp_path / f"{n}.sqlite" for n in range(2)]
    both: list[Engine] = [engines.Serial(), engines.Pool(2)]
    for path, engine in zip(paths, both, strict=True):
        progress = done(plan_, path, engine)
        assert (progress.done, progress.failed) == (300, 150)
    with store.open_store(paths[1]) as stored:
        assert {trial for trial, _ in stored.failures()} == set(range(150))
        row = stored.trial(7)
    assert row["seed"] == trials.seed_of(plan_.spec, 0, 7)
    assert row["error"].startswith("lost.yaml: no such scene")
    assert contents(paths[0]) == contents(paths[1])


# A module for workers to import: trials that do nothing, or now and then kill their worker.
STUBS = """
import os
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution import engines
from skysim.experiments.study.execution.outcomes import Outcome
BEGIN = engines.initialize_worker
def deadly(ready, seed):
    if seed % 200 == 5:
        os._exit(3)
    return Outcome("solved", 1, 1, stars=float(seed % 100))
def trivial(ready, seed):
    return Outcome("solved", 1, 1)
def make_deadly():
    trials.TRIALS["centroids"] = trials.one_by_one(deadly)
def begin_deadly(spec):
    BEGIN(spec)
    make_deadly()
def begin_trivial(spec):
    BEGIN(spec)
    trials.TRIALS["centroids"] = trials.one_by_one(trivial)
"""


@pytest.fixture
def stubs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The stub module on the import path of this process and its workers."""
    (tmp_path / "study_stubs.py").write_text(STUBS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "study_stubs", raising=False)
    return importlib.import_module("study_stubs")


def deaths(plan_: plan.Plan) -> list[int]:
    """The trials that kill a process running `deadly`."""
    bad = [
        n
        for n in range(plan_.trials)
        if trials.seed_of(plan_.spec, *divmod(n, 150)) % 200 == 5
    ]
    assert 1 <= len(bad) <= 3
    return bad


@pytest.mark.long
def test_a_trial_that_kills_its_worker_fails_and_no_other(
    plan_: plan.Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stubs: Any
) -> None:
    monkeypatch.setattr(engines, "initialize_worker", stubs.begin_deadly)
    bad = deaths(plan_)
    path = tmp_path / "deadly.sqlite"
    progress = done(plan_, path, engines.Pool(2))
    assert (progress.done, progress.failed) == (plan_.trials, len(bad))
    with store.open_store(path) as stored:
        assert stored.failures() == [(n, "its worker process died, 3 times") for n in bad]
        columns = stored.columns()
    failed = np.isin(columns["trial"], bad)
    assert set(columns["status"][failed]) == {"failed"}
    assert np.array_equal(columns["stars"][~failed], columns["seed"][~failed] % 100)


class FakePool:
    """Substitute for a pool of processes: work is done when the engine waits; a death loses all chunks in flight.

    deaths  : how many more times trial 2 kills its worker
    retries : number of chunks in flight, itself among them, when a trial was submitted again
    """

    def __init__(self, deaths: int) -> None:
        self.deaths = deaths
        self.seen = set[int]()
        self.retries = list[int]()
        self.pending = dict[Future[engines.TimedRows], list[int]]()
        self._processes = None

    def submit(self, _: Any, chunk: engines.Chunk) -> Future[engines.TimedRows]:
        future = Future[engines.TimedRows]()
        first = chunk[0].first
        self.pending[future] = list(range(first, first + len(chunk[0].replicates)))
        if not self.seen.isdisjoint(self.pending[future]):
            self.retries.append(len(self.pending))
        self.seen.update(self.pending[future])
        return future

    def wait(self, *_: Any, **__: Any) -> Any:
        """Finish one chunk, or let a worker die of trial 2."""
        if self.deaths and any(2 in chunk for chunk in self.pending.values()):
            self.deaths -= 1
            for future in self.pending:
                future.set_exception(BrokenProcessPool())
        else:
            future = next(iter(self.pending))
            rows = [
                trials.Row(n, 0, n, 0, "", "", trials.Outcome("solved"), None, 0.0)
                for n in self.pending[future]
            ]
            del self.pending[future]
            future.set_result((rows, 0.0))
        return SimpleNamespace(done=[future])

    def shutdown(self, **_: Any) -> None:
        self.pending.clear()


@pytest.mark.parametrize(("deaths", "failed"), [(0, []), (1, []), (3, []), (4, [2])])
def test_trials_lost_with_a_worker_are_retried_one_by_one(
    plan_: plan.Plan, monkeypatch: pytest.MonkeyPatch, deaths: int, failed: list[int]
) -> None:
    """Four chunks of three trials. The first death counts for no trial, as others run; the next three for trial 2."""
    pool = FakePool(deaths)
    chunks = [(trials.Segment(0, {}, n, range(n, n + 3)),) for n in range(0, 12, 3)]
    queue = SimpleNamespace(
        next=lambda: chunks.pop(0) if chunks else (), report_time=lambda *_: None
    )
    monkeypatch.setattr(engines, "start_pool", lambda *_: pool)
    monkeypatch.setattr(engines, "wait", pool.wait)
    rows = [
        row
        for batch in engines.Pool(2).run(trials.TrialJob(plan_.spec), queue)
        for row in batch
    ]
    assert sorted(row.trial for row in rows) == list(range(12))
    assert [row.trial for row in rows if row.error is not None] == failed
    assert set(pool.retries) == ({1} if deaths else set())


class Run:
    """A pool's run in a separate process and process group, as started by a shell."""

    def __init__(self, plan_: plan.Plan, path: Path, workers: int) -> None:
        command = [sys.executable, "-c", DRIVER, str(plan_.path), str(path), str(workers)]
        self.process = subprocess.Popen(
            command,
            env=ENVIRONMENT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self.family: list[psutil.Process] = []

    def reach(self, count: int) -> bool:
        """Wait until this number of trials is in the store; return whether it was reached."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.family = (
                psutil.Process(self.process.pid).children(recursive=True) or self.family
            )
            if int(line) >= count:
                return True
        return False

    def end(self, by: signal.Signals) -> int:
        """Send a signal (to the group for SIGINT); return the status once the process and its children have ended."""
        os.killpg(self.process.pid, by) if by == signal.SIGINT else self.process.send_signal(
            by
        )
        status = self.process.wait(20)
        assert self.family, "it had no workers"
        _, orphans = psutil.wait_procs(self.family, timeout=5)
        # A container without an init keeps the dead of a dead parent.
        assert not [
            one
            for one in orphans
            if one.is_running() and one.status() != psutil.STATUS_ZOMBIE
        ]
        return status


@pytest.mark.long
@pytest.mark.parametrize("kills", [1, pytest.param(6, marks=pytest.mark.long)])
def test_a_pool_killed_at_any_instant_resumes_with_any_number_of_workers(
    plan_: plan.Plan, serial_contents: str, tmp_path: Path, kills: int
) -> None:
    path = tmp_path / "killed.sqlite"
    draw = np.random.default_rng(kills)
    before = 0
    for n in range(kills):
        run = Run(plan_, path, 2 + n % 2)
        assert run.reach(before + 1)
        time.sleep(draw.uniform(0, 0.02))
        assert run.end(signal.SIGKILL) in (-signal.SIGKILL, 0)
        with store.writing(path) as stored:
            assert stored.db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
            before = stored.counts()["done"]
        assert before > 0
        if before == plan_.trials:
            break
    assert done(plan_, path, engines.Pool(1), resume=True).done == plan_.trials
    assert contents(path) == serial_contents


@pytest.mark.long
def test_a_pool_interrupted_by_the_keyboard_resumes(
    plan_: plan.Plan, serial_contents: str, tmp_path: Path
) -> None:
    path = tmp_path / "interrupted.sqlite"
    run = Run(plan_, path, 2)
    assert run.reach(1)
    assert run.end(signal.SIGINT) != 0
    with store.open_store(path) as stored:
        (ended,) = stored.runs()
        assert 0 < ended["trials"] == stored.counts()["done"] < plan_.trials
    done(plan_, path, engines.Serial(), resume=True)
    assert contents(path) == serial_contents


@pytest.mark.long
def test_memory_stays_flat_over_many_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stubs: Any
) -> None:
    """100,000 trials of a pool: between a fifth and the end the coordinator grows by less than 20 MB."""
    monkeypatch.setattr(engines, "initialize_worker", stubs.begin_trivial)
    plan_ = study(tmp_path, STUDY.replace("150", "50000"))
    me = psutil.Process()
    seen = []
    done(
        plan_,
        tmp_path / "many.sqlite",
        engines.Pool(2),
        watch=lambda progress: seen.append((progress.done, me.memory_info().rss)),
    )
    counts, rss = np.array(seen).T
    assert counts[-1] == 100_000
    late = rss[counts >= 20_000]
    assert late.max() - late[0] < 20e6


# A Dask cluster.


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    yield from cluster_of(tmp_path_factory.mktemp("dask"), "--no-nanny", count=2)


def test_a_chunk_travels_as_text_and_comes_back_bit_for_bit() -> None:
    from skysim.experiments.study.execution import dask_engine

    settings = {
        "trial.noise_px": 0.1 + 0.2,
        "light.layout": {"kind": "boards", "lit": [3, 6]},
        "camera.focus": None,
    }
    chunk = (
        trials.Segment(3, settings, 41, range(7, 12)),
        trials.Segment(4, {}, 46, range(0, 1)),
    )
    assert dask_engine.decode_chunk(dask_engine.encode_chunk(chunk)) == chunk


@pytest.mark.long
def test_a_run_that_is_stopped_leaves_nothing_on_the_cluster(
    cluster: Cluster, plan_: plan.Plan
) -> None:
    engine = on_dask(cluster, 2)
    rows = engine.run(
        trials.TrialJob(plan_.spec),
        runner.ChunkQueue(plan_, plan_.points, np.arange(plan_.trials)),
    )
    assert next(rows)[0].error is None
    assert {len(state) for state in engine.client.run(recipes).values()} == {1}
    assert isinstance(rows, Generator)
    rows.close()
    assert engine.client.status == "closed"
    engine = on_dask(cluster, 2)
    for _ in range(100):
        if not engine.client.run_on_scheduler(tasks):
            break
        time.sleep(0.05)
    assert engine.client.run_on_scheduler(tasks) == 0
    assert {len(state) for state in engine.client.run(recipes).values()} == {0}
    engine.client.close()


def recipes() -> list[str]:
    """Names of the runs that a worker has received."""
    from skysim.experiments.study.execution import dask_engine

    return list(dask_engine.JOBS)


def tasks(dask_scheduler: Any) -> int:
    return len(dask_scheduler.tasks)


@pytest.mark.slow
def test_other_code_on_the_cluster_is_refused(cluster: Cluster) -> None:
    on_dask(cluster, 2).client.run(change_code, "0123456789abcdef")
    try:
        with pytest.raises(
            InputError,
            match=rf"has skysim 0123456789abcdef; allowed: {trials.code_version()}",
        ):
            dask(cluster.address)
    finally:
        from distributed import Client

        with Client(cluster.address, set_as_default=False) as client:
            client.run(change_code, trials.code_version())


def change_code(version: str) -> None:
    """Make a worker report another code version."""
    trials.code_version = lambda: version  # type: ignore[assignment]


@pytest.mark.long
def test_dask_gives_the_same_rows_after_losing_a_worker(
    cluster: Cluster, plan_: plan.Plan, serial_contents: str, tmp_path: Path
) -> None:
    engine = on_dask(cluster, 2)
    victims = cluster.workers[:1]
    path = tmp_path / "dask.sqlite"
    assert engine.workers >= 1

    def kill(progress: runner.Progress) -> None:
        if progress.now >= 30 and victims:
            victims.pop().kill()

    assert done(plan_, path, engine, watch=kill).done == plan_.trials
    assert not victims
    assert cluster.workers[0].wait(10) == -signal.SIGKILL
    assert contents(path) == serial_contents
    again = tmp_path / "again.sqlite"  # by the same engine, and by who is left
    done(plan_, again, engine)
    assert contents(again) == serial_contents


@pytest.mark.slow
@pytest.mark.parametrize(
    "scheduler",
    ["", "nonsense", "tcp://127.0.0.1", "tcp://127.0.0.1:99999", "foo://1.2.3.4:5"],
)
def test_an_invalid_address_is_refused_in_one_line(scheduler: str) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(
        InputError, match=r"scheduler: .*such as tcp://10\.0\.0\.1:8786"
    ) as refused:
        dask(scheduler)
    assert "\n" not in str(refused.value)


@pytest.mark.long
def test_an_address_that_does_not_answer_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    from skysim.experiments.study.execution import dask_engine

    monkeypatch.setattr(dask_engine, "WAIT_S", 0.3)
    with pytest.raises(InputError, match=r"no reply from tcp://127\.0\.0\.1:1 "):
        dask("tcp://127.0.0.1:1")


@pytest.mark.long
def test_without_the_extra_one_line_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(
        sys.modules, "skysim.experiments.study.execution.dask_engine", raising=False
    )
    monkeypatch.delattr(skysim.experiments.study.execution, "dask_engine", raising=False)
    with pytest.raises(InputError, match=r"pip install 'skysim\[dask\]'"):
        dask("tcp://127.0.0.1:8786")


@pytest.mark.long
def test_a_trial_that_kills_dask_workers_fails_and_no_other(
    plan_: plan.Plan, tmp_path: Path, stubs: Any
) -> None:
    bad = deaths(plan_)
    found = os.pathsep.join([str(ROOT), str(tmp_path)])
    dask = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0", "PYTHONPATH": found}
    for cluster in cluster_of(tmp_path, "--nworkers", "2", environment=dask):
        engine = on_dask(cluster, 2)
        path = tmp_path / "deadly.sqlite"
        engine.client.register_worker_callbacks(stubs.make_deadly)
        done(plan_, path, engine)
        with store.open_store(path) as stored:
            assert stored.failures() == [(n, "its worker process died, 3 times") for n in bad]
            assert stored.counts()["done"] == plan_.trials


@pytest.mark.long
def test_a_lost_scheduler_is_reported_and_received_rows_are_kept(
    plan_: plan.Plan, serial_contents: str, tmp_path: Path
) -> None:
    path = tmp_path / "lost.sqlite"
    for cluster in cluster_of(tmp_path, "--no-nanny"):
        engine = on_dask(cluster, 1)
        scheduler = psutil.Process(int(engine.client.run_on_scheduler(os.getpid)))

        def kill(progress: runner.Progress, scheduler: psutil.Process = scheduler) -> None:
            if progress.now >= 30 and scheduler.is_running():
                scheduler.kill()

        with pytest.raises(InputError, match=r"scheduler: connection lost"):
            done(plan_, path, engine, watch=kill)
    done(plan_, path, engines.Serial(), resume=True)
    assert contents(path) == serial_contents


@pytest.mark.long
def test_a_cluster_without_workers_is_reported_and_received_rows_are_kept(
    plan_: plan.Plan, serial_contents: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    from skysim.experiments.study.execution import dask_engine

    monkeypatch.setattr(dask_engine, "IDLE_S", 2.0)
    path = tmp_path / "alone.sqlite"
    for cluster in cluster_of(tmp_path, "--no-nanny"):
        engine = on_dask(cluster, 1)

        def kill(progress: runner.Progress, worker: Any = cluster.workers[0]) -> None:
            if progress.now >= 30:
                worker.kill()

        with pytest.raises(InputError, match=r"scheduler: no worker for 2 s, .* resume"):
            done(plan_, path, engine, watch=kill)
    done(plan_, path, engines.Serial(), resume=True)
    assert contents(path) == serial_contents


CTRL_C = """
import os, signal, time
from skysim.experiments.study.execution import workers

signal.signal(signal.SIGINT, lambda *_: None)
workers.start_fork_server()
time.sleep(0.4)
os.killpg(0, signal.SIGINT)
time.sleep(0.6)
"""


@pytest.mark.slow
def test_ctrl_c_during_the_imports_of_the_workers_prints_nothing_of_theirs() -> None:
    """A terminal sends it to every process of the command."""
    done_ = subprocess.run(
        [sys.executable, "-c", CTRL_C],
        capture_output=True,
        text=True,
        timeout=60,
        start_new_session=True,
        check=False,
    )
    assert (done_.returncode, done_.stderr) == (0, "")
