"""A survey from images on disk of a dome that differs from its list, with faults; and refusals."""

from __future__ import annotations

import contextlib
import io as std_io
import json
import re
import shutil
import sys
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from astropy.table import Table
from scipy.spatial.transform import Rotation

from skysim.apps.cli import main
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.experiments.dome_survey import (
    survey_frames,
    survey_procedure,
)
from skysim.scene import loader
from skysim.simulation.lab import Lab, build_lab

DEAD = 44
FAR = 20
SWAPPED = (31, 57)
FAR_M = 0.03
FOCAL_RATIO = 1.004
LEVER_M = (0.003, -0.002, 0.378)
STOPS = 30
TILT_DEG = 12.0
SCENE = """
schema: 1
base: afit_simsat_ideal
title: a small dome from a list
light:
  layout: {{kind: listed, cap_deg: 25, file: {leds}}}
  led: {{intensity: "0.8 mcd", disk_diameter: "4 mm"}}
camera: {{width_px: 640, height_px: 480, pixel: "10.5 um", focal_length: "{focal_mm} mm"}}
tracker: {{min_area_px: 9{lever}}}
"""


def command(*words: object) -> tuple[int, str, str]:
    """Exit code, standard output and error output."""
    out = std_io.StringIO()
    err = std_io.StringIO()
    argv = sys.argv
    sys.argv = ["skysim", *map(str, words)]
    try:
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            pytest.raises(SystemExit) as left,
        ):
            main.main()
    finally:
        sys.argv = argv
    return int(left.value.code or 0), out.getvalue(), err.getvalue()


def write_leds(path: Path, ids: list[int], place_m: Floats, level: Floats) -> None:
    rows = [
        f"{n},{x:.6f},{y:.6f},{z:.6f},{one:.3f}"
        for n, (x, y, z), one in zip(ids, place_m, level, strict=True)
    ]
    path.write_text("\n".join(["id,x_m,y_m,z_m,level", *rows, ""]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`design.yaml` with the assumed dome, and `built.yaml` with the true one."""
    made = tmp_path_factory.mktemp("dome")
    text = (
        "schema: 1\nbase: afit_simsat_ideal\ntitle: places\nlight:\n"
        '  layout: {kind: poisson_disk, cap_deg: 17, spacing: "38 mm", hardware_seed: 3}\n'
    )
    (made / "places.yaml").write_text(text)
    place_m = build_lab(loader.load(made / "places.yaml")).camera.sources.place[:, :3]
    rng = np.random.default_rng(1)
    count = len(place_m)
    level = np.array([1.0, 0.6, 0.36])[rng.integers(0, 3, count)]
    level[list(SWAPPED)] = [1.0, 0.36]
    write_leds(made / "design.csv", list(range(count)), place_m, level)
    built_m = place_m + rng.normal(0, 0.001, place_m.shape)
    across = np.cross(place_m[FAR], [0.3, 0.5, 0.1])
    built_m[FAR] += FAR_M * across / np.linalg.norm(across)
    level[list(SWAPPED)] = [0.36, 1.0]
    left = [n for n in range(count) if n != DEAD]
    write_leds(made / "built.csv", left, built_m[left], level[left])
    lever = ", assumed_camera_body: [3 mm, -2 mm, 378 mm]"
    (made / "design.yaml").write_text(
        SCENE.format(leds="design.csv", focal_mm=18.0, lever=lever)
    )
    (made / "built.yaml").write_text(
        SCENE.format(leds="built.csv", focal_mm=18.0 * FOCAL_RATIO, lever="")
    )
    return made


@pytest.fixture(scope="module")
def built(folder: Path) -> Lab:
    return build_lab(loader.load(folder / "built.yaml"))


@pytest.fixture(scope="module")
def frames(folder: Path, built: Lab) -> Path:
    """The images of a survey of the built dome, and the attitudes of its IMU."""
    uncertainty = survey_frames.survey_uncertainty("0.3 deg", "1 mm", "3 mm", "1%")
    lab = build_lab(survey_frames.as_listed(loader.load(folder / "design.yaml")))
    assumed = survey_frames.prior_of(
        lab,
        survey_frames.calibration_prior(lab).camera,
        survey_frames.calibration_prior(lab).leds,
    )._replace(uncertainty=uncertainty)
    model = survey_frames.survey_model(assumed, 0.02)
    held = survey_frames.planned_stops(built.scene, model, 8.0, STOPS, TILT_DEG)
    for _ in survey_procedure.simulated_frames(built, uncertainty, held, folder / "frames"):
        pass
    return folder / "frames"


def surveyed(folder: Path, frames: Path, out: str) -> dict[str, Any]:
    words = [
        "survey",
        folder / "design.yaml",
        "--images",
        frames,
        "--camera",
        folder / "design.yaml",
        "--led-sigma",
    ]
    words += [
        "1 mm",
        "--imu-sigma",
        "0.3 deg",
        "--tilt",
        TILT_DEG,
        "--out",
        folder / out,
        "--json",
    ]
    code, printed, err = command(*words)
    assert (code, err) == (0, "")
    return json.loads(printed)


@pytest.fixture(scope="module")
def result(folder: Path, frames: Path) -> dict[str, Any]:
    return surveyed(folder, frames, "by_imu")


@pytest.mark.slow
def test_a_folder_of_images_alone_gives_the_dome_as_built(
    result: dict[str, Any], folder: Path, built: Lab
) -> None:
    """Against the truth: places, focal length and lever are within their errors and better than the list."""
    found = Table.read(folder / "by_imu" / "leds.ecsv", format="ascii.ecsv")
    assert len(found) > 0.7 * len(built.camera.sources)
    row = np.searchsorted(built.camera.sources.id, found["id"])
    error_m = (
        np.column_stack([found[f"{axis}_m"] for axis in "xyz"])
        - built.camera.sources.place[row, :3]
    )
    rms_m = np.sqrt(np.mean(error_m**2))
    claimed_m = np.sqrt(np.mean(np.array(found["sigma_m"]) ** 2))
    assert rms_m < 0.0005  # the list: 1 mm
    assert (
        claimed_m / 2 < rms_m < 2 * claimed_m
    )  # errors that all LEDs share do not average out
    values = {line["what"]: line for line in result["values"]}
    truth = {"focal length px": built.scene.camera.focal_px}
    truth |= {
        f"lever {axis} mm": 1e3 * one
        for axis, one in zip("xyz", built.camera.mount.camera_body_m, strict=True)
    }
    for what, value in truth.items():
        line = values[what]
        assert abs(line["found"] - value) < 4.5 * line["sigma"], line
        assert abs(line["found"] - value) < abs(line["believed"] - value), line


@pytest.mark.slow
def test_exactly_the_injected_faults_are_named(result: dict[str, Any]) -> None:
    faults = result["faults"]
    assert faults["dark"] == [DEAD]
    assert list(faults["displaced"]) == [str(FAR)]
    # And its error of 1 mm about each axis.
    assert faults["displaced"][str(FAR)] == pytest.approx(FAR_M, abs=0.005)
    assert {(led, shows) for led, shows, _ in faults["exchanged"]} == {SWAPPED, SWAPPED[::-1]}
    assert faults["unlisted"] == []
    assert faults["list_sigma_m"] == pytest.approx(0.001, rel=0.3)


@pytest.mark.slow
def test_coverage_and_next_attitudes_are_in_the_result(
    result: dict[str, Any], folder: Path
) -> None:
    coverage = result["coverage"]
    assert (
        coverage["measured"]
        == result["surveyed"]
        == sum(one["measured"] for one in coverage["by_led"])
    )
    assert len(result["next"]) == 12
    assert result["next_reaches"]["measured"] >= result["surveyed"]
    assert max(one["tilt_deg"] for one in result["next"]) <= TILT_DEG
    assert (folder / "by_imu" / "survey.png").stat().st_size > 20_000
    assert json.loads((folder / "by_imu" / "survey.json").read_text())["coverage"] == coverage


@pytest.mark.slow
def test_the_report_has_the_numbers_and_the_faults_with_places(
    result: dict[str, Any], folder: Path
) -> None:
    page = (folder / "by_imu" / "report.html").read_text()
    assert result["report"] == str(folder / "by_imu" / "report.html")
    assert f"{result['surveyed']} of {result['leds']} LEDs measured" in page
    assert re.search(rf">{DEAD}</td><td[^>]*>dark</td>", page)
    place_mm = ", ".join(f"{1e3 * one:.1f}" for one in result["faults"]["found_m"][str(FAR)])
    assert re.search(rf">{FAR}</td><td[^>]*>displaced</td>", page)
    assert f"({place_mm}) mm" in page
    assert page.count(">exchanged</td>") == 2
    assert page.count('src="data:image/png;base64,') == 2
    coverage = page[page.index("<h2>Coverage and next attitudes") : page.index("<h2>Faults")]
    assert coverage.count("<tr><td") == len(result["next"])


@pytest.mark.slow
def test_without_an_imu_the_tracker_identifies_the_images(
    folder: Path, frames: Path, result: dict[str, Any]
) -> None:
    """LEDs that differ in place alone, to a millimeter: nearly all images, and the same dome."""
    alone = folder / "alone"
    shutil.copytree(frames, alone)
    (alone / survey_procedure.ATTITUDES).unlink()
    found = surveyed(folder, alone, "lost")
    assert found["tied"] > 0.8 * STOPS
    assert found["surveyed"] > 0.8 * result["surveyed"]
    assert found["faults"]["dark"] == [DEAD]
    by_imu, lost = (
        {line["what"]: line["found"] for line in one["values"]} for one in (result, found)
    )
    assert lost["focal length px"] == pytest.approx(by_imu["focal length px"], rel=2e-3)


# --- images as they arrive ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_watch_ends_with_the_survey_of_the_images_at_hand(
    folder: Path,
    frames: Path,
    result: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A thread adds images; Ctrl-C follows when all are read. The survey equals that of the complete folder."""
    arriving = tmp_path / "arriving"
    arriving.mkdir()

    def drop() -> None:
        shutil.copy(frames / survey_procedure.ATTITUDES, arriving)
        (arriving / "noise.png").write_bytes(b"no image")
        for path in sorted(frames.glob("*.fits")):
            shutil.copy(path, arriving / f".{path.name}")
            (arriving / f".{path.name}").rename(arriving / path.name)

    dropping = threading.Thread(target=drop)

    def wait(_: float) -> None:
        rested.append(dropping.is_alive())
        if len(rested) > 3 and not any(rested[-3:]):
            raise KeyboardInterrupt

    rested: list[bool] = []
    monkeypatch.setattr(survey_procedure.time, "sleep", wait)
    dropping.start()
    words = [
        "survey",
        folder / "design.yaml",
        "--images",
        arriving,
        "--camera",
        folder / "design.yaml",
        "--watch",
    ]
    words += [
        "--led-sigma",
        "1 mm",
        "--imu-sigma",
        "0.3 deg",
        "--tilt",
        TILT_DEG,
        "--out",
        tmp_path / "out",
    ]
    code, printed, err = command(*words)
    dropping.join()
    assert code == 0
    assert err.count("\n") == 1  # for the file that is no image
    assert "noise.png" in err
    assert f"{STOPS} of 150 images, {STOPS} with an attitude" in printed
    assert "LEDs measured" in printed.split("surveyed in")[0]
    found = json.loads((tmp_path / "out" / "survey.json").read_text())
    assert (found["surveyed"], found["faults"]) == (result["surveyed"], result["faults"])


# --- what is refused ----------------------------------------------------------------------------------------


def write_images(folder: Path, count: int, size: tuple[int, int] = (480, 640)) -> None:
    folder.mkdir(exist_ok=True)
    for n in range(count):
        cv2.imwrite(str(folder / f"{n:03d}.png"), np.full(size, 9, np.uint16))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("prepare", "says"),
    [
        (lambda path: None, "no such folder"),
        (lambda path: path.mkdir(), "0 images; allowed: 3 or more, typically tens"),
        (lambda path: write_images(path, 2), "2 images; allowed: 3 or more, typically tens"),
        (
            lambda path: write_images(path, 4, (100, 120)),
            "120 x 100 pixels; allowed: 640 x 480, as the camera has them",
        ),
        (
            lambda path: (write_images(path, 3), (path / "003.png").write_bytes(b"PNG?")),
            "003.png: cannot be decoded",
        ),
        (
            lambda path: write_images(path, 3),
            "0 of 3 images identified; allowed: 2 or more: give their attitudes",
        ),
    ],
)
def test_images_that_cannot_be_surveyed_are_refused_in_one_line(
    folder: Path, tmp_path: Path, prepare: Any, says: str
) -> None:
    prepare(tmp_path / "in")
    words = (
        "survey",
        folder / "design.yaml",
        "--images",
        tmp_path / "in",
        "--camera",
        folder / "design.yaml",
    )
    code, _, err = command(*words, "--out", tmp_path / "out")
    assert (code, err.count("\n")) == (2, 1)
    assert says in err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--images", "."], "--images: no camera; allowed: with --camera FILE"),
        (["--camera", "x.yaml"], "--camera: has no effect without --images"),
        (["--plan", "--checks", "3"], "--checks: has no effect with --plan"),
        (["--repeat", "3", "--frames-to", "x"], "--frames-to: has no effect with --repeat"),
        (
            ["--watch"],
            "--watch: has no effect without --images; allowed: with --images FOLDER",
        ),
        (
            ["--images", ".", "--camera", "x.yaml", "--watch", "--checks", "3"],
            "--checks: has no effect with --watch",
        ),
        (
            ["--plan", "--repeat", "3"],
            "--repeat: has no effect with --plan; allowed: one of them",
        ),
    ],
)
def test_contradicting_survey_options_are_refused_in_one_line(
    words: list[str], says: str
) -> None:
    code, _, err = command("survey", "afit_simsat", *words)
    assert (code, err.count("\n")) == (2, 1)
    assert says in err


HEAD = "file,roll_deg,pitch_deg,yaw_deg\n"


def test_written_attitudes_are_read_unchanged(tmp_path: Path) -> None:
    held = survey_frames.from_angles(np.array([[1.0, -20.0, 170.0], [0.5, 3.0, -90.0]]))
    survey_procedure.write_attitudes(
        tmp_path / "a.csv", ["b.fits", "a.fits"], held, {"leds": [3, 4]}
    )
    read = survey_procedure.read_attitudes(tmp_path / "a.csv")
    assert list(read) == ["b.fits", "a.fits"]
    # Four decimals.
    assert (Rotation.concatenate(list(read.values())) * held.inv()).magnitude().max() < 2e-6


def test_solved_attitudes_are_written_with_covariances_and_read_as_an_imu_s(
    tmp_path: Path,
) -> None:
    covariance = np.arange(9.0).reshape(3, 3)
    row = {
        "file": "b.fits",
        "status": "solved",
        "roll_deg": 1.0,
        "pitch_deg": -20.0,
        "yaw_deg": 170.0,
        "cam_from_lab_xyzw": [0.1, 0.2, 0.3, 0.9],
        "covariance_rad2": (covariance + covariance.T).tolist(),
        "matches": 7,
    }
    unknown = dict.fromkeys(row) | {"file": "a.fits", "status": "not identified"}
    path = tmp_path / "solved.csv"
    survey_procedure.write_solved(path, [unknown, row])
    assert list(survey_procedure.read_attitudes(path)) == ["b.fits"]
    head, only = (line.split(",") for line in path.read_text().splitlines())
    found = dict(zip(head, only, strict=True))
    assert [float(found[f"cam_from_lab_{one}"]) for one in "xyzw"] == [0.1, 0.2, 0.3, 0.9]
    upper = [
        float(found[f"covariance_{one}_rad2"]) for one in ("xx", "xy", "xz", "yy", "yz", "zz")
    ]
    assert upper == [0, 4, 8, 8, 12, 16]
    assert found["leds"] == "7"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no attitudes; allowed: columns file, roll_deg, pitch_deg, yaw_deg"),
        ("file,roll_deg,pitch_deg\na,1,2\n", "no attitudes"),
        (HEAD, "no attitudes"),
        (HEAD + "a.fits,1,2\n", "line 2: 3 values; allowed: 4"),
        (HEAD + "a.fits,1,2,x\n", "line 2: 'x' is not a number"),
        (HEAD + "a.fits,1,2,nan\n", "line 2: 'nan' is not a finite number"),
        (HEAD + "a.fits,1,2,3\na.fits,1,2,3\n", "'a.fits' is in line 2 too; allowed: once"),
    ],
)
def test_faulty_attitudes_are_refused_in_one_line(
    tmp_path: Path, text: str, says: str
) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError) as refused:
        survey_procedure.read_attitudes(tmp_path / "a.csv")
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


def test_of_two_formats_of_one_image_one_is_read(tmp_path: Path) -> None:
    for name in ("b.png", "a.png", "a.fits", "c.jpg", "notes.txt", ".d.png"):
        (tmp_path / name).touch()
    assert [path.name for path in survey_procedure.image_files(tmp_path)] == [
        "a.fits",
        "b.png",
        "c.jpg",
    ]
