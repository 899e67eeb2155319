"""What the air takes from starlight: extinction."""

from __future__ import annotations

import numpy as np

from skysim.core.types import Floats


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
