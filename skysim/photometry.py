"""Magnitude or radiant intensity -> photons. Bandpass 400-1000 nm, the silicon camera's own."""

from __future__ import annotations

import numpy as np

from skysim.types import Floats

# A V = 0 star of type G2, seen as a black body, sends 56,200 photons/s/mm² in 400-1000 nm (reference §2).
# Stars of other colours differ on silicon by +.01..+.19 (A0) to -.55 mag (M): a scatter left to the user.
V0_PH_S_M2 = 5.62e10

LUMINOUS_EFFICACY_LM_W = 300.0  # white phosphor LED, lumens a radiated watt (reference §2)
GREEN_PHOTON_J = 6.62607015e-34 * 299792458.0 / 555e-9  # energy h c / λ where the eye is most sensitive


def star_flux_ph_s_m2(v_mag: float | Floats) -> Floats:
    """Pogson's law: five magnitudes are a factor 100 in photon flux above the atmosphere.

    v_mag : any shape, Johnson V. Returns photons s^-1 m^-2 in 400-1000 nm, same shape.
    F = F0 10^(-0.4 V), F0 of a G2 star (reference §2).
    """
    return np.asarray(V0_PH_S_M2 * 10.0 ** (-0.4 * np.asarray(v_mag, dtype=float)))


def led_strength_ph_s_sr(intensity_cd: float | Floats) -> Floats:
    """Candela to photons: lumens a steradian, over lumens a watt, over joules a photon.

    intensity_cd : any shape, along the LED's normal. Returns photons s^-1 sr^-1, same shape.
    I_ph = I_v / (300 lm/W) / (h c / 555 nm): every photon is counted as a green one (reference §2).
    """
    return np.asarray(np.asarray(intensity_cd, dtype=float) / LUMINOUS_EFFICACY_LM_W / GREEN_PHOTON_J)
