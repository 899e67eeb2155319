"""Adapters for external star trackers: a program in its own process, or a Python function in this one.

They get the same set-up and frames as skysim's own tracker, and their answers become the same reports. Every failure of
an external tracker becomes the status of a frame.
"""

import inspect
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Report
from skysim.core import errors
from skysim.core.errors import InputError
from skysim.core.plugins import ProgramError, describe_error, host_command
from skysim.core.types import Frame
from skysim.scene.scene import Scene
from skysim.scene.sections.tracker import OWN
from skysim.tracking.tracker_interface import (
    FAILED,
    TRACKERS,
    Answer,
    Picture,
    Setup,
    TrackerProgram,
    check_answer,
    split_command,
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


class ExternalTracker(FrameTracker, TrackerProgram):
    """A tracker in its own process."""

    @classmethod
    def of_scene(cls, scene: Scene, setup: Setup, commands: Mapping[str, str]) -> Self:
        """Start the tracker that the scene names. Raises InputError if it is unknown or refuses the set-up."""
        name = scene.tracker.name
        TRACKERS.check_name(name, commands)
        image_format = None
        environment = None
        if name in commands:
            arguments, image_format = split_command(name, commands[name])
        else:
            arguments, environment = host_command("skysim.tracking.tracker_host", name)
        limit_s = scene.tracker.time_limit_s
        return cls(name, arguments, image_format, setup, limit_s, environment)

    def solve_frame(
        self, frame: Frame, streak_px: tuple[float, float] | None = None
    ) -> Report:
        """The tracker's report on a frame; streak_px is as in `Picture`."""
        try:
            return to_report(self.solve(picture_of(frame, streak_px)))
        except ProgramError as error:
            return Report(Attitude(f"{FAILED}{error}"), Centroids.empty())


def picture_of(frame: Frame, streak_px: tuple[float, float] | None) -> Picture:
    """What a tracker gets of a frame."""
    return Picture(frame.image_dn, frame.index, frame.t_mid_s, frame.exposure_s, streak_px)


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


# A tracker of one's own in this process.


def takes_setup(given: Any) -> bool:
    """Whether a callable's first parameter is named `setup`: it makes a tracker from a set-up."""
    try:
        return next(iter(inspect.signature(given).parameters), "") == "setup"
    except (TypeError, ValueError):  # no callable, or one without a signature
        return False


class FunctionTracker(FrameTracker):
    """A tracker that is a Python object in this process.

    Attributes
    ----------
    name
        Name for messages and reports
    function
        Function from an image (H, W) to the attitude, as `tracker_interface.to_answer` takes it; or one whose first
        parameter is named `setup`, from a `Setup` to a tracker: a `tracker_interface.Tracker`, or the function that its
        method `solve` would be
    takes_picture
        Whether the function takes a `Picture`, with image, time, exposure and streak, as one does after its set-up
    """

    def __init__(
        self, name: str, function: Callable[..., Any], takes_picture: bool = False
    ) -> None:
        self.name = name
        self.function = function
        self.takes_setup = takes_setup(function)
        self.takes_picture = takes_picture

    def set_up(self, setup: Setup) -> "FunctionTracker":
        """The tracker after its set-up: a function of a `Picture`. Raises InputError if it makes none."""
        made = self.function(setup)
        solve = getattr(made, "solve", made)
        if not callable(solve):
            raise InputError(
                "tracker",
                f"{self.name} made {type(made).__name__} of its set-up",
                "an object with a method solve, or a function",
            )
        return FunctionTracker(self.name, solve, takes_picture=True)

    def solve_frame(
        self, frame: Frame, streak_px: tuple[float, float] | None = None
    ) -> Report:
        """The tracker's report on a frame; the function gets a copy of the image."""
        picture = replace(picture_of(frame, streak_px), image_dn=np.array(frame.image_dn))
        begin_s = time.perf_counter()
        try:
            given = picture if self.takes_picture else picture.image_dn
            answer = check_answer(self.function(given))
        except Exception as error:
            errors.raise_wrapped(error)
            return Report(Attitude(f"{FAILED}{describe_error(error)}"), Centroids.empty())
        report = to_report(answer)
        report.seconds.setdefault("solve", time.perf_counter() - begin_s)
        return report
