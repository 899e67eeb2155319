"""The cells of a datasheet: what each redraws, and scenes without cells."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.experiments.datasheet import scene_changes
from skysim.experiments.datasheet.cells import (
    BENDS_PX,
    FULL,
    MIN_FIELDS,
    MODEL_FIELDS,
    QUICK,
    STREAKS_PX,
    DatasheetCell,
    Designer,
    check_scene,
    measure,
    states_c,
    unit_seeds,
)
from skysim.scene.loader import load


@pytest.mark.parametrize("scene", ["shefex2", "afit_simsat", "thermal_drift"])
def test_every_cell_is_different(scene):
    """Names are distinct; only frames that are compared share their noise: a change, and the draw before it."""
    cells = list(Designer(load(scene, {}), QUICK).cells())
    assert len({cell.name for cell in cells}) == len(cells)
    noise = Counter(cell.settings["trial.noise_seed"] for cell in cells)
    shared = {seed for seed, count in noise.items() if count > 1}
    paired = {
        cell.settings["trial.noise_seed"]
        for cell in cells
        if cell.experiment in ("cause", "disturbance")
    }
    assert shared == paired & {
        cell.settings["trial.noise_seed"] for cell in cells if cell.experiment == "total"
    }


def test_the_total_cells_use_the_units_of_the_terms_in_turn():
    """Each unit is used equally often, so that terms and total agree with few units; probabilities use other frames."""
    designer = Designer(load("afit_simsat", {}), FULL)
    cells = list(designer.cells())
    assert designer.seeds == [
        "camera.detector.hardware_seed",
        "tracker.survey.seed",
        "light.layout.hardware_seed",
    ]
    seeds = {
        name: [one.settings["tracker.survey.seed"] for one in cells if one.experiment == name]
        for name in ("terms", "total", "sky")
    }
    assert len(set(seeds["terms"])) == FULL.units
    assert set(Counter(seeds["total"]).values()) == {FULL.draws // FULL.units}
    assert set(seeds["total"]) == set(seeds["terms"])
    assert len(set(seeds["sky"])) == FULL.sky
    assert not set(seeds["terms"]) & set(seeds["sky"])


def test_units_and_thermal_states_are_combined_equally_often():
    designer = Designer(load("thermal_drift", {}), QUICK)
    draws = [cell.settings for cell in designer.cells() if cell.experiment == "total"]
    combined = Counter(
        (one["camera.detector.hardware_seed"], one["thermal.temperature"]["temperature_c"])
        for one in draws
    )
    assert len(combined) == designer.units * designer.states
    assert set(combined.values()) == {1}


@pytest.mark.parametrize("experiment", ["cause", "total"])
def test_every_thermal_state_is_used_equally_often(experiment):
    """Also by the frames with a cause: of the first state alone they would tell the effect of one temperature."""
    designer = Designer(load("thermal_drift", {}), QUICK)
    cells = [cell for cell in designer.cells() if cell.experiment == experiment]
    used = Counter(
        (cell.levels.get("cause"), cell.settings["thermal.temperature"]["temperature_c"])
        for cell in cells
        if cell.levels.get("cause") != "the temperature held"
    )
    causes = {cause for cause, _ in used}
    assert len(used) == len(causes) * designer.states
    assert len(set(used.values())) == 1


def test_only_a_tracker_with_a_tracking_mode_has_tracking_limits():
    rolling = {"camera.shutter": "{kind: rolling, row_time: 20 us}"}
    for scene, overrides, has in (
        ("shefex2", {}, True),
        ("shefex2", rolling, False),
        ("afit_simsat", {}, False),
    ):
        cells = Designer(load(scene, overrides), QUICK).cells()
        assert any(cell.experiment.startswith("tracked") for cell in cells) == has


def test_units_are_equal_without_a_pattern():
    plain = {f"camera.detector.{key}": "0" for key in ("prnu", "dsnu", "hot_pixels")}
    assert unit_seeds(load("shefex2", {})) == ["camera.detector.hardware_seed"]
    assert unit_seeds(load("shefex2", plain)) == []
    assert Designer(load("shefex2", plain), QUICK).units == 1


def test_thermal_states_match_the_scene():
    """A period of the sine of 3 K about 21 C in four steps; none without a section."""
    scene = load("thermal_drift", {})
    assert states_c(scene, 4) == pytest.approx([21, 24, 21, 18])
    assert states_c(load("shefex2", {}), 4) == []


@pytest.mark.parametrize(
    ("fields", "least", "message"),
    [
        (
            9,
            MIN_FIELDS,
            "datasheet.fields: 9: too few for the error terms, 10 needed; allowed: 10 or more",
        ),
        (16, MODEL_FIELDS, "datasheet.fields: 16: .* allowed: 20 or more"),
    ],
)
def test_too_few_fields_are_refused_before_the_first_trial(fields, least, message, tmp_path):
    with pytest.raises(InputError, match=message):
        measure(
            "shefex2", load("shefex2", {}), {}, tmp_path / "x", fields=fields, least=least
        )
    assert not (tmp_path / "x").exists()


def test_a_cell_that_is_not_allowed_is_refused_before_the_first_trial(tmp_path, monkeypatch):
    def refused(self):
        yield DatasheetCell("cause", {"cause": "more"}, {"camera.f_number": -1})

    monkeypatch.setattr(Designer, "cells", refused)
    with pytest.raises(InputError, match=r"cause cause more: camera\.f_number"):
        measure("shefex2", load("shefex2", {}), {}, tmp_path, fields=10, workers=1)


@pytest.mark.parametrize(
    ("scene", "overrides", "message"),
    [
        ("collimated_display", {}, "light.kind: collimated_display"),
        ("coded_spiral", {}, "tracker.decoder: gives no attitude for one frame"),
        (
            "shefex2",
            {"tracker.exposure_control": "{mean_dn: 500}"},
            "tracker.exposure_control",
        ),
    ],
)
def test_a_scene_without_attitudes_of_single_frames_is_refused(scene, overrides, message):
    with pytest.raises(InputError, match=message) as refused:
        check_scene(load(scene, overrides))
    assert "allowed" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_turn_about_the_boresight_smears_the_edge_as_far_as_the_streak_says():
    """A star at half of the field's smaller side moves by radius times angle."""
    scene = load("shefex2", {})
    designer = Designer(scene, QUICK)
    radius_px = min(scene.camera.width_px, scene.camera.height_px) / 2
    for streak, rate in zip(
        (2.0, 32.0), designer.rates_deg_s((2.0, 32.0), "boresight"), strict=True
    ):
        assert radius_px * np.radians(rate) * scene.exposure.time_s == pytest.approx(
            streak, rel=0.05
        )
    cells = [one for one in designer.cells() if one.experiment == "boresight"]
    assert all(one.settings["trial.rate_axis"] == "boresight" for one in cells)


@pytest.mark.parametrize("time_s", [0.02, 0.1])
def test_streaks_and_bends_have_their_lengths_in_the_image(time_s):
    """A star at the center runs by f tan(w T) at a rate w, by half of a bend in T from rest; rates have two digits."""
    designer = Designer(load("shefex2", {"exposure.time": f"{time_s} s"}), QUICK)
    camera = designer.scene.camera
    rates = np.radians(designer.rates_deg_s(STREAKS_PX))
    streaks_px = camera.focal_px * np.tan(rates * time_s)
    np.testing.assert_allclose(streaks_px, STREAKS_PX, rtol=0.06)
    accelerations = np.radians(designer.accelerations_deg_s2(BENDS_PX, time_s))
    bends_px = 2 * camera.focal_px * np.tan(accelerations * time_s**2 / 2)
    np.testing.assert_allclose(bends_px, BENDS_PX, rtol=0.06)


def test_exclusion_angles_need_a_baffle():
    baffle = {
        "camera.baffle": "{angle_deg: [10, 90], pst: [1e-3, 1e-6]}",
        "light.bodies": "{}",
    }
    for overrides, bodies in (({}, ()), (baffle, ("sun", "moon"))):
        scene = load("shefex2", overrides)
        cells = [
            one for one in Designer(scene, QUICK).cells() if one.experiment == "exclusion"
        ]
        assert {one.levels["body"] for one in cells} == set(bodies)
        for one in cells:
            off_deg = one.levels["off_deg"]
            assert one.settings["trial.near"]["off_deg"] == [off_deg, off_deg]


@pytest.mark.parametrize(
    ("name", "keys", "has"),
    [
        (
            "afit_as_built",
            {"camera.psf.coma_px": "1", "camera.detector.cti_serial": "1e-5"},
            {
                "no transfer loss",
                "the lever known",
                "the LEDs' map known",
                "the pupil fixed",
                "dies centered",
                "no sag",
                "a round ball",
                "no coma",
                "even pixels",
                "straight edges",
                "no brighter-fatter charge",
            },
        ),
        (
            "shefex2",
            {"site.longitude_deg": "9", "light.air": "{dispersion: true}"},
            {"no fixed pattern", "no dispersion by the air"},
        ),
    ],
)
def test_a_cause_that_is_switched_off_is_no_cause(
    name: str, keys: dict[str, str], has: set[str]
) -> None:
    listed = scene_changes.causes(load(name, keys))
    assert has <= set(listed)
    for cause in has:
        ideal = {key: json.dumps(value) for key, value in listed[cause].items()}
        assert cause not in scene_changes.causes(load(name, keys | ideal))
