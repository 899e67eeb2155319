"""Full disks, unwritable folders and signals: one error line and no partial file."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from astropy.io import fits
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.core import files
from skysim.core.errors import InputError
from skysim.results.files import recording, run_export
from skysim.scene import loader
from skysim.simulation.flight import open_flight

SKYSIM = [sys.executable, "-m", "skysim"]
SMALL = ["--set", "light.limit_mag=5"]


def ready() -> None:
    """Restore Ctrl-C, which a shell's background jobs ignore."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def asked(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*SKYSIM, *words], capture_output=True, text=True, timeout=300, check=False
    )


def whole_frames(folder: Path) -> int:
    """Number of frames; checks that each is readable and no temporary file is left."""
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
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", place],
        check=False,
        capture_output=True,
    )
    if done.returncode:
        pytest.skip("nothing can be mounted here")
    yield place
    subprocess.run(["umount", place], check=True)


@pytest.mark.long
def test_a_full_disk_is_reported_and_written_files_are_complete(mounted: Path) -> None:
    done = asked("run", "shefex2", "--frames", "20", "--out", str(mounted / "run"), *SMALL)
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"skysim: {mounted / 'run' / 'frame_'}")
    assert re.search(
        r": No space left on device; [\d.e-]+ MB are free, nothing is half-written$", last
    )
    assert "Traceback" not in done.stderr
    assert whole_frames(mounted / "run") >= 1


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> recording.Recording:
    """Three frames with their truth."""
    folder = tmp_path_factory.mktemp("flown")
    scene = loader.load("shefex2", {"exposure.frames": "3", "light.limit_mag": "5"})
    for shot in open_flight(scene).shots(solves=False):
        recording.write_frame(folder, shot.frame, shot.truth, scene)
    return recording.Recording(folder)


@contextlib.contextmanager
def no_room(file_bytes: int) -> Iterator[None]:
    """Limit the size of files, so that writes fail as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("tiff", "frame_0000.tif"),
        ("zarr", "frames.zarr"),
        ("video", "frames.mp4"),
        ("ecsv", "truth.ecsv"),
        ("parquet", "truth.parquet"),
        ("aem", "truth.aem"),
    ],
)
def test_an_export_without_room_names_file_and_reason_and_leaves_nothing(
    flown: recording.Recording,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    name: str,
    file: str,
) -> None:
    def quiet(items: Iterable[Any], total: int, what: str) -> Iterator[Any]:
        yield from items

    with no_room(500), pytest.raises(OSError, match="File too large") as raised:
        run_export.export(flown, [name], tmp_path, quiet)
    assert raised.value.filename == str(tmp_path / file)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


def test_a_film_that_lost_frames_is_refused(
    flown: recording.Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is room again when the film is checked: the cause is unknown, but frames are missing."""
    film = cv2.VideoWriter

    class Forgetful:
        def __init__(self, *arguments: Any) -> None:
            self.film = film(*arguments)
            self.frames = 0
            self.isOpened = self.film.isOpened
            self.release = self.film.release

        def write(self, image: Any) -> None:
            self.frames += 1
            if self.frames < 3:
                self.film.write(image)

    monkeypatch.setattr(
        "skysim.results.files.run_export.cv2.VideoWriter",
        type("F", (Forgetful,), {"fourcc": film.fourcc}),
    )
    with pytest.raises(InputError, match=r"frames\.mp4: OpenCV wrote 2 of 3 frames"):
        run_export.export(flown, ["video"], tmp_path, lambda items, *_: iter(items))
    assert list(tmp_path.iterdir()) == []


def test_a_stream_without_room_names_the_file_and_counts_what_was_lost(
    tmp_path: Path,
) -> None:
    command = [
        "live",
        "shefex2",
        "--folder",
        str(tmp_path),
        "--speed",
        "0",
        "--frames",
        "5",
        *SMALL,
    ]
    with no_room(100_000):
        done = CliRunner().invoke(main.app, [*command, "--json"])
    assert str(done.exception) == f"--folder: {tmp_path / 'frame_000000.png'}: File too large"
    report = json.loads(done.stdout)
    assert report["outputs"]["folder"]["dropped"]["frame"] == report["made"] >= 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
def test_a_picture_without_room_names_file_and_reason(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], suffix: str
) -> None:
    image = np.random.default_rng(1).integers(0, 255, (64, 64), np.uint8)
    with no_room(500), pytest.raises(OSError, match="File too large") as raised:
        files.write_image(tmp_path / f"a.{suffix}", image)
    assert raised.value.filename == str(tmp_path / f"a.{suffix}")
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


@pytest.mark.long
def test_an_unwritable_folder_is_reported_in_one_line(mounted: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro", mounted], check=True)
    for words in (("run", "shefex2", "--frames", "1"), ("study", "run", "led_count")):
        done = asked(*words, "--out", str(mounted / "run"))
        assert done.returncode == 2
        assert (
            done.stderr.splitlines()[-1]
            == f"skysim: {mounted / 'run'}: cannot be created as a folder: Read-only file system"
        )


@pytest.mark.long
@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.long), signal.SIGTERM]
)
def test_a_run_that_is_stopped_leaves_whole_frames(
    tmp_path: Path, number: signal.Signals
) -> None:
    command = [*SKYSIM, "run", "shefex2", "--frames", "400", "--out", str(tmp_path), *SMALL]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=ready)
    until = time.monotonic() + 200
    while not (tmp_path / "frame_0002.fits").exists():
        assert run.poll() is None
        assert time.monotonic() < until
        time.sleep(0.02)
    os.kill(run.pid, number)
    errors = run.communicate(timeout=60)[1]
    assert run.returncode == 130
    assert errors.splitlines()[-1] == "skysim: stopped"
    assert whole_frames(tmp_path) >= 3
