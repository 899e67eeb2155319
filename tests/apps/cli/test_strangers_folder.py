"""A stranger's folder runs no code: no process that a command starts imports a module from the working directory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from tests.helpers.labpage import Server, come

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
    (folder / "s.yaml").write_text(
        "schema: 1\nbase: afit_simsat\nexposure: {frames: 2, first: 0.05 s}\n"
    )
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
def test_nor_does_the_page(folder: Path, tmp_path: Path) -> None:
    """Its workers are forked from a process that sets a scene up."""
    pytest.importorskip("nicegui", reason="the extra `gui` is not installed")
    with Server(tmp_path, program=[str(SKYSIM)], cwd=folder) as page:
        # The process from which the workers are forked is idle once it has imported what they need.
        assert page.come_to("gui.template", 1) == 1
        (template,) = page.children("gui.template")
        busy_s = 1.0
        assert come(
            lambda: template.cpu_times().user > busy_s and template.cpu_percent(busy_s) < 1
        )
        assert page.status() in (200, 401, 403)
    assert [path.name for path in (folder / "marks").iterdir()] == []
