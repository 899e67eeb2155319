"""An option of the command line that does nothing is refused in one line."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

Command = Callable[..., subprocess.CompletedProcess[str]]
STUDY = {
    "schema": 1,
    "title": "Small",
    "scene": "afit_simsat_ideal",
    "seed": 1,
    "trial": {"kind": "centroids"},
    "factors": {"noise": {"key": "trial.noise_px", "values": [0.1]}},
    "responses": ["identified"],
}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "run shefex2 --program mine=cat",
            "--program mine: has no effect: nothing has this name",
        ),
        (
            "check shefex2 --program mine=cat",
            "--program mine: has no effect: nothing has this name",
        ),
        (
            "validate study.yaml shefex2 --program mine=cat",
            "--program mine: has no effect: nothing has this name",
        ),
        (
            "compare shefex2 --tracker own --program mine=cat",
            "--program mine: has no effect: nothing has this name",
        ),
        (
            "study run study.yaml --program mine=cat",
            "--program mine: has no effect: nothing has this name",
        ),
        (
            "study run study.yaml --engine serial --workers 2",
            "--workers 2: has no effect with --engine serial",
        ),
        (
            "live shefex2 --folder out --host ::1",
            "--host ::1: has no effect without --tcp or --http",
        ),
        ("reproduce shefex-figs-4-5 --open", "--open: has no effect without --report"),
    ],
)
def test_an_option_without_effect_is_refused(
    command: Command, words: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(STUDY))
    done = command(*words.split())
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"skysim: {message}")
    assert done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["study.yaml"]


@pytest.mark.parametrize("words", ["reproduce shefex-figs-4-5", "datasheet shefex2"])
def test_a_page_that_cannot_be_written_is_refused_before_the_work(
    command: Command, words: str, tmp_path: Path
) -> None:
    done = command(*words.split(), "--markdown", "page.pdf")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("skysim: page.pdf: unknown file format '.pdf'; allowed:")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_program_named_by_a_study_s_level_has_an_effect(
    command: Command, tmp_path: Path
) -> None:
    """It is started; its trials fail because `true` ends at once, and the report is written."""
    factors = {"tracker": {"key": "tracker.name", "values": ["own", "mine"]}}
    study = STUDY | {"factors": factors, "trial": {"kind": "frames"}, "scene": "shefex2"}
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(study))
    words = ["study", "run", "study.yaml", "--engine", "serial", "--program", "mine=true"]
    done = command(*words)
    assert "has no effect" not in done.stderr
    assert (tmp_path / "out/study/report.html").exists()
