"""Projection against OpenCV, vignetting against traced rays, and camera dimensions against hand calculations."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skysim.camera.optics import VIGNETTING, Optics, fold_r
from skysim.camera.render import Window, render
from skysim.core.types import Mount, Sources, Trajectory
from skysim.scene.sections.camera import CameraConfig

CAMERA = {
    "width_px": 659,
    "height_px": 493,
    "pixel": "9.9 um",
    "focal_length": "25 mm",
    "f_number": 1.4,
    "transmission": 0.85,
    "detector": {
        "quantum_efficiency": 0.4,
        "full_well_e": 40000,
        "gain_e_dn": 10,
        "bits": 12,
    },
}


def optics(**camera: object) -> Optics:
    return Optics.from_camera(CameraConfig.model_validate(CAMERA | camera))


def rays(count: int, half_angle_deg: float, seed: int) -> np.ndarray:
    tangent = np.random.default_rng(seed).uniform(-1, 1, (count, 2)) * np.tan(
        np.radians(half_angle_deg)
    )
    return np.column_stack([tangent, np.ones(count)])


def matrix(lens: Optics) -> np.ndarray:
    """OpenCV's camera matrix."""
    focal = lens.camera.focal_px
    (x, y) = lens.camera.center_px
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])


# The worst of these folds at r = .71; the rays below end at .66.
small = st.floats(-0.3, 0.3, allow_subnormal=False)


@settings(max_examples=50, derandomize=True, deadline=None)
@given(st.tuples(small, small, st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), small))
def test_distortion_matches_opencv(distortion: tuple[float, ...]) -> None:
    lens = optics(distortion=list(distortion), principal_point_px=[300.0, 250.0])
    vectors = rays(100, 25, 1)
    wanted, _ = cv2.projectPoints(
        vectors, np.zeros(3), np.zeros(3), matrix(lens), np.array(distortion)
    )
    # Rounding of 1e3 px.
    np.testing.assert_allclose(lens.project(vectors), wanted[:, 0], rtol=0, atol=1e-9)


def test_a_distortion_too_small_to_matter_does_no_harm() -> None:
    lens = optics(distortion=[0, 0, 0, 0, 1e-320])
    vectors = rays(100, 25, 1)
    np.testing.assert_allclose(
        lens.project(vectors), optics().project(vectors), rtol=0, atol=1e-9
    )


def test_the_boresight_is_the_chip_s_center_by_default() -> None:
    boresight = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(optics().project(boresight), [329, 246], rtol=0, atol=1e-12)
    moved = optics(principal_point_px=[12.5, 400.0])
    np.testing.assert_allclose(moved.project(boresight), [12.5, 400.0], rtol=0, atol=1e-12)


def test_right_is_plus_x_and_down_is_plus_y() -> None:
    # tan(1 deg) x 25 mm / 9.9 um = 44.078 px.
    tangent = np.tan(np.radians(1.0))
    right, below = optics().project(np.array([[tangent, 0, 1.0], [0, tangent, 1.0]])) - [
        329,
        246,
    ]
    np.testing.assert_allclose(right, [44.078, 0], rtol=0, atol=5e-4)
    np.testing.assert_allclose(below, [0, 44.078], rtol=0, atol=5e-4)


def test_a_vector_s_length_does_not_matter_and_what_is_behind_has_no_pixel() -> None:
    vectors = rays(10, 10, 2)
    np.testing.assert_allclose(
        optics().project(7 * vectors), optics().project(vectors), rtol=0, atol=1e-10
    )
    assert np.isnan(optics().project(-vectors)).all()


# Distortion that turns back


def test_beyond_the_fold_of_barrel_distortion_there_is_no_image() -> None:
    """r (1 - .3 r^2) grows up to 1 - .9 r^2 = 0, r = 1.0541; beyond, OpenCV's formula would fold the sky back in."""
    lens = optics(distortion=[-0.3, 0, 0, 0, 0])
    assert lens.fold_r == pytest.approx(np.sqrt(1 / 0.9), rel=1e-12)
    r = np.linspace(0, 3, 3001)
    x = lens.project(np.column_stack([r, 0 * r, 0 * r + 1]))[:, 0]
    inside = r < np.sqrt(1 / 0.9)
    assert (np.diff(x[inside]) > 0).all()
    assert np.isnan(x[~inside]).all()
    reach = lens.camera.focal_px * np.sqrt(1 / 0.9) * (1 - 0.3 / 0.9)
    assert np.nanmax(x) - lens.camera.center_px[0] == pytest.approx(reach, rel=1e-6)


@pytest.mark.parametrize(
    "distortion",
    [
        (-0.3, 0.0, 0.0, 0.0, 0.0),
        (-0.3, 0.0, 0.01, -0.02, 0.0),
        (0.1, -0.2, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, -0.05),
        (-0.5, 0.05, 0.0, 0.0, 0.01),  # turns back, and then on again
        (0.3, 0.1, 0.0, 0.0, 0.1),
        (-0.3, 0.3, 0.0, 0.0, 0.0),
        (0.0,) * 5,
    ],
)
def test_the_fold_is_where_the_image_stops_growing(distortion: tuple[float, ...]) -> None:
    """The fold is found by stepping outward."""
    k1, k2, _, _, k3 = distortion
    r = np.linspace(0, 10, 1_000_001)
    shrinks = np.diff(r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)) < 0
    walked = r[shrinks.argmax()] if shrinks.any() else np.inf
    assert fold_r(distortion) == pytest.approx(walked, abs=2e-5)


# Sizes


def test_field_of_view_and_diagonal_match_the_reference() -> None:
    # Reference H1: 14.868 x 11.150 degrees over the whole chip, true diagonal 18.51.
    lens = optics()
    assert np.degrees(2 * np.arctan(659 / 2 / lens.camera.focal_px)) == pytest.approx(
        14.868, abs=0.001
    )
    assert np.degrees(2 * np.arctan(493 / 2 / lens.camera.focal_px)) == pytest.approx(
        11.150, abs=0.001
    )
    assert np.degrees(2 * lens.field_rad) == pytest.approx(18.51, abs=0.01)


def test_the_field_reaches_the_farthest_corner_of_a_shifted_chip() -> None:
    shifted = optics(principal_point_px=[100.0, 400.0])
    corner = np.array([658.5 - 100, 400.5, shifted.camera.focal_px])
    # Linear between 4,001 tangents: its curvature is not seen.
    assert shifted.field_rad == pytest.approx(
        np.arccos(corner[2] / np.linalg.norm(corner)), abs=1e-9
    )


@pytest.mark.parametrize("k1", [-0.3, -0.1, 0.2, 0.5])
def test_the_field_undoes_distortion(k1: float) -> None:
    """OpenCV projects the direction at this angle toward the farthest corner onto that corner."""
    lens = optics(
        focal_length="7 mm", distortion=[k1, 0, 0, 0, 0], principal_point_px=[300.0, 250.0]
    )
    corner = np.array([658.5, -0.5])
    aside = (
        (corner - [300.0, 250.0])
        / np.hypot(*(corner - [300.0, 250.0]))
        * np.tan(lens.field_rad)
    )
    edge = np.array([[*aside, 1.0]])
    found, _ = cv2.projectPoints(
        edge, np.zeros(3), np.zeros(3), matrix(lens), np.array([k1, 0, 0, 0, 0.0])
    )
    # A table of 4,001 rows, linear between.
    np.testing.assert_allclose(found[0, 0], corner, rtol=0, atol=2e-3)


def test_a_field_that_ends_before_the_corner_ends_at_the_fold() -> None:
    """At 3 mm the corner is at a distorted radius of 1.36, and the image reaches to .70 only."""
    assert optics(
        focal_length="3 mm", distortion=[-0.3, 0, 0, 0, 0]
    ).field_rad == pytest.approx(np.arctan(np.sqrt(1 / 0.9)), abs=1e-12)


@pytest.mark.parametrize(
    "distortion", [[0, 0, 0, 0, 0], [-0.3, 0.1, 0, 0, 0], [0.3, 0, 0, 0, 0]]
)
def test_the_field_is_never_too_small(distortion: list[float]) -> None:
    """Every imaged direction is within the field."""
    lens = optics(
        focal_length="8 mm", principal_point_px=[500.0, 100.0], distortion=distortion
    )
    vectors = rays(5000, 50, 3)
    xy = lens.project(vectors)
    on_chip = np.all((xy >= -0.5) & (xy <= [658.5, 492.5]), axis=1)
    angle = np.arccos(1 / np.linalg.norm(vectors, axis=1))
    assert on_chip.sum() > 100
    assert angle[on_chip].max() < lens.field_rad


# Focus


def test_a_lens_focused_nearby_is_farther_from_its_chip() -> None:
    """Reference §1.2: 35 mm at 33 in is 36.53 mm, and 6.4 mm of chip see 10.01 deg in place of 10.45."""
    afit = {"width_px": 1600, "height_px": 1200, "pixel": "4 um", "focal_length": "35 mm"}
    near = optics(**afit, focus="33 in")
    far = optics(**afit)
    assert near.camera.image_distance_m == pytest.approx(36.53e-3, abs=5e-6)
    assert far.camera.image_distance_m == pytest.approx(35e-3, rel=1e-15)
    fields = [np.degrees(2 * np.arctan(800 / lens.camera.focal_px)) for lens in (near, far)]
    assert fields == pytest.approx([10.01, 10.45], abs=5e-3)
    # The pupil is the lens's own and stays.
    assert near.collecting_m2 == far.collecting_m2


@pytest.mark.parametrize("focus_m", [0.1, 0.5, 3.0, 1e4])
def test_focus_obeys_newton_s_law(focus_m: float) -> None:
    """(u - f)(v - f) = f^2, and an object of height h in focus has an image of h v / u."""
    lens = optics(focus=f"{focus_m} m")
    image_m = lens.camera.image_distance_m
    assert (focus_m - 0.025) * (image_m - 0.025) == pytest.approx(0.025**2, rel=1e-9)
    x, _ = lens.project(np.array([0.01, 0, focus_m])) - lens.camera.center_px
    assert x * 9.9e-6 == pytest.approx(0.01 * image_m / focus_m, rel=1e-12)


# Light


def test_the_pupil_collects_its_area_times_the_transmission() -> None:
    assert optics().collecting_m2 == pytest.approx(
        np.pi / 4 * (0.025 / 1.4) ** 2 * 0.85, rel=1e-14
    )


def test_a_point_s_light_falls_with_the_pupil_s_foreshortening() -> None:
    """It does not fall with cos^4, the law of an extended source."""
    angle = np.radians([0, 30, 60, 89, 90, 91, 180])
    wanted = [1, np.sqrt(0.75), 0.5, np.cos(np.radians(89)), 0, 0, 0]
    np.testing.assert_allclose(optics().throughput(np.cos(angle)), wanted, rtol=0, atol=1e-15)


def traced(field_rad: float, cutoff_rad: float) -> float:
    """Share of the rays through a round stop, one grid of them, that pass an equal one straight behind it.

    The second stands where rays at the cutoff have just walked a whole diameter aside.
    """
    x, y = np.meshgrid(*[(np.arange(2000) + 0.5) / 1000 - 1] * 2)
    first = x**2 + y**2 < 1
    behind = 2 / np.tan(cutoff_rad)
    second = (x + behind * np.tan(field_rad)) ** 2 + y**2 < 1
    return float(np.mean(second[first]))


@pytest.mark.slow
@pytest.mark.parametrize("cutoff_deg", [8.0, 30.0, 75.0])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_two_stops_pass_the_rays_that_fit_through_both(
    share: float, cutoff_deg: float
) -> None:
    field = np.arctan(share * np.tan(np.radians(cutoff_deg)))
    lens = optics(vignetting={"kind": "two_stops", "cutoff_deg": cutoff_deg})
    throughput = lens.throughput(np.cos(field)) / np.cos(field)
    # 3.1 million rays; the rim's coarseness is worth a thousandth of a diameter.
    assert throughput == pytest.approx(traced(field, np.radians(cutoff_deg)), abs=5e-4)


def test_vignetting_by_two_stops_matches_a_hand_calculation() -> None:
    """Disks a radius apart overlap by 2 / 3 - sqrt(3) / (2 pi) = .3910 of a disk; a whole diameter apart by nothing."""
    lens = optics(vignetting={"kind": "two_stops", "cutoff_deg": 45})
    field = np.array([0, np.arctan(0.5), np.pi / 4, 1.5, np.pi / 2, 3.0])
    wanted = [1, np.cos(field[1]) * (2 / 3 - np.sqrt(3) / (2 * np.pi)), 0, 0, 0, 0]
    np.testing.assert_allclose(lens.throughput(np.cos(field)), wanted, rtol=0, atol=1e-12)


def test_vignetting_starts_with_the_slope_of_two_circles() -> None:
    """Near the axis a displacement of u diameters cuts off two lunes, 4 u / pi of the disk."""
    config = optics(vignetting={"kind": "two_stops", "cutoff_deg": 45}).camera.vignetting
    u = 1e-4
    lost = 1 - VIGNETTING["two_stops"](config, np.array([np.arctan(u)]))[0]
    assert lost == pytest.approx(4 * u / np.pi, rel=1e-6)


def test_a_table_of_transmission_is_linear_between_its_angles_and_level_beyond() -> None:
    measured = {"kind": "table", "angle_deg": [0, 5, 10], "transmission": [1.0, 0.9, 0.5]}
    angle_deg = np.array([0, 2, 5, 9, 10, 40])
    cosine = np.cos(np.radians(angle_deg))
    throughput = optics(vignetting=measured).throughput(cosine) / cosine
    np.testing.assert_allclose(throughput, [1, 0.96, 0.9, 0.58, 0.5, 0.5], rtol=0, atol=1e-12)


def test_a_star_s_electrons_are_scaled_by_vignetting() -> None:
    """Rendered at 10 deg off axis, the ratio to the axis is the product of cosine and vignetting."""
    lens = optics(vignetting={"kind": "two_stops", "cutoff_deg": 40}, focal_length="15 mm")
    angle = np.radians([0.0, 8.0])
    place = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle), 0 * angle])
    id = np.arange(2)
    one = np.ones(2)
    zero = np.zeros(2)
    stars = Sources(
        id,
        place,
        np.zeros((2, 3)),
        zero,
        1e8 * one,
        one,
        zero,
        one,
        0 * id,
        np.full(2, np.nan),
    )
    still = Trajectory(np.array([0.0, 1.0]), Rotation.identity(2), np.zeros((2, 3)))
    image = np.zeros((493, 659))
    seen = render(
        image, stars, lens, still, Mount(np.zeros(3), Rotation.identity()), Window(0.0, 0.5)
    )
    wanted = (
        np.cos(angle) * [1, traced(angle[1], np.radians(40))] * lens.collecting_m2 * 0.5e8
    )
    np.testing.assert_allclose(seen.electrons, wanted, rtol=1e-3, atol=0)
