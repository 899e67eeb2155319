"""The attitude control law (PID with feed-forward). Independent of the simulator and the actuators."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from skysim.core.jit import jit
from skysim.core.quaternion import apply, cross, inverse, matrix_vector, multiply, to_rotvec
from skysim.core.types import Floats
from skysim.dynamics.guidance import Reference
from skysim.scene.sections.motion import ControlConfig

TORQUE_DEFICIT = (
    0.01  # relative torque deficit that counts as a limit; damped steering gives smaller ones
)


@dataclass(slots=True)
class Pid:
    """Proportional, integral and derivative torque on the rotation vector of the error, with feed-forward.

        torque = J (alpha_ref - kp e - ki int(e) - kd (w - w_ref)) + w x (J w + h)

    The proportional and integral terms together are limited to kd times the rate

        w_most = min(rate limit, sqrt(a |e|)),    a = authority / greatest moment of inertia,

    from which half of the authority still brakes within the angle |e| (cascade saturation: Wie & Lu 1995, J.
    Guidance 18, 1372; its variable limit: Wie, Bailey & Heiberg 2002, J. Guidance 25, 96; both `assumed`). Without
    this limit a large error or rate drives the torque from one limit to the other and the vehicle never comes to
    rest.

    Here e is the rotation vector of ref_from_body and h the momentum stored in wheels or CMGs. The feed-forward
    J alpha + w x (J w + h) is Euler's equation, so that the feedback only has to reject disturbances. Rates and
    torques are in body axes; J is (3, 3). Stateful: one motion each. ki = 0 is a PD controller.
    """

    reference: Reference
    inertia_kg_m2: Floats
    kp: float
    ki: float
    kd: float
    authority_nm: float = math.inf
    rate_limit_rad_s: float = math.inf
    limited: bool = False
    error_rad: Floats = field(default_factory=lambda: np.zeros(3))
    error_sum_rad_s: Floats = field(default_factory=lambda: np.zeros(3))

    def torque_nm(
        self, t_s: float, lab_from_body_wxyz: Floats, rate_body_rad_s: Floats, momentum_nms: Floats
    ) -> Floats:
        """(3,) the commanded torque at t_s, to be held until the next call."""
        gains = self.kp, self.ki, self.kd, self.authority_nm, self.rate_limit_rad_s
        self.error_rad, torque_nm, self.limited = pid_torque(
            self.reference.state_at(t_s),
            (lab_from_body_wxyz, rate_body_rad_s),
            self.error_sum_rad_s,
            self.inertia_kg_m2,
            momentum_nms,
            gains,
        )
        return torque_nm

    def integrate(self, commanded_nm: Floats, achieved_nm: Floats, period_s: float) -> None:
        """Integrate the error, except on axes that got less torque than commanded (anti-windup), and not while limited.

        A positive error commands a negative torque, so on an axis at the positive torque limit a positive error is
        still integrated.
        """
        if not self.limited:
            integrate_error(
                self.error_sum_rad_s, self.error_rad, commanded_nm, achieved_nm, period_s
            )


@jit
def pid_torque(
    reference: tuple[Floats, Floats, Floats],
    state: tuple[Floats, Floats],
    error_sum: Floats,
    inertia: Floats,
    momentum: Floats,
    gains: tuple[float, float, float, float, float],
) -> tuple[Floats, Floats, bool]:
    """Error and torque, (3,) each, of Pid's equation, and whether it was limited; compiled, called every period."""
    lab_from_ref, rate_ref, accel_ref = reference
    lab_from_body, rate = state
    kp, ki, kd, authority, rate_limit = gains
    body_from_ref = multiply(inverse(lab_from_body), lab_from_ref)
    # e is the rotation vector of ref_from_body, the inverse of body_from_ref.
    error = -to_rotvec(body_from_ref)
    rate_error = rate - apply(body_from_ref, rate_ref)
    feedback = kp * error + ki * error_sum
    feedback_size = math.sqrt((feedback**2).sum())
    error_angle = math.sqrt((error**2).sum())
    feedback_limit = kd * min(
        rate_limit,
        math.sqrt(authority / max(inertia[0, 0], inertia[1, 1], inertia[2, 2]) * error_angle),
    )
    # Small errors are not limited: there the integral must be free to balance a constant torque.
    limited = feedback_size > feedback_limit and kp * error_angle > feedback_limit
    if limited:
        feedback = feedback * (feedback_limit / feedback_size)
    acceleration = apply(body_from_ref, accel_ref) - feedback - kd * rate_error
    return (
        error,
        matrix_vector(inertia, acceleration) + cross(rate, matrix_vector(inertia, rate) + momentum),
        limited,
    )


@jit
def integrate_error(
    error_sum: Floats, error: Floats, commanded: Floats, achieved: Floats, period_s: float
) -> None:
    """`Pid.integrate` on one error sum (3,), in place."""
    for i in range(3):
        # Anti-windup: do not integrate further into a limit, but do integrate out of it.
        saturated = abs(achieved[i]) < abs(commanded[i]) * (1 - TORQUE_DEFICIT)
        if not saturated or error[i] * commanded[i] > 0:
            error_sum[i] += error[i] * period_s


def build_controller(
    reference: Reference,
    inertia_kg_m2: ArrayLike,
    config: ControlConfig | None = None,
    authority_nm: float = math.inf,
    rate_limit_rad_s: float = math.inf,
) -> Pid:
    """A controller with its poles placed: the error obeys (s^2 + 2 z b s + b^2)(s + p) = 0 on each axis.

    Bandwidth b and damping z are those of the attitude loop; p, integral_rad_s, is the pole that removes the steady
    error of a constant torque, such as an unbalanced bearing's; law pd is p = 0, and leaves torque / (J b^2). The
    defaults settle in some 5 s, slow enough for a control period of 10 ms (b x period = 0.03).

    Parameters
    ----------
    inertia_kg_m2
        (3,) principal moments or (3, 3) tensor about the bearing, in body axes
    authority_nm
        Torque available in every direction; rate_limit_rad_s : greatest return rate
    """
    config = config or ControlConfig()
    inertia = np.asarray(inertia_kg_m2, dtype=float)
    b = config.bandwidth_rad_s
    z = config.damping
    p = config.integral_rad_s if config.law == "pid" else 0.0
    return Pid(
        reference,
        inertia if inertia.ndim == 2 else np.diag(inertia).copy(),
        kp=b**2 + 2 * z * b * p,
        ki=b**2 * p,
        kd=2 * z * b + p,
        authority_nm=authority_nm,
        rate_limit_rad_s=rate_limit_rad_s,
    )
