"""The whole story: a scene is lit, flown, photographed and solved, afterwards or as it happens."""

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

Watch = Callable[[float, float], None]


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame, what it was made from, what the tracker made of it, and seconds spent making it by stage."""

    frame: Frame
    truth: Truth
    report: Report
    seconds: dict[str, float]


def prepare(scene: Scene, watch: Watch | None = None) -> Testbed:
    """Build the vehicle, light the sky or the dome, and fly to the last exposure.

    watch(t_s, duration_s) is called at every tick on the way.
    """
    return simulate_motion(build_testbed(scene), watch)


def simulate_motion(lab: Testbed, watch: Watch | None = None) -> Testbed:
    """The lab after the flight: tick by tick the vehicle's computer steers, MuJoCo moves, the sensors feel.

    A tick is a control period. With `filter` the frames are taken and solved as their exposures end, and what the
    star tracker says is in the filter, and with feedback: filter in the controls, after the latency declared.
    """
    aloft = ClosedLoop(lab)
    flight = aloft.flight
    aloft.vibration.pieces(flight.times_s(0, flight.last + 1))  # too much is told before the flight
    eyes = OnboardCamera(aloft, tracker(lab)) if lab.scene.filter and aloft.navigation else None
    diary = TelemetryRecorder(flight, aloft.pilot, aloft.navigation)
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
    """Frame after frame of a lab on the ground as it happens; memory holds the last moments alone, however long it
    lasts. They are the frames that `run` makes of it.

    estimator : solves each; without one they are not solved, but where a filter needs it
    wanted(index, close_s) : whether a frame is made at all; the others are as they would have been
    """
    aloft = ClosedLoop(lab, forgets=True)
    flight = aloft.flight
    eyes = OnboardCamera(aloft, estimator or (tracker(lab) if lab.scene.filter else None), wanted)
    steps = round(aloft.pilot.period_s / flight.step_s)
    while flight.steps_left:
        aloft.tick(steps)
        yield from eyes.looks()


def render_frames(lab: Testbed) -> Iterator[tuple[Frame, Truth, dict[str, float]]]:
    """Frame after frame with its truth and the seconds it took, each exposed as the one before asks for.

    A frame that was taken in flight is taken again as it was then.
    """
    meter = ExposureController(lab.scene)
    for index in range(lab.scene.exposure.frames):
        clock = Clock()
        frame, truth = render_frame(lab, index, clock, lab.exposures_s.get(index, meter.exposure_s))
        meter.see(frame)
        yield frame, truth, clock.seconds


def warm_up(lab: Testbed, estimator: factory.Estimator) -> None:
    """A frame for the compiler, whose seconds are nobody's; somebody else's tracker gets every frame once, in order."""
    frame, _ = render_frame(lab, 0)
    if not isinstance(estimator, ExternalTracker):
        factory.answer(estimator, frame)


def run(lab: Testbed, estimator: factory.Estimator) -> Iterator[FrameResult]:
    """Photograph and solve frame after frame; what was solved in flight is not solved again."""
    warm_up(lab, estimator)
    for frame, truth, seconds in render_frames(lab):
        report = lab.reports.get(frame.index) or factory.answer(estimator, frame)
        yield FrameResult(frame, truth, report, seconds)
