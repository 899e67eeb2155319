"""Read and compile MJCF files; report MuJoCo's errors in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco

from skysim.core.errors import InputError
from skysim.core.io.guarded import run_guarded
from skysim.core.paths import SCENES
from skysim.dynamics.multibody.mjcf_sandbox import check_confined

TRIAL = Path(__file__).parent / "mjcf_trial.py"
TRIAL_CPU_S = 3
TRIAL_BYTES = 1 << 30


def load(path: Path) -> Any:
    """The MJCF file as an MjSpec."""
    if not path.is_file():
        raise InputError(
            path, "no such file; vehicle.model is a path relative to the scene or to scenes/"
        )
    check_confined(path)
    if fault := trial_fault(path, path.stat().st_mtime_ns):
        raise InputError(path, f"not a MuJoCo model that skysim reads: {fault}")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(path, f"not a MuJoCo model: {one_line(error)}") from error


@lru_cache(maxsize=64)
def trial_fault(path: Path, modified_ns: int) -> str:
    """Why MuJoCo does not survive the file, in one line; "" if it does. A shipped file needs no trial.

    modified_ns : so that a changed file is tried again
    """
    data = path.read_bytes()
    if any(data == shipped.read_bytes() for shipped in (SCENES / "vehicles").glob("*.xml")):
        return ""
    return run_guarded(TRIAL, str(path), cpu_s=TRIAL_CPU_S, memory_bytes=TRIAL_BYTES)


def compile_spec(spec: Any, path: Path) -> Any:
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(path, f"MuJoCo cannot compile it: {one_line(error)}") from error


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it would otherwise print and append to a file in the working folder."""
    caught: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(caught.append)
    try:
        yield caught
    finally:
        mujoco.set_mju_user_warning(before)


def one_line(error: Exception) -> str:
    return " ".join(str(error).split())
