"""Compile the tracker in a second process while the first one compiles the renderer, which halves the time.

numba compiles one function at a time and keeps the result on disk, where every process finds it. The packages skysim
and estimator share no compiled function, so two processes can compile them at once:

1. `TrackerCompilation` starts the second process when the first function of skysim is compiled.
2. The second process, `python -m skysim.simulation.compilation SCENE [KEY=VALUE ...]`, builds the scene's tracker and
   solves a synthetic frame, which needs no renderer.
3. Before the first process compiles a function of estimator, it waits for the second one. Later functions then come
   from numba's cache.
"""

import gc
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
from numba.core import event
from scipy.spatial.transform import Rotation

from skysim.camera.detector import saturation_dn
from skysim.core.errors import InputError
from skysim.core.guarded import PYTHON
from skysim.core.random_streams import random_stream
from skysim.core.types import Frame
from skysim.core.yaml_reader import parse_overrides
from skysim.scene import loader
from skysim.simulation.lab import StarCamera, build_lab, build_tracker, exposure_window
from skysim.tracking import factory
from skysim.tracking.onboard_model import assumed_camera

# Wide enough for the smallest area of every shipped scene: without detections, no later stage would be compiled.
SPOT_SIGMA_PX = 2.0
NOISE_DN = 3.0
MAX_SPOTS = 50


class TrackerCompilation(event.Listener):
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
        elif self.process is not None and module.startswith("estimator."):
            self.process.wait()
            gc.unfreeze()

    def on_end(self, _: event.Event) -> None:
        """Required by the interface; does nothing."""


@contextmanager
def on_two_processes(scene: str, overrides: Mapping[str, str]) -> Iterator[None]:
    """Within this context, compile the scene's tracker in a second process if the renderer must be compiled."""
    listener = TrackerCompilation(
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


def warm_up(camera: StarCamera, lab_from_body: Rotation, tracker: factory.Estimator) -> None:
    """Solve a synthetic frame so that numba compiles before timing.

    External trackers are skipped: each frame must reach them once, in order.
    """
    if not isinstance(tracker, factory.UserTracker):
        factory.solve_frame(tracker, synthetic_frame(camera, lab_from_body))


def synthetic_frame(camera: StarCamera, lab_from_body: Rotation) -> Frame:
    """A frame at an attitude with equal Gaussian spots at the brightest LEDs or stars; it needs no renderer."""
    # 1. Pixel positions of the sources in front of the camera.
    assumed = assumed_camera(camera.scene)
    when = exposure_window(camera.scene, 0)
    place = camera.sources.place[np.argsort(camera.sources.magnitude, kind="stable")]
    vectors_cam = camera.mount.toward(place, lab_from_body)
    xy_px = assumed.pixels(vectors_cam[vectors_cam[:, 2] > 0])
    xy_px = xy_px[assumed.contains(xy_px)][:MAX_SPOTS]
    # 2. Background with noise, and the spots.
    full_dn = saturation_dn(camera.scene.camera.detector)
    image_dn = random_stream(0).normal(
        0.1 * full_dn, NOISE_DN, (assumed.height_px, assumed.width_px)
    )
    down, along = (
        np.exp(-(((at_px[:, None] - np.arange(size)) / SPOT_SIGMA_PX) ** 2) / 2)
        for at_px, size in zip(xy_px.T[::-1], image_dn.shape, strict=True)
    )
    image_dn += 0.5 * full_dn * down.T @ along
    image = np.clip(image_dn, 0, full_dn).astype(np.uint16)
    return Frame(0, image, when.open_s, when.exposure_s, full_dn)


if __name__ == "__main__":
    # Build a scene's tracker and solve a synthetic frame with it; external trackers are skipped.
    gc.disable()  # a short life: collecting the compiler's objects takes 6 % of it
    name, *texts = sys.argv[1:]
    try:
        lab = build_lab(loader.load(name, parse_overrides(texts)))
        warm_up(lab.camera, lab.start, build_tracker(lab.camera))
    except InputError as error:
        sys.exit(str(error))
