"""Flight computer: compute the control torque of every control period and allocate it to the actuators.

`FlightComputer.compute_controls` does the following:

1. Call the control law (attitude_control.py or an external controller) with the measured attitude and rate.
2. Subtract the torque of the fans that dump momentum.
3. Allocate the rest to the chosen actuators.
4. Return the torque that they can give to the law, for its anti-windup.

Another program may replace the law by a torque, or single motors' commands (`Commands`).
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from skysim.core.plugins import NO_PROGRAMS, Programs
from skysim.core.types import Floats, lengths
from skysim.dynamics.attitude_control import Pid
from skysim.dynamics.controllers import ControllerSetup, ExternalLaw, external_law
from skysim.dynamics.guidance import Reference
from skysim.dynamics.multibody import VehicleModel
from skysim.dynamics.multibody.actuator_kind import Actuators, ControlInput
from skysim.dynamics.multibody.model import build_actuators
from skysim.dynamics.multibody.thrusters import MomentumDump
from skysim.dynamics.multibody.wheels import WheelActuator
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import BUILT_IN_LAWS

# Return rate of the controller over the gyros' rate limit (`assumed`)
GYRO_RATE_FRACTION = 0.7


class Commands(NamedTuple):
    """What another program commands in place of the control law in one control period.

    Attributes
    ----------
    torque_nm
        (3,) torque in body axes, which the actuators of the control law give; None without
    motors
        Commands (n,) of the single motors by the key of their set in `vehicle`, in the units and the order of
        `Actuators.command`; those of the law's own actuators replace the law
    """

    torque_nm: Floats | None = None
    motors: Mapping[str, Floats] = MappingProxyType({})


NO_COMMANDS = Commands()


def authority_nm(actuators: Actuators) -> float:
    """Torque available in every direction with every command within its limit.

    A torque T of unit length in the worst direction demands max |command_from_torque T| = the greatest row norm.
    """
    return float(actuators.limit / lengths(actuators.command_from_torque).max())


def usage(actuators: Actuators, torque_nm: Floats) -> Floats:
    """(N,) ratio of the greatest command to its limit, for torques (N, 3) on the body."""
    commands = np.abs(torque_nm @ actuators.command_from_torque.T)
    return commands.max(axis=1) / actuators.limit


class FlightComputer:
    """Attitude control with one set of actuators, and momentum dumping with the fans. Stateful: one object per motion.

    Attributes
    ----------
    config
        The scene's `motion.control`; None if the motion is prescribed
    period_s
        Control period
    actuator_sets
        All actuators that are switched on, by their key in `vehicle`, and `ideal`
    stores
        Those that store momentum
    actuator
        Actuators that receive the control torque
    control_torque_nm
        (3,) control torque of the last period in body axes; zeros without a controller
    achieved_nm
        (3,) torque in body axes that actuators and fans give in the last period
    control
        (nu,) controls of the last period
    names
        Names of the n motors that the law commands
    momentum_dump
        Momentum dumping; None if it is off
    """

    def __init__(
        self,
        scene: Scene,
        vehicle: VehicleModel,
        reference: Reference,
        programs: Programs = NO_PROGRAMS,
    ) -> None:
        self.config = None if scene.motion.is_prescribed else scene.motion.control
        self.period_s = 1 / scene.control_rate_hz
        self.actuator_sets = build_actuators(scene.vehicle, vehicle)
        self.stores = [
            one for one in self.actuator_sets.values() if hasattr(one, "momentum_nms")
        ]
        self.control = np.zeros(vehicle.model.nu)
        self.control_torque_nm = np.zeros(3)
        self.achieved_nm = np.zeros(3)
        self.names: list[str] = []
        self.momentum_dump: MomentumDump | None = None
        self.actuator = self.actuator_sets["ideal"]
        if self.config is None:
            return
        # With a controller: its actuators, its law, and the fans that dump momentum.
        self.actuator = self.actuator_sets[self.config.actuators]
        self.names = [vehicle.model.actuator(number).name for number in self.actuator.motor]
        self.law = self.build_law(scene, vehicle, reference, programs)
        fans = scene.vehicle.fans
        if self.config.desaturation and fans:
            self.momentum_dump = MomentumDump(
                self.actuator_sets["fans"], fans.time_constant_s, self.config.desaturation
            )

    def build_law(
        self,
        scene: Scene,
        vehicle: VehicleModel,
        reference: Reference,
        programs: Programs,
    ) -> Pid | ExternalLaw:
        """The control law that the scene names. Raises InputError if it is unknown or refuses the set-up."""
        config = self.config
        assert config is not None
        torque_nm = authority_nm(self.actuator)
        rate_limit_rad_s = return_rate_limit_rad_s(scene)
        if config.law in BUILT_IN_LAWS and config.law not in programs:
            return Pid(reference, vehicle.inertia_kg_m2, config, torque_nm, rate_limit_rad_s)
        # An external controller gets the same numbers that place the poles of the built-in one.
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
        return external_law(reference, setup, config, programs)

    def close(self) -> None:
        """End the process of an external controller."""
        if self.config and isinstance(self.law, ExternalLaw):
            self.law.close()

    def momentum_nms(self, angles_rad: Floats, speeds_rad_s: Floats) -> Floats:
        """(3,) momentum stored in wheels and CMGs, in body axes; the arguments are the full qpos and qvel."""
        stored_nms = np.zeros(3)
        for one in self.stores:
            stored_nms += one.momentum_nms(angles_rad, speeds_rad_s)
        return stored_nms

    def compute_controls(
        self,
        inputs: ControlInput,
        lab_from_body_wxyz: Floats,
        momentum_nms: Floats,
        commands: Commands = NO_COMMANDS,
    ) -> Floats:
        """(nu,) controls for this period.

        Parameters
        ----------
        inputs
            Time, measured rate and encoder readings
        lab_from_body_wxyz
            (4,) measured attitude
        momentum_nms
            (3,) momentum stored in wheels and CMGs, in body axes
        commands
            What replaces the control law
        """
        self.control = control = np.zeros(len(self.control))
        # 1. Control law, unless its torque or its actuators are commanded.
        torque_nm = commands.torque_nm
        has_law = (
            self.config and torque_nm is None and self.config.actuators not in commands.motors
        )
        if has_law:
            torque_nm = self.law.torque_nm(
                inputs.t_s, lab_from_body_wxyz, inputs.rate_body_rad_s, momentum_nms
            )
        self.control_torque_nm = np.zeros(3) if torque_nm is None else torque_nm
        # 2. The actuators hold the body against the fans, which takes momentum out of them.
        actuator_torque_nm = self.control_torque_nm
        if self.momentum_dump:
            dump_nm = self.momentum_dump.allocate(control, momentum_nms, inputs)
            actuator_torque_nm = actuator_torque_nm - dump_nm
        # 3. Allocation.
        achieved_nm = self.actuator.allocate(control, actuator_torque_nm, inputs)
        self.achieved_nm = achieved_nm + dump_nm if self.momentum_dump else achieved_nm
        for key, motor_commands in commands.motors.items():
            self.actuator_sets[key].command(control, motor_commands, inputs)
        # 4. Anti-windup.
        if has_law:
            self.law.integrate(actuator_torque_nm, achieved_nm, self.period_s)
        return control

    def loads(self, control: Floats, speeds_rad_s: Floats) -> dict[str, Floats]:
        """Commands of the law's motors by name, or their speeds, relative to their limits.

        They are those of the controls (..., nu) and the full qvel (..., nv).
        """
        # Without a law no motor is commanded.
        if not self.names:
            return {}
        actuator = self.actuator
        loads = np.abs(control[..., actuator.motor]) / actuator.limit
        if isinstance(actuator, WheelActuator):
            # The speed of a wheel counts if it is closer to its limit.
            speeds = np.abs(speeds_rad_s[..., actuator.hinges.dof])
            loads = np.maximum(loads, speeds / actuator.speed_limit_rad_s)
        return dict(zip(self.names, loads.T, strict=True))


def return_rate_limit_rad_s(scene: Scene) -> float:
    """Rate limit of the return to the reference: below the gyros' limit if the controller uses them, else infinite.

    A saturated gyro reads less than the true rate, so a return faster than its limit would not be braked.
    """
    control = scene.motion.control
    imu = scene.vehicle.imu
    if control is None or control.feedback == "truth" or imu is None:
        return math.inf
    return GYRO_RATE_FRACTION * math.radians(imu.gyro.rate_limit_deg_s)
