"""A camera's calibration through OpenCV's YAML: OpenCV reads ours, we read OpenCV's, another lens is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skysim.apps import plate_solver
from skysim.camera.optics import Optics
from skysim.core import files
from skysim.core.errors import InputError
from skysim.results.files import recording
from skysim.scene import loader, opencv_calibration
from skysim.scene.opencv_calibration import OpencvCalibration
from skysim.simulation.flight import simulate_motion

CALIBRATION = OpencvCalibration(
    1600, 1200, 4545.123456789, (790.25, 611.5), (-0.1, 1e-7, 1e-05, -3.2e-9, 0.25)
)


def by_opencv(path: Path, **more: Any) -> Path:
    """A file written by OpenCV."""
    focal = CALIBRATION.focal_px
    (x, y) = CALIBRATION.center_px
    keys = {
        "calibration_time": "Sun 22 Nov 2026 14:00:00 UTC",
        "image_width": CALIBRATION.width_px,
        "image_height": CALIBRATION.height_px,
        "camera_matrix": np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]]),
        "distortion_coefficients": np.array(CALIBRATION.distortion)[:, None],
        "avg_reprojection_error": 0.21,
        "per_view_reprojection_errors": np.full((3, 1), 0.2, np.float32),
    }
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in (keys | more).items():
        file.write(key, value)
    file.release()
    return path


numbers = st.floats(-1e3, 1e3, allow_subnormal=False)


@settings(
    max_examples=50,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    st.builds(
        OpencvCalibration,
        st.integers(1, 20000),
        st.integers(1, 20000),
        st.floats(1e-3, 1e8),
        st.tuples(numbers, numbers),
        st.tuples(*[numbers] * 5),
    )
)
def test_a_calibration_round_trips_exactly_through_opencv_and_skysim(
    tmp_path: Path, calibration: OpencvCalibration
) -> None:
    path = tmp_path / "camera.yml"
    files.write_text(path, opencv_calibration.text(calibration))
    assert opencv_calibration.looks_like_calibration(path)
    assert opencv_calibration.read(path) == calibration
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    size = (file.getNode("image_width").real(), file.getNode("image_height").real())
    assert size == (calibration.width_px, calibration.height_px)
    fx, cx, fy, cy = file.getNode("camera_matrix").mat()[[0, 0, 1, 1], [0, 2, 1, 2]]
    assert (fx, fy, cx, cy) == (
        calibration.focal_px,
        calibration.focal_px,
        *calibration.center_px,
    )
    assert (
        tuple(file.getNode("distortion_coefficients").mat().ravel()) == calibration.distortion
    )


def test_a_calibration_written_by_opencv_is_read(tmp_path: Path) -> None:
    """By OpenCV 5, by 4, whose first line is no YAML, and as ROS has it, without tags."""
    path = by_opencv(tmp_path / "five.yml")
    assert opencv_calibration.read(path) == CALIBRATION
    text = path.read_text()
    (tmp_path / "four.yml").write_text(text.replace("%YAML 1.2", "%YAML:1.0"))
    assert opencv_calibration.read(tmp_path / "four.yml") == CALIBRATION
    ros = text.replace("!!opencv-matrix", "").replace(
        "%YAML 1.2\n---\n", "distortion_model: plumb_bob\n"
    )
    (tmp_path / "ros.yaml").write_text(ros)
    assert opencv_calibration.looks_like_calibration(tmp_path / "ros.yaml")
    assert opencv_calibration.read(tmp_path / "ros.yaml") == CALIBRATION


MATRIX = np.array([[900.0, 0, 800], [0, 900, 600], [0, 0, 1]])


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        (
            {"camera_matrix": MATRIX * [1, 1.01, 1]},
            "fx 900 and fy 909 differ by 0.99 %; allowed: square pixels",
        ),
        (
            {"camera_matrix": MATRIX + np.eye(3, k=1)},
            "camera_matrix: another form; allowed: [fx, 0, cx",
        ),
        ({"camera_matrix": -MATRIX}, "camera_matrix: another form; allowed: [fx, 0, cx"),
        (
            {"camera_matrix": MATRIX * np.nan},
            "camera_matrix: other data; allowed: 9 finite numbers",
        ),
        ({"camera_matrix": np.eye(4)}, "camera_matrix: 4 rows and 4 cols; allowed: 3x3"),
        ({"camera_matrix": 7}, "camera_matrix: missing"),
        (
            {"distortion_coefficients": np.full((1, 8), 0.1)},
            "8 terms; allowed: k1, k2, p1, p2, k3",
        ),
        ({"distortion_coefficients": np.zeros((1, 3))}, "1 rows and 3 cols; allowed: 1x4"),
        ({"image_width": 0}, "image_width: 0 is not allowed"),
        ({"image_height": 1200.5}, "image_height: 1200.5 is not allowed"),
        ({"fisheye_model": 1}, "fisheye_model: 1; allowed: 0"),
        (
            {"distortion_model": "equidistant"},
            "distortion_model: 'equidistant'; allowed: plumb_bob",
        ),
    ],
)
def test_another_lens_is_refused_in_one_line(
    tmp_path: Path, more: dict[str, Any], complaint: str
) -> None:
    path = by_opencv(tmp_path / "camera.yml", **more)
    with pytest.raises(InputError) as raised:
        opencv_calibration.read(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert complaint in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"%YAML:1.0\n---\n",
        b"\xff\xfe\x00",
        b"camera_matrix: !!python/object/apply:os.system ['true']\n",
        b"camera_matrix: !!opencv-matrix [1, 2]\n",
        b"camera_matrix: !!opencv-matrix {rows: {}, cols: [], data: 3}\nimage_width: 3\nimage_height: 3\n",
        b"image_width: 3\nimage_height: 3\ncamera_matrix: {rows: 3, cols: 3, data: [1, 2]}\n",
        b"a: " + b"[" * 20_000,
        b"x: '" + b"y" * (1 << 20) + b"'\n",
    ],
    ids=[
        "empty",
        "head",
        "utf-16",
        "object",
        "no matrix",
        "odd shape",
        "short",
        "deep",
        "long",
    ],
)
def test_a_hostile_file_is_refused_in_one_line(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "camera.yml"
    path.write_bytes(data)
    with pytest.raises(InputError) as raised:
        opencv_calibration.read(path)
    assert "\n" not in str(raised.value)


# Where it is used


@pytest.fixture
def lens(tmp_path: Path) -> Path:
    """A calibration of a camera like shefex2's with a slightly different lens."""
    calibration = OpencvCalibration(
        659, 493, 2540.5, (331.25, 244.5), (-0.12, 0.04, 6e-4, -4e-4, 0.0)
    )
    files.write_text(tmp_path / "lens.yml", opencv_calibration.text(calibration))
    return tmp_path / "lens.yml"


@pytest.mark.parametrize("focus", ["infinity", "3 m"])
def test_a_scene_s_camera_has_opencv_s_calibration(lens: Path, focus: str) -> None:
    """A file beside the scene; directions go through `cv2.projectPoints` and our lens to the same pixels."""
    own = lens.parent / "mine.yaml"
    own.write_text(
        f"schema: 1\nbase: shefex2\ncamera: {{calibration: lens.yml, focal_length: null, focus: {focus}}}\n"
    )
    camera = loader.load(own).camera
    file = cv2.FileStorage(str(lens), cv2.FILE_STORAGE_READ)
    matrix = file.getNode("camera_matrix").mat()
    bent = file.getNode("distortion_coefficients").mat()
    points = np.random.default_rng(1).uniform((-0.13, -0.09, 1), (0.13, 0.09, 1), (200, 3))
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, bent)[0][:, 0]
    np.testing.assert_allclose(
        Optics.from_camera(camera).project(points), theirs, rtol=0, atol=1e-7
    )
    assert (camera.width_px, camera.height_px) == (659, 493)


@pytest.mark.parametrize(
    ("said", "complaint"),
    [
        (
            "calibration: lens.yml",
            "camera.focal_length: conflicts with camera.calibration; allowed: one of the two",
        ),
        (
            "calibration: none.yml, focal_length: null",
            "camera.calibration: none.yml: cannot be read",
        ),
        (
            "calibration: lens.yml, focal_length: null, preset: lu205c",
            "for frames of 659x493; the preset's are 1600x1200",
        ),
        (
            "calibration: lens.yml, focal_length: null, pixel: 5",
            "camera.pixel: 5 has no unit",
        ),
    ],
)
def test_a_contradiction_is_reported_with_its_line(
    lens: Path, said: str, complaint: str
) -> None:
    own = lens.parent / "mine.yaml"
    own.write_text(f"schema: 1\nbase: shefex2\ncamera: {{{said}}}\n")
    with pytest.raises(InputError) as raised:
        loader.load(own)
    assert complaint in str(raised.value)
    assert str(raised.value).endswith(")")
    assert "line" in str(raised.value)


@pytest.mark.slow
def test_a_frame_is_solved_by_its_camera_s_calibration(lens: Path) -> None:
    """A focal length wrong by a part in a thousand, as chessboards have it, is found again."""
    own = lens.parent / "mine.yaml"
    own.write_text(
        "schema: 1\nbase: shefex2\ncamera: {calibration: lens.yml, focal_length: null}\nexposure: {frames: 1}\n"
    )
    loaded = loader.load(own)
    frame, truth = simulate_motion(loaded).render(0)
    recording.write_frame(lens.parent, frame, truth, loaded)
    calibration = opencv_calibration.read(lens)
    off = opencv_calibration.text(
        OpencvCalibration(
            calibration.width_px,
            calibration.height_px,
            calibration.focal_px * 1.001,
            calibration.center_px,
            calibration.distortion,
        )
    )
    files.write_text(lens, off)
    how = plate_solver.make_solver(None, lens)
    answer = plate_solver.solve_file(lens.parent / "frame_0000.fits", how)
    assert answer["status"] == "solved"
    true = scene_pointing(truth, calibration)
    assert [answer["ra_deg"], answer["dec_deg"]] == pytest.approx(true, abs=3 / 3600)
    files.write_image(lens.parent / "other.png", np.zeros((480, 640), np.uint16))
    refused = plate_solver.solve_file(lens.parent / "other.png", how)
    assert refused["status"].endswith("other.png: 640x480 pixels; this camera's are 659x493")


def scene_pointing(truth: Any, calibration: OpencvCalibration) -> list[float]:
    """RA and Dec, deg, of the image's center by OpenCV's undistortion."""
    focal = calibration.focal_px
    (x, y) = calibration.center_px
    matrix = np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])
    middle = np.array([[[329.0, 246.0]]])
    ray = np.append(
        cv2.undistortPoints(middle, matrix, np.array(calibration.distortion)).ravel(), 1
    )
    direction = truth.cam_from_lab.inv().apply(ray / np.linalg.norm(ray))
    return [
        float(np.degrees(np.arctan2(direction[1], direction[0]))),
        float(np.degrees(np.arcsin(direction[2]))),
    ]
