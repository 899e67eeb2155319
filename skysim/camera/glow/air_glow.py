"""The sky's glow over a site at a time: airglow, moonlight and twilight, and nothing below the skyline.

Each is a surface brightness in nanolamberts by empirical laws: Krisciunas & Schaefer 1991, PASP 103, 1033 (KS91);
Schaefer 1998, Sky & Telescope 95, 57.
"""

import math

import numpy as np

from skysim.camera.glow.background import (
    NANOLAMBERT_V0,
    ViewingGeometry,
    angular_separation_deg,
    diffuse_air_mass,
    moonlight_nl,
    nanolamberts_e_s,
    scattering,
)
from skysim.core.constants import SUN_V_MAG
from skysim.core.types import Floats
from skysim.scene.sections.surroundings import AirGlowConfig
from skysim.sources.air import Sky, air_mass
from skysim.sources.ephemeris import Place, observe_from, place

ERG_NL = 1.02e-15  # erg s^-1 cm^-2 um^-1 arcsec^-2 in a nanolambert (Schaefer 1998)
# V magnitude of 1 erg s^-1 cm^-2 um^-1 (Schaefer 1998).
V_ZERO_MAG = -11.05
# Least angle to the Sun: the scattering functions at its limb hold within it.
NEAREST_DEG = 0.25


def air_glow(config: AirGlowConfig, sky: Sky, view: ViewingGeometry) -> Floats:
    """(M,) electrons per second and pixel of the sky's glow, with the Sun's color; 0 below the skyline."""
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
    return nanolamberts_e_s(nanolamberts, view) * above


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
