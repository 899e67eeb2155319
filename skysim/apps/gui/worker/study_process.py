"""Runs a study in its own process and reads its progress from its store: Monte Carlo of a scene, or a study file."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import yaml

from skysim.core import errors
from skysim.core.errors import InputError
from skysim.core.guarded import PYTHON
from skysim.experiments.study.api import run_study
from skysim.experiments.study.execution import store
from skysim.results import metrics

RESPONSES = {  # label on the page by response
    "identified": "identified",
    "wrong": "wrong",
    "refused": "refused",
    "cross_arcsec_rms": "cross rms, ″",
    "roll_arcsec_rms": "roll rms, ″",
    "cross_arcsec_mean": "cross mean, ″",
    "roll_arcsec_mean": "roll mean, ″",
    "angle_arcsec_mean": "angle mean, ″",
    "time_ms_median": "ms per trial",
}
BINS = 28
PAGE_STUDY = "monte_carlo_"  # prefix of the folders of Monte Carlo studies; the user follows
MAX_STUDIES = 4  # maximum number of studies of all pages at once
MAX_FAILED = 20  # maximum number of failed trials in the results


class StudyResults(NamedTuple):
    """Results of a study so far.

    Attributes
    ----------
    statistics
        (value, low, high) by response
    bins, counts
        Histogram of the error angle, arcsec
    failed
        (number, reason) of trials that raised, then of wrong ones, then of unsolved ones; the
        first MAX_FAILED
    """

    done: int
    statistics: dict[str, tuple[float, float, float]]
    bins: tuple[float, ...]
    counts: tuple[int, ...]
    failed: tuple[tuple[int, str], ...]


NO_RESULTS = StudyResults(0, {}, (), (), ())


def monte_carlo(
    scene: str, overrides: Mapping[str, str], trial: Mapping[str, Any], count: int, seed: int
) -> str:
    """YAML of a study with `count` random attitudes of a scene."""
    tree = {
        "schema": 1,
        "title": f"Monte Carlo of {Path(scene).stem}, {count} trials of {trial['kind']}",
        "scene": scene,
        "seed": seed,
        "set": {key: yaml.safe_load(value) for key, value in overrides.items()},
        "trial": dict(trial),
        "factors": {"tracker": {"levels": {"as_set": {}}}},
        "replicates": count,
        "responses": list(RESPONSES),
    }
    return yaml.safe_dump(tree, sort_keys=False)


class StudyProcess:
    """One study's process, which ends with its tab.

    Attributes
    ----------
    begun
        Processes of all tabs; ended ones are removed before another one begins
    """

    begun: ClassVar[set[StudyProcess]] = set()

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process: asyncio.subprocess.Process | None = None
        self.total = 0

    @property
    def running(self) -> bool:
        return self.process is not None and self.process.returncode is None

    async def start(self, study: Path) -> None:
        """Start the process, which continues the study in the folder's store; its stderr is kept for `wait`."""
        self.process = await asyncio.create_subprocess_exec(
            *PYTHON,
            "-m",
            "skysim.apps.gui.worker.study_process",
            str(study),
            str(self.folder),
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,
        )
        StudyProcess.begun.add(self)

    @classmethod
    def check_count(cls) -> None:
        """Raise InputError if MAX_STUDIES run already."""
        cls.begun = {process for process in cls.begun if process.running}
        if len(cls.begun) >= MAX_STUDIES:
            raise InputError(
                "",
                f"{MAX_STUDIES} of {MAX_STUDIES} studies are running; start again after one has ended",
            )

    async def wait(self) -> str:
        """Wait for the process; return the last line of its standard error if it failed, else ""."""
        if self.process is None:
            return ""
        _, stderr = await self.process.communicate()
        lines = stderr.decode(errors="replace").strip().splitlines()
        return lines[-1] if self.process.returncode and lines else ""

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """Interrupt the process as Ctrl-C does, or terminate it with SIGTERM; finished trials are kept."""
        if self.process and self.process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self.process.send_signal(how)

    def results(self) -> StudyResults | None:
        """Results in the store so far; None before the first trial is done."""
        path = self.folder / store.STORE
        if not path.is_file():
            return None
        try:
            with store.open_store(path) as stored:
                counts = stored.counts()
                columns = stored.columns(failed=False)
                raised = stored.failures()
        except InputError:
            return None
        if not counts["done"]:
            return None
        statistics = {name: metrics.response(name)(columns)[:3] for name in RESPONSES}
        error_arcsec = metrics.QUANTITIES["angle_arcsec"](columns)
        bins, heights = histogram(error_arcsec[np.isfinite(error_arcsec)])
        failed = (*raised, *unsolved(columns))[:MAX_FAILED]
        return StudyResults(counts["done"], statistics, bins, heights, failed)


def unsolved(columns: Mapping[str, Any]) -> list[tuple[int, str]]:
    """(number, reason) of trials with a wrong frame, then of those with an unsolved one."""
    wrong = columns["wrong"] > 0
    refused = (columns["solved"] < columns["frames"]) & ~wrong
    unsolved_trials = zip(
        columns["trial"][refused].tolist(), columns["status"][refused].tolist(), strict=True
    )
    return [
        *((trial, "wrong") for trial in columns["trial"][wrong].tolist()),
        *unsolved_trials,
    ]


def histogram(error_arcsec: Any) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Bin centers and counts with logarithmic bins, because errors range from arc-seconds to degrees."""
    if not len(error_arcsec):
        return (), ()
    low = max(float(error_arcsec.min()), 1e-3)
    high = max(float(error_arcsec.max()), 2e-3)
    edges = np.geomspace(low / 1.05, high * 1.05, BINS + 1)
    counts, _ = np.histogram(error_arcsec, edges)
    return tuple(np.sqrt(edges[1:] * edges[:-1]).tolist()), tuple(counts.tolist())


def run_and_report(study: Path, folder: Path) -> None:
    """Body of the process: run a study's missing trials and write its report. SIGTERM ends it as Ctrl-C does."""
    errors.handle_signals()
    try:
        run_study(study, out=folder, workers=1).report().save(folder / "report.html")
    except InputError as error:
        sys.exit(f"skysim: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


def is_shown(name: str, user: str) -> bool:
    """Whether a user may see a study: any except the Monte Carlo studies of other users of the page."""
    return not name.startswith(PAGE_STUDY) or name.startswith(f"{PAGE_STUDY}{user}_")


def finished(folder: Path, user: str) -> list[Path]:
    """Folders of the studies that have a report and are shown to a user, newest first."""
    folders = (path.parent for path in folder.glob("*/report.html"))
    shown = [
        path
        for path in folders
        if (path / store.STORE).is_file() and is_shown(path.name, user)
    ]
    return sorted(shown, key=lambda path: -(path / "report.html").stat().st_mtime)


if __name__ == "__main__":
    run_and_report(*map(Path, sys.argv[1:]))
