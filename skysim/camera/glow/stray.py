"""Ghosts: light that two surfaces of a lens reflect, so that it reaches the chip a second time.

To first order the reflected light has a focal length of its own: a pair of surfaces images the field again, m times as
large, through the same axis, and out of focus. A light at x on the chip has its ghost at

    c - m (x - c),

with c the principal point; m > 0 puts it on the other side. A ghost takes part in everything else as its light does:
motion, pulses, shutter, vignetting.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, special
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from skysim.camera.glow.background import node_directions, unproject, viewing_geometry
from skysim.camera.optics import Optics, ScaledOptics
from skysim.core.types import Floats, Sources, SourceTruth
from skysim.scene.sections.camera import DiskPsfConfig, GhostConfig, GlareConfig
from skysim.sources.dome.interreflection import DiffuseLight, ReflectingDome
from skysim.sources.dome.mirror import mirrored
from skysim.sources.photometry import Band
from skysim.sources.satellites import GHOST

BLUR_PX = 0.7  # of a ghost's edge


@lru_cache(maxsize=64)
def ghost_optics(optics: Optics, ghost: GhostConfig) -> ScaledOptics:
    """The lens by the pair of surfaces of a ghost: its light is a share of the image's, spread over a disk.

    Its field is that of all lights whose ghosts reach the chip.
    """
    blur = DiskPsfConfig(kind="disk", radius_px=ghost.radius_px, sigma_px=BLUR_PX)
    camera = optics.camera.model_copy(update={"psf": blur})
    reach = (1 + ghost.radius_px / camera.corner_px) / abs(ghost.magnification)
    field_rad = math.atan(math.tan(optics.field_rad) * reach)
    scale = -ghost.magnification * getattr(optics, "scale", 1.0)
    return ScaledOptics(
        camera, optics.collecting_m2 * ghost.share, optics.fold_r, field_rad, scale=scale
    )


def as_ghosts(lights: SourceTruth, number: int) -> SourceTruth:
    """The truth of the lights of a pair of surfaces, as that of its ghosts; pairs are numbered from 1."""
    return replace(lights, id=lights.id + number * GHOST)


# Veiling glare: light that rough or dirty surfaces of a lens scatter over the chip, by its glare-
# spread function.


BLOCKS = 8  # least number of blocks of pixels across the core: a light is shifted by less than a 16th of it


def add_glare(light_e: NDArray[Any], config: GlareConfig) -> None:
    """Spread a share of the light of an (H, W) frame, in place."""
    block = block_px(light_e.shape, config.core_px)
    height, width = (size // block for size in light_e.shape)
    coarse = light_e.reshape(height, block, width, block).mean(axis=(1, 3), dtype=float)
    spectrum = fft.dctn(coarse, type=2, norm="ortho") * transfer(config, (height, width), block)
    scattered = fft.idctn(spectrum, type=2, norm="ortho").astype(light_e.dtype)
    light_e *= 1 - config.share
    light_e += config.share * ndimage.zoom(
        scattered, block, order=1, mode="reflect", grid_mode=True
    )


def block_px(shape: tuple[int, ...], core_px: float) -> int:
    """The side of the square blocks in which the glare is computed: a divisor of the frame's sides."""
    common = math.gcd(*shape)
    return max(n for n in range(1, max(int(core_px / BLOCKS), 1) + 1) if common % n == 0)


@lru_cache(maxsize=4)
def transfer(config: GlareConfig, shape: tuple[int, int], block: int) -> Floats:
    """(h, w) the transform of the glare at the frequencies of the cosine transform of blocks."""
    order = config.exponent / 2 - 1
    rows, columns = (np.pi * np.arange(size) / (size * block) for size in shape)
    scaled = config.core_px * np.hypot(rows[:, None], columns)
    scaled[0, 0] = 1.0  # the limit is 1
    values = 2 ** (1 - order) / special.gamma(order) * scaled**order * special.kv(order, scaled)
    values[0, 0] = 1.0
    return np.asarray(values)


def without_glare(sources: SourceTruth, config: GlareConfig) -> SourceTruth:
    """The truth of images from which a share of the light was scattered away."""
    return replace(
        sources,
        electrons=(1 - config.share) * sources.electrons,
        peak_e=(1 - config.share) * sources.peak_e,
    )


# What a camera sees of the light that a dome reflects: the glow of wall and floor, and images of
# LEDs in the wall.


IRRADIANCE = 16, 21  # places over the chip's rows and columns at which the wall's light is computed
GRID = (
    28,
    36,
)  # directions over the chip's rows and columns from which images in the wall are searched
MARGIN = 0.15  # of the chip's size, beyond its edges, for images of LEDs that reach in


def wall_glow(
    dome: ReflectingDome, optics: Optics, cam_from_lab: Rotation, camera_m: Floats, band: Band
) -> Floats:
    """(h, w) electrons s^-1 px^-1 at the nodes of `background.glow_map`: the radiance rho E / pi times the etendue.

    Nothing is in front of wall and floor. The rim is smoothed over the distance of two nodes, and beyond wall and floor
    it is dark. The light of the wall is interpolated between fewer points (`IRRADIANCE`), as it varies slowly.

    Parameters
    ----------
    camera_m
        (3,) the entrance pupil in the lab; outside of the wall it sees nothing
    """
    toward, pixel_sr, shape = node_directions(optics)
    view = viewing_geometry(toward, pixel_sr, optics, cam_from_lab, band)
    if dome.diffuse is None or not dome.wall.inside(camera_m):
        return np.zeros(shape)
    few = chip_grid(optics, IRRADIANCE, 0.0) @ cam_from_lab.as_matrix()
    seen = np.isfinite(dome.wall.meet(camera_m, view.toward_lab)[:, 0])
    wall_m = camera_m + dome.wall.exit_m(camera_m, few.reshape(-1, 3))[:, None] * few.reshape(-1, 3)
    radiance = (
        seen * dome.config.diffuse * spread(dome.diffuse, wall_m, dome.wall.inward(wall_m), shape)
    )
    if dome.config.floor:
        up = np.array([0.0, 0.0, 1.0])
        depth_m = camera_m[2] + dome.config.floor.depth_m
        floor_m = camera_m + meeting(few.reshape(-1, 3), depth_m)
        axis_m = np.linalg.norm((camera_m + meeting(view.toward_lab, depth_m))[:, :2], axis=1)
        on_floor = ~seen & (axis_m < dome.config.floor.radius_m)
        radiance += (
            on_floor
            * dome.config.floor.share
            * spread(dome.diffuse, floor_m, np.tile(up, (len(floor_m), 1)), shape)
        )
    return np.asarray(radiance / np.pi * view.etendue_m2_sr()).reshape(shape)


def meeting(toward: Floats, depth_m: float) -> Floats:
    """(N, 3) offsets to a level plane this far below along unit vectors; NaN for those that do not point down."""
    return toward * (depth_m / np.where(toward[:, 2] < 0, -toward[:, 2], np.nan))[:, None]


def spread(
    diffuse: DiffuseLight, points_m: Floats, normals: Floats, shape: tuple[int, int]
) -> Floats:
    """(h * w,) irradiance at the nodes, linear between points at `IRRADIANCE` evenly spread places of the chip."""
    values = np.nan_to_num(diffuse.irradiance_e_s_m2(points_m, normals)).reshape(IRRADIANCE)
    places = (np.linspace(0, 1, count) for count in IRRADIANCE)
    nodes = (np.linspace(0, 1, count) for count in shape)
    return np.asarray(RectBivariateSpline(*places, values, kx=1, ky=1)(*nodes)).ravel()


def images_in_wall(
    dome: ReflectingDome, leds: Sources, optics: Optics, cam_from_lab: Rotation, camera_m: Floats
) -> Sources:
    """The images of the LEDs in the wall that are in the field, for a camera at rest there.

    They keep their virtual places while the camera moves during the exposure, which is exact for a flat wall.
    """
    grid = chip_grid(optics, GRID, MARGIN) @ cam_from_lab.as_matrix()
    return mirrored(dome.config, dome.wall, leds, camera_m, grid)


@lru_cache(maxsize=8)
def chip_grid(optics: Optics, shape: tuple[int, int], margin: float) -> Floats:
    """(h, w, 3) unit vectors in camera axes, evenly spread over the chip and a margin, a fraction of its size."""
    camera = optics.camera
    rows, columns = (
        np.linspace(-margin * size, (1 + margin) * size, count) - 0.5
        for size, count in zip((camera.height_px, camera.width_px), shape, strict=True)
    )
    x, y = np.meshgrid(columns, rows)
    return unproject(np.column_stack([x.ravel(), y.ravel()]), optics).reshape(*shape, 3)
