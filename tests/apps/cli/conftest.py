"""The command line in this process, which saves a second of imports a command."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from skysim.apps.cli import main


@pytest.fixture
def command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run `skysim` with some words in the folder `tmp_path`; `answers` are what is typed."""

    def run(*words: object, answers: str = "") -> subprocess.CompletedProcess[str]:
        arguments = ["skysim", *map(str, words)]
        out = io.StringIO()
        err = io.StringIO()
        monkeypatch.setattr(sys, "argv", arguments)
        monkeypatch.setattr(sys, "stdin", io.StringIO(answers))
        with (
            contextlib.chdir(tmp_path),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            pytest.raises(SystemExit) as left,
        ):
            main.main()
        return subprocess.CompletedProcess(
            arguments, int(left.value.code or 0), out.getvalue(), err.getvalue()
        )

    return run
