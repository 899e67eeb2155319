"""The public names of skysim. `__init__.py` reads them from here, and loads each on first use."""

from .apps.plate_solver import solve as solve
from .core import __version__ as __version__
from .core.errors import InputError as InputError
from .experiments.study.api import run_study as run_study
from .results.run import render as render
from .results.run import render_at as render_at
from .results.run import simulate as simulate
from .scene.loader import list_scenes as list_scenes
from .scene.loader import load_scene as load_scene
from .scene.scene import Scene as Scene
from .simulation.flight import open_flight as open_flight
from .simulation.lab import build_lab as build_lab
