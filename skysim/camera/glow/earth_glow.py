"""The Earth's light as seen from an orbit and from a site.

From an orbit: its lit side, the air above its limb, the airglow, and stray light. Over a site at a time: airglow,
moonlight and twilight, and nothing below the skyline. These are surface brightnesses in nanolamberts by empirical laws:
Krisciunas & Schaefer 1991, PASP 103, 1033 (KS91); Schaefer 1998, Sky & Telescope 95, 57.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from skysim.camera.glow.background import (
    NANOLAMBERT_V0,
    PointedCamera,
    ViewingGeometry,
    angular_separation_deg,
    diffuse_air_mass,
    moonlight_nl,
    nanolamberts_e_s,
    scattering,
    transmittance,
)
from skysim.core.constants import EARTH_RADIUS_M, SUN_V_MAG
from skysim.core.types import UP, Floats, normalized
from skysim.scene.sections.camera import BaffleConfig
from skysim.scene.sections.surroundings import AirGlowConfig, EarthConfig
from skysim.sources.air import Sky, air_mass
from skysim.sources.bodies import BodyLight
from skysim.sources.camera_orbit import TO_SPHERE
from skysim.sources.dome.surface import perpendicular, unit_vectors
from skysim.sources.ephemeris import Place, observe_from, place
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
    along = normalized(toward * TO_SPHERE)
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
    boresight = camera.cam_from_lab.inv().apply(UP)
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


# The sky's glow over a site at a time: airglow, moonlight and twilight, and nothing below the skyline.

ERG_NL = 1.02e-15  # erg s^-1 cm^-2 um^-1 arcsec^-2 in a nanolambert (Schaefer 1998)
# V magnitude of 1 erg s^-1 cm^-2 um^-1 (Schaefer 1998).
V_ZERO_MAG = -11.05
# Least angle to the Sun: the scattering functions at its limb hold within it.
NEAREST_DEG = 0.25


def air_glow(config: AirGlowConfig, sky: Sky, view: ViewingGeometry) -> Floats:
    """(h, w) electrons per second and pixel of the sky's glow, with the Sun's color; 0 below the skyline."""
    zenith_rad = math.pi / 2 - sky.altitude_rad(view.toward_lab)
    extinction_mag = sky.air.config.extinction_mag
    above = ~sky.below_horizon(view.toward_lab)
    # Brightnesses add; then nanolamberts to radiance, and radiance to electrons.
    nanolamberts = airglow_nl(config.dark_mag_arcsec2, zenith_rad, extinction_mag)
    if config.moonlight:
        nanolamberts = nanolamberts + moonlight(sky, view.toward_lab, zenith_rad)
    if config.twilight:
        sun = seen_place("sun", sky).direction
        nanolamberts = nanolamberts + sunlight_nl(
            angular_separation_deg(view.toward_lab, sun),
            float(np.degrees(sky.altitude_rad(sun[None])[0])),
            np.degrees(zenith_rad),
            extinction_mag,
        )
    return (nanolamberts_e_s(nanolamberts, view) * above).reshape(view.shape)


def seen_place(name: str, sky: Sky) -> Place:
    """The place of a body over the site, raised by refraction."""
    at = place(name, observe_from(sky.time, sky.air.site))
    return at._replace(
        direction=sky.air.refraction.apparent(at.direction[None], sky.zenith)[0]
    )


def airglow_nl(
    zenith_mag_arcsec2: float, zenith_rad: Floats, extinction_mag: float
) -> Floats:
    """Brightness of the moonless sky in nanolamberts: brighter toward the horizon, then extinct (KS91 eq. 2).

    B(Z) = B(0) X 10^(-0.4 k (X - 1)). All of the sky's light, with zodiacal light and starlight, is taken as airglow.
    """
    masses = diffuse_air_mass(zenith_rad)
    at_zenith = NANOLAMBERT_V0 * 10 ** (-0.4 * zenith_mag_arcsec2)
    return at_zenith * masses * 10 ** (-0.4 * extinction_mag * (masses - 1))


def moonlight(sky: Sky, directions: Floats, zenith_rad: Floats) -> Floats:
    """Moonlight scattered by the air in nanolamberts (KS91), for the Moon over the site; none while it is set."""
    moon = seen_place("moon", sky)
    altitude_rad = float(sky.altitude_rad(moon.direction[None])[0])
    if altitude_rad < 0:
        return np.zeros(len(directions))
    return moonlight_nl(
        angular_separation_deg(directions, moon.direction),
        math.degrees(moon.phase_rad),
        sky.air.config.extinction_mag,
        float(diffuse_air_mass(math.pi / 2 - altitude_rad)),
        diffuse_air_mass(zenith_rad),
    )


def sunlight_nl(
    from_sun_deg: Floats, sun_altitude_deg: float, zenith_deg: Floats, extinction_mag: float
) -> Floats:
    """Sunlight scattered by the air in nanolamberts: the lower of the laws of twilight and day (Schaefer 1998).

    Twilight: B = 10^(-0.4 (m - m0 + 32.5 - h - Z / (360 k))) (100 / rho) (1 - 10^(-0.4 k)), a magnitude for each degree
    of the Sun's altitude h; by day B = 10^(-0.4 (m - m0 + 43.27)) (1 - 10^(-0.4 k X)) (f(rho) t + 440000 (1 - t)),
    with the scattering function f of moonlight, t = 10^(-0.4 k X(sun)) and all angles in degrees.
    """
    off_deg = np.maximum(from_sun_deg, NEAREST_DEG)
    # The law of twilight divides by the extinction.
    k = max(extinction_mag, 1e-3)
    bright_mag = SUN_V_MAG - V_ZERO_MAG
    # Twilight.
    twilight = 10 ** (-0.4 * (bright_mag + 32.5 - sun_altitude_deg - zenith_deg / (360 * k)))
    twilight = twilight * (100 / off_deg) * (1 - 10 ** (-0.4 * k))
    # Day: t, then single scattering and a uniform part of what is scattered more often.
    passed = 10 ** (-0.4 * k * float(air_mass(np.radians(sun_altitude_deg))))
    scattered = 1 - 10 ** (-0.4 * k * air_mass(np.radians(90 - zenith_deg)))
    day = (
        10 ** (-0.4 * (bright_mag + 43.27))
        * scattered
        * (scattering(off_deg) * passed + 440_000 * (1 - passed))
    )
    return np.minimum(twilight, day) / ERG_NL
