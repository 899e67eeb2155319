"""All kinds of actuators, and their use in a vehicle's model.

A new kind is a file beside this one, an entry in `KINDS`, and its section in scene/sections/vehicle.py. The MJCF of a
vehicle places the actuators by the names of joints and sites; the scene sets their limits.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.dynamics.multibody.actuator_kind import (
    ActuatorDrive,
    ActuatorKind,
    Actuators,
    add_motor,
    named,
)
from skysim.dynamics.multibody.cmgs import CMGS
from skysim.dynamics.multibody.fans import FANS
from skysim.dynamics.multibody.thrusters import THRUSTERS
from skysim.dynamics.multibody.trims import TRIM, TRIMS
from skysim.dynamics.multibody.wheels import WHEELS
from skysim.scene.sections.vehicle import VehicleConfig

KINDS: tuple[ActuatorKind, ...] = (WHEELS, CMGS, FANS, THRUSTERS, TRIMS)

TORQUES = ("torque_x", "torque_y", "torque_z")
PREFIXES = (*(prefix for kind in KINDS for prefix in (*kind.joints, *kind.sites)), TRIM)


class IdealTorques(Actuators):
    """Ideal torques about the body's axes, each of which is clipped by itself."""

    def drive(self, torque_nm: Floats) -> Floats:
        return torque_nm


def kinds_on(vehicle: VehicleConfig) -> list[tuple[ActuatorKind, Any]]:
    """The kinds that a scene switches on, each with its section."""
    kinds = [(kind, getattr(vehicle, kind.key)) for kind in KINDS]
    return [(kind, config) for kind, config in kinds if config is not None]


def build_actuators(config: VehicleConfig, vehicle: Any) -> dict[str, Actuators]:
    """All actuators that are switched on, by their key in `vehicle`, and `ideal` torques about the body's axes."""
    ideal = IdealTorques(vehicle.torques, np.eye(3), np.eye(3), config.torque_limit_nm)
    return {"ideal": ideal} | {
        kind.key: kind.control(vehicle, own) for kind, own in kinds_on(config)
    }


def build_drives(config: VehicleConfig, vehicle: Any) -> list[ActuatorDrive]:
    """The hardware between commands and motors of all actuators that are switched on."""
    return [kind.drive(vehicle, own) for kind, own in kinds_on(config) if kind.drive]


def set_start(vehicle: VehicleConfig, model: Any, data: Any) -> None:
    """Set the angles and speeds of the actuators' joints in the data of a model to those at the scene's start."""
    for kind, config in kinds_on(vehicle):
        kind.start(model, data, config)


def add_actuators(spec: Any, model: Any, vehicle: VehicleConfig) -> None:
    """Add three ideal torques and the motors of all actuators that are on; model is the compiled spec."""
    for name, axis in zip(TORQUES, np.eye(3), strict=True):
        # The motor of a ball joint acts about an axis of the body.
        add_motor(spec, "bearing", gear=[*axis, 0, 0, 0]).name = name
    for kind, config in kinds_on(vehicle):
        kind.add(spec, model, config)


def lock_unused(spec: Any, vehicle: VehicleConfig, path: Path) -> dict[str, str]:
    """Delete the joints of actuators that are off, which locks them; check those of actuators that are on.

    Returns the names of the deleted joints, each with the key of the scene that would have kept it. Raises
    InputError if an actuator that is on has no joint, or for names in the file that skysim reserves.
    """
    locked: dict[str, str] = {}
    check_names(spec, path)
    # 1. Joints: delete or check.
    trim = "trims" if vehicle.trims else "trim"
    prefixes_by_key = {kind.key: kind.joints for kind in KINDS} | {trim: (TRIM,)}
    for key, prefixes in prefixes_by_key.items():
        for prefix in prefixes:
            found = named(spec.joints, prefix)
            if getattr(vehicle, key) is None:
                locked |= dict.fromkeys((joint.name for joint in found), f"vehicle.{key}")
                for joint in found:
                    spec.delete(joint)
            else:
                check_joints(found, prefix, key, path)
    # 2. The kinds' own checks, and their sites.
    for kind, _ in kinds_on(vehicle):
        kind.check(spec, path)
        for prefix in kind.sites:
            if not named(spec.sites, prefix):
                raise InputError(path, f"no site {prefix}*, which vehicle.{kind.key} needs")
    # 3. Names of the motors that `add_actuators` adds.
    for actuator in spec.actuators:
        problem = ""
        if actuator.name in TORQUES or actuator.name.startswith(PREFIXES):
            problem = f"actuator {actuator.name}: an actuator of this name is added"
        elif actuator.target.startswith(PREFIXES):
            problem = f"actuator of {actuator.target} is set by the scene"
        if problem:
            raise InputError(path, f"{problem}; remove it from the file")
    return locked


def check_joints(found: Sequence[Any], prefix: str, key: str, path: Path) -> None:
    """Raise InputError if joints of an actuator are missing, have another type, or have properties of their own.

    The scene sets their limit, spring, damping and drive.
    """
    wanted = mujoco.mjtJoint.mjJNT_SLIDE if prefix == TRIM else mujoco.mjtJoint.mjJNT_HINGE
    if not found:
        raise InputError(path, f"no joint {prefix}*, which vehicle.{key} needs")
    if any(joint.type != wanted for joint in found):
        raise InputError(
            path, f"joints {prefix}* must be {'slides' if prefix == TRIM else 'hinges'}"
        )
    # Each of these would act in addition to the scene's values.
    names = "range stiffness springref damping frictionloss armature actfrcrange"
    for joint, name in itertools.product(found, names.split()):
        if np.any(getattr(joint, name)):
            in_file = name.replace("actfrc", "actuatorfrc")
            raise InputError(
                path,
                f"joint {joint.name}: {in_file} is set by the scene; remove it from the file",
            )


def locked_joint_hint(spec: Any, locked: dict[str, str]) -> str:
    """Text to add to the error of a model that does not compile, if it refers to a deleted joint; else ""."""
    # All names that sensors, actuators and constraints refer to.
    named = {sensor.objname for sensor in spec.sensors} | {
        actuator.target for actuator in spec.actuators
    }
    named |= {
        name for equality in spec.equalities for name in (equality.name1, equality.name2)
    }
    name = next((name for name in locked if name in named), "")
    return name and f"; {locked[name]} is off, which locks joint {name}"


def check_names(spec: Any, path: Path) -> None:
    """Raise InputError for a joint or site whose name lacks the underscore of a prefix.

    It would silently not be an actuator.
    """
    # Prefixes end with an underscore: wheel_1 is a wheel, wheel1 nearly one.
    for element in (*spec.joints, *spec.sites):
        prefix = next((p for p in PREFIXES if element.name.startswith(p[:-1])), None)
        if prefix and not element.name.startswith(prefix):
            raise InputError(
                path,
                element.name,
                f"{prefix}{element.name[len(prefix) - 1 :]}, or another word",
            )
