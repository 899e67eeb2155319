"""Reaction wheels: hinge joints `wheel_*`.

Conventions of all kinds of actuators: every vector is in body axes, and the n members of a set are the columns of
(3, n). A torque T acts on the body and changes the stored momentum h by its opposite, dh/dt = -T. On a rotating body
the stored momentum also exerts -rate x h. The actuators do not compensate this; the controller adds +rate x h to its
command.

Rotors do not follow the body's rotation about their axles, so the inertia that responds to a torque is
J - sum inertia axle axle^T.

A wheel at rest, or whose speed crosses zero, sticks while the torque on its bearing is below the stiction
(`Stiction`); from there on the friction is that of a moving wheel.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skysim.core.constants import RPM_RAD_S
from skysim.core.types import Floats
from skysim.dynamics.multibody.actuator_kind import (
    ActuatorKind,
    Actuators,
    ControlInput,
    Hinges,
    add_motor,
    inverse,
    joints,
    member_values,
    scale_to_limit,
)
from skysim.scene.sections.vehicle import WheelsConfig

WHEEL = "wheel_"

REST_RAD_S = 1e-6  # speed below which a wheel is at rest
# MuJoCo's parameters of a friction that lets no wheel creep: the shortest time constant, and the greatest impedance.
HARD_FRICTION = ([2e-3, 1.0], [0.9999, 0.9999, 1e-3, 0.5, 2.0])


@dataclass(slots=True)
class WheelSet:
    """A set of n reaction wheels. A motor torque u on a wheel acts oppositely on the body: T = -sum axis u.

    Attributes
    ----------
    axes
        (3, n) unit vectors in body axes; a positive speed is right-handed about them
    inertia_kg_m2
        (n,) inertia of each wheel about its axle
    torque_limit_nm
        Greatest motor torque
    speed_limit_rad_s
        Greatest speed relative to the body
    motor_from_torque
        (n, 3) minus the pseudo-inverse of the axes
    """

    axes: Floats
    inertia_kg_m2: Floats
    torque_limit_nm: float
    speed_limit_rad_s: float
    motor_from_torque: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # T = -axes u, solved for u.
        self.motor_from_torque = -inverse(self.axes)

    def momentum(self, speed_rad_s: Floats) -> Floats:
        """Angular momentum (3,) of wheels at speeds (n,) relative to the body: h = sum axis inertia speed."""
        return self.axes @ (self.inertia_kg_m2 * speed_rad_s)

    def drive(self, torque_nm: Floats, speed_rad_s: Floats, period_s: float) -> Floats:
        """Motor torques (n,) on the wheels that give torque_nm (3,) on the body for the next period_s.

        1. The smallest torques that give it, u = -axes^+ T; if the axes do not span space (n < 3, or all in a plane),
           the nearest in least squares.
        2. One factor scales them to the torque limit, which keeps the direction of T.
        3. `within_limits`, which may change the direction.
        """
        motor = scale_to_limit(self.motor_from_torque @ torque_nm, self.torque_limit_nm)
        return self.within_limits(motor, speed_rad_s, period_s)

    def within_limits(self, motor_nm: Floats, speed_rad_s: Floats, period_s: float) -> Floats:
        """Motor torques (n,), each clipped to what just reaches the speed limit within period_s.

        By inertia d(speed)/dt = u, without the body's own acceleration. A wheel at its limit can only be braked.
        """
        torque_per_speed = self.inertia_kg_m2 / period_s
        upper = np.maximum(torque_per_speed * (self.speed_limit_rad_s - speed_rad_s), 0.0)
        lower = np.minimum(-torque_per_speed * (self.speed_limit_rad_s + speed_rad_s), 0.0)
        return np.clip(motor_nm, lower, upper)


class WheelActuator(Actuators):
    """Actuators of the flight computer: reaction wheels, see `WheelSet`."""

    def __init__(self, model: Any, config: WheelsConfig) -> None:
        self.joints = hinges = Hinges.from_model(model, WHEEL)
        limit_nm = config.torque_limit_nm
        limit_rad_s = config.speed_limit_rpm * RPM_RAD_S
        self.model = WheelSet(hinges.axes, hinges.inertia_kg_m2, limit_nm, limit_rad_s)
        super().__init__(hinges.motor, -hinges.axes, self.model.motor_from_torque, limit_nm)

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        speeds = inputs.speeds_rad_s[self.joints.dof]
        motor = self.model.drive(torque_nm, speeds, inputs.period_s)
        return super().command(control, motor, inputs)

    def command(self, control: Floats, commands: Floats, inputs: ControlInput) -> Floats:
        speeds = inputs.speeds_rad_s[self.joints.dof]
        motor = self.model.within_limits(commands, speeds, inputs.period_s)
        return super().command(control, motor, inputs)

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return self.model.momentum(speeds_rad_s[self.joints.dof])


class Stiction:
    """Static friction of the wheels: MuJoCo's friction loss of a wheel that sticks is raised to the stiction.

    MuJoCo itself holds a wheel with the Coulomb friction. The torque on the bearing of a wheel at rest is that of its
    motor less what the body's acceleration a demands, u - inertia axis . a. Stateful: one object per motion.

    Parameters
    ----------
    model
        Compiled model of this motion alone; its friction losses change
    config
        The scene's `vehicle.wheels`

    Attributes
    ----------
    sticks
        (n,) whether each wheel sticks
    before_rad_s
        (n,) speeds at the step before
    """

    def __init__(self, model: Any, config: WheelsConfig) -> None:
        self.model = model
        self.config = config
        self.joints = Hinges.from_model(model, WHEEL)
        self.sticks = np.zeros(len(self.joints), dtype=bool)
        self.before_rad_s = np.zeros(len(self.joints))

    def set_friction(
        self, control: Floats, speeds_rad_s: Floats, body_rad_s2: Floats
    ) -> None:
        """Set the friction losses of the next step, from its controls (nu,) and the full qvel; see the class.

        The acceleration of the body (3,) is that of the step before.
        """
        speed = speeds_rad_s[self.joints.dof]
        inertial_nm = self.joints.inertia_kg_m2 * (body_rad_s2 @ self.joints.axes)
        load_nm = control[self.joints.motor] - inertial_nm
        # A wheel comes to rest where its speed changes sign, or by friction alone, which lets it creep to zero.
        rests = self.sticks | (np.abs(speed) < REST_RAD_S) | (speed * self.before_rad_s < 0)
        self.sticks = rests & (np.abs(load_nm) <= self.config.stiction_nm)
        self.before_rad_s = speed
        self.model.dof_frictionloss[self.joints.dof] = np.where(
            self.sticks, self.config.stiction_nm, self.config.coulomb_nm
        )


def add_wheels(spec: Any, _: Any, wheels: WheelsConfig) -> None:
    """Add a motor at each wheel, and the friction of its axle; MuJoCo's Coulomb friction also holds a wheel at rest."""
    # T = coulomb sign(speed) + viscous speed.
    for joint in joints(spec, WHEEL):
        joint.frictionloss = wheels.coulomb_nm
        joint.damping = [wheels.viscous_nms, 0.0, 0.0]
        if wheels.stiction_nm:
            joint.solref_friction, joint.solimp_friction = HARD_FRICTION
        add_motor(spec, joint.name, wheels.torque_limit_nm)


def start_wheels(model: Any, data: Any, config: WheelsConfig) -> None:
    """Set the wheel speeds at the start."""
    hinges = Hinges.from_model(model, WHEEL)
    data.qvel[hinges.dof] = (
        member_values(config.start_rpm, len(hinges), "vehicle.wheels.start_rpm") * RPM_RAD_S
    )


WHEELS = ActuatorKind(
    "wheels", add_wheels, WheelActuator, joints=(WHEEL,), start=start_wheels
)
