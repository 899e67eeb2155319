"""Script for `core.guarded`: read and compile an MJCF file, to see whether MuJoCo survives it.

It succeeds only if a model has been compiled and its dynamics computed within the limits. Any other end is a failure,
since an error of MuJoCo may mean that memory ran out here, where the caller has more.
"""

import sys
from typing import Any

import mujoco

ERRORS = (ValueError, mujoco.FatalError)
OUT_OF_MEMORY = (
    "ould not allocate"  # in MuJoCo's messages, such as "could not allocate mjData arena"
)
# Occlusion takes a time proportional to the square of ngeom, inertia to the square of nv. A vehicle keeps several
# models, each of nbuffer bytes.
MAX_ELEMENTS = {"nbody": 2000, "ngeom": 2000, "nv": 1000, "nbuffer": 1 << 28}


def run_trial(path: str) -> None:
    """Read and compile the file at path, without its joints if MuJoCo rejects them, since the caller may lock them.

    Raises an error of ERRORS, RuntimeError after a failed allocation in MuJoCo, and SystemExit for a large model.
    """
    spec = mujoco.MjSpec.from_file(path)
    try:
        model = spec.compile()
    except ERRORS as error:
        if OUT_OF_MEMORY in str(error):
            raise
        for element in [*spec.keys, *spec.joints]:
            spec.delete(element)
        model = spec.compile()
    check_model(model)


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
    except (RuntimeError, *ERRORS) as error:
        if isinstance(error, RuntimeError) or OUT_OF_MEMORY in str(error):
            raise MemoryError from None
        sys.exit(" ".join(str(error).split()))
