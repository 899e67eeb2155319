"""Tolerances as on a data sheet: moments, bounds, and error messages for wrong ones."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from skysim.core.errors import InputError
from skysim.core.units import ConfigModel, LengthError, NumberError, Tolerance, scaled_errors
from skysim.dynamics import imu
from skysim.scene import loader
from skysim.scene.sections import vehicle
from skysim.sources import dome
from skysim.sources.dome import survey_errors
from skysim.sources.dome.codes import Clocks
from skysim.sources.photometry import Band

COUNT = 200_000


class Sized(ConfigModel):
    """A section with an error of each kind."""

    place_m: LengthError = 0.0
    ratio: NumberError = 0.0


def size(value: Any, key: str = "place") -> float:
    made = Sized.model_validate({key: value})
    return made.place_m if key == "place" else made.ratio


def normals(count: int = COUNT, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(count)


# --- the laws


@pytest.mark.parametrize(
    ("half", "sigma"), [(0.5, None), (0.5, 0.5 / 3), (0.5, 0.2), (0.5, 1.0), (0.5, 10.0)]
)
def test_a_tolerance_has_the_deviation_of_its_distribution(
    half: float, sigma: float | None
) -> None:
    """Against SciPy, and against the moments of what is drawn; a wide parent is uniform within the bounds."""
    oracle = (
        stats.uniform(-half, 2 * half)
        if sigma is None
        else stats.truncnorm(-half / sigma, half / sigma, 0, sigma)
    )
    tolerance = Tolerance(half, sigma)
    assert float(tolerance) == pytest.approx(oracle.std(), rel=1e-9)
    drawn = scaled_errors(tolerance, normals())
    assert np.abs(drawn).max() <= half
    assert stats.kstest(drawn, oracle.cdf).pvalue > 1e-6
    assert abs(drawn.mean()) < 5 * float(tolerance) / np.sqrt(COUNT)
    # The variance of a variance is (kurtosis + 2) sigma^4 / N.
    kurtosis = float(oracle.stats("k")) + 2
    assert drawn.var() == pytest.approx(oracle.var(), rel=5 * np.sqrt(kurtosis / COUNT))


def test_a_tolerance_of_many_sigmas_is_a_gaussian_and_of_few_uniform() -> None:
    z = normals(1000)
    np.testing.assert_allclose(scaled_errors(Tolerance(8.0, 1.0), z), z, rtol=0, atol=1e-10)
    wide = scaled_errors(Tolerance(1.0, 100.0), z)
    np.testing.assert_allclose(wide, scaled_errors(Tolerance(1.0), z), rtol=0, atol=1e-4)


def test_a_plain_size_scales_standard_normal_numbers_bit_for_bit() -> None:
    z = normals(100)
    assert scaled_errors(0.3, z).tobytes() == (0.3 * z).tobytes()


# --- as a scene states them


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("0.2 mm", 2e-4),
        ({"sigma": "0.2 mm"}, 2e-4),
        ({"sigma": "0.2 mm", "distribution": "normal"}, 2e-4),
        ({"tolerance": "0.5 mm"}, Tolerance(5e-4)),
        ({"tolerance": "±0.5 mm", "distribution": "uniform"}, Tolerance(5e-4)),
        ({"tolerance": "+/-20 um"}, Tolerance(2e-5)),
        (
            {"tolerance": "+- 1 mm", "distribution": "truncated_normal"},
            Tolerance(1e-3, 1e-3 / 3),
        ),
        (
            {"tolerance": "1 mm", "distribution": "truncated_normal", "sigma": "0.5 mm"},
            Tolerance(1e-3, 5e-4),
        ),
    ],
)
def test_a_size_is_read_as_a_sigma_or_a_tolerance(value: Any, expected: float) -> None:
    read = size(value)
    assert float(read) == pytest.approx(float(expected), rel=1e-12)
    assert isinstance(read, Tolerance) == isinstance(expected, Tolerance)
    if isinstance(expected, Tolerance):
        assert (read.half_width, read.parent_sigma) == pytest.approx(
            (expected.half_width, expected.parent_sigma)
        )


def test_a_bare_number_takes_a_tolerance_too() -> None:
    assert size(0.08, "ratio") == 0.08
    assert (
        size({"tolerance": 0.1}, "ratio")
        == size({"tolerance": "±0.1"}, "ratio")
        == Tolerance(0.1)
    )


@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        ({"tolerance": "0.5"}, "0.5 has no unit"),
        ({"tolerance": 0.5}, "has no unit"),
        ({"tolerance": "0 mm"}, "greater than 0"),
        ({"tolerance": "-1 mm"}, "greater than 0"),
        ({"tolerence": "1 mm"}, "unknown key; did you mean tolerance"),
        ({}, "an error requires a tolerance"),
        ({"distribution": "uniform"}, "uniform requires a tolerance"),
        (
            {"sigma": "1 mm", "distribution": "truncated_normal"},
            "truncated_normal requires a tolerance",
        ),
        (
            {"tolerance": "1 mm", "distribution": "normal"},
            "a normal distribution has none; allowed: uniform",
        ),
        (
            {"tolerance": "1 mm", "sigma": "1 mm"},
            "a uniform distribution has none; allowed: distribution: truncated",
        ),
        (
            {"tolerance": "1 mm", "sigma": "1 m", "distribution": "truncated_normal"},
            "a hundredth to a hundred times",
        ),
        ("-1 mm", "greater than or equal to 0"),
    ],
)
def test_a_wrong_size_is_refused(value: Any, complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        size(value)


def test_a_tolerance_is_not_a_sigma_of_its_size() -> None:
    """Scenes with one or the other are different: caches and hashes tell them apart."""
    tolerance = Tolerance(1.0)
    assert tolerance != float(tolerance)
    assert tolerance == Tolerance(1.0) != Tolerance(1.0, 0.5)
    assert pickle.loads(pickle.dumps(tolerance)) == copy.deepcopy(tolerance) == tolerance
    assert (
        Sized(place="1 mm").model_dump()
        != Sized(place={"tolerance": "1.7320508075688772 mm"}).model_dump()
    )


def test_a_misspelled_tolerance_is_answered_with_key_and_line() -> None:
    with pytest.raises(InputError) as caught:
        loader.load("afit_simsat", {"tracker.survey.led_sigma": "{tolerence: 1 mm}"})
    assert str(caught.value) == (
        "tracker.survey.led_sigma.tolerence: unknown key; did you mean tolerance?;"
        " allowed: distribution, tolerance, sigma (overrides)"
    )


# --- where a scene has them


def test_the_survey_s_leds_and_lever_stay_within_their_tolerance() -> None:
    places_m = np.zeros((20_000, 3))
    tolerance = Tolerance(5e-4)
    error_m = survey_errors.assumed_m(places_m, tolerance, 3, "leds")
    assert np.abs(error_m).max() <= 5e-4
    assert error_m.std(axis=0) == pytest.approx(5e-4 / np.sqrt(3), rel=0.02)


def dome_of(**led: Any) -> Any:
    keys = {"layout": "{kind: random, count: 20000, cap_deg: 60}", "occlusion": "false"}
    texts = {f"light.{key}": value for key, value in keys.items()}
    texts["light.surface"] = "{kind: sphere, apex: 1 m, radius: 1 m}"
    return loader.load(
        "afit_simsat", texts | {f"light.led.{key}": value for key, value in led.items()}
    ).light


def test_leds_of_a_bin_are_as_bright_as_its_tolerance() -> None:
    """±10 % about the nominal intensity, uniformly, and not lognormal."""
    band = Band.from_efficiency(0.5)
    binned = dome.sources(
        dome_of(scatter="{tolerance: 0.1}", drive="{kind: direct}"), band
    ).strength
    exact = dome.sources(dome_of(scatter="0", drive="{kind: direct}"), band).strength
    factor = binned / exact
    assert np.abs(factor - 1).max() <= 0.1 * (1 + 1e-12)
    assert stats.kstest(factor, stats.uniform(0.9, 0.2).cdf).pvalue > 1e-6


def test_a_bin_that_leaves_no_light_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"light.led.scatter: a tolerance of 1 leaves no light"
    ):
        loader.load(
            "afit_simsat",
            {"light.led.scatter": "{tolerance: 1.0, distribution: truncated_normal}"},
        )


def test_crystals_of_a_data_sheet_are_within_their_tolerance() -> None:
    config = dome_of(clock="{offset_ppm: {tolerance: 50}, drift_ppm_h: 0}").led.clock
    offset = Clocks.draw(config, 20_000, 1, 2).offset
    assert np.abs(offset).max() <= 50e-6
    assert offset.std() == pytest.approx(50e-6 / np.sqrt(3), rel=0.02)


def test_gyros_of_a_data_sheet_are_within_their_tolerance() -> None:
    """Scale factors, misalignments and turn-on biases over a thousand units."""
    config = vehicle.ImuConfig.model_validate(
        {
            "gyro": {
                "scale_ppm": {"tolerance": 300},
                "turn_on_bias_deg_h": {"tolerance": 2},
                "misalignment_arcsec": 0,
            }
        }
    )
    units = [
        imu.Imu(config.model_copy(update={"hardware_seed": seed}), np.random.default_rng(0))
        for seed in range(1000)
    ]
    scale_ppm = np.array([np.diag(unit.gyro.matrix) - 1 for unit in units]) * 1e6
    bias_deg_h = np.degrees([unit.gyro.turn_on_bias for unit in units]) * 3600
    for drawn, half in ((scale_ppm, 300), (bias_deg_h, 2)):
        assert np.abs(drawn).max() <= half * (1 + 1e-9)
        assert drawn.std() == pytest.approx(half / np.sqrt(3), rel=0.05)


def test_glued_leds_stay_within_their_tolerance() -> None:
    """Places on a flat board, along its own axes, with the glue and without."""
    keys = {
        "light.surface": "{kind: flat, apex: 1.2 m}",
        "light.layout": "{kind: patch_boards, cap_deg: 40, spacing: 3 cm, pitch: 8 mm, glue_scatter: GLUE}",
    }
    made = [
        dome.sources(
            loader.load(
                "afit_simsat",
                keys | {"light.layout": keys["light.layout"].replace("GLUE", glue)},
            ).light,
            Band.from_efficiency(0.5),
        ).place[:, :3]
        for glue in ("{tolerance: 0.1 mm}", "0 mm")
    ]
    moved_m = np.linalg.norm(made[0] - made[1], axis=1)
    assert len(moved_m) > 1000
    assert moved_m.max() <= 1e-4 * np.sqrt(2) * (1 + 1e-9)
    assert np.mean(moved_m**2) == pytest.approx(2 * 1e-8 / 3, rel=0.05)
