"""The lab in the browser: frames per second, latency, traffic, memory and the twentieth tab, in Chromium.

`python -m benchmarks lab` serves shefex2 with a detector of 1024 x 1024 pixels and 120 frames at 40 Hz; every frame is
solved. A browser without a graphics card draws on the same cores that render the frames, so the processor time of
server and browser is measured too: it depends less on what else the machine does. `SKYSIM_BENCH_TABS` is the number of
tabs that are opened and closed for the memory, 30 by default, and `SKYSIM_BENCH_PLAY_S` the time of playing, 120 s.

The tabs share a browser's cache, as a person's do. Those of the crowd are in another browser of the lowest priority,
since people have their own computers.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil

from benchmarks.timing import verdict
from skysim.apps.gui.server import QUIET_S, RECONNECT_S
from skysim.core.types import Floats

SCENE = """schema: 1
base: shefex2
title: SHEFEX-2 with a square megapixel
camera: {width_px: 1024, height_px: 1024}
exposure: {time: "20 ms", rate_hz: 40, frames: 120, first: "0.1 s"}
"""
SIZES = ((1280, 800), (1920, 1080))
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--no-sandbox", "--enable-unsafe-swiftshader")
TOKEN = "bench"
WORKERS_LIMIT = 4
HELD_S = 6.0
REPEAT_S = 0.03  # a keyboard's repeat interval
PRESSES = 30
CROWD = 20
# the first load code
WARM_TABS = 3
TABS = int(os.environ.get("SKYSIM_BENCH_TABS", "30"))
PLAY_S = float(os.environ.get("SKYSIM_BENCH_PLAY_S", "120"))
LOOK_S = 2.0
COLLECTED_S = 2 * QUIET_S  # until a closed page is collected
IDLE_S = 0.1  # processor time in a second of a server that waits
WARM_S = 180.0  # for compiling and loading on a busy machine
# When a frame was drawn and a key went down, by the page's clock.
WATCH = """() => { window.drawn = []; window.pressed = [];
 new MutationObserver(() => window.drawn.push(performance.now())).observe(
   document.querySelector('.lab-frame canvas'), {attributeFilter: ['data-frame']});
 document.addEventListener('keydown', event => window.pressed.push(event.timeStamp), true); }"""
# Whether the clock of the flight shows a frame. Looks at each of the browser's pictures would take time of their own.
CLOCK = """frame => [...document.querySelectorAll('.lab-panels .mono')].some(
  one => new RegExp(`${frame}$`).test(one.textContent))"""
LOOK_MS = 100


class Traffic:
    """Bytes that a page has received: over its websocket before compression, and over HTTP."""

    def __init__(self, page: Any) -> None:
        self.websocket = self.http = 0
        page.on("websocket", lambda opened: opened.on("framereceived", self.count_message))
        network = page.context.new_cdp_session(page)
        network.send("Network.enable")
        network.on("Network.dataReceived", self.count_data)

    def count_message(self, message: Any) -> None:
        self.websocket += len(message)

    def count_data(self, part: Any) -> None:
        self.http += int(part["dataLength"])


class Server:
    """A process that serves the page of a scene, with a limit on its workers."""

    def __init__(self, scene: str, folder: str, workers: int = 12) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        command = [
            sys.executable,
            "-m",
            "skysim",
            "gui",
            scene,
            "--no-open",
            "--port",
            str(port),
            "--token",
            TOKEN,
        ]
        places = ["--out", folder, "--folder", folder, "--workers", str(workers)]
        self.process = psutil.Popen(
            [*command, *places], start_new_session=True, stdout=subprocess.DEVNULL
        )
        self.url = f"http://127.0.0.1:{port}/?token={TOKEN}"

    def workers(self) -> list[psutil.Process]:
        """Its worker processes, the oldest first."""
        templates = [
            one
            for one in self.process.children()
            if "gui.template" in " ".join(one.cmdline())
        ]
        return sorted(
            (one for template in templates for one in template.children()),
            key=psutil.Process.create_time,
        )

    def cpu_s(self) -> float:
        """Processor time of it and its workers."""
        return sum(
            cpu_s(one) for one in [self.process, *self.process.children(recursive=True)]
        )

    def settle(self, workers: int) -> None:
        """Wait until it has so many workers, and all of them wait for work."""
        end = time.monotonic() + WARM_S
        idle = False
        while not idle and time.monotonic() < end:
            before = self.cpu_s()
            time.sleep(1.0)
            idle = len(self.workers()) == workers and self.cpu_s() - before < IDLE_S

    def memory_mb(self) -> float:
        """Its own memory, without that which it shares with others."""
        return float(self.process.memory_full_info().uss) / 1e6


@contextmanager
def served(scene: str, workers: int = 12) -> Iterator[Server]:
    """Start a GUI server for a scene."""
    with tempfile.TemporaryDirectory() as folder:
        server = Server(scene, folder, workers)
        try:
            reached(server.url)
            yield server
        finally:
            os.killpg(server.process.pid, signal.SIGTERM)
            server.process.wait(30)


def cpu_s(process: psutil.Process) -> float:
    """Processor time of a process; 0 if it has ended."""
    try:
        times = process.cpu_times()
        return float(times.user + times.system)
    except psutil.Error:
        return 0.0


def browser_cpu_s() -> float:
    """Processor time of the browser that this process has started."""
    children = psutil.Process().children(recursive=True)
    return sum(cpu_s(one) for one in children if "chrom" in one.name())


def reached(url: str) -> None:
    """Wait until a server responds at the address. Raises TimeoutError."""
    # The token is passed on as a cookie.
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    end = time.monotonic() + WARM_S
    while time.monotonic() < end:
        with suppress(OSError):
            opener.open(url, timeout=2).read()
            return
        time.sleep(0.1)
    raise TimeoutError(url)


def chromium() -> str:
    """Path of the browser. Raises StopIteration if there is none."""
    return next(path for name in BROWSERS if (path := shutil.which(name)))


def measure() -> list[dict[str, Any]]:
    """Speed on two sizes of screen, then memory over tabs, then a crowd of tabs."""
    from playwright.sync_api import sync_playwright

    rows = []
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        scene = Path(folder) / "square.yaml"
        scene.write_text(SCENE)
        browser, other = (
            driver.chromium.launch(executable_path=chromium(), args=list(FLAGS))
            for _ in range(2)
        )
        tabs = browser.new_context()
        with served(str(scene)) as server:
            opened(tabs, server).close()  # compiles what is not in the cache
            for size in SIZES:
                rows += speed(tabs, server, size)
            rows += [memory(tabs, server), playing(tabs, server)]
        with served("shefex2", WORKERS_LIMIT) as server:
            rows += crowd(tabs, other, server)
        browser.close()
    return rows


def say(text: str) -> None:
    """Progress, as a run takes minutes."""
    print(f"lab: {text}", file=sys.stderr, flush=True)


def new_page(tabs: Any, size: tuple[int, int] = SIZES[0]) -> Any:
    """A new, empty tab. tabs : a browser's context"""
    page = tabs.new_page()
    page.set_viewport_size({"width": size[0], "height": size[1]})
    return page


def opened(tabs: Any, server: Server) -> Any:
    """A new page that shows a solved frame."""
    page = new_page(tabs)
    page.goto(server.url)
    shown(page)
    return page


def shown(page: Any) -> None:
    page.locator(".lab-frame canvas[data-frame]").wait_for(timeout=1e3 * WARM_S)
    page.locator(".lab-card [data-state=good]").wait_for(timeout=1e3 * WARM_S)


def speed(tabs: Any, server: Server, size: tuple[int, int]) -> list[dict[str, Any]]:
    """Opening, keys and playing on a screen of a size."""
    screen = f"{size[0]} x {size[1]}"
    say(screen)
    server.settle(0)
    page = new_page(tabs, size)
    traffic = Traffic(page)
    begin = time.monotonic()
    page.goto(server.url)
    shown(page)
    open_s = time.monotonic() - begin
    server.settle(1)
    page.evaluate(WATCH)
    held = measured(page, server, traffic, partial(hold, page))
    page.wait_for_timeout(500)
    before = (server.cpu_s(), browser_cpu_s())
    delays = delays_ms(page, PRESSES)
    after = (server.cpu_s(), browser_cpu_s())
    spent_ms = [1e3 * (b - a) / PRESSES for a, b in zip(before, after, strict=True)]
    simulate(page)
    played = measured(page, server, traffic, partial(play, page))
    page.close()
    middle, most = np.quantile(delays, [0.5, 0.9])
    return [
        verdict(f"page opened and shown, {screen}", open_s, "s", "a worker is ready", 2.0),
        verdict(
            f"key to picture, median, {screen}", middle, "ms", f"{PRESSES} presses", 50.0
        ),
        verdict(f"key to picture, 90 %, {screen}", most, "ms", f"{PRESSES} presses", 90.0),
        plain(f"key: processor, server, {screen}", spent_ms[0], "ms/key", "with its worker"),
        plain(f"key: processor, browser, {screen}", spent_ms[1], "ms/key", "and at rest"),
        *held.rows(f"key held, {screen}"),
        *played.rows(f"playing, {screen}"),
    ]


class Measured(NamedTuple):
    """Frames that were drawn in a time, and what they took: bytes, processor time of the server and of the browser."""

    frames: int
    seconds: float
    websocket: int
    http: int
    server_s: float
    browser_s: float

    def rows(self, what: str) -> list[dict[str, Any]]:
        count = max(self.frames, 1)
        return [
            verdict(
                f"{what}: frames shown",
                self.frames / self.seconds,
                "/s",
                "1024 x 1024, solved",
                30.0,
                least=True,
            ),
            verdict(
                f"{what}: websocket",
                self.websocket / 1e3 / count,
                "kB/frame",
                "before compression",
                20.0,
            ),
            plain(
                f"{what}: HTTP",
                self.http / 1e3 / count,
                "kB/frame",
                "shades of the screen's pixels",
            ),
            plain(
                f"{what}: processor, server",
                1e3 * self.server_s / count,
                "ms/frame",
                "with its workers",
            ),
            plain(
                f"{what}: processor, browser",
                1e3 * self.browser_s / count,
                "ms/frame",
                "without a graphics card",
            ),
        ]


def plain(name: str, value: float, unit: str, what: str) -> dict[str, Any]:
    """A result without a bar."""
    return verdict(name, value, unit, what, math.inf) | {"bar": None, "met": None}


def measured(
    page: Any, server: Server, traffic: Traffic, action: Callable[[], None]
) -> Measured:
    """What an action on a page takes."""
    page.evaluate("() => { window.drawn = [] }")
    traffic.websocket = traffic.http = 0
    before = (server.cpu_s(), browser_cpu_s())
    begin = time.monotonic()
    action()
    seconds = time.monotonic() - begin
    after = (server.cpu_s(), browser_cpu_s())
    frames = int(page.evaluate("window.drawn.length"))
    return Measured(
        frames,
        seconds,
        traffic.websocket,
        traffic.http,
        after[0] - before[0],
        after[1] - before[1],
    )


def hold(page: Any) -> None:
    """Hold an arrow key. The driver takes some 13 ms for a press, so the presses follow a schedule."""
    begin = time.monotonic()
    for count in range(1, round(HELD_S / REPEAT_S) + 1):
        page.keyboard.down("ArrowLeft")
        time.sleep(max(begin + count * REPEAT_S - time.monotonic(), 0.0))
    page.keyboard.up("ArrowLeft")


def simulate(page: Any) -> None:
    """Compute the flight and let it play to its end."""
    page.get_by_role("tab", name="Run").click()
    page.get_by_role("button", name="Simulate").click()
    clock = page.get_by_text(re.compile(r"120/120$"))
    clock.wait_for(timeout=1e3 * WARM_S)
    page.locator(".lab-frame").click(position={"x": 5, "y": 5})  # keys are the page's again


def play(page: Any) -> None:
    """Play the flight from its start to its end, in real time."""
    page.keyboard.press("p")
    for frame in (" [1-9]/120", "120/120"):
        page.wait_for_function(CLOCK, arg=frame, polling=LOOK_MS, timeout=1e3 * WARM_S)


def delays_ms(page: Any, presses: int) -> Floats:
    """(presses,) milliseconds from a key press to the next picture, by the page's clock."""
    found = []
    for _ in range(presses):
        page.evaluate("() => { window.drawn = []; window.pressed = [] }")
        page.keyboard.press("ArrowRight")
        page.wait_for_function("window.drawn.length > 0", polling=20, timeout=1e3 * WARM_S)
        found.append(page.evaluate("window.drawn[0] - window.pressed[0]"))
        page.wait_for_timeout(150)
    return np.array(found)


def memory(tabs: Any, server: Server) -> dict[str, Any]:
    """Growth of the server's own memory over tabs that are opened and closed."""
    levels = []
    for tab in range(WARM_TABS + TABS):
        opened(tabs, server).close()
        server.settle(0)
        time.sleep(COLLECTED_S)
        levels.append(server.memory_mb())
        say(f"tab {tab + 1}: {levels[-1]:.1f} MB")
    return growth(f"memory over {TABS} tabs", levels[WARM_TABS:])


def playing(tabs: Any, server: Server) -> dict[str, Any]:
    """Growth of the memory of server and worker while a flight plays again and again."""
    page = opened(tabs, server)
    simulate(page)
    server.settle(1)
    page.evaluate(WATCH)
    levels = []
    end = time.monotonic() + PLAY_S
    ended = page.get_by_role("button", name="Play").locator("i", has_text="play_arrow")
    while time.monotonic() < end:
        if ended.is_visible():
            page.keyboard.press("p")
        time.sleep(LOOK_S)
        levels.append(server.memory_mb() + server.workers()[0].memory_full_info().uss / 1e6)
    frames = int(page.evaluate("window.drawn.length"))
    page.close()
    return growth(
        f"memory over {PLAY_S:.0f} s of playing, {frames} frames", levels[len(levels) // 10 :]
    )


def growth(name: str, levels: list[float]) -> dict[str, Any]:
    """Change between the medians of either half of some levels of memory, MB."""
    half = len(levels) // 2
    before = float(np.median(levels[:half]))
    after = float(np.median(levels[half:]))
    change = 100 * (after - before) / before
    return verdict(name, abs(change), "%", f"{before:.1f} to {after:.1f} MB", 2.0)


def crowd(tabs: Any, other: Any, server: Server) -> list[dict[str, Any]]:
    """Keys on one tab while many others of another browser wait for a worker, and the time until one of them opens."""
    first = opened(tabs, server)
    first.evaluate(WATCH)
    alone = delays_ms(first, PRESSES)
    lower_priority()
    others = [new_page(other.new_context()) for _ in range(CROWD - 1)]
    during = list[float]()
    for page in others:
        page.goto(server.url, wait_until="commit")
        during += delays_ms(first, 2).tolist()
    for page in others[: WORKERS_LIMIT - 1]:
        shown(page)
    for page in others[WORKERS_LIMIT - 1 :]:
        page.get_by_text("workers in use").wait_for(timeout=1e3 * WARM_S)
    say(f"{CROWD} tabs on {WORKERS_LIMIT} workers")
    during += delays_ms(first, PRESSES).tolist()
    begin = time.monotonic()
    others[0].close()
    shown(others[WORKERS_LIMIT - 1])
    # In which the closed page could have come back.
    waited_s = time.monotonic() - begin - RECONNECT_S
    for page in (first, *others[1:]):
        page.close()
    median = float(np.median(alone))
    worst = float(np.max(during))
    what = f"beyond {median:.0f} ms alone; median {np.median(during):.0f} ms"
    return [
        verdict(
            "a waiting tab opened after a worker is free", waited_s, "s", f"{CROWD} tabs", 5.0
        ),
        verdict("greatest delay of a key while they open", worst - median, "ms", what, 150.0),
    ]


def lower_priority() -> None:
    """Let the processes of the newer browser run only while nothing else does; those that it starts later do so too.

    Chromium gives a page that it shows a higher priority (nice), but leaves the policy of the scheduler.
    """
    browsers = [
        one for one in psutil.Process().children(recursive=True) if "chrom" in one.name()
    ]
    roots = [
        one for one in browsers if one.parent() is None or "chrom" not in one.parent().name()
    ]
    newest = max(roots, key=psutil.Process.create_time)
    for one in (newest, *newest.children(recursive=True)):
        for thread in one.threads():
            with suppress(ProcessLookupError):  # it has ended meanwhile
                os.sched_setscheduler(thread.id, os.SCHED_IDLE, os.sched_param(0))
