"""The whole story: a scene is flown, lit, photographed and solved. Owns the random streams."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator import catalog
from estimator.attitude import SOLVERS
from estimator.camera import Camera
from estimator.centroid import CENTROIDERS
from estimator.detect import DETECTORS
from estimator.identify import IDENTIFIERS
from estimator.nearfield import SOLVERS as NEAR_SOLVERS
from estimator.nearfield import LedMap, Lever
from estimator.tracker import Clock, DomeTracker, Report, Settings, StarTracker
from estimator.types import Attitude, BadImage, Centroids
from skysim import background, catalogue, control, dome, jitter, sky, world
from skysim.camera import Camera as CameraPart
from skysim.camera import RollingShutter
from skysim.detector import Chip, expose, judge, saturation_dn, smear
from skysim.led import Emitter
from skysim.optics import Optics
from skysim.photometry import Band
from skysim.psf import EXTENT
from skysim.quantity import one_of
from skysim.render import Window, render
from skysim.scene import CATALOGUES, Dome, Pointing, Scene
from skysim.types import BadInput, Frame, Mount, Sources, Trajectory, Truth

STAGE_ID = {"detector": 1, "jitter": 2}

Estimator = StarTracker | DomeTracker


def rng(seed: int, stage: str, frame: int) -> np.random.Generator:
    """A stage's random stream for one frame, the same whatever was drawn before: frame 57 renders alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STAGE_ID[stage], frame)))


@dataclass(frozen=True, slots=True)
class Lab:
    """What a scene becomes before the first frame: hardware, lights and the flight.

    canvas : (H, W) where the light of one frame after another is drawn; float64 where noise is off, for such a frame
             is the truth to many digits, and float32 otherwise
    """

    scene: Scene
    mount: Mount
    trajectory: Trajectory
    sources: Sources
    emitter: Emitter
    optics: Optics
    chip: Chip
    band: Band
    canvas: NDArray[Any]


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame, what it was made from, what the tracker made of it, and seconds spent making it by stage."""

    frame: Frame
    truth: Truth
    report: Report
    seconds: dict[str, float]


def prepare(scene: Scene) -> Lab:
    """Build the vehicle, fly it to the last exposure, and light the sky or the dome."""
    believed_settings(scene)  # a wrong name is told before the flight
    EXTENT[scene.camera.psf.kind](scene.camera.psf, scene.camera)  # and so is a measured PSF's bad file
    vehicle = world.build(scene.vehicle)
    mount = world.mount(vehicle)
    last_s = window(scene, scene.exposure.frames - 1).close_s(scene.camera.height_px)
    pilot = None
    if scene.motion.control == "pid":
        plan = control.plan(scene.motion, lab_from_body_start(scene, mount))
        pilot = control.pid(plan, vehicle.inertia_kg_m2, scene.vehicle.torque_limit_nm)
    trajectory = world.fly(
        vehicle,
        lab_from_body_start(scene, mount),
        np.radians(scene.motion.rate_deg_s),
        last_s + 2e-3,
        pilot,
    )
    trajectory = jitter.shake(trajectory, scene.motion.jitter, rng(scene.seed, "jitter", 0))
    band = Band.of(scene.camera.detector.quantum_efficiency)
    emitter = Emitter.of(scene.light.led) if isinstance(scene.light, Dome) else Emitter()
    optics, chip = Optics.of(scene.camera), Chip.of(scene.camera)
    kind = np.float32 if scene.camera.detector.noise else np.float64
    canvas = np.empty((scene.camera.height_px, scene.camera.width_px), kind)
    return Lab(scene, mount, trajectory, lights(scene, band), emitter, optics, chip, band, canvas)


def lab_from_body_start(scene: Scene, mount: Mount) -> Rotation:
    """The attitude at t = 0. Under the stars the lab's axes are those of the ICRS."""
    start = scene.motion.start
    if isinstance(start, Pointing):
        return sky.cam_from_icrs(start.ra_deg, start.dec_deg, start.roll_deg).inv() * mount.cam_from_body
    return control.attitude(start)


def lights(scene: Scene, band: Band) -> Sources:
    """Everything that shines, as the band sees it."""
    if isinstance(scene.light, Dome):
        return dome.sources(scene.light, band)
    if not (CATALOGUES / f"{scene.light.catalogue}.ecsv").is_file():
        known = ", ".join(sorted(path.stem for path in CATALOGUES.glob("hipparcos*.ecsv")))
        raise BadInput(
            f"light.catalogue: {scene.light.catalogue!r} is none of {known}; see skysim catalog build"
        )
    stars = catalogue.read(scene.light.catalogue)
    return sky.sources(stars, scene.start_time, scene.light.limit_mag, Rotation.identity(), band)


def window(scene: Scene, index: int) -> Window:
    """When the chip gathers the light of a frame."""
    shutter = scene.camera.shutter
    row_time_s = shutter.row_time_s if isinstance(shutter, RollingShutter) else 0.0
    begin_s = scene.exposure.first_s + index / scene.exposure.rate_hz
    return Window(begin_s, scene.exposure.time_s, row_time_s)


def shoot(lab: Lab, index: int, clock: Clock | None = None) -> tuple[Frame, Truth]:
    """One frame with its truth. Depends on the scene and the index alone."""
    clock = clock or Clock()
    scene, camera = lab.scene, lab.scene.camera
    when = window(scene, index)
    middle_s = when.middle_s(camera.height_px)
    lab_from_body = lab.trajectory.at(middle_s)
    cam_from_lab = lab.mount.cam_from_body * lab_from_body.inv()
    light_e = lab.canvas
    glow = background.glow_map(scene.background, lab.optics, cam_from_lab, lab.band)
    background.fill(light_e, glow, when.exposure_s)
    seen = render(light_e, lab.sources, lab.optics, lab.trajectory, lab.mount, when, lab.emitter)
    smear(light_e, when.exposure_s, lab.chip.shutter)
    seen = judge(seen, light_e, when.exposure_s, lab.chip)
    clock.lap("render")
    image = expose(light_e, when.exposure_s, lab.chip, rng(scene.seed, "detector", index))
    clock.lap("detector")
    rate_cam = lab.mount.cam_from_body.apply(lab.trajectory.rate_at(middle_s))
    truth = Truth(middle_s, lab_from_body, cam_from_lab, rate_cam, seen)
    return Frame(index, image, middle_s, when.exposure_s, saturation_dn(camera.detector)), truth


def tracker(lab: Lab) -> Estimator:
    """The star tracker with what it believes of the hardware: the scene's `tracker` section, else the truth."""
    scene, believed = lab.scene, lab.scene.tracker
    camera, settings = believed_camera(scene), believed_settings(scene)
    if isinstance(scene.light, Dome):
        centre_m, semi_axes_m = dome.surface(scene.light.surface).as_ellipsoid()
        board = lab.sources.id // dome.HOLES
        leds = LedMap(lab.sources.id, lab.sources.place[:, :3], centre_m, semi_axes_m, board)
        arm = believed.believed_camera_body_m or lab.mount.camera_body_m
        return DomeTracker(camera, leds, Lever(np.array(arm), lab.mount.cam_from_body), settings)
    stars = catalog.read(CATALOGUES / f"{scene.light.catalogue}.ecsv")
    stars = catalog.brighter(stars, believed.limit_mag)
    return StarTracker(camera, stars, catalog.apparent(stars, catalog.on_earth(scene.start_time)), settings)


def believed_camera(scene: Scene) -> Camera:
    """The calibration in the tracker's head."""
    believed_m = scene.tracker.believed_focal_length_m
    return calibration(scene.camera).zoomed(believed_m / scene.camera.focal_length_m if believed_m else 1.0)


def calibration(camera: CameraPart) -> Camera:
    """A perfect calibration of a camera, in the tracker's own terms."""
    return Camera(camera.width_px, camera.height_px, camera.focal_px, camera.centre_px, camera.distortion)


def believed_settings(scene: Scene) -> Settings:
    """The tracker's algorithms and thresholds as the scene names them. Raises BadInput for a wrong name."""
    part = scene.tracker
    near = isinstance(scene.light, Dome)
    return Settings(
        detector=known("detector", part.detector, DETECTORS),
        centroider=known("centroider", part.centroider, CENTROIDERS),
        identifier=known("identifier", part.identifier, IDENTIFIERS),
        solver=known("solver", part.solver, NEAR_SOLVERS if near else SOLVERS),
        threshold_sigma=part.threshold_sigma,
        min_area_px=part.min_area_px,
        gain_e_dn=scene.camera.detector.gain_e_dn,
        saturation=saturation_dn(scene.camera.detector),
        centroid_sigma_px=part.centroid_sigma_px,
    )


def known(key: str, name: str, algorithms: Mapping[str, object]) -> str:
    """The name, if there is such an algorithm: only the estimator knows, and scene.py may not ask it."""
    try:
        return one_of(name, algorithms)
    except ValueError as error:
        raise BadInput(f"tracker.{key}: {error}") from None


def run(lab: Lab, estimator: Estimator) -> Iterator[Shot]:
    """Photograph and solve frame after frame."""
    answer(estimator, shoot(lab, 0)[0])  # a frame for the compiler, whose seconds are nobody's
    for index in range(lab.scene.exposure.frames):
        clock = Clock()
        frame, truth = shoot(lab, index, clock)
        yield Shot(frame, truth, answer(estimator, frame), clock.seconds)


def answer(estimator: Estimator, frame: Frame) -> Report:
    """The tracker's report; a frame that it will not look at (empty, saturated) is a status too."""
    try:
        return estimator.solve(frame.image_dn)
    except BadImage as error:
        return Report(Attitude(str(error)), Centroids.none())
