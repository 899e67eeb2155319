"""3-D geometry of the laboratory, as numbers for the browser to draw."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skysim.apps.gui.messages import LabGeometry
from skysim.core.types import Floats
from skysim.dynamics import multibody
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.testbed import Testbed
from skysim.sources.dome.shell import surface
from skysim.sources.dome.shell.surface import Surface

SKY_RADIUS_M = 2.5
MAX_STARS, MAX_LEDS = 600, 4000
RAY_M = 2.5  # drawn length of the field's edges that meet no surface
RINGS, SECTORS, DOTS = 4, 12, 144  # of the dotted lines on a dome


def lab_geometry(testbed: Testbed) -> LabGeometry:
    """Geometry of a testbed: vehicle, lights, camera and dome."""
    under_dome = isinstance(testbed.scene.light, DomeConfig)
    shapes = tuple(
        (shape.kind, shape.size_m, shape.position_m, shape.body_from_shape_wxyz, shape.rgba[:3])
        for shape in multibody.shapes(testbed.vehicle)
    )
    return LabGeometry(
        shapes,
        *lights(testbed, under_dome),
        testbed.mount.camera_body_m,
        corners_m(testbed),
        dome_points(testbed) if under_dome else np.empty((0, 3)),
    )


def lights(testbed: Testbed, under_dome: bool) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Ids, (N, 3) positions and (N,) drawn sizes of the brightest lights, the brightest first.

    The size grows with the time-averaged power to the power of 0.3, so that faint lights remain visible.
    """
    sources = testbed.sources
    power = sources.strength * np.minimum(sources.on_s / sources.period_s, 1.0)
    rows = np.argsort(-power)[: MAX_LEDS if under_dome else MAX_STARS]
    position = sources.place[rows, :3] * (1.0 if under_dome else SKY_RADIUS_M)
    brightest = max(float(power[rows[0]]), 1e-300) if len(rows) else 1.0
    return sources.id[rows], position, np.clip((power[rows] / brightest) ** 0.3, 0.15, 1.0)


def corners_m(testbed: Testbed) -> Floats:
    """(4, 3) points where the field's corners meet the dome with the vehicle level, else RAY_M away; body axes."""
    camera = testbed.scene.camera
    x, y = camera.width_px / 2 / camera.focal_px, camera.height_px / 2 / camera.focal_px
    rays_cam = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1.0]])
    rays = testbed.mount.cam_from_body.inv().apply(rays_cam / np.linalg.norm(rays_cam, axis=1)[:, None])
    far_points = testbed.mount.camera_body_m + RAY_M * rays
    if not isinstance(testbed.scene.light, DomeConfig):
        return far_points
    dome = surface.build_surface(testbed.scene.light.surface)
    points = dome.meet(testbed.mount.camera_body_m, rays)
    return np.where(np.isfinite(points), points, far_points)


def dome_points(testbed: Testbed) -> Floats:
    """(K, 3) points of circles of equal polar angle and of meridians on the dome's inside."""
    assert isinstance(testbed.scene.light, DomeConfig)
    dome = surface.build_surface(testbed.scene.light.surface)
    cap = np.radians(testbed.scene.light.layout.cap_deg)
    azimuths = np.linspace(0, 2 * np.pi, 49)
    lines = [points_on_dome(dome, np.full(49, cap * n / RINGS), azimuths) for n in range(1, RINGS + 1)]
    lines += [points_on_dome(dome, np.linspace(0, cap, 13), np.full(13, a)) for a in azimuths[: 48 : 48 // SECTORS]]
    return np.concatenate([np.empty((0, 3)), *(line for line in lines if len(line) > 1)])


def points_on_dome(dome: Surface, polar: Floats, azimuth: Floats) -> Floats:
    """(K, 3) points where rays from the bearing meet the dome; rays that miss it are omitted. Angles in rad."""
    rays = np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    points = dome.meet(np.zeros(3), rays)
    return points[np.isfinite(points).all(axis=1)]
