"""An external controller as a control law of the flight computer: in this process, or in one of its own."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from skysim.core.errors import InputError, printable
from skysim.core.plugins import (
    MAX_STATUS_CHARS,
    Program,
    ProgramError,
    describe_error,
    host_command,
)
from skysim.core.types import Floats
from skysim.dynamics.controllers.interface import (
    CONTROLLERS,
    ControllerInput,
    ControllerSetup,
    Factory,
    build_law,
    check_torque,
    torque_of_reply,
)
from skysim.dynamics.guidance import Reference
from skysim.scene.sections.motion import ControlConfig


class ControllerSource(NamedTuple):
    """Where external controllers come from, beside entry points.

    programs : commands by name, from the user's command line
    factory  : the controller given to `skysim.simulate`, in place of the one that the scene names
    """

    programs: Mapping[str, str] = {}
    factory: Factory | None = None

    def check_name(self, law: str) -> None:
        """Raise InputError for an unknown name of a law."""
        if self.factory is None:
            CONTROLLERS.check_name(law, self.programs)


NO_SOURCE = ControllerSource()


class ExternalLaw:
    """An external controller with the methods of `attitude_control.Pid`. Stateful: one motion each.

    answer : returns the checked torque for an input, or raises an exception
    program: the running program, None for a callable in this process
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
        self, t_s: float, lab_from_body_wxyz: Floats, rate_body_rad_s: Floats, momentum_nms: Floats
    ) -> Floats:
        """(3,) the commanded torque at t_s. Raises InputError that names the controller if it gives none."""
        lab_from_ref_wxyz, rate_ref, acceleration_ref = self.reference.state_at(t_s)
        inputs = ControllerInput(
            self.tick,
            t_s,
            scalar_last(lab_from_body_wxyz),
            rate_body_rad_s.copy(),
            scalar_last(lab_from_ref_wxyz),
            np.array(rate_ref),
            np.array(acceleration_ref),
            momentum_nms.copy(),
            self.achieved_nm,
        )
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
        """Keep the torque that the actuators gave: the controller gets it in its next input."""
        self.achieved_nm = self.commanded_nm - (commanded_nm - achieved_nm)

    def close(self) -> None:
        """End the program, if there is one."""
        if self.program:
            self.program.close()


def external_law(
    reference: Reference, setup: ControllerSetup, config: ControlConfig, source: ControllerSource
) -> ExternalLaw:
    """Start the controller that the scene names. Raises InputError if it is unknown or refuses the set-up."""
    name = config.law
    source.check_name(name)
    if source.factory is not None:
        try:
            law = build_law(source.factory, setup)
        except Exception as error:
            raise InputError(CONTROLLERS.key, f"{name}: {describe_error(error)}") from error
        return ExternalLaw(
            reference, name, lambda inputs: check_torque(law(inputs), setup.authority_nm)
        )
    environment = None
    if name in source.programs:
        arguments = shlex.split(source.programs[name])
    else:
        arguments, environment = host_command("skysim.dynamics.controllers.host", name)
    program = Program(
        CONTROLLERS.key, name, arguments, setup.as_tree(), config.time_limit_s, environment
    )

    def answer(inputs: ControllerInput) -> Floats:
        message = (json.dumps(inputs.as_tree()) + "\n").encode()
        return torque_of_reply(
            program.exchange([message], config.time_limit_s), inputs.tick, setup.authority_nm
        )

    return ExternalLaw(reference, name, answer, program)


def scalar_last(a_from_b_wxyz: Floats) -> Floats:
    """(4,) xyzw of a quaternion wxyz."""
    return a_from_b_wxyz[[1, 2, 3, 0]]
