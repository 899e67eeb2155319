"""The interface for external attitude controllers: set-up, input, torque, and discovery by entry points.

A controller is made by a factory: any callable, such as a class, that takes a `ControllerSetup` and returns the law, a
callable that takes a `ControllerInput` every control period and returns the torque (3,) on the body, N m in body axes.
The scene's actuators then allocate the torque, as they do for skysim's own laws. A factory is given to
`skysim.simulate`, or named by an entry point of the group `skysim.controllers`; a program behind a pipe exchanges the
same values as JSON. docs/howto/controller.md has examples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from skysim.core.errors import printable
from skysim.core.plugins import MAX_STATUS_CHARS, Floats, PluginKind, finite_array, to_lists
from skysim.scene.sections.motion import BUILT_IN_LAWS, PRESCRIBED

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

CONTROLLERS = PluginKind(
    "law", "skysim.controllers", "motion.control.law", (*BUILT_IN_LAWS, PRESCRIBED)
)
PROTOCOL = 1  # version, the first key of the set-up
MAX_AUTHORITIES = (
    1000.0  # largest torque over the actuators' authority: larger ones are errors of unit or sign
)


@dataclass(frozen=True, slots=True)
class ControllerSetup:
    """What a controller gets before the first control period.

    period_s         : control period: time between two calls
    inertia_kg_m2    : (3, 3) about the bearing, in body axes
    authority_nm     : torque that the actuators can give in every direction; a larger one is limited by them
    rate_limit_rad_s : rate above which the gyros saturate, with a margin; None if the controller does not use them
    actuators, feedback, bandwidth_rad_s, damping, integral_rad_s, options : of the scene's `motion.control`
    seed             : for a controller that draws random numbers
    """

    period_s: float
    inertia_kg_m2: Floats
    authority_nm: float
    rate_limit_rad_s: float | None
    actuators: str
    feedback: str
    bandwidth_rad_s: float
    damping: float
    integral_rad_s: float
    seed: int
    options: Mapping[str, Any] = field(default_factory=dict)

    def as_tree(self) -> dict[str, Any]:
        """As a JSON object; arrays become lists."""
        tree: dict[str, Any] = to_lists(asdict(self))
        return {"skysim_controller": PROTOCOL, **tree}

    @classmethod
    def of_tree(cls, tree: Mapping[str, Any]) -> Self:
        """The inverse of `as_tree`."""
        values = {name: value for name, value in tree.items() if name != "skysim_controller"}
        return cls(**values | {"inertia_kg_m2": np.array(values["inertia_kg_m2"])})


@dataclass(frozen=True, slots=True)
class ControllerInput:
    """What a controller gets at the start of a control period. Quaternions are unit, scalar last: v_lab = q v q*.

    tick                     : number of the period, from 0;  t_s : seconds since the scene's start
    lab_from_body_xyzw       : (4,) measured attitude;  rate_body_rad_s : (3,) measured rate in body axes. The source
        of both is `motion.control.feedback`
    lab_from_ref_xyzw        : (4,) commanded attitude
    rate_ref_rad_s, acceleration_ref_rad_s2 : (3,) each, commanded, in the commanded attitude's own axes
    momentum_nms             : (3,) stored in wheels and CMGs, in body axes
    achieved_nm              : (3,) torque that the actuators gave for the last command; zeros at the first
    """

    tick: int
    t_s: float
    lab_from_body_xyzw: Floats
    rate_body_rad_s: Floats
    lab_from_ref_xyzw: Floats
    rate_ref_rad_s: Floats
    acceleration_ref_rad_s2: Floats
    momentum_nms: Floats
    achieved_nm: Floats

    @property
    def lab_from_body(self) -> Rotation:
        """The measured attitude."""
        return _rotation(self.lab_from_body_xyzw)

    @property
    def lab_from_ref(self) -> Rotation:
        """The commanded attitude."""
        return _rotation(self.lab_from_ref_xyzw)

    def as_tree(self) -> dict[str, Any]:
        """As a JSON object; arrays become lists."""
        return {item.name: to_lists(getattr(self, item.name)) for item in fields(self)}

    @classmethod
    def of_tree(cls, tree: Mapping[str, Any]) -> Self:
        """The inverse of `as_tree`."""
        values: dict[str, Any] = {
            name: np.array(value) if isinstance(value, list) else value
            for name, value in tree.items()
        }
        return cls(**values)


Law = Callable[[ControllerInput], Any]
Factory = Callable[[ControllerSetup], Law]


def build_law(factory: Any, setup: ControllerSetup) -> Law:
    """The law that a factory makes of a set-up. Raises TypeError if it is not callable."""
    law = factory(setup)
    if not callable(law):
        raise TypeError(
            f"it returned {type(law).__name__} for the set-up; allowed: a callable that takes a ControllerInput"
        )
    return law


def check_torque(torque_nm: Any, authority_nm: float) -> Floats:
    """(3,) torque, finite and at most MAX_AUTHORITIES times the authority. Raises ValueError."""
    torque = finite_array(torque_nm, "torque_nm", (3,))
    if np.linalg.norm(torque) > MAX_AUTHORITIES * authority_nm:
        raise ValueError(
            f"torque_nm is {np.linalg.norm(torque):.3g} N m; allowed: up to {MAX_AUTHORITIES:g} times the actuators'"
            f" {authority_nm:.3g} N m"
        )
    return torque


def torque_of_reply(reply: Any, tick: int, authority_nm: float) -> Floats:
    """The torque in a program's answer to a tick, a parsed JSON value. Raises ValueError."""
    if not isinstance(reply, dict) or reply.get("tick") != tick:
        raise ValueError(f"no answer to tick {tick}, but {printable(reply)[:80]!r}")
    if "status" in reply:
        raise ValueError(printable(reply["status"])[:MAX_STATUS_CHARS] or "a status without a text")
    unknown = [printable(name) for name in reply if name not in ("tick", "torque_nm")]
    if unknown:
        raise ValueError(f"unknown key {unknown[0][:80]!r}; allowed: tick, torque_nm, status")
    return check_torque(reply.get("torque_nm"), authority_nm)


def _rotation(a_from_b_xyzw: Floats) -> Rotation:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(a_from_b_xyzw)
