"""Command laws of wheels, fans and control moment gyroscopes: torque on the body to actuator commands.

MuJoCo simulates the rotors. Here every vector is in body axes and a set's n members are the columns of (3, n). A
torque T is on the body; the stored momentum h changes by its opposite, dh/dt = -T. Stored momentum also acts on a
rotating body, with -rate x h; the actuators do not compensate this: the controller adds +rate x h to its command.

The inertia that responds to the torque is that of the body without its rotors' inertia about their axles, which do
not follow the body about these: J - sum inertia axle axle^T.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from skysim.core.errors import InputError, unknown_name
from skysim.core.jit import jit
from skysim.core.types import Floats
from skysim.scene.sections.motion import DesaturationConfig

# Generalized singularity-robust inverse and the weights of variable-speed CMGs: the sizes are `assumed`.
DAMPING = 0.01  # lambda at a singularity, in units of the rotors' momentum squared
DITHER = 0.01  # off-diagonal part of the damping
DITHER_RAD_S = math.pi / 2
DAMPING_DECAY = 10.0  # of both away from a singularity: exp(-DAMPING_DECAY det A A^T)
RANK_TOLERANCE = 1e-6  # directions with a smaller fraction of the largest singular value get no torque


@jit
def scale_to_limit(command: Floats, limit: float) -> Floats:
    """Scale all elements of a command by one factor, so that none exceeds the limit and the direction is kept."""
    peak = np.abs(command).max()
    return command * (limit / peak if peak > limit else 1.0)


def unit_columns(axes: Floats, name: str) -> Floats:
    """(3, n) floats; raises InputError unless they are unit vectors."""
    columns = np.ascontiguousarray(axes, dtype=float)  # one layout, or numba compiles for each
    if columns.ndim != 2 or len(columns) != 3 or not columns.size:
        raise InputError(name, f"shape {columns.shape}", "(3, n), one column each")
    norm = np.linalg.norm(columns, axis=0)
    if not np.all(np.abs(norm - 1) < 1e-6):
        raise InputError(name, f"lengths {np.round(norm, 6).tolist()}", "unit vectors")
    return columns


def positive_values(value: Floats, n: int, name: str) -> Floats:
    """(n,) positive floats; raises InputError otherwise."""
    values = np.asarray(value, dtype=float)
    if values.shape != (n,) or not np.all(values > 0):
        raise InputError(name, values.tolist(), f"{n} positive numbers")
    return values


@dataclass(frozen=True, slots=True)
class WheelSet:
    """Reaction wheels: a motor's torque on its wheel acts oppositely on the body, T = -sum axis u.

    axes : (3, n) unit vectors; a positive speed is right-handed about them
    inertia_kg_m2 : (n,) of each wheel about its axle
    speed_limit_rad_s : relative to the body
    Raises InputError (one line) for axes that are not unit vectors and inertias that are not positive.
    """

    axes: Floats
    inertia_kg_m2: Floats
    torque_limit_nm: float
    speed_limit_rad_s: float
    motor_from_torque: Floats = field(init=False, repr=False)  # (n, 3) minus the pseudo-inverse of the axes

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


@dataclass(frozen=True, slots=True)
class FanSet:
    """Fans: thrust with a lever arm about the bearing's center rotates the vehicle, T = sum position x axis thrust.

    force_axes : (3, n) unit vectors along which a positive thrust pushes the body
    positions_m: (3, n) from the center of rotation
    Raises InputError (one line) for axes that are not unit vectors and positions of another shape.
    """

    force_axes: Floats
    positions_m: Floats
    thrust_limit_n: float
    torque_per_thrust_m: Floats = field(init=False, repr=False)  # (3, n) lever arms, N m per N
    thrust_from_torque: Floats = field(init=False, repr=False)  # (n, 3)

    def __post_init__(self) -> None:
        axes, positions = unit_columns(self.force_axes, "fan axes"), np.asarray(self.positions_m, dtype=float)
        if positions.shape != axes.shape:
            raise InputError("fan positions_m", f"shape {positions.shape}", f"{axes.shape}, as the axes")
        arms = np.cross(positions, axes, axis=0)
        object.__setattr__(self, "torque_per_thrust_m", arms)
        object.__setattr__(self, "thrust_from_torque", np.linalg.pinv(arms, rcond=RANK_TOLERANCE))

    def torque(self, thrust_n: Floats) -> Floats:
        """Torque (3,) on the body of thrusts (n,)."""
        return self.torque_per_thrust_m @ thrust_n

    def drive(self, torque_nm: Floats) -> Floats:
        """Thrusts (n,), the smallest that give the torque (3,), or the nearest to it in least squares.

        Beyond the limit all are scaled together, which keeps the direction. Each fan can blow either way. The
        bearing takes the net force.
        """
        return scale_to_limit(self.thrust_from_torque @ torque_nm, self.thrust_limit_n)


@jit
def solve_gram(gram: Floats, rhs: Floats) -> Floats:
    """x of gram x = rhs for a symmetric positive semidefinite (3, 3); singular directions get zero."""
    value, vector = np.linalg.eigh(gram)
    x = np.zeros(3)
    for k in range(3):
        if value[k] > RANK_TOLERANCE**2 * value[2]:
            x += vector[:, k] * ((vector[:, k] * rhs).sum() / value[k])
    return x


@jit
def gram_determinant(m: Floats) -> float:
    """Determinant of A A^T (3, 3), clipped at zero against rounding; np.linalg.det takes several times as long."""
    minor_0 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    minor_1 = m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0]
    minor_2 = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
    return max(m[0, 0] * minor_0 - m[0, 1] * minor_1 + m[0, 2] * minor_2, 0.0)


@jit
def pseudo_inverse(jacobian_unit: Floats, momentum_rate: Floats, t_s: float) -> Floats:
    """The smallest gimbal rates that give a momentum rate, A^T (A A^T)^-1 dh/dt; no singularity avoidance.

    The rates grow without bound near a singularity, and this law tends to steer into one.
    """
    return jacobian_unit.T @ solve_gram(jacobian_unit @ jacobian_unit.T, momentum_rate)


@jit
def singularity_robust(jacobian_unit: Floats, momentum_rate: Floats, t_s: float) -> Floats:
    """Gimbal rates by the generalized singularity-robust inverse: A^T (A A^T + lambda E)^-1 dh/dt.

    Near a singularity lambda = 0.01 exp(-10 det A A^T) keeps the rates bounded, at the price of an error in the
    torque. The off-diagonal elements e_i = 0.01 sin(pi t / 2 + phase_i) of the matrix E, of unit diagonal, move the
    gimbals sideways for a torque along the singular direction, and so out of the singularity. Wie, Bailey & Heiberg
    2001, J. Guidance, Control, and Dynamics 24 (5), 865; the numbers are `assumed`.
    """
    gram = jacobian_unit @ jacobian_unit.T
    damping = DAMPING * math.exp(-DAMPING_DECAY * gram_determinant(gram))
    for row, column, phase in ((1, 2, 0.0), (0, 2, math.pi / 2), (0, 1, math.pi)):
        dither = damping * DITHER * math.sin(DITHER_RAD_S * t_s + phase)
        gram[row, column] += dither
        gram[column, row] += dither
        gram[row, row] += damping / 2  # each row is visited twice
        gram[column, column] += damping / 2
    return jacobian_unit.T @ solve_gram(gram, momentum_rate)


# (jacobian (3, n) of unit rotor momentum, dh/dt (3,) in the same unit, time in s) -> gimbal rates (n,) in rad/s.
STEERING: dict[str, Callable[[Floats, Floats, float], Floats]] = {
    "pseudo_inverse": pseudo_inverse,
    "singularity_robust": singularity_robust,
}


@jit
def rotor_axles(spin_axes: Floats, cross_axes: Floats, angle_rad: Floats) -> tuple[Floats, Floats]:
    """Rotor axles (3, n) at the gimbal angles, s cos + t sin, and their derivative (3, n) by the gimbal angles."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
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
    """Variable-speed CMGs: gimbals and rotors share dh/dt (3,), with the rotors active near gimbal singularities.

    The exact solution that is smallest in a weighted norm: gimbal rates in units of their limit, rotor torques in
    units of theirs times exp(-5 det A A^T) (A of unit rotor momentum), which keeps the rotors idle away from
    singularities. Beyond a limit all are scaled together. Schaub, Vadali & Junkins 1998, J. Astronautical Sciences
    46 (3); weighting by the limits is our own choice, the number is `assumed`.
    """
    gram = jacobian @ jacobian.T
    determinant = gram_determinant(gram) / unit_nms**6 if unit_nms > 0 else 0.0
    gimbal_weight, rotor_weight = rate_limit**2, torque_limit**2 * math.exp(-DAMPING_DECAY * determinant)
    # Weighted minimum norm: x = W B^T (B W B^T)^-1 dh/dt with B = [jacobian, axle] and W = diag(limits^2).
    multiplier = solve_gram(gimbal_weight * gram + rotor_weight * (axle @ axle.T), momentum_rate_nm)
    rate, torque = gimbal_weight * (jacobian.T @ multiplier), rotor_weight * (axle.T @ multiplier)
    scale = 1 / max(1.0, np.abs(rate).max() / rate_limit, np.abs(torque).max() / torque_limit)
    return rate * scale, torque * scale


@dataclass(frozen=True, slots=True)
class CmgSet:
    """Control moment gyroscopes: rotating a spinning rotor's axle gives the torque d(angle)/dt x h.

    gimbal_axes, spin_axes : (3, n) unit vectors at right angles; the rotor's axle at gimbal angle zero
    rotor_inertia_kg_m2    : (n,) of each rotor about its axle
    rotor_torque_limit_nm  : None leaves the rotors to spin; a torque makes them variable-speed CMGs
    steering               : a key of STEERING, which variable-speed CMGs do not use

    A rotor's axle points along s cos(angle) + g x s sin(angle), g the gimbal's and s the spin axis. The torque of
    accelerating a gimbal about its own axis is left out. Raises InputError (one line) for axes that are not unit
    vectors or not at right angles, and for an unknown steering law.
    """

    gimbal_axes: Floats
    spin_axes: Floats
    rotor_inertia_kg_m2: Floats
    gimbal_rate_limit_rad_s: float
    rotor_torque_limit_nm: float | None = None
    steering: str = "singularity_robust"
    cross_axes: Floats = field(init=False, repr=False)  # (3, n) g x s

    def __post_init__(self) -> None:
        gimbal = unit_columns(self.gimbal_axes, "gimbal axes")
        spin = unit_columns(self.spin_axes, "rotor axes")
        inertia = positive_values(self.rotor_inertia_kg_m2, gimbal.shape[1], "rotor_inertia_kg_m2")
        if spin.shape != gimbal.shape or np.abs((gimbal * spin).sum(axis=0)).max() > 1e-6:
            raise InputError("rotor axes", "", "one for each gimbal, at right angles to its axis")
        if self.steering not in STEERING:
            raise InputError("cmgs.steering", *unknown_name("steering law", self.steering, STEERING))
        arrays = {"gimbal_axes": gimbal, "spin_axes": spin, "rotor_inertia_kg_m2": inertia}
        for name, value in arrays.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "cross_axes", np.ascontiguousarray(np.cross(gimbal, spin, axis=0)))

    def momentum(self, angle_rad: Floats, rotor_rad_s: Floats) -> Floats:
        """Angular momentum (3,) of the rotors relative to the body: sum of inertia speed axle."""
        axle, _ = rotor_axles(self.spin_axes, self.cross_axes, angle_rad)
        return axle @ (self.rotor_inertia_kg_m2 * rotor_rad_s)

    def jacobian(self, angle_rad: Floats, rotor_rad_s: Floats) -> Floats:
        """A (3, n), derivative of the momentum by the gimbal angles; columns g x h."""
        _, derivative = rotor_axles(self.spin_axes, self.cross_axes, angle_rad)
        return derivative * (self.rotor_inertia_kg_m2 * rotor_rad_s)

    def manipulability(self, angle_rad: Floats, rotor_rad_s: Floats) -> Floats:
        """Distance from singularity: 1 if torque is equally easy in every direction, 0 if a direction has none.

        sqrt(det A A^T) over its greatest value for the same trace, (sum h^2 / 3)^1.5, which is independent of the
        rotors' size and number. 0 with the rotors at rest. (..., n) -> (...).
        """
        angle, spin = np.asarray(angle_rad)[..., None, :], np.asarray(rotor_rad_s)[..., None, :]
        cross = self.cross_axes * np.cos(angle) - self.spin_axes * np.sin(angle)
        jacobian = cross * (self.rotor_inertia_kg_m2 * spin)
        gram = jacobian @ jacobian.swapaxes(-1, -2)
        largest = (np.trace(gram, axis1=-2, axis2=-1) / 3) ** 3
        return np.sqrt(np.maximum(np.linalg.det(gram), 0.0) / np.where(largest > 0, largest, 1.0))

    def drive(
        self,
        torque_nm: Floats,
        rate_body_rad_s: Floats,
        angle_rad: Floats,
        rotor_rad_s: Floats,
        t_s: float,
    ) -> tuple[Floats, Floats]:
        """Gimbal rates (n,) and motor torques (n,) on the rotors that give torque_nm (3,) on the body.

        torque on the body = -A d(angle)/dt - sum axle u, with A from the rotors' inertial spin, which is their
        speed plus the body's rate along the axle. The body also feels -rate x h: the controller's feed-forward has
        to include +rate x h in torque_nm, it is not added here.

        Without a rotor torque limit the rotors get no torque. Beyond a limit everything is scaled together, which
        keeps the torque's direction.
        """
        axle, derivative = rotor_axles(self.spin_axes, self.cross_axes, angle_rad)
        # A gimbal rotates the rotor's inertial angular momentum, which includes the body's rate along the axle.
        spin_nms = self.rotor_inertia_kg_m2 * (rotor_rad_s + rate_body_rad_s @ axle)
        jacobian = derivative * spin_nms
        unit_nms = float(np.abs(spin_nms).mean())
        if self.rotor_torque_limit_nm is not None:
            limits = self.gimbal_rate_limit_rad_s, self.rotor_torque_limit_nm
            return vscmg_commands(axle, jacobian, unit_nms, -torque_nm, *limits)
        if unit_nms == 0:  # rotors at rest give no gyroscopic torque
            return np.zeros_like(spin_nms), np.zeros_like(spin_nms)
        rate = STEERING[self.steering](jacobian / unit_nms, torque_nm / -unit_nms, t_s)
        return scale_to_limit(rate, self.gimbal_rate_limit_rad_s), np.zeros_like(rate)


@dataclass(slots=True)
class Desaturator:
    """Momentum dumping by fans: torque -h / time on the body, once the stored momentum h exceeds a threshold.

    The controller holds the body still against this torque, so that the wheels or CMGs absorb it and h decays as
    exp(-t / time). Stateful: one motion each.
    """

    config: DesaturationConfig
    running: bool = False

    def torque(self, momentum_nms: Floats) -> Floats:
        """Torque (3,) that the fans should give on the body: zero until |h| > start, then -h / time down to stop."""
        magnitude = math.sqrt(float(momentum_nms @ momentum_nms))
        self.running = magnitude >= self.config.stop_nms if self.running else magnitude > self.config.start_nms
        return momentum_nms * (-1.0 / self.config.time_s) if self.running else np.zeros(3)
