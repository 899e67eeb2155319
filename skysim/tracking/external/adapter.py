"""A star tracker of somebody else's in the place of our own: set up alike, asked alike, and scored by the same code."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.catalog.catalog import StarCatalog
from estimator.core.camera import Camera
from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Report, Settings
from skysim.core.errors import InputError
from skysim.core.types import Floats, Frame
from skysim.scene import scene as scenes
from skysim.scene.light import StarsConfig
from skysim.tracking.external import interface, process
from skysim.tracking.external.interface import FAILED, OWN, Answer, Leds, Picture, Setup, Stars


class ExternalTracker:
    """A tracker in a process of its own. Whatever goes wrong there is the status of a frame."""

    def __init__(self, program: process.Program) -> None:
        self.program = program

    @classmethod
    def of(
        cls,
        scene: scenes.Scene,
        camera: Camera,
        settings: Settings,
        lights: Stars | Leds,
        commands: Mapping[str, str],
    ) -> ExternalTracker:
        """The one that the scene names. Raises InputError where there is none, or where it will not work here."""
        told, name = scene.tracker, scene.tracker.name
        interface.known(name, commands)
        setup = set_up(scene, camera, settings, lights)
        if name in commands:
            parts, kind = process.words(name, commands[name])
            return cls(process.Program(name, parts, kind, setup, told.time_limit_s))
        host = [sys.executable, "-m", "skysim.tracking.external.host", name]
        # What this process can import, that one can: an entry point that was found here is found there.
        path = os.pathsep.join(part or os.getcwd() for part in sys.path)
        environment = {**os.environ, "PYTHONPATH": path}
        return cls(process.Program(name, host, None, setup, told.time_limit_s, environment))

    def look(self, frame: Frame, streak_px: tuple[float, float] | None = None) -> Report:
        """Its report on a frame."""
        picture = Picture(frame.image_dn, frame.index, frame.t_mid_s, frame.exposure_s, streak_px)
        try:
            return report(self.program.solve(picture))
        except process.Fault as fault:
            return Report(Attitude(f"{FAILED}{fault}"), Centroids.none())

    def solve_centroids(self, centroids: Centroids) -> Attitude:
        """Nothing that another tracker could be asked. Raises InputError."""
        raise InputError(f"tracker.name: {self.program.name} takes frames; allowed under centroids: {OWN}")


def set_up(scene: scenes.Scene, camera: Camera, settings: Settings, lights: Stars | Leds) -> Setup:
    """What it is told: what our own tracker believes."""
    return Setup(
        "icrs" if isinstance(scene.light, StarsConfig) else "lab",
        scene.start_time.isoformat(),
        camera.width_px,
        camera.height_px,
        camera.focal_px,
        camera.centre_px,
        camera.distortion,
        settings.gain_e_dn,
        settings.saturation,
        scene.seed,
        lights if isinstance(lights, Stars) else None,
        lights if isinstance(lights, Leds) else None,
        dict(scene.tracker.options),
    )


def stars(catalogue: StarCatalog, direction: Floats) -> Stars:
    """The on-board catalogue."""
    return Stars(catalogue.id, direction, catalogue.v_mag)


def leds(believed: LedMap, lever: Lever) -> Leds:
    """The dome's map, and where the camera sits."""
    return Leds(believed.id, believed.position_m, lever.camera_body_m, lever.cam_from_body.as_quat())


def report(answer: Answer) -> Report:
    """An answer, checked before, in our tracker's own terms. Which star is which it does not say."""
    xy_px = answer.centroids_px
    unknown = np.full(len(xy_px), np.nan)
    seconds = {} if answer.seconds is None else {"solve": answer.seconds}
    quaternion = answer.cam_from_ref_xyzw
    attitude = Attitude(
        answer.status,
        None if quaternion is None else Rotation.from_quat(quaternion),
        answer.covariance_rad2,
    )
    return Report(attitude, Centroids(xy_px, unknown, unknown), seconds)
