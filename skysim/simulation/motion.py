"""The vehicle in motion: flight computer, dynamics, disturbances, vibration and IMU, one control period at a time."""

from __future__ import annotations

import math

import numpy as np

from skysim.core.random_streams import AIR_CURRENT, IMU, JITTER, random_stream
from skysim.core.types import Floats, Trajectory
from skysim.dynamics import guidance, imu, multibody
from skysim.dynamics.controllers import ControllerSource
from skysim.dynamics.disturbances import DisturbanceModel
from skysim.dynamics.flight_computer import FlightComputer
from skysim.dynamics.jitter import Vibration
from skysim.dynamics.multibody.actuators.kind import ControlInput
from skysim.simulation import timing
from skysim.simulation.lab import Lab
from skysim.simulation.reference_limits import check_reference
from skysim.simulation.telemetry import TelemetryRecorder
from skysim.tracking.navigation import Navigation


class Motion:
    """The motion of a lab's vehicle. Stateful: use one instance for one motion.

    duration_s : at most; may be infinite with `kept_s`
    kept_s     : how long past states and IMU samples are kept; None: all of them
    Raises InputError for a maneuver that the vehicle cannot follow, and for too fast vibration.
    """

    def __init__(
        self,
        lab: Lab,
        controllers: ControllerSource,
        duration_s: float,
        kept_s: float | None = None,
    ) -> None:
        scene = lab.scene
        vehicle = lab.vehicle
        self.lab = lab
        self.reference = guidance.plan(scene.motion, lab.start, lab.profiles)
        check_reference(self.reference, scene, vehicle, duration_s)
        self.simulation = build_simulation(lab, self.reference, duration_s, kept_s)
        self.vibration = Vibration.draw(
            scene.motion, random_stream(scene.seed, JITTER, 0), self.reference
        )
        if kept_s is None:
            # Raises InputError before any long work.
            self.vibration.subdivisions(self.simulation.times_s(0, self.simulation.last_step + 1))
        self.flight_computer = FlightComputer(scene, vehicle, self.reference, controllers)
        self.navigation = build_navigation(lab, math.inf if kept_s is None else kept_s)
        self.disturbances = DisturbanceModel.from_config(
            scene.vehicle.disturbances,
            imu.earth_rate_lab_rad_s(scene.site),
            guidance.impulses(scene.motion, self.reference),
            vehicle.inertia_kg_m2,
            self.flight_computer.period_s,
            random_stream(scene.seed, AIR_CURRENT, 0),
        )
        self.recorder = None
        if kept_s is None:
            self.recorder = TelemetryRecorder(
                self.simulation, self.flight_computer, self.navigation
            )

    def close(self) -> None:
        """End the process of an external controller."""
        self.flight_computer.close()

    @property
    def is_free(self) -> bool:
        """Whether nothing depends on the motion: no disturbances, no controller and no navigation."""
        return self.disturbances.inactive and not (self.lab.scene.motion.control or self.navigation)

    @property
    def period_steps(self) -> int:
        """Integration steps in a control period."""
        return round(self.flight_computer.period_s / self.simulation.step_s)

    def advance(self, steps: int, torque_nm: Floats | None = None) -> None:
        """Simulate one control period, or the rest of the motion, and record it.

        The order is: attitude and rate as the controller gets them, controls, disturbance torques, integration, IMU.
        The controls are held over the period.

        torque_nm : (3,) in body axes, in place of the controller's
        """
        simulation = self.simulation
        flight_computer = self.flight_computer
        navigation = self.navigation
        t_s = simulation.now_s
        angles = simulation.angles_rad
        speeds = simulation.speeds_rad_s
        attitude = simulation.lab_from_body_wxyz
        rate = simulation.rate_body_rad_s
        momentum = flight_computer.momentum_nms(angles, speeds)
        # The controller sees the truth or, with feedback imu or filter, the navigation's estimates.
        measured_attitude = attitude
        measured_rate = rate
        feedback = flight_computer.config.feedback if flight_computer.config else "truth"
        if feedback != "truth" and navigation:
            measured_attitude = navigation.attitude_wxyz(feedback)
            measured_rate = navigation.body_rate_rad_s(feedback)
        inputs = ControlInput(t_s, flight_computer.period_s, measured_rate, angles, speeds)
        control = np.empty((min(steps, simulation.steps_left), simulation.model.nu))
        control[:] = flight_computer.compute_controls(
            inputs, measured_attitude, momentum, torque_nm
        )
        if not (self.disturbances.inactive or self.lab.scene.motion.is_prescribed):
            times_s = simulation.times_s(simulation.step, simulation.step + len(control) + 1)
            disturbance = self.disturbances.torque_nm(times_s, attitude, rate, momentum)
            # Disturbances act through the model's ideal torque actuators, step by step; commands are constant.
            control[:, simulation.vehicle.torques] += disturbance
            if self.recorder:
                self.recorder.record_disturbance(disturbance.sum(axis=0) / len(control))
        if self.recorder:
            # Before the motion advances: every column of a row is of the same time.
            self.recorder.record(momentum)
        simulation.advance(control)
        if navigation:
            navigation.sample_imu(simulation.now_s, *self.last_knots(len(control)))

    def trajectory(self, begin_s: float = 0.0) -> Trajectory:
        """The motion from shortly before a time until now, with the vibration."""
        first = max(int(begin_s / self.simulation.step_s) - 1, self.simulation.first_step)
        return self.vibration.add_to(self.simulation.trajectory(first))

    def last_knots(self, steps: int) -> tuple[Floats, Floats, Floats]:
        """Times (K,), attitudes (K, 4) as wxyz and rates (K, 3) of the last steps, with the vibration."""
        simulation = self.simulation
        begin = max(simulation.step - steps, 0)
        if not self.vibration.components:
            return simulation.knots(begin)
        trajectory = self.vibration.add_to(simulation.trajectory(begin))
        return (
            trajectory.t_s,
            trajectory.lab_from_body.as_quat(scalar_first=True),
            trajectory.rate_body_rad_s,
        )


def history_s(lab: Lab) -> float:
    """Seconds of past states that a frame of any camera needs when it is due."""
    return max(timing.history_s(camera.scene) for camera in lab.cameras)


def build_simulation(
    lab: Lab, reference: guidance.Reference, duration_s: float, kept_s: float | None
) -> multibody.Simulation:
    """The simulation of the motion at its start: by dynamics, or along the reference if the motion is prescribed."""
    motion = lab.scene.motion
    if motion.is_prescribed:
        return multibody.PrescribedMotion(
            lab.vehicle, lambda t_s: reference.state_at(t_s)[:2], duration_s, kept_s
        )
    rate = guidance.start_rate_rad_s(motion, lab.profiles)
    return multibody.Simulation(lab.vehicle, lab.start, rate, duration_s, kept_s)


def build_navigation(lab: Lab, kept_s: float) -> Navigation | None:
    """The on-board navigation, or None without an IMU. kept_s: how long it keeps IMU samples."""
    if lab.scene.vehicle.imu is None:
        return None
    position_m = multibody.imu_position_m(lab.vehicle)
    stream = random_stream(lab.scene.seed, IMU, 0)
    mounts = tuple(camera.mount for camera in lab.cameras)
    return Navigation(
        lab.scene, mounts, lab.start, position_m, lab.vehicle.gravity_m_s2, stream, kept_s
    )
