"""Closed-loop simulation: step flight computer, dynamics, IMU and star tracker together.

Every control period (`ClosedLoop.tick`) the flight computer reads the true or the estimated attitude and sets the
actuator controls, the disturbance torques are added, MuJoCo integrates the equations of motion, and the IMU samples
the motion. `OnboardCamera.looks` then renders and solves each frame whose exposure and latency have passed and
updates the attitude filter, which the controller may use in the next period.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.trackers.pipeline import Clock, Report
from skysim.core.errors import InputError
from skysim.core.types import Floats, Frame, Truth
from skysim.dynamics import guidance, imu, multibody
from skysim.dynamics.disturbances import DisturbanceModel
from skysim.dynamics.flight_computer import FlightComputer, Now
from skysim.dynamics.jitter import Vibration
from skysim.scene.scene import Scene
from skysim.simulation.exposure import render_frame
from skysim.simulation.random_streams import rng
from skysim.simulation.telemetry import TelemetryRecorder
from skysim.simulation.testbed import window
from skysim.tracking import factory
from skysim.tracking.exposure_control import ExposureController
from skysim.tracking.navigation import Navigation

if TYPE_CHECKING:
    from skysim.simulation.testbed import Testbed

LOOK_S = 0.05  # sampling interval of a maneuver when its tilt is checked
MARGIN_S = 0.05  # kept of past states beyond what a frame needs

Wanted = Callable[[int, float], bool]


class CapturedFrame(NamedTuple):
    """A frame rendered during the motion, its truth, the tracker's report, and the filter's status of the update."""

    frame: Frame
    truth: Truth
    report: Report | None
    verdict: str


class ClosedLoop:
    """A test bed in motion. Stateful: use one instance for one motion.

    forgets : keep only the past states that the next frame needs; else all of them
    """

    def __init__(self, lab: Testbed, forgets: bool = False) -> None:
        scene, ship = lab.scene, lab.ship
        start = lab.trajectory.lab_from_body[0]
        self.lab, self.forgets = lab, forgets
        kept_s = memory_s(scene) if forgets else None
        self.flight = multibody.Flight(ship, start, np.radians(scene.motion.rate_deg_s), lab.flown_s, kept_s)
        self.vibration = Vibration.of(scene.motion, rng(scene.seed, "jitter", 0))
        self.reference = guidance.plan(scene.motion, start)
        self.pilot, self.navigation = (
            FlightComputer(scene, ship, self.reference),
            navigator(lab, start, not forgets),
        )
        self.room = DisturbanceModel.of(
            scene.vehicle.disturbances,
            imu.earth_rate_lab_rad_s(scene.lab),
            guidance.knocks(scene.motion),
            ship.inertia_kg_m2,
            self.pilot.period_s,
            rng(scene.seed, "draught", 0),
        )
        check_reference(self.reference, lab)

    @property
    def nobody_speaks(self) -> bool:
        """Whether nothing reacts to the motion: no disturbances, no controller and no navigation."""
        return self.room.quiet and not (self.lab.scene.motion.control or self.navigation)

    def tick(self, steps: int, diary: TelemetryRecorder | None = None) -> None:
        """Simulate one control period, or what is left of the motion, and record it.

        The order is: attitude and rate as the controller gets them, controls, disturbance torques, integration, IMU.
        The controls are held over the period.
        """
        flight, pilot, navigation = self.flight, self.pilot, self.navigation
        t_s, angles, speeds = flight.now_s, flight.angles_rad, flight.speeds_rad_s
        attitude, rate = flight.lab_from_body_wxyz, flight.rate_body_rad_s
        stored = pilot.momentum_nms(angles, speeds)
        # The controller sees the truth or, with feedback imu or filter, the navigation's estimates.
        seen, turning = attitude, rate
        if pilot.told and pilot.told.feedback != "truth" and navigation:
            seen, turning = (
                navigation.attitude_wxyz(pilot.told.feedback),
                navigation.rate(pilot.told.feedback),
            )
        control = np.empty((min(steps, flight.steps_left), flight.model.nu))
        control[:] = pilot.steer(Now(t_s, pilot.period_s, turning, angles, speeds), seen, stored)
        if not self.room.quiet:
            times_s = flight.times_s(flight.step, flight.step + len(control) + 1)
            disturbance = self.room.torque_nm(times_s, attitude, rate, stored)
            # Disturbances act through the model's ideal torque actuators, step by step; commands are
            # constant.
            control[:, flight.world.torques] += disturbance
            if diary:
                diary.disturbed(disturbance.sum(axis=0) / len(control))
        if diary:
            # Before the motion advances: every column of a row is of the same time.
            diary.note(stored)
        flight.advance(control)
        if navigation:
            navigation.feel(flight.now_s, *felt(flight, self.vibration, len(control)))

    def here(self, open_s: float) -> Testbed:
        """The test bed with the trajectory from shortly before a time until now."""
        since = self.flight.trajectory(max(int(open_s / self.flight.step_s) - 1, 0))
        return replace(self.lab, trajectory=self.vibration.lay_over(since))


class OnboardCamera:
    """The camera and star tracker during the motion: render each frame when due, solve it, update the filter.

    tracker : solves the frames; None leaves them unsolved
    wanted(index, close_s) : whether to render a frame
    """

    def __init__(
        self, aloft: ClosedLoop, tracker: factory.Estimator | None, wanted: Wanted | None = None
    ) -> None:
        self.aloft, self.tracker, self.wanted = aloft, tracker, wanted
        self.scene, self.meter = aloft.lab.scene, ExposureController(aloft.lab.scene)
        self.latency_s = self.scene.filter.latency_s if self.scene.filter else 0.0
        self.index = 0

    def looks(self, clock: Clock | None = None) -> Iterator[CapturedFrame]:
        """Yield the frames not yet rendered whose exposure ended at least the filter's latency ago."""
        scene, aloft = self.scene, self.aloft
        while self.index < aloft.lab.frames:
            when = window(scene, self.index, self.meter.exposure_s)
            close_s = when.close_s(scene.camera.height_px)
            # Not due yet: the exposure is not over, or the solution would still be in processing.
            if close_s + self.latency_s > aloft.flight.now_s:
                return
            if self.wanted and not self.wanted(self.index, close_s):
                self.index += 1
                continue
            frame, truth = render_frame(aloft.here(when.open_s), self.index, clock, when.exposure_s)
            self.meter.see(frame)
            report = factory.solve_frame(self.tracker, frame) if self.tracker else None
            # The filter takes the solution at its mid-exposure time, although it arrives later.
            told = aloft.navigation if scene.filter and report else None
            verdict = told.see(frame.t_mid_s, report.attitude) if told and report else ""
            self.index += 1
            yield CapturedFrame(frame, truth, report, verdict)


def memory_s(scene: Scene) -> float:
    """Seconds of past states that a frame needs when due: longest exposure, latency, two control periods."""
    control, latency_s = scene.tracker.exposure_control, scene.filter.latency_s if scene.filter else 0.0
    when = window(scene, 0, control.longest_s if control else None)
    return (
        when.close_s(scene.camera.height_px) - when.open_s + latency_s + 2 / scene.control_rate_hz + MARGIN_S
    )


def check_reference(reference: guidance.Reference, lab: Testbed) -> None:
    """Raise InputError for a maneuver that commands a tilt beyond the stop: the controller would push against it."""
    vehicle = lab.scene.vehicle
    if vehicle.mount != "air_bearing" or lab.scene.motion.control is None:
        return
    t_s = np.arange(0, min(reference.duration_s, lab.flown_s) + LOOK_S, LOOK_S)
    tilt_deg = multibody.tilt_deg(reference.attitudes(t_s))
    beyond = np.flatnonzero(tilt_deg > vehicle.tilt_stop_deg)
    if len(beyond):
        raise InputError(
            f"motion.manoeuvre: asks for a tilt of {tilt_deg[beyond[0]]:.3g} deg at {t_s[beyond[0]]:.3g} s, beyond"
            f" vehicle.tilt_stop_deg {vehicle.tilt_stop_deg:g}"
        )


def felt(flight: multibody.Flight, vibration: Vibration, steps: int) -> tuple[Floats, Floats, Floats]:
    """Times (K,), attitudes (K, 4) as wxyz and rates (K, 3) of the last steps, with the vibration added."""
    begin = max(flight.step - steps, 0)
    if not vibration.voices:
        return flight.knots(begin)
    shaken = vibration.lay_over(flight.trajectory(begin))
    return shaken.t_s, shaken.lab_from_body.as_quat(scalar_first=True), shaken.rate_body_rad_s


def navigator(lab: Testbed, start: Rotation, records: bool) -> Navigation | None:
    """The on-board navigation, or None without an IMU. records: whether it keeps every IMU sample."""
    if lab.scene.vehicle.imu is None:
        return None
    place_m = multibody.imu_place_m(lab.ship)
    stream = rng(lab.scene.seed, "imu", 0)
    return Navigation(lab.scene, lab.mount, start, place_m, lab.ship.gravity_m_s2, stream, records)
