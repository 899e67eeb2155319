"""From charge to DN: the law of each step, the exact distribution of DN, and clipping at both ends."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from scipy import stats

from skysim.camera import detector
from skysim.camera.detector import Detector
from skysim.core.types import SourceTruth
from skysim.scene.sections.camera import CameraConfig

SHAPE = (400, 500)
N = SHAPE[0] * SHAPE[1]
CLEAN = {
    "quantum_efficiency": 0.5,
    "full_well_e": 1e9,
    "gain_e_dn": 1.0,
    "offset_dn": 1000.0,
    "bits": 16,
}
LENS = {"pixel": "5 um", "focal_length": "25 mm", "f_number": 2}


def detector_with(
    shape: tuple[int, int] = SHAPE, shutter: dict[str, Any] | None = None, **changes: Any
) -> Detector:
    part = LENS | {"height_px": shape[0], "width_px": shape[1], "detector": CLEAN | changes}
    return Detector.from_camera(
        CameraConfig.model_validate(part | ({"shutter": shutter} if shutter else {}))
    )


def expose(
    light_e: np.ndarray, made: Detector, seed: int = 1, exposure_s: float = 0.05
) -> np.ndarray:
    kind = np.float32 if made.config.noise else np.float64
    return detector.expose(
        light_e.astype(kind), exposure_s, made, np.random.default_rng(seed)
    ).astype(float)


def frame(
    mean_e: float, seed: int = 1, exposure_s: float = 0.05, **changes: Any
) -> np.ndarray:
    return expose(np.full(SHAPE, mean_e), detector_with(**changes), seed, exposure_s)


# The numbers as a whole


def law(
    mean_e: float, read_e: float, gain: float, offset: float, bits: int, well_e: float
) -> np.ndarray:
    """Probability of every DN: Poisson electrons clipped at the well, plus Gaussian noise, rounded and clipped."""
    n = np.arange(int(mean_e + 12 * np.sqrt(mean_e)) + 12)
    edges_e = (np.arange(2**bits - 1) + 0.5 - offset) * gain
    held = np.minimum(n, well_e)
    below = stats.norm.cdf((edges_e[:, None] - held) / read_e) @ stats.poisson.pmf(n, mean_e)
    return np.diff(np.concatenate([[0], below, [1]]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mean_e", "read_e", "gain", "offset", "bits", "well_e"),
    [
        (0.3, 14.7, 10.0, 64.0, 12, 40000),  # a star tracker's sky
        (0.3, 0.4, 1.0, 5.0, 8, 100),  # counted electrons
        (7.5, 2.0, 0.37, 30.0, 12, 40000),  # a gain finer than an electron
        (40.0, 5.0, 3.0, 10.0, 10, 40000),
        (900.0, 50.0, 157.0, 2.0, 8, 40000),  # coarse eight bits
        (5000.0, 15.0, 10.0, 100.0, 12, 5010.0),  # half of it held by the well
        (1200.0, 20.0, 5.0, 20.0, 8, 40000),  # half of it beyond the converter's end
        (1.0, 30.0, 4.0, 3.0, 12, 40000),  # half of it below zero
    ],
)
def test_the_noise_histogram_matches_the_detector_s_law(
    mean_e: float, read_e: float, gain: float, offset: float, bits: int, well_e: float
) -> None:
    settings = {"gain_e_dn": gain, "offset_dn": offset, "bits": bits, "full_well_e": well_e}
    made = detector_with((1000, 1000), read_noise_e=read_e, **settings)
    numbers = (
        expose(np.full((1000, 1000), mean_e), made, seed=int(100 * mean_e))
        .astype(np.int64)
        .ravel()
    )
    wanted = law(float(np.float32(mean_e)), read_e, gain, offset, bits, well_e) * 1e6
    found = np.bincount(numbers, minlength=len(wanted))
    common = wanted >= 10
    assert found[~common].sum() == pytest.approx(
        wanted[~common].sum(), abs=4 * np.sqrt(wanted[~common].sum()) + 1
    )
    chi2 = ((found - wanted)[common] ** 2 / wanted[common]).sum()
    assert stats.chi2.sf(chi2, common.sum() - 1) > 1e-4


@pytest.mark.slow
def test_photon_transfer_slope_is_one_over_the_gain() -> None:
    """Variance against mean of ten thousand frames' pixels is a line of slope 1/gain from the read noise
    (Janesick). A ramp of light across the chip gives all levels at once; each pixel is compared with itself, so the
    fixed pattern stays out of the variance, and the columns' offsets are taken from the mean as a bias frame is."""
    gain = 4.0
    read_e = 20.0
    frames = 10_000
    levels = np.repeat(np.geomspace(30, 30000, 16), 2)
    made = detector_with(
        (16, 32),
        gain_e_dn=gain,
        read_noise_e=read_e,
        prnu=0.03,
        column_offset_e=9,
        full_well_e=2e5,
    )
    light_e = np.tile(levels, (16, 1)).astype(np.float32)
    rng = np.random.default_rng(7)
    numbers = np.array(
        [detector.expose(light_e.copy(), 0.01, made, rng) for _ in range(frames)], dtype=float
    )
    mean = numbers.mean(axis=0) - 1000
    variance = numbers.var(axis=0, ddof=1).ravel()
    mean = (mean - made.column_offset_e / gain).ravel()
    error = variance * np.sqrt(2 / frames)
    (slope, floor), covariance = np.polyfit(mean, variance, 1, w=1 / error, cov="unscaled")
    assert slope == pytest.approx(1 / gain, abs=4 * np.sqrt(covariance[0, 0]))
    assert floor == pytest.approx(
        (read_e / gain) ** 2 + 1 / 12, abs=4 * np.sqrt(covariance[1, 1])
    )
    assert np.sqrt(covariance[0, 0]) < 1e-3 / gain  # so that it would see a per cent
    chi2 = (((variance - floor - slope * mean) / error) ** 2).sum()
    assert stats.chi2.sf(chi2, mean.size - 2) > 1e-4


# Counting


@pytest.mark.parametrize("mean_e", [0.5, 20.0, 3000.0])
def test_shot_noise_has_the_variance_of_its_mean(mean_e: float) -> None:
    made = frame(mean_e) - 1000
    assert made.mean() == pytest.approx(mean_e, abs=4 * np.sqrt(mean_e / N))
    # The variance of a Poisson sample's variance is (2 mu^2 + mu) / N.
    assert made.var() == pytest.approx(mean_e, abs=4 * np.sqrt((2 * mean_e**2 + mean_e) / N))


def test_prnu_scales_light_and_not_dark_current() -> None:
    made = detector_with(prnu=0.02, dark_e_s=1e5)
    lit, dark = (
        np.mean([expose(np.full(SHAPE, e), made, n) - 1000 for n in range(30)], axis=0)
        for e in (2e4, 0)
    )
    spread = lit - dark
    error = np.sqrt((2e4 + 2 * 5e3) / 30)
    assert spread.std() == pytest.approx(np.hypot(0.02 * 2e4, error), rel=4 / np.sqrt(2 * N))
    assert spread.mean() == pytest.approx(
        2e4, abs=4 * np.hypot(0.02 * 2e4, error) / np.sqrt(N)
    )
    assert np.corrcoef(spread.ravel(), made.sensitivity.ravel())[0, 1] > 0.98
    assert dark.std() == pytest.approx(np.sqrt(5e3 / 30), rel=4 / np.sqrt(2 * N))


def test_dark_current_doubles_with_its_temperature() -> None:
    warm = {"dark_e_s": 200.0, "dark_temperature_c": 20, "dark_doubling_c": 7}
    mean = [
        frame(0, temperature_c=t, exposure_s=2.0, **warm).mean() - 1000
        for t in (6, 13, 20, 27)
    ]
    np.testing.assert_allclose(mean, [100, 200, 400, 800], rtol=0, atol=4 * np.sqrt(800 / N))
    assert frame(0, exposure_s=2.0, **warm).mean() - 1000 == pytest.approx(
        400, abs=4 * np.sqrt(400 / N)
    )


def test_dark_current_is_lognormal_with_its_own_mean_and_spread() -> None:
    dark = detector_with((1000, 1000), dark_e_s=100, dsnu=0.4).dark_e_s.astype(float)
    assert dark.mean() == pytest.approx(100, abs=4 * 40 / 1e3)
    s = np.sqrt(np.log(1 + 0.4**2))
    assert stats.kstest(np.log(dark.ravel() / 100) / s + s / 2, "norm").pvalue > 1e-4


def test_hot_pixels_have_their_declared_number_and_strength() -> None:
    dark = (
        detector_with(
            (1000, 1000), dark_e_s=5, hot_pixels=0.01, hot_e_s=3000
        ).dark_e_s.astype(float)
        - 5
    )
    hot = dark[dark > 0]
    assert len(hot) == pytest.approx(1e4, abs=4 * 1e2)
    assert stats.kstest(hot / 3000, "expon").pvalue > 1e-4


def test_the_fixed_pattern_depends_on_the_hardware_seed() -> None:
    spread = {
        "prnu": 0.01,
        "dark_e_s": 10,
        "dsnu": 0.3,
        "hot_pixels": 1e-3,
        "hot_e_s": 100,
        "column_offset_e": 3,
    }
    same, again, other = (detector_with(hardware_seed=seed, **spread) for seed in (4, 4, 5))
    for name in ("sensitivity", "dark_e_s", "column_offset_e"):
        np.testing.assert_array_equal(getattr(same, name), getattr(again, name))
        assert np.mean(getattr(same, name) == getattr(other, name)) < 0.01


# Reading


def test_read_reset_and_rounding_variances_add() -> None:
    made = frame(0.0, read_noise_e=14.7, reset_noise_e=8.0) - 1000
    assert made.mean() == pytest.approx(0, abs=4 * 17 / np.sqrt(N))
    variance = 14.7**2 + 8**2 + 1 / 12
    assert made.var() == pytest.approx(variance, abs=4 * variance * np.sqrt(2 / N))


def test_column_offsets_are_fixed() -> None:
    made = detector_with(column_offset_e=6.0, read_noise_e=2.0)
    columns = expose(np.zeros(SHAPE), made).mean(axis=0) - 1000
    np.testing.assert_allclose(
        columns, made.column_offset_e, rtol=0, atol=5 * 2.1 / np.sqrt(SHAPE[0])
    )
    assert columns.std() == pytest.approx(6.0, rel=4 / np.sqrt(2 * SHAPE[1]))


@pytest.mark.parametrize("gain", [1.0, 7.3, 10.0])
def test_the_gain_divides_and_the_offset_adds(gain: float) -> None:
    made = frame(5000.0, gain_e_dn=gain, offset_dn=64.0)
    assert made.mean() == pytest.approx(
        64 + 5000 / gain, abs=4 * np.sqrt(5000 / N) / gain + 1e-3
    )


def test_the_amplifier_has_its_declared_nonlinearity_at_full_well() -> None:
    bent = {"nonlinearity": 0.05, "full_well_e": 40000.0}
    for mean_e in (4000.0, 20000.0, 36000.0):
        # <e^2> is mean^2 + mean.
        wanted = mean_e * (1 - 0.05 * mean_e / 40000) - 0.05 * mean_e / 40000
        assert frame(mean_e, **bent).mean() - 1000 == pytest.approx(
            wanted, abs=4 * np.sqrt(mean_e / N)
        )
    assert frame(1e6, **bent).mean() == 1000 + 38000


@pytest.mark.parametrize(("bits", "top"), [(8, 255), (12, 4095), (16, 65535)])
def test_the_converter_ends_at_zero_and_at_all_ones(bits: int, top: int) -> None:
    made = detector_with((16, 16), offset_dn=100, bits=bits, read_noise_e=500.0)
    dark = expose(np.zeros((16, 16)), made)
    assert dark.min() == 0
    assert dark.dtype == float
    np.testing.assert_array_equal(expose(np.full((16, 16), 1e8), made), top)
    raw = detector.expose(
        np.zeros((16, 16), np.float32), 0.05, made, np.random.default_rng(0)
    )
    assert raw.dtype == np.uint16


# Full wells


def test_charge_is_clipped_at_full_well() -> None:
    made = frame(1e5, full_well_e=40000, gain_e_dn=10, offset_dn=64)
    np.testing.assert_array_equal(made, 4064)


def test_read_noise_is_added_after_clipping_at_full_well() -> None:
    made = frame(1e5, full_well_e=40000, gain_e_dn=10, offset_dn=64, read_noise_e=50)
    assert made.mean() == pytest.approx(4064, abs=4 * 5 / np.sqrt(N))
    assert made.std() == pytest.approx(np.sqrt(25 + 1 / 12), abs=4 * 5 / np.sqrt(2 * N))


@pytest.mark.parametrize(("bits", "ends_at"), [(16, 4064.0), (12, 4064.0), (10, 1023.0)])
def test_saturation_is_the_lower_of_well_and_converter(bits: int, ends_at: float) -> None:
    made = detector_with((16, 16), full_well_e=40000, gain_e_dn=10, offset_dn=64, bits=bits)
    assert detector.saturation_dn(made.config) == ends_at
    np.testing.assert_array_equal(expose(np.full((16, 16), 1e6), made), ends_at)


def spot(electrons: float) -> np.ndarray:
    light_e = np.zeros((64, 32))
    light_e[30, 10] = electrons
    return light_e


def test_an_overflowing_well_spills_along_its_column_without_loss() -> None:
    made = (
        expose(spot(2e5), detector_with((64, 32), full_well_e=20000, blooming="column"))
        - 1000
    )
    assert made[:, 10].max() == 20000
    assert (made[:, 10] == 20000).sum() in (9, 10, 11)
    assert made.sum() == pytest.approx(2e5, abs=4 * np.sqrt(2e5))
    assert not made[:, np.arange(32) != 10].any()
    drained = (
        expose(
            spot(2e5),
            detector_with((64, 32), full_well_e=20000, blooming="column", anti_blooming=1.0),
        )
        - 1000
    )
    assert drained.sum() == 20000


def test_transfers_leave_charge_behind_the_star() -> None:
    """31 parallel transfers of 1e-3 leave 3 % in the pixel that is read after it (away from the register)."""
    made = (
        np.mean(
            [
                expose(spot(1e4), detector_with((64, 32), cti_parallel=1e-3), n)
                for n in range(60)
            ],
            axis=0,
        )
        - 1000
    )
    lost = 31 * 1e-3 * (1 - 1e-3) ** 31
    error = np.sqrt(1e4 / 60)
    assert made[31, 10] == pytest.approx(1e4 * lost, abs=4 * error * lost + 0.3)
    assert made[30, 10] == pytest.approx(1e4 * (1 - 1e-3) ** 31, abs=4 * error)
    assert made.sum() == pytest.approx(1e4, abs=4 * error + 5)
    quiet = expose(spot(1e4), detector_with((64, 32), cti_parallel=1e-3, noise=False)) - 1000
    assert quiet[31, 10] == pytest.approx(1e4 * lost, rel=1e-9)  # the expectation knows of it


def test_particles_add_their_tracks() -> None:
    shower = {"per_cm2_s": 4e4, "depth": "10 um"}
    made = expose(np.zeros((64, 32)), detector_with((64, 32), particles=[shower])) - 1000
    struck = 4e4 * 0.05 * 64 * 32 * (5e-4) ** 2  # about one a frame of 64 x 32 pixels of 5 um
    assert struck == pytest.approx(1.0, abs=0.1)
    sums = [
        (
            expose(np.zeros((64, 32)), detector_with((64, 32), particles=[shower]), n) - 1000
        ).sum()
        for n in range(200)
    ]
    assert np.mean(np.array(sums) == 0) == pytest.approx(
        np.exp(-struck), abs=4 * np.sqrt(0.25 / 200) + 0.05
    )
    assert made.min() >= 0


# Shutters of charge


@pytest.mark.parametrize(
    ("shutter", "share"),
    [
        ({"kind": "frame_transfer", "row_time": "10 us"}, 10e-6 / 0.05),
        ({"kind": "interline", "row_time": "100 us", "leak": 0.02}, 0.02 * 100e-6 / 0.05),
    ],
)
def test_a_shifted_frame_smears_its_columns(shutter: dict[str, Any], share: float) -> None:
    quiet = detector_with((64, 32), shutter=shutter, noise=False, offset_dn=0)
    light_e = spot(1e6)
    detector.smear(light_e, 0.05, quiet.shutter)
    made = expose(light_e, quiet)
    others = np.delete(made[:, 10], 30)
    np.testing.assert_allclose(others, 1e6 * share, rtol=1e-6, atol=0)
    assert not np.delete(made, 10, axis=1).any()


# The expectation, and the truth that goes with it


def test_without_noise_the_frame_is_the_expectation() -> None:
    mean_e = np.random.default_rng(3).uniform(0, 1e6, SHAPE)
    quiet = {
        "noise": False,
        "gain_e_dn": 7.0,
        "offset_dn": 64,
        "dark_e_s": 100.0,
        "bits": 8,
        "full_well_e": 10,
    }
    made = expose(mean_e, detector_with(**quiet), exposure_s=0.5)
    np.testing.assert_allclose(made, (mean_e + 50) / 7 + 64, rtol=1e-15, atol=0)


@pytest.mark.slow
def test_the_mean_of_many_frames_is_the_frame_without_noise() -> None:
    settings = {
        "read_noise_e": 10.0,
        "gain_e_dn": 5.0,
        "dark_e_s": 200.0,
        "prnu": 0.05,
        "column_offset_e": 20.0,
    }
    settings |= {"dsnu": 0.5, "hot_pixels": 0.01, "hot_e_s": 1000}
    quiet = frame(1234.5, noise=False, **settings)
    mean = np.mean([frame(1234.5, seed, **settings) for seed in range(40)], axis=0)
    sigma = np.sqrt((1234.5 + 10 + 100) / 25 + 1 / 12) / np.sqrt(40)
    # Hot pixels and PRNU change sigma a little.
    assert ((mean - quiet) / sigma).std() == pytest.approx(1, abs=0.15)
    assert (mean - quiet).mean() == pytest.approx(0, abs=4 * sigma / np.sqrt(N))


DRAW = """
import sys, numba, numpy as np
from skysim.scene.sections.camera import CameraConfig
from skysim.camera.detector import Detector, expose
numba.set_num_threads(int(sys.argv[1]))
made = Detector.from_camera(CameraConfig.model_validate(eval(sys.argv[2])))
frames = [expose(np.full((64, 48), 100, np.float32), 0.05, made, np.random.default_rng(s)) for s in (4, 5)]
sys.stdout.buffer.write(np.array(frames).tobytes())
"""


@pytest.mark.long
def test_the_same_stream_gives_the_same_frame_on_any_number_of_threads() -> None:
    part = repr(
        LENS
        | {
            "height_px": 64,
            "width_px": 48,
            "detector": CLEAN | {"read_noise_e": 5, "prnu": 0.01},
        }
    )
    alone, many = (
        np.frombuffer(
            subprocess.run(
                [sys.executable, "-c", DRAW, threads, part],
                env=os.environ | {"NUMBA_NUM_THREADS": "3"},
                capture_output=True,
                check=True,
            ).stdout,
            np.uint16,
        ).reshape(2, 64, 48)
        for threads in ("1", "3")
    )
    np.testing.assert_array_equal(alone, many)
    assert np.mean(alone[0] != alone[1]) > 0.8


def test_row_by_row_simulation_equals_step_by_step_simulation() -> None:
    """An unreachable blooming threshold selects the step-by-step code."""
    light_e = np.random.default_rng(1).uniform(0, 3000, SHAPE)
    spread = {
        "read_noise_e": 5,
        "prnu": 0.01,
        "dark_e_s": 200,
        "dsnu": 0.3,
        "column_offset_e": 3,
    }
    short, long = (
        expose(light_e, detector_with(blooming=kind, **spread), 4)
        for kind in ("none", "column")
    )
    np.testing.assert_array_equal(short, long)


def test_noise_of_neighboring_pixels_is_independent() -> None:
    made = frame(400.0, read_noise_e=10) - 1400
    for shifted in (made[:, 1:] * made[:, :-1], made[1:] * made[:-1]):
        assert shifted.mean() == pytest.approx(0, abs=4 * 500 / np.sqrt(N))


def seen(electrons: float, area_px: float, peak_e: float) -> SourceTruth:
    one = np.ones(1)
    place = np.array([[10, 30]])
    return SourceTruth(
        one.astype(int), place * 1.0, place * 1.0, electrons * one, peak_e * one, 0 * one, area_px * one, place,
        one > 1, one,
    )  # fmt: skip


def test_signal_to_noise_matches_repeated_photometry() -> None:
    """A flat image of 25 pixels, 40 e- each on a sky of 30: its sum over them in 400 frames."""
    light_e = np.full((64, 32), 30.0)
    light_e[28:33, 8:13] += 40
    made = detector_with((64, 32), read_noise_e=10.0, gain_e_dn=12.0, offset_dn=20.0)
    sources = detector.add_snr_and_saturation(
        seen(1000.0, 25.0, 40.0), light_e.astype(np.float32), 0.05, made
    )
    sums = [(expose(light_e, made, n)[28:33, 8:13]).sum() * 12.0 for n in range(400)]
    assert sources.snr[0] == pytest.approx(1000 / np.std(sums), rel=4 / np.sqrt(2 * 400))
    assert not sources.saturated[0]


def test_signal_to_noise_has_each_noise_of_a_pixel() -> None:
    """N / sqrt(N + n (sky + read^2 + reset^2 + gain^2 / 12)), the CCD equation; each of the last three alone."""
    light_e = np.full((64, 32), 70.0)
    noise_e = {"read_noise_e": 7.0, "reset_noise_e": 11.0, "gain_e_dn": 30.0}
    for name in noise_e:
        one = {"read_noise_e": 0.1, "reset_noise_e": 0.0, "gain_e_dn": 1.0} | {
            name: noise_e[name]
        }
        made = detector_with((64, 32), offset_dn=20.0, **one)
        sources = detector.add_snr_and_saturation(
            seen(1000.0, 25.0, 40.0), light_e.astype(np.float32), 0.05, made
        )
        pixel_e2 = (
            one["read_noise_e"] ** 2 + one["reset_noise_e"] ** 2 + one["gain_e_dn"] ** 2 / 12
        )
        assert sources.snr[0] == pytest.approx(
            1000 / np.sqrt(1000 + 25 * (30 + pixel_e2)), rel=1e-6
        )


@pytest.mark.parametrize(("peak_e", "full"), [(39000.0, False), (41000.0, True)])
def test_a_source_is_saturated_where_its_brightest_pixel_is(
    peak_e: float, full: bool
) -> None:
    made = detector_with((64, 32), full_well_e=40000.0, gain_e_dn=10.0, offset_dn=64.0)
    sources = detector.add_snr_and_saturation(
        seen(peak_e, 1.0, peak_e), spot(peak_e).astype(np.float32), 0.05, made
    )
    assert sources.saturated[0] == full


# Charge that repels charge.


def test_charge_moves_over_the_boundaries_and_none_is_lost() -> None:
    """Boundary by boundary: the brighter of two pixels loses a (q - p) (q + p) / 2 to the other."""
    shift_per_e = 2e-6
    chip = detector_with((16, 17), full_well_e=1e5, brighter_fatter_per_e=shift_per_e)
    before = np.random.default_rng(4).uniform(0, 6e4, (16, 17))
    light_e = before.copy()
    detector.repel(light_e, chip.config)
    expected = before.copy()
    for here, there in [
        *(((j, i), (j, i + 1)) for j in range(16) for i in range(16)),
        *(((j, i), (j + 1, i)) for j in range(15) for i in range(17)),
    ]:
        flow_e = (
            shift_per_e * (before[here] - before[there]) * (before[here] + before[there]) / 2
        )
        expected[here] -= flow_e
        expected[there] += flow_e
    np.testing.assert_allclose(light_e, expected, rtol=1e-12)
    assert light_e.sum() == pytest.approx(before.sum(), rel=1e-12)


def test_a_bright_star_is_wider_than_a_faint_one() -> None:
    """By the law's own second moment: a sum of squares of the light, over the light."""
    chip = detector_with((21, 21), full_well_e=1e5, brighter_fatter_per_e=1e-6)
    y, x = np.mgrid[-10:11, -10:11]
    light = np.exp(-(x**2 + y**2) / (2 * 1.1**2))
    widths = []
    for peak_e in (100.0, 6e4):
        light_e = peak_e * light
        detector.repel(light_e, chip.config)
        widths.append((light_e * x**2).sum() / light_e.sum())
    # The Laplacian moves a moment of x^2 by 2 for each unit of q^2 a / 2.
    wider = 1e-6 * 6e4 * (light**2).sum() / light.sum()
    assert widths[1] - widths[0] == pytest.approx(wider, rel=0.01)


def test_wells_that_would_lose_more_than_they_hold_are_refused() -> None:
    with pytest.raises(ValueError, match="brighter_fatter_per_e"):
        detector_with(full_well_e=1e5, brighter_fatter_per_e=1e-5)
