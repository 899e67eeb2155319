"""`skysim new`: what it writes is valid, commented and runs as it is; nothing is overwritten."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import skysim
from skysim.apps.cli.commands.resources import KINDS
from skysim.apps.cli.examples import EXAMPLES
from skysim.apps.cli.main import app
from skysim.core.errors import InputError
from skysim.scene import loader


def begin(kind: str, folder: Path, name: str = "mine") -> str:
    """Run `skysim new` and return what it prints."""
    done = CliRunner().invoke(
        app, ["new", kind, name, "--out", str(folder)], catch_exceptions=False
    )
    assert done.exit_code == 0
    return done.output


def test_the_kinds_are_those_that_the_help_promises() -> None:
    assert {"dome", "sky", "vehicle", "camera", "study"} <= set(KINDS)


@pytest.mark.parametrize("kind", ["dome", "sky", "vehicle"])
def test_a_new_scene_is_valid_and_named(kind: str, tmp_path: Path) -> None:
    begin(kind, tmp_path)
    scene = loader.load(str(tmp_path / "mine.yaml"))
    assert scene.name == "mine"
    assert "NAME" not in (tmp_path / "mine.yaml").read_text()


def test_the_new_vehicle_hangs_a_little_below_its_bearing(tmp_path: Path) -> None:
    """A center of mass above the bearing would fall over, one far below would need more torque than the wheels have."""
    begin("vehicle", tmp_path)
    lab = skysim.build_lab(skysim.load_scene(str(tmp_path / "mine.yaml")))
    x_m, y_m, z_m = lab.vehicle.mass.center_m
    assert (x_m, y_m) == pytest.approx((0, 0), abs=1e-9)
    assert -50e-6 < z_m < 0


def test_a_new_camera_is_a_preset(tmp_path: Path) -> None:
    begin("camera", tmp_path)
    begin("sky", tmp_path, "night")
    scene = loader.load(str(tmp_path / "night.yaml"), {"camera": "{preset: mine.yaml}"})
    assert (scene.camera.width_px, scene.camera.height_px) == (1936, 1216)


def test_the_uses_name_the_file_and_existing_commands(tmp_path: Path) -> None:
    for kind in KINDS:
        uses = [
            line.split()
            for line in begin(kind, tmp_path / kind).splitlines()
            if line.startswith("  skysim")
        ]
        assert uses
        for _, command, *_ in uses:
            assert command in EXAMPLES


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    begin("vehicle", tmp_path)
    (tmp_path / "mine.xml").write_text("my work")
    (tmp_path / "mine.yaml").unlink()
    with pytest.raises(InputError, match=r"mine\.xml: exists; choose another name"):
        begin("vehicle", tmp_path)
    assert (tmp_path / "mine.xml").read_text() == "my work"
    assert not (tmp_path / "mine.yaml").exists()


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("dom", "mine", "unknown kind 'dom'; allowed: camera, "),
        ("dome", "my/dome", "NAME: 'my/dome' is no name; allowed: a letter"),
    ],
)
def test_a_wrong_kind_or_name_is_one_line(kind: str, name: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        begin(kind, Path(), name)
    assert str(caught.value).startswith(message)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dome", "sky", "vehicle"])
def test_a_new_scene_runs_and_every_frame_is_right(kind: str, tmp_path: Path) -> None:
    begin(kind, tmp_path)
    run = skysim.simulate(
        skysim.load_scene(str(tmp_path / "mine.yaml"), {"exposure.frames": 3})
    )
    assert [step.attitude.status for step in run] == ["solved"] * 3
    assert max(step.error_arcsec for step in run) < 600


@pytest.mark.slow
def test_a_new_study_runs(tmp_path: Path) -> None:
    begin("study", tmp_path)
    result = skysim.run_study(
        tmp_path / "mine.yaml", {"replicates": 1}, out=tmp_path / "out", workers=1
    )
    assert len(result.trials()) == 8


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scoreboard", "afit_simsat_ideal"])
def test_a_new_tracker_solves_stars_and_leds(name: str, tmp_path: Path) -> None:
    begin("tracker", tmp_path)
    programs = {"mine": f"{sys.executable} {tmp_path / 'mine.py'}"}
    changes = {"exposure.frames": 2, "tracker.name": "mine", "tracker.time_limit": "3 min"}
    scene = skysim.load_scene(name, changes)
    run = skysim.simulate(scene, programs=programs)
    assert [step.attitude.status for step in run] == ["solved"] * 2
    assert all(np.isfinite(step.row.nees) for step in run)
    assert max(step.error_arcsec for step in run) < 600


@pytest.mark.slow
def test_a_new_controller_points_the_vehicle(tmp_path: Path) -> None:
    begin("controller", tmp_path)
    programs = {"mine": f"{sys.executable} {tmp_path / 'mine.py'}"}
    scene = skysim.load_scene("simsat_slew", {"exposure.frames": 2})
    log = skysim.simulate(scene, controller="mine", programs=programs).telemetry
    off_rad = (log.lab_from_ref.inv() * log.lab_from_body).magnitude().max()
    assert np.degrees(off_rad) < 1
