"""What a scene's file states replaces what its base says: a map the survey, null a key, 0 without a unit."""

from __future__ import annotations

from pathlib import Path

import pytest

from skysim import load_scene
from skysim.core.errors import InputError
from skysim.scene.scene import Scene
from skysim.scene.sections.tracker import SurveyErrorsConfig


def above(folder: Path, text: str) -> Scene:
    """The scene of a file with this section above a base with a survey, beside a map."""
    (folder / "leds.ecsv").touch()
    (folder / "mine.yaml").write_text(f"schema: 1\nbase: afit_simsat\n{text}\n")
    return load_scene(folder / "mine.yaml")


def test_a_map_replaces_the_survey_of_its_base(tmp_path: Path) -> None:
    tracker = above(tmp_path, "tracker: {map: leds.ecsv}").tracker
    assert tracker.map == str(tmp_path / "leds.ecsv")
    assert tracker.survey == SurveyErrorsConfig(seed=2012)
    by_option = load_scene("afit_simsat", {"tracker.map": tracker.map}).tracker
    assert by_option == tracker


def test_a_survey_beside_its_map_is_a_conflict(tmp_path: Path) -> None:
    text = "tracker: {map: leds.ecsv, survey: {led_sigma: 0.1 mm}}"
    with pytest.raises(InputError, match=r"led_sigma: conflicts with tracker.map.*line 3"):
        above(tmp_path, text)


@pytest.mark.parametrize(
    "text",
    ["survey: null", "survey: {led_sigma: null, lever_sigma: null, seed: null}"],
)
def test_null_removes_a_key_of_the_base(tmp_path: Path, text: str) -> None:
    assert above(tmp_path, f"tracker: {{{text}}}").tracker.survey == SurveyErrorsConfig()
    assert above(tmp_path, f"tracker: {{{text}, map: leds.ecsv}}").tracker.map


def test_null_gives_the_default_and_stays_a_value_where_it_is_one(tmp_path: Path) -> None:
    scene = above(
        tmp_path, "light: {led: {pwm_period: null}}\nmotion: {control: null, maneuver: []}"
    )
    assert scene.dome is not None
    assert (
        scene.dome.led.pwm_period_s
        == type(scene.dome.led).model_fields["pwm_period_s"].get_default()
    )
    assert scene.motion.control is None
    with pytest.raises(InputError, match=r"camera.focal_length: None has no unit"):
        above(tmp_path, "camera: {focal_length: null}")


@pytest.mark.parametrize("zero", ["0", "0.0", '"0"', '"0 m"'])
def test_zero_needs_no_unit(tmp_path: Path, zero: str) -> None:
    survey = above(tmp_path, f"tracker: {{survey: {{led_sigma: {zero}}}}}").tracker.survey
    assert survey.led_sigma_m == 0
    for other in ("1", "false"):
        with pytest.raises(InputError, match="has no unit"):
            above(tmp_path, f"tracker: {{survey: {{led_sigma: {other}}}}}")
