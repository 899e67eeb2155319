"""A star tracker's laboratory in software: simulate, render, solve, score.

run = skysim.simulate(skysim.load_scene("shefex2", {"exposure.frames": 3}))
run[0].image, run[0].truth, run[0].attitude, run[0].error_arcsec
"""

import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skysim.apps.plate_solver import solve_image as solve
    from skysim.core.errors import InputError
    from skysim.experiments.study.api import run_study
    from skysim.results.run import render, simulate
    from skysim.scene.loader import list_scenes, load_scene
    from skysim.scene.scene import Scene

# Idle threads of compiled loops sleep: on a busy machine spinning threads take the core that the others wait for, and
# a frame takes three times as long (measured). Read when the first loop runs.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"
# The public names and where they are defined; loaded on first use (PEP 562), so that `import skysim` is quick.
_PUBLIC = {
    "InputError": ("core.errors", "InputError"),
    "Scene": ("scene.scene", "Scene"),
    "list_scenes": ("scene.loader", "list_scenes"),
    "load_scene": ("scene.loader", "load_scene"),
    "render": ("results.run", "render"),
    "run_study": ("experiments.study.api", "run_study"),
    "simulate": ("results.run", "simulate"),
    "solve": ("apps.plate_solver", "solve_image"),
}
__all__ = ["InputError", "Scene", "list_scenes", "load_scene", "render", "run_study", "simulate", "solve"]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    module, attribute = _PUBLIC[name]
    return getattr(import_module(f"{__name__}.{module}"), attribute)


def __dir__() -> list[str]:
    return sorted([*globals(), *_PUBLIC])
