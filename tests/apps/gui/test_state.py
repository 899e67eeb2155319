"""The state of the lab's page: its address, and in Chromium reload, back, undo and a shared link."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from skysim.apps.gui.page import tab
from skysim.apps.gui.views.context import PageView
from skysim.core.errors import InputError
from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    address,
    angles,
    changed,
    chosen,
    come,
    onto_the_page,
    opened,
    panel,
    set_to,
    source,
    status,
)

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
SCENES = ("shefex2", "/a b/ä&=.yaml")
VIEWS = (
    PageView("shefex2"),
    PageView(
        "/a b/ä&=.yaml",
        {"camera.focal_length": "35 mm", "light.bodies": "{}", "title": "a=b&set=c#"},
        angles_deg=(1.5, -2.25, 359.0),
    ),
    PageView("shefex2", kind="flight", t_s=12.3456, angles_deg=(0.0, 0.0, 0.0)),
    PageView("shefex2", kind="replay", study="monte_carlo_ab_1", trial=17),
    PageView("shefex2", kind="photo", photo="my sky?.jpg"),
    PageView("shefex2", angles_deg=(1.0, 2.0, 3.0), head="side & rear"),
)


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.kind)
def test_a_view_is_restored_from_its_url(view: PageView) -> None:
    assert PageView.from_query(view.query(), SCENES) == view
    assert re.fullmatch(r"\?[\w%.+&=-]+", view.query())


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("?scene=/etc/passwd", "scene '/etc/passwd' is not offered here"),
        ("?scene=shefex2&view=no", "allowed: live, flight"),
        ("?scene=shefex2&at=1,2", "three angles"),
        ("?scene=shefex2&at=1,2,nan", "three angles"),
        ("?scene=shefex2&view=flight&t=soon", "allowed: numbers"),
        ("?scene=shefex2&veiw=flight", "'veiw'; allowed: scene, set, view"),
        ("?scne=shefex2", "'scne'; allowed: scene"),
    ],
)
def test_an_invalid_view_url_is_refused_in_one_line(query: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PageView.from_query(query, SCENES)


def test_a_url_without_a_scene_gives_no_view() -> None:
    assert PageView.from_query("", SCENES) is None
    assert PageView.from_query("?token=x", SCENES) is None


def test_steps_are_distinguished_from_continuous_changes() -> None:
    view = VIEWS[2]
    assert view.same_step(replace(view, t_s=1.0, angles_deg=(1.0, 2.0, 3.0)))
    for other in (
        replace(view, kind="live"),
        replace(view, overrides={"a": "b"}),
        replace(view, trial=3),
    ):
        assert not view.same_step(other)


def test_a_movement_is_one_undo_step_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """This holds directly after opening a page or an edit."""
    sent: list[str] = []
    monkeypatch.setattr(tab.ui, "run_javascript", sent.append)
    shown = SimpleNamespace(state=VIEWS[0])
    written = tab.History.__new__(tab.History)
    written.page = shown
    written.home = "shefex2"
    written.written = None
    written.is_settling = lambda: False
    written.showing = False
    written.moving = False
    written.unchanged = 0
    turned = [replace(VIEWS[0], angles_deg=(float(n), 0.0, 0.0)) for n in range(3)]
    edited = replace(turned[2], overrides={"camera.f_number": "2"})
    after = replace(edited, angles_deg=(9.0, 0.0, 0.0))
    pushed = []
    for shown.state in (VIEWS[0], *turned, edited, after):
        written.write()
        pushed.append(", true," in sent[-1])
    assert pushed == [False, True, False, False, True, True]
    # Angles that are typed in between are a step of their own.
    written.end_step()
    for degrees in (10.0, 11.0):
        shown.state = replace(after, angles_deg=(degrees, 0.0, 0.0))
        written.write()
        pushed.append(", true," in sent[-1])
    assert pushed[-2:] == [True, False]


# In the browser.


def written(page: Any, *parts: str) -> bool:
    """Whether the address has these parts after a short wait."""
    return come(lambda: all(part in address(page) for part in parts))


def angles_if_any(page: Any) -> Any:
    """The typed angles; zeros while a page without a frame has none."""
    typed = [field.input_value() for field in page.locator(".lab-angle").all()]
    return [float(text or 0) for text in typed]


def found_key(page: Any, key: str) -> Any:
    """The field of a scene's key in the forms."""
    panel(page, "Scene")
    page.get_by_placeholder("find a key").fill(key)
    field = page.get_by_label(key, exact=True)
    field.wait_for()
    return field


@pytest.mark.browser
@in_browser
def test_reload_link_and_back_restore_the_view(browser: Any, server: Server) -> None:
    with opened(browser, server.login, NARROW) as page:
        assert written(page, "scene=shefex2", "at=")
        found_key(page, "camera.f_number")
        set_to(page, "camera.f_number", "2")
        onto_the_page(page)
        for angle in (1, 2, 3):
            page.locator(".lab-angle").nth(angle - 1).fill("40")
        frame = source(page)
        page.locator(".lab-angle").nth(2).press("Enter")
        changed(page, frame)
        assert written(page, "camera.f_number%3D2", "at=40.000000%2C40.000000%2C40.000000")
        link = address(page)

        page.reload()
        status(page, "solved")
        np.testing.assert_allclose(angles(page), 40, rtol=0, atol=1e-4)
        assert come(lambda: found_key(page, "camera.f_number").input_value() == "2")
        assert address(page) == link

        with opened(browser, server.login, NARROW) as shared:  # another person, logged in
            shared.goto(link)
            assert come(lambda: np.allclose(angles_if_any(shared), 40, rtol=0, atol=1e-4))

        page.go_back()
        assert come(lambda: abs(angles(page)[0] - 40) > 1)
        assert written(page, "camera.f_number%3D2")
        page.go_back()
        assert come(lambda: found_key(page, "camera.f_number").input_value() != "2")
        page.go_forward()
        page.go_forward()
        assert come(lambda: np.allclose(angles(page), 40, rtol=0, atol=1e-4))


@pytest.mark.browser
@in_browser
def test_undo_and_redo_go_through_moves_and_scenes(browser: Any, server: Server) -> None:
    with opened(browser, server.login, NARROW) as page:
        assert written(page, "at=")
        start = angles(page)
        for _ in range(3):  # one movement
            page.keyboard.press("Shift+ArrowUp")
        assert come(lambda: angles(page)[1] > start[1] + 8)  # three of 2.8
        moved = angles(page)
        assert come(lambda: f"at={moved[0]:.3f}"[:-1] in address(page))
        page.wait_for_timeout(2500)
        chosen(page, "Scene", "collimated_display")
        assert written(page, "scene=collimated_display")
        onto_the_page(page)
        page.keyboard.press("Control+z")
        assert come(lambda: np.allclose(angles(page), moved, rtol=0, atol=1e-3))
        page.keyboard.press("Control+z")
        assert come(lambda: np.allclose(angles(page), start, rtol=0, atol=1e-3))
        page.keyboard.press("Control+z")  # nothing before it: the page stays
        page.keyboard.press("Control+Shift+z")
        assert come(lambda: np.allclose(angles(page), moved, rtol=0, atol=1e-3))
        page.keyboard.press("Control+Shift+z")
        assert written(page, "scene=collimated_display")
        assert come(
            lambda: (
                page.get_by_role("combobox", name="Scene")
                .input_value()
                .startswith("collimated_display: ")
            )
        )


@pytest.mark.browser
@in_browser
def test_the_printed_link_returns_to_the_last_view_and_a_bad_one_is_refused(
    browser: Any, server: Server
) -> None:
    with opened(browser, server.login, NARROW) as page:
        before = angles(page)
        page.keyboard.press("Shift+ArrowLeft")
        assert come(lambda: abs(angles(page)[0] - before[0]) > 1)
        moved = angles(page)
        assert written(page, f"at={moved[0]:.2f}"[:-1])
        page.goto(server.login)
        status(page, "solved")
        np.testing.assert_allclose(angles(page), moved, rtol=0, atol=1e-4)
        page.goto(f"{server.url}?scene=%2Fetc%2Fpasswd")
        page.get_by_role("status").filter(has_text="is not offered here").wait_for()
        status(page, "solved")  # the server's own scene


@pytest.mark.browser
@in_browser
def test_a_stopped_study_survives_a_reload_and_resumes(browser: Any, server: Server) -> None:
    with opened(browser, server.login, NARROW) as page:
        panel(page, "Monte Carlo")
        page.get_by_label("noise, px").fill("7")
        page.get_by_label("runs, F8").fill("4000")
        page.get_by_role("button", name="Start").click()
        page.get_by_text(re.compile(r"^[1-9]\d* of 4000 trials")).wait_for()
        page.get_by_role("button", name="Stop").click()
        stopped = page.get_by_text("trials; stopped, Start continues").inner_text()
        assert written(page, "study=monte_carlo_")
        page.reload()
        status(page, "")
        panel(page, "Monte Carlo")
        assert page.get_by_text("trials; stopped, Start continues").inner_text() == stopped
        assert page.get_by_label("noise, px").input_value() in ("7", "7.0")
        folders = sorted(server.out.iterdir())
        page.get_by_role("button", name="Start").click()
        grows = page.get_by_text(re.compile(r"^[1-9]\d* of 4000 trials$"))
        grows.wait_for()
        assert come(lambda: int(grows.inner_text().split()[0]) > int(stopped.split()[0]))
        assert sorted(server.out.iterdir()) == folders
        page.get_by_role("button", name="Stop").click()
        page.get_by_text("trials; stopped, Start continues").wait_for()
        page.get_by_role("button", name="replay").first.click()
        assert written(page, "view=replay", "trial=")
        page.reload()
        page.get_by_text(re.compile(r"^trial \d+ of monte_carlo_")).wait_for()
