"""A signal ends the computation wherever it arrives, and is never taken for a failure of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing import forkserver
from pathlib import Path

import numpy as np
import psutil
import pytest

from skysim.core import errors
from skysim.core.errors import InputError
from skysim.experiments.study.execution import engines, store, trials
from skysim.experiments.study.plan import TrialSpec

SKY = TrialSpec("shefex2", ".", 1, {}, {"kind": "centroids"}, True)
# Trials whose compiled kernel builds named tuples, as those of the trackers do; SIGTERM arrives while it runs.
DRIVER = """
import os, signal, sys, threading
from typing import NamedTuple
import numba
from skysim.core import errors
from skysim.experiments.study.execution import engines, trials
from skysim.experiments.study.plan import TrialSpec

class Sum(NamedTuple):
    value: float

@numba.njit(nogil=True)
def kernel(count):
    total = 0.0
    for n in range(count):
        total += n % 7
    return Sum(total), total

def trial(setup, seeds):
    for _ in range(100):
        kernel(30_000_000)

kernel(1)
trials.TRIALS["centroids"] = trial
job = trials.TrialJob(TrialSpec("shefex2", ".", 1, {}, {"kind": "centroids"}, True))
trials.prepared_setup(job.spec, {})
errors.handle_signals()
seen = []
for n in range(10):
    chunks = iter([(trials.Segment(0, {}, 0, range(1)),), ()])
    threading.Timer(0.05 + 0.007 * n, os.kill, (os.getpid(), signal.SIGTERM)).start()
    try:
        seen.append(engines.Serial().run(job, type("Chunks", (), {"next": lambda _: next(chunks)})()).__next__())
    except KeyboardInterrupt:
        seen.append("stopped")
print(seen)
"""


def lost(handler: Callable[[], object]) -> None:
    """Call a handler as numba's wrapper calls the constructor of a named tuple, then run on."""
    eval("lambda handler: handler()")(handler)
    for _ in range(3):
        time.sleep(0)
    raise AssertionError("it ran on")


def handle() -> None:
    """Run the handler as Python does for a signal that arrives here."""
    errors.interrupt(signal.SIGTERM, sys._getframe())


class Finalized:
    """An object whose finalizer gets a signal."""

    def __del__(self) -> None:
        handle()


def test_a_signal_is_raised_by_the_caller_of_a_function_that_would_lose_it() -> None:
    """Python drops exceptions of a finalizer, and numba crashes at those of a named tuple's constructor."""
    before = sys.gettrace()
    try:
        with pytest.raises(KeyboardInterrupt):
            handle()
        with pytest.raises(KeyboardInterrupt):
            lost(handle)
        with pytest.raises(KeyboardInterrupt):
            lost(Finalized)
    finally:
        sys.settrace(before)


def test_an_interrupt_in_another_exception_is_no_failed_trial(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without the handler, Ctrl-C in a kernel's wrapper arrives as SystemError."""

    def wrapped(*_: object) -> None:
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setitem(trials.TRIALS, "centroids", wrapped)
    with pytest.raises(KeyboardInterrupt):
        trials.run_block(SKY, trials.Segment(0, {}, 0, range(1)))


@pytest.mark.slow
def test_sigterm_in_a_compiled_kernel_is_no_failed_trial() -> None:
    done = subprocess.run(
        [sys.executable, "-c", DRIVER],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert done.stdout.strip() == str(["stopped"] * 10)
    assert done.stderr == ""


class Chunks:
    """Single trials, up to a number of them."""

    def __init__(self, most: int) -> None:
        self.left = iter(range(most))

    def next(self) -> engines.Chunk:
        number = next(self.left, None)
        return (
            ()
            if number is None
            else (trials.Segment(0, {}, number, range(number, number + 1)),)
        )

    def report_time(self, chunk: engines.Chunk, seconds: float) -> None:
        """Chunks have one size."""


@pytest.mark.slow
def test_sigterm_to_a_worker_in_a_kernel_is_no_failed_trial() -> None:
    """The worker dies; its trial is tried again by another."""
    engine = engines.Pool(2)
    killed = 0

    def kill_one() -> None:
        nonlocal killed
        for child in psutil.Process().children(recursive=True):
            if child.is_running() and child.cpu_times().user > 0 and not child.children():
                child.send_signal(signal.SIGTERM)
                killed += 1
                return

    rows = []
    for count, some in enumerate(engine.run(trials.TrialJob(SKY), Chunks(200))):
        if count == 20:
            threading.Timer(0.003, kill_one).start()
        rows += some
    engine.close()
    assert killed == 1
    assert sorted(row.trial for row in rows) == list(range(200))
    assert [row.error for row in rows if row.error] == []


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        ["study", "run", "false_stars", "--engine", "serial", "--out", "out"],
        ["study", "run", "rate_smear", "--workers", "2", "--out", "out"],
        ["datasheet", "shefex2", "--quick", "--out", "out"],
        ["dataset", "afit_simsat", "--frames", "5000", "--engine", "serial", "--out", "out"],
        ["run", "afit_simsat", "--frames", "5000", "--out", "out"],
    ],
    ids=["study serial", "study pool", "datasheet", "dataset", "run"],
)
def test_a_command_that_is_killed_ends_at_once(tmp_path: Path, words: list[str]) -> None:
    command = [sys.executable, "-m", "skysim", *words]
    for n in range(3):
        folder = tmp_path / str(n)
        folder.mkdir()
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=folder)
        until = time.monotonic() + 200
        while not list(folder.glob("out/*")):
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.02)
        time.sleep(3 + 0.37 * n)
        os.kill(process.pid, signal.SIGTERM)
        errors = process.communicate(timeout=60)[1]
        # Python turns the code into death by SIGINT if the interrupt came in the evaluation of a string.
        assert process.returncode in (130, -signal.SIGINT)
        assert "skysim: stopped" in errors.splitlines()
    for path in tmp_path.rglob("*.sqlite"):
        with store.open_store(path) as stored:
            assert stored.counts()["failed"] == 0


# Before main(), and at the start of workers.

SIGNALED = """
import os, signal, sys
from skysim.core import errors

number, module = sys.argv[1:]

class Finder:
    def find_spec(self, name, *_):
        if name == module:
            os.kill(os.getpid(), int(number))

sys.meta_path.insert(0, Finder())
signal.signal(signal.SIGINT, signal.default_int_handler)
from skysim.__main__ import main
sys.argv[1:] = ["--version"]
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    "module", ["typer", "estimator.core.errors", "skysim.apps.cli.commands.solve"]
)
def test_a_signal_during_the_imports_of_the_command_is_one_line(
    number: signal.Signals, module: str
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SIGNALED, str(int(number)), module],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "skysim: stopped\n")


def test_main_takes_signals_over_from_the_imports(monkeypatch: pytest.MonkeyPatch) -> None:
    before = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]
    try:
        for own, taken in ((signal.default_int_handler, True), (signal.SIG_IGN, False)):
            signal.signal(signal.SIGINT, own)
            for handler in (errors.stop, errors.interrupt):
                errors.handle_signals(handler)
                assert signal.getsignal(signal.SIGTERM) is handler
                assert signal.getsignal(signal.SIGINT) is (handler if taken else own)
    finally:
        signal.signal(signal.SIGINT, before[0])
        signal.signal(signal.SIGTERM, before[1])


@pytest.mark.long
@pytest.mark.parametrize("seed", range(6))
def test_processes_killed_at_the_start_of_a_pool_end_it_in_one_line_or_not_at_all(
    seed: int, tmp_path: Path
) -> None:
    """The fork server or a worker, at the moment at which it appears or up to a second later."""
    draw = np.random.default_rng(seed)
    after_s = draw.uniform(0, 1)
    killed = threading.Event()

    def kill_one() -> None:
        until_s = time.monotonic() + 60
        while time.monotonic() < until_s:
            found = [
                one
                for one in psutil.Process().children(recursive=True)
                if "forkserver" in " ".join(one.cmdline())
            ]
            if len(found) > seed % 2:
                time.sleep(after_s * (seed > 1))
                found[-1].kill()
                killed.set()
                return

    if forkserver._forkserver._forkserver_pid:
        forkserver._forkserver._stop()  # type: ignore[attr-defined]
    thread = threading.Thread(target=kill_one)
    thread.start()
    engine = engines.Pool(2)
    rows = []
    refused = ""
    try:
        for some in engine.run(trials.TrialJob(SKY), Chunks(40)):
            rows += some
    except InputError as error:
        refused = str(error)
    finally:
        thread.join()
        engine.close()
    if refused:
        assert (
            refused == "workers: 2 processes do not start; allowed: fewer, or engine serial"
        )
    else:
        assert sorted(row.trial for row in rows) == list(range(40))
        assert [row.error for row in rows if row.error] == []
    assert killed.is_set()
