"""Disturbance torques: bearing turbine torque, Earth rotation, air currents, impulses.

`DisturbanceModel.torque_nm` adds them for each control period:

1. Constant in the lab: the turbine torque of the bearing's air jets, and the air current of this period.
2. Apparent torque of the Earth's rotation, from the body's rate and the stored momentum.
3. Impulses (knocks), as the mean torque of each step.

The cable's spring and the air drag depend on the state within a step. MuJoCo computes them (multibody/model.py).
"""

import math

import numpy as np
from numpy.random import Generator

from skysim.core.jit import jit
from skysim.core.quaternion import apply, cross, inverse, matrix_vector
from skysim.core.types import Floats
from skysim.dynamics.guidance import Impulse
from skysim.scene.sections.vehicle import AirCurrentConfig, DisturbancesConfig


@jit
def earth_torque_nm(
    inertia_kg_m2: Floats,
    momentum_nms: Floats,
    rate_body_rad_s: Floats,
    earth_body_rad_s: Floats,
) -> Floats:
    """(3,) apparent torque of the Earth's rotation on a vehicle in the lab, in body axes.

    w is the body's rate in the lab, W the Earth's rate (dW/dt = -w x W in body axes), J the inertia and h the
    rotors' momentum. Euler's equation in inertial space,

        J (w + W)' + h' + (w + W) x (J (w + W) + h) = T,

    equals that of a lab at rest with the additional torque

        T_earth = J (w x W) - w x J W - W x (J w + J W + h).

    Everything is in body axes, (3,) and (3, 3). Gravity is along the plumb line, so the centrifugal force is in it.
    """
    # J W, and the total momentum J (w + W) + h.
    earth_momentum = matrix_vector(inertia_kg_m2, earth_body_rad_s)
    total_momentum = (
        matrix_vector(inertia_kg_m2, rate_body_rad_s) + earth_momentum + momentum_nms
    )
    return (
        matrix_vector(inertia_kg_m2, cross(rate_body_rad_s, earth_body_rad_s))
        - cross(rate_body_rad_s, earth_momentum)
        - cross(earth_body_rad_s, total_momentum)
    )


@jit
def lab_and_earth_torque(
    torque_lab_nm: Floats,
    earth_lab_rad_s: Floats,
    inertia_kg_m2: Floats,
    state: tuple[Floats, Floats, Floats],
) -> Floats:
    """(3,) sum of a torque given in lab axes and of `earth_torque_nm`, in body axes.

    Parameters
    ----------
    torque_lab_nm
        (3,) torque in lab axes
    earth_lab_rad_s
        (3,) Earth's rate in lab axes
    inertia_kg_m2
        (3, 3) inertia about the bearing, in body axes
    state
        lab_from_body_wxyz (4,), body's rate (3,) and rotors' momentum (3,) in body axes
    """
    lab_from_body, rate, momentum = state
    body_from_lab = inverse(lab_from_body)
    earth = apply(body_from_lab, earth_lab_rad_s)
    return apply(body_from_lab, torque_lab_nm) + earth_torque_nm(
        inertia_kg_m2, momentum, rate, earth
    )


class AirCurrent:
    """Torque of air currents: an Ornstein-Uhlenbeck process about each lab axis, sampled every control period.

        T' = a T + sqrt(1 - a^2) rms N(0, 1),    a = exp(-period / correlation time)

    This is exact for samples a period apart. The process starts in its stationary distribution; its
    autocorrelation is rms^2 exp(-|lag| / correlation time).
    """

    def __init__(self, config: AirCurrentConfig, period_s: float, rng: Generator) -> None:
        self.rms_nm = np.array(config.rms_nm)
        self.decay = math.exp(-period_s / config.correlation_s)
        self.rng = rng
        # The stationary distribution.
        self.torque_nm = self.rms_nm * rng.standard_normal(3)

    def sample(self) -> Floats:
        """(3,) torque of this control period in lab axes; draws that of the next period."""
        current = self.torque_nm
        # The innovation keeps the variance at rms^2.
        innovation = math.sqrt(1 - self.decay**2) * self.rms_nm * self.rng.standard_normal(3)
        self.torque_nm = self.decay * current + innovation
        return current


class DisturbanceModel:
    """The disturbances of a vehicle, period by period. Stateful: one object per motion.

    Attributes
    ----------
    turbine_lab_nm
        (3,) constant turbine torque in lab axes
    earth_lab_rad_s
        (3,) Earth's rate in lab axes; zeros if it is off
    air_current
        Air current; None if it is off
    impulses
        Knocks in order of time
    inertia_kg_m2
        (3, 3) inertia about the bearing, in body axes
    inactive
        Whether there is no disturbance
    """

    def __init__(
        self,
        config: DisturbancesConfig,
        earth_lab_rad_s: Floats,
        impulses: tuple[Impulse, ...],
        inertia_kg_m2: Floats,
        period_s: float,
        rng: Generator,
    ) -> None:
        self.turbine_lab_nm = np.array(config.turbine_nm)
        self.earth_lab_rad_s = earth_lab_rad_s if config.earth_rotation else np.zeros(3)
        air = config.air_current
        self.air_current = AirCurrent(air, period_s, rng) if air else None
        self.impulses = impulses
        self.inertia_kg_m2 = inertia_kg_m2
        self.inactive = not (
            self.turbine_lab_nm.any() or self.earth_lab_rad_s.any() or air or impulses
        )

    def torque_nm(
        self,
        times_s: Floats,
        lab_from_body_wxyz: Floats,
        rate_body_rad_s: Floats,
        momentum_nms: Floats,
    ) -> Floats:
        """(K, 3) torque in body axes in each of K steps between the (K + 1,) times of a control period.

        Attitude (4,), rate (3,) and rotors' momentum (3,) are those at the start of the period and are held over
        it: in 10 ms they change by a thousandth. An impulse is a half-sine of torque whose integral is J times its
        change of rate; each step gets the mean torque of its part.
        """
        # 1. Torque that is constant in the lab.
        torque_lab_nm = (
            self.turbine_lab_nm + self.air_current.sample()
            if self.air_current
            else self.turbine_lab_nm
        )
        # 2. The same in body axes, and the Earth's rotation.
        torque_nm = np.empty((len(times_s) - 1, 3))
        torque_nm[:] = lab_and_earth_torque(
            torque_lab_nm,
            self.earth_lab_rad_s,
            self.inertia_kg_m2,
            (lab_from_body_wxyz, rate_body_rad_s, momentum_nms),
        )
        # 3. Impulses that overlap this period.
        for impulse in self.impulses:
            if (
                impulse.begin_s < times_s[-1]
                and times_s[0] < impulse.begin_s + impulse.duration_s
            ):
                # The fraction of the impulse in a step over the step's length is the mean torque of a unit impulse.
                given = impulse.fraction(times_s[:-1], times_s[1:])
                torque_nm += np.outer(
                    given / np.diff(times_s), self.inertia_kg_m2 @ impulse.rate_rad_s
                )
        return torque_nm
