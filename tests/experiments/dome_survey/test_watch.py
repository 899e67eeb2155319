"""A folder that is watched while images arrive: every image is read once, each bad one is one line."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimator.core.camera import Camera
from estimator.trackers.pipeline import Settings
from skysim.core.errors import InputError
from skysim.experiments.dome_survey.survey_procedure import ATTITUDES, WatchedFolder

CAMERA = Camera(64, 48, 100.0, (31.5, 23.5))
HEAD = "file,roll_deg,pitch_deg,yaw_deg\n"


def write(path: Path, size: tuple[int, int] = (48, 64)) -> None:
    """Write an image as a camera's program does: the file appears whole."""
    write_bytes(path, cv2.imencode(".png", np.full(size, 9, np.uint16))[1].tobytes())


def write_bytes(path: Path, data: bytes) -> None:
    part = path.with_name(f".{path.name}")
    part.write_bytes(data)
    os.replace(part, path)


def watched(folder: Path) -> WatchedFolder:
    return WatchedFolder(folder, CAMERA, Settings())


@pytest.fixture
def dropping(tmp_path: Path) -> threading.Thread:
    """A thread that drops twelve images into the folder, one of the wrong size, one that is no image, and attitudes."""

    def drop() -> None:
        (tmp_path / "bad.png").write_bytes(b"no image")
        write(tmp_path / "small.png", (10, 10))
        for n in range(12):
            write(tmp_path / f"{n:02d}.png")
            rows = "".join(f"{k:02d}.png,{k},0,0\n" for k in range(n + 1))
            write_bytes(tmp_path / ATTITUDES, (HEAD + rows).encode())

    return threading.Thread(target=drop)


def test_every_image_is_read_once_and_each_bad_one_is_one_line(
    tmp_path: Path, dropping: threading.Thread
) -> None:
    folder = watched(tmp_path)
    dropping.start()
    news = list(folder.arrivals(12, poll_s=0.005))
    dropping.join()
    read = [name for one in news for name in one.read if name != ATTITUDES]
    complaints = [error for one in news for error in one.complaints]
    assert sorted(read) == [f"{n:02d}.png" for n in range(12)]
    assert [sorted(Path(error.key).name for error in complaints)] == [
        ["bad.png", "small.png"]
    ]
    assert not any("\n" in str(error) for error in complaints)
    for _ in range(2):  # the attitudes of the last image may be written after it
        folder.look()
    assert [picture.name for picture in folder.pictures] == sorted(read)
    attitudes = [picture.lab_from_body for picture in folder.pictures]
    roll_deg = [one.as_euler("xyz", degrees=True)[0] for one in attitudes if one is not None]
    np.testing.assert_allclose(roll_deg, np.arange(12), atol=1e-9)


def test_a_file_is_read_when_it_no_longer_grows(tmp_path: Path) -> None:
    write(tmp_path / "whole.png")
    data = (tmp_path / "whole.png").read_bytes()
    (tmp_path / "whole.png").unlink()
    folder = watched(tmp_path)
    growing = tmp_path / "a.png"
    for end in (len(data) // 3, len(data) // 2, len(data)):
        growing.write_bytes(data[:end])
        assert folder.look() == ([], [])
    assert folder.look() == (["a.png"], [])
    assert folder.look() == ([], [])


def test_a_repaired_image_is_read_again(tmp_path: Path) -> None:
    folder = watched(tmp_path)
    path = tmp_path / "a.png"
    path.write_bytes(b"no image")
    folder.look()
    assert len(folder.look().complaints) == 1
    assert folder.look() == ([], [])
    write(path)
    folder.look()
    assert folder.look() == (["a.png"], [])
    assert [picture.name for picture in folder.pictures] == ["a.png"]


def test_an_image_that_is_removed_or_replaced_by_a_better_format_is_not_counted_twice(
    tmp_path: Path,
) -> None:
    folder = watched(tmp_path)
    for name in ("a.bmp", "b.png"):
        write(tmp_path / name)
    folder.look()
    folder.look()
    write(tmp_path / "a.png")
    (tmp_path / "b.png").unlink()
    folder.look()
    assert folder.look().read == ["a.png"]
    assert [picture.name for picture in folder.pictures] == ["a.png"]


def test_faulty_attitudes_are_one_line_and_the_watch_continues(tmp_path: Path) -> None:
    folder = watched(tmp_path)
    write(tmp_path / "a.png")
    (tmp_path / ATTITUDES).write_text(HEAD + "a.png,1,2\n")
    folder.look()
    read, complaints = folder.look()
    assert read == ["a.png"]
    assert [(error.problem, error.allowed) for error in complaints] == [
        ("3 values", "4, as the first line has")
    ]
    (tmp_path / ATTITUDES).write_text(HEAD + "a.png,1,2,3\n")
    folder.look()
    assert folder.look().read == [ATTITUDES]
    assert folder.pictures[0].lab_from_body is not None


def test_a_missing_folder_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        next(watched(tmp_path / "none").arrivals(3))
