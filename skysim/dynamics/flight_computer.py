"""Flight computer: at every control period compute the control torque and allocate it to the actuators.

`FlightComputer.steer` calls the control law (attitude_control.py) with the measured attitude and rate, subtracts
what the fans give for momentum dumping, and has the chosen actuator set convert the rest to commands (`allot`). The
law gets the torque that the actuators give back, for its anti-windup.
"""

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

WITHIN_GYROS = 0.7  # of the gyros' rate limit (`assumed`)


class Now(NamedTuple):
    """The controller's inputs at the start of a control period: measured body rate (3,), all of qpos and qvel.

    Of the latter only angles and speeds of wheels and gimbals are used, as encoders without errors.
    """

    t_s: float
    period_s: float
    rate_body_rad_s: Floats
    angles_rad: Floats
    speeds_rad_s: Floats


class Actuators(Protocol):
    """An actuator set: converts a torque (3,) wanted on the body to entries of the controls (nu,)."""

    def allot(self, control: Floats, wanted_nm: Floats, now: Now) -> Floats:
        """Write the commands; return (3,) the torque that they will give."""
        ...

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        """(3,) stored angular momentum, in body axes."""
        ...

    @property
    def authority_nm(self) -> float:
        """The torque available in every direction while no member is at its limit."""
        ...


class IdealTorque:
    """Ideal actuator: body-axis torques clipped to a limit."""

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


class WheelActuator:
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


class CmgActuator:
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
        """Torque available in every direction, with every gimbal at zero."""
        jacobian = self.set.jacobian(np.zeros(len(self.gimbals)), np.full(len(self.rotors), self.rotor_rad_s))
        return weakest(
            np.asarray(np.linalg.pinv(jacobian), dtype=np.float64), self.set.gimbal_rate_limit_rad_s
        )

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return self.set.momentum(angles_rad[self.gimbals.qpos], speeds_rad_s[self.rotors.dof])


class FanActuator:
    """Fans, commanded as if they had no lag; see `actuators.FanSet`."""

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
    """Torque available in every direction with each of n commands, rows of (n, 3), within its limit."""
    return float(limit / np.linalg.norm(command_from_torque, axis=1).max())


# The actuator set for each key of `vehicle` that switches one on.
ACTUATORS: dict[str, Callable[..., Actuators]] = {
    "wheels": WheelActuator,
    "cmgs": CmgActuator,
    "fans": FanActuator,
}


class MomentumDump:
    """Momentum dumping by fans, with a model of their lag."""

    def __init__(self, fans: Actuators, desaturator: Desaturator) -> None:
        assert isinstance(fans, FanActuator)
        self.fans, self.desaturator = fans, desaturator
        self.blown_nm = np.zeros(3)

    def allot(self, control: Floats, momentum_nms: Floats, now: Now) -> Floats:
        """Command the fans; return (3,) the torque that they give now according to the lag model."""
        before = self.blown_nm
        asked = self.fans.allot(control, self.desaturator.torque(momentum_nms), now)
        # First-order lag of the fans over one period; the torque at its start is the one that acts now.
        self.blown_nm = before + (asked - before) * -math.expm1(-now.period_s / self.fans.lag_s)
        return before


class FlightComputer:
    """Attitude control with one set of actuators, and momentum dumping with the fans. Stateful: one motion each.

    sets      : all actuators that are switched on, by their key in `vehicle`
    wanted_nm : (3,) control torque of the last period, zeros without a controller
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
        self.unloading: MomentumDump | None = None
        if self.told is None:
            return
        self.hands = IdealTorque(ship) if self.told.actuators == "ideal" else self.sets[self.told.actuators]
        authority_nm, fastest_rad_s = self.hands.authority_nm, believable_rad_s(scene)
        self.law = controller(reference, ship.inertia_kg_m2, self.told, authority_nm, fastest_rad_s)
        if self.told.desaturation:
            self.unloading = MomentumDump(self.sets["fans"], Desaturator(self.told.desaturation))

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        """(3,) stored in wheels and CMGs, in body axes; the arguments are all of qpos and qvel."""
        stored = np.zeros(3)
        for one in self.sets.values():
            stored += one.momentum_nms(angles_rad, speeds_rad_s)
        return stored

    def steer(self, now: Now, lab_from_body_wxyz: Floats, momentum_nms: Floats) -> Floats:
        """(nu,) controls for this period from the measured attitude (4,) and the stored momentum (3,)."""
        control = np.zeros(self.nu)
        if self.told is None:
            return control
        self.wanted_nm = self.law.torque_nm(now.t_s, lab_from_body_wxyz, now.rate_body_rad_s, momentum_nms)
        rest_nm = self.wanted_nm
        if self.unloading:
            # The other actuators give the wanted torque less the fans', which takes momentum out of them.
            rest_nm = rest_nm - self.unloading.allot(control, momentum_nms, now)
        given_nm = self.hands.allot(control, rest_nm, now)
        self.law.learn(rest_nm, given_nm, self.period_s)
        return control


def believable_rad_s(scene: Scene) -> float:
    """Rate limit of the controller's return to the reference: below the gyros' limit if it uses them, else infinite.

    A saturated gyro reads less than the true rate, so a return faster than its limit would not be braked.
    """
    told, imu = scene.motion.control, scene.vehicle.imu
    if told is None or told.feedback == "truth" or imu is None:
        return math.inf
    return WITHIN_GYROS * math.radians(imu.gyro.rate_limit_deg_s)
