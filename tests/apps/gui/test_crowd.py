"""More tabs than workers: those beyond the limit wait in order, and delay no other tab."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Any, ClassVar

import pytest

from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    QUICK_MS,
    Server,
    changed,
    come,
    opened,
    pictured,
    source,
    status,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.server import RECONNECT_S
from skysim.apps.gui.worker import session

pytest_plugins = ["tests.helpers.labpage"]
TABS = 20
ANIMATIONS = "document.getAnimations().length"
PAGES = 8  # in Chromium, where each of them takes seconds to load
WORKERS = 2


class Hand:
    """Substitute for a worker process."""

    alive: ClassVar[set[Any]] = set()

    def __init__(self) -> None:
        self.alive.add(self)

    def close(self) -> None:
        self.alive.discard(self)


def test_tabs_get_workers_in_order_and_a_closed_tab_frees_its_worker(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The event loop keeps running while twenty tabs wait: it counts between any two of their polls."""
    monkeypatch.setattr(session, "Session", Hand)
    monkeypatch.setattr(session, "QUEUE_S", 0.001)
    monkeypatch.setattr(Hand, "alive", set())
    workers = session.Workers(WORKERS)
    served = list[tuple[int, Hand | None]]()
    status_texts = dict[int, str]()
    gone = set[int]()

    async def tab(number: int) -> None:
        got = await workers.wait(
            lambda: number not in gone, lambda text: status_texts.update({number: text})
        )
        served.append((number, got))

    async def story() -> None:
        tabs = [asyncio.create_task(tab(number)) for number in range(TABS)]
        for _ in range(50):
            await asyncio.sleep(0)
        assert [number for number, _ in served] == [0, 1]
        await asyncio.sleep(0.02)
        assert status_texts[2] == "2 of 2 workers in use."
        assert (
            status_texts[TABS - 1] == f"2 of 2 workers in use; {TABS - 3} before this page."
        )
        gone.add(2)  # it is closed while it waits
        await tabs[2]
        assert served[-1] == (2, None)
        for next_one in range(3, TABS):
            hand = served[-2 if next_one == 3 else -1][1]
            assert hand is not None
            hand.close()
            if next_one == 3:
                # A newcomer looks at once, and yet is the last.
                tabs.append(asyncio.create_task(tab(TABS)))
            await tabs[next_one]
            assert served[-1][0] == next_one
            assert len(Hand.alive) == WORKERS
        gone.add(TABS)
        await tabs[TABS]
        assert workers.queue == []

    asyncio.run(asyncio.wait_for(story(), 60))


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_eight_tabs_share_two_workers(browser: Any, tmp_path: Path) -> None:
    with (
        Server(tmp_path, "--workers", str(WORKERS)) as server,
        opened(browser, server.login, NARROW) as first,
    ):
        with opened(browser, server.login, NARROW) as second:
            waiting = []
            for _ in range(PAGES - WORKERS):
                waiting.append(browser.new_page(viewport=NARROW))
                waiting[-1].goto(server.login, wait_until="commit")
                frame = source(first)
                first.keyboard.press("ArrowRight")
                changed(first, frame)  # keys of others go on
            for page in waiting:
                page.set_default_timeout(QUICK_MS)
                page.get_by_text(
                    "This page opens when another one has been closed."
                ).wait_for()
            assert come(lambda: sorted(map(place, waiting)) == list(range(PAGES - WORKERS)))
            pictured(waiting[-1], "test_eight_tabs_share_two_workers")
            for page in waiting:  # an animation would take the processor from those who work
                # The page's own transition, and its first second, take a moment.
                assert come(lambda page=page: page.evaluate(ANIMATIONS) == 0)
                waited = page.locator(".lab-waited")
                assert come(lambda waited=waited: waited.inner_text().endswith(" s"))
            status(second, "solved")
            waiting.sort(key=place)
        status(waiting[0], "solved")  # the second is closed
        assert come(lambda: list(map(place, waiting[1:])) == list(range(PAGES - WORKERS - 1)))
        for page in reversed(waiting):
            page.close()


def place(page: Any) -> int:
    """Number of pages that wait before this one; -1 if it does not wait."""
    found = re.search(
        r"2 of 2 workers in use(?:; (\d+) before this page)?\.",
        page.locator(".lab-wait").inner_text(),
    )
    return int(found[1] or 0) if found else -1


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_a_tab_that_is_closed_while_it_waits_leaves_the_log_clean(
    browser: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its turn comes after its browser has gone, while the server still waits for the browser to come back."""
    with Server(tmp_path, "--workers", "1") as server:
        with opened(browser, server.login, NARROW) as first:
            waiting = [browser.new_page(viewport=NARROW) for _ in range(2)]
            for page in waiting:
                page.goto(server.login, wait_until="commit")
                page.get_by_text("This page opens when another one").wait_for()
            waiting.sort(key=place)
            first.close()
            waiting[1].wait_for_timeout(1000 * (RECONNECT_S - 1.5))
            waiting[0].close()
        # The other one opens when both have gone.
        waiting[1].set_default_timeout(QUICK_MS)
        status(waiting[1], "solved")
        waiting[1].wait_for_timeout(
            12_000
        )  # a script that is not answered ends after ten seconds
        waiting[1].close()
    written = capfd.readouterr().err
    assert "Traceback" not in written, written
