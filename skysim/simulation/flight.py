"""A lab in flight: its motion, the exposures of its cameras as they become due, and the recorded telemetry.

`Flight.events` is the closed loop:

1. `Flight.advance`: every control period the flight computer reads the true or the estimated attitude and sets the
   actuators, MuJoCo integrates the equations of motion, and the IMU samples the motion (motion.py).
2. `Flight.capture_due`: a frame is rendered once, when its exposure and its latency have passed. It is solved.
3. With a filter the solution updates the attitude that the controller may use in the next period.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Self

from scipy.spatial.transform import Rotation

from estimator.core.types import RateEstimate
from estimator.trackers.pipeline import Clock, Report
from skysim.camera.render import Window
from skysim.core.errors import InputError, refusing
from skysim.core.plugins import finite_array
from skysim.core.quaternion import to_rotation
from skysim.core.text import LARGEST
from skysim.core.types import Floats, Frame, Telemetry, Trajectory, Truth, frozen
from skysim.dynamics import imu
from skysim.dynamics.flight_computer import NO_COMMANDS, Commands
from skysim.scene.scene import Scene
from skysim.simulation.exposure import render_frame
from skysim.simulation.lab import (
    NO_PARTS,
    Lab,
    StarCamera,
    UserParts,
    build_lab,
    build_tracker,
    exposure_window,
    time_tag_error_s,
    window_from,
    with_parts,
)
from skysim.simulation.motion import Motion
from skysim.tracking import factory, navigation
from skysim.tracking.factory import ExposureController

# Index of the first frame outside of the schedule. The index of a frame selects its noise.
FIRST_OBSERVATION = 1_000_000
BATCH = 10  # control periods between two looks at the schedules

Progress = Callable[[float, float], None]
FrameSelector = Callable[[int, float], bool]


@frozen
class Shot:
    """One exposure: its frame and truth, and the solution of the star tracker.

    Attributes
    ----------
    camera, window
        Star camera, and its exposure window
    frame, truth
        Image and truth
    report
        Report of the tracker; None if the frame was not solved
    rate
        Rate from the gyros that the tracker received; None without `tracker.gyro`
    update_status
        Status of the filter's update with the solution; empty without a filter
    seconds
        Computing time by stage of the rendering
    """

    camera: StarCamera
    window: Window
    frame: Frame
    truth: Truth
    report: Report | None
    rate: RateEstimate | None
    update_status: str
    seconds: dict[str, float]

    @property
    def solution(self) -> Report:
        """The report of an exposure that the tracker was to solve."""
        assert self.report is not None
        return self.report


@frozen
class State:
    """The true state of the vehicle.

    Attributes
    ----------
    t_s
        Time since the scene's start
    lab_from_body
        Attitude
    rate_body_rad_s
        (3,) rate in body axes
    wheel_rad_s
        (n,) speeds of the reaction wheels
    gimbal_rad
        (n,) angles of the CMGs' gimbals
    readings
        Of thrusters thruster_duty (n,), the open fraction of the last control period, and propellant_kg; of trim
        masses that move trim_m (n,), their positions
    """

    t_s: float
    lab_from_body: Rotation
    rate_body_rad_s: Floats
    wheel_rad_s: Floats
    gimbal_rad: Floats
    readings: dict[str, Floats]


class Schedule:
    """The exposures of one camera in a flight.

    Attributes
    ----------
    camera, scene, number
        Star camera, its scene, and its number in the lab
    frames
        Number of frames; infinite in an endless flight
    exposure_control
        Chooses the exposure time of the next frame
    latency_s
        Time from the end of an exposure to its solution
    index
        Index of the next frame
    exposures_s
        Exposure times of the frames exposed so far, by index; empty in an endless flight
    triggers_s
        Times at which triggered exposures open, by index; None: the scene's schedule
    skipped
        Number of the scene's exposures that were left out for triggered ones; negative if these were more
    """

    def __init__(self, camera: StarCamera, number: int, frames: float) -> None:
        self.camera = camera
        self.number = number
        self.frames = frames
        self.scene = scene = camera.scene
        self.exposure_control = ExposureController(scene)
        self.latency_s = scene.filter.latency_s if scene.filter else 0.0
        self.index = 0
        self.exposures_s: dict[int, float] = {}
        self.triggers_s: dict[int, float] | None = None
        self.skipped = 0

    @property
    def is_over(self) -> bool:
        """Whether all frames were exposed."""
        if self.triggers_s is not None:
            return self.index not in self.triggers_s
        return self.index + self.skipped >= self.frames

    def trigger(self, now_s: float) -> None:
        """Open an exposure now, or at the end of those that were triggered before."""
        waiting = {n: t_s for n, t_s in (self.triggers_s or {}).items() if n >= self.index}
        open_s = now_s
        if waiting:
            last = self.window_from(max(waiting.values()))
            open_s = max(now_s, last.close_s)
        self.triggers_s = waiting | {self.index + len(waiting): open_s}

    def resume(self, now_s: float) -> None:
        """Expose by the scene's schedule again, from its next time on; triggers that wait are dropped."""
        exposure = self.scene.exposure
        due = max(math.ceil((now_s - exposure.first_s) * exposure.rate_hz), 0)
        self.skipped = due - self.index
        self.triggers_s = None

    def window_from(self, open_s: float) -> Window:
        """Window of an exposure that opens at this time."""
        return window_from(self.scene, open_s, self.exposure_control.exposure_s)

    def window_to(self, close_s: float) -> Window:
        """Window of an exposure whose last row ends at this time."""
        window = self.window_from(0.0)
        return window._replace(open_s=close_s - window.close_s)

    @property
    def window(self) -> Window:
        """Exposure window of the next frame."""
        if self.triggers_s is not None:
            return self.window_from(self.triggers_s[self.index])
        number = self.index + self.skipped
        return exposure_window(self.scene, number, self.exposure_control.exposure_s)

    @property
    def due_s(self) -> float:
        """Time at which the next frame is due: it is exposed, its solution is ready, and its time tag has passed."""
        window = self.window
        tagged_s = window.middle_s + time_tag_error_s(self.scene, self.index)
        return max(window.close_s + self.latency_s, tagged_s)


class Flight:
    """A lab in motion, from t = 0 on. Stateful: use one object for one motion.

    Close it, or use it as a context manager: an external controller has a process.

    Parameters
    ----------
    lab
        Laboratory to move
    parts
        User's parts that replace those of the scene
    endless
        Expose frames without end, whatever the scene's number of frames
    keeps_history
        Keep all past states, for telemetry and trajectory; else only those that the next frame needs

    Raises
    ------
    InputError
        For a maneuver that the vehicle cannot follow, and for an endless flight that keeps its history.
    """

    def __init__(
        self,
        lab: Lab,
        parts: UserParts = NO_PARTS,
        *,
        endless: bool = False,
        keeps_history: bool = True,
    ) -> None:
        if endless and keeps_history:
            raise InputError(
                "endless", "the history would have no end", "keeps_history=False"
            )
        self.lab = lab
        self.parts = parts
        self.duration_s = math.inf if endless else lab.duration_s
        self.motion = Motion(
            lab, parts.programs, self.duration_s, None if keeps_history else lab.history_s
        )
        self.schedules = [
            Schedule(camera, number, math.inf if endless else camera.scene.exposure.frames)
            for number, camera in enumerate(lab.cameras)
        ]
        self.trackers: dict[int, factory.Estimator] = {}
        self.observations = 0
        self.is_in_shots = False
        self.flown: Trajectory | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process of an external controller."""
        self.motion.close()

    # The motion

    @property
    def now_s(self) -> float:
        """Time since the scene's start."""
        return self.motion.simulation.now_s

    @property
    def is_over(self) -> bool:
        """Whether the motion has reached its end."""
        return self.motion.simulation.steps_left == 0

    @property
    def state(self) -> State:
        """The present state of the vehicle."""
        simulation = self.motion.simulation
        vehicle = self.lab.vehicle
        return State(
            self.now_s,
            to_rotation(simulation.lab_from_body_wxyz),
            simulation.rate_body_rad_s.copy(),
            simulation.speeds_rad_s[vehicle.wheels.dof],
            simulation.angles_rad[vehicle.gimbals.qpos],
            self.motion.readings,
        )

    def step(
        self, torque_nm: Floats | None = None, motors: Mapping[str, Any] = NO_COMMANDS.motors
    ) -> list[Shot]:
        """Simulate one control period. Returns the exposures that updated the filter in it; none without a filter.

        Parameters
        ----------
        torque_nm
            (3,) torque in body axes that replaces that of the controller. The scene's actuators give it, or the
            ideal actuator if the scene has no controller
        motors
            Commands of single motors, as `commands` takes them

        Raises
        ------
        InputError
            Inside a loop over `shots`, at the end of the motion, and for commands that `commands` refuses.
        """
        self.refuse_in_shots("step")
        if self.is_over:
            raise InputError(
                "step", f"the motion has ended at {self.now_s:g} s", "more frames, or endless"
            )
        self.motion.advance(self.motion.period_steps, self.commands(torque_nm, motors))
        return list(self.capture_due(self.filter_schedules))

    def commands(
        self, torque_nm: Any = None, motors: Mapping[str, Any] = NO_COMMANDS.motors
    ) -> Commands:
        """Commands for a control period, checked.

        Parameters
        ----------
        torque_nm
            (3,) torque in body axes; None without
        motors
            Commands (n,) of single motors by the key of their actuators: torques of `wheels` in N m, gimbal rates of
            `cmgs` in rad/s, thrusts of `fans` and `thrusters` in N, displacements of `trims` in m. Those beyond a limit
            are clipped to it

        Raises
        ------
        InputError
            For commands to a prescribed motion, actuators that are off, and values that are not as many finite
            numbers as there are motors.
        """
        if torque_nm is None and not motors:
            return NO_COMMANDS
        if self.lab.scene.motion.is_prescribed:
            raise InputError(
                "step", "a prescribed motion takes no torque", "another motion.control.law"
            )
        sets = self.motion.flight_computer.actuator_sets
        unknown = [key for key in motors if key not in sets]
        if unknown:
            raise InputError(unknown[0], "no such actuators", ", ".join(sets))
        with refusing(ValueError, "step"):
            if torque_nm is not None:
                # Its square must be finite; the actuators give far less.
                torque_nm = finite_array(torque_nm, "torque_nm", (3,)).clip(-LARGEST, LARGEST)
            return Commands(
                torque_nm,
                {
                    key: finite_array(values, key, sets[key].motor.shape)
                    for key, values in motors.items()
                },
            )

    def refuse_in_shots(self, name: str) -> None:
        """Raise InputError inside a loop over `shots`."""
        if self.is_in_shots:
            raise InputError(
                name,
                "inside a loop over shots, which steps by itself",
                "observe, or after it",
            )

    def simulate_motion(self) -> Self:
        """Simulate the rest of the motion, and return the flight. Only the frames that a filter needs are rendered."""
        for _ in self.events(self.filter_schedules, captures_late=False):
            pass
        return self

    def advance(self, schedules: Sequence[Schedule]) -> None:
        """Simulate the control periods to the next due frame, BATCH at most unless nothing depends on the motion."""
        motion = self.motion
        due_s = min((one.due_s for one in schedules if not one.is_over), default=math.inf)
        if motion.is_free:
            left_s = min(due_s, self.duration_s) - self.now_s
            if not motion.keeps_history:
                # No more than there is room for.
                left_s = min(left_s, self.lab.history_s)
            periods = max(math.ceil(left_s / motion.flight_computer.period_s), 1)
            motion.advance(periods * motion.period_steps)
            return
        for _ in range(BATCH):
            motion.advance(motion.period_steps)
            if self.is_over or self.now_s >= due_s:
                return

    @property
    def filter_schedules(self) -> list[Schedule]:
        """Schedules of the cameras whose solutions the filter needs: with a filter all, else none."""
        return self.schedules if self.lab.scene.filter and self.motion.navigation else []

    def trajectory(self, begin_s: float = 0.0) -> Trajectory:
        """The motion from about a time until now, with the vibration; only its last part in a flight without history.

        After the end it is always the whole motion, which is made once.
        """
        if not self.is_over:
            return self.motion.trajectory(begin_s)
        if self.flown is None:
            self.flown = self.motion.trajectory()
        return self.flown

    def telemetry(self) -> Telemetry:
        """True and estimated states at every control period.

        Raises
        ------
        InputError
            In a flight without history, and before the first step.
        """
        if not self.motion.keeps_history:
            raise InputError(
                "telemetry", "this flight keeps no history", "keeps_history=True"
            )
        if not self.now_s:
            raise InputError("telemetry", "the motion has not begun", "after a step")
        return self.motion.telemetry()

    def imu_samples(self, since_s: float = -math.inf) -> imu.Increments | None:
        """Samples of the IMU from about the time since_s on, as far as they are kept; None without an IMU."""
        return self.motion.navigation.imu_samples(since_s) if self.motion.navigation else None

    # The exposures

    def shots(
        self,
        *,
        cameras: Sequence[int] | None = None,
        solves: bool = True,
        selects: FrameSelector | None = None,
        progress: Progress | None = None,
    ) -> Iterator[Shot]:
        """Simulate the rest of the motion; yield every exposure as it becomes due.

        Parameters
        ----------
        cameras
            Numbers of the cameras whose exposures are yielded; None for all
        solves
            Whether to solve the frames; with a filter they are solved in any case
        selects
            selects(index, close_s) says whether to render a frame of the main camera. A skipped frame does not
            change the others, except that exposure control and filter do not see it
        progress
            Called as progress(t_s, duration_s) after every frame and every BATCH control periods
        """
        wanted = [one for one in self.schedules if cameras is None or one.number in cameras]
        shown = [one.camera for one in wanted]
        for shot in self.events(self.filter_schedules or wanted, solves, selects, progress):
            if shot is not None and shot.camera in shown:
                yield shot

    def events(
        self,
        schedules: Sequence[Schedule],
        solves: bool = False,
        selects: FrameSelector | None = None,
        progress: Progress | None = None,
        captures_late: bool = True,
    ) -> Iterator[Shot | None]:
        """Yield the shots of some cameras as in `shots`, and None after every call of `advance`.

        Parameters
        ----------
        schedules
            Schedules of the cameras
        solves, selects, progress
            As in `shots`
        captures_late
            Whether to yield the shots that are due only after the end of the motion
        """
        self.refuse_in_shots("shots")
        self.is_in_shots = True
        try:
            while not self.is_over:
                # 1. Motion.
                self.advance(schedules)
                # 2. and 3. Frames that became due.
                yield from self.capture_due(schedules, solves, selects)
                yield None
                if progress:
                    progress(self.now_s, self.duration_s)
            if captures_late:
                yield from self.capture_due(schedules, solves, selects, late=True)
        finally:
            self.is_in_shots = False

    def capture_due(
        self,
        schedules: Sequence[Schedule],
        solves: bool = False,
        selects: FrameSelector | None = None,
        late: bool = False,
        updates_filter: bool = True,
    ) -> Iterator[Shot]:
        """Yield the exposures that are due and not yet rendered, in order; a filter is updated with each.

        Late ones ended within the motion but are due after its end; the filter is not updated.
        """
        has_filter = bool(self.filter_schedules) and updates_filter and not late
        while due := [
            one
            for one in schedules
            if not one.is_over and (one.window.close_s if late else one.due_s) <= self.now_s
        ]:
            # Of several that are due at once, the first camera's.
            schedule = min(due, key=lambda one: one.due_s)
            index = schedule.index
            window = schedule.window
            schedule.index += 1
            if selects and schedule.number == 0 and not selects(index, window.close_s):
                continue
            if math.isfinite(schedule.frames):
                schedule.exposures_s[index] = window.exposure_s
            shot = self.capture(schedule, index, window, solves or has_filter, has_filter)
            schedule.exposure_control.update(shot.frame)
            yield shot

    def capture(
        self,
        schedule: Schedule,
        index: int,
        window: Window,
        solves: bool,
        updates_filter: bool,
        given: Trajectory | None = None,
    ) -> Shot:
        """Render an exposure, solve it, and update the filter with the solution.

        Parameters
        ----------
        schedule
            Schedule of the camera
        index, window
            Index of the frame and its exposure window
        solves
            Whether to solve the frame
        updates_filter
            Whether to update the filter with the solution
        given
            Motion in place of the flight's, which no gyro measures

        Raises
        ------
        InputError
            For an exposure that began before the oldest state that the flight keeps.
        """
        camera = schedule.camera
        simulation = self.motion.simulation
        first = simulation.first_step
        if first and first * simulation.step_s > window.open_s:
            raise InputError(
                "shots", f"the flight has forgotten frame {index}", "keeps_history=True"
            )
        # Render.
        clock = Clock()
        trajectory = given or self.trajectory(window.open_s)
        frame, truth = render_frame(
            camera, trajectory.since(window.open_s), index, clock, window
        )
        # Solve.
        rate = None if given else self.measured_rate(camera, window)
        report = None
        if solves:
            tracker = self.tracker_of(schedule, frame)
            report = factory.solve_frame(tracker, frame, rate=rate)
        update_status = ""
        if updates_filter and report and self.motion.navigation:
            # The filter takes the solution at its mid-exposure time, although it arrives later.
            update_status = self.motion.navigation.update_filter(
                frame.t_mid_s, report.attitude, schedule.number
            )
        return Shot(camera, window, frame, truth, report, rate, update_status, clock.seconds)

    def tracker_of(self, schedule: Schedule, frame: Frame) -> factory.Estimator:
        """The tracker of a camera. A new one first solves the frame once, so no time contains the making of tables.

        External trackers do not: each frame must reach them once, in order.
        """
        number = schedule.number
        if number not in self.trackers:
            programs = self.parts.programs
            if number == 0 and self.parts.tracker is not None:
                programs = {**programs, schedule.scene.tracker.name: self.parts.tracker}
            self.trackers[number] = tracker = build_tracker(schedule.camera, programs)
            if not isinstance(tracker, factory.UserTracker):
                factory.solve_frame(tracker, frame)
        return self.trackers[number]

    def measured_rate(self, camera: StarCamera, window: Window) -> RateEstimate | None:
        """Rate from the gyros during an exposure that the tracker receives; None without `tracker.gyro`."""
        scene = camera.scene
        config = scene.vehicle.imu
        samples = self.imu_samples(window.open_s) if scene.tracker.gyro else None
        if config is None or samples is None:
            return None
        return navigation.rate_of_frame(samples, window, config, camera.mount)

    def render(self, index: int, camera: int = 0) -> tuple[Frame, Truth]:
        """Render an exposure of the schedule again from the motion so far; the frame equals that of `shots`.

        Parameters
        ----------
        index
            Index of the frame
        camera
            Number of the camera

        Raises
        ------
        InputError
            For a frame that is not exposed yet.
        """
        schedule = self.schedules[camera]
        scene = schedule.scene
        exposure_s = schedule.exposures_s.get(index)
        if exposure_s is None and scene.tracker.exposure_control:
            raise InputError(
                "render",
                f"frame {index} has no exposure time yet",
                "after it came from shots",
            )
        window = exposure_window(scene, index, exposure_s)
        if not (0 <= index < schedule.frames and window.close_s <= self.now_s):
            raise InputError(
                "render", f"frame {index} is not exposed at {self.now_s:g} s", "one that is"
            )
        return render_frame(schedule.camera, self.trajectory(), index, None, window)

    def observe(self, camera: int = 0, *, solves: bool = True) -> Shot:
        """Render and solve an exposure that ends now, outside of the schedule; the filter is not updated.

        Each observation has its own noise. Before t = 0 the vehicle rotates at its initial rate.
        """
        schedule = self.schedules[camera]
        window = schedule.window_to(self.now_s)
        index = FIRST_OBSERVATION + self.observations
        self.observations += 1
        return self.capture(schedule, index, window, solves, updates_filter=False)


def open_flight(
    scene: Scene,
    *,
    controller: Any = None,
    tracker: Any = None,
    profile: Any = None,
    programs: Mapping[str, str] = factory.NO_PROGRAMS,
    endless: bool = False,
    keeps_history: bool = True,
) -> Flight:
    """A flight of a scene. The parts controller, tracker, profile and programs are those of `skysim.simulate`.

    Raises
    ------
    InputError
        For a part that cannot be used, before any long work.
    """
    scene, parts = with_parts(scene, programs, controller, tracker, profile)
    return Flight(
        build_lab(scene, parts), parts, endless=endless, keeps_history=keeps_history
    )


def simulate_motion(scene: Scene) -> Flight:
    """A flight of the scene after its end. Only the frames that a filter needs are rendered."""
    return open_flight(scene).simulate_motion()
