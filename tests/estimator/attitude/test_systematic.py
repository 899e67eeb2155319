"""Covariance of an attitude from survey errors, against Monte Carlo of the solution itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude import systematic
from estimator.attitude.dome_map import LedMap, Lever
from estimator.attitude.rotation_fit import rotation_only
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker

CAMERA = Camera(1600, 1200, 9000.0, (799.5, 599.5))
LEVER = Lever(np.array([0.01, -0.02, 0.38]), Rotation.from_euler("z", 30, degrees=True))
TRUTH = Rotation.from_euler("xyz", [4, -7, 20], degrees=True)  # body_from_lab
SURFACE = np.zeros(3), np.full(3, 1.2)


def leds_in_view(count: int, seed: int) -> Floats:
    """(N, 3) LEDs on a sphere of 1.2 m that the camera sees, m in the lab."""
    rng = np.random.default_rng(seed)
    tangent = rng.uniform(-1, 1, (count, 2)) * [0.085, 0.062]
    rays = LEVER.cam_from_body.inv().apply(np.column_stack([tangent, np.ones(count)]))
    along = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    b = along @ LEVER.camera_body_m
    c = LEVER.camera_body_m @ LEVER.camera_body_m - 1.2**2
    return TRUTH.inv().apply(LEVER.camera_body_m + (-b + np.sqrt(b**2 - c))[:, None] * along)


def seen(position_m: Floats) -> Floats:
    """(N, 3) LEDs from the pupil, in camera axes."""
    return LEVER.cam_from_body.apply(TRUTH.apply(position_m) - LEVER.camera_body_m)


def solved(rays: Floats, sigma_rad: Floats, position_m: Floats) -> Floats:
    """(3,) error of the rotation in camera axes, solved from rays and the map's places."""
    found, _ = rotation_only(
        rays,
        sigma_rad,
        position_m,
        LedMap(np.arange(len(rays)), position_m, *SURFACE),
        LEVER,
        TRUTH,
    )
    return (LEVER.cam_from_body * found * TRUTH.inv() * LEVER.cam_from_body.inv()).as_rotvec()


def assert_covariance(errors: Floats, claimed: Floats) -> None:
    """Every element of a sample covariance within five standard deviations of the claimed one."""
    found = errors.T @ errors / len(errors)
    variance = np.diag(claimed)
    spread = np.sqrt((np.outer(variance, variance) + claimed**2) / len(errors))
    assert (np.abs(found - claimed) / spread).max() < 5


def view_of(position_m: Floats) -> systematic.Geometry:
    return systematic.geometry(
        LEVER.cam_from_body.apply(TRUTH.apply(position_m)), seen(position_m)
    )


def unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_equal_errors_give_the_solver_s_covariance() -> None:
    position_m = leds_in_view(8, 1)
    sigma = np.full(8, 3e-5)
    view = view_of(position_m)
    _, covariance = rotation_only(
        unit(seen(position_m)),
        sigma,
        position_m,
        LedMap(np.arange(8), position_m, *SURFACE),
        LEVER,
        TRUTH,
    )
    R = LEVER.cam_from_body.as_matrix()
    ours = systematic.from_independent(view, sigma, systematic.isotropic(sigma))
    np.testing.assert_allclose(
        ours, R @ covariance @ R.T, rtol=1e-8, atol=1e-8 * covariance.max()
    )


def test_own_errors_that_differ_by_led_and_direction_have_the_claimed_covariance() -> None:
    """LEDs believed off along one axis of the lab, by 0.1 mm to 1 mm, and solved with equal weights."""
    position_m = leds_in_view(7, 2)
    sigma = np.full(7, 1e-4)
    rng = np.random.default_rng(3)
    direction = unit(rng.normal(size=(7, 3))) * rng.uniform(1e-4, 1e-3, (7, 1))
    covariance_m2 = np.einsum("ni,nj->nij", direction, direction)
    view = view_of(position_m)
    by_place = view.gradient @ (LEVER.cam_from_body * TRUTH).as_matrix()
    claimed = systematic.from_independent(
        view, sigma, by_place @ covariance_m2 @ np.moveaxis(by_place, 1, 2)
    )
    rays = unit(seen(position_m))
    errors = np.array(
        [
            solved(rays, sigma, position_m + direction * rng.standard_normal((7, 1)))
            for _ in range(800)
        ]
    )
    assert_covariance(errors, claimed)


@pytest.mark.slow
def test_common_errors_have_the_claimed_covariance() -> None:
    """A map shifted and turned as a whole, and a focal length that is wrong."""
    position_m = leds_in_view(7, 4)
    sigma = np.full(7, 1e-4)
    rng = np.random.default_rng(5)
    fields = np.array(
        [np.tile([5e-4, 0, 0], (7, 1)), 4e-4 * np.cross([0.3, 0, 1.0], position_m)]
    )
    view = view_of(position_m)
    by_place = view.gradient @ (LEVER.cam_from_body * TRUTH).as_matrix()
    changes = [np.einsum("kij,mkj->mki", by_place, fields), 1e-3 * view.tangent[None]]
    claimed = systematic.from_common(view, sigma, np.concatenate(changes))
    errors = []
    for _ in range(800):
        z = rng.standard_normal(3)
        q = seen(position_m)
        q[:, :2] *= 1 + 1e-3 * z[2]
        errors.append(
            solved(unit(q), sigma, position_m + np.einsum("m,mni->ni", z[:2], fields))
        )
    assert_covariance(np.array(errors), claimed)


def whitened(tracker_of: Callable[[int], tuple[DomeTracker, Floats]], draws: int) -> Floats:
    """(D, 3) errors over the claimed covariance's root, of a tracker with true centroids and a drawn map."""
    values = []
    for seed in range(draws):
        tracker, xy_px = tracker_of(seed)
        centroids = Centroids(xy_px, np.full(len(xy_px), 0.05), np.full(len(xy_px), 1e4))
        answer = tracker.solve_centroids(centroids)
        assert answer.status == "solved"
        error = (answer.cam_from_ref * (LEVER.cam_from_body * TRUTH).inv()).as_rotvec()
        values.append(np.linalg.solve(np.linalg.cholesky(answer.covariance_rad2), error))
        assert np.linalg.eigvalsh(answer.covariance_rad2 - answer.systematic_rad2).min() > 0
    return np.array(values)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["own", "common", "focal", "all"])
def test_the_dome_tracker_claims_the_errors_of_its_map(kind: str) -> None:
    """Errors along the lab's x for each LED, a shift of all, a focal length: whitened errors are standard normal."""
    spread = np.random.default_rng(7).normal(size=(300, 3)) + np.array([0, 0, 2])
    position_m = np.vstack([leds_in_view(9, 6), 1.2 * unit(spread)])
    own = (
        np.zeros((3, 3))
        if kind in ("common", "focal")
        else np.diag([(6e-4) ** 2, 1e-10, 1e-10])
    )
    shift = 3e-4 * (kind in ("common", "all")) * np.ones(3)
    focal = 5e-4 * (kind in ("focal", "all"))

    def tracker_of(seed: int) -> tuple[DomeTracker, Floats]:
        rng = np.random.default_rng(seed)
        drawn = rng.multivariate_normal(
            np.zeros(3), own, len(position_m)
        ) + shift * rng.standard_normal(3)
        map_ = LedMap(
            *(np.arange(len(position_m)), position_m + drawn, *SURFACE, None),
            sigma_m=float(np.sqrt(np.trace(own) / 3)),
            covariance_m2=np.tile(own, (len(position_m), 1, 1)),
            common_m=np.array([np.tile(s, (len(position_m), 1)) for s in np.diag(shift)]),
        )
        camera = Camera(
            1600,
            1200,
            CAMERA.focal_px * (1 + focal * rng.standard_normal()),
            CAMERA.center_px,
        )
        camera = Camera(
            *(camera.width_px, camera.height_px, camera.focal_px, camera.center_px),
            focal_sigma=focal,
        )
        xy_px = CAMERA.pixels(seen(position_m))
        xy_px = xy_px[np.nan_to_num(xy_px, nan=-1).min(axis=1) > 5]
        xy_px = xy_px[(xy_px < [1595, 1195]).all(axis=1)]
        settings = Settings(
            identifier="led_pairs", solver="rotation_only", centroid_sigma_px=0.05
        )
        noisy_px = xy_px + np.hypot(0.05, 0.05) * rng.standard_normal(xy_px.shape)
        return DomeTracker(camera, map_, LEVER, settings), noisy_px

    errors = whitened(tracker_of, 200)
    products = errors.T @ errors / len(errors)
    assert np.abs(products - np.eye(3)).max() < 5 * np.sqrt(2 / 200)


@pytest.mark.slow
@pytest.mark.parametrize("focal", [0.0, 2e-3])
def test_the_star_tracker_claims_the_error_of_its_focal_length(focal: float) -> None:
    """Stars to one side of the image, so that a wrong focal length turns the attitude: the mean NEES is 3."""
    camera = Camera(1600, 1200, 4000.0, (799.5, 599.5), focal_sigma=focal)
    tracker = StarTracker.for_sky(camera, limit_mag=6.0)
    cam_from_ref = Rotation.from_euler("xyz", [80, 10, 30], degrees=True)
    rows, exact_px = tracker.field_matcher.in_field(camera, cam_from_ref)
    chosen = exact_px[:, 0] > 900
    rows = rows[chosen]
    exact_px = exact_px[chosen]
    assert len(rows) >= 5
    rng = np.random.default_rng(8)
    squares = []
    for _ in range(1000):
        scale = 1 + focal * rng.standard_normal()
        xy_px = camera.center_px + (exact_px - camera.center_px) * scale
        xy_px = xy_px + np.hypot(0.05, 0.1) * rng.standard_normal(xy_px.shape)
        centroids = Centroids(xy_px, np.full(len(rows), 0.05), np.full(len(rows), 1e4))
        answer = tracker.solve_matches(centroids, np.arange(len(rows)), rows)
        error = (answer.cam_from_ref * cam_from_ref.inv()).as_rotvec()
        squares.append(error @ np.linalg.solve(answer.covariance_rad2, error))
        assert (answer.systematic_rad2 is None) == (focal == 0)
    assert abs(np.mean(squares) - 3) < 5 * np.sqrt(6 / 1000)
