"""Text from outside is printed literally: no markup is interpreted and no control character reaches the terminal."""

from __future__ import annotations

import io
import sys

import pytest

from skysim.apps.cli import terminal
from skysim.experiments.study.execution.runner import Progress
from skysim.results.report import Cell, Column, Table, print_table
from skysim.tracking.tracker_interface import Answer, check_answer

HOSTILE = "m[red].png [/b] no match [/tmp/x] :bug: \\"


class Screen(io.StringIO):
    """A string buffer that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


def test_a_table_shows_cells_heads_and_title_as_they_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    table = Table(
        [Column("file", kind="text"), Column(HOSTILE)],
        [["a[/b]/m[red].png", Cell("WRONG", "bad")]],
    )
    print_table(table, HOSTILE)
    title, heads, line = capsys.readouterr().out.splitlines()
    assert title.strip() == HOSTILE
    assert heads.split(maxsplit=1)[1].strip() == HOSTILE
    assert line.split() == ["a[/b]/m[red].png", "WRONG"]


def test_bars_show_a_title_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "stderr", screen := Screen())
    assert list(terminal.progress([1, 2], 2, HOSTILE)) == [1, 2]
    with terminal.progress_callback("watched " + HOSTILE) as watch:
        watch(1.0, 1.0)
    with terminal.trial_progress("counted " + HOSTILE, 2) as watch_trials:
        watch_trials(Progress(2, 2))
    for name in ("", "watched ", "counted "):
        assert name + HOSTILE in screen.getvalue()


def test_control_characters_of_a_tracker_s_text_are_escaped(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert (
        check_answer(Answer("lost \x1b[2J\x07\ud800 in\u202e space")).status
        == "lost ?[2J?? in? space"
    )
    terminal.print_error("a\x1b[31m.png: no such\nfile")
    assert capsys.readouterr().err == "skysim: a?[31m.png: no such file\n"
