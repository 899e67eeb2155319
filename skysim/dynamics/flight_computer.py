"""Flight computer: at every control period compute the control torque and allocate it to the actuators.

`FlightComputer.compute_controls` calls the control law (attitude_control.py) with the measured attitude and rate,
subtracts the fans' torque of momentum dumping, and allocates the rest to the chosen actuator set (`allocate`). The
torque that the actuators can give is returned to the law for its anti-windup.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import numpy as np

from skysim.core.constants import RPM_RAD_S
from skysim.core.types import Floats
from skysim.dynamics.actuators import CmgSet, Desaturator, FanSet, WheelSet
from skysim.dynamics.attitude_control import Pid, build_controller
from skysim.dynamics.controllers.adapter import NO_SOURCE, ControllerSource, ExternalLaw, external_law
from skysim.dynamics.controllers.interface import ControllerSetup
from skysim.dynamics.guidance import Reference
from skysim.dynamics.multibody import VehicleModel
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import BUILT_IN_LAWS, ControlConfig
from skysim.scene.sections.vehicle import CmgsConfig, FansConfig, WheelsConfig

GYRO_RATE_FRACTION = 0.7  # of the gyros' rate limit (`assumed`)


class ControlInput(NamedTuple):
    """The controller's inputs at the start of a control period: measured body rate (3,), all of qpos and qvel.

    Of the latter only angles and speeds of wheels and gimbals are used, as encoders without errors.
    """

    t_s: float
    period_s: float
    rate_body_rad_s: Floats
    angles_rad: Floats
    speeds_rad_s: Floats


class Actuators(Protocol):
    """An actuator set: converts a torque (3,) on the body to entries of the controls (nu,)."""

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        """Write the commands; return (3,) the torque that they will give."""
        ...

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        """(3,) stored angular momentum, in body axes."""
        ...

    def command_map(self) -> tuple[Floats, float]:
        """(n, 3) commands per torque on the body with every gimbal at zero, and the limit of each command."""
        ...


class IdealTorque:
    """Ideal actuator: body-axis torques clipped to a limit."""

    def __init__(self, vehicle: VehicleModel) -> None:
        self.motor, self.limit_nm = vehicle.torques, vehicle.config.torque_limit_nm

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        control[self.motor] = achieved_nm = np.clip(torque_nm, -self.limit_nm, self.limit_nm)
        return achieved_nm

    def command_map(self) -> tuple[Floats, float]:
        return np.eye(3), self.limit_nm

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return np.zeros(3)


class WheelActuator:
    """Reaction wheels; see `actuators.WheelSet`."""

    def __init__(self, vehicle: VehicleModel, config: WheelsConfig) -> None:
        self.joints = joints = vehicle.wheels
        limit_rad_s = config.speed_limit_rpm * RPM_RAD_S
        self.model = WheelSet(joints.axes, joints.inertia_kg_m2, config.torque_limit_nm, limit_rad_s)

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        motor = self.model.drive(torque_nm, inputs.speeds_rad_s[self.joints.dof], inputs.period_s)
        control[self.joints.motor] = motor
        return -self.model.axes @ motor

    def command_map(self) -> tuple[Floats, float]:
        return self.model.motor_from_torque, self.model.torque_limit_nm

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return self.model.momentum(speeds_rad_s[self.joints.dof])


class CmgActuator:
    """Control moment gyroscopes; see `actuators.CmgSet`."""

    def __init__(self, vehicle: VehicleModel, config: CmgsConfig) -> None:
        self.gimbals, self.rotors = vehicle.gimbals, vehicle.rotors
        self.rotor_rad_s = config.rotor_rpm * RPM_RAD_S
        self.model = CmgSet(
            self.gimbals.axes,
            self.rotors.axes,
            self.rotors.inertia_kg_m2,
            math.radians(config.gimbal_rate_limit_deg_s),
            config.rotor_torque_limit_nm,
            config.steering,
        )

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        angle, spin = inputs.angles_rad[self.gimbals.qpos], inputs.speeds_rad_s[self.rotors.dof]
        rate, torque = self.model.drive(torque_nm, inputs.rate_body_rad_s, angle, spin, inputs.t_s)
        control[self.gimbals.motor] = rate
        achieved_nm = -self.model.jacobian(angle, spin) @ rate
        if self.model.rotor_torque_limit_nm is not None:
            control[self.rotors.motor] = torque
            achieved_nm -= self.model.momentum(angle, torque / self.model.rotor_inertia_kg_m2)
        return achieved_nm

    def command_map(self) -> tuple[Floats, float]:
        jacobian = self.model.jacobian(np.zeros(len(self.gimbals)), np.full(len(self.rotors), self.rotor_rad_s))
        return np.asarray(np.linalg.pinv(jacobian), dtype=np.float64), self.model.gimbal_rate_limit_rad_s

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return self.model.momentum(angles_rad[self.gimbals.qpos], speeds_rad_s[self.rotors.dof])


class FanActuator:
    """Fans, commanded as if they had no lag; see `actuators.FanSet`."""

    def __init__(self, vehicle: VehicleModel, config: FansConfig) -> None:
        self.motor, self.lag_s = vehicle.fans.motor, config.time_constant_s
        self.model = FanSet(vehicle.fans.axes, vehicle.fans.positions_m, config.thrust_limit_n)

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        thrust = self.model.drive(torque_nm)
        control[self.motor] = thrust
        return self.model.torque(thrust)

    def command_map(self) -> tuple[Floats, float]:
        return self.model.thrust_from_torque, self.model.thrust_limit_n

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        return np.zeros(3)


def authority_nm(actuators: Actuators) -> float:
    """Torque available in every direction with every command within its limit."""
    command_from_torque, limit = actuators.command_map()
    return float(limit / np.linalg.norm(command_from_torque, axis=1).max())


def usage(actuators: Actuators, torque_nm: Floats) -> Floats:
    """(N,) greatest command over its limit, for torques (N, 3) on the body."""
    command_from_torque, limit = actuators.command_map()
    return np.asarray(np.abs(torque_nm @ command_from_torque.T).max(axis=1) / limit)


# The actuator set for each key of `vehicle` that switches one on.
ACTUATORS: dict[str, Callable[..., Actuators]] = {
    "wheels": WheelActuator,
    "cmgs": CmgActuator,
    "fans": FanActuator,
}


def build_actuators(scene: Scene, vehicle: VehicleModel) -> dict[str, Actuators]:
    """All actuators that are switched on, by their key in `vehicle`."""
    return {
        key: actuator_type(vehicle, config)
        for key, actuator_type in ACTUATORS.items()
        if (config := getattr(scene.vehicle, key)) is not None
    }


def controlling_actuator(
    config: ControlConfig, actuator_sets: Mapping[str, Actuators], vehicle: VehicleModel
) -> Actuators:
    """The actuators that the controller's torque is given to."""
    return IdealTorque(vehicle) if config.actuators == "ideal" else actuator_sets[config.actuators]


class MomentumDump:
    """Momentum dumping by fans, with a model of their lag."""

    def __init__(self, fans: Actuators, desaturator: Desaturator) -> None:
        assert isinstance(fans, FanActuator)
        self.fans, self.desaturator = fans, desaturator
        self.fan_torque_nm = np.zeros(3)

    def allocate(self, control: Floats, momentum_nms: Floats, inputs: ControlInput) -> Floats:
        """Command the fans; return (3,) the torque that they give now according to the lag model."""
        present_nm = self.fan_torque_nm
        commanded_nm = self.fans.allocate(control, self.desaturator.torque(momentum_nms), inputs)
        # First-order lag of the fans over one period; the torque at its start is the one that acts now.
        self.fan_torque_nm = present_nm + (commanded_nm - present_nm) * -math.expm1(-inputs.period_s / self.fans.lag_s)
        return present_nm


class FlightComputer:
    """Attitude control with one set of actuators, and momentum dumping with the fans. Stateful: one motion each.

    source            : of external controllers
    actuator_sets     : all actuators that are switched on, by their key in `vehicle`
    control_torque_nm : (3,) control torque of the last period, zeros without a controller
    """

    def __init__(
        self, scene: Scene, vehicle: VehicleModel, reference: Reference, source: ControllerSource = NO_SOURCE
    ) -> None:
        self.config = None if scene.motion.is_prescribed else scene.motion.control
        self.period_s = 1 / scene.control_rate_hz
        self.actuator_sets = build_actuators(scene, vehicle)
        self.nu = vehicle.model.nu
        self.control_torque_nm = np.zeros(3)
        self.momentum_dump: MomentumDump | None = None
        self.actuator: Actuators = IdealTorque(vehicle)
        if self.config is None:
            return
        self.actuator = controlling_actuator(self.config, self.actuator_sets, vehicle)
        self.law = self.build_law(scene, vehicle, reference, source)
        if self.config.desaturation:
            self.momentum_dump = MomentumDump(self.actuator_sets["fans"], Desaturator(self.config.desaturation))

    def build_law(
        self, scene: Scene, vehicle: VehicleModel, reference: Reference, source: ControllerSource
    ) -> Pid | ExternalLaw:
        """The control law that the scene names. Raises InputError if it is unknown or refuses the set-up."""
        config = self.config
        assert config is not None
        torque_nm, rate_limit_rad_s = authority_nm(self.actuator), return_rate_limit_rad_s(scene)
        if source.factory is None and config.law in BUILT_IN_LAWS:
            return build_controller(reference, vehicle.inertia_kg_m2, config, torque_nm, rate_limit_rad_s)
        setup = ControllerSetup(
            self.period_s,
            np.array(vehicle.inertia_kg_m2),
            torque_nm,
            rate_limit_rad_s if math.isfinite(rate_limit_rad_s) else None,
            config.actuators,
            config.feedback,
            config.bandwidth_rad_s,
            config.damping,
            config.integral_rad_s,
            scene.seed,
            dict(config.options),
        )
        return external_law(reference, setup, config, source)

    def close(self) -> None:
        """End the process of an external controller."""
        if self.config and isinstance(self.law, ExternalLaw):
            self.law.close()

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        """(3,) stored in wheels and CMGs, in body axes; the arguments are all of qpos and qvel."""
        stored = np.zeros(3)
        for actuator_set in self.actuator_sets.values():
            stored += actuator_set.momentum_nms(angles_rad, speeds_rad_s)
        return stored

    def compute_controls(
        self,
        inputs: ControlInput,
        lab_from_body_wxyz: Floats,
        momentum_nms: Floats,
        torque_nm: Floats | None = None,
    ) -> Floats:
        """(nu,) controls for this period from the measured attitude (4,) and the stored momentum (3,).

        torque_nm : (3,) in body axes, in place of the control law's
        """
        control = np.zeros(self.nu)
        if self.config is None and torque_nm is None:
            return control
        if torque_nm is None:
            self.control_torque_nm = self.law.torque_nm(
                inputs.t_s, lab_from_body_wxyz, inputs.rate_body_rad_s, momentum_nms
            )
        else:
            self.control_torque_nm = torque_nm
        actuator_torque_nm = self.control_torque_nm
        if self.momentum_dump:
            # The other actuators give the commanded torque minus the fans', which removes their momentum.
            actuator_torque_nm = actuator_torque_nm - self.momentum_dump.allocate(control, momentum_nms, inputs)
        achieved_nm = self.actuator.allocate(control, actuator_torque_nm, inputs)
        if torque_nm is None:
            self.law.integrate(actuator_torque_nm, achieved_nm, self.period_s)
        return control


def return_rate_limit_rad_s(scene: Scene) -> float:
    """Rate limit of the controller's return to the reference: below the gyros' limit if it uses them, else infinite.

    A saturated gyro reads less than the true rate, so a return faster than its limit would not be braked.
    """
    control, imu = scene.motion.control, scene.vehicle.imu
    if control is None or control.feedback == "truth" or imu is None:
        return math.inf
    return GYRO_RATE_FRACTION * math.radians(imu.gyro.rate_limit_deg_s)
