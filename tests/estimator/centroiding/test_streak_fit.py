"""Smeared stars: line filter and line fit against independently drawn frames and the Cramér-Rao bound."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage, optimize, stats
from scipy.special import erf

from estimator.centroiding import streak_fit
from estimator.centroiding.centroid import cog, gaussian_fit, streak
from estimator.core.types import FramePriors
from estimator.detection import background as frame_background
from estimator.detection import detect
from estimator.detection.components import runs_above
from tests.helpers.interpreted import interpreted
from tests.helpers.lens_and_streak import streak_ends

BINOMIAL = np.outer([1, 2, 1], [1, 2, 1]) / 16
SIGMA_PX = 0.7


def smeared(
    shape: tuple[int, int],
    x: float,
    y: float,
    dx: float,
    dy: float,
    flux: float,
    sigma: float = SIGMA_PX,
) -> np.ndarray:
    """A moving Gaussian integrated over each pixel in 80 steps from end to end."""

    def share(count: int, at: np.ndarray) -> np.ndarray:
        return (
            np.diff(
                erf((np.arange(count + 1) - 0.5 - at[:, None]) / (sigma * 2**0.5)), axis=1
            )
            / 2
        )

    t = (np.arange(80) + 0.5) / 80 - 0.5
    return flux / 80 * share(shape[0], y + t * dy).T @ share(shape[1], x + t * dx)


def field(
    rng: np.random.Generator,
    dx: float,
    dy: float,
    fluxes_e: np.ndarray,
    noise_e: float = 10.0,
):
    """A 512x512 frame of up to 36 streaks on a lattice, and their middles."""
    lattice = np.array(
        [(x, y) for y in range(56, 480, 80) for x in range(56, 480, 80)], float
    )
    xy = lattice[: len(fluxes_e)] + rng.uniform(-8, 8, (len(fluxes_e), 2))
    light = np.full((512, 512), 50.0)
    for (x, y), flux in zip(xy, fluxes_e, strict=True):
        cell = slice(round(y) - 30, round(y) + 31), slice(round(x) - 30, round(x) + 31)
        light[cell] += smeared((61, 61), x - round(x) + 30, y - round(y) + 30, dx, dy, flux)
    image = rng.poisson(light) + rng.normal(100, noise_e, light.shape)
    return np.rint(image).clip(0, 65535).astype(np.uint16), xy


def nearest(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found[None] - wanted[:, None], axis=2).argmin(axis=1)


def near(found: np.ndarray, wanted: np.ndarray) -> int:
    """Number of places with a blob within 2 px."""
    return int((np.linalg.norm(found[None] - wanted[:, None], axis=2).min(axis=1) < 2).sum())


def cramer_rao_px(length: float, flux_e: float, noise_e: float) -> tuple[float, float]:
    """Bound along and across a streak of known length, direction, width and sky, averaged over places in a pixel."""
    shape = (31, 41)
    step = 1e-4

    def bound(x: float, y: float) -> np.ndarray:
        def model(p: np.ndarray) -> np.ndarray:
            return smeared(shape, p[0], p[1], length, 0.0, flux_e * p[2]).ravel()

        p = np.array([x, y, 1.0])
        slopes = np.array(
            [(model(p + step * e) - model(p - step * e)) / (2 * step) for e in np.eye(3)]
        )
        fisher = slopes / (model(p) + noise_e**2) @ slopes.T
        return np.linalg.inv(fisher).diagonal()[:2]

    places = np.linspace(-0.4, 0.4, 5)
    mean = np.mean([bound(20 + x, 15 + y) for x in places for y in places], axis=0)
    return float(np.sqrt(mean[0])), float(np.sqrt(mean[1]))


@pytest.mark.parametrize("dtype", ["u2", "f8"])
@pytest.mark.parametrize("streak_px", [(9.0, 0.0), (0.0, 7.0), (8.0, -6.0), (-3.0, 12.0)])
def test_the_line_filter_matches_scipy_s_mean_along_the_line(streak_px, dtype: str) -> None:
    rng = np.random.default_rng(60)
    image = rng.integers(0, 200, (90, 120)).astype(dtype)
    taps = detect.line_taps(streak_px)
    reach = np.abs(taps).max()
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    kernel[taps[:, 1] + reach, taps[:, 0] + reach] = 1 / len(taps)
    smooth = ndimage.correlate(image.astype(float), BINOMIAL, mode="nearest")
    wanted = ndimage.correlate(smooth, kernel, mode="nearest") > 101.3
    mask = np.zeros_like(wanted)
    for y, x0, x1 in runs_above(image, np.full((2, 3), 101.3), taps):
        mask[y, x0 : x1 + 1] = True
    assert 100 < wanted.sum() < wanted.size - 100
    np.testing.assert_array_equal(mask, wanted)


@pytest.mark.parametrize("streak_px", [(9.0, 0.0), (8.0, -6.0)])
def test_the_line_filter_scales_white_noise_by_its_stated_factor(streak_px) -> None:
    taps = detect.line_taps(streak_px)
    noise = np.random.default_rng(61).normal(0, 1, (600, 600))
    smooth = ndimage.correlate(noise, BINOMIAL)
    line = np.mean([np.roll(smooth, tuple(tap[::-1]), (0, 1)) for tap in taps], axis=0)
    # Some 15,000 independent patches: 0.6 % of a deviation.
    assert detect.noise_factor(taps) == pytest.approx(line.std(), rel=0.025)


@pytest.mark.parametrize("with_gyro", [True, False])
def test_streaks_of_12_px_are_found_with_and_without_the_gyro(with_gyro: bool) -> None:
    rng = np.random.default_rng(62)
    # At 1,000 e a streak's pixels are 5 of their own sigmas in the filtered image; the line filter sees 10.
    fluxes = np.concatenate([np.full(12, 1000.0), np.full(24, 3000.0)])
    found = strangers = 0
    for angle in rng.uniform(0, np.pi, 6):
        dx = 12 * np.cos(angle)
        dy = 12 * np.sin(angle)
        image, xy = field(rng, dx, dy, fluxes)
        blobs = detect.default(image, priors=FramePriors((dx, dy) if with_gyro else None))
        found += near(blobs.xy_px, xy)
        strangers += len(blobs) - near(blobs.xy_px, xy)
    assert found >= 0.98 * 6 * 36
    assert strangers <= 3


def test_in_pure_noise_the_line_filter_keeps_only_bright_runs_of_five_pixels() -> None:
    # At two sigma noise itself makes blobs: they are scipy's labels of the filtered frame, by the rule.
    image = np.random.default_rng(69).normal(1000, 9, (256, 256))
    streak_px = (9.0, 0.0)
    background = frame_background.estimate_background(image)
    blobs = detect.detect_streaks(image, background, 2.0, 1000, FramePriors(streak_px))
    taps = detect.line_taps(streak_px)
    above = (
        2.0 * detect.noise_factor(taps) / frame_background.FILTERED_NOISE * background.noise
    )
    mask = np.zeros(image.shape, bool)
    for y, x0, x1 in runs_above(image, background.level + above, taps):
        mask[y, x0 : x1 + 1] = True
    labels, count = ndimage.label(mask, np.ones((3, 3)))
    area = ndimage.sum(mask, labels, np.arange(1, count + 1)).astype(int)
    # Some of a few pixels may hold less light than the sky: none of eight.
    assert len(blobs) <= (area >= detect.MIN_STREAK_AREA_PX).sum()
    assert sorted(blobs.area_px[blobs.area_px >= 8]) == sorted(area[area >= 8])
    assert (area >= 8).sum() > 20


def test_a_line_filter_detects_fainter_streaks_than_a_round_filter() -> None:
    # Reference section 3: a streak of 15 px loses 2.2 magnitudes; the mean over it gains most of it back.
    rng = np.random.default_rng(63)
    image, xy = field(rng, 12.0, 9.0, np.full(36, 900.0))
    blobs = detect.default(image, priors=FramePriors((12.0, 9.0)))
    with_line, without = (near(found.xy_px, xy) for found in (blobs, detect.local(image)))
    assert with_line >= 34
    assert without < with_line / 2
    assert not blobs.flag.any()


@pytest.mark.slow
@pytest.mark.parametrize("length", [4.41, 8.8, 15.0])
def test_the_streak_center_is_mid_exposure_within_its_covariance(length: float) -> None:
    rng = np.random.default_rng(64)
    scaled = []
    off = []
    ends_off = []
    for angle in rng.uniform(0, np.pi, 10):
        dx = length * np.cos(angle)
        dy = length * np.sin(angle)
        image, xy = field(rng, dx, dy, np.full(36, 8000.0))
        priors = FramePriors((dx, dy))
        blobs = detect.default(image, priors=priors)
        found = streak(image, blobs, 1.0, priors)
        rows = nearest(found.xy_px, xy)
        error = found.xy_px[rows] - xy
        spread = found.covariance_px2[rows]
        scaled.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(spread), error))
        off.append(error @ np.array([[dx, -dy], [dy, dx]]) / length)
        begin, end = streak_ends(image, blobs, 1.0, priors)
        flipped = np.sum((end - begin)[rows] * [dx, dy], axis=1) < 0
        begin = np.where(flipped[:, None], end[rows], begin[rows])
        ends_off.append(begin - (xy - [dx / 2, dy / 2]))
    chi2 = np.concatenate(scaled).mean() / 2
    # 720 numbers: 5.3 %, three deviations; 2 % for the pixel as a Gaussian of its own variance.
    assert 0.82 < chi2 < 1.18
    off = np.concatenate(off)
    assert np.abs(off.mean(axis=0)).max() < 4 * off.std() / np.sqrt(len(off))
    # An end is a middle and half a length: the end is the less well known.
    ends = np.concatenate(ends_off)
    assert np.abs(ends.mean(axis=0)).max() < 0.02
    assert off[:, 0].std() < np.linalg.norm(ends, axis=1).std() * 3


@pytest.mark.slow
def test_the_fit_reaches_the_cramer_rao_bound_along_and_across() -> None:
    along, across = cramer_rao_px(4.41, 2000.0, 15.0)
    # The reference's section 3: .074 and .037 for a streak of 4.41 px, 2,000 e, read noise 15.
    assert along == pytest.approx(0.074, rel=0.03)
    assert across == pytest.approx(0.037, rel=0.03)
    rng = np.random.default_rng(65)
    length = 8.0
    along, across = cramer_rao_px(length, 6000.0, 10.0 * np.hypot(1, np.sqrt(50) / 10))
    off = []
    for _ in range(16):
        image, xy = field(rng, length, 0.0, np.full(36, 6000.0))
        priors = FramePriors((length, 0.0))
        found = streak(image, detect.default(image, priors=priors), 1.0, priors)
        off.append(found.xy_px[nearest(found.xy_px, xy)] - xy)
    rms = np.concatenate(off).std(axis=0)
    # 576 errors give a deviation to 3 %. Length, width and direction are free in the fit, but they are even or turn
    # about the middle: they cost the place nothing.
    assert rms[0] / along == pytest.approx(1, abs=0.12)
    assert rms[1] / across == pytest.approx(1, abs=0.12)


def test_a_fragment_of_a_faint_streak_is_not_taken_for_the_whole() -> None:
    rng = np.random.default_rng(71)
    priors = FramePriors((14.0, 10.0))
    scaled = []
    for _ in range(8):
        image, xy = field(rng, 14.0, 10.0, np.full(36, 1000.0))  # signal to noise of 7
        found = streak(image, detect.default(image, priors=priors), 1.0, priors)
        off = found.xy_px[:, None] - xy
        row = np.linalg.norm(off, axis=2).argmin(axis=1)
        error = off[np.arange(len(found)), row]
        near = np.linalg.norm(error, axis=1) < 9  # of the light of that streak
        inverse = np.linalg.inv(found.covariance_px2[near])
        scaled.append(np.einsum("ni,nij,nj->n", error[near], inverse, error[near]))
    chi2 = np.concatenate(scaled)
    assert len(chi2) > 200
    assert np.mean(chi2 > 16) < 0.01  # of two numbers: beyond four standard deviations, 3e-4


def test_the_line_fit_beats_the_center_of_gravity() -> None:
    rng = np.random.default_rng(66)
    image, xy = field(rng, 9.0, 7.0, np.full(36, 4000.0))
    priors = FramePriors((9.0, 7.0))
    blobs = detect.default(image, priors=priors)
    fitted = streak(image, blobs, 1.0, priors)
    by_gravity = cog(image, blobs, 1.0)
    errors = [found.xy_px[nearest(found.xy_px, xy)] - xy for found in (fitted, by_gravity)]
    assert errors[0].std() < errors[1].std() / 2
    # A streak of 11 px has 130 pixels of noise of 12 e-: some 2 % of its light for one, 0.4 % for all.
    assert fitted.flux.mean() == pytest.approx(4000, rel=0.02)


def test_round_stars_get_the_round_fit() -> None:
    rng = np.random.default_rng(67)
    image, _ = field(rng, 0.0, 0.0, np.full(36, 8000.0))
    blobs = detect.default(image)
    assert blobs.streak_px is None
    lines = streak(image, blobs)
    rounds = gaussian_fit(image, blobs)
    np.testing.assert_array_equal(lines.xy_px, rounds.xy_px)
    np.testing.assert_array_equal(lines.sigma_px, rounds.sigma_px)
    assert lines.covariance_px2 is None  # x and y are alike


@pytest.mark.slow
@pytest.mark.parametrize("stretch", [1.0, 1.5])
def test_a_star_s_own_streak_has_its_claimed_covariance_for_any_frame_streak(
    stretch: float,
) -> None:
    """The vector without priors is unbiased with a correct covariance, even if the frame's streak is 50 % too long."""
    true = np.array([6.0, 3.5])
    nees = []
    errors = []
    for seed in range(8):
        image, _ = field(np.random.default_rng([69, seed]), *true, np.full(36, 3_000.0))
        found = streak(image, detect.default(image), 1.0, FramePriors(tuple(stretch * true)))
        assert found.streak_px is not None
        assert found.streak_covariance_px2 is not None
        own = found.streak_px * np.sign(found.streak_px @ true)[:, None]
        errors.append(own - true)
        nees += [
            error @ np.linalg.solve(P, error)
            for error, P in zip(own - true, found.streak_covariance_px2, strict=True)
        ]
    assert np.mean(nees) == pytest.approx(2, abs=4 * 2 / np.sqrt(len(nees)))
    offset = np.mean(np.concatenate(errors), axis=0)
    spread = np.std(np.concatenate(errors), axis=0)
    np.testing.assert_allclose(offset, 0, rtol=0, atol=4 * spread.max() / np.sqrt(len(nees)))


@pytest.mark.parametrize("seed", range(3))
def test_a_star_s_own_vector_excludes_the_priors(seed: int) -> None:
    """Of seven Gaussian parameters: the posterior of data and priors leads back to mean and covariance of the data."""
    rng = np.random.default_rng(seed)
    place = [streak_fit.LENGTH, streak_fit.ANGLE]
    data_mean = np.array([10.0, 11.0, 900.0, 9.0, 0.6, 0.9, 5.0])
    root = 0.5 * rng.standard_normal((7, 7)) + 2 * np.eye(7)
    scale = np.array([0.1, 0.1, 20.0, 0.9, 0.06, 0.1, 1.0])
    covariance = scale[:, None] * np.linalg.inv(root @ root.T) * scale
    prior_mean = np.array([10.5, 0.7])
    prior = np.zeros((7, 7))
    prior[place, place] = (
        1 / np.array([streak_fit.length_sigma_px(10.5), streak_fit.ANGLE_RAD]) ** 2
    )
    normal = np.linalg.inv(covariance) + prior
    pull = np.zeros(7)
    pull[place] = prior[place, place] * prior_mean
    p = np.linalg.solve(normal, np.linalg.solve(covariance, data_mean) + pull)
    out = np.full(5, np.nan)
    start = np.zeros(7)
    start[place] = prior_mean
    streak_fit._own_vector(np.linalg.cholesky(normal), p, start, 1.0, 0.01, out)
    length, angle = data_mean[place]
    c = np.cos(angle)
    s = np.sin(angle)
    by_both = np.array([[c, -length * s], [s, length * c]])
    own = covariance[np.ix_(place, place)] + np.diag([0.01, 0.0])
    np.testing.assert_allclose(out[:2], [length * c, length * s], rtol=1e-9)
    np.testing.assert_allclose(
        out[[2, 4, 4, 3]].reshape(2, 2), by_both @ own @ by_both.T, rtol=1e-7
    )


def test_a_frame_s_short_streak_is_corrected_by_its_stars() -> None:
    """Moments underestimate the streak of a faint frame; the median of the fits replaces it."""
    image, _ = field(np.random.default_rng(70), 12.0, 4.0, np.full(30, 20_000.0))
    blobs = replace(detect.default(image), streak_px=(7.0, 2.3))
    found = streak(image, blobs)
    assert found.streak_px is not None
    length = np.linalg.norm(found.streak_px, axis=1)
    assert np.nanmedian(length) == pytest.approx(np.hypot(12, 4), rel=0.02)
    assert np.isfinite(length).sum() >= 25


def test_false_streaks_of_white_noise_are_rare() -> None:
    # The line's mean over 12 pixels has some 2^20 / 40 independent values a frame; five of their sigmas leave 3e-7.
    rng = np.random.default_rng(68)
    found = 0
    for _ in range(6):
        image = rng.normal(1000, 9, (1024, 1024))
        found += len(detect.default(image, priors=FramePriors((10.0, 6.0))))
    expected = 6 * 2**20 / 5 * stats.norm.sf(5)
    assert found <= 3 + 4 * expected
    assert frame_background.estimate_background(image).noise.mean() == pytest.approx(
        9 * 0.375, rel=0.03
    )


@pytest.mark.slow
def test_streaks_below_the_single_detection_limit_are_found_by_their_common_direction() -> (
    None
):
    """Five streaks of unknown direction; the filter for round stars finds two of them at most."""
    rng = np.random.default_rng(31)
    middles = rng.uniform(40, 360, (5, 2))
    along = np.array([10.0, 6.0])
    rows, columns = np.mgrid[:400, :400]
    light = np.zeros((400, 400))
    for middle in middles:
        for step in np.linspace(-0.5, 0.5, 60):
            x, y = middle + step * along
            light += (
                500
                / 60
                / (2 * np.pi * 0.64)
                * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 2 / 0.64)
            )
    image = 100 + light + rng.normal(0, 10, light.shape)
    blobs = detect.default(image, priors=FramePriors(tuple(along)))
    unaided = detect.default(image)
    assert len(detect.local(image)) <= 2
    assert len(blobs) == 5
    near = np.linalg.norm(unaided.xy_px[:, None] - middles, axis=2).min(axis=0)
    # One in five may be lost for a direction that is not quite its own.
    assert np.sum(near < 3) >= 4
    assert len(unaided) <= 6


def test_pure_noise_has_no_streak_direction() -> None:
    frames = np.random.default_rng(32).normal(100, 10, (20, 300, 300))
    assert sum(len(detect.default(frame)) for frame in frames) <= 2


def test_the_fit_s_model_is_the_integral_of_a_moving_gaussian() -> None:
    """Flux and brightness of a line of light, summed over a fine lattice of its way; slopes by central differences."""
    plain = interpreted("estimator.centroiding.streak_fit")
    y, x = (grid.ravel().astype(float) for grid in np.mgrid[:31, :41])
    p = np.array([20.3, 14.8, 500.0, 9.0, 0.4, 0.8, 7.0])

    def model(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = np.ones((8, x.size))
        weight = np.empty(x.size)
        plain._rows(np.vstack([x, y, np.zeros(x.size)]), 3.0, 2.0, at, rows, weight)
        np.testing.assert_allclose(
            weight, 1 / (9 + (-rows[7] - at[plain.SKY]) / 2), rtol=1e-9
        )
        return -rows[7], rows  # the pixels are zero: the residual is minus the model

    light, rows = model(p)
    assert (light - 7).sum() == pytest.approx(500, rel=1e-6)
    t = (np.arange(2000) + 0.5) / 2000 - 0.5
    way = p[:2] + 9.0 * t[:, None] * [np.cos(0.4), np.sin(0.4)]
    distance2 = (x[:, None] - way[:, 0]) ** 2 + (y[:, None] - way[:, 1]) ** 2
    drawn = 500 * np.mean(np.exp(-distance2 / 2 / 0.8**2), axis=1) / (2 * np.pi * 0.8**2)
    np.testing.assert_allclose(light - 7, drawn, rtol=0, atol=1e-4 * drawn.max())
    for n in range(7):
        step = np.zeros(7)
        step[n] = 1e-5
        slope = (model(p + step)[0] - model(p - step)[0]) / 2e-5
        # Beyond five widths from an end the integral is cut off, at 3e-7 of the light.
        np.testing.assert_allclose(rows[n], slope, rtol=0, atol=1e-4 * np.abs(slope).max())


@pytest.mark.parametrize(
    "start",
    [(0.2, 0.1, 0.3, 0.02), (2.5, -1.0, 0.0, 0.0), (0.0, 0.0, 6.0, 0.0), (0.0, 0.0, 0, 0.3)],
)
def test_a_fit_that_starts_pixels_off_converges_to_the_truth(
    start: tuple[float, float, float, float],
) -> None:
    """Position, length and direction start off; a first step that is too long is shortened; almost no noise."""
    plain = interpreted("estimator.centroiding.streak_fit")
    y, x = (grid.ravel().astype(float) for grid in np.mgrid[:31, :41])
    truth = np.array([20.3, 14.8, 50000.0, 9.0, 0.4, 0.8, 7.0])
    rows = np.ones((8, x.size))
    weight = np.empty(x.size)
    out = np.empty(13)
    plain._rows(np.vstack([x, y, np.zeros(x.size)]), 1.0, 1e9, truth, rows, weight)
    p = np.add(truth, [start[0], start[1], 0, start[2], start[3], 0.1, 0])
    assert plain._fit(np.vstack([x, y, -rows[7]]), 1.0, 1e9, rows, weight, p, out)
    wanted = [20.3, 14.8, 50000, 9 * np.cos(0.4), 9 * np.sin(0.4)]
    np.testing.assert_allclose(out[:5], wanted, rtol=1e-4)


def test_a_fit_uses_every_pixel_near_its_line_and_no_other() -> None:
    plain = interpreted("estimator.centroiding.streak_fit")
    streak_px = (8.0, -6.0)
    image = smeared((41, 41), 20.3, 19.8, *streak_px, 5000.0)
    box = np.array([[14, 14, 26, 26]])
    grid = np.ones((1, 1))

    def fit(at: tuple[int, int] | None = None) -> np.ndarray:
        changed = image.copy()
        if at is not None:
            changed[at] += 100.0
        return plain.fit_all(
            changed,
            np.array([[20.0, 20.0]]),
            box,
            0 * grid,
            grid,
            np.array([streak_px]),
            1.0,
            1e9,
        )

    y, x = np.mgrid[:41, :41]
    u = ((x - 20) * 8 - (y - 20) * 6) / 10
    v = ((x - 20) * 6 + (y - 20) * 8) / 10
    far_px = np.hypot(np.maximum(np.abs(u) - 5, 0), v)
    # The window ends 4 px beyond the line's ends in x and y.
    near = (far_px <= 4.5) & (np.abs(x - 20) <= 8) & (np.abs(y - 20) <= 7)
    plain_fit = fit()
    used = np.argwhere(near)
    assert plain_fit.shape == (1, 13)
    np.testing.assert_allclose(plain_fit[0, :2], [20.3, 19.8], rtol=0, atol=0.01)
    for at in (used[0], used[-1]):
        assert np.abs(fit(tuple(at)) - plain_fit).max() > 1e-3
    for at in ((20 + 6, 20), (20, 20 + 9)):
        assert not near[at]
        np.testing.assert_array_equal(fit(at), plain_fit)


def test_a_streak_s_length_direction_and_width_are_weighed_with_the_frame_s() -> None:
    """The least chi-square of pixels and priors by SciPy: sigmas of 0.15 of the length and 0.5 px, 0.15 rad, 0.15."""
    plain = interpreted("estimator.centroiding.streak_fit")
    y, x = (grid.ravel().astype(float) for grid in np.mgrid[:17, :27])
    start = np.array([13.0, 8.0, 900.0, 9.0, 0.0, 0.8, 7.0])
    noise = 20.0

    def model(p: np.ndarray) -> np.ndarray:
        u, v = np.array([[np.cos(p[4]), np.sin(p[4])], [-np.sin(p[4]), np.cos(p[4])]]) @ [
            x - p[0],
            y - p[1],
        ]
        along = np.diff(
            erf(np.array([u - p[3] / 2, u + p[3] / 2]) / (p[5] * 2**0.5)), axis=0
        )[0] / (2 * p[3])
        return p[6] + p[2] * along * np.exp(-((v / p[5]) ** 2) / 2) / (
            p[5] * np.sqrt(2 * np.pi)
        )

    light = model(np.array([13.3, 8.2, 1000.0, 12.0, 0.1, 0.9, 7.0]))

    def residuals(p: np.ndarray) -> np.ndarray:
        return np.append(
            (light - model(p)) / noise, (start - p)[3:6] / [0.15 * 9 + 0.5, 0.15, 0.15 * 0.8]
        )

    p = start.copy()
    rows = np.ones((8, x.size))
    weight = np.empty(x.size)
    out = np.empty(13)
    assert plain._fit(np.vstack([x, y, light]), noise, 1e9, rows, weight, p, out)
    wanted = optimize.least_squares(
        residuals, start, x_scale=[1, 1, 100, 1, 0.1, 0.1, 1], xtol=1e-12
    ).x
    assert 10 < wanted[3] < 11.5  # between the frame's and its own
    off = np.abs(p - wanted) / [0.01, 0.01, 5, 0.02, 0.002, 0.002, 0.02]
    assert off.max() < 1, off
