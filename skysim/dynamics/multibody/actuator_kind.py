"""The interface of a kind of actuator, and the helpers that the kinds share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np

from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats, Ints, frozen

# Directions whose singular value is a smaller fraction of the largest get no torque.
RANK_TOLERANCE = 1e-6


class ControlInput(NamedTuple):
    """The inputs of an actuator set at the start of a control period.

    Attributes
    ----------
    t_s, period_s
        Time since the scene's start, and length of the control period
    rate_body_rad_s
        (3,) measured rate of the body, in body axes
    angles_rad, speeds_rad_s
        The full qpos and qvel; only those of wheels, rotors and gimbals are used, as encoders without errors
    """

    t_s: float
    period_s: float
    rate_body_rad_s: Floats
    angles_rad: Floats
    speeds_rad_s: Floats


@dataclass
class Actuators:
    """A set of n actuators of one kind: converts a torque (3,) on the body to entries of the controls (nu,).

    Its torque is proportional to its commands. Kinds override what differs.

    Attributes
    ----------
    motor
        (n,) numbers of the commanded motors
    torque_from_command, command_from_torque
        (3, n) torques on the body per unit of command, and (n, 3) the reverse, with every gimbal at zero
    limit
        Greatest size of a command
    """

    motor: Ints
    torque_from_command: Floats
    command_from_torque: Floats
    limit: float

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        """Write the commands into control; return the torque (3,) that they will give."""
        return self.command(control, self.drive(torque_nm), inputs)

    def drive(self, torque_nm: Floats) -> Floats:
        """The smallest commands (n,) that give the torque (3,), or the nearest to it in least squares.

        One factor scales all commands to the limit, which keeps the direction of the torque.
        """
        commands = self.command_from_torque.dot(torque_nm)
        scale_to_limit(commands, self.limit)
        return commands

    def command(self, control: Floats, commands: Floats, inputs: ControlInput) -> Floats:
        """The same for commands (n,) of the single motors, each of which is clipped to its limits."""
        control[self.motor] = given = commands.clip(-self.limit, self.limit)
        # The operator takes twice as long for so few numbers.
        return self.torque_from_command.dot(given)


class ActuatorDrive(Protocol):
    """Hardware between the commands of a set and MuJoCo's motors, such as valves. Stateful: one object per motion.

    Attributes
    ----------
    readings
        Present values by name, such as the propellant
    """

    @property
    def readings(self) -> dict[str, Floats]: ...

    def apply(self, control: Floats, angles_rad: Floats) -> None:
        """Replace the commands in the controls (K, nu) of the next K steps by those of the motors at each step.

        The full qpos is that of the first step.
        """
        ...


def nothing(*_: Any) -> None:
    """Do nothing: the default of functions that a kind does not need."""


@frozen
class ActuatorKind:
    """A kind of actuator.

    Attributes
    ----------
    key
        Key of its section in the scene's `vehicle`, which switches it on
    joints, sites
        Prefixes of the names of its joints and sites in the vehicle's file
    add
        (spec, compiled spec, config): adds its motors to the spec
    control
        (`VehicleModel`, config): returns the set that the flight computer commands
    start
        (model, data, config): sets the initial angles and speeds of its joints in the data
    check
        (spec, path of the file): raises InputError for joints that do not fit together
    drive
        (`VehicleModel`, config): returns the hardware between commands and motors; None without any
    """

    key: str
    add: Callable[[Any, Any, Any], None]
    control: Callable[[Any, Any], Actuators]
    joints: tuple[str, ...] = ()
    sites: tuple[str, ...] = ()
    start: Callable[[Any, Any, Any], None] = nothing
    check: Callable[[Any, Path], None] = nothing
    drive: Callable[[Any, Any], ActuatorDrive] | None = None


@jit
def scale_to_limit(commands: Floats, limit: float) -> None:
    """Scale the commands by one factor, in place, so that none exceeds the limit; their direction is kept."""
    peak = np.abs(commands).max()
    if peak > limit:
        commands *= limit / peak


def inverse(torque_from_command: Floats) -> Floats:
    """(n, 3) pseudo-inverse of (3, n): the smallest commands that give a torque, or the nearest in least squares."""
    return np.asarray(np.linalg.pinv(torque_from_command, rcond=RANK_TOLERANCE), np.float64)


# Joints, sites and motors of actuators in the MuJoCo model.

UNIT_GEAR = (1, 0, 0, 0, 0, 0)


class Hinges:
    """All joints of a compiled model whose name begins with a prefix, in the order of their names.

    Attributes
    ----------
    names
        Names of the n joints
    axes
        (3, n) unit vectors of the axes in body axes, with all joints at zero
    inertia_kg_m2
        (n,) inertia about each axis of everything that rotates with it
    qpos, dof
        (n,) indices of the angles in qpos and of the speeds in qvel
    motor
        (n,) numbers of the actuators; -1 for a joint without one
    """

    def __init__(self, model: Any, prefix: str) -> None:
        self.model = model
        self.names = tuple(sorted(all_names(model.joint, model.njnt, prefix)))
        self.ids = np.array([model.joint(name).id for name in self.names], dtype=np.int64)
        self.qpos = model.jnt_qposadr[self.ids].astype(np.int64)
        self.dof = model.jnt_dofadr[self.ids].astype(np.int64)
        # A motor has the name of its joint; MuJoCo gives -1 for a name that does not exist.
        kind = mujoco.mjtObj.mjOBJ_ACTUATOR
        motor = [mujoco.mj_name2id(model, kind, name) for name in self.names]
        self.motor = np.array(motor, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.names)

    # The start of a flight needs only the numbers of the joints, and these two are as much work as the rest of it.

    @cached_property
    def axes(self) -> Floats:
        return at_zero(self.model).xaxis[self.ids].T.copy()

    @cached_property
    def inertia_kg_m2(self) -> Floats:
        # The diagonal of the joint-space inertia matrix is the inertia about each axis.
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, at_zero(self.model), full)
        return full[self.dof, self.dof]


def at_zero(model: Any) -> Any:
    """Data of a compiled model with all joints at zero, where the axes of the body are those of the lab."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def all_names(element: Any, count: int, prefix: str = "") -> list[str]:
    """Names with a prefix of the elements of one kind of a compiled model; `element` returns one by its number."""
    return [name for k in range(count) if (name := element(k).name).startswith(prefix)]


def named(elements: Iterable[Any], prefix: str) -> list[Any]:
    """The joints or sites of a spec whose name begins with prefix, in the order of their names."""
    return sorted(
        (one for one in elements if one.name.startswith(prefix)), key=attrgetter("name")
    )


def add_motor(
    spec: Any,
    target: str,
    limit: float | None = None,
    gear: Sequence[float] = UNIT_GEAR,
    kind: Any = mujoco.mjtTrn.mjTRN_JOINT,
) -> Any:
    """Add a motor with its target's name, whose force is gear times its control, limited to +-limit if one is given."""
    motor = spec.add_actuator(name=target, trntype=kind, target=target, gear=gear)
    motor.set_to_motor()
    if limit is not None:
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.ctrlrange = [-limit, limit]
    return motor


def add_servos(spec: Any, model: Any, prefix: str, tau_s: float) -> None:
    """Add a servo at each joint whose name begins with prefix; its set-point is the integral of the commanded rate.

    A critically damped spring pulls the joint to it with the time constant tau,

        torque = kp (set-point - angle) - kv d(angle)/dt,    kp = inertia / tau^2,    kv = 2 inertia / tau

    The inertia of a slide is its mass, and its angle a position.
    """
    inertias = Hinges(model, prefix).inertia_kg_m2
    for joint, inertia in zip(named(spec.joints, prefix), inertias, strict=True):
        servo = spec.add_actuator(
            name=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name
        )
        servo.set_to_intvelocity(kp=inertia / tau_s**2, kv=2 * inertia / tau_s)


def member_values(values: tuple[float, ...], count: int, key: str) -> Floats:
    """(count,) values, one for each member; zeros if none are given. Raises InputError for another number."""
    if values and len(values) != count:
        raise InputError(key, f"{len(values)} values", f"{count}, one for each, or none")
    return np.array(values or (0.0,) * count)
