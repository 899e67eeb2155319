"""The real sky on a dome: where an LED must be, and how bright, to appear as a star to the camera.

1. Each star's apparent direction is traced from the camera's nominal place to the surface (`project_stars`).
2. Stars closer than an LED's diameter are merged into one LED at their center of light (`merge_close_stars`).
3. Levels compensate for the distance and emission angle of each LED, so that the irradiance at the camera follows the
   magnitudes (`led_levels`).
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from skysim.core.errors import InputError
from skysim.core.types import Floats, Ints, lengths, normalized, taken
from skysim.scene.sections import layouts, leds
from skysim.sources import catalog
from skysim.sources import stars as star_sources
from skysim.sources.dome.led import Emitter, irradiance_e_s_m2
from skysim.sources.dome.surface import Surface
from skysim.sources.photometry import Band, synthetic_mag


class ProjectedStars(NamedTuple):
    """Stars on the dome, brightest first.

    Attributes
    ----------
    hip, v_mag
        (N,) Hipparcos numbers and V magnitudes
    shown_mag
        (N,) magnitudes that the LEDs have to show: V, or the instrumental magnitude in the chip's band
    place_m
        (N, 3) places in the lab
    """

    hip: Ints
    v_mag: Floats
    shown_mag: Floats
    place_m: Floats


def project_stars(
    config: layouts.CelestialConfig, surface: Surface, led: leds.LedConfig, band: Band
) -> ProjectedStars:
    """Stars as LED places: apparent directions at config.epoch, traced from the camera's nominal place to the surface.

    The lab's +z is the zenith at RA, Dec; roll is the position angle of the lab's -y there.

    1. Apparent directions of the stars above the horizon.
    2. Places on the dome within its cap, the brightest star first.
    3. Take the brightest, and merge those that one LED's disk would cover (`merge_close_stars`).
    4. A merged place is a mean of points on the surface and so is inside it: trace it back onto the surface.

    Raises
    ------
    InputError
        For a camera outside the dome, and if there are no stars or too few.
    """
    camera_m = np.array(config.camera_m)
    if not surface.inside(camera_m):
        distance_m = np.linalg.norm(camera_m)
        raise InputError(
            "light.layout.camera",
            f"{distance_m:g} m from the bearing's center, outside of the dome",
            "inside",
        )
    # 1.
    stars = catalog.read_for("light.layout.catalog", config.catalog)
    lab_from_icrs = star_sources.cam_from_icrs(
        config.zenith_ra_deg, config.zenith_dec_deg, config.roll_deg
    )
    direction = lab_from_icrs.apply(star_sources.apparent(stars, config.epoch))
    above_horizon = direction[:, 2] > 0
    stars = stars.take(above_horizon)
    mag = stars.v_mag
    if config.brightness == "band":
        mag = synthetic_mag(stars.v_mag, stars.b_v, stars.v_i, band)
    # 2.
    place_m = surface.meet(camera_m, direction[above_horizon])
    within = place_m[:, 2] >= np.cos(np.radians(config.cap_deg)) * lengths(place_m)
    projected = taken(ProjectedStars(stars.hip, stars.v_mag, mag, place_m), within)
    projected = taken(projected, np.argsort(projected.v_mag, kind="stable"))
    # 3.
    selected = select_brightest(projected, config, led.disk_diameter_m)
    # 4.
    rays = normalized(selected.place_m - camera_m)
    return selected._replace(place_m=surface.meet(camera_m, rays))


def merge_targets(place_m: Floats, separation_m: float) -> Ints:
    """(N,) index of the star with which each star is merged: itself, unless a brighter target is within separation_m.

    Parameters
    ----------
    place_m
        (N, 3) places, brightest first, so that a star's target does not depend on fainter stars
    """
    target = np.arange(len(place_m))
    # Sorted pairs: when a pair is reached, it is decided whether its brighter star is a target.
    for bright, faint in sorted(cKDTree(place_m).query_pairs(separation_m * (1 - 1e-9))):
        if target[bright] == bright and target[faint] == faint:
            target[faint] = bright
    return target


def merge_stars(stars: ProjectedStars, target: Ints) -> ProjectedStars:
    """Merge stars: the light of each is added to its target's, at their center of light.

    The merged stars have the targets' numbers, and the order of combined V. m = -2.5 log10(sum 10^(-0.4 m_i)).
    """
    first, group = np.unique(target, return_inverse=True)

    def combined_mag(mag: Floats) -> Floats:
        # A single star keeps its magnitude to the last digit.
        single = np.bincount(group, minlength=len(first)) == 1
        sum_mag = -2.5 * np.log10(np.bincount(group, 10 ** (-0.4 * mag)))
        return np.where(single, mag[first], sum_mag)

    # Center of light, sum of light times place.
    light = 10 ** (-0.4 * stars.shown_mag)
    weight = light / np.bincount(group, light)[group]
    place_m = np.array(
        [np.bincount(group, weight * axis) for axis in stars.place_m.T], dtype=float
    ).T
    v_mag = combined_mag(stars.v_mag)
    order = np.argsort(v_mag, kind="stable")
    shown_mag = combined_mag(stars.shown_mag)
    return taken(ProjectedStars(stars.hip[first], v_mag, shown_mag, place_m), order)


def merge_close_stars(
    stars: ProjectedStars, count: int, separation_m: float
) -> ProjectedStars:
    """The first `count` stars as LEDs, no two nearer to each other than separation_m.

    A merged LED is between the places of its stars and may be too near a third star, so merging repeats until no two
    LEDs are too near.
    """
    selected = taken(stars, slice(count))
    while True:
        target = merge_targets(selected.place_m, separation_m)
        if np.all(target == np.arange(len(target))):
            return selected
        selected = merge_stars(selected, target)


def select_brightest(
    stars: ProjectedStars, config: layouts.CelestialConfig, separation_m: float
) -> ProjectedStars:
    """The brightest stars merged into config.count LEDs, or all stars to config.limit_mag. Raises InputError."""
    if config.limit_mag is not None:
        count = int(np.sum(stars.v_mag <= config.limit_mag))
        if not count:
            raise InputError(
                "light.layout.limit_mag",
                f"no star to {config.limit_mag:g} mag on the dome",
                "a fainter limit",
            )
        return merge_close_stars(stars, count, separation_m)
    wanted = config.count or 1
    count = min(wanted, len(stars.hip))
    merged = merge_close_stars(stars, count, separation_m)
    while len(merged.hip) < wanted and count < len(stars.hip):
        # Each star adds one LED at most.
        count = min(count + wanted - len(merged.hip), len(stars.hip))
        merged = merge_close_stars(stars, count, separation_m)
    if len(merged.hip) < wanted:
        raise InputError(
            "light.layout.count",
            f"{wanted} LEDs, but the catalog gives {len(merged.hip)} on the dome",
            "at most that",
        )
    return merged


def led_levels(
    config: layouts.CelestialConfig,
    stars: ProjectedStars,
    normal: Floats,
    led: leds.LedConfig,
) -> Floats:
    """(N,) levels for which the irradiance at the camera's nominal place follows Pogson's law, 10^(-0.4 m).

    m is stars.shown_mag, but no star is shown brighter than config.brightest_mag. All LEDs have one color, so the
    magnitudes hold for this chip only, and m should be its instrumental magnitude. The level compensates for the LED's
    distance and emission angle; the LED that needs most light has level 1.

    Parameters
    ----------
    normal
        (N, 3) normals of the LEDs

    Raises
    ------
    InputError
        For an LED whose lobe does not reach the camera.
    """
    to_camera = np.array(config.camera_m) - stars.place_m
    distance_m = lengths(to_camera)
    cos_emission = np.einsum("nj,nj->n", normal, to_camera) / distance_m
    ones = np.ones(len(distance_m))
    # Irradiance per unit strength on an aperture that faces the LED, as stars at infinity are measured.
    gain = irradiance_e_s_m2(ones, Emitter.from_config(led), cos_emission, ones, distance_m)
    if not np.all(gain > 0):
        raise InputError(
            "light.led.lobe",
            f"the LED of HIP {stars.hip[gain <= 0][0]} does not reach the camera",
            "a wider lobe",
        )
    brightest_mag = -np.inf if config.brightest_mag is None else config.brightest_mag
    shown_mag = np.maximum(stars.shown_mag, brightest_mag)
    needed = 10 ** (-0.4 * shown_mag) / gain
    return needed / needed.max()
