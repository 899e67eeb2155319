"""The lab's parts without a browser: rotation keys, schema forms, marks, guard, worker, Monte Carlo."""

from __future__ import annotations

import asyncio
import re
import time
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from nicegui import core
from nicegui.client import Client
from nicegui.page import page as page_at

from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from skysim.apps.access import host_of
from skysim.apps.gui import server
from skysim.apps.gui.messages import LIGHT, Detection
from skysim.apps.gui.page.tab import Tab
from skysim.apps.gui.server import FILES, Guard, KeptFiles, report_path, user_of
from skysim.apps.gui.views import forms, keys, overlay
from skysim.apps.gui.views.overlay import FRAMES, NAMES, TabFrames
from skysim.apps.gui.views.sensor import SensorView
from skysim.apps.gui.worker import (
    geometry,
    photo,
    pixels,
    playback,
    study_process,
    tasks,
    workbench,
)
from skysim.apps.gui.worker.photo import SUFFIXES
from skysim.apps.gui.worker.session import Session, WorkerLost
from skysim.core.errors import InputError
from skysim.core.images import IMAGE_SUFFIXES
from skysim.core.paths import ROOT, SCENES
from skysim.core.types import Mount
from skysim.experiments.study import study_file as study_loader
from skysim.results import plots, scoring
from skysim.scene import loader
from skysim.simulation.flight import open_flight, simulate_motion
from skysim.simulation.lab import build_lab
from skysim.sources import catalog, stars
from tests.helpers.solutions import numbers, solution


def test_a_solar_system_body_is_listed_with_name_and_magnitude() -> None:
    """In the sensor's labels and in the page's text about a true light."""
    sensor = SimpleNamespace(prefix="HIP")
    assert [SensorView.name(sensor, id) for id in (9_000_599, 32349, 20)] == [
        "Jupiter",
        "Sirius",
        "HIP 20",
    ]
    settings = {
        "light.bodies": "{}",
        "start_time": "2012-06-24T21:00:00",
        "exposure.frames": "1",
    }
    settings |= {
        "motion.start": "{ra_deg: 154.9, dec_deg: 4.8}",
        "motion.rate_deg_s": "[0, 0, 0]",
    }
    flight = simulate_motion(loader.load("shefex2", settings))
    lights = workbench.true_lights(flight.render(0)[1], workbench.magnitude_by_id(flight.lab))
    assert lights[0].id == 9_000_301
    assert lights[0].magnitude == pytest.approx(-8.84, abs=0.01)


# Where the camera looks.

STARS = build_lab(loader.load("shefex2"))
DOME = build_lab(loader.load("afit_simsat"))


def boresight(mount: Mount, lab_from_body: Rotation) -> np.ndarray:
    return lab_from_body.apply(mount.cam_from_body.inv().apply([0.0, 0.0, 1.0]))


def test_typed_angles_are_the_camera_s_under_the_stars() -> None:
    mount = STARS.camera.mount
    lab_from_body = geometry.from_angles(STARS, (83.0, -5.0, 30.0))
    ra, dec = np.radians([83.0, -5.0])
    towards = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    np.testing.assert_allclose(boresight(mount, lab_from_body), towards, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dec_deg", [0.0, 60.0, 89.9])
def test_an_arrow_key_moves_stars_by_its_share_of_the_field_even_at_the_pole(
    dec_deg: float,
) -> None:
    """After the right key, a star at the image's center is a fiftieth of the field to its left."""
    mount = STARS.camera.mount
    before = geometry.from_angles(STARS, (83.0, dec_deg, 20.0))
    after = geometry.moved(STARS, before, geometry.FINE, 0.0, 0.0)
    star = boresight(mount, before)
    x, y, z = (mount.cam_from_body * after.inv()).apply(star)
    across = 2 * np.arctan(STARS.scene.camera.width_px / 2 / STARS.scene.camera.focal_px)
    np.testing.assert_allclose(np.arctan2(x, z), -geometry.FINE * across, rtol=1e-9)
    np.testing.assert_allclose(y, 0.0, atol=1e-12)
    _, y, z = (
        mount.cam_from_body * geometry.moved(STARS, before, 0.0, geometry.FINE, 0.0).inv()
    ).apply(star)
    # Down: y is down.
    np.testing.assert_allclose(np.arctan2(y, z), geometry.FINE * across, rtol=1e-9)


def test_key_r_rolls_the_camera_clockwise_and_stars_counterclockwise() -> None:
    """PTASE's sign: positive when the sensor moves clockwise, stars appear counter-clockwise."""
    mount = STARS.camera.mount
    before = geometry.from_angles(STARS, (83.0, 2.0, 0.0))
    above = stars.cam_from_icrs(83.0, 2.0, 0.0).inv().apply([0.0, -0.1, 1.0])
    x, y, _ = (mount.cam_from_body * geometry.moved(STARS, before, 0, 0, 10.0).inv()).apply(
        above
    )
    np.testing.assert_allclose(
        np.degrees(np.arctan2(-x, -y)), 10.0, rtol=1e-9
    )  # to the left of up


def test_a_tilt_beyond_the_stop_and_angles_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match=r"tilt of 40\.0 deg: the bearing stops at 30 deg"):
        geometry.from_angles(DOME, (40.0, 0.0, 0.0))
    for angles in ((400.0, 0.0, 0.0), (10.0, 95.0, 0.0), (float("nan"), 0.0, 0.0)):
        with pytest.raises(InputError, match="allowed"):
            geometry.from_angles(STARS, angles)


def test_every_key_of_the_2005_program_is_in_the_key_help() -> None:
    """Fialho & Saotome 2005, section 3.1: arrows, E, R, 1, 2, F1, F5, F6, F7, F8, F10, ESC."""
    theirs = {"ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "e", "r", "1", "2", "Escape"}
    assert theirs | {f"F{n}" for n in (1, 5, 6, 7, 8, 10)} <= set(keys.ACTION_BY_KEY)


# Forms.


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.stem for path in SCENES.glob("*.yaml")))
def test_a_form_s_unchanged_values_give_the_same_scene(name: str) -> None:
    """Overriding the file by the fields' values changes nothing: units, defaults and lists round-trip."""
    values = forms.fields(name, {})
    again = {one.key: one.text for one in values if not one.is_set and one.text != "null"}
    before, after = (
        loader.load(name, keys_, refuses_unused=False).model_dump() for keys_ in ({}, again)
    )
    assert rounded(after) == rounded(before)


def rounded(tree: object) -> object:
    """Numbers rounded to six digits, as shown in the fields."""
    if isinstance(tree, dict):
        return {key: rounded(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [rounded(value) for value in tree]
    return float(f"{tree:.5g}") if isinstance(tree, float) else tree


def test_fields_know_their_unit_and_their_choices() -> None:
    values = {one.key: one for one in forms.fields("afit_simsat", {"exposure.time": "5 ms"})}
    assert values["camera.focal_length"].text == "35 mm"
    assert values["vehicle.tilt_stop_deg"].unit == "deg"
    assert values["motion.control"].text == "pid"  # a word that stands for a section
    assert values["light.occlusion"].allowed_values == ("true", "false")
    assert values["exposure.time"].text == "5 ms"
    assert not values["camera.detector.bits"].is_set


def test_changing_a_section_s_kind_shows_its_keys_and_keeps_common_ones() -> None:
    """Returning to the file's kind restores the file's section; edits of a section are dropped with its kind."""
    at_first = {one.key: one for one in forms.fields("shefex2", {})}
    assert at_first["camera.shutter.kind"].allowed_values == (
        "global",
        "rolling",
        "frame_transfer",
        "interline",
    )
    # Another one needs another start of the motion.
    assert at_first["light.kind"].allowed_values == ("stars",)
    edited = {"tracker.limit_mag": "5.5", "camera.shutter.row_time": "20 us"}
    rolling = forms.with_value("shefex2", edited, "camera.shutter.kind", "rolling")
    assert rolling == {
        "tracker.limit_mag": "5.5",
        "camera.shutter": "{kind: rolling, row_time: 2e-05 s}",
    }
    shutter = {
        one.key: one
        for one in forms.fields("shefex2", rolling)
        if one.key.startswith("camera.shutter")
    }
    assert set(shutter) == {"camera.shutter.kind", "camera.shutter.row_time"}
    assert shutter["camera.shutter.kind"].text == "rolling"
    assert shutter["camera.shutter.row_time"].text == "2e-05 s"
    back = forms.with_value(
        "shefex2", rolling, "camera.shutter.kind", at_first["camera.shutter.kind"].text
    )
    assert back == {"tracker.limit_mag": "5.5"}


def test_an_optional_section_can_be_added_and_removed() -> None:
    assert {one.key: one for one in forms.fields("shefex2", {})}[
        "camera.vignetting.kind"
    ].shown == "none"
    with_stops = forms.with_value("shefex2", {}, "camera.vignetting.kind", "two_stops")
    assert loader.load("shefex2", with_stops).camera.vignetting.kind == "two_stops"
    assert forms.with_value("shefex2", with_stops, "camera.vignetting.kind", "none") == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["afit_simsat", "shefex2", "simsat_slew"])
def test_every_offered_kind_gives_a_valid_scene(name: str) -> None:
    fields = [field for field in forms.fields(name, {}) if field.key.endswith(".kind")]
    offered = [(field.key, kind) for field in fields for kind in field.allowed_values]
    assert len(offered) > 10
    for key, kind in offered:
        scene = loader.load(name, forms.with_value(name, {}, key, kind))
        value = forms.section_at(scene, key.removesuffix(".kind"))[1]
        assert getattr(value, "kind", "none") == kind


def test_an_edit_removes_earlier_edits_that_it_makes_useless() -> None:
    """The detector thesis has thresholds of its own."""
    before = {"tracker.threshold_sigma": "6", "camera.f_number": "2"}
    assert forms.with_value("shefex2", before, "tracker.detector", "thesis") == {
        "camera.f_number": "2",
        "tracker.detector": "thesis",
    }
    with pytest.raises(InputError, match=r"tracker\.threshold_sigma"):
        forms.with_value("shefex2", {}, "tracker.threshold_sigma", "-1")


def test_keys_without_effect_are_reported() -> None:
    stars, dome = (
        {one.key: one for one in forms.fields(name, {})}
        for name in ("shefex2", "afit_simsat")
    )
    assert "LEDs" in dome["tracker.limit_mag"].no_effect
    assert not stars["tracker.limit_mag"].no_effect
    assert stars["tracker.brightness_sigma"].no_effect
    thesis = {one.key: one for one in forms.fields("shefex2", {"tracker.detector": "thesis"})}
    assert thesis["tracker.threshold_sigma"].no_effect
    assert not stars["tracker.threshold_sigma"].no_effect
    assert "default" in stars["tracker.identifier"].allowed_values
    assert (dome["tracker.solver"].shown, stars["tracker.identifier"].shown) == (
        "rotation_only",
        "default",
    )


@pytest.mark.slow
def test_the_feedback_can_be_changed_for_both_forms_of_the_control_section() -> None:
    for name in ("afit_simsat", "simsat_bump", "simsat_slew"):
        values = forms.loop_overrides(name, {}, "truth")
        assert loader.load(name, values).motion.control.feedback == "truth"
        assert (
            loader.load(name, values).motion.control.law
            == loader.load(name).motion.control.law
        )
        assert loader.load(name, forms.loop_overrides(name, {}, "")).motion.control is None


def test_a_key_that_is_sought_before_the_form_is_filled_is_shown(tmp_path: Path) -> None:
    """Its section opens once the fields are there, of another scene too, whose fields replace those of the first."""

    async def story() -> None:
        core.loop = asyncio.get_running_loop()
        client = Client(page_at("/"))
        with client:
            tab = Tab("shefex2", tmp_path, tmp_path)
            await tab.build()
            panel = tab.form
            panel.find.value = "exposure.frames"
            for scene in ("shefex2", "afit_simsat"):
                tab.set_state(scene=scene)
                panel.hide_others(scene)
                assert not panel.parts.visible
                panel.set_scene(forms.fields(scene, {}))
                assert panel.parts.visible
                sections = panel.expansions.items()
                assert [name for name, one in sections if one.value] == ["exposure"]
                assert [name for name, one in sections if one.visible] == ["exposure"]
            panel.hide_others(scene)  # it was opened again, with another value
            assert panel.parts.visible
        client.delete()

    asyncio.run(story())


def test_a_scene_s_file_outside_its_folder_is_refused(tmp_path: Path) -> None:
    outside = tmp_path / "secret.csv"
    outside.write_text("x")
    with pytest.raises(
        InputError, match=r"tracker\.map: .* allowed: a file in the scene's own folder"
    ):
        forms.validated_scene("afit_simsat_ideal", {"tracker.map": str(outside)})


def test_a_scene_is_saved_as_its_differences_without_overwriting(tmp_path: Path) -> None:
    path = forms.save(tmp_path, "mine", "shefex2", {"camera.f_number": "2"}, "Mine")
    assert loader.load(path).camera.f_number == 2
    assert loader.load(path).light == STARS.scene.light
    with pytest.raises(InputError, match="file exists"):
        forms.save(tmp_path, "mine", "shefex2", {}, "Mine")
    for name in ("../up", "a/b", "", ".hidden"):
        with pytest.raises(InputError, match="allowed: letters"):
            forms.save(tmp_path, name, "shefex2", {}, "Mine")


# Marks.

LIGHTS = np.rec.fromarrays(
    [
        np.array([1, 2]),
        np.array([[10.0, 20], [50, 60]]),
        np.array([1e4, 1e3]),
        np.array([2.0, 4.0]),
        np.array([1e3, 1e2]),
        np.array([False, False]),
    ],
    LIGHT,
)
SPOTS = (Detection(10.1, 20.0, 0.01, 5.0, 1, (0.1, 0.0)), Detection(80.0, 80.0, 0.1, 1.0))


def test_each_kind_of_mark_has_its_position_and_can_be_switched_off() -> None:
    result = replace(solution(SPOTS), windows_px=((50.0, 60.0),))
    drawn = {kind: overlay.marks(LIGHTS, result, {kind}, str) for kind in overlay.KINDS}
    points = {
        kind: {mark["kind"]: mark["points"] for mark in of_kind["marks"]}
        for kind, of_kind in drawn.items()
    }
    # Nothing as faint is detected.
    assert points["truth"] == {"truth": [[10.0, 20.0]], "faint": [[50.0, 60.0]]}
    assert points["detected"] == {"detected": [[10.1, 20.0], [80.0, 80.0]]}
    assert points["identified"] == {"identified": [[10.1, 20.0]]}
    assert points["false"] == {"false": [[80.0, 80.0]]}
    assert points["windows"] == {"windows": [[50.0, 60.0]]}
    assert [kind for kind, of_kind in drawn.items() if of_kind["names"]] == ["identified"]
    assert drawn["identified"]["names"] == [(10.1, 20.0, "1")]
    assert overlay.marks(LIGHTS, result, (), str)["marks"] == []


def test_a_faint_light_beside_a_detection_of_noise_gets_no_tick() -> None:
    noise = Detection(51.0, 60.0, 0.1, 1.0)
    result = solution((SPOTS[0], noise))
    solved = {
        mark["kind"]: mark["points"]
        for mark in overlay.marks(LIGHTS, result, {"truth"}, str)["marks"]
    }
    assert solved == {"truth": [[10.0, 20.0]], "faint": [[50.0, 60.0]]}
    unsolved = solution((noise,), "too few")
    ticks = {
        mark["kind"]: mark["points"]
        for mark in overlay.marks(LIGHTS, unsolved, {"truth"}, str)["marks"]
    }
    assert ticks == {"truth": [[10.0, 20.0], [50.0, 60.0]]}


def test_the_cursor_finds_lights_and_detections_independent_of_marks() -> None:
    found = overlay.marks(LIGHTS, solution(SPOTS), (), str)["lights"]
    assert found == [
        (10.0, 20.0, 1, 0),
        (50.0, 60.0, 2, 0),
        (10.1, 20.0, 1, 1),
        (80.0, 80.0, -1, 1),
    ]


# Pixels for the browser.


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_reach_the_browser_unchanged(dtype: type) -> None:
    image = (
        np.random.default_rng(3).integers(0, np.iinfo(dtype).max + 1, (7, 9)).astype(dtype)
    )
    data = pixels.levels_of(image).data()
    assert np.frombuffer(data, float, 2).tolist() == [0.0, 1.0]
    np.testing.assert_array_equal(np.frombuffer(data, dtype, offset=16).reshape(7, 9), image)


def test_other_numbers_are_rounded_to_a_65535th_of_their_range() -> None:
    image = np.random.default_rng(3).normal(5.0, 100.0, (40, 50))
    data = pixels.levels_of(image).data()
    offset, step = np.frombuffer(data, float, 2)
    decoded = offset + step * np.frombuffer(data, np.uint16, offset=16).reshape(40, 50)
    assert step == pytest.approx(np.ptp(image) / 65535)
    np.testing.assert_allclose(decoded, image, rtol=0, atol=0.51 * step)
    np.testing.assert_array_equal(
        np.frombuffer(pixels.levels_of(np.full((2, 2), 7.5)).data(), float, 2), [7.5, 1.0]
    )


def test_a_frame_s_pose_and_lens_map_a_light_s_pixel_back_to_the_light() -> None:
    """Under the dome by the depth at which its ray meets the surface; under the stars by the rotation alone."""
    for scene, within_rad in (("afit_simsat", 2e-4), ("shefex2", 2e-5)):
        flight = simulate_motion(
            loader.load(scene, {"exposure.frames": "1", "motion.rate_deg_s": "[0, 0, 0]"})
        )
        lab = flight.lab
        (_, truth) = flight.render(0)
        lens = geometry.scene_lens(lab)
        pose = geometry.scene_pose(lab, lens, truth)
        camera = lab.scene.camera
        nodes_px = [
            np.linspace(-0.5, size - 0.5, lens.n)
            for size in (camera.width_px, camera.height_px)
        ]

        def table(
            values: tuple[float, ...], nodes_px: list[np.ndarray] = nodes_px, n: int = lens.n
        ) -> Any:
            grid = np.array(values, float).reshape(n, n)
            return RegularGridInterpolator(nodes_px[::-1], grid)

        xy = truth.sources.flux_xy_px[:20]
        rays_cam = np.column_stack(
            [table(lens.x)(xy[:, ::-1]), table(lens.y)(xy[:, ::-1]), np.ones(len(xy))]
        )
        pointed = rays_cam @ np.reshape(pose.rotation, (3, 3)).T
        if pose.depth_m is not None:
            pointed = (
                np.array(pose.place_m) + table(pose.depth_m)(xy[:, ::-1])[:, None] * pointed
            )
        pointed /= np.linalg.norm(pointed, axis=1, keepdims=True)
        rows = [
            lab.camera.sources.id.tolist().index(id) for id in truth.sources.id[:20].tolist()
        ]
        wanted = lab.camera.sources.place[rows, :3]
        wanted = wanted / np.linalg.norm(wanted, axis=1, keepdims=True)
        assert np.linalg.norm(pointed - wanted, axis=1).max() < within_rad, scene


def test_named_stars_are_bright_and_names_are_unique() -> None:
    stars = catalog.read("hipparcos_hp6.5")
    v_mag = dict(zip(stars.hip.tolist(), stars.v_mag.tolist(), strict=True))
    assert max(v_mag[hip] for hip in NAMES) < 3.4
    assert len(set(NAMES.values())) == len(NAMES)


# The guard.


async def knock(guard: Guard, headers: dict[str, str], query: str = "") -> int:
    """The status that a request gets; 200 is the page's own."""
    statuses: list[int] = []

    async def send(message: dict) -> None:
        statuses.append(message.get("status", 0))

    values = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {
        "type": "http",
        "method": "GET",
        "path": "/",
        "headers": values,
        "query_string": query.encode(),
    }
    await guard(scope, None, send)
    return statuses[0]


async def page(scope: dict, receive: object, send) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": []})


@pytest.mark.parametrize(
    ("headers", "query", "status"),
    [
        ({"host": "127.0.0.1:8080", "cookie": "skysim_gui_8080=right"}, "", 200),
        ({"host": "127.0.0.1:8080", "cookie": "skysim_gui_8080=right"}, "token=right", 303),
        ({"host": "127.0.0.1:8080"}, "", 401),
        ({"host": "127.0.0.1:8080", "cookie": "skysim_gui_8081=right"}, "", 401),
        ({"host": "evil.example"}, "token=right", 403),
        ({"host": "localhost:8080", "origin": "http://evil.example"}, "token=right", 403),
        ({"host": "localhost:8080", "origin": "http://localhost:8080"}, "token=right", 303),
        ({"host": "localhost", "content-length": str(10**9)}, "token=right", 413),
    ],
)
def test_a_local_page_requires_token_host_and_origin(
    headers: dict[str, str], query: str, status: int
) -> None:
    guard = Guard(page, "127.0.0.1", "right", 8080)
    assert asyncio.run(knock(guard, headers, query)) == status


@pytest.mark.parametrize(
    ("headers", "query", "status"),
    [
        ({"host": "lab"}, "", 401),
        ({"host": "lab"}, "token=wrong", 401),
        ({"host": "lab"}, "token=right", 303),
        ({"host": "lab", "cookie": "skysim_gui_8080=right"}, "", 200),
        ({"host": "lab", "cookie": "skysim_gui_8080=wrong"}, "", 401),
    ],
)
def test_a_shared_page_requires_its_token(
    headers: dict[str, str], query: str, status: int
) -> None:
    guard = Guard(page, "0.0.0.0", "right", 8080)
    assert asyncio.run(knock(guard, headers, query)) == status


@pytest.mark.parametrize(
    ("path", "method", "query", "headers", "status", "asked"),
    [
        (f"{FILES}/static/vue.js", "GET", "", {}, 200, 1),
        (f"{FILES}/static/vue.js", "GET", "", {"accept-encoding": "gzip, br"}, 200, 1),
        (f"{FILES}/static/none.js", "GET", "", {}, 404, 3),
        (f"{FILES}/static/vue.js", "HEAD", "", {}, 200, 3),
        (f"{FILES}/static/vue.js", "GET", "v=1", {}, 200, 3),
        (f"{FILES}/static/vue.js", "GET", "", {"range": "bytes=0-1"}, 200, 3),
        (f"{FILES}/dynamic_resources/a.css", "GET", "", {}, 200, 3),
        ("/", "GET", "", {}, 200, 3),
    ],
)
def test_static_files_of_the_page_are_cached(
    path: str, method: str, query: str, headers: dict[str, str], status: int, asked: int
) -> None:
    """Other responses are not cached; each answer is complete, and an outer layer may change its headers."""
    calls = []
    answers = list[list[dict]]()

    async def inner(scope: dict, _receive: object, send) -> None:
        calls.append(scope)
        await send(
            {"type": "http.response.start", "status": status, "headers": [(b"a", b"b")]}
        )
        await send({"type": "http.response.body", "body": b"one", "more_body": True})
        await send({"type": "http.response.body", "body": b"two", "more_body": False})

    kept = KeptFiles(inner)
    raw = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {
        "type": "http",
        "method": method,
        "path": path,
        "headers": raw,
        "query_string": query.encode(),
    }
    for _ in range(3):
        answers.append([])

        async def send(message: dict) -> None:
            answers[-1].append(dict(message))
            message["headers"] = "changed"

        asyncio.run(kept(scope, None, send))
    assert len(calls) == asked
    for start, *body in answers:
        assert (start["status"], start["headers"]) == (status, [(b"a", b"b")])
        assert b"".join(part["body"] for part in body) == b"onetwo"


def test_a_compressed_file_is_not_sent_to_a_browser_that_asks_for_a_plain_one() -> None:
    async def inner(scope: dict, _receive: object, send) -> None:
        await send(
            {"type": "http.response.start", "status": 200, "headers": list(scope["headers"])}
        )
        await send({"type": "http.response.body", "body": b""})

    kept = KeptFiles(inner)
    starts = list[dict]()

    async def send(message: dict) -> None:
        starts.append(message)

    for encoding in (b"gzip", b"identity", b"gzip"):
        scope = {
            "type": "http",
            "method": "GET",
            "path": f"{FILES}/a.js",
            "query_string": b"",
        }
        asyncio.run(kept(scope | {"headers": [(b"accept-encoding", encoding)]}, None, send))
    assert [dict(one["headers"])[b"accept-encoding"] for one in starts[::2]] == [
        b"gzip",
        b"identity",
        b"gzip",
    ]


@pytest.mark.slow
def test_closed_pages_are_collected_once_while_no_frame_is_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A garbage collection takes as long as many frames, so frames must not wait for it."""
    collected = list[float]()
    frames = TabFrames(lambda _: None)
    monkeypatch.setattr(server, "release_memory", lambda: collected.append(time.monotonic()))
    monkeypatch.setattr(server, "QUIET_S", 0.2)
    monkeypatch.setitem(FRAMES, "busy", frames)

    async def close_while_another_plays() -> None:
        closed = server.ClosedPages()
        for number in range(8):
            frames.add(number, SimpleNamespace(), alone=False)
            closed.collect_soon()
            await asyncio.sleep(0.05)
        assert not collected
        await asyncio.sleep(0.5)
        assert len(collected) == 1
        assert collected[0] - frames.added_s > 0.2
        for _ in range(3):  # without a frame in between
            closed.collect_soon()
            await asyncio.sleep(0.05)
        await asyncio.sleep(0.2)
        assert len(collected) == 2

    asyncio.run(close_while_another_plays())


def test_closed_pages_are_eventually_collected_while_frames_are_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    collected = list[bool]()
    frames = TabFrames(lambda _: None)
    monkeypatch.setattr(server, "release_memory", lambda: collected.append(True))
    monkeypatch.setattr(server, "QUIET_S", 0.05)
    monkeypatch.setattr(server, "PATIENCE_S", 0.2)
    monkeypatch.setitem(FRAMES, "busy", frames)

    async def close_while_another_plays() -> None:
        server.ClosedPages().collect_soon()
        for number in range(20):
            frames.add(number, SimpleNamespace(), alone=False)
            await asyncio.sleep(0.02)

    asyncio.run(close_while_another_plays())
    assert collected == [True]


def test_every_response_forbids_framing_by_other_sites() -> None:
    """A report keeps its own, stricter one."""
    sent: list[dict] = []

    async def send(message: dict) -> None:
        sent.append(message)

    async def report(_scope: dict, _receive: object, send) -> None:
        await send(
            {
                "type": "http.response.start",
                "status": 200,
                "headers": [(b"content-security-policy", b"none")],
            }
        )

    for served in (page, report):
        headers = [(b"host", b"a"), (b"cookie", b"skysim_gui_1=right")]
        scope = {
            "type": "http",
            "method": "GET",
            "path": "/",
            "headers": headers,
            "query_string": b"",
        }
        asyncio.run(Guard(served, "0.0.0.0", "right", 1)(scope, None, send))
    policies = [dict(message["headers"]) for message in sent]
    assert b"frame-ancestors 'none'" in policies[0][b"content-security-policy"]
    assert policies[1][b"content-security-policy"] == b"none"
    assert [one[b"x-frame-options"] for one in policies] == [b"DENY"] * 2


@pytest.mark.parametrize("name", ["..", "../out", "\0", "x" * 5000, "none", ""])
def test_a_report_outside_the_folder_is_not_found(name: str, tmp_path: Path) -> None:
    (tmp_path / "out" / "study").mkdir(parents=True)
    for folder in (tmp_path, tmp_path / "out" / "study"):
        (folder / "report.html").write_text("report")
    assert report_path(tmp_path / "out", name) is None
    assert report_path(tmp_path / "out", "study") is not None


def test_a_study_s_report_is_visible_only_to_its_user(tmp_path: Path) -> None:
    mine = "0123456789abcdef"
    other = "fedcba9876543210"
    names = f"monte_carlo_{mine}_tab_1", f"monte_carlo_{other}_tab_1", "afit_sensitivity"
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.html").write_text("report")
        (tmp_path / name / "study.sqlite").touch()
    assert [report_path(tmp_path, name, mine) is not None for name in names] == [
        True,
        False,
        True,
    ]
    assert [report_path(tmp_path, name) is not None for name in names] == [False, False, True]
    assert user_of({"skysim_user": mine}) == mine
    assert user_of({"skysim_user": "../x"}) == user_of({}) == ""


def test_the_port_is_removed_from_a_host() -> None:
    assert [host_of(one) for one in ("a:1", "a", "[::1]:8", "[::1]")] == [
        "a",
        "a",
        "[::1]",
        "[::1]",
    ]


# The worker.


@pytest.mark.slow
def test_a_worker_is_forked_with_its_scene_set_up_and_a_closed_one_leaves_nothing() -> None:
    """One tab's worker has moved; another, forked afterwards, is at the scene's start."""

    async def story() -> None:
        scene = str(loader.find("shefex2").resolve())
        first = Session()
        try:
            _, start = await first.run("open", scene, {}, True)
            assert (
                await first.run("move", 1.0, 0.0, 5.0, True)
            ).angles_deg != start.angles_deg
            second = Session()
            try:
                assert (await second.run("open", scene, {}, True))[
                    1
                ].angles_deg == start.angles_deg
            finally:
                second.close()
        finally:
            first.close()
        assert not first.process.is_alive()
        assert not second.process.is_alive()
        assert not Session.alive & {first, second}

    asyncio.run(story())


@pytest.mark.slow
def test_kept_frames_of_a_flight_equal_rerendered_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    worker = tasks.Worker()
    pixels_of = []
    exported = []
    worker.open("shefex2", {"exposure.frames": "2"}, False)
    for kept_bytes in (playback.KEPT_BYTES, 0):
        monkeypatch.setattr(playback, "KEPT_BYTES", kept_bytes)
        worker.begin_flight()
        while not worker.advance_flight(1.0).is_done:
            pass
        assert [frame.place is None for frame in worker.flight.frames] == [
            kept_bytes == 0
        ] * 2
        worker.flight_frame(0)
        pixels_of.append(worker.flight_frame(1).pixels.data)
        exported.append(fits.getdata(BytesIO(worker.export()["frame.fits"])))
    assert pixels_of[0] == pixels_of[1] == pixels.levels_of(exported[0]).data()
    np.testing.assert_array_equal(*exported)
    moved = worker.move(0.0, 0.0, 1.0, False)  # afterwards the export is of the live scene
    exported_now = fits.getdata(BytesIO(worker.export()["frame.fits"]))
    assert pixels.levels_of(exported_now).data() == moved.pixels.data


@pytest.mark.long
def test_a_session_answers_refuses_bad_input_and_ends_with_its_tab() -> None:
    async def story() -> None:
        session = Session()
        try:
            scene_info, view = await session.run("open", "shefex2", {}, True)
            assert scene_info.names == ("RA", "Dec", "roll")
            assert view.result.row.estimate_deg
            assert view.result.row.cross_arcsec < 10
            with pytest.raises(InputError, match="Dec: 95 deg is not allowed"):
                await session.run("point", (10.0, 95.0, 0.0), False)
            there = await session.run("point", (10.0, 45.0, 0.0), False)
            np.testing.assert_allclose(there.angles_deg[:2], (10.0, 45.0), rtol=0, atol=1e-9)
            files = await session.run("export")
            assert set(photo.FILE_BY_ITEM.values()) - {"", "solution.json"} == set(files)
            with pytest.raises(InputError, match=r"x\.exe: allowed"):
                await session.run("solve_file", "x.exe", b"MZ", None)
            with pytest.raises(InputError, match="no camera found"):
                await session.run("solve_next", "nowhere.avi", None)
        finally:
            session.close()
        assert not session.process.is_alive()
        with pytest.raises((WorkerLost, RuntimeError)):
            await session.run("render", False)

    asyncio.run(story())


@pytest.mark.long
def test_a_flight_equals_that_of_the_command_line_and_keeps_its_frames() -> None:
    async def story() -> None:
        session = Session()
        try:
            await session.run("open", "simsat_slew", {"exposure.frames": "4"}, False)
            with pytest.raises(InputError, match="no flight has begun"):
                await session.run("advance_flight", 0.01)
            steps = [await session.run("begin_flight")]
            await session.run("move", 0.0, 0.0, 1.0, False)  # other tasks have their turn
            while not steps[-1].is_done:
                steps.append(await session.run("advance_flight", 0.5))
                if len(steps) == 3:
                    await session.run("move", 0.0, 0.0, 1.0, False)
            rows = [row for step in steps for row in step.rows]
            log = next(step.log for step in steps if step.log)
            assert log["t_s"][-1] > 1.0
            assert set(log) >= {"momentum", "pointing"}
            # They are the frames of the command line: the same truth, errors and lights.
            flight = open_flight(loader.load("simsat_slew", {"exposure.frames": "4"}))
            expected = [scoring.Score(shot).row for shot in flight.shots()]
            assert len(rows) == 4
            assert [numbers(one.row) for one in rows] == [numbers(row) for row in expected]
            view = await session.run("flight_frame", 2)
            assert view.result.row == rows[2].row
            assert view.result.row.estimate_deg
            files = await session.run("export")
            frame, _ = flight.render(2)
            np.testing.assert_array_equal(
                fits.getdata(BytesIO(files["frame.fits"])), frame.image_dn
            )
            assert view.pixels.data == pixels.levels_of(frame.image_dn).data()
            with pytest.raises(InputError, match="the flight has no frame 4"):
                await session.run("flight_frame", 4)
        finally:
            session.close()

    asyncio.run(story())


@pytest.mark.long
def test_a_photograph_is_solved_by_the_chosen_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tracker's settings show the stages; an unknown stage is refused."""
    used: list[str] = []
    solved = photo.solved_photo

    def watched(image: np.ndarray, report: Report, tracker: StarTracker) -> photo.PhotoPixels:
        used.append(tracker.settings.identifier)
        return solved(image, report, tracker)

    monkeypatch.setattr(photo, "solved_photo", watched)
    data = (ROOT / "docs" / "images" / "sky.jpg").read_bytes()
    for stages in ((), (("identifier", "pyramid"),)):
        photo.photo_from_file("sky.jpg", data, 40.0, stages)
    assert used == ["default", "pyramid"]
    with pytest.raises(InputError, match="identifier"):
        photo.photo_from_file("sky.jpg", data, 40.0, (("identifier", "none"),))


# Monte Carlo.


@pytest.mark.long
def test_monte_carlo_runs_a_study_and_shows_the_store_s_results(tmp_path: Path) -> None:
    trial = {"kind": "centroids", "noise_px": 0.2}
    text = study_process.monte_carlo(
        "shefex2", {"camera.focal_length": "24 mm"}, trial, 40, 7
    )
    path = tmp_path / "monte_carlo.yaml"
    path.write_text(text)
    values = study_loader.load(path)
    assert values.trials == 40
    assert values.study.seed == 7

    async def story() -> study_process.StudyResults | None:
        process = study_process.StudyProcess(tmp_path)
        assert process.results() is None
        await process.start(path)
        assert await process.wait() == ""
        return process.results()

    results = asyncio.run(story())
    assert results is not None
    assert results.done == 40
    assert sum(results.counts) == round(40 * (1 - results.statistics["refused"][0]))
    assert results.statistics["identified"][0] > 0.8
    assert tmp_path in study_process.finished(tmp_path.parent, "")


def test_a_histogram_counts_every_trial_once() -> None:
    errors = np.random.default_rng(1).lognormal(1, 1, 1000)
    bins, counts = study_process.histogram(errors)
    assert sum(counts) == 1000
    assert len(bins) == len(counts) == study_process.BINS
    assert study_process.histogram(np.empty(0)) == ((), ())


def test_a_saved_scene_names_its_base_first() -> None:
    text = photo.scene_yaml(
        "shefex2", {"camera.f_number": "2", "tracker.limit_mag": "5"}, "T"
    )
    assert re.match(
        r"schema: 1\nbase: shefex2\ntitle: T\ncamera:\n  f_number: 2\ntracker:\n  limit_mag: 5\n",
        text,
    )


def test_frame_statistics_measure_the_sky_despite_stars() -> None:
    """The scatter of whole numbers has the rounding's 1/12 on top; 2 % of the pixels are stars."""
    random = np.random.default_rng(7)
    for sigma_dn in (0.6, 3.0, 20.0):
        image = np.rint(random.normal(200, sigma_dn, (800, 800)))
        image[random.random(image.shape) < 0.02] += 40 * sigma_dn + 100
        image[:2, :3] = 4095
        values = plots.frame_statistics(image.astype(np.uint16), 4095.0)
        np.testing.assert_allclose(values.sky_dn, 200, rtol=0, atol=0.06 * sigma_dn + 0.01)
        np.testing.assert_allclose(
            values.scatter_dn, np.hypot(sigma_dn, 12**-0.5), rtol=0.06, atol=0
        )
        assert (values.peak_dn, values.saturated) == (4095, 6)


def test_wrong_and_refused_trials_are_distinguished_from_solved_ones() -> None:
    columns = {
        "trial": np.array([3, 5, 8]),
        "frames": np.array([1, 2, 1]),
        "solved": np.array([1, 1, 1]),
        "wrong": np.array([0, 0, 1]),
        "status": np.array(["solved", "no match", "solved"], dtype=object),
    }
    assert study_process.unsolved(columns) == [(8, "wrong"), (5, "no match")]


def test_a_constant_offset_does_not_change_the_displayed_frame() -> None:
    """Black and white are measured from the sky."""
    image = np.random.default_rng(2).poisson(20, (200, 200)).astype(np.uint16)
    image[50, 60] = 900
    shown = [plots.to_8bit((image + up).astype(np.uint16), "square root") for up in (0, 1000)]
    np.testing.assert_array_equal(*shown)


def test_the_file_dialog_accepts_every_image_suffix() -> None:
    """A browser's `accept` knows one suffix: `.gz` of `.fits.gz`."""
    assert {".fits", ".gz", ".fz", ".png", ".jpg"} <= set(SUFFIXES)
    assert all(any(name.endswith(end) for end in SUFFIXES) for name in IMAGE_SUFFIXES)
    assert all(len(end) > 1 for end in SUFFIXES)
