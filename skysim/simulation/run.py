"""Run a scene from start to end: build, simulate the motion, render and solve the frames.

Without an attitude filter the motion is simulated first (`simulate_motion`) and the frames are rendered and solved
afterwards (`run`). With a filter, frames are rendered and solved during the motion, because the filter and possibly
the controller use their attitudes. `live` yields frames during the motion and keeps only the most recent states.
"""

from __future__ import annotations

import collections
import contextlib
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from estimator.trackers.pipeline import Clock, Report
from skysim.core.types import Frame, Truth
from skysim.scene.scene import Scene
from skysim.simulation.closed_loop import CapturedFrame, ClosedLoop, OnboardCamera, measured_rate
from skysim.simulation.compilation import synthetic_frame
from skysim.simulation.exposure import render_frame
from skysim.simulation.telemetry import TelemetryRecorder
from skysim.simulation.testbed import Testbed, build_testbed, build_tracker, exposure_window
from skysim.tracking import factory
from skysim.tracking.exposure_control import ExposureController

ProgressCallback = Callable[[float, float], None]


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame, its truth, the tracker's report, and the seconds spent in each stage."""

    frame: Frame
    truth: Truth
    report: Report
    seconds: dict[str, float]


def prepare(scene: Scene, watch: ProgressCallback | None = None) -> Testbed:
    """Build the test bed and simulate its motion up to the end of the last exposure.

    watch(t_s, duration_s) is called after every control period.
    """
    return simulate_motion(build_testbed(scene), watch)


def simulate_motion(testbed: Testbed, watch: ProgressCallback | None = None) -> Testbed:
    """Return the test bed with its simulated motion, telemetry and IMU record.

    Each step is a control period: the flight computer sets the controls, MuJoCo integrates, the IMU samples. With
    `filter`, frames are rendered and solved as their exposures end; the star tracker's attitudes reach the
    filter (and with feedback: filter the controller) after the declared latency.
    """
    steps = motion_steps(testbed)
    with contextlib.closing(steps):
        while True:
            try:
                now_s, end_s = next(steps)
            except StopIteration as end:
                return end.value
            if watch:
                watch(now_s, end_s)


def motion_steps(testbed: Testbed) -> Generator[tuple[float, float], None, Testbed]:
    """`simulate_motion` as a generator: yields (t_s, end_s) after every control period, returns the test bed."""
    loop = ClosedLoop(testbed)
    try:
        captured, recorder = yield from fly(loop)
    finally:
        loop.close()
    motion: dict[str, Any] = {
        "trajectory": loop.vibration.add_to(loop.simulation.trajectory()),
        "telemetry": recorder.telemetry(loop.reference if testbed.scene.motion.control else None, testbed.cameras),
        "imu_samples": loop.navigation.imu_samples() if loop.navigation else None,
    }
    main, *heads = (
        replace(camera, **motion, **solved._asdict()) for camera, solved in zip(testbed.cameras, captured, strict=True)
    )
    return replace(main, heads=tuple(heads))


class Captured(NamedTuple):
    """Frames of one camera that were solved during the motion, by index; see `Testbed`."""

    reports: dict[int, Report]
    update_statuses: dict[int, str]
    exposures_s: dict[int, float]


def fly(loop: ClosedLoop) -> Generator[tuple[float, float], None, tuple[list[Captured], TelemetryRecorder]]:
    """Simulate the whole motion; with a filter also the frames. Yields (t_s, end_s) after every control period;
    returns the frames of each camera, and the telemetry.
    """
    testbed, simulation = loop.testbed, loop.simulation
    # Raises InputError for too fast vibration before any long work.
    loop.vibration.subdivisions(simulation.times_s(0, simulation.last_step + 1))
    cameras = onboard_cameras(loop)
    for camera in cameras:
        warm_up_tracker(camera.testbed, camera.tracker)
    captured = [Captured({}, {}, {}) for _ in testbed.cameras]
    recorder = TelemetryRecorder(simulation, loop.flight_computer, loop.navigation)
    # If nothing depends on the motion, one call integrates all of it.
    steps = simulation.steps_left if loop.is_free_motion else round(loop.flight_computer.period_s / simulation.step_s)
    while simulation.steps_left:
        loop.tick(steps, recorder)
        for camera in cameras:
            for frame, _, report, status in camera.capture_due():
                assert report is not None
                reports, update_statuses, exposures_s = captured[camera.number]
                reports[frame.index], update_statuses[frame.index] = report, status
                exposures_s[frame.index] = frame.exposure_s
        yield simulation.now_s, simulation.now_s + simulation.steps_left * simulation.step_s
    return captured, recorder


def onboard_cameras(loop: ClosedLoop) -> list[OnboardCamera]:
    """The cameras whose frames are solved during the motion: with a filter all, else none."""
    if not (loop.testbed.scene.filter and loop.navigation):
        return []
    beds = loop.testbed.cameras
    return [OnboardCamera(loop, build_tracker(bed), number=n) for n, bed in enumerate(beds)]


def live(
    testbed: Testbed, estimator: factory.Estimator | None, selects: Callable[[int, float], bool] | None = None
) -> Iterator[CapturedFrame]:
    """Yield the frames of a test bed during its motion, each rendered as its exposure ends.

    Only the most recent states are kept, so that the motion may last without end. The frames equal those of `run`, and
    are those of the main camera; with a filter the others update it.

    estimator : solves each frame; if None, frames are solved only where the scene has a filter
    selects(index, close_s) : whether to render a frame. Skipping one does not change the others, except that exposure
        control and filter do not see it
    """
    loop = ClosedLoop(testbed, discards_history=True)
    simulation = loop.simulation
    camera = OnboardCamera(loop, estimator or (build_tracker(testbed) if testbed.scene.filter else None), selects)
    heads = onboard_cameras(loop)[1:]
    steps = round(loop.flight_computer.period_s / simulation.step_s)
    try:
        while simulation.steps_left:
            loop.tick(steps)
            yield from camera.capture_due()
            for head in heads:
                collections.deque(head.capture_due(), maxlen=0)  # for the filter
    finally:
        loop.close()


def render_frames(testbed: Testbed) -> Iterator[tuple[Frame, Truth, dict[str, float]]]:
    """Yield every frame with its truth and the seconds spent in each stage; automatic exposure sets each
    exposure time.

    A frame that was already rendered during the motion keeps the exposure time it had then.
    """
    exposure_control = ExposureController(testbed.scene)
    for index in range(testbed.scene.exposure.frames):
        clock = Clock()
        frame, truth = render_frame(testbed, index, clock, testbed.exposures_s.get(index, exposure_control.exposure_s))
        exposure_control.update(frame)
        yield frame, truth, clock.seconds


def warm_up(testbed: Testbed, estimator: factory.Estimator) -> None:
    """Render and solve one frame so that numba compiles before timing.

    External trackers are skipped: each frame must reach them once, in order.
    """
    frame, _ = render_frame(testbed, 0)
    if not isinstance(estimator, factory.UserTracker):
        factory.solve_frame(estimator, frame)


def warm_up_tracker(testbed: Testbed, tracker: factory.Estimator | None) -> None:
    """Solve a synthetic frame so that numba compiles before timing, where no frame can be rendered yet.

    External trackers are skipped, as in `warm_up`.
    """
    if tracker is not None and not isinstance(tracker, factory.UserTracker):
        factory.solve_frame(tracker, synthetic_frame(testbed))


def run(testbed: Testbed, estimator: factory.Estimator) -> Iterator[FrameResult]:
    """Render and solve the frames in order; reuse the reports of frames that were solved during the motion."""
    warm_up(testbed, estimator)
    for frame, truth, seconds in render_frames(testbed):
        report = testbed.reports.get(frame.index)
        if report is None:
            window = exposure_window(testbed.scene, frame.index, frame.exposure_s)
            rate = measured_rate(testbed, testbed.imu_samples, window)
            report = factory.solve_frame(estimator, frame, rate=rate)
        yield FrameResult(frame, truth, report, seconds)
