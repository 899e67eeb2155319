"""Before the tests: remove outdated machine code, and compile what most tests need in two processes at once."""

from __future__ import annotations

import ast
import gc
import math
import shutil
import signal
import tempfile
import time
from collections.abc import Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import pytest

pytest.register_assert_rewrite("tests.helpers")
from tests.helpers import compilation  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]


def pytest_configure(config: pytest.Config) -> None:
    """Remove numba's cached code of a module that is older than the module, or than any that it imports.

    Numba notices a change in the file where a cached function stands, but not in the functions and constants that
    it took from other files: stale machine code answers wrongly, or crashes where a tuple's fields have moved. The
    two packages do not call each other's compiled code. Workers of xdist start after their controller has cleaned.
    """
    # Collected tests are a million objects, which each search for garbage would go through: an eighth of all time.
    gc.set_threshold(100_000)
    # A shell's background job ignores Ctrl-C, and so would all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(config, "workerinput"):
        return
    for package in (ROOT / "skysim", ROOT / "estimator"):
        changed_s = {path: path.stat().st_mtime for path in package.rglob("*.py")}
        caches = {
            path: path.stat().st_mtime for path in package.rglob("__pycache__/*.nb[ic]")
        }
        if min(caches.values(), default=math.inf) >= max(changed_s.values()):
            continue
        uses = {path: imported(path, changed_s.keys()) for path in changed_s}
        for path, compiled_s in caches.items():
            source = path.parents[1] / f"{path.name.partition('.')[0]}.py"
            if compiled_s < max(changed_s[one] for one in with_imports(source, uses)):
                path.unlink(missing_ok=True)  # another run of the tests may be quicker


def imported(path: Path, files: Collection[Path]) -> set[Path]:
    """The files among `files` whose names a file's compiled functions can use: those that its top level imports."""
    names = set()
    for node in ast.parse(path.read_bytes()).body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    stems = (ROOT / name.replace(".", "/") for name in names)
    return {
        one
        for stem in stems
        for one in (stem.with_suffix(".py"), stem / "__init__.py")
        if one in files
    }


def with_imports(source: Path, uses: Mapping[Path, set[Path]]) -> set[Path]:
    """A file and all that it imports, directly or not; every file if it is no longer there."""
    if source not in uses:
        return set(uses)
    found = {source}
    new = uses[source]
    while new := new - found:
        found |= new
        new = set().union(*(uses[path] for path in new))
    return found


COMPILED = pytest.StashKey[tuple[Path, Future[None]]]()
LAST_COMPILED = "estimator/identification/__pycache__/star_quads.identify-*.nbi"  # which `make demo` leaves out


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config) -> None:
    """Fill numba's cache, if it is empty or the demo's, while the workers of xdist collect.

    Each of them would compile everything. `make compile` does it before.
    """
    if config.args == config.getini("testpaths") and not any(ROOT.glob(LAST_COMPILED)):
        folder = Path(tempfile.mkdtemp())
        pool = ThreadPoolExecutor()
        compiled = pool.submit(compilation.main, ["--basic"])
        compiled.add_done_callback(lambda _: (folder / "done").touch())
        config.stash[COMPILED] = folder, compiled


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Give a worker of xdist the file that marks the end of the compilation."""
    if COMPILED in node.config.stash:
        node.workerinput["compiled"] = str(node.config.stash[COMPILED][0] / "done")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Keep the tests out of searches for garbage, and let a worker wait for the compilation before its first test."""
    gc.freeze()
    done = getattr(session.config, "workerinput", {}).get("compiled")
    while done and not Path(done).exists():
        time.sleep(0.1)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove files of the compilation and raise its error, if any."""
    if COMPILED in config.stash:
        folder, compiled = config.stash[COMPILED]
        wait([compiled])
        shutil.rmtree(folder, ignore_errors=True)
        compiled.result()
