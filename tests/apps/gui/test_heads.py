"""Every camera of a scene is shown as the command line has it; LEDs that blink codes are named after some frames."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.worker.tasks import Worker
from skysim.results.scoring import Score
from skysim.scene import loader
from skysim.simulation.flight import open_flight
from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    address,
    come,
    onto_the_page,
    open_scene,
    opened,
    pictured,
    simulate,
)
from tests.helpers.solutions import flown, numbers

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")


@pytest.mark.slow
def test_a_further_camera_s_rows_are_those_of_the_command_line() -> None:
    worker = Worker()
    overrides = {"exposure.frames": "3"}
    main, _ = worker.open("two_heads", overrides, False)
    assert (main.heads, main.head) == (("main", "side"), "main")
    moved = worker.move(0.1, 0.0, 0.0, False)
    info, view = worker.open("two_heads", overrides, False, None, "side")
    assert info.head == "side"
    np.testing.assert_array_equal(view.body_wxyz, moved.body_wxyz)  # the vehicle stays
    rows_of_side = flown(worker)
    flight = open_flight(loader.load("two_heads", overrides))
    expected = [Score(shot).row for shot in flight.shots(cameras=[1])]
    assert [numbers(one.row) for one in rows_of_side] == [numbers(row) for row in expected]
    # A kept frame is the camera's own.
    worker.flight_frame(2)
    worker.export()
    frame = worker.workbench.frame
    assert frame is not None
    np.testing.assert_array_equal(frame.image_dn, flight.render(2, 1)[0].image_dn)
    # Without such a camera the main one is shown.
    other, _ = worker.open("shefex2", {}, False, None, "side")
    assert other.head == "main"


@pytest.mark.slow
def test_leds_are_named_by_further_frames_of_the_same_run_only() -> None:
    worker = Worker()
    info, view = worker.open("coded_spiral", {}, True)
    assert info.code_frames == 2 * 19  # bits
    frames = 1
    while view.result and not view.result.row.estimate_deg and frames < info.code_frames:
        view = worker.render_next(frames, True)
        frames += 1
    assert view.result
    assert 3 <= frames < 19
    assert not view.result.row.wrong
    assert {spot.id for spot in view.result.detections} == set(view.lights.id.tolist())
    # New runs show the first bit again.
    for _ in range(frames):
        view = worker.render(True)
        assert view.result
        assert view.result.row.estimate_deg is None
    assert worker.open("shefex2", {}, False)[0].code_frames == 0


# In the browser.


@pytest.mark.browser
@in_browser
def test_a_camera_is_chosen_and_is_in_the_address(browser: Any, server: Server) -> None:
    with opened(browser, server.login, NARROW) as page:
        camera = page.get_by_role("combobox", name="Camera")
        assert not camera.is_visible()
        open_scene(page, "two_heads")
        before = page.locator(".lab-angle").first.input_value()
        camera.click()
        page.get_by_role("option", name="side").click()
        assert come(lambda: page.locator(".lab-angle").first.input_value() != before)
        assert come(lambda: address(page).endswith("&head=side"))
        page.keyboard.press("Control+z")
        assert come(lambda: page.locator(".lab-angle").first.input_value() == before)
        assert camera.input_value() == "main"
        page.keyboard.press("Control+Shift+z")
        assert come(lambda: camera.input_value() == "side")
        # A key leaves the camera, another scene does not have it.
        simulate(page, 4)
        page.get_by_text(re.compile(r"4/4$")).wait_for()
        assert come(lambda: "head=side" in address(page))
        page.reload()
        page.get_by_text(re.compile(r"^flight at ")).wait_for()
        assert come(lambda: camera.input_value() == "side")
        pictured(page, "a_further_camera")
        open_scene(page, "shefex2")
        assert come(lambda: "head=" not in address(page))
        assert not camera.is_visible()


@pytest.mark.browser
@in_browser
@pytest.mark.parametrize(
    ("query", "told"),
    [
        ("scene=two_heads&head=nose", "two_heads has no camera 'nose'; allowed: main, side"),
        ("scene=shefex2&study=none_such", "study 'none_such' is not in the folder"),
        ("scene=shefex2&view=replay&study=nope&trial=3", "study 'nope' is not in the folder"),
        ("scene=shefex2&set=camera.fov=3", "camera.fov: unknown key; allowed: "),
        ("scene=shefex2&at=1e300,0,0", "allowed: 0 to 360"),
        ("scene=shefex2&at=1,2", "three angles"),
        ("scene=shefex2&trial=x", "at, t, trial; allowed: numbers"),
    ],
)
def test_an_address_with_a_wrong_value_says_so(
    browser: Any, server: Server, query: str, told: str
) -> None:
    """The page shows what it can of the address, and no key of it is dropped without a word."""
    with opened(browser, server.login, NARROW) as page:
        page.goto(f"{server.url}?{query}")
        page.get_by_role("status").filter(has_text=told).wait_for()


@pytest.mark.browser
@in_browser
def test_key_1_reads_the_codes_until_the_leds_are_named(browser: Any, server: Server) -> None:
    with opened(browser, f"{server.login}", NARROW) as page:
        page.goto(f"{server.url}?scene=coded_spiral")
        page.get_by_text(re.compile("^codes: too few lights")).wait_for()
        onto_the_page(page)
        page.keyboard.press("1")
        page.get_by_text(re.compile(r"^after \d+ frames: LED \d+(, LED \d+){3}$")).wait_for()
        page.get_by_text(re.compile(r"^solved; 4 of 4 lights identified")).wait_for()
        pictured(page, "named_by_codes")
