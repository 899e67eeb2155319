"""Stray light past the baffle: of the Sun, the Moon and the planets, and of the Earth's lit side.

A body's irradiance before the lens times the point source transmittance (PST) of baffle and lens at its angle from the
boresight is the irradiance on the chip, the same in every pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from skysim.camera.glow.background import angular_separation_deg, transmittance
from skysim.camera.glow.earth_glow import LAYER, earth_radiance
from skysim.core.constants import EARTH_RADIUS_M
from skysim.core.types import Floats
from skysim.scene.sections.camera import BaffleConfig
from skysim.scene.sections.orbit import EarthConfig
from skysim.sources.dome.shell.surface import perpendicular
from skysim.sources.photometry import Band
from skysim.sources.solar_system.bodies import BodyLight

# directions over the Earth's disc and the air around it
GROUND_RINGS = 64
AIR_RINGS = 10
SPOKES = 128


def pst(baffle: BaffleConfig, directions: Floats, boresight: Floats) -> Floats:
    """(M,) point source transmittance for light from directions (M, 3)."""
    return transmittance(
        angular_separation_deg(directions, boresight), baffle.angle_deg, baffle.pst
    )


def stray_of_bodies_e_s_m2(
    baffle: BaffleConfig, bodies: Sequence[BodyLight], boresight: Floats
) -> dict[str, float]:
    """Photo-electrons s^-1 m^-2 of the chip that each body causes, by its name, as a point at its center.

    boresight : (3,)
    """
    directions = np.array([body.place.direction for body in bodies]).reshape(-1, 3)
    through = pst(baffle, directions, boresight)
    return {
        body.title: body.flux_e_s_m2 * float(t) for body, t in zip(bodies, through, strict=True)
    }


def earth_around(
    config: EarthConfig, observer_m: Floats, sun_m: Floats, band: Band
) -> tuple[Floats, Floats]:
    """(M, 3) directions to the Earth and (M,) irradiances, photo-electrons s^-1 m^-2, of its parts around them.

    A sum over them is an integral over the cone about the nadir that holds the disc and the air around it, by
    Gauss-Legendre rules in the cosine of the nadir angle, one for the ground and one for the air, and even steps around
    it. The radiance is that of `earth_radiance`.
    """
    distance_m = float(np.linalg.norm(observer_m))
    edges = [
        math.sqrt(max(1 - (radius * EARTH_RADIUS_M / distance_m) ** 2, 0.0))
        for radius in (1.0, LAYER[1])
    ]
    in_cone, weights_sr = cone_rule(*edges)
    directions = in_cone @ axes_about(-observer_m / distance_m)
    return directions, weights_sr * earth_radiance(config, observer_m, directions, sun_m, band)


def stray_around_e_s_m2(
    baffle: BaffleConfig, directions: Floats, irradiance_e_s_m2: Floats, boresight: Floats
) -> float:
    """Photo-electrons s^-1 m^-2 of the chip from parts of an extended light: the sum of irradiance times PST."""
    return float(np.sum(irradiance_e_s_m2 * pst(baffle, directions, boresight)))


@lru_cache(maxsize=4)
def cone_rule(ground: float, top: float) -> tuple[Floats, Floats]:
    """(M, 3) directions about z and their weights in sr: to the ground's edge at this cosine, then to the air's top."""
    rules = [interval_rule(ground, 1.0, GROUND_RINGS), interval_rule(top, ground, AIR_RINGS)]
    cosine, weight = (np.concatenate(column) for column in zip(*rules, strict=True))
    sine = np.sqrt(1 - cosine**2)
    around = (np.arange(SPOKES) + 0.5) * 2 * np.pi / SPOKES
    columns = (
        np.outer(sine, np.cos(around)),
        np.outer(sine, np.sin(around)),
        np.outer(cosine, np.ones(SPOKES)),
    )
    weights_sr = np.repeat(weight * 2 * np.pi / SPOKES, SPOKES)
    return np.stack([column.ravel() for column in columns], axis=1), weights_sr


def interval_rule(low: float, high: float, count: int) -> tuple[Floats, Floats]:
    """Places and weights of the Gauss-Legendre rule on an interval."""
    x, weight = np.polynomial.legendre.leggauss(count)
    return (low + high + (high - low) * x) / 2, weight * (high - low) / 2


def axes_about(z: Floats) -> Floats:
    """(3, 3) rows: two unit vectors across the unit vector z, and z."""
    x = perpendicular(z[None])[0]
    return np.stack([x, np.cross(z, x), z])
