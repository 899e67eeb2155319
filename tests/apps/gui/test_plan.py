"""The lab's plan panel: check, ambiguity map and survey, by the worker and in Chromium."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from labpage import CHROMIUM, chosen, come, panel, status

from skysim.apps.gui.messages import AmbiguityMap
from skysim.apps.gui.page.panels.plan import HOLD_S, ambiguity_text, survey_flight
from skysim.apps.gui.page.style import color_scale
from skysim.apps.gui.worker.scene import planning
from skysim.core.errors import InputError
from skysim.dynamics import guidance
from skysim.experiments.dome_survey import stops
from skysim.scene import loader
from skysim.simulation import checks
from skysim.simulation.testbed import build_testbed

pytest_plugins = ["labpage"]
ANGLES = ((5.0, -3.0, 20.0), (-4.0, 2.0, 140.0))


def test_a_check_is_that_of_the_command() -> None:
    testbed = build_testbed(loader.load("afit_simsat", {"exposure.time": "50 ms"}))
    found, expected = planning.check(testbed), checks.check(testbed)
    assert [name for name, _ in found.facts] == [fact.name for fact in expected.facts]
    assert list(found.findings) == expected.findings
    assert found.findings  # all LEDs saturate


@pytest.mark.slow
def test_a_regular_dome_is_ambiguous_and_a_random_one_is_not() -> None:
    """The rings of a geodesic dome repeat after a fifth of a turn."""
    shares = {}
    for kind, size in (("geodesic", "frequency: 32"), ("poisson_disk", "count: 800")):
        settings = {"light.layout": f"{{kind: {kind}, {size}, cap_deg: 40}}"}
        testbed = build_testbed(loader.load("afit_simsat_ideal", settings))
        found = planning.ambiguity(testbed)
        assert set(found.ids) <= set(testbed.sources.id)
        assert np.all((found.fraction >= found.least) & (found.fraction <= 1))
        shares[kind] = np.mean(found.fraction > 0.9)
    assert shares["geodesic"] > 0.5
    assert shares["poisson_disk"] == 0


def test_stars_have_no_ambiguity_map() -> None:
    with pytest.raises(InputError, match=r"light\.kind: stars: .*; allowed: dome"):
        planning.ambiguity(build_testbed(loader.load("shefex2")))


def test_the_most_similar_fields_are_named() -> None:
    found = AmbiguityMap(np.array([3, 8]), np.array([8, 3]), np.array([0.5, 0.95]), 0.3, 0.61)
    text = ambiguity_text(found)
    assert text.startswith("1 of 2 fields look like another one")
    assert "LED 8 and 3, 95 %" in text


def test_a_survey_is_flown_through_its_attitudes_with_frames_over_all_of_it() -> None:
    flown = loader.load("afit_simsat", survey_flight("afit_simsat", {}, ANGLES))
    reference = guidance.plan(flown.motion)
    t_s, found = 0.0, []
    for leg in reference.legs[:-1]:
        t_s += leg.duration_s
        if leg.duration_s == HOLD_S:
            found.append(reference.state_at(t_s - HOLD_S / 2)[0])
    assert len(found) == len(ANGLES)
    wxyz = stops.from_angles(np.array(ANGLES)).as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs(np.sum(np.array(found) * wxyz, axis=1)), 1, rtol=0, atol=1e-9)
    last_s = flown.exposure.first_s + (flown.exposure.frames - 1) / flown.exposure.rate_hz
    assert reference.duration_s - HOLD_S < last_s <= reference.duration_s


def test_a_plan_needs_two_frames() -> None:
    with pytest.raises(InputError, match="frames 1: allowed: 2 to"):
        planning.survey(loader.load("afit_simsat"), 1)


def test_colors_are_told_apart_by_their_lightness() -> None:
    """The scale's luminance rises all along, so that eyes that see fewer colors see it as well."""
    luminance = color_scale(np.linspace(0, 1, 64)) @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(luminance) > 0)


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_check_map_and_survey_in_the_page(page: Any) -> None:
    chosen(page, "Scene", "afit_simsat")
    page.wait_for_function("document.querySelector('.lab-title').innerText.includes('AFIT')")
    status(page, "solved")
    panel(page, "Plan")
    page.get_by_role("button", name="Check", exact=True).click()
    page.locator(".lab-facts").get_by_text("field of view").wait_for()
    page.get_by_role("button", name="Map", exact=True).click()
    page.get_by_text("fields look like another one").wait_for()
    page.get_by_role("button", name="Plan", exact=True).click()
    page.get_by_text("Predicted rms error").wait_for()
    wanted = page.locator(".lab-stops .num").nth(5).inner_text()  # the first roll, after five heads
    page.get_by_role("button", name="Point to attitude 1", exact=True).click()
    assert come(lambda: abs(float(page.get_by_label("angle 1").input_value()) - float(wanted)) < 0.006)
    page.get_by_role("button", name="Fly", exact=True).click()
    page.get_by_role("button", name="Stop", exact=True).wait_for()  # of the flight that is computed
    page.get_by_role("button", name="Stop", exact=True).click()
    page.get_by_role("button", name="Simulate", exact=True).wait_for()
