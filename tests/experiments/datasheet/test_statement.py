"""The numbers of a datasheet from errors that are drawn, beside direct arithmetic: rows, texts and figures."""

from __future__ import annotations

import itertools
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from skysim.core.types import Floats
from skysim.experiments.datasheet import (
    datasheet_report,
    model_fit,
    performance,
    scene_changes,
    statement,
    variance_components,
)
from skysim.experiments.datasheet.cells import AXES, Designer, MeasuredFrames, Size
from skysim.experiments.datasheet.error_model import ErrorModel
from skysim.experiments.datasheet.performance import Counts
from skysim.experiments.datasheet.statement import Statement, StatementSection
from skysim.experiments.datasheet.variance_components import Bounded
from skysim.scene.loader import load

SIZE = Size(fields=16, units=4, states=2, attitudes=2, frames=2, draws=8, sky=4, pairs=3)
BAFFLE = {
    "camera.baffle": "{angle_deg: [10, 90], pst: [1e-3, 1e-6]}",
    "light.bodies": "{}",
    "thermal.mount_arcsec_k": "[1.0, 0.0, 0.0]",
    "thermal.temperature": "{kind: table, hours: [0, 1], temperature_c: [20, 23]}",
}


def made_sheet(scene: str = "shefex2", overrides: dict[str, str] = BAFFLE) -> MeasuredFrames:
    """All cells of a scene with errors of 1 to 3 arcseconds, more at a rate; a tenth refused, a few false."""
    loaded = load(scene, overrides)
    designer = Designer(loaded, SIZE)
    cells = list(designer.cells())
    rng = np.random.default_rng(1)
    shape = (len(cells), SIZE.fields)
    rates = np.array([cell.settings.get("trial.rate_deg_s", 0.0) for cell in cells])
    biased = 2.0 + (1 + rates[:, None]) * rng.standard_normal((3, *shape))
    columns: dict[str, Any] = dict(
        zip(AXES, biased * [[[1.0]], [[1.5]], [[6.0]]], strict=True)
    )
    draw = rng.uniform(size=shape)
    sure = np.array([cell.experiment == "terms" for cell in cells])[:, None]
    columns["solved"] = ((draw > 0.1) | sure).astype(float)
    columns["wrong"] = ((draw > 0.97) & ~sure).astype(float)
    columns["nees"] = rng.chisquare(3, shape)
    columns["streak_px"] = 40 * rates[:, None] + rng.uniform(0, 1, shape)
    columns["boresight_ra_deg"] = rng.uniform(0, 360, shape)
    columns["boresight_dec_deg"] = rng.uniform(-80, 80, shape)
    columns["body_azimuth_deg"] = rng.uniform(0, 360, shape)
    columns["body_tilt_deg"] = rng.uniform(0, 30, shape)
    columns["trial"] = np.arange(draw.size).reshape(shape)
    unused: Any = None
    return MeasuredFrames(loaded, scene, {}, SIZE, designer, cells, columns, unused)


@pytest.fixture(scope="module")
def sheet() -> MeasuredFrames:
    return made_sheet()


def stated(sheet: MeasuredFrames) -> Statement:
    with pytest.MonkeyPatch.context() as patch:
        times_s = np.linspace(0.00994, 0.02994, 41)
        patch.setattr(performance, "solution_times_s", lambda _: times_s)
        return statement.state(sheet)


@pytest.fixture(scope="module")
def whole(sheet: MeasuredFrames) -> Statement:
    return stated(sheet)


def chosen(sheet: MeasuredFrames, experiment: str, **levels: Any) -> Floats:
    """(3, cells, fields) errors of cells, NaN where not right."""
    rows = [
        n
        for n, cell in enumerate(sheet.cells)
        if cell.experiment == experiment
        and all(cell.levels.get(key) == value for key, value in levels.items())
    ]
    assert rows
    errors = np.array([sheet.columns[name][rows] for name in AXES])
    right = (sheet.columns["solved"][rows] == 1) & (sheet.columns["wrong"][rows] == 0)
    return np.where(right, errors, np.nan)


def field_squares(errors: Floats) -> Floats:
    """(fields,) mean squares over axes and cells; NaN in fields without any."""
    squares = np.ma.masked_invalid(errors**2).mean(axis=(0, 1))
    return np.ma.filled(squares, np.nan)


def rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def test_a_row_at_a_rate_has_the_noise_of_its_pairs_and_the_errors_of_its_frames(
    sheet: MeasuredFrames, whole: Statement
) -> None:
    """At rest the frames of the terms' first unit, state and attitude: rms of half the difference's square, and all."""
    for rows, experiment in ((whole.rates, "rate"), (whole.boresight_rates, "boresight")):
        assert [row["rate_deg_s"] for row in rows] == [
            0.0,
            *sheet.levels(experiment, "rate_deg_s"),
        ]
        assert rows[0]["streak_px"] == 0
        for row in rows:
            if row["rate_deg_s"] == 0:
                errors = chosen(sheet, "terms", unit=0, state=0, attitude=0)
            else:
                errors = chosen(sheet, experiment, rate_deg_s=row["rate_deg_s"])
                assert row["streak_px"] == pytest.approx(
                    40 * row["rate_deg_s"] + 0.5, abs=0.3
                )
            apart = errors[:, 0] - errors[:, 1]
            assert row["nea_across"] == pytest.approx(rms(apart[:2]) / math.sqrt(2))
            assert row["nea_about"] == pytest.approx(rms(apart[2]) / math.sqrt(2))
            assert row["rms_across"] == pytest.approx(rms(errors[:2]))
            assert row["rms_about"] == pytest.approx(rms(errors[2]))
            right = np.isfinite(errors[0]).all(axis=0).sum()
            assert row["counts"].right == right
            assert row["counts"].frames == 16


def test_quantiles_are_those_of_the_angle_between_boresights_and_of_the_roll(
    sheet: MeasuredFrames, whole: Statement
) -> None:
    x, y, roll = (one[np.isfinite(one)] for one in chosen(sheet, "sky"))
    assert [one["level"] for one in whole.quantiles] == [0.683, 0.954, 0.997]
    for one in whole.quantiles:
        across = np.quantile(np.sqrt(x**2 + y**2), one["level"])
        assert one["across"].value == pytest.approx(across)
        assert one["about"].value == pytest.approx(np.quantile(np.abs(roll), one["level"]))
        assert one["across"].trials in (0, len(x))


def test_a_cause_is_judged_on_as_many_draws_as_it_has_the_best_first(
    sheet: MeasuredFrames, whole: Statement
) -> None:
    """Mean squares over the fields of both, each field the mean of its frames and of the axes of a group."""
    assert {one["cause"] for one in whole.causes} == set(scene_changes.causes(sheet.scene))
    sums = []
    for one in whole.causes:
        after = chosen(sheet, "cause", cause=one["cause"])
        assert after.shape[1] == SIZE.pairs
        before = np.concatenate(
            [chosen(sheet, "total", draw=draw) for draw in range(SIZE.pairs)], axis=1
        )
        for name, axes in (("across", [0, 1]), ("about", [2])):
            squares = np.ma.masked_invalid(
                [field_squares(each[axes]) for each in (after, before)]
            )
            known = ~squares.mask.any(axis=0) if squares.mask.any() else slice(None)
            ratio = squares[0][known].mean() / squares[1][known].mean()
            assert one[name].value == pytest.approx(ratio)
            assert one[name].low < ratio < one[name].high
        sums.append(one["across"].value + one["about"].value)
    assert sums == sorted(sums)


def test_disturbances_and_exclusions_count_every_frame(
    sheet: MeasuredFrames, whole: Statement
) -> None:
    """The undisturbed frames are the first of the total ones; the farthest angle from a body comes first."""
    assert whole.disturbances[0]["disturbance"] == "none"
    names = [one["disturbance"] for one in whole.disturbances[1:]]
    assert names == list(scene_changes.disturbances(sheet.scene))
    errors = [chosen(sheet, "total", draw=0)]
    errors += [chosen(sheet, "disturbance", disturbance=name) for name in names]
    for one, found in zip(whole.disturbances, errors, strict=True):
        assert one["counts"].frames == 16
        assert one["counts"].right == np.isfinite(found[0]).sum()
        assert one["rms_about"] == pytest.approx(rms(found[2]))
    places = [(one["body"], one["off_deg"]) for one in whole.exclusions]
    angles = sorted(scene_changes.OFF_DEG, reverse=True)
    assert places == [(body, angle) for body in ("sun", "moon") for angle in angles]


def test_the_terms_of_a_group_are_the_means_over_its_axes(
    sheet: MeasuredFrames, whole: Statement
) -> None:
    """The mean error, its share of the whole, and the sum over the mean square of the total frames."""
    design = (SIZE.units, 2, SIZE.attitudes, SIZE.frames)
    units = len({cell.levels["unit"] for cell in sheet.cells if cell.experiment == "terms"})
    errors = chosen(sheet, "terms").reshape(3, units, *design[1:], SIZE.fields)
    errors = np.moveaxis(errors, -1, 1)
    means = [one.mean() for one in errors]
    assert [one.value for one in whole.bias] == pytest.approx(means)
    assert all(one.low < one.value < one.high for one in whole.bias)
    assert whole.fields == SIZE.fields
    totals = chosen(sheet, "total")
    for name, axes in (("across", [0, 1]), ("about", [2])):
        table = whole.terms[name]
        square = float(np.mean(errors[axes] ** 2))
        assert table.squares["total"].value == pytest.approx(square)
        parts = [table.squares[one].value for one in variance_components.TERMS]
        assert sum(parts) == pytest.approx(square)
        assert table.ratio.value == pytest.approx(square / field_squares(totals[axes]).mean())
        assert table.signs["temporal"] == table.signs["bias"] == table.signs["total"] == 1
        # Nothing scatters from field to field: it is within the intervals, or hardly beside them.
        assert table.dominant == max(
            variance_components.TERMS, key=lambda one: table.squares[one].value
        )


@pytest.mark.parametrize(
    ("value", "zero", "expected"),
    [((2, 1, 3), 0, 1), ((-2, -3, -1), 0, -1), ((1, -1, 3), 0, 0), ((2, 1, 3), 4, -1)],
)
def test_a_term_s_sign_is_that_of_its_whole_interval(
    value: tuple[float, float, float], zero: float, expected: int
) -> None:
    assert variance_components.sign(Bounded(*value), zero) == expected
    assert variance_components.sign(Bounded(1.0, math.nan, math.nan), zero) == 0


def test_a_global_shutter_reads_out_at_once(sheet: MeasuredFrames) -> None:
    """The latency is half of the exposure and the solution; the rate that of the slowest of twenty solutions."""
    scene = SimpleNamespace(
        camera=SimpleNamespace(shutter=SimpleNamespace(), height_px=1000),
        exposure=SimpleNamespace(time_s=0.1, rate_hz=5.0),
    )
    times_s = [0.01, *[0.02] * 17, 0.5, 0.5, 1.0]
    unused: Any = SimpleNamespace(scene=scene)
    found = performance.timing(unused, times_s)
    assert found["readout_s"] == 0
    assert found["latency_s"] == pytest.approx(0.05 + 0.02)
    assert found["greatest_rate_hz"] == pytest.approx(2)
    assert found["rate_hz"] == 5


def test_a_term_is_printed_as_a_root_and_a_percentage() -> None:
    """A square of 4 (1 to 9) of 16 is 2 (1 to 3) and a quarter; without a sign it is its upper bound."""
    squares = {
        "field": Bounded(4.0, 1.0, 9.0),
        "pixel": Bounded(1.0, -1.0, 4.0),
        "bias": Bounded(-4.0, -9.0, -1.0),
        "total": Bounded(16.0, 9.0, 25.0),
    }
    signs = {"field": 1, "pixel": 0, "bias": -1, "total": 1}
    table: Any = SimpleNamespace(squares=squares, signs=signs)
    assert statement.sizes(table, "field") == ["2 (1 to 3)", "25.0"]
    assert statement.sizes(table, "pixel") == ["< 2", "< 25.0"]
    assert statement.sizes(table, "bias") == ["negative", "-25.0"]
    assert statement.sizes(table, "total") == ["4 (3 to 5)", "100.0"]


def test_values_are_printed_with_their_intervals_or_their_absence() -> None:
    assert statement.bounded(Bounded(1.23456, 1.0, 2.0)) == "1.23 (1 to 2)"
    assert statement.bounded(Bounded(1.26, 1.04, 2.0), 2) == "1.3 (1 to 2)"
    assert statement.bounded(Bounded(1.0, math.nan, math.nan)) == "too few to say"
    assert statement.percent(Counts(200, 100, 100, 0).share("right")).startswith("50 (4")
    assert statement.arcsec(1.2345) == "1.23"
    assert statement.arcsec(math.nan) == "-"
    missing: Any = SimpleNamespace(low=math.nan, needs=12)
    assert statement.quantile_text(missing) == "not established: 12 more frames needed"


@pytest.mark.parametrize(
    ("units", "factors"), [(4, (0.57, 3.7)), (8, (0.66, 2.0)), (5, (0.6, 2.9))]
)
def test_few_units_bound_the_scatter_as_the_tables_of_chi_square_say(
    units: int, factors: tuple[float, float]
) -> None:
    """The factors for a standard deviation at 95 % of n = 4, 5, 8: 0.566 and 3.73, 0.599 and 2.87, 0.661 and 2.035.

    Source: Dixon & Massey, Introduction to Statistical Analysis, tables of chi-square over degrees of freedom.
    """
    text = statement.unit_text(units)
    found = re.search(r"factor of (\S+) to (\S+) \(95 %\)", text)
    assert found
    assert (float(found[1]), float(found[2])) == factors
    assert f"the {units} units" in text


def numbers_of(text: str) -> list[float]:
    return [float(one) for one in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", text)]


def section_of(whole: Statement, title: str) -> StatementSection:
    return next(one for one in statement.sections(whole) if one.title == title)


def test_every_section_is_there_unless_its_numbers_are_missing(whole: Statement) -> None:
    titles = [one.title for one in statement.sections(whole)]
    assert len(titles) == 12
    without = whole._replace(
        magnitudes=[], exclusions=[], tracked_rates=[], refusal=ValueError()
    )
    left = [one.title for one in statement.sections(without)]
    gone = {"Error terms", "By magnitude limit", "Exclusion angles", "In tracking mode"}
    assert [one for one in titles if one not in gone] == left
    reasons = "\n".join(datasheet_report.left_out(without))
    for words in ("Exclusion angles", "Tracking mode", "Magnitude limits"):
        assert words in reasons
    assert "Thermo-elastic" not in reasons
    assert datasheet_report.left_out(whole) == []


def test_the_term_section_has_a_row_for_each_term_and_the_sum(
    sheet: MeasuredFrames, whole: Statement
) -> None:
    section = section_of(whole, "Error terms")
    names = ["bias", "thermal", "field", "pixel", "temporal", "total"]
    assert len(section.rows) == 6
    for name, row in zip(names, section.rows, strict=True):
        assert row[1:3] == statement.sizes(whole.terms["across"], name)
        assert row[3:5] == statement.sizes(whole.terms["about"], name)
        assert len(row) == len(section.headers)
    text = " ".join(section.texts)
    totals = len(sheet.rows("total"))
    assert f"mean square of {totals} frames" in text
    assert f"{SIZE.fields} fields, {sheet.designer.units} units, 2 thermal states" in text
    # Seeds of the chip alone make units differ.
    assert ("factor of" in text) == (sheet.designer.units > 1)
    assert section.texts[-1].startswith("Mean error about the camera's axes")


def test_without_thermal_states_their_row_says_so() -> None:
    made = made_sheet(overrides={"camera.detector.prnu": "0"})
    section = section_of(stated(made), "Error terms")
    assert section.rows[1][1:5] == ["not in the scene", "-", "not in the scene", "-"]
    assert len(section.rows) == 6
    assert any("section thermal" in one for one in datasheet_report.left_out(stated(made)))


def test_shares_claims_and_times_are_those_of_the_counts(whole: Statement) -> None:
    counts = whole.counts
    assert counts.frames == 4 * 16
    section = section_of(whole, "Right, refused and false attitudes")
    text = " ".join(section.texts)
    for kind in ("right", "refused", "false"):
        share = 100 * getattr(counts, kind) / counts.frames
        assert f"{kind} {share:.4g} (" in text
    # 41 times from 9.94 to 29.94 ms in equal steps: 19.94 and 28.94
    assert "median 19.9 ms, 95 % within 28.9 ms (41 frames" in text
    assert "Sky coverage" in text
    assert [row[0] for row in section.rows] == ["95 %", "99 %", "99.7 %"]
    for row, level in zip(section.rows, (0.95, 0.99, 0.997), strict=True):
        shown = counts.share("right").low >= level
        assert row[1] == ("yes" if shown else "no")
        assert int(row[2]) == counts.frames
        assert int(row[3]) == counts.frames - counts.right
        assert int(row[4]) == math.ceil(math.log(0.05) / math.log(level))
        assert (row[5] == "-") == shown
    perfect = whole._replace(claims=performance.claims(Counts(5000, 5000, 0, 0)))
    rows = section_of(perfect, "Right, refused and false attitudes").rows
    assert all(row[1] == "yes" and row[5] == "-" for row in rows)


def test_what_dominates_and_what_is_left_are_in_percent(whole: Statement) -> None:
    section = section_of(whole, "What dominates, and what would lower it")
    for text, (name, table) in zip(section.texts, whole.terms.items(), strict=False):
        share = 100 * table.squares[table.dominant].value / table.squares["total"].value
        assert text.startswith(name.capitalize())
        assert f": {share:.0f} % of the variance" in text
    for row, one in zip(section.rows, whole.causes, strict=True):
        assert row[0] == one["cause"]
        assert numbers_of(row[1])[0] == pytest.approx(100 * one["across"].value, rel=5e-3)
        assert numbers_of(row[2])[2] == pytest.approx(100 * one["about"].high, rel=5e-3)


def test_tables_by_rate_acceleration_and_limit_print_their_rows(whole: Statement) -> None:
    for title, rows, key, before in (
        ("By rate", whole.rates, "rate_deg_s", 2),
        ("By rate about the boresight", whole.boresight_rates, "rate_deg_s", 2),
        ("By acceleration", whole.accelerations, "acceleration_deg_s2", 1),
        ("By magnitude limit", whole.magnitudes, "limit_mag", 1),
    ):
        section = section_of(whole, title)
        assert len(section.rows) == len(rows) > 1
        for printed, row in zip(section.rows, rows, strict=True):
            assert len(printed) == len(section.headers)
            assert numbers_of(printed[0])[0] == pytest.approx(row[key], rel=1e-5)
            found = [float(one) for one in printed[before : before + 4]]
            names = ("nea_across", "rms_across", "nea_about", "rms_about")
            assert found == pytest.approx([row[name] for name in names], rel=5e-3)
            share = 100 * row["counts"].right / row["counts"].frames
            assert numbers_of(printed[-3])[0] == pytest.approx(share, rel=1e-3)
            assert printed[-2:] == [str(row["counts"].refused), str(row["counts"].false)]
    own = [row for row in section_of(whole, "By magnitude limit").rows if "scene" in row[0]]
    assert len(own) == 1
    # 1 / sqrt(2 F) and 1 / sqrt(F) of 16 fields
    assert "about 18 % across and 25 % about" in " ".join(section_of(whole, "By rate").texts)


def test_tables_of_outcomes_print_shares_and_the_errors_of_the_right(
    whole: Statement,
) -> None:
    for title, rows, names in (
        ("Under disturbances", whole.disturbances, ["disturbance"]),
        ("Exclusion angles", whole.exclusions, ["body", "off_deg"]),
    ):
        section = section_of(whole, title)
        for printed, row in zip(section.rows, rows, strict=True):
            assert len(printed) == len(section.headers)
            assert printed[0].lower() == str(row[names[0]]).lower()
            errors = [float(one) for one in printed[-2:]]
            assert errors == pytest.approx([row["rms_across"], row["rms_about"]], rel=5e-3)
            assert printed[-4:-2] == [str(row["counts"].refused), str(row["counts"].false)]
    tracked = section_of(whole, "In tracking mode")
    expected = len(whole.tracked_rates) + len(whole.tracked_accelerations)
    assert len(tracked.rows) == expected
    assert [bool(row[0]) for row in tracked.rows].count(True) == len(whole.tracked_rates)
    assert all(bool(row[0]) != bool(row[1]) for row in tracked.rows)


def test_times_are_printed_in_milliseconds(whole: Statement) -> None:
    section = section_of(whole, "Update rate and latency")
    found = dict(section.rows)
    timing = whole.timing
    assert float(found["half of the exposure, ms"]) == pytest.approx(
        1000 * timing["half_exposure_s"], rel=5e-3
    )
    assert float(found["latency, ms"]) == pytest.approx(1000 * timing["latency_s"], rel=5e-3)
    late = "Not every frame can be solved before the next one"
    for rate_hz, said in ((1e9, True), (1e-9, False)):
        changed = whole._replace(timing=timing | {"rate_hz": rate_hz})
        texts = section_of(changed, "Update rate and latency").texts
        assert any(late in text for text in texts) == said


def test_a_limit_says_where_it_is_or_how_many_attitudes_it_needs() -> None:
    """Of 200 frames 95 % is shown by 199 and refuted by 150; 20 frames show nothing, and 90 % would need 29."""
    rows = [
        {"rate_deg_s": rate, "counts": Counts(200, right, 200 - right, 0)}
        for rate, right in ((0.0, 200), (1.0, 199), (2.0, 190), (3.0, 150))
    ]
    text = performance.bracket_text("acquisition", rows, "rate_deg_s")
    assert "95 % of right attitudes are shown up to 1 °/s;" in text
    assert "fewer than 95 % are shown from 3 °/s on." in text
    best = performance.bracket_text("acquisition", rows[:2], "rate_deg_s")
    assert best.endswith("fewer than 95 % are shown at none tested.")
    worst = performance.bracket_text("acquisition", rows[3:], "rate_deg_s")
    assert "are shown at no level tested;" in worst
    few = [{"rate_deg_s": 1.0, "counts": Counts(20, 20, 0, 0)}]
    said = performance.bracket_text("acquisition", few, "rate_deg_s")
    assert said == "Limit of acquisition: not established: 20 attitudes, 29 needed."
    off = [{"off_deg": 90.0, "counts": Counts(200, 200, 0, 0)}]
    assert "down to 90 °;" in performance.bracket_text("the angle", off, "off_deg")


def test_the_numbers_for_json_are_those_of_the_statement(whole: Statement) -> None:
    found = datasheet_report.numbers(whole)
    assert found["fields"] == found["fields_solved"] == 16
    assert found["rate_deg_s"] == 0.0
    assert found["frames"] == whole.sheet.columns["trial"].size
    assert found["states_c"] == [20.0, 23.0]
    assert found["counts"]["shares"]["right"]["value"] == pytest.approx(
        whole.counts.right / whole.counts.frames
    )
    assert found["terms"]["about"]["squares"]["field"]["value"] == (
        whole.terms["about"].squares["field"].value
    )
    limits = found["limits"]
    assert set(limits) == {"acquisition", "tracking", "about the boresight"}
    assert set(limits["acquisition"]) == {"rate_deg_s", "acceleration_deg_s2"}
    assert set(limits["about the boresight"]) == {"rate_deg_s"}
    assert limits["acquisition"]["rate_deg_s"]["fields"] == 16
    without = whole._replace(tracked_rates=[], tracked_accelerations=[])
    assert "tracking" not in datasheet_report.limits(without)


def test_a_negative_term_and_a_contradicted_sum_are_failures(whole: Statement) -> None:
    table = whole.terms["across"]
    negative = table._replace(signs=table.signs | {"field": -1}, ratio=Bounded(1.0, 0.9, 1.1))
    unlike = table._replace(signs={}, ratio=Bounded(2.0, 1.5, 2.5))
    for tables, words in (
        ({"across": negative}, "is negative"),
        ({"across": unlike}, "add up"),
    ):
        failed = datasheet_report.failed_checks(whole._replace(terms=tables))
        assert len(failed) == 1
        assert words in failed[0]
    fine = table._replace(signs={"field": 1, "pixel": 0}, ratio=Bounded(1.0, 0.9, 1.1))
    assert datasheet_report.failed_checks(whole._replace(terms={"across": fine})) == []


def test_the_verdict_is_bad_with_a_false_attitude(whole: Statement) -> None:
    for false, kind in ((0, "good"), (1, "bad")):
        counts = Counts(100, 99 - false, 1, false)
        verdict = datasheet_report.verdict(whole._replace(counts=counts))
        assert verdict.tone == kind
        assert f"{false} of 100 a false one; error of one axis at rest" in verdict.text
    bare = datasheet_report.verdict(whole._replace(terms={}))
    assert bare.text.endswith("a false one.")


def test_the_command_repeats_scene_options_and_fields(sheet: MeasuredFrames) -> None:
    changed = sheet._replace(overrides={"seed": "7", "camera.f_number": "2"})
    assert datasheet_report.command(changed, ["--quick"]) == (
        "skysim datasheet shefex2 --quick --seed 7 --set camera.f_number=2 --fields 16"
    )


@pytest.mark.slow
def test_only_the_first_three_sections_are_printed_on_a_terminal(
    whole: Statement, tmp_path: Path
) -> None:
    report = datasheet_report.datasheet_report(whole, ["--quick"])
    sections = [
        one for one in report.blocks if hasattr(one, "on_terminal") and hasattr(one, "title")
    ]
    shown = [one.title for one in sections if one.on_terminal]
    assert [one.title for one in sections][:3] == shown[:3]
    assert len(shown) == 3
    paths = datasheet_report.write_all(tmp_path, whole, report)
    assert paths["json"].is_file()
    assert len(list(tmp_path.glob("*.png"))) == len(datasheet_report.FIGURES)
    standard = sections[-1].blocks[0]
    places = {row[1] for row in standard.rows}
    titles = {one.title for one in statement.sections(whole)}
    assert places <= titles | {"not on this sheet", "not here"}
    assert len(standard.rows) > 10


# Figures, by what is drawn.


def drawn(draw: Any, whole: Statement) -> Any:
    fig = Figure()
    draw(whole, fig)
    return fig.axes


def test_the_terms_are_bars_of_their_roots(whole: Statement) -> None:
    for axes, table in zip(
        drawn(datasheet_report.draw_terms, whole), whole.terms.values(), strict=True
    ):
        roots = [
            math.sqrt(max(table.squares[name].value, 0.0))
            for name in variance_components.TERMS
        ]
        assert [bar.get_width() for bar in axes.patches] == pytest.approx(roots)
        for line, name in zip(axes.lines, variance_components.TERMS, strict=True):
            ends = [math.sqrt(max(end, 0.0)) for end in table.squares[name][1:]]
            assert list(line.get_xdata()) == pytest.approx(ends)
        assert [bar.get_y() + bar.get_height() / 2 for bar in axes.patches] == pytest.approx(
            range(5)
        )
        assert axes.yaxis_inverted()
    alone = stated(made_sheet(overrides={}))
    assert [len(axes.patches) for axes in drawn(datasheet_report.draw_terms, alone)] == [4, 4]


def bars_of(container: Any) -> tuple[Floats, Floats, list[Any]]:
    """x and y of an errorbar's points, and the ends of its bars."""
    line, _, bars = container
    return line.get_xdata(), line.get_ydata(), bars[0].get_segments()


def test_what_is_left_is_drawn_in_percent_with_its_ends(whole: Statement) -> None:
    (axes,) = drawn(datasheet_report.draw_causes, whole)
    for n, name in enumerate(("across", "about")):
        x, y, bars = bars_of(axes.containers[n])
        assert list(x) == pytest.approx([100 * one[name].value for one in whole.causes])
        assert list(y) == pytest.approx([k + 0.2 * n for k in range(len(whole.causes))])
        ends = [[100 * one[name].low, 100 * one[name].high] for one in whole.causes]
        assert np.array(bars)[:, :, 0] == pytest.approx(np.array(ends))
    assert axes.lines[-1].get_xdata()[0] == 100 or any(
        list(line.get_xdata()) == [100, 100] for line in axes.lines
    )


def test_every_frame_of_the_sky_is_a_point_of_its_outcome(
    sheet: MeasuredFrames, whole: Statement
) -> None:
    """East is to the left: the longitude is minus the right ascension, -180 to 180 degrees; false ones are large."""
    (axes,) = drawn(datasheet_report.draw_sky, whole)
    rows = sheet.rows("sky")
    kinds = {line.get_label(): line for line in axes.lines}
    counts = whole.counts
    for name in ("right", "refused", "false"):
        size = getattr(counts, name)
        assert size > 0
        assert len(kinds[name].get_xdata()) == size
        assert kinds[name].get_markersize() == (2 if name == "right" else 5)
    drawn_x = np.concatenate([line.get_xdata() for line in axes.lines])
    drawn_y = np.concatenate([line.get_ydata() for line in axes.lines])
    assert np.abs(drawn_x).max() <= math.pi
    ra = np.radians(sheet.columns["boresight_ra_deg"][rows].ravel())
    dec = np.radians(sheet.columns["boresight_dec_deg"][rows].ravel())
    wanted = np.sort_complex(np.cos(dec) * np.exp(-1j * ra))
    found = np.sort_complex(np.cos(drawn_y) * np.exp(1j * drawn_x))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)


def test_a_figure_by_a_quantity_has_noise_errors_and_shares(whole: Statement) -> None:
    for name, rows, key in (
        ("rates", whole.rates, "rate_deg_s"),
        ("magnitudes", whole.magnitudes, "limit_mag"),
    ):
        draw = datasheet_report.FIGURES[name][0]
        errors, share = drawn(draw, whole)
        found = {one.get_label(): bars_of(one) for one in errors.containers}
        assert set(found) == {"NEA across", "rms across", "NEA about", "rms about"}
        for label, (x, y, _) in found.items():
            kind, group = label.lower().split()
            assert list(x) == [row[key] for row in rows]
            assert list(y) == pytest.approx([row[f"{kind}_{group}"] for row in rows])
        assert errors.get_yscale() == "log"
        known = [row[what] for row in rows for what in row["intervals"]]
        assert errors.get_ylim() == pytest.approx((min(known) / 3, max(known) * 3))
        x, y, bars = bars_of(share.containers[0])
        shares = [row["counts"].share("right") for row in rows]
        assert list(y) == pytest.approx([100 * one.value for one in shares])
        ends = np.array([[100 * one.low, 100 * one.high] for one in shares])
        # Bars are as long as the distance to the end, to both sides.
        found_ends = np.array(bars)[:, :, 1]
        assert found_ends == pytest.approx(ends)


def test_exclusion_angles_are_drawn_by_body(whole: Statement) -> None:
    (axes,) = drawn(datasheet_report.draw_exclusions, whole)
    assert [one.get_label() for one in axes.containers] == ["Sun", "Moon"]
    for one, body in zip(axes.containers, ("sun", "moon"), strict=True):
        x, y, _ = bars_of(one)
        rows = [row for row in whole.exclusions if row["body"] == body]
        assert list(x) == [row["off_deg"] for row in rows]
        shares = [row["counts"].right / row["counts"].frames for row in rows]
        assert list(y) == pytest.approx([100 * share for share in shares])


def test_a_dome_s_tilts_are_drawn_about_the_vertical() -> None:
    made = made_sheet("afit_simsat", {})
    whole = stated(made)
    (axes,) = drawn(datasheet_report.draw_sky, whole)
    assert axes.name == "polar"
    rows = made.rows("sky")
    tilts = np.concatenate([line.get_ydata() for line in axes.lines])
    assert np.sort(tilts) == pytest.approx(
        np.sort(made.columns["body_tilt_deg"][rows].ravel())
    )
    assert not whole.magnitudes
    assert "Sky coverage" not in " ".join(
        section_of(whole, "Right, refused and false attitudes").texts
    )
    assert "the tilts of the vehicle" in " ".join(
        section_of(whole, "Right, refused and false attitudes").texts
    )


# The constants of the error model.


def variance(values: Floats) -> float:
    """Unbiased, by its definition."""
    return float(np.sum((values - np.mean(values)) ** 2) / (len(values) - 1))


def test_products_of_a_sequence_are_means_over_fields_and_both_axes(
    sheet: MeasuredFrames,
) -> None:
    mean = np.array([0.5, -0.25, 9.0])
    angles, products, squares = model_fit.lagged(sheet, mean)
    expected = []
    for rate in sheet.levels("sequence", "rate_deg_s"):
        errors = chosen(sheet, "sequence", rate_deg_s=rate)[:2] - mean[:2, None, None]
        steps = [0, 1, 2, 4, 8, 16]
        for first, second in itertools.combinations(range(6), 2):
            expected.append(
                (
                    rate * (steps[second] - steps[first]) / sheet.scene.exposure.rate_hz,
                    np.nanmean(errors[:, first] * errors[:, second]),
                    np.nanmean(errors**2),
                )
            )
    np.testing.assert_allclose(np.transpose([angles, products, squares]), expected, rtol=1e-9)


def test_the_noise_of_a_field_is_estimated_from_its_terms_and_its_sequence_at_rest(
    sheet: MeasuredFrames,
) -> None:
    """The variance from frame to frame, mean over axes and all else; fields without one frame at rest are left out."""
    axes = slice(0, 2)
    terms = chosen(sheet, "terms").reshape(3, -1, 2, SIZE.fields)[axes]
    rest = chosen(sheet, "sequence", rate_deg_s=0.0)[axes]
    known = np.flatnonzero(np.isfinite(rest).all(axis=(0, 1)))
    assert 3 < len(known) < SIZE.fields
    first, second = model_fit.field_variances(sheet, axes)
    for n, field in enumerate(known):
        of_pairs = [variance(pair) for pair in terms[..., field].reshape(-1, 2)]
        assert first[n] == pytest.approx(np.mean(of_pairs))
        assert second[n] == pytest.approx(
            np.mean([variance(one) for one in rest[..., field]])
        )
    assert len(first) == len(second) == len(known)


def test_rates_are_those_of_the_sequences_and_of_faster_pairs(sheet: MeasuredFrames) -> None:
    """Up to the first rate at which fewer than ten fields are right."""
    found = model_fit.errors_by_rate(sheet)
    sequenced = sheet.levels("sequence", "rate_deg_s")
    faster = [rate for rate in sheet.levels("rate", "rate_deg_s") if rate > sequenced[-1]]
    assert list(found) == [*sequenced, *faster]
    for rate, errors in found.items():
        kind = "sequence" if rate in sequenced else "rate"
        np.testing.assert_array_equal(errors, chosen(sheet, kind, rate_deg_s=rate))
    for right, last in ((10, None), (9, 1)):
        solved = sheet.columns["solved"].copy()
        solved[sheet.rows("rate", rate_deg_s=faster[1])] = 0
        solved[sheet.rows("rate", rate_deg_s=faster[1])[0], :right] = 1
        columns = sheet.columns | {"solved": solved, "wrong": 0 * solved}
        rates = list(model_fit.errors_by_rate(sheet._replace(columns=columns)))
        assert rates == [*sequenced, *faster[:last]]


def test_the_streak_s_noise_is_what_is_about_the_rate_s_axis_beyond_the_other(
    sheet: MeasuredFrames, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of 5 about an axis at 0.4 rad and 3 about the other: a mean square of 16 more; never below 0."""
    rng = np.random.default_rng(3)
    about, other = np.array([[5.0], [3.0]]) * np.sign(rng.standard_normal((2, 400)))
    angle = np.full(400, 0.4)
    x = 1.0 + about * np.cos(angle) - other * np.sin(angle)
    y = -2.0 + about * np.sin(angle) + other * np.cos(angle)
    errors = np.stack([x, y, 0 * x])[:, None]
    mean = np.array([1.0, -2.0, 0.0])
    monkeypatch.setattr(model_fit, "axes_rad", lambda sheet, rate: angle)
    assert model_fit.along_square(sheet, 1.0, mean, errors) == pytest.approx(16)
    assert model_fit.along_square(sheet, 0.0, mean, errors) == 0
    turned = np.stack([y + 3.0, -(x - 1.0), 0 * x])[:, None]
    assert model_fit.along_square(sheet, 1.0, mean, turned) == 0


def test_the_correlation_angle_is_that_of_exact_products(
    sheet: MeasuredFrames, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Products of field and pixel terms in their ratio at rest, times any factor: one of 60 angles fits exactly."""
    pixel_deg = sheet.designer.pixel_deg
    half_deg = scene_changes.half_field_deg(sheet.scene)
    field = np.array([2.0, 1.0, 50.0])
    pixel = np.array([1.0, 1.5, 70.0])
    tried = pixel_deg * (8 * half_deg / pixel_deg) ** (np.arange(60) / 59)
    angles = np.geomspace(pixel_deg / 3, 10 * half_deg, 40)
    squares = np.random.default_rng(4).uniform(1, 3, 40)
    for n in (1, 20, 41, 58):
        by_field = 5.0 * np.exp(-angles / tried[n])
        products = 0.37 * (by_field + 3.25 * np.exp(-angles / pixel_deg))
        monkeypatch.setattr(model_fit, "lagged", lambda *_, p=products: (angles, p, squares))
        found = model_fit.field_angle_deg(sheet, field, pixel, np.zeros(3))
        assert found == pytest.approx(tried[n], rel=1e-9)
    none = model_fit.field_angle_deg(sheet, 0 * field, 0 * pixel, np.zeros(3))
    assert none == pytest.approx(tried[-1])


def test_the_constants_of_a_model_are_the_terms_of_its_sheet(
    sheet: MeasuredFrames, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise at a rate: what the first unit's mean, field, pixel and half of the streak's share leave of the square.

    Not below a twentieth of it; at rest the temporal term.
    """
    monkeypatch.setattr(model_fit, "axes_rad", lambda sheet, rate: np.full(SIZE.fields, 0.3))
    found = model_fit.constants(sheet)
    errors, _ = variance_components.term_errors(sheet)
    units = sheet.designer.units
    assert found["mean"] == pytest.approx([one.mean() for one in errors])
    by_field = errors[:, :, 0, 0].reshape(3, -1)
    first_mean = by_field.mean(axis=1)
    assert model_fit.unit_mean(sheet) == pytest.approx(first_mean)
    shares = variance_components.contributions(errors)
    field, pixel, temporal = (
        np.sqrt(np.maximum(one.mean(axis=-1), 0))
        for one in (shares.field, shares.pixel, shares.temporal)
    )
    assert found["field"] == pytest.approx(field)
    assert found["pixel"] == pytest.approx(pixel)
    assert found["noise"][0] == pytest.approx(temporal)
    assert found["scale_deg"] == scene_changes.half_field_deg(sheet.scene)
    assert found["pixel_deg"] == sheet.designer.pixel_deg
    assert found["along"][0] == 0
    assert units > 1
    for n, (rate, one) in enumerate(model_fit.errors_by_rate(sheet).items()):
        square = np.array([np.nanmean(axis**2) for axis in one])
        slow = first_mean**2 + field**2 + pixel**2
        slow[:2] += found["along"][n] ** 2 / 2
        left = np.maximum(square - slow, 0.05 * square)
        if rate:
            assert found["noise"][n] == pytest.approx(np.sqrt(left))
    assert found["scale"][0] == found["scale"][1]


def test_a_model_s_correlation_is_compared_over_all_pairs_of_a_sequence(
    sheet: MeasuredFrames, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mean over pairs and axes of products over the mean squares, after the model's mean is subtracted."""
    monkeypatch.setattr(model_fit, "axes_rad", lambda sheet, rate: np.full(SIZE.fields, 0.3))
    monkeypatch.setattr(model_fit, "DRAWN", 500)
    model = ErrorModel(model_fit.constants(sheet))
    rate = sheet.levels("sequence", "rate_deg_s")[2]
    found = model_fit.agreement(model, sheet, rate, "even")
    centered = chosen(sheet, "sequence", rate_deg_s=rate) - model.mean[:, None, None]
    measured = []
    expected = []
    steps = [0, 1, 2, 4, 8, 16]
    for one, two in itertools.combinations(range(6), 2):
        for axis in centered:
            measured.append(np.nanmean(axis[one] * axis[two]) / np.nanmean(axis**2))
        apart_deg = rate * (steps[two] - steps[one]) / sheet.scene.exposure.rate_hz
        expected.append(model.correlation(apart_deg, rate))
    assert found.correlation == pytest.approx(np.mean(measured))
    assert found.expected_correlation == pytest.approx(np.mean(expected))
    assert found.frames == np.isfinite(centered[0, 0]).sum()
    assert found.rate_deg_s == rate


def test_halves_of_the_solved_fields_test_each_other() -> None:
    """Every second of the fields with terms, then of the others."""
    made = made_sheet()
    made = made._replace(size=made.size._replace(fields=16))
    part = model_fit.some_fields(made, np.array([3, 0, 8]))
    assert part.size.fields == 3
    for name, values in part.columns.items():
        np.testing.assert_array_equal(values, made.columns[name][:, [3, 0, 8]])
    none = model_fit.rms_of_term(np.array([[4.0, 4.0], [-1.0, -3.0], [1.0, 17.0]]))
    assert none == pytest.approx([2.0, 0.0, 3.0])


def test_the_scatter_of_two_units_is_their_unbiased_variance() -> None:
    """Units 1 and 3, the same in all fields, states and attitudes: a variance of 2; one unit has none."""
    errors = np.broadcast_to(np.array([1.0, 3.0])[:, None, None, None], (3, 12, 2, 2, 2, 2))
    assert model_fit.unit_scatter(errors) == pytest.approx(np.sqrt([2.0] * 3))
    assert model_fit.unit_scatter(errors[:, :, :1]) == pytest.approx([0.0] * 3)
    # Only what changes from field to field has no part in it.
    rng = np.random.default_rng(5)
    more = errors + 0.01 * rng.standard_normal((3, 12, 1, 2, 2, 2))
    assert model_fit.unit_scatter(more) == pytest.approx(np.sqrt([2.0] * 3))
