"""Laws of detection, centroids and the stages about them, on any frame; of camera and attitude for any directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as some
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from scipy.ndimage import convolve
from scipy.spatial.transform import Rotation

from estimator.attitude import solvers
from estimator.attitude.solvers import SOLVERS
from estimator.centroiding import centroid
from estimator.centroiding.centroid import CENTROIDERS
from estimator.core import camera
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.types import (
    NO_SPREAD,
    Attitude,
    Blobs,
    Centroids,
    FramePriors,
    ra_dec_roll_rad,
)
from estimator.detection import background, bayer, classify, components, detect, windows
from estimator.detection.classify import Flag
from estimator.detection.detect import DETECTORS
from estimator.identification.star_detections import Sensor, detections_of
from estimator.trackers import pipeline
from estimator.trackers.pipeline import Clock, Settings
from tests.helpers.laws import (
    ANY,
    NUMBERS,
    SEEDS,
    answered,
    assert_covariance,
    law,
    turn,
    units,
)
from tests.helpers.lens_and_streak import streak_ends

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]
WIDTH = 90
HEIGHT = 70
CAMERA = Camera.from_fov(WIDTH, HEIGHT, 0.3)
# Those that compiled code is compiled for once, and any other.
KINDS = some.sampled_from(["u2", "f8", ">f8"])
EVERY_KIND = some.sampled_from(
    ["?", "u1", "i1", "<u2", ">u2", ">i4", "u8", "f2", ">f4", "f8", "c8", "S3", "O"]
)
FRAMES = KINDS.flatmap(lambda kind: arrays(kind, (HEIGHT, WIDTH), fill=some.just(0)))
STREAKS = some.none() | some.tuples(some.floats(-15, 15), some.floats(-15, 15))
BINOMIAL = np.outer([1, 2, 1], [1, 2, 1]) / 16


def starry(
    rng: np.random.Generator, kind: str = "f8", smear_px: float = 0.0
) -> tuple[NDArray, Floats]:
    """A noisy sky with stars that are alone, smeared along x, and their places."""
    places = np.array([(x, y) for x in (15, 44, 74) for y in (14, 35, 56)]) + rng.uniform(
        -2, 2, (9, 2)
    )
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    frame = rng.normal(100.0, 5, (HEIGHT, WIDTH))
    for at_x, at_y in places:
        for shift in np.linspace(-smear_px / 2, smear_px / 2, 21):
            frame += rng.uniform(150, 180) * np.exp(
                -((x - at_x - shift) ** 2 + (y - at_y) ** 2) / 2.88
            )
    return frame.astype(kind), places


def assert_inside(blobs: Blobs, most: int) -> None:
    """Check that boxes are within the frame, sorted by brightness, at most `most`, with known flags."""
    assert len(blobs) <= most
    assert (blobs.box_px >= 0).all()
    assert (blobs.box_px[:, [0, 2]] < WIDTH).all()
    assert (blobs.box_px[:, [1, 3]] < HEIGHT).all()
    assert (np.diff(blobs.flux) <= 0).all()
    assert (blobs.flag & ~int(~Flag(0)) == 0).all()


# Detection


@law(
    detect.prepare_image,
    detect.check_image,
    detect.check_monochrome,
    detect.check_size,
    detect.to_native,
)
@given(
    image=EVERY_KIND.flatmap(
        lambda kind: arrays(kind, array_shapes(max_dims=3, min_side=0, max_side=20))
    )
)
def test_any_array_is_taken_with_its_values_or_refused(image: NDArray) -> None:
    prepared = answered(lambda: detect.prepare_image(image), ImageError)
    assert prepared is None or (
        prepared.ndim == 2 and prepared.dtype.isnative and min(prepared.shape) >= 16
    )
    assert prepared is None or (np.isfinite(prepared).all() and (prepared == image).all())


@law(*DETECTORS.values(), slow=True)
@given(
    rng=SEEDS,
    hostile=FRAMES,
    name=some.sampled_from(sorted(DETECTORS)),
    streak_px=STREAKS,
    most=some.integers(1, 12),
)
def test_blobs_lie_in_the_frame(
    rng: np.random.Generator,
    hostile: NDArray,
    name: str,
    streak_px: tuple[float, float] | None,
    most: int,
) -> None:
    answered(
        lambda: DETECTORS[name](hostile, 5.0, 3, most, FramePriors(streak_px, np.inf)),
        ImageError,
    )
    frame, _ = starry(rng)
    assert_inside(DETECTORS[name](frame, 5.0, 3, most, FramePriors(streak_px, 3000.0)), most)


@law(detect.local, detect.default, detect.components)
@given(
    rng=SEEDS,
    up=some.integers(1, 500),
    name=some.sampled_from(["default", "local", "components"]),
)
def test_a_brighter_sky_hides_no_star(rng: np.random.Generator, up: int, name: str) -> None:
    frame, places = starry(rng)
    low, high = (DETECTORS[name](frame + more, 5.0, 3, 50, FramePriors()) for more in (0, up))
    assert len(low) == len(high)
    near = np.linalg.norm(low.xy_px[:, None] - places, axis=2)
    assert (near.min(axis=0) < 1).all()  # every star
    np.testing.assert_allclose(high.xy_px, low.xy_px, rtol=0, atol=1e-6)


@law(
    detect.detect_blobs,
    detect.detect_streaks,
    detect.detect_faint_streaks,
    detect.in_full_length,
    detect.flat_background,
    background.estimate_background,
    slow=True,
)
@given(rng=SEEDS, streak_px=STREAKS.filter(bool), sigma=some.floats(3, 9))
def test_a_lower_threshold_finds_fainter_objects(
    rng: np.random.Generator, streak_px: tuple[float, float], sigma: float
) -> None:
    frame, _ = starry(rng)
    sky = background.estimate_background(frame)
    flat = detect.flat_background(frame)
    assert sky.level.min() <= flat.level.item() <= sky.level.max()
    found = [
        detect.detect_blobs(frame, flat, more * flat.noise, 1, 99)
        for more in (sigma, sigma + 1)
    ]
    for blobs in found:
        assert_inside(blobs, 99)
    assert found[0].area_px.sum() >= found[1].area_px.sum()
    assert_inside(detect.detect_streaks(frame, sky, sigma, 99, FramePriors(streak_px)), 99)
    faint = detect.detect_faint_streaks(frame, sky, sigma, 99, FramePriors())
    assert_inside(faint, 99)
    assert_inside(
        detect.in_full_length(
            frame, replace(faint, streak_px=streak_px), sigma, 99, FramePriors()
        ),
        99,
    )


@law(components.runs_above, background.estimate_background, background.accumulator_type)
@given(rng=SEEDS, threshold=some.floats(90, 300), kind=some.sampled_from(["u2", "f8"]))
def test_runs_match_a_plain_filter_above_threshold(
    rng: np.random.Generator, threshold: float, kind: str
) -> None:
    frame, _ = starry(rng, kind)
    runs = components.runs_above(frame, np.full((1, 1), threshold))
    in_runs = np.zeros(frame.shape, bool)
    for y, first, last in runs:
        in_runs[y, first : last + 1] = True
    np.testing.assert_array_equal(
        in_runs, convolve(frame.astype(float), BINOMIAL, mode="nearest") > threshold
    )
    lower, higher = (
        background.estimate_background(frame + np.array(more, kind)) for more in (0, 50)
    )
    # By the median's own steps.
    np.testing.assert_allclose(higher.level - lower.level, 50, rtol=0, atol=0.3)
    for pixel in ("u1", "i1", "u2", "i2"):
        assert (
            np.iinfo(background.accumulator_type(np.dtype(pixel))).max
            >= 16 * np.iinfo(pixel).max
        )


@law(detect.line_taps, detect.noise_factor)
@given(some.tuples(some.floats(-60, 60), some.floats(-60, 60)))
def test_a_line_filter_keeps_less_noise_and_has_no_direction(
    streak_px: tuple[float, float],
) -> None:
    taps = detect.line_taps(streak_px)
    assert sorted(map(tuple, taps)) == sorted(map(tuple, -taps))
    assert (np.abs(taps) <= np.abs(streak_px) / 2 + 0.5).all()
    kept = detect.noise_factor(taps)
    assert 0.375 / np.sqrt(len(taps)) - 1e-12 <= kept <= 0.375 + 1e-12


@law(bayer.gray_from_bayer, pipeline.monochrome)
@given(SEEDS, some.sampled_from(bayer.PATTERNS), some.booleans())
def test_a_gray_image_is_within_its_colors_and_transposes_with_them(
    rng: np.random.Generator, pattern: str, whole: bool
) -> None:
    frame, _ = starry(rng)
    frame = frame if whole else frame + 0.25
    gray = pipeline.monochrome(frame, Settings(bayer=pattern))
    assert 0.9999 * frame.min() - 0.5 <= gray.min() <= gray.max() <= frame.max()
    transposed = bayer.gray_from_bayer(
        np.ascontiguousarray(frame.T), pattern[0] + pattern[2] + pattern[1] + pattern[3]
    )
    # The order of additions may round a half the other way.
    assert np.abs(transposed.T.astype(float) - gray).max() <= (1.0 if whole else 1e-9)
    assert pipeline.monochrome(frame, Settings()) is frame
    with pytest.raises(ImageError, match="RGGB"):
        bayer.gray_from_bayer(frame, pattern[::-1] + "G")


@law(detect.replace_bad_pixels)
@given(
    rng=SEEDS,
    bad=arrays(
        "i8", some.tuples(some.integers(0, 9), some.just(2)), elements=some.integers(-2, 95)
    ),
)
def test_replacing_bad_pixels_changes_no_other_pixel(
    rng: np.random.Generator, bad: NDArray
) -> None:
    frame, _ = starry(rng)
    replaced = answered(lambda: detect.replace_bad_pixels(frame, bad), ImageError)
    assert (replaced is not None) == bool(((bad >= 0) & (bad < [WIDTH, HEIGHT])).all())
    mended = frame if replaced is None else replaced
    changed = set(map(tuple, np.argwhere(mended != frame)[:, ::-1].tolist()))
    assert changed <= set(map(tuple, bad.tolist()))
    assert frame.min() <= mended.min() <= mended.max() <= frame.max()


@law(classify.find_captions)
@given(SEEDS, some.integers(5, 12), some.integers(8, 30), some.booleans())
def test_letters_are_flagged_as_text_anywhere(
    rng: np.random.Generator, letters: int, height: int, even: bool
) -> None:
    """A line of letters beside lights far below; moved and in any order; none if they are equally wide."""
    width = (
        np.full(letters, height)
        if even
        else rng.permutation(np.arange(letters) % 2 + 1) * height // 2
    )
    left = np.cumsum(width + rng.integers(1, height, letters)) - width
    line = np.column_stack(
        [left, np.zeros_like(left), left + width - 1, np.full(letters, height - 1)]
    )
    lights = (
        rng.integers(0, 400, (6, 1)) * [1, 0, 1, 0]
        + np.arange(6)[:, None] * [0, 60, 0, 60]
        + [0, 100, 6, 106]
    )
    order = rng.permutation(letters + 6)
    boxes = (np.concatenate([line, lights]) + rng.integers(0, 1000, 2)[[0, 1, 0, 1]])[
        order
    ].astype(np.int64)
    text = classify.find_captions(boxes, np.where(order < letters, 255.0, 200.0))
    assert text.tolist() == ((order < letters) & (not even)).tolist()


@law(classify.classify, Blobs.take)
@given(rng=SEEDS, full=some.floats(50, 400), streak_px=STREAKS)
def test_classification_changes_only_flags(
    rng: np.random.Generator, full: float, streak_px: tuple[float, float] | None
) -> None:
    frame, _ = starry(rng)
    blobs = DETECTORS["local"](frame, 5.0, 3, 50, FramePriors())
    classified = classify.classify(frame, blobs, FramePriors(streak_px, full))
    np.testing.assert_array_equal(
        classified.flag & int(Flag.SATURATED) != 0, classified.peak >= full
    )
    assert streak_px in (None, classified.streak_px)
    order = rng.permutation(len(classified))
    taken = classified.take(order)
    for name in ("box_px", "xy_px", "flux", "peak", "area_px", "flag"):
        np.testing.assert_array_equal(getattr(taken, name), getattr(classified, name)[order])


@law(classify.streaks_px)
@given(rng=SEEDS, turn_rad=some.floats(-0.5, 0.5), streak_px=STREAKS)
def test_streaks_of_a_roll_differ_across_their_separation(
    rng: np.random.Generator, turn_rad: float, streak_px: tuple[float, float] | None
) -> None:
    """By the turn times it; their mean over a frame's four corners is the streak at its center."""
    blobs = replace(
        DETECTORS["local"](starry(rng)[0], 5.0, 3, 4, FramePriors()), turn_rad=turn_rad
    )
    given_px = streak_px or (0.0, 0.0)
    corners = np.array(
        [(0, 0), (0, HEIGHT - 1), (WIDTH - 1, 0), (WIDTH - 1, HEIGHT - 1)], float
    )
    at_corners = classify.streaks_px(replace(blobs, xy_px=corners), (HEIGHT, WIDTH), given_px)
    np.testing.assert_allclose(at_corners.mean(axis=0), given_px, rtol=0, atol=1e-12)
    streaks = classify.streaks_px(blobs, (HEIGHT, WIDTH), given_px)
    apart, differ = (each[1:] - each[0] for each in (blobs.xy_px, streaks))
    np.testing.assert_allclose(differ, turn_rad * apart[:, ::-1] * [-1, 1], rtol=0, atol=1e-9)


@law(windows.in_windows)
@given(rng=SEEDS, strange=arrays("f8", (4, 2), elements=ANY), half_px=some.floats(0, 20))
def test_windows_anywhere_hold_blobs_of_the_frame(
    rng: np.random.Generator, strange: NDArray, half_px: float
) -> None:
    frame, places = starry(rng)
    assert_inside(
        windows.in_windows(frame, np.concatenate([strange, places]), half_px, 6.0), 13
    )
    found = windows.in_windows(frame, places, 3.0, 6.0)
    assert len(found) == 9
    assert (np.linalg.norm(found.xy_px[:, None] - places, axis=2).min(axis=1) < 1).all()


# Centroids


@law(
    *CENTROIDERS.values(),
    centroid.cog,
    centroid.weighted,
    centroid.gaussian_window,
    centroid.disk,
    centroid.streak,
)
@given(rng=SEEDS, name=some.sampled_from(sorted(CENTROIDERS)), hostile=FRAMES)
def test_centroids_are_at_their_stars_in_any_order_of_blobs(
    rng: np.random.Generator, name: str, hostile: NDArray
) -> None:
    frame, places = starry(rng)
    blobs = DETECTORS["local"](frame, 5.0, 3, 9, FramePriors())
    seen = CENTROIDERS[name](frame, blobs, 1.0, FramePriors())
    assert (np.linalg.norm(seen.xy_px[:, None] - places, axis=2).min(axis=1) < 1).all()
    assert (seen.sigma_px > 0).all()
    order = rng.permutation(len(blobs))
    again = CENTROIDERS[name](frame, blobs.take(order), 1.0, FramePriors())
    # A fit ends where its steps are a small part of the error, a tenth of a pixel.
    np.testing.assert_allclose(again.xy_px, seen.xy_px[order], rtol=0, atol=1e-3)
    odd = frame.copy()
    odd[:] = np.where(np.isfinite(hostile.astype(float)), hostile.astype(float), 0)
    assert len(CENTROIDERS[name](odd, blobs, 1.0, FramePriors())) == len(blobs)


@law(centroid.streak, centroid.gaussian_fit)
@given(rng=SEEDS, long_px=some.floats(7, 11))
def test_a_streak_s_center_is_between_its_ends(
    rng: np.random.Generator, long_px: float
) -> None:
    frame, _places = starry(rng, smear_px=long_px)
    priors = FramePriors((long_px, 0.0))
    blobs = DETECTORS["default"](frame, 5.0, 3, 9, priors)
    begin, end = streak_ends(frame, blobs, 1.0, priors)
    seen = centroid.streak(frame, blobs, 1.0, priors)
    line = ~np.isnan(begin[:, 0])
    assert line.any()
    np.testing.assert_allclose(((begin + end) / 2)[line], seen.xy_px[line], rtol=0, atol=1e-9)
    assert (np.abs(np.linalg.norm(end - begin, axis=1) - long_px)[line] < 3).all()
    assert_covariance(seen.covariance_px2)
    assert len(centroid.gaussian_fit(frame, blobs, 1.0, priors)) == len(blobs)


@law(
    Centroids.take,
    Centroids.empty,
    pipeline.brightest,
    pipeline.FrameTracker.direction_sigma_rad,
    pipeline.away_from_border,
    pipeline.inflate_uncertainty,
)
@given(
    rng=SEEDS,
    count=some.integers(0, 60),
    base=some.integers(1, 30),
    floor_px=some.floats(0, 2),
)
def test_lights_are_selected_and_weighted_by_the_settings(
    rng: np.random.Generator, count: int, base: int, floor_px: float
) -> None:
    lights = Centroids(
        rng.uniform(0, 60, (count, 2)), rng.uniform(0.01, 1, count), -np.arange(count) + 99.0
    )
    settings = Settings(
        base_stars=base, centroid_sigma_px=floor_px, bad_px=np.array([[44, 35]])
    )
    few = pipeline.brightest(lights, settings)
    np.testing.assert_array_equal(few.xy_px, lights.xy_px[: 2 * base])
    assert len(lights.take(np.zeros(count, bool))) == len(Centroids.empty()) == 0
    tracker = pipeline.FrameTracker()
    tracker.camera = CAMERA
    tracker.settings = settings
    sigma = tracker.direction_sigma_rad(lights) * CAMERA.focal_px
    assert (sigma >= np.maximum(lights.sigma_px, floor_px) - 1e-12).all()
    frame, _ = starry(rng)
    blobs = DETECTORS["local"](frame, 5.0, 3, 9, FramePriors())
    seen = CENTROIDERS["cog"](frame, blobs, 1.0, FramePriors())
    assert (
        pipeline.inflate_uncertainty(seen, blobs, settings).sigma_px >= seen.sigma_px
    ).all()
    off_border = (blobs.box_px > 0) & (blobs.box_px < np.tile([WIDTH - 1, HEIGHT - 1], 2))
    np.testing.assert_array_equal(
        pipeline.away_from_border(blobs.box_px, CAMERA), off_border.all(axis=1)
    )


@law()
@given(rng=SEEDS, count=some.integers(0, 9), more_px=some.floats(0, 5), even=some.booleans())
def test_weights_are_the_inverse_of_all_the_errors(
    rng: np.random.Generator, count: int, more_px: float, even: bool
) -> None:
    roots = rng.normal(size=(count, 2, 2)) + 2 * np.eye(2)
    spread = roots @ roots.transpose(0, 2, 1) + 0.01 * np.eye(2)
    sigma = np.sqrt(np.trace(spread, axis1=1, axis2=2) / 2)
    known = NO_SPREAD if even else spread
    lights = (np.zeros((count, 2)), sigma, np.hypot(sigma, more_px), np.ones(count), known)
    seen = detections_of(
        lights, Sensor(1.0, (0.0, 0.0), (0.0,) * 5, np.zeros(4), np.nan, 0.25), 0.0
    )
    xx, yy, xy = seen.weight.T
    weight = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -1)
    alone = sigma[:, None, None] ** 2 * np.eye(2) if even else spread
    whole = weight @ (alone + more_px**2 * np.eye(2))
    np.testing.assert_allclose(
        whole, np.broadcast_to(np.eye(2), whole.shape), rtol=0, atol=1e-9
    )
    greatest = np.linalg.eigvalsh(alone + more_px**2 * np.eye(2))[:, 1]
    np.testing.assert_allclose(seen.sigma**2, greatest, rtol=1e-9)


@law(pipeline.detect_and_centroid, pipeline.FrameTracker.solve, Clock.lap, camera.check_frame)
@given(
    rng=SEEDS,
    hostile=FRAMES | arrays("f8", array_shapes(max_dims=3, max_side=90), fill=some.just(1)),
    streak_px=STREAKS,
)
def test_processing_a_frame_gives_lights_on_the_chip_and_its_duration(
    rng: np.random.Generator, hostile: NDArray, streak_px: tuple[float, float] | None
) -> None:
    fits = answered(lambda: camera.check_frame(hostile, CAMERA) or True, ImageError)
    assert bool(fits) == (hostile.shape == (HEIGHT, WIDTH))
    tracker = pipeline.FrameTracker()
    tracker.camera = CAMERA
    tracker.settings = Settings()
    tracker.solve_centroids = lambda *_, **__: Attitude("not solved")
    answered(lambda: tracker.solve(hostile, streak_px), ImageError)
    frame, _ = starry(rng)
    clock = Clock()
    seen = pipeline.detect_and_centroid(frame, CAMERA, Settings(), clock, streak_px)
    assert CAMERA.contains(seen.xy_px).all()
    assert ((seen.sigma_px > 0) & (seen.sigma_px < 5)).all()
    before = clock.seconds["detect"]
    clock.lap("detect")
    assert clock.seconds["detect"] >= before > 0


# Camera


@law(Camera.rays, Camera.pixels, Camera.tangents, Camera.contains)
@given(rng=SEEDS, k1=some.floats(-0.3, 0.3), p=some.floats(-0.01, 0.01))
@example(rng=np.random.default_rng(1), k1=2.2e-313, p=0.0)  # once divided by
def test_projected_rays_return_to_their_pixels(
    rng: np.random.Generator, k1: float, p: float
) -> None:
    lens = Camera(WIDTH, HEIGHT, 120.0, (44.0, 36.0), (k1, 0.0, p, -p, 0.0))
    xy = rng.uniform(-0.5, [WIDTH - 0.5, HEIGHT - 0.5], (20, 2))
    rays = lens.rays(xy)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, rtol=0, atol=1e-12)
    np.testing.assert_allclose(lens.pixels(rays), xy, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        lens.tangents(xy), rays[:, :2] / rays[:, 2:], rtol=0, atol=1e-12
    )
    assert np.isnan(lens.pixels(-rays)).all()
    assert lens.contains(xy).all()
    assert (lens.contains(xy, 3.0) <= lens.contains(xy, 1.0)).all()


@law(Camera.from_fov, Camera.fov_rad, Camera.diagonal_rad, Camera.zoomed)
@given(fov_rad=some.floats(0.01, 2.5), factor=some.floats(1.01, 9))
def test_a_longer_lens_has_a_smaller_field(fov_rad: float, factor: float) -> None:
    lens = Camera.from_fov(WIDTH, HEIGHT, fov_rad)
    np.testing.assert_allclose(lens.fov_rad, fov_rad, rtol=1e-9, atol=0)
    assert lens.diagonal_rad > lens.fov_rad > lens.zoomed(factor).fov_rad
    np.testing.assert_allclose(
        lens.zoomed(factor).zoomed(1 / factor).focal_px, lens.focal_px, rtol=1e-12, atol=0
    )


@law(Camera.field_sr)
@given(fov_deg=some.floats(0.5, 8), aspect=some.floats(0.3, 1))
def test_a_small_field_has_the_solid_angle_of_its_pyramid(
    fov_deg: float, aspect: float
) -> None:
    """Omega = 4 asin(sin(a / 2) sin(b / 2)) of a pyramid with the angles a and b between opposite sides."""
    lens = Camera.from_fov(2000, round(2000 * aspect), np.radians(fov_deg))
    sides_rad = 2 * np.arctan(np.array([lens.width_px, lens.height_px]) / 2 / lens.focal_px)
    exact_sr = 4 * np.arcsin(np.prod(np.sin(sides_rad / 2)))
    # A pixel's solid angle falls by cos^3 of its angle from the axis: by 1.5 tan^2 on the mean, to second order.
    second = 1.5 * np.sum(np.tan(sides_rad / 2) ** 2) / 3
    assert lens.field_sr == pytest.approx(exact_sr * (1 + second), rel=2 * second**2)


# Attitude


@law(*SOLVERS.values(), solvers.rotation)
@given(
    rng=SEEDS,
    count=some.integers(2, 12),
    noise=some.floats(0, 0.01),
    name=some.sampled_from(sorted(SOLVERS)),
)
def test_a_solver_finds_the_rotation_in_any_order_of_stars(
    rng: np.random.Generator, count: int, noise: float, name: str
) -> None:
    truth = turn(rng)
    ref = units(rng, count)
    sigma = rng.uniform(1e-5, 1e-3, count)
    cam = truth.apply(ref) + noise * sigma[:, None] * rng.normal(size=(count, 3))
    cam /= np.linalg.norm(cam, axis=1, keepdims=True)
    found = answered(lambda: SOLVERS[name](cam, ref, sigma))
    one_line = np.abs(ref @ ref.T)[np.triu_indices(count, 1)].min() > 1 - 1e-6
    assert one_line or found is not None
    found = found or truth
    matrix = found.as_matrix()
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=1e-12)
    assert solvers.rotation(matrix).approx_equal(found, 1e-7)
    weight = 1 / sigma**2
    cost, best = (
        np.sum(weight * np.sum((cam - one.apply(ref)) ** 2, axis=1)) for one in (found, truth)
    )
    assert name == "triad" or cost <= best * (1 + 1e-6) + 1e-12 * weight.sum()
    order = rng.permutation(count)
    again = answered(lambda: SOLVERS[name](cam[order], ref[order], sigma[order])) or found
    assert (again * found.inv()).magnitude() < 1e-6


@law(*SOLVERS.values(), solvers.covariance)
@given(
    rng=SEEDS,
    cam=NUMBERS,
    ref=NUMBERS,
    sigma=NUMBERS,
    name=some.sampled_from(sorted(SOLVERS)),
    scale=some.floats(0.1, 9),
)
def test_any_directions_are_solved_or_refused(
    rng: np.random.Generator,
    cam: NDArray,
    ref: NDArray,
    sigma: NDArray,
    name: str,
    scale: float,
) -> None:
    solution = answered(lambda: SOLVERS[name](cam, ref, sigma))
    assert solution is None or np.isfinite(solution.as_quat()).all()
    answered(lambda: solvers.covariance(cam, sigma, name))
    seen = units(rng, 5)
    spread = solvers.covariance(seen, np.full(5, 1e-4), name)
    assert_covariance(spread)
    np.testing.assert_allclose(
        solvers.covariance(seen, np.full(5, scale * 1e-4), name), scale**2 * spread, rtol=1e-6
    )


@law(ra_dec_roll_rad, Attitude.ra_dec_roll_deg)
@given(rng=SEEDS)
def test_right_ascension_declination_and_roll_determine_the_attitude(
    rng: np.random.Generator,
) -> None:
    truth = turn(rng)
    ra, dec, roll = ra_dec_roll_rad(truth)
    assert 0 <= ra < 2 * np.pi
    assert -np.pi < roll <= np.pi
    sight = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    up = np.cos(roll) * north + np.sin(roll) * np.cross(sight, north) * -1
    built = Rotation.from_matrix([np.cross(-up, sight), -up, sight])
    assert (built * truth.inv()).magnitude() < 1e-9
    np.testing.assert_array_equal(
        Attitude("solved", truth).ra_dec_roll_deg, np.degrees([ra, dec, roll])
    )
    assert np.isnan(Attitude("lost").ra_dec_roll_deg).all()


BLEMISHES = {  # flags, a bad pixel, and the variance added
    "none": (0, [30, 30], 0.0),
    "saturated": (int(Flag.SATURATED), [30, 30], pipeline.SATURATED_SIGMA_PX**2),
    "bad pixel beside it": (0, [9, 13], pipeline.BAD_PIXEL_SIGMA_PX**2),
    "bad pixel two away": (0, [8, 11], 0.0),
    "both": (
        int(Flag.SATURATED),
        [11, 11],
        pipeline.SATURATED_SIGMA_PX**2 + pipeline.BAD_PIXEL_SIGMA_PX**2,
    ),
}


@pytest.mark.parametrize(("flag", "bad_px", "variance"), BLEMISHES.values(), ids=BLEMISHES)
def test_a_blemish_adds_the_same_variance_in_every_direction(
    flag: int, bad_px: list[int], variance: float
) -> None:
    """A saturated center and a bad pixel are independent errors; the ellipse of the rest keeps its axes."""
    one = np.ones(1)
    blob = Blobs(
        np.array([[10, 10, 12, 12]]),
        np.array([[11.0, 11.0]]),
        one,
        one,
        one,
        None,
        np.array([flag]),
    )
    ellipse = np.array([[[4e-4, 1e-4], [1e-4, 2e-4]]])
    lights = Centroids(np.array([[11.0, 11.0]]), np.array([0.02]), np.array([99.0]), ellipse)
    settings = Settings(bad_px=np.array([bad_px, [40, 40]]))
    found = pipeline.inflate_uncertainty(lights, blob, settings)
    np.testing.assert_allclose(
        found.covariance_px2, ellipse + variance * np.eye(2), rtol=1e-12
    )
    assert found.sigma_px[0] == pytest.approx(np.hypot(0.02, np.sqrt(variance)), rel=1e-12)
