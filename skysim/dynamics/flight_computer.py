"""The vehicle's computer at every tick: the controller's torque, allotted to the actuators that it flies with."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from skysim.core.types import Floats
from skysim.core.units import RPM_RAD_S
from skysim.dynamics.actuators import CmgSet, Desaturator, FanSet, WheelSet
from skysim.dynamics.attitude_control import controller
from skysim.dynamics.guidance import Reference
from skysim.dynamics.multibody import World
from skysim.scene.scene import Scene
from skysim.scene.vehicle import CmgsConfig, FansConfig, WheelsConfig

WITHIN_GYROS = 0.7  # `assumed`


class Now(NamedTuple):
    """A tick's beginning: the body's believed rate (3,), and all of qpos and qvel.

    Only wheels' and gimbals' own encoders read the latter, which have no errors.
    """

    t_s: float
    period_s: float
    rate_body_rad_s: Floats
    angles_rad: Floats
    speeds_rad_s: Floats


class Actuators(Protocol):
    """One set: it takes a torque (3,) wanted on the body and writes into the controls (nu,)."""

    def allot(self, control: Floats, wanted_nm: Floats, now: Now) -> Floats:
        """(3,) the torque that the commands will give."""
        ...

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        """(3,) stored, in body axes."""
        ...

    @property
    def authority_nm(self) -> float:
        """The torque that it can give in every direction, while nothing is at its limit."""
        ...


class Torques:
    """Torques from nowhere about the body's axes, each within its limit."""

    def __init__(self, ship: World) -> None:
        self.motor, self.limit_nm = ship.torques, ship.vehicle.torque_limit_nm

    def allot(self, control: Floats, wanted_nm: Floats, now: Now) -> Floats:
        control[self.motor] = given = np.clip(wanted_nm, -self.limit_nm, self.limit_nm)
        return given

    @property
    def authority_nm(self) -> float:
        return self.limit_nm

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return np.zeros(3)


class OnWheels:
    """Reaction wheels; see `actuators.WheelSet`."""

    def __init__(self, ship: World, part: WheelsConfig) -> None:
        self.at = at = ship.wheels
        limit_rad_s = part.speed_limit_rpm * RPM_RAD_S
        self.set = WheelSet(at.axes, at.inertia_kg_m2, part.torque_limit_nm, limit_rad_s)

    def allot(self, control: Floats, wanted_nm: Floats, now: Now) -> Floats:
        motor = self.set.drive(wanted_nm, now.speeds_rad_s[self.at.dof], now.period_s)
        control[self.at.motor] = motor
        return -self.set.axes @ motor

    @property
    def authority_nm(self) -> float:
        return weakest(self.set.motor_from_torque, self.set.torque_limit_nm)

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return self.set.momentum(speeds_rad_s[self.at.dof])


class OnCmgs:
    """Control moment gyroscopes; see `actuators.CmgSet`."""

    def __init__(self, ship: World, part: CmgsConfig) -> None:
        self.gimbals, self.rotors = ship.gimbals, ship.rotors
        self.rotor_rad_s = part.rotor_rpm * RPM_RAD_S
        self.set = CmgSet(
            self.gimbals.axes,
            self.rotors.axes,
            self.rotors.inertia_kg_m2,
            math.radians(part.gimbal_rate_limit_deg_s),
            part.rotor_torque_limit_nm,
            part.steering,
        )

    def allot(self, control: Floats, wanted_nm: Floats, now: Now) -> Floats:
        angle, spin = now.angles_rad[self.gimbals.qpos], now.speeds_rad_s[self.rotors.dof]
        rate, torque = self.set.drive(wanted_nm, now.rate_body_rad_s, angle, spin, now.t_s)
        control[self.gimbals.motor] = rate
        given = -self.set.jacobian(angle, spin) @ rate
        if self.set.rotor_torque_limit_nm is not None:
            control[self.rotors.motor] = torque
            given -= self.set.momentum(angle, torque / self.set.rotor_inertia_kg_m2)
        return given

    @property
    def authority_nm(self) -> float:
        """With every gimbal at zero."""
        jacobian = self.set.jacobian(np.zeros(len(self.gimbals)), np.full(len(self.rotors), self.rotor_rad_s))
        return weakest(
            np.asarray(np.linalg.pinv(jacobian), dtype=np.float64), self.set.gimbal_rate_limit_rad_s
        )

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return self.set.momentum(angles_rad[self.gimbals.qpos], speeds_rad_s[self.rotors.dof])


class OnFans:
    """Fans, as if they gave at once what they give after their lag; see `actuators.FanSet`."""

    def __init__(self, ship: World, part: FansConfig) -> None:
        self.motor, self.lag_s = ship.fans.motor, part.time_constant_s
        self.set = FanSet(ship.fans.axes, ship.fans.places_m, part.thrust_limit_n)

    def allot(self, control: Floats, wanted_nm: Floats, now: Now) -> Floats:
        thrust = self.set.drive(wanted_nm)
        control[self.motor] = thrust
        return self.set.torque(thrust)

    @property
    def authority_nm(self) -> float:
        return weakest(self.set.thrust_from_torque, self.set.thrust_limit_n)

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return np.zeros(3)


def weakest(command_from_torque: Floats, limit: float) -> float:
    """The torque in every direction that keeps each of n commands (n, 3) within its limit."""
    return float(limit / np.linalg.norm(command_from_torque, axis=1).max())


# How each key of `vehicle` that switches actuators on is flown with.
ACTUATORS: dict[str, Callable[..., Actuators]] = {"wheels": OnWheels, "cmgs": OnCmgs, "fans": OnFans}


class Unloading:
    """Fans that take momentum out of the other actuators, and what they give in the meantime."""

    def __init__(self, fans: Actuators, desaturator: Desaturator) -> None:
        assert isinstance(fans, OnFans)
        self.fans, self.desaturator = fans, desaturator
        self.blown_nm = np.zeros(3)

    def allot(self, control: Floats, momentum_nms: Floats, now: Now) -> Floats:
        """(3,) torque that the fans give now, as their lag is believed to be."""
        before = self.blown_nm
        asked = self.fans.allot(control, self.desaturator.torque(momentum_nms), now)
        self.blown_nm = before + (asked - before) * -math.expm1(-now.period_s / self.fans.lag_s)
        return before


class FlightComputer:
    """Steers with one set of actuators, and takes momentum out of it with the fans. Stateful: one flight each.

    sets      : all actuators that are switched on, by their key in `vehicle`
    wanted_nm : (3,) what the controller asked for at the last tick, zeros where nobody flies
    """

    def __init__(self, scene: Scene, ship: World, reference: Reference) -> None:
        self.told, self.period_s = scene.motion.control, 1 / scene.control_rate_hz
        self.sets = {
            key: kind(ship, part)
            for key, kind in ACTUATORS.items()
            if (part := getattr(scene.vehicle, key)) is not None
        }
        self.nu = ship.model.nu
        self.wanted_nm = np.zeros(3)
        self.unloading: Unloading | None = None
        if self.told is None:
            return
        self.hands = Torques(ship) if self.told.actuators == "ideal" else self.sets[self.told.actuators]
        authority_nm, fastest_rad_s = self.hands.authority_nm, believable_rad_s(scene)
        self.law = controller(reference, ship.inertia_kg_m2, self.told, authority_nm, fastest_rad_s)
        if self.told.desaturation:
            self.unloading = Unloading(self.sets["fans"], Desaturator(self.told.desaturation))

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        """(3,) stored in wheels and CMGs, in body axes; the arguments are all of qpos and qvel."""
        stored = np.zeros(3)
        for one in self.sets.values():
            stored += one.momentum_nms(angles_rad, speeds_rad_s)
        return stored

    def steer(self, now: Now, lab_from_body_wxyz: Floats, momentum_nms: Floats) -> Floats:
        """(nu,) controls for the tick that begins, from the believed attitude (4,) and the stored momentum (3,)."""
        control = np.zeros(self.nu)
        if self.told is None:
            return control
        self.wanted_nm = self.law.torque_nm(now.t_s, lab_from_body_wxyz, now.rate_body_rad_s, momentum_nms)
        rest_nm = self.wanted_nm
        if self.unloading:
            rest_nm = rest_nm - self.unloading.allot(control, momentum_nms, now)
        given_nm = self.hands.allot(control, rest_nm, now)
        self.law.learn(rest_nm, given_nm, self.period_s)
        return control


def believable_rad_s(scene: Scene) -> float:
    """How fast the controller may let the vehicle turn back: below what its gyros can follow, if it steers by them.

    A gyro at its limit shows less than the true rate. A rate of return below that limit still brakes.
    """
    told, imu = scene.motion.control, scene.vehicle.imu
    if told is None or told.feedback == "truth" or imu is None:
        return math.inf
    return WITHIN_GYROS * math.radians(imu.gyro.rate_limit_deg_s)
