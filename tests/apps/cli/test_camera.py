"""`skysim camera`: presets, a camera's field of view, and a new camera from a data sheet."""

from __future__ import annotations

import functools
import json
import math
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from skysim.scene import loader, opencv_calibration

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def camera(command: Command) -> Command:
    return functools.partial(command, "camera")


def line(done: subprocess.CompletedProcess[str], name: str) -> str:
    (found,) = [line for line in done.stdout.splitlines() if line.startswith(name)]
    return found.removeprefix(name).strip()


def test_the_presets_are_listed_with_size_and_shutter(camera: Command) -> None:
    listed = {entry["name"]: entry for entry in json.loads(camera("--json").stdout)}
    assert sorted(listed) == loader.list_cameras()
    assert listed["imx264"]["size"] == "2448 x 2048 px"
    assert (listed["imx477"]["shutter"], listed["imx174"]["shutter"]) == ("rolling", "global")
    assert "imx264      2448 x 2048 px  3.45 um  global" in camera().stdout


@pytest.mark.parametrize("words", [["shefex2"], ["show", "shefex2"]])
def test_a_camera_shows_its_field_and_the_angle_of_a_pixel(
    camera: Command, words: list[str]
) -> None:
    """Reference H1: 14.868 x 11.150 deg behind 25 mm, diagonal 18.51; 9.9 um / 25 mm are 81.68 arcsec."""
    done = camera(*words)
    assert line(done, "field of view") == "14.87° × 11.15°, diagonal 18.51°; 81.68″ a pixel"


def test_a_preset_is_shown_with_a_lens_and_without(camera: Command) -> None:
    assert (
        line(camera("imx264"), "field of view")
        == "no lens: add --set camera.focal_length='16 mm'"
    )
    shown = json.loads(
        camera("--json", "imx264", "--set", "camera.focal_length=16 mm").stdout
    )
    assert shown["field_deg"][0] == pytest.approx(
        2 * math.degrees(math.atan(2448 * 3.45e-6 / 2 / 0.016)), rel=1e-12
    )
    assert shown["arcsec_px"] == pytest.approx(
        math.degrees(3.45e-6 / 0.016) * 3600, rel=1e-12
    )


def test_a_calibration_is_written_and_shown(camera: Command, tmp_path: Path) -> None:
    path = tmp_path / "lens.yml"
    assert camera("--out", path, "shefex2").returncode == 0
    assert opencv_calibration.read(path) == loader.load("shefex2").camera.calibration()
    assert camera(path).stdout == camera("shefex2").stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nosuch"], "unknown camera 'nosuch'; allowed: aps, "),
        (
            ["imx264", "--out", "x.yml"],
            "--out x.yml: imx264 has no lens; allowed: --set camera.focal_length='16 mm'",
        ),
        (
            ["new", "--pixels", "9x9", "--out", "x.txt"],
            "--out x.txt: no .yaml file; allowed: a new .yaml file",
        ),
        (["new", "--pixels", "99x99"], "--pitch: missing; Pixel pitch"),
    ],
)
def test_wrong_camera_input_is_refused_in_one_line(
    camera: Command, words: list[str], message: str, tmp_path: Path
) -> None:
    done = camera(*words)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"skysim: {message}")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_set_has_no_effect_on_a_calibration(camera: Command, tmp_path: Path) -> None:
    path = tmp_path / "lens.yml"
    path.write_text(opencv_calibration.text(loader.load("shefex2").camera.calibration()))
    assert (
        "--set camera.f_number=2: has no effect"
        in camera(path, "--set", "camera.f_number=2").stderr
    )


def test_a_new_camera_from_options_names_what_is_not_stated(
    camera: Command, tmp_path: Path
) -> None:
    words = [
        "--pixels",
        "1936x1216",
        "--pitch",
        "5.86 um",
        "--focal-length",
        "25 mm",
        "--f-number",
        2,
    ]
    done = camera("new", *words, "--out", "my.yaml")
    assert done.stdout.startswith(
        "my.yaml: 1936 x 1216 px; 25.57° × 16.22°, diagonal 30.00°; 48.35″ a pixel\n"
    )
    assert line(done, "  full well").startswith(
        "30910 (900 e- a square micrometer, as in the IMX264): it is unknown"
    )
    assert (
        len(
            [
                row
                for row in done.stdout.splitlines()
                if row.startswith("  ") and row[2].isalpha()
            ]
        )
        == 11
    )
    scene = {"schema": 1, "base": "shefex2", "camera": {"preset": "my.yaml"}}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    assert loader.load(tmp_path / "scene.yaml").camera.focal_length_m == pytest.approx(
        0.025, rel=1e-12
    )
    again = camera("new", *words, "--out", "my.yaml")
    assert again.stderr == "skysim: --out my.yaml: exists; allowed: a new .yaml file\n"


def test_questions_are_asked_again_after_a_wrong_answer(
    camera: Command, tmp_path: Path
) -> None:
    """An empty answer to a required question counts as wrong; lens and row-time questions depend on answers."""
    answers = [
        "",
        "1936x1216",
        "5.86",
        "5.86 um",
        "",
        "",
        "",
        "12",
        "",
        "32513",
        "",
        "",
        "",
        "",
    ]
    done = camera("new", answers="\n".join(answers) + "\n")
    assert done.stderr.splitlines()[:2] == [
        "skysim: pixels: required",
        "skysim: --pitch: '5.86'; allowed: a length with its unit, such as \"5.86 um\"",
    ]
    assert "row-time" not in done.stdout
    assert "blur" not in done.stdout
    assert "where: EMVA 1288: saturation capacity\n  not stated: 30910 (900 e-" in done.stdout
    written = yaml.safe_load((tmp_path / "camera.yaml").read_text())["camera"]
    assert written["detector"]["full_well_e"] == 32513


def test_ending_the_questions_early_writes_no_file(camera: Command, tmp_path: Path) -> None:
    done = camera("new", answers="1936x1216\n")
    assert done.returncode == 130
    assert list(tmp_path.iterdir()) == []
