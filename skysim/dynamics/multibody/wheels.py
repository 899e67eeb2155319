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

from typing import Any

import numpy as np

from skysim.core.constants import RPM_RAD_S
from skysim.core.jit import jit
from skysim.core.types import Floats
from skysim.dynamics.multibody.actuator_kind import (
    ActuatorKind,
    Actuators,
    ControlInput,
    Hinges,
    add_motor,
    inverse,
    member_values,
    named,
)
from skysim.scene.sections.vehicle import WheelsConfig

WHEEL = "wheel_"

REST_RAD_S = 1e-6  # speed below which a wheel is at rest
# MuJoCo's parameters of a friction that lets no wheel creep: the shortest time constant, and the greatest impedance.
HARD_FRICTION = ([2e-3, 1.0], [0.9999, 0.9999, 1e-3, 0.5, 2.0])


class WheelActuator(Actuators):
    """Actuators of the flight computer: n reaction wheels.

    A motor torque u on a wheel acts oppositely on the body, T = -sum axis u. `drive` scales the torques to their limit,
    which keeps the direction of T; the speed limit may change it.

    Attributes
    ----------
    hinges
        Axles of the wheels; a positive speed is right-handed about them
    """

    def __init__(self, vehicle: Any, config: WheelsConfig) -> None:
        self.hinges = hinges = vehicle.wheels
        # T = -axes u, solved for u.
        motor_from_torque = -inverse(hinges.axes)
        super().__init__(
            hinges.motor, -hinges.axes, motor_from_torque, config.torque_limit_nm
        )
        self.speed_limit_rad_s = config.speed_limit_rpm * RPM_RAD_S
        self.momentum_from_speed = hinges.axes * hinges.inertia_kg_m2

    def command(self, control: Floats, commands: Floats, inputs: ControlInput) -> Floats:
        """Each motor torque is also clipped to what just reaches the speed limit within the period.

        By inertia d(speed)/dt = u, without the body's own acceleration. A wheel at its limit can only be braked.
        """
        given = np.empty(len(commands))
        limit_torques(
            commands,
            inputs.speeds_rad_s[self.hinges.dof],
            self.hinges.inertia_kg_m2,
            inputs.period_s,
            self.limit,
            self.speed_limit_rad_s,
            given,
        )
        control[self.motor] = given
        return self.torque_from_command.dot(given)

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        """Angular momentum (3,) of the wheels relative to the body: h = sum axis inertia speed."""
        return self.momentum_from_speed.dot(speeds_rad_s[self.hinges.dof])


@jit
def limit_torques(
    torques_nm: Floats,
    speeds_rad_s: Floats,
    inertia_kg_m2: Floats,
    period_s: float,
    torque_limit_nm: float,
    speed_limit_rad_s: float,
    given_nm: Floats,
) -> None:
    """Set given_nm (n,), the torques of the motors clipped as in `WheelActuator.command`."""
    for n in range(len(torques_nm)):
        torque_per_speed = inertia_kg_m2[n] / period_s
        upper = max(torque_per_speed * (speed_limit_rad_s - speeds_rad_s[n]), 0.0)
        lower = min(-torque_per_speed * (speed_limit_rad_s + speeds_rad_s[n]), 0.0)
        given_nm[n] = min(max(torques_nm[n], lower, -torque_limit_nm), upper, torque_limit_nm)


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
        self.joints = Hinges(model, WHEEL)
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
    for joint in named(spec.joints, WHEEL):
        joint.frictionloss = wheels.coulomb_nm
        joint.damping = [wheels.viscous_nms, 0.0, 0.0]
        if wheels.stiction_nm:
            joint.solref_friction, joint.solimp_friction = HARD_FRICTION
        add_motor(spec, joint.name, wheels.torque_limit_nm)


def start_wheels(model: Any, data: Any, config: WheelsConfig) -> None:
    """Set the wheel speeds at the start."""
    hinges = Hinges(model, WHEEL)
    data.qvel[hinges.dof] = (
        member_values(config.start_rpm, len(hinges), "vehicle.wheels.start_rpm") * RPM_RAD_S
    )


WHEELS = ActuatorKind(
    "wheels", add_wheels, WheelActuator, joints=(WHEEL,), start=start_wheels
)
