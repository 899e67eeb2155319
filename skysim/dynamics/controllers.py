"""External attitude controllers: their interface, and the control law that calls one.

A factory makes the controller: any callable, such as a class, that takes a `ControllerSetup` and returns the law. The
law is a callable that takes a `ControllerInput` every control period and returns the torque on the body, (3,) in N m
in body axes. The scene's actuators then allocate the torque, as they do for skysim's own laws.

A factory is given to `skysim.simulate` and runs in this process, or an entry point of the group `skysim.controllers`
names it and it runs in a process of its own. A program behind a pipe exchanges the same values as JSON.
docs/howto/controller.md has examples.
"""

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import asdict, field
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError, printable
from skysim.core.plugins import (
    MAX_STATUS_CHARS,
    PluginKind,
    Program,
    ProgramError,
    Programs,
    describe_error,
    finite_array,
    host_command,
    to_lists,
)
from skysim.core.types import Floats, Record, frozen
from skysim.dynamics.guidance import Reference
from skysim.scene.sections.motion import BUILT_IN_LAWS, PRESCRIBED, ControlConfig

# The interface.

CONTROLLERS = PluginKind(
    "law", "skysim.controllers", "motion.control.law", (*BUILT_IN_LAWS, PRESCRIBED)
)
PROTOCOL = 1  # version of the protocol, the first key of the set-up
# Largest torque over the actuators' authority; a larger torque is an error of unit or sign.
MAX_AUTHORITIES = 1000.0


@frozen
class ControllerSetup:
    """The data that a controller gets before the first control period.

    Attributes
    ----------
    period_s
        Control period: time between two calls
    inertia_kg_m2
        (3, 3) inertia about the bearing, in body axes
    authority_nm
        Torque that the actuators can give in every direction; they limit a larger one
    rate_limit_rad_s
        Rate above which the gyros saturate, with a margin; None if they are not used
    actuators, feedback, bandwidth_rad_s, damping, integral_rad_s, options
        Values of these keys in the scene's `motion.control`
    seed
        The scene's seed, for a controller that draws random numbers
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

    def as_tree(self) -> Record:
        """The set-up as a JSON object; arrays become lists."""
        return {"skysim_controller": PROTOCOL, **to_lists(asdict(self))}

    @classmethod
    def of_tree(cls, tree: Mapping[str, Any]) -> Self:
        """The inverse of `as_tree`."""
        values = {**tree, "inertia_kg_m2": np.array(tree["inertia_kg_m2"])}
        values.pop("skysim_controller", None)
        return cls(**values)


@frozen
class ControllerInput:
    """The data that a controller gets at the start of a control period.

    Quaternions are unit quaternions, scalar last: v_lab = q v q*.

    Attributes
    ----------
    tick
        Number of the period, from 0
    t_s
        Seconds since the scene's start
    lab_from_body_xyzw
        (4,) measured attitude, from the source that `motion.control.feedback` names
    rate_body_rad_s
        (3,) measured rate in body axes, from the same source
    lab_from_ref_xyzw
        (4,) commanded attitude
    rate_ref_rad_s, acceleration_ref_rad_s2
        (3,) commanded rate and acceleration, in the axes of the commanded attitude
    momentum_nms
        (3,) momentum stored in wheels and CMGs, in body axes
    achieved_nm
        (3,) torque that the actuators gave for the last command; zeros in the first period
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
        return Rotation.from_quat(self.lab_from_body_xyzw)

    @property
    def lab_from_ref(self) -> Rotation:
        """The commanded attitude."""
        return Rotation.from_quat(self.lab_from_ref_xyzw)

    def as_tree(self) -> Record:
        """The input as a JSON object; arrays become lists."""
        return to_lists(asdict(self))

    @classmethod
    def of_tree(cls, tree: Mapping[str, Any]) -> Self:
        """The inverse of `as_tree`."""
        values: Record = {
            name: np.array(value) if isinstance(value, list) else value
            for name, value in tree.items()
        }
        return cls(**values)


Law = Callable[[ControllerInput], Any]
Factory = Callable[[ControllerSetup], Law]


def build_law(factory: Any, setup: ControllerSetup) -> Law:
    """The law that a factory returns for a set-up. Raises TypeError if it is not callable."""
    law = factory(setup)
    if not callable(law):
        raise TypeError(
            f"it returned {type(law).__name__} for the set-up; allowed: a callable that takes a ControllerInput"
        )
    return law


def check_torque(torque_nm: Any, authority_nm: float) -> Floats:
    """(3,) torque. Raises ValueError unless it is finite and at most MAX_AUTHORITIES times the authority."""
    torque = finite_array(torque_nm, "torque_nm", (3,))
    if np.linalg.norm(torque) > MAX_AUTHORITIES * authority_nm:
        raise ValueError(
            f"torque_nm is {np.linalg.norm(torque):.3g} N m; allowed: up to {MAX_AUTHORITIES:g} times the actuators'"
            f" {authority_nm:.3g} N m"
        )
    return torque


def torque_of_reply(reply: Any, tick: int, authority_nm: float) -> Floats:
    """The torque (3,) in a program's reply to a tick, a parsed JSON value. Raises ValueError for any other reply."""
    if not isinstance(reply, dict) or reply.get("tick") != tick:
        raise ValueError(f"no answer to tick {tick}, but {printable(reply)[:80]!r}")
    if "status" in reply:
        raise ValueError(
            printable(reply["status"])[:MAX_STATUS_CHARS] or "a status without a text"
        )
    unknown = [printable(name) for name in reply if name not in ("tick", "torque_nm")]
    if unknown:
        raise ValueError(f"unknown key {unknown[0][:80]!r}; allowed: tick, torque_nm, status")
    return check_torque(reply.get("torque_nm"), authority_nm)


# The control law that calls an external controller.


class ExternalLaw:
    """An external controller with the methods of `attitude_control.Pid`. Stateful: one object per motion.

    Attributes
    ----------
    answer
        Function from an input to the checked torque (3,); raises an exception if there is none
    program
        Running program; None for a callable in this process
    """

    def __init__(
        self,
        reference: Reference,
        name: str,
        answer: Callable[[ControllerInput], Floats],
        program: Program | None = None,
    ) -> None:
        self.reference = reference
        self.name = name
        self.answer = answer
        self.program = program
        self.tick = 0
        self.commanded_nm = self.achieved_nm = np.zeros(3)

    def torque_nm(
        self,
        t_s: float,
        lab_from_body_wxyz: Floats,
        rate_body_rad_s: Floats,
        momentum_nms: Floats,
    ) -> Floats:
        """(3,) torque commanded at t_s. Raises InputError that names the controller if it gives none."""
        lab_from_ref_wxyz, rate_ref, acceleration_ref = self.reference.state_at(t_s)
        inputs = ControllerInput(
            self.tick,
            t_s,
            np.roll(lab_from_body_wxyz, -1),
            rate_body_rad_s.copy(),
            np.roll(lab_from_ref_wxyz, -1),
            np.array(rate_ref),
            np.array(acceleration_ref),
            momentum_nms.copy(),
            self.achieved_nm,
        )
        # Any failure of the user's code ends the run with the controller's name.
        try:
            self.commanded_nm = self.answer(inputs)
        except Exception as error:
            reason = (
                str(error)
                if isinstance(error, ProgramError | ValueError)
                else describe_error(error)
            )
            self.close()
            text = printable(reason)[:MAX_STATUS_CHARS]
            raise InputError(CONTROLLERS.key, f"{self.name}: {text}, at {t_s:g} s") from error
        self.tick += 1
        return self.commanded_nm

    def integrate(self, commanded_nm: Floats, achieved_nm: Floats, period_s: float) -> None:
        """Keep the torque that the actuators gave; the controller gets it in its next input."""
        # The difference between the two arguments is the actuators' deficit, with or without a momentum dump.
        self.achieved_nm = self.commanded_nm - (commanded_nm - achieved_nm)

    def close(self) -> None:
        """End the program, if there is one."""
        if self.program:
            self.program.close()


def external_law(
    reference: Reference,
    setup: ControllerSetup,
    config: ControlConfig,
    programs: Programs,
) -> ExternalLaw:
    """Start the controller that the scene names. Raises InputError if it is unknown or refuses the set-up.

    `programs` has the commands of programs, and factories given in Python, by name.
    """
    name = config.law
    CONTROLLERS.check_name(name, programs)
    given = programs.get(name)
    # A factory given in Python runs in this process.
    if callable(given):
        try:
            law = build_law(given, setup)
        except Exception as error:
            raise InputError(CONTROLLERS.key, f"{name}: {describe_error(error)}") from error
        return ExternalLaw(
            reference, name, lambda inputs: check_torque(law(inputs), setup.authority_nm)
        )
    # A program of the command line, or an entry point that a host process of skysim runs.
    environment = None
    if given is not None:
        arguments = shlex.split(given)
    else:
        arguments, environment = host_command("skysim.dynamics.controller_host", name)
    program = Program(
        CONTROLLERS.key, name, arguments, setup.as_tree(), config.time_limit_s, environment
    )

    def answer(inputs: ControllerInput) -> Floats:
        message = (json.dumps(inputs.as_tree()) + "\n").encode()
        return torque_of_reply(
            program.exchange([message], config.time_limit_s), inputs.tick, setup.authority_nm
        )

    return ExternalLaw(reference, name, answer, program)
