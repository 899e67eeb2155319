"""A small part of the baseline in every run of the tests; `make baseline` compares all of it."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from skysim.core.paths import ROOT
from tests.baseline.machine import differences

DIGESTS = ROOT / "tests/baseline/digests"


def compared(*names: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tests.baseline", *names]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


@pytest.mark.slow
def test_messages_of_wrong_scenes_match_the_baseline() -> None:
    done = compared("messages/skysim.load_scene*")
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
@pytest.mark.skipif(
    bool(
        differences(
            json.loads((DIGESTS / "scenes.json").read_text(encoding="utf-8"))["machine"]
        )
    ),
    reason="recorded on another machine or with other versions",
)
def test_a_run_of_a_sky_matches_the_baseline() -> None:
    done = compared("scenes/shefex2")
    assert done.returncode == 0, done.stdout
