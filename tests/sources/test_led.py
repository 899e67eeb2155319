"""Emission of LEDs: inverse-square law, Lambert's cosine, and pulses against brute-force sampling."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from skysim.camera.glow.background import PointedCamera
from skysim.camera.glow.display_glow import black_glow
from skysim.core.types import Floats, Sources
from skysim.scene import loader
from skysim.scene.sections.leds import (
    AgingConfig,
    CosineLobeConfig,
    LedConfig,
    LobeTableConfig,
    WarmUpConfig,
)
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import build_lab, exposure_window
from skysim.sources.dome import sources
from skysim.sources.dome.led import (
    FALLOFF,
    LOBES,
    Emitter,
    aging_factors,
    irradiance_e_s_m2,
    warm_up_factor,
)
from skysim.sources.photometry import Band, led_strength_e_s_sr

ONE = np.ones(1)
LAMBERT = Emitter()


def irradiance(
    cos_out: float = 1.0,
    cos_in: float = 1.0,
    distance_m: float = 1.0,
    emitter: Emitter = LAMBERT,
) -> float:
    return float(
        irradiance_e_s_m2(5e12 * ONE, emitter, cos_out * ONE, cos_in * ONE, distance_m * ONE)[
            0
        ]
    )


def cosine(exponent: float) -> Emitter:
    return Emitter(lobe=CosineLobeConfig(exponent=exponent))


def measured(angle_deg: list[float], intensity: list[float]) -> Emitter:
    table = {"kind": "table", "angle_deg": angle_deg, "intensity": intensity}
    return Emitter(lobe=LobeTableConfig.model_validate(table))


def test_on_its_normal_at_a_meter_the_irradiance_is_the_strength() -> None:
    assert irradiance() == pytest.approx(5e12, rel=1e-15)


@pytest.mark.parametrize("distance_m", [0.1, 0.8382, 1.0, 3.0])
def test_twice_as_far_is_a_quarter_as_bright(distance_m: float) -> None:
    assert irradiance(distance_m=2 * distance_m) == pytest.approx(
        irradiance(distance_m=distance_m) / 4, rel=1e-14
    )


def test_emitter_and_aperture_each_contribute_a_cosine() -> None:
    out, into = np.cos(np.radians([30.0, 10.0]))
    assert irradiance(out, into) == pytest.approx(5e12 * out * into, rel=1e-14)


def test_reference_cosine_falloff_of_the_led_at_5_10_and_30_degrees() -> None:
    # Reference §2: .9962 / .9848 / .866.
    share = [
        irradiance(cos_out=float(np.cos(np.radians(angle)))) / 5e12 for angle in (5, 10, 30)
    ]
    np.testing.assert_allclose(
        share, [0.9962, 0.9848, 0.866], rtol=0, atol=5e-5
    )  # as printed


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.5, 20.0])
def test_the_lobe_is_the_cosine_to_its_exponent(exponent: float) -> None:
    assert irradiance(cos_out=0.8, emitter=cosine(exponent)) == pytest.approx(
        5e12 * 0.8**exponent, rel=1e-13
    )


def test_a_measured_lobe_is_interpolated_through_its_points() -> None:
    emitter = measured([0, 30, 60, 75], [1.0, 0.9, 0.5, 0.2])
    made = [
        irradiance(np.cos(np.radians(angle)), emitter=emitter) / 5e12
        for angle in (0, 30, 60, 45, 74.99)
    ]
    np.testing.assert_allclose(made, [1, 0.9, 0.5, 0.7, 0.2002], rtol=0, atol=1e-9)
    assert irradiance(np.cos(np.radians(75.1)), emitter=emitter) == 0.0


def test_a_table_of_cosines_is_lambert_s_lobe() -> None:
    """Every 5 degrees; the chord of a cosine is off by h^2 / 8 at most."""
    angle_deg = np.arange(0.0, 91.0, 5.0)
    emitter = measured(
        angle_deg.tolist(), np.maximum(np.cos(np.radians(angle_deg)), 0).tolist()
    )
    cos_out = np.cos(np.radians(np.arange(0.5, 90, 0.7)))
    made = irradiance_e_s_m2(np.ones(1), emitter, cos_out, np.ones(1), np.ones(1))
    np.testing.assert_allclose(made, cos_out, rtol=0, atol=np.radians(5) ** 2 / 8)


@pytest.mark.parametrize("seed", range(5))
def test_interpolation_of_a_decreasing_lobe_is_decreasing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle_deg = np.append(0, np.sort(rng.uniform(1, 90, 6)))
    intensity = np.append(1, np.sort(rng.uniform(0, 1, 6))[::-1])
    emitter = measured(angle_deg.tolist(), intensity.tolist())
    made = LOBES["table"](emitter.lobe, np.cos(np.radians(np.linspace(0, 89, 400))))
    assert np.all(np.diff(made) <= 1e-15)
    assert made.max() <= intensity[0]


@pytest.mark.parametrize(
    ("cos_out", "cos_in"), [(-0.1, 1.0), (0.0, 1.0), (1.0, -0.1), (1.0, 0.0), (-0.5, -0.5)]
)
@pytest.mark.parametrize(
    "emitter", [cosine(0.0), cosine(1.0), cosine(2.5), measured([0, 180], [1.0, 1.0])]
)
def test_an_led_emits_nothing_backwards_and_nothing_is_received_from_behind(
    cos_out: float, cos_in: float, emitter: Emitter
) -> None:
    assert irradiance(cos_out, cos_in, emitter=emitter) == 0.0


def test_a_lambertian_disk_sends_pi_times_its_strength_into_the_half_space() -> None:
    """Integrating I cos over the hemisphere gives pi I: Gauss-Legendre in the cosine, exact for a line."""
    node, weight = np.polynomial.legendre.leggauss(4)
    flat = np.ones(4)
    sent = irradiance_e_s_m2(5e12 * flat, LAMBERT, (node + 1) / 2, flat, flat)
    assert 2 * np.pi * (sent @ weight) / 2 == pytest.approx(np.pi * 5e12, rel=1e-13)


def test_a_scene_names_the_laws_of_its_leds() -> None:
    part = {
        "intensity": "16 mcd",
        "disk_diameter": "2 mm",
        "lobe": {"kind": "cosine", "exponent": 3},
    }
    assert Emitter.from_config(LedConfig.model_validate(part)) == cosine(3.0)
    del part["lobe"]
    assert Emitter.from_config(LedConfig.model_validate(part)) == LAMBERT


def test_every_lobe_of_the_schema_is_implemented() -> None:
    kinds = [
        part.model_fields["kind"].annotation.__args__[0]
        for part in (CosineLobeConfig, LobeTableConfig)
    ]
    assert sorted(LOBES) == sorted(kinds)


def test_the_falloff_that_a_scene_names_is_the_one_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(FALLOFF, "cubic", lambda distance_m: distance_m**-3.0)
    assert irradiance(distance_m=2.0, emitter=Emitter("cubic")) == pytest.approx(
        5e12 / 8, rel=1e-14
    )


def test_every_falloff_is_decreasing() -> None:
    distance = np.linspace(0.2, 5, 50)
    for law in FALLOFF.values():
        assert np.all(np.diff(law(distance)) < 0)


def test_reference_electrons_of_a_bright_led() -> None:
    # Reference §2: 0.6 cd at 33 in, 35 mm at f/8, T .85, QE .30: 3.1e7 electrons a millisecond.
    strength = led_strength_e_s_sr(0.6, "white", Band.from_efficiency(0.30))
    at_camera = irradiance_e_s_m2(strength, LAMBERT, ONE, ONE, 33 * 0.0254 * ONE)
    pupil_m2 = np.pi / 4 * (0.035 / 8) ** 2
    # Two digits.
    assert float(at_camera[0] * pupil_m2 * 0.85 * 1e-3) == pytest.approx(3.1e7, rel=0.02)


def test_every_falloff_law_can_be_named_in_a_scene() -> None:
    assert set(get_args(LedConfig.model_fields["falloff"].annotation)) == set(FALLOFF)


# Aging and warm-up


def aging(hours: float, scatter: object = 0.0) -> AgingConfig:
    return AgingConfig.model_validate(
        {"hours": hours, "life_hours": 36_000.0, "scatter": scatter}
    )


def test_the_tm_21_procedure_recovers_the_scene_s_lifetime() -> None:
    """A line fitted to the logarithms of the light measured every thousand hours, and where it crosses 70 %."""
    hours = np.arange(1000.0, 10_001.0, 1000.0)
    light = [float(aging_factors(aging(each), np.zeros(1))[0]) for each in hours]
    slope, intercept = np.polyfit(hours, np.log(light), 1)
    assert math.exp(intercept) == pytest.approx(1, rel=1e-9)
    assert math.log(math.exp(intercept) / 0.7) / -slope == pytest.approx(36_000, rel=1e-9)


@pytest.mark.parametrize("scatter", [0.2, {"tolerance": 0.3}])
def test_each_led_ages_at_its_own_rate(scatter: object) -> None:
    config = aging(12_000.0, scatter)
    rates = (
        -np.log(aging_factors(config, np.random.default_rng(3).standard_normal(20_000)))
        / 12_000
    )
    nominal = math.log(1 / 0.7) / 36_000
    if isinstance(scatter, float):
        assert np.log(rates / nominal).std() == pytest.approx(scatter, rel=0.02)
        assert np.log(rates / nominal).mean() == pytest.approx(0, abs=0.006)
    else:
        assert np.abs(rates / nominal - 1).max() < 0.3
        assert (rates / nominal).std() == pytest.approx(0.3 / math.sqrt(3), rel=0.02)


def test_aging_changes_only_the_light_of_a_dome() -> None:
    """Each LED by its own factor, the same in every run of the same hardware."""
    band = Band.from_efficiency(0.3)

    def leds(keys: str) -> Sources:
        settings = {"light.led.aging": keys} if keys else {}
        return sources(loader.load("afit_simsat", settings).light, band)

    new, even, own = (leds(keys) for keys in ("", "{hours: 9000, life_hours: 18000}", UNEVEN))
    np.testing.assert_allclose(even.strength / new.strength, math.sqrt(0.7), rtol=1e-12)
    left = own.strength / new.strength
    assert np.log(np.log(left) / math.log(0.7) * 2).std() == pytest.approx(0.2, rel=0.1)
    np.testing.assert_array_equal(own.strength, leds(UNEVEN).strength)
    for column in ("place", "period_s", "start_s", "on_s", "radius_m"):
        np.testing.assert_array_equal(getattr(own, column), getattr(new, column))


UNEVEN = "{hours: 9000, life_hours: 18000, scatter: 0.2}"


def test_all_pixels_of_a_panel_age_alike() -> None:
    """Their pixels, and the glow of the black ones."""
    keys = {"light.layout.contrast": "500"}
    cameras = [
        build_lab(loader.load("nps_tas2", keys | more)).camera
        for more in ({}, {"light.led.aging": "{hours: 9000, life_hours: 18000}"})
    ]
    new, old = (camera.sources.strength for camera in cameras)
    np.testing.assert_allclose(old / new, math.sqrt(0.7), rtol=1e-12)
    glows = [
        black_glow(
            one.scene.light,
            PointedCamera(one.optics, Rotation.identity(), np.zeros(3), one.band),
        )
        for one in cameras
    ]
    assert glows[0] is not None
    assert glows[0].max() > 0
    np.testing.assert_allclose(glows[1], math.sqrt(0.7) * glows[0], rtol=1e-12)


def test_warm_up_follows_newton_s_law() -> None:
    """The light follows d g / d t = (steady - g) / time from 1."""
    config = WarmUpConfig.model_validate({"steady": 0.88, "time": "7 min"})
    times = np.array([10.0, 60.0, 420.0, 3000.0])
    solved = solve_ivp(
        lambda _, g: (0.88 - g) / 420, (0, 3000), [1.0], t_eval=times, rtol=1e-10, atol=1e-12
    ).y[0]
    np.testing.assert_allclose(
        [warm_up_factor(config, t_s) for t_s in times], solved, rtol=1e-8
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "keys"),
    [
        ("apl_dome", {"light.reflection": "{diffuse: 0.5, specular: 0.1}"}),
        ("nps_tas2", {"light.layout.contrast": "500"}),
    ],
)
def test_all_light_of_the_leds_falls_while_they_warm_up(
    scene: str, keys: dict[str, str]
) -> None:
    """LEDs, their images in the wall, its glow, and that of black pixels; by the law at mid-exposure of each frame."""
    keys = keys | {
        "background": "[]",
        "camera.detector.noise": "false",
        "exposure.rate_hz": "0.5",
    }
    dark = keys | {"light.led.intensity": "1e-20 cd"}
    warm = keys | {"light.led.warm_up": "{steady: 0.8, time: 2 s}"}
    for index in (0, 1):
        dark_dn, cold_dn, warm_dn = (
            still(scene, settings, index) for settings in (dark, keys, warm)
        )
        t_s = exposure_window(loader.load(scene, keys), index).middle_s
        left = 0.8 + 0.2 * math.exp(-t_s / 2)
        np.testing.assert_allclose(
            warm_dn - dark_dn, left * (cold_dn - dark_dn), rtol=0, atol=1e-9 * cold_dn.max()
        )


def still(scene: str, keys: dict[str, str], index: int) -> Floats:
    lab = build_lab(loader.load(scene, keys))
    return render_at_rest(lab.camera, lab.start, index)[0].image_dn
