"""Lights at a finite distance: surfaces by their equations, solves by truth and Monte Carlo."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude import dome_map, nearfield, rotation_fit
from estimator.attitude.dome_map import LedMap, Lever
from estimator.core.camera import Camera
from estimator.core.errors import ImageError

# AFIT's SimSat: 35 mm lens, 4 um pixels, camera 15 in above the bearing, apex at 48 in (reference 1.1, 5).
CAMERA = Camera(1600, 1200, 8750.0, (799.5, 599.5))
RADIUS_M = 1.2192
LEVER = Lever(np.array([0.0, 0.0, 0.381]), Rotation.identity())
ASKEW = Lever(np.array([0.02, -0.035, 0.37]), Rotation.from_euler("xyz", [0.03, -0.02, 0.7]))
SPHERE = (np.zeros(3), np.full(3, RADIUS_M))
MEASURED = (
    np.array([0.0, 0.003, 0.492]),
    np.array([0.9876, 0.9876, 0.7264]),
)  # 38.88 and 28.60 in


def leds_in_view(
    rng: np.random.Generator,
    body_from_lab: Rotation,
    lever: Lever,
    count: int,
    surface: tuple = SPHERE,
) -> LedMap:
    """Lights where rays through random pixels meet a surface."""
    leds = LedMap(np.arange(count), np.zeros((count, 3)), *surface)
    pixels = rng.uniform(0, [1599, 1199], (count, 2))
    lab_from_cam = (lever.cam_from_body * body_from_lab).inv()
    origin = body_from_lab.inv().apply(lever.camera_body_m)
    places = dome_map.on_surface(lab_from_cam.apply(CAMERA.rays(pixels)), origin, leds)
    return LedMap(leds.id, places, *surface)


def true_rays(body_from_lab: Rotation, leds: LedMap, lever: Lever) -> np.ndarray:
    rays = lever.cam_from_body.apply(
        body_from_lab.apply(leds.position_m) - lever.camera_body_m
    )
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def tilted(rng: np.random.Generator, tilt_rad: float) -> Rotation:
    about = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(about), np.sin(about), 0])
    return Rotation.from_rotvec(tilt_rad * axis) * Rotation.from_rotvec(
        [0, 0, rng.uniform(0, 2 * np.pi)]
    )


def nudged(rng: np.random.Generator, rotation: Rotation, by_rad: float) -> Rotation:
    axis = rng.normal(size=3)
    return Rotation.from_rotvec(by_rad * axis / np.linalg.norm(axis)) * rotation


def angle_rad(a: Rotation, b: Rotation) -> float:
    return (a * b.inv()).magnitude()


def test_the_pixel_of_a_light_matches_a_hand_calculation() -> None:
    # 1 m above a camera 0.4 m up, 50 mm along x and -20 mm along y: 1000 * .05 right, 1000 * .02 up.
    camera = Camera(640, 480, 1000.0, (320.0, 240.0))
    lever = Lever(np.array([0.0, 0.0, 0.4]), Rotation.identity())
    light = np.array([[0.05, -0.02, 1.4]])
    level = dome_map.project(Rotation.identity(), light, lever, camera)
    np.testing.assert_allclose(level, [[370, 220]], rtol=0, atol=1e-10)  # rounding
    # The vehicle's axes a quarter turn on: body x is where lab y was, so (x, y) becomes (y, -x).
    quarter = Rotation.from_matrix([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    yawed = dome_map.project(quarter, light, lever, camera)
    np.testing.assert_allclose(yawed, [[300, 190]], rtol=0, atol=1e-10)


def test_the_parallax_of_a_tilted_camera_matches_a_hand_calculation() -> None:
    # A light on the vertical at 1.4 m; the vehicle leans by t: in body axes it stands at 1.4 (0, sin t, cos t).
    camera = Camera(640, 480, 1000.0, (320.0, 240.0))
    lever = Lever(np.array([0.0, 0.0, 0.4]), Rotation.identity())
    body_from_lab = Rotation.from_rotvec([-0.1, 0, 0])
    pixel = dome_map.project(body_from_lab, np.array([[0, 0, 1.4]]), lever, camera)
    y = 240 + 1000 * 1.4 * np.sin(0.1) / (1.4 * np.cos(0.1) - 0.4)
    np.testing.assert_allclose(pixel, [[320, y]], rtol=0, atol=1e-10)  # rounding


def test_a_light_behind_the_camera_has_no_pixel() -> None:
    below = dome_map.project(Rotation.identity(), np.array([[0, 0, 0.3]]), LEVER, CAMERA)
    assert np.isnan(below).all()


def test_points_on_a_sphere_lie_on_it_and_on_their_rays() -> None:
    rng = np.random.default_rng(50)
    rays = rng.normal(size=(500, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    camera = np.array([0.2, -0.3, 0.6])
    points = dome_map.on_sphere(rays, camera, RADIUS_M)
    # 1e-15: rounding of meters.
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), RADIUS_M, rtol=0, atol=2e-15)
    np.testing.assert_allclose(np.cross(points - camera, rays), 0, rtol=0, atol=2e-15)
    assert np.sum((points - camera) * rays, axis=1).min() > 0


def test_a_camera_outside_its_sphere_is_refused() -> None:
    with pytest.raises(
        ValueError,
        match=r"camera 1\.3 m from the bearing; allowed: inside the sphere of 1\.2 m",
    ):
        dome_map.on_sphere(np.array([[0.0, 0, 1]]), np.array([1.3, 0, 0]), 1.2)


def test_points_on_an_ellipsoid_satisfy_its_equation_and_lie_on_their_rays() -> None:
    rng = np.random.default_rng(51)
    rays = rng.normal(size=(500, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = np.array([0.1, 0.05, 0.38])
    center, axes = MEASURED
    points = dome_map.on_surface(
        rays, origin, LedMap(np.arange(0), np.zeros((0, 3)), center, axes)
    )
    # 1e-14: rounding of a quadratic's root.
    np.testing.assert_allclose(
        np.sum(((points - center) / axes) ** 2, axis=1), 1, rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(np.cross(points - origin, rays), 0, rtol=0, atol=1e-14)
    assert np.sum((points - origin) * rays, axis=1).min() > 0


def test_a_sphere_is_an_ellipsoid_of_equal_axes() -> None:
    rng = np.random.default_rng(52)
    rays = CAMERA.rays(rng.uniform(0, [1599, 1199], (100, 2)))
    round_leds = LedMap(np.arange(0), np.zeros((0, 3)), *SPHERE)
    # 1e-14: rounding.
    np.testing.assert_allclose(
        dome_map.on_surface(rays, LEVER.camera_body_m, round_leds),
        dome_map.on_sphere(rays, LEVER.camera_body_m, RADIUS_M),
        rtol=0,
        atol=1e-14,
    )


def test_infinite_semi_axes_are_a_ceiling() -> None:
    rays = np.array([[0.6, 0, 0.8], [0, 0, 1]])
    flat = LedMap(
        np.arange(0), np.zeros((0, 3)), np.zeros(3), np.array([np.inf, np.inf, 1.2])
    )
    met = dome_map.on_surface(rays, np.array([0.1, 0, 0.4]), flat)
    # 0.8 m up along (.6, .8) is 0.6 m across, by hand.
    np.testing.assert_allclose(met, [[0.7, 0, 1.2], [0.1, 0, 1.2]], rtol=0, atol=1e-15)


def test_a_ray_that_misses_has_no_point() -> None:
    beside = LedMap(np.arange(0), np.zeros((0, 3)), np.array([5.0, 0, 0]), np.ones(3))
    assert np.isnan(dome_map.on_surface(np.array([[0.0, 0, 1]]), np.zeros(3), beside)).all()


@pytest.mark.parametrize("lever", [LEVER, ASKEW])
def test_the_jacobian_is_the_derivative_of_the_projection(lever: Lever) -> None:
    rng = np.random.default_rng(53)
    truth = tilted(rng, 0.4)
    step = 1e-6
    leds = leds_in_view(rng, truth, lever, 6)
    unit_camera = Camera(2, 2, 1.0, (0.0, 0.0))
    cam_from_body = lever.cam_from_body

    def tangents(w: np.ndarray) -> np.ndarray:
        rotated = cam_from_body.inv() * Rotation.from_rotvec(w) * cam_from_body * truth
        return dome_map.project(rotated, leds.position_m, lever, unit_camera).ravel()

    slopes = [(tangents(step * e) - tangents(-step * e)) / (2 * step) for e in np.eye(3)]
    b = cam_from_body.apply(truth.apply(leds.position_m))
    jacobian = rotation_fit.tangent_jacobian(b, b - cam_from_body.apply(lever.camera_body_m))
    # 1e-9: rounding of 1e-16 over a step of 1e-6, and the step's square.
    np.testing.assert_allclose(jacobian, np.transpose(slopes), rtol=0, atol=1e-9)


@pytest.mark.compiles
@pytest.mark.parametrize("surface", [SPHERE, MEASURED], ids=["sphere", "ellipsoid"])
@pytest.mark.parametrize("lever", [LEVER, ASKEW], ids=["axial", "askew"])
@pytest.mark.parametrize("count", [2, 5, 20])
def test_the_exact_solve_is_exact_from_five_degrees_off(
    count: int, lever: Lever, surface: tuple
) -> None:
    rng = np.random.default_rng(54)
    for _ in range(30):
        truth = tilted(rng, np.radians(30))
        leds = leds_in_view(rng, truth, lever, count, surface)
        found, _ = rotation_fit.rotation_only(
            true_rays(truth, leds, lever),
            np.full(count, 1e-5),
            leds.position_m,
            leds,
            lever,
            nudged(rng, truth, np.radians(5)),
        )
        separation_m = np.linalg.norm(leds.position_m[0] - leds.position_m[1:], axis=1).max()
        # 1e-13 rad (reference 5: 1e-14 degree): rounding over the pattern's size, 0.2 m but for pairs by chance.
        assert angle_rad(found, truth) < 1e-13 / min(separation_m / 0.1, 1)


def monte_carlo(
    lever: Lever, count: int, surface: tuple, seed: int, trials: int
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (trials, 3) in body axes and the covariances claimed, for centroids of 0.1 px."""
    rng = np.random.default_rng(seed)
    errors = []
    claimed = []
    for _ in range(trials):
        truth = tilted(rng, np.radians(15))
        leds = leds_in_view(rng, truth, lever, count, surface)
        pixels = dome_map.project(truth, leds.position_m, lever, CAMERA) + rng.normal(
            0, 0.1, (count, 2)
        )
        found, spread = rotation_fit.rotation_only(
            CAMERA.rays(pixels),
            np.full(count, 0.1 / CAMERA.focal_px),
            leds.position_m,
            leds,
            lever,
            nudged(rng, truth, 0.01),
        )
        errors.append((found * truth.inv()).as_rotvec())
        claimed.append(spread)
    return np.array(errors), np.array(claimed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lever", "surface"),
    [
        pytest.param(LEVER, SPHERE, marks=pytest.mark.long),
        pytest.param(LEVER, MEASURED, marks=pytest.mark.long),
        pytest.param(ASKEW, SPHERE, marks=pytest.mark.long),
        (ASKEW, MEASURED),
    ],
)
def test_the_covariance_matches_the_scatter(lever: Lever, surface: tuple) -> None:
    errors, claimed = monte_carlo(lever, 5, surface, seed=55, trials=600)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(claimed), errors)
    # Chi-square of three degrees: mean 3, deviation sqrt(6 / 600) = 0.1; three of them.
    assert nees.mean() == pytest.approx(3, abs=0.3)


@pytest.mark.long
def test_five_lights_have_the_reference_s_error() -> None:
    errors, _ = monte_carlo(LEVER, 5, SPHERE, seed=56, trials=1000)
    cross = np.degrees(np.sqrt(np.mean(errors[:, 0] ** 2 + errors[:, 1] ** 2)))
    roll = np.degrees(np.sqrt(np.mean(errors[:, 2] ** 2)))
    # Reference section 5, table: .0003 (.005) degree; a figure of one digit stands for a band of its half;
    # 1,000 trials give roll to 2.2 %.
    assert 0.00025 < cross < 0.00035
    assert 0.0045 < roll < 0.0055 * (1 + 3 * 0.022)
    # And its formula: an axis has sigma (R - M) / (R sqrt N), as Liebe's law 8 to 14 % low for five (section 3).
    axis = np.degrees(0.1 / 8750) * (RADIUS_M - 0.381) / RADIUS_M / np.sqrt(5)
    assert 1.0 < cross / np.sqrt(2) / axis < 1.17


@pytest.mark.compiles
@pytest.mark.parametrize("lever", [LEVER, ASKEW], ids=["axial", "askew"])
def test_rays_on_the_surface_find_the_truth_on_a_centered_sphere(lever: Lever) -> None:
    rng = np.random.default_rng(57)
    for _ in range(30):
        truth = tilted(rng, np.radians(25))
        leds = leds_in_view(rng, truth, lever, 5)
        found, _ = nearfield.ray_on_surface(
            true_rays(truth, leds, lever),
            np.full(5, 1e-5),
            leds.position_m,
            leds,
            lever,
            nudged(rng, truth, np.radians(5)),
        )
        # Rounding over directions 0.1 rad apart.
        assert angle_rad(found, truth) < 1e-12


def test_rays_on_the_true_ellipsoid_find_the_truth_too() -> None:
    rng = np.random.default_rng(58)
    for _ in range(30):
        truth = tilted(rng, np.radians(10))
        leds = leds_in_view(rng, truth, LEVER, 6, MEASURED)
        found, _ = nearfield.ray_on_surface(
            true_rays(truth, leds, LEVER),
            np.full(6, 1e-5),
            leds.position_m,
            leds,
            LEVER,
            nudged(rng, truth, np.radians(1)),
        )
        # It converges linearly and stops at steps of 1e-13 rad or after twenty.
        assert angle_rad(found, truth) < 1e-9


def test_rays_on_a_sphere_instead_of_an_ellipsoid_err_by_the_surface_difference() -> None:
    # Reference section 5, "ray-sphere corrected" on the ellipsoid: .003 degree at 30; the exact solve has none.
    rng = np.random.default_rng(59)
    errors = []
    for _ in range(100):
        truth = tilted(rng, np.radians(30))
        real = leds_in_view(rng, truth, LEVER, 5, MEASURED)
        leds = LedMap(real.id, real.position_m, *SPHERE)
        found, _ = nearfield.ray_on_surface(
            true_rays(truth, real, LEVER),
            np.full(5, 1e-5),
            real.position_m,
            leds,
            LEVER,
            truth,
        )
        errors.append(angle_rad(found, truth))
    rms_deg = np.degrees(np.sqrt(np.mean(np.square(errors))))
    assert 0.0005 < rms_deg < 0.02


@pytest.mark.parametrize("lever", [LEVER, ASKEW], ids=["axial", "askew"])
@pytest.mark.parametrize("count", [1, 3])
def test_one_light_seen_repeatedly_leaves_one_rotation_undetermined(
    count: int, lever: Lever
) -> None:
    leds = LedMap(np.arange(count), np.tile([0.1, 0.05, 1.19], (count, 1)), *SPHERE)
    truth = Rotation.from_rotvec([0.1, 0.05, 0.3])
    with pytest.raises(ValueError, match=f"{count} rays do not determine a rotation"):
        rotation_fit.rotation_only(
            true_rays(truth, leds, lever),
            np.full(count, 1e-5),
            leds.position_m,
            leds,
            lever,
            truth,
        )


def test_lights_that_contradict_the_rays_are_refused() -> None:
    # Lights on opposite sides of the dome and rays all about the boresight: no rotation brings them together.
    rng = np.random.default_rng(60)
    places = RADIUS_M * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0.1]])
    leds = LedMap(np.arange(4), places, *SPHERE)
    with pytest.raises(ValueError, match="rotation_only: not converged"):
        rotation_fit.rotation_only(
            CAMERA.rays(rng.uniform(0, [1599, 1199], (4, 2))),
            np.full(4, 1e-5),
            places,
            leds,
            LEVER,
            Rotation.from_rotvec([0.3, 0.2, 0]),
        )


def test_a_camera_beyond_the_nearest_light_is_refused() -> None:
    leds = LedMap(np.arange(2), np.array([[0.0, 0, 0.35], [0, 0, 1.2]]), *SPHERE)
    with pytest.raises(
        ImageError,
        match=r"0\.381 m from the bearing; allowed: less than the nearest LED's 0\.350 m",
    ):
        dome_map.check_lever(leds, LEVER)
    dome_map.check_lever(LedMap(leds.id[1:], leds.position_m[1:], *SPHERE), LEVER)
