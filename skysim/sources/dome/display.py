"""Stars shown by displays instead of LEDs: an LCD panel, a collimated micro-display, a projector.

1. A display rounds places to its pixels and levels to its gray levels (`draw_blocks`).
2. On an LCD panel each star is a block of pixels at a finite distance (`panel_sources`); behind a collimator it is a
   parallel beam, a source at infinity (`display_sources`); a projector lights a disk on the wall (`projector_sources`).
"""

import dataclasses
import datetime
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Bools, Floats, Ints, Sources, homogeneous, lengths, normalized
from skysim.scene.sections import layouts, leds, light
from skysim.scene.sections.layouts import LensDisplayConfig, ProjectorConfig
from skysim.scene.sections.leds import LedConfig
from skysim.sources import stars as star_sources
from skysim.sources.catalog import Catalog
from skysim.sources.dome.led import (
    DRIVES,
    DriveInput,
    aging_factors,
    chromatic_of,
    full_strength_e_s_sr,
    strength_factors,
)
from skysim.sources.dome.surface import Plane, Surface
from skysim.sources.photometry import SUN, Band, Reals, star_chromatic, star_flux_e_s_m2

PanelConfig = layouts.LcdConfig | layouts.ProjectorConfig


class PixelBlocks(NamedTuple):
    """Stars on a display, one for each of M lit blocks.

    star
        (M,) index of the star; of several stars on one block the brightest
    corner_px
        (M, 2) column and row of the block's first pixel
    center_px
        (M, 2) column and row of the block's center, from the display's center
    level
        (M,) transmitted light above that of black, as a fraction of a white block's
    """

    star: Ints
    corner_px: Ints
    center_px: Floats
    level: Floats


def draw_blocks(
    config: layouts.PixelsConfig, position_m: Floats, level: Floats
) -> PixelBlocks:
    """Draw stars as blocks of pixels: places rounded to the nearest block that fits, levels to the nearest gray.

    Rounding to a pitch p is an error uniform over p, p / sqrt(12) rms along each axis. A returned level of 0 is a
    star too faint for the gray levels.

    Parameters
    ----------
    position_m
        (N, 2) places on the display along the directions of its columns and its rows, from its center
    level
        (N,) fractions of white; stars on one block add up, to white at most
    """
    pixels = np.array(config.pixels)
    exact_px = position_m / config.pitch_m + (pixels - 1) / 2 - (config.block - 1) / 2
    corner = np.clip(np.rint(exact_px), 0, pixels - config.block).astype(np.int64)
    # Brightest first, so that `first` is the brightest star of each block.
    order = np.argsort(-level, kind="stable")
    _, first, block = np.unique(
        corner[order] @ [1, pixels[0]], return_index=True, return_inverse=True
    )
    total = np.minimum(np.bincount(block, level[order], len(first)), 1.0)
    star = order[first]
    center_px = corner[star] + (config.block - 1) / 2 - (pixels - 1) / 2
    transmitted = gray_transmission(config, total) * (1 - black_transmission(config))
    return PixelBlocks(star, corner[star], center_px, transmitted)


def black_transmission(config: layouts.PixelsConfig) -> float:
    """Transmission of a black pixel, as a fraction of white: 1 / contrast, or 0."""
    return 1 / config.contrast if config.contrast else 0.0


def gray_transmission(config: layouts.PixelsConfig, level: Floats) -> Floats:
    """(N,) transmission of the nearest gray level: that of g / (G - 1), g as in `gray_number`."""
    top = config.gray_levels - 1
    return transmission(config, gray_number(config, level) / top)


def gray_number(config: layouts.PixelsConfig, level: Floats) -> Floats:
    """(N,) nearest gray levels g of levels 0 to 1, rounded from (G - 1) v, of which v has this transmission.

    Rounding is in g, as in a program that writes a picture, so steps are fine for faint stars.
    """
    gamma = config.gamma
    if gamma == "srgb":
        gray = np.where(level <= 0.0031308, 12.92 * level, 1.055 * level ** (1 / 2.4) - 0.055)
    elif isinstance(gamma, tuple):
        gray = np.interp(level, gamma, np.linspace(0, 1, len(gamma)))
    else:
        gray = level ** (1 / gamma)
    return np.rint((config.gray_levels - 1) * gray)


def transmission(config: layouts.PixelsConfig, gray: Floats) -> Floats:
    """(N,) light above that of black of grays from black, 0, to white, 1, by the display's gamma."""
    gamma = config.gamma
    if gamma == "srgb":  # IEC 61966-2-1
        return np.where(gray <= 0.04045, gray / 12.92, ((gray + 0.055) / 1.055) ** 2.4)
    if isinstance(gamma, tuple):
        return np.interp(gray, np.linspace(0, 1, len(gamma)), gamma)
    return gray**gamma


def min_level(config: layouts.PixelsConfig) -> float:
    """Level below which a star is black: half a step of gray."""
    return float(transmission(config, np.array(0.5 / (config.gray_levels - 1))))


def panel_surface(config: layouts.LcdConfig, surface: Any) -> Plane:
    """The panel as a surface: the flat surface, cut to the extent of the pixels.

    Raises
    ------
    InputError
        If the pixels do not fit into the surface's width and height.
    """
    assert isinstance(surface, Plane)  # DomeConfig admits no other surface
    half_m = np.array(config.pixels) * config.pitch_m / 2
    if np.any(half_m > surface.half_m * (1 + 1e-9)):
        raise InputError(
            "light.layout.pixels",
            f"need {2 * half_m[0]:.4g} m by {2 * half_m[1]:.4g} m",
            f"the surface's {2 * surface.half_m[0]:.4g} m by {2 * surface.half_m[1]:.4g} m",
        )
    return dataclasses.replace(surface, half_m=half_m)


def ideal_led(led: leds.LedConfig) -> leds.LedConfig:
    """The LED as new, on direct current, without scatter: its strength is the level that a layout gives a star."""
    return led.with_values(
        drive=leds.DirectConfig(kind="direct"), scatter=0.0, color_scatter_m=0.0, aging=None
    )


def panel_strength_e_s_sr(led: leds.LedConfig, band: Band) -> float:
    """Strength of a white pixel of a panel in photo-electrons s^-1 sr^-1; the backlight ages as one LED."""
    return full_strength_e_s_sr(led, band) * float(aging_factors(led.aging, np.zeros(1))[0])


def panel_sources(
    config: layouts.LcdConfig, panel: Plane, led: leds.LedConfig, band: Band, stars: Sources
) -> Sources:
    """Stars on an LCD panel, each a block of n x n equal pixels: n^2 times a pixel's light from n times its width.

    Places and gray levels are those of `draw_blocks`. A block is represented by a disk of its area, with the star's
    number.

    Parameters
    ----------
    stars
        Stars as LEDs that are always lit, on the panel or near it; they are projected onto it

    Raises
    ------
    InputError
        For a star nearer to black than to the first gray level.
    """
    # In the panel's own frame, and back from the rounded places.
    own_m = panel.lab_from_own.inv().apply(stars.xyz - panel.center_m)
    blocks = visible_blocks(
        config, own_m[:, :2], stars.strength / full_strength_e_s_sr(led, band)
    )
    flat_m = homogeneous(blocks.center_px * config.pitch_m, 0.0)
    place_m = panel.center_m + panel.lab_from_own.apply(flat_m)
    radius_m = config.block * led.disk_diameter_m / 2
    row = blocks.corner_px[:, 1] / config.pixels[1]
    return block_sources(config, led, band, stars, blocks, place_m, panel, radius_m, row)


def visible_blocks(config: PanelConfig, position_m: Floats, level: Floats) -> PixelBlocks:
    """`draw_blocks`, without black stars.

    Raises
    ------
    InputError
        For a star nearer to black than to the first gray level.
    """
    blocks = draw_blocks(config, position_m, level)
    if not np.all(blocks.level > 0):
        raise InputError(
            "light.layout.points",
            f"a star of level {level.min():.2g} is black on {config.gray_levels} gray levels",
            f"{min_level(config):.2g} or more",
        )
    return blocks


def block_sources(
    config: PanelConfig,
    led: leds.LedConfig,
    band: Band,
    stars: Sources,
    blocks: PixelBlocks,
    place_m: Floats,
    surface: Surface,
    radius_m: Reals,
    row: Reals = 0.0,
    gain: Reals = 1.0,
) -> Sources:
    """The M blocks as sources, each with n^2 times the light of a pixel.

    Parameters
    ----------
    place_m, surface
        (M, 3) places, and the surface that they are on
    radius_m
        Radius of the disk that represents a block
    row
        As in `DriveInput`
    gain
        Light of a block's pixel, relative to the white pixel `led`
    """
    rng = random_stream(config.points.hardware_seed)
    count = len(blocks.star)
    # Pixels scatter independently: the mean of n^2 of them scatters by 1 / n as much, and is nearly Gaussian.
    spread = led.scatter if config.block == 1 else led.scatter / config.block
    scatter = strength_factors(spread, rng.standard_normal(count))
    pulses = DRIVES[led.drive.kind](
        led, DriveInput(blocks.level, np.zeros(count, dtype=np.int64), row), rng
    )
    # n^2 pixels of the panel, each dimmed by scatter, gray level and lens.
    full = panel_strength_e_s_sr(led, band) * config.block**2
    strength = full * scatter * pulses.strength * gain
    return Sources(
        id=stars.id[blocks.star],
        place=homogeneous(place_m, 1.0),
        normal=surface.inward(place_m),
        radius_m=np.broadcast_to(radius_m, (count,)).copy(),
        **pulses._replace(strength=strength)._asdict(),
        magnitude=stars.magnitude[blocks.star],
        chromatic=chromatic_of(led, band, np.zeros(count)),
    )


def lab_from_icrs(config: light.CollimatedDisplayConfig) -> Rotation:
    """Rotation from ICRS to lab axes: the collimator's axis is lab +z, roll is the position angle of lab -y."""
    return star_sources.cam_from_icrs(
        config.axis_ra_deg, config.axis_dec_deg, config.roll_deg
    )


def display_sources(
    config: light.CollimatedDisplayConfig, stars: Catalog, time: datetime.datetime, band: Band
) -> Sources:
    """Stars on a collimated display: a pixel (x, y) off the axis is a parallel beam along (x, y, focal length).

    1. Apparent directions of the stars, and their places on the display.
    2. Round to pixels and gray levels.
    3. The blocks as beams, without the distortion for which the places were drawn.

    Returns Sources in lab axes: points at infinity, or, with config.conjugate_m = D, at D from the bearing's center, so
    that a camera off it by r sees them shifted by r / D. Strength is that of a star of config.brightest_mag and the
    Sun's color, times the gray level; magnitude is the catalog's. Pixels are not resolved.

    Parameters
    ----------
    time
        UTC of the apparent places that are shown

    Raises
    ------
    InputError
        If no star is in the field, and for a star nearer to black than to the first gray level.
    """
    # 1.
    stars = stars.to_limit(config.limit_mag)
    direction = np.zeros((0, 3))
    if len(stars):
        direction = lab_from_icrs(config).apply(star_sources.apparent(stars, time))
    on_display_m, within = on_chip_m(config, direction)
    stars = stars.take(within)
    on_display_m = on_display_m[within]
    if not len(stars):
        raise InputError(
            "light.limit_mag",
            "no star of the catalog is on the display to this limit",
            "a fainter one",
        )
    # 2.
    level = np.minimum(10 ** (-0.4 * (stars.v_mag - config.brightest_mag)), 1.0)
    blocks = draw_blocks(config, on_display_m, level)
    if not np.all(blocks.level > 0):
        darkest_mag = config.brightest_mag - 2.5 * np.log10(min_level(config))
        raise InputError(
            "light.limit_mag",
            f"stars of V {stars.v_mag.max():.3g} are black on {config.gray_levels} gray levels",
            f"to {darkest_mag:.3g}",
        )
    # 3.
    shown_m = blocks.center_px * config.pitch_m
    shown_m *= undistortion(config, shown_m)[:, None]
    beam = homogeneous(shown_m, config.focal_length_m)
    white_e_s_m2 = float(star_flux_e_s_m2(config.brightest_mag, *SUN, band))
    beams = beam_sources(config, beam, white_e_s_m2 * blocks.level, stars.take(blocks.star))
    b_v, v_i = (np.full(len(beam), color) for color in SUN)
    return dataclasses.replace(beams, chromatic=star_chromatic(b_v, v_i, band))


def beam_sources(
    config: light.CollimatedDisplayConfig, beam: Floats, flux_e_s_m2: Floats, stars: Catalog
) -> Sources:
    """Beams along (N, 3) as steady sources at infinity or, for an imperfect collimator, at config.conjugate_m.

    At the distance D a source has the strength F D^2, which gives the flux F at the bearing.
    """
    direction = normalized(beam)
    beams = star_sources.steady_points(stars.hip, direction, flux_e_s_m2, stars.v_mag)
    if config.conjugate_m is None:
        return beams
    return dataclasses.replace(
        beams,
        place=homogeneous(direction * config.conjugate_m, 1.0),
        normal=-direction,
        strength=flux_e_s_m2 * config.conjugate_m**2,
    )


# A projector in the dome: a grid of pixels through a lens onto the matt wall, from a place off the center. A pixel at
# the chip's coordinates c is the ray whose tangents t from the axis have c = f t (1 + k t^2). It spans the solid angle
#
#     w = (p / f)^2 cos^3(theta) / [(1 + k t^2) (1 + 3 k t^2)]
#
# and lights w D^2 / cos(i) of the wall, with the angle theta from the axis, the distance D and the angle of incidence
# i: so a pixel grows with distance and incidence, and the wall gets darker as E = I cos(i) / D^2, while the light of a
# pixel as a whole is lost only by the lens, cos^n(theta) (n = 4: natural vignetting). The wall sends it back by its
# own lobe: a Lambertian wall of reflectance rho that receives the flux F has the intensity rho F / pi along its
# normal. A point in focus at the depth F along the axis has at the depth z a disk of diameter (f / N) |z - F| / F.


NEWTON_STEPS = 12  # of the inversion of the distortion


def own_from_lab(config: ProjectorConfig) -> Rotation:
    """Rotation from the lab's axes to the projector's: x along its rows, y along its columns, z along its axis."""
    axis = np.array(config.aim_m) - config.position_m
    axis /= np.linalg.norm(axis)
    # The rows are level before the rotation about the axis: along lab x, as far as the axis allows.
    right = np.array([1.0, 0.0, 0.0]) - axis[0] * axis
    right = right / np.linalg.norm(right)
    right = Rotation.from_rotvec(np.radians(config.rotation_deg) * axis).apply(right)
    return Rotation.from_matrix(np.array([right, np.cross(axis, right), axis]))


def on_chip_m(config: LensDisplayConfig, own: Floats) -> tuple[Floats, Bools]:
    """(N, 2) places on the chip of directions (N, 3) in the lens's axes, and (N,) whether they are on its pixels.

    A direction beyond the fold of the distortion, where 1 + 3 k t^2 = 0, is not on them.
    """
    in_front = own[:, 2] > 0
    tangent = own[:, :2] / np.where(in_front, own[:, 2], np.nan)[:, None]
    tangent2 = np.sum(tangent**2, axis=1, keepdims=True)
    chip_m = config.focal_length_m * tangent * (1 + config.distortion * tangent2)
    half_m = np.array(config.pixels) * config.pitch_m / 2
    unfolded = 1 + 3 * config.distortion * tangent2[:, 0] > 0
    return chip_m, in_front & unfolded & np.all(np.abs(chip_m) <= half_m, axis=1)


def undistortion(config: LensDisplayConfig, chip_m: Floats) -> Floats:
    """(N,) factors from places (N, 2) on the chip to those without distortion, by Newton's method."""
    radius = lengths(chip_m) / config.focal_length_m
    tangent = radius
    for _ in range(NEWTON_STEPS if config.distortion else 0):
        excess = tangent * (1 + config.distortion * tangent**2) - radius
        tangent = tangent - excess / (1 + 3 * config.distortion * tangent**2)
    return np.divide(tangent, radius, out=np.ones_like(radius), where=radius > 0)


def rays(config: ProjectorConfig, chip_m: Floats) -> Floats:
    """(N, 3) unit rays in the lab through places (N, 2) on the chip."""
    stretch = undistortion(config, chip_m)
    own = normalized(homogeneous(chip_m / config.focal_length_m * stretch[:, None], 1.0))
    return own_from_lab(config).inv().apply(own)


def pixel_sr(config: LensDisplayConfig, cos_axis: Floats) -> Floats:
    """(N,) solid angles w of pixels at these cosines from the axis."""
    tangent2 = 1 / cos_axis**2 - 1
    stretch = (1 + config.distortion * tangent2) * (1 + 3 * config.distortion * tangent2)
    return (config.pitch_m / config.focal_length_m) ** 2 * cos_axis**3 / stretch


def spot_radius_m(
    config: ProjectorConfig, surface: Surface, chip_m: Floats, place_m: Floats
) -> Floats:
    """(N,) radii of uniform disks with the mean square radius of each block's image on the wall.

    A parallelogram with the edges a, b has the mean square distance (a^2 + b^2) / 12 from its center, a disk r^2 / 2.

    1. The edges a, b are traced from the chip to the wall.
    2. The defocus disk is projected along the ray onto the wall: v to v - (n . v) / (n . u) u.
    """
    position_m = np.array(config.position_m)
    R_own_from_lab = own_from_lab(config).as_matrix()
    ray = rays(config, chip_m)
    normal = surface.inward(place_m)
    square_m2 = np.zeros(len(chip_m))
    half_m = config.block * config.pitch_m / 2
    # 1. The mean square of a parallelogram as r^2 of a disk: (a^2 + b^2) / 6.
    for axis in np.eye(2):
        ends = [rays(config, chip_m + side * half_m * axis) for side in (1, -1)]
        first_m, last_m = (surface.exit_m(position_m, end)[:, None] * end for end in ends)
        square_m2 += np.sum((first_m - last_m) ** 2, axis=1) / 6
    # 2. Depth along the axis, and radius of the defocus disk there.
    depth_m = (place_m - position_m) @ R_own_from_lab[2]
    focus_m = config.focus_m or float(np.linalg.norm(np.array(config.aim_m) - position_m))
    blur_m = config.focal_length_m / config.f_number / 2 * np.abs(depth_m / focus_m - 1)
    for axis in R_own_from_lab[:2]:
        on_wall = axis - (normal @ axis / np.sum(normal * ray, axis=1))[:, None] * ray
        square_m2 += blur_m**2 / 2 * np.sum(on_wall**2, axis=1)
    return np.sqrt(square_m2)


def projector_sources(
    config: ProjectorConfig, surface: Surface, led: LedConfig, band: Band, stars: Sources
) -> Sources:
    """Stars drawn on the nearest blocks of pixels, as disks on the wall where the projector's rays meet it.

    1. Places of the stars on the chip.
    2. Round to pixels and gray levels. The picture is drawn for the lens's distortion, so a star is off by the rounding
       alone.
    3. Trace the pixels to the wall; size and light of their disks there.

    Parameters
    ----------
    stars
        Stars as LEDs that are always lit, on the surface, with their numbers

    Raises
    ------
    InputError
        For a projector outside the dome, for stars outside its picture or nearer to black than
        to the first gray level, and for a pixel that passes below the rim.
    """
    position_m = np.array(config.position_m)
    if not surface.inside(position_m):
        raise InputError(
            "light.layout.position", f"{config.position_m} m is outside of the dome", "inside"
        )
    # 1.
    chip_m, shown = on_chip_m(config, own_from_lab(config).apply(stars.xyz - position_m))
    if not shown.all():
        raise InputError(
            "light.layout.points",
            f"{np.sum(~shown)} of {len(shown)} stars are outside of the projector's picture",
            "a smaller cap_deg, a shorter focal_length, or another position",
        )
    # 2.
    blocks = visible_blocks(config, chip_m, stars.strength / full_strength_e_s_sr(led, band))
    drawn_m = blocks.center_px * config.pitch_m
    # 3.
    ray = rays(config, drawn_m)
    place_m = surface.meet(position_m, ray)
    if np.isnan(place_m).any():
        raise InputError(
            "light.layout.points",
            "a star's pixel is below the dome's rim",
            "a smaller cap_deg",
        )
    lens_disk_m = spot_radius_m(config, surface, drawn_m, place_m)
    cos_axis = ray @ own_from_lab(config).as_matrix()[2]
    radius_m = np.hypot(lens_disk_m, led.disk_diameter_m / 2)
    gain = cos_axis**config.falloff
    return block_sources(
        config, led, band, stars, blocks, place_m, surface, radius_m, gain=gain
    )


def white_wall_per_m2(config: ProjectorConfig, place_m: Floats, normal: Floats) -> Floats:
    """(N,) light of white pixels per area of the wall at places (N, 3), relative to one pixel on the axis, in 1/m^2.

    cos^n(theta) over the area w D^2 / cos(i) that a pixel lights; 0 outside of the picture, and for NaN.
    """
    sight_m = place_m - np.array(config.position_m)
    own = own_from_lab(config).apply(sight_m)
    _, shown = on_chip_m(config, own)
    distance_m = lengths(sight_m)
    cos_axis = np.where(shown, own[:, 2] / distance_m, 1.0)
    cos_incidence = -np.sum(normal * sight_m, axis=1) / distance_m
    area_m2 = pixel_sr(config, cos_axis) * distance_m**2 / np.maximum(cos_incidence, 0)
    return np.where(shown & (cos_incidence > 0), cos_axis**config.falloff / area_m2, 0.0)
