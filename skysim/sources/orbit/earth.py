"""The Earth as an ellipsoid: what it hides, and how much of the Sun it leaves to a satellite.

The ellipsoid (WGS 84) is a unit sphere in coordinates in which z is stretched, and lines stay lines. Its axis is taken
for the GCRS's z (a tenth of a degree off in 2020, which displaces the limb by up to 40 m). The air is left out.
"""

from __future__ import annotations

import erfa
import numpy as np
from numpy.typing import NDArray

from skysim.core.constants import EARTH_FLATTENING, EARTH_RADIUS_M
from skysim.core.types import Floats
from skysim.sources.bodies import BODIES
from skysim.sources.ephemeris import load_ephemeris

SUN_RADIUS_M = 1e3 * BODIES["sun"].radius_km
TO_SPHERE = np.array([1.0, 1.0, 1 / (1 - EARTH_FLATTENING)]) / EARTH_RADIUS_M  # per meter


def sun_m(tt_jd: float) -> Floats:
    """(3,) the Sun from the Earth's center, GCRS axes, geometric."""
    ephemeris = load_ephemeris()
    return 1e3 * (ephemeris.position_km("sun", tt_jd) - ephemeris.position_km("earth", tt_jd))


def hidden_by_earth(
    observer_m: Floats, direction: Floats, distance_m: Floats | float = np.inf
) -> NDArray[np.bool_]:
    """Whether the Earth is between an observer and points in unit directions (..., 3) at these distances.

    The line p + s d comes nearest to the center at s = -p.d, where its distance is sqrt(p^2 - (p.d)^2). An observer on
    or below the ellipsoid sees what is above the plane that touches it there.
    """
    place = observer_m * TO_SPHERE
    along = direction * TO_SPHERE
    length = np.linalg.norm(along, axis=-1)
    inward = -(along @ place if place.ndim == 1 else np.sum(along * place, axis=-1)) / length
    square = np.sum(place * place, axis=-1)
    below = square - inward**2 < np.minimum(1.0, square * (1 - 1e-12))
    entry = inward - np.sqrt(np.maximum(1 - square + inward**2, 0.0))
    return np.asarray((inward > 0) & below & (np.maximum(entry, 0.0) < distance_m * length))


def sunlit_fraction(place_m: Floats, sun_m: Floats) -> Floats:
    """(...,) part of the Sun's disc that the Earth leaves to places (..., 3): 1 in the light, 0 in the umbra.

    The limb crosses the Sun's disc as a straight line, at h solar radii from its center toward the Earth:
    f = 1/2 + (h sqrt(1 - h^2) + arcsin h) / pi, for |h| < 1. The Sun's elevation above the limb is that on the
    stretched sphere (within 0.4 % of it). Refraction and the limb's curvature across the Sun (0.7 % of the light in a
    low orbit) are left out. Source: Montenbruck & Gill 2000, Satellite Orbits, section 3.4.2.
    """
    to_sun = sun_m - place_m
    h_rad = limb_elevation_rad(place_m, to_sun)
    h = np.clip(h_rad * np.linalg.norm(to_sun, axis=-1) / SUN_RADIUS_M, -1, 1)
    return np.asarray(0.5 + (h * np.sqrt(1 - h**2) + np.arcsin(h)) / np.pi)


def limb_elevation_rad(place_m: Floats, direction: Floats) -> Floats:
    """(...,) angles of directions (..., 3) above the Earth's limb, seen from places (..., 3); below it negative.

    With the nadir angle of the direction and the angular radius of the Earth, arcsin(1/r), it is their difference.
    """
    place = place_m * TO_SPHERE
    toward = direction * TO_SPHERE
    radius = np.linalg.norm(place, axis=-1)
    length = np.linalg.norm(toward, axis=-1)
    above_horizon = np.arcsin(np.clip(np.sum(place * toward, axis=-1) / (radius * length), -1, 1))
    return np.asarray(above_horizon + np.arccos(1 / np.maximum(radius, 1.0)))


def to_astronomical(direction: Floats) -> tuple[float, float]:
    """Right ascension and declination of a vector, degrees."""
    ra, dec = erfa.c2s(direction)
    return float(np.degrees(ra)) % 360, float(np.degrees(dec))
