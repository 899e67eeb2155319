"""Compile the identification in a second process while the first one compiles the rest, in three fifths of the time.

numba compiles one function at a time and keeps the result on disk, where every process finds it. Identification is
about half of all compiled code, so two processes can compile it and the rest at once:

1. `IdentificationCompilation` starts the second process when the first function of skysim is compiled.
2. The second process, `python -m skysim.simulation.compilation SCENE [KEY=VALUE ...]`, builds the scene's tracker and
   identifies lights at given pixels, which needs no frame.
3. The first process compiles the renderer, the detector and the centroider. Before it compiles a function of the
   identification, it waits for the second one. The functions that it calls then come from numba's cache.
"""

import gc
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
from numba.core import event
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, Centroids
from skysim.core.errors import InputError
from skysim.core.guarded import PYTHON
from skysim.core.yaml_reader import parse_overrides
from skysim.scene import loader
from skysim.simulation.lab import StarCamera, build_lab, build_tracker, exposure_window
from skysim.tracking import factory
from skysim.tracking.onboard_model import assumed_camera

MAX_SPOTS = 50
SIGMA_PX = 0.1
# Packages for which the first process waits
IDENTIFICATION = ("estimator.catalog", "estimator.identification", "estimator.trackers")


class IdentificationCompilation(event.Listener):
    """Listener to numba that starts the second process, and waits for it, as the module's docstring says."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self.command = [*PYTHON, "-m", __name__, *arguments]
        self.process: subprocess.Popen[bytes] | None = None

    def on_start(self, compilation: event.Event) -> None:
        """Called by numba before it compiles a function."""
        module = compilation.data["dispatcher"].py_func.__module__
        if self.process is None and module.startswith("skysim."):
            silent = subprocess.DEVNULL
            self.process = subprocess.Popen(
                self.command, stdin=silent, stdout=silent, stderr=silent
            )
            # The collector would go through all that is imported again and again.
            gc.freeze()
        elif self.process is not None and module.startswith(IDENTIFICATION):
            self.process.wait()

    def on_end(self, _: event.Event) -> None:
        """Required by the interface; does nothing."""


@contextmanager
def on_two_processes(scene: str, overrides: Mapping[str, str]) -> Iterator[None]:
    """Within this context, compile the identification in a second process if the renderer must be compiled."""
    listener = IdentificationCompilation(
        [scene, *(f"{key}={value}" for key, value in overrides.items())]
    )
    event.register("numba:compile", listener)
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)
        if listener.process is not None:
            listener.process.terminate()
            listener.process.wait()
            gc.unfreeze()


def identify_spots(
    camera: StarCamera, lab_from_body: Rotation, tracker: factory.Estimator
) -> Attitude:
    """The tracker's attitude from equal spots at the brightest LEDs or stars."""
    assumed = assumed_camera(camera.scene)
    place = camera.sources.place[np.argsort(camera.sources.magnitude, kind="stable")]
    vectors_cam = camera.mount.toward(place, lab_from_body)
    xy_px = assumed.pixels(vectors_cam[vectors_cam[:, 2] > 0])
    xy_px = xy_px[assumed.contains(xy_px)][:MAX_SPOTS]
    centroids = Centroids(xy_px, np.full(len(xy_px), SIGMA_PX), np.ones(len(xy_px)))
    exposure_s = exposure_window(camera.scene, 0).exposure_s
    return factory.solve_centroids(tracker, centroids, exposure_s)


if __name__ == "__main__":
    # Build a scene's tracker and identify spots with it; an external one has nothing to compile.
    gc.disable()  # a short life: collecting the compiler's objects takes 6 % of it
    name, *texts = sys.argv[1:]
    try:
        lab = build_lab(loader.load(name, parse_overrides(texts)))
        tracker = build_tracker(lab.camera)
        if not isinstance(tracker, factory.UserTracker):
            identify_spots(lab.camera, lab.start, tracker)
    except InputError as error:
        sys.exit(str(error))
