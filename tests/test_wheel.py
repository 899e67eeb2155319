"""An installed package needs no checkout: it contains scenes and data."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.core.paths import ROOT


def test_the_version_option_prints_versions_for_a_bug_report() -> None:
    result = CliRunner().invoke(main.app, ["--version"])
    assert re.match(
        r"skysim \d+\.\d+\.\d+, MuJoCo \d+\.\d+\.\d+, numpy \d+\.\d+\.\d+, Python 3\.\d+\.\d+$",
        result.stdout,
    )


@pytest.mark.long
def test_a_wheel_runs_a_scene_outside_of_the_checkout(tmp_path: Path) -> None:
    wheels = tmp_path / "wheels"
    there = tmp_path / "installed"
    here = tmp_path / "here"
    here.mkdir()
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", wheels, ROOT], check=True)
    wheel = next(wheels.glob("skysim-*.whl"))
    scripts = {path.relative_to(ROOT).as_posix() for path in (ROOT / "skysim").rglob("*.js")}
    assert scripts
    assert scripts <= set(zipfile.ZipFile(wheel).namelist())  # of the page
    subprocess.run([*pip, "install", "--no-deps", "--target", there, wheel], check=True)
    environment = os.environ | {"PYTHONPATH": str(there)}

    def python(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, *words],
            cwd=here,
            env=environment,
            check=True,
            capture_output=True,
            text=True,
        )
        return done.stdout

    assert python("-c", "import skysim; print(skysim.__file__)").startswith(str(there))
    ran = python("-m", "skysim", "run", "afit_simsat", "--frames", "2")
    assert "2 of 2 frames solved, 0 wrong" in ran
    assert (here / "out/afit_simsat/report.html").is_file()
    assert "led_count" in python("-m", "skysim", "study")
    moon = (
        "light.bodies={}",
        "start_time=2012-06-24T21:00:00",
        "motion.start={ra_deg: 154.9, dec_deg: 4.8}",
    )
    checked = python(
        "-m", "skysim", "check", "shefex2", *(word for one in moon for word in ("--set", one))
    )
    assert "Moon" in checked  # by the ephemeris in data/ephemeris
