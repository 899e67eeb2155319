"""What an LED sends towards the camera: emission lobe, falloff with distance, and its pulses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from skysim.types import Floats

Falloff = Callable[[Floats], Floats]


def inverse_square(distance_m: Floats) -> Floats:
    """Flux spreads over a sphere: 1 / d^2, in m^-2."""
    return 1.0 / distance_m**2


FALLOFF: dict[str, Falloff] = {"inverse_square": inverse_square}


def irradiance_ph_s_m2(
    strength_ph_s_sr: Floats,
    lobe: Floats,
    cos_emission: Floats,
    cos_incidence: Floats,
    distance_m: Floats,
    falloff: str = "inverse_square",
) -> Floats:
    """Photons through a square metre of the aperture: E = I_0 cos^m(theta) cos(phi) f(d).

    theta is measured at the LED from its normal (m = 1 is Lambert's law: a disc seen foreshortened), phi at the
    aperture from the boresight. Zero behind either. All arrays alike in shape.
    """
    lit = (cos_emission > 0) & (cos_incidence > 0)
    emitted = np.maximum(cos_emission, 1e-300) ** lobe
    return np.where(lit, strength_ph_s_sr * emitted * cos_incidence * FALLOFF[falloff](distance_m), 0.0)


def lit_s(begin_s: Floats, end_s: Floats, period_s: Floats, start_s: Floats, on_s: Floats) -> Floats:
    """Seconds of [begin, end] during which a pulse train shines: lit from start for on in every period.

    The running total F(t) = floor(u) on + min(frac(u) period, on), u = (t - start) / period, makes the integral
    exact for any interval. Arrays broadcast.
    """

    def total(t_s: Floats) -> Floats:
        cycles = np.floor((t_s - start_s) / period_s)
        return cycles * on_s + np.minimum(t_s - start_s - cycles * period_s, on_s)

    return total(np.asarray(end_s)) - total(np.asarray(begin_s))
