"""The page for everyone: by keyboard and screen reader, at every width and zoom, with any eyes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui import views
from skysim.apps.gui.messages import LIGHT, Detection
from skysim.apps.gui.page.readouts import rows
from skysim.apps.gui.page.tab import PANELS
from skysim.apps.gui.views import overlay, space, style
from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    angles,
    changed,
    come,
    onto_the_page,
    opened,
    panel,
    pictured,
    screen,
    source,
)

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
SCRIPTS = Path(views.__file__).parent / "js"
BLACK = (0.0, 0.0, 0.0)
GRAPHICS = 3.0  # least contrast of marks, lines and states (WCAG 2.1, 1.4.11)
TEXT = 4.5  # and of texts (1.4.3)


def rgb(color: str) -> tuple[float, ...]:
    """0 to 1, of "#rrggbb", "0xrrggbb" or "rgb(r g b / a%)" over black."""
    if color.startswith("rgb"):
        *levels, percent = map(float, re.findall(r"[\d.]+", color))
        return tuple(level * percent / 100 / 255 for level in levels)
    digits = color.removeprefix("#").removeprefix("0x")
    return tuple(int(digits[n : n + 2], 16) / 255 for n in (0, 2, 4))


def contrast(color: tuple[float, ...], ground: tuple[float, ...]) -> float:
    """(L1 + 0.05) / (L2 + 0.05) of the relative luminances (WCAG 2)."""

    def luminance(srgb: tuple[float, ...]) -> float:
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in srgb]
        return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

    low, high = sorted((luminance(color), luminance(ground)))
    return (high + 0.05) / (low + 0.05)


def test_contrast_is_that_of_the_standard() -> None:
    """Black and white, and the gray that WCAG gives as just sufficient on white."""
    assert contrast(rgb("#ffffff"), BLACK) == pytest.approx(21)
    assert contrast(rgb("#767676"), rgb("#ffffff")) == pytest.approx(4.54, abs=0.01)


def drawn_colors() -> Iterator[tuple[str, str]]:
    """Every color that the scripts draw over the frame or beside it on the dark ground, with its file."""
    for path in (SCRIPTS / name for name in ("frame.js", "marks.js", "plots.js")):
        for color in re.findall(r'"(#[0-9a-f]{6}|rgb\([^"]*\))"', path.read_text()):
            if not color.startswith("rgb(13 16 21"):  # the ground of texts
                yield path.name, color


@pytest.mark.parametrize("kind", overlay.COLORS)
def test_a_mark_is_seen_on_the_frame_and_its_switch_in_both_themes(kind: str) -> None:
    color = rgb(overlay.COLORS[kind])
    assert contrast(color, BLACK) > GRAPHICS
    assert contrast(color, rgb(style.DARK["ground"])) > TEXT
    dim = re.search(
        r"body--light \.lab-bar \S+ {{? *filter: brightness\(([\d.]+)\)", style.CSS
    )
    assert dim
    dimmed = tuple(float(dim[1]) * level for level in color)
    assert contrast(dimmed, rgb(style.LIGHT["ground"])) > TEXT


@pytest.mark.parametrize(("file", "color"), list(drawn_colors()))
def test_what_the_scripts_draw_is_seen_on_black_and_on_the_plot_s_ground(
    file: str, color: str
) -> None:
    assert contrast(rgb(color), BLACK) > GRAPHICS
    assert contrast(rgb(color), rgb(style.DARK["ground"])) > GRAPHICS * 0.93


def test_plots_and_3d_texts_keep_the_dark_ground_in_the_light_theme() -> None:
    plot = re.search(r"\.lab-plot {([^}]*touch-action[^}]*)}", style.CSS)
    assert plot
    assert f"background: {style.DARK['ground']}" in plot[1]
    for name in ("lab-turn", "lab-push", "lab-tag"):
        rule = re.search(rf"\.{name} {{([^}}]*)}}", style.CSS)
        assert rule, name
        assert "background: #0d1015b0" in rule[1]
        color = re.search(r"[^-]color: (#\w+)", rule[1])
        assert color
        digits = color[1] if len(color[1]) == 7 else "#" + 2 * color[1][1:]
        assert contrast(rgb(digits), rgb("#0d1015")) > TEXT


def test_every_state_of_a_light_is_seen_in_the_laboratory() -> None:
    """On its dark ground; the states differ in size as well as in color."""
    text = (SCRIPTS / "lights.js").read_text()
    colors = dict(re.findall(r"(\w+): (0x\w{6})", text))
    sizes = dict(
        re.findall(r"(\w+): ([\d.]+)[,} ]", text.partition("SIZES")[2].split("\n")[0])
    )
    assert colors.keys() < sizes.keys()
    for state, color in colors.items():
        assert contrast(rgb(color), rgb(style.DARK["ground"])) > GRAPHICS, state
    assert len({sizes[state] for state in colors}) == len(colors)


def test_marks_and_states_differ_by_shape_or_text_as_well_as_by_color() -> None:
    """Color-blind users can distinguish them, also in a gray print."""
    shapes = (
        (SCRIPTS / "marks.js")
        .read_text()
        .partition("const SHAPES = {")[2]
        .partition("\n};")[0]
    )
    drawn = dict(
        re.findall(r"^  (\w+): \(pen, x, y\) => (.*?),?$(?=\n  \w|\Z)", shapes, re.M | re.S)
    )
    # Residuals are arrows.
    assert drawn.keys() | {"residuals"} == overlay.KIND_BY_MARK.keys()
    assert len(set(drawn.values())) == len(drawn)
    for theme in (style.DARK, style.LIGHT):
        assert len({theme[state] for state in ("good", "warn", "bad", "quiet")}) == 4
    # A key of the form that the user has changed has an asterisk, one of the scene's file is bold.
    assert '.lab-sections .warn::before { content: "* " }' in style.CSS
    assert ".lab-sections .given { font-weight: 600 }" in style.CSS
    # Of the table's rows, the last cell tells the state.
    lights = np.rec.fromarrays(
        [
            [1, 2, 3],
            np.array([(10.0, 10), (50, 50), (90, 90)]),
            [9e3, 8e3, 7e3],
            [1.0, 2, 3],
            [9e2, 8e2, 7e2],
            [False] * 3,
        ],
        LIGHT,
    )
    spots = [
        Detection(10, 10, 0.1, 9.0, 1),
        Detection(50, 50, 0.1, 8.0, 7),
        Detection(20, 70, 0.1, 1.0),
    ]
    table = list(rows(lights, spots, str))
    assert [(row["state"], row["cells"][0], row["cells"][-1]) for row in table] == [
        ("good", "1", "1"),
        ("warn", "2", "7"),
        ("quiet", "3", None),
        ("warn", "no light", None),
    ]


# In the browser.


@pytest.fixture(scope="module")
def own(browser: Any, server: Server) -> Any:
    with opened(browser, server.login, NARROW) as found:
        yield found


def focus_the_frame(page: Any) -> None:
    """By the Tab key, from the control before it."""
    page.get_by_role("combobox", name="Colors").focus()
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.matches('.lab-frame canvas')")


@pytest.mark.browser
@in_browser
def test_arrow_keys_step_through_the_lights_of_a_frame_with_focus(own: Any) -> None:
    page = own
    canvas = page.locator(".lab-frame canvas")
    said = page.locator("[aria-live=polite].lab-unseen")
    before = angles(page)
    frame = source(page)
    focus_the_frame(page)
    assert "arrow keys" in canvas.get_attribute("aria-description")
    assert re.match(
        r"Sensor view: \d+ true lights; identified: ", canvas.get_attribute("aria-label")
    )
    page.get_by_text("arrow keys: from light to light").wait_for()  # also for the eye
    told = []
    for key in ("ArrowRight", "ArrowDown", "ArrowLeft", "ArrowUp", "ArrowUp"):
        page.keyboard.press(key)
        told.append(said.inner_text())
    # The brightest of Orion's belt and shoulders, then the last of all.
    count = re.match(r"1 of (\d+): Bellatrix, identified, x [\d.]+, y [\d.]+$", told[0])
    assert count, told
    assert [text.split()[0] for text in told] == [
        "1",
        "2",
        "1",
        count[1],
        f"{int(count[1]) - 1}",
    ]
    assert "Alnilam, identified" in told[1]
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert said.inner_text() == told[0]
    assert canvas.get_attribute("data-ringed") == "25336"  # Bellatrix's number
    page.locator(".lab-under .mono", has_text="residual").wait_for()
    page.keyboard.press("Enter")
    assert come(lambda: "centroid" in said.inner_text())
    assert "Bellatrix" in said.inner_text()
    place = re.findall(r"[\d.]+", told[0].partition(", x")[2])
    loupe = page.locator(".lab-loupe[aria-label^=pixels]").get_attribute("aria-label")
    assert loupe.startswith(
        f"pixels from {round(float(place[0])) - 5} {round(float(place[1])) - 3},"
    )
    assert source(page) == frame
    np.testing.assert_array_equal(angles(page), before)
    page.keyboard.press("Escape")  # the keys are the camera's again
    page.keyboard.press("ArrowRight")
    changed(page, frame)


@pytest.mark.browser
@in_browser
def test_a_click_on_the_frame_leaves_the_arrow_keys_to_the_camera(own: Any) -> None:
    page = own
    frame = source(page)
    page.mouse.click(*screen(page, 300, 200))
    page.keyboard.press("ArrowLeft")
    changed(page, frame)
    focus_the_frame(page)  # and the click is forgotten
    page.keyboard.press("ArrowRight")
    assert come(lambda: page.locator("[aria-live=polite].lab-unseen").inner_text() != "")
    onto_the_page(page)


COVERED = """() => { const canvas = document.querySelector(".lab-names"), pen = canvas.getContext("2d");
  const at = canvas.getBoundingClientRect(), any = (x, y, w, h) => pen.getImageData(x, y, w, h).data.some(Boolean);
  const over = [...document.querySelectorAll(".lab-looks > *, .lab-turn")].map(one => one.getBoundingClientRect());
  return [any(0, 0, canvas.width, canvas.height), over.length,
    over.filter(box => any(box.left - at.left, box.top - at.top, box.width, box.height)).length]; }"""


@pytest.mark.browser
@in_browser
def test_names_in_the_laboratory_are_not_under_its_buttons_and_texts(own: Any) -> None:
    """From every place: whether there are names, the number of buttons and texts, and of those with a name there."""
    page = own
    canvas = page.locator(".lab-space canvas").first
    for name in space.VIEWS:
        drawn = canvas.get_attribute("data-drawn")
        page.get_by_role("button", name=name, exact=True).click()
        assert come(lambda: canvas.get_attribute("data-drawn") != drawn)  # noqa: B023
        if name == "camera":
            assert page.evaluate(COVERED) == [True, 5, 0]
        assert page.evaluate(COVERED)[1:] == [5, 0]


SCROLLED = """() => { const root = document.documentElement, found = [];
  if (root.scrollWidth > root.clientWidth) found.push("the page");
  for (const at of document.querySelectorAll("body *")) {
    const { overflowX } = getComputedStyle(at);
    if (["auto", "scroll"].includes(overflowX) && at.scrollWidth > at.clientWidth) found.push(at.className);
  }
  return found; }"""  # what has a horizontal scroll bar


@pytest.fixture(scope="module")
def with_scroll_bars(browser: Any, server: Server) -> Iterator[Any]:
    """A tab with scroll bars that take room, which Playwright hides otherwise."""
    chromium = browser.browser_type.launch(
        executable_path=CHROMIUM,
        args=["--no-sandbox", "--enable-unsafe-swiftshader"],
        ignore_default_args=["--hide-scrollbars"],
    )
    with opened(chromium, server.login, NARROW) as page:
        yield page
    chromium.close()


@pytest.mark.browser
@in_browser
@pytest.mark.parametrize("zoom", [1, 2])
def test_nothing_scrolls_sideways_at_any_width(with_scroll_bars: Any, zoom: int) -> None:
    """At 200 % a window has half its pixels."""
    page = with_scroll_bars
    sizes = [(width, 900) for width in range(420, 1921, 60)]
    sizes += [(899, 800), (900, 800), (1000, 700), (1001, 700), (1440, 900), (1920, 1080)]
    if zoom == 2:
        sizes = [(width // 2, height // 2) for width, height in sizes if width >= 840]
    faults = set()
    for name in PANELS:
        panel(page, name)
        for width, height in sizes:
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_timeout(60)
            faults |= {(name, width, one) for one in page.evaluate(SCROLLED)}
        pictured(page, f"width_{zoom}_{name.replace(' ', '_')}")
        page.evaluate("document.querySelector('.nicegui-content').scrollTo(0, 0)")
    assert not faults
