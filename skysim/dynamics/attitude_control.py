"""The attitude control law (PID with feed-forward). Independent of the simulator and the actuators."""

import math

import numpy as np

from skysim.core.jit import jit
from skysim.core.quaternion import apply, cross, inverse, matrix_vector, multiply, to_rotvec
from skysim.core.types import Floats
from skysim.dynamics.guidance import Reference
from skysim.scene.sections.motion import ControlConfig

# Relative torque deficit that counts as saturation; damped steering laws give smaller ones.
TORQUE_DEFICIT = 0.01


class Pid:
    """PID control on the rotation vector of the attitude error, with feed-forward. Stateful: one object per motion.

    1. The attitude error e is the rotation vector of ref_from_body; the rate error is w - w_ref.
    2. The proportional and integral terms are limited together to kd times the return rate

           w_max = min(rate limit, sqrt(a |e|)),    a = authority / greatest moment of inertia.

       Half of the authority then still brakes within the angle |e| (cascade saturation: Wie & Lu 1995, J. Guidance
       18, 1372; its variable limit: Wie, Bailey & Heiberg 2002, J. Guidance 25, 96; both `assumed`). Without this
       limit a large error drives the torque from one limit to the other and the vehicle never comes to rest.
    3. The torque is Euler's equation for the commanded acceleration minus the feedback:

           torque = J (alpha_ref - kp e - ki int(e) - kd (w - w_ref)) + w x (J w + h)

       so the feedback only has to reject disturbances. h is the momentum stored in wheels or CMGs.
    4. After the actuators have answered, the error is integrated, except on saturated axes (`integrate`).

    Rates and torques are in body axes. The gains place the poles: the error obeys
    (s^2 + 2 z b s + b^2)(s + p) = 0 on each axis.

        kp = b^2 + 2 z b p,    ki = b^2 p,    kd = 2 z b + p

    b and z are the bandwidth and damping of the attitude loop. p = integral_rad_s is the pole that removes the
    steady error of a constant torque, such as that of an unbalanced bearing. Law pd has p = 0, which leaves the
    error torque / (J b^2). The defaults settle in about 5 s, slow enough for a control period of 10 ms
    (b x period = 0.03).

    Parameters
    ----------
    reference
        Commanded attitude, rate and acceleration over time
    inertia_kg_m2
        (3, 3) inertia J about the bearing, in body axes
    config
        The scene's `motion.control`; None for its defaults
    authority_nm
        Torque that the actuators can give in every direction
    rate_limit_rad_s
        Greatest return rate

    Attributes
    ----------
    gains
        (5,) gains kp, ki and kd in 1/s2, 1/s3 and 1/s, the same on each axis, authority, and rate limit
    limited
        Whether step 2 limited the last command
    error_rad
        (3,) attitude error of the last command
    error_sum_rad_s
        (3,) integral of the error
    """

    def __init__(
        self,
        reference: Reference,
        inertia_kg_m2: Floats,
        config: ControlConfig | None = None,
        authority_nm: float = math.inf,
        rate_limit_rad_s: float = math.inf,
    ) -> None:
        config = config or ControlConfig()
        self.reference = reference
        self.inertia_kg_m2 = inertia_kg_m2
        # The gains are the coefficients of the expanded polynomial.
        b = config.bandwidth_rad_s
        z = config.damping
        p = config.integral_rad_s if config.law == "pid" else 0.0
        gains = b**2 + 2 * z * b * p, b**2 * p, 2 * z * b + p
        self.gains = np.array([*gains, authority_nm, rate_limit_rad_s])
        self.limited = False
        self.error_rad = np.zeros(3)
        self.error_sum_rad_s = np.zeros(3)

    def torque_nm(
        self,
        t_s: float,
        lab_from_body_wxyz: Floats,
        rate_body_rad_s: Floats,
        momentum_nms: Floats,
    ) -> Floats:
        """(3,) torque commanded at t_s, which is held until the next call."""
        torque_nm = np.empty(3)
        self.limited = pid_torque(
            *self.reference.state_at(t_s),
            lab_from_body_wxyz,
            rate_body_rad_s,
            self.error_sum_rad_s,
            self.inertia_kg_m2,
            momentum_nms,
            self.gains,
            self.error_rad,
            torque_nm,
        )
        return torque_nm

    def integrate(self, commanded_nm: Floats, achieved_nm: Floats, period_s: float) -> None:
        """Integrate the error, except while the return rate is limited or on an axis whose torque saturates.

        A positive error commands a negative torque. On an axis at its positive torque limit a positive error is
        therefore still integrated: it reduces the command.
        """
        if not self.limited:
            integrate_error(
                self.error_sum_rad_s, self.error_rad, commanded_nm, achieved_nm, period_s
            )


@jit
def pid_torque(
    lab_from_ref: Floats,
    rate_ref: Floats,
    accel_ref: Floats,
    lab_from_body: Floats,
    rate: Floats,
    error_sum: Floats,
    inertia: Floats,
    momentum: Floats,
    gains: Floats,
    error: Floats,
    torque: Floats,
) -> bool:
    """Set the torque (3,) by steps 1 to 3 of `Pid`; whether step 2 limited the feedback.

    Parameters
    ----------
    lab_from_ref, rate_ref, accel_ref
        Attitude lab_from_ref_wxyz (4,), rate (3,) and acceleration (3,) in the reference's axes
    lab_from_body, rate
        Attitude lab_from_body_wxyz (4,) and rate (3,) in body axes
    error_sum
        (3,) integral of the error
    inertia
        (3, 3) inertia about the bearing
    momentum
        (3,) momentum stored in wheels and CMGs
    gains
        (5,) kp, ki, kd, authority in N m, rate limit in rad/s
    error, torque
        (3,) attitude error and torque, set in place
    """
    kp, ki, kd, authority, rate_limit = gains
    # 1. Errors. e is the rotation vector of ref_from_body, the inverse of body_from_ref.
    body_from_ref = multiply(inverse(lab_from_body), lab_from_ref)
    error[:] = -to_rotvec(body_from_ref)
    # The reference's rate and acceleration are in its own axes.
    rate_error = rate - apply(body_from_ref, rate_ref)
    # 2. Limit the return rate.
    feedback = kp * error + ki * error_sum
    feedback_size = math.sqrt((feedback**2).sum())
    error_angle = math.sqrt((error**2).sum())
    # w_max = min(rate limit, sqrt(a |e|)).
    feedback_limit = kd * min(
        rate_limit,
        math.sqrt(authority / max(inertia[0, 0], inertia[1, 1], inertia[2, 2]) * error_angle),
    )
    # Small errors are not limited: there the integral must be free to balance a constant torque.
    limited = feedback_size > feedback_limit and kp * error_angle > feedback_limit
    if limited:
        feedback = feedback * (feedback_limit / feedback_size)
    # 3. Euler's equation, with the gyroscopic torque of the body and of the stored momentum.
    acceleration = apply(body_from_ref, accel_ref) - feedback - kd * rate_error
    gyroscopic = cross(rate, matrix_vector(inertia, rate) + momentum)
    wanted = matrix_vector(inertia, acceleration) + gyroscopic
    for n in range(3):
        torque[n] = wanted[n]
    return limited


@jit
def integrate_error(
    error_sum: Floats, error: Floats, commanded: Floats, achieved: Floats, period_s: float
) -> None:
    """Step 4 of `Pid`: add error times period_s to error_sum (3,), in place."""
    for i in range(3):
        # Anti-windup: do not integrate further into saturation, but do integrate out of it.
        saturated = abs(achieved[i]) < abs(commanded[i]) * (1 - TORQUE_DEFICIT)
        if not saturated or error[i] * commanded[i] > 0:
            error_sum[i] += error[i] * period_s
