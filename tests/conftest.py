"""Before the tests: remove outdated machine code, and compile what most tests need in two processes at once."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

pytest.register_assert_rewrite("labpage", "laws")
ROOT = Path(__file__).resolve().parents[1]


def pytest_configure(config: pytest.Config) -> None:
    """Remove numba's cached code of a package that is older than any of the package's sources.

    Numba notices a change in the file where a cached function stands, but not in the functions and constants that
    it took from other files: stale machine code answers wrongly, or crashes where a tuple's fields have moved. The
    two packages do not call each other's compiled code. Workers of xdist start after their controller has cleaned.
    """
    if hasattr(config, "workerinput"):
        return
    for package in (ROOT / "skysim", ROOT / "estimator"):
        changed_s = max(path.stat().st_mtime for path in package.rglob("*.py"))
        for path in package.rglob("__pycache__/*.nb[ic]"):
            with contextlib.suppress(FileNotFoundError):  # another run of the tests was quicker
                if path.stat().st_mtime < changed_s:
                    path.unlink()


# Modules run as commands, one group per process: the trackers, and the renderer. They share no compiled function.
SCENES = ("shefex2", "afit_simsat")
GROUPS = (
    [["skysim.simulation.compilation", scene] for scene in SCENES],
    [["skysim", "render", scene, "--frames", "1", "--out", "{folder}"] for scene in SCENES],
)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config) -> None:
    """Fill numba's cache, if it is empty, before the workers of xdist start: each of them would compile everything."""
    if config.args != config.getini("testpaths") or any(ROOT.glob("estimator/*/__pycache__/*.nbi")):
        return
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as pool:
        list(pool.map(lambda group: [run_module(words, folder) for words in group], GROUPS))


def run_module(words: list[str], folder: str) -> None:
    """Run `python -m WORDS`; its output appears only if it fails."""
    command = [sys.executable, "-m", *(word.format(folder=folder) for word in words)]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
