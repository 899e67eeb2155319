"""Magnitudes and candelas -> photons, against the reference's own numbers."""

import numpy as np
import pytest

from skysim.photometry import led_strength_ph_s_sr, star_flux_ph_s_m2


def test_a_v0_star_sends_the_reference_number_of_photons() -> None:
    # Reference §2: 56,200 photons/s/mm².
    assert star_flux_ph_s_m2(0.0) == pytest.approx(56_200 * 1e6, rel=1e-12)


def test_five_magnitudes_are_a_factor_of_a_hundred() -> None:
    flux = star_flux_ph_s_m2(np.array([[-1.0, 4.0], [1.5, 6.5]]))
    assert flux.shape == (2, 2)
    np.testing.assert_allclose(flux[:, 0] / flux[:, 1], 100.0, rtol=1e-12, atol=0)  # Pogson's definition


def test_liebe_s_rate_is_the_flux_times_efficiency() -> None:
    # Reference §2: Liebe's 19,100 /s/mm² at V = 0 equals quantum efficiency times transmission of 0.34.
    assert 19_100 / (star_flux_ph_s_m2(0.0) * 1e-6) == pytest.approx(0.34, abs=0.005)


def test_an_led_fills_the_lens_as_the_reference_says() -> None:
    # Reference §2: 0.6 cd, 35 mm lens at f/8, T .85, QE .30 at 33 in gives 3.1e7 e-/ms (two figures: 2 %).
    aperture_m2 = np.pi / 4 * (0.035 / 8) ** 2
    solid_angle_sr = aperture_m2 / (33 * 0.0254) ** 2
    electrons_a_ms = led_strength_ph_s_sr(0.6) * solid_angle_sr * 0.85 * 0.30 * 1e-3
    assert electrons_a_ms == pytest.approx(3.1e7, rel=0.02)


def test_one_candela_is_three_milliwatts_of_green_photons() -> None:
    # By hand: 1 cd = 1 lm/sr = 1/300 W/sr; a 555 nm photon is 2.23393 eV = 3.57918e-19 J.
    assert led_strength_ph_s_sr(1.0) == pytest.approx(1 / 300 / 3.57918e-19, rel=1e-5)
