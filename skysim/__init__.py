"""A star tracker's laboratory in software: simulate, render, solve, score.

run = skysim.simulate(skysim.load_scene("shefex2", {"exposure.frames": 3}))
run[0].image, run[0].truth, run[0].attitude, run[0].error_arcsec
"""

import os
from typing import TYPE_CHECKING

import lazy_loader

from skysim.core import __version__ as __version__

# Idle threads of compiled loops sleep: on a busy machine spinning threads take the core that the others wait for, and
# a frame takes three times as long (measured). Read when the first loop runs.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# Loaded on first use, so that `import skysim` is quick.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "apps.plate_solver": ["solve"],
        "core.errors": ["InputError"],
        "experiments.study.api": ["run_study"],
        "results.run": ["render", "render_at", "simulate"],
        "scene.loader": ["list_scenes", "load_scene"],
        "scene.scene": ["Scene"],
        "simulation.flight": ["open_flight"],
        "simulation.lab": ["build_lab"],
    },
)

if TYPE_CHECKING:
    from skysim.apps.plate_solver import solve as solve
    from skysim.core.errors import InputError as InputError
    from skysim.experiments.study.api import run_study as run_study
    from skysim.results.run import render as render
    from skysim.results.run import render_at as render_at
    from skysim.results.run import simulate as simulate
    from skysim.scene.loader import list_scenes as list_scenes
    from skysim.scene.loader import load_scene as load_scene
    from skysim.scene.scene import Scene as Scene
    from skysim.simulation.flight import open_flight as open_flight
    from skysim.simulation.lab import build_lab as build_lab
