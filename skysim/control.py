"""What the vehicle is told to do, and the controller that makes it so. Knows nothing of the simulator."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from skysim.scene import Attitude, Hold, Motion, Slew
from skysim.types import Floats


def attitude(angles: Attitude | Slew) -> Rotation:
    """3-2-1 Euler angles (intrinsic ZYX) to lab_from_body = Rz(yaw) Ry(pitch) Rx(roll); degrees in."""
    return Rotation.from_euler("ZYX", [angles.yaw_deg, angles.pitch_deg, angles.roll_deg], degrees=True)


@dataclass(frozen=True, slots=True)
class Turn:
    """A rest-to-rest turn about one axis, which stands still in the body and in the lab (Euler's theorem).

    The rate rises along the smoothstep 3x^2 - 2x^3 (x = t / ramp_s), cruises at rate_rad_s and falls
    likewise: the acceleration is continuous, zero at both ends of a ramp, and 1.5 rate_rad_s / ramp_s at its
    middle. A hold is a turn of no angle.

    lab_from_start : attitude at the start
    axis_body      : (3,) unit vector (zeros for a hold)
    """

    lab_from_start: Rotation
    axis_body: Floats
    angle_rad: float
    rate_rad_s: float
    ramp_s: float
    duration_s: float

    def rise(self, t_s: float) -> tuple[float, float, float]:
        """Angle, rate and acceleration of a start from rest that goes on cruising."""
        x = min(t_s / self.ramp_s, 1.0)
        angle = self.rate_rad_s * (self.ramp_s * x**3 * (1 - x / 2) + max(t_s - self.ramp_s, 0.0))
        return angle, self.rate_rad_s * x**2 * (3 - 2 * x), self.rate_rad_s / self.ramp_s * 6 * x * (1 - x)

    def at(self, t_s: float) -> tuple[Rotation, Floats, Floats]:
        """lab_from_ref, rate and acceleration in its body axes, 0 <= t_s <= duration_s after the start."""
        if t_s <= self.duration_s / 2:
            angle, rate, acceleration = self.rise(t_s)
        else:  # the second half is the first one played backwards
            left, rate, braking = self.rise(self.duration_s - t_s)
            angle, acceleration = self.angle_rad - left, -braking
        turned = Rotation.from_rotvec(angle * self.axis_body)
        return self.lab_from_start * turned, rate * self.axis_body, acceleration * self.axis_body


def hold(lab_from_start: Rotation, duration_s: float) -> Turn:
    """No motion for a while."""
    return Turn(lab_from_start, np.zeros(3), 0.0, 0.0, 1.0, duration_s)


def slew(lab_from_start: Rotation, lab_from_end: Rotation, rate_rad_s: float, accel_rad_s2: float) -> Turn:
    """The shortest eigen-axis turn, as quick as the two limits allow.

    A ramp to the rate v takes 1.5 v / a and 0.75 v^2 / a of angle; a turn too short for two of them peaks at
    v = sqrt(a angle / 1.5) and never cruises.
    """
    turn = (lab_from_start.inv() * lab_from_end).as_rotvec()
    angle = float(np.linalg.norm(turn))
    if angle < 1e-12:
        return hold(lab_from_start, 0.0)
    rate = min(rate_rad_s, math.sqrt(accel_rad_s2 * angle / 1.5))
    ramp = 1.5 * rate / accel_rad_s2
    return Turn(lab_from_start, turn / angle, angle, rate, ramp, ramp + angle / rate)


@dataclass(frozen=True, slots=True)
class Reference:
    """The attitude asked for, at every time: turn after turn, then the last attitude for ever.

    start_s : when each turn starts, ascending from 0
    """

    turns: tuple[Turn, ...]
    start_s: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        return self.start_s[-1] + self.turns[-1].duration_s

    def at(self, t_s: float) -> tuple[Rotation, Floats, Floats]:
        """lab_from_ref, its angular rate (rad/s) and acceleration (rad/s2), each (3,) in its own axes."""
        k = max(bisect.bisect_right(self.start_s, t_s) - 1, 0)
        turn = self.turns[k]
        return turn.at(min(max(t_s - self.start_s[k], 0.0), turn.duration_s))


def plan(motion: Motion, lab_from_start: Rotation | None = None) -> Reference:
    """The manoeuvre as one continuous reference; every slew starts where the element before it ended.

    lab_from_start defaults to motion.start, or to the identity where that is a pointing among the stars: the
    slews of such a scene are counted from the attitude in which it starts.
    """
    here = lab_from_start if lab_from_start is not None else start(motion)
    turns: list[Turn] = []
    for element in motion.manoeuvre:
        if isinstance(element, Hold):
            turns.append(hold(here, element.duration_s))
        else:
            there = attitude(element)
            limits = math.radians(element.rate_deg_s), math.radians(element.acceleration_deg_s2)
            turns.append(slew(here, there, *limits))
            here = there
    turns = turns or [hold(here, 0.0)]
    ends = np.cumsum([turn.duration_s for turn in turns])
    return Reference(tuple(turns), (0.0, *map(float, ends[:-1])))


def start(motion: Motion) -> Rotation:
    """lab_from_body at the start: the identity for a pointing, which defines the lab by the body."""
    return attitude(motion.start) if isinstance(motion.start, Attitude) else Rotation.identity()


@dataclass(slots=True)
class Pid:
    """Proportional, integral and derivative torque on the rotation vector of the error, with feed-forward.

        torque = J (alpha_ref - kp e - ki int(e) - kd (w - w_ref)) + w x J w

    where e is the rotation vector of ref_from_body. The feed-forward J alpha + w x J w is Euler's equation,
    so that the feedback has only the disturbances to fight. The integral stops on an axis whose torque is at
    its limit, unless the error drives it back (anti-windup). Stateful: one flight each. Rates and torques
    are in body axes; J is (3, 3).
    """

    reference: Reference
    inertia_kg_m2: Floats
    torque_limit_nm: float
    kp: float
    ki: float
    kd: float
    last_s: float | None = None
    error_sum_rad_s: Floats = field(default_factory=lambda: np.zeros(3))

    def __call__(self, t_s: float, lab_from_body: Rotation, rate_body_rad_s: Floats) -> Floats:
        """The torque (N m) asked for at t_s, within the limit; to be held until the next call."""
        lab_from_ref, rate_ref, accel_ref = self.reference.at(t_s)
        ref_from_body = lab_from_ref.inv() * lab_from_body
        error = ref_from_body.as_rotvec()
        # Row vectors times ref_from_body turn from the reference's axes to the body's.
        rate_wanted, accel_wanted = np.array([rate_ref, accel_ref]) @ ref_from_body.as_matrix()
        feedback = (
            self.kp * error + self.kd * (rate_body_rad_s - rate_wanted) + self.ki * self.error_sum_rad_s
        )
        gyroscopic = cross(rate_body_rad_s, self.inertia_kg_m2 @ rate_body_rad_s)
        torque = self.inertia_kg_m2 @ (accel_wanted - feedback) + gyroscopic
        self.integrate(t_s, error, torque)
        return np.clip(torque, -self.torque_limit_nm, self.torque_limit_nm)

    def integrate(self, t_s: float, error: Floats, torque: Floats) -> None:
        """Add the error since the last call, but not on an axis where it would push deeper into the limit."""
        step = t_s - self.last_s if self.last_s is not None else 0.0
        self.last_s = t_s
        # A positive error asks for a negative torque: it helps an axis that is stuck at the positive limit.
        free = (np.abs(torque) < self.torque_limit_nm) | (np.sign(error) == np.sign(torque))
        self.error_sum_rad_s = self.error_sum_rad_s + np.where(free, error * step, 0.0)


def cross(a: Floats, b: Floats) -> Floats:
    """a x b of two 3-vectors; np.cross takes ten times as long over a single pair."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def pid(
    reference: Reference,
    inertia_kg_m2: ArrayLike,
    torque_limit_nm: float = math.inf,
    bandwidth_rad_s: float = 3.0,
    damping: float = 0.8,
    integral_rad_s: float = 0.6,
) -> Pid:
    """A controller with poles placed: the error obeys (s^2 + 2 z b s + b^2)(s + p) = 0 on each axis.

    inertia_kg_m2 : (3,) principal moments or (3, 3) tensor about the bearing, in body axes
    bandwidth b and damping z are those of the attitude loop; p, integral_rad_s, is the pole that takes away
    what a constant torque, such as an unbalanced bearing's, would leave. The defaults settle in some 5 s,
    slow enough for a control period of 10 ms (b x period = 0.03).
    """
    inertia = np.asarray(inertia_kg_m2, dtype=float)
    b, p = bandwidth_rad_s, integral_rad_s
    return Pid(
        reference,
        inertia if inertia.ndim == 2 else np.diag(inertia),
        torque_limit_nm,
        kp=b**2 + 2 * damping * b * p,
        ki=b**2 * p,
        kd=2 * damping * b + p,
    )
