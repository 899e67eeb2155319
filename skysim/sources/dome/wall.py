"""Area and volume of a dome's formed wall."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from skysim.core.types import Floats
from skysim.sources.dome.surface import Radial, Shell


class WallSize(NamedTuple):
    """Area of the inside and volume of the wall, without ribs and flange."""

    area_m2: float
    volume_m3: float


def wall_size(surface: Radial, cap_deg: float) -> WallSize:
    """The size of a formed wall, a surface of revolution, cut toward the sphere's center at the rim.

    At the angle a from the axis, about the sphere's center, the wall of thickness t begins at the radius r:

        A = 2 pi int r sqrt(r^2 + r'^2) sin a da,    V = 2 pi / 3 int ((r + t)^3 - r^3) sin a da

    from the apex to the rim, or without one to cap_deg from the axis, seen from the bearing.
    """
    shell = surface.radius
    assert isinstance(shell, Shell)
    rim = surface.rim
    if rim.unbounded:
        rim = replace(rim, half_rad=math.radians(cap_deg))

    def inner(angle_rad: float) -> tuple[float, float]:
        """Inner radius and its derivative."""
        radius, slope = shell.evaluate(unit(angle_rad))
        return float(radius[0]), float(np.linalg.norm(slope))

    def area(angle_rad: float) -> float:
        radius_m, slope_m = inner(angle_rad)
        return radius_m * math.hypot(radius_m, slope_m) * math.sin(angle_rad)

    def volume(angle_rad: float) -> float:
        radius_m, _ = inner(angle_rad)
        outer_m = radius_m + (shell.max_m - radius_m) / shell.inner_fraction
        return (outer_m**3 - radius_m**3) / 3 * math.sin(angle_rad)

    def beyond(angle_rad: float) -> float:
        """1 beyond the rim, else -1."""
        point_m = inner(angle_rad)[0] * unit(angle_rad)
        return -1.0 if rim.contains(point_m)[0] else 1.0

    edge_rad = (
        scipy.optimize.bisect(beyond, 0.0, math.pi, xtol=1e-13)
        if beyond(math.pi) > 0
        else math.pi
    )
    # The thickness has a kink at the base.
    kinks = [min(shell.base_rad, edge_rad)]
    area_m2, volume_m3 = (
        2 * math.pi * scipy.integrate.quad(density, 0.0, edge_rad, points=kinks)[0]
        for density in (area, volume)
    )
    return WallSize(area_m2, volume_m3)


def unit(angle_rad: float) -> Floats:
    """(1, 3) unit vector at an angle from the axis."""
    return np.array([[math.sin(angle_rad), 0.0, math.cos(angle_rad)]])
