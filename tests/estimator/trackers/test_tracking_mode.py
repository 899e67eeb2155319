"""Tracking mode: following stars, health flags, and recovery after loss."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation
from scipy.special import erf

from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids, RateEstimate, StarMatch
from estimator.detection.windows import in_windows
from estimator.trackers.pipeline import Clock, Settings
from estimator.trackers.star_tracker import StarTracker
from estimator.trackers.tracking_mode import Health, LastSolution, TrackedReport, TrackingMode

pytestmark = pytest.mark.slow  # much is compiled

FILE = Path(__file__).parents[3] / "data/catalogs/hipparcos_hp6.5.ecsv"
CAMERA = Camera.from_fov(659, 493, np.radians(14.87))
START = Rotation.from_euler("xyz", [20, 50, 130], degrees=True)
RATE_RAD_S = np.radians([0.3, -0.4, 0.2])
STEP_S = 0.1
PSF_PX = 0.8


@pytest.fixture(scope="module")
def tracker() -> StarTracker:
    stars = catalog.brighter_than(catalog.read(FILE), 6.0)
    settings = Settings(centroider="gaussian_fit", centroid_sigma_px=0.02, saturation=60_000)
    return StarTracker(CAMERA, stars, stars.vectors, settings)


def attitude(t_s: float) -> Rotation:
    return Rotation.from_rotvec(RATE_RAD_S * t_s) * START


def light_of_stars(tracker: StarTracker, cam_from_ref: Rotation, light: float):
    """Gaussian stars, in electrons."""
    image = np.zeros((CAMERA.height_px, CAMERA.width_px))
    rows, pixels = tracker.field_matcher.in_field(CAMERA, cam_from_ref)
    edges_x = np.arange(CAMERA.width_px + 1) - 0.5
    edges_y = np.arange(CAMERA.height_px + 1) - 0.5
    for (x, y), mag in zip(pixels, tracker.stars.v_mag[rows], strict=True):
        across, down = (
            np.diff(erf((e - at) / (PSF_PX * 2**0.5))) / 2
            for e, at in ((edges_x, x), (edges_y, y))
        )
        image += light * 10 ** (-0.4 * mag) * np.outer(down, across)
    return image


def photograph(
    tracker: StarTracker, cam_from_ref: Rotation, seed: int = 0, light: float = 3e5
):
    """Stars over a sky of 20 electrons, photon and read noise; 16 bits."""
    image = 20 + light_of_stars(tracker, cam_from_ref, light)
    rng = np.random.default_rng(seed)
    return np.clip(rng.poisson(image) + rng.normal(300, 12, image.shape), 0, 65535).astype(
        np.uint16
    )


def off_rad(report, truth: Rotation) -> float:
    return float((report.attitude.cam_from_ref * truth.inv()).magnitude())


def test_the_tracker_searches_once_and_then_tracks(tracker: StarTracker) -> None:
    follower = TrackingMode(tracker)
    reports = [
        follower.solve(photograph(tracker, attitude(t), n), t)
        for n, t in enumerate(np.arange(8) * STEP_S)
    ]
    # Ten stars of a hundredth of a pixel: roll of 20".
    assert max(off_rad(r, attitude(n * STEP_S)) for n, r in enumerate(reports)) < 2e-4
    assert reports[0].expected == 0
    assert reports[0].health & Health.SEARCHED
    # The second frame's prediction knows no rate, but 0.05 deg in a tenth of a second is 2 px, within its windows.
    assert all(r.expected >= 8 and not r.health & Health.SEARCHED for r in reports[1:])
    assert all(r.log10_odds > 10 for r in reports)
    nees = [error(r, attitude(n * STEP_S)) for n, r in enumerate(reports)]
    # chi-square of three degrees, eight times: four deviations.
    assert np.mean(nees) < 3 + 4 * np.sqrt(6 / 8)


def error(report, truth: Rotation) -> float:
    turn = (report.attitude.cam_from_ref * truth.inv()).as_rotvec()
    return float(turn @ np.linalg.solve(report.attitude.covariance_rad2, turn))


def test_the_last_rate_predicts_the_next_frame(tracker: StarTracker) -> None:
    """At 5 deg/s the stars move 22 px a frame: a prediction without the rate, or with its inverse, misses them."""
    follower = TrackingMode(tracker)
    turns = [Rotation.from_rotvec(n * STEP_S * 10 * RATE_RAD_S) for n in range(3)]
    reports = [
        follower.solve(photograph(tracker, turn * START, n), n * STEP_S)
        for n, turn in enumerate(turns)
    ]
    assert [bool(r.health & Health.SEARCHED) for r in reports] == [True, True, False]
    assert off_rad(reports[2], turns[2] * START) < 2e-4


def test_a_prediction_changes_the_volumes_of_attitudes_and_of_lights(
    tracker: StarTracker,
) -> None:
    """The same detections lost in space and followed: the odds differ by two ratios.

    Volumes of attitudes: 8 pi^2, against a boresight within a square of 16 px and a roll of as much over the half field
    of 246.5 px. Places of a light: the sensor, against the windows.
    """
    follower = TrackingMode(tracker)
    follower.solve(photograph(tracker, START), 0.0)
    followed = follower.solve(photograph(tracker, START, 1), STEP_S)
    assert not followed.health & Health.SEARCHED
    lost = tracker.solve_centroids(followed.centroids).match
    match = followed.attitude.match
    assert lost is not None
    assert match is not None
    volume = (16 / CAMERA.focal_px) ** 2 * 16 / 246.5
    places = followed.expected * 16**2 / (CAMERA.width_px * CAMERA.height_px)
    expected = np.log10(8 * np.pi**2 / volume) + len(match.star) * np.log10(places)
    gain = followed.log10_odds + lost.log10_chance
    # The sensor's area by its corners: half a pixel more or less on each side
    assert gain == pytest.approx(expected, abs=0.02 * len(match.star))


@pytest.mark.parametrize("seed", range(4))
def test_lights_anywhere_in_the_windows_are_no_lock(tracker: StarTracker, seed: int) -> None:
    """Where the prediction is wrong, each window has a light at some place: no attitude follows from that."""
    rng = np.random.default_rng(seed)
    follower = TrackingMode(tracker)
    centers_px = follower.window_centers_px(START)
    y, x = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    image = rng.normal(300, 12, x.shape)
    for at in centers_px + rng.uniform(-7, 7, centers_px.shape):
        image += 900 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 2 / 0.8**2)
    follower.last = LastSolution(0.0, START, np.zeros(3))
    report = follower.solve(image.astype(np.uint16), STEP_S)
    assert not report.attitude.solved


def test_a_change_of_the_rate_predicts_the_next_frame_and_is_claimed(
    tracker: StarTracker,
) -> None:
    """At 30 deg/s^2 the fourth frame is 13 px from where the last rate puts it: out of a window of 8 px."""
    follower = TrackingMode(tracker)
    change_rad_s2 = np.radians(30) * np.array([0.6, 0.8, 0.0])
    times_s = STEP_S * np.arange(4)
    turns = [Rotation.from_rotvec(change_rad_s2 * t**2 / 2) for t in times_s]
    reports = [
        follower.solve(photograph(tracker, turn * START, n), t)
        for n, (turn, t) in enumerate(zip(turns, times_s, strict=True))
    ]
    assert not reports[3].health & Health.SEARCHED
    assert off_rad(reports[3], turns[3] * START) < 2e-4
    assert follower.last is not None
    np.testing.assert_allclose(
        follower.last.acceleration_rad_s2, change_rad_s2, rtol=0, atol=0.05
    )
    # The claim: a twelfth of a T^2 along the rate, less for a short streak.
    attitude = reports[3].attitude
    rate = RateEstimate(-change_rad_s2 * 0.25, 1e-6 * np.eye(3))
    follower.last = LastSolution(
        times_s[2], turns[2] * START, change_rad_s2 * 0.15, np.zeros(3), STEP_S
    )
    told = follower._remember(
        times_s[3], replace(attitude, rate=rate), reports[3].centroids, 0.04
    )
    length_px = 0.25 * np.linalg.norm(change_rad_s2) * 0.04 * CAMERA.focal_px
    axis = np.array([0.6, 0.8, 0.0])
    added = axis @ (told.covariance_rad2 - attitude.covariance_rad2) @ axis
    expected = np.radians(30) * 0.04**2 / 12 * length_px / (length_px + 8)
    assert np.sqrt(added) == pytest.approx(expected, rel=0.05)


def test_residuals_of_one_sigma_are_counted_over_2n_less_3(tracker: StarTracker) -> None:
    """Three of the 2 N measured coordinates are spent on the attitude; two stars leave one degree of freedom."""
    rows, pixels = tracker.field_matcher.in_field(CAMERA, START)
    for count in (2, 4, 9):
        xy = pixels[:count] + 0.1
        sigma = np.full(count, 0.1)
        match = StarMatch(np.arange(count), rows[:count], START, -9.0)
        attitude = Attitude("solved", START, np.eye(3), match)
        centroids = Centroids(xy, sigma, np.ones(count))
        report = TrackingMode(tracker)._report(attitude, centroids, sigma, Clock(), None)
        assert report.chi2_per_dof == pytest.approx(2 * count / (2 * count - 3), rel=1e-6)


def test_the_rotation_measured_by_the_gyros_is_followed_at_once(tracker: StarTracker) -> None:
    follower = TrackingMode(tracker)
    follower.solve(photograph(tracker, attitude(0)), 0.0)
    turn = attitude(STEP_S) * attitude(0).inv()
    report = follower.solve(
        photograph(tracker, attitude(STEP_S), 1), STEP_S, now_from_then=turn
    )
    assert report.expected >= 8
    assert off_rad(report, attitude(STEP_S)) < 2e-4


def test_after_a_jump_the_tracker_searches_and_never_answers_wrongly(
    tracker: StarTracker,
) -> None:
    follower = TrackingMode(tracker)
    jumped = Rotation.from_rotvec([0.2, -0.1, 1.0]) * START
    follower.solve(photograph(tracker, START), 0.0)
    report = follower.solve(photograph(tracker, jumped), STEP_S)
    assert report.health & Health.SEARCHED
    assert off_rad(report, jumped) < 2e-4


def test_a_frame_without_stars_is_lost_and_the_next_one_is_tracked(
    tracker: StarTracker,
) -> None:
    follower = TrackingMode(tracker)
    still = [follower.solve(photograph(tracker, START, n), n * STEP_S) for n in range(2)]
    dark = follower.solve(photograph(tracker, START, 5, light=0.0), 0.2)
    again = follower.solve(photograph(tracker, START, 6), 0.3)
    assert dark.health == Health.LOST
    assert dark.attitude.cam_from_ref is None
    assert np.isnan(dark.chi2_per_dof)
    assert [still[1].expected > 0, again.expected > 0] == [True, True]


def test_an_outdated_attitude_is_not_used_for_prediction(tracker: StarTracker) -> None:
    follower = TrackingMode(tracker, max_age_s=1.0)
    follower.solve(photograph(tracker, START), 0.0)
    assert follower.solve(photograph(tracker, START, 1), 1.5).health & Health.SEARCHED
    assert not follower.solve(photograph(tracker, START, 2), 2.0).health & Health.SEARCHED
    # Time ran backwards.
    assert follower.solve(photograph(tracker, START, 2), 1.0).health & Health.SEARCHED


@pytest.mark.parametrize("seed", [1, 2])
def test_no_gap_makes_a_wrong_answer(tracker: StarTracker, seed: int) -> None:
    """Successive dark frames, missing frames, knocks unseen by the gyros and outdated predictions.

    Every frame with stars is solved correctly; after a short gap the gyros' rotation predicts the attitude.
    """
    rng = np.random.default_rng(seed)
    follower = TrackingMode(tracker)
    t_s = 0.0
    truth = START
    then = START
    solved = 0
    followed = 0
    lost = 0
    for n in range(60):
        gap = rng.choice(
            ["none", "dark", "missing", "knock", "stale"], p=[0.5, 0.2, 0.15, 0.1, 0.05]
        )
        step_s = {"missing": rng.uniform(0.3, 3.0), "stale": 6.0}.get(gap, STEP_S)
        t_s = t_s + step_s
        turn = Rotation.from_rotvec(RATE_RAD_S * step_s)
        truth = turn * truth
        if gap == "knock":
            truth = Rotation.from_rotvec(rng.normal(0, 0.3, 3)) * truth
        motion = truth * then.inv() if gap != "knock" else Rotation.identity()
        report = follower.solve(
            photograph(tracker, truth, n, light=0.0 if gap == "dark" else 3e5), t_s, motion
        )
        if gap == "dark":
            assert report.health == Health.LOST
            lost += 1
            continue
        enough = len(tracker.field_matcher.in_field(CAMERA, truth)[0]) >= 8
        assert report.attitude.solved or not enough
        if report.attitude.solved:
            assert off_rad(report, truth) < 1e-3, (n, gap)
            then = truth
            solved = solved + 1
            followed = followed + (report.expected > 0)
    assert solved >= 40
    assert followed >= 0.6 * solved
    assert lost >= 5


def clouded(tracker: StarTracker, share: float) -> TrackedReport:
    """The second frame in tracking mode, with clouds over all but this share of the stars in windows."""
    follower = TrackingMode(tracker)
    follower.solve(photograph(tracker, START), 0.0)
    image = photograph(tracker, START, 1)
    columns = np.sort(follower.window_centers_px(START)[:, 0])
    left = int(columns[round(share * len(columns)) - 1]) + 6
    image[:, left:] = photograph(tracker, START, 2, light=0.0)[:, left:]
    report = follower.solve(image, STEP_S)
    assert off_rad(report, START) < 1e-3
    return report


def test_missing_stars_are_reported_and_too_few_start_a_search(tracker: StarTracker) -> None:
    """A few of many expected stars may be so by chance, and are searched for in the whole frame."""
    assert clouded(tracker, 0.42).health & ~Health.FEW == Health.MISSING
    assert clouded(tracker, 0.2).health & ~Health.FEW == Health.SEARCHED


def test_saturated_and_smeared_stars_have_their_statuses(tracker: StarTracker) -> None:
    follower = TrackingMode(tracker)
    follower.solve(photograph(tracker, START), 0.0)
    bright = follower.solve(photograph(tracker, START, 1, light=2e7), STEP_S)
    assert bright.health & Health.SATURATED
    smeared = np.mean(
        [photograph(tracker, shifted(x), 2) for x in np.linspace(-4.5, 4.5, 19)], axis=0
    )
    quick = follower.solve(smeared.astype(np.uint16), 2 * STEP_S, streak_px=(9.0, 0.0))
    assert quick.health & Health.SMEARED
    assert off_rad(quick, START) < 1e-3


def shifted(x_px: float) -> Rotation:
    """The initial attitude rotated to shift the stars this far, px, to the right."""
    return Rotation.from_rotvec([0, x_px / CAMERA.focal_px, 0]) * START


def test_tracking_with_an_uncertain_camera_is_refused() -> None:
    stars = catalog.brighter_than(catalog.read(FILE), 5.0)
    with pytest.raises(ValueError, match=r"focal_uncertainty is 0\.05; allowed: 0"):
        TrackingMode(StarTracker(CAMERA, stars, stars.vectors, focal_uncertainty=0.05))


def test_another_camera_s_frame_is_bad_input(tracker: StarTracker) -> None:
    follower = TrackingMode(tracker)
    follower.solve(photograph(tracker, START), 0.0)
    with pytest.raises(ImageError, match="the image is 600x493 pixels"):
        follower.solve(photograph(tracker, START)[:, :600], STEP_S)


def test_a_window_holds_its_star_and_no_other(tracker: StarTracker) -> None:
    image = photograph(tracker, START)
    rows, pixels = tracker.field_matcher.in_field(CAMERA, START)
    bright = pixels[tracker.stars.v_mag[rows] < 4.5]
    blobs = in_windows(image, bright + np.array([2.0, -1.0]), 6.0, 4.0)
    nearest = np.abs(blobs.xy_px[:, None] - bright).max(axis=2).min(axis=1)
    assert len(blobs) == len(bright)
    assert nearest.max() < 0.3  # the middle of a blob, no centroid yet
    assert len(in_windows(image, np.repeat(bright[:1], 3, axis=0), 6.0, 4.0)) == 1
    dark = photograph(tracker, START, 1, light=0.0)
    assert len(in_windows(dark, bright, 6.0, 6.0)) == 0


def test_most_stars_of_four_to_five_sigma_are_found_in_their_windows(
    tracker: StarTracker,
) -> None:
    """In the filtered image; by a threshold of 4 sigma seven in ten are, by that of a frame, 5 sigma, three in ten."""
    found = []
    for light in np.geomspace(1.5e4, 6e4, 8):
        filtered = ndimage.correlate(
            light_of_stars(tracker, START, light), np.outer([1, 2, 1], [1, 2, 1]) / 16
        )
        filtered = ndimage.maximum_filter(filtered, 5)
        follower = TrackingMode(tracker)
        centers_px = follower.window_centers_px(START)
        x, y = np.rint(centers_px).astype(int).T
        sigmas = filtered[y, x] / (0.375 * np.hypot(12, np.sqrt(20)))
        faint = centers_px[(sigmas > 4) & (sigmas < 5)]
        for seed in range(3):
            follower.last = LastSolution(0.0, START, np.zeros(3))
            xy_px = follower.solve(
                photograph(tracker, START, seed, light), STEP_S
            ).centroids.xy_px
            found += (
                np.linalg.norm(xy_px[:, None] - faint, axis=2).min(axis=0, initial=np.inf) < 2
            ).tolist()
    assert len(found) > 30
    assert np.mean(found) > 0.55
