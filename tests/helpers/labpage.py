"""A server of the lab's page and a browser for it: fixtures and helpers of test_lab_page and test_lab_work."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skysim.core.paths import ROOT

CHROMIUM = next(
    (
        found
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (found := shutil.which(name))
    ),
    "",
)
PICTURES = ROOT / "out" / "screenshots"
SLOW_MS = 600_000  # a first compilation on a busy machine
QUICK_MS = 90_000
TOKEN = "right"
STAGES = ("detector", "centroider", "identifier", "solver")
WIDE = {"width": 1920, "height": 1080}
NARROW = {"width": 1280, "height": 800}


class Server:
    """A process that serves the page, with a folder of its own."""

    def __init__(
        self,
        folder: Path,
        *options: str,
        host: str = "127.0.0.1",
        program: Sequence[str] = (sys.executable, "-m", "skysim"),
        cwd: Path = ROOT,
    ) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.folder = folder
        self.out = folder / "out"
        command = [
            *program,
            "gui",
            "shefex2",
            "--no-open",
            "--port",
            str(self.port),
        ]
        place = [
            "--host",
            host,
            "--folder",
            str(folder),
            "--out",
            str(self.out),
            "--token",
            TOKEN,
        ]
        # With pytest's own variable NiceGUI takes the server for a test of itself.
        environment = {
            name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"
        }
        self.process = subprocess.Popen(
            [*command, *place, *options], cwd=cwd, env=environment, start_new_session=True
        )
        self.url = f"http://127.0.0.1:{self.port}/"
        self.login = f"{self.url}?token={TOKEN}"

    def __enter__(self) -> Server:
        for _ in range(1200):
            with contextlib.suppress(OSError):
                self.status()
                return self
            assert self.process.poll() is None, "the server ended"
            time.sleep(0.1)
        raise TimeoutError("the server does not answer")

    def __exit__(self, *_: object) -> None:
        os.killpg(self.process.pid, signal.SIGTERM)
        self.process.wait(60)

    def status(self, path: str = "", **headers: str) -> int:
        """HTTP status of a request without browser and token cookie."""
        asked = urllib.request.Request(self.url + path, headers=headers)
        try:
            return int(urllib.request.urlopen(asked, timeout=5).status)
        except urllib.error.HTTPError as error:
            return error.code

    def children(self, word: str) -> list[Any]:
        """Its child processes whose command contains a word."""
        psutil = pytest.importorskip("psutil")
        found = []
        for one in psutil.Process(self.process.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):  # ended meanwhile
                found += [one] * (word in " ".join(one.cmdline()))
        return found

    def come_to(self, word: str, count: int) -> int:
        """Number of such processes: the expected one as soon as it is reached, else that at the time limit."""
        come(lambda: len(self.children(word)) == count)
        return len(self.children(word))


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The server of most tests."""
    pytest.importorskip("nicegui", reason="the extra `gui` is not installed")
    with Server(tmp_path_factory.mktemp("lab")) as found:
        yield found


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium without a screen."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="the extra `browser` is not installed"
    )
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--enable-unsafe-swiftshader"]
        )
        yield found
        found.close()


@pytest.fixture(scope="module")
def tab(browser: Any, server: Server) -> Iterator[Any]:
    """One tab shared by most tests, as a person keeps it open."""
    with opened(browser, server.login, NARROW) as found:
        yield found


@pytest.fixture
def page(tab: Any, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The tab with its first panel shown; saves a screenshot after the test."""
    tab.get_by_role("tab", name="Run").click()
    tab.get_by_role("button", name="fit", exact=True).click()
    yield tab
    pictured(tab, request.node.name)


@pytest.fixture(scope="module")
def second(browser: Any, server: Server) -> Iterator[Any]:
    """Another tab."""
    with opened(browser, server.login, NARROW) as found:
        yield found


def pictured(page: Any, name: str) -> None:
    """Save a screenshot of the page. CI saves none."""
    if os.environ.get("CI"):
        return
    PICTURES.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=PICTURES / f"{name}.png")


class opened:
    """A tab that is closed after use."""

    def __init__(self, browser: Any, address: str, size: dict[str, int]) -> None:
        self.page = browser.new_page(viewport=size)
        self.page.set_default_timeout(SLOW_MS)
        self.faults: list[str] = []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.goto(address)
        status(self.page, "solved")
        self.page.locator(".lab-frame canvas[data-frame]").wait_for()
        self.page.set_default_timeout(QUICK_MS)
        # No person types in the moment in which fields are filled in.
        self.page.wait_for_timeout(300)

    def __enter__(self) -> Any:
        return self.page

    def __exit__(self, *_: object) -> None:
        self.page.close()
        assert self.faults == []


def status(page: Any, starts: str) -> str:
    """Wait until the tracker's status starts with this text; return it."""
    found = page.locator(".lab-card .mono", has_text=re.compile(f"^{starts}"))
    found.first.wait_for()
    return str(found.first.inner_text())


def address(page: Any) -> str:
    """The address now. `page.url` keeps the former one until Playwright has handled the browser's messages."""
    return str(page.evaluate("location.href"))


def angles(page: Any) -> np.ndarray:
    """The three typed angles."""
    return np.array(
        [float(field.input_value()) for field in page.locator(".lab-angle").all()]
    )


def source(page: Any) -> str:
    """URL of the drawn frame."""
    return str(page.locator(".lab-frame canvas").get_attribute("data-frame"))


def changed(page: Any, before: str) -> None:
    """Wait for another frame."""
    page.wait_for_function(
        "before => ![undefined, before].includes(document.querySelector('.lab-frame canvas').dataset.frame)",
        arg=before,
        polling=50,  # by default at each repainting, which takes the processor from who computes the frame
    )


def come(true: Callable[[], bool], within_s: float = QUICK_MS / 1000) -> bool:
    """Whether a condition becomes true within a time limit."""
    until = time.monotonic() + within_s
    while not (found := true()) and time.monotonic() < until:
        time.sleep(0.1)
    return found


def panel(page: Any, name: str) -> None:
    page.get_by_role("tab", name=name).click()


def chosen(page: Any, name: str, option: str) -> None:
    """Choose from a list."""
    page.get_by_role("combobox", name=name).click()
    page.get_by_role("option", name=re.compile(f"^{re.escape(option)}(:|$)")).click()


def open_scene(page: Any, name: str) -> None:
    """Choose a scene from the list and wait for its first frame."""
    frame = source(page)
    chosen(page, "Scene", name)
    changed(page, frame)
    status(page, "solved")


def choose_stage(page: Any, stage: str, algorithm: str) -> None:
    """Choose an algorithm of the tracker in the panel that F6 or F7 opens."""
    key, first = (
        ("F6", "detector") if stage in ("detector", "centroider") else ("F7", "identifier")
    )
    onto_the_page(page)
    page.keyboard.press(key)
    # The panel takes the focus once its part is open; before, it would take it from what the test does next.
    field = page.get_by_role("combobox", name=f"tracker.{first}")
    assert come(lambda: field.evaluate("at => at.contains(document.activeElement)"))
    chosen(page, f"tracker.{stage}", algorithm)
    before = "(default|[a-z_ ]+) · " * STAGES.index(stage)
    page.get_by_text(re.compile(rf"^stages \(F6, F7\): {before}{algorithm}\b")).wait_for()


def set_to(page: Any, name: str, value: str) -> None:
    """Type a key's value in the forms and wait for the result."""
    frame = source(page)
    field = page.get_by_label(name, exact=True)
    field.fill(value)
    field.press("Enter")
    changed(page, frame)


def simulate(page: Any, frames: int) -> None:
    """Start to compute a flight of this number of frames."""
    panel(page, "Scene")
    page.get_by_placeholder("find a key").fill("exposure.frames")
    set_to(page, "exposure.frames", str(frames))
    onto_the_page(page)
    panel(page, "Run")
    page.get_by_role("button", name="Simulate").click()


def onto_the_page(page: Any) -> None:
    """Remove the keyboard focus from the field."""
    page.locator(".lab-frame").click(position={"x": 5, "y": 5})


def exported(page: Any, kind: str, folder: Path) -> Path:
    """Download a file from the page."""
    page.get_by_role("button", name="Export").click()
    with page.expect_download() as comes:
        page.locator(".q-menu .q-item", has_text=re.compile(f"^{kind}$")).click()
    page.locator(".q-menu").wait_for(state="detached")
    path = folder / comes.value.suggested_filename
    comes.value.save_as(path)
    return path


def brightness(page: Any) -> float:
    """Mean brightness of the canvas, 0 to 255."""
    screenshot = page.locator(".lab-frame canvas").screenshot()
    return float(
        cv2.imdecode(np.frombuffer(screenshot, np.uint8), cv2.IMREAD_GRAYSCALE).mean()
    )


def screen(page: Any, x: float, y: float) -> tuple[float, float]:
    """Screen position of a frame's pixel."""
    box = page.locator(".lab-frame canvas").bounding_box()
    left, top, scale = map(
        float, page.locator(".lab-frame canvas").get_attribute("data-placement").split()
    )
    return box["x"] + left + (x + 0.5) * scale, box["y"] + top + (y + 0.5) * scale


def frame_pixel(page: Any, x: float, y: float) -> tuple[float, float]:
    """Pixel of a frame at a screen position."""
    (left, top), (right, below) = screen(page, 0, 0), screen(page, 1, 1)
    return (x - left) / (right - left), (y - top) / (below - top)


def picture(page: Any, **how: Any) -> np.ndarray:
    """(H, W, 3) of the screen, whole numbers that can be subtracted."""
    return cv2.imdecode(
        np.frombuffer(page.screenshot(**how), np.uint8), cv2.IMREAD_COLOR
    ).astype(int)


def pixels(page: Any) -> list[tuple[int, int, int]]:
    """(x, y, DN) of the pixels shown enlarged."""
    label = page.locator(".lab-loupe[aria-label^=pixels]").get_attribute("aria-label")
    x, y, across, down, *values = map(int, re.findall(r"\d+", label))
    assert len(values) == across * down
    return [(x + n % across, y + n // across, dn) for n, dn in enumerate(values)]


def differs(page: Any, before: np.ndarray, box: tuple[int, int, int, int]) -> bool:
    """Whether a part of the screen (left, top, right, bottom) differs from an earlier picture."""
    left, top, right, bottom = box
    clip = {"x": left, "y": top, "width": right - left, "height": bottom - top}
    return bool(
        (np.abs(picture(page, clip=clip) - before[top:bottom, left:right]) > 20).sum() > 30
    )
