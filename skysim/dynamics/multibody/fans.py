"""Fans: sites `fan_*`, which push along their own z axis with a first-order lag; momentum dumping by fans."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from skysim.core.types import Floats
from skysim.dynamics.multibody.actuator_kind import (
    ActuatorKind,
    Actuators,
    ControlInput,
    add_motor,
    all_names,
    at_zero,
    inverse,
    named,
)
from skysim.scene.sections.motion import DesaturationConfig
from skysim.scene.sections.vehicle import FansConfig

FAN = "fan_"


class Fans:
    """Fans, or thrusters, of a compiled model: sites with an actuator whose name begins with a prefix, in their order.

    Attributes
    ----------
    names
        Names of the n fans
    axes
        (3, n) unit vectors of the thrust directions, in body axes
    positions_m
        (3, n) positions in body axes
    motor
        (n,) numbers of the actuators
    """

    def __init__(self, model: Any, prefix: str) -> None:
        data = at_zero(model)
        self.names = tuple(sorted(all_names(model.actuator, model.nu, prefix)))
        sites = [model.site(name).id for name in self.names]
        # z axes of the sites.
        self.axes = data.site_xmat[sites].reshape(-1, 3, 3)[:, :, 2].T.copy()
        self.positions_m = data.site_xpos[sites].T.copy()
        motor = [model.actuator(name).id for name in self.names]
        self.motor = np.array(motor, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.names)


class FanSet(Actuators):
    """Actuators of the flight computer: n fans, commanded as if they had no lag. Each can blow either way.

    A thrust has a lever arm about the bearing's center, T = sum position x axis thrust. The bearing takes the net
    force.
    """

    def __init__(self, fans: Fans, thrust_limit_n: float) -> None:
        lever_m = np.cross(fans.positions_m, fans.axes, axis=0)
        super().__init__(fans.motor, lever_m, inverse(lever_m), thrust_limit_n)


class MomentumDump:
    """Momentum dumping by fans, with a model of their lag: torque -h / time once the stored momentum h is too large.

    The controller holds the body still against this torque. The wheels or CMGs absorb it, and h decays as
    exp(-t / time). Stateful: one object per motion.
    """

    def __init__(self, fans: Actuators, lag_s: float, config: DesaturationConfig) -> None:
        self.fans = fans
        self.lag_s = lag_s
        self.config = config
        self.running = False
        self.fan_torque_nm = np.zeros(3)

    def torque(self, momentum_nms: Floats) -> Floats:
        """Torque (3,) that the fans should give: zero until |h| > start, then -h / time until |h| < stop."""
        # Two thresholds (hysteresis), so that the fans do not switch on and off at one.
        magnitude = math.sqrt(float(momentum_nms @ momentum_nms))
        self.running = (
            magnitude >= self.config.stop_nms
            if self.running
            else magnitude > self.config.start_nms
        )
        return momentum_nms * (-1.0 / self.config.time_s) if self.running else np.zeros(3)

    def allocate(self, control: Floats, momentum_nms: Floats, inputs: ControlInput) -> Floats:
        """Command the fans; return the torque (3,) that they give now according to the lag model."""
        present_nm = self.fan_torque_nm
        commanded_nm = self.fans.allocate(control, self.torque(momentum_nms), inputs)
        # First-order lag over one period, T' = T + (command - T) (1 - exp(-period / lag)). The torque at its start
        # acts now.
        self.fan_torque_nm = present_nm + (commanded_nm - present_nm) * -math.expm1(
            -inputs.period_s / self.lag_s
        )
        return present_nm


def add_force(spec: Any, site: str, limit_n: float) -> Any:
    """Add a force along z of a site."""
    return add_motor(spec, site, limit_n, [0, 0, 1, 0, 0, 0], mujoco.mjtTrn.mjTRN_SITE)


def add_fans(spec: Any, _: Any, config: FansConfig) -> None:
    """Add a force at each fan along z of its site, which follows the command with a first-order lag."""
    for site in named(spec.sites, FAN):
        fan = add_force(spec, site.name, config.thrust_limit_n)
        # Not FILTEREXACT, which is exact for Euler steps only: with Runge-Kutta it adds half a step of lag.
        fan.dyntype = mujoco.mjtDyn.mjDYN_FILTER
        fan.dynprm[0] = config.time_constant_s


FANS = ActuatorKind(
    "fans",
    add_fans,
    lambda vehicle, config: FanSet(vehicle.fans, config.thrust_limit_n),
    sites=(FAN,),
)
