"""The whole story: a scene is flown, lit, photographed and solved. Owns the random streams and the closed loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.stages import Clock, Report
from skysim import background, catalogue, display, dome, imu, manoeuvre, onboard, sky, world
from skysim.camera import RollingShutter
from skysim.detector import Chip, expose, judge, saturation_dn, smear
from skysim.disturbance import Room
from skysim.jitter import Vibration
from skysim.led import Emitter
from skysim.optics import Optics
from skysim.photometry import Band
from skysim.pilot import Now, Pilot
from skysim.planetarium import known_catalogue
from skysim.psf import EXTENT
from skysim.render import Poses, Window, in_view, look, render
from skysim.scene import Bench, Dome, Pointing, Scene
from skysim.telemetry import Diary
from skysim.types import BadInput, Floats, Frame, Mount, Sources, Telemetry, Trajectory, Truth
from skysim.world import stage

STAGE_ID = {"detector": 1, "jitter": 2, "imu": 3, "draught": 4}
SPARE_S = 2e-3  # flown beyond the last exposure
LOOK_S = 0.05  # between two looks at what a manoeuvre asks for

Watch = Callable[[float, float], None]


def rng(seed: int, stage: str, frame: int) -> np.random.Generator:
    """A stage's random stream for one frame, the same whatever was drawn before: frame 57 renders alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STAGE_ID[stage], frame)))


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

    @property
    def flown_s(self) -> float:
        """How long the flight has to be, for the longest exposure of the last frame."""
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


def furnish(scene: Scene) -> Lab:
    """The lab on the ground: all but the flight, of which there is the start alone."""
    onboard.believed_settings(scene)  # a wrong name is told before the flight
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
    scene, ship = lab.scene, lab.ship
    start = lab.trajectory.lab_from_body[0]
    flight = world.Flight(ship, start, np.radians(scene.motion.rate_deg_s), lab.flown_s)
    vibration = Vibration.of(scene.motion, rng(scene.seed, "jitter", 0))
    vibration.pieces(flight.times_s(0, len(flight.states)))  # too much is told before the flight
    reference = manoeuvre.plan(scene.motion, start)
    pilot, navigation = Pilot(scene, ship, reference), navigator(lab, start)
    room = Room.of(
        scene.vehicle.disturbances,
        imu.earth_rate_lab_rad_s(scene.lab),
        manoeuvre.knocks(scene.motion),
        ship.inertia_kg_m2,
        pilot.period_s,
        rng(scene.seed, "draught", 0),
    )
    eyes = Eyes(lab, vibration, navigation) if scene.filter and navigation else None
    diary = Diary(flight, pilot, navigation)
    steps = round(pilot.period_s / flight.step_s)
    if not (scene.motion.control or navigation) and room.quiet:
        steps = flight.steps_left  # nobody has anything to say before the end
    check_reference(reference, lab)
    while flight.steps_left:
        tick(flight, pilot, room, navigation, diary, min(steps, flight.steps_left))
        if navigation:
            navigation.feel(flight.now_s, *felt(flight, vibration, steps))
        if eyes:
            eyes.look(flight)
        if watch:
            watch(flight.now_s, flight.now_s + flight.steps_left * flight.step_s)
    told = reference if scene.motion.control else None
    return replace(
        lab,
        trajectory=vibration.lay_over(flight.trajectory()),
        telemetry=diary.telemetry(told),
        record=navigation.record() if navigation else None,
        reports=eyes.reports if eyes else {},
        verdicts=eyes.verdicts if eyes else {},
        exposures_s=eyes.exposures_s if eyes else {},
    )


def check_reference(reference: manoeuvre.Reference, lab: Lab) -> None:
    """Refuse a manoeuvre that asks for a tilt beyond the stop, which the controller would push against."""
    vehicle = lab.scene.vehicle
    if vehicle.mount != "air_bearing" or lab.scene.motion.control is None:
        return
    t_s = np.arange(0, min(reference.duration_s, lab.flown_s) + LOOK_S, LOOK_S)
    tilt_deg = world.tilt_deg(reference.attitudes(t_s))
    beyond = np.flatnonzero(tilt_deg > vehicle.tilt_stop_deg)
    if len(beyond):
        raise BadInput(
            f"motion.manoeuvre: asks for a tilt of {tilt_deg[beyond[0]]:.3g} deg at {t_s[beyond[0]]:.3g} s, beyond"
            f" vehicle.tilt_stop_deg {vehicle.tilt_stop_deg:g}"
        )


def tick(
    flight: world.Flight,
    pilot: Pilot,
    room: Room,
    navigation: onboard.Navigation | None,
    diary: Diary,
    steps: int,
) -> None:
    """One control period: believe, steer, be disturbed, move."""
    t_s, angles, speeds = flight.now_s, flight.angles_rad, flight.speeds_rad_s
    attitude, rate = flight.lab_from_body_wxyz, flight.rate_body_rad_s
    stored = pilot.momentum_nms(angles, speeds)
    seen, turning = attitude, rate
    if pilot.told and pilot.told.feedback != "truth" and navigation:
        seen, turning = navigation.attitude_wxyz(pilot.told.feedback), navigation.rate(pilot.told.feedback)
    control = np.empty((steps, flight.model.nu))
    control[:] = pilot.steer(Now(t_s, pilot.period_s, turning, angles, speeds), seen, stored)
    if not room.quiet:
        times_s = flight.times_s(flight.step, flight.step + steps + 1)
        disturbance = room.torque_nm(times_s, attitude, rate, stored)
        control[:, flight.world.torques] += disturbance
        diary.disturbed(disturbance.sum(axis=0) / steps)
    diary.note(stored)
    flight.advance(control)


def felt(flight: world.Flight, vibration: Vibration, steps: int) -> tuple[Floats, Floats, Floats]:
    """Times (K,), attitudes (K, 4) as wxyz and rates (K, 3) of the last steps, with what shakes them."""
    begin = max(flight.step - steps, 0)
    if not vibration.voices:
        return flight.knots(begin)
    shaken = vibration.lay_over(flight.trajectory(begin))
    return shaken.t_s, shaken.lab_from_body.as_quat(scalar_first=True), shaken.rate_body_rad_s


def navigator(lab: Lab, start: Rotation) -> onboard.Navigation | None:
    """The computer that listens to the gyros, where there are any."""
    if lab.scene.vehicle.imu is None:
        return None
    place_m = world.imu_place_m(lab.ship)
    stream = rng(lab.scene.seed, "imu", 0)
    return onboard.Navigation(lab.scene, lab.mount, start, place_m, lab.ship.gravity_m_s2, stream)


class Eyes:
    """The star tracker in flight: every frame is taken and solved when its time has come, and told the filter."""

    def __init__(self, lab: Lab, vibration: Vibration, navigation: onboard.Navigation) -> None:
        self.lab, self.vibration, self.navigation = lab, vibration, navigation
        self.tracker, self.meter = tracker(lab), onboard.Meter(lab.scene)
        self.reports: dict[int, Report] = {}
        self.verdicts: dict[int, str] = {}
        self.exposures_s: dict[int, float] = {}

    def look(self, flight: world.Flight) -> None:
        """All frames whose exposure ended the filter's latency ago, and which were not solved yet."""
        scene = self.lab.scene
        assert scene.filter is not None
        while len(self.reports) < scene.exposure.frames:
            index = len(self.reports)
            when = window(scene, index, self.meter.exposure_s)
            if when.close_s(scene.camera.height_px) + scene.filter.latency_s > flight.now_s:
                return
            since = flight.trajectory(max(int(when.open_s / flight.step_s) - 1, 0))
            here = replace(self.lab, trajectory=self.vibration.lay_over(since))
            frame, _ = shoot(here, index, exposure_s=when.exposure_s)
            self.meter.see(frame)
            report = onboard.answer(self.tracker, frame)
            self.reports[index], self.exposures_s[index] = report, when.exposure_s
            self.verdicts[index] = self.navigation.see(frame.t_mid_s, report.attitude)


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


def window(scene: Scene, index: int, exposure_s: float | None = None) -> Window:
    """When the chip gathers the light of a frame; for the scene's own exposure if none is given."""
    shutter = scene.camera.shutter
    row_time_s = shutter.row_time_s if isinstance(shutter, RollingShutter) else 0.0
    begin_s = scene.exposure.first_s + index / scene.exposure.rate_hz
    return Window(begin_s, scene.exposure.time_s if exposure_s is None else exposure_s, row_time_s)


def shoot(
    lab: Lab, index: int, clock: Clock | None = None, exposure_s: float | None = None
) -> tuple[Frame, Truth]:
    """One frame with its truth. Depends on the scene, the index and the exposure (the scene's if left out) alone."""
    clock = clock or Clock()
    scene, camera = lab.scene, lab.scene.camera
    when = window(scene, index, exposure_s)
    middle_s = when.middle_s(camera.height_px)
    lab_from_body = lab.trajectory.at(middle_s)
    cam_from_lab = lab.mount.cam_from_body * lab_from_body.inv()
    light_e = lab.canvas
    glow = background.glow_map(scene.background, lab.optics, cam_from_lab, lab.band)
    background.fill(light_e, glow, when.exposure_s)
    camera_m = lab_from_body.apply(lab.mount.camera_body_m)
    black = display.black_glow(scene.light, lab.optics, cam_from_lab, camera_m, lab.band)
    if black is not None:
        light_e += black * when.exposure_s
    hides = partial(world.hidden, lab.obstacles, lab_from_body) if lab.obstacles else None
    seen = render(light_e, lab.sources, lab.optics, lab.trajectory, lab.mount, when, lab.emitter, hides)
    smear(light_e, when.exposure_s, lab.chip.shutter)
    seen = judge(seen, light_e, when.exposure_s, lab.chip)
    clock.lap("render")
    image = expose(light_e, when.exposure_s, lab.chip, rng(scene.seed, "detector", index))
    clock.lap("detector")
    rate_cam = lab.mount.cam_from_body.apply(lab.trajectory.rate_at(middle_s))
    truth = Truth(middle_s, lab_from_body, cam_from_lab, rate_cam, seen, behind_things(lab, lab_from_body))
    return Frame(index, image, middle_s, when.exposure_s, saturation_dn(camera.detector)), truth


def behind_things(lab: Lab, lab_from_body: Rotation) -> NDArray[np.int64]:
    """(M,) ids of the sources that would be on the chip at that attitude, had something not stood in the way."""
    if lab.obstacles is None:
        return np.zeros(0, np.int64)
    cam_from_lab = (lab.mount.cam_from_body * lab_from_body.inv()).as_matrix()
    here = Poses(cam_from_lab[None], lab_from_body.apply(lab.mount.camera_body_m)[None])
    near = lab.sources.take(in_view(lab.sources, lab.optics, here))
    xy_px = look(near, lab.optics, here)[0][0]
    size_px = np.array([lab.scene.camera.width_px, lab.scene.camera.height_px])
    on_chip = ((xy_px > -0.5) & (xy_px < size_px - 0.5)).all(axis=1)
    return near.id[on_chip & world.hidden(lab.obstacles, lab_from_body, near)]


def tracker(lab: Lab) -> onboard.Estimator:
    """The star tracker with what it believes of the hardware."""
    return onboard.tracker(lab.scene, lab.mount, lab.sources)


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


def run(lab: Lab, estimator: onboard.Estimator) -> Iterator[Shot]:
    """Photograph and solve frame after frame; what was solved in flight is not solved again."""
    onboard.answer(estimator, shoot(lab, 0)[0])  # a frame for the compiler, whose seconds are nobody's
    for frame, truth, seconds in photographs(lab):
        report = lab.reports.get(frame.index) or onboard.answer(estimator, frame)
        yield Shot(frame, truth, report, seconds)
