"""Classification of blobs by flags, on independently drawn frames."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import erf

from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Blobs, Centroids, FramePriors, RateEstimate
from estimator.detection import classify, detect
from estimator.detection.classify import NO_STAR, Flag
from estimator.trackers.pipeline import Clock, FrameTracker, Settings, detect_and_centroid
from tests.helpers import drawn_frames as frames

SHAPE = (493, 659)
CAMERA = Camera.from_fov(659, 493, np.radians(14.87))


def star(
    x: float, y: float, flux: float, sigma: float, shape: tuple[int, int] = SHAPE
) -> np.ndarray:
    """A Gaussian integrated over each pixel."""
    down, across = (
        np.diff(erf((np.arange(n + 1) - 0.5 - at) / (sigma * 2**0.5))) / 2
        for n, at in zip(shape, (y, x), strict=True)
    )
    return flux * np.outer(down, across)


def sky_frame(
    rng: np.random.Generator, stars: int, sigma: float, shape: tuple[int, int] = SHAPE
):
    """Light of stars of 4,000 to 40,000 electrons on a lattice, and their positions."""
    step = 80
    lattice = [
        (x, y) for y in range(60, shape[0] - 40, step) for x in range(60, shape[1] - 40, step)
    ]
    xy = np.array(lattice, float)[rng.permutation(len(lattice))[:stars]] + rng.uniform(
        -10, 10, (stars, 2)
    )
    light = sum(star(x, y, rng.uniform(4e3, 4e4), sigma, shape) for x, y in xy)
    return light, xy


def exposed(rng: np.random.Generator, light: np.ndarray, noise: float = 12.0) -> np.ndarray:
    image = rng.poisson(light) + rng.normal(300, noise, light.shape)
    return np.rint(image).clip(0, 65535).astype(np.uint16)


def flags_near(blobs: Blobs, x: float, y: float) -> int:
    """The flags of the blob whose box holds a pixel."""
    x0, y0, x1, y1 = blobs.box_px.T
    inside = (x0 - 1 <= x) & (x <= x1 + 1) & (y0 - 1 <= y) & (y <= y1 + 1)
    assert inside.sum() == 1
    return int(blobs.flag[inside][0])


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.45, 0.7, 1.0, 2.0])
def test_stars_are_not_flagged(sigma: float) -> None:
    rng = np.random.default_rng(40)
    flags = []
    for _ in range(10):
        light, _ = sky_frame(rng, 20, sigma)
        flags.append(detect.default(exposed(rng, light)).flag)
    assert len(np.concatenate(flags)) == 200
    assert np.concatenate(flags).tolist() == [0] * 200


@pytest.mark.compiles
def test_hot_pixels_are_flagged_and_left_out() -> None:
    rng = np.random.default_rng(41)
    light, xy = sky_frame(rng, 15, 0.7)
    image = exposed(rng, light)
    hot = [(25, 25), (105, 110), (333, 265), (640, 480)]
    for k, (x, y) in enumerate(hot):
        image[y, x] += (800, 3000, 20_000, 60_000)[k]
    blobs = detect.default(image)
    assert [flags_near(blobs, x, y) for x, y in hot] == [Flag.HOT] * 4
    found = detect_and_centroid(image, CAMERA, Settings(centroider="gaussian_fit"), Clock())
    assert len(found) == len(xy)
    assert off_px(found, xy).max() < 0.1


def off_px(found: Centroids, places: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found.xy_px[None] - places[:, None], axis=2).min(axis=1)


@pytest.mark.compiles
@pytest.mark.parametrize("angle_deg", [10.0, 45.0, 100.0, 170.0])
def test_a_track_among_round_stars_is_flagged(angle_deg: float) -> None:
    rng = np.random.default_rng(42)
    light, _ = sky_frame(rng, 15, 0.7)
    angle = np.radians(angle_deg)
    for along in np.arange(-12, 12, 0.25):
        light += star(340 + along * np.cos(angle), 262 + along * np.sin(angle), 300, 0.3)
    blobs = detect.default(exposed(rng, light))
    assert flags_near(blobs, 340, 262) == Flag.TRACK
    assert np.count_nonzero(blobs.flag) == 1


def test_the_moon_is_flagged_and_its_neighborhood_is_not() -> None:
    # 0.52 deg at 14.87 deg a row of 659 is a disk of 23 px, blurred by its own glare.
    rng = np.random.default_rng(43)
    light, xy = sky_frame(rng, 15, 0.7)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    r = np.hypot(x - 345.3, y - 258.1)
    light += 4e4 / (1 + np.exp((r - 11.5) / 1.2)) + 300 * np.exp(-r / 12)
    blobs = detect.default(exposed(rng, light))
    assert flags_near(blobs, 345, 258) & Flag.HUGE
    far = np.hypot(*(xy - (345, 258)).T) > 60
    assert not any(flags_near(blobs, *place) & NO_STAR for place in xy[far])


def test_an_led_is_not_flagged_as_moon() -> None:
    # Reference section 2: a 2 mm LED is a disk of 20.8 px on the 1600x1200 camera; all disks are alike.
    rng = np.random.default_rng(44)
    light = np.zeros((1200, 1600))
    y, x = np.mgrid[-20:21, -20:21]
    for cx, cy in rng.uniform(100, 1100, (8, 2)).round().astype(int):
        light[cy - 20 : cy + 21, cx - 20 : cx + 21] += 2e4 / (
            1 + np.exp((np.hypot(x, y) - 10.4) / 0.5)
        )
    blobs = detect.default(exposed(rng, light))
    assert len(blobs) == 8
    assert blobs.flag.tolist() == [0] * 8


def test_branches_are_flagged_as_texture() -> None:
    # The lower fifth of the frame is as rough as foliage under a street lamp.
    rng = np.random.default_rng(45)
    light, xy = sky_frame(rng, 15, 0.7)
    rough = rng.uniform(0, 1, (33, 220)).repeat(3, 0).repeat(3, 1)
    light[-99:] += 3000 * rough[:, :659]
    blobs = detect.default(exposed(rng, light))
    middle_y = blobs.box_px[:, [1, 3]].mean(axis=1)
    low = middle_y > SHAPE[0] - 90
    assert np.all(blobs.flag[low] & NO_STAR)
    clear = xy[xy[:, 1] < SHAPE[0] - 170]
    assert len(clear) >= 5
    assert [flags_near(blobs, *place) for place in clear] == [0] * len(clear)


@pytest.mark.slow
def test_smeared_stars_are_no_tracks_and_give_the_frame_s_streak() -> None:
    rng = np.random.default_rng(46)
    light = np.zeros(SHAPE)
    for x, y in sky_frame(rng, 15, 0.7)[1]:
        for t in np.arange(-0.5, 0.5, 0.02) + 0.01:
            light += star(x + 10 * t, y - 6 * t, 400, 0.7)
    blobs = detect.default(exposed(rng, light))
    assert len(blobs) == 15
    assert np.all(blobs.flag == 0)
    assert blobs.streak_px is not None
    x, y = blobs.streak_px
    # Second moments of pixels above the noise fall short of the whole streak's by the ends that sink in it.
    assert np.hypot(x, y) == pytest.approx(np.hypot(10, 6), rel=0.1)
    assert np.degrees(np.arctan(y / x)) == pytest.approx(np.degrees(np.arctan(-0.6)), abs=3)


def smeared_frame(
    rng: np.random.Generator, streak: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """A frame of 15 streaks, drawn in steps below half a pixel, and their centers."""
    steps = 4 * int(np.hypot(*streak)) + 1
    light = np.zeros(SHAPE)
    xy = sky_frame(rng, 15, 0.7)[1]
    for at in xy:
        corner = np.rint(at).astype(int) - 12
        for t in (np.arange(steps) + 0.5) / steps - 0.5:
            patch = star(*(at + t * np.array(streak) - corner), 2e4 / steps, 0.7, (25, 25))
            light[corner[1] : corner[1] + 25, corner[0] : corner[0] + 25] += patch
    return exposed(rng, light), xy


@pytest.mark.parametrize("streak", [(2.5, 1.0), (4.0, -3.0)])
def test_a_short_streak_is_found_and_centered_without_a_gyro_as_with_one(
    streak: tuple[float, float],
) -> None:
    """A round-star fit of a short streak would double the error and understate it."""
    image, xy = smeared_frame(np.random.default_rng(47), streak)
    alone, guided = (
        detect_and_centroid(image, CAMERA, Settings(), Clock(), known)
        for known in (None, streak)
    )
    rms_px = [np.sqrt(np.mean(off_px(found, xy) ** 2)) for found in (alone, guided)]
    assert len(alone) == len(guided) == 15
    assert rms_px[0] < 1.1 * rms_px[1] < 0.06


def test_a_hot_pixel_in_a_smeared_frame_is_not_taken_for_a_star() -> None:
    image, _ = smeared_frame(np.random.default_rng(48), (3.5, 2.0))
    hot = [(25, 25), (640, 480)]
    for x, y in hot:
        image[y, x] += 20_000
    for known in (None, (3.5, 2.0)):
        blobs = detect.default(image, priors=FramePriors(known))
        assert [flags_near(blobs, x, y) for x, y in hot] == [Flag.HOT] * 2
        assert np.count_nonzero(blobs.flag == 0) == 15


def rolled_frame(seed: int, turn_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A frame of 15 stars while the camera rotates by this (3,) vector, and their positions at mid-exposure."""
    rng = np.random.default_rng(seed)
    light = np.zeros(SHAPE)
    xy = sky_frame(rng, 15, 0.7)[1]
    rays = CAMERA.rays(xy)
    for part in (np.arange(120) + 0.5) / 120 - 0.5:
        for at in CAMERA.pixels(Rotation.from_rotvec(-part * turn_rad).apply(rays)):
            x, y = np.rint(at).astype(int) - 6
            light[y : y + 13, x : x + 13] += star(*(at - [x, y]), 2e4 / 120, 0.7, (13, 13))
    return exposed(rng, light), xy


HOT_PX = [(25, 25), (640, 480), (8, 250), (650, 8)]


@pytest.mark.parametrize("rate_known", [False, True])
@pytest.mark.parametrize("streak", [(0.0, 0.0), (4.0, 0.0), (10.0, -6.0), (20.0, 5.0)])
@pytest.mark.parametrize("turn_rad", [0.025, -0.045])
def test_streaks_that_differ_by_a_roll_are_stars(
    streak: tuple[float, float], turn_rad: float, rate_known: bool
) -> None:
    """By 20 or 37 px between opposite corners; the four brightest lights are hot pixels. From a gyro or the frame."""
    across = np.array([streak[1], -streak[0]]) / CAMERA.focal_px
    image, xy = rolled_frame(49, np.array([*across, -turn_rad]))
    for x, y in HOT_PX:
        image[y, x] += 20_000
    rate = (
        RateEstimate(np.array([*across, -turn_rad]) / 0.1, 1e-12 * np.eye(3))
        if rate_known
        else None
    )
    tracker = FrameTracker()
    tracker.camera = CAMERA
    tracker.settings = Settings()
    tracker.solve_centroids = lambda *_, **__: Attitude("no_solution")
    seen = tracker.solve(image, None, rate, 0.1).centroids
    assert len(seen) == 15
    assert off_px(seen, xy).max() < 0.15
    assert seen.covariance_px2 is not None
    nearest = np.linalg.norm(seen.xy_px[None] - xy[:, None], axis=2).argmin(axis=1)
    error = (seen.xy_px[nearest] - xy)[:, :, None]
    chi2 = np.swapaxes(error, 1, 2) @ np.linalg.solve(seen.covariance_px2[nearest], error)
    assert chi2.mean() < 2 * 2  # where an arc's mean were taken for its middle, up to 2 * 13
    blobs = detect.default(image)
    assert [flags_near(blobs, x, y) & Flag.HOT for x, y in HOT_PX] == [Flag.HOT] * 4
    assert np.count_nonzero(blobs.flag == 0) == 15
    assert blobs.streak_px is not None
    if any(streak):  # the sign of one frame is arbitrary
        turn_rad *= np.sign(np.dot(blobs.streak_px, streak))
        assert blobs.turn_rad == pytest.approx(turn_rad, rel=0.1)
        assert np.abs(blobs.streak_px) == pytest.approx(np.abs(streak), abs=0.5)


def test_a_track_among_streaks_of_a_roll_is_flagged() -> None:
    image, _ = rolled_frame(49, np.array([0.0, 10.0 / CAMERA.focal_px, 0.03]))
    track = sum(star(20 + t, 20 - t, 900.0, 0.7, (41, 41)) for t in np.arange(-12, 12, 0.25))
    image[240:281, 290:331] += np.rint(track).astype(np.uint16)
    blobs = detect.default(image)
    assert blobs.turn_rad != 0
    assert blobs.flag[blobs.flag != 0].tolist() == [Flag.TRACK]
    assert flags_near(blobs, 310, 260) == Flag.TRACK


def add_line(light: np.ndarray, at: tuple[int, int], angle: float) -> None:
    """Draw a line of 16 px in the 41 pixels from a place."""
    for t in np.arange(-8, 8, 0.25):
        x = 20 + t * np.cos(angle)
        y = 20 + t * np.sin(angle)
        light[at[1] : at[1] + 41, at[0] : at[0] + 41] += star(x, y, 900.0, 0.7, (41, 41))


@pytest.mark.parametrize("angle_deg", [12.0, 75.0])
def test_a_faint_track_in_pieces_is_flagged(angle_deg: float) -> None:
    """Near the threshold a line is many blobs: of up to 24 at most two are left, and no star is taken for a piece."""
    rng = np.random.default_rng(53)
    angle = np.radians(angle_deg)
    light, xy = sky_frame(rng, 25, 0.7)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] - np.array([240.0, 320.0])[:, None, None]
    along = x * np.cos(angle) + y * np.sin(angle)
    across = y * np.cos(angle) - x * np.sin(angle)
    track = np.where(np.abs(along) < 230, np.exp(-(across**2) / (2 * 0.7**2)), 0.0)
    pieces = []
    left = []
    for peak in (24.0, 27.0, 30.0):
        blobs = detect.default(exposed(rng, light + peak * track))
        away = np.linalg.norm(blobs.xy_px[:, None] - xy, axis=2).min(axis=1) > 3
        # A star may be on the line.
        assert np.count_nonzero(~away & (blobs.flag == 0)) >= len(xy) - 1
        pieces.append(np.count_nonzero(away))
        left.append(np.count_nonzero(away & (blobs.flag & NO_STAR == 0)))
    assert max(pieces) >= 20
    assert max(left) <= 2, (pieces, left)


def test_tracks_among_round_stars_are_not_taken_for_a_roll() -> None:
    """Any two of three tracks would give a roll, but the stars are round."""
    rng = np.random.default_rng(50)
    light, _ = sky_frame(rng, 15, 0.7)
    for at, angle in (((20, 20), 0.4), ((560, 20), 2.0), ((20, 430), 1.2)):
        add_line(light, at, angle)
    blobs = detect.default(exposed(rng, light))
    assert blobs.turn_rad == 0
    assert np.count_nonzero(blobs.flag == Flag.TRACK) == 3
    assert np.count_nonzero(blobs.flag == 0) == 15


def test_three_tracks_are_not_taken_for_a_roll() -> None:
    """Any two lines agree with some roll, so five are required."""
    light = np.zeros(SHAPE)
    for at, angle in (((100, 100), 0.4), ((500, 120), 2.0), ((220, 400), 1.2)):
        add_line(light, at, angle)
    blobs = detect.default(exposed(np.random.default_rng(52), light))
    assert len(blobs) == 3
    assert blobs.turn_rad == 0


@pytest.mark.parametrize(("peak_sigma", "flag"), [(6.0, 0), (30.0, Flag.TRACK)])
def test_only_a_clear_line_is_a_track_among_streaks(peak_sigma: float, flag: int) -> None:
    """Lines across the streak that the gyros predict; the shape of a line of 6 sigma per pixel is mostly noise."""
    rng = np.random.default_rng(51)
    light = np.zeros(SHAPE)
    # The peak of a line of so much light per pixel of its length is that over sqrt(2 pi) sigma.
    flux = peak_sigma * 12.0 * np.sqrt(2 * np.pi) * 0.7 * 0.25
    line = sum(
        star(12 + 0.5 * t, 12 + 0.86 * t, flux, 0.7, (25, 25)) for t in np.arange(-6, 6, 0.25)
    )
    places = [(x, y) for x in (150, 300, 450) for y in (120, 360)]
    for x, y in places:
        light[y - 12 : y + 13, x - 12 : x + 13] += line
    image = exposed(rng, light)
    blobs = classify.classify(image, detect.default(image), FramePriors((10.0, -6.0)))
    assert [flags_near(blobs, x, y) for x, y in places] == [flag] * len(places)


def trailed_frame(seed: int, flux_per_px: float, spread: float) -> np.ndarray:
    """A frame of 15 trails of 45 px, longer or shorter by a relative standard deviation; the first five are bright."""
    rng = np.random.default_rng(seed)
    light = np.zeros(SHAPE)
    places = [(x, y) for y in (80, 240, 400) for x in (70, 190, 310, 430, 550)]
    for row, (x, y) in enumerate(places):
        length = 45 * (1 + spread * rng.standard_normal())
        flux = 600.0 if row < 5 else flux_per_px
        for along in np.arange(0.25, length, 0.5) - length / 2:
            patch = star(35 + 0.8 * along, 35 + 0.6 * along, flux / 2, 0.8, (71, 71))
            light[y - 35 : y + 36, x - 35 : x + 36] += patch
    return exposed(rng, light)


def test_long_streaks_that_differ_by_a_few_percent_are_stars() -> None:
    """Of 45 px: at 5 % the squared lengths, 2,000 px^2, differ by 200, far more than a track of 6 px."""
    blobs = detect.default(trailed_frame(60, 600.0, 0.05))
    assert len(blobs) == 15
    assert blobs.flag.tolist() == [0] * 15
    assert np.hypot(*blobs.streak_px) == pytest.approx(45, rel=0.08)


def test_streaks_that_break_up_into_pieces_are_found_whole() -> None:
    """Ten of 15 trails are just above the noise of a pixel; the bright ones give the length of all."""
    image = trailed_frame(61, 60.0, 0.02)
    background = detect.estimate_background(image)
    pieces = detect.detect_blobs(
        image, background, 5.0 * background.noise, 3, 100, detect.GROW_SIGMA
    )
    assert len(pieces) > 20
    blobs = detect.default(image)
    assert len(blobs) == 15
    assert np.degrees(np.arctan2(blobs.streak_px[1], blobs.streak_px[0])) == pytest.approx(
        36.9, abs=5
    )
    assert np.hypot(*blobs.streak_px) == pytest.approx(45, rel=0.1)


@pytest.mark.parametrize("height_px", [24, 30])
def test_a_caption_is_flagged_as_text_and_gives_no_streak(height_px: int) -> None:
    """Most of the brightest lights are letters, some of them vertical lines."""
    rng = np.random.default_rng(62)
    light, xy = sky_frame(rng, 15, 0.8)
    image = exposed(rng, light)
    mask = np.zeros(SHAPE, np.uint8)
    cv2.putText(
        mask, "2012-06-22 11:11:14", (30, 48), cv2.FONT_HERSHEY_DUPLEX, height_px / 22, 255, 1
    )
    image[mask > 128] = 60_000
    blobs = detect.default(image)
    far = xy[xy[:, 1] > 70]
    assert [flags_near(blobs, *place) for place in far] == [0] * len(far)
    assert blobs.streak_px is None
    written = (blobs.box_px[:, 3] < 65) & (blobs.peak == 60_000)
    assert written.sum() > 10
    assert np.all(blobs.flag[written] & NO_STAR)
    assert np.count_nonzero(blobs.flag[written] & Flag.TEXT) >= written.sum() - 1


def test_streaks_side_by_side_are_not_flagged_as_text() -> None:
    """Their boxes have the size of the filter: all are equally high, and rounding makes their widths differ."""
    light = np.zeros(SHAPE)
    for n, x in enumerate(range(20, 600, 30)):
        light[100 + n % 4 : 200 + n % 4, x] = 60.0
    light = cv2.GaussianBlur(light, (0, 0), 0.8)
    image = exposed(np.random.default_rng(3), light)
    blobs = detect.default(image, priors=FramePriors((0.6, 100.0)))
    assert len(blobs) >= 20
    assert not (blobs.flag & Flag.TEXT).any()


def test_rows_of_equal_lights_are_not_flagged_as_text() -> None:
    """LEDs are disks of one size and may be in a row; letters differ in width."""
    light = np.zeros(SHAPE)
    y, x = np.mgrid[-12:13, -12:13]
    for at in range(60, 600, 26):
        light[188:213, at - 12 : at + 13] += 2e4 / (1 + np.exp((np.hypot(x, y) - 7) / 0.4))
    blobs = detect.default(exposed(np.random.default_rng(63), light))
    assert blobs.flag.tolist() == [0] * 21


@pytest.mark.compiles
@pytest.mark.parametrize("seed", [2, 50, 84])
def test_columns_of_readout_smear_are_not_taken_for_streaks(seed: int) -> None:
    """Saturated stars leave columns from border to border: they are parallel, but no star moved along them."""
    setup = frames.SETUPS[3]
    stars = catalog.hipparcos()
    image, truth = frames.render(setup, stars, np.random.default_rng([1, seed]))
    blobs = detect.default(image, priors=FramePriors(None, setup.depth))
    assert blobs.streak_px is None
    xy_px = setup.camera.pixels(truth.apply(stars.vectors[stars.v_mag < 5.5]))
    bright = xy_px[setup.camera.contains(np.nan_to_num(xy_px, nan=-1e9), 20.0)]
    off_px = np.linalg.norm(
        bright[:, None] - blobs.xy_px[blobs.flag & NO_STAR == 0], axis=2
    ).min(axis=1)
    assert np.mean(off_px < 2) >= 0.6


@pytest.mark.parametrize("centroider", ["cog", "gaussian_window", "gaussian_fit"])
@pytest.mark.parametrize("over", [2.0, 10.0])
def test_saturated_stars_are_kept_with_a_sigma_that_covers_them(
    centroider: str, over: float
) -> None:
    rng = np.random.default_rng(47)
    full = 60_000
    settings = Settings(centroider=centroider, saturation=full)
    scaled = []
    flags = []
    for _ in range(4):
        xy = sky_frame(rng, 15, 1.0)[1]
        light = sum(star(x, y, over * full * 2 * np.pi, 1.0) for x, y in xy)
        image = exposed(rng, light).clip(0, full)
        flags.append(detect.default(image, priors=FramePriors(saturation=full)).flag)
        found = detect_and_centroid(image, CAMERA, settings, Clock())
        assert len(found) == 15
        scaled.append(off_px(found, xy) / found.sigma_px.mean())
    assert np.all(np.concatenate(flags) == Flag.SATURATED)
    # A sigma an axis, so 2 degrees of freedom: safe, and not by more than ten times.
    assert 2 / 100 < np.mean(np.concatenate(scaled) ** 2) < 2 or centroider == "gaussian_fit"
    assert np.mean(np.concatenate(scaled) ** 2) < 2


@pytest.mark.slow
@pytest.mark.parametrize("centroider", ["cog", "gaussian_fit"])
def test_a_star_on_a_replaced_pixel_has_its_claimed_sigma(centroider: str) -> None:
    rng = np.random.default_rng(48)
    off = []
    claimed_px = []
    for _ in range(12):
        light, xy = sky_frame(rng, 15, 0.8)
        image = exposed(rng, light)
        bad = np.rint(xy).astype(int) + rng.integers(-1, 2, (15, 2))
        image[bad[:, 1], bad[:, 0]] = rng.choice([0, 65535], 15)
        found = detect_and_centroid(
            image, CAMERA, Settings(centroider=centroider, bad_px=bad), Clock()
        )
        rows = np.linalg.norm(found.xy_px[None] - xy[:, None], axis=2).argmin(axis=1)
        off.append(found.xy_px[rows] - xy)
        claimed_px.append(found.sigma_px[rows])
    chi2 = np.mean((np.concatenate(off) / np.concatenate(claimed_px)[:, None]) ** 2)
    # 360 numbers that are not Gaussian (a bad pixel on the peak is worse than one beside it): within a factor of 2.
    assert 0.5 < chi2 < 2


def test_a_bad_pixel_far_from_any_star_is_not_detected() -> None:
    rng = np.random.default_rng(49)
    light, _ = sky_frame(rng, 10, 0.8)
    image = exposed(rng, light)
    bad = np.array([(20, 20), (21, 20), (20, 21), (650, 5), (0, 0)])
    image[bad[:, 1], bad[:, 0]] = 65535
    mended = detect.replace_bad_pixels(image, bad)
    assert mended[bad[:, 1], bad[:, 0]].max() < 300 + 5 * 12
    assert image[20, 20] == 65535
    assert len(detect.default(mended)) == 10


def test_a_bad_pixel_gets_the_median_of_its_good_neighbors() -> None:
    """Within one pixel; of nine bad ones the middle gets that of those within two; at corners and edges too."""
    image = np.random.default_rng(48).uniform(100, 200, (12, 15))
    block = [(x, y) for x in (6, 7, 8) for y in (4, 5, 6)]
    bad = np.array([(0, 0), (14, 0), (14, 11), (0, 7), (3, 11), (11, 9), (12, 9), *block])
    good = np.full((16, 19), np.nan)
    good[2:-2, 2:-2] = image
    good[bad[:, 1] + 2, bad[:, 0] + 2] = np.nan
    wanted = image.copy()
    for x, y in bad:
        near = good[y + 1 : y + 4, x + 1 : x + 4]
        far = good[y : y + 5, x : x + 5]
        wanted[y, x] = np.nanmedian(far if np.isnan(near).all() else near)
    np.testing.assert_array_equal(detect.replace_bad_pixels(image, bad), wanted)


def test_a_bad_pixel_off_the_sensor_is_refused() -> None:
    with pytest.raises(
        ImageError, match="the bad-pixel map reaches beyond the frame of 659x493 pixels"
    ):
        detect.replace_bad_pixels(np.eye(493, 659), np.array([(659, 3)]))


def test_a_frame_without_blobs_has_no_flags() -> None:
    image = np.random.default_rng(50).normal(300, 5, (128, 128))
    blobs = detect.default(image, 20.0)
    assert len(blobs) == len(classify.classify(image, blobs, FramePriors()).flag) == 0
