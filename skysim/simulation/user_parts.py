"""A scene with parts that are given in Python: a controller, a star tracker, or an attitude profile."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.star_tracker import StarTracker
from skysim.core.errors import InputError
from skysim.core.yaml_reader import is_file
from skysim.dynamics.controllers import ControllerSource
from skysim.dynamics.controllers import Factory
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import PRESCRIBED, ControlConfig, MotionConfig, ProfileConfig
from skysim.tracking import factory
from skysim.tracking.external_tracker import FunctionTracker

GIVEN_TABLE = "(table)"  # in place of a profile's file


@dataclass(frozen=True, slots=True)
class UserParts:
    """What a user gives in place of the scene's own parts.

    programs   : commands of external trackers and controllers by name; only the user's command line sets them
    controller : makes the control law
    tracker    : of the main camera
    profile    : table of attitudes, in place of the file of the first maneuver of kind profile
    """

    programs: Mapping[str, str] = field(default_factory=dict)
    controller: Factory | None = None
    tracker: factory.Estimator | None = None
    profile: Any = None

    @property
    def controllers(self) -> ControllerSource:
        """Where external controllers come from, beside entry points."""
        return ControllerSource(self.programs, self.controller)


NO_PARTS = UserParts()


def with_parts(
    scene: Scene,
    programs: Mapping[str, str] = factory.NO_PROGRAMS,
    controller: Any = None,
    tracker: Any = None,
    profile: Any = None,
) -> tuple[Scene, UserParts]:
    """The scene that names these parts in place of its own, and the parts; see `results.simulate.simulate`.

    Raises InputError for a part of another type.
    """
    motion = scene.motion
    law = None
    estimator = None
    if controller is not None:
        motion, law = with_controller(motion, controller)
    if profile is not None:
        motion = with_profile(motion, profile)
    scene = scene.model_copy(update={"motion": motion})
    if tracker is not None:
        scene, estimator = with_tracker(scene, tracker)
    table = None if isinstance(profile, str | Path) else profile
    return scene, UserParts(programs, law, estimator, table)


def with_controller(motion: MotionConfig, controller: Any) -> tuple[MotionConfig, Any]:
    """The motion with a controller, and the factory of one that is not given by name."""
    config = motion.control or ControlConfig()
    if not (isinstance(controller, str) or callable(controller)):
        raise InputError(
            "controller", type(controller).__name__, "a name, or a callable that takes a set-up"
        )
    law = controller if isinstance(controller, str) else name_of(controller)
    changed = motion.model_copy(update={"control": config.model_copy(update={"law": law})})
    return changed, None if isinstance(controller, str) else controller


def with_profile(motion: MotionConfig, profile: Any) -> MotionConfig:
    """The motion along a profile only, from its own start; prescribed if there is no controller."""
    if isinstance(profile, str | Path) and not is_file(Path(profile)):
        raise InputError("profile", f"{profile} is not a file", "a file, or a table")
    file = str(profile) if isinstance(profile, str | Path) else GIVEN_TABLE
    element = ProfileConfig.model_construct(kind="profile", file=file)
    return motion.model_copy(
        update={
            "start": "profile",
            "rate_deg_s": (0.0, 0.0, 0.0),
            "maneuver": (element,),
            "control": motion.control or ControlConfig(law=PRESCRIBED),
        }
    )


def with_tracker(scene: Scene, tracker: Any) -> tuple[Scene, factory.Estimator | None]:
    """The scene with a tracker, and the tracker if it is not given by name."""
    estimator: factory.Estimator | None = None
    if isinstance(tracker, StarTracker | DomeTracker):
        estimator = tracker
    elif callable(tracker) and not isinstance(tracker, type):
        estimator = FunctionTracker(name_of(tracker), tracker)
    elif not isinstance(tracker, str):
        what = (
            f"the class {tracker.__name__}" if isinstance(tracker, type) else type(tracker).__name__
        )
        raise InputError(
            "tracker", what, "a name, a function of an image, a StarTracker or a DomeTracker"
        )
    name = tracker if isinstance(tracker, str) else name_of(tracker)
    config = scene.tracker.model_copy(update={"name": name})
    return scene.model_copy(update={"tracker": config}), estimator


def name_of(part: Any) -> str:
    """Name of a function or class, or of an object's class, for messages and reports."""
    return re.sub(r"\W", "", getattr(part, "__name__", type(part).__name__)) or "function"
