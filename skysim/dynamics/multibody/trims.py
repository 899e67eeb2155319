"""Trim masses that motors move in flight: slide joints `trim_*`, see mass.py for those that stay in place.

With the masses m at displacements d from their start, along axes a, gravity g turns the body by

    T = sum m d a x g

which is horizontal: no displacement gives a torque about the vertical. MuJoCo computes it, and all other effects of the
moving masses. A lead screw is stiff, so its servo is fast, and its set-point leads by what gravity would make it yield.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.types import Floats
from skysim.dynamics.multibody.actuator_kind import (
    ActuatorKind,
    Actuators,
    ControlInput,
    Hinges,
    add_servos,
    inverse,
)
from skysim.scene.sections.vehicle import TrimsConfig

TRIM = "trim_"

SERVO_S = 5e-3  # time constant of the servo; five steps of the integration


def gravity_body_m_s2(model: Any, angles_rad: Floats) -> Floats:
    """(3,) the model's gravity in body axes, at a full qpos."""
    lab_from_body = Rotation.from_quat(angles_rad[:4], scalar_first=True)
    return lab_from_body.inv().apply(model.opt.gravity)


class TrimMotors:
    """Motors of the trim masses that count their steps. Stateful: one object per motion.

    Parameters
    ----------
    vehicle
        `VehicleModel`
    config
        The scene's `vehicle.trims`

    Attributes
    ----------
    start_m, position_m
        (n,) positions along the slides at the start and now
    """

    def __init__(self, vehicle: Any, config: TrimsConfig) -> None:
        self.model = vehicle.model
        self.config = config
        self.slides = Hinges(self.model, TRIM)
        self.motor = self.slides.motor
        self.start_m = self.model.qpos0[self.slides.qpos]
        self.position_m = self.start_m

    def moved(self, displacement_m: Floats, times_s: Floats) -> Floats:
        """Positions (K, n) at times (K, 1) after the start of a move to displacements (n,), within the travel."""
        wanted_m = np.clip(
            self.start_m + displacement_m, -self.config.travel_m, self.config.travel_m
        )
        reach_m = self.config.speed_limit_m_s * times_s
        return self.position_m + np.clip(wanted_m - self.position_m, -reach_m, reach_m)


class TrimActuator(TrimMotors, Actuators):
    """Actuators of the flight computer: trim masses. A command is a displacement from the position at the start.

    The computer measures the vertical as an inclinometer without errors would.
    """

    def __init__(self, vehicle: Any, config: TrimsConfig) -> None:
        TrimMotors.__init__(self, vehicle, config)
        lever_n = self.levers_n(self.model.qpos0)
        Actuators.__init__(self, self.motor, lever_n, inverse(lever_n), config.travel_m)

    def levers_n(self, angles_rad: Floats) -> Floats:
        """(3, n) torque on the body for each displacement, m a x g, at a full qpos."""
        gravity = gravity_body_m_s2(self.model, angles_rad)
        # The inertia of a slide is its mass.
        return np.cross(self.slides.axes.T, gravity).T * self.slides.inertia_kg_m2

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        """Command the smallest displacements that give the torque, or the nearest to it in least squares."""
        displacement_m = inverse(self.levers_n(inputs.angles_rad)) @ torque_nm
        return self.command(control, displacement_m, inputs)

    def command(self, control: Floats, commands: Floats, inputs: ControlInput) -> Floats:
        """The torque returned is that of the displacements in reach of a period."""
        control[self.motor] = commands
        self.position_m = self.moved(commands, np.array(inputs.period_s))
        return self.levers_n(inputs.angles_rad) @ (self.position_m - self.start_m)


class TrimDrive(TrimMotors):
    """The motors themselves: they move at a limited speed to the commanded displacements.

    Attributes
    ----------
    readings
        trim_m (n,): positions of the masses along their slides
    set_point_m
        (n,) set-points of the servos; None before the first period
    """

    set_point_m: Floats | None = None

    @property
    def readings(self) -> dict[str, Floats]:
        return {"trim_m": self.position_m}

    def apply(self, control: Floats, angles_rad: Floats) -> None:
        """Replace the displacements by the rates of the servos' set-points."""
        step_s = np.float64(self.model.opt.timestep)
        # 1. Positions after each step.
        times_s = step_s * np.arange(1, len(control) + 1)[:, None]
        path_m = self.moved(control[0, self.motor], times_s)
        # 2. A servo yields by the acceleration of gravity over its frequency squared.
        sag_m = SERVO_S**2 * (gravity_body_m_s2(self.model, angles_rad) @ self.slides.axes)
        if self.set_point_m is None:
            self.set_point_m = self.start_m - sag_m
        set_points_m = np.vstack((self.set_point_m, path_m - sag_m))
        control[:, self.motor] = np.diff(set_points_m, axis=0) / step_s
        self.position_m = path_m[-1]
        self.set_point_m = set_points_m[-1]


def add_trims(spec: Any, model: Any, _: TrimsConfig) -> None:
    """Add a servo at each slide."""
    add_servos(spec, model, TRIM, SERVO_S)


def start_trims(model: Any, data: Any, _: TrimsConfig) -> None:
    """Set the set-points of the servos to the positions at the start, less what gravity makes them yield."""
    slides = Hinges(model, TRIM)
    if (slides.motor < 0).any():
        return  # a model without motors, of the shapes alone
    sag_m = SERVO_S**2 * (gravity_body_m_s2(model, data.qpos) @ slides.axes)
    data.act[model.actuator_actadr[slides.motor]] = model.qpos0[slides.qpos] - sag_m


TRIMS = ActuatorKind("trims", add_trims, TrimActuator, start=start_trims, drive=TrimDrive)
