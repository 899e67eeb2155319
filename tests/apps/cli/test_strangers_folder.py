"""A stranger's folder runs no code: no process that a command starts imports a module from the working directory."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

SKYSIM = Path(sys.executable).with_name("skysim")
NAMES = {
    *sys.stdlib_module_names,
    "skysim",
    "estimator",
    "numpy",
    "mujoco",
    "glfw",
    "usercustomize",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene, a compressed picture, and modules that leave a mark when they are imported."""
    folder = tmp_path_factory.mktemp("stranger")
    marks = folder / "marks"
    marks.mkdir()
    for name in NAMES:
        code = f"import posix\nposix.mkdir({str(marks / name)!r})\n"
        (folder / f"{name}.py").write_text(code, encoding="utf-8")
    (folder / "s.yaml").write_text("schema: 1\nbase: afit_simsat\nexposure: {frames: 2}\n")
    (folder / "study.yaml").write_text(
        "schema: 1\ntitle: A study\nscene: shefex2\nseed: 1\ntrial: {kind: centroids, noise_px: 0.1}\n"
        "factors:\n  lights: {key: trial.lights, values: [8, 12]}\nreplicates: 3\nresponses: [identified]\n"
    )
    image = fits.CompImageHDU(np.full((64, 64), 100, np.int16))
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(folder / "photo.fits")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "validate s.yaml",
        "check s.yaml",
        "run s.yaml --frames 1 --out out_run --scene-3d",
        "study run study.yaml --out out_study --workers 2",
        "solve photo.fits --fov 10",
        "scenes export s.yaml --out s.xml",
        "live s.yaml --folder out_live --frames 1 --speed 0",
    ],
)
def test_a_command_imports_nothing_from_the_working_directory(
    folder: Path, command: str
) -> None:
    done = subprocess.run(
        [SKYSIM, *command.split()], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert "Traceback" not in done.stderr, done.stderr
    assert [path.name for path in (folder / "marks").iterdir()] == []


@pytest.mark.slow
def test_nor_does_the_page(folder: Path) -> None:
    """Its workers are forked from a process that sets a scene up."""
    words = [SKYSIM, "gui", "s.yaml", "--no-open", "--port", "18437"]
    # The library of the page does not start its server under pytest.
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("PYTEST")
    }
    with subprocess.Popen(words, cwd=folder, env=environment) as page:
        try:
            time.sleep(20)
            assert page.poll() is None
        finally:
            page.terminate()
        page.wait(30)
    assert [path.name for path in (folder / "marks").iterdir()] == []
