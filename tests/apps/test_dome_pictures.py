"""Pictures of a dome's LEDs solved with `skysim solve --dome`: the truth, chi-square, outputs, and what is refused."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.table import Table
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import skysim
from skysim.apps import plate_solver
from skysim.apps.cli import main
from skysim.apps.plate_solver.plate_solution import DomeSolution, dome_fields, solve_dome
from skysim.core.errors import InputError
from skysim.core.images import ViewedImage
from skysim.experiments.dome_survey import survey_frames
from skysim.scene import loader
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking.dome_map_file import DomeMap, write_dome_map
from tests.helpers.changed_light import with_sources

RARE = 1e-6  # the seeds are fixed: it fails for a wrong law alone
LED_SIGMA_M = 1e-3
SMALL = """
schema: 1
base: afit_simsat_ideal
title: a small dome seen by a wide lens
light:
  layout: {kind: poisson_disk, cap_deg: 24, spacing: "38 mm", hardware_seed: 3}
  led: {intensity: "0.5 mcd", disk_diameter: "4 mm"}
camera: {width_px: 640, height_px: 480, pixel: "10.5 um", focal_length: "18 mm"}
tracker: {min_area_px: 9, survey: {led_sigma: "1 mm", lever_sigma: "0 mm", seed: 5}}
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dome") / "small.yaml"
    path.write_text(SMALL)
    return path


@pytest.fixture(scope="module")
def lab(scene: Path) -> Lab:
    return build_lab(loader.load(scene))


@pytest.fixture(scope="module")
def solver(scene: Path) -> plate_solver.DomeSolver:
    return plate_solver.make_dome_solver(scene)


@pytest.fixture(scope="module")
def folder(scene: Path, lab: Lab) -> Path:
    """Two pictures at rest, 2 degrees of yaw apart."""
    held = Rotation.from_euler("z", [[10.0], [12.0]], degrees=True)
    for n, (frame, _) in enumerate(survey_frames.render_stops(lab, held)):
        cv2.imwrite(str(scene.parent / f"frame_{n}.png"), frame.image_dn)
    return scene.parent


def command(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    """The exit code of `skysim solve` with these words."""
    monkeypatch.setattr(sys, "argv", ["skysim", "solve", *map(str, words)])
    with pytest.raises(SystemExit) as left:
        main.main()
    return int(left.value.code or 0)


@pytest.mark.slow
def test_attitudes_err_as_their_covariance_says_where_the_dome_differs_from_its_list(
    lab: Lab, solver: plate_solver.DomeSolver
) -> None:
    """The LEDs stand 1 mm from their places in the list about each axis, as the scene says that they may.

    The tracker takes the least distance of an LED for all of them, so that NEES may be somewhat below three.
    """
    sources = lab.camera.sources
    place = sources.place.copy()
    place[:, :3] += np.random.default_rng(2).normal(0, LED_SIGMA_M, (len(place), 3))
    true = with_sources(lab, replace(sources, place=place))
    held = survey_frames.stop_attitudes(lab.scene, "checks", 30, 20.0)
    nees = []
    for frame, truth in survey_frames.render_stops(true, held):
        reading = solve_dome(ViewedImage(frame.image_dn), solver)
        found = DomeSolution(**dome_fields(reading))
        if found.status == "solved":
            turn = Rotation.from_quat(found.cam_from_lab_xyzw) * truth.cam_from_lab.inv()
            error_rad = turn.as_rotvec()
            nees.append(error_rad @ np.linalg.solve(found.covariance_rad2, error_rad))
    assert len(nees) > 20
    assert 1 < np.mean(nees) < chi2.ppf(1 - RARE, 3 * len(nees)) / len(nees)


def test_the_list_has_no_simulated_errors_but_their_sizes(
    lab: Lab, solver: plate_solver.DomeSolver
) -> None:
    leds = solver.tracker.leds
    np.testing.assert_allclose(leds.position_m, lab.camera.sources.place[:, :3], atol=1e-12)
    assert leds.sigma_m == LED_SIGMA_M
    assert solver.tracker.camera.focal_px == pytest.approx(lab.scene.camera.focal_px)


@pytest.mark.slow
def test_a_picture_gets_attitude_covariance_and_leds(folder: Path, scene: Path) -> None:
    found = skysim.solve(folder / "frame_0.png", dome=scene)
    assert (found.status, found.hint) == ("solved", "")
    assert found.yaw_deg == pytest.approx(10.0, abs=0.1)
    assert [found.roll_deg, found.pitch_deg] == pytest.approx([0.0, 0.0], abs=0.1)
    sigma_rad = np.sqrt(np.diag(found.covariance_rad2))
    assert found.roll_sigma_arcsec == pytest.approx(np.degrees(sigma_rad[2]) * 3600)
    residuals_px = [[one["residual_x_px"], one["residual_y_px"]] for one in found.leds]
    assert found.rms_px == pytest.approx(np.sqrt(np.mean(np.square(residuals_px))))
    assert len(found.leds) == found.matches > 5


@pytest.mark.slow
def test_a_sequence_has_the_rate(
    folder: Path, scene: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    names = [folder / f"frame_{n}.png" for n in range(2)]
    out = folder / "sequence"
    assert (
        command(monkeypatch, *names, "--dome", scene, "--sequence", "--rate", 2, "--out", out)
        == 0
    )
    text = capsys.readouterr().out
    assert "2 of 2 solved over 0.5 s; no gap; rate median 4" in text
    _, second = json.loads((out / "solutions.json").read_text())
    assert second["rate_deg_s"] == pytest.approx([0.0, 0.0, 4.0], abs=0.1)


@pytest.mark.slow
def test_table_and_annotated_picture_name_the_leds(
    folder: Path, scene: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    files = [folder / "leds.ecsv", folder / "marked.png"]
    words = ["--table", files[0], "--annotate", files[1], "--out", folder / "out", "--json"]
    assert command(monkeypatch, folder / "frame_0.png", "--dome", scene, *words) == 0
    (found,) = json.loads(capsys.readouterr().out)
    table = Table.read(files[0], format="ascii.ecsv")
    assert table["name"].tolist() == [one["name"] for one in found["leds"]]
    assert set(table.colnames) == set(found["leds"][0])
    assert cv2.imread(str(files[1])).shape[2] == 3
    # The table is a list of lights.
    assert skysim.solve(files[0], dome=scene).matches == found["matches"]


@pytest.mark.slow
def test_pictures_that_are_not_of_the_dome_are_refused(
    folder: Path, solver: plate_solver.DomeSolver
) -> None:
    picture = cv2.imread(str(folder / "frame_0.png"), cv2.IMREAD_UNCHANGED)
    rng = np.random.default_rng(1)
    other = rng.normal(100, 3, picture.shape)
    rows, columns = np.mgrid[: len(other), : len(other[0])]
    for x, y in rng.uniform(20, 460, (20, 2)):
        other[(columns - x) ** 2 + (rows - y) ** 2 < 40] += 900
    cases = {
        "perhaps mirrored": picture[:, ::-1],
        "too few lights (0)": rng.normal(100, 3, picture.shape),
        "LEDs at no attitude: is it this dome": other,
    }
    for hint, pixels in cases.items():
        image = ViewedImage(np.ascontiguousarray(pixels).astype(np.uint16))
        found = dome_fields(solve_dome(image, solver))
        assert found["status"] != "solved"
        assert "cam_from_lab_xyzw" not in found
        assert hint in found["hint"]


@pytest.mark.slow
def test_a_map_takes_the_place_of_the_list_and_its_gaps_are_told(
    folder: Path, scene: Path, lab: Lab
) -> None:
    leds = lab.camera.sources
    camera = lab.scene.camera
    count = 12
    path = folder / "map.ecsv"
    write_dome_map(
        path,
        DomeMap(
            leds.id[:count],
            leds.place[:count, :3],
            np.full(count, 1e-4),
            np.array(lab.camera.mount.camera_body_m),
            1e-4,
            (camera.width_px, camera.height_px),
            1.01 * camera.focal_px,
            1.0,
            camera.center_px,
            (0.0, 0.0),
            (0.0,) * 5,
            (0.0,) * 5,
        ),
    )
    solver = plate_solver.make_dome_solver(scene, path)
    assert solver.tracker.camera.focal_px == pytest.approx(1.01 * camera.focal_px)
    assert len(solver.tracker.leds.id) == count
    found = skysim.solve(folder / "frame_0.png", dome=scene, map=path)
    assert f"the map lacks {len(leds.id) - count} LEDs of the scene" in found.hint


@pytest.mark.slow
def test_a_camera_of_a_dome_s_scene_points_to_dome(
    folder: Path, scene: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    words = ["--camera", scene, "--out", folder / "sky", "--json"]
    assert command(monkeypatch, folder / "frame_0.png", *words) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert f"solve them with --dome {scene}" in found["hint"]


@pytest.mark.parametrize("name", ["fov", "camera", "time", "catalog", "near", "size", "wcs"])
def test_options_of_the_sky_have_no_effect_under_a_dome(
    name: str, scene: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    value = {"fov": "10", "near": "1,2,3", "size": "9x9", "time": "2012-06-22"}.get(name, "x")
    assert command(monkeypatch, "a.png", "--dome", scene, f"--{name}", value) == 2
    assert f"--{name}: has no effect with --dome" in capsys.readouterr().err


def test_a_scene_without_a_dome_and_a_map_without_one_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    with pytest.raises(InputError, match="the light of shefex2 is stars; allowed: a dome"):
        plate_solver.make_dome_solver("shefex2")
    assert command(monkeypatch, "a.png", "--map", "leds.ecsv") == 2
    assert "--map: has no effect without --dome" in capsys.readouterr().err
