"""Run `skysim` in a forked process that has all imports and no state of an earlier command."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import runpy
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numba

ROOT = Path(__file__).resolve().parents[2]
CRASHED = 70  # exit code of a process that ends with a traceback


class Ran(NamedTuple):
    """Exit code of a process, the bytes that it printed, and its messages without paths of this machine."""

    code: int
    out: bytes
    err: str


def preload() -> None:
    """Import what commands import on first use: all of the package `skysim`, the command line, numba, matplotlib."""
    package = importlib.import_module("skysim")
    for name in package.__all__:
        getattr(package, name)
    for name in (
        "astropy.io.fits",
        "astropy.table",
        "astropy.io.ascii",
        "matplotlib.pyplot",
        "jinja2",
    ):
        importlib.import_module(name)
    numba.njit(
        lambda: 0
    )()  # numba's own tables; no thread is started, for a fork would lose it
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        command("--version")


def run(folder: Path, *words: str) -> Ran:
    """Run `skysim WORDS` in a folder. Raises RuntimeError if it crashes."""
    ran = forked(folder, lambda: command(*words))
    if ran.code == CRASHED:
        raise RuntimeError(f"skysim {' '.join(words)}\n{ran.err}")
    return ran


def succeed(folder: Path, *words: str) -> Ran:
    """Run `skysim WORDS` in a folder. Raises RuntimeError if its exit code is not 0."""
    ran = run(folder, *words)
    if ran.code:
        raise RuntimeError(f"skysim {' '.join(words)}: exit code {ran.code}: {ran.err}")
    return ran


def command(*words: str) -> None:
    """The same as `python -m skysim WORDS`, in this process."""
    sys.argv = ["skysim", *words]
    runpy.run_module("skysim", run_name="__main__", alter_sys=True)


def forked(folder: Path, action: Callable[[], object]) -> Ran:
    """Call a function in a forked process whose working directory is `folder`."""
    out = folder.with_suffix(".out")
    err = folder.with_suffix(".err")
    sys.stdout.flush()
    sys.stderr.flush()
    process = os.fork()
    if process == 0:
        for number, path in enumerate((Path(os.devnull), out, err)):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        os.chdir(folder)
        os._exit(exit_code(action))
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    ran = Ran(code, out.read_bytes(), err.read_text(encoding="utf-8"))
    out.unlink()
    err.unlink()
    return ran._replace(err=ran.err.replace(str(folder), "FOLDER").replace(str(ROOT), "ROOT"))


def exit_code(action: Callable[[], object]) -> int:
    """Call a function as the body of a process; a traceback is printed. Returns the exit code."""
    code = 0
    try:
        action()
    except SystemExit as left:
        code = int(left.code or 0)
    except BaseException:
        traceback.print_exc()
        code = CRASHED
    sys.stdout.flush()
    sys.stderr.flush()
    return code
