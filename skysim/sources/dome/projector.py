"""A projector in the dome: a grid of pixels through a lens onto the matt wall, from a place off the center.

A pixel at the chip's coordinates c is the ray whose tangents t from the axis have c = f t (1 + k t^2). It spans the
solid angle

    w = (p / f)^2 cos^3(theta) / [(1 + k t^2) (1 + 3 k t^2)]

and lights w D^2 / cos(i) of the wall, with the angle theta from the axis, the distance D and the angle of incidence i:
so a pixel grows with distance and incidence, and the wall gets darker as E = I cos(i) / D^2, while the light of a pixel
as a whole is lost only by the lens, cos^n(theta) (n = 4: natural vignetting). The wall sends it back by its own lobe:
a Lambertian wall of reflectance rho that receives the flux F has the intensity rho F / pi along its normal.

A point in focus at the depth F along the axis has at the depth z a disk of diameter (f / N) |z - F| / F.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from skysim.core.errors import InputError
from skysim.core.types import Floats, Sources
from skysim.scene.sections.layouts import ProjectorConfig
from skysim.scene.sections.leds import LedConfig
from skysim.sources.dome.display import (Patches, block_sources, visible_blocks)
from skysim.sources.dome.led import full_strength_e_s_sr
from skysim.sources.dome.surface import Surface
from skysim.sources.photometry import Band



NEWTON_STEPS = 12


def own_from_lab(config: ProjectorConfig) -> Rotation:
    """Rotation from the lab's axes to the projector's: x along its rows, y along its columns, z along its axis."""
    axis = np.array(config.aim_m) - config.position_m
    axis /= np.linalg.norm(axis)
    right = np.array([1.0, 0.0, 0.0]) - axis[0] * axis
    right = Rotation.from_rotvec(np.radians(config.rotation_deg) * axis).apply(
        right / np.linalg.norm(right)
    )
    return Rotation.from_matrix(np.array([right, np.cross(axis, right), axis]))


def on_chip_m(config: ProjectorConfig, own: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """(N, 2) places on the chip of directions (N, 3) in the projector's axes, and whether they are on its pixels."""
    in_front = own[:, 2] > 0
    tangent = own[:, :2] / np.where(in_front, own[:, 2], np.nan)[:, None]
    tangent2 = np.sum(tangent**2, axis=1, keepdims=True)
    chip_m = config.focal_length_m * tangent * (1 + config.distortion * tangent2)
    half_m = np.array(config.pixels) * config.pitch_m / 2
    unfolded = 1 + 3 * config.distortion * tangent2[:, 0] > 0
    return chip_m, np.asarray(in_front & unfolded & np.all(np.abs(chip_m) <= half_m, axis=1))


def rays(config: ProjectorConfig, chip_m: Floats) -> Floats:
    """(N, 3) unit rays in the lab of places (N, 2) on the chip; Newton's method inverts the distortion."""
    radius = np.linalg.norm(chip_m, axis=1) / config.focal_length_m
    tangent = radius
    for _ in range(NEWTON_STEPS if config.distortion else 0):
        excess = tangent * (1 + config.distortion * tangent**2) - radius
        tangent = tangent - excess / (1 + 3 * config.distortion * tangent**2)
    stretch = np.divide(tangent, radius, out=np.ones_like(radius), where=radius > 0)
    own = np.column_stack([chip_m / config.focal_length_m * stretch[:, None], np.ones(len(chip_m))])
    return np.asarray(
        own_from_lab(config).inv().apply(own / np.linalg.norm(own, axis=1, keepdims=True))
    )


def pixel_sr(config: ProjectorConfig, cos_axis: Floats) -> Floats:
    """(N,) solid angle of a pixel at these cosines from the axis."""
    tangent2 = 1 / cos_axis**2 - 1
    stretch = (1 + config.distortion * tangent2) * (1 + 3 * config.distortion * tangent2)
    return np.asarray((config.pitch_m / config.focal_length_m) ** 2 * cos_axis**3 / stretch)


def spot_radius_m(
    config: ProjectorConfig, surface: Surface, chip_m: Floats, place_m: Floats, normal: Floats
) -> Floats:
    """(N,) radius of a uniform disk with the mean square radius of each block's image on the wall.

    A parallelogram with the edges a, b has the mean square distance (a^2 + b^2) / 12 from its center, a disk r^2 / 2.
    The edges are traced. The defocus disk is projected along the ray onto the wall: v to v - (n . v) / (n . u) u.
    """
    position_m = np.array(config.position_m)
    R_own_from_lab = own_from_lab(config).as_matrix()
    ray = rays(config, chip_m)
    square_m2 = np.zeros(len(chip_m))
    half_m = config.block * config.pitch_m / 2
    for axis in np.eye(2):
        ends = [rays(config, chip_m + side * half_m * axis) for side in (1, -1)]
        first_m, last_m = (surface.exit_m(position_m, end)[:, None] * end for end in ends)
        square_m2 += np.sum((first_m - last_m) ** 2, axis=1) / 6
    depth_m = (place_m - position_m) @ R_own_from_lab[2]
    focus_m = config.focus_m or float(np.linalg.norm(np.array(config.aim_m) - position_m))
    blur_m = config.focal_length_m / config.f_number / 2 * np.abs(depth_m / focus_m - 1)
    for axis in R_own_from_lab[:2]:
        on_wall = axis - (normal @ axis / np.sum(normal * ray, axis=1))[:, None] * ray
        square_m2 += blur_m**2 / 2 * np.sum(on_wall**2, axis=1)
    return np.asarray(np.sqrt(square_m2))


def projector_sources(
    config: ProjectorConfig, surface: Surface, led: LedConfig, band: Band, stars: Sources
) -> Sources:
    """Stars drawn on the nearest blocks of pixels, as disks on the wall where the projector's rays meet it.

    stars : as LEDs that are always lit, on the surface. Numbers are theirs; the picture is drawn for the lens's
        distortion, so that a star is off by the rounding to pixels alone
    Raises InputError for a projector outside the dome, for stars outside its picture or nearer to black than to the
    first gray level, and for a pixel that passes below the rim.
    """
    position_m = np.array(config.position_m)
    if not surface.inside(position_m):
        raise InputError(
            "light.layout.position", f"{config.position_m} m is outside of the dome", "inside"
        )
    chip_m, shown = on_chip_m(config, own_from_lab(config).apply(stars.place[:, :3] - position_m))
    if not shown.all():
        raise InputError(
            "light.layout.points",
            f"{np.sum(~shown)} of {len(shown)} stars are outside of the projector's picture",
            "a smaller cap_deg, a shorter focal_length, or another position",
        )
    blocks = visible_blocks(config, chip_m, stars.strength / full_strength_e_s_sr(led, band))
    drawn_m = blocks.center_px * config.pitch_m
    ray = rays(config, drawn_m)
    place_m = surface.meet(position_m, ray)
    if np.isnan(place_m).any():
        raise InputError(
            "light.layout.points", "a star's pixel is below the dome's rim", "a smaller cap_deg"
        )
    normal = surface.inward(place_m)
    lens_disk_m = spot_radius_m(config, surface, drawn_m, place_m, normal)
    cos_axis = ray @ own_from_lab(config).as_matrix()[2]
    patches = Patches(
        place_m, normal, np.hypot(lens_disk_m, led.disk_diameter_m / 2), cos_axis**config.falloff
    )
    return block_sources(config, led, band, stars, blocks, patches, 0.0)


def white_wall_per_m2(config: ProjectorConfig, place_m: Floats, normal: Floats) -> Floats:
    """(N,) light of white pixels per area of the wall at places (N, 3), over that of one pixel on the axis, 1/m^2.

    E = I cos(i) / D^2 in units of a pixel's: cos^n(theta) over the area w D^2 / cos(i) that it lights; 0 outside of the
    picture, and for NaN.
    """
    sight_m = place_m - np.array(config.position_m)
    own = own_from_lab(config).apply(sight_m)
    _, shown = on_chip_m(config, own)
    distance_m = np.linalg.norm(sight_m, axis=1)
    cos_axis = np.where(shown, own[:, 2] / distance_m, 1.0)
    cos_incidence = -np.sum(normal * sight_m, axis=1) / distance_m
    area_m2 = pixel_sr(config, cos_axis) * distance_m**2 / np.maximum(cos_incidence, 0)
    return np.where(shown & (cos_incidence > 0), cos_axis**config.falloff / area_m2, 0.0)


