"""Laws of the trackers under a rolling shutter: stars and LEDs, with a gyro, with streaks, and without both."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.attitude.rate import STARS, Sight, tangent_motion
from estimator.attitude.rotation_fit import tangent_jacobian
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids, RateEstimate, StarMatch
from estimator.identification.refusals import NO_LIGHTS, NO_STARS
from estimator.trackers import rolling_shutter
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from tests.helpers.laws import SEEDS, law
from tests.helpers.moving_lights import CAMERA, EXPOSURE_S, Moving

pytestmark = pytest.mark.slow
ARCSEC_RAD = np.radians(1 / 3600)
SETTINGS = Settings(centroid_sigma_px=0.01)
WIDE = replace(CAMERA, focal_px=5000.0, distortion=(0.0,) * 5)
RATE_DEG_S = np.array([3.0, -4.0, 0.5])


@pytest.fixture(scope="module")
def tracker() -> StarTracker:
    stars = catalog.brighter_than(catalog.hipparcos(), 6.0)
    return StarTracker(WIDE, stars, stars.vectors, SETTINGS)


def star_frame(
    tracker: StarTracker, seed: int, rate_deg_s: Floats = RATE_DEG_S
) -> tuple[Moving, Centroids]:
    """A catalog field before a rotating camera and its exact centroids."""
    truth = Rotation.random(rng=np.random.default_rng(seed))
    _, xy_px = tracker.field_matcher.in_field(WIDE, truth)
    xy_px = xy_px[WIDE.contains(xy_px, 120.0)]
    seen = Moving(truth, np.radians(rate_deg_s), xy_px, camera=WIDE)
    return seen, seen.centroids()


def exact(rate_rad_s: Floats) -> RateEstimate:
    return RateEstimate(rate_rad_s, 1e-16 * np.eye(3))


def error_arcsec(attitude: Attitude, seen: Moving) -> Floats:
    assert attitude.cam_from_ref is not None
    return (attitude.cam_from_ref * seen.cam_from_ref.inv()).as_rotvec() / ARCSEC_RAD


def test_a_rolling_shutter_frame_is_solved_at_the_middle_row_s_time(
    tracker: StarTracker,
) -> None:
    blind = StarTracker(
        replace(WIDE, row_time_s=0.0), tracker.stars, tracker.stars.vectors, SETTINGS
    )
    signs = 0
    for seed in range(6):
        seen, found = star_frame(tracker, seed)
        by_gyro = tracker.solve_centroids(found, rate=exact(seen.rate_rad_s))
        by_streaks = tracker.solve_centroids(found, exposure_s=EXPOSURE_S)
        for attitude in by_gyro, by_streaks:
            assert np.linalg.norm(error_arcsec(attitude, seen)) < 0.1
            assert attitude.rate is not None
            assert_allclose(attitude.rate.rate_rad_s, seen.rate_rad_s, rtol=0, atol=1e-5)
            assert attitude.covariance_rad2 is not None
        assert by_streaks.rate is not None
        signs += by_streaks.rate.sign_known
        # Without the correction 36 px of shear between the first and the last row make it no star field.
        assert not blind.solve_centroids(found).solved
    assert signs == 6


def test_an_uncorrected_shear_rotates_the_field_as_predicted(tracker: StarTracker) -> None:
    """A shear s of x by y is best met by the roll -s sum(y^2) / sum(x^2 + y^2): of a slow rate, which still solves."""
    slow_deg_s = np.array([0.0, 0.05, 0.0])
    blind = StarTracker(
        replace(WIDE, row_time_s=0.0), tracker.stars, tracker.stars.vectors, Settings()
    )
    for seed in range(3):
        seen, found = star_frame(tracker, seed, slow_deg_s)
        attitude = blind.solve_centroids(found)
        assert attitude.match is not None
        x, y = (seen.still_px[attitude.match.observed] - WIDE.center_px).T
        x = x - x.mean()
        y = y - y.mean()
        shear = -np.radians(0.05) * WIDE.focal_px * WIDE.row_time_s
        expected = -shear * np.sum(y**2) / np.sum(x**2 + y**2) / ARCSEC_RAD
        assert abs(expected) > 10
        assert error_arcsec(attitude, seen)[2] == pytest.approx(expected, rel=0.1)
        assert (
            np.linalg.norm(
                error_arcsec(tracker.solve_centroids(found, exposure_s=EXPOSURE_S), seen)
            )
            < 0.1
        )


@pytest.mark.parametrize("sign", [-1, 1])
def test_of_two_signs_the_one_with_more_evidence_is_kept(
    tracker: StarTracker, monkeypatch: pytest.MonkeyPatch, sign: int
) -> None:
    """Some stars also match with the wrong sign; the result does not depend on the order of trials."""
    seen, found = star_frame(tracker, 1, sign * RATE_DEG_S)
    tried = []

    def both_solve(*arguments: Any) -> Attitude:
        rate = arguments[4][0]
        tried.append(rate)
        chance = -38.0 if rate.rate_rad_s @ seen.rate_rad_s > 0 else -7.0
        return Attitude(
            "solved",
            seen.cam_from_ref,
            np.eye(3),
            StarMatch(*2 * [np.arange(7)], seen.cam_from_ref, chance),
            rate=rate,
        )

    monkeypatch.setattr(rolling_shutter, "_solve_with", both_solve)
    attitude = tracker.solve_centroids(found, exposure_s=EXPOSURE_S)
    assert attitude.rate is not None
    assert attitude.rate.rate_rad_s @ seen.rate_rad_s > 0
    assert [rate.sign_known for rate in tried] == [False, False]


def test_row_times_alone_determine_a_slow_rate_with_its_sign(tracker: StarTracker) -> None:
    for seed in range(3):
        seen, found = star_frame(tracker, seed, np.array([0.3, -0.2, 0.1]))
        attitude = tracker.solve_centroids(
            replace(found, streak_px=None), exposure_s=EXPOSURE_S
        )
        assert np.linalg.norm(error_arcsec(attitude, seen)) < 0.1
        assert attitude.rate is not None
        assert attitude.rate.sign_known
        assert_allclose(attitude.rate.rate_rad_s, seen.rate_rad_s, rtol=0, atol=1e-5)


def test_the_covariance_is_that_of_attitude_and_rate_together(tracker: StarTracker) -> None:
    """Stars in the upper rows alone: the attitude at the middle row is extrapolated with the rate that they give.

    The inverse of the six by six normal matrix of rotation and rate, from slopes J and -t J, against the tracker's.
    """
    for seed in range(3):
        seen, _ = star_frame(tracker, seed, np.array([0.3, -0.2, 0.1]))
        seen = replace(seen, still_px=seen.still_px[seen.still_px[:, 1] < 600.0])
        found = replace(seen.centroids(), streak_px=None)
        attitude = tracker.solve_centroids(found, exposure_s=EXPOSURE_S)
        assert attitude.match is not None
        assert attitude.covariance_rad2 is not None
        used = tracker.with_errors(found.take(attitude.match.observed))
        rays = WIDE.rays(used.xy_px)
        by_rotation = tangent_jacobian(rays, rays).reshape(-1, 2, 3)
        delay_s = WIDE.row_delays_s(used.xy_px)
        assert (delay_s < 0).all()
        slopes = np.concatenate([by_rotation, -delay_s[:, None, None] * by_rotation], axis=2)
        weighted = slopes / (used.sigma_px / WIDE.focal_px)[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, weighted)
        joint = np.linalg.inv(normal)[:3, :3]
        alone = np.linalg.inv(normal[:3, :3])
        claimed, expected, fixed = (
            np.sqrt(np.diag(one)) for one in (attitude.covariance_rad2, joint, alone)
        )
        assert (expected > 1.3 * fixed).all()
        assert_allclose(claimed, expected, rtol=0.05, atol=0)


@pytest.mark.parametrize("focal_px", [1500.0, 8000.0])
def test_the_first_guess_of_a_slow_rate_shears_the_field_by_a_given_length(
    focal_px: float,
) -> None:
    """By one standard deviation, from the middle row to the first. A streak at half the height has one length."""
    camera = replace(WIDE, focal_px=focal_px, row_time_s=3e-4)
    points = Centroids(np.full((3, 2), 100.0), np.full(3, 0.1), np.ones(3))
    guesses = [
        one.covariance_rad2_s2
        for one, _ in rolling_shutter.candidates(camera, STARS, points, None, EXPOSURE_S)
    ]
    assert len(guesses) == 2
    sheared_px = [
        np.sqrt(guess[0, 0]) * focal_px * abs(camera.row_delays_s(np.zeros((1, 2)))[0])
        for guess in guesses
    ]
    assert sheared_px[0] == pytest.approx(rolling_shutter.SMALL_SHEAR_PX, rel=2e-3)
    assert sheared_px[1] > rolling_shutter.SMALL_SHEAR_PX
    # At the edge of the chip's middle column, above the center by half the height.
    above = np.array([[0.0, camera.height_px / 2 / focal_px, 1.0]])
    about = tangent_motion(above)[0] @ [0.0, 0.0, 1.0]
    across = tangent_motion(np.array([[0.0, 0.0, 1.0]]))[0] @ [0.0, 1.0, 0.0]
    for guess in guesses:
        sigma = np.sqrt(np.diag(guess))
        assert sigma[2] * np.linalg.norm(about) == pytest.approx(
            sigma[1] * np.linalg.norm(across)
        )


def test_the_prior_of_a_rate_is_what_the_frame_does_not_tell() -> None:
    """Any rate to 10 rad/s from streaks; else four times the slow one, 0.5 deg/s where the exposure is unknown."""
    found = Moving(
        Rotation.identity(),
        np.radians(RATE_DEG_S),
        np.random.default_rng(2).uniform(200, 1000, (20, 2)),
        camera=WIDE,
    ).centroids()
    both = list(rolling_shutter.candidates(WIDE, STARS, found, None, EXPOSURE_S))
    assert len(both) == 2
    for _, prior in both:
        assert_allclose(prior.covariance_rad2_s2, 100 * np.eye(3), rtol=1e-12, atol=0)
        assert_allclose(prior.rate_rad_s, 0, rtol=0, atol=0)
    points = replace(found, streak_px=None)
    # 0.5 deg/s move an image by f w tau of a row: no shear of a pixel in half of the rows of a fast readout
    for row_time_s, count in ((3e-4, 2), (-3e-4, 2), (1e-6, 1)):
        camera = replace(WIDE, row_time_s=row_time_s)
        shear_px = np.radians(0.5) * WIDE.focal_px * abs(row_time_s) * WIDE.height_px / 2
        assert (shear_px > 1) == (count == 2)
        guesses = list(rolling_shutter.candidates(camera, STARS, points, None, None))
        assert len(guesses) == count
        last, prior = guesses[-1]
        sigma = np.sqrt(np.diag(last.covariance_rad2_s2))
        assert_allclose(sigma[:2], np.radians(0.5), rtol=1e-12, atol=0)
        assert sigma[2] / sigma[0] == pytest.approx(WIDE.focal_px / (WIDE.height_px / 2))
        for guess, own in guesses:
            assert_allclose(
                own.covariance_rad2_s2, 16 * last.covariance_rad2_s2, rtol=1e-12, atol=0
            )
            assert_allclose(guess.rate_rad_s, 0, rtol=0, atol=0)
    assert_allclose(
        guesses[0][0].covariance_rad2_s2, last.covariance_rad2_s2, rtol=1e-12, atol=0
    )


@pytest.mark.parametrize("row_time_s", [0.0, 8e-5])
def test_too_few_lights_are_no_field_and_none_are_no_lights(
    tracker: StarTracker, row_time_s: float
) -> None:
    """Three lights are never asked to be a field; four are."""
    asked: list[int] = []

    def refuse(centroids: Centroids) -> Attitude:
        asked.append(len(centroids))
        return Attitude("asked")

    camera = replace(WIDE, row_time_s=row_time_s)
    lights = rolling_shutter.Lights(tracker.stars.vectors, np.zeros(3), lambda some, _: some)
    for count in range(5):
        some = Centroids(np.full((count, 2), 300.0), np.full(count, 0.1), np.ones(count))
        found = rolling_shutter.solve_lights(camera, lights, some, refuse, None, None)
        few = count < rolling_shutter.MIN_EVIDENCE_MATCHES
        expected = "asked" if not few else NO_STARS if count else NO_LIGHTS
        assert found.status == expected
    assert set(asked) == set(range(rolling_shutter.MIN_EVIDENCE_MATCHES, 5))


@pytest.mark.parametrize("ratio", [1.0019, 1.0021, 0.9981, 0.9979])
def test_a_focal_length_is_the_calibrated_one_within_two_thousandths(ratio: float) -> None:
    fitted = WIDE.zoomed(ratio)
    attitude = Attitude("solved", camera=fitted)
    same = abs(ratio - 1) < 0.002
    assert rolling_shutter._lens(attitude, WIDE) is (WIDE if same else fitted)
    assert rolling_shutter._lens(Attitude("solved"), WIDE) is WIDE


def test_the_gyro_gives_the_sign_of_a_global_shutter_frame_s_rate(
    tracker: StarTracker,
) -> None:
    still = StarTracker(
        replace(WIDE, row_time_s=0.0), tracker.stars, tracker.stars.vectors, SETTINGS
    )
    seen, _ = star_frame(tracker, 1)
    found = replace(seen, camera=still.camera).centroids()
    rough = RateEstimate(1.2 * seen.rate_rad_s, 1e-4 * np.eye(3))
    signed, open_sign = (
        still.solve_centroids(found, exposure_s=EXPOSURE_S, rate=rate).rate
        for rate in (rough, None)
    )
    assert signed is not None
    assert open_sign is not None
    assert (signed.sign_known, open_sign.sign_known) == (True, False)
    assert_allclose(signed.rate_rad_s, seen.rate_rad_s, rtol=0, atol=1e-4)
    assert_allclose(np.abs(open_sign.rate_rad_s), np.abs(seen.rate_rad_s), rtol=0, atol=1e-4)
    assert still.solve_centroids(found).rate is None
    solved = still.solve_centroids(found)
    for lacking in (replace(solved, match=None), replace(solved, camera=None)):
        assert rolling_shutter.with_streak_rate(lacking, found, EXPOSURE_S) is lacking
    assert rolling_shutter.with_streak_rate(solved, found, EXPOSURE_S).rate is not None
    with pytest.raises(ImageError, match=r"exposure_s: 0.0; allowed: finite, above 0"):
        still.solve_centroids(found, exposure_s=0.0)


def test_leds_of_a_rolling_shutter_frame_are_solved_at_the_middle_row_s_time() -> None:
    """On a dome of two radii, with the camera on its lever arm: the images of near LEDs move more."""
    rng = np.random.default_rng(4)
    camera = Camera(1600, 1200, 8000.0, (799.5, 599.5), row_time_s=80e-6)
    cap = Rotation.from_rotvec(
        np.column_stack([rng.uniform(-0.4, 0.4, (500, 2)), np.zeros(500)])
    )
    place_m = cap.apply([0.0, 0.0, 1.0]) * rng.uniform(0.95, 1.0, (500, 1))
    lever = Lever(np.array([0.01, -0.02, 0.3]), Rotation.identity())
    leds = LedMap(np.arange(500), place_m, np.zeros(3), np.ones(3))
    dome = DomeTracker(
        camera, leds, lever, Settings(identifier="led_pairs", solver="rotation_only")
    )
    for seed in range(3):
        truth = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 0.05, 3))
        xy_px = camera.pixels(truth.apply(place_m) - lever.camera_body_m)
        inside = camera.contains(xy_px, 150.0)
        radius_m = np.linalg.norm(place_m[inside], axis=1)
        seen = Moving(
            truth,
            np.radians([2.0, 3.0, -1.0]),
            xy_px[inside],
            Sight(lever.camera_body_m, radius_m),
            camera,
        )
        found = seen.centroids()
        for arguments in {"rate": exact(seen.rate_rad_s)}, {"exposure_s": EXPOSURE_S}:
            attitude = dome.solve_centroids(found, **arguments)  # type: ignore[arg-type]
            assert np.linalg.norm(error_arcsec(attitude, seen)) < 0.5
            assert attitude.rate is not None
            assert_allclose(attitude.rate.rate_rad_s, seen.rate_rad_s, rtol=0, atol=1e-4)


@law(
    rolling_shutter.solve_lights,
    rolling_shutter.candidates,
    rolling_shutter.with_streak_rate,
    rolling_shutter.Lights.sight,
    StarTracker.with_errors,
)
@given(rng=SEEDS)
def test_rolling_shutter_candidates_include_the_true_rate_and_refusals_stay(
    rng: np.random.Generator,
) -> None:
    stars = catalog.brighter_than(catalog.hipparcos(), 3.0)
    tracker = StarTracker(WIDE, stars, stars.vectors, SETTINGS)
    seen, found = star_frame(tracker, int(rng.integers(1000)))
    # Enough lights for streaks, whether or not they are stars.
    seen = replace(seen, still_px=rng.uniform(200, 1000, (20, 2)))
    found = seen.centroids()
    lights = rolling_shutter.Lights(
        stars.vectors, np.zeros(3), lambda some, _: tracker.with_errors(some)
    )
    assert lights.sight.radius_m == pytest.approx(1)
    rates = list(rolling_shutter.candidates(WIDE, lights.sight, found, None, EXPOSURE_S))
    assert min(np.linalg.norm(one.rate_rad_s - seen.rate_rad_s) for one, _ in rates) < 1e-3
    assert not any(one.sign_known for one, _ in rates)
    slow = list(
        rolling_shutter.candidates(
            WIDE, lights.sight, replace(found, streak_px=None), None, EXPOSURE_S
        )
    )
    assert slow[-1][0].rate_rad_s.tolist() == [0, 0, 0]
    gyro = RateEstimate(seen.rate_rad_s, np.eye(3))
    assert list(rolling_shutter.candidates(WIDE, lights.sight, found, gyro, EXPOSURE_S)) == [
        (gyro, gyro)
    ]
    both = list(
        rolling_shutter.candidates(
            WIDE, lights.sight, found, replace(gyro, sign_known=False), None
        )
    )
    assert_allclose(both[0][0].rate_rad_s, -both[1][0].rate_rad_s, rtol=0, atol=0)
    refused = rolling_shutter.solve_lights(
        WIDE, lights, found, lambda _: Attitude("no"), None, EXPOSURE_S
    )
    assert refused.status == "no"
    assert rolling_shutter.with_streak_rate(refused, found, EXPOSURE_S) is refused
    total = tracker.with_errors(found)
    assert_allclose(total.sigma_px, tracker.sigma_px(found), rtol=1e-12, atol=0)
    assert total.covariance_px2 is not None
    assert_allclose(total.covariance_px2[:, 0, 0], total.sigma_px**2, rtol=1e-12, atol=0)
