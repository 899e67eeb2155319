"""Before the tests: no machine code from before the last change."""

from __future__ import annotations

import contextlib
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
