"""The pattern on a display, seen by a rendered camera before it: attitudes come back; gamma and lens are undone."""

from __future__ import annotations

import dataclasses
import urllib.error
import urllib.request
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from skysim.apps.live import http
from skysim.apps.live.display_pattern import PEAK, DisplayPattern, lights_of, spots
from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.core.types import Floats, Sources
from skysim.scene import loader
from skysim.scene.sections.layouts import PixelsConfig, ProjectorConfig
from skysim.simulation.exposure import expected_exposure, render_at_rest
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.sources.dome import display
from skysim.sources.stars import steady_points
from skysim.tracking.factory import solve_frame
from tests.helpers.changed_light import with_sources
from tests.helpers.labpage import CHROMIUM

pytest_plugins = ["tests.helpers.labpage"]
QUIET = {"camera.detector.noise": "false"}
PITCH_M = 16.2e-6
FOCAL_M = 45e-3
PIXEL_ARCSEC = np.degrees(PITCH_M / FOCAL_M) * 3600  # 74
DISTORTION = -0.08
MEASURED = (0.0, 0.002, 0.02, 0.07, 0.16, 0.31, 0.5, 0.74, 1.0)
BENCH = QUIET | {
    "light.pixels": "[960, 600]",
    "light.pitch": "16.2 um",
    "light.distortion": str(DISTORTION),
    "light.limit_mag": "3",  # of the bench's own stars, which the pattern replaces
}


@pytest.fixture(scope="module")
def flown() -> Lab:
    return build_lab(loader.load("shefex2", QUIET))


def bench(gamma: Any = "srgb") -> Lab:
    return build_lab(loader.load("collimated_display", BENCH | {"light.gamma": str(gamma)}))


def light_of(gray: Floats, gamma: Any) -> Floats:
    """Light of grays from 0 to 1 by the display's own law, written here once more."""
    if gamma == "srgb":  # IEC 61966-2-1
        return np.array(
            [v / 12.92 if v < 0.04 else ((v + 0.055) / 1.055) ** 2.4 for v in gray]
        )
    if isinstance(gamma, list):
        return np.interp(gray * (len(gamma) - 1), range(len(gamma)), gamma)
    return gray**gamma


def tangent_of(place_m: float) -> float:
    """The tangent t that the collimator images to the radius f t (1 + k t^2)."""
    return float(
        brentq(lambda t: FOCAL_M * t * (1 + DISTORTION * t**2) - place_m, 0, 0.5, xtol=1e-15)
    )


def beams(gray: np.ndarray, white_e_s_m2: float, gamma: Any) -> Sources:
    """Every lit pixel of a picture as a parallel beam behind the collimator, traced one by one."""
    row, column = np.nonzero(gray)
    height, width = gray.shape
    place_m = PITCH_M * np.column_stack([column - (width - 1) / 2, row - (height - 1) / 2])
    radius_m = np.linalg.norm(place_m, axis=1)
    tangent = np.array([tangent_of(one) for one in radius_m])
    ray = np.column_stack([place_m * (tangent / radius_m)[:, None], np.ones(len(row))])
    flux = white_e_s_m2 * light_of(gray[row, column] / 255, gamma)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return steady_points(np.arange(len(row)), ray, flux, np.full(len(row), np.nan))


def seen_error(
    flown: Lab, gamma: Any, at_start: Rotation, limited: float = 1.0
) -> tuple[Floats, int]:
    """Error of the real camera's tracker, in pixels of the display about the camera's axes, and its matches.

    limited is the factor by which the brightest star exceeds white.
    """
    stand = bench(gamma)
    pattern = DisplayPattern.of_bench(flown, stand)
    pattern = dataclasses.replace(pattern, white_e_s_m2=pattern.white_e_s_m2 / limited)
    lab_from_body = flown.start * at_start
    picture = pattern.picture(0.0, lab_from_body)
    assert picture.shown > 100
    sources = beams(picture.gray, pattern.white_e_s_m2 / PEAK, gamma)
    frame, _ = render_at_rest(with_sources(stand, sources).camera, stand.start)
    attitude = solve_frame(build_tracker(flown.camera), frame).attitude
    assert attitude.cam_from_ref is not None, attitude.status
    assert attitude.match is not None
    commanded = flown.camera.mount.cam_from_body * lab_from_body.inv()
    error = (attitude.cam_from_ref * commanded.inv()).as_rotvec(degrees=True) * 3600
    return error / PIXEL_ARCSEC, len(attitude.match.star)


TURNS_DEG = ([0, 0, 0], [31, -12, 140], [-50, 22, -75], [10.003, 4.002, 0])


@pytest.mark.slow
@pytest.mark.parametrize("turn_deg", TURNS_DEG)
@pytest.mark.parametrize(("gamma", "limited"), [("srgb", 10), (2.2, 1), (list(MEASURED), 1)])
def test_a_camera_before_the_display_finds_the_commanded_attitude(
    flown: Lab, gamma: Any, limited: float, turn_deg: list[float]
) -> None:
    """To 1/64 of the display's pixel, 1.2 arcsec of 74; under the sky itself this tracker errs by up to 0.9."""
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True)
    error_px, matches = seen_error(flown, gamma, turn, limited)
    assert np.hypot(*error_px[:2]) < 1 / 64
    assert abs(error_px[2]) < 1 / 8  # the field is 12 deg
    assert matches >= 8


@pytest.mark.slow
def test_coarse_dark_grays_cost_a_part_of_a_pixel(flown: Lab) -> None:
    """With Sirius as white, stars of V 5 have five grays of sRGB's straight part."""
    for turn_deg in TURNS_DEG:
        error_px, _ = seen_error(flown, "srgb", Rotation.from_euler("xyz", turn_deg, True))
        assert np.hypot(*error_px[:2]) < 1 / 16


@pytest.mark.parametrize("gamma", ["srgb", 1.8, list(MEASURED)])
def test_gray_levels_undo_the_gamma_to_half_a_level(gamma: Any) -> None:
    """Light of half a level less and of half a level more enclose the light that is wanted."""
    config = bench(gamma).scene.light
    assert isinstance(config, PixelsConfig)
    level = np.concatenate([[0.0, 1.0], np.geomspace(1e-7, 1, 2001)])
    gray = display.gray_number(config, level)
    assert np.all(gray == np.rint(gray))
    low = light_of(np.maximum(gray - 0.5, 0) / 255, gamma)
    high = light_of(np.minimum(gray + 0.5, 255) / 255, gamma)
    assert np.all((low <= level * (1 + 1e-4)) & (level <= high * (1 + 1e-4) + 1e-9))
    shown = display.transmission(config, np.arange(256) / 255)
    np.testing.assert_allclose(shown, light_of(np.arange(256) / 255, gamma), rtol=1e-12)
    np.testing.assert_array_equal(display.gray_number(config, shown), np.arange(256))


def test_a_collimator_s_distortion_is_undone(flown: Lab) -> None:
    """Pixels traced through the lens come back to a millionth of a pixel."""
    pattern = DisplayPattern.of_bench(flown, bench())
    gray = np.zeros((600, 960), np.uint8)
    gray[::37, ::41] = 255
    row, column = np.nonzero(gray)
    xy_px, shown = pattern.places_px(beams(gray, 1.0, "srgb").place[:, :3])
    assert shown.all()
    np.testing.assert_allclose(xy_px, np.column_stack([column, row]), rtol=0, atol=1e-6)


def test_a_monitor_s_pixels_are_where_a_ruler_finds_them(flown: Lab) -> None:
    """The panel is level, 1.4 m up and 0.1 m along x; column and row grow along the lab's x and y."""
    stand = build_lab(loader.load("nps_tas2"))
    pattern = DisplayPattern.of_bench(flown, stand)
    px = np.array([[0, 0], [1679, 0], [300, 1049], [839.5, 524.5]])
    flat_m = (px - [839.5, 524.5]) * 0.258e-3 + [0.1, 0.0]
    toward = np.column_stack([flat_m, np.full(4, 1.4)]) - stand.start.apply(
        stand.camera.mount.camera_body_m
    )
    xy_px, shown = pattern.places_px(toward / np.linalg.norm(toward, axis=1)[:, None])
    assert shown.all()
    np.testing.assert_allclose(xy_px, px, rtol=0, atol=1e-9)
    assert not pattern.places_px(toward * [1, 1, -1])[1].any()


def test_a_projector_s_pixels_are_on_the_wall(flown: Lab) -> None:
    """The ray of each pixel meets the wall where the camera looks for it."""
    stand = build_lab(loader.load("projected_dome"))
    pattern = DisplayPattern.of_bench(flown, stand)
    screen = pattern.screen
    assert isinstance(screen, ProjectorConfig)
    assert pattern.surface is not None
    px = np.array([[600, 500], [1300, 400], [959.5, 599.5]])
    rays = display.rays(screen, (px - [959.5, 599.5]) * screen.pitch_m)
    wall_m = pattern.surface.meet(np.array(screen.position_m), rays)
    xy_px, shown = pattern.places_px(wall_m - pattern.camera_m)
    assert shown.all()
    np.testing.assert_allclose(xy_px, px, rtol=0, atol=1e-6)


def test_a_spot_has_its_place_as_centroid_and_one_width() -> None:
    """Moments of the nine shares: sum 1, mean the place, variance 1/4."""
    xy_px = np.random.default_rng(7).uniform(1, 8, (500, 2))
    index, share = spots(xy_px, 10)
    pixel = np.stack([index % 10, index // 10])
    mean = np.sum(share * pixel, axis=2)
    np.testing.assert_allclose(share.sum(axis=1), 1, rtol=1e-14)
    np.testing.assert_allclose(mean.T, xy_px, rtol=0, atol=1e-13)
    variance = np.sum(share * (pixel - mean[:, :, None]) ** 2, axis=2)
    np.testing.assert_allclose(variance, 0.25, rtol=0, atol=1e-13)
    assert share.min() >= 0
    assert share.max() <= PEAK


@pytest.mark.slow
@pytest.mark.parametrize("name", ["shefex2", "afit_simsat"])
def test_lights_are_those_of_the_rendered_frame(name: str) -> None:
    """Directions and electrons of a frame at rest, of stars and of LEDs near a camera off the center."""
    lab = build_lab(loader.load(name, QUIET))
    camera = lab.camera
    lab_from_body = lab.start * Rotation.from_euler("xyz", [3, -2, 20], degrees=True)
    _, truth = render_at_rest(camera, lab_from_body)
    exposure = expected_exposure(camera, lab_from_body, np.zeros(3), truth.t_s)
    toward, irradiance = lights_of([camera.known.during(exposure)], exposure)
    ahead = toward[:, 2] > 0.9
    toward = toward[ahead]
    irradiance = irradiance[ahead]
    rendered = truth.sources
    xy_px = camera.optics.project(toward)
    distance_px = np.linalg.norm(xy_px[:, None] - rendered.xy_px, axis=2)
    nearest = np.nanargmin(np.where(np.isnan(distance_px), np.inf, distance_px), axis=0)
    apart_px = distance_px[nearest, np.arange(len(nearest))]
    # Lateral chromatic aberration moves an image.
    assert np.median(apart_px) < 0.02
    electrons = (
        irradiance[nearest]
        * camera.optics.throughput(toward[nearest, 2])
        * camera.optics.collecting_m2
        * camera.scene.exposure.time_s
    )
    size = [camera.scene.camera.width_px, camera.scene.camera.height_px]
    whole = np.all((rendered.xy_px > 20) & (rendered.xy_px < np.array(size) - 20), axis=1)
    alone = (apart_px < 0.1) & (rendered.electrons > 100) & whole
    assert np.sum(alone) > 5
    np.testing.assert_allclose(electrons[alone], rendered.electrons[alone], rtol=0.02)


def test_faint_and_limited_lights_are_counted(flown: Lab) -> None:
    """Every star on the display is shown or faint; brighter ones than white are limited to white."""
    pattern = DisplayPattern.of_bench(flown, bench(1.0))
    picture = pattern.picture(0.0, flown.start)
    on_all = DisplayPattern.of_bench(flown, bench(2.2)).picture(0.0, flown.start)
    assert on_all.faint == 0
    assert picture.faint > 0
    assert picture.shown + picture.faint == on_all.shown
    assert picture.limited == 0
    # Toward Sirius itself, which is white where it is brightest.
    sirius = flown.camera.sources
    direction = sirius.place[np.argmax(sirius.strength), :3]
    turn, _ = Rotation.align_vectors([[0, 0, 1]], [direction])
    at_sirius = turn.inv() * flown.camera.mount.cam_from_body
    bright = dataclasses.replace(pattern, lab_from_cam=Rotation.identity())
    centered = bright.picture(0.0, at_sirius)
    # An even number of pixels has its center between four, each with 1/4 of the light.
    assert centered.gray.max() == np.rint(255 * 0.25 / PEAK)
    limited = dataclasses.replace(bright, white_e_s_m2=pattern.white_e_s_m2 / 9)
    picture = limited.picture(0.0, at_sirius)
    assert picture.limited >= 1
    assert picture.gray.max() == 255


def test_a_bench_needs_a_display_of_8_bits(flown: Lab) -> None:
    with pytest.raises(
        InputError, match=r"light\.kind: no display; allowed: collimated_display"
    ):
        DisplayPattern.of_bench(flown, flown)
    coarse = build_lab(loader.load("collimated_display", {"light.gray_levels": "64"}))
    with pytest.raises(InputError, match="gray_levels: 64; allowed: 256"):
        DisplayPattern.of_bench(flown, coarse)


def test_a_measured_gamma_rises_from_black_to_white() -> None:
    with pytest.raises(InputError, match=r"light\.gamma: not a rise from 0 to 1"):
        bench([0.0, 0.5, 0.4, 1.0])


def test_the_server_shows_the_flight_s_instant(flown: Lab) -> None:
    server = http.FrameServer(dict, "127.0.0.1", 0)
    address = f"http://127.0.0.1:{server.server_port}"
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{address}/display", timeout=10)
    pattern = DisplayPattern.of_bench(flown, bench())
    server.show = lambda: pattern.picture(0.0, flown.start)
    assert b"/display.png" in urllib.request.urlopen(f"{address}/display", timeout=10).read()
    png = urllib.request.urlopen(f"{address}/display.png?&7", timeout=10).read()
    gray = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(gray, server.show().gray)
    server.close()


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium")
def test_the_page_shows_the_picture_pixel_by_pixel(flown: Lab, browser: Any) -> None:
    """A screenshot of the page has the very gray levels; with scaled pixels the page says so."""
    gray = DisplayPattern.of_bench(flown, bench()).picture(0.0, flown.start).gray
    png = cv2.imencode(".png", gray)[1].tobytes()
    html = (DATA / "display.html").read_text(encoding="utf-8")
    for scale, told in ((1, False), (1.5, True)):
        context = browser.new_context(
            viewport={"width": 960, "height": 600}, device_scale_factor=scale
        )
        page = context.new_page()
        page.route(
            "**/display.png*", lambda route: route.fulfill(body=png, content_type="image/png")
        )
        page.route(
            "**/display", lambda route: route.fulfill(body=html, content_type="text/html")
        )
        page.goto("http://skysim.invalid/display")
        page.wait_for_function("document.getElementById('sky').naturalWidth > 0")
        page.wait_for_function("document.getElementById('sky').style.width != ''")
        note = page.locator("#note")
        assert "Press any key for full screen." in note.inner_text()
        assert ("scales pixels by 1.5" in note.inner_text()) == told
        page.keyboard.press("f")
        page.wait_for_function("document.fullscreenElement !== null")
        if not told:
            page.wait_for_function("document.getElementById('note').textContent === ''")
            shot = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
            np.testing.assert_array_equal(shot, np.repeat(gray[:, :, None], 3, axis=2))
        context.close()
