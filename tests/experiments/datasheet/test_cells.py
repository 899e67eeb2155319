"""The cells of a datasheet: what each redraws, and scenes without cells."""

from __future__ import annotations

import json
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

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
    attitudes,
    check_scene,
    measure,
    planned,
    read,
    require_fields,
    states_c,
    unit_seeds,
)
from skysim.experiments.datasheet.scene_changes import catalog_end_mag
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


def test_a_setting_is_that_of_its_unit_state_and_attitude():
    """Each with new noise; an attitude is a few pixels from the next one, to other phases in the pixels."""
    designer = Designer(load("thermal_drift", {}), QUICK)
    pixel_deg = np.degrees(1 / designer.scene.camera.focal_px)
    first = designer.settings()
    other = designer.settings(unit=2, state=4, attitude=3, turn_deg=0.5)
    assert other["trial.noise_seed"] == first["trial.noise_seed"] + 1
    for key in designer.seeds:
        assert (first[key], other[key]) == (1000, 1002)
    assert first["trial.turn_deg"] == 0
    assert other["trial.turn_deg"] == pytest.approx(0.5 + 3 * 3.37 * pixel_deg)
    # Of three states the fifth is the second.
    assert other["thermal.temperature"] == {
        "kind": "steady",
        "temperature_c": designer.temperatures_c[1],
    }


def test_draws_have_other_attitudes_than_the_terms_and_each_other():
    """The first has the eleventh attitude: no more than ten are those of the terms."""
    designer = Designer(load("shefex2", {}), QUICK)
    cells = list(designer.cells())
    turns = {
        name: [one.settings["trial.turn_deg"] for one in cells if one.experiment == name]
        for name in ("terms", "total", "sky")
    }
    step_deg = 3.37 * designer.pixel_deg
    assert sorted(set(turns["terms"])) == pytest.approx([0, step_deg])
    expected = [(10 + n) * step_deg for n in range(len(turns["total"]))]
    assert turns["total"] == pytest.approx(expected)
    assert set(turns["sky"]) == {0.0}
    seeds = [one.settings["trial.attitude_seed"] for one in cells if one.experiment == "sky"]
    assert seeds == list(range(1, QUICK.sky + 1))


def test_frames_with_a_change_have_the_noise_of_those_without_it():
    designer = Designer(load("shefex2", {}), QUICK)
    cells = list(designer.cells())
    total = {one.levels["draw"]: one.settings for one in cells if one.experiment == "total"}
    pairs = [one for one in cells if one.experiment == "cause"]
    counts = Counter(one.levels["cause"] for one in pairs)
    assert set(counts.values()) == {QUICK.pairs}
    for cell in pairs:
        same = total[cell.levels["draw"]]
        assert same["trial.noise_seed"] == cell.settings["trial.noise_seed"]
        assert same["trial.turn_deg"] == cell.settings["trial.turn_deg"]
    for cell in cells:
        if cell.experiment == "disturbance":
            assert cell.levels["draw"] == 0
            centroids = cell.settings.get("trial.kind") == "centroids"
            assert ("trial.turn_deg" in cell.settings) == (not centroids)


@pytest.mark.parametrize("draws", [8, 9, 12])
def test_total_frames_have_whole_rounds_of_units_and_states(draws):
    designer = Designer(load("thermal_drift", {}), QUICK._replace(draws=draws))
    cells = [one for one in designer.cells() if one.experiment == "total"]
    combinations = designer.units * designer.states
    assert len(cells) % combinations == 0
    assert draws <= len(cells) < draws + combinations


def test_a_sequence_turns_by_its_rate_from_frame_to_frame():
    """Of one unit, at the scene's frame rate: at rest, and at the four slowest rates."""
    scene = load("shefex2", {})
    designer = Designer(scene, QUICK)
    cells = list(designer.sequences())
    rates = list(dict.fromkeys(one.levels["rate_deg_s"] for one in cells))
    assert rates == [0.0, *designer.rates_deg_s(STREAKS_PX[:4])]
    for one in cells:
        expected = one.levels["rate_deg_s"] * one.levels["step"] / scene.exposure.rate_hz
        assert one.settings["trial.turn_deg"] == pytest.approx(expected)
        assert one.settings["trial.rate_deg_s"] == one.levels["rate_deg_s"]
    steps = [one.levels["step"] for one in cells if one.levels["rate_deg_s"] == 0]
    assert steps == [0, 1, 2, 4, 8, 16]


def test_pairs_differ_in_their_noise_alone():
    designer = Designer(load("shefex2", {}), QUICK)
    for experiment in ("rate", "boresight", "acceleration", "magnitude"):
        cells = [one for one in designer.cells() if one.experiment == experiment]
        assert len(cells) % 2 == 0
        for first, second in zip(cells[::2], cells[1::2], strict=True):
            assert (first.levels["frame"], second.levels["frame"]) == (0, 1)
            differing = {
                key for key in first.settings if first.settings[key] != second.settings[key]
            }
            assert differing == {"trial.noise_seed"}


def test_tracked_motions_miss_by_their_acceleration_between_two_frames():
    """a t^2 from one frame to the next, in pixels; a frame is tracked after two others."""
    scene = load("shefex2", {})
    designer = Designer(scene, QUICK)
    cells = list(designer.tracked())
    assert {one.settings["trial.tracked"] for one in cells} == {2}
    accelerations = sorted(
        {
            one.settings["trial.acceleration_deg_s2"]
            for one in cells
            if one.experiment == "tracked acceleration_deg_s2"
        }
    )
    missed_px = np.radians(accelerations) / scene.exposure.rate_hz**2 * scene.camera.focal_px
    np.testing.assert_allclose(missed_px, [8, 30, 60, 120], rtol=0.06)
    rates = sorted(
        {
            one.settings["trial.rate_deg_s"]
            for one in cells
            if one.experiment == "tracked rate_deg_s"
        }
    )
    streaks_px = np.radians(rates) * scene.exposure.time_s * scene.camera.focal_px
    np.testing.assert_allclose(streaks_px, [2, 8, 16, 32], rtol=0.06)


def test_the_catalog_s_limit_is_varied_as_far_as_it_has_stars():
    scene = load("shefex2", {})
    limits = {
        one.settings["tracker.limit_mag"] - scene.tracker.limit_mag
        for one in Designer(scene, QUICK).magnitudes()
    }
    allowed = scene.tracker.limit_mag + 0.5 <= catalog_end_mag(scene)
    assert sorted(limits) == pytest.approx([-1, -0.5, 0, 0.5][: 4 if allowed else 3])
    end = load("shefex2", {"tracker.limit_mag": f"{catalog_end_mag(scene) - 0.3}"})
    last = max(one.settings["tracker.limit_mag"] for one in Designer(end, QUICK).magnitudes())
    assert last == pytest.approx(end.tracker.limit_mag)
    assert list(Designer(load("afit_simsat", {}), QUICK).magnitudes()) == []


@pytest.mark.parametrize(
    ("fields", "solved", "least", "enough"),
    [(9, 9, 10, 10), (20, 6, 10, 50), (12, 0, 10, 180), (40, 8, 20, 150), (12, 5, 20, 72)],
)
def test_a_refusal_names_fields_of_which_enough_would_be_solved(
    fields, solved, least, enough
):
    """Half as many again as the share that is solved asks for; as many as needed where all are solved."""
    require_fields(fields, least, least, "")
    with pytest.raises(InputError, match=f"allowed: {enough} or more"):
        require_fields(fields, solved, least, "few")


def test_a_state_s_temperatures_are_those_of_its_history():
    """A table's from its first to its last hour, a steady one's alone, and equal parts of a day."""
    base = {"thermal.mount_arcsec_k": "[1, 0, 0]"}
    table = "{kind: table, hours: [2, 3, 6], temperature_c: [10, 15, 30]}"
    scene = load("shefex2", base | {"thermal.temperature": table})
    assert states_c(scene, 5) == pytest.approx([10, 15, 20, 25, 30])
    steady = "{kind: steady, temperature_c: 12}"
    assert states_c(load("shefex2", base | {"thermal.temperature": steady}), 5) == [12]
    linear = "{kind: linear, start_c: 20, rate_c_h: 1}"
    drifting = load("shefex2", base | {"thermal.temperature": linear})
    assert np.diff(states_c(drifting, 4)) == pytest.approx([6, 6, 6])


def test_a_dome_s_attitudes_are_within_the_stop_and_thirty_degrees():
    assert attitudes(load("shefex2", {})) == {}
    for stop_deg, greatest in ((20, 20), (45, 30)):
        scene = load("afit_simsat", {"vehicle.tilt_stop_deg": f"{stop_deg}"})
        assert attitudes(scene) == {"tilt_deg": [0.0, greatest]}


def test_faster_rates_are_twice_the_last_ones():
    designer = Designer(load("shefex2", {}), QUICK)
    cells = list(designer.rates())
    fastest = {
        name: max(one.levels["rate_deg_s"] for one in cells if one.experiment == name)
        for name in ("rate", "boresight")
    }
    count = len(cells)
    designer.add_faster(cells, ["rate", "boresight"])
    added = cells[count:]
    assert [one.experiment for one in added] == ["rate"] * 2 + ["boresight"] * 2
    for one in added:
        assert one.levels["rate_deg_s"] == 2 * fastest[one.experiment]


def test_the_study_of_a_datasheet_has_its_cells_fields_and_overrides(tmp_path):
    """The seed is the scene's, and all else that was set on the command line is in the file."""
    overrides = {"seed": "11", "camera.f_number": "2.5"}
    scene = load("shefex2", overrides)
    designer = Designer(scene, QUICK)
    cells = list(designer.terms())
    plan = planned(tmp_path / "sheet.yaml", "shefex2", designer, overrides, cells)
    written = yaml.safe_load((tmp_path / "sheet.yaml").read_text(encoding="utf-8"))
    assert written["set"] == {"camera.f_number": 2.5}
    assert written["seed"] == 11
    assert written["schema"] == 1
    assert written["replicates"] == QUICK.fields
    assert written["trial"] == {"kind": "frames"}
    assert len(plan.points) == len(cells)
    assert plan.trials == len(cells) * QUICK.fields
    assert list(written["factors"]["cell"]["levels"]) == [cell.name for cell in cells]
    plain = planned(tmp_path / "plain.yaml", "shefex2", designer, {}, cells)
    assert "set" not in yaml.safe_load((tmp_path / "plain.yaml").read_text(encoding="utf-8"))
    assert plain.trials == plan.trials


def test_results_are_read_by_cell_and_field():
    """Trial n is field n modulo the fields of cell n over the fields; the first failure is named with its cell."""
    points = [SimpleNamespace(levels={"cell": f"cell {n}"}) for n in range(3)]
    plan = SimpleNamespace(points=points, study=SimpleNamespace(replicates=4))
    kept = SimpleNamespace(failures=list, columns=lambda: {"x": np.arange(12)})
    found = read(plan, kept)
    np.testing.assert_array_equal(found["x"], [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]])
    kept.failures = lambda: [(7, "Traceback\n  line\nValueError: why\n"), (9, "other")]
    with pytest.raises(InputError, match="cell 1: ValueError: why"):
        read(plan, kept)


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
