"""Start-up: processor seconds of whole commands, with compiled code in the cache, and of one that compiles it."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from typing import Any

from benchmarks.timing import verdict

REPEATS = 3
# Greatest processor time of a first run, which compiles the renderer and the tracker, s.
FIRST_S = 45.0
# Command and greatest processor time, s.
COMMANDS = {
    "--help": 0.5,
    "scenes": 0.3,
    "validate shefex2": 1.0,
    "validate afit_simsat": 1.0,
    "check afit_simsat": 1.3,
    "solve frame_0000.png --fov 14.87": 1.0,
    "run afit_simsat --frames 1": 2.0,
    "run shefex2 --frames 1": 3.0,
}


def measure() -> list[dict[str, Any]]:
    """The commands in turn, in a folder with a rendered frame to solve."""
    with tempfile.TemporaryDirectory() as folder:
        skysim(["render", "shefex2", "--frames", "1", "--out", "."], folder)
        rows = [
            verdict(
                f"skysim {words}",
                least_s(words.split(), folder),
                "s",
                "user + system time",
                bar,
            )
            for words, bar in COMMANDS.items()
        ]
        first = skysim(
            ["run", "shefex2", "--frames", "1"], folder, NUMBA_CACHE_DIR=f"{folder}/empty"
        )
        what = "skysim run shefex2 --frames 1, nothing compiled"
        return [*rows, verdict(what, first, "s", "user + system time", FIRST_S)]


def least_s(words: list[str], folder: str) -> float:
    """The least processor time of some repeats; the first, which may compile, is not counted."""
    skysim(words, folder)
    return min(skysim(words, folder) for _ in range(REPEATS))


def skysim(words: list[str], folder: str, **environment: str) -> float:
    """Run a command; processor seconds of it and of its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-m", "skysim", *words],
        cwd=folder,
        env=os.environ | environment,
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
