"""Flights, studies, tabs and workers of the lab's page in Chromium."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    TOKEN,
    Server,
    address,
    angles,
    changed,
    chosen,
    come,
    onto_the_page,
    open_scene,
    opened,
    panel,
    pictured,
    simulate,
    source,
    status,
)

pytest_plugins = ["tests.helpers.labpage"]
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed"),
]


def test_a_dome_flight_is_played_positioned_and_its_loop_opened(page: Any) -> None:
    """The flight is computed while keys move the camera; then it plays to its last frame at any speed."""
    open_scene(page, "simsat_slew")
    simulate(page, 120)
    page.get_by_text(re.compile(r"^[\d.]+ of [\d.]+ s, \d+ frames$")).wait_for()
    frame = source(page)
    page.keyboard.press("ArrowRight")
    changed(page, frame)  # before the flight is computed
    page.get_by_role("button", name="Stop").click()
    page.get_by_role("button", name="Simulate").wait_for()
    simulate(page, 8)
    page.get_by_text(re.compile(r"^\d of 8 frames solved, 0 wrong; rms: cross")).wait_for()
    clock = page.get_by_text(re.compile(r"^\d+\.\d\d s +\d/8$"))
    # A flight that is computed plays: pause it.
    page.get_by_role("button", name="Previous frame").click()
    chosen(page, "Speed", "5×")
    onto_the_page(page)
    page.keyboard.press("Control+k")
    page.get_by_label("Action", exact=True).fill("play the flight")
    page.get_by_role("option").first.click()
    page.get_by_role("dialog").wait_for(state="detached")
    page.keyboard.press("Control+k")  # draws the list anew, without the row that was clicked
    page.get_by_label("Action", exact=True).wait_for()
    page.keyboard.press("Escape")
    clock.filter(has_text="8/8").wait_for()
    page.get_by_text(re.compile(r"^flight at 8\.01 s$")).wait_for()
    page.keyboard.press(",")
    clock.filter(has_text="7/8").wait_for()
    strips = page.locator(".nicegui-echart:visible").first
    box = strips.bounding_box()
    # Early in the first strip.
    page.mouse.click(box["x"] + 52 + 0.03 * (box["width"] - 64), box["y"] + 70)
    clock.filter(has_text="1/8").wait_for()
    with page.expect_download() as comes:
        page.get_by_role("button", name="CSV").click()
    assert comes.value.path().read_text().count("\n") == 9
    assert come(lambda: re.search(r"t=1\.00", address(page)))
    page.reload()
    page.get_by_text(re.compile(r"^flight at 1\.0[01] s$")).wait_for()  # computed again
    page.keyboard.press("l")
    page.get_by_text("live", exact=True).wait_for()
    panel(page, "Run")
    feedback = page.locator(".q-select", has=page.get_by_role("combobox", name="Feedback"))
    for count, loop in enumerate(("open loop", "closed by the truth"), 1):
        chosen(page, "Feedback", loop)
        panel(page, "Log")
        log = page.locator(".lab-log")
        opened_again = re.compile(r"opened simsat_slew with .*motion")
        assert come(lambda: len(opened_again.findall(log.inner_text())) == count)  # noqa: B023
        panel(page, "Run")
        feedback.filter(has_text=loop).wait_for()
    chosen(page, "Feedback", "closed by the filter")
    page.get_by_role("status").filter(
        has_text="filter requires the section filter"
    ).wait_for()


def test_monte_carlo_stops_resumes_and_replays_a_failed_trial(
    second: Any, server: Server
) -> None:
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
    panel(second, "Run")
    frame = source(second)
    second.keyboard.press("Shift+ArrowDown")
    changed(second, frame)
    assert not np.allclose(angles(second), still, rtol=0, atol=0.1)
    np.testing.assert_array_equal(angles(page), still)


def test_closing_a_tab_ends_its_worker_and_its_study(
    page: Any, second: Any, server: Server
) -> None:
    assert (
        server.come_to("gui.template", 3) == 3
    )  # two tabs' and the one that they are forked from
    assert server.children("study")
    second.close()
    assert server.come_to("study", 0) == 0
    assert server.come_to("gui.template", 2) == 2


def test_a_killed_worker_is_reported_and_replaced(page: Any, server: Server) -> None:
    onto_the_page(page)
    for worker in server.children("gui.template"):
        worker.kill()
    # The key that finds it ended is not lost.
    before = angles(page)
    page.keyboard.press("ArrowRight")
    assert come(lambda: np.abs(angles(page) - before).max() > 0.01)
    panel(page, "Log")
    page.get_by_text("a new one shows the view again").first.wait_for()


def test_a_flight_that_was_lost_says_so(page: Any, server: Server) -> None:
    simulate(page, 2000)
    page.get_by_text(re.compile(r"^[\d.]+ of [\d.]+ s, \d+ frames$")).wait_for()
    page.wait_for_timeout(1000)  # no double click
    page.get_by_role("button", name="Stop").click()
    page.get_by_role("button", name="Simulate").wait_for()
    # The second click of a double click does not stop it.
    page.get_by_role("button", name="Simulate").dblclick()
    page.wait_for_timeout(1000)
    page.get_by_role("button", name="Stop").wait_for()
    for worker in server.children("gui.template"):
        worker.kill()
    page.get_by_role("status").filter(
        has_text="the flight was lost with its worker: Simulate computes it again"
    ).wait_for()
    page.get_by_role("button", name="Simulate").wait_for()


def test_a_shared_page_requires_its_token_and_rejects_other_origins(
    browser: Any, server: Server, tmp_path: Path
) -> None:
    assert server.status(Host="evil.example") == 403
    assert (
        server.status(
            "_nicegui_ws/socket.io/?EIO=4&transport=polling", Origin="http://evil.example"
        )
        == 403
    )
    with Server(tmp_path, host="0.0.0.0") as others:
        for one in (server, others):
            assert [
                one.status(path)
                for path in ("", "?token=wrong", "?token=%C3%A9", "frame/x/1")
            ] == [401] * 4
            assert one.status("report/%00", Cookie=f"skysim_gui_{one.port}={TOKEN}") == 404
        with opened(browser, others.login, NARROW) as page:
            assert "token" not in page.url
            status(page, "solved")
            files = page.evaluate(
                "performance.getEntriesByType('resource').map(one => new URL(one.name).pathname)"
            )
            kept = [path for path in files if path.startswith("/_nicegui/")]
            # Also of files that the server keeps.
            assert {others.status(path[1:]) for path in kept} == {401}
