"""Fans and cold-gas thrusters: sites `fan_*` and `thruster_*`, which push the body along their own z axis.

Fans follow their command with a first-order lag; momentum is dumped by fans. A thruster's valve is open or closed. In
every control period of length T the flight computer asks for thrusts f >= 0 (`ThrusterActuator`), and the valves
give pulses of the full thrust F (`ValveDrive`):

1. Pulse width: each valve is open for f / F of the period. A pulse shorter than the minimum impulse is not begun; its
   impulse is saved up for a later period, so that the mean is right (sigma-delta modulation).
2. Lag: the thrust follows its valve with a time constant tau,

       df/dt = (F - f) / tau while it is open,    df/dt = -f / tau while it is closed

3. Supply: the mass flow of propellant is f / (specific impulse g0), until the tank is empty. With blowdown F is
   proportional to the pressure, and so to the propellant left. The vehicle's mass properties do not change.

Every step of the integration gets the mean of f over it, so impulse and propellant are exact.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import mujoco
import numpy as np
import scipy

from skysim.core.constants import STANDARD_GRAVITY_M_S2
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
    scale_to_limit,
)
from skysim.scene.sections.motion import DesaturationConfig
from skysim.scene.sections.vehicle import FansConfig, ThrustersConfig

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


# Cold-gas thrusters.

THRUSTER = "thruster_"

# Weight of the thrusts beside the torque, relative to the lever arms: the torque is smaller by its square, 1e-8.
SHARING = 1e-4
SHORTEST_LAG_S = 1e-15  # stands for no lag


class ThrusterActuator(FanSet):
    """Actuators of the flight computer: one-sided thrusters, commanded as if their thrust were continuous.

    Parameters
    ----------
    vehicle
        `VehicleModel`
    config
        The scene's `vehicle.thrusters`
    """

    def __init__(self, vehicle: Any, config: ThrustersConfig) -> None:
        super().__init__(vehicle.thrusters, config.thrust_n)
        lever_m = self.torque_from_command
        self.weighted_m = np.vstack(
            (lever_m, SHARING * np.linalg.norm(lever_m) * np.eye(len(self.motor)))
        )
        # The map is that of thrusters that push both ways, scaled to the greatest thrust of one-sided ones. The scale
        # is 2 if each thruster has an opposite one; else it is that of the worst of 26 directions.
        both_ways = self.command_from_torque
        scales = [
            self.thrusts(torque).max() / np.abs(both_ways @ torque).max()
            for torque in map(np.array, itertools.product((-1.0, 0.0, 1.0), repeat=3))
            if (both_ways @ torque).any()
        ]
        self.command_from_torque = both_ways * max(scales, default=1.0)

    def thrusts(self, torque_nm: Floats) -> Floats:
        """The smallest thrusts (n,) f >= 0 that give the torque (3,) T, or the nearest to it, without a limit.

        They minimize |A f - T|^2 + |SHARING A|^2 |f|^2 for the lever arms A, by non-negative least squares (Lawson &
        Hanson 1974). The second term shares the torque among thrusters that act alike.
        """
        return scipy.optimize.nnls(
            self.weighted_m, np.append(torque_nm, np.zeros(len(self.motor)))
        )[0]

    def drive(self, torque_nm: Floats) -> Floats:
        """The thrusts, scaled to the limit by one factor."""
        thrusts = self.thrusts(torque_nm)
        scale_to_limit(thrusts, self.limit)
        return thrusts

    def command(self, control: Floats, commands: Floats, inputs: ControlInput) -> Floats:
        return super().command(control, np.maximum(commands, 0.0), inputs)


def propellant_kg(impulse_ns: Floats, config: ThrustersConfig) -> Floats:
    """Propellant of these impulses: impulse / (specific impulse g0)."""
    return impulse_ns / (config.specific_impulse_s * STANDARD_GRAVITY_M_S2)


class ValveDrive:
    """Valves and tank of the thrusters, see the module's docstring.

    Parameters
    ----------
    vehicle
        `VehicleModel`
    config
        The scene's `vehicle.thrusters`

    Attributes
    ----------
    readings
        thruster_duty (n,): open fraction of the last period; propellant_kg (): propellant left
    thrust_n
        (n,) present thrusts
    saved_ns, begun_ns
        (n,) impulses saved up for a pulse, and left of a pulse that goes on, both of the full thrust at the start
    """

    def __init__(self, vehicle: Any, config: ThrustersConfig) -> None:
        self.config = config
        self.motor = vehicle.thrusters.motor
        self.step_s = np.float64(vehicle.model.opt.timestep)
        self.lag_s = max(config.time_constant_s, SHORTEST_LAG_S)
        zeros = np.zeros(len(self.motor))
        self.thrust_n = self.saved_ns = self.begun_ns = zeros
        self.readings = {
            "thruster_duty": zeros,
            "propellant_kg": np.array(config.propellant_kg),
        }

    def apply(self, control: Floats, angles_rad: Floats) -> None:
        times_s = self.step_s * np.arange(len(control) + 1)[:, None]
        # 1. Pulses.
        open_s = self.pulses_s(control[0, self.motor], times_s[-1, 0])
        # 2. Lag.
        impulse_ns = self.impulses_ns(open_s, times_s)
        # 3. Supply: the last of the propellant may not last a whole step.
        left_kg = self.readings["propellant_kg"]
        flow_kg = propellant_kg(impulse_ns.sum(axis=1), self.config)
        before_kg = left_kg - np.cumsum(flow_kg) + flow_kg
        share = np.clip(before_kg / np.maximum(flow_kg, np.finfo(float).tiny), 0.0, 1.0)
        control[:, self.motor] = impulse_ns * (share / self.step_s)[:, None]
        left_kg = np.maximum(left_kg - (flow_kg * share).sum(), 0.0)
        self.thrust_n = self.thrust_n * (left_kg > 0)
        self.readings = {
            "thruster_duty": open_s / times_s[-1],
            "propellant_kg": np.asarray(left_kg),
        }

    def pulses_s(self, wanted_n: Floats, period_s: float) -> Floats:
        """(n,) times for which the valves open at the start of the period, for thrusts wanted_n (n,).

        A pulse that is as long as the period may go on in the next.
        """
        thrust_n = self.config.thrust_n
        shortest_ns = self.config.minimum_impulse_ns
        # 1. A pulse begins when the saved impulse is large enough.
        wanted_ns = self.saved_ns + np.clip(wanted_n, 0.0, thrust_n) * period_s
        gives = (wanted_ns >= shortest_ns) | (self.begun_ns > 0)
        pulse_ns = self.begun_ns + np.where(gives, wanted_ns, 0.0)
        # 2. The rest is for later.
        given_ns = np.minimum(pulse_ns, thrust_n * period_s)
        self.begun_ns = pulse_ns - given_ns
        self.saved_ns = np.where(gives, 0.0, wanted_ns)
        return given_ns / thrust_n

    def impulses_ns(self, open_s: Floats, times_s: Floats) -> Floats:
        """(K, n) impulses between the times (K + 1, 1), of valves that are open until open_s (n,).

        The integral of the thrust f(t) with f(0) = f0 is

            F t + (f0 - F) tau (1 - exp(-t / tau))

        and so on from the time when F becomes 0. Afterwards `thrust_n` is f at the last time.
        """
        left = self.readings["propellant_kg"] / self.config.propellant_kg
        full_n = self.config.thrust_n * (
            left if self.config.supply == "blowdown" else left > 0
        )
        opened_s = np.minimum(times_s, open_s)
        closed_s = times_s - opened_s
        excess_n = self.thrust_n - full_n
        at_closing_n = full_n + excess_n * np.exp(-open_s / self.lag_s)
        impulse_ns = full_n * opened_s - self.lag_s * (
            excess_n * np.expm1(-opened_s / self.lag_s)
            + at_closing_n * np.expm1(-closed_s / self.lag_s)
        )
        self.thrust_n = at_closing_n * np.exp(-closed_s[-1] / self.lag_s)
        return np.diff(impulse_ns, axis=0)


def add_thrusters(spec: Any, _: Any, config: ThrustersConfig) -> None:
    """Add a one-sided force at each thruster along z of its site; `ValveDrive` has its lag."""
    for site in named(spec.sites, THRUSTER):
        add_force(spec, site.name, config.thrust_n).ctrlrange = [0.0, config.thrust_n]


THRUSTERS = ActuatorKind(
    "thrusters", add_thrusters, ThrusterActuator, sites=(THRUSTER,), drive=ValveDrive
)
