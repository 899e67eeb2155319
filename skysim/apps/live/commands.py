"""Commands of clients: one JSON object a line, checked, and held until they time out.

| key | value |
|---|---|
| `torque_nm` | (3,) torque in body axes, which the actuators of the scene's control law give |
| `wheels`, `cmgs`, `fans`, `thrusters`, `trims`, `ideal` | (n,) commands of the single motors, see `Flight.commands` |
| `attitude` | a solution of the client's tracker: t_s (of the frame), cam_from_ref_xyzw, covariance_rad2 (3, 3) |
| `exposure_s` | exposure time of the next frames |
| `triggered` | true: expose frames at triggers from now on; false: by the scene's schedule |
| `trigger` | true: expose a frame from now on, where frames are triggered |
| `abort` | true: forget the triggered exposures that have not ended |
"""

from __future__ import annotations

import json
import math
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude
from skysim.core.errors import InputError, check_name, refusing
from skysim.core.plugins import finite_array
from skysim.core.types import Floats, Record
from skysim.dynamics.flight_computer import Commands
from skysim.simulation.flight import Flight
from skysim.simulation.lab import longest_live_s

MOST_WAITING = 1000  # commands that wait for the next control period
MOST_TRIGGERS = 100  # triggered exposures that wait
LEAST_VARIANCE_RAD2 = 1e-18  # about each axis: the filter loses less than 0.0002" in rounding
MOST_VARIANCE_RAD2 = 1.0
ROUNDING = 1e-9  # relative difference of what is symmetric
QUATERNION_TOLERANCE = 1e-3  # of the length of a quaternion
# Of a command, beside the actuators of its scene.
KEYS = ("torque_nm", "attitude", "exposure_s", "triggered", "trigger", "abort")
SOLUTION_KEYS = ("t_s", "cam_from_ref_xyzw", "covariance_rad2")

Reply = Callable[[str], None]


def parse(line: bytes) -> Record:
    """The object in a line. Raises InputError for anything else."""
    with suppress(ValueError, RecursionError):
        found = json.loads(line)
        if isinstance(found, dict):
            return found
    raise InputError("", f"not an object of JSON: {line[:40]!r}", '{"torque_nm": [0, 0, 0]}')


class Inbox:
    """Commands that wait for the next control period, with the function that reports an error to their client."""

    def __init__(self) -> None:
        self.waiting: deque[tuple[Record, Reply]] = deque()

    def put(self, command: Record, reply: Reply) -> bool:
        """Add a command; refuse it where too many wait. Return whether it waits."""
        if len(self.waiting) >= MOST_WAITING:
            reply(f"more than {MOST_WAITING} commands in a control period")
            return False
        self.waiting.append((command, reply))
        return True

    def take(self) -> Iterator[tuple[Record, Reply]]:
        """All that waits; each command waits until its caller asks for the next."""
        for _ in range(len(self.waiting)):
            yield self.waiting[0]
            self.waiting.popleft()


@dataclass
class CommandState:
    """The commands in force, and what clients have asked for.

    Attributes
    ----------
    flight
        Flight that is commanded
    timeout_s
        Time of the simulator after which a command of actuators ends
    has_triggers
        Whether frames are exposed at triggers
    longest_exposure_s
        Longest exposure time that may be commanded
    held
        Values and time of each command of actuators, by its key
    received, refused, timeouts
        Numbers of commands that were taken and refused, and that have timed out
    updates
        Numbers of the filter's updates with clients' solutions, by their status
    """

    flight: Flight
    timeout_s: float
    has_triggers: bool
    longest_exposure_s: float = field(init=False)
    held: dict[str, tuple[Floats, float]] = field(default_factory=dict)
    received: int = 0
    refused: int = 0
    timeouts: int = 0
    updates: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.longest_exposure_s = longest_live_s(self.flight.lab.scene)
        self.set_triggered(self.has_triggers)

    def set_triggered(self, triggered: bool) -> None:
        """Expose frames at triggers, or by the scene's schedule."""
        schedule = self.flight.schedules[0]
        self.has_triggers = triggered
        if triggered and schedule.triggers_s is None:
            schedule.triggers_s = {}
        elif not triggered and schedule.triggers_s is not None:
            schedule.resume(self.flight.now_s)

    def receive(self, inbox: Inbox) -> None:
        """Take what has arrived; a refused command changes nothing, and its client gets the reason."""
        for command, reply in inbox.take():
            try:
                self.apply(command)
                self.received += 1
            except InputError as error:
                self.refused += 1
                reply(str(error))

    def apply(self, command: Record) -> None:
        """Check a command as a whole, then take it. Raises InputError."""
        flight = self.flight
        schedule = flight.schedules[0]
        for key in command:
            allowed = *KEYS, *flight.motion.flight_computer.actuator_sets
            check_name("", "key", key[:40], allowed)
        actuators = dict(command)
        exposure_s = actuators.pop("exposure_s", None)
        if exposure_s is not None:
            exposure_s = self.exposure_s(exposure_s)
        flags = {"triggered": self.has_triggers, "trigger": False, "abort": False}
        for key, default in flags.items():
            flags[key] = actuators.pop(key, default)
            if not isinstance(flags[key], bool):
                raise InputError(key, repr(flags[key])[:40], "true or false")
            if flags[key] and not flags["triggered"]:
                problem = "the scene's schedule exposes the frames"
                raise InputError(key, problem, "--trigger, or triggered")
        waiting = sum(index >= schedule.index for index in schedule.triggers_s or ())
        if flags["trigger"] and waiting >= MOST_TRIGGERS:
            raise InputError("trigger", f"{MOST_TRIGGERS} exposures are waiting")
        solution = actuators.pop("attitude", None)
        attitude = None if solution is None else self.solution(solution)
        commands = flight.commands(actuators.pop("torque_nm", None), actuators)
        values = dict(commands.motors)
        if commands.torque_nm is not None:
            values["torque_nm"] = commands.torque_nm
        self.held |= {key: (value, flight.now_s) for key, value in values.items()}
        if exposure_s:
            schedule.exposure_control.exposure_s = exposure_s
        self.set_triggered(flags["triggered"])
        if flags["abort"]:
            schedule.triggers_s = {}
        if flags["trigger"]:
            schedule.trigger(flight.now_s)
        if attitude and flight.motion.navigation:
            status = flight.motion.navigation.update_filter(solution["t_s"], attitude)
            self.updates[status] += 1

    def exposure_s(self, value: Any) -> float:
        """A commanded exposure time, checked."""
        longest_s = self.longest_exposure_s
        if type(value) not in (int, float) or not 0 < value <= longest_s:
            raise InputError("exposure_s", repr(value)[:40], f"more than 0, to {longest_s:g}")
        if self.flight.lab.scene.tracker.exposure_control:
            raise InputError("exposure_s", "the scene's tracker.exposure_control sets it")
        return float(value)

    def solution(self, value: Any) -> Attitude:
        """A client's solution for the filter, checked."""
        if not self.flight.lab.scene.filter:
            raise InputError(
                "attitude", "the scene has no filter", "a scene with the section filter"
            )
        if not isinstance(value, dict) or set(value) != set(SOLUTION_KEYS):
            raise InputError("attitude", repr(value)[:40], ", ".join(SOLUTION_KEYS))
        with refusing(ValueError, "attitude"):
            t_s = float(finite_array(value["t_s"], "t_s", ()))
            quaternion = finite_array(value["cam_from_ref_xyzw"], "cam_from_ref_xyzw", (4,))
            covariance = finite_array(value["covariance_rad2"], "covariance_rad2", (3, 3))
        if abs(math.hypot(*quaternion) - 1) > QUATERNION_TOLERANCE:
            raise InputError("attitude", "cam_from_ref_xyzw is not a unit quaternion")
        least, _, most = np.linalg.eigvalsh(covariance)
        is_symmetric = np.abs(covariance - covariance.T).max() <= ROUNDING * most
        if not is_symmetric or not LEAST_VARIANCE_RAD2 <= least <= most <= MOST_VARIANCE_RAD2:
            raise InputError(
                "attitude",
                "covariance_rad2 is no covariance of an attitude",
                "symmetric, with standard deviations from 1e-9 to 1 rad",
            )
        if not 0 <= t_s <= self.flight.now_s:
            raise InputError(
                "attitude", f"t_s {t_s:g}", f"0 to {self.flight.now_s:g}, the present"
            )
        return Attitude("solved", Rotation.from_quat(quaternion), covariance)

    def in_force(self) -> Commands:
        """The commands of the next control period: those that have not timed out."""
        end_s = self.flight.now_s - self.timeout_s
        kept = {key: held for key, held in self.held.items() if held[1] >= end_s}
        self.timeouts += len(self.held) - len(kept)
        self.held = kept
        motors = {key: value for key, (value, _) in kept.items()}
        return Commands(motors.pop("torque_nm", None), motors)
