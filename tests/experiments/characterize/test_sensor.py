"""A sensor from darks and flats: each estimator against an independent law, all against simulated chips."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from skysim.camera import detector
from skysim.camera.detector import Detector
from skysim.core.types import Floats
from skysim.experiments.characterize import (
    fixed_pattern,
    frame_files,
    photon_transfer,
    sensor_fit,
)
from skysim.experiments.characterize.fixed_pattern import RateNoise
from skysim.experiments.characterize.photon_transfer import (
    Estimate,
    Level,
    TransferPoints,
    propagate,
)
from skysim.experiments.characterize.sensor_fit import MeasuredSensor
from skysim.scene.sections.camera import CameraConfig, DetectorConfig
from tests.helpers.two_samples import histogram_p

CHIP = {
    "quantum_efficiency": 0.6,
    "bits": 12,
    "gain_e_dn": 2.64,
    "offset_dn": 100,
    "full_well_e": 10700,
    "read_noise_e": 6.0,
    "nonlinearity": 0.03,
    "prnu": 0.01,
    "column_offset_e": 2.0,
    "dark_e_s": 5.0,
    "dsnu": 0.3,
    "hot_pixels": 2e-3,
    "hot_e_s": 100.0,
    "dark_temperature_c": 20.0,
    "dark_doubling_c": 7.0,
}
FLAT_S = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.65, 0.8, 1.3, 1.5)
Z_95 = stats.norm.ppf(0.975)


def camera(side_px: int, seed: int = 0, **changes: Any) -> CameraConfig:
    lens = {
        "pixel": "5 um",
        "focal_length": "25 mm",
        "f_number": 2,
        "height_px": side_px,
        "width_px": side_px,
    }
    return CameraConfig.model_validate(
        lens | {"detector": CHIP | {"hardware_seed": seed} | changes}
    )


def level(exposure_s: float, temperature_c: float | None, frames: Iterable[NDArray]) -> Level:
    """The level of two frames or more."""
    found = Level(exposure_s, temperature_c)
    for frame in frames:
        found.add(frame)
    return found


def measured(
    side_px: int, seed: int, darks: int = 8, drift: float = 0.0, **changes: Any
) -> MeasuredSensor:
    """Darks of three exposures at two temperatures, and flats in pairs, of one simulated chip.

    The lamp has another power in every pair, by the relative standard deviation `drift`.
    """
    rng = np.random.default_rng(1000 + seed)

    def frames(temperature_c: float, rate_e_s: float, exposure_s: float, count: int) -> Level:
        made = Detector.from_camera(
            camera(side_px, seed, **(changes | {"temperature_c": temperature_c}))
        )
        light_e = np.full((side_px, side_px), rate_e_s * exposure_s, np.float32)
        shots = (detector.expose(light_e.copy(), exposure_s, made, rng) for _ in range(count))
        return level(exposure_s, temperature_c, shots)

    lamp = np.random.default_rng(seed)
    rate_e_s = float((CHIP | changes)["full_well_e"]) * (1 + drift * lamp.normal(size=99))
    dark_levels = [
        frames(at_c, 0.0, t_s, darks) for at_c in (20.0, 30.0) for t_s in (0.1, 5.0, 20.0)
    ]
    return sensor_fit.characterize(
        dark_levels,
        [
            frames(20.0, float(rate), t_s, 2)
            for rate, t_s in zip(rate_e_s, FLAT_S, strict=False)
        ],
    )


def test_half_the_variance_of_a_pair_s_difference_is_the_noise_without_pattern_and_flicker() -> (
    None
):
    rng = np.random.default_rng(1)
    pattern = rng.uniform(200, 4000, (200, 300))
    sigma = 7.0
    frames = [
        np.rint(pattern * lamp + rng.normal(0, sigma, pattern.shape))
        for lamp in (1, 1.0, 1, 1.0)
    ]
    shifted = [frame.astype(np.uint16) + np.uint16(n) for n, frame in enumerate(frames)]
    found = level(0.1, 20.0, shifted)
    moments = found.point(np.ones(pattern.shape, bool))
    assert found.count == 4
    assert abs(moments.variance_dn2 - sigma**2 - 1 / 12) < 4 * moments.variance_sigma_dn2
    assert moments.variance_sigma_dn2 == pytest.approx(
        sigma**2 * np.sqrt(2 / 2 / pattern.size), rel=0.02
    )
    assert abs(moments.mean_dn - pattern.mean() - 1.5) < 4 * sigma / np.sqrt(4 * pattern.size)
    assert moments.difference_dn2 == pytest.approx(1.0, rel=0.2)


def test_an_odd_last_frame_is_left_out() -> None:
    rng = np.random.default_rng(2)
    frames = [rng.integers(90, 110, (20, 30)).astype(np.uint16) for _ in range(5)]
    odd = level(1.0, None, frames)
    even = level(1.0, None, frames[:4])
    assert odd.count == 4
    np.testing.assert_array_equal(odd.variance_dn2, even.variance_dn2)


def exact_points(
    gain_dn_e: float, curvature: float, read_dn: float, black_dn: float
) -> TransferPoints:
    """Points of the law, from 10^7 numbers drawn for none: by the moments of a Poisson variable up to the fourth."""
    points = []
    for lit, rate_e_s, times in (
        (0, 3.0, (0.1, 5.0, 20.0)),
        (1, 2003.0, (0.1, 0.4, 1.0, 2.0, 3.0)),
    ):
        for t_s in times:
            n = rate_e_s * t_s
            # y = x - c x^2 of x = K N + r: exact variance with E[N^k] of Poisson and a Gaussian r.
            support = np.arange(int(n + 12 * np.sqrt(n)) + 20)
            weight = stats.poisson.pmf(support, n)
            nodes, by = np.polynomial.hermite_e.hermegauss(9)
            x = gain_dn_e * support[:, None] + read_dn * nodes
            y = x - curvature * x**2
            w = weight[:, None] * by / by.sum()
            mean = float((w * y).sum())
            variance = float((w * (y - mean) ** 2).sum()) + 1 / 12
            points.append(
                (t_s, lit, 0, black_dn + mean, 1e-3, variance, 1e-3 * variance, 0.0)
            )
    return TransferPoints(*map(np.array, zip(*points, strict=True)))


def test_the_fit_returns_the_law_of_its_points() -> None:
    gain = 0.4
    curvature = 4e-6
    read = 2.5
    black = 100.0
    found = photon_transfer.fit(exact_points(gain, curvature, read, black), 0.0)
    assert found.gain_e_dn.value == pytest.approx(1 / gain, rel=2e-3)
    assert found.read_noise_e.value == pytest.approx(read / gain, rel=2e-3)
    assert found.values[photon_transfer.CURVATURE] == pytest.approx(curvature, rel=5e-3)
    assert found.offset_dn.value == pytest.approx(black, abs=2e-3)
    assert found.values[photon_transfer.LIGHT] / gain == pytest.approx(2000, rel=2e-3)
    assert found.values[photon_transfer.FIRST_DARK] / gain == pytest.approx(3, rel=2e-3)


def test_linear_signal_is_the_inverse_of_the_amplifier() -> None:
    x = np.linspace(0, 4000, 9)
    for curvature in (0.0, 1e-5, -1e-5):
        np.testing.assert_allclose(
            photon_transfer.linear_dn(x - curvature * x**2, curvature),
            x,
            rtol=1e-12,
            atol=1e-9,
        )


def test_the_lamp_s_flicker_is_the_variance_beyond_noise() -> None:
    rng = np.random.default_rng(3)
    pixels = 4000
    flicker = 0.004
    points = []
    for mean in np.linspace(500, 3000, 400):
        change = rng.normal(0, np.sqrt(2 * (flicker * mean) ** 2 + 2 * mean / pixels))
        points.append((1.0, 1, 0, 100 + mean, 0.0, mean, 0.0, change**2))
    levels = TransferPoints(*map(np.array, zip(*points, strict=True)))
    assert photon_transfer.lamp_flicker(levels, 100.0, pixels) == pytest.approx(
        flicker, rel=0.1
    )


def drawn_rates(
    rng: np.random.Generator, pixels: int, noise: RateNoise, hot: float = 0.004
) -> Floats:
    mean = 2.0
    dsnu = 0.4
    excess = 30.0
    s2 = np.log1p(dsnu**2)
    rates = mean * rng.lognormal(-s2 / 2, np.sqrt(s2), pixels)
    rates += np.where(rng.random(pixels) < hot, rng.exponential(excess, pixels), 0.0)
    return rates + rng.normal(0, np.sqrt(noise.reading + noise.counting * rates))


@pytest.mark.parametrize("reading", [0.001, 0.3])
def test_the_dark_current_s_law_matches_drawn_pixels(reading: float) -> None:
    rng = np.random.default_rng(4)
    noise = RateNoise(reading, 0.01)
    rates = drawn_rates(rng, 400_000, noise)
    theta = np.array([np.log(2.0), np.log(0.4), np.log(0.004 / 0.996), np.log(30.0)])
    edges = np.quantile(rates, np.linspace(0.002, 0.998, 60))
    expected = len(rates) * fixed_pattern.probabilities(theta, edges, noise)
    counts = np.bincount(np.searchsorted(edges, rates), minlength=len(edges) + 1)
    assert expected.sum() == pytest.approx(len(rates))
    chi2 = np.sum((counts - expected) ** 2 / expected)
    assert 1e-4 < stats.chi2.sf(chi2, len(edges)) < 1


@pytest.mark.slow
def test_dark_current_of_drawn_pixels_is_found_within_its_interval() -> None:
    """Over twenty chips of 60,000 pixels: mean pulls below 1, so that no parameter is biased by half a sigma."""
    pulls = []
    for seed in range(20):
        noise = RateNoise(0.3, 0.01)
        found = fixed_pattern.fit(
            drawn_rates(np.random.default_rng(seed), 60_000, noise), noise, np.inf
        )
        assert found.hot is not None
        pairs = (
            (found.mean, 2.0),
            (found.dsnu, 0.4),
            (found.hot_pixels, 0.004),
            (found.hot, 30.0),
        )
        pulls.append([(one.value - truth) / one.sigma for one, truth in pairs])
    mean = np.mean(pulls, axis=0)
    spread = np.std(pulls, axis=0, ddof=1)
    assert np.all(np.abs(mean) < 4 / np.sqrt(20))
    assert np.all((spread > 0.5) & (spread < 1.6))


def test_few_hot_pixels_are_counted() -> None:
    noise = RateNoise(0.3, 0.01)
    rates = drawn_rates(np.random.default_rng(7), 60_000, noise, hot=0.0)
    rates[[5, 900, 40_000]] = 80.0
    found = fixed_pattern.fit(rates, noise, np.inf)
    assert found.hot is None
    assert found.hot_pixels.value == pytest.approx(3 / 60_000)
    exact = stats.binomtest(3, 60_000).proportion_ci()
    assert (found.hot_pixels.low, found.hot_pixels.high) == pytest.approx(
        (exact.low, exact.high), rel=1e-6
    )


def test_a_dark_current_below_the_noise_is_not_resolved() -> None:
    rng = np.random.default_rng(8)
    noise = RateNoise(4.0, 0.01)
    assert not fixed_pattern.is_resolved(rng.normal(0.3, 2.0, 50_000), noise)
    assert fixed_pattern.is_resolved(drawn_rates(rng, 50_000, noise), noise)


@pytest.mark.slow
@pytest.mark.parametrize("dark_e_s", [5.0, 5e-4], ids=["equal", "none"])
def test_hot_pixels_beside_equal_dark_currents_are_measured(dark_e_s: float) -> None:
    """They change no median, neither of currents without scatter nor of a cold chip without current."""
    drawn = 200
    found = measured(
        256, 3, dsnu=0.0, hot_pixels=drawn / 256**2, hot_e_s=558.0, dark_e_s=dark_e_s
    )
    for key, truth in (("hot_pixels", drawn / 256**2), ("hot_e_s", 558.0)):
        one = found.estimates[key]
        assert one.value == pytest.approx(truth, abs=3 * one.sigma)
        assert one.sigma < 0.2 * truth
    assert not any("hot" in remark for remark in found.remarks)
    none = measured(128, 3, dsnu=0.0, hot_pixels=0.0, dark_e_s=dark_e_s).estimates
    assert none["hot_pixels"].value == 0
    assert none["hot_pixels"].high == pytest.approx(-np.log(0.025) / 128**2, rel=0.01)


@pytest.mark.slow
def test_a_drifting_lamp_widens_the_interval_of_the_nonlinearity() -> None:
    """Over twelve chips: a drift of 0.2 % between levels, unseen by pairs, is found; the intervals cover the truth."""
    found = [measured(128, seed, drift=0.002) for seed in range(12)]
    intervals = [one.estimates["nonlinearity"] for one in found]
    # 95 % of twelve: fewer than nine by chance in 0.02 % of the cases.
    assert sum(one.low < 0.03 < one.high for one in intervals) >= 9
    assert np.median([one.transfer.drift for one in found]) == pytest.approx(0.002, rel=0.5)
    assert all("lamp" in one.remarks[-1] for one in found if one.transfer.drift)
    steady = [measured(128, seed) for seed in range(12)]
    assert sum(one.transfer.drift > 0 for one in steady) <= 3


def test_uneven_illumination_is_not_counted_as_prnu() -> None:
    """A slope of 20 % over the flat is fully removed by the polynomial."""
    y, x = np.mgrid[0:96, 0:128]
    image = 500 * (1 + 0.1 * (x - 64) / 64 - 0.06 * ((y - 48) / 48) ** 2)
    trend = fixed_pattern.smooth(image, np.ones(image.shape, bool))
    np.testing.assert_allclose(
        trend, image, rtol=3e-4
    )  # means of a block are not its center's


def test_error_propagation_matches_that_of_a_product() -> None:
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    value, sigma, *_ = propagate(lambda p: p[0] * p[1], np.array([2.0, 5.0]), covariance)
    slope = np.array([5.0, 2.0])
    assert value == pytest.approx(10)
    assert sigma == pytest.approx(np.sqrt(slope @ covariance @ slope), rel=1e-6)


def test_intervals_match_their_sampling_laws() -> None:
    assert Estimate.normal(3.0, 0.5)[2:] == pytest.approx((3 - 0.5 * Z_95, 3 + 0.5 * Z_95))
    assert Estimate.lognormal(3.0, 0.3)[2:] == pytest.approx(
        (3 * np.exp(-0.1 * Z_95), 3 * np.exp(0.1 * Z_95))
    )
    root = Estimate.root(9.0, 0.6)
    assert root == pytest.approx((3.0, 0.1, np.sqrt(9 - 0.6 * Z_95), np.sqrt(9 + 0.6 * Z_95)))
    assert Estimate.root(-1.0, 0.1).low == Estimate.root(-1.0, 0.1).high == 0
    logistic = Estimate.logistic(-4.0, 0.2)
    assert logistic.low == pytest.approx(1 / (1 + np.exp(4 + 0.2 * Z_95)))


# Simulated chips


@pytest.mark.slow
def test_a_chip_s_parameters_are_recovered_within_two_percent() -> None:
    """All but the hot pixels and the columns, whose number on a chip limits them: those within 3 sigma."""
    found = measured(400, 1, darks=16)
    assert set(found.estimates) == {*CHIP} - {
        "quantum_efficiency",
        "bits",
        "dark_temperature_c",
    }
    for key, one in found.estimates.items():
        truth = float(CHIP[key])
        if key in ("hot_pixels", "hot_e_s", "column_offset_e"):
            assert abs(one.value - truth) < 3 * one.sigma, key
        else:
            assert one.value == pytest.approx(truth, rel=0.02), key
    assert not found.remarks
    assert 0.5 < found.transfer.misfit < 1.6


@pytest.mark.slow
def test_a_converter_that_saturates_first_bounds_the_full_well() -> None:
    found = measured(128, 2, full_well_e=30_000.0, gain_e_dn=2.0, nonlinearity=0.0)
    assert found.estimates["full_well_e"].value == pytest.approx((4095 - 100) * 2.0, rel=0.02)
    assert found.estimates["gain_e_dn"].value == pytest.approx(2.0, rel=0.03)


@pytest.mark.slow
def test_the_linearity_error_matches_that_of_a_parabola() -> None:
    found = measured(128, 3)
    t = np.array([one for one in FLAT_S if 0.04 < one < 0.95])
    x = np.minimum(t, 1.0) * (1 - 0.03 * np.minimum(t, 1.0))
    slope, intercept = np.polyfit(t, x, 1, w=1 / x)
    expected = np.mean(np.abs(x - slope * t - intercept) / (slope * t + intercept))
    assert found.linearity_error == pytest.approx(expected, rel=0.15)


@pytest.mark.long
def test_intervals_cover_the_truth_in_95_percent_of_400_cameras() -> None:
    """128 x 128 pixels. A parameter's count is binomial, so 95 +- 2 % is asked of all together, 3.3 sigma of each."""
    cameras = 400
    covered: dict[str, list[bool]] = {}
    for seed in range(cameras):
        for key, one in measured(128, seed).estimates.items():
            covered.setdefault(key, []).append(one.low <= float(CHIP[key]) <= one.high)
    assert {len(one) for one in covered.values()} == {cameras}
    share = {key: float(np.mean(one)) for key, one in covered.items()}
    assert np.mean(list(share.values())) == pytest.approx(0.95, abs=0.02), share
    assert min(share.values()) > 0.95 - 3.3 * np.sqrt(0.95 * 0.05 / cameras), share


# Two samples


@pytest.mark.slow
def test_frames_of_the_measured_camera_are_indistinguishable_and_those_of_a_wrong_one_are_not() -> (
    None
):
    """Another chip of the same preset: darks, warm darks and flats. Columns are the same along a column, so without."""
    side = 256
    changes = {"column_offset_e": 0.0}
    found = measured(side, 11, darks=16, **changes).estimates
    values = {key: max(one.value, 0.0) for key, one in found.items()} | changes
    # The lamp as the flats measured it, not as it is.
    light = found["gain_e_dn"].value / CHIP["gain_e_dn"]

    def numbers(config: DetectorConfig, shot: frame_files.PlannedFrame, seed: int) -> Floats:
        one = camera(side).model_copy(update={"detector": config})
        return np.concatenate(
            [frame.ravel() for frame in frame_files.frames_of(one, shot, seed)]
        ).astype(float)

    true = DetectorConfig.model_validate(CHIP | changes | {"hardware_seed": 21})
    ours = DetectorConfig.model_validate(CHIP | values | {"hardware_seed": 22})
    wrong = ours.model_copy(update={"dsnu": 1.08 * ours.dsnu, "prnu": 1.2 * ours.prnu})
    for kind, exposure_s, at_c, rate_e_s in (
        ("darks", 20.0, 20.0, 0.0),
        ("darks", 5.0, 32.0, 0.0),
        ("flats", 0.5, 20.0, 8000.0),
    ):
        shot = frame_files.PlannedFrame(kind, exposure_s, at_c, rate_e_s, 1)
        measured_shot = shot._replace(light_e_s=rate_e_s * light)
        same, other = (numbers(config, measured_shot, 5) for config in (ours, wrong))
        assert histogram_p(numbers(true, shot, 4), same) > 0.01, (kind, at_c)
        assert histogram_p(numbers(true, shot, 4), other) < 1e-3, (kind, at_c)


def test_tracks_of_particles_are_neither_noise_nor_hot_pixels() -> None:
    """Twelve tracks of six pixels in one dark of eight: as many pixels as would be hot, with a fivefold variance."""
    rng = np.random.default_rng(12)
    shape = (96, 96)
    frames = [
        np.rint(100 + rng.normal(0, 3, shape) + rng.poisson(20, shape)).astype(np.uint16)
        for _ in range(8)
    ]
    for x, y in rng.integers(0, 90, (12, 2)):
        frames[3][y, x : x + 6] += 400
    hit = level(10.0, None, frames)
    usable = sensor_fit.usable_pixels([hit])
    assert 70 <= (~usable).sum() <= 76
    assert hit.point(usable).variance_dn2 == pytest.approx(9 + 20 + 1 / 12, rel=0.04)
    assert hit.point(np.ones(shape, bool)).variance_dn2 > 2 * 29


def test_the_scatter_of_equal_pixels_in_whole_numbers_is_that_of_their_noise() -> None:
    """Means of sixteen rounded numbers of 0.975: a step of the numbers is a tenth of the scatter of their mean.

    The variance beyond the noise is 0 within its error, over twenty chips; a scatter of 5 % of the noise's is found.
    """
    rng = np.random.default_rng(4)
    pulls = []
    for own in [0.0] * 20 + [0.05**0.5]:
        noise = RateNoise((0.975**2 + 1 / 12) / 16, 0.0)
        each = own * np.sqrt(noise.reading) * rng.standard_normal(20_000)
        frames = np.rint(7.3 + each + 0.975 * rng.standard_normal((16, 20_000)))
        variance, error = fixed_pattern.own_variance(frames.mean(axis=0), noise)
        pulls.append(variance / error)
    assert abs(np.mean(pulls[:-1])) < 4 / np.sqrt(20)
    assert 0.6 < np.std(pulls[:-1]) < 1.5
    assert pulls[-1] == pytest.approx(0.05 / (1.1 * np.sqrt(2 / 20_000)), abs=3)


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (6.9997953, 7.000022, "6.9998 to 7.00002"),
        (31.9998196, 32.0004566, "31.99982 to 32.00046"),
        (0.2995905, 0.3004496, "0.29959 to 0.30045"),
        (0.0, 3.518e-6, "0 to 3.518e-06"),
        (5.0, 5.0, "5 to 5"),
    ],
)
def test_an_interval_shows_its_width(low: float, high: float, text: str) -> None:
    assert photon_transfer.interval_text(low, high) == text
