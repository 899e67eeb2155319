"""Compilation in a second process reaches the end of identification; the order of loading changes nothing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from skysim.core.paths import ROOT, SCENES
from skysim.scene import loader
from skysim.simulation.compilation import identify_spots
from skysim.simulation.lab import build_lab, build_tracker

# Too few or too regular LEDs for an attitude.
SYMMETRIC = {"afit_test1", "afit_test2", "afit_test3"}
CODED = {"coded_spiral"}  # a frame alone does not name its LEDs
NAMES = (
    {path.stem.removesuffix("_ideal") for path in SCENES.glob("*.yaml")} - SYMMETRIC - CODED
)
# Prints the modules of all functions that numba compiles for a module that runs as a command.
MODULES = """
import json, runpy, sys
from numba.core import event
found = set()
class Modules(event.Listener):
    def on_start(self, compilation):
        found.add(compilation.data["dispatcher"].py_func.__module__)
    def on_end(self, _):
        pass
event.register("numba:compile", Modules())
try:
    runpy.run_module(sys.argv.pop(1), run_name="__main__")
finally:
    json.dump(sorted(found), open("modules.json", "w"))
"""
# Prints light, centroids and attitude. With a second argument functions with fastmath are loaded from numba's cache
# before those that call them.
FLY = """
import sys
from skysim.scene import loader
from skysim.simulation.flight import open_flight

if sys.argv[2:]:
    parts = [part for name, part in sorted(sys.modules.items()) if name.startswith(("skysim.", "estimator."))]
    kernels = {one for part in parts for one in vars(part).values() if hasattr(one, "py_func")}
    kernels = {one for one in kernels if one.targetoptions["fastmath"]}
    for kernel in kernels:
        for signature, *_ in kernel._cache._cache_file._load_index():
            kernel.compile(signature)
    assert sum(len(kernel.signatures) for kernel in kernels) > 5
(shot,) = open_flight(loader.load(sys.argv[1], {"exposure.frames": "1"})).shots()
attitude = shot.solution.attitude
print(shot.truth.sources.electrons.tobytes().hex(), shot.frame.image_dn.sum())
print(shot.solution.centroids.xy_px.tobytes().hex(), attitude.cam_from_ref.as_quat().tobytes().hex())
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(NAMES))
def test_the_spots_are_identified(name: str) -> None:
    """If they were refused, the last steps would be left to be compiled in the first process."""
    lab = build_lab(loader.load(name))
    attitude = identify_spots(lab.camera, lab.start, build_tracker(lab.camera))
    assert attitude.status == "solved"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["afit_simsat", "shefex2"])
def test_a_frame_does_not_depend_on_the_functions_that_are_loaded_first(name: str) -> None:
    """A function is compiled again into each that calls it, and the copy that is loaded first serves all.

    The copies are optimized once and twice, so they must round alike.
    """
    plain, first = (
        subprocess.run(
            [sys.executable, "-c", FLY, name, *words], capture_output=True, text=True
        )
        for words in ([], ["first"])
    )
    assert not plain.returncode, plain.stderr
    assert first.stdout == plain.stdout, first.stderr


RENDER = ("skysim", "render", "shefex2", "--frames", "1", "--out", "frames")
IDENTIFY = ("skysim.simulation.compilation", "shefex2")


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(RENDER, marks=pytest.mark.slow),
        pytest.param(IDENTIFY, marks=pytest.mark.long),
    ],
    ids=["render", "identify"],
)
def test_stars_compile_neither_ellipses_nor_text(
    tmp_path: Path, words: tuple[str, ...]
) -> None:
    """The images of disks are a third of the renderer; numba's texts of errors take seconds (`a[i] = array`)."""
    cache = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", MODULES, *words]
    subprocess.run(command, cwd=tmp_path, env=cache, check=True, capture_output=True)
    compiled = json.loads((tmp_path / "modules.json").read_text())
    assert ("skysim.camera.psf.splat" in compiled) == (words == RENDER)
    assert ("estimator.identification.star_search" in compiled) == (words == IDENTIFY)
    assert "skysim.camera.psf.ellipse" not in compiled
    assert "numba.cpython.unicode" not in compiled
