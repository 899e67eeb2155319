"""What the tracker believes of its camera, its lever arm and the dome."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from estimator.attitude.dome_map import LedMap, Lever
from estimator.core.camera import Camera
from skysim.core.errors import InputError
from skysim.core.types import Mount, Sources
from skysim.scene.camera import CameraConfig as CameraPart
from skysim.scene.light import DomeConfig
from skysim.scene.scene import Scene
from skysim.sources.dome import layout, surface, survey_errors
from skysim.tracking import dome_map_file


def believed_dome(scene: Scene, light: DomeConfig, sources: Sources) -> LedMap:
    """The dome on the tracker's map: the true one, and the errors of its survey."""
    inside, told = surface.build_surface(light.surface), scene.tracker.survey
    place_m = survey_errors.believed_leds_m(inside, sources.place[:, :3], told)
    board = layout.board_of(light.layout, sources.id)
    ellipsoid = survey_errors.believed_ellipsoid(inside, told)
    return LedMap(sources.id, place_m, *ellipsoid, board, told.led_sigma_m)


def believed_lever(scene: Scene, mount: Mount) -> Lever:
    """The camera's place on the vehicle as it was told, else as it was surveyed; its attitude is known."""
    told = scene.tracker.survey
    arm_m = scene.tracker.believed_camera_body_m or survey_errors.believed_m(
        mount.camera_body_m, told.lever_sigma_m, told.seed, "lever"
    )
    return Lever(np.array(arm_m), mount.cam_from_body, told.lever_sigma_m)


def surveyed_dome(scene: Scene, path: str, leds: LedMap, lever: Lever) -> tuple[Camera, LedMap, Lever]:
    """Camera, LEDs and lever from the file of a survey; surface and boards as they are believed without it.

    One sigma stands for all LEDs, the median of the file's. Raises BadInput for a file that is of another dome.
    """
    told = dome_map_file.read_dome_map(Path(path))
    size_px = (scene.camera.width_px, scene.camera.height_px)
    if told.size_px != size_px:
        raise InputError(
            f"tracker.map: {path}: is of a camera of {told.size_px} px; allowed: this one's, {size_px} px"
        )
    order = np.argsort(leds.id)
    row = order[np.minimum(np.searchsorted(leds.id, told.id, sorter=order), len(order) - 1)]
    strange = told.id[leds.id[row] != told.id]
    if len(strange):
        raise InputError(f"tracker.map: {path}: LED {strange[0]} is none of this dome's {len(order)}")
    board = None if leds.board is None else leds.board[row]
    placed = replace(
        leds, id=told.id, position_m=told.position_m, board=board, sigma_m=float(np.median(told.sigma_m))
    )
    camera = replace(
        calibration(scene.camera),
        focal_px=told.focal_px,
        centre_px=told.centre_px,
        distortion=told.distortion,
    )
    return camera, placed, Lever(told.camera_body_m, lever.cam_from_body, told.lever_sigma_m)


def believed_camera(scene: Scene) -> Camera:
    """The calibration in the tracker's head."""
    told, true = scene.tracker, calibration(scene.camera)
    if told.believed_distortion is not None:
        true = replace(true, distortion=told.believed_distortion)
    believed_m = told.believed_focal_length_m
    return true.zoomed(believed_m / scene.camera.focal_length_m if believed_m else 1.0)


def calibration(camera: CameraPart) -> Camera:
    """A perfect calibration of a camera, in the tracker's own terms."""
    return Camera(camera.width_px, camera.height_px, camera.focal_px, camera.centre_px, camera.distortion)
