"""Run a scene from start to end: build, simulate the motion, render and solve the frames.

Without an attitude filter the motion is simulated first (`simulate_motion`) and the frames are rendered and solved
afterwards (`run`). With a filter, frames are rendered and solved during the motion, because the filter and possibly
the controller use their attitudes. `live` yields frames during the motion and keeps only the most recent states.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from estimator.trackers.pipeline import Clock, Report
from skysim.core.types import Frame, Truth
from skysim.scene.scene import Scene
from skysim.simulation.closed_loop import CapturedFrame, ClosedLoop, OnboardCamera
from skysim.simulation.exposure import render_frame
from skysim.simulation.telemetry import TelemetryRecorder
from skysim.simulation.testbed import Testbed, build_testbed, tracker
from skysim.tracking import factory
from skysim.tracking.exposure_control import ExposureController
from skysim.tracking.external.adapter import ExternalTracker

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


def simulate_motion(lab: Testbed, watch: ProgressCallback | None = None) -> Testbed:
    """Return the test bed with its simulated motion, telemetry and IMU record.

    Each step is a control period: the flight computer sets the controls, MuJoCo integrates, the IMU samples. With
    `filter`, frames are rendered and solved as their exposures end; the star tracker's attitudes reach the
    filter (and
    with feedback: filter the controller) after the declared latency.
    """
    aloft = ClosedLoop(lab)
    flight = aloft.flight
    aloft.vibration.pieces(flight.times_s(0, flight.last + 1))  # may raise InputError: do it first
    eyes = OnboardCamera(aloft, tracker(lab)) if lab.scene.filter and aloft.navigation else None
    diary = TelemetryRecorder(flight, aloft.pilot, aloft.navigation)
    # With nothing that reacts to the motion, one call integrates all of it.
    steps = flight.steps_left if aloft.nobody_speaks else round(aloft.pilot.period_s / flight.step_s)
    reports: dict[int, Report] = {}
    verdicts, exposures_s = {}, {}
    while flight.steps_left:
        aloft.tick(steps, diary)
        for look in eyes.looks() if eyes else ():
            index = look.frame.index
            assert look.report is not None
            reports[index], verdicts[index] = look.report, look.verdict
            exposures_s[index] = look.frame.exposure_s
        if watch:
            watch(flight.now_s, flight.now_s + flight.steps_left * flight.step_s)
    return replace(
        lab,
        trajectory=aloft.vibration.lay_over(flight.trajectory()),
        telemetry=diary.telemetry(aloft.reference if lab.scene.motion.control else None),
        record=aloft.navigation.record() if aloft.navigation else None,
        reports=reports,
        verdicts=verdicts,
        exposures_s=exposures_s,
    )


def live(
    lab: Testbed, estimator: factory.Estimator | None, wanted: Callable[[int, float], bool] | None = None
) -> Iterator[CapturedFrame]:
    """Yield the frames of a test bed during its motion, each rendered as its exposure ends.

    Only the most recent states are kept, so that the motion may last without end. The frames equal those of `run`.

    estimator : solves each frame; if None, frames are solved only where the scene has a filter
    wanted(index, close_s) : whether to render a frame. Skipping one does not change the others, except that exposure
        control and filter do not see it
    """
    aloft = ClosedLoop(lab, forgets=True)
    flight = aloft.flight
    eyes = OnboardCamera(aloft, estimator or (tracker(lab) if lab.scene.filter else None), wanted)
    steps = round(aloft.pilot.period_s / flight.step_s)
    while flight.steps_left:
        aloft.tick(steps)
        yield from eyes.looks()


def render_frames(lab: Testbed) -> Iterator[tuple[Frame, Truth, dict[str, float]]]:
    """Yield every frame with its truth and the seconds spent in each stage; automatic exposure sets each
    exposure time.

    A frame that was already rendered during the motion keeps the exposure time it had then.
    """
    meter = ExposureController(lab.scene)
    for index in range(lab.scene.exposure.frames):
        clock = Clock()
        frame, truth = render_frame(lab, index, clock, lab.exposures_s.get(index, meter.exposure_s))
        meter.see(frame)
        yield frame, truth, clock.seconds


def warm_up(lab: Testbed, estimator: factory.Estimator) -> None:
    """Render and solve one frame so that numba compiles before timing.

    External trackers are skipped: each frame must reach them once, in order.
    """
    frame, _ = render_frame(lab, 0)
    if not isinstance(estimator, ExternalTracker):
        factory.solve_frame(estimator, frame)


def run(lab: Testbed, estimator: factory.Estimator) -> Iterator[FrameResult]:
    """Render and solve the frames in order; reuse the reports of frames that were solved during the motion."""
    warm_up(lab, estimator)
    for frame, truth, seconds in render_frames(lab):
        report = lab.reports.get(frame.index) or factory.solve_frame(estimator, frame)
        yield FrameResult(frame, truth, report, seconds)
