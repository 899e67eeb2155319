"""What an LED sends: inverse square, Lambert's cosine, and its pulses against brute-force sampling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skysim.led import FALLOFF, irradiance_ph_s_m2, lit_s
from skysim.photometry import led_strength_ph_s_sr

ONE = np.ones(1)


def irradiance(
    cos_out: float = 1.0, cos_in: float = 1.0, distance_m: float = 1.0, lobe: float = 1.0
) -> float:
    return float(irradiance_ph_s_m2(5e12 * ONE, lobe * ONE, cos_out * ONE, cos_in * ONE, distance_m * ONE)[0])


def test_on_its_normal_at_a_metre_the_irradiance_is_the_strength() -> None:
    assert irradiance() == pytest.approx(5e12, rel=1e-15)


@pytest.mark.parametrize("distance_m", [0.1, 0.8382, 1.0, 3.0])
def test_twice_as_far_is_a_quarter_as_bright(distance_m: float) -> None:
    assert irradiance(distance_m=2 * distance_m) == pytest.approx(
        irradiance(distance_m=distance_m) / 4, rel=1e-14
    )


def test_lambert_s_emitter_and_the_aperture_each_cost_a_cosine() -> None:
    out, into = np.cos(np.radians([30.0, 10.0]))
    assert irradiance(out, into) == pytest.approx(5e12 * out * into, rel=1e-14)


def test_reference_cosine_falloff_of_the_led_at_5_10_and_30_degrees() -> None:
    # Reference §2: .9962 / .9848 / .866.
    share = [irradiance(cos_out=float(np.cos(np.radians(angle)))) / 5e12 for angle in (5, 10, 30)]
    np.testing.assert_allclose(share, [0.9962, 0.9848, 0.866], rtol=0, atol=5e-5)  # as printed


@pytest.mark.parametrize("lobe", [0.0, 1.0, 2.5, 20.0])
def test_the_lobe_is_the_cosine_to_its_exponent(lobe: float) -> None:
    assert irradiance(cos_out=0.8, lobe=lobe) == pytest.approx(5e12 * 0.8**lobe, rel=1e-13)


@pytest.mark.parametrize(
    ("cos_out", "cos_in"), [(-0.1, 1.0), (0.0, 1.0), (1.0, -0.1), (1.0, 0.0), (-0.5, -0.5)]
)
@pytest.mark.parametrize("lobe", [0.0, 1.0, 3.0])
def test_nothing_goes_backwards_or_comes_from_behind(cos_out: float, cos_in: float, lobe: float) -> None:
    assert irradiance(cos_out, cos_in, lobe=lobe) == 0.0


def test_a_lambertian_disc_sends_pi_times_its_strength_into_the_half_space() -> None:
    """Integrating I cos over the hemisphere gives pi I: Gauss-Legendre in the cosine, exact for a line."""
    node, weight = np.polynomial.legendre.leggauss(4)
    cosine = (node + 1) / 2
    flat = np.ones(4)
    sent = irradiance_ph_s_m2(5e12 * flat, flat, cosine, flat, flat)
    assert 2 * np.pi * (sent @ weight) / 2 == pytest.approx(np.pi * 5e12, rel=1e-13)


def test_every_falloff_falls() -> None:
    distance = np.linspace(0.2, 5, 50)
    for law in FALLOFF.values():
        assert np.all(np.diff(law(distance)) < 0)


def test_reference_electrons_of_a_bright_led() -> None:
    # Reference §2: 0.6 cd at 33 in, 35 mm at f/8, T .85, QE .30: 3.1e7 electrons a millisecond.
    at_camera = irradiance_ph_s_m2(led_strength_ph_s_sr(0.6) * ONE, ONE, ONE, ONE, 33 * 0.0254 * ONE)
    pupil_m2 = np.pi / 4 * (0.035 / 8) ** 2
    assert float(at_camera[0] * pupil_m2 * 0.85 * 0.30 * 1e-3) == pytest.approx(3.1e7, rel=0.02)  # two digits


def sampled_lit_s(begin: float, end: float, period: float, start: float, on: float) -> float:
    """The pulse train looked at in the middle of each of 20,000 equal slices."""
    slices = 20_000
    t = begin + (end - begin) * (np.arange(slices) + 0.5) / slices
    return float(np.mean(np.mod(t - start, period) < on) * (end - begin))


span = st.floats(0, 5)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(span, span, st.floats(0.2, 3), st.floats(-2, 2), st.floats(0, 1))
def test_lit_time_is_that_of_brute_force_sampling(
    begin: float, length: float, period: float, start: float, duty: float
) -> None:
    exact = float(lit_s(begin, begin + length, period, start, duty * period))
    # Each of the at most 2 (length / period + 2) edges falls within a slice, which is counted or not.
    edges = 2 * (length / period + 2)
    sampled = sampled_lit_s(begin, begin + length, period, start, duty * period)
    assert exact == pytest.approx(sampled, abs=edges * length / 20_000 + 1e-12)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(st.floats(0, 1000), st.integers(1, 40), st.floats(0, 1e-3), st.floats(0.01, 1))
def test_whole_periods_shine_for_exactly_their_duty(
    begin: float, periods: int, start: float, duty: float
) -> None:
    on = duty * 1e-3
    lit = float(lit_s(begin, begin + periods * 1e-3, 1e-3, start, on))
    assert lit == pytest.approx(periods * on, abs=1e-12)  # t of 1000 s is held to 1e-13 s


@settings(max_examples=100, derandomize=True, deadline=None)
@given(span, span, span, st.floats(0.1, 2), st.floats(0, 1))
def test_lit_time_of_two_intervals_adds(a: float, b: float, c: float, start: float, duty: float) -> None:
    first, middle, last = sorted((a, b, c))
    whole = lit_s(first, last, 0.7, start, duty * 0.7)
    parts = lit_s(first, middle, 0.7, start, duty * 0.7) + lit_s(middle, last, 0.7, start, duty * 0.7)
    assert float(whole) == pytest.approx(float(parts), abs=1e-13)


def test_a_star_always_shines() -> None:
    edges = np.linspace(3.217, 3.931, 12)
    shone = lit_s(edges[:-1], edges[1:], 1.0, 0.0, 1.0)
    np.testing.assert_allclose(shone, np.diff(edges), rtol=0, atol=1e-14)  # rounding of the times


def test_lit_time_broadcasts_edges_over_sources() -> None:
    edges = np.linspace(0, 1e-3, 5)
    lit = lit_s(edges[:-1, None], edges[1:, None], np.full(3, 1e-3), np.zeros(3), np.array([1e-3, 5e-4, 0]))
    quarters = 2.5e-4 * np.array([[1, 1, 0], [1, 1, 0], [1, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(lit, quarters, rtol=0, atol=1e-18)
