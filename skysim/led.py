"""What an LED sends towards the camera: emission lobe and falloff with distance (its pulses are in pulse.py)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skysim.light import CosineLobe, Led, Lobe, LobeTable
from skysim.types import Floats

Falloff = Callable[[Floats], Floats]


def inverse_square(distance_m: Floats) -> Floats:
    """Flux spreads over a sphere: 1 / d^2, in m^-2."""
    return 1.0 / distance_m**2


FALLOFF: dict[str, Falloff] = {"inverse_square": inverse_square}


def cosine_lobe(part: CosineLobe, cos_emission: Floats) -> Floats:
    """A lamp's radiant intensity as a power of the cosine: cos^m; m = 1 is Lambert's disc, seen foreshortened."""
    return np.asarray(np.maximum(cos_emission, 0.0) ** part.exponent)


def table_lobe(part: LobeTable, cos_emission: Floats) -> Floats:
    """A measured lobe: relative intensity linear between the angles measured, which neither overshoots nor ripples.

    Within the first angle it is the first value; beyond the last it is nothing.
    """
    angle_deg = np.degrees(np.arccos(np.clip(cos_emission, -1.0, 1.0)))
    return np.asarray(np.interp(angle_deg, part.angle_deg, part.intensity, right=0.0))


# Each of (its part of the scene, cosine of the angle from the LED's normal) -> intensity, 1 on the normal.
LOBES: dict[str, Callable[[Any, Floats], Floats]] = {"cosine": cosine_lobe, "table": table_lobe}


@dataclass(frozen=True, slots=True)
class Emitter:
    """How a dome's LEDs shine: the laws of distance and of angle. By default a Lambertian disc's.

    falloff : a key of FALLOFF
    lobe    : its kind is a key of LOBES
    """

    falloff: str = "inverse_square"
    lobe: Lobe = field(default_factory=CosineLobe)

    @classmethod
    def of(cls, led: Led) -> Emitter:
        """The laws that a scene names."""
        return cls(led.falloff, led.lobe)


def irradiance_e_s_m2(
    strength_e_s_sr: Floats, emitter: Emitter, cos_emission: Floats, cos_incidence: Floats, distance_m: Floats
) -> Floats:
    """Light through a square metre of the aperture: E = I_0 L(theta) cos(phi) f(d), zero behind either.

    strength_e_s_sr : photo-electrons s^-1 sr^-1 along the LED's normal
    cos_emission    : of theta, at the LED from its normal; L is the emitter's lobe
    cos_incidence   : of phi, at the aperture from the boresight
    distance_m      : f is the emitter's falloff
    The arrays broadcast. Returns photo-electrons s^-1 m^-2.
    """
    lit = (np.asarray(cos_emission) > 0) & (np.asarray(cos_incidence) > 0)
    emitted = LOBES[emitter.lobe.kind](emitter.lobe, cos_emission)
    return np.where(
        lit, strength_e_s_sr * emitted * cos_incidence * FALLOFF[emitter.falloff](distance_m), 0.0
    )
