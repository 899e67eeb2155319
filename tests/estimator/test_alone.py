"""The estimator with only numpy, scipy, numba and OpenCV, in this checkout and as a separate package."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from skysim.core.paths import ROOT

ALLOWED = {"estimator", "numpy", "scipy", "numba", "llvmlite", "cv2"}
BLOCK = f"""
import sys
from importlib.abc import MetaPathFinder

class Only(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        first = name.partition(".")[0]
        if first not in {ALLOWED} and first not in sys.stdlib_module_names and not first.startswith("_"):
            raise ModuleNotFoundError(f"No module named {{name!r}}")

sys.meta_path.insert(0, Only())
"""
# Stars of a catalog that the user has, a frame of them, and the same answer from their places and from the frame.
WORK = """
import numpy as np

from estimator import Camera, Centroids, DomeTracker, ImageError, StarCatalog, StarTracker, TrackingMode
from estimator.trackers.pipeline import draw
from scipy.spatial.transform import Rotation

rng = np.random.default_rng(1)
ra_deg, dec_deg = rng.uniform(0, 360, 5000), np.degrees(np.arcsin(rng.uniform(-1, 1, 5000)))
stars = StarCatalog.from_radec(ra_deg, dec_deg, rng.uniform(0, 6, 5000))
camera = Camera.from_fov(640, 480, fov_deg=15)
tracker = StarTracker(camera, stars, stars.vectors)
truth = Rotation.random(rng=rng)
xy_px = camera.pixels(truth.apply(tracker.stars.vectors))
seen = np.flatnonzero(camera.contains(np.nan_to_num(xy_px, nan=-1e9), 3.0))
flux = 10 ** (-0.4 * tracker.stars.v_mag[seen])
image = draw(camera, xy_px[seen], 3000 * flux / flux.max() + 100, np.dtype("u2"))
for found in (
    tracker.solve_centroids(Centroids(xy_px[seen], np.full(len(seen), 0.1), flux)),
    tracker.solve(image).attitude,
    TrackingMode(tracker).solve(image, 0.0).attitude,
):
    assert found.solved, found.status
    assert (found.cam_from_ref * truth.inv()).magnitude() < 1e-3
try:
    StarTracker.for_sky(camera)
    print("with a date")
except ImageError as error:
    print(error)
assert len(StarCatalog.read(CATALOG)) > 7000
"""


def test_a_blocked_module_cannot_be_imported() -> None:
    for name in ("skysim", "astropy", "erfa", "lazy_loader"):
        done = subprocess.run(
            [sys.executable, "-c", f"{BLOCK}import {name}"], capture_output=True, text=True
        )
        assert f"No module named '{name}'" in done.stderr


@pytest.mark.slow
def test_estimator_solves_without_any_other_package() -> None:
    catalog = f"CATALOG = {str(ROOT / 'data/catalogs/hipparcos_hp6.5.ecsv')!r}"
    done = subprocess.run(
        [sys.executable, "-c", f"{BLOCK}{catalog}{WORK}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == (
        "a date needs pyerfa (pip install pyerfa); without it: StarTracker(camera, stars, vectors)"
    )


@pytest.mark.long
def test_the_estimator_wheel_solves_in_a_bare_environment(tmp_path: Path) -> None:
    """With only the dependencies installed by pip, then with the extra for dates."""
    wheels = tmp_path / "wheels"
    bare = tmp_path / "bare"
    here = tmp_path / "here"
    here.mkdir()
    quiet = ["-m", "pip", "--quiet", "--disable-pip-version-check"]
    source = ROOT / "estimator"
    subprocess.run(
        [sys.executable, *quiet, "wheel", "--no-deps", "-w", wheels, source], check=True
    )
    (wheel,) = wheels.glob("skysim_estimator-*.whl")
    subprocess.run([sys.executable, "-m", "venv", bare], check=True)
    python = bare / "bin/python"
    subprocess.run([python, *quiet, "install", wheel], check=True)
    catalog = "import pathlib, estimator; ROOT = pathlib.Path(estimator.__file__).parent\n"
    catalog += "CATALOG = ROOT / 'data/catalogs/hipparcos_hp6.5.ecsv'"
    clean = {
        name: value for name, value in os.environ.items() if not name.startswith("PYTHON")
    }

    def printed() -> str:
        done = subprocess.run(
            [python, "-c", f"{catalog}{WORK}"],
            cwd=here,
            env=clean,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    assert printed().startswith("a date needs pyerfa")
    subprocess.run([python, *quiet, "install", f"{wheel}[sky]"], check=True)
    assert printed() == "with a date"
