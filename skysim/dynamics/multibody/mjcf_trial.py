"""Script for `core.io.guarded`: read and compile an MJCF file, to see whether MuJoCo survives it.

It fails if memory runs out or the model is too large. Any other error of MuJoCo is left to the caller, who meets it
again and reports it. The compilation is then repeated without joints: the caller may lock those that MuJoCo rejects.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import Any

import mujoco

ERRORS = (ValueError, mujoco.FatalError)
MAX_ELEMENTS = {
    "nbody": 2000,
    "ngeom": 2000,
    "nv": 1000,
}  # occlusion takes the square of the geoms, inertia of nv


def run_trial(path: str) -> None:
    """Raises MemoryError, or RuntimeError, MuJoCo's for a failed allocation in C++; SystemExit for a large model."""
    try:
        spec = mujoco.MjSpec.from_file(path)
    except ERRORS:
        return
    try:
        check_model(spec.compile())
    except ERRORS:
        with suppress(*ERRORS):
            for element in [*spec.keys, *spec.joints]:
                spec.delete(element)
            check_model(spec.compile())


def check_model(model: Any) -> None:
    for name, limit in MAX_ELEMENTS.items():
        if (count := getattr(model, name)) > limit:
            sys.exit(f"it has {name} {count}; allowed: up to {limit}")
    mujoco.mj_forward(model, mujoco.MjData(model))


if __name__ == "__main__":
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        run_trial(sys.argv[1])
    except RuntimeError:
        raise MemoryError from None
