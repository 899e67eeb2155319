"""What floating-point results depend on besides the code: processor instructions and library versions."""

from __future__ import annotations

import platform
from importlib.metadata import version

import numpy as np

LIBRARIES = (
    "numpy",
    "scipy",
    "numba",
    "mujoco",
    "astropy",
    "pyerfa",
    "pydantic",
    "typer",
    "opencv-python-headless",
)


def machine() -> dict[str, str]:
    """Instruction sets that numpy found, and the versions of Python and of the libraries."""
    simd = np.show_config(mode="dicts")["SIMD Extensions"]  # type: ignore[call-overload]
    return {
        "processor": " ".join(
            [platform.machine(), *simd["baseline"], *simd.get("found", [])]
        ),
        "python": platform.python_version(),
        **{name: version(name) for name in LIBRARIES},
    }


def differences(recorded: dict[str, str]) -> list[str]:
    """One line for each value that differs from that of the recording machine."""
    return [
        f"recorded with {name} {recorded.get(name)}, here {value}"
        for name, value in machine().items()
        if recorded.get(name) != value
    ]
