"""Laws of a rotating camera: image velocities, frames at one time, rates from streaks, disks and rows, and errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from estimator.attitude import rate, rolling, rotation_fit
from estimator.attitude.rate import STARS, Sight
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.types import Centroids, RateEstimate
from estimator.detection import classify
from estimator.detection.detect import local
from tests.helpers.laws import SEEDS, answered, assert_covariance, law, units
from tests.helpers.moving_lights import CAMERA, EXPOSURE_S, STREAK_SIGMA_PX, Moving, moving

ARCSEC_RAD = np.radians(1 / 3600)
ANYTHING = RateEstimate(np.zeros(3), 100.0 * np.eye(3))
DOME = Sight(np.array([0.02, -0.03, 0.3]), 1.2)
GLOBAL = replace(CAMERA, row_time_s=0.0)


def any_rate(rng: np.random.Generator, most_deg_s: float = 5.0) -> Floats:
    """A random rate about any axis with at least 1 deg/s across the boresight."""
    across = units(rng, 1)[0] * [1, 1, 0]
    return rng.uniform(1.0, most_deg_s) * (
        across / np.linalg.norm(across) + [0, 0, rng.uniform(-0.3, 0.3)]
    )


def exact(rate_rad_s: Floats) -> RateEstimate:
    return RateEstimate(rate_rad_s, np.zeros((3, 3)))


@law(
    rate.tangent_motion,
    rate.places_cam,
    rate.center_streak_px,
    rate.Sight.take,
    Camera.row_delays_s,
)
@given(rng=SEEDS)
def test_images_move_at_the_rate_s_predicted_velocity(rng: np.random.Generator) -> None:
    for sight in STARS, DOME, DOME._replace(radius_m=rng.uniform(1.0, 1.4, 30)):
        seen = replace(moving(rng, any_rate(rng), sight=sight), camera=GLOBAL)
        rays = GLOBAL.rays(seen.still_px)
        step_s = 1e-6
        moved = [GLOBAL.tangents(seen.pixels(np.full(30, t_s))) for t_s in (-step_s, step_s)]
        expected = (moved[1] - moved[0]) / 2 / step_s
        assert_allclose(
            rate.tangent_motion(rays, sight) @ seen.rate_rad_s, expected, rtol=0, atol=1e-6
        )
        assert_allclose(
            seen.cam_from_ref.apply(seen.place_ref),
            rate.places_cam(rays, sight),
            rtol=0,
            atol=1e-12,
        )
        some = rate.places_cam(rays[[3, 1]], sight.take(np.array([3, 1])))
        assert_allclose(some, rate.places_cam(rays, sight)[[3, 1]], rtol=0, atol=0)
    middle_px = np.array(
        [[5.0, (CAMERA.height_px - 1) / 2], [5.0, (CAMERA.height_px - 1) / 2 + 10]]
    )
    assert_allclose(
        CAMERA.row_delays_s(middle_px), [0, 10 * CAMERA.row_time_s], rtol=0, atol=1e-18
    )
    dx, dy = rate.center_streak_px(CAMERA, exact(np.array([0.1, 0.2, 5.0])), 0.5)
    assert (dx, dy) == pytest.approx((-0.2 * 0.5 * 3000, 0.1 * 0.5 * 3000))


@law(rate.at_middle_row, rate.error_gain, rate.covariance_of)
@given(rng=SEEDS)
def test_correction_moves_rolling_shutter_lights_to_global_shutter_positions(
    rng: np.random.Generator,
) -> None:
    for sight in STARS, DOME:
        seen = moving(rng, any_rate(rng, 10.0), sight=sight)
        found = seen.centroids()
        still = rate.at_middle_row(CAMERA, found, exact(seen.rate_rad_s), sight)
        assert_allclose(still.xy_px, seen.still_px, rtol=0, atol=1e-9)
        assert np.abs(found.xy_px - seen.still_px).max() > 1
        # An error of a centroid moves its place at the middle row by the gain.
        error_px = rng.normal(0, 1e-4, found.xy_px.shape)
        off = rate.at_middle_row(
            CAMERA,
            replace(found, xy_px=found.xy_px + error_px),
            exact(seen.rate_rad_s),
            sight,
        )
        gain = rate.error_gain(
            CAMERA, rate.tangent_motion(CAMERA.rays(found.xy_px), sight) @ seen.rate_rad_s
        )
        assert_allclose(
            off.xy_px - still.xy_px,
            np.einsum("nij,nj->ni", gain, error_px),
            rtol=0,
            atol=2e-6,
        )
        assert still.covariance_px2 is not None
        expected = gain @ rate.covariance_of(found) @ np.swapaxes(gain, 1, 2)
        assert_allclose(still.covariance_px2, expected, rtol=0, atol=1e-12)
        # An error of the rate moves it too.
        other = seen.rate_rad_s + rng.normal(0, 1e-6, 3)
        moved = rate.at_middle_row(CAMERA, found, exact(other), sight).xy_px - still.xy_px
        sure = RateEstimate(
            seen.rate_rad_s, np.outer(other - seen.rate_rad_s, other - seen.rate_rad_s)
        )
        spread = rate.at_middle_row(
            CAMERA, replace(found, sigma_px=0 * found.sigma_px), sure, sight
        )
        assert spread.covariance_px2 is not None
        assert_allclose(
            np.sqrt(spread.covariance_px2[:, [0, 1], [0, 1]]),
            np.abs(moved),
            rtol=0.02,
            atol=1e-5,
        )
    assert rate.at_middle_row(GLOBAL, found, exact(seen.rate_rad_s)) is found


@pytest.mark.slow
@law(
    rate.from_streaks,
    rate.chords,
    rate.aligned,
    rate.inliers,
    rate.inverses,
    rate.streak_factor,
)
@given(rng=SEEDS)
def test_exact_streaks_give_the_rate_in_one_of_two_signs(rng: np.random.Generator) -> None:
    for camera in CAMERA, GLOBAL:
        for sight in STARS, DOME:
            seen = replace(moving(rng, any_rate(rng), sight=sight), camera=camera)
            found = seen.centroids()
            assert found.streak_px is not None
            rates = rate.from_streaks(camera, found, EXPOSURE_S, sight)
            off = [np.linalg.norm(one.rate_rad_s - seen.rate_rad_s) for one in rates]
            assert len(rates) == 2
            assert not any(one.sign_known for one in rates)
            # A chord is not quite T times the velocity.
            assert min(off) < 1e-3 * np.linalg.norm(seen.rate_rad_s)
            opposite = rates[int(np.argmax(off))].rate_rad_s
            assert opposite @ seen.rate_rad_s < 0
            # One wrong streak of thirty is left out, or is within the gate of 16: with the leverage 3 / 30 it then
            # moves the rate by a squared Mahalanobis distance below 16 (1 / 10) / (9 / 10).
            wrong = replace(
                found,
                streak_px=found.streak_px + np.where(np.arange(30)[:, None] == 7, 5.0, 0.0),
            )
            again = rate.from_streaks(camera, wrong, EXPOSURE_S, sight)
            errors = [
                (one.rate_rad_s - seen.rate_rad_s, one.covariance_rad2_s2) for one in again
            ]
            assert (
                min(
                    error @ np.linalg.solve(covariance, error) for error, covariance in errors
                )
                < 1.8
            )
    assert rate.from_streaks(CAMERA, found.take(np.arange(2)), EXPOSURE_S) == []
    assert rate.from_streaks(CAMERA, replace(found, streak_px=None), EXPOSURE_S) == []
    for exposure_s in 0.0, -1.0, np.nan, np.inf:
        assert (
            answered(
                lambda exposure_s=exposure_s: rate.from_streaks(CAMERA, found, exposure_s),
                ImageError,
            )
            is None
        )


@law(rate.image_paths, slow=True)
@given(rng=SEEDS)
def test_the_paths_of_images_are_those_of_a_constant_rate(rng: np.random.Generator) -> None:
    """Against the path itself: its ends, their middle, and its mean over the exposure."""
    camera = replace(GLOBAL, distortion=(-0.1, 0.0, 0.0, 0.0, 0.0))
    exposure_s = 0.1
    omega = np.radians(any_rate(rng, 12.0))
    corners = camera.corners_px - camera.center_px
    middle_px = camera.center_px + rng.uniform(-0.8, 0.8, (20, 2)) * corners.max(axis=0)
    t_s = np.linspace(-0.5, 0.5, 101) * exposure_s
    rays = camera.rays(middle_px)
    path = np.array(
        [camera.pixels(Rotation.from_rotvec(-omega * t).apply(rays)) for t in t_s]
    )
    streak_px = path[-1] - path[0]
    length_px = np.linalg.norm(streak_px, axis=1)[:, None]
    found = Centroids(
        middle_px,
        np.full(20, 0.1),
        np.ones(20),
        streak_px=streak_px,
        streak_covariance_px2=np.tile(1e-4 * np.eye(2), (20, 1, 1)),
    )
    paths = rate.image_paths(camera, found, exposure_s)
    assert paths is not None
    streaks, light_px, ahead_px = paths
    sign = np.sign(np.sum(streaks * streak_px, axis=1))[:, None]
    assert_allclose(streaks * sign, streak_px, rtol=0, atol=2e-3 * length_px.max())
    tolerance = 0.02 * np.abs(path.mean(axis=0) - middle_px).max() + 1e-4
    assert_allclose(light_px, path.mean(axis=0) - middle_px, rtol=0, atol=tolerance)
    along = streak_px / length_px
    ends_px = np.sum(((path[0] + path[-1]) / 2 - path.mean(axis=0)) * along, axis=1)
    expected = ends_px[:, None] * along
    assert_allclose(ahead_px, expected, rtol=0, atol=0.012 * np.abs(expected).max() + 1e-4)
    assert rate.image_paths(camera, found.take(np.arange(2)), exposure_s) is None


@pytest.mark.slow
def test_the_rate_from_streaks_has_its_claimed_covariance() -> None:
    nees = []
    for seed in range(300):
        rng = np.random.default_rng([21, seed])
        seen = replace(moving(rng, any_rate(rng), 12), camera=GLOBAL)
        both = rate.from_streaks(GLOBAL, seen.centroids(rng), EXPOSURE_S)
        best = min(
            both, key=lambda one: float(np.linalg.norm(one.rate_rad_s - seen.rate_rad_s))
        )
        error = best.rate_rad_s - seen.rate_rad_s
        nees.append(error @ np.linalg.solve(best.covariance_rad2_s2, error))
    assert np.mean(nees) == pytest.approx(3, abs=4 * np.sqrt(6 / 300))


def test_streaks_in_one_direction_leave_the_rate_about_it_to_its_prior() -> None:
    """That of 10 rad/s: a variance of 100 rad^2/s^2, as streaks of lights on the boresight say nothing of the roll."""
    camera = replace(GLOBAL, distortion=(0.0,) * 5)
    seen = Moving(
        Rotation.identity(), np.array([0.02, 0.01, 0.0]), np.tile(camera.center_px, (5, 1))
    )
    both = rate.from_streaks(camera, replace(seen, camera=camera).centroids(), EXPOSURE_S)
    for one in both:
        assert_allclose(one.covariance_rad2_s2[2], [0, 0, 100], rtol=1e-9, atol=1e-9)
        # c = -f T J w: 5 chords of 0.1 px each
        across = STREAK_SIGMA_PX / (camera.focal_px * EXPOSURE_S) / np.sqrt(5)
        assert_allclose(
            one.covariance_rad2_s2[:2, :2], across**2 * np.eye(2), rtol=1e-6, atol=0
        )


@pytest.mark.slow
def test_the_covariance_of_noisy_streaks_is_that_of_their_noise() -> None:
    """Eight times the claimed: the mean of its unbiased estimates with 3 rates taken from 2 N numbers is 64 times."""
    factors = []
    for seed in range(300):
        rng = np.random.default_rng([26, seed])
        seen = replace(moving(rng, any_rate(rng, 20.0), 5), camera=GLOBAL)
        exactly = seen.centroids()
        assert exactly.streak_px is not None
        noise_px = 8 * STREAK_SIGMA_PX * rng.standard_normal(exactly.streak_px.shape)
        noisy = replace(exactly, streak_px=exactly.streak_px + noise_px)
        claimed, found = (
            rate.from_streaks(GLOBAL, one, EXPOSURE_S)[0].covariance_rad2_s2
            for one in (exactly, noisy)
        )
        factors.append(np.trace(np.linalg.solve(claimed, found)) / 3)
    # The chi-square of 7 numbers, divided by 7, has the deviation sqrt(2 / 7).
    assert np.mean(factors) == pytest.approx(64, rel=4 * np.sqrt(2 / 7 / 300))


@pytest.mark.slow
@law(rolling.fit)
@given(rng=SEEDS)
def test_attitude_and_rate_are_found_together(rng: np.random.Generator) -> None:
    for sight in STARS, DOME:
        seen = moving(rng, any_rate(rng), sight=sight)
        found = seen.centroids()
        start = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)) * seen.cam_from_ref
        places = seen.place_ref
        lever = sight.lever_cam_m
        rows = rolling.fit(CAMERA, found, places, lever, (start, np.zeros(3)), ANYTHING)
        assert (rows.cam_from_ref * seen.cam_from_ref.inv()).magnitude() < 1e-3 * ARCSEC_RAD
        assert_allclose(rows.rate.rate_rad_s, seen.rate_rad_s, rtol=0, atol=1e-8)
        first = start, rows.rate.rate_rad_s
        streaks = rolling.fit(CAMERA, found, places, lever, first, ANYTHING, EXPOSURE_S)
        assert (streaks.cam_from_ref * seen.cam_from_ref.inv()).magnitude() < 0.1 * ARCSEC_RAD
        more, less = (np.trace(one.rate.covariance_rad2_s2) for one in (rows, streaks))
        assert less < more
        assert_covariance(streaks.rate.covariance_rad2_s2)
    few = found.take(np.arange(1)), places[:1]
    assert (
        answered(
            lambda: rolling.fit(CAMERA, few[0], few[1], lever, (start, np.zeros(3)), ANYTHING)
        )
        is None
    )


def test_a_light_is_weighted_by_its_residual_s_own_change() -> None:
    """An error of a centroid also moves the row at whose time it is predicted: by finite differences, at 40 deg/s."""
    camera = replace(CAMERA, distortion=(0.0,) * 5)
    for seed in range(4):
        rng = np.random.default_rng([25, seed])
        seen = replace(moving(rng, any_rate(rng, 40.0), 6), camera=camera)
        found = seen.centroids()

        def residual_px(
            xy_px: Floats, seen: Moving = seen, found: Centroids = found
        ) -> tuple[Floats, Floats]:
            turn = Rotation.from_rotvec(
                -camera.row_delays_s(xy_px)[:, None] * seen.rate_rad_s
            )
            place = turn.apply(seen.cam_from_ref.apply(seen.place_ref))
            lights = replace(found, xy_px=xy_px)
            rows = rolling._rows(
                camera, lights, place, np.zeros(3), turn, seen.rate_rad_s, None
            )
            return camera.focal_px * rows[0].residual, rows[0].information

        still, information = residual_px(found.xy_px)
        by_error = np.stack(
            [
                (residual_px(found.xy_px + step)[0] - still) / 1e-3
                for step in 1e-3 * np.eye(2)
            ],
            axis=2,
        )
        expected = by_error @ by_error.mT * (found.sigma_px[0] / camera.focal_px) ** 2
        assert np.abs(by_error - np.eye(2)).max() > 0.02
        size = float(np.abs(expected).max())
        assert_allclose(np.linalg.inv(information), expected, rtol=0, atol=2e-3 * size)


@pytest.mark.parametrize("seed", range(230, 240))
def test_a_light_at_the_outlier_limit_does_not_prevent_convergence(seed: int) -> None:
    """Errors with long tails: in 234 a light is an outlier with every second step, for ever."""
    rng = np.random.default_rng([23, seed])
    seen = moving(rng, np.radians(rng.normal(0, 1, 3)), 12)
    found = seen.centroids(rng)
    found = replace(
        found, xy_px=found.xy_px + 1.5 * found.sigma_px[:, None] * rng.standard_t(2, (12, 2))
    )
    start = seen.cam_from_ref, seen.rate_rad_s
    fit = rolling.fit(CAMERA, found, seen.place_ref, np.zeros(3), start, ANYTHING)
    assert (
        fit.cam_from_ref * seen.cam_from_ref.inv()
    ).magnitude() < 100 * found.sigma_px.max() / CAMERA.focal_px


@law(rolling.rate_covariance_rad2)
@given(rng=SEEDS)
def test_an_error_of_the_rate_rotates_the_attitude(rng: np.random.Generator) -> None:
    seen = moving(rng, any_rate(rng))
    error = rng.normal(0, 1e-5, 3)
    found = seen.centroids()
    wrong = rate.at_middle_row(CAMERA, found, exact(seen.rate_rad_s + error))
    place = seen.cam_from_ref.apply(seen.place_ref)
    jacobian = rotation_fit.tangent_jacobian(place, place).reshape(-1, 2, 3)
    residual = GLOBAL.tangents(wrong.xy_px) - GLOBAL.tangents(seen.still_px)
    turned, *_ = np.linalg.lstsq(jacobian.reshape(-1, 3), residual.ravel(), rcond=None)
    covariance = rolling.rate_covariance_rad2(CAMERA, found, jacobian, np.outer(error, error))
    assert_allclose(
        covariance, np.outer(turned, turned), rtol=0, atol=0.05 * float(turned @ turned)
    )


@pytest.mark.slow
def test_a_rolling_shutter_attitude_has_its_claimed_covariance() -> None:
    """Of the attitude that is solved after the rate, with the covariance of both."""
    nees = []
    for seed in range(300):
        rng = np.random.default_rng([22, seed])
        seen = moving(rng, any_rate(rng), 10)
        found = seen.centroids(rng)
        places = seen.place_ref
        fit = rolling.fit(
            CAMERA, found, places, np.zeros(3), (seen.cam_from_ref, seen.rate_rad_s), ANYTHING
        )
        place = seen.cam_from_ref.apply(places)
        jacobian = rotation_fit.tangent_jacobian(place, place)
        noise = (
            np.linalg.inv(jacobian.T @ jacobian) * (found.sigma_px[0] / CAMERA.focal_px) ** 2
        )
        by_rate = rolling.rate_covariance_rad2(
            CAMERA, found, jacobian.reshape(-1, 2, 3), fit.rate.covariance_rad2_s2
        )
        error = (fit.cam_from_ref * seen.cam_from_ref.inv()).as_rotvec()
        nees.append(error @ np.linalg.solve(noise + by_rate, error))
    assert np.mean(nees) == pytest.approx(3, abs=4 * np.sqrt(6 / 300))


def moments_of(seen: Moving, variance_px2: float) -> Floats:
    """(N, 3) second moments of round images of a rolling shutter: a D D' and the streak's."""
    velocity = (
        seen.camera.focal_px
        * rate.tangent_motion(GLOBAL.rays(seen.still_px), seen.sight)
        @ seen.rate_rad_s
    )
    u, w = CAMERA.row_time_s * velocity.T
    gain = 1 / (1 - w)
    shear = np.moveaxis(np.array([[np.ones_like(u), u * gain], [0 * u, gain]]), 2, 0)
    streak = (gain * velocity.T * EXPOSURE_S).T
    matrix = (
        variance_px2 * shear @ np.swapaxes(shear, 1, 2)
        + np.einsum("ni,nj->nij", streak, streak) / 12
    )
    return np.column_stack(
        [
            matrix[:, 0, 0] - matrix[:, 1, 1],
            2 * matrix[:, 0, 1],
            matrix[:, 0, 0] + matrix[:, 1, 1],
        ]
    )


@law(rate.from_moments)
@given(rng=SEEDS)
def test_disks_of_a_rolling_shutter_determine_the_rate(rng: np.random.Generator) -> None:
    seen = moving(rng, any_rate(rng, 8.0), sight=DOME)
    disks = replace(
        seen.centroids(),
        xy_px=seen.still_px,
        streak_px=None,
        moments_px2=moments_of(seen, 30.0),
    )
    rates = rate.from_moments(CAMERA, disks, EXPOSURE_S, DOME)
    assert len(rates) == 2
    assert min(
        np.linalg.norm(one.rate_rad_s - seen.rate_rad_s) for one in rates
    ) < np.radians(0.05)
    assert_covariance(rates[0].covariance_rad2_s2)
    assert rate.from_moments(GLOBAL, disks, EXPOSURE_S, DOME) == []
    points = replace(disks, moments_px2=moments_of(seen, 0.1) * 0.01)
    assert rate.from_moments(CAMERA, points, EXPOSURE_S, DOME) == []


def test_the_covariance_of_a_rate_from_disks_is_that_of_one_error_of_all_moments() -> None:
    """Moments that are wrong by 1 % of xx + yy in all lights move the rate by one standard deviation, to a tenth.

    Twice as many lights have the same error, so they do not reduce it.
    """
    rng = np.random.default_rng(26)
    seen = moving(rng, np.array([3.0, 4.0, 0.2]), 40, sight=DOME)
    moments = moments_of(seen, 30.0)
    disks = replace(
        seen.centroids(), xy_px=seen.still_px, streak_px=None, moments_px2=moments
    )

    def nearest(found: Centroids) -> RateEstimate:
        both = rate.from_moments(CAMERA, found, EXPOSURE_S, DOME)
        return min(
            both, key=lambda one: float(np.linalg.norm(one.rate_rad_s - seen.rate_rad_s))
        )

    right = nearest(disks)
    wrong = moments + 0.01 * moments[:, 2:] * [1.0, 0.0, 0.0]
    change = nearest(replace(disks, moments_px2=wrong)).rate_rad_s - right.rate_rad_s
    size = change @ np.linalg.solve(right.covariance_rad2_s2, change)
    assert np.sqrt(size) == pytest.approx(1, abs=0.1)
    doubled = nearest(disks.take(np.tile(np.arange(40), 2)))
    assert_allclose(doubled.covariance_rad2_s2, right.covariance_rad2_s2, rtol=1e-6, atol=0)


@pytest.mark.parametrize("rate_deg_s", [(3.0, 4.0, 0.2), (-7.0, 1.0, 0.0), (0.5, -0.8, 0.1)])
def test_the_motion_of_a_disk_is_a_root_of_its_moments(
    rate_deg_s: tuple[float, float, float],
) -> None:
    """Of the exact moments, one of both roots is the motion from row to row; the other one has the same moments."""
    seen = moving(np.random.default_rng(27), np.array(rate_deg_s), 12)
    variance_px2 = 30.0
    moments = moments_of(seen, variance_px2)
    rows = EXPOSURE_S / CAMERA.row_time_s
    velocity = rate.tangent_motion(GLOBAL.rays(seen.still_px), STARS) @ seen.rate_rad_s
    u, w = CAMERA.focal_px * CAMERA.row_time_s * velocity.T
    both = np.stack([rate._roots(moments, rows, side) for side in (1, -1)])
    off = np.abs(both - (u + 1j * w)).min(axis=0)
    assert_allclose(off, 0, rtol=0, atol=1e-9)
    for z in both:
        gain = 1 / (1 - z.imag)
        streak = rows**2 / 12 * gain**2
        # D D^T = [[1 + (u g)^2, u g^2], [u g^2, g^2]]; a from the sum of the diagonal
        trace = 1 + (z.real * gain) ** 2 + gain**2
        a = (moments[:, 2] - streak * np.abs(z) ** 2) / trace
        shape = a * (1 + (z.real * gain) ** 2 - gain**2) + streak * (z.real**2 - z.imag**2)
        cross = a * z.real * gain**2 + streak * z.real * z.imag
        assert_allclose(
            moments[:, :2], np.column_stack([shape, 2 * cross]), rtol=0, atol=1e-9
        )


def test_a_rate_from_disks_is_that_of_weighted_least_squares() -> None:
    """By SciPy-free arithmetic: rows divided by their deviations; of two roots the one that is nearer counts."""
    rng = np.random.default_rng(28)
    motion_px = rng.standard_normal((6, 2, 3))
    omega = np.array([0.5, -0.3, 0.2])
    truth = motion_px @ omega @ [1, 1j]
    noisy = truth + 0.01 * (rng.standard_normal(6) + 1j * rng.standard_normal(6))
    roots = np.stack([noisy, noisy + 50.0])
    roots[:, ::2] = roots[::-1, ::2]
    sigma_px = np.tile(rng.uniform(0.5, 2.0, 6), (2, 1))
    sigma_px[:, 5] = 0.0  # not usable
    found = rate._fit_disks(roots, sigma_px, motion_px, complex(truth.mean()))
    assert found is not None
    scale = np.repeat(sigma_px[0, :5], 2)
    design = motion_px[:5].reshape(-1, 3) / scale[:, None]
    measured = np.column_stack([noisy.real, noisy.imag])[:5].ravel() / scale
    expected, *_ = np.linalg.lstsq(design, measured, rcond=None)
    assert_allclose(found.rate_rad_s, expected, rtol=0, atol=1e-12)
    assert_allclose(
        found.covariance_rad2_s2, 5 * np.linalg.inv(design.T @ design), rtol=1e-9, atol=0
    )
    sigma_px[:, 3:] = 0.0
    assert rate._fit_disks(roots, sigma_px, motion_px, 0j) is not None
    sigma_px[:, 2] = 0.0
    assert rate._fit_disks(roots, sigma_px, motion_px, 0j) is None


def test_three_lights_of_a_measurable_size_give_a_rate() -> None:
    """Not two; the median of xx + yy is 8 px^2 or more. Three streaks do, too."""
    seen = moving(np.random.default_rng(29), np.array([3.0, 4.0, 0.2]), 3)
    moments = moments_of(seen, 30.0)
    disks = replace(seen.centroids(), xy_px=seen.still_px, moments_px2=moments)
    assert len(rate.from_moments(CAMERA, disks, EXPOSURE_S)) == 2
    assert rate.from_moments(CAMERA, disks.take(np.arange(2)), EXPOSURE_S) == []
    for total_px2, count in ((7.9, 0), (8.1, 2)):
        sized = replace(disks, moments_px2=moments * total_px2 / np.median(moments[:, 2]))
        assert len(rate.from_moments(CAMERA, sized, EXPOSURE_S)) == count
    assert len(rate.from_streaks(CAMERA, disks, EXPOSURE_S)) == 2
    assert rate.from_streaks(CAMERA, disks.take(np.arange(2)), EXPOSURE_S) == []


def test_an_outlier_is_beyond_four_standard_deviations_of_the_noise_that_is_seen() -> None:
    """Sixteen times the median of the squares, and not less than sixteen."""
    information = np.tile(np.diag([4.0, 1.0]), (5, 1, 1))
    for median, limit in ((0.2, 16.0), (1.0, 16.0), (2.5, 40.0)):
        for factor, kept in ((0.99, True), (1.01, False)):
            squares = np.array([0.1, 0.1, median, median, factor * limit])
            squares[3] = squares[2] + 1e-9
            residual = np.column_stack([np.sqrt(squares) / 2, 0 * squares])
            found = rate.inliers(residual, information)
            assert found[-1] == kept
            assert found[:4].all()


@law(classify.moments)
@given(rng=SEEDS)
def test_moments_of_an_ellipse_match_those_of_its_pixels(rng: np.random.Generator) -> None:
    xx, yy = rng.uniform(12, 30, 2)
    xy = rng.uniform(-0.5, 0.5) * np.sqrt(xx * yy)
    offset = np.stack(np.meshgrid(np.arange(120) - 59.5, np.arange(120) - 59.5), axis=-1)
    distance2 = np.einsum(
        "yxi,ij,yxj->yx", offset, np.linalg.inv([[xx, xy], [xy, yy]]), offset
    )
    # Of a uniform ellipse; its moments are a quarter of the squared half axes.
    inside = distance2 < 4
    image = np.where(inside, 5000.0, 0.0) + rng.normal(100, 1, (120, 120))
    blobs = local(image, 8.0, 50)
    assert len(blobs) == 1
    (found,) = classify.moments(image, blobs)
    pixels = np.cov(offset[inside].T, bias=True)
    of_pixels = [pixels[0, 0] - pixels[1, 1], 2 * pixels[0, 1], pixels[0, 0] + pixels[1, 1]]
    assert_allclose(found, of_pixels, rtol=0, atol=0.005 * (xx + yy))
    # Whole pixels of the outline.
    assert_allclose(found, [xx - yy, 2 * xy, xx + yy], rtol=0, atol=0.07 * (xx + yy))


@law(RateEstimate.resolved)
@given(rng=SEEDS)
def test_another_rate_resolves_the_sign(rng: np.random.Generator) -> None:
    true = rng.normal(0, 1, 3)
    spread = 0.01 * np.eye(3)
    unsigned = RateEstimate(-true, spread, sign_known=False)
    resolved = unsigned.resolved(RateEstimate(true + rng.normal(0, 0.1, 3), spread))
    if true @ true > 1:
        assert resolved.sign_known
        assert_allclose(resolved.rate_rad_s, true, rtol=0, atol=0)
    assert unsigned.resolved(unsigned) is unsigned
    assert not unsigned.resolved(RateEstimate(true, 1e4 * np.eye(3))).sign_known
    known = RateEstimate(true, spread)
    assert known.resolved(RateEstimate(-true, spread)) is known
    assert np.array_equal(resolved.covariance_rad2_s2, spread)


def test_centroids_keep_their_streaks() -> None:
    found = moving(np.random.default_rng(1), np.array([1.0, 2.0, 0.0])).centroids()
    part: Centroids = found.take(np.array([4, 2]))
    assert part.streak_px is not None
    assert found.streak_px is not None
    assert part.streak_covariance_px2 is not None
    assert_allclose(part.streak_px, found.streak_px[[4, 2]], rtol=0, atol=0)
    assert_allclose(
        part.streak_covariance_px2[:, 0, 0], STREAK_SIGMA_PX**2, rtol=1e-12, atol=0
    )
