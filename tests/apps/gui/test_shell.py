"""The frame around the lab's panels: list of actions, theme, splitter, narrow windows, wording."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    WIDE,
    Server,
    changed,
    come,
    onto_the_page,
    opened,
    panel,
    pictured,
    source,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.cli.options import OPTIONS
from skysim.apps.gui.page.actions import Command, matching
from skysim.apps.gui.page.tab import PANELS
from skysim.apps.gui.views import overlay, style
from skysim.apps.gui.views.widgets import LABELS, for_page
from skysim.apps.gui.worker.study_process import MAX_STUDIES, StudyProcess
from skysim.apps.gui.worker.workbench import Workbench
from skysim.core.errors import OVERRIDES, InputError, Where

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")


@pytest.mark.parametrize(
    ("error", "shown"),
    [
        (
            InputError("camera.f_number", "", "above 0", OVERRIDES),
            "camera.f_number: allowed: above 0",
        ),
        (InputError("seed", "-1", "", Where("x.yaml", 3)), "seed: -1 (x.yaml, line 3)"),
        (
            InputError("solve.fov_deg", "200", "2 to 120"),
            "the field of view: 200; allowed: 2 to 120",
        ),
        (InputError("survey.tilt_deg", "95", "to 30"), "the tilt: 95; allowed: to 30"),
        (InputError("", "no frame has been rendered"), "no frame has been rendered"),
    ],
)
def test_an_error_names_the_field_of_the_page(error: InputError, shown: str) -> None:
    assert for_page(error) == shown


def test_every_parameter_of_a_photo_has_a_label() -> None:
    assert {key for key in OPTIONS if key.startswith("solve.")} <= LABELS.keys()


def test_actions_are_found_by_words_in_any_order() -> None:
    commands = [
        Command("show the log", lambda: None, "F10"),
        Command("show the next frame", lambda: None, "."),
    ]
    assert matching(commands, "FRAME show") == commands[1:]
    assert matching(commands, "") == commands
    assert matching(commands, "none") == []


def test_a_study_beyond_the_number_allowed_is_refused(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = {StudyProcess(tmp_path) for _ in range(MAX_STUDIES)}
    monkeypatch.setattr(StudyProcess, "begun", running)
    StudyProcess.check_count()  # none of them runs
    monkeypatch.setattr(StudyProcess, "begun", running)
    monkeypatch.setattr(StudyProcess, "running", property(lambda _: True))
    with pytest.raises(
        InputError, match=f"{MAX_STUDIES} of {MAX_STUDIES} studies are running"
    ):
        StudyProcess.check_count()


EYES = {  # linear RGB as seen: Machado, Oliveira and Fernandes 2009, severity 1
    "normal": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
STATES = ("good", "warn", "bad")


def distance(colors: Iterable[str], eye: str) -> float:
    """The least distance between two of some colors, in Oklab (Ottosson 2020), of which 0.02 is just noticeable."""
    srgb = np.array(
        [[int(color[n : n + 2], 16) / 255 for n in (1, 3, 5)] for color in colors]
    )
    linear = (
        np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        @ np.array(EYES[eye]).T
    )
    cones = [
        [0.412221, 0.536333, 0.051446],
        [0.211903, 0.680700, 0.107397],
        [0.088302, 0.281719, 0.629979],
    ]
    lab = [
        [0.210454, 0.793618, -0.004072],
        [1.977998, -2.428592, 0.450594],
        [0.025904, 0.782772, -0.808676],
    ]
    seen = np.cbrt(np.clip(linear, 0, 1) @ np.array(cones).T) @ np.array(lab).T
    i, j = np.triu_indices(len(seen), 1)
    return float(np.linalg.norm(seen[i] - seen[j], axis=1).min())


@pytest.mark.parametrize("eye", EYES)
def test_colors_are_distinguishable_with_color_blindness(eye: str) -> None:
    """Red and green of equal lightness would be 0.04 apart in deuteranopia."""
    assert distance(["#3f9a52", "#e05555"], "deuteranopia") < 0.04
    # These are dashed.
    marks = [color for kind, color in overlay.COLORS.items() if kind != "windows"]
    states = [[theme[name] for name in STATES] for theme in (style.DARK, style.LIGHT)]
    # The curves of the reference have the color of the text.
    curves = [[*style.CURVE_COLORS, theme["text"]] for theme in (style.DARK, style.LIGHT)]
    for colors in (*curves, marks, *states):
        assert distance(colors, eye) > 0.1


@pytest.mark.slow
def test_the_time_of_the_first_frame_excludes_compilation() -> None:
    """This holds for a tracker chosen later, too: its first frame takes about as long as its second."""
    bench = Workbench.open("shefex2", {})
    for overrides in ({}, {"tracker.identifier": "pyramid"}):
        bench = Workbench.open("shefex2", overrides, bench)
        first, second = (bench.render_at_rest(solve=True).result for _ in range(2))
        assert first is not None
        assert second is not None
        assert first.row.time_ms < 10 * second.row.time_ms + 50


# In the browser.

# Texts of the panels by their contrast, the least first: (L1 + 0.05) / (L2 + 0.05) of the relative luminances (WCAG 2).
# Controls that are switched off need none.
CONTRASTS = """() => {
  const rgba = text => { const [r, g, b, a = 1] = text.match(/[\\d.]+/g).map(Number); return [r, g, b, a]; };
  const over = ([r, g, b, a], [x, y, z]) => [a * r + (1 - a) * x, a * g + (1 - a) * y, a * b + (1 - a) * z, 1];
  const ground = at => { const own = rgba(getComputedStyle(at).backgroundColor);
    return own[3] === 1 || !at.parentElement ? own : over(own, ground(at.parentElement)); };
  const linear = c => (c /= 255) <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b) + 0.05;
  const hasText = at => [...at.childNodes].some(one => one.nodeType === Node.TEXT_NODE && one.data.trim());
  const found = [...document.querySelectorAll('.lab-head *, .lab-card *, .lab-bar *, .lab-panels *, .lab-keys *')]
    .filter(at => hasText(at) && at.checkVisibility() && !at.closest('[disabled], .disabled')).map(at => {
      const { color, filter } = getComputedStyle(at), dim = Number(filter.match(/brightness\\(([\\d.]+)\\)/)?.[1] ?? 1);
      const [r, g, b, a] = rgba(color), below = ground(at);
      const ends = [light(below), light(over([dim * r, dim * g, dim * b, a], below))];
      return [Math.max(...ends) / Math.min(...ends), at.innerText]; });
  return found.sort((a, b) => a[0] - b[0]);
}"""


@pytest.fixture(scope="module")
def tab_of_own(browser: Any, server: Server) -> Any:
    with opened(browser, server.login, NARROW) as found:
        yield found


@pytest.mark.browser
@in_browser
def test_every_action_is_found_by_ctrl_k(tab_of_own: Any) -> None:
    page = tab_of_own
    page.keyboard.press("Control+k")
    field = page.get_by_label("Action", exact=True)
    field.wait_for()
    listed = page.get_by_role("dialog").inner_text()
    for name in ("F5", "F10", "Ctrl Z", "panel: Monte Carlo", "export: truth", "light theme"):
        assert name in listed
    pictured(page, "palette")
    field.fill("log session")
    page.get_by_role("option").filter(has_text="F10").wait_for()
    assert come(lambda: page.get_by_role("option").count() == 1)
    field.press("Enter")
    page.locator(".lab-log").wait_for()
    page.get_by_role("dialog").wait_for(state="detached")
    frame = source(page)
    page.keyboard.press("ArrowRight")  # the camera's again
    changed(page, frame)


@pytest.mark.browser
@in_browser
def test_texts_have_sufficient_contrast_in_both_themes(tab_of_own: Any) -> None:
    """WCAG 2 demands a contrast of 4.5 for text of this size."""
    page = tab_of_own
    for _ in range(2):
        for name in PANELS:
            panel(page, name)
            page.wait_for_timeout(300)  # the tab's own color changes gradually
            contrast, text = page.evaluate(CONTRASTS)[0]
            assert contrast > 4.5, (name, text)
        change_theme(page)


def change_theme(page: Any) -> None:
    """Change between the dark and the light theme."""
    before = ground(page)
    page.keyboard.press("Control+k")
    page.get_by_label("Action", exact=True).fill("theme")
    page.get_by_role("option").filter(has_text="theme").click()
    page.get_by_role("dialog").wait_for(state="detached")
    assert come(lambda: ground(page) != before)


def ground(page: Any) -> str:
    """Background color of the panels."""
    return str(page.evaluate("getComputedStyle(document.body).backgroundColor"))


@pytest.mark.browser
@in_browser
def test_the_theme_and_the_splitter_are_remembered(tab_of_own: Any) -> None:
    page = tab_of_own

    def wide() -> float:
        return float(page.locator(".lab-side").bounding_box()["width"])

    before = wide()
    change_theme(page)
    light = ground(page)
    page.mouse.move(1280 - before, 400)
    page.mouse.down()
    page.mouse.move(1280 - before - 80, 400, steps=4)
    page.mouse.up()
    assert come(lambda: abs(wide() - before - 80) < 8)
    page.get_by_role("separator", name="Width of the panels").focus()
    frame = source(page)
    dragged = wide()
    page.keyboard.press("ArrowRight")
    assert come(lambda: abs(wide() - dragged + 24) < 1)
    assert source(page) == frame
    kept = wide()
    page.reload()
    page.locator(".lab-frame canvas[data-frame]").wait_for()
    assert come(lambda: ground(page) == light)
    assert wide() == kept
    pictured(page, "light")
    change_theme(page)


@pytest.mark.browser
@in_browser
@pytest.mark.parametrize("size", [NARROW, WIDE], ids=["1280", "1920"])
def test_frame_laboratory_and_panel_are_visible_together_and_resizable(
    tab_of_own: Any, size: dict[str, int]
) -> None:
    page = tab_of_own
    page.set_viewport_size(size)
    panel(page, "Run")
    line = page.get_by_role("separator", name="Height of the 3-D view")

    def tall() -> float:
        return float(page.locator(".lab-space-pane").bounding_box()["height"])

    def drag(down: float) -> None:
        box = line.bounding_box()
        x = box["x"] + 0.5 * box["width"]
        y = box["y"] + 0.5 * box["height"]
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x, y + down, steps=4)
        page.mouse.up()

    first = tall()
    frame = source(page)
    panels = page.locator(".lab-panels").bounding_box()
    assert first > 180
    assert panels["height"] > 240
    assert panels["y"] + panels["height"] < size["height"]
    drag(60)
    assert come(lambda: abs(tall() - first - 60) < 8)
    line.focus()
    dragged = tall()
    page.keyboard.press("ArrowUp")
    assert come(lambda: abs(tall() - dragged + 24) < 1)
    assert source(page) == frame  # the key was not the camera's
    kept = tall()
    page.reload()
    page.locator(".lab-frame canvas[data-frame]").wait_for()
    assert come(lambda: tall() == kept)
    line.dblclick()
    assert come(lambda: tall() == first)
    pictured(page, f"together_{size['width']}")
    page.set_viewport_size(NARROW)


@pytest.mark.browser
@in_browser
def test_a_closed_or_unchanged_laboratory_is_not_redrawn(
    tab_of_own: Any,
) -> None:
    page = tab_of_own
    line = page.get_by_role("separator", name="Height of the 3-D view")
    canvas = page.locator(".lab-space canvas").first

    def pictures() -> int:
        return int(canvas.get_attribute("data-drawn") or 0)

    def moved(key: str) -> int:
        """Number of pictures drawn after a key press."""
        page.wait_for_timeout(1000)
        before = pictures()
        frame = source(page)
        onto_the_page(page)
        page.keyboard.press(key)
        changed(page, frame)
        page.wait_for_timeout(1500)
        return pictures() - before

    page.locator(".lab-space-pane").wait_for()
    assert moved("ArrowRight") >= 1
    line.focus()
    for _ in range(12):
        page.keyboard.press("ArrowUp")
    assert come(lambda: page.locator(".lab-space-pane").bounding_box()["height"] == 0)
    assert moved("ArrowRight") == 0
    before = pictures()
    line.focus()
    page.keyboard.press("Enter")
    assert come(lambda: pictures() > before)  # with the newest attitude
    assert moved("ArrowLeft") >= 1


@pytest.mark.browser
@in_browser
@pytest.mark.parametrize("width", [900, 420])
def test_a_narrow_window_cuts_no_control(tab_of_own: Any, width: int) -> None:
    page = tab_of_own
    kinds = "button, input, .q-checkbox, .q-slider, canvas"
    cut = f"""() => [...document.querySelector(".lab").querySelectorAll("{kinds}")]
      .filter(one => one.checkVisibility() && one.getBoundingClientRect().width > 2)
      .map(one => [one.ariaLabel || one.innerText || one.className, one.getBoundingClientRect()])
      .filter(([_, box]) => box.left < 0 || box.right > innerWidth + 1).map(([name]) => name)"""
    panel(page, "Log")
    page.set_viewport_size({"width": width, "height": 800})
    for name in ("Run", "Lights", "Scene", "Monte Carlo"):
        panel(page, name)
        page.wait_for_timeout(500)
        assert page.evaluate(cut) == []
        space = page.locator(".lab-space canvas").first
        assert come(lambda: space.bounding_box()["width"] > 0.8 * width)  # noqa: B023
        assert space.bounding_box()["height"] > 300
        assert page.locator(".lab-frame canvas").bounding_box()["width"] > 0.5 * width
        pictured(page, f"narrow_{width}_{name.replace(' ', '_')}")
    page.set_viewport_size(NARROW)
    onto_the_page(page)
