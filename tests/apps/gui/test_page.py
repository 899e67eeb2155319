"""The lab's page in Chromium, by Playwright. Skipped where either is missing; pictures in out/screenshots."""

from __future__ import annotations

import json
import re
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from astropy.coordinates import Angle
from astropy.io import fits
from astropy.table import Table
from astropy.visualization import ZScaleInterval
from astropy.wcs import WCS
from scipy.interpolate import RegularGridInterpolator

from skysim.core.paths import ROOT
from skysim.scene import loader
from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    SLOW_MS,
    TOKEN,
    WIDE,
    Server,
    address,
    angles,
    brightness,
    changed,
    choose_stage,
    chosen,
    come,
    differs,
    exported,
    frame_pixel,
    onto_the_page,
    opened,
    panel,
    picture,
    pictured,
    pixels,
    screen,
    set_to,
    source,
    status,
)

FOCUSED = """() => {
  const at = document.activeElement, whole = at.closest(".q-field, .q-slider") || at;
  const box = whole.getBoundingClientRect(), named = whole.querySelector("[aria-label]");
  return [at.ariaLabel || at.innerText || whole.ariaLabel || named?.ariaLabel, Math.max(Math.floor(box.left) - 4, 0),
          Math.max(Math.floor(box.top) - 4, 0), Math.min(Math.ceil(box.right) + 4, innerWidth),
          Math.ceil(box.bottom) + 4];
}"""  # what has the focus, and where it is
pytest_plugins = ["tests.helpers.labpage"]
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed"),
]


def test_the_page_shows_a_solved_frame_with_names_and_key_help(page: Any) -> None:
    assert re.match(r"solved; \d+ of \d+ lights identified", status(page, "solved"))
    page.get_by_role("application", name="Mintaka").wait_for()  # of Orion's belt
    shown = page.locator(".lab-keys").first.inner_text()
    assert all(
        name in shown for name in ("F1", "F5", "F6", "F7", "F8", "F10", "E R", "1", "2")
    )


def test_at_either_window_size_nothing_is_cut_off_or_scrolls(page: Any) -> None:
    for size in (WIDE, NARROW):
        page.set_viewport_size(size)
        page.wait_for_timeout(300)
        box = page.locator(".lab-frame canvas").bounding_box()
        assert box["x"] > 0
        assert box["x"] + box["width"] < size["width"]
        assert box["y"] + box["height"] < size["height"]
        assert box["width"] > 0.45 * size["width"]
        root = "document.documentElement"
        assert not page.evaluate(
            f"{root}.scrollHeight > innerHeight || {root}.scrollWidth > innerWidth"
        )
        pictured(page, f"size_{size['width']}")


def test_keys_slew_and_the_frame_does_not_jump(page: Any) -> None:
    before = angles(page)
    box = page.locator(".lab-frame canvas").bounding_box()
    for key, coarse in (("ArrowRight", False), ("ArrowUp", True), ("r", False)):
        frame = source(page)
        page.keyboard.press(f"Shift+{key}" if coarse else key)
        changed(page, frame)
        status(page, "solved")
    after = angles(page)
    turned = after - before
    assert 2 < abs(turned[1]) < 4  # a fifth of 14.9 degrees, at a roll of 20
    assert (
        -1.3 < turned[2] < -0.7
    )  # clockwise: up turns to the west; the rest is the meridians'
    assert page.locator(".lab-frame canvas").bounding_box() == box


def test_a_key_that_repeats_loses_no_step(page: Any) -> None:
    before = angles(page)[2]
    for _ in range(20):
        page.keyboard.down("e")  # faster than frames are made
    page.keyboard.up("e")
    page.wait_for_timeout(300)

    def turned() -> float:
        return (angles(page)[2] - before + 180) % 360 - 180

    assert come(lambda: turned() > 19.9)
    page.wait_for_timeout(300)
    np.testing.assert_allclose(turned(), 20, rtol=0, atol=1e-3)
    assert status(page, "solved")


def test_the_marks_are_drawn_on_their_stars(page: Any) -> None:
    green = """() => { const canvas = document.querySelector('.lab-frame canvas');
      const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
      let count = 0;
      for (let n = 0; n < data.length; n += 4) count += data[n + 1] > data[n] + 60;
      return count; }"""
    assert page.evaluate(green) > 500
    page.get_by_role("checkbox", name="identified").click()
    page.wait_for_function(f"() => ({green})() === 0")
    page.get_by_role("checkbox", name="identified").click()
    page.wait_for_function(f"() => ({green})() > 500")


def test_a_typed_attitude_is_identified_by_key_1(page: Any) -> None:
    page.keyboard.press("F5")
    # The server moves the focus; later, it would take it from a field that is being filled.
    first = page.locator(".lab-angle").first
    assert come(lambda: first.evaluate("at => at === document.activeElement"))
    for n, angle in enumerate(("120", "-30", "0"), 1):
        page.locator(".lab-angle").nth(n - 1).fill(angle)
    frame = source(page)
    page.locator(".lab-angle").nth(2).press("Enter")
    changed(page, frame)
    np.testing.assert_allclose(angles(page), (120, -30, 0), rtol=0, atol=1e-3)
    page.locator(".lab-frame").click(position={"x": 5, "y": 5})
    frame = source(page)
    page.keyboard.press("1")
    changed(page, frame)
    assert status(page, "solved")


def test_every_export_reads_back(page: Any, tmp_path: Path) -> None:
    kept = {
        name: exported(page, name, tmp_path)
        for name in ("truth", "solution", "figure", "scene", "command line", "Python")
    }
    frame = fits.getdata(exported(page, "frame, FITS", tmp_path))
    gray = cv2.imread(str(exported(page, "frame, PNG", tmp_path)), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(gray, frame)
    truth = Table.read(kept["truth"])
    solution = json.loads(kept["solution"].read_text())
    assert f"{len(truth)} true lights" in page.locator(".lab-frame canvas").get_attribute(
        "aria-label"
    )
    np.testing.assert_allclose(solution["estimate_deg"], angles(page), rtol=0, atol=0.01)
    assert cv2.imread(str(kept["figure"])).shape[2] == 3
    exported_scene = loader.load(kept["scene"])
    own = {"stem": "", "motion": None}
    assert exported_scene.model_dump() | own == loader.load("shefex2").model_dump() | own
    start = exported_scene.motion.start
    np.testing.assert_allclose(
        [start.ra_deg, start.dec_deg, start.roll_deg], angles(page), rtol=0, atol=1e-4
    )
    with zipfile.ZipFile(exported(page, "all of them", tmp_path)) as archive:
        assert set(archive.namelist()) == {
            path.name for path in tmp_path.iterdir() if path.suffix != ".zip"
        }
        assert archive.read("frame.png") == (tmp_path / "frame.png").read_bytes()


def test_hovering_shows_a_star_s_data_and_a_click_enlarges_it(
    page: Any, tmp_path: Path
) -> None:
    spots = json.loads(exported(page, "solution", tmp_path).read_text())["spots"]
    frame = fits.getdata(exported(page, "frame, FITS", tmp_path))
    spot = max((one for one in spots if one["id"] >= 0), key=lambda one: one["flux"])
    page.mouse.click(*screen(page, spot["x"], spot["y"]))
    enlarged = pixels(page)
    assert [dn for *_, dn in enlarged] == [int(frame[y, x]) for x, y, _ in enlarged]
    assert len(enlarged) == 7 * 11
    assert (round(spot["x"]), round(spot["y"])) == enlarged[3 * 11 + 5][:2]
    page.locator(".lab-under .mono", has_text="residual").wait_for()
    readout = page.locator(".lab-under .mono").inner_text()
    assert float(re.search(r"residual ([\d.]+) px", readout)[1]) == pytest.approx(
        np.hypot(*spot["residual_px"]), abs=6e-4
    )
    assert re.search(rf"centroid +{spot['x']:.2f} +{spot['y']:.2f} ", readout)
    assert float(re.search(r"V (-?[\d.]+)", readout)[1]) < 5


def limits(page: Any) -> list[float]:
    """The display's black and white levels, DN."""
    return [
        float(level)
        for level in page.locator(".lab-plot").get_attribute("data-limits").split()
    ]


def test_limits_are_set_by_zscale_or_dragging_and_curves_brighten_faint_pixels(
    page: Any, tmp_path: Path
) -> None:
    frame = fits.getdata(exported(page, "frame, FITS", tmp_path))
    dark = brightness(page)
    automatic = limits(page)
    chosen(page, "Limits", "zscale")
    wanted = ZScaleInterval().get_limits(frame)
    assert come(lambda: np.allclose(limits(page), wanted, rtol=1e-6, atol=0))
    chosen(page, "Limits", "min to max")
    assert come(lambda: limits(page) == [frame.min(), frame.max()])
    chosen(page, "Limits", "automatic")
    chosen(page, "Stretch", "logarithm")
    assert come(lambda: brightness(page) > 1.05 * dark)
    chosen(page, "Stretch", "square root")
    box = page.locator(".lab-plot").bounding_box()
    page.mouse.move(box["x"] + box["width"] - 2, box["y"] + 80)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 80)
    page.mouse.up()
    assert limits(page)[1] != automatic[1]
    assert limits(page)[0] == automatic[0]
    assert page.get_by_role("combobox", name="Limits").input_value() == "manual"
    chosen(page, "Limits", "automatic")
    assert come(lambda: limits(page) == automatic)


def test_the_wheel_zooms_about_the_cursor_a_drag_pans_and_fit_shows_the_whole_frame(
    page: Any,
) -> None:
    canvas = page.locator(".lab-frame canvas")
    # a mouse counts whole pixels
    whole = canvas.get_attribute("data-placement")
    at = np.round(screen(page, 200, 300))
    spot = frame_pixel(page, *at)
    page.mouse.move(*at)
    page.mouse.wheel(0, -500)
    assert come(lambda: canvas.get_attribute("data-placement") != whole)
    assert float(canvas.get_attribute("data-placement").split()[2]) > 2 * float(
        whole.split()[2]
    )
    np.testing.assert_allclose(screen(page, *spot), at, rtol=0, atol=0.01)
    page.mouse.down()
    page.mouse.move(at[0] + 40, at[1] - 25)
    page.mouse.up()
    np.testing.assert_allclose(
        screen(page, *spot), (at[0] + 40, at[1] - 25), rtol=0, atol=0.01
    )
    page.get_by_role("button", name="fit", exact=True).click()
    assert canvas.get_attribute("data-placement") == whole


def test_the_readout_has_the_pixel_s_value_and_direction(page: Any, tmp_path: Path) -> None:
    """Right ascension and declination as the exported frame's WCS, by astropy."""
    path = exported(page, "frame, FITS", tmp_path)
    frame = fits.getdata(path)
    sky = WCS(fits.getheader(path))
    for x, y in ((100, 80), (500, 400)):
        page.mouse.move(*screen(page, x, y))
        readout = page.locator(".lab-readout .mono").inner_text()
        place = [
            float(value) for value in re.match(r"x ([\d.]+) +y ([\d.]+)", readout).groups()
        ]
        assert int(re.search(r"(\d+) DN", readout)[1]) == frame[y, x]
        ra_deg, dec_deg = sky.pixel_to_world_values(*place)
        # A place's 0.05 px.
        assert float(re.search(r"RA ([\d.]+)°", readout)[1]) == pytest.approx(
            float(ra_deg), abs=6e-3
        )
        shown_dec = float(re.search(r"Dec ([+−][\d.]+)°", readout)[1].replace("−", "-"))
        assert shown_dec == pytest.approx(float(dec_deg), abs=6e-3)
        hours = Angle(re.search(r"\d+h\d+m[\d.]+s", readout)[0]).degree
        assert hours == pytest.approx(float(ra_deg), abs=6e-3)


def test_a_cut_shows_its_profile(page: Any, tmp_path: Path) -> None:
    frame = fits.getdata(exported(page, "frame, FITS", tmp_path))
    plot = page.locator(".lab-plot")
    page.mouse.move(*screen(page, 100, 200))
    page.keyboard.down("Shift")
    page.mouse.down()
    page.mouse.move(*screen(page, 160, 200), steps=4)
    page.mouse.up()
    page.keyboard.up("Shift")
    values, ends = (
        np.array(plot.get_attribute(f"data-{name}").split(), float)
        for name in ("profile", "cut")
    )
    # To a pixel of the screen.
    np.testing.assert_allclose(ends, [100, 200, 160, 200], rtol=0, atol=2)
    x, y = np.linspace(ends[:2], ends[2:], len(values)).T
    expected = RegularGridInterpolator(tuple(map(np.arange, frame.shape)), frame)((y, x))
    np.testing.assert_allclose(values, expected, rtol=0, atol=0.06)
    page.keyboard.down("Shift")
    page.mouse.click(*screen(page, 300, 100))
    page.keyboard.up("Shift")
    assert "histogram" in plot.get_attribute("aria-label")


def test_colors_and_the_grid_are_drawn(page: Any) -> None:
    def share(color: str) -> float:
        return page.evaluate(
            """color => { const canvas = document.querySelector('.lab-frame canvas');
      const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
      const is = { colored: range => range > 8, gray: range => range === 0 }[color];
      let count = 0;
      for (let n = 0; n < data.length; n += 4) {
        const rgb = data.subarray(n, n + 3);
        count += is(Math.max(...rgb) - Math.min(...rgb));
      }
      return count * 4 / data.length; }""",
            color,
        )

    assert share("gray") > 0.9
    chosen(page, "Colors", "inferno")
    assert come(lambda: share("colored") > 0.3)
    chosen(page, "Colors", "gray")
    assert come(lambda: (plain := share("gray")) > 0.9 and plain < 1)
    plain = share("gray")
    page.get_by_role("checkbox", name="grid").click()
    assert come(lambda: share("gray") < plain - 0.002)
    page.get_by_role("checkbox", name="grid").click()


NAMES = """async ([names, size]) => { const { drawNames } = await import("skysim-views/marks.js");
  const boxes = [], pen = { fillRect: (...box) => boxes.push(box), fillText() {} };
  drawNames(pen, names, (x, y) => [x, y], size, "#fff");
  return boxes; }"""


def test_names_are_beside_their_stars_within_the_frame_and_cover_no_other(page: Any) -> None:
    size = (659, 493)
    random = np.random.default_rng(4)
    places = np.vstack(
        [random.uniform(0, size, (20, 2)), [[size[0] - 1, 5], [3, size[1] - 2]]]
    )
    names = [(*place, f"HIP {n}") for n, place in enumerate(places.tolist())]
    boxes = np.array(page.evaluate(NAMES, [names, list(size)]))
    assert 15 <= len(boxes) <= len(names)
    low = boxes[:, :2]
    high = boxes[:, :2] + boxes[:, 2:]
    assert (low >= -1.01).all()
    assert (high <= np.array(size) + 1.01).all()
    separate = (low[:, None] >= high[None] - 2.01).any(axis=2)
    np.testing.assert_array_equal(separate | separate.T, ~np.eye(len(boxes), dtype=bool))
    gap = (
        np.maximum(np.maximum(low[:, None] - places, places - high[:, None]), 0)
        .max(axis=2)
        .min(axis=1)
    )
    assert (gap < 25).all()


def test_tab_reaches_every_control_and_shows_where_it_is(page: Any) -> None:
    onto_the_page(page)
    unseen = picture(page)
    reached = []
    # From the first control: a click on the frame lets Tab go on there.
    page.get_by_role("combobox", name="Scene").focus()
    page.keyboard.press("Shift+Tab")
    for _ in range(28):
        page.keyboard.press("Tab")
        name, *box = page.evaluate(FOCUSED)
        assert come(partial(differs, page, unseen, box)), name
        reached.append(name.partition(":")[0])
    wanted = [
        "Scene",
        "identify",
        "Export",
        "truth",
        "Stretch",
        "Limits",
        "Colors",
        "Sensor view",
        "Width of the panels",
        "true RA in degrees",
        "Height of the 3-D view",
        "Simulate",
    ]
    assert [name for name in reached if name in wanted] == wanted
    onto_the_page(page)


def test_typing_and_help_hold_the_camera_still(page: Any) -> None:
    frame = source(page)
    field = page.locator(".lab-angle").nth(0)
    before = field.input_value()
    field.fill("")
    page.keyboard.type("e1r2")
    page.keyboard.press("ArrowUp")
    assert field.input_value() == "e1r2"
    page.keyboard.press("Enter")
    page.get_by_text("an angle is not a number").first.wait_for()
    field.fill(before)
    onto_the_page(page)
    page.keyboard.press("F1")
    page.get_by_role("dialog").wait_for()
    page.keyboard.press("ArrowUp")
    page.keyboard.press("Escape")
    page.get_by_role("dialog").wait_for(state="detached")
    assert source(page) == frame
    page.keyboard.press("1")
    changed(page, frame)


def focused(page: Any, name: str) -> None:
    """Wait until a list has the keyboard focus."""
    page.wait_for_function(
        "name => document.activeElement.closest('[aria-label]')?.ariaLabel === name", arg=name
    )


def test_f7_selects_an_identifier_and_returns_the_keys_to_the_camera(page: Any) -> None:
    page.keyboard.press("F7")
    focused(page, "tracker.identifier")
    page.keyboard.press("Enter")
    page.get_by_role("option", name="pyramid").wait_for()
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    page.get_by_role("listbox").wait_for(state="detached")
    page.get_by_text("stages (F6, F7): default · default · pyramid · default").wait_for()
    status(page, "solved")
    frame = source(page)
    page.keyboard.press("1")
    changed(page, frame)
    panel(page, "Log")
    page.get_by_text("opened shefex2 with tracker.identifier").wait_for()


def test_f6_configures_image_processing_without_keys_that_have_no_effect(page: Any) -> None:
    """Each change is an override of the scene, which is undone."""
    page.keyboard.press("F6")
    focused(page, "tracker.detector")
    onto_the_page(page)
    identified = status(page, "solved")
    set_to(page, "tracker.threshold_sigma", "9")
    assert come(lambda: status(page, "solved") != identified)
    assert come(lambda: "tracker.threshold_sigma%3D9" in address(page))
    choose_stage(page, "detector", "thesis")
    page.get_by_label("tracker.threshold_sigma", exact=True).wait_for(state="hidden")
    assert page.get_by_label("tracker.min_area_px", exact=True).is_hidden()
    assert come(
        lambda: (
            "tracker.detector%3Dthesis" in address(page) and "threshold" not in address(page)
        )
    )
    pictured(page, "f6")
    for undone in ("tracker.detector", "tracker.threshold_sigma"):
        onto_the_page(page)
        page.wait_for_timeout(1500)
        page.keyboard.press("Control+z")
        assert come(lambda: undone not in address(page)), address(page)  # noqa: B023
    field = page.get_by_label("tracker.threshold_sigma", exact=True)
    assert come(lambda: field.input_value() == "5")


def test_the_sensor_model_s_noise_is_set_in_arcseconds(page: Any) -> None:
    panel(page, "Monte Carlo")
    page.get_by_label("noise, ″ an axis").fill("3")
    page.get_by_label("noise, ″ an axis").press("Enter")
    pixels = page.get_by_label("noise, px")
    assert come(lambda: float(pixels.input_value()) == pytest.approx(3 / 81.7, rel=2e-3))
    pixels.fill("0.1")
    onto_the_page(page)


def test_f8_sets_the_field_and_an_arrow_moves_a_fiftieth_of_it(page: Any) -> None:
    page.keyboard.press("F8")
    page.locator("input[aria-label='runs, F8']:focus").wait_for()
    set_to(page, "field, °", "8")
    onto_the_page(page)
    before = angles(page)
    frame = source(page)
    page.keyboard.press("ArrowUp")
    changed(page, frame)
    (ra, dec, _), (ra_before, dec_before, _) = np.radians(angles(page)), np.radians(before)
    cosine = np.sin(dec) * np.sin(dec_before) + np.cos(dec) * np.cos(dec_before) * np.cos(
        ra - ra_before
    )
    np.testing.assert_allclose(np.degrees(np.arccos(cosine)), 8 / 50, rtol=2e-3, atol=0)
    set_to(page, "field, °", "14.868")


def test_monte_carlo_of_200_by_2_runs_and_its_report_is_private(
    page: Any, server: Server
) -> None:
    frame = source(page)
    page.keyboard.press("n")  # the camera's noise, which trials of centroids do not have
    changed(page, frame)
    page.keyboard.press("2")
    page.get_by_role("status").filter(
        has_text="trials of centroids do not use camera.detector.noise"
    ).wait_for()
    page.get_by_text("200 of 200 trials").wait_for()
    summary = page.get_by_text("identified", exact=False).last.inner_text()
    assert float(re.search(r"identified\s+([\d.]+)", summary)[1]) > 0.9
    report = page.locator("a[href^='/report/']").first
    path = str(report.get_attribute("href")).removeprefix("/")
    # Another browser that has the token.
    assert server.status(path, Cookie=f"skysim_gui_{server.port}={TOKEN}") == 404
    with page.expect_popup() as opens:
        report.click()
    opens.value.wait_for_function("() => document.title.startsWith('Monte Carlo of')")
    opens.value.close()
    frame = source(page)
    page.keyboard.press("n")
    changed(page, frame)


def test_a_dropped_picture_is_solved_shown_or_refused(page: Any, tmp_path: Path) -> None:
    before = angles(page)
    frame = source(page)
    panel(page, "Image")
    photo = cv2.imread(str(ROOT / "docs" / "images" / "sky.jpg"), cv2.IMREAD_GRAYSCALE)
    page.set_input_files("input[type=file]", ROOT / "docs" / "images" / "sky.jpg")
    page.get_by_text("sky.jpg: solved").wait_for()
    changed(page, frame)
    identifier = page.get_by_text(re.compile("^stages")).inner_text().split(" · ")[2]
    stage = "" if identifier == "default" else f"; identifier {identifier}"
    assert page.get_by_text(f"sky.jpg: solved{stage}\n").count() == 1
    assert page.locator(".lab-angle").nth(0).input_value() == ""  # its attitude is unknown
    page.mouse.click(*screen(page, 600, 400))
    for x, y, dn in pixels(page):  # the picture's, not the scene's
        assert abs(dn - int(photo[y, x])) <= 2
    noise, broken, program, large = (
        tmp_path / f"{name}" for name in ("noise.png", "broken.png", "a.exe", "large.png")
    )
    cv2.imwrite(
        str(noise), np.random.default_rng(1).integers(90, 110, (480, 640), dtype=np.uint8)
    )
    page.set_input_files("input[type=file]", noise)
    page.get_by_text(re.compile(r"noise\.png: (?!solved|solving)")).wait_for()
    broken.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    program.write_bytes(b"MZ")
    with large.open("wb") as file:
        file.truncate(65 * 2**20)
    for path, why in (
        (broken, "cannot be decoded"),
        (program, "refused; allowed"),
        (broken, "cannot be decoded"),
        (large, "refused; allowed"),
    ):
        page.set_input_files("input[type=file]", path)
        page.get_by_role("status").filter(has_text=why).wait_for()
    identified(page)
    np.testing.assert_array_equal(angles(page), before)


def identified(page: Any) -> None:
    """The scene is shown again."""
    onto_the_page(page)
    frame = source(page)
    page.keyboard.press("1")
    changed(page, frame)


def test_a_picture_is_solved_by_the_chosen_detector_and_identifier(page: Any) -> None:
    choose_stage(page, "identifier", "default")
    panel(page, "Image")
    sky = ROOT / "docs" / "images" / "sky.jpg"
    page.set_input_files("input[type=file]", sky)
    page.get_by_text(re.compile(r"sky\.jpg: solved\n")).wait_for(timeout=SLOW_MS)
    field = float(
        re.search(r"field ([\d.]+)°", page.locator(".lab-panels .mono").last.inner_text())[1]
    )
    choose_stage(page, "identifier", "pyramid")
    panel(page, "Image")
    page.get_by_label("field of view, deg").fill(str(field))
    page.set_input_files("input[type=file]", sky)
    page.get_by_text("sky.jpg: solved; identifier pyramid").wait_for(timeout=SLOW_MS)
    page.get_by_label("field of view, deg").fill("")
    choose_stage(page, "identifier", "default")
    identified(page)


def rolled(page: Any, name: str) -> float:
    """Solved roll of a picture."""
    facts = page.locator(
        ".lab-panels .mono", has_text=re.compile(rf"^{name}: solved")
    ).last.inner_text()
    return float(re.search(r"roll ([\d.]+)", facts)[1])


def test_a_live_camera_is_followed_to_its_end(browser: Any, tmp_path: Path) -> None:
    photo = cv2.imread(str(ROOT / "docs" / "images" / "sky.jpg"))
    high, wide = photo.shape[:2]
    clip = str(tmp_path / "clip.avi")
    video = cv2.VideoWriter(clip, cv2.VideoWriter.fourcc(*"MJPG"), 5, (wide, high))
    for turn_deg in (0, 10):
        turn = cv2.getRotationMatrix2D((wide / 2, high / 2), turn_deg, 1)
        video.write(cv2.warpAffine(photo, turn, (wide, high)))
    video.release()
    with (
        Server(tmp_path, "--camera", clip) as watching,
        opened(browser, watching.login, NARROW) as page,
    ):
        panel(page, "Image")
        page.set_input_files("input[type=file]", ROOT / "docs" / "images" / "sky.jpg")
        still = rolled(page, "sky.jpg")
        page.get_by_role("button", name="Watch").click()
        page.get_by_role("status").filter(has_text="ends after 2 frames").wait_for()
        turned = rolled(page, "camera")
        # The last frame's; the sky turns back.
        np.testing.assert_allclose(still - turned, 10, rtol=0, atol=0.05)
        page.get_by_role("button", name="Watch").wait_for()
        identified(page)


def test_without_a_list_of_cameras_no_camera_can_be_opened(page: Any) -> None:
    panel(page, "Image")
    page.get_by_text("No live camera is offered here").wait_for()
    assert page.get_by_role("button", name="Watch").count() == 0


def test_an_export_contains_the_image_on_the_page(page: Any, tmp_path: Path) -> None:
    """A photograph's pixels and solution, no truth; then the scene's again."""
    panel(page, "Image")
    page.set_input_files("input[type=file]", ROOT / "docs" / "images" / "sky.jpg")
    rolled(page, "sky.jpg")
    saved = exported(page, "frame, PNG", tmp_path)
    photo = cv2.imread(str(ROOT / "docs" / "images" / "sky.jpg"), cv2.IMREAD_GRAYSCALE)
    assert cv2.imread(str(saved), cv2.IMREAD_UNCHANGED).shape == photo.shape
    solution = json.loads(exported(page, "solution", tmp_path).read_text())["solution"]
    # Read now: an earlier solution of the picture may have been on the page.
    assert solution["roll_deg"] == pytest.approx(rolled(page, "sky.jpg"), abs=1e-3)
    page.get_by_role("button", name="Export").click()
    page.locator(".q-menu .q-item", has_text=re.compile("^truth$")).click()
    page.get_by_role("status").filter(
        has_text="truth: not known of an image from elsewhere"
    ).wait_for()
    identified(page)


def test_starting_twice_starts_one_study(page: Any, server: Server) -> None:
    panel(page, "Monte Carlo")
    page.get_by_label("runs").fill("20000")
    page.get_by_role("button", name="Start").dblclick()
    page.keyboard.press("2")
    assert server.come_to("study", 1) == 1
    page.get_by_role("button", name="Stop").click()
    assert server.come_to("study", 0) == 0


def test_bad_input_is_refused_at_its_field(page: Any) -> None:
    page.locator(".lab-angle").nth(1).fill("95")
    page.locator(".lab-angle").nth(1).press("Enter")
    page.get_by_text("Dec: 95 deg is not allowed").first.wait_for()
    page.get_by_role("tab", name="Scene").click()
    page.get_by_role("button", name='Expand "camera"').click()
    page.get_by_label("camera.focal_length", exact=True).fill("35 mmm")
    page.get_by_label("camera.focal_length", exact=True).press("Enter")
    page.get_by_text("'35 mmm' is not a length; allowed").wait_for()
    set_to(page, "camera.focal_length", "50 mm")
    page.get_by_placeholder("new-name").fill("../out")
    page.get_by_role("button", name="Save as").click()
    page.get_by_text("allowed: letters, digits").first.wait_for()


def test_another_shutter_is_chosen_in_the_form(page: Any) -> None:
    panel(page, "Scene")
    page.get_by_placeholder("find a key").fill("shutter")
    frame = source(page)
    chosen(page, "camera.shutter.kind", "rolling")
    changed(page, frame)
    assert come(lambda: page.get_by_label("camera.shutter.leak", exact=True).count() == 0)
    assert (
        page.get_by_label("camera.shutter.row_time", exact=True).input_value() == "2.25e-05 s"
    )
    pictured(page, "shutter")
    frame = source(page)
    chosen(page, "camera.shutter.kind", "interline")
    changed(page, frame)
    page.get_by_label("camera.shutter.leak", exact=True).wait_for()
    page.get_by_placeholder("find a key").fill("")
    onto_the_page(page)


def test_a_scene_is_saved_reopened_and_not_overwritten(page: Any, server: Server) -> None:
    panel(page, "Scene")
    page.get_by_placeholder("find a key").fill("focal_length")
    set_to(page, "camera.focal_length", "45 mm")
    for message in ("saved as mine.yaml", "mine.yaml: file exists"):
        page.get_by_placeholder("new-name").fill("mine")
        page.get_by_role("button", name="Save as").click()
        page.get_by_role("status").filter(has_text=message).wait_for()
    assert loader.load(server.folder / "mine.yaml").camera.focal_length_m == 0.045
    frame = source(page)
    chosen(page, "Scene", "mine.yaml")
    changed(page, frame)
    assert page.get_by_label("camera.focal_length", exact=True).input_value() == "45 mm"
    status(page, "solved")
