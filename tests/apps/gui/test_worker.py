"""Flights, studies, tabs and workers of the lab's page in Chromium."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labpage import (
    CHROMIUM,
    NARROW,
    TOKEN,
    Server,
    angles,
    changed,
    chosen,
    come,
    onto_the_page,
    opened,
    panel,
    pictured,
    source,
    status,
)

pytest_plugins = ["labpage"]
pytestmark = [pytest.mark.browser, pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")]


def test_a_dome_is_flown_played_sought_and_its_loop_opened(page: Any) -> None:
    chosen(page, "Scene", "simsat_slew")
    page.get_by_text("SimSat slews on its reaction wheels").wait_for()
    status(page, "solved")
    panel(page, "Run")
    page.get_by_role("button", name="Simulate").click()
    page.get_by_text(re.compile(r"^[1-9]\.\d\d s$")).wait_for()  # plays by itself
    assert status(page, "solved")
    play, clock = page.get_by_role("button", name="Play"), page.get_by_text(re.compile(r"^\d+\.\d\d s$"))

    def now_s() -> float:
        return float(clock.inner_text().split()[0])

    onto_the_page(page)
    page.keyboard.press("1")  # pauses it
    page.wait_for_function("() => document.querySelector('[aria-label=Play]').innerText === 'play_arrow'")
    slider = page.get_by_role("slider", name="Time")
    box, end_s = slider.bounding_box(), float(slider.get_attribute("aria-valuemax"))
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert come(lambda: 0.4 * end_s < now_s() < 0.6 * end_s)
    assert float(slider.get_attribute("aria-valuenow")) == now_s()
    chosen(page, "Speed", "1/10")
    play.click()
    begun, from_s = time.monotonic(), now_s()
    assert come(lambda: now_s() > from_s + 0.2)
    assert time.monotonic() - begun > 0.8  # real time takes 0.2 s
    chosen(page, "Speed", "5×")
    assert come(lambda: now_s() > end_s - 1.5)
    page.wait_for_function("() => document.querySelector('[aria-label=Play]').innerText === 'play_arrow'")
    feedback = page.locator(".q-select", has=page.get_by_role("combobox", name="Feedback"))
    for count, loop in enumerate(("open loop", "closed by the truth"), 1):
        chosen(page, "Feedback", loop)
        panel(page, "Log")
        log = page.locator(".lab-log")
        assert come(lambda: log.inner_text().count("opened simsat_slew with motion") == count)  # noqa: B023
        panel(page, "Run")
        feedback.filter(has_text=loop).wait_for()
    chosen(page, "Feedback", "closed by the filter")
    page.get_by_role("status").filter(has_text="filter requires the section filter").wait_for()


def test_monte_carlo_is_stopped_goes_on_and_a_failed_trial_is_seen_again(second: Any, server: Server) -> None:
    panel(second, "Monte Carlo")
    second.get_by_label("noise, px").fill("8")
    second.get_by_label("runs, F8").fill("5000")
    second.get_by_role("button", name="Start").click()
    grows = second.get_by_text(re.compile(r"^[1-9]\d* of 5000 trials"))
    grows.wait_for()
    second.get_by_role("button", name="Stop").click()
    stopped = second.get_by_text("trials; stopped, Start continues").inner_text()
    assert server.come_to("study", 0) == 0
    folders = sorted(server.out.iterdir())
    second.get_by_role("button", name="Start").click()
    grows.wait_for()
    assert come(lambda: int(grows.inner_text().split()[0]) > int(stopped.split()[0]))
    assert sorted(server.out.iterdir()) == folders
    frame = source(second)
    second.get_by_role("button", name="replay").first.click()
    changed(second, frame)
    assert "solved" not in second.locator(".lab-card .mono").last.inner_text()
    pictured(second, "test_a_failed_trial_is_seen_again")


def test_two_tabs_do_not_disturb_one_another(page: Any, second: Any) -> None:
    still = angles(page)
    panel(second, "Lab")
    frame = source(second)
    second.keyboard.press("Shift+ArrowDown")
    changed(second, frame)
    assert not np.allclose(angles(second), still, rtol=0, atol=0.1)
    np.testing.assert_array_equal(angles(page), still)


def test_closing_a_tab_ends_its_worker_and_its_study(page: Any, second: Any, server: Server) -> None:
    assert come(lambda: len(server.children("spawn_main")) >= 3)  # two tabs; one waits for the next
    assert server.children("study")
    second.close()
    assert server.come_to("study", 0) == 0
    assert server.come_to("spawn_main", 2) == 2


def test_a_worker_that_is_killed_is_told_and_a_new_page_works(page: Any, server: Server) -> None:
    for worker in server.children("spawn_main"):
        worker.kill()
    page.keyboard.press("1")
    page.get_by_role("status").filter(has_text="worker has stopped: reload the page").wait_for()
    page.reload()
    status(page, "solved")


def test_a_page_for_others_takes_its_token_and_no_other_site_s_word(
    browser: Any, server: Server, tmp_path: Path
) -> None:
    assert server.status(Host="evil.example") == 403
    assert server.status("_nicegui_ws/socket.io/?EIO=4&transport=polling", Origin="http://evil.example") == 403
    with Server(tmp_path, host="0.0.0.0") as others:
        for one in (server, others):
            assert [one.status(path) for path in ("", "?token=wrong", "?token=%C3%A9", "frame/x/1")] == [401] * 4
            assert one.status("report/%00", Cookie=f"skysim_gui_{one.port}={TOKEN}") == 404
        with opened(browser, others.login, NARROW) as page:
            assert "token" not in page.url
            status(page, "solved")
