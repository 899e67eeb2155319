"""Speed of the browser GUI in Chromium: frames per second while a key is held, what a frame takes over the websocket,
latency from key to image, and the time until a page shows its first frame.

`python -m benchmarks.gui [SECONDS]` serves shefex2 with a detector of 1024 x 1024 pixels and prints the numbers for
screens of 1280 x 800 and 1920 x 1080. Every frame is solved. A browser without a graphics card draws on the same cores
that render the frames.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

SCENE = """schema: 1
base: shefex2
title: SHEFEX-2 with a square megapixel
camera: {width_px: 1024, height_px: 1024}
"""
SIZES = ((1280, 800), (1920, 1080))
PRESSES = 30
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
LOADS = """() => { window.came = [];
 new MutationObserver(() => window.came.push(performance.now())).observe(
 document.querySelector('.lab-frame canvas'), {attributeFilter: ['data-frame']}); }"""


@contextmanager
def served(name: str) -> Iterator[str]:
    """Start a GUI server for a scene; yields its address."""
    with tempfile.TemporaryDirectory() as folder, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        command = [sys.executable, "-m", "skysim", "gui", name, "--no-open", "--port", str(port), "--token", "bench"]
        server = subprocess.Popen([*command, "--out", folder], start_new_session=True)
        try:
            yield reached(f"http://127.0.0.1:{port}/?token=bench")
        finally:
            os.killpg(server.pid, signal.SIGTERM)
            server.wait(10)


def reached(url: str) -> str:
    """Wait until a server responds at the address, and return it. Raises TimeoutError."""
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())  # the token is passed on as a cookie
    for _ in range(600):
        try:
            opener.open(url, timeout=2).read()
            return url
        except OSError:
            time.sleep(0.1)
    raise TimeoutError(url)


def held(page: Any, seconds: float) -> float:
    """Frames per second while an arrow key is held."""
    page.evaluate("() => { window.came = [] }")
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        page.keyboard.down("ArrowLeft")
        time.sleep(0.03)  # a keyboard's repeat interval
    page.keyboard.up("ArrowLeft")
    return float(page.evaluate("window.came.length")) / seconds


def delays_ms(page: Any) -> np.ndarray:
    """(PRESSES,) milliseconds from a key press to the next image."""
    found = []
    for _ in range(PRESSES):
        before = page.evaluate("window.came.length")
        begin = page.evaluate("performance.now()")
        page.keyboard.press("ArrowRight")
        page.wait_for_function(f"window.came.length > {before}", polling=5)
        found.append(page.evaluate(f"window.came[{before}]") - begin)
        page.wait_for_timeout(150)
    return np.array(found)


def main(seconds: float) -> None:
    """Print the numbers for each screen size."""
    from playwright.sync_api import sync_playwright

    print("screen       frames/s   kB/frame   key to picture: median, 90 %, ms   page, s")
    print("bars               30         20                           60      90         3")
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "square.yaml"
        scene.write_text(SCENE)
        with served(str(scene)) as url, sync_playwright() as driver:
            measured(driver, url, seconds)


def measured(driver: Any, url: str, seconds: float) -> None:
    """Print one line per screen size."""
    browser = driver.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
    for width, height in SIZES:
        page, received = browser.new_page(viewport={"width": width, "height": height}), []
        page.on("websocket", partial(count_bytes, received))
        begin = time.monotonic()
        page.goto(url)
        page.locator(".lab-frame canvas[data-frame]").wait_for(timeout=90_000)
        shown_s = time.monotonic() - begin
        page.locator(".lab-card .good").wait_for(timeout=90_000)
        page.wait_for_timeout(20_000)  # the server starts the spare worker for the next tab
        page.evaluate(LOADS)
        received.clear()
        rate = held(page, seconds)
        frame_kb = sum(received) / 1e3 / max(rate * seconds, 1)
        late = delays_ms(page)
        middle, most = np.quantile(late, [0.5, 0.9])
        numbers = f"{rate:8.1f}   {frame_kb:8.1f}   {middle:26.0f} {most:7.0f}   {shown_s:7.1f}"
        print(f"{width} x {height:<6d} {numbers}", flush=True)
        page.close()
    browser.close()


def count_bytes(received: list[int], socket: Any) -> None:
    """Note the length of each message that a websocket receives, before compression."""
    socket.on("framereceived", lambda message: received.append(len(message)))


def chromium() -> str:
    """Path of the browser. Raises StopIteration if there is none."""
    return next(path for name in BROWSERS if (path := shutil.which(name)))


if __name__ == "__main__":
    main(float((sys.argv[1:] or ["6"])[0]))
