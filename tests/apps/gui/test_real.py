"""A real camera beside the simulation: folder and video, attitudes, pictures, and what explains the residuals."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    come,
    open_scene,
    opened,
    panel,
    pictured,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.messages import REAL_VIEWS
from skysim.apps.gui.worker import real
from skysim.apps.gui.worker.tasks import Worker
from skysim.core.errors import InputError
from skysim.experiments.dome_survey import survey_frames
from skysim.results.files import recording
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.simulation.lab import Lab, build_lab

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")

DOME = "afit_simsat"
FOCAL_SHARE = 1.006  # focal length of the real camera over that of the scene


@pytest.fixture(scope="module")
def laboratory() -> Lab:
    """The real laboratory: a camera with another focal length, LEDs off the list as the scene draws them."""
    scene: Scene = loader.load(DOME)
    focal_m = FOCAL_SHARE * scene.camera.focal_length_m
    return build_lab(scene.with_values("camera", focal_length_m=focal_m))


def written(lab: Lab, folder: Path, count: int, first: int = 0) -> list[Rotation]:
    """Write real frames at attitudes of a survey, and return lab_from_body of each."""
    folder.mkdir(exist_ok=True)
    held = survey_frames.stop_attitudes(lab.scene, "attitudes", count + first, 8.0)[first:]
    for frame, truth in survey_frames.render_stops(lab, held, first):
        path = folder / f"real_{frame.index:03d}.fits"
        recording.write_fits(path, frame, truth, lab.scene)
    return list(held)


@pytest.fixture
def worker() -> Iterator[Worker]:
    found = Worker()
    found.open(DOME, {}, solve=False)
    yield found
    found.release()


def compared(worker: Worker, folder: Path, follow: bool) -> Any:
    """The next real frame of a folder, solved by the scene's tracker."""
    return worker.solve_next(str(folder), None, (), True, follow)


def test_a_file_is_taken_when_it_is_complete_and_once(tmp_path: Path) -> None:
    source = real.RealSource(str(tmp_path))
    assert source.picture() is None
    image = np.full((20, 30), 7, np.uint16)
    cv2.imwrite(str(tmp_path / "b.png"), image)
    assert source.picture() is None  # it may still be written
    name, picture = source.picture() or ("", None)
    assert name == "b.png"
    assert picture is not None
    np.testing.assert_array_equal(picture.pixels, image)
    assert source.picture() is None


@pytest.mark.slow
def test_a_real_frame_s_attitude_is_near_the_true_one_and_moves_the_simulation(
    worker: Worker, laboratory: Lab, tmp_path: Path
) -> None:
    (held,) = written(laboratory, tmp_path, 1)
    before = worker.workbench.lab_from_body
    assert compared(worker, tmp_path, False) is False
    photo = compared(worker, tmp_path, False)
    assert photo.result.row.status == "solved"
    assert worker.workbench.lab_from_body is before
    wanted = held.as_euler("ZYX", degrees=True)[::-1]
    row = photo.result.row
    np.testing.assert_allclose(row.estimate_deg, wanted, rtol=0, atol=0.2)
    written(laboratory, tmp_path, 1, first=1)
    assert compared(worker, tmp_path, True) is False
    photo = compared(worker, tmp_path, True)
    row = photo.result.row
    # The simulation has the attitude of the real frame: their difference is nothing.
    np.testing.assert_allclose(photo.angles_deg, row.estimate_deg, rtol=0, atol=1e-9)
    assert row.cross_arcsec < 0.01
    assert not row.wrong
    # The identified LEDs are those of the simulation.
    seen = set(photo.lights.id.tolist())
    assert {one.id for one in photo.result.detections if one.id >= 0} <= seen
    for name in REAL_VIEWS:
        assert worker.real_view(name).pixels.fields["size"] == photo.pixels.fields["size"]


def test_the_difference_of_like_frames_is_noise_whatever_their_brightness() -> None:
    rng = np.random.default_rng(5)
    shape = (200, 300)
    light = np.zeros(shape)
    light[50:54, 60:64] = 400.0
    simulated = 10 + light + rng.normal(0, 1, shape)
    brighter = 30 + 2.5 * light + rng.normal(0, 1, shape)
    found = real.pictures(brighter, simulated)
    assert list(found) == list(REAL_VIEWS)
    assert abs(found["difference"][50:54, 60:64]).max() < 30
    assert np.median(found["overlay"]) == pytest.approx(0, abs=0.5)
    np.testing.assert_allclose(found["overlay"][50:54, 60:64], 1000, rtol=0.02)
    blank = real.pictures(np.full(shape, 3.0), np.full(shape, 4.0))
    assert not blank["difference"].any()


@pytest.mark.slow
def test_the_survey_by_real_frames_finds_the_true_focal_length(
    worker: Worker, laboratory: Lab, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="no real frame"):
        worker.explain()
    count = 14
    written(laboratory, tmp_path, count)
    assert compared(worker, tmp_path, False) is False
    for _ in range(count):
        assert compared(worker, tmp_path, False)
    text = worker.explain()
    focal = re.search(r"first: focal length px ([+-][\d.]+) ± ([\d.]+)", text)
    assert focal, text
    true_px = (FOCAL_SHARE - 1) * worker.workbench.scene.camera.focal_px
    assert abs(float(focal[1]) - true_px) < 4 * float(focal[2])
    assert abs(float(focal[1])) > 3 * float(focal[2])
    assert "Nothing" not in text
    before, after = map(float, re.findall(r"([\d.]+) px (?:rms before|after)", text))
    assert after < before / 2


def test_a_picture_of_another_size_is_refused_and_the_sky_has_no_survey(
    worker: Worker, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "b.png"), np.full((20, 30), 7, np.uint16))
    assert compared(worker, tmp_path, False) is False
    with pytest.raises(InputError, match=r"b\.png: 30 x 20 pixels; allowed: 1600 x 1200"):
        compared(worker, tmp_path, False)
    assert compared(worker, tmp_path, False) is False


@pytest.mark.slow
def test_a_sky_frame_is_solved_by_the_scene_s_star_tracker(tmp_path: Path) -> None:
    lab = build_lab(loader.load("shefex2"))
    for frame, truth in survey_frames.render_stops(lab, Rotation.concatenate([lab.start])):
        recording.write_fits(tmp_path / "sky.fits", frame, truth, lab.scene)
    worker = Worker()
    worker.open("shefex2", {}, solve=False)
    assert compared(worker, tmp_path, True) is False
    photo = compared(worker, tmp_path, True)
    assert photo.result.row.status == "solved"
    with pytest.raises(InputError, match="a survey needs LEDs"):
        worker.explain()


@pytest.mark.browser
@in_browser
def test_a_watched_folder_is_compared_with_the_simulation(
    browser: Any, laboratory: Lab, tmp_path: Path
) -> None:
    shots = tmp_path / "shots"
    written(laboratory, shots, 6)
    with (
        Server(tmp_path, "--camera", str(shots)) as watching,
        opened(browser, watching.login, NARROW) as page,
    ):
        open_scene(page, DOME)
        panel(page, "Image")
        page.get_by_role("checkbox", name="as the scene's camera").click()
        page.get_by_role("button", name="Watch").click()
        text = page.get_by_text(re.compile("^real_005.fits: solved"))
        text.wait_for()
        assert "real minus simulated: cross 0.0″" in text.inner_text()
        page.get_by_text("simulated", exact=True).first.wait_for()
        # Further files are solved as they come.
        written(laboratory, shots, 6, first=6)
        page.get_by_text(re.compile("^real_011.fits: solved")).wait_for()
        assert page.locator("[data-state=photo]").inner_text() == "image real_011.fits"
        page.get_by_role("checkbox", name="residuals", exact=True).click()
        canvas = page.locator(".lab-frame > canvas")
        assert come(lambda: "arrows × " in str(canvas.get_attribute("data-arrows")))
        assert "LED " in str(canvas.get_attribute("aria-label"))
        page.wait_for_timeout(800)
        pictured(page, "real_frame")
        for view in ("simulated", "difference", "overlay"):
            before = canvas.get_attribute("data-frame")
            page.get_by_role("button", name=view, exact=True).click()
            assert come(lambda: canvas.get_attribute("data-frame") != before)  # noqa: B023
            page.wait_for_timeout(600)
            pictured(page, f"real_{view}")
        page.get_by_role("button", name="blink", exact=True).click()
        drawn = set()
        assert come(lambda: drawn.add(canvas.get_attribute("data-frame")) or len(drawn) > 3)
        page.get_by_role("button", name="real", exact=True).click()
        page.get_by_role("button", name="Explain the residuals").click()
        answer = page.get_by_text(re.compile(r"frames are connected.* px after"))
        answer.first.wait_for()
        assert "focal length px" in answer.first.inner_text()
        pictured(page, "real_explained")
        page.get_by_role("button", name="Stop").click()
        page.get_by_role("button", name="Watch").wait_for()
