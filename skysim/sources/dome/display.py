"""Stars shown by other devices than LEDs: optical fibers in a shell (APL), an LCD panel, a collimated micro-display.

A display rounds places to its pixels and levels to its gray levels (`drawn`). On an LCD panel each star is a block of
pixels at a finite distance; behind a collimator it is a parallel beam, a source at infinity.
"""

from __future__ import annotations

import dataclasses
import datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Floats, Sources
from skysim.scene import leds, light
from skysim.sources import stars as star_sources
from skysim.sources.catalog import Catalogue
from skysim.sources.dome.led import DRIVES, Lamps, full_e_s_sr
from skysim.sources.dome.surface import Plane
from skysim.sources.photometry import SUN, Band, star_flux_e_s_m2

SHELL = 2  # spawn key of the shell's own random stream, which leaves the fibers' places unchanged

Ints = NDArray[np.int64]


def standing_off(part: leds.FibresConfig, ends: Sources) -> Sources:
    """Displace each fiber's end along the surface's normal by v R, the radius error of a stretched shell.

    v is uniform in +-part.radius_variation, R the end's distance from the bearing; positive is outward. A camera that
    is r off the center and assumes a perfect dome sees an end displaced by up to (r / R) v rad (JHU/APL's .4 % of 4
    ft, 50 mm
    off: 34"). Normals are unchanged. The random stream is that of part.points.hardware_seed.
    """
    rng = np.random.default_rng(np.random.SeedSequence(part.points.hardware_seed, spawn_key=(SHELL,)))
    place_m = ends.place[:, :3]
    share = part.radius_variation * rng.uniform(-1, 1, len(ends))
    off_m = share * np.linalg.norm(place_m, axis=1)
    moved = place_m - off_m[:, None] * ends.normal
    return dataclasses.replace(ends, place=np.column_stack([moved, ends.place[:, 3]]))


class Drawn(NamedTuple):
    """Stars on a display, one for each of M lit blocks.

    star      : (M,) index of the star; where several fall on one block, of the brightest
    corner_px : (M, 2) column and row of the block's first pixel
    middle_px : (M, 2) column and row of its center, from the display's center
    level     : (M,) transmitted light above that of black, as a share of a white block's
    """

    star: Ints
    corner_px: Ints
    middle_px: Floats
    level: Floats


def drawn(part: leds.PixelsConfig, from_middle_m: Floats, level: Floats) -> Drawn:
    """Draw stars as blocks of pixels: places rounded to the nearest block that fits, levels to the nearest gray.

    from_middle_m : (N, 2) places on the display along its columns' and its rows' direction, from its center
    level         : (N,) share of white; stars on one block add up, to white at most
    Rounding to a pitch p is an error uniform over p, p / sqrt(12) rms along each axis. A returned level of 0 is a
    star too faint for the gray levels.
    """
    pixels = np.array(part.pixels)
    wanted_px = from_middle_m / part.pitch_m + (pixels - 1) / 2 - (part.block - 1) / 2
    corner = np.clip(np.rint(wanted_px), 0, pixels - part.block).astype(np.int64)
    # Brightest first, so that `first` is the brightest star of each block.
    order = np.argsort(-level, kind="stable")
    _, first, block = np.unique(corner[order] @ [1, pixels[0]], return_index=True, return_inverse=True)
    together = np.minimum(np.bincount(block, level[order], len(first)), 1.0)
    star = order[first]
    middle_px = corner[star] + (part.block - 1) / 2 - (pixels - 1) / 2
    return Drawn(star, corner[star], middle_px, grey(part, together) * (1 - black(part)))


def black(part: leds.PixelsConfig) -> float:
    """Transmission of a black pixel, as a share of white."""
    return 1 / part.contrast if part.contrast else 0.0


def grey(part: leds.PixelsConfig, level: Floats) -> Floats:
    """(N,) transmission of the nearest gray level: (g / (G - 1))^gamma, g rounded from (G - 1) level^(1 / gamma).

    Rounding is in g, as in a program that writes a picture, so steps are fine for faint stars.
    """
    top = part.grey_levels - 1
    return np.asarray((np.rint(top * level ** (1 / part.gamma)) / top) ** part.gamma)


def faintest(part: leds.PixelsConfig) -> float:
    """Level below which a star is black: half a step of gray."""
    return float((0.5 / (part.grey_levels - 1)) ** part.gamma)


def glass(part: leds.LcdConfig, inside: Any) -> Plane:
    """The panel as a surface: the flat surface, cut to the extent of the pixels.

    Raises InputError if the pixels do not fit into the surface's width and height.
    """
    assert isinstance(inside, Plane)  # DomeConfig admits no other surface
    half_m = np.array(part.pixels) * part.pitch_m / 2
    if np.any(half_m > inside.half_m * (1 + 1e-9)):
        raise InputError(
            f"light.layout.pixels: take {2 * half_m[0]:.4g} m by {2 * half_m[1]:.4g} m; allowed: the surface's"
            f" {2 * inside.half_m[0]:.4g} m by {2 * inside.half_m[1]:.4g} m"
        )
    return dataclasses.replace(inside, half_m=half_m)


def steady(led: leds.LedConfig) -> leds.LedConfig:
    """The LED on direct current without scatter, which gives the levels a layout wants before the panel draws them."""
    return led.model_copy(update={"drive": leds.DirectConfig(kind="direct"), "scatter": 0.0})


def on_panel(part: leds.LcdConfig, panel: Plane, led: leds.LedConfig, band: Band, wanted: Sources) -> Sources:
    """Stars on an LCD panel, each a block of n x n equal pixels: n^2 times a pixel's light from n times its width.

    wanted : the stars as LEDs that are always lit, on the panel or near it; they are projected onto it
    Places and gray levels as in `drawn`. A block is represented by a disc of its area; numbers are those of the
    stars. Raises InputError for a star that is nearer to black than to the first gray.
    """
    own_m = panel.lab_from_own.inv().apply(wanted.place[:, :3] - panel.centre_m)
    level = wanted.strength / full_e_s_sr(led, band)
    show = drawn(part, own_m[:, :2], level)
    if not np.all(show.level > 0):
        raise InputError(
            f"light.layout.points: a star of level {level.min():.2g} is black on {part.grey_levels} grey levels;"
            f" allowed: {faintest(part):.2g} or more"
        )
    rng = np.random.default_rng(part.points.hardware_seed)
    count = len(show.star)
    # Pixels scatter independently: the mean of n^2 of them scatters by 1 / n as much.
    scatter = np.exp(led.scatter / part.block * rng.standard_normal(count))
    row = show.corner_px[:, 1] / part.pixels[1]
    pulses = DRIVES[led.drive.kind](led, Lamps(show.level, np.zeros(count, dtype=np.int64), row), rng)
    flat_m = np.column_stack([show.middle_px * part.pitch_m, np.zeros(count)])
    place_m = panel.centre_m + panel.lab_from_own.apply(flat_m)
    return Sources(
        id=wanted.id[show.star],
        place=np.column_stack([place_m, np.ones(count)]),
        normal=panel.inward(place_m),
        radius_m=np.full(count, part.block * led.disc_diameter_m / 2),
        strength=full_e_s_sr(led, band) * part.block**2 * scatter * pulses.strength,
        period_s=pulses.period_s,
        start_s=pulses.start_s,
        on_s=pulses.on_s,
        magnitude=wanted.magnitude[show.star],
    )


def lab_from_icrs(part: light.BenchConfig) -> Rotation:
    """Rotation from ICRS to lab axes: the collimator's axis is lab +z, and roll is the position angle of lab -y."""
    return star_sources.cam_from_icrs(part.axis_ra_deg, part.axis_dec_deg, part.roll_deg)


def bench(part: light.BenchConfig, stars: Catalogue, time: datetime.datetime, band: Band) -> Sources:
    """Stars on a collimated display: a pixel (x, y) off the axis is a parallel beam along (x, y, focal length).

    time : UTC, of the apparent places shown
    Returns Sources in lab axes: points at infinity, or, with part.conjugate_m = D, at D from the bearing's center, so
    that a camera off it by r sees them shifted by r / D. Strength is that of a star of part.brightest_mag and the
    Sun's color, times the gray level; magnitude is the catalog's. Pixels are not resolved.
    Raises InputError if no star is in the field, and for a star that is nearer to black than to the first gray.
    """
    stars = stars.take(stars.v_mag <= part.limit_mag)
    direction = (
        lab_from_icrs(part).apply(star_sources.apparent(stars, time)) if len(stars) else np.zeros((0, 3))
    )
    above = direction[:, 2] > 0
    stars, direction = stars.take(above), direction[above]
    on_display_m = direction[:, :2] / direction[:, 2:] * part.focal_length_m
    half_m = np.array(part.pixels) * part.pitch_m / 2
    within = np.all(np.abs(on_display_m) <= half_m, axis=1)
    stars, on_display_m = stars.take(within), on_display_m[within]
    if not len(stars):
        raise InputError("light.limit_mag: no star on the display is so bright; allowed: a fainter limit")
    level = np.minimum(10 ** (-0.4 * (stars.v_mag - part.brightest_mag)), 1.0)
    show = drawn(part, on_display_m, level)
    if not np.all(show.level > 0):
        darkest_mag = part.brightest_mag - 2.5 * np.log10(faintest(part))
        raise InputError(
            f"light.limit_mag: stars of V {stars.v_mag.max():.3g} are black on {part.grey_levels} grey levels;"
            f" allowed: to {darkest_mag:.3g}"
        )
    beam = np.column_stack([show.middle_px * part.pitch_m, np.full(len(show.star), part.focal_length_m)])
    white_e_s_m2 = float(star_flux_e_s_m2(part.brightest_mag, *SUN, band))
    return collimated(part, beam, white_e_s_m2 * show.level, stars.take(show.star))


def collimated(part: light.BenchConfig, beam: Floats, flux_e_s_m2: Floats, stars: Catalogue) -> Sources:
    """Beams along (N, 3) as steady sources at infinity or, for an imperfect collimator, at part.conjugate_m."""
    direction = beam / np.linalg.norm(beam, axis=1, keepdims=True)
    zero, one = np.zeros(len(beam)), np.ones(len(beam))
    place, normal, strength = np.column_stack([direction, zero]), 0 * direction, flux_e_s_m2
    if part.conjugate_m is not None:
        place = np.column_stack([direction * part.conjugate_m, one])
        normal, strength = -direction, flux_e_s_m2 * part.conjugate_m**2
    return Sources(
        id=stars.hip,
        place=place,
        normal=normal,
        radius_m=zero,
        strength=strength,
        period_s=one,
        start_s=zero,
        on_s=one,
        magnitude=stars.v_mag,
    )
