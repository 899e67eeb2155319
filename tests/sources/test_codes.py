"""LEDs that blink: the mean light of an exposure against fine sampling, failing bits, clocks, and rendered frames."""

from __future__ import annotations

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.scene.sections.leds import CyclicCodeConfig, PlainCodeConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import build_lab
from skysim.simulation.lights.emitters import LedDome
from skysim.sources.dome.codebooks import codebook, light_levels
from skysim.sources.dome.codes import Clocks, LedCodes

SCENE = "coded_spiral"


def codes(clock: Clocks | None, dropout: float = 0.0, depth: float = 0.6) -> LedCodes:
    """Forty coded LEDs with one bit per frame or per 20 ms."""
    if clock is None:
        plain = PlainCodeConfig(kind="gray", depth=depth, dropout=dropout)
        return LedCodes(codebook(plain, 40), plain, None, 3)
    cyclic = CyclicCodeConfig(kind="cyclic", depth=depth, bit_time="20 ms", dropout=dropout)
    return LedCodes(codebook(cyclic, 40), cyclic, clock, 3)


@pytest.mark.parametrize("frame", [0, 7, 12_345])
def test_a_frame_shows_the_bit_of_its_number(frame: int) -> None:
    shown = codes(None)
    bit = shown.words[:, frame % shown.words.shape[1]]
    np.testing.assert_array_equal(
        shown.mean_level(1.0, 0.004, frame), np.where(bit, 1.0, 0.4)
    )


@pytest.mark.parametrize(
    ("open_s", "exposure_s"), [(3.0, 0.004), (3.017, 0.02), (700.003, 0.09), (0.0, 1e-4)]
)
def test_an_exposure_has_the_mean_light_of_its_bits(open_s: float, exposure_s: float) -> None:
    """Against ten thousand moments of the clock's time, whose rate is 1 + y + d t at t."""
    clock = Clocks(np.array([1234.567]), np.array([2e-4]), np.array([1e-7]))
    shown = codes(clock)
    t = open_s + (np.arange(10_000) + 0.5) / 10_000 * exposure_s
    bit = (
        np.floor((1234.567 + t + 2e-4 * t + 1e-7 * t**2 / 2) / 0.02).astype(int)
        % shown.words.shape[1]
    )
    expected = np.where(shown.words[:, bit], 1.0, 0.4).mean(axis=1)
    np.testing.assert_allclose(
        shown.mean_level(open_s, exposure_s, 0), expected, rtol=0, atol=2e-4
    )


def test_bits_fail_at_the_stated_rate_independently() -> None:
    """Binomial: 400,000 bits at 3 %, and the failures of two LEDs coincide as often as independent ones."""
    kind = PlainCodeConfig(kind="gray", depth=1.0, dropout=0.03)
    shown = LedCodes(codebook(kind, 400), kind, None, 3)
    failed = np.array(
        [shown.level(n) != shown.words[:, n % shown.words.shape[1]] for n in range(1000)]
    )
    assert failed.mean() == pytest.approx(0.03, abs=5 * np.sqrt(0.03 * 0.97 / failed.size))
    both = (failed[:, ::2] & failed[:, 1::2]).mean()
    assert both == pytest.approx(0.03**2, abs=5 * 0.03 / np.sqrt(failed.size / 2))
    np.testing.assert_array_equal(shown.level(5), shown.level(5))


def test_a_bit_of_several_levels_fails_to_any_other_level() -> None:
    """40,000 bits at 30 %: each of the three other levels as often."""
    code = PlainCodeConfig(kind="gray", depth=0.75, levels=4, dropout=0.3)
    words = codebook(code, 400)
    shown = LedCodes(words, code, None, 3)
    light = light_levels(code, np.arange(4))
    steps = [
        (
            np.abs(shown.level(n)[:, None] - light).argmin(axis=1)
            - words[:, n % words.shape[1]]
        )
        % 4
        for n in range(100)
    ]
    share = np.bincount(np.concatenate(steps).astype(int), minlength=4) / 40_000
    np.testing.assert_allclose(
        share, [0.7, 0.1, 0.1, 0.1], rtol=0, atol=5 * np.sqrt(0.3 * 0.7 / 40_000)
    )


def test_a_run_s_code_phase_is_random_and_its_clock_belongs_to_the_hardware() -> None:
    settings = {
        "light.led.code": "{kind: cyclic, bit_time: 20 ms}",
        "light.led.clock": "{offset_ppm: 50}",
    }
    lab = build_lab(loader.load(SCENE, settings))
    dome = lab.camera.known
    assert isinstance(dome, LedDome)
    runs = [dome.timing(seed).codes for seed in (5, 6)]
    assert runs[0].clock.offset == runs[1].clock.offset
    assert abs(runs[0].clock.on_s - runs[1].clock.on_s) > 1
    plain = build_lab(loader.load("afit_simsat")).camera.known
    assert isinstance(plain, LedDome)
    assert plain.timing(5).codes is None


def test_a_rendered_led_has_the_light_of_its_bits() -> None:
    """The same attitude in frames of different bits; the electrons of the truth, per LED, over those of another."""
    settings = {
        "light.led.code.depth": "0.25",
        "motion.control": "null",
        "motion.maneuver": "[]",
    }
    lab = build_lab(loader.load(SCENE, settings))
    truths = [render_at_rest(lab.camera, lab.start, index)[1].sources for index in (2, 9)]
    assert len(truths[0].id) >= 3
    row = np.searchsorted(lab.camera.sources.id, truths[0].id)
    assert isinstance(lab.camera.known, LedDome)
    words = lab.camera.known.timing(lab.scene.seed).codes.words
    expected = [np.where(words[row, bit], 1.0, 0.75) for bit in (2, 9)]
    assert len(set((expected[0] / expected[1]).tolist())) > 1
    np.testing.assert_array_equal(truths[0].id, truths[1].id)
    np.testing.assert_allclose(
        truths[0].electrons / truths[1].electrons,
        expected[0] / expected[1],
        rtol=1e-6,
        atol=0,
    )


def test_codes_that_cannot_be_read_are_refused() -> None:
    for settings, reason in (
        (
            {"light.led.code": "{kind: gray, bit_time: 20 ms}"},
            "a gray code cannot be read without the camera's trigger",
        ),
        (
            {
                "light.led.code": "{kind: cyclic, bit_time: 20 ms}",
                "camera.shutter": "{kind: rolling, row_time: 10 us}",
            },
            "the rows of a rolling shutter show different bits",
        ),
        (
            {"light.led.code": "{kind: gray, depth: 1, levels: 4}"},
            "levels: 4 with depth 1, equally spaced",
        ),
        ({"light.led.code": "{kind: cyclic, levels: 4}"}, "levels"),
        ({"light.led.code": "null"}, "tracker.decoder: requires light.led.code"),
    ):
        with pytest.raises(InputError, match=reason):
            loader.load(SCENE, settings)
