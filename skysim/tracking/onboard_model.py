"""The tracker's models of its camera, lever arm and dome: the true values with calibration and survey errors."""

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
    """The dome map that the tracker uses: the true LED positions and surface with the errors of the survey."""
    inside, told = surface.build_surface(light.surface), scene.tracker.survey
    place_m = survey_errors.believed_leds_m(inside, sources.place[:, :3], told)
    board = layout.board_of(light.layout, sources.id)
    ellipsoid = survey_errors.believed_ellipsoid(inside, told)
    return LedMap(sources.id, place_m, *ellipsoid, board, told.led_sigma_m)


def believed_lever(scene: Scene, mount: Mount) -> Lever:
    """The camera's lever arm that the tracker assumes: `believed_camera_body_m`, else the true one with survey error.

    The camera's attitude on the vehicle is known exactly.
    """
    told = scene.tracker.survey
    arm_m = scene.tracker.believed_camera_body_m or survey_errors.believed_m(
        mount.camera_body_m, told.lever_sigma_m, told.seed, "lever"
    )
    return Lever(np.array(arm_m), mount.cam_from_body, told.lever_sigma_m)


def surveyed_dome(scene: Scene, path: str, leds: LedMap, lever: Lever) -> tuple[Camera, LedMap, Lever]:
    """Camera, LEDs and lever arm from a survey's file; surface and boards stay those of the given LedMap.

    One sigma serves for all LEDs, the median of the file's. Raises InputError for a file of another dome or camera.
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
    """The camera calibration that the tracker uses."""
    told, true = scene.tracker, calibration(scene.camera)
    if told.believed_distortion is not None:
        true = replace(true, distortion=told.believed_distortion)
    believed_m = told.believed_focal_length_m
    return true.zoomed(believed_m / scene.camera.focal_length_m if believed_m else 1.0)


def calibration(camera: CameraPart) -> Camera:
    """The exact calibration of a camera, as the estimator's Camera."""
    return Camera(camera.width_px, camera.height_px, camera.focal_px, camera.centre_px, camera.distortion)
