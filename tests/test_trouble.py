"""Trouble around us: a full disk, a folder that can't be written, signals. One line, and nothing half-written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from astropy.io import fits

SKYSIM = [sys.executable, "-m", "skysim"]
SMALL = ["--set", "light.limit_mag=5"]


def ready() -> None:
    """A shell's background job hands down that Ctrl-C is to be ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def asked(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*SKYSIM, *words], capture_output=True, text=True, timeout=300, check=False)


def whole_frames(folder: Path) -> int:
    """How many frames there are, each of them readable, and no leftover of another."""
    assert [path.name for path in folder.iterdir() if path.name.startswith(".")] == []
    frames = sorted(folder.glob("frame_*.fits"))
    for path in frames:
        assert fits.getdata(path).shape == (493, 659)
        assert path.with_suffix(".png").stat().st_size > 1000
    return len(frames)


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Path]:
    """A file system of two megabytes."""
    place = tmp_path / "disk"
    place.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", place], check=False, capture_output=True
    )
    if done.returncode:
        pytest.skip("nothing can be mounted here")
    yield place
    subprocess.run(["umount", place], check=True)


def test_a_full_disk_is_named_and_what_was_written_is_whole(mounted: Path) -> None:
    done = asked("run", "shefex2", "--frames", "20", "--out", str(mounted / "run"), *SMALL)
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"skysim: {mounted / 'run' / 'frame_'}")
    assert last.endswith(": No space left on device")
    assert "Traceback" not in done.stderr
    assert whole_frames(mounted / "run") >= 1


@pytest.mark.long
def test_a_folder_that_cannot_be_written_is_told_in_a_line(mounted: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro", mounted], check=True)
    for words in (("run", "shefex2", "--frames", "1"), ("study", "run", "led_count")):
        done = asked(*words, "--out", str(mounted / "run"))
        assert done.returncode == 2
        assert (
            done.stderr.splitlines()[-1]
            == f"skysim: {mounted / 'run'}: cannot be made a folder: Read-only file system"
        )


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.long), signal.SIGTERM])
def test_a_run_that_is_stopped_leaves_whole_frames(tmp_path: Path, number: signal.Signals) -> None:
    command = [*SKYSIM, "run", "shefex2", "--frames", "400", "--out", str(tmp_path), *SMALL]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=ready)
    until = time.monotonic() + 200
    while not (tmp_path / "frame_0002.fits").exists():
        assert run.poll() is None
        assert time.monotonic() < until
        time.sleep(0.02)
    os.kill(run.pid, number)
    told = run.communicate(timeout=60)[1]
    assert run.returncode == 130
    assert told.splitlines()[-1] == "skysim: stopped"
    assert whole_frames(tmp_path) >= 3
