"""The Earth's light as seen from an orbit: its lit side, the air above its limb, the airglow, and stray light."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from skysim.camera.glow.background import (
    PointedCamera,
    angular_separation_deg,
    transmittance,
)
from skysim.core.constants import EARTH_RADIUS_M, SUN_V_MAG
from skysim.core.types import Floats, normalized
from skysim.scene.sections.camera import BaffleConfig
from skysim.scene.sections.surroundings import EarthConfig
from skysim.sources.bodies import BodyLight
from skysim.sources.camera_orbit import TO_SPHERE
from skysim.sources.dome.surface import perpendicular, unit_vectors
from skysim.sources.photometry import SUN, Band, sky_radiance_e_s_m2_sr, star_flux_e_s_m2

NODE_PX = 4.0  # spacing of the nodes: the limb is blurred over this number of pixels
AIR_M = 8e3  # scale height of the air
# Bottom and top of the airglow, in radii of the Earth.
LAYER = (1 + 85e3 / EARTH_RADIUS_M, 1 + 95e3 / EARTH_RADIUS_M)


def earth_radiance(
    config: EarthConfig, observer_m: Floats, toward: Floats, sun_m: Floats, band: Band
) -> Floats:
    """(M,) photo-electrons s^-1 m^-2 sr^-1 from directions (M, 3), GCRS axes.

    1. The ellipsoid is stretched to the unit sphere; a line of sight has the impact parameter b.
    2. Ground: Lambert's law, albedo E mu0 / pi, with the Sun's irradiance E and the cosine mu0 of its zenith distance.
       Air: above the limb the ground's value at the tangent point times exp(-h / 8 km), h its height.
    3. Airglow: a uniform layer from 85 to 95 km. The path in it is sqrt(top^2 - b^2) - sqrt(bottom^2 - b^2), twice
       where the line misses the ground (van Rhijn 1921), over the layer's thickness. It is brightest at b = bottom, 72
       times as bright as from above.

    Clouds and seas are left out.
    """
    # 1. Impact parameter, and distance to the ground or to the tangent point.
    place = observer_m * TO_SPHERE
    along = toward * TO_SPHERE
    along = normalized(along)
    inward = -(along @ place)
    impact = np.sqrt(np.maximum(place @ place - inward**2, 0.0))
    down = inward > 0
    ground = (impact < 1) & down
    path = inward - np.sqrt(np.maximum(1 - impact**2, 0.0))
    # 2. Sunlight on the ground, and on the air above the limb.
    normal = place + path[:, None] * along
    mu0 = normal @ (sun_m / np.linalg.norm(sun_m)) / np.maximum(impact, 1.0)
    irradiance = float(star_flux_e_s_m2(SUN_V_MAG, *SUN, band))
    height_m = np.maximum(impact - 1, 0.0) * EARTH_RADIUS_M
    lit = down * config.albedo * irradiance / np.pi * np.maximum(mu0, 0.0)
    day = lit * np.exp(-height_m / AIR_M)
    # 3. Path through the glowing layer, over its thickness.
    half_chords = [np.sqrt(np.maximum(radius**2 - impact**2, 0.0)) for radius in LAYER]
    path_in_layer = (half_chords[1] - half_chords[0]) / (LAYER[1] - LAYER[0])
    layers = path_in_layer * np.where(ground, 1, 2) * down
    airglow = float(sky_radiance_e_s_m2_sr(config.airglow_mag_arcsec2, band))
    return day + layers * airglow


def earth_light(
    config: EarthConfig,
    observer_m: Floats,
    sun_m: Floats,
    camera: PointedCamera,
) -> Floats | None:
    """(h, w) electrons s^-1 px^-1 of the Earth at nodes for `background.fill`; None if it is not in the field."""
    # The angle between boresight and nadir, and the angular radius of Earth and airglow.
    boresight = camera.cam_from_lab.inv().apply([0.0, 0.0, 1.0])
    distance_m = float(np.linalg.norm(observer_m))
    cosine = float(-boresight @ observer_m) / distance_m
    from_nadir_rad = math.acos(max(min(cosine, 1.0), -1.0))
    reach_rad = math.asin(min(LAYER[1] * EARTH_RADIUS_M / distance_m, 1.0))
    if from_nadir_rad > reach_rad + camera.optics.field_rad:
        return None
    view = camera.nodes(NODE_PX)
    radiance = earth_radiance(config, observer_m, view.toward_lab, sun_m, view.band)
    return (radiance * view.etendue_m2_sr()).reshape(view.shape)


# Stray light past the baffle: of the Sun, the Moon and the planets, and of the Earth's lit side. A body's irradiance
# before the lens times the point source transmittance (PST) of baffle and lens, at its angle from the boresight, is the
# irradiance on the chip, the same in every pixel.


# Numbers of directions over the Earth's disc and the air around it.
GROUND_RINGS = 64
AIR_RINGS = 10
SPOKES = 128


def pst(baffle: BaffleConfig, directions: Floats, boresight: Floats) -> Floats:
    """(M,) point source transmittance of the baffle for light from directions (M, 3)."""
    return transmittance(
        angular_separation_deg(directions, boresight), baffle.angle_deg, baffle.pst
    )


def stray_of_bodies_e_s_m2(
    baffle: BaffleConfig, bodies: Sequence[BodyLight], boresight: Floats
) -> dict[str, float]:
    """Photo-electrons s^-1 m^-2 of the chip that each body causes, by its name.

    Parameters
    ----------
    bodies
        Taken as points at their centers
    boresight
        (3,) unit vector in the axes of the bodies' directions
    """
    directions = np.array([body.place.direction for body in bodies]).reshape(-1, 3)
    through = pst(baffle, directions, boresight)
    return {
        body.title: body.flux_e_s_m2 * float(t)
        for body, t in zip(bodies, through, strict=True)
    }


def earth_around(
    config: EarthConfig, observer_m: Floats, sun_m: Floats, band: Band
) -> tuple[Floats, Floats]:
    """The Earth and its air as many small sources, for stray light.

    A sum over them is an integral over the cone about the nadir that contains the disc and the air around it, by
    Gauss-Legendre rules in the cosine of the nadir angle, one for the ground and one for the air, and even steps in
    azimuth. The radiance is that of `earth_radiance`.

    Returns
    -------
    tuple
        (M, 3) directions and (M,) irradiances, photo-electrons s^-1 m^-2
    """
    # Cosines of the angular radii of the ground and of the air's top.
    distance_m = float(np.linalg.norm(observer_m))
    edges = [
        math.sqrt(max(1 - (radius * EARTH_RADIUS_M / distance_m) ** 2, 0.0))
        for radius in (1.0, LAYER[1])
    ]
    in_cone, weights_sr = cone_rule(*edges)
    nadir = -observer_m / distance_m
    across = perpendicular(nadir[None])[0]
    directions = in_cone @ np.stack([across, np.cross(nadir, across), nadir])
    return directions, weights_sr * earth_radiance(
        config, observer_m, directions, sun_m, band
    )


def stray_around_e_s_m2(
    baffle: BaffleConfig, directions: Floats, irradiance_e_s_m2: Floats, boresight: Floats
) -> float:
    """Photo-electrons s^-1 m^-2 of the chip from many small sources: the sum of irradiance times PST."""
    return float(np.sum(irradiance_e_s_m2 * pst(baffle, directions, boresight)))


@lru_cache(maxsize=4)
def cone_rule(ground: float, top: float) -> tuple[Floats, Floats]:
    """(M, 3) directions about z and their weights in sr.

    They cover the cap with cosines from 1 to `ground`, then the ring to `top`.
    """
    rules = [interval_rule(ground, 1.0, GROUND_RINGS), interval_rule(top, ground, AIR_RINGS)]
    cosine, weight = (np.concatenate(column) for column in zip(*rules, strict=True))
    around = (np.arange(SPOKES) + 0.5) * 2 * np.pi / SPOKES
    weights_sr = np.repeat(weight * 2 * np.pi / SPOKES, SPOKES)
    return unit_vectors(cosine[:, None], around).reshape(-1, 3), weights_sr


def interval_rule(low: float, high: float, count: int) -> tuple[Floats, Floats]:
    """Nodes and weights of the Gauss-Legendre rule on an interval."""
    x, weight = np.polynomial.legendre.leggauss(count)
    return (low + high + (high - low) * x) / 2, weight * (high - low) / 2
