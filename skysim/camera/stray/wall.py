"""What a camera sees of the light that a dome reflects: the glow of wall and floor, and images of LEDs in the wall."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from skysim.camera.glow.background import node_directions, unproject, viewing_geometry
from skysim.camera.optics import Optics
from skysim.core.types import Floats, Sources
from skysim.sources.dome.reflection.dome import ReflectingDome
from skysim.sources.dome.reflection.interreflection import DiffuseLight
from skysim.sources.dome.reflection.mirror import mirrored
from skysim.sources.photometry import Band

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

    camera_m : (3,) the entrance pupil in the lab; outside of the wall it sees nothing
    Nothing is in front of wall and floor. The rim is smoothed over the distance of two nodes, and beyond wall and floor
    it is dark. The light of the wall is interpolated between fewer points (`IRRADIANCE`), as it varies slowly.
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
