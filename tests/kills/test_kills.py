"""A kill of every command, and disks and clocks in trouble; `python -m tests.kills` is the whole campaign."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.kills.campaign import FAKETIME, JOBS, TROUBLES, Campaign, Job

NAMES = [job.name for job in JOBS]


@pytest.mark.long
@pytest.mark.parametrize("job", JOBS, ids=NAMES)
def test_a_killed_command_goes_on_to_the_same_results(job: Job, tmp_path: Path) -> None:
    if job.on_dask:
        pytest.importorskip("distributed")
    result = Campaign(tmp_path, seed=2).run(job, 2)
    assert result.findings == []
    assert result.identical == result.kills == 2


@pytest.mark.long
@pytest.mark.parametrize("name", TROUBLES)
@pytest.mark.parametrize("job", [job for job in JOBS if not job.on_dask])
def test_a_command_in_trouble_says_so_in_one_line_and_goes_on(
    job: Job, name: str, tmp_path: Path
) -> None:
    if name == "clock set back" and not FAKETIME.exists():
        pytest.skip("faketime is not installed")
    if name != "clock set back" and (os.geteuid() or not shutil.which("mount")):
        pytest.skip("nothing can be mounted here")
    trouble = getattr(Campaign(tmp_path, seed=3), name.replace(" ", "_"))(job)
    assert trouble.findings == []


def test_a_half_written_file_and_a_wrong_row_are_found(tmp_path: Path) -> None:
    """The campaign's own law: what is left is a part of the whole, and at the end equal to it."""
    from tests.kills.campaign import differences, state, temporary_files

    (tmp_path / "a.json").write_text('{"a": 1, "time_ms": 3}')
    (tmp_path / "b.bin").write_bytes(b"1234")
    whole = state(tmp_path)
    (tmp_path / "a.json").write_text('{"a": 1, "time_ms": 4}')
    assert differences(state(tmp_path), whole, is_end=True) == []
    (tmp_path / "b.bin").write_bytes(b"12")
    assert differences(state(tmp_path), whole, is_end=False) == ["b.bin: differs"]
    (tmp_path / "b.bin").rename(tmp_path / ".b.skysim-0-1.bin")
    assert differences(state(tmp_path), whole, is_end=False) == []
    assert differences(state(tmp_path), whole, is_end=True) == ["b.bin: missing"]
    assert temporary_files(tmp_path) == [".b.skysim-0-1.bin"]
    (tmp_path / "a.json").write_text('{"a"')
    assert differences(state(tmp_path), whole, is_end=False) == ["a.json: differs"]
