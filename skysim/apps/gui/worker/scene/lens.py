"""Where a frame's pixels point, for the browser."""

from __future__ import annotations

import numpy as np

from estimator.core.camera import Camera
from estimator.core.types import Attitude
from skysim.apps.gui.messages import Lens, Pose
from skysim.core.types import Floats, Truth
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.lab import Lab
from skysim.sources.dome.shell import surface
from skysim.tracking.onboard_model import calibration

NODES = 13  # along each side of a frame, of the tables between which the browser interpolates


def lens_of(camera: Camera) -> Lens:
    """Tables of the tangents x / z and y / z of a camera's pixels, from the frame's upper left to its lower right
    corner."""
    x = np.linspace(-0.5, camera.width_px - 0.5, NODES)
    y = np.linspace(-0.5, camera.height_px - 0.5, NODES)
    tangents = camera.tangents(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    return Lens(NODES, *(tuple(column.tolist()) for column in tangents.T))


def scene_lens(lab: Lab) -> Lens:
    """The tables of a scene's true camera."""
    return lens_of(calibration(lab.scene.camera))


def scene_pose(lab: Lab, lens: Lens, truth: Truth) -> Pose:
    """The true attitude of a frame's camera; under a dome also where its rays meet the surface."""
    lab_from_cam = truth.cam_from_lab.inv()
    rotation = tuple(lab_from_cam.as_matrix().ravel().tolist())
    if not isinstance(lab.scene.light, DomeConfig):
        return Pose(rotation)
    place_m = truth.lab_from_body.apply(lab.camera.mount.camera_body_m)
    rays_cam = np.column_stack([lens.x, lens.y, np.ones(len(lens.x))])
    length = np.linalg.norm(rays_cam, axis=1)
    dome = surface.build_surface(lab.scene.light.surface)
    points_m = dome.meet(place_m, lab_from_cam.apply(rays_cam / length[:, None]))
    depth_m = (
        np.linalg.norm(points_m - place_m, axis=1) / length
    )  # along the boresight; NaN where a ray meets nothing
    return Pose(rotation, tuple(place_m.tolist()), tuple(rounded(depth_m)))


def rounded(depth_m: Floats) -> list[float | None]:
    """Depths to 0.01 mm; None for a ray that meets nothing."""
    return [None if np.isnan(value) else round(float(value), 5) for value in depth_m]


def solved_pose(attitude: Attitude) -> Pose | None:
    """The tracker's attitude of an image from elsewhere; None if it was not solved."""
    if attitude.cam_from_ref is None:
        return None
    return Pose(tuple(attitude.cam_from_ref.inv().as_matrix().ravel().tolist()))
