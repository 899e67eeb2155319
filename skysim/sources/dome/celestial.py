"""The real sky on a dome: where an LED must be, and how bright, to appear as a star to the camera.

Each star's apparent direction is traced from the camera's nominal place to the surface. Stars closer than an LED's
diameter are merged into one LED at their center of light. Levels compensate for the distance and emission angle of
each LED, so that the irradiance at the camera follows the magnitudes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene import leds
from skysim.sources import catalog
from skysim.sources import stars as star_sources
from skysim.sources.catalog import known_catalogue
from skysim.sources.dome.led import Emitter, irradiance_e_s_m2
from skysim.sources.dome.surface import Inside
from skysim.sources.photometry import Band, synthetic_mag


class Projected(NamedTuple):
    """Stars on the dome, brightest first: hip, v_mag, shown_mag (N,), place_m (N, 3) in the lab.

    shown_mag : magnitude that the LED has to show: V, or the instrumental magnitude in the chip's band
    """

    hip: NDArray[np.int64]
    v_mag: Floats
    shown_mag: Floats
    place_m: Floats


def projected(part: leds.CelestialConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Projected:
    """Stars as LED places: apparent directions at part.epoch, traced from the camera's nominal place to the surface.

    The lab's +z is the zenith at RA, Dec; roll is the position angle of the lab's -y there. Of the stars on the
    dome's cap the brightest are taken; those that one LED's disc would cover are merged, see `lights`.
    Raises InputError for a camera outside the dome, and if there are no stars or too few.
    """
    camera_m = np.array(part.camera_m)
    if not inside.inside(camera_m):
        out_m = np.linalg.norm(camera_m)
        raise InputError(
            f"light.layout.camera: {out_m:g} m from the bearing's centre is outside of the dome; allowed: inside"
        )
    stars = catalog.read(known_catalogue("light.layout.catalogue", part.catalogue))
    lab_from_icrs = star_sources.cam_from_icrs(part.zenith_ra_deg, part.zenith_dec_deg, part.roll_deg)
    direction = lab_from_icrs.apply(star_sources.apparent(stars, part.epoch))
    above = direction[:, 2] > 0
    stars, place_m = stars.take(above), inside.meet(camera_m, direction[above])
    within = place_m[:, 2] >= np.cos(np.radians(part.cap_deg)) * np.linalg.norm(place_m, axis=1)
    stars, place_m = stars.take(within), place_m[within]
    order = np.argsort(stars.v_mag, kind="stable")
    stars, place_m = stars.take(order), place_m[order]
    mag = synthetic_mag(stars.v_mag, stars.b_v, stars.v_i, band) if part.brightness == "band" else stars.v_mag
    together = brightest(Projected(stars.hip, stars.v_mag, mag, place_m), part, led.disc_diameter_m)
    rays = together.place_m - camera_m
    # A merged place is a mean of points on the surface and so lies inside it: trace it back onto the surface.
    return together._replace(
        place_m=inside.meet(camera_m, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    )


def leaders(place_m: Floats, apart_m: float) -> NDArray[np.int64]:
    """(N,) index of the star into whose LED each star is merged: itself, unless a brighter leader is within apart_m.

    place_m : (N, 3), brightest first, so that a star's leader does not depend on fainter stars.
    """
    leader = np.arange(len(place_m))
    # Sorted pairs: when a pair is reached, its brighter star is known to be a leader or not.
    for bright, faint in sorted(cKDTree(place_m).query_pairs(apart_m * (1 - 1e-9))):
        if leader[bright] == bright and leader[faint] == faint:
            leader[faint] = bright
    return leader


def merged(stars: Projected, leader: NDArray[np.int64]) -> Projected:
    """The stars with the light of each added to its leader's, at their center of light.

    The numbers are the leaders'; the order is by combined V.
    """
    first, group = np.unique(leader, return_inverse=True)

    def together(mag: Floats) -> Floats:
        alone = np.bincount(group, minlength=len(first)) == 1
        sum_mag = -2.5 * np.log10(np.bincount(group, 10 ** (-0.4 * mag)))
        return np.where(alone, mag[first], sum_mag)

    light = 10 ** (-0.4 * stars.shown_mag)
    weight = light / np.bincount(group, light)[group]
    place_m = np.array([np.bincount(group, weight * axis) for axis in stars.place_m.T], dtype=float).T
    v_mag = together(stars.v_mag)
    order = np.argsort(v_mag, kind="stable")
    return Projected(stars.hip[first][order], v_mag[order], together(stars.shown_mag)[order], place_m[order])


def lights(stars: Projected, shown: int, apart_m: float) -> Projected:
    """The first `shown` stars as LEDs, no two nearer to each other than apart_m.

    A merged LED is between the places of its stars and may be too near a third, so merging repeats until none is.
    """
    leds = Projected(stars.hip[:shown], stars.v_mag[:shown], stars.shown_mag[:shown], stars.place_m[:shown])
    while True:
        leader = leaders(leds.place_m, apart_m)
        if np.all(leader == np.arange(len(leader))):
            return leds
        leds = merged(leds, leader)


def brightest(stars: Projected, part: leds.CelestialConfig, apart_m: float) -> Projected:
    """The brightest stars, merged into part.count LEDs, or all stars to part.limit_mag. Raises InputError."""
    if part.limit_mag is not None:
        shown = int(np.sum(stars.v_mag <= part.limit_mag))
        if not shown:
            raise InputError(
                "light.layout.limit_mag: no star on the dome is so bright; allowed: a fainter limit"
            )
        return lights(stars, shown, apart_m)
    count = part.count or 1
    shown = min(count, len(stars.hip))
    leds = lights(stars, shown, apart_m)
    while len(leds.hip) < count and shown < len(stars.hip):
        shown = min(shown + count - len(leds.hip), len(stars.hip))  # each star adds one LED at most
        leds = lights(stars, shown, apart_m)
    if len(leds.hip) < count:
        raise InputError(
            f"light.layout.count: {count} stars, where the catalogue has {len(leds.hip)} on the dome; allowed: no more"
            " than that"
        )
    return leds


def levels(part: leds.CelestialConfig, stars: Projected, normal: Floats, led: leds.LedConfig) -> Floats:
    """(N,) levels for which the irradiance at the camera's nominal place follows Pogson's law, 10^(-0.4 m).

    m is stars.shown_mag. All LEDs have one color, so the magnitudes hold for this chip only, where m should be its
    instrumental magnitude. The level compensates for the LED's distance and emission angle; the LED that needs most
    has level 1. No star is shown brighter than part.brightest_mag. normal : (N, 3) of the LEDs.
    Raises InputError for an LED whose lobe does not reach the camera.
    """
    to_camera = np.array(part.camera_m) - stars.place_m
    distance_m = np.linalg.norm(to_camera, axis=1)
    cos_emission = np.einsum("nj,nj->n", normal, to_camera) / distance_m
    one = np.ones(len(distance_m))
    # Irradiance per unit strength on an aperture that faces the LED, as stars at infinity are measured.
    gain = irradiance_e_s_m2(one, Emitter.of(led), cos_emission, one, distance_m)
    if not np.all(gain > 0):
        raise InputError(
            f"light.led.lobe: the LED of HIP {stars.hip[gain <= 0][0]} sends the camera nothing; allowed: a wider lobe"
        )
    shown_mag = np.maximum(stars.shown_mag, -np.inf if part.brightest_mag is None else part.brightest_mag)
    needed = 10 ** (-0.4 * shown_mag) / gain
    return np.asarray(needed / needed.max())
