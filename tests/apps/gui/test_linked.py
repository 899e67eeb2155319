"""Frame, 3-D laboratory and table show the same lights; a hovered light is highlighted in all of them."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    come,
    exported,
    open_scene,
    opened,
    panel,
    pictured,
    screen,
    simulate,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.messages import LIGHT, Detection, Residual
from skysim.apps.gui.page import readouts, strips
from skysim.apps.gui.worker import geometry, playback
from skysim.core.types import Mount
from skysim.scene import loader
from skysim.simulation.lab import build_lab
from tests.helpers.solutions import solution

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")


def test_the_table_has_every_light_with_its_detection_then_the_false_ones() -> None:
    places_px = np.array([[10.0, 20], [40, 50], [70, 80]])
    true = np.rec.fromarrays(
        [
            np.array([3, 4, 5]),
            places_px,
            np.array([5000.0, 900, 100]),
            np.array([1.5, np.nan, 4]),
            np.array([1250.0, 90, 9]),
            np.array([True, False, False]),
        ],
        LIGHT,
    )
    found = [
        Detection(200, 200, 0.1, 50),
        Detection(10.3, 20.4, 0.05, 700, 3, (0.02, 0.0)),
        Detection(40.0, 50.0, 0.1, 90, 9, (0.3, 0.4)),
    ]
    table = list(readouts.rows(true, found, "LED {}".format, 1000.0))
    assert [row["id"] for row in table] == [3, 4, 5, -1]
    assert [row["state"] for row in table] == ["good", "warn", "quiet", "warn"]
    assert table[0]["cells"] == [
        *("LED 3", 1.5, 5000.0, 1250.0, "full", 10.0, 20.0),
        *(pytest.approx(0.5), "LED 3"),
    ]
    assert table[1]["cells"][3:5] == [90.0, 0.09]
    unknown = list(readouts.rows(true, found, "LED {}".format))
    assert unknown[0]["cells"][4] == "full"
    assert np.isnan(unknown[1]["cells"][4])  # null in the browser
    assert table[1]["cells"][-1] == "LED 9"
    assert np.isnan(table[1]["cells"][1])  # an LED has no magnitude
    assert table[3]["cells"][:7] == ["no light", None, 50, None, None, 200, 200]
    assert {len(row["cells"]) for row in table} == {9}
    assert len({row["key"] for row in table}) == 4


@pytest.mark.slow
def test_an_led_without_current_is_dark_and_the_views_have_their_directions() -> None:
    lab = build_lab(loader.load("afit_simsat", {}))
    strength = lab.camera.sources.strength.copy()
    strength[5] = 0.0
    dark = lab.camera.sources.id[5]
    sources = replace(lab.camera.sources, strength=strength)
    ids, places_m, radius_m, lit = geometry.lights(sources)
    assert ids[~lit].tolist() == [dark]
    assert radius_m[lit].min() > 0
    np.testing.assert_array_equal(places_m[ids == dark][0], sources.place[5, :3])
    views = geometry.lab_geometry(lab)["views"]
    boresight = lab.camera.mount.cam_from_body.inv().apply([0.0, 0.0, 1.0])
    eye, target, *_ = views["camera"]
    np.testing.assert_allclose(eye, lab.camera.mount.camera_body_m, rtol=0, atol=1e-12)
    np.testing.assert_allclose(target - eye, boresight, rtol=0, atol=1e-12)
    assert views["top"][0][2] > places_m[:, 2].max()
    assert views["outside"][0][2] < places_m[:, 2].max()


def test_the_strip_of_residuals_has_a_dot_for_each_identified_light_and_frame() -> None:
    spots = (
        Detection(1, 2, 0.1, 5, 7, (0.0, 0.03125)),
        Detection(3, 4, 0.1, 5),
        Detection(5, 6, 0.1, 5, 9, (float("nan"), 0.0)),
    )
    view = SimpleNamespace(
        result=solution(spots, t_s=0.25), body_wxyz=np.array([1.0, 0, 0, 0])
    )
    mount = Mount(np.zeros(3), Rotation.identity())
    assert list(playback.light_residuals(view, mount)) == [
        (0.25, 7, 0.03125, (0.0, 0.03125, 0.0))
    ]
    values = (0.25, 7, 0.03125), (0.5, 7, 0.0625), (0.5, 9, 0.131)
    residuals = [Residual(*one, (0.0, 0.0, 0.0)) for one in values]
    (strip,) = strips.strips([], {}, residuals)
    assert strip.dots == [[0.25, 0.0312, 7], [0.5, 0.0625, 7], [0.5, 0.131, 9]]
    # A chart that is drawn again does not send them again.
    assert not any(curve.points for curve in strip.curves)


def test_too_many_residuals_are_thinned_by_whole_frames() -> None:
    residuals = [
        Residual(t / 10, id, 0.1, (0.1, 0.0, 0.0)) for t in range(700) for id in range(60)
    ]
    dots = strips.thinned(residuals)
    assert len(dots) <= strips.MAX_DOTS
    assert [[dot[2] for dot in dots if dot[0] == t] for t in (0.0, 0.3)] == [
        list(range(60))
    ] * 2


# In the browser.


@pytest.fixture(scope="module")
def dome(browser: Any, server: Server) -> Any:
    """A tab with a dome."""
    with opened(browser, server.login, NARROW) as page:
        open_scene(page, "afit_simsat")
        assert come(lambda: "dark 0" in drawn(page, "lights"))
        yield page


def drawn(page: Any, name: str) -> str:
    """State reported by the 3-D view."""
    return str(page.locator(".lab-space canvas").first.get_attribute(f"data-{name}") or "")


def identified(page: Any, folder: Path) -> dict[int, tuple[float, float]]:
    """Pixels of the identified lights."""
    spots = json.loads(exported(page, "solution", folder).read_text())["spots"]
    return {spot["id"]: (spot["x"], spot["y"]) for spot in spots if spot["id"] >= 0}


@pytest.mark.browser
@in_browser
def test_the_laboratory_shows_which_lights_are_lit_seen_and_identified(
    dome: Any, tmp_path: Path
) -> None:
    count = len(identified(dome, tmp_path))
    assert come(lambda: f"identified {count}," in drawn(dome, "lights"))
    for name in ("camera", "bearing", "top", "outside"):
        before = drawn(dome, "drawn")
        dome.get_by_role("button", name=name, exact=True).click()
        assert come(lambda: drawn(dome, "view") == name and drawn(dome, "drawn") != before)  # noqa: B023
        pictured(dome, f"the_laboratory_from_{name}")
    box = dome.locator(".lab-space").bounding_box()
    dome.mouse.move(box["x"] + 200, box["y"] + 200)
    dome.mouse.down()
    dome.mouse.move(box["x"] + 260, box["y"] + 220, steps=3)
    dome.mouse.up()
    assert drawn(dome, "view") == "free"
    dome.get_by_role("button", name="outside", exact=True).click()
    assert come(lambda: drawn(dome, "view") == "outside")


@pytest.mark.browser
@in_browser
def test_hovering_a_light_highlights_it_in_all_views(dome: Any, tmp_path: Path) -> None:
    """From the star camera the 3-D view shows each LED where the frame does."""
    spots = identified(dome, tmp_path)
    one, (x, y) = next(iter(spots.items()))
    frame = dome.locator(".lab-frame canvas")
    dome.mouse.move(*screen(dome, x, y))
    assert come(lambda: drawn(dome, "ringed") == str(one))
    dome.mouse.move(*screen(dome, 2, 2))
    assert come(lambda: drawn(dome, "ringed") == "")

    dome.get_by_role("button", name="camera", exact=True).click()
    assert come(lambda: drawn(dome, "view") == "camera")
    space = dome.locator(".lab-space").bounding_box()
    width = 1600
    height = 1200
    scale = space["height"] / height
    inside = {
        n: at
        for n, at in spots.items()
        if abs(at[0] - width / 2) * scale < space["width"] / 2 - 10
    }
    assert len(inside) > 4
    nearest = min(inside, key=lambda n: np.hypot(inside[n][0] - 800, inside[n][1] - 700))
    at = np.array(inside[nearest]) - ((width - 1) / 2, (height - 1) / 2)
    x = space["x"] + space["width"] / 2 + at[0] * scale
    y = space["y"] + space["height"] / 2 + at[1] * scale

    def pointed_at(shift_px: int) -> bool:
        # The view picks when the pointer moves, from the picture that it has drawn by then.
        dome.mouse.move(x + shift_px, y)
        return bool(frame.get_attribute("data-ringed") == str(nearest))

    assert come(lambda: pointed_at(0) or pointed_at(1))
    dome.locator(".lab-under .mono", has_text=f"LED {nearest}").wait_for()
    dome.get_by_role("button", name="outside", exact=True).click()

    panel(dome, "Lights")
    row = dome.locator(f".lab-lights tr[data-id='{one}']")
    row.hover()
    assert come(lambda: frame.get_attribute("data-ringed") == str(one))
    assert "ringed" in str(row.get_attribute("class"))
    dome.mouse.move(*screen(dome, *inside[nearest]))
    other = dome.locator(f".lab-lights tr[data-id='{nearest}'].ringed")
    other.wait_for()
    pictured(dome, "the_table_of_lights")


DOT = """() => {
  const canvas = document.querySelector(".lab-dots"), strips = getElement(+canvas.parentElement.id.slice(1));
  const at = strips.scale(), box = canvas.getBoundingClientRect(), dot = strips.dots.at(-3), [x, y] = at(dot);
  const axis = strips.chart.getOption().yAxis[strips.grid], most = Math.max(...strips.dots.map((one) => one[1]));
  // The axis ends at the next greater of 1, 2, 5, 10 times a power of ten, and every dot's light has its name.
  const decade = 10 ** Math.floor(Math.log10(axis.max / 1.5));
  const isRound = Math.abs([2, 5, 10].reduce((rest, step) => rest * (axis.max / decade - step), 1)) < 1e-6;
  if (!isRound || axis.max < most || axis.max > 2.5 * most) throw Error(`axis to ${axis.max} of dots up to ${most}`);
  if (strips.dots.some(([, , id]) => !/^[A-Z]/.test(strips.names[id]))) throw Error("a dot without a name");
  return [dot[2], box.left + x, box.top + y]; }"""  # number and place of a dot on the screen


@pytest.mark.browser
@in_browser
def test_hovering_links_a_residual_s_dot_and_its_light(browser: Any, server: Server) -> None:
    with opened(browser, server.login, NARROW) as page:
        simulate(page, 5)
        page.get_by_text(re.compile(r"5/5$")).wait_for()
        for _ in range(10):  # room for all strips
            page.get_by_role("separator", name="Height of the 3-D view").press("ArrowUp")
        canvas = page.locator(".lab-dots")
        frame = page.locator(".lab-frame canvas")
        assert come(lambda: int(canvas.get_attribute("data-dots") or 0) > 60)
        canvas.evaluate("one => one.closest('.q-tab-panel').scrollTo(0, 250)")
        page.wait_for_timeout(500)
        _, x, y = page.evaluate(DOT)
        page.mouse.move(x - 30, y - 60)
        page.mouse.move(x, y, steps=3)
        assert come(lambda: canvas.get_attribute("data-ringed") != "")
        one = str(canvas.get_attribute("data-ringed"))  # of dots on one another the nearest
        assert come(lambda: drawn(page, "ringed") == one)
        assert come(lambda: frame.get_attribute("data-ringed") == one)
        pictured(page, "a_dot_of_a_strip")
        page.mouse.move(*screen(page, 2, 2))
        assert come(lambda: canvas.get_attribute("data-ringed") == "")
        page.mouse.move(*screen(page, *next(iter(identified(page, server.folder).values()))))
        assert come(lambda: canvas.get_attribute("data-ringed") not in ("", None))
        assert canvas.get_attribute("data-ringed") == frame.get_attribute("data-ringed")
