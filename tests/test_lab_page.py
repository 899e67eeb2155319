"""The lab's page in Chromium, by Playwright. Skipped where either is missing; pictures in out/screenshots."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skysim.quantity import ROOT

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
pytestmark = [pytest.mark.browser, pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")]

SERVER: list[int] = []  # its process
PICTURES = ROOT / "out" / "screenshots"
SLOW_MS = 150_000  # a first compilation on a busy machine
WIDE, NARROW = {"width": 1920, "height": 1080}, {"width": 1280, "height": 800}


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server with a folder of its own."""
    pytest.importorskip("nicegui", reason="the extra `lab` is not installed")
    folder = tmp_path_factory.mktemp("lab")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "skysim", "lab", "shefex2", "--no-open", "--port", str(port)]
    told = ["--folder", str(folder), "--out", str(folder / "out")]
    # With pytest's own variable NiceGUI takes the server for a test of itself.
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    server = subprocess.Popen([*command, *told], cwd=ROOT, env=environment, start_new_session=True)
    url = f"http://127.0.0.1:{port}/"
    try:
        for _ in range(300):
            try:
                urllib.request.urlopen(url, timeout=2).read()
                break
            except OSError:
                assert server.poll() is None, "the server ended"
                time.sleep(0.1)
        SERVER.append(server.pid)
        yield url
    finally:
        os.killpg(server.pid, signal.SIGTERM)
        server.wait(10)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium without a screen."""
    playwright = pytest.importorskip("playwright.sync_api", reason="the extra `browser` is not installed")
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--enable-unsafe-swiftshader"]
        )
        yield found
        found.close()


@pytest.fixture(scope="module")
def tab(browser: Any, address: str) -> Iterator[Any]:
    """A tab for most tests, one after the other, as a person has it open."""
    with opened(browser, address, NARROW) as found:
        yield found


@pytest.fixture
def page(tab: Any, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The tab, with its first panel before it; a picture of how the test left it."""
    tab.get_by_role("tab", name="Lab").click()
    yield tab
    pictured(tab, request.node.name)


@pytest.fixture(scope="module")
def second(browser: Any, address: str) -> Iterator[Any]:
    """Another tab."""
    with opened(browser, address, NARROW) as found:
        yield found


def pictured(page: Any, name: str) -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=PICTURES / f"{name}.png")


class opened:
    """A tab, closed in the end."""

    def __init__(self, browser: Any, address: str, size: dict[str, int]) -> None:
        self.page = browser.new_page(viewport=size)
        self.page.set_default_timeout(SLOW_MS)
        self.faults: list[str] = []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.goto(address)
        status(self.page, "solved")
        self.page.locator(".lab-frame canvas[data-frame]").wait_for()
        self.page.wait_for_timeout(300)  # no person types in the moment in which fields are filled in

    def __enter__(self) -> Any:
        return self.page

    def __exit__(self, *_: object) -> None:
        self.page.close()
        assert self.faults == []


def status(page: Any, starts: str) -> str:
    """The tracker's status, once it begins so."""
    found = page.locator(".lab-card .mono", has_text=re.compile(f"^{starts}"))
    found.first.wait_for()
    return str(found.first.inner_text())


def angles(page: Any) -> np.ndarray:
    """The three typed angles."""
    return np.array([float(page.get_by_label(f"angle {n}").input_value()) for n in (1, 2, 3)])


def source(page: Any) -> str:
    """Which frame is drawn."""
    return str(page.locator(".lab-frame canvas").get_attribute("data-frame"))


def changed(page: Any, before: str) -> None:
    """Wait for another frame."""
    page.wait_for_function(
        "before => document.querySelector('.lab-frame canvas').dataset.frame !== before", arg=before
    )


def test_it_shows_a_solved_frame_with_names_and_a_map_of_keys(page: Any) -> None:
    assert re.match(r"solved; \d+ of \d+ lights named", status(page, "solved"))
    page.get_by_role("img", name="Mintaka").wait_for()  # of Orion's belt
    shown = page.locator(".lab-keys").first.inner_text()
    assert all(name in shown for name in ("F1", "F5", "F6", "F7", "F8", "F10", "E R", "1", "2"))


def test_nothing_is_cut_off_or_scrolls_at_either_size(page: Any) -> None:
    for size in (WIDE, NARROW):
        page.set_viewport_size(size)
        page.wait_for_timeout(300)
        box = page.locator(".lab-frame canvas").bounding_box()
        assert box["x"] > 0
        assert box["x"] + box["width"] < size["width"]
        assert box["y"] + box["height"] < size["height"]
        assert box["width"] > 0.45 * size["width"]
        root = "document.documentElement"
        assert not page.evaluate(f"{root}.scrollHeight > innerHeight || {root}.scrollWidth > innerWidth")
        pictured(page, f"size_{size['width']}")


def test_keys_slew_and_the_frame_does_not_jump(page: Any) -> None:
    before, box = angles(page), page.locator(".lab-frame canvas").bounding_box()
    for key, coarse in (("ArrowRight", False), ("ArrowUp", True), ("r", False)):
        frame = source(page)
        page.keyboard.press(f"Shift+{key}" if coarse else key)
        changed(page, frame)
        status(page, "solved")
    after = angles(page)
    turned = after - before
    assert 2 < abs(turned[1]) < 4  # a fifth of 14.9 degrees, at a roll of 20
    assert -1.3 < turned[2] < -0.7  # clockwise: up turns to the west; the rest is the meridians'
    assert page.locator(".lab-frame canvas").bounding_box() == box


def test_a_key_that_repeats_loses_no_step(page: Any) -> None:
    before = angles(page)[2]
    for _ in range(20):
        page.keyboard.down("e")  # faster than frames are made
    page.keyboard.up("e")
    page.wait_for_timeout(300)
    after = before
    for _ in range(100):
        if abs(after - before) > 19.9:
            break
        page.wait_for_timeout(50)
        after = angles(page)[2]
    np.testing.assert_allclose((after - before + 180) % 360 - 180, 20, rtol=0, atol=1e-3)
    assert status(page, "solved")


def test_the_marks_are_drawn_on_their_stars(page: Any) -> None:
    green = """() => { const canvas = document.querySelector('.lab-frame canvas');
      const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
      let count = 0;
      for (let n = 0; n < data.length; n += 4) count += data[n + 1] > data[n] + 40 && data[n + 1] > data[n + 2] + 40;
      return count; }"""
    assert page.evaluate(green) > 500
    page.get_by_role("checkbox", name="identified").click()
    page.wait_for_function(f"() => ({green})() === 0")
    page.get_by_role("checkbox", name="identified").click()
    page.wait_for_function(f"() => ({green})() > 500")


def test_an_attitude_is_typed_and_1_identifies_it(page: Any) -> None:
    page.keyboard.press("F5")
    for n, angle in enumerate(("120", "-30", "0"), 1):
        page.get_by_label(f"angle {n}").fill(angle)
    frame = source(page)
    page.get_by_label("angle 3").press("Enter")
    changed(page, frame)
    np.testing.assert_allclose(angles(page), (120, -30, 0), rtol=0, atol=1e-3)
    page.locator(".lab-frame").click(position={"x": 5, "y": 5})
    frame = source(page)
    page.keyboard.press("1")
    changed(page, frame)
    assert status(page, "solved")


def test_another_identifier_by_f7(page: Any) -> None:
    page.keyboard.press("F7")
    page.get_by_role("option", name="pyramid").click()
    page.get_by_role("tab", name="Log").click()
    page.get_by_text("opened shefex2 with tracker.identifier").wait_for()
    assert status(page, "solved")


def test_monte_carlo_of_200_by_2(page: Any) -> None:
    page.keyboard.press("2")
    page.get_by_text("200 of 200 trials").wait_for()
    told = page.get_by_text("identified", exact=False).last.inner_text()
    assert float(re.search(r"identified\s+([\d.]+)", told)[1]) > 0.9
    with page.expect_popup() as opens:
        page.locator("a[href^='/report/']").first.click()
    assert "Monte Carlo of" in opens.value.title()
    opens.value.close()


def test_a_dropped_picture_is_solved_and_one_without_stars_refused(page: Any, tmp_path: Path) -> None:
    before = angles(page)
    page.get_by_role("tab", name="Image").click()
    page.set_input_files("input[type=file]", ROOT / "docs" / "sky.jpg")
    page.get_by_text("sky.jpg: solved").wait_for()
    assert page.get_by_label("angle 1").input_value() == ""  # nobody knows where it was taken
    noise = tmp_path / "noise.png"
    cv2.imwrite(str(noise), np.random.default_rng(1).integers(90, 110, (480, 640), dtype=np.uint8))
    page.set_input_files("input[type=file]", noise)
    page.get_by_text(re.compile(r"noise\.png: (?!solved|solving)")).wait_for()
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    page.set_input_files("input[type=file]", broken)
    page.get_by_text("cannot be decoded").first.wait_for()
    frame = source(page)
    page.keyboard.press("1")
    changed(page, frame)
    np.testing.assert_array_equal(angles(page), before)


def test_bad_input_is_refused_where_it_stands(page: Any) -> None:
    page.get_by_label("angle 2").fill("95")
    page.get_by_label("angle 2").press("Enter")
    page.get_by_text("Dec: 95 deg is not allowed").first.wait_for()
    page.get_by_role("tab", name="Scene").click()
    page.get_by_role("button", name='Expand "camera"').click()
    page.get_by_label("camera.focal_length", exact=True).fill("35 mmm")
    page.get_by_label("camera.focal_length", exact=True).press("Enter")
    page.get_by_text("'35 mmm' is not a length; allowed").wait_for()
    page.get_by_label("camera.focal_length", exact=True).fill("50 mm")
    frame = source(page)
    page.get_by_label("camera.focal_length", exact=True).press("Enter")
    changed(page, frame)
    page.get_by_placeholder("new-name").fill("../out")
    page.get_by_role("button", name="Save as").click()
    page.get_by_text("allowed: letters, digits").first.wait_for()


def test_a_dome_is_flown_and_played(page: Any) -> None:
    page.get_by_role("combobox", name="Scene").click()
    page.get_by_role("option", name="simsat_slew").click()
    page.get_by_text("SimSat slews on its reaction wheels").wait_for()
    status(page, "solved")
    page.get_by_role("tab", name="Run").click()
    page.get_by_role("button", name="Fly").click()
    page.get_by_text(re.compile(r"^[1-9]\.\d\d s$")).wait_for()  # plays by itself
    assert status(page, "solved")
    page.get_by_role("button", name="Play").click()


def test_two_tabs_do_not_disturb_one_another(page: Any, second: Any) -> None:
    still = angles(page)
    frame = source(second)
    second.keyboard.press("Shift+ArrowDown")
    changed(second, frame)
    assert not np.allclose(angles(second), still, rtol=0, atol=0.1)
    np.testing.assert_array_equal(angles(page), still)


def test_closing_a_tab_ends_its_worker(page: Any, second: Any) -> None:
    psutil = pytest.importorskip("psutil")

    def come_to(count: int) -> int:
        """How many workers the server has, once they are so many, else after a while."""
        for _ in range(150):
            children = psutil.Process(SERVER[0]).children(recursive=True)
            found = sum("spawn_main" in " ".join(one.cmdline()) for one in children)
            if found == count:
                break
            time.sleep(0.1)
        return found

    assert come_to(3) == 3  # two tabs, and one worker that waits for the next
    second.close()
    assert come_to(2) == 2
