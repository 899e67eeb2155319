"""Projection against OpenCV's, and the camera's own sizes by hand."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skysim import scene
from skysim.optics import PSFS, Optics

CAMERA = {
    "width_px": 659,
    "height_px": 493,
    "pixel": "9.9 um",
    "focal_length": "25 mm",
    "f_number": 1.4,
    "transmission": 0.85,
    "detector": {"quantum_efficiency": 0.4, "full_well_e": 40000, "gain_e_dn": 10, "bits": 12},
}


def optics(**camera: object) -> Optics:
    return Optics.of(scene.Camera.model_validate(CAMERA | camera))


def rays(count: int, half_angle_deg: float, seed: int) -> np.ndarray:
    tangent = np.random.default_rng(seed).uniform(-1, 1, (count, 2)) * np.tan(np.radians(half_angle_deg))
    return np.column_stack([tangent, np.ones(count)])


small = st.floats(-0.3, 0.3)


@settings(max_examples=50, derandomize=True, deadline=None)
@given(st.tuples(small, small, st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), small))
def test_distortion_is_opencv_s(distortion: tuple[float, ...]) -> None:
    lens, vectors = optics(distortion=list(distortion), principal_point_px=[300.0, 250.0]), rays(100, 25, 1)
    matrix = np.array([[lens.focal_px, 0, 300.0], [0, lens.focal_px, 250.0], [0, 0, 1]])
    wanted, _ = cv2.projectPoints(vectors, np.zeros(3), np.zeros(3), matrix, np.array(distortion))
    np.testing.assert_allclose(lens.project(vectors), wanted[:, 0], rtol=0, atol=1e-9)  # rounding of 1e3 px


def test_the_boresight_is_the_middle_of_the_chip_unless_told_otherwise() -> None:
    boresight = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(optics().project(boresight), [329, 246], rtol=0, atol=1e-12)
    moved = optics(principal_point_px=[12.5, 400.0])
    np.testing.assert_allclose(moved.project(boresight), [12.5, 400.0], rtol=0, atol=1e-12)


def test_right_is_plus_x_and_down_is_plus_y() -> None:
    # tan(1 deg) x 25 mm / 9.9 um = 44.078 px.
    tangent = np.tan(np.radians(1.0))
    right, below = optics().project(np.array([[tangent, 0, 1.0], [0, tangent, 1.0]])) - [329, 246]
    np.testing.assert_allclose(right, [44.078, 0], rtol=0, atol=5e-4)
    np.testing.assert_allclose(below, [0, 44.078], rtol=0, atol=5e-4)


def test_a_vector_s_length_does_not_matter_and_what_is_behind_has_no_pixel() -> None:
    vectors = rays(10, 10, 2)
    np.testing.assert_allclose(optics().project(7 * vectors), optics().project(vectors), rtol=0, atol=1e-10)
    assert np.isnan(optics().project(-vectors)).all()


def test_reference_field_of_view_and_diagonal() -> None:
    # Reference H1: 14.868 x 11.150 degrees over the whole chip, true diagonal 18.51.
    lens = optics()
    assert np.degrees(2 * np.arctan(659 / 2 / lens.focal_px)) == pytest.approx(14.868, abs=0.001)
    assert np.degrees(2 * lens.half_diagonal_rad) == pytest.approx(18.51, abs=0.01)


def test_half_diagonal_reaches_the_farthest_corner_of_a_shifted_chip() -> None:
    shifted = optics(principal_point_px=[100.0, 400.0])
    corner = np.array([658.5 - 100, 400.5, shifted.focal_px])
    assert shifted.half_diagonal_rad == pytest.approx(
        np.arccos(corner[2] / np.linalg.norm(corner)), abs=1e-12
    )


def test_half_diagonal_is_never_too_small() -> None:
    """Whatever an undistorted camera images is within it."""
    lens = optics(principal_point_px=[500.0, 100.0])
    vectors = rays(5000, 30, 3)
    xy = lens.project(vectors)
    on_chip = np.all((xy >= -0.5) & (xy <= [658.5, 492.5]), axis=1)
    angle = np.arccos(1 / np.linalg.norm(vectors, axis=1))
    assert on_chip.sum() > 100
    assert angle[on_chip].max() < lens.half_diagonal_rad


def test_the_pupil_collects_its_area_times_the_transmission() -> None:
    assert optics().collecting_m2 == pytest.approx(np.pi / 4 * (0.025 / 1.4) ** 2 * 0.85, rel=1e-14)


def test_every_psf_is_a_sigma_and_a_radius() -> None:
    psf = scene.Psf(kind="disc", sigma_px=0.8, radius_px=3.0)
    assert PSFS["disc"](psf) == (0.8, 3.0)
    assert PSFS["gaussian"](psf) == (0.8, 0.0)
