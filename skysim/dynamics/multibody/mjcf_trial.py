"""Script for `core.guarded`: read and compile an MJCF file, to see whether MuJoCo survives it.

It fails if memory runs out or the model is too large. It ignores any other error of MuJoCo: the caller gets the same
error and reports it. After such an error it compiles again without joints, since the caller may lock the joints that
MuJoCo rejects.
"""

import sys
from contextlib import suppress
from typing import Any

import mujoco

ERRORS = (ValueError, mujoco.FatalError)
# Occlusion takes a time proportional to the square of ngeom, inertia to the square of nv.
MAX_ELEMENTS = {"nbody": 2000, "ngeom": 2000, "nv": 1000}


def run_trial(path: str) -> None:
    """Read and compile the file at path.

    Raises MemoryError, or RuntimeError after a failed allocation in MuJoCo, and SystemExit for a large model.
    """
    try:
        spec = mujoco.MjSpec.from_file(path)
    except ERRORS:
        return
    # If it does not compile, the caller reports it, or compiles it without some joints.
    try:
        check_model(spec.compile())
    except ERRORS:
        with suppress(*ERRORS):
            for element in [*spec.keys, *spec.joints]:
                spec.delete(element)
            check_model(spec.compile())


def check_model(model: Any) -> None:
    """Exit with a message if the model is too large; else compute its forward dynamics once."""
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
