"""Reaction wheels: hinge joints `wheel_*`.

Here and in the other kinds every vector is in body axes and a set's n members are the columns of (3, n). A torque T is
on the body; the stored momentum h changes by its opposite, dh/dt = -T. Stored momentum also acts on a rotating body,
with -rate x h; the actuators do not compensate this: the controller adds +rate x h to its command.

The inertia that responds to the torque is that of the body without its rotors' inertia about their axles, which do
not follow the body about these: J - sum inertia axle axle^T.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from skysim.core.constants import RPM_RAD_S
from skysim.core.types import Floats
from skysim.dynamics.multibody.actuator_kind import (
    RANK_TOLERANCE,
    ActuatorKind,
    ControlInput,
    Hinges,
    add_motor,
    joints,
    member_values,
    positive_values,
    scale_to_limit,
    unit_columns,
)
from skysim.scene.sections.vehicle import WheelsConfig

WHEEL = "wheel_"


@dataclass(frozen=True, slots=True)
class WheelSet:
    """Reaction wheels: a motor's torque on its wheel acts oppositely on the body, T = -sum axis u.

    Attributes
    ----------
    axes
        (3, n) unit vectors; a positive speed is right-handed about them
    inertia_kg_m2
        (n,) of each wheel about its axle
    speed_limit_rad_s
        Relative to the body

    Raises
    ------
    InputError
        (one line) for axes that are not unit vectors and inertias that are not positive.
    """

    axes: Floats
    inertia_kg_m2: Floats
    torque_limit_nm: float
    speed_limit_rad_s: float
    motor_from_torque: Floats = field(
        init=False, repr=False
    )  # (n, 3) minus the pseudo-inverse of the axes

    def __post_init__(self) -> None:
        axes = unit_columns(self.axes, "wheel axes")
        object.__setattr__(self, "axes", axes)
        inertia = positive_values(self.inertia_kg_m2, axes.shape[1], "wheel inertia_kg_m2")
        object.__setattr__(self, "inertia_kg_m2", inertia)
        object.__setattr__(self, "motor_from_torque", -np.linalg.pinv(axes, rcond=RANK_TOLERANCE))

    def momentum(self, speed_rad_s: Floats) -> Floats:
        """Angular momentum (3,) that the wheels (n,) hold relative to the body: sum axis inertia speed."""
        return self.axes @ (self.inertia_kg_m2 * speed_rad_s)

    def drive(self, torque_nm: Floats, speed_rad_s: Floats, period_s: float) -> Floats:
        """Motor torques (n,) on the wheels that give torque_nm (3,) on the body for the next period_s.

        The smallest ones that do; if the axes do not span space (n < 3, or all in a plane), those nearest in
        least squares.
        Beyond the torque limit all are scaled together, which keeps the direction. A torque that would carry a wheel
        beyond its speed limit is then reduced to what just reaches it (I d(speed)/dt = u, without the body's own
        acceleration): a wheel at its limit can only be braked, and the direction is not kept.
        """
        # Scaling keeps the torque's direction; the clip to the speed limits afterwards may change it.
        motor = scale_to_limit(self.motor_from_torque @ torque_nm, self.torque_limit_nm)
        torque_per_speed = self.inertia_kg_m2 / period_s
        upper = np.maximum(torque_per_speed * (self.speed_limit_rad_s - speed_rad_s), 0.0)
        lower = np.minimum(-torque_per_speed * (self.speed_limit_rad_s + speed_rad_s), 0.0)
        return np.minimum(np.maximum(motor, lower), upper)


class WheelActuator:
    """Reaction wheels as the flight computer commands them, see `WheelSet`."""

    def __init__(self, model: Any, config: WheelsConfig) -> None:
        self.joints = hinges = Hinges.from_model(model, WHEEL)
        limit_rad_s = config.speed_limit_rpm * RPM_RAD_S
        self.model = WheelSet(
            hinges.axes, hinges.inertia_kg_m2, config.torque_limit_nm, limit_rad_s
        )

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        motor = self.model.drive(torque_nm, inputs.speeds_rad_s[self.joints.dof], inputs.period_s)
        control[self.joints.motor] = motor
        return -self.model.axes @ motor

    def command_map(self) -> tuple[Floats, float]:
        return self.model.motor_from_torque, self.model.torque_limit_nm

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return self.model.momentum(speeds_rad_s[self.joints.dof])


def add_wheels(spec: Any, _: Any, wheels: WheelsConfig) -> None:
    """A motor at each wheel, and its axle's friction; Coulomb friction is MuJoCo's, which holds at rest."""
    for joint in joints(spec, WHEEL):
        joint.frictionloss = wheels.coulomb_nm
        joint.damping = [wheels.viscous_nms, 0.0, 0.0]
        add_motor(spec, joint.name, mujoco.mjtTrn.mjTRN_JOINT, joint.name, wheels.torque_limit_nm)


def start_wheels(model: Any, data: Any, config: WheelsConfig) -> None:
    """Set the wheels' speeds at the start."""
    hinges = Hinges.from_model(model, WHEEL)
    data.qvel[hinges.dof] = (
        member_values(config.start_rpm, len(hinges), "vehicle.wheels.start_rpm") * RPM_RAD_S
    )


WHEELS = ActuatorKind("wheels", add_wheels, WheelActuator, joints=(WHEEL,), start=start_wheels)
