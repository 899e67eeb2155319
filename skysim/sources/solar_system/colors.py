"""Photo-electrons of reflected sunlight, by the albedo of a body at four wavelengths.

A planet is no star: methane makes Uranus brightest in blue and dark beyond 700 nm, a color that no black body has.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from skysim.core.types import Floats
from skysim.sources.photometry import SUN, Band, black_body_v0, chromatic_moments, temperature_k

Albedo = tuple[float, float, float, float]

BANDS_M = (
    438e-9,
    545e-9,
    641e-9,
    798e-9,
)  # effective wavelengths of B, V, Cousins' R and I (Bessell 2005, ARA&A 43, 293)
WHITE: Albedo = (1.0, 1.0, 1.0, 1.0)
# Planets: geometric albedos of Mallama, Krobusek & Pavlov 2017, Icarus 282, 19 (arXiv:1609.05048), table 7. The Moon,
# relative to V: Kieffer & Stone 2005, AJ 129, 2887, equation 10 and table 4 at a phase angle of 45 degrees without
# libration, smoothed by a parabola in the logarithms; it reddens by 0.1 mag in V-I from full to quarter.
ALBEDO: dict[str, Albedo] = {
    "sun": WHITE,
    "moon": (0.786, 1.0, 1.169, 1.402),
    "mercury": (0.105, 0.142, 0.158, 0.180),
    "venus": (0.658, 0.689, 0.658, 0.640),
    "mars": (0.088, 0.170, 0.250, 0.285),
    "jupiter": (0.443, 0.538, 0.513, 0.389),
    "saturn": (0.339, 0.499, 0.646, 0.543),
    "uranus": (0.561, 0.488, 0.264, 0.089),
    "neptune": (0.562, 0.442, 0.226, 0.072),
}


def reflected_flux_e_s_m2(v_mag: float, albedo: Albedo, band: Band) -> float:
    """Photo-electrons s^-1 m^-2 of a body of this V magnitude: 10^(-0.4 V) ∫ n(λ) p(λ) / p(V) QE(λ) dλ.

    n is the photon flux of a star like the Sun of V = 0, p the albedo, linear between the four bands and constant
    beyond them.
    """
    return float(_flux_v0_e_s_m2(albedo, band) * 10 ** (-0.4 * v_mag))


@lru_cache(maxsize=64)
def _flux_v0_e_s_m2(albedo: Albedo, band: Band) -> float:
    return float(band.integral(lambda wavelength_m: reflected_v0(wavelength_m, albedo)))


def reflected_v0(wavelength_m: Floats, albedo: Albedo) -> Floats:
    """Spectral photon flux of a body of V = 0, as `black_body_v0`."""
    relative = np.array(albedo) / albedo[1]
    return np.asarray(
        black_body_v0(wavelength_m, temperature_k(*SUN))
        * np.interp(wavelength_m, BANDS_M, relative)
    )


@lru_cache(maxsize=64)
def reflected_chromatic(albedo: Albedo, band: Band) -> Floats | None:
    """(4,) `chromatic_moments` of a body; None for a lens without chromatic aberration."""
    if band.chromatic is None:
        return None
    return chromatic_moments(band, lambda wavelength_m: reflected_v0(wavelength_m, albedo))
