"""Charge to numbers: every step's mean and variance, and the chip's two ends."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skysim import detector
from skysim.scene import Detector

PIXELS = (400, 500)
N = 400 * 500
CLEAN = {
    "quantum_efficiency": 0.5,
    "full_well_e": 1e9,
    "gain_e_dn": 1.0,
    "offset_dn": 1000.0,
    "bits": 16,
}


def chip(**changes: Any) -> Detector:
    return Detector.model_validate(CLEAN | changes)


def frame(mean_e: float, seed: int = 1, exposure_s: float = 0.05, **changes: Any) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return detector.expose(np.full(PIXELS, mean_e), exposure_s, chip(**changes), rng).astype(float)


@pytest.mark.parametrize("mean_e", [0.5, 20.0, 3000.0])
def test_shot_noise_has_the_variance_of_its_mean(mean_e: float) -> None:
    made = frame(mean_e) - 1000
    assert made.mean() == pytest.approx(mean_e, abs=4 * np.sqrt(mean_e / N))
    # The variance of a Poisson sample's variance is (2 mu^2 + mu) / N.
    assert made.var() == pytest.approx(mean_e, abs=4 * np.sqrt((2 * mean_e**2 + mean_e) / N))


def test_read_noise_adds_its_variance_and_the_rounding_a_twelfth() -> None:
    made = frame(0.0, read_noise_e=14.7) - 1000
    assert made.mean() == pytest.approx(0, abs=4 * 14.7 / np.sqrt(N))
    assert made.var() == pytest.approx(14.7**2 + 1 / 12, abs=4 * 14.7**2 * np.sqrt(2 / N))


def test_read_noise_is_gaussian() -> None:
    made = (frame(0.0, read_noise_e=40.0) - 1000) / 40
    assert np.mean(made**3) == pytest.approx(0, abs=4 * np.sqrt(15 / N))
    assert np.mean(made**4) == pytest.approx(3, abs=4 * np.sqrt(96 / N))


def test_photon_transfer_slope_is_one_over_the_gain() -> None:
    """Variance against mean of the numbers is a line of slope 1/gain from the read noise (Janesick)."""
    levels, gain = np.array([200, 1000, 3000, 8000, 16000.0]), 4.0
    frames = [frame(e, seed=int(e), gain_e_dn=gain, read_noise_e=20.0) for e in levels]
    mean, variance = np.transpose([(made.mean() - 1000, made.var()) for made in frames])
    error = variance * np.sqrt(2 / N)
    slope, floor = np.polyfit(mean, variance, 1, w=1 / error)
    assert slope == pytest.approx(1 / gain, abs=1e-3)  # four sigma of the fit: 4 x 0.25 sqrt(2 / N) / 2
    assert floor == pytest.approx(20**2 / gain**2 + 1 / 12, abs=0.8)


@pytest.mark.parametrize("gain", [1.0, 7.3, 10.0])
def test_the_gain_divides_and_the_offset_adds(gain: float) -> None:
    made = frame(5000.0, gain_e_dn=gain, offset_dn=64.0)
    assert made.mean() == pytest.approx(64 + 5000 / gain, abs=4 * np.sqrt(5000 / N) / gain + 1e-3)


def test_numbers_are_the_nearest_integers() -> None:
    electrons = np.array([[0.0, 4.9, 5.1, 14.9, 15.1, 104.0]])
    np.testing.assert_array_equal(detector.digitise(electrons, 10.0, 64.0, 12), [[64, 64, 65, 65, 66, 74]])


@pytest.mark.parametrize(("bits", "top"), [(8, 255), (12, 4095), (16, 65535)])
def test_the_converter_ends_at_zero_and_at_all_ones(bits: int, top: int) -> None:
    made = detector.digitise(np.array([[-1e6, 1e9]]), 1.0, 100.0, bits)
    assert made.dtype == np.uint16
    np.testing.assert_array_equal(made, [[0, top]])


def test_a_full_well_holds_no_more() -> None:
    made = frame(1e5, full_well_e=40000, gain_e_dn=10, offset_dn=64)
    np.testing.assert_array_equal(made, 4064)


def test_read_noise_comes_after_the_well_and_so_shows_above_it() -> None:
    made = frame(1e5, full_well_e=40000, gain_e_dn=10, offset_dn=64, read_noise_e=50)
    assert made.mean() == pytest.approx(4064, abs=4 * 5 / np.sqrt(N))
    assert made.std() == pytest.approx(np.sqrt(25 + 1 / 12), abs=4 * 5 / np.sqrt(2 * N))


@pytest.mark.parametrize(("bits", "ends_at"), [(16, 4064.0), (12, 4064.0), (10, 1023.0)])
def test_saturation_is_the_lower_of_well_and_converter(bits: int, ends_at: float) -> None:
    part = chip(full_well_e=40000, gain_e_dn=10, offset_dn=64, bits=bits)
    assert detector.saturation_dn(part) == ends_at
    blinding = detector.expose(np.full((4, 4), 1e6), 0.05, part, np.random.default_rng(0))
    np.testing.assert_array_equal(blinding, ends_at)


def test_dark_current_and_sky_grow_with_time() -> None:
    mean = [frame(0.0, exposure_s=t, dark_e_s=200.0, sky_e_s=300.0).mean() - 1000 for t in (1.0, 2.0, 4.0)]
    np.testing.assert_allclose(mean, [500, 1000, 2000], rtol=0, atol=4 * np.sqrt(2000 / N))


def test_without_noise_the_frame_is_the_expectation() -> None:
    mean_e = np.random.default_rng(3).uniform(0, 1e6, PIXELS)
    quiet = chip(noise=False, gain_e_dn=7.0, offset_dn=64, dark_e_s=100.0, bits=8, full_well_e=10)
    made = detector.expose(mean_e, 0.5, quiet, np.random.default_rng(0))
    assert made.dtype == np.float64
    np.testing.assert_allclose(made, (mean_e + 50) / 7 + 64, rtol=1e-15, atol=0)


def test_the_mean_of_many_frames_is_the_frame_without_noise() -> None:
    settings = {"read_noise_e": 10.0, "gain_e_dn": 5.0, "dark_e_s": 200.0}
    quiet = frame(1234.5, noise=False, **settings)
    sigma = np.sqrt((1234.5 + 10 + 100) / 25 + 1 / 12)
    assert frame(1234.5, **settings).mean() == pytest.approx(quiet.mean(), abs=4 * sigma / np.sqrt(N))


def test_the_same_stream_gives_the_same_frame_and_leaves_the_light_alone() -> None:
    light = np.full(PIXELS, 100.0)
    first, again, other = (
        detector.expose(light, 0.05, chip(read_noise_e=5), np.random.default_rng(seed)) for seed in (4, 4, 5)
    )
    np.testing.assert_array_equal(first, again)
    assert np.mean(first != other) > 0.8
    np.testing.assert_array_equal(light, 100.0)


def test_pixels_know_nothing_of_their_neighbours() -> None:
    made = frame(400.0, read_noise_e=10) - 1400
    for shifted in (made[:, 1:] * made[:, :-1], made[1:] * made[:-1]):
        assert shifted.mean() == pytest.approx(0, abs=4 * 500 / np.sqrt(N))
