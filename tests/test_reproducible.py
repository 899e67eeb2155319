"""Same seed and version give the same frames, truth and answers, in any process and after any compilation."""

from __future__ import annotations

import hashlib
import os
import re
import select
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
import pytest
from astropy.table import Table

import estimator.core.jit
import skysim.core.jit
from skysim.core.paths import ROOT

SCENES = ("afit_simsat", "shefex2", "simsat_bump")
# Seconds of wall clock stand in these, and in no other file.
TIMED = ("report.html", "solutions.ecsv")


def digests(folder: Path) -> dict[str, str]:
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.iterdir())
        if path.name not in TIMED
    }


def answers(folder: Path) -> list[str]:
    """Rows of the solutions with every digit, without computing times."""
    table = Table.read(folder / "solutions.ecsv", format="ascii.ecsv")
    table.remove_column("time_ms")
    return [str(tuple(row)) for row in table]


def made(scene: str, out: Path, **environment: str) -> Path:
    """Files of a run in a separate process."""
    folder = out / scene
    command = [
        sys.executable,
        "-m",
        "skysim",
        "run",
        scene,
        "--frames",
        "3",
        "--out",
        str(folder),
    ]
    subprocess.run(command, check=True, capture_output=True, env=os.environ | environment)
    return folder


@pytest.mark.parametrize("package", [estimator, skysim])
def test_a_loop_is_compiled_equally_for_any_first_caller(package: Any) -> None:
    """Compiler options of a caller (division errors, order of additions) do not change its callees."""

    @package.core.jit.jit(cache=False)
    def lost(small: float) -> tuple[float, float]:
        return (1 + small) - 1, 1 / (small - small)

    @numba.njit(error_model="python", fastmath={"reassoc", "nsz"})
    def caller(small: float) -> tuple[float, float]:
        return lost(small)

    assert caller(1e-30) == (0, np.inf)
    compiling = [
        path for path in Path(*package.__path__).rglob("*.py") if "njit" in path.read_text()
    ]
    assert compiling == [Path(package.core.jit.__file__)]


LOOPS = """
from skysim.core import errors
errors.running_as_command = {attended}
from skysim.core.jit import jit
@jit
def one(x): return x + 1
@jit
def two(x): return one(x) + 1
assert two(1) == 3 and two(1.0) == 3.0
"""


@pytest.mark.long
def test_a_command_announces_compilation_once_and_not_after_it(tmp_path: Path) -> None:
    """On a terminal: with cold and warm cache and as a package; never into a file."""
    said = []
    for name, attended, seen in (
        ("a", True, True),
        ("a", True, True),
        ("b", False, True),
        ("c", True, False),
    ):
        script = tmp_path / f"{name}.py"
        if not script.exists():
            script.write_text(LOOPS.format(attended=attended))
        ours, theirs = os.openpty()
        stderr = theirs if seen else subprocess.PIPE
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            [sys.executable, script], stderr=stderr, env=environment, check=True
        )
        os.write(theirs, b"end\n")
        output = done.stderr or b""
        while not output.endswith(b"end\r\n"):
            output += os.read(ours, 10_000)
        said.append(output.decode().replace("\r", ""))
        os.close(ours), os.close(theirs)
    assert re.fullmatch(r"skysim: compiling numba functions.*\nend\n", said[0])
    assert said[1:] == ["end\n"] * 3


@pytest.mark.slow
def test_the_first_rendered_picture_announces_compilation(tmp_path: Path) -> None:
    """Otherwise half a minute would pass without output. The test stops after the announcement."""
    cv2.imwrite(
        str(tmp_path / "x.png"), np.random.default_rng(0).integers(0, 99, (64, 80), np.uint8)
    )
    ours, theirs = os.openpty()
    words = [sys.executable, "-m", "skysim", "solve", "x.png", "--fov", "20"]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=theirs, env=environment, cwd=tmp_path
    ) as process:
        ready, _, _ = select.select([ours], [], [], 120)
        said = os.read(ours, 1000).decode() if ready else ""
        process.terminate()
    os.close(ours), os.close(theirs)
    assert said.startswith("skysim: compiling numba functions (once ")


@pytest.mark.long
def test_bytes_do_not_depend_on_threads_or_on_what_was_compiled_before(
    tmp_path: Path,
) -> None:
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    for scene in SCENES:
        cold = made(scene, tmp_path / "cold", **cache, NUMBA_NUM_THREADS="1")
        warm = made(scene, tmp_path / "warm", **cache, NUMBA_NUM_THREADS="1")
        two = made(
            scene, tmp_path / "two", **cache, NUMBA_NUM_THREADS="2", OPENBLAS_NUM_THREADS="2"
        )
        assert len(digests(cold)) > 9
        for other in (warm, two):
            assert digests(other) == digests(cold)
            assert answers(other) == answers(cold)
