"""What the air takes from starlight: extinction and scintillation."""

from __future__ import annotations

import numpy as np

from skysim.core.types import Floats

SCINTILLATION_M_S = 10e-6  # of the variance at D = 1 m, t = 1 s, m^(4/3) s
C_Y = 1.56  # median of the sites in Osborn et al. (2015)
SCALE_HEIGHT_M = 8000.0  # of the turbulence in Young's law


def air_mass(altitude_rad: Floats) -> Floats:
    """Air masses along the line of sight over that at the zenith: X = 1 / sin(h + 244 / (165 + 47 h^1.1)).

    h is the apparent altitude in degrees; 38.75 on the horizon, which holds below it.
    Source: Pickering (2002), DIO 12, 20.
    """
    h_deg = np.degrees(np.maximum(altitude_rad, 0.0))
    return np.asarray(1 / np.sin(np.radians(h_deg + 244 / (165 + 47 * h_deg**1.1))))


def transmission(air_masses: Floats, extinction_mag: float | Floats) -> Floats:
    """Bouguer's law: 10^(-0.4 k X) of the light passes X air masses."""
    return np.asarray(10 ** (-0.4 * extinction_mag * air_masses))


def scintillation_variance(air_masses: Floats, aperture_m: float, exposure_s: float, height_m: float) -> Floats:
    """Relative variance of a star's light: 10^-5 C_Y^2 D^(-4/3) t^-1 X^3 exp(-2 h / H).

    For exposures longer than the wind takes to cross the aperture and apertures wider than the turbulence's Fresnel
    zone (some 5 cm); narrower ones twinkle less than by this law. Source: Young (1967), AJ 72, 747, in the form of
    Osborn et al. (2015), MNRAS 452, 1707, equation 7.
    """
    site = SCINTILLATION_M_S * C_Y**2 * np.exp(-2 * height_m / SCALE_HEIGHT_M)
    return np.asarray(site * aperture_m ** (-4 / 3) / exposure_s * air_masses**3)


def scintillation(variance: Floats, rng: np.random.Generator) -> Floats:
    """(N,) factors of stars' light with mean 1 and these variances, log-normal (Dravins et al. 1997, PASP 109, 173)."""
    log_variance = np.log1p(variance)
    return np.asarray(np.exp(np.sqrt(log_variance) * rng.standard_normal(len(variance)) - log_variance / 2))
