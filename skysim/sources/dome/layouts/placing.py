"""Parts that all layouts share: directions from the bearing, their places on the surface, LEDs as light sources."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree

from skysim.core.constants import GOLDEN_ANGLE_RAD
from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import (
    Floats,
    Ints,
    Sources,
    homogeneous,
    lengths,
    normalized,
    polar_rad,
)
from skysim.scene.sections.layouts import HOLES, DimmedConfig, LitConfig
from skysim.scene.sections.leds import LedConfig
from skysim.sources.dome.layouts.ambiguity import unique_levels
from skysim.sources.dome.led import (
    DRIVES,
    DriveInput,
    aging_factors,
    chromatic_of,
    color_factors,
    full_strength_e_s_sr,
    strength_factors,
)
from skysim.sources.dome.surface import Surface, circle_rad, directions, unit_vectors
from skysim.sources.photometry import NODES, Band

MAX_CELLS = 500  # along each side of the square in which `thin` lists sites


class PlacedLeds(NamedTuple):
    """LED positions before drive and brightness are assigned.

    Attributes
    ----------
    id
        (N,) LED numbers
    place_m
        (N, 3) places in the lab
    normal
        (N, 3) unit normals
    level
        (N,) fractions of full brightness, 0 < level <= 1
    magnitude
        (N,) magnitudes of the stars that the LEDs represent; NaN for LEDs that represent none
    types
        (N,) names in `led.types`, empty for `led` itself; none for LEDs of one type
    number
        (N,) LED numbers instead of `id`, which gives the boards, if only some of the places have an LED
    """

    id: Ints
    place_m: Floats
    normal: Floats
    level: Floats
    magnitude: Floats
    types: Sequence[str] = ()
    number: Ints | None = None


def led_sources(placed: PlacedLeds, led: LedConfig, band: Band, rng: Generator) -> Sources:
    """Sources of placed LEDs: strength with its scatter from LED to LED, and the drive's pulse timing.

    `rng` is the hardware's random stream.
    """
    # Order of the random numbers: strengths, phases of the drive, colors, aging.
    count = len(placed.id)
    names = np.array(placed.types or [""] * count)
    types = [(led.of_type(name), names == name) for name in sorted({*names.tolist()})]
    strength = np.empty(count)
    for one, rows in types:
        strength[rows] = full_strength_e_s_sr(one, band)
    strength *= strength_factors(led.scatter, rng.standard_normal(count))
    pulses = DRIVES[led.drive.kind](led, DriveInput(placed.level, placed.id // HOLES), rng)
    color = np.zeros(count)
    # Drawn last, so that all other numbers are the same without it.
    if any(one.color_scatter_m for one, _ in types):
        color = rng.standard_normal(count)
    chromatic = None if band.chromatic is None else np.empty((count, 4 + 2 * NODES))
    for one, rows in types:
        if one.color_scatter_m:
            strength[rows] *= color_factors(one, band, color[rows])
        if chromatic is not None:
            chromatic[rows] = chromatic_of(one, band, color[rows])
    if led.aging:
        strength = strength * aging_factors(led.aging, rng.standard_normal(count))
    return Sources(
        id=placed.id if placed.number is None else placed.number,
        place=homogeneous(placed.place_m, 1.0),
        normal=placed.normal,
        radius_m=np.full(count, led.disk_diameter_m / 2),
        **pulses._replace(strength=strength * pulses.strength)._asdict(),
        magnitude=placed.magnitude,
        chromatic=chromatic,
    )


def on_surface(surface: Surface, place_m: Floats, level: Floats) -> PlacedLeds:
    """LEDs at (N, 3) places with the surface's normals there, numbered from 0."""
    number = np.arange(len(place_m), dtype=np.int64)
    unknown = np.full(len(place_m), np.nan)
    return PlacedLeds(number, place_m, surface.inward(place_m), level, unknown)


def dimmed(
    config: DimmedConfig, surface: Surface, place_m: Floats, rng: Generator
) -> PlacedLeds:
    """LEDs at (N, 3) places on the surface, each with a random level of the layout's `dimming`.

    Of a regular layout a random fraction `lit_fraction` has an LED; each keeps its number among all places.
    """
    number = None
    # Which LEDs are lit is drawn before their levels.
    if isinstance(config, LitConfig):
        lit = max(round(config.lit_fraction * len(place_m)), 1)
        number = np.sort(rng.permutation(len(place_m))[:lit])
        place_m = place_m[number]
    if config.unique_neighbors:
        # Levels by which an LED is known from its neighbors.
        levels = np.unique(config.dimming)
        level = levels[unique_levels(len(levels), config.unique_neighbors, place_m, rng)]
    else:
        level = rng.choice(config.dimming, len(place_m))
    return on_surface(surface, place_m, level)._replace(number=number)


def cap(count: int, half_angle_rad: float) -> Floats:
    """(count, 3) unit vectors spread evenly over a cap about +z: a Fibonacci spiral, equal steps in z.

    Equal steps in z are equal areas on the sphere; successive azimuths differ by the golden angle.
    """
    # Points at the middles of equal steps.
    n = np.arange(count) + 0.5
    z = 1 - n / count * (1 - np.cos(half_angle_rad))
    return unit_vectors(z, n * GOLDEN_ANGLE_RAD)


def scattered_cap(count: int, half_angle_rad: float, rng: Generator) -> Floats:
    """(count, 3) independent unit vectors, uniform over a cap about +z: uniform in z and in azimuth."""
    z = 1 - rng.random(count) * (1 - np.cos(half_angle_rad))
    azimuth = rng.uniform(0, 2 * np.pi, count)
    return unit_vectors(z, azimuth)


def directions_from_angles(directions_deg: Any) -> Floats:
    """(N, 3) unit vectors from the bearing, for (N, 2) azimuths from +x toward +y and tilts from +z, in degrees."""
    azimuth, tilt = np.radians(np.asarray(directions_deg, dtype=float)).T
    return directions(tilt, azimuth)


tilts_rad = polar_rad  # of places or directions from the zenith, seen from the bearing


def check_cap(keys: Sequence[str], directions: Floats, cap_deg: float) -> None:
    """Raise InputError for the first of (N, 3) directions from the bearing that is outside the cap."""
    # Written so that NaN is outside.
    length = lengths(directions)
    tilt_deg = np.degrees(tilts_rad(directions))
    beyond = np.flatnonzero(~((length > 0) & (tilt_deg <= cap_deg * (1 + 1e-12))))
    if len(beyond):
        raise InputError(
            keys[beyond[0]],
            f"{tilt_deg[beyond[0]]:.4g} deg from the zenith, seen from the bearing's center",
            f"light.layout.cap_deg, {cap_deg:g}",
        )


def project_from_bearing(surface: Surface, directions: Floats) -> Floats:
    """(..., 3) points where rays from the bearing's center meet the surface. Raises InputError if one misses it."""
    place_m = surface.from_bearing(directions)
    if np.isnan(place_m).any():
        raise InputError(
            "light.layout",
            "exceeds the surface",
            f"cap_deg up to {largest_cap_deg(surface):.1f}, a larger surface or rim, or kind listed",
        )
    return place_m


def largest_cap_deg(surface: Surface) -> float:
    """Greatest angle from the zenith, seen from the bearing, to which the surface extends at every azimuth, to 0.1."""
    tilt_deg = np.arange(0, 1800) / 10
    azimuth_rad = circle_rad(72)
    rays = directions(np.radians(tilt_deg)[:, None], azimuth_rad)
    missed = np.isnan(surface.from_bearing(rays))
    met = np.logical_and.accumulate(~missed.any(axis=(1, 2)))
    return float(tilt_deg[met].max(initial=0.0))


def spread(sites_m: Floats, spacing_m: float, count: int, bisections: int) -> Ints:
    """Indices of `count` sites at the widest spacing at which `thin` finds that many, by bisection.

    Fewer than `count` if there is no room for them even at spacing_m.
    """
    chosen = thin(sites_m, spacing_m, count)
    low_m = spacing_m
    high_m = float(np.ptp(sites_m, axis=0).max())
    for _ in range(bisections):
        middle_m = (low_m + high_m) / 2
        wider = thin(sites_m, middle_m, count)
        if len(wider) < count:
            high_m = middle_m
        else:
            low_m = middle_m
            chosen = wider
    return chosen


@jit
def thin(sites_m: Floats, spacing_m: float, count: int = 0) -> Ints:
    """Indices of sites taken in order, each if none taken before is within the spacing; the first `count` if not 0.

    For sites in random order this is random sequential adsorption. The time is linear in the number of sites: the
    sites taken are listed by squares of the horizontal plane, at least the spacing wide, with a border of empty ones.
    """
    reach_m = np.abs(sites_m).max()
    cell_m = max(spacing_m, 2 * reach_m / MAX_CELLS)
    side = int(2 * reach_m / cell_m) + 3
    newest = np.full((side, side), -1, np.int32)  # the site taken last in each square
    older = np.empty(len(sites_m), np.int32)  # the one taken before it there, or -1
    taken = np.empty(len(sites_m), np.int64)
    found = 0
    for site in range(len(sites_m)):
        x = int((sites_m[site, 0] + reach_m) / cell_m) + 1
        y = int((sites_m[site, 1] + reach_m) / cell_m) + 1
        is_free = True
        for near in newest[x - 1 : x + 2, y - 1 : y + 2].flat:
            while is_free and near >= 0:
                distance2 = 0.0
                for axis in range(3):
                    distance2 += (sites_m[near, axis] - sites_m[site, axis]) ** 2
                is_free = distance2 > spacing_m**2
                near = older[near]
        if is_free:
            older[site] = newest[x, y]
            newest[x, y] = site
            taken[found] = site
            found += 1
            if found == count:
                break
    return taken[:found]


def spacing_ok(place_m: Floats, spacing_m: float) -> bool:
    """Whether no two LEDs are nearer to each other than the spacing."""
    return bool(cKDTree(place_m).query(place_m, k=2)[0][:, 1].min() >= spacing_m)


def contract(place_m: Floats, sites_m: Floats, fraction: float) -> Floats:
    """(N, 3) sites nearest to a layout that is contracted to this fraction of its solid angle about the zenith.

    Few attitudes see the rim, so its LEDs help more where more fields overlap. With z = cos(zenith angle) the
    contraction is 1 - z' = fraction (1 - z), which scales every solid angle alike.
    """
    # Contract the directions, then take the nearest sites.
    direction = normalized(place_m)
    z = 1 - fraction * (1 - direction[:, 2])
    # Ratio of sin(zenith angle) after the contraction to that before it.
    narrower = np.sqrt((1 - z**2) / np.maximum(1 - direction[:, 2] ** 2, 1e-12))
    xy = direction[:, :2] * narrower[:, None]
    site_direction = normalized(sites_m)
    return sites_m[cKDTree(site_direction).query(np.column_stack([xy, z]))[1]]
