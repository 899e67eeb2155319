"""Completion in a shell: commands, names of scenes and studies, and files."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from skysim.apps.cli.options import complete_scene, complete_study


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("skysim run ptase_2", ["ptase_2003"]),
        ("skysim study run led_c", ["led_count"]),
        ("skysim camera imx2", ["imx250", "imx264"]),
        ("skysim camera show imx2", ["imx250", "imx264"]),
        ("skysim camera ne", ["new"]),
        ("skysim camera new --row", ["--row-time"]),
        ("skysim camera imx264 --se", ["--set"]),
    ],
)
def test_a_shell_completes_names_and_options(typed: str, completed: list[str]) -> None:
    environment = os.environ | {
        "_SKYSIM_COMPLETE": "complete_bash",
        "COMP_WORDS": typed,
        "COMP_CWORD": str(len(typed.split()) - 1),
    }
    code = "import sys; sys.argv[0] = 'skysim'; from skysim.apps.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert (done.stdout.split(), done.stderr) == (completed, "")


def test_files_and_folders_complete_beside_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "shed").mkdir()
    for name in ("shed/lab.yaml", "shefex_mine.yaml", "notes.txt"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    assert complete_scene("she") == ["shed/", "shefex2", "shefex_mine.yaml", "shefex_night"]
    assert complete_scene("shed/") == ["shed/lab.yaml"]
    assert complete_scene("no") == []
    assert complete_study("led_c") == ["led_count"]
