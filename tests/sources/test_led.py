"""What an LED sends: inverse square, Lambert's cosine, and its pulses against brute-force sampling."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from skysim.scene.sections.leds import CosineLobeConfig, LedConfig, LobeTableConfig
from skysim.sources.dome.led import FALLOFF, LOBES, Emitter, irradiance_e_s_m2
from skysim.sources.photometry import Band, led_strength_e_s_sr

ONE = np.ones(1)
LAMBERT = Emitter()


def irradiance(cos_out: float = 1.0, cos_in: float = 1.0, distance_m: float = 1.0, emitter: Emitter = LAMBERT) -> float:
    return float(irradiance_e_s_m2(5e12 * ONE, emitter, cos_out * ONE, cos_in * ONE, distance_m * ONE)[0])


def cosine(exponent: float) -> Emitter:
    return Emitter(lobe=CosineLobeConfig(exponent=exponent))


def measured(angle_deg: list[float], intensity: list[float]) -> Emitter:
    table = {"kind": "table", "angle_deg": angle_deg, "intensity": intensity}
    return Emitter(lobe=LobeTableConfig.model_validate(table))


def test_on_its_normal_at_a_meter_the_irradiance_is_the_strength() -> None:
    assert irradiance() == pytest.approx(5e12, rel=1e-15)


@pytest.mark.parametrize("distance_m", [0.1, 0.8382, 1.0, 3.0])
def test_twice_as_far_is_a_quarter_as_bright(distance_m: float) -> None:
    assert irradiance(distance_m=2 * distance_m) == pytest.approx(irradiance(distance_m=distance_m) / 4, rel=1e-14)


def test_lambert_s_emitter_and_the_aperture_each_cost_a_cosine() -> None:
    out, into = np.cos(np.radians([30.0, 10.0]))
    assert irradiance(out, into) == pytest.approx(5e12 * out * into, rel=1e-14)


def test_reference_cosine_falloff_of_the_led_at_5_10_and_30_degrees() -> None:
    # Reference §2: .9962 / .9848 / .866.
    share = [irradiance(cos_out=float(np.cos(np.radians(angle)))) / 5e12 for angle in (5, 10, 30)]
    np.testing.assert_allclose(share, [0.9962, 0.9848, 0.866], rtol=0, atol=5e-5)  # as printed


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.5, 20.0])
def test_the_lobe_is_the_cosine_to_its_exponent(exponent: float) -> None:
    assert irradiance(cos_out=0.8, emitter=cosine(exponent)) == pytest.approx(5e12 * 0.8**exponent, rel=1e-13)


def test_a_measured_lobe_goes_through_its_points_and_between_them() -> None:
    emitter = measured([0, 30, 60, 75], [1.0, 0.9, 0.5, 0.2])
    made = [irradiance(np.cos(np.radians(angle)), emitter=emitter) / 5e12 for angle in (0, 30, 60, 45, 74.99)]
    np.testing.assert_allclose(made, [1, 0.9, 0.5, 0.7, 0.2002], rtol=0, atol=1e-9)
    assert irradiance(np.cos(np.radians(75.1)), emitter=emitter) == 0.0


def test_a_table_of_cosines_is_lambert_s_lobe() -> None:
    """Every 5 degrees; the chord of a cosine is off by h^2 / 8 at most."""
    angle_deg = np.arange(0.0, 91.0, 5.0)
    emitter = measured(angle_deg.tolist(), np.maximum(np.cos(np.radians(angle_deg)), 0).tolist())
    cos_out = np.cos(np.radians(np.arange(0.5, 90, 0.7)))
    made = irradiance_e_s_m2(np.ones(1), emitter, cos_out, np.ones(1), np.ones(1))
    np.testing.assert_allclose(made, cos_out, rtol=0, atol=np.radians(5) ** 2 / 8)


@pytest.mark.parametrize("seed", range(5))
def test_a_measured_lobe_that_falls_falls_in_between(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle_deg = np.append(0, np.sort(rng.uniform(1, 90, 6)))
    intensity = np.append(1, np.sort(rng.uniform(0, 1, 6))[::-1])
    emitter = measured(angle_deg.tolist(), intensity.tolist())
    made = LOBES["table"](emitter.lobe, np.cos(np.radians(np.linspace(0, 89, 400))))
    assert np.all(np.diff(made) <= 1e-15)
    assert made.max() <= intensity[0]


@pytest.mark.parametrize(("cos_out", "cos_in"), [(-0.1, 1.0), (0.0, 1.0), (1.0, -0.1), (1.0, 0.0), (-0.5, -0.5)])
@pytest.mark.parametrize("emitter", [cosine(0.0), cosine(1.0), cosine(2.5), measured([0, 180], [1.0, 1.0])])
def test_nothing_goes_backwards_or_comes_from_behind(cos_out: float, cos_in: float, emitter: Emitter) -> None:
    assert irradiance(cos_out, cos_in, emitter=emitter) == 0.0


def test_a_lambertian_disk_sends_pi_times_its_strength_into_the_half_space() -> None:
    """Integrating I cos over the hemisphere gives pi I: Gauss-Legendre in the cosine, exact for a line."""
    node, weight = np.polynomial.legendre.leggauss(4)
    flat = np.ones(4)
    sent = irradiance_e_s_m2(5e12 * flat, LAMBERT, (node + 1) / 2, flat, flat)
    assert 2 * np.pi * (sent @ weight) / 2 == pytest.approx(np.pi * 5e12, rel=1e-13)


def test_a_scene_s_led_names_its_laws() -> None:
    part = {"intensity": "16 mcd", "disk_diameter": "2 mm", "lobe": {"kind": "cosine", "exponent": 3}}
    assert Emitter.from_config(LedConfig.model_validate(part)) == cosine(3.0)
    del part["lobe"]
    assert Emitter.from_config(LedConfig.model_validate(part)) == LAMBERT


def test_every_lobe_of_a_scene_is_known_here() -> None:
    kinds = [part.model_fields["kind"].annotation.__args__[0] for part in (CosineLobeConfig, LobeTableConfig)]
    assert sorted(LOBES) == sorted(kinds)


def test_the_falloff_that_a_scene_names_is_the_one_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FALLOFF, "cubic", lambda distance_m: distance_m**-3.0)
    assert irradiance(distance_m=2.0, emitter=Emitter("cubic")) == pytest.approx(5e12 / 8, rel=1e-14)


def test_every_falloff_falls() -> None:
    distance = np.linspace(0.2, 5, 50)
    for law in FALLOFF.values():
        assert np.all(np.diff(law(distance)) < 0)


def test_reference_electrons_of_a_bright_led() -> None:
    # Reference §2: 0.6 cd at 33 in, 35 mm at f/8, T .85, QE .30: 3.1e7 electrons a millisecond.
    strength = led_strength_e_s_sr(0.6, "white", Band.from_efficiency(0.30))
    at_camera = irradiance_e_s_m2(strength, LAMBERT, ONE, ONE, 33 * 0.0254 * ONE)
    pupil_m2 = np.pi / 4 * (0.035 / 8) ** 2
    assert float(at_camera[0] * pupil_m2 * 0.85 * 1e-3) == pytest.approx(3.1e7, rel=0.02)  # two digits


def test_every_falloff_law_can_be_named_in_a_scene() -> None:
    assert set(get_args(LedConfig.model_fields["falloff"].annotation)) == set(FALLOFF)
