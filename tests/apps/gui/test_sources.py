"""A part of the page whose source has changed is emptied: it shows nothing of the scene or study before."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.page.head import noise_text
from skysim.apps.gui.page.tab import PANELS
from skysim.apps.gui.views.context import PageContext, PageView
from skysim.apps.gui.worker.workbench import Workbench
from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    SLOW_MS,
    Server,
    angles,
    come,
    onto_the_page,
    open_scene,
    opened,
    panel,
    pictured,
    status,
)

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
ORION = PageView("shefex2")


@pytest.mark.parametrize(
    ("before", "changes", "emptied"),
    [
        (ORION, {"angles_deg": (1.0, 2.0, 3.0)}, ""),
        (ORION, {"kind": "flight", "t_s": 0.5}, ""),
        (ORION, {"kind": "photo", "photo": "a.png"}, "image"),
        (PageView("x", kind="photo", photo="a"), {"photo": "b"}, "image"),
        (PageView("x", kind="photo", photo="a"), {"kind": "live"}, "image"),
        (PageView("x", kind="replay", study="s", trial=3), {"trial": 4}, "image"),
        (ORION, {"study": "s"}, "study"),
        (ORION, {"overrides": {"seed": "2"}}, "scene image"),
        (ORION, {"scene": "shefex2"}, "scene image study"),  # its file may be another one
        (ORION, {"scene": "afit_simsat"}, "scene image study"),
    ],
)
def test_a_part_is_emptied_when_its_source_changes(
    before: PageView, changes: dict[str, Any], emptied: str
) -> None:
    page = PageContext()
    page.state = before
    page.derived = []
    found: list[str] = []
    page.derive(lambda view: view.opened, lambda: found.append("scene"))
    page.derive(lambda view: view.image, lambda: found.append("image"))
    page.derive(lambda view: view.study, lambda: found.append("study"))
    page.set_state(**changes)
    assert found == emptied.split()


def test_the_noise_switch_says_why_fewer_lights_are_identified() -> None:
    """Each lost light is a blob of its own in the noisy frame, and none where only the noise is absent."""
    bench = Workbench.open("shefex2", {})
    noisy = bench.render_at_rest(solve=True)
    exact = Workbench.open("shefex2", {"camera.detector.noise": "false"}).render_at_rest(
        solve=True
    )
    text = noise_text(noisy, exact)
    rows = [view.result.row for view in (exact, noisy) if view.result]
    counts = re.findall(r"(\d+) of (\d+)", text)
    assert counts == [(str(row.matched), str(row.detected)) for row in rows]
    assert rows[0].matched < rows[1].matched
    assert rows[0].detected > rows[1].detected
    more, less = map(float, re.search(r"([\d.]+) to ([\d.]+) DN", text).groups())  # type: ignore[union-attr]
    assert more == pytest.approx(noisy.statistics.scatter_dn, rel=0.06)
    assert less == pytest.approx(exact.statistics.scatter_dn, rel=0.06)
    assert noise_text(exact, noisy) == ""
    assert noise_text(noisy, exact._replace(result=None)) == ""
    # Every lost light has a fainter one beside it, of which the noisy frame has no blob.
    lost = {spot.id for spot in noisy.result.detections} - {  # type: ignore[union-attr]
        spot.id
        for spot in exact.result.detections  # type: ignore[union-attr]
    }
    for light in noisy.lights[np.isin(noisy.lights.id, list(lost))]:
        beside = np.hypot(*(noisy.lights.xy_px - light.xy_px).T)
        assert np.sort(beside)[1] < 9


# In the browser.


def shown(page: Any) -> dict[str, str]:
    """The texts of all parts of the page that are about its scene, by part."""
    found = {}
    for name in PANELS:
        if name in ("Log", "Lights"):
            continue
        panel(page, name)
        if name == "Scene":
            page.locator(".lab-sections .q-item:visible").first.wait_for()
        page.wait_for_timeout(700)
        texts = page.locator(".q-tab-panel:visible").inner_text()
        # The list of reports is of the folder, not of the scene.
        found[name] = texts.partition("Finished studies")[0]
    space = page.locator(".lab-space canvas").first
    found["3-D"] = str(space.get_attribute("data-lights"))
    found["banner"] = page.locator(".lab-banner").inner_text()
    return found


def picture_of_noise(folder: Path) -> Path:
    path = folder / "noise.png"
    image = np.random.default_rng(1).integers(90, 110, (480, 640), dtype=np.uint8)
    cv2.imwrite(str(path), image)
    return path


@pytest.mark.browser
@in_browser
def test_a_refused_photograph_is_not_beside_lights_of_the_scene(
    page: Any, tmp_path: Path
) -> None:
    space = page.locator(".lab-space canvas").first
    assert come(lambda: not space.get_attribute("data-lights").startswith("identified 0,"))
    panel(page, "Image")
    page.set_input_files("input[type=file]", picture_of_noise(tmp_path))
    page.get_by_text(re.compile(r"noise\.png: (?!solved|solving)")).wait_for()
    assert come(
        lambda: space.get_attribute("data-lights").startswith("identified 0, seen 0,")
    )
    onto_the_page(page)
    page.keyboard.press("1")
    page.get_by_text("No image on the page").wait_for()
    assert come(lambda: not space.get_attribute("data-lights").startswith("identified 0,"))


@pytest.mark.browser
@in_browser
def test_a_photograph_that_cannot_be_decoded_leaves_no_image(
    page: Any, tmp_path: Path
) -> None:
    before = angles(page)
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    panel(page, "Lights")
    rows = page.locator(".lab-lights:visible tbody tr")
    assert come(lambda: rows.count() > 5)
    panel(page, "Image")
    page.set_input_files("input[type=file]", broken)
    page.locator(".lab-wait", has_text="broken.png: cannot be decoded").wait_for()
    canvas = page.locator(".lab-frame canvas")
    assert canvas.get_attribute("data-frame") is None
    assert canvas.evaluate("canvas => canvas.width") == 0
    assert page.locator(".lab-banner").inner_text() == "image broken.png"
    assert [field.input_value() for field in page.locator(".lab-angle").all()] == [""] * 3
    page.get_by_role("button", name="Export").click()
    page.locator(".q-menu .q-item", has_text=re.compile("^truth$")).click()
    page.get_by_role("status").filter(has_text="the page shows no image").wait_for()
    pictured(page, "no_image")
    panel(page, "Lights")
    assert come(lambda: rows.count() == 0)
    page.get_by_role("button", name="Live", exact=True).click()
    canvas.and_(page.locator("[data-frame]")).wait_for()
    assert come(lambda: np.array_equal(angles(page), before))
    assert page.locator(".lab-wait").is_hidden()


@pytest.mark.browser
@in_browser
def test_a_used_page_shows_another_scene_as_a_fresh_one_does(
    browser: Any, server: Server, tmp_path: Path
) -> None:
    """Everything is filled for one scene; then the page and a fresh one show another scene alike."""
    with (
        opened(browser, server.login, NARROW) as page,
        opened(browser, server.login, NARROW) as fresh,
    ):
        fresh.goto(f"{server.url}?scene=afit_simsat")
        fresh.locator(".lab-scene", has_text="afit_simsat").wait_for()
        status(fresh, "solved")
        expected = shown(fresh)
        panel(page, "Check")
        page.get_by_role("button", name="Check", exact=True).click()
        page.locator(".lab-facts").get_by_text("field of view").wait_for()
        panel(page, "Run")
        page.get_by_role("button", name="Simulate").click()
        page.get_by_text("frames solved").wait_for(timeout=SLOW_MS)
        panel(page, "Monte Carlo")
        page.get_by_label("runs, F8").fill("20")
        page.get_by_role("button", name="Start").click()
        page.get_by_text("20 of 20 trials").wait_for()
        with page.expect_popup() as opens:
            page.get_by_role("button", name="Report", exact=True).click()
        opens.value.wait_for_function("() => document.title.startsWith('Monte Carlo of')")
        opens.value.close()
        page.get_by_label("runs, F8").fill("200")
        panel(page, "Image")
        page.set_input_files("input[type=file]", picture_of_noise(tmp_path))
        page.get_by_text(re.compile(r"noise\.png: (?!solved|solving)")).wait_for()
        filled = shown(page)
        alike = {name for name in filled if filled[name] == expected[name]}
        assert alike <= {"Scene", "Survey"}
        onto_the_page(page)
        open_scene(page, "afit_simsat")
        assert shown(page) == expected


@pytest.mark.browser
@in_browser
def test_results_of_a_study_go_with_its_choice(browser: Any, server: Server) -> None:
    with opened(browser, server.login, NARROW) as page:
        panel(page, "Monte Carlo")
        page.get_by_label("runs, F8").fill("20")
        page.get_by_role("button", name="Start").click()
        page.get_by_text("20 of 20 trials").wait_for()
        report = page.get_by_role("button", name="Report", exact=True)
        assert come(report.is_enabled)
        page.get_by_role("combobox", name="Study").click()
        page.get_by_role("option").nth(1).click()
        page.get_by_text("No study of this scene has been run yet").wait_for()
        assert report.is_disabled()
        assert "0.9" not in page.get_by_text("95 % interval").locator("..").inner_text()
