"""V magnitudes of the Sun, the Moon and the planets by distance and phase.

A body at r au from the Sun and d au from the observer, at a phase angle of a degrees, has

    V = 5 log10(r d) + V(1, 0) + f(a).

The planets' polynomials are those of the Astronomical Almanac: Mallama & Hilton 2018, Astronomy and Computing 25, 10
(arXiv:1808.01973). The rotation of Mars (0.06 mag) is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
import numpy as np
from skysim.core.constants import AU_KM, JULIAN_YEAR_DAY, SUN_V_MAG
from skysim.core.time import J2000_JD
from skysim.core.types import Floats
from skysim.sources.ephemeris import Place



MOON_KM = 384400.0  # mean distance
FULL_MOON_MAG = -12.73  # at this distance, the Sun at 1 au
EARTH = (-3.99, -1.060e-3, 2.054e-4)
POLES_DEG = {
    "saturn": (40.589, 83.537),
    "uranus": (257.311, -15.175),
}  # right ascension, declination (IAU WGCCRE 2015)
URANUS_FLATTENING = 0.0022927


def magnitude(name: str, place: Place, tt_jd: float) -> float:
    """V of a body above the atmosphere. Phase angles that the Earth never sees are extrapolated."""
    if name == "sun":
        return float(SUN_V_MAG + 5 * np.log10(place.distance_km / AU_KM))
    sun_au = place.sun_distance_km / AU_KM
    phase_deg = float(np.degrees(place.phase_rad))
    if name == "moon":
        return moon_magnitude(place.distance_km, sun_au, phase_deg)
    return float(
        5 * np.log10(sun_au * place.distance_km / AU_KM) + PLANETS[name](phase_deg, place, tt_jd)
    )


def moon_magnitude(distance_km: float, sun_au: float, phase_deg: float) -> float:
    """V = -12.73 + 0.026 a + 4e-9 a^4 at the mean distance.

    Source: Allen 1976, as in Krisciunas & Schaefer 1991, PASP 103, 1033. Within 7 degrees of full the Moon is up to
    35 % brighter than this (its opposition surge); beyond 150 degrees the law is extrapolated. An eclipse is not
    computed.
    """
    law = FULL_MOON_MAG + 0.026 * phase_deg + 4e-9 * phase_deg**4
    return float(law + 5 * np.log10(distance_km / MOON_KM * sun_au))


def earthshine_fraction(moon: Place) -> float:
    """Light of the earthlit Moon over that of the sunlit Moon.

    The Earth, as bright from the Moon as its phase polynomial says at a phase angle of 180 degrees less the Moon's,
    shines on the Moon from the observer's direction. So the earthlit Moon is a full Moon (phase angle 0) fainter by
    the magnitude of the Earth less that of the Sun, both as seen from the Moon.
    """
    sun_au = moon.sun_distance_km / AU_KM
    moon_au = moon.distance_km / AU_KM
    phase_deg = float(np.degrees(moon.phase_rad))
    earth_mag = polynomial(180 - phase_deg, EARTH) + 5 * np.log10(moon_au * sun_au)
    fainter = earth_mag - (SUN_V_MAG + 5 * np.log10(sun_au))
    full, sunlit = (
        moon_magnitude(moon.distance_km, sun_au, angle_deg) for angle_deg in (0.0, phase_deg)
    )
    return float(10 ** (-0.4 * (full + fainter - sunlit)))


def polynomial(phase_deg: float, coefficients: tuple[float, ...]) -> float:
    """The sum of c_k a^k."""
    return float(sum(c * phase_deg**k for k, c in enumerate(coefficients)))


def mercury(phase_deg: float, _place: Place, _tt_jd: float) -> float:
    return polynomial(
        phase_deg, (-0.613, 6.3280e-2, -1.6336e-3, 3.3644e-5, -3.4265e-7, 1.6893e-9, -3.0334e-12)
    )


def venus(phase_deg: float, _place: Place, _tt_jd: float) -> float:
    """Two polynomials: near inferior conjunction sunlight is scattered forward."""
    far = (-4.384, -1.044e-3, 3.687e-4, -2.814e-6, 8.938e-9)
    return polynomial(phase_deg, far if phase_deg < 163.7 else (236.05828, -2.81914, 8.39034e-3))


def mars(phase_deg: float, _place: Place, _tt_jd: float) -> float:
    return polynomial(
        phase_deg,
        (-1.601, 2.267e-2, -1.302e-4) if phase_deg <= 50 else (-0.367, -2.573e-2, 3.445e-4),
    )


def jupiter(phase_deg: float, _place: Place, _tt_jd: float) -> float:
    return polynomial(phase_deg, (-9.395, -3.7e-4, 6.16e-4))


def saturn(phase_deg: float, place: Place, _tt_jd: float) -> float:
    """Globe and rings; b is the geometric mean of the latitudes of Sun and observer, 0 if the rings are seen unlit."""
    to_sun, to_observer = latitudes_rad("saturn", place)
    tilt = math.sin(math.sqrt(max(to_sun * to_observer, 0.0)))
    return -8.914 - 1.825 * tilt + 0.026 * phase_deg - 0.378 * tilt * math.exp(-2.25 * phase_deg)


def uranus(phase_deg: float, place: Place, _tt_jd: float) -> float:
    """Fainter toward the equator; the latitudes are planetographic."""
    latitudes_deg = np.degrees(
        np.arctan(np.tan(latitudes_rad("uranus", place)) / (1 - URANUS_FLATTENING) ** 2)
    )
    by_phase = polynomial(phase_deg, (0.0, 6.587e-3, 1.045e-4)) if phase_deg > 3.1 else 0.0
    return -7.110 + by_phase - 8.4e-4 * float(np.abs(latitudes_deg).mean())


def neptune(phase_deg: float, _place: Place, tt_jd: float) -> float:
    """It brightened from 1980 to 2000."""
    year = 2000 + (tt_jd - J2000_JD) / JULIAN_YEAR_DAY
    at_full = min(max(-6.89 - 0.0054 * (year - 1980), -7.0), -6.89)
    return at_full + (polynomial(phase_deg, (0.0, 7.944e-3, 9.617e-5)) if phase_deg > 1.9 else 0.0)


PLANETS: dict[str, Callable[[float, Place, float], float]] = {
    "mercury": mercury,
    "venus": venus,
    "mars": mars,
    "jupiter": jupiter,
    "saturn": saturn,
    "uranus": uranus,
    "neptune": neptune,
}


def latitudes_rad(name: str, place: Place) -> Floats:
    """(2,) planetocentric latitudes of the Sun and of the observer above the planet's equator."""
    ra, dec = np.radians(POLES_DEG[name])
    pole = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    sines = [
        -(vector @ pole) / np.linalg.norm(vector)
        for vector in (place.from_sun_km, place.to_body_km)
    ]
    return np.arcsin(sines)


