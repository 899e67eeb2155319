"""Tables in a narrow terminal: columns are left out and named, numbers are never cut."""

import re

import pytest

from skysim.apps.cli import terminal
from skysim.core.types import FrameRow

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


@pytest.mark.parametrize(("width", "left_out"), [(80, 4), (110, 1), (240, 0)])
def test_the_rows_of_a_run_fit_the_terminal(
    width: int, left_out: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(terminal, "terminal_width", lambda: width)
    terminal.print_rows([row(0), row(1)], TRIPLE, [10.0, 10.0])
    lines = capsys.readouterr().out.splitlines()
    named = [line for line in lines if line.startswith("in the report")]
    assert sum(len(line.partition(": ")[2].split(", ")) for line in named) == left_out
    table = [line for line in lines if "solved" in line]
    assert len(table) == 2
    for line in table:
        assert len(line) <= width
        assert "…" not in line
        assert re.search(r"1234\.567 +-2345\.678", line)
