"""Control moment gyroscopes (CMGs): hinge joints `gimbal_*`, each of which carries `rotor_*` with the same suffix.

Frames and signs are those of wheels.py. The steering of each control period:

1. The rotor axles at the gimbal angles, and their derivative (`rotor_axles`).
2. The Jacobian A of the stored momentum h by the gimbal angles: columns g x h (`CmgActuator.jacobian`).
3. Gimbal rates with A d(angle)/dt = dh/dt = -T, by a steering law of `STEERING`. Variable-speed CMGs also use rotor
   torques (`vscmg_commands`).
4. One factor scales all commands to their limits, so the torque's direction is kept.

A is singular if all g x h are in a plane. Then no gimbal rate gives a torque along the plane's normal.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.constants import RPM_RAD_S
from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats
from skysim.dynamics.multibody.actuator_kind import (
    RANK_TOLERANCE,
    ActuatorKind,
    Actuators,
    ControlInput,
    Hinges,
    add_motor,
    add_servos,
    inverse,
    member_values,
    named,
    scale_to_limit,
)
from skysim.scene.sections.vehicle import CmgsConfig

GIMBAL = "gimbal_"
ROTOR = "rotor_"

# Generalized singularity-robust inverse and the weights of variable-speed CMGs: the sizes are `assumed`.
DAMPING = 0.01  # lambda at a singularity, in units of the rotors' momentum squared
DITHER = 0.01  # amplitude of the off-diagonal elements of E
DITHER_RAD_S = math.pi / 2  # their angular frequency
DAMPING_DECAY = 10.0  # away from a singularity lambda decays as exp(-DAMPING_DECAY det A A^T)


@jit
def solve_gram(gram: Floats, rhs: Floats) -> Floats:
    """(3,) x of gram x = rhs for a symmetric positive semidefinite gram (3, 3); singular directions get zero.

    x = sum_k v_k (v_k . rhs) / lambda_k over the eigenvectors v_k whose eigenvalue lambda_k is not negligible.
    """
    # Eigenvalues are squared singular values, in ascending order.
    value, vector = np.linalg.eigh(gram)
    x = np.zeros(3)
    for k in range(3):
        if value[k] > RANK_TOLERANCE**2 * value[2]:
            x += vector[:, k] * ((vector[:, k] * rhs).sum() / value[k])
    return x


@jit
def gram_determinant(m: Floats) -> float:
    """Determinant of A A^T (3, 3) as the triple product of its rows, clipped at zero against rounding.

    np.linalg.det takes several times as long.
    """
    return max((m[0] * np.cross(m[1], m[2])).sum(), 0.0)


@jit
def pseudo_inverse(jacobian_unit: Floats, momentum_rate: Floats, t_s: float) -> Floats:
    """(n,) smallest gimbal rates that give a momentum rate: A^T (A A^T)^-1 dh/dt, without singularity avoidance.

    The rates grow without bound near a singularity, and this law tends to steer into one.
    """
    return jacobian_unit.T @ solve_gram(jacobian_unit @ jacobian_unit.T, momentum_rate)


@jit
def singularity_robust(jacobian_unit: Floats, momentum_rate: Floats, t_s: float) -> Floats:
    """(n,) gimbal rates by the generalized singularity-robust inverse: A^T (A A^T + lambda E)^-1 dh/dt.

    Near a singularity lambda = 0.01 exp(-10 det A A^T) keeps the rates bounded, at the cost of an error in the
    torque. E has a unit diagonal and the off-diagonal elements e_i = 0.01 sin(pi t / 2 + phase_i). For a torque
    along the singular direction these move the gimbals sideways, and so out of the singularity. Wie, Bailey &
    Heiberg 2001, J. Guidance, Control, and Dynamics 24 (5), 865; the numbers are `assumed`.
    """
    gram = jacobian_unit @ jacobian_unit.T
    # A A^T + lambda E. The loop visits each row twice, so each visit adds half of the diagonal element.
    damping = DAMPING * math.exp(-DAMPING_DECAY * gram_determinant(gram))
    for row, column, phase in ((1, 2, 0.0), (0, 2, math.pi / 2), (0, 1, math.pi)):
        dither = damping * DITHER * math.sin(DITHER_RAD_S * t_s + phase)
        gram[row, column] += dither
        gram[column, row] += dither
        gram[row, row] += damping / 2
        gram[column, column] += damping / 2
    return jacobian_unit.T @ solve_gram(gram, momentum_rate)


# (jacobian (3, n) of unit rotor momentum, dh/dt (3,) in the same unit, time in s) -> gimbal rates (n,) in rad/s.
STEERING: dict[str, Callable[[Floats, Floats, float], Floats]] = {
    "pseudo_inverse": pseudo_inverse,
    "singularity_robust": singularity_robust,
}


@jit
def rotor_axles(
    spin_axes: Floats, cross_axes: Floats, angle_rad: Floats
) -> tuple[Floats, Floats]:
    """Rotor axles (3, n) at the gimbal angles, and their derivative (3, n) by the gimbal angles.

    axle = s cos(angle) + (g x s) sin(angle),    derivative = (g x s) cos(angle) - s sin(angle)
    """
    cosine = np.cos(angle_rad)
    sine = np.sin(angle_rad)
    return spin_axes * cosine + cross_axes * sine, cross_axes * cosine - spin_axes * sine


@jit
def vscmg_commands(
    axle: Floats,
    jacobian: Floats,
    unit_nms: float,
    momentum_rate_nm: Floats,
    rate_limit: float,
    torque_limit: float,
) -> tuple[Floats, Floats]:
    """Gimbal rates (n,) and rotor torques (n,) of variable-speed CMGs that together give dh/dt (3,).

    1. Weights: gimbal rates are measured in units of their limit, rotor torques in units of their limit times
       exp(-5 det A A^T), A of unit rotor momentum. This keeps the rotors idle away from singularities.
    2. The exact solution that is smallest in the weighted norm,

           x = W B^T (B W B^T)^-1 dh/dt,    B = [A, axle],    W = diag(weights^2).

    3. One factor scales all commands to their limits.

    Schaub, Vadali & Junkins 1998, J. Astronautical Sciences 46 (3); weighting by the limits is our own choice, the
    number is `assumed`.
    """
    # 1. Weights, squared.
    gram = jacobian @ jacobian.T
    determinant = gram_determinant(gram) / unit_nms**6 if unit_nms > 0 else 0.0
    gimbal_weight = rate_limit**2
    rotor_weight = torque_limit**2 * math.exp(-DAMPING_DECAY * determinant)
    # 2. Weighted minimum norm.
    multiplier = solve_gram(
        gimbal_weight * gram + rotor_weight * (axle @ axle.T), momentum_rate_nm
    )
    rate = gimbal_weight * (jacobian.T @ multiplier)
    torque = rotor_weight * (axle.T @ multiplier)
    # 3. Limits.
    scale = 1 / max(1.0, np.abs(rate).max() / rate_limit, np.abs(torque).max() / torque_limit)
    return rate * scale, torque * scale


class CmgActuator(Actuators):
    """Actuators of the flight computer: n control moment gyroscopes.

    Rotating the axle of a spinning rotor gives a torque,

        torque on the body = -d(angle)/dt g x h

    g is the gimbal axis and h the rotor's momentum along its axle. The torque that accelerates a gimbal about its
    own axis is left out. Variable-speed CMGs have no steering law.

    Attributes
    ----------
    gimbals
        Gimbals, whose axes are g
    rotors
        Rotors, whose axes s are those of the axles at gimbal angle zero, at right angles to g
    cross_axes
        (3, n) g x s

    Raises
    ------
    InputError
        If axes are not at right angles.
    """

    def __init__(self, vehicle: Any, config: CmgsConfig) -> None:
        self.gimbals = gimbals = vehicle.gimbals
        self.rotors = rotors = vehicle.rotors
        if np.abs((gimbals.axes * rotors.axes).sum(axis=0)).max() > 1e-6:
            raise InputError(
                "rotor axes", "", "one for each gimbal, at right angles to its axis"
            )
        self.config = config
        # One memory layout, since numba compiles for each.
        self.cross_axes = np.ascontiguousarray(np.cross(gimbals.axes, rotors.axes, axis=0))
        speeds = np.full(len(rotors), config.rotor_rpm * RPM_RAD_S)
        jacobian = self.jacobian(np.zeros(len(gimbals)), speeds)
        limit_rad_s = math.radians(config.gimbal_rate_limit_deg_s)
        super().__init__(gimbals.motor, -jacobian, inverse(-jacobian), limit_rad_s)

    def momentum(self, angle_rad: Floats, rotor_rad_s: Floats) -> Floats:
        """Angular momentum (3,) of the rotors relative to the body: h = sum axle inertia speed."""
        axle, _ = rotor_axles(self.rotors.axes, self.cross_axes, angle_rad)
        return axle @ (self.rotors.inertia_kg_m2 * rotor_rad_s)

    def jacobian(self, angle_rad: Floats, rotor_rad_s: Floats) -> Floats:
        """(3, n) Jacobian A: derivative of the momentum by the gimbal angles, with columns g x h."""
        _, derivative = rotor_axles(self.rotors.axes, self.cross_axes, angle_rad)
        return derivative * (self.rotors.inertia_kg_m2 * rotor_rad_s)

    def manipulability(self, angle_rad: Floats, rotor_rad_s: Floats) -> Floats:
        """Distance from singularity (...) at angles and speeds (..., n), between 0 and 1.

            sqrt(det A A^T) / (trace(A A^T) / 3)^1.5

        It is 1 if torque is equally easy in every direction, and 0 if there is no torque in one direction, or if the
        rotors are at rest. It does not depend on the size and number of the rotors.
        """
        angle = angle_rad[..., None, :]
        spin = rotor_rad_s[..., None, :]
        cross = self.cross_axes * np.cos(angle) - self.rotors.axes * np.sin(angle)
        jacobian = cross * (self.rotors.inertia_kg_m2 * spin)
        gram = jacobian @ jacobian.swapaxes(-1, -2)
        # det A A^T is greatest for three equal eigenvalues of the same trace.
        largest = (np.trace(gram, axis1=-2, axis2=-1) / 3) ** 3
        return np.sqrt(
            np.maximum(np.linalg.det(gram), 0.0) / np.where(largest > 0, largest, 1.0)
        )

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        """Command gimbal rates (n,) and motor torques u (n,) on the rotors that give torque_nm (3,) on the body.

            torque on the body = -A d(angle)/dt - sum axle u

        A is that of the rotors' inertial spin, which is their speed plus the body's rate along the axle. The body
        also feels -rate x h. The controller's feed-forward must include +rate x h in torque_nm; it is not added here.

        Without a rotor torque limit the rotors get no torque. One factor scales all commands to their limits, which
        keeps the torque's direction.
        """
        # 1. Axles.
        angle = inputs.angles_rad[self.gimbals.qpos]
        axle, derivative = rotor_axles(self.rotors.axes, self.cross_axes, angle)
        # 2. Jacobian. A gimbal rotates the inertial angular momentum, which includes the body's rate along the axle.
        speed = inputs.speeds_rad_s[self.rotors.dof] + inputs.rate_body_rad_s @ axle
        spin_nms = self.rotors.inertia_kg_m2 * speed
        jacobian = derivative * spin_nms
        # The steering laws take A and dh/dt in units of the rotors' mean momentum.
        unit_nms = float(np.abs(spin_nms).mean())
        # 3. and 4. Steering within the limits. Rotors at rest give no gyroscopic torque.
        torque_limit_nm = self.config.rotor_torque_limit_nm
        if torque_limit_nm is not None:
            limits = self.limit, torque_limit_nm
            rate, motor = vscmg_commands(axle, jacobian, unit_nms, -torque_nm, *limits)
            control[self.rotors.motor] = motor
            # sum axle u is the momentum of speeds u / inertia.
            given_nm = self.momentum(angle, motor / self.rotors.inertia_kg_m2)
            return self.command(control, rate, inputs) - given_nm
        rate = np.zeros_like(spin_nms)
        if unit_nms:
            steering = STEERING[self.config.steering]
            rate = steering(jacobian / unit_nms, torque_nm / -unit_nms, inputs.t_s)
        scale_to_limit(rate, self.limit)
        return self.command(control, rate, inputs)

    def command(self, control: Floats, commands: Floats, inputs: ControlInput) -> Floats:
        super().command(control, commands, inputs)
        angle = inputs.angles_rad[self.gimbals.qpos]
        jacobian = self.jacobian(angle, inputs.speeds_rad_s[self.rotors.dof])
        return -jacobian @ control[self.motor]

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return self.momentum(angles_rad[self.gimbals.qpos], speeds_rad_s[self.rotors.dof])


def check_rotor_pairs(spec: Any, path: Path) -> None:
    """Raise InputError unless each rotor is on the gimbal with the same suffix."""
    for gimbal in named(spec.joints, GIMBAL):
        suffix = gimbal.name.removeprefix(GIMBAL)
        rotor = spec.joint(ROTOR + suffix)
        if rotor is None or rotor.parent.parent != gimbal.parent:
            raise InputError(
                path,
                f"joint {gimbal.name} has no joint {ROTOR}{suffix} on a child body of its own",
            )
    if len(named(spec.joints, ROTOR)) != len(named(spec.joints, GIMBAL)):
        raise InputError(path, f"a joint {ROTOR}* has no joint {GIMBAL}* of the same suffix")


def add_cmgs(spec: Any, model: Any, cmgs: CmgsConfig) -> None:
    """Add a rate servo at each gimbal, and a motor at each variable-speed rotor; other rotors keep their momentum.

    The spring of the servo holds the rate against gyroscopic torque from the vehicle's rotation. A damper alone would
    not hold it.
    """
    add_servos(spec, model, GIMBAL, cmgs.gimbal_time_constant_s)
    for joint in named(spec.joints, ROTOR):
        if cmgs.rotor_torque_limit_nm:
            add_motor(spec, joint.name, cmgs.rotor_torque_limit_nm)


def start_cmgs(model: Any, data: Any, config: CmgsConfig) -> None:
    """Set the gimbal angles and rotor speeds at the start."""
    gimbals = Hinges(model, GIMBAL)
    angles = np.radians(
        member_values(config.start_deg, len(gimbals), "vehicle.cmgs.start_deg")
    )
    data.qpos[gimbals.qpos] = angles
    driven = gimbals.motor >= 0
    # A servo whose set-point differs from the angle would jerk the gimbal.
    data.act[model.actuator_actadr[gimbals.motor[driven]]] = angles[driven]
    data.qvel[Hinges(model, ROTOR).dof] = config.rotor_rpm * RPM_RAD_S


CMGS = ActuatorKind(
    "cmgs",
    add_cmgs,
    CmgActuator,
    joints=(GIMBAL, ROTOR),
    start=start_cmgs,
    check=check_rotor_pairs,
)
