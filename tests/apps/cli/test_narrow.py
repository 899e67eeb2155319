"""Tables in a narrow terminal: columns are left out and named, numbers are never cut."""

import re
from pathlib import Path

import numpy as np
import pytest

from skysim.apps.cli import terminal
from skysim.experiments.tracker_comparison import TrackerScore
from skysim.results import report as as_text
from skysim.results.metrics import Summary
from skysim.results.report import Report
from skysim.results.run_report import frame_table, motion_section, run_report
from skysim.results.scoring import FrameRow
from skysim.scene import loader
from skysim.simulation.checks import Check

TRIPLE = ("roll", "pitch", "yaw")


def row(frame: int) -> FrameRow:
    angles = (-123.4567, 45.6789, 179.9999)
    return FrameRow(
        frame=frame,
        t_s=12.5 * frame,
        rate_deg_s=4.2,
        status="solved",
        truth_deg=angles,
        estimate_deg=angles,
        cross_arcsec=1234.567,
        roll_arcsec=-2345.678,
        detected=20,
        matched=20,
        rms_px=0.1,
        time_ms=12.3,
        wrong=False,
    )


def score(name: str) -> TrackerScore:
    times = {"time_ms_median": 12.5, "time_ms_p95": 123.0, "nees": 3.14}
    errors = dict.fromkeys(
        [
            f"{angle}_arcsec_{what}"
            for angle in ("cross", "roll")
            for what in ("median", "worst")
        ],
        1234.5,
    )
    return TrackerScore(
        name, 400, Summary(0.951, 0.925, 0.97, 400), 3, 12, 0, **errors, **times, refusals={}
    )


@pytest.mark.parametrize("width", [80, 100, 240])
def test_a_scoreboard_fits_the_terminal_and_keeps_its_main_columns(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(as_text, "terminal_width", lambda: width)
    terminal.print_scores([score("own"), score("somebody_else")], Path("out/scoreboard"))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    kept = next(line for line in lines if line.startswith("tracker"))
    assert re.search(r"frames +right % .*wrong +refused +failed +cross ″ .*roll ″", kept)
    assert ("95 % ms" in kept) == (width == 240)
    assert not any("…" in line for line in lines)


def report(motion: dict[str, float]) -> Report:
    picture = np.zeros((4, 4, 3), np.uint8)
    stages = dict.fromkeys(
        ["render", "detector", "detect", "centroid", "identify", "solve"], 12.34
    )
    return run_report(
        loader.load("afit_simsat"),
        Check([], []),
        "skysim run x",
        [row(0), row(1)],
        stages_ms=stages,
        motion=motion_section(motion, (), b""),
        annotated=picture,
        views=[],
        judged=[],
    )


def test_the_summary_of_a_run_fits_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(as_text, "terminal_width", lambda: 80)
    motion = {
        "pointing_deg_worst": 0.0687,
        "pointing_deg_end": 0.069,
        "torque_nm_worst": 0.0757,
        "imu_deg_worst": 1.0,
    }
    report(motion | {"imu_deg_end": 0.005, "gyro_saturated_s": 0.0}).print()
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[0] == "Motion"
    assert [line.partition(":")[0] for line in lines[1:3]] == ["pointing", "IMU alone"]
    assert lines[-2].startswith(
        "2 of 2 frames solved, 0 wrong; "
    )  # the answer, above the prompt


@pytest.mark.parametrize(("width", "left_out"), [(80, 10), (110, 5), (240, 0)])
def test_the_rows_of_a_run_fit_the_terminal(
    width: int,
    left_out: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(as_text, "terminal_width", lambda: width)
    as_text.print_table(frame_table(TRIPLE, [row(0), row(1)]))
    out = capsys.readouterr().out
    lines = out.splitlines()
    named = " ".join(out.split()).partition("in a wider terminal: ")[2]
    assert len(named.split(", ") if named else []) == left_out
    table = [line for line in lines if "solved" in line]
    assert len(table) == 2
    for line in table:
        assert len(line) <= width
        assert "…" not in line
        assert re.search(r"1234\.567 +-2345\.678", line)
