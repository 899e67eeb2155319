"""The whole story: a scene is lit, flown, photographed and solved, afterwards or as it happens."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.stages import Clock, Report
from skysim import catalogue, display, dome, imu, manoeuvre, onboard, sky, trackers, world
from skysim.aloft import Aloft, Eyes, Look
from skysim.detector import Chip
from skysim.led import Emitter
from skysim.optics import Optics
from skysim.photometry import Band
from skysim.planetarium import known_catalogue
from skysim.psf import EXTENT
from skysim.scene import Bench, Dome, Pointing, Scene
from skysim.shutter import shoot, window
from skysim.telemetry import Diary
from skysim.types import Frame, Mount, Sources, Telemetry, Trajectory, Truth
from skysim.world import stage

SPARE_S = 2e-3  # flown beyond the last exposure

Watch = Callable[[float, float], None]


@dataclass(frozen=True, slots=True)
class Lab:
    """What a scene becomes before the first frame is kept: hardware, lights and the flight.

    canvas    : (H, W) where the light of one frame after another is drawn; float64 where noise is off, for such a
                frame is the truth to many digits, and float32 otherwise
    trajectory: the flight, jitter and all; telemetry: what the vehicle's computers did in it
    obstacles : what can hide a light; None where the scene has light.occlusion off
    record    : what the IMU put out, every sample of it; None where there is none
    reports   : the star tracker's answers to the frames that were taken and solved in flight, for the filter
    verdicts  : what the filter made of each
    exposures_s: of each
    programs  : commands by name, which the scene's tracker may be: the user's, who alone may say what is run
    endless   : frame follows frame for ever, whatever number the scene has; for `live` alone, which forgets
    """

    scene: Scene
    ship: world.World
    mount: Mount
    sources: Sources
    emitter: Emitter
    optics: Optics
    chip: Chip
    band: Band
    canvas: NDArray[Any]
    trajectory: Trajectory
    obstacles: world.Obstacles | None = None
    telemetry: Telemetry | None = None
    record: imu.Increments | None = None
    reports: dict[int, Report] = field(default_factory=dict)
    verdicts: dict[int, str] = field(default_factory=dict)
    exposures_s: dict[int, float] = field(default_factory=dict)
    programs: Mapping[str, str] = field(default_factory=dict)
    endless: bool = False

    @property
    def frames(self) -> float:
        """How many there are."""
        return math.inf if self.endless else self.scene.exposure.frames

    @property
    def flown_s(self) -> float:
        """How long the flight has to be, for the longest exposure of the last frame."""
        if self.endless:
            return math.inf
        part = self.scene.tracker.exposure_control
        last = window(self.scene, self.scene.exposure.frames - 1, part.longest_s if part else None)
        return last.close_s(self.scene.camera.height_px) + SPARE_S

    @property
    def log(self) -> Telemetry:
        """The telemetry of a lab that has flown."""
        assert self.telemetry is not None, "not flown yet"
        return self.telemetry


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame, what it was made from, what the tracker made of it, and seconds spent making it by stage."""

    frame: Frame
    truth: Truth
    report: Report
    seconds: dict[str, float]


def prepare(scene: Scene, watch: Watch | None = None) -> Lab:
    """Build the vehicle, light the sky or the dome, and fly to the last exposure.

    watch(t_s, duration_s) is called at every tick on the way.
    """
    return fly(furnish(scene), watch)


def furnish(scene: Scene, programs: Mapping[str, str] = onboard.NO_PROGRAMS) -> Lab:
    """The lab on the ground: all but the flight, of which there is the start alone."""
    onboard.believed_settings(scene)  # a wrong name is told before the flight
    trackers.known(scene.tracker.name, programs)  # this one too
    EXTENT[scene.camera.psf.kind](scene.camera.psf, scene.camera)  # and so is a measured PSF's bad file
    ship = world.build(scene.vehicle)
    band = Band.of(scene.camera.detector.quantum_efficiency)
    kind = np.float32 if scene.camera.detector.noise else np.float64
    mount = world.mount(ship)
    start = lab_from_body_start(scene, mount)
    return Lab(
        scene,
        ship,
        mount,
        lights(scene, band),
        Emitter.of(scene.light.led) if isinstance(scene.light, Dome) else Emitter(),
        Optics.of(scene.camera),
        Chip.of(scene.camera),
        band,
        np.empty((scene.camera.height_px, scene.camera.width_px), kind),
        Trajectory.at_rest(start, 1.0),
        obstacles(scene, ship),
        programs=programs,
    )


def obstacles(scene: Scene, ship: world.World) -> world.Obstacles | None:
    """What can hide a light from the camera, if the scene would have it so; a bench has nothing in its beam."""
    if not getattr(scene.light, "occlusion", False):
        return None
    return world.obstacles(ship, dome.surface(scene.light.surface) if isinstance(scene.light, Dome) else None)


def staged(lab: Lab) -> str:
    """The lab as one MJCF text, for MuJoCo's own viewer and for pictures."""
    return stage.mjcf(lab.ship, lab.scene, lab.sources, lab.trajectory.lab_from_body[0])


def fly(lab: Lab, watch: Watch | None = None) -> Lab:
    """The lab after the flight: tick by tick the vehicle's computer steers, MuJoCo moves, the sensors feel.

    A tick is a control period. With `filter` the frames are taken and solved as their exposures end, and what the
    star tracker says is in the filter, and with feedback: filter in the controls, after the latency declared.
    """
    aloft = Aloft(lab)
    flight = aloft.flight
    aloft.vibration.pieces(flight.times_s(0, flight.last + 1))  # too much is told before the flight
    eyes = Eyes(aloft, tracker(lab)) if lab.scene.filter and aloft.navigation else None
    diary = Diary(flight, aloft.pilot, aloft.navigation)
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
    lab: Lab, estimator: onboard.Estimator | None, wanted: Callable[[int, float], bool] | None = None
) -> Iterator[Look]:
    """Frame after frame of a lab on the ground as it happens; memory holds the last moments alone, however long it
    lasts. They are the frames that `run` makes of it.

    estimator : solves each; without one they are not solved, but where a filter needs it
    wanted(index, close_s) : whether a frame is made at all; the others are as they would have been
    """
    aloft = Aloft(lab, forgets=True)
    flight = aloft.flight
    eyes = Eyes(aloft, estimator or (tracker(lab) if lab.scene.filter else None), wanted)
    steps = round(aloft.pilot.period_s / flight.step_s)
    while flight.steps_left:
        aloft.tick(steps)
        yield from eyes.looks()


def lab_from_body_start(scene: Scene, mount: Mount) -> Rotation:
    """The attitude at t = 0. Under the stars the lab's axes are those of the ICRS."""
    start = scene.motion.start
    if isinstance(start, Pointing):
        return sky.cam_from_icrs(start.ra_deg, start.dec_deg, start.roll_deg).inv() * mount.cam_from_body
    return manoeuvre.attitude(start)


def lights(scene: Scene, band: Band) -> Sources:
    """Everything that shines, as the band sees it."""
    if isinstance(scene.light, Dome):
        return dome.sources(scene.light, band)
    stars = catalogue.read(known_catalogue("light.catalogue", scene.light.catalogue))
    if isinstance(scene.light, Bench):
        return display.bench(scene.light, stars, scene.start_time, band)
    return sky.sources(stars, scene.start_time, scene.light.limit_mag, Rotation.identity(), band)


def tracker(lab: Lab) -> onboard.Estimator:
    """The star tracker with what it believes of the hardware."""
    return onboard.tracker(lab.scene, lab.mount, lab.sources, lab.programs)


def photographs(lab: Lab) -> Iterator[tuple[Frame, Truth, dict[str, float]]]:
    """Frame after frame with its truth and the seconds it took, each exposed as the one before asks for.

    A frame that was taken in flight is taken again as it was then.
    """
    meter = onboard.Meter(lab.scene)
    for index in range(lab.scene.exposure.frames):
        clock = Clock()
        frame, truth = shoot(lab, index, clock, lab.exposures_s.get(index, meter.exposure_s))
        meter.see(frame)
        yield frame, truth, clock.seconds


def warm(lab: Lab, estimator: onboard.Estimator) -> None:
    """A frame for the compiler, whose seconds are nobody's; somebody else's tracker gets every frame once, in order."""
    frame, _ = shoot(lab, 0)
    if not isinstance(estimator, onboard.Guest):
        onboard.answer(estimator, frame)


def run(lab: Lab, estimator: onboard.Estimator) -> Iterator[Shot]:
    """Photograph and solve frame after frame; what was solved in flight is not solved again."""
    warm(lab, estimator)
    for frame, truth, seconds in photographs(lab):
        report = lab.reports.get(frame.index) or onboard.answer(estimator, frame)
        yield Shot(frame, truth, report, seconds)
