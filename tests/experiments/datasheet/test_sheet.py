"""A whole datasheet from rendered frames: it resumes after a stop and recovers injected errors."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from skysim.core.errors import InputError
from skysim.experiments.datasheet import (
    cells,
    datasheet_report,
    model_fit,
    performance,
    statement,
)
from skysim.experiments.datasheet.cells import Designer, Size
from skysim.experiments.datasheet.datasheet_report import numbers
from skysim.experiments.datasheet.statement import Statement, sections, state
from skysim.experiments.datasheet.variance_components import contributions
from skysim.experiments.study.execution import trials
from skysim.experiments.study.plan import TrialSpec
from skysim.scene.loader import load

SMALL = Size(fields=12, units=1, states=2, attitudes=2, frames=2, draws=2, sky=2, pairs=1)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def small() -> Iterator[None]:
    """Few levels of every experiment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cells, "QUICK", SMALL)
        patch.setattr(cells, "STREAKS_PX", (1.0,))
        patch.setattr(cells, "BORESIGHT_PX", (2.0,))
        patch.setattr(cells, "MOST_FAIL", 2.0)
        patch.setattr(cells, "SEQUENCE", (0, 1))
        patch.setattr(cells, "BENDS_PX", (4.0,))
        patch.setattr(cells, "FAINTER", (-1.0,))
        patch.setattr(cells, "TRACKED_STREAKS_PX", (1.0,))
        patch.setattr(cells, "MISSED_PX", (3.0, 24.0))
        patch.setattr(performance, "TIMED", 3)
        yield


@pytest.fixture(scope="module")
def sheet(small: None, tmp_path_factory: pytest.TempPathFactory) -> cells.MeasuredFrames:
    """A datasheet of all experiments, measured in one go; it takes half a minute."""
    return measured(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def rates_only(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all experiments only those at rates, for what is asked of these alone."""
    monkeypatch.setattr(Designer, "cells", Designer.rates)


def measured(
    folder: Path, watch: Callable[[int], Any] | None = None, fields: int | None = None
) -> cells.MeasuredFrames:
    scene = load("shefex2", {})
    return cells.measure(
        "shefex2", scene, {}, folder, quick=True, fields=fields, workers=1, watch=watch
    )


def stop_after(batches: int) -> Callable[[int], Any]:
    """A watch that stops the run as Ctrl-C does."""
    seen: list[int] = []

    def watch(progress: object) -> None:
        seen.append(1)
        if len(seen) == batches:
            raise KeyboardInterrupt

    return lambda trials: watch


def untimed(statement: Statement) -> str:
    """All numbers except the times of this machine."""
    return json.dumps(numbers(statement._replace(times_s=[], timing={})))


def test_a_stopped_datasheet_resumes_with_the_same_result(
    sheet: cells.MeasuredFrames, tmp_path: Path
) -> None:
    whole = state(sheet)
    assert len(whole.times_s) == 3
    assert min(whole.times_s) > 0
    # The prediction follows an acceleration that moves stars by three windows.
    assert numbers(whole)["limits"]["tracking"]["acceleration_deg_s2"]["below"] == np.inf
    with pytest.raises(KeyboardInterrupt):
        measured(tmp_path, stop_after(4))
    again = state(measured(tmp_path))
    assert untimed(again) == untimed(whole)
    report = datasheet_report.datasheet_report(whole, ["--quick"])
    paths = datasheet_report.write_all(tmp_path, whole, report)
    assert json.loads(paths["json"].read_text())["fields"] == 12
    text = paths["report"].read_text(encoding="utf-8")
    assert all(section.title in text for section in sections(whole))
    assert text.count("<img") == 6
    # And what is left out, and the second page.
    assert report.markdown().count("\n## ") == len(sections(whole)) + 2
    assert len(list(tmp_path.glob("*.png"))) == 6
    with pytest.raises(InputError, match="contains another study"):
        cells.measure(
            "shefex2",
            load("shefex2", {}),
            {"camera.f_number": "2"},
            tmp_path,
            quick=True,
            workers=1,
        )


def test_rates_double_until_most_fields_fail_and_are_kept(
    rates_only: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To streaks of 4 px, the side of a field of that size; a second call finds the rates that the first one added.

    Nothing is drawn again: the same rows as before.
    """
    monkeypatch.setattr(cells, "MOST_FAIL", 0.5)
    monkeypatch.setattr(cells.scene_changes, "side_px", lambda scene: 4)
    first = measured(tmp_path)
    rates = first.levels("rate", "rate_deg_s")
    assert [rate / rates[0] for rate in rates] == [1, 2, 4]
    again = measured(tmp_path)
    assert again.levels("rate", "rate_deg_s") == rates
    assert again.columns["x_arcsec"].tobytes() == first.columns["x_arcsec"].tobytes()
    more = measured(tmp_path, fields=13)
    assert more.levels("rate", "rate_deg_s")[:3] == rates
    assert more.columns["x_arcsec"][:, :12].tobytes() == first.columns["x_arcsec"].tobytes()
    # Fewer than half of them right at the last rate: no faster one.
    last = first.rows("rate", rate_deg_s=rates[-1])
    monkeypatch.setattr(cells.scene_changes, "side_px", lambda scene: 1000)
    assert "rate" in first.solved_at_all_rates()
    first.columns["solved"][last[0], :7] = 0
    assert "rate" not in first.solved_at_all_rates()


def test_chosen_rates_are_measured(rates_only: None, tmp_path: Path) -> None:
    rates_deg_s = [0.5, 0, 0.2]
    chosen = cells.measure(
        "shefex2",
        load("shefex2", {}),
        {},
        tmp_path,
        quick=True,
        rates_deg_s=rates_deg_s,
        workers=1,
    )
    assert chosen.levels("rate", "rate_deg_s") == [0.2, 0.5]
    assert chosen.levels("boresight", "rate_deg_s") == [0.2, 0.5]


@pytest.mark.parametrize("solved", [0, pytest.param(6, marks=pytest.mark.long)])
def test_what_was_measured_is_written_without_the_terms(
    sheet: cells.MeasuredFrames, tmp_path: Path, solved: int
) -> None:
    """With too few solved fields for the terms the page has all else, and says first what is missing."""
    few = sheet.columns["solved"].copy()
    few[:, solved:] = 0
    sheet = sheet._replace(columns=sheet.columns | {"solved": few})
    statement = state(sheet)
    assert statement.refusal
    report = datasheet_report.datasheet_report(statement, ["--quick"])
    text = report.markdown()
    missing = f"The error terms are not stated. Fields 12: {solved} of them are solved in all"
    assert text.index(missing) < text.index("of frames lost in space have a right attitude")
    assert "## By rate" in text
    assert "## Error terms" not in text
    paths = datasheet_report.write_all(tmp_path, statement, report)
    written = json.loads(paths["json"].read_text())
    assert missing in written["failed_checks"][0]
    assert written["counts"]["right"] == 2 * solved
    with pytest.raises(InputError, match=r"datasheet\.fields: 12: .* 20 needed"):
        model_fit.agreements(sheet)


def test_an_injected_bias_and_thermal_drift_are_recovered() -> None:
    """The mount turns by 10" per kelvin about x and 4" about roll: at 20, 22 and 27 C with the reference at 20.

    The states' effects are 0, 20 and 70" about x; about y there is nothing but what the tracker has.
    """
    per_k = np.array([10.0, 0.0, 40.0])
    temperatures_c = np.array([20.0, 22.0, 27.0])
    thermal = {
        "thermal.temperature": "{kind: table, hours: [0, 1, 2], temperature_c: [20, 22, 27]}",
        "thermal.mount_arcsec_k": f"{per_k.tolist()}",
    }
    designer = Designer(load("shefex2", thermal), Size(12, 1, 3, 2, 2, 1, 1, 1))
    assert designer.temperatures_c == temperatures_c.tolist()
    base = {"thermal.mount_arcsec_k": per_k.tolist()}
    spec = TrialSpec("shefex2", ".", 3, base, {"kind": "frames"}, True)
    errors = []
    for cell in designer.terms():
        rows = trials.TrialJob(spec).run((trials.Segment(0, cell.settings, 0, range(12)),))
        assert all(row.outcome.solved and not row.error for row in rows)
        errors.append(
            [
                [row.outcome.x_arcsec, row.outcome.y_arcsec, row.outcome.roll_arcsec]
                for row in rows
            ]
        )
    shape = (1, designer.states, 2, 2, 12, 3)
    by_axis = np.moveaxis(np.array(errors).reshape(shape), (4, 5), (1, 0))
    for axis, slope in enumerate(per_k):
        effects = slope * (temperatures_c - 20)
        found = contributions(by_axis[axis])
        expected = np.var(effects)
        assert found.thermal.mean() == pytest.approx(
            expected, rel=0.05, abs=1.0 if axis < 2 else 20.0
        )
        assert found.bias.mean() == pytest.approx(
            np.mean(effects) ** 2, rel=0.05, abs=2.0 if axis < 2 else 20.0
        )


def test_the_text_on_accelerations_states_the_lag_of_the_mean(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From rest at mid-exposure the mean of a t^2 / 2 over the exposure, by quadrature, is that stated."""
    monkeypatch.setattr(statement, "bracket_text", lambda *_: "")
    texts = statement.acceleration_section(SimpleNamespace(accelerations=[])).texts
    stated = re.findall(r"a T² / (\d+)", " ".join(texts))
    mean, _ = quad(lambda t: t**2 / 2, -0.5, 0.5)
    assert [float(one) for one in stated] == pytest.approx([1 / mean])
