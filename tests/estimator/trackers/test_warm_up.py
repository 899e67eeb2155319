"""After the warm-up neither frames of any array layout nor centroids compile anything."""

from __future__ import annotations

import subprocess
import sys

import pytest

from skysim.core.paths import ROOT

COUNT = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from scipy.spatial.transform import Rotation
import estimator
from estimator import *
from estimator.trackers import pipeline

def compiled():
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("estimator")]
    kernels = {id(one): one for module in modules for one in vars(module).values() if isinstance(one, Dispatcher)}
    return {one.py_func.__qualname__: one.signatures for one in kernels.values() if one.signatures}

def disguises(image):
    locked = image.copy()
    locked.flags.writeable = False
    spread = np.empty((2 * len(image), 2 * image.shape[1]), image.dtype)[::2, ::2]
    spread[...] = image
    bytes_ = np.minimum(image, 255).astype("u1")
    return image, np.asfortranarray(image), image[::-1, ::-1], locked, spread, image.astype(">u2"), bytes_, bytes_ > 150
"""
STARS = """
camera = Camera.from_fov(659, 493, fov_deg=14.87)
tracker = StarTracker.for_sky(camera, settings=Settings(saturation=4095))
follower = TrackingMode(tracker)
follower.warm_up()
before, solved, followed = compiled(), 0, 0
for n, cam_from_ref in enumerate(Rotation.random(12, np.random.default_rng(5))):
    rows, xy_px = tracker.field_matcher.in_field(camera, cam_from_ref)
    light = 10 ** (-0.4 * tracker.stars.v_mag[rows])
    false_px = np.random.default_rng(n).uniform(0, 490, (n, 2))
    for streak_px in ((0.0, 0.0), (6.0, 3.0)):
        places = np.concatenate([xy_px, false_px])
        peaks = np.concatenate([3e3 * light / light.max(), np.full(n, 900.0)])
        for seen in disguises(pipeline.draw(camera, places, peaks, np.dtype("u2"), streak_px)):
            try:
                solved += tracker.solve(seen).attitude.solved
                report = follower.solve(seen, n / 10)
                followed += report.expected > 0
                follower.solve(seen, n / 10, Rotation.identity(), (6, 3))
            except ImageError:
                pass  # a part of a sky in few steps is empty
    xy_px, light = xy_px.astype(">f4"), light[::-1][::-1]
    lights = Centroids(np.asfortranarray(xy_px), np.full((len(light), 2), 0.1)[:, 0], light)
    solved += tracker.solve_centroids(lights).solved
assert solved > 80 and followed > 60, (solved, followed)
"""
DOME = """
import skysim
from skysim.scene import loader
from skysim.simulation.lab import build_lab, build_tracker

scene = loader.load("afit_simsat_ideal")
tracker = build_tracker(build_lab(scene).camera)
tracker.warm_up()
before, solved = compiled(), 0
for n in range(3):
    for seen in disguises(skysim.render(scene, index=n)[0].image_dn):
        try:
            solved += tracker.solve(seen).attitude.solved
            solved += tracker.solve(seen, (5, 3)).attitude.solved
        except ImageError:
            pass
assert solved > 15, solved
"""
PRINT_COUNTS = """
new = {name: len(kinds) - len(before.get(name, ())) for name, kinds in compiled().items()}
print(sorted(name for name, more in new.items() if more))
"""


@pytest.mark.slow
@pytest.mark.parametrize("work", [STARS, DOME], ids=["stars", "dome"])
def test_no_frame_compiles_anything_after_the_warm_up(work: str) -> None:
    """In a process of its own: other tests compile what a warm-up might leave out."""
    done = subprocess.run(
        [sys.executable, "-c", COUNT + work + PRINT_COUNTS],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
