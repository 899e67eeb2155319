"""Adapters for external star trackers: a program in its own process, or a Python function in this one.

They get the same set-up and frames as skysim's own tracker, and their answers become the same reports. Every failure of
an external tracker becomes the status of a frame.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.core.camera import Camera
from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Report, Settings
from skysim.core import errors
from skysim.core.errors import InputError
from skysim.core.plugins import ProgramError, describe_error, host_command
from skysim.core.types import Frame
from skysim.scene import scene as scenes
from skysim.scene.sections.tracker import OWN
from skysim.tracking import tracker_interface
from skysim.tracking.tracker_interface import (
    FAILED,
    SOLVED,
    TRACKERS,
    Answer,
    Leds,
    Picture,
    Setup,
    Stars,
    check_answer,
)


class FrameTracker:
    """A tracker that solves frames only: each must reach it once, in order.

    Attributes
    ----------
    name
        Name for messages and reports
    """

    name: str

    def solve_centroids(self, centroids: Centroids) -> Attitude:
        """Raise InputError: the tracker takes an image, not centroids."""
        raise InputError("tracker.name", f"{self.name} solves frames, not centroids", OWN)


class ExternalTracker(FrameTracker):
    """A tracker in its own process."""

    def __init__(self, program: tracker_interface.TrackerProgram) -> None:
        self.program = program
        self.name = program.name

    @classmethod
    def start(
        cls,
        scene: scenes.Scene,
        camera: Camera,
        settings: Settings,
        lights: Stars | Leds,
        commands: Mapping[str, str],
    ) -> ExternalTracker:
        """Start the tracker that the scene names. Raises InputError if it is unknown or refuses the set-up."""
        name = scene.tracker.name
        TRACKERS.check_name(name, commands)
        setup = build_setup(scene, camera, settings, lights)
        image_format = None
        environment = None
        if name in commands:
            arguments, image_format = tracker_interface.split_command(name, commands[name])
        else:
            arguments, environment = host_command("skysim.tracking.tracker_host", name)
        limit_s = scene.tracker.time_limit_s
        return cls(
            tracker_interface.TrackerProgram(
                name, arguments, image_format, setup, limit_s, environment
            )
        )

    def solve_frame(
        self, frame: Frame, streak_px: tuple[float, float] | None = None
    ) -> Report:
        """The tracker's report on a frame; streak_px is as in `Picture`."""
        picture = Picture(
            frame.image_dn, frame.index, frame.t_mid_s, frame.exposure_s, streak_px
        )
        try:
            return to_report(self.program.solve(picture))
        except ProgramError as error:
            return Report(Attitude(f"{FAILED}{error}"), Centroids.empty())


def build_setup(
    scene: scenes.Scene, camera: Camera, settings: Settings, lights: Stars | Leds
) -> Setup:
    """The set-up that is sent to the tracker: the hardware that skysim's own tracker would assume."""
    return Setup(
        "icrs" if scene.stars else "lab",
        scene.start_time.isoformat(),
        camera.width_px,
        camera.height_px,
        camera.focal_px,
        camera.center_px,
        camera.distortion,
        settings.gain_e_dn,
        settings.saturation,
        scene.seed,
        lights if isinstance(lights, Stars) else None,
        lights if isinstance(lights, Leds) else None,
        dict(scene.tracker.options),
    )


def to_report(answer: Answer) -> Report:
    """The report of a checked answer; it has no identifications, since external trackers do not return any."""
    xy_px = answer.centroids_px
    unmeasured = np.full(len(xy_px), np.nan)
    seconds = {} if answer.seconds is None else {"solve": answer.seconds}
    quaternion = answer.cam_from_ref_xyzw
    attitude = Attitude(
        answer.status,
        None if quaternion is None else Rotation.from_quat(quaternion),
        answer.covariance_rad2,
    )
    return Report(attitude, Centroids(xy_px, unmeasured, unmeasured), seconds)


# A Python function as a star tracker.

NO_ATTITUDE = "no attitude"  # status if the function returned None


class FunctionTracker(FrameTracker):
    """A tracker that is a function in this process.

    Attributes
    ----------
    name
        Name for messages and reports
    function
        Function from an image (H, W) to an Answer, to the attitude cam_from_ref as a Rotation or as a unit quaternion
        (4,) scalar last, or to None for no attitude
    """

    def __init__(self, name: str, function: Callable[[NDArray], Any]) -> None:
        self.name = name
        self.function = function

    def solve_frame(
        self, frame: Frame, streak_px: tuple[float, float] | None = None
    ) -> Report:
        """The tracker's report on a frame; the function gets a copy of the image."""
        begin_s = time.perf_counter()
        try:
            answer = check_answer(to_answer(self.function(np.array(frame.image_dn))))
        except Exception as error:
            errors.raise_wrapped(error)
            return Report(Attitude(f"{FAILED}{describe_error(error)}"), Centroids.empty())
        report = to_report(answer)
        report.seconds.setdefault("solve", time.perf_counter() - begin_s)
        return report


def to_answer(value: Any) -> Any:
    """The value that a function returned, as an Answer; `check_answer` refuses other values, which stay unchanged."""
    if value is None:
        return Answer(NO_ATTITUDE)
    if isinstance(value, Rotation):
        return Answer(SOLVED, value.as_quat())
    if isinstance(value, np.ndarray | list | tuple):
        return Answer(SOLVED, value)
    return value
