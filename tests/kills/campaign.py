"""Commands that are killed at random moments, and the law that they go on to the same results.

The state of a results folder is a mapping: one entry for each file, without what a clock decides, and one for each row
of a store. After a kill the state is a part of that of an undisturbed run: no file is half-written and no row wrong.
At the end, after the command was resumed, or run again where it has no resume, both states are equal, and no temporary
file and no process is left.
"""

from __future__ import annotations

import io
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil  # type: ignore[import-untyped]
from astropy.table import Table

from tests.helpers.clusters import ENVIRONMENT, Cluster, cluster_of

SKYSIM = [sys.executable, "-m", "skysim"]
FAKETIME = Path(
    "/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1"
)  # of Debian's package faketime
LIMIT_S = 900.0  # of a command
ORPHANS_S = 20.0  # time for the processes of a killed command to end

STUDY = """
schema: 1
title: strays
scene: shefex2
seed: 1
set: {light.limit_mag: 5.0}
trial: {kind: centroids, lights: 15}
factors: {strays: {key: trial.false_lights, values: [0, 5]}}
replicates: 60
responses: [identified]
"""
OTHER_VERSION = """
from skysim.experiments.study.execution import setups
setups.code_version = lambda: "0123456789abcdef"
"""
State = dict[str, Any]
KEPT = {
    "PYTHONDONTWRITEBYTECODE": ""
}  # bytecode is kept: hundreds of processes would compile the sources again
TROUBLES = ("full disk", "read only", "clock set back")


class Job(NamedTuple):
    """A command: its words without --out, those that resume it, whom to kill, and its share of the kills."""

    name: str
    words: tuple[str, ...]
    again: tuple[str, ...]
    victims: tuple[str, ...]
    share: int
    on_dask: bool = False


SMALL = ("--set", "light.limit_mag=5")
RUN = ("run", "shefex2", "--frames", "5", *SMALL)
EXPORT = (
    "export",
    "flown",
    *(f"--to={one}" for one in ("aem", "ecsv", "parquet", "tiff", "zarr", "video")),
)
DATASET = ("dataset", "shefex2", "--frames", "12", "--shard-frames", "1", *SMALL)
DATASET += tuple(f"--to={one}" for one in ("webdataset", "coco", "zarr"))
DATASHEET = (
    "datasheet",
    "shefex2",
    "--quick",
    "--fields",
    "10",
    "--rates",
    "0,1",
    "--workers",
    "2",
)
BALANCE = ("balance", "cubesat_table", "--estimate-only", "--longer", "0.2")
SURVEY = ("survey", "afit_simsat", "--frames", "10", "--checks", "2")
POOL = ("--workers", "2")
OF_POOL = ("command", "worker", "group", "worker", "command", "server")
OF_DASK = ("dask worker", "scheduler", "other version", "command")
# Sixty kills in all.
JOBS = (
    Job("run", RUN, RUN, ("command",), 7),
    Job(
        "study, pool",
        ("study", "run", "strays.yaml", *POOL),
        ("study", "resume", "strays.yaml", *POOL),
        OF_POOL,
        11,
    ),
    Job(
        "study, dask",
        ("study", "run", "strays.yaml"),
        ("study", "resume", "strays.yaml"),
        OF_DASK,
        9,
        True,
    ),
    Job("dataset, pool", (*DATASET, *POOL), (*DATASET, *POOL), OF_POOL, 7),
    Job("dataset, dask", DATASET, DATASET, OF_DASK, 5, True),
    Job("datasheet", DATASHEET, DATASHEET, OF_POOL, 7),
    Job("balance", BALANCE, BALANCE, ("command",), 4),
    Job("survey", SURVEY, SURVEY, ("command",), 4),
    Job("export", EXPORT, EXPORT, ("command",), 6),
)


# States.


def state(folder: Path) -> State:
    """The files and rows in a folder. Files that are hidden are temporary ones."""
    found: State = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file() and not any(
            part.startswith(".") for part in path.relative_to(folder).parts
        ):
            if path.suffix == ".sqlite":
                found |= rows_of(path, name)
            elif not re.search(r"\.(lock|(lock|sqlite)-(wal|shm|journal))$", name):
                found[name] = content(path)
    return found


def content(path: Path) -> Any:
    """What a file holds, without dates and times of computation, so that equal runs have equal contents."""
    data = path.read_bytes()
    try:
        if path.suffix == ".html":
            return data.rstrip().endswith(b"</html>")
        if path.suffix == ".json":
            return without_times(json.loads(data))
        if path.name.startswith("solutions") and path.suffix in (".ecsv", ".parquet"):
            return without_clock(path)
    except Exception as error:
        return f"{path}: half-written: {error}"
    return re.sub(rb"CREATION_DATE = \S+", b"", data) if path.suffix == ".aem" else data


def without_times(tree: Any) -> Any:
    """A tree of JSON without the keys of computation times."""
    if isinstance(tree, dict):
        return {
            key: without_times(one)
            for key, one in tree.items()
            if not key.endswith("_ms") and key not in ("timing", "times_s")  # of a datasheet
        }
    return [without_times(one) for one in tree] if isinstance(tree, list) else tree


def without_clock(path: Path) -> str:
    """A table of solutions as text, without the tracker's computation times."""
    if path.suffix == ".parquet":
        import pyarrow.parquet

        columns = pyarrow.parquet.read_table(path).to_pydict()
    else:
        table = Table.read(path, format="ascii.ecsv")
        columns = {name: list(table[name]) for name in table.colnames}
    return repr(
        {name: column for name, column in columns.items() if not name.endswith("_ms")}
    )


def rows_of(path: Path, name: str) -> State:
    """Points and trials of a store, row for row."""
    found: State = {}
    with closing(sqlite3.connect(path)) as db:
        whole = db.execute("PRAGMA integrity_check").fetchone()[0]
        if whole != "ok":
            return {name: whole}
        for table in ("points", "trials"):
            with suppress(sqlite3.OperationalError):  # killed before it had tables
                for row in db.execute(f"SELECT * FROM {table}"):
                    found[f"{name} {table} {row[0]}"] = repr(row)
    return found


def differences(found: State, whole: State, is_end: bool) -> list[str]:
    """Where a state is no part of the whole one, or at the end not equal to it."""
    wrong = [f"{name}: differs" for name in found if found[name] != whole.get(name)]
    missing = [f"{name}: missing" for name in whole if name not in found] if is_end else []
    return wrong + missing


def temporary_files(folder: Path) -> list[str]:
    """Names of hidden and partial files."""
    return [
        str(one.relative_to(folder))
        for one in folder.rglob("*")
        if one.name.startswith(".") or one.name.endswith(".partial")
    ]


# Processes.


class Running:
    """A command in a session of its own, as a shell would start it."""

    def __init__(
        self, words: tuple[str, ...], folder: Path, environment: dict[str, str] | None = None
    ) -> None:
        self.began_s = time.monotonic()
        self.errors = io.TextIOWrapper((folder / "errors.txt").open("w+b"))
        self.process = subprocess.Popen(
            [*SKYSIM, *words, "--out", "out"],
            cwd=folder,
            env=ENVIRONMENT | KEPT | (environment or {}),
            stdout=subprocess.DEVNULL,
            stderr=self.errors,
            start_new_session=True,
        )

    def family(self) -> list[psutil.Process]:
        """The processes of its session, which outlive it too."""
        found = []
        for one in psutil.process_iter():
            with suppress(psutil.Error, ProcessLookupError):
                if (
                    os.getsid(one.pid) == self.process.pid
                    and one.status() != psutil.STATUS_ZOMBIE
                ):
                    found.append(one)
        return found

    def servants(self, kind: str) -> list[psutil.Process]:
        """Its fork server (`server`), or the processes that this has forked (`worker`)."""
        found = []
        for one in self.family():
            with suppress(psutil.Error):
                is_server = "forkserver" in " ".join(one.cmdline())
                is_child = is_server and one.ppid() != self.process.pid
                if is_server and is_child == (kind == "worker"):
                    found.append(one)
        return found

    def end(self) -> tuple[int, str]:
        """Wait for the end of it and of all its processes; return code and standard error."""
        code = self.process.wait(LIMIT_S)
        until_s = time.monotonic() + ORPHANS_S
        while self.family() and time.monotonic() < until_s:
            time.sleep(0.1)
        orphans = [" ".join(one.cmdline())[:80] for one in self.family()]
        for one in self.family():
            one.kill()
        self.errors.seek(0)
        text = self.errors.read()
        self.errors.close()
        return code, text + "".join(f"\norphan: {one}" for one in orphans)


def complaints(code: int, errors: str, allowed: tuple[int, ...]) -> list[str]:
    """What a command must not do: end with another code, print a traceback, leave processes."""
    found = [f"code {code}"] if code not in allowed else []
    found += [
        line
        for line in errors.splitlines()
        if re.match("Traceback|orphan|Exception ignored", line)
    ]
    return [*found, *errors.strip().splitlines()[-1:]] if found else []


# The campaign.


class Result:
    """Counts and findings of a job."""

    def __init__(self) -> None:
        self.kills = 0
        self.by_victim: dict[str, int] = {}
        self.identical = 0
        self.findings: list[str] = []


class Trouble(NamedTuple):
    """What a command said, and what was wrong."""

    line: str
    findings: list[str]


@contextmanager
def mounted(place: Path, size_kib: int) -> Iterator[None]:
    """A file system of this size in a folder, which is made."""
    place.mkdir()
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size_kib}k", "tmpfs", place], check=True
    )
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", place], check=True)


def remount(place: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", place], check=True)


class Campaign:
    """Kills of the jobs in folders of their own, from a seed."""

    def __init__(self, place: Path, seed: int, say: Callable[[str], None] = print) -> None:
        self.place = place
        self.say = say
        self.rng = np.random.default_rng(seed)
        self.wholes: dict[tuple[str, ...], tuple[State, float]] = {}
        self.whole_folders: dict[tuple[str, ...], Path] = {}
        self.folders = 0

    def folder(self) -> Path:
        """A new folder with what the commands need."""
        self.folders += 1
        made = self.place / str(self.folders)
        made.mkdir(parents=True)
        (made / "strays.yaml").write_text(STUDY)
        (made / "other.py").write_text(OTHER_VERSION)
        return made

    def flown(self) -> Path:
        """A finished run, for the exports; one for all, since it has the tracker's times."""
        made = self.place / "flown"
        if not made.exists():
            words = [*SKYSIM, *RUN, "--out", str(made)]
            subprocess.run(words, env=ENVIRONMENT, check=True, capture_output=True)
        return made

    def words(self, words: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(str(self.flown()) if one == "flown" else one for one in words)

    def whole(self, job: Job) -> tuple[State, float]:
        """The state of an undisturbed run, and its time; a Dask cluster must give that of a pool."""
        words = self.words(job.words + (POOL if job.on_dask else ()))
        if words not in self.wholes:
            folder = self.folder()
            running = Running(words, folder)
            code, errors = running.end()
            took_s = time.monotonic() - running.began_s
            assert not complaints(code, errors, (0,)), errors
            self.wholes[words] = state(folder / "out"), took_s
            self.whole_folders[words] = folder / "out"
        return self.wholes[words]

    def run(self, job: Job, kills: int) -> Result:
        """Kill a job so many times, in chains of one to three, each of which is resumed to the end."""
        result = Result()
        whole, took_s = self.whole(job)
        late = 0
        while result.kills < kills:
            before = result.kills
            victim = job.victims[result.kills % len(job.victims)]
            length = min(int(self.rng.integers(1, 4)), kills - result.kills)
            with self.cluster(job) as cluster:
                folder = self.folder()
                for _ in range(length):
                    after_s = took_s * self.rng.uniform(0.02, 0.95) / (1 + late)
                    self.kill(job, folder, cluster, victim, after_s, result)
                    if victim not in ("command", "group", "worker"):
                        break  # the cluster is lost
                    victim = (
                        job.victims[result.kills % len(job.victims)]
                        if not job.on_dask
                        else victim
                    )
                found = self.finish(
                    job, folder, cluster if victim in ("command", "dask worker") else None
                )
            found += differences(state(folder / "out"), whole, is_end=True)
            found += temporary_files(folder / "out")
            hits = result.kills - before
            late = 0 if hits else late + 1
            if found:
                result.findings += [f"{folder.name} {victim}: {one}" for one in found[:5]]
            else:
                result.identical += hits
            self.say(
                f"{job.name}: {result.kills} of {kills} kills, {result.identical} identical, {found[:3]}"
            )
        return result

    def refused(self, job: Job, folder: Path, expected: str) -> tuple[str, list[str]]:
        """The line in which a command says that it cannot write, and what is wrong with it and what it left."""
        code, errors = Running(self.command(job, folder, None), folder).end()
        line = errors.strip().splitlines()[-1]
        found = complaints(code, errors, (2,))
        if not re.fullmatch(rf"skysim: .*{expected}.*", line) or len(line) > 400:
            found.append(f"said {line}")
        return line, found + differences(
            state(folder / "out"), self.whole(job)[0], is_end=False
        )

    def full_disk(self, job: Job) -> Trouble:
        """A disk with room for a part of the results; with more room the command goes on."""
        whole, _ = self.whole(job)
        folder = self.folder()
        out = folder / "out"
        size_kib = int(self.rng.uniform(0.2, 0.8) * self.bytes_of_whole(job)) >> 10
        with mounted(out, size_kib):
            line, found = self.refused(job, folder, "MB are free.*")
            found += temporary_files(out)
            remount(out, "size=2g")
            found += self.finish(job, folder, None)
            found += differences(state(out), whole, is_end=True)
        return Trouble(line.replace(str(folder), ""), found)

    def read_only(self, job: Job) -> Trouble:
        """A folder that became read-only after a part was done: that part is kept, and is gone on with."""
        whole, took_s = self.whole(job)
        folder = self.folder()
        out = folder / "out"
        with mounted(out, 1 << 20):
            running = Running(self.command(job, folder, None), folder)
            time.sleep(0.7 * took_s)
            with suppress(ProcessLookupError):
                os.killpg(running.process.pid, signal.SIGKILL)
            running.end()
            before = state(out)
            remount(out, "ro")
            line, found = self.refused(job, folder, "[Rr]ead-?only")
            found += [f"{name}: lost" for name in before if name not in state(out)]
            remount(out, "rw")
            found += self.finish(job, folder, None)
            found += differences(state(out), whole, is_end=True)
        return Trouble(line.replace(str(folder), ""), found)

    def clock_set_back(self, job: Job) -> Trouble:
        """A killed command goes on three days earlier, and meanwhile the clock is set back by another day."""
        whole, took_s = self.whole(job)
        folder = self.folder()
        running = Running(self.command(job, folder, None), folder)
        time.sleep(0.7 * took_s)
        with suppress(ProcessLookupError):
            os.killpg(running.process.pid, signal.SIGKILL)
        running.end()
        clock = folder / "clock"
        clock.write_text("-3d")
        environment = {
            "LD_PRELOAD": str(FAKETIME),
            "FAKETIME_TIMESTAMP_FILE": str(clock),
            "FAKETIME_NO_CACHE": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }
        running = Running(self.command(job, folder, None), folder, environment)
        time.sleep(0.3 * took_s)
        clock.write_text("-4d")
        found = complaints(*running.end(), (0,))
        found += differences(state(folder / "out"), whole, is_end=True)
        return Trouble("goes on", found)

    def bytes_of_whole(self, job: Job) -> int:
        """Size of the results of an undisturbed run."""
        folder = self.whole_folders[self.words(job.words)]
        return sum(one.stat().st_size for one in folder.rglob("*") if one.is_file())

    @contextmanager
    def cluster(self, job: Job) -> Iterator[Cluster | None]:
        """Two workers of Dask for a job on it."""
        if not job.on_dask:
            yield None
            return
        from distributed import Client

        folder = self.place / f"dask{self.folders}"
        folder.mkdir(parents=True)
        for cluster in cluster_of(folder, "--no-nanny", count=2):
            with Client(cluster.address, set_as_default=False, timeout=60) as client:
                client.wait_for_workers(2, 120)
            yield cluster

    def command(self, job: Job, folder: Path, cluster: Cluster | None) -> tuple[str, ...]:
        """The words that begin or resume a job in a folder."""
        rows = any(" trials " in name for name in state(folder / "out"))
        is_begun = rows or "study" not in job.words
        words = self.words(job.again if is_begun else job.words)
        if cluster:
            return (*words, "--engine", "dask", "--scheduler", cluster.address)
        return words + (POOL if job.on_dask else ())

    def kill(
        self,
        job: Job,
        folder: Path,
        cluster: Cluster | None,
        victim: str,
        after_s: float,
        result: Result,
    ) -> None:
        """Start or resume a job, kill a victim after a time, and judge what is left."""
        running = Running(self.command(job, folder, cluster), folder)
        if victim in ("worker", "server"):
            while running.process.poll() is None and not running.servants(victim):
                time.sleep(0.02)
            after_s /= 3  # they run for a part of the time
        time.sleep(after_s)
        hit = running.process.poll() is None and self.strike(running, victim, cluster, folder)
        if hit:
            result.kills += 1
            result.by_victim[victim] = result.by_victim.get(victim, 0) + 1
        code, errors = running.end()
        allowed = (-signal.SIGKILL,) if hit and victim in ("command", "group") else (0, 2)
        found = complaints(code, errors, allowed)
        found += differences(state(folder / "out"), self.whole(job)[0], is_end=False)
        result.findings += [
            f"{folder.name} {victim} after {after_s:.1f} s: {one}" for one in found[:5]
        ]

    def strike(
        self, running: Running, victim: str, cluster: Cluster | None, folder: Path
    ) -> bool:
        """Kill the victim; whether there was one."""
        if victim == "command":
            running.process.kill()
        elif victim == "group":
            os.killpg(running.process.pid, signal.SIGKILL)
        elif victim in ("worker", "server"):
            found = running.servants(victim)
            if not found:
                return False
            found[int(self.rng.integers(len(found)))].kill()
        elif victim == "dask worker":
            assert cluster
            cluster.workers.pop().kill()
        elif victim == "scheduler":
            assert cluster
            scheduler(cluster).kill()
        else:
            assert cluster
            command = [
                sys.executable,
                "-m",
                "distributed.cli.dask_worker",
                cluster.address,
                "--no-nanny",
            ]
            command += [
                "--host",
                "127.0.0.1",
                "--no-dashboard",
                "--nthreads",
                "1",
                "--preload",
                "other.py",
            ]
            quiet: dict[str, Any] = {
                "stdout": subprocess.DEVNULL,
                "stderr": subprocess.DEVNULL,
            }
            cluster.workers.append(
                subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, **quiet)
            )
            time.sleep(4)  # it joins
            for one in cluster.workers[:2]:
                one.kill()
        return True

    def finish(self, job: Job, folder: Path, cluster: Cluster | None) -> list[str]:
        """Resume a job to its end, and return what is wrong."""
        if cluster and not any(one.poll() is None for one in cluster.workers):
            cluster = None
        running = Running(self.command(job, folder, cluster), folder)
        return complaints(*running.end(), (0,))


def scheduler(cluster: Cluster) -> psutil.Process:
    """The scheduler of a cluster that this process has started."""
    port = cluster.address.rpartition(":")[2]
    for one in psutil.Process().children():
        words = one.cmdline() if one.is_running() else []
        if "distributed.cli.dask_scheduler" in words and port in words:
            return one
    raise LookupError(cluster.address)
