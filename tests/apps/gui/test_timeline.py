"""The timeline of a flight: what was wrong, refused, saturated or at a limit, and a click that shows its frame."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    address,
    come,
    open_scene,
    opened,
    panel,
    pictured,
    set_to,
    simulate,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.worker import playback
from skysim.apps.gui.worker.workbench import Workbench

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")


def test_limits_are_the_times_of_the_telemetry() -> None:
    bearing = SimpleNamespace(mount="air_bearing", tilt_stop_deg=30.0)
    free = SimpleNamespace(mount="free", tilt_stop_deg=30.0)
    wheel = np.array([0.2, 1.0, 1.0, 0.5, 1.0, 0.1])
    log = SimpleNamespace(
        t_s=0.1 * np.arange(6),
        loads={"wheel_x": wheel, "wheel_y": 0.5 * wheel},
        saturated=np.array([True, True, False, False, False, False]),
        lab_from_body=Rotation.from_rotvec(
            np.radians([[x, 0, 0] for x in (0, 10, 20, 29.95, 30, 30)])
        ),
    )
    found = [
        (name, round(a, 6), round(b, 6)) for name, a, b in playback.at_limits(log, bearing)
    ]
    assert found == [
        ("wheel_x limit", 0.1, 0.2),
        ("wheel_x limit", 0.4, 0.4),
        ("gyro limit", 0.0, 0.1),
        ("tilt stop", 0.3, 0.5),
    ]
    log.saturated = None
    assert len(list(playback.at_limits(log, free))) == 2


def test_a_frame_s_row_counts_its_saturated_pixels() -> None:
    playing = playback.Playback(
        Workbench.open(
            "shefex2",
            {
                "exposure.frames": "2",
                "exposure.time": "90 ms",
                "motion.rate_deg_s": "[0, 0, 0]",
                "camera.detector.gain_e_dn": "0.2",
            },
        )
    )
    rows = []
    while not (step := playing.advance(1.0)).is_done:
        rows += step.rows
    rows += step.rows
    counts = [kept.view.statistics.saturated for kept in playing.frames]
    assert [row.saturated for row in rows] == counts
    assert max(counts) > 0


@pytest.mark.browser
@in_browser
def test_what_the_filter_refuses_is_on_the_timeline_with_its_reason(
    browser: Any, server: Server
) -> None:
    """A gate of a hundredth of a sigma refuses right attitudes, until three agree and the filter adopts them."""
    with opened(browser, server.login, NARROW) as page:
        open_scene(page, "simsat_bump")
        panel(page, "Scene")
        page.get_by_placeholder("find a key").fill("gate_sigma")
        set_to(page, "filter.gate_sigma", "0.01")
        simulate(page, 4)
        page.get_by_text(re.compile("of 4 frames solved")).first.wait_for()
        panel(page, "Run")
        events = page.get_by_role("list", name="Events of the flight").get_by_role("button")
        assert come(lambda: events.count() == 3)
        assert [one.get_attribute("aria-label") for one in events.all()] == [
            "0.51 s: the filter refused: outside the gate",
            "1.01 s: the filter refused: outside the gate",
            "1.51 s: the filter reset",
        ]
        pictured(page, "timeline_filter")


@pytest.mark.browser
@in_browser
def test_a_click_on_an_event_shows_its_frame(browser: Any, server: Server) -> None:
    with opened(browser, server.login, NARROW) as page:
        panel(page, "Scene")
        page.get_by_placeholder("find a key").fill("gain_e_dn")
        set_to(page, "camera.detector.gain_e_dn", "0.2")
        simulate(page, 6)
        page.get_by_text(
            re.compile("^6 frames, none solved|of 6 frames solved")
        ).first.wait_for()
        panel(page, "Run")
        events = page.get_by_role("list", name="Events of the flight").get_by_role("button")
        assert come(lambda: events.count() >= 6)
        pictured(page, "timeline")
        label = events.nth(3).get_attribute("aria-label")
        t_s = float(label.split(" s:")[0])
        events.nth(3).click()
        page.locator("[data-state=flight]", has_text=f"flight at {t_s:.2f} s").wait_for()
        # A link to a time after the flight
        assert come(lambda: "view=flight" in address(page))
        page.goto(re.sub(r"&t=[\d.]+", "&t=999", address(page)))
        said = page.get_by_role("status").filter(
            has_text="999 s is after the last frame, at "
        )
        said.wait_for()
