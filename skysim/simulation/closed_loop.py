"""Closed-loop simulation: step flight computer, dynamics, IMU and star tracker together.

Every control period (`ClosedLoop.tick`) the flight computer reads the true or the estimated attitude and sets the
actuator controls, the disturbance torques are added, MuJoCo integrates the equations of motion, and the IMU samples
the motion. `OnboardCamera.capture_due` then renders and solves each frame whose exposure and latency have passed and
updates the attitude filter, which the controller may use in the next period.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import RateEstimate
from estimator.trackers.pipeline import Clock, Report
from skysim.camera.render import Window
from skysim.core.errors import InputError
from skysim.core.random_streams import AIR_CURRENT, IMU, JITTER, random_stream
from skysim.core.types import Floats, Frame, Trajectory, Truth
from skysim.dynamics import guidance, imu, multibody
from skysim.dynamics.disturbances import DisturbanceModel
from skysim.dynamics.flight_computer import ControlInput, FlightComputer
from skysim.dynamics.jitter import Vibration
from skysim.scene.scene import Scene
from skysim.simulation.exposure import render_frame
from skysim.simulation.reference_limits import check_reference
from skysim.simulation.telemetry import TelemetryRecorder
from skysim.simulation.testbed import exposure_window, time_tag_error_s
from skysim.tracking import factory, gyro
from skysim.tracking.exposure_control import ExposureController
from skysim.tracking.navigation import Navigation

if TYPE_CHECKING:
    from skysim.simulation.testbed import Testbed

HISTORY_MARGIN_S = 0.05  # kept of past states beyond what a frame needs

FrameSelector = Callable[[int, float], bool]


class CapturedFrame(NamedTuple):
    """A frame rendered during the motion, its truth, the tracker's report, and the filter's status of the update."""

    frame: Frame
    truth: Truth
    report: Report | None
    update_status: str


class ClosedLoop:
    """A test bed in motion. Stateful: use one instance for one motion.

    discards_history : keep only the past states that the next frame needs; else all of them
    """

    def __init__(self, testbed: Testbed, discards_history: bool = False) -> None:
        scene, vehicle = testbed.scene, testbed.vehicle
        start = testbed.trajectory.lab_from_body[0]
        self.testbed, self.discards_history = testbed, discards_history
        self.reference = guidance.plan(scene.motion, start, testbed.profiles)
        self.simulation = build_simulation(testbed, self.reference, history_s(testbed) if discards_history else None)
        self.vibration = Vibration.draw(scene.motion, random_stream(scene.seed, JITTER, 0), self.reference)
        self.flight_computer = FlightComputer(scene, vehicle, self.reference, testbed.controllers)
        self.navigation = build_navigation(testbed, start, history_s(testbed) if discards_history else math.inf)
        self.disturbances = DisturbanceModel.from_config(
            scene.vehicle.disturbances,
            imu.earth_rate_lab_rad_s(scene.site),
            guidance.impulses(scene.motion, self.reference),
            vehicle.inertia_kg_m2,
            self.flight_computer.period_s,
            random_stream(scene.seed, AIR_CURRENT, 0),
        )
        try:
            check_reference(self.reference, testbed)
        except InputError:
            self.close()
            raise

    def close(self) -> None:
        """End the process of an external controller."""
        self.flight_computer.close()

    @property
    def is_free_motion(self) -> bool:
        """Whether nothing depends on the motion: no disturbances, no controller and no navigation."""
        return self.disturbances.inactive and not (self.testbed.scene.motion.control or self.navigation)

    def tick(self, steps: int, recorder: TelemetryRecorder | None = None) -> None:
        """Simulate one control period, or the rest of the motion, and record it.

        The order is: attitude and rate as the controller gets them, controls, disturbance torques, integration, IMU.
        The controls are held over the period.
        """
        simulation, flight_computer, navigation = self.simulation, self.flight_computer, self.navigation
        t_s, angles, speeds = simulation.now_s, simulation.angles_rad, simulation.speeds_rad_s
        attitude, rate = simulation.lab_from_body_wxyz, simulation.rate_body_rad_s
        momentum = flight_computer.momentum_nms(angles, speeds)
        # The controller sees the truth or, with feedback imu or filter, the navigation's estimates.
        measured_attitude, measured_rate = attitude, rate
        feedback = flight_computer.config.feedback if flight_computer.config else "truth"
        if feedback != "truth" and navigation:
            measured_attitude = navigation.attitude_wxyz(feedback)
            measured_rate = navigation.body_rate_rad_s(feedback)
        inputs = ControlInput(t_s, flight_computer.period_s, measured_rate, angles, speeds)
        control = np.empty((min(steps, simulation.steps_left), simulation.model.nu))
        control[:] = flight_computer.compute_controls(inputs, measured_attitude, momentum)
        if not (self.disturbances.inactive or self.testbed.scene.motion.is_prescribed):
            times_s = simulation.times_s(simulation.step, simulation.step + len(control) + 1)
            disturbance = self.disturbances.torque_nm(times_s, attitude, rate, momentum)
            # Disturbances act through the model's ideal torque actuators, step by step; commands are constant.
            control[:, simulation.vehicle.torques] += disturbance
            if recorder:
                recorder.record_disturbance(disturbance.sum(axis=0) / len(control))
        if recorder:
            # Before the motion advances: every column of a row is of the same time.
            recorder.record(momentum)
        simulation.advance(control)
        if navigation:
            navigation.sample_imu(simulation.now_s, *recent_motion(simulation, self.vibration, len(control)))

    def trajectory_since(self, begin_s: float) -> Trajectory:
        """The motion from shortly before a time until now."""
        trajectory = self.simulation.trajectory(max(int(begin_s / self.simulation.step_s) - 1, 0))
        return self.vibration.add_to(trajectory)


class OnboardCamera:
    """A camera and star tracker during the motion: render each frame when due, solve it, update the filter.

    tracker : solves the frames; None leaves them unsolved
    selects(index, close_s) : whether to render a frame
    number  : of the camera on the vehicle, 0 for the main one
    """

    def __init__(
        self,
        loop: ClosedLoop,
        tracker: factory.Estimator | None,
        selects: FrameSelector | None = None,
        number: int = 0,
    ) -> None:
        self.loop, self.tracker, self.selects, self.number = loop, tracker, selects, number
        self.testbed = loop.testbed.cameras[number]
        self.scene, self.exposure_control = self.testbed.scene, ExposureController(self.testbed.scene)
        self.latency_s = self.scene.filter.latency_s if self.scene.filter else 0.0
        self.index = 0

    def capture_due(self, clock: Clock | None = None) -> Iterator[CapturedFrame]:
        """Yield the frames not yet rendered whose exposure ended at least the filter's latency ago."""
        scene, loop = self.scene, self.loop
        frames = math.inf if loop.testbed.endless else self.testbed.frames
        while self.index < frames:
            window = exposure_window(scene, self.index, self.exposure_control.exposure_s)
            close_s = window.close_s(scene.camera.height_px)
            tagged_s = window.middle_s(scene.camera.height_px) + time_tag_error_s(scene, self.index)
            # Not due yet: the exposure is not over, the solution still in processing, or its time still to come.
            if max(close_s + self.latency_s, tagged_s) > loop.simulation.now_s:
                return
            if self.selects and not self.selects(self.index, close_s):
                self.index += 1
                continue
            moved = replace(self.testbed, trajectory=loop.trajectory_since(window.open_s))
            frame, truth = render_frame(moved, self.index, clock, window.exposure_s)
            self.exposure_control.update(frame)
            samples = loop.navigation.imu_samples() if loop.navigation and scene.tracker.gyro else None
            rate = measured_rate(self.testbed, samples, window)
            report = factory.solve_frame(self.tracker, frame, rate=rate) if self.tracker else None
            # The filter takes the solution at its mid-exposure time, although it arrives later.
            navigation = loop.navigation if scene.filter and report else None
            update_status = ""
            if navigation and report:
                update_status = navigation.update_filter(frame.t_mid_s, report.attitude, self.number)
            self.index += 1
            yield CapturedFrame(frame, truth, report, update_status)


def measured_rate(testbed: Testbed, samples: imu.Increments | None, window: Window) -> RateEstimate | None:
    """The gyro's rate during an exposure as the tracker gets it; None without `tracker.gyro`."""
    config, scene = testbed.scene.vehicle.imu, testbed.scene
    if samples is None or config is None or not scene.tracker.gyro:
        return None
    return gyro.rate_of_frame(samples, window, scene.camera.height_px, config, testbed.mount)


def history_s(testbed: Testbed) -> float:
    """Seconds of past states that a frame of any camera needs when due: see `camera_history_s`."""
    return max(camera_history_s(camera.scene) for camera in testbed.cameras)


def camera_history_s(scene: Scene) -> float:
    """Seconds of past states that a frame needs when due: longest exposure, latency, two control periods."""
    control, latency_s = scene.tracker.exposure_control, scene.filter.latency_s if scene.filter else 0.0
    window = exposure_window(scene, 0, control.longest_s if control else None)
    return (
        window.close_s(scene.camera.height_px)
        - window.open_s
        + latency_s
        + 2 / scene.control_rate_hz
        + HISTORY_MARGIN_S
    )


def build_simulation(testbed: Testbed, reference: guidance.Reference, history_s: float | None) -> multibody.Simulation:
    """The simulation of the motion at its start: by dynamics, or along the reference if the motion is prescribed."""
    motion = testbed.scene.motion
    if motion.is_prescribed:
        return multibody.PrescribedMotion(
            testbed.vehicle, lambda t_s: reference.state_at(t_s)[:2], testbed.duration_s, history_s
        )
    start, rate = testbed.trajectory.lab_from_body[0], guidance.start_rate_rad_s(motion, testbed.profiles)
    return multibody.Simulation(testbed.vehicle, start, rate, testbed.duration_s, history_s)


def recent_motion(simulation: multibody.Simulation, vibration: Vibration, steps: int) -> tuple[Floats, Floats, Floats]:
    """Times (K,), attitudes (K, 4) as wxyz and rates (K, 3) of the last steps, with the vibration added."""
    begin = max(simulation.step - steps, 0)
    if not vibration.components:
        return simulation.knots(begin)
    trajectory = vibration.add_to(simulation.trajectory(begin))
    return trajectory.t_s, trajectory.lab_from_body.as_quat(scalar_first=True), trajectory.rate_body_rad_s


def build_navigation(testbed: Testbed, start: Rotation, kept_s: float) -> Navigation | None:
    """The on-board navigation, or None without an IMU. kept_s: how long it keeps IMU samples."""
    if testbed.scene.vehicle.imu is None:
        return None
    position_m = multibody.imu_position_m(testbed.vehicle)
    stream = random_stream(testbed.scene.seed, IMU, 0)
    mounts = tuple(camera.mount for camera in testbed.cameras)
    return Navigation(testbed.scene, mounts, start, position_m, testbed.vehicle.gravity_m_s2, stream, kept_s)
