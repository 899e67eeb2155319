"""Actuators in the MuJoCo model: their joints and sites, and the motors that drive them.

A vehicle's MJCF places them by name: hinge joints `wheel_*`; hinge joints `gimbal_*`, each carrying a hinge
joint `rotor_*` with the same suffix; sites `fan_*`, which push along their own z; slide joints `trim_*` of trim
masses (mass.py). The scene sets their limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene.sections.vehicle import CmgsConfig, FansConfig, VehicleConfig, WheelsConfig

TORQUES = ("torque_x", "torque_y", "torque_z")
UNIT_GEAR = (1, 0, 0, 0, 0, 0)
WHEEL, GIMBAL, ROTOR, FAN, TRIM = "wheel_", "gimbal_", "rotor_", "fan_", "trim_"

JOINT_TYPE = {TRIM: mujoco.mjtJoint.mjJNT_SLIDE}  # of joints that are not hinges


@dataclass(frozen=True, slots=True)
class Hinges:
    """Hinge joints of one kind, in the order of their names.

    names        : (n)
    axes         : (3, n) unit axes in body axes, with all joints at zero
    inertia_kg_m2: (n,) about each axis, of all that rotates with it
    qpos, dof    : (n,) indices of angle and speed in qpos and qvel
    motor        : (n,) actuator numbers, -1 without one
    """

    names: tuple[str, ...]
    axes: Floats
    inertia_kg_m2: Floats
    qpos: NDArray[np.int64]
    dof: NDArray[np.int64]
    motor: NDArray[np.int64]

    @classmethod
    def from_model(cls, model: Any, prefix: str) -> Hinges:
        """All joints whose name begins with prefix."""
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        names = sorted(name for name in all_names(model.joint, model.njnt) if name.startswith(prefix))
        ids = np.array([model.joint(name).id for name in names], dtype=np.int64)
        dof = model.jnt_dofadr[ids].astype(np.int64)
        actuators = all_names(model.actuator, model.nu)
        motor = [actuators.index(name) if name in actuators else -1 for name in names]
        return cls(
            tuple(names),
            data.xaxis[ids].T.copy(),
            full[dof, dof],
            model.jnt_qposadr[ids].astype(np.int64),
            dof,
            np.array(motor, dtype=np.int64),
        )

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, slots=True)
class Fans:
    """Fans, in the order of their names: (3, n) thrust directions and positions, and actuator numbers."""

    names: tuple[str, ...]
    axes: Floats
    positions_m: Floats
    motor: NDArray[np.int64]

    @classmethod
    def from_model(cls, model: Any) -> Fans:
        """The fans that have an actuator."""
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        names = sorted(name for name in all_names(model.actuator, model.nu) if name.startswith(FAN))
        sites = [model.site(name).id for name in names]
        axes = data.site_xmat[sites].reshape(-1, 3, 3)[:, :, 2]
        motor = np.array([model.actuator(name).id for name in names], dtype=np.int64)
        return cls(tuple(names), axes.T.copy(), data.site_xpos[sites].T.copy(), motor)

    def __len__(self) -> int:
        return len(self.names)


def all_names(element: Any, count: int) -> list[str]:
    """Names of a compiled model's elements of one kind; `element` is its accessor by number."""
    return [element(k).name for k in range(count)]


def joints(spec: Any, prefix: str) -> list[Any]:
    """The joints of a spec whose name begins with prefix, in the order of their names."""
    return sorted((j for j in spec.joints if j.name.startswith(prefix)), key=lambda joint: joint.name)


def lock_unused(spec: Any, vehicle: VehicleConfig, path: Path) -> dict[str, str]:
    """Delete the joints of actuators that are off. Raises InputError if an actuator that is on has no joint.

    Returns the names of the deleted joints, each with the scene's key that would have kept it.
    """
    locked: dict[str, str] = {}
    check_names(spec, path)
    for config, key, prefixes in (
        (vehicle.wheels, "wheels", (WHEEL,)),
        (vehicle.cmgs, "cmgs", (GIMBAL, ROTOR)),
        (vehicle.trim, "trim", (TRIM,)),
    ):
        for prefix in prefixes:
            hinges = joints(spec, prefix)
            if config is None:
                locked |= dict.fromkeys((joint.name for joint in hinges), f"vehicle.{key}")
                for joint in hinges:
                    spec.delete(joint)
            elif not hinges:
                raise InputError(path, f"no joint {prefix}*, which vehicle.{key} needs")
            elif any(joint.type != JOINT_TYPE.get(prefix, mujoco.mjtJoint.mjJNT_HINGE) for joint in hinges):
                raise InputError(path, f"joints {prefix}* must be {'slides' if prefix in JOINT_TYPE else 'hinges'}")
            for joint in hinges if config else ():
                check_bare(joint, path)
    if vehicle.cmgs:
        check_rotor_pairs(spec, path)
    if vehicle.fans and not fan_sites(spec):
        raise InputError(path, f"no site {FAN}*, which vehicle.fans needs")
    for actuator in spec.actuators:
        if actuator.name in TORQUES or actuator.name.startswith((WHEEL, GIMBAL, ROTOR, FAN, TRIM)):
            raise InputError(
                path, f"actuator {actuator.name}: an actuator of this name is added; remove it from the file"
            )
    return locked


def locked_joint_hint(spec: Any, locked: dict[str, str]) -> str:
    """An addition to the problem of a model that does not compile, if it refers to a joint that was deleted."""
    named = {sensor.objname for sensor in spec.sensors} | {actuator.target for actuator in spec.actuators}
    named |= {name for equality in spec.equalities for name in (equality.name1, equality.name2)}
    names = [name for name in locked if name in named]
    return f"; {locked[names[0]]} is off, which locks joint {names[0]}" if names else ""


def check_names(spec: Any, path: Path) -> None:
    """Raise InputError for a joint or site whose name nearly matches an actuator's: it would silently not be one."""
    for element in (*spec.joints, *spec.sites):
        prefix = next((p for p in (WHEEL, GIMBAL, ROTOR, FAN, TRIM) if element.name.startswith(p[:-1])), None)
        if prefix and not element.name.startswith(prefix):
            raise InputError(path, element.name, f"{prefix}{element.name[len(prefix) - 1 :]}, or another word")


def check_bare(joint: Any, path: Path) -> None:
    """Raise InputError for limits, springs, damping or drives of an actuator's joint in the file: the
    scene sets them.
    """
    attributes = {
        "range": joint.range,
        "stiffness": joint.stiffness,
        "damping": joint.damping,
        "frictionloss": joint.frictionloss,
        "armature": joint.armature,
        "actuatorfrcrange": joint.actfrcrange,
    }
    for name, value in attributes.items():
        if np.any(value):
            raise InputError(path, f"joint {joint.name}: {name} is set by the scene; remove it from the file")


def check_rotor_pairs(spec: Any, path: Path) -> None:
    """Check that each rotor is on the gimbal with the same suffix. Raises InputError."""
    for gimbal in joints(spec, GIMBAL):
        suffix = gimbal.name.removeprefix(GIMBAL)
        rotor = spec.joint(ROTOR + suffix)
        if rotor is None or rotor.parent.parent != gimbal.parent:
            raise InputError(path, f"joint {gimbal.name} has no joint {ROTOR}{suffix} on a child body of its own")
    if len(joints(spec, ROTOR)) != len(joints(spec, GIMBAL)):
        raise InputError(path, f"a joint {ROTOR}* has no joint {GIMBAL}* of the same suffix")


def fan_sites(spec: Any) -> list[Any]:
    return sorted((site for site in spec.sites if site.name.startswith(FAN)), key=lambda site: site.name)


def add_actuators(spec: Any, model: Any, vehicle: VehicleConfig) -> None:
    """Add the motors of all actuators that are on, and three ideal torques; model is the compiled spec."""
    for name, axis in zip(TORQUES, np.eye(3), strict=True):
        # A ball joint's motor acts about a body axis.
        add_motor(spec, name, mujoco.mjtTrn.mjTRN_JOINT, "bearing", gear=[*axis, 0, 0, 0])
    if vehicle.wheels:
        add_wheels(spec, vehicle.wheels)
    if vehicle.cmgs:
        add_cmgs(spec, model, vehicle.cmgs)
    if vehicle.fans:
        add_fans(spec, vehicle.fans)


def add_motor(
    spec: Any,
    name: str,
    kind: Any,
    target: str,
    limit: float | None = None,
    gear: Sequence[float] = UNIT_GEAR,
) -> Any:
    """Add a motor: force = control, which is limited to +-limit if one is given."""
    motor = spec.add_actuator(name=name, trntype=kind, target=target, gear=gear)
    motor.set_to_motor()
    if limit is not None:
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.ctrlrange = [-limit, limit]
    return motor


def add_wheels(spec: Any, wheels: WheelsConfig) -> None:
    """A motor at each wheel, and its axle's friction; Coulomb friction is MuJoCo's, which holds at rest."""
    for joint in joints(spec, WHEEL):
        joint.frictionloss, joint.damping = wheels.coulomb_nm, [wheels.viscous_nms, 0.0, 0.0]
        add_motor(spec, joint.name, mujoco.mjtTrn.mjTRN_JOINT, joint.name, wheels.torque_limit_nm)


def add_cmgs(spec: Any, model: Any, cmgs: CmgsConfig) -> None:
    """A rate servo at each gimbal, and a motor at each variable-speed rotor; other rotors keep their momentum.

    The servo's set-point is the integral of the commanded rate. A critically damped spring pulls the gimbal to it
    with the scene's time constant, so that the rate is held against gyroscopic torque from the vehicle's rotation;
    a damper alone would not hold it.
    """
    tau_s = cmgs.gimbal_time_constant_s
    for joint, inertia in zip(joints(spec, GIMBAL), Hinges.from_model(model, GIMBAL).inertia_kg_m2, strict=True):
        servo = spec.add_actuator(name=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name)
        servo.set_to_intvelocity(kp=inertia / tau_s**2, kv=2 * inertia / tau_s)
    for joint in joints(spec, ROTOR):
        if cmgs.rotor_torque_limit_nm:
            add_motor(spec, joint.name, mujoco.mjtTrn.mjTRN_JOINT, joint.name, cmgs.rotor_torque_limit_nm)


def add_fans(spec: Any, config: FansConfig) -> None:
    """A force at each fan, along its site's z, which follows the command with a first-order lag."""
    for site in fan_sites(spec):
        limit = config.thrust_limit_n
        fan = add_motor(spec, site.name, mujoco.mjtTrn.mjTRN_SITE, site.name, limit, [0, 0, 1, 0, 0, 0])
        # Not FILTEREXACT, which is exact for Euler steps only: with Runge-Kutta it adds half a step of lag.
        fan.dyntype = mujoco.mjtDyn.mjDYN_FILTER
        fan.dynprm[0] = config.time_constant_s
