"""Laws of errors that all lights of a frame share, and of a least-squares rotation's response to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from estimator.attitude import rotation_fit, systematic
from estimator.attitude.dome_map import LedMap, Lever, led_sigma_rad
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.vectors import normalized
from tests.helpers.laws import SEEDS, assert_covariance, law, turn, units

FOCAL_SIGMA = 2e-3
CAMERA = Camera(1000, 800, 2000.0, (510.0, 380.0), focal_sigma=FOCAL_SIGMA)
COUNT = 6


def places(rng: np.random.Generator, count: int = COUNT) -> tuple[Floats, Floats]:
    """(K, 3) LEDs from the bearing and from the pupil, m, in camera axes and in the camera's field."""
    rays = np.column_stack(
        [rng.uniform(-0.2, 0.2, (count, 2)), np.ones(count)]
    ) * rng.uniform(0.8, 1.5, (count, 1))
    return rays + np.array([*rng.normal(0, 0.02, 2), 0.3]), rays


def tangents(vectors: Floats) -> Floats:
    return vectors[:, :2] / vectors[:, 2:]


def sigmas(rng: np.random.Generator, count: int = COUNT) -> Floats:
    return rng.uniform(1e-5, 1e-4, count)


def covariances(rng: np.random.Generator, size: int, count: int = COUNT) -> Floats:
    """(K, S, S) of any shape, of about 1e-5 rad."""
    root = rng.normal(0, 1e-5, (count, size, size))
    return root @ np.moveaxis(root, 1, 2)


@law(rotation_fit.tangent_gradients, rotation_fit.tangent_jacobian, systematic.geometry)
@given(rng=SEEDS)
def test_changes_of_tangents_match_their_derivatives(rng: np.random.Generator) -> None:
    bearing, pupil = places(rng)
    # The second order is 3e-11 for a step of four deviations.
    step_m = rng.normal(0, 1e-6, pupil.shape)
    turned_rad = rng.normal(0, 1e-6, 3)
    view = systematic.geometry(bearing, pupil)
    assert_allclose(view.tangent, tangents(pupil), rtol=0, atol=1e-15)
    gradient = rotation_fit.tangent_gradients(pupil)
    moved = tangents(pupil + step_m) - view.tangent
    assert_allclose(np.einsum("kij,kj->ki", gradient, step_m), moved, rtol=0, atol=1e-10)
    # Along the ray nothing changes.
    assert_allclose(np.einsum("kij,kj->ki", gradient, pupil), 0, rtol=0, atol=1e-14)
    jacobian = rotation_fit.tangent_jacobian(bearing, pupil)
    rotated = (
        tangents(pupil + Rotation.from_rotvec(turned_rad).apply(bearing) - bearing)
        - view.tangent
    )
    assert_allclose((jacobian @ turned_rad).reshape(-1, 2), rotated, rtol=0, atol=1e-10)
    assert_allclose(view.jacobian.reshape(-1, 3), jacobian, rtol=0, atol=0)
    assert_allclose(view.gradient, gradient, rtol=0, atol=0)


@law(systematic.response, systematic.from_common, systematic.residual_products)
@given(rng=SEEDS)
def test_a_rotation_is_found_and_leaves_no_residual(rng: np.random.Generator) -> None:
    view = systematic.geometry(*places(rng))
    sigma = sigmas(rng)
    turned_rad = rng.normal(0, 1e-4, 3)
    change = view.jacobian @ turned_rad
    found = np.einsum("kai,ki->a", systematic.response(view, sigma), change)
    assert_allclose(found, turned_rad, rtol=0, atol=1e-15)
    covariance = systematic.from_common(view, sigma, change[None])
    assert_allclose(covariance, np.outer(turned_rad, turned_rad), rtol=0, atol=1e-18)
    other = rng.normal(0, 1e-5, (2, COUNT, 2))
    products = systematic.residual_products(
        view, sigma, np.concatenate([change[None], other])
    )
    assert_allclose(
        products[0], 0, rtol=0, atol=1e-10 * np.abs(change / sigma[:, None]).sum() ** 2
    )
    assert_covariance(products)
    # A fit adds no residual.
    assert (np.diag(products)[1:] <= ((other / sigma[:, None]) ** 2).sum(axis=(1, 2))).all()


@law(systematic.with_focal)
@given(rng=SEEDS)
def test_a_fitted_focal_length_absorbs_a_change_of_scale_without_rotation(
    rng: np.random.Generator,
) -> None:
    """And the covariances with it are those of the inverse of the whole information, a rotation's block of it."""
    view = systematic.geometry(*places(rng))
    sigma = sigmas(rng)
    joint = systematic.with_focal(view)
    scaled = 1e-3 * view.tangent
    answer = np.einsum("kai,ki->a", systematic.response(joint, sigma), scaled)
    assert_allclose(answer, [0, 0, 0, 1e-3], rtol=0, atol=1e-9)
    assert_allclose(
        systematic.residual_products(joint, sigma, scaled[None]), 0, rtol=0, atol=1e-9
    )
    weighted = (joint.jacobian / sigma[:, None, None]).reshape(-1, 4)
    wanted = np.linalg.inv(weighted.T @ weighted)
    errors = systematic.isotropic(sigma)
    found = systematic.from_independent(joint, sigma, errors)
    assert_allclose(found, wanted, rtol=1e-6, atol=1e-12)
    plain = systematic.from_independent(view, sigma, errors)
    total, part = systematic.with_survey(
        plain, view, sigma, 0 * errors, errors, scaled[None], True
    )
    assert_allclose(total, wanted[:3, :3], rtol=1e-6, atol=1e-12)
    assert_allclose(part, total, rtol=1e-9)


@law(systematic.isotropic, systematic.from_independent)
@given(rng=SEEDS)
def test_the_weights_own_errors_have_the_inverse_of_the_information(
    rng: np.random.Generator,
) -> None:
    view = systematic.geometry(*places(rng))
    sigma = sigmas(rng)
    errors = systematic.isotropic(sigma)
    assert_allclose(errors[:, 0, 0], sigma**2, rtol=1e-12, atol=0)
    assert_allclose(errors[:, 0, 1], 0, rtol=0, atol=0)
    ours = systematic.from_independent(view, sigma, errors)
    jacobian = (view.jacobian / sigma[:, None, None]).reshape(-1, 3)
    assert_allclose(ours @ (jacobian.T @ jacobian), np.eye(3), rtol=0, atol=1e-7)
    assert_covariance(systematic.from_independent(view, sigma, covariances(rng, 2)))


@law(systematic.with_survey)
@given(rng=SEEDS)
def test_without_survey_errors_the_covariance_equals_the_solver_s(
    rng: np.random.Generator,
) -> None:
    view = systematic.geometry(*places(rng))
    sigma = sigmas(rng)
    solver = (
        systematic.from_independent(view, sigma, systematic.isotropic(sigma))
        + covariances(rng, 3)[0]
    )
    nothing = np.zeros((COUNT, 2, 2))
    total, part = systematic.with_survey(
        solver, view, sigma, systematic.isotropic(sigma), nothing, np.empty((0, COUNT, 2))
    )
    assert_allclose(total, solver, rtol=0, atol=1e-7 * np.abs(solver).max())
    assert_allclose(part, 0, rtol=0, atol=0)
    own = covariances(rng, 2)
    common = rng.normal(0, 1e-5, (2, COUNT, 2))
    total, part = systematic.with_survey(
        solver, view, sigma, systematic.isotropic(sigma), own, common
    )
    assert_covariance(part)
    assert_allclose(total - part, solver, rtol=0, atol=1e-7 * np.abs(total).max())


@law(systematic.focal_error_px, systematic.with_focal_error, systematic.focal_error_rad)
@given(rng=SEEDS)
def test_a_focal_length_s_error_grows_from_the_principal_point(
    rng: np.random.Generator,
) -> None:
    xy_px = rng.uniform(0, [999, 799], (COUNT, 2))
    rays = CAMERA.rays(xy_px)
    sigma = sigmas(rng)
    longer = replace(CAMERA, focal_px=CAMERA.focal_px * (1 + FOCAL_SIGMA))
    moved_px = np.linalg.norm(longer.pixels(rays) - xy_px, axis=1)
    assert_allclose(systematic.focal_error_px(CAMERA, xy_px), moved_px, rtol=1e-9, atol=1e-9)
    per_axis = systematic.focal_error_rad(rays, CAMERA)
    assert_allclose(per_axis * CAMERA.focal_px * np.sqrt(2), moved_px, rtol=1e-9, atol=1e-9)
    view = systematic.geometry(rays, rays)
    noisy = np.hypot(sigma, systematic.focal_error_px(CAMERA, xy_px) / CAMERA.focal_px)
    claimed = systematic.from_independent(view, noisy, systematic.isotropic(noisy))
    noise_px2 = (sigma * CAMERA.focal_px) ** 2
    total, part = systematic.with_focal_error(claimed, CAMERA, rays, noisy, noise_px2)
    assert_covariance(part)
    assert_covariance(total - part)


@law(led_sigma_rad, LedMap.radius_m, Lever.pupil_cam_m, Lever.body_from_cam, normalized)
@given(rng=SEEDS)
def test_isotropic_led_errors_on_a_sphere_are_angles_from_the_camera(
    rng: np.random.Generator,
) -> None:
    """An error along the line from the bearing moves no direction. The least distance is the radius less the lever."""
    along = units(rng, COUNT)
    sigma_m = rng.uniform(1e-4, 1e-3)
    leds = LedMap(
        np.arange(COUNT), 1.2 * along, np.zeros(3), np.full(3, 1.2), sigma_m=sigma_m
    )
    assert_allclose(leds.radius_m, 1.2, rtol=1e-14)
    assert_allclose(normalized(leds.position_m), along, rtol=0, atol=1e-15)
    arm = Lever(np.array([0, 0, rng.uniform(0, 0.4)]), turn(rng))
    axis_cam = arm.cam_from_body.as_matrix()[:, 2]
    assert_allclose(arm.pupil_cam_m, arm.camera_body_m[2] * axis_cam, rtol=0, atol=1e-15)
    assert (arm.body_from_cam * arm.cam_from_body).magnitude() < 1e-15
    expected = np.full(COUNT, sigma_m / (1.2 - arm.camera_body_m[2]))
    assert_allclose(led_sigma_rad(leds, arm), expected, rtol=1e-12, atol=0)
    radial = 1e-4 * np.einsum("ni,nj->nij", along, along)
    each = sigma_m**2 * np.tile(np.eye(3), (COUNT, 1, 1)) + radial
    assert_allclose(
        led_sigma_rad(replace(leds, covariance_m2=each), arm),
        expected,
        rtol=1e-9,
        atol=0,
    )
