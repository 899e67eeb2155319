"""Detection: false alarms against Gaussian theory, blobs against scipy.ndimage, texts of refusals."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage, stats
from scipy.special import erf

from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Background, FramePriors
from estimator.detection import background as frame_background
from estimator.detection import detect
from estimator.detection.classify import NO_STAR
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid

BINOMIAL = np.outer([1, 2, 1], [1, 2, 1]) / 16


def flat_background(level: float) -> Background:
    return Background(np.full((1, 1), level), np.ones((1, 1)))


def field_of_stars(
    seed: int, noise: float = 5.0, flux: float = 5000.0
) -> tuple[np.ndarray, np.ndarray]:
    """A 256x320 frame with 12 well separated Gaussian stars of sigma 0.8 px on a sky of 100."""
    rng = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.arange(40, 320, 80), np.arange(40, 256, 80))
    xy = np.column_stack([columns.ravel(), rows.ravel()]) + rng.uniform(-10, 10, (12, 2))
    edges_x = np.arange(321) - 0.5
    edges_y = np.arange(257) - 0.5
    image = rng.normal(100, noise, (256, 320))
    for x, y in xy:
        across, down = (
            np.diff(erf((edges - at) / (0.8 * 2**0.5))) / 2
            for edges, at in ((edges_x, x), (edges_y, y))
        )
        image += flux * np.outer(down, across)
    return image, xy


def nearest_px(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found[None] - wanted[:, None], axis=2).min(axis=1)


@pytest.mark.parametrize("sigma", [4.0, 4.5, 5.0])
def test_the_false_alarm_rate_on_white_noise_is_the_gaussian_tail(sigma: float) -> None:
    rng = np.random.default_rng(4)
    frames = 8
    area = sum(
        detect.local(rng.normal(500, 9, (1024, 1024)), sigma, min_area_px=1).area_px.sum()
        for _ in range(frames)
    )
    expected = frames * 1024**2 * stats.norm.sf(sigma)
    # A tile's noise is known to some 3 %, which raises the mean of the steep tail by up to a half at 5 sigma;
    # then three Poisson deviations, of clumps of about two pixels.
    spread = 3 * np.sqrt(2 * expected)
    assert expected / 2 - spread < area < 2 * expected + spread


def test_three_pixels_at_five_sigma_reject_white_noise() -> None:
    # 4 Mpx hold 1.2 pixels above 5 sigma; three together are far rarer.
    rng = np.random.default_rng(5)
    assert sum(len(detect.local(rng.normal(0, 1, (1024, 1024)))) for _ in range(4)) == 0


def test_the_measured_sky_is_the_mean_and_the_filtered_noise() -> None:
    # White noise through the binomial filter keeps (1 + 4 + 1) / 16 = 0.375 of its deviation.
    image = np.random.default_rng(6).normal(200, 8, (512, 512))
    background = frame_background.estimate_background(image)
    assert background.level.shape == background.noise.shape == (8, 8)
    # Six rows of 64 pixels; [1 2 1] leaves one independent number in 8/3, 144 in all: the mean is known to 3 / 12, the
    # deviation to 3 / sqrt(288), a tenth worse for being clipped. Five deviations for 64 tiles.
    np.testing.assert_allclose(background.level, 200, rtol=0, atol=5 * 0.25)
    np.testing.assert_allclose(background.noise, 3, rtol=0, atol=5 * 0.2)
    assert background.level.mean() == pytest.approx(200, abs=3 * 0.25 / 8)
    assert background.noise.mean() == pytest.approx(3, abs=3 * 0.2 / 8)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["u2", "i4", "f8"])
def test_the_sky_of_a_crowded_tile_is_the_sky_between_the_stars(dtype: str) -> None:
    # A fifth of the pixels hold 60 units of light; clipping at 3 sigma forgets them, a plain mean would show 12.
    rng = np.random.default_rng(61)
    image = rng.normal(60, 3, (256, 256))
    image[rng.uniform(size=(32, 32)).repeat(8, 0).repeat(8, 1) < 0.2] += 100
    background = frame_background.estimate_background(image.round().astype(dtype))
    np.testing.assert_allclose(background.level, 60, rtol=0, atol=1.0)


def test_the_noise_of_float_images_has_the_floor_of_16_bit_rounding() -> None:
    """A step over the range of the image, uniform within: step / sqrt(12), which the binomial filter reduces to 3/8."""
    image = np.full((128, 128), 40.0)
    image[64, 64] = 40.0 + 65535 * 0.25
    background = frame_background.estimate_background(image)
    np.testing.assert_allclose(background.noise, 0.375 * 0.25 / np.sqrt(12), rtol=1e-12)


def test_the_sky_between_tile_centers_is_bilinear() -> None:
    # Four tiles of a 128x128 frame have their centers at 31.5 and 95.5; half-way between is the mean.
    grid = np.array([[0.0, 8.0], [16.0, 40.0]])
    assert frame_background.interpolate(grid, 128, 128, 31.5, 31.5) == 0
    assert frame_background.interpolate(grid, 128, 128, 31.5, 95.5) == 8
    assert frame_background.interpolate(grid, 128, 128, 63.5, 63.5) == 16
    assert frame_background.interpolate(grid, 128, 128, 0.0, 0.0) == 0
    assert frame_background.interpolate(grid, 128, 128, 127.0, 127.0) == 40


@pytest.mark.parametrize("seed", range(6))
def test_blobs_match_scipy_s_labels_of_the_same_mask(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = rng.integers(20, 90, 2)
    image = rng.normal(50, 10, (height, width))
    cut = rng.uniform(1, 6)
    blobs = detect.detect_blobs(image, flat_background(50.0), np.full((1, 1), cut), 1, 10_000)
    mask = ndimage.correlate(image, BINOMIAL, mode="nearest") - 50 > cut
    labels, count = ndimage.label(mask, np.ones((3, 3)))
    every = np.arange(1, count + 1)
    flux = ndimage.sum(image - 50, labels, every)
    order = every[flux > 0][np.argsort(-flux[flux > 0])]
    boxes = [ndimage.find_objects(labels)[label - 1] for label in order]
    middles = np.array(ndimage.center_of_mass(image - 50, labels, order))[:, ::-1]
    assert len(blobs) == len(order) > 5
    np.testing.assert_array_equal(blobs.area_px, ndimage.sum(mask, labels, order))
    np.testing.assert_array_equal(blobs.peak, ndimage.maximum(image, labels, order))
    np.testing.assert_array_equal(
        blobs.box_px, [[b[1].start, b[0].start, b[1].stop - 1, b[0].stop - 1] for b in boxes]
    )
    # Rounding of sums of some hundreds; the middle divides by a flux that may be small.
    np.testing.assert_allclose(blobs.flux, flux[order - 1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(blobs.xy_px, middles, rtol=1e-9, atol=1e-7)


def test_arms_that_meet_only_at_the_bottom_are_one_blob() -> None:
    # A comb lying on its back gives every tooth a label of its own until the last row joins them all.
    image = np.zeros((64, 64))
    image[8:50, 6:60:6] = 100.0
    image[50, 6:55] = 100.0
    blobs = detect.detect_blobs(image, flat_background(0.0), np.full((1, 1), 20.0), 1, 10)
    _, count = ndimage.label(ndimage.correlate(image, BINOMIAL) > 20, np.ones((3, 3)))
    assert len(blobs) == count == 1
    assert blobs.flux[0] == pytest.approx(image.sum(), abs=1e-9)  # rounding


def test_the_peak_of_an_image_below_zero_is_below_zero() -> None:
    # A dark-subtracted float frame may lie below zero everywhere.
    image, _ = field_of_stars(7)
    above = detect.local(image)
    below = detect.local(image - 10_000)
    assert below.peak.max() < 0
    np.testing.assert_allclose(below.peak + 10_000, above.peak, rtol=0, atol=1e-9)  # rounding


@pytest.mark.parametrize("slope", [(0.5, 0.0), (0.0, -2.0), (3.0, 3.0), (20.0, -10.0)])
def test_a_ramp_of_the_sky_is_not_detected(slope: tuple[float, float]) -> None:
    y, x = np.mgrid[:512, :640]
    image = (
        20_000
        + slope[0] * x
        + slope[1] * y
        + np.random.default_rng(8).normal(0, 5, (512, 640))
    )
    assert len(detect.local(image)) == 0


def test_stars_on_a_gentle_ramp_are_all_found() -> None:
    image, xy = field_of_stars(9)
    ramp = 0.2 * np.arange(320)[None, :] - 0.1 * np.arange(256)[:, None]
    blobs = detect.local(image + ramp)
    assert len(blobs) == 12
    assert nearest_px(blobs.xy_px, xy).max() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["u1", "u2", "f4", "f8", ">f4", ">f8", ">u2", "f2"])
@pytest.mark.parametrize("name", [name for name in detect.DETECTORS if name != "thesis"])
def test_stars_are_found_in_pixels_of_any_type(name: str, dtype: str) -> None:
    # FITS is big-endian. 300 units of light have a peak of some 60 above 100, so they fit 8 bits.
    image, xy = field_of_stars(10, noise=2.0, flux=300.0)
    blobs = detect.DETECTORS[name](image.round().astype(dtype))
    assert len(blobs) == 12
    assert np.all(blobs.flag & NO_STAR == 0)
    # A third of a pixel: 300 units of light under noise of 2, cut off at five deviations.
    assert nearest_px(blobs.xy_px, xy).max() < 0.33


@pytest.mark.parametrize(
    "dtype",
    ["?", "u1", "i1", "<u2", ">u2", "i2", ">i4", "u4", "i8", "u8", "f2", ">f4", "f8", ">f8"],
)
def test_compiled_code_gets_one_of_three_types_and_every_value(dtype: str) -> None:
    image = np.random.default_rng(62).integers(0, 100, (40, 50)).astype(dtype)
    native = detect.to_native(image)
    assert native.dtype in (np.uint16, np.int32, np.float64)
    assert native.dtype.isnative
    np.testing.assert_array_equal(native, image)
    if image.dtype.itemsize >= 4 and image.dtype.kind in "iu":
        image[3, 4] = np.iinfo(image.dtype).max
        np.testing.assert_array_equal(detect.to_native(image), image.astype(np.float64))


def test_the_thesis_s_full_scale_is_that_of_the_pixel_type() -> None:
    image = np.random.default_rng(15).normal(5, 1, (120, 160))
    image[40:50, 40:50] += 60
    assert [len(detect.thesis(image.astype(dtype))) for dtype in ("u1", "u2")] == [1, 0]


@pytest.mark.parametrize(
    ("threshold", "expected"), [(0.02, 4), (0.04, 3), (0.1, 2), (0.25, 1), (0.5, 0)]
)
def test_the_thesis_s_threshold_is_a_share_of_full_scale(
    threshold: float, expected: int
) -> None:
    """Padro 2012, page 73: lights of 3, 6, 15 and 35 % of 255 by thresholds of 2, 4, 10, 25 and 50 %."""
    image = np.zeros((120, 160), np.uint8)
    image[::2, ::2] = 1  # a frame of one value is empty
    for n, share in enumerate((0.03, 0.06, 0.15, 0.35)):
        image[40:52, 20 + 35 * n : 32 + 35 * n] = round(255 * share)
    blobs = detect.thesis(image, priors=FramePriors(intensity_threshold=threshold))
    assert len(blobs) == expected
    camera = Camera.from_fov(160, 120, 0.2)
    settings = Settings(detector="thesis", intensity_threshold=threshold)
    assert len(detect_and_centroid(image, camera, settings, Clock())) == expected


@pytest.mark.parametrize("threshold", [0.0, 1.1, float("nan"), "4 %"])
def test_a_threshold_beyond_full_scale_is_refused(threshold: float) -> None:
    for make in (FramePriors, Settings):
        with pytest.raises(ImageError, match=r"intensity_threshold.*above 0, up to 1"):
            make(intensity_threshold=threshold)


def test_a_boolean_mask_is_a_valid_image() -> None:
    image = np.zeros((64, 64), bool)
    image[30:34, 40:44] = True
    # rounding.
    np.testing.assert_allclose(detect.local(image).xy_px, [[41.5, 31.5]], rtol=0, atol=1e-12)


def test_blobs_are_sorted_by_brightness_and_the_faintest_dropped() -> None:
    image = np.random.default_rng(11).normal(0, 1, (128, 128))
    for k, peak in enumerate((300, 900, 600)):
        image[20:23, 20 + 40 * k : 23 + 40 * k] += peak
    blobs = detect.local(image, max_blobs=2)
    # A ninth of a pixel would be a whole pixel of the square gone; noise is a three-hundredth of it.
    np.testing.assert_allclose(blobs.xy_px, [[61, 21], [101, 21]], rtol=0, atol=0.1)


def test_hot_pixels_do_not_displace_stars_from_the_list() -> None:
    """Two hundred bright hot pixels beside the stars, and room for sixty blobs: all the stars are among them."""
    image, xy_px = field_of_stars(4)
    rng = np.random.default_rng(5)
    row, column = np.meshgrid(
        *(np.arange(8, side - 8, 16) for side in image.shape), indexing="ij"
    )
    places = rng.permutation(np.column_stack([row.ravel(), column.ravel()]))
    far = np.array([np.hypot(*(xy_px - place[::-1]).T).min() > 8 for place in places])
    hot = places[far][:200]
    image[hot[:, 0], hot[:, 1]] += 60_000
    blobs = detect.default(image, max_blobs=60)
    assert len(hot) > 150
    assert len(blobs) == 60
    stars = blobs.take(blobs.flag & NO_STAR == 0)
    assert nearest_px(stars.xy_px, xy_px).max() < 1


def test_small_blobs_are_left_out() -> None:
    image = np.random.default_rng(12).normal(0, 1, (64, 64))
    image[30, 30] = (
        60.0  # filtered: a peak of 15, shoulders of 7.5 and corners of 3.75 against 5 * .375
    )
    assert detect.local(image, min_area_px=9).area_px.tolist() == [9]
    assert len(detect.local(image, min_area_px=20)) == 0


BAD = {
    "the image holds NaN": np.where(np.eye(32) > 0, np.nan, 1.0),
    "the image holds NaN or infinite": np.where(np.eye(32) > 0, np.inf, 1.0),
    "the frame is empty: every pixel is 7.0": np.full((32, 32), 7.0),
    r"an image of shape \(32, 32, 3\); allowed: monochrome": np.zeros((32, 32, 3)),
    r"an image of shape \(32,\); allowed: monochrome": np.zeros(32),
    "40x8 pixels are too few": np.eye(8, 40),
    "0x0 pixels are too few": np.zeros((0, 0)),
    "pixels of type complex128 are not real numbers": np.eye(32) * 1j,
    "pixels of type <U1 are not real numbers": np.full((32, 32), "x"),
}


@pytest.mark.parametrize("message", BAD)
@pytest.mark.parametrize("name", list(detect.DETECTORS))
def test_an_invalid_image_is_refused_in_one_line(name: str, message: str) -> None:
    with pytest.raises(ImageError, match=f"^{message}[^\n]*$"):
        detect.DETECTORS[name](BAD[message])


def test_a_texture_is_refused() -> None:
    # 25,600 points a few pixels from the corners of a lattice of 10: few of the pixels feel one.
    image = np.zeros((1600, 1600))
    place = np.arange(0, 1600, 10)[:, None] + np.random.default_rng(13).integers(
        2, 7, (2, 160, 160)
    )
    image[place[0], place[1].transpose(1, 0)] = 1.0
    with pytest.raises(ImageError, match="over 20000 blobs"):
        detect.local(image)


@pytest.mark.slow
def test_the_line_filter_ignores_streaks_longer_than_the_maximum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Lattices that close to lines of 1200 and of 600 px: filters of the length of the first took a minute."""
    taps: list[int] = []
    kept = detect.line_taps
    monkeypatch.setattr(detect, "line_taps", lambda streak: taps.append(1) or kept(streak))
    lattice = np.full((3000, 240), 10, np.uint8)
    lattice[:600:3, ::6] = 231
    long = lattice.copy()
    long[:1200:3, ::6] = 231
    blobs = detect.default(long)
    assert max(map(abs, blobs.streak_px)) > detect.MAX_STREAK_PX
    assert not taps
    short = detect.default(lattice)
    assert max(map(abs, short.streak_px)) < detect.MAX_STREAK_PX
    assert taps
    stars, xy = field_of_stars(3)
    in_stars = detect.default(stars, priors=FramePriors((0.0, 5000.0)))
    assert nearest_px(in_stars.xy_px, xy).max() < 1


def streaked(
    rng: np.random.Generator, streak_px: tuple[float, float], flux: float
) -> tuple[np.ndarray, np.ndarray]:
    """A frame with noise of 5 and ten streaks of this flux, far from each other and from the border; their centers."""
    places = np.array(
        [[70 + 90 * (n % 5), 70 + 160 * (n // 5)] for n in range(10)]
    ) + rng.uniform(-5, 5, (10, 2))
    y, x = np.mgrid[0:300, 0:500]
    frame = 100 + 5 * rng.standard_normal(x.shape)
    steps = np.linspace(-0.5, 0.5, 200)
    for place in places:
        at = place + steps[:, None] * np.array(streak_px)
        inside = np.abs(x - place[0]) + np.abs(y - place[1]) < 90
        away2 = (x[inside][:, None] - at[:, 0]) ** 2 + (y[inside][:, None] - at[:, 1]) ** 2
        frame[inside] += (
            flux * np.exp(-away2 / (2 * 0.8**2)).mean(axis=1) / (2 * np.pi * 0.8**2)
        )
    return frame, places


@pytest.mark.slow
@pytest.mark.parametrize("length_px", [12.0, 24.0, 48.0])
@pytest.mark.parametrize("angle_deg", [63.0, 120.0])
def test_faint_streaks_are_found_at_full_length(length_px: float, angle_deg: float) -> None:
    """Streaks of 2 sigma in a pixel, of which the first filter finds pieces: without longer filters a streak of 48 px
    appears to be of 7 px.
    """
    streak_px = (
        length_px * np.cos(np.radians(angle_deg)),
        length_px * np.sin(np.radians(angle_deg)),
    )
    frame, places = streaked(np.random.default_rng(3), streak_px, 25.0 * length_px)
    blobs = detect.default(frame)
    assert blobs.streak_px is not None
    assert np.hypot(*blobs.streak_px) == pytest.approx(length_px, rel=0.25)
    direction_deg = np.degrees(np.arctan2(*blobs.streak_px[::-1])) % 180
    assert direction_deg == pytest.approx(angle_deg, abs=5)
    assert nearest_px(blobs.xy_px, places).max() < 3


def test_a_field_that_only_rolls_is_not_line_filtered() -> None:
    """Its streaks are those of a roll, whose streak at the center has no length."""
    image, _ = field_of_stars(4)
    turning = replace(detect.default(image), streak_px=(0.0, 0.0), turn_rad=0.01)
    assert detect.in_full_length(image, turning, 5.0, 99, FramePriors()) is turning


def skies(rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """The light of 12 stars, sigma 0.8 px, in a frame of 200 x 240 pixels, and their places; none near another."""
    xy = np.array([(x, y) for x in (30.0, 90.0, 150.0, 210.0) for y in (30.0, 95.0, 160.0)])
    xy += rng.uniform(-9, 9, xy.shape)
    y, x = np.mgrid[:200, :240]
    light = np.zeros((200, 240))
    for star in xy:
        light += 2e4 * np.exp(-((x - star[0]) ** 2 + (y - star[1]) ** 2) / 2 / 0.8**2)
    return light, xy


def centroids_px(image: NDArray, saturation: float) -> NDArray:
    """Places of the lights in an image, as a tracker finds them."""
    camera = Camera.from_fov(240, 200, 0.2)
    settings = Settings(saturation=saturation)
    return detect_and_centroid(image, camera, settings, Clock()).xy_px


@pytest.mark.parametrize("share", [0.06, 0.5])
def test_readout_smear_neither_hides_nor_moves_a_light(share: float) -> None:
    """The share of its column's light that each pixel gets in the shift is not seen as a light."""
    rng = np.random.default_rng(3)
    light, xy = skies(rng)
    light = light + 100 + share / 200 * light.sum(axis=0)
    image = np.rint(rng.poisson(light) + rng.normal(100, 5, light.shape)).astype(np.uint16)
    found = centroids_px(image, np.inf)
    off = np.abs(found[:, None] - xy)
    assert len(found) == len(xy)
    assert off.max(axis=2).min(axis=1).max() < 0.05
    near = off.max(axis=2).argmin(axis=1)
    assert abs(np.mean(found - xy[near])) < 0.005


def test_stars_are_found_in_a_sky_that_rises_to_saturation() -> None:
    """All that are below the saturated part of the frame, and nothing else; the noise rises with the sky."""
    rng = np.random.default_rng(4)
    light, xy = skies(rng)
    light = light + 6e4 * (np.linspace(0, 1.1, 240) ** 2)
    noisy = rng.poisson(light) + rng.normal(100, 5, light.shape)
    image = np.minimum(np.rint(noisy), 50_000).astype(np.uint16)
    found = centroids_px(image, 50_000.0)
    below = xy[xy[:, 0] < 170]
    off = np.abs(found[:, None] - below).max(axis=2)
    assert off.min(axis=0).max() < 0.2
    assert np.abs(found[:, None] - xy).max(axis=2).min(axis=1).max() < 1.0
