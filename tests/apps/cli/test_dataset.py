"""`skysim dataset` on the command line: what it prints, and how it ends."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from skysim.experiments import dataset_run
from skysim.experiments.dataset_run import ShardResult
from skysim.experiments.study.execution import engines

Command = Callable[..., subprocess.CompletedProcess[str]]
SIZE = ("--set", "camera.width_px=120", "--set", "camera.height_px=90")
WORDS = (
    "dataset",
    "shefex2",
    "--frames",
    3,
    "--shard-frames",
    2,
    "--out",
    "frames",
    "--engine",
    "serial",
    *SIZE,
)


@pytest.mark.slow
def test_it_writes_the_frames_and_says_where(command: Command, tmp_path: Path) -> None:
    done = command(*WORDS, "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["out"], told["frames"], told["shards"], told["failed"]) == ("frames", 3, 2, 0)
    assert sorted(path.name for path in (tmp_path / "frames" / "shards").iterdir()) == [
        "000000.tar",
        "000001.tar",
    ]
    again = command(*WORDS)
    assert (again.returncode, again.stdout) == (0, "3 of 3 frames in 2 shards: frames\n")
    other = command(*WORDS, "--seed", 9)
    assert other.returncode == 2
    assert "contains another dataset" in other.stderr


def test_frames_that_are_missing_end_it_with_an_error(
    command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dead(self: dataset_run.DatasetJob, chunk: engines.Chunk) -> list[ShardResult]:
        return [self.failed(segment, engines.DIED) for segment in chunk]

    monkeypatch.setattr(dataset_run.DatasetJob, "run", dead)
    done = command(*WORDS)
    assert done.returncode == 2
    assert done.stdout == "0 of 3 frames in 2 shards: frames\n"
    assert "3 frames are missing" in done.stderr
