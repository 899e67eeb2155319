"""The lab's plan panel: check, ambiguity map and survey, by the worker and in Chromium."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.messages import AmbiguityMap, SurveyFound, SurveyPlan
from skysim.apps.gui.page.plan_panel import (
    ambiguity_text,
    greatest_tilt_deg,
    prediction_text,
    survey_flight,
    survey_lines,
)
from skysim.apps.gui.views.style import color_scale
from skysim.apps.gui.worker import playback as survey
from skysim.apps.gui.worker import workbench
from skysim.apps.gui.worker.tasks import Worker
from skysim.core import quaternion
from skysim.core.errors import InputError
from skysim.dynamics import guidance
from skysim.experiments.dome_survey import survey_frames
from skysim.scene import loader
from skysim.simulation import checks
from skysim.simulation.checks import attitudes, detection, sampling
from skysim.simulation.lab import build_lab
from skysim.tracking import dome_map_file
from tests.helpers.labpage import (
    CHROMIUM,
    SLOW_MS,
    chosen,
    come,
    open_scene,
    panel,
    set_to,
)

pytest_plugins = ["tests.helpers.labpage"]
ANGLES = ((5.0, -3.0, 20.0), (-4.0, 2.0, 140.0))


@pytest.mark.slow
def test_a_check_equals_that_of_the_command() -> None:
    lab = build_lab(loader.load("afit_simsat", {"exposure.time": "50 ms"}))
    found = Worker(SimpleNamespace(whole=lab)).check()
    expected = checks.check(lab)
    assert [fact.name for fact in found.facts] == [fact.name for fact in expected.facts]
    assert found.findings == expected.findings
    assert found.findings  # all LEDs saturate


@pytest.mark.slow
def test_a_regular_dome_is_ambiguous_and_a_random_one_is_not() -> None:
    """The rings of a geodesic dome repeat after 72 deg."""
    shares = {}
    for kind, size in (("geodesic", "frequency: 32"), ("poisson_disk", "count: 800")):
        settings = {"light.layout": f"{{kind: {kind}, {size}, cap_deg: 40}}"}
        lab = build_lab(loader.load("afit_simsat_ideal", settings))
        found = workbench.ambiguity(lab)
        assert set(found.ids) <= set(lab.camera.sources.id)
        assert np.all((found.fraction >= found.least) & (found.fraction <= 1))
        shares[kind] = np.mean(found.fraction > 0.9)
    assert shares["geodesic"] > 0.5
    assert shares["poisson_disk"] == 0


def test_stars_have_no_ambiguity_map() -> None:
    with pytest.raises(InputError, match=r"light\.kind: stars: .*; allowed: dome"):
        workbench.ambiguity(build_lab(loader.load("shefex2")))


def test_the_most_similar_fields_are_named() -> None:
    found = AmbiguityMap(np.array([3, 8]), np.array([8, 3]), np.array([0.5, 0.95]), 0.3, 0.61)
    text = ambiguity_text(found)
    assert text.startswith("1 of 2 fields look like another one")
    assert "LED 8 and 3, 95 %" in text


SLOW_CAMERA = {"exposure.rate_hz": "0.2", "exposure.time": "4.9 s", "exposure.first": "300 s"}
TILTED = ((-21.0, 8.0, 22.0), (-7.0, -23.0, -154.0), (10.0, 20.0, 60.0))


@pytest.mark.parametrize(
    ("overrides", "angles"), [({}, ANGLES), (SLOW_CAMERA, ANGLES), ({}, TILTED)]
)
def test_a_survey_is_flown_through_its_attitudes_with_a_frame_at_each(
    overrides: dict[str, str], angles: Any
) -> None:
    flown = loader.load("afit_simsat", survey_flight("afit_simsat", overrides, angles))
    reference = guidance.plan(flown.motion)
    shown = flown.exposure
    begin_s = shown.first_s + np.arange(shown.frames) / shown.rate_hz
    holds = [leg for leg, one in enumerate(flown.motion.maneuver) if one.kind == "hold"]
    assert len(holds) == len(angles)
    for leg, wanted in zip(holds, angles, strict=True):
        start_s = reference.start_s[leg]
        end_s = reference.start_s[leg + 1]
        wxyz = survey_frames.from_angles(np.array([wanted])).as_quat(scalar_first=True)[0]
        assert abs(reference.state_at(start_s)[0] @ wxyz) == pytest.approx(1, abs=1e-9)
        assert np.any((begin_s >= start_s) & (begin_s + shown.time_s <= end_s))


def test_a_survey_does_not_tilt_the_vehicle_beyond_its_stop_between_attitudes() -> None:
    """The rotation about one axis from one tilted attitude to the opposite one may tilt it by more than both."""
    first, last = (survey_frames.from_angles(np.array([angles]))[0] for angles in TILTED[:2])
    assert greatest_tilt_deg(first, last) == pytest.approx(32.2, abs=0.1)
    assert max(greatest_tilt_deg(one, one) for one in (first, last)) < 24.1
    overrides = {
        "vehicle.tilt_stop_deg": "25",
        "motion.control": "prescribed",
        "motion.maneuver": "[]",
    }
    flown = loader.load("afit_simsat", survey_flight("afit_simsat", overrides, TILTED))
    reference = guidance.plan(flown.motion)
    t_s = np.arange(0, reference.duration_s, 0.2)
    up = [
        quaternion.to_rotation(reference.state_at(t)[0]).apply([0.0, 0.0, 1.0]) for t in t_s
    ]
    assert np.min(np.array(up)[:, 2]) > np.cos(np.radians(25))


@pytest.mark.parametrize(("pixels", "taken"), [(0.9, [3, 6]), (1.1, [])])
def test_a_survey_takes_the_last_frame_of_a_hold_if_the_vehicle_rests(
    pixels: float, taken: list[int]
) -> None:
    """Images then move by less than a pixel. A frame exposed beyond the hold does not count."""
    legs = ", ".join(
        f"{{kind: slew, roll_deg: {roll}}}, {{kind: hold, duration: 5 s}}" for roll in (3, 0)
    )
    scene = loader.load(
        "afit_simsat_ideal", {"motion.maneuver": f"[{legs}]", "motion.control": "prescribed"}
    )
    start_s = guidance.plan(scene.motion).start_s
    exposure_s = 0.1
    rate_rad_s = pixels / exposure_s / scene.camera.focal_px
    t_s = [
        0.0,
        start_s[1] - 0.01,
        start_s[1],
        start_s[2] - 0.11,
        start_s[2] - 0.09,
        start_s[3],
        start_s[4] - 0.2,
    ]
    trajectory = SimpleNamespace(rate_at=lambda _: np.array([0.0, rate_rad_s, 0.0]))
    flight: Any = SimpleNamespace(
        lab=SimpleNamespace(scene=scene), is_over=True, trajectory=lambda: trajectory
    )
    views: Any = [
        SimpleNamespace(
            result=SimpleNamespace(row=SimpleNamespace(t_s=begin + exposure_s / 2)),
            exposure_s=exposure_s,
        )
        for begin in t_s
    ]
    assert survey.frames_at_rest(flight, views) == (taken, 2)


def flight_of(worker: Worker, overrides: dict[str, str]) -> None:
    """Open the scene and compute its flight."""
    worker.open("afit_simsat", overrides, False)
    worker.begin_flight()
    while not worker.advance_flight(10.0).is_done:
        pass


@pytest.mark.long
def test_a_survey_continues_with_the_frames_flown() -> None:
    """Frames are at the planned attitudes; more frames measure more LEDs with the estimated errors."""
    worker = Worker()
    bench = {"motion.control": "prescribed", "motion.maneuver": "[]"}
    worker.open("afit_simsat", bench, False)
    plan = worker.plan_survey(8)
    measured = 0
    for count in (8, 16):
        flight_of(worker, survey_flight("afit_simsat", bench, plan.angles_deg))
        assert worker.flight is not None
        views = [kept.view for kept in worker.flight.frames]
        rows, holds = survey.frames_at_rest(worker.flight.flight, views)
        assert holds == len(rows) == 8
        wxyz = np.array([views[row].body_wxyz for row in rows])
        wanted = survey_frames.from_angles(np.array(plan.angles_deg)).as_quat(
            scalar_first=True
        )
        np.testing.assert_allclose(
            np.abs(np.sum(wxyz * wanted, axis=1)), 1, rtol=0, atol=1e-9
        )
        found = worker.adjust_survey(8)
        of = found.statistics
        assert (of["frames"], of["refusal"]) == (count, "")
        assert of["measured"] > measured
        assert of["measured"] + of["seen_once"] + of["unseen"] <= len(found.ids) == 1465
        assert np.sum(found.known > 0) == of["measured"]
        plan = found.plan
        measured = of["measured"]
    assert 0.6 < of["led_mm_after"] / of["sigma_mm"] < 1.6
    assert of["led_mm_after"] < 0.5 * of["led_mm_before"]
    check_map(worker, found)
    flight_of(worker, survey_flight("afit_simsat", bench, ANGLES))
    assert worker.flight is not None
    worker.flight.frames = worker.flight.frames[:1]  # stopped before it came to an attitude
    with pytest.raises(InputError, match="rests at none of the flight's 2 holds"):
        worker.adjust_survey(8)
    check_map(worker, found)  # as before
    info, _ = worker.open("afit_simsat", {**bench, "exposure.time": "9 ms"}, False)
    assert info.surveyed
    info, _ = worker.open("afit_simsat", {**bench, "seed": "9"}, False)
    assert not info.surveyed
    with pytest.raises(InputError, match="no survey of this scene: plan one"):
        worker.survey_map()


def check_map(worker: Worker, found: SurveyFound) -> None:
    """The map's LEDs are those measured, at the true places but for the error that the page shows."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "leds.ecsv"
        path.write_bytes(worker.survey_map())
        dome = dome_map_file.read_dome_map(path)
    assert set(dome.id) == set(found.ids[found.known > 0])
    sources = worker.workbench.lab.camera.sources
    place_m = dict(zip(sources.id.tolist(), sources.place[:, :3], strict=True))
    error_m = dome.position_m - np.array([place_m[led] for led in dome.id.tolist()])
    error_mm = 1e3 * float(np.sqrt(np.mean(error_m**2)))
    assert error_mm == pytest.approx(found.statistics["led_mm_after"], rel=1e-6)


@pytest.mark.slow
def test_a_survey_has_the_frames_of_its_flights_once() -> None:
    """No frame of another maneuver counts. Two attitudes are reported as too few, and the next ones are planned."""
    worker = Worker()
    bench = {"motion.control": "prescribed", "exposure.frames": "2"}
    worker.open("afit_simsat", bench, False)
    worker.begin_flight()
    with pytest.raises(InputError, match="no survey of this scene: plan one"):
        worker.adjust_survey(4)
    worker.plan_survey(2)
    with pytest.raises(InputError, match="rests at none of the flight's 0 holds"):
        worker.adjust_survey(4)
    flown = survey_flight("afit_simsat", bench, ANGLES)
    flight_of(worker, flown)
    found = worker.adjust_survey(4)
    counts = [found.statistics[name] for name in ("frames", "measured", "missed")]
    assert counts == [2, 0, 0]
    assert survey_lines(found)[1].startswith("Not determined yet: ")
    assert len(found.plan.angles_deg) == 4
    with pytest.raises(InputError, match="has measured no LED yet"):
        worker.survey_map()
    flight_of(worker, flown)  # the same frames again
    with pytest.raises(InputError, match="has the frames of this flight"):
        worker.adjust_survey(4)


def test_a_survey_that_determines_nothing_is_reported() -> None:
    plan = SurveyPlan(ANGLES, [30, 31], 1465, ((4, 0, None), (6, 50, 0.46)))
    statistics: dict[str, Any] = {"frames": 2, "missed": 1, "seen_once": 60, "unseen": 1405}
    statistics |= {"measured": 0, "refusal": "too few"}
    refused = SurveyFound(statistics, [], np.arange(3), np.zeros(0), plan)
    assert survey_lines(refused) == [
        "2 frames: no LED measured; 60 seen once, 1405 not seen.",
        "1 attitudes have no frame: the vehicle did not rest there.",
        "Not determined yet: too few.",
    ]
    assert (
        prediction_text(plan)
        == "Predicted of the 1465 LEDs: after 6 frames 50 LEDs to 0.46 mm rms."
    )


def test_a_plan_needs_two_frames() -> None:
    with pytest.raises(InputError, match="frames: 1; allowed: 2 to"):
        survey.begin(loader.load("afit_simsat"), 1)


def test_colors_differ_in_lightness() -> None:
    """The scale's luminance is monotonic, so that color-blind readers can read it."""
    luminance = color_scale(np.linspace(0, 1, 64)) @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(luminance) > 0)


@pytest.mark.slow
def test_coverage_is_that_of_the_checked_attitudes_and_leaves_the_frame() -> None:
    """An independent count: lights of the check's own forecast at the same attitude."""
    worker = Worker()
    _, before = worker.open("afit_simsat", {}, True)
    angles, boresights = worker.reach()
    lab = worker.workbench.lab
    reach = attitudes.within_reach(attitudes.of_frames(lab), 0.999 * 30.0)
    np.testing.assert_allclose(boresights, reach.boresights, rtol=0, atol=1e-12)
    forecast = sampling.sampled(reach, detection.context_of(lab))
    for n in (0, 17, 40):
        lights, row = worker.cover(angles[n])
        np.testing.assert_allclose(row.truth_deg, angles[n], rtol=0, atol=1e-9)
        # The images of some are only in part on the detector.
        assert 0 <= lights - len(forecast.seen[n]) <= 4
        assert row.detected <= lights
        assert (row.status == "solved") == (row.matched > 0)
    assert worker.export()["frame.fits"]
    assert worker.workbench.result is before.result


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_a_map_of_coverage_can_be_stopped_and_a_click_points_the_camera(page: Any) -> None:
    open_scene(page, "afit_simsat")
    panel(page, "Check")
    page.get_by_role("button", name="Coverage", exact=True).click()
    marks = page.locator(".lab-coverage [role=button]")
    assert come(lambda: marks.count() >= 3)
    page.get_by_role("button", name="Stop", exact=True).click()
    page.get_by_role("button", name="Coverage", exact=True).wait_for()
    count = marks.count()
    page.wait_for_timeout(1000)
    assert marks.count() == count < 48
    page.get_by_role("button", name="Coverage", exact=True).click()
    assert come(lambda: marks.count() == 48)
    page.get_by_text("48 of 48 attitudes").wait_for()
    told = marks.nth(30).get_attribute("aria-label")
    marks.nth(30).click()
    wanted = [float(text) for text in re.findall(r"(-?[\d.]+)°", told)]
    assert come(
        lambda: np.allclose(
            [float(field.input_value()) for field in page.locator(".lab-angle").all()],
            wanted,
            rtol=0,
            atol=0.051,
        )
    )
    assert "solved" in told
    space = page.locator(".lab-space canvas").first
    assert space.get_attribute("data-dots") == "48"
    open_scene(page, "shefex2")
    assert come(lambda: marks.count() == 0)


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_check_map_and_survey_work_in_the_page(page: Any) -> None:
    open_scene(page, "afit_simsat")
    panel(page, "Check")
    page.get_by_role("button", name="Check", exact=True).click()
    page.locator(".lab-facts").get_by_text("field of view").wait_for()
    page.get_by_role("button", name="Map", exact=True).click()
    page.get_by_text("fields look like another one").wait_for()
    panel(page, "Survey")
    page.get_by_label("frames", exact=True).fill("5")
    page.get_by_role("button", name="Plan", exact=True).click()
    page.get_by_text("Predicted of the 1465 LEDs").wait_for()
    wanted = (
        page.locator(".lab-stops .num").nth(5).inner_text()
    )  # the first roll, after five heads
    page.get_by_role("button", name="Point to attitude 1", exact=True).click()
    assert come(
        lambda: (
            abs(float(page.locator(".lab-angle").nth(0).input_value()) - float(wanted))
            < 0.006
        )
    )
    fly, adjust, save = (
        page.get_by_role("button", name=name, exact=True)
        for name in ("Fly", "Adjust", "Map file")
    )
    assert save.is_disabled()
    fly.click()
    # The panel stays, and tells how far the flight is; few frames of it show the way.
    flown = page.locator(".q-tab-panel:visible").get_by_text(
        re.compile("frames solved, 0 wrong")
    )
    flown.wait_for(timeout=SLOW_MS)
    assert int(flown.inner_text().split()[2]) < 80
    assert come(adjust.is_enabled)
    adjust.click()
    page.get_by_text("5 frames, ").wait_for()
    page.get_by_text("after 10 frames").wait_for()  # the next attitudes, which can be flown
    assert page.locator(".lab-stops .num").nth(5).inner_text() != wanted
    with page.expect_download() as download:
        save.click()
    assert download.value.suggested_filename == "afit_simsat_leds.ecsv"
    of_survey = page.get_by_text("the brighter the better")
    of_map = page.get_by_text("drawn in the 3-D view")
    of_survey.wait_for()
    panel(page, "Check")
    assert of_map.is_hidden()
    page.get_by_role("button", name="Map", exact=True).click()  # it colors the LEDs anew
    of_map.wait_for()
    panel(page, "Survey")
    assert of_survey.is_hidden()
    page.get_by_role("button", name="Plan", exact=True).click()
    page.get_by_text("A new survey forgets the 5 frames").wait_for()
    page.get_by_role("button", name="Cancel", exact=True).click()
    page.get_by_text("A new survey forgets").wait_for(state="hidden")
    assert come(adjust.is_enabled)
    assert page.get_by_text("5 frames, ").is_visible()
    panel(page, "Scene")
    page.get_by_placeholder("find a key").fill("exposure.frames")
    set_to(page, "exposure.frames", "3")  # with another exposure the survey goes on
    panel(page, "Survey")
    page.get_by_text("after 10 frames").wait_for()
    adjust.click()
    page.get_by_text("no flight: fly the survey's attitudes").first.wait_for()
    page.get_by_role("button", name="Plan", exact=True).click()
    page.get_by_role("button", name="Begin anew", exact=True).click()
    page.get_by_text("after 4 frames").wait_for()  # the steps of a new plan
    chosen(page, "Scene", "shefex2")  # and what was shown of the dome is not shown of the sky
    page.get_by_text("Plan begins a survey").wait_for()
    assert adjust.is_disabled()
    assert save.is_disabled()
