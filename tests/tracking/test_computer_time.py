"""The tracker's times on another computer: measured seconds x our clock / its clock x a factor."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from skysim.core.errors import InputError
from skysim.experiments.study.execution import store, trials
from skysim.experiments.study.plan import TrialSpec
from skysim.scene.sections.tracker import ComputerConfig
from skysim.tracking import computer_time

MEASURED_MS = {"render": 50.0, "detect": 2.0, "centroid": 0.5, "identify": 1.0, "solve": 0.25}


def test_times_grow_with_our_clock_over_its_clock_and_with_the_factor() -> None:
    """At 2.6 GHz 2 ms are 5.2 million cycles: 8 ms at 650 MHz, 24 ms if it needs three cycles for one of ours."""
    same = ComputerConfig(clock_mhz=650, host_clock_mhz=2600)
    assert computer_time.on_computer(same, MEASURED_MS) == pytest.approx(
        {"detect": 8.0, "centroid": 2.0, "identify": 4.0, "solve": 1.0}
    )
    slower = ComputerConfig(clock_mhz=650, host_clock_mhz=2600, cycles_factor=3)
    assert computer_time.total(slower, MEASURED_MS) == pytest.approx(45.0)
    assert math.isnan(computer_time.total(None, MEASURED_MS))


def test_the_report_says_both_clocks_and_whence_ours_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("model name\t: X\ncpu MHz\t\t: 1300.000\ncpu MHz\t\t: 2600.000\n")
    monkeypatch.setattr(computer_time, "CPUINFO", cpuinfo)
    monkeypatch.setattr(computer_time, "fastest_mhz", computer_time.fastest_mhz.__wrapped__)
    told = computer_time.computer_text(ComputerConfig(clock_mhz=650), MEASURED_MS)
    assert "650 MHz: detect 8.00, centroid 2.00, identify 4.00, solve 1.00; 15.00 ms" in told
    assert f"measured at 2600 MHz by {cpuinfo}, cycles x 1" in told
    own = ComputerConfig(clock_mhz=650, host_clock_mhz=1300)
    assert "measured at 1300 MHz by host_clock_mhz" in computer_time.computer_text(
        own, MEASURED_MS
    )


def test_a_machine_that_does_not_tell_its_clock_asks_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(computer_time, "CPUINFO", tmp_path / "none")
    with pytest.raises(InputError, match=r"tracker\.computer\.host_clock_mhz: no clock"):
        computer_time.fastest_mhz.__wrapped__()


@pytest.mark.slow
def test_a_study_has_the_tracker_s_time_on_that_computer_beside_the_trial_and_does_not_compare_it(
    tmp_path: Path,
) -> None:
    """Fifty times the cycles take fifty times the time, apart from the noise of measuring."""
    spec = TrialSpec("shefex2", ".", 1, {}, {"kind": "frames"}, True)
    outcomes = []
    for factor in 1, 50:
        computer = {"clock_mhz": 650, "host_clock_mhz": 2600, "cycles_factor": factor}
        segment = trials.Segment(0, {"tracker.computer": computer}, 0, range(6))
        rows = trials.TrialJob(spec).run((segment,))
        outcomes.append(sorted(row.outcome.computer_ms for row in rows)[2])
    assert 20 < outcomes[1] / outcomes[0] < 125
    assert min(row.outcome.computer_ms / row.outcome.detect_ms for row in rows) > 200
    assert rows[0].outcome == replace(rows[0].outcome, computer_ms=-1.0)
    with store.writing(tmp_path / "study.sqlite") as kept:
        kept.add(rows)
        assert kept.columns()["computer_ms"].tolist() == [
            row.outcome.computer_ms for row in rows
        ]
