"""The camera model against hand calculations and OpenCV's Brown-Conrady distortion."""

import cv2
import numpy as np
import pytest

from estimator.core.camera import Camera, check_frame, distorted, undistorted
from estimator.core.errors import ImageError

LENS = (-0.12, 0.05, 0.001, -0.002, -0.01)
DISTORTED = Camera(1600, 1200, 2000.0, (810.5, 590.25), LENS)
CV_MATRIX = np.array([[2000.0, 0, 810.5], [0, 2000.0, 590.25], [0, 0, 1]])


def pixels_over(camera: Camera, count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(
        0, [camera.width_px - 1, camera.height_px - 1], (count, 2)
    )


def test_a_distorted_pixel_matches_a_hand_calculation() -> None:
    # x/z = .2, y/z = -.1: r2 = .05; radial = 1 + .05 k1 + .0025 k2 with k1 = -.1, k2 = .4 is .996;
    # x' = .1992 + 2 p1 (-.02) + p2 (.05 + .08) with p1 = .01, p2 = -.02: .1992 - .0004 - .0026 = .1962;
    # y' = -.0996 + p1 (.05 + .02) + 2 p2 (-.02) = -.0996 + .0007 + .0008 = -.0981.
    camera = Camera(640, 480, 1000.0, (300.0, 200.0), (-0.1, 0.4, 0.01, -0.02, 0.0))
    # 1e-10: rounding of numbers of a few hundred.
    np.testing.assert_allclose(
        camera.pixels(np.array([[0.4, -0.2, 2.0]])), [[496.2, 101.9]], rtol=0, atol=1e-10
    )


def test_the_boresight_lands_on_the_principal_point() -> None:
    np.testing.assert_array_equal(
        DISTORTED.pixels(np.array([[0.0, 0.0, 3.0]])), [[810.5, 590.25]]
    )


def test_x_is_to_the_right_and_y_is_down() -> None:
    camera = Camera(100, 100, 100.0, (50.0, 50.0))
    pixels = camera.pixels(np.array([[0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]))
    np.testing.assert_allclose(pixels, [[60, 50], [50, 60]], rtol=0, atol=1e-12)  # rounding


def test_a_direction_behind_the_camera_has_no_pixel() -> None:
    assert np.isnan(DISTORTED.pixels(np.array([[0.1, 0.1, -1.0], [1.0, 0.0, 0.0]]))).all()


def test_barrel_distortion_does_not_fold_a_far_star_into_the_field() -> None:
    # r (1 - .15 r^2) turns back at r = sqrt(1 / .45) = 1.4907; at r = 2.5 it is .156, well within the field.
    camera = Camera(1600, 1200, 2000.0, (810.5, 590.25), (-0.15, 0.0, 0.0, 0.0, 0.0))
    pixels = camera.pixels(np.array([[1.4906, 0, 1], [1.4908, 0, 1], [0, 2.5, 1]]))
    assert np.isnan(pixels).all(axis=1).tolist() == [False, True, True]
    # A pincushion and a lens whose k2 holds against k1 have no fold.
    for lens in [(0.15, 0.0, 0.0, 0.0, 0.0), (-0.1, 0.2, 0.0, 0.0, 0.0)]:
        sharp = Camera(1600, 1200, 2000.0, (810.5, 590.25), lens)
        assert np.isfinite(sharp.pixels(np.array([[2.5, 0, 1]]))).all()


def test_the_distortion_matches_opencv() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (500, 2)), np.ones(500)]) * rng.uniform(
        1, 9, (500, 1)
    )
    oracle, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CV_MATRIX, np.array(LENS))
    # 1e-9 px: rounding in two orders of summation.
    np.testing.assert_allclose(DISTORTED.pixels(points), oracle[:, 0], rtol=0, atol=1e-9)


def test_the_undistortion_matches_opencv() -> None:
    pixels = pixels_over(DISTORTED, 500, seed=2)
    done = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    oracle = cv2.undistortPoints(
        pixels[:, None], CV_MATRIX, np.array(LENS), criteria=done
    ).reshape(-1, 2)
    rays = DISTORTED.rays(pixels)
    # 1e-9: both iterate to convergence; OpenCV stops by the pixel error.
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], oracle, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", [(0.0,) * 5, LENS, (0.2, -0.1, 0.003, 0.002, 0.05)])
def test_rays_and_pixels_are_inverse_functions(lens: tuple[float, ...]) -> None:
    camera = Camera(1600, 1200, 2000.0, (810.5, 590.25), lens)
    pixels = pixels_over(camera, 1000, seed=3)
    rays = camera.rays(pixels)
    # 1e-12 of the focal length, and of a unit vector: rounding through some tens of iterations.
    np.testing.assert_allclose(camera.pixels(rays), pixels, rtol=0, atol=2000 * 1e-12)
    np.testing.assert_allclose(camera.rays(camera.pixels(rays)), rays, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, rtol=0, atol=1e-15)


def test_without_distortion_tangents_are_linear_however_far_off() -> None:
    """This holds even if the square of a tangent overflows, where zero distortion could give NaN."""
    xy_px = np.array([[10.0, 20.0], [1e200, -1e200], [810.5, 590.25]])
    found = undistorted(xy_px, 2000.0, 810.5, 590.25, (0.0, 0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(found, (xy_px - [810.5, 590.25]) / 2000, rtol=1e-15)


@pytest.mark.parametrize("coefficient", range(5))
def test_the_distortion_by_each_coefficient_is_undone(coefficient: int) -> None:
    lens = tuple(0.05 * (n == coefficient) for n in range(5))
    tangent = np.array([[0.2, -0.1], [-0.3, 0.25], [0.0, 0.1]])
    xy_px = 2000 * distorted(tangent, lens) + [810.5, 590.25]
    np.testing.assert_allclose(
        undistorted(xy_px, 2000.0, 810.5, 590.25, lens), tangent, rtol=0, atol=1e-14
    )


def test_the_field_is_the_angle_between_the_centers_of_the_edge_columns() -> None:
    camera = Camera.from_fov(659, 493, np.radians(14.87))
    left, right = camera.rays(np.array([[0.0, 246.0], [658.0, 246.0]]))
    assert np.degrees(np.arccos(left @ right)) == pytest.approx(14.87, abs=1e-12)  # rounding
    assert np.degrees(camera.fov_rad) == pytest.approx(14.87, abs=1e-12)
    np.testing.assert_array_equal(camera.rays(np.array([[329.0, 246.0]])), [[0, 0, 1]])


def test_the_diagonal_is_the_angle_between_opposite_corners() -> None:
    # Reference H1: SHEFEX-2's 14.868 x 11.150 degrees have a diagonal of 18.51 (24.95 mm, 9.9 um).
    camera = Camera(659, 493, 24.95e-3 / 9.9e-6, (329.0, 246.0))
    corners = camera.rays(np.array([[-0.5, -0.5], [658.5, 492.5]]))
    # rounding.
    assert camera.diagonal_rad == pytest.approx(np.arccos(corners[0] @ corners[1]), abs=1e-12)
    # .05 degree: the papers leave open whether edges or middles of pixels are meant, a pixel of .023 apart.
    assert np.degrees(camera.diagonal_rad) == pytest.approx(18.51, abs=0.05)


def test_a_zoomed_camera_magnifies_angles_from_the_axis() -> None:
    plain = Camera(640, 480, 1000.0, (320.0, 240.0))
    vector = np.array([[0.1, -0.05, 1.0]])
    off = plain.pixels(vector) - plain.center_px
    zoomed = plain.zoomed(1.5)
    # rounding.
    np.testing.assert_allclose(
        zoomed.pixels(vector) - zoomed.center_px, 1.5 * off, rtol=0, atol=1e-12
    )


def test_a_sensor_ends_half_a_pixel_beyond_its_outermost_pixel_centers() -> None:
    camera = Camera(10, 8, 10.0, (4.5, 3.5))
    inside = camera.contains(
        np.array([[-0.5, -0.5], [9.5, 7.5], [-0.51, 0], [9.51, 0], [0, 7.51], [0, -0.51]])
    )
    assert inside.tolist() == [True, True, False, False, False, False]
    shrunk = camera.contains(
        np.array([[0.4, 4.0], [0.5, 4.0], [4.0, 6.5], [4.0, 6.6]]), margin_px=1.0
    )
    assert shrunk.tolist() == [False, True, True, False]


def test_an_image_of_another_size_is_refused_with_both_sizes() -> None:
    with pytest.raises(
        ImageError, match="the image is 20x10 pixels; this camera's are 1600x1200"
    ):
        check_frame(np.zeros((10, 20)), DISTORTED)
    check_frame(np.zeros((1200, 1600)), DISTORTED)


@pytest.mark.parametrize("given", [{}, {"fov_rad": 0.3, "fov_deg": 17.0}])
def test_giving_the_field_of_view_twice_is_refused(given: dict[str, float]) -> None:
    with pytest.raises(ImageError, match="takes either fov_rad or fov_deg"):
        Camera.from_fov(640, 480, **given)
