"""Runs a study in its own process and reads its progress from its store: Monte Carlo of a scene, or a study file."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from skysim.core.errors import InputError
from skysim.experiments.study import store
from skysim.experiments.study.store import STORE
from skysim.results import metrics

RESPONSES = (
    "identified",
    "wrong",
    "refused",
    "cross_arcsec_rms",
    "roll_arcsec_rms",
    "angle_arcsec_mean",
    "time_ms_median",
)
BINS = 28
SHOWN = 20  # most failed trials in a tally


class Tally(NamedTuple):
    """Results of a study so far.

    figures : (value, low, high) by response;  bins, counts : histogram of the error angle, arcsec
    failed  : (number, reason) of trials that raised, then of wrong ones, then of unsolved ones; the first SHOWN
    """

    done: int
    wrong: int
    figures: dict[str, tuple[float, float, float]]
    bins: tuple[float, ...]
    counts: tuple[int, ...]
    failed: tuple[tuple[int, str], ...]


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


class Trials:
    """One study's process, which ends with its tab."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process: asyncio.subprocess.Process | None = None
        self.total = 0
        self.words = ""

    @property
    def running(self) -> bool:
        return self.process is not None and self.process.returncode is None

    async def begin(self, study: Path, verb: str = "run") -> None:
        """Start the process; its standard error is kept for `end`. verb : run or resume"""
        command = ["-m", "skysim", "study", verb, str(study), "--out", str(self.folder), "--workers", "1"]
        self.process = await asyncio.create_subprocess_exec(
            sys.executable,
            *command,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,
        )

    async def end(self) -> str:
        """Wait for the process; return the last line of its standard error if it failed, else ""."""
        if self.process is None:
            return ""
        _, told = await self.process.communicate()
        lines = told.decode(errors="replace").strip().splitlines()
        return lines[-1] if self.process.returncode and lines else ""

    def stop(self) -> None:
        """Interrupt the process as Ctrl-C does: finished trials are kept."""
        if self.process and self.process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self.process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """Terminate the process when its tab has closed."""
        if self.process and self.process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self.process.terminate()

    def tally(self) -> Tally | None:
        """Results in the store so far; None before the first trial is done."""
        path = self.folder / STORE
        if not path.is_file():
            return None
        try:
            with store.open_store(path) as kept:
                counts, columns, raised = kept.counts(), kept.columns("error IS NULL"), kept.failures()
        except InputError:
            return None
        if not counts["done"]:
            return None
        figures = {}
        for name in RESPONSES:
            told = metrics.response(name)(columns)
            figures[name] = (told.value, told.low, told.high)
        off = metrics.FIGURES["angle_arcsec"](columns)
        bins, heights = histogram(off[np.isfinite(off)])
        failed = (*raised, *unsolved(columns))[:SHOWN]
        return Tally(counts["done"], counts["wrong"], figures, bins, heights, failed)


def unsolved(columns: Mapping[str, Any]) -> list[tuple[int, str]]:
    """(number, reason) of trials with a wrong frame, then of those with an unsolved one."""
    wrong = columns["wrong"] > 0
    refused = (columns["solved"] < columns["frames"]) & ~wrong
    told = zip(columns["trial"][refused].tolist(), columns["status"][refused].tolist(), strict=True)
    return [*((trial, "wrong") for trial in columns["trial"][wrong].tolist()), *told]


def histogram(off_arcsec: Any) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Bin centers and counts with logarithmic bins, because errors range from arc-seconds to degrees."""
    if not len(off_arcsec):
        return (), ()
    low, high = max(float(off_arcsec.min()), 1e-3), max(float(off_arcsec.max()), 2e-3)
    edges = np.geomspace(low / 1.05, high * 1.05, BINS + 1)
    counts, _ = np.histogram(off_arcsec, edges)
    return tuple(np.sqrt(edges[1:] * edges[:-1]).tolist()), tuple(counts.tolist())


def finished(folder: Path) -> list[Path]:
    """Folders of the studies that have a report, the newest first."""
    found = [path.parent for path in folder.glob("*/report.html") if (path.parent / STORE).is_file()]
    return sorted(found, key=lambda path: -(path / "report.html").stat().st_mtime)
