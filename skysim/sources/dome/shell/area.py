"""Area of a dome's surface over a cap of directions from the bearing."""

from __future__ import annotations

import numpy as np

from skysim.sources.dome.shell.surface import Plane, Surface

RINGS = 200
SECTORS = 180


def cap_area_m2(surface: Surface, cap_deg: float) -> float:
    """Area of a surface within an angle from the zenith, seen from the bearing, m^2; of a panel with sides all of it.

    A cone of directions of solid angle dW about the unit vector u meets the surface at the distance r, where its inward
    normal is n, in the area

        dA = r^2 dW / -(u . n),

    integrated over the cosine of the zenith angle by Gauss and Legendre's rule, and over the azimuth in equal steps,
    which is exact to rounding for a smooth surface. Beyond a rim there is none, to one part in RINGS.
    """
    if isinstance(surface, Plane) and np.isfinite(surface.half_m).all():
        return float(np.prod(2 * surface.half_m))
    node, weight = np.polynomial.legendre.leggauss(RINGS)
    least = np.cos(np.radians(cap_deg))
    cosine = (1 + least) / 2 + (1 - least) / 2 * node
    azimuth = np.arange(SECTORS) * (2 * np.pi / SECTORS)
    z, angle = (grid.ravel() for grid in np.meshgrid(cosine, azimuth, indexing="ij"))
    ring = np.sqrt(1 - z**2)
    rays = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
    place_m = surface.meet(np.zeros(3), rays)
    met = np.isfinite(place_m[:, 0])
    place_m = place_m[met]
    rays = rays[met]
    element_m2 = np.sum(place_m**2, axis=1) / -np.sum(rays * surface.inward(place_m), axis=1)
    solid = np.repeat(weight, SECTORS)[met] * (1 - least) / 2 * (2 * np.pi / SECTORS)
    return float(element_m2 @ solid)
