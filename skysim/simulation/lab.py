"""The laboratory of a scene: the vehicle and its star cameras, with the lights that they see.

`with_parts` puts parts given in Python into a scene. `build_lab` builds the laboratory:

1. Check the names of algorithms and the files, before any long work.
2. Vehicle, mount of the camera, attitude profiles.
3. Main camera with its lights, then the further cameras (heads).

The timing of a scene's frames is that of its cameras: exposure windows, trigger jitter, time tags, duration.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.detector import Detector
from skysim.camera.optics import Optics
from skysim.camera.psf.otf import EXTENT
from skysim.camera.render import Window
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError, errors_under
from skysim.core.plugins import NO_PROGRAMS, Programs
from skysim.core.random_streams import CAMERA_TIMING, JITTER, random_stream
from skysim.core.types import Array, Floats, Mount, Sources, frozen
from skysim.core.units import scaled_errors
from skysim.core.yaml_reader import is_file
from skysim.dynamics import guidance, multibody
from skysim.dynamics.controllers import CONTROLLERS
from skysim.dynamics.jitter import Vibration
from skysim.dynamics.multibody import mjcf_export
from skysim.dynamics.profiles import load_profiles
from skysim.dynamics.reference_curves import AttitudeSpline
from skysim.scene.scene import Scene, check_scene
from skysim.scene.sections.camera import ColorEfficiencyConfig
from skysim.scene.sections.light import DomeConfig
from skysim.scene.sections.motion import (
    PRESCRIBED,
    ControlConfig,
    PointingConfig,
    ProfileConfig,
)
from skysim.simulation.lights.light import KnownLight, Light, LightPlan, Seeds
from skysim.simulation.lights.registry import build_lights
from skysim.sources import catalog, stars
from skysim.sources.camera_orbit import CameraOrbit, Viewpoint, build_orbit
from skysim.sources.photometry import Band
from skysim.tracking import factory
from skysim.tracking.tracker_interface import TRACKERS

# Timing of a scene's frames: exposure windows, trigger jitter, time tags, and the duration of the motion.

MARGIN_S = 2e-3  # time that is simulated after the last exposure
# Longest exposure that a client may set where the scene has none as long.
LONGEST_LIVE_S = 1.0
HISTORY_MARGIN_S = 0.05  # duration of past states that is kept beyond the needs of a frame


def exposure_window(scene: Scene, index: int, exposure_s: float | None = None) -> Window:
    """The exposure window of a frame, which opens late by its trigger jitter; exposure_s defaults to the scene's."""
    jitter_s = scene.exposure.trigger_jitter_s
    late_s = jitter_s * timing_draws(scene.seed, index)[0] if jitter_s else 0.0
    begin_s = scene.exposure.first_s + index / scene.exposure.rate_hz + late_s
    return window_from(scene, begin_s, exposure_s)


def window_from(scene: Scene, begin_s: float, exposure_s: float | None = None) -> Window:
    """The window of an exposure that begins at begin_s, with the row time of the camera's shutter."""
    if exposure_s is None:
        exposure_s = scene.exposure.time_s
    camera = scene.camera
    return Window(begin_s, exposure_s, camera.row_delay_s, camera.height_px)


def time_tag_error_s(scene: Scene, index: int) -> float:
    """Time tag of a frame minus the true time of mid-exposure."""
    exposure = scene.exposure
    if not exposure.time_tag_jitter_s:
        return exposure.time_tag_offset_s
    drawn = np.array(timing_draws(scene.seed, index)[1])
    return exposure.time_tag_offset_s + float(
        scaled_errors(exposure.time_tag_jitter_s, drawn)
    )


@lru_cache(maxsize=64)
def timing_draws(seed: int, index: int) -> tuple[float, float]:
    """A uniform draw for the trigger of a frame, and a standard normal draw for its time tag.

    They are cached, since every control period needs those of the next frame.
    """
    trigger, tag = (random_stream(seed, CAMERA_TIMING, index, part) for part in range(2))
    return trigger.random(), float(tag.standard_normal())


def longest_exposure_s(scene: Scene) -> float:
    """The longest exposure time that a frame can get."""
    control = scene.tracker.exposure_control
    return control.longest_s if control else scene.exposure.time_s


def longest_live_s(scene: Scene) -> float:
    """The longest exposure that a client may set: the scene's longest, or a frame period up to LONGEST_LIVE_S."""
    period_s = min(1 / scene.exposure.rate_hz, LONGEST_LIVE_S)
    return max(longest_exposure_s(scene), period_s)


def frame_end_s(scene: Scene, index: int) -> float:
    """Time until which a motion must last for a frame."""
    return exposure_window(scene, index).close_s + MARGIN_S


def duration_s(scene: Scene) -> float:
    """Duration of a motion until the longest exposure of the last frame ends, and a period begins after its middle.

    Telemetry has a row at the beginning of each control period, so it covers mid-exposure and time tag of all frames.
    """
    last = scene.exposure.frames - 1
    window = exposure_window(scene, last, longest_exposure_s(scene))
    latest_s = window.middle_s + max(time_tag_error_s(scene, last), 0.0)
    covered_s = math.ceil(latest_s * scene.control_rate_hz) / scene.control_rate_hz
    return max(window.close_s, covered_s) + MARGIN_S


def history_s(scene: Scene) -> float:
    """Duration of past states that a frame needs when it is due: longest exposure, latency, two control periods."""
    latency_s = scene.filter.latency_s if scene.filter else 0.0
    window = window_from(scene, 0.0, longest_live_s(scene))
    return window.close_s + latency_s + 2 / scene.control_rate_hz + HISTORY_MARGIN_S


# Parts that are given in Python: a controller, a star tracker, or an attitude profile.

GIVEN_TABLE = "(table)"  # stands for the file of a profile that is given as a table


@frozen
class UserParts:
    """User's parts that replace those of the scene.

    Attributes
    ----------
    programs
        External trackers and controllers by name: commands, or controllers and trackers given in Python
    tracker
        Star tracker of the main camera
    profile
        Table of attitudes that replaces the file of the first maneuver of kind profile
    given
        The arguments of `with_parts` in Python, by name, for reports
    """

    programs: Programs = field(default_factory=dict)
    tracker: factory.Estimator | None = None
    profile: Any = None
    given: Mapping[str, str] = field(default_factory=dict)


NO_PARTS = UserParts()


def with_parts(
    scene: Scene,
    programs: Programs = NO_PROGRAMS,
    controller: Any = None,
    tracker: Any = None,
    profile: Any = None,
) -> tuple[Scene, UserParts]:
    """The scene with the names of these parts, and the parts; see `results.run.simulate` for their types.

    Raises
    ------
    InputError
        For a part of a wrong type.
    """
    check_scene(scene)
    motion = scene.motion
    estimator = None
    if controller is not None:
        check_controller(controller)
        law = controller if isinstance(controller, str) else name_of(controller)
        config = (motion.control or ControlConfig()).with_values(law=law)
        motion = motion.with_values(control=config)
        programs = programs if law is controller else {**programs, law: controller}
    is_named = isinstance(profile, str | Path)
    if profile is not None:
        # Along the profile alone, from its start; prescribed if there is no controller.
        if is_named and not is_file(Path(profile)):
            raise InputError("profile", f"{profile} is not a file", "a file, or a table")
        file = str(profile) if is_named else GIVEN_TABLE
        motion = motion.with_values(
            start="profile",
            rate_deg_s=(0.0, 0.0, 0.0),
            maneuver=(ProfileConfig.model_construct(kind="profile", file=file),),
            control=motion.control or ControlConfig(law=PRESCRIBED),
        )
    scene = scene.with_values(motion=motion)
    if tracker is not None:
        name = tracker if isinstance(tracker, str) else name_of(tracker)
        estimator = None if name is tracker else factory.tracker_of(name, tracker)
        scene = scene.with_values("tracker", name=name)
    table = None if is_named else profile
    parts = {"controller": controller, "tracker": tracker, "profile": profile}
    given = {
        name: repr(str(part)) if isinstance(part, str | Path) else name_of(part)
        for name, part in parts.items()
        if part is not None
    }
    commands = {name: one for name, one in programs.items() if isinstance(one, str)}
    given |= {"programs": repr(commands)} if commands else {}
    return scene, UserParts(programs, estimator, table, given)


def check_controller(controller: Any) -> None:
    """Raise InputError for what is no controller."""
    if not (isinstance(controller, str) or callable(controller)):
        raise InputError(
            "controller",
            type(controller).__name__,
            "a name, or a callable that takes a set-up",
        )


def check_tracker(tracker: Any) -> None:
    """Raise InputError for what is no tracker."""
    if not isinstance(tracker, str):
        factory.tracker_of(name_of(tracker), tracker)


def name_of(part: Any) -> str:
    """Name of a function or class, or of an object's class, for messages and reports."""
    return re.sub(r"\W", "", getattr(part, "__name__", type(part).__name__)) or "function"


# The laboratory.

MAIN = "main"  # name of the camera of the scene's section `camera`


class ColorChannel(NamedTuple):
    """The pixels of one color of a Bayer mosaic, and the lights as they see them.

    Attributes
    ----------
    first_px
        Rows and columns (y, x) of its pixels in the mosaic's first 2 x 2 pixels
    band, lights
        As in `StarCamera`
    """

    first_px: tuple[tuple[int, int], ...]
    band: Band
    lights: tuple[Light, ...]


@frozen
class StarCamera:
    """A camera of the lab: its hardware and the light that reaches it, without time, motion or results.

    Attributes
    ----------
    name
        "main" for the camera of the scene's section `camera`, else the name of the head
    scene
        The scene with this camera's settings, see `Scene.of_head`
    mount
        Assumed position and attitude on the body
    optics, detector, band
        Hardware of the camera; the band of a color camera is that of its gray image
    canvas
        (H, W) array in which the light of every frame is drawn: float32, or float64 without noise, since such a
        frame is the expectation itself
    lights
        Lights in this camera's band, from the farthest to the lens, see `simulation.lights`
    channels
        Red, green and blue pixels of a color camera, whose light is drawn instead; none if it is monochrome
    orbit
        Orbit about the Earth; None for a camera on the ground
    run_seed
        Seed of the draws that all cameras share in a run; the camera's own draws use the seed of its scene
    mount_error
        Rotation of the real camera from the assumed mount; None if there is no error
    """

    name: str
    scene: Scene
    mount: Mount
    optics: Optics
    detector: Detector
    band: Band
    canvas: Array
    lights: tuple[Light, ...]
    channels: tuple[ColorChannel, ...]
    orbit: CameraOrbit | None
    run_seed: int
    mount_error: Rotation | None = None

    @property
    def viewpoint(self) -> Viewpoint:
        """Place of the camera on the Earth or in its orbit, as a function of time."""
        return Viewpoint(self.scene.start_time, self.scene.site, self.orbit)

    @property
    def seeds(self) -> Seeds:
        """Seeds of the lights in this run."""
        return Seeds(self.run_seed, self.scene.seed)

    @property
    def known(self) -> KnownLight:
        """The light of the scene's section `light`, from which a tracker can determine the attitude."""
        return next(light for light in self.lights if isinstance(light, KnownLight))

    @property
    def sources(self) -> Sources:
        """The stars or LEDs of that light at the scene's start."""
        return self.known.sources


@frozen
class Lab:
    """The laboratory: the vehicle and its cameras. It has no time and no results; a `Flight` moves it.

    Attributes
    ----------
    scene
        The scene
    vehicle
        Vehicle on its bearing
    cameras
        The main camera, then the heads of the scene in their order
    start
        lab_from_body at t = 0
    profiles
        Attitude profiles of the maneuvers of kind profile, in their order
    """

    scene: Scene
    vehicle: multibody.VehicleModel
    cameras: tuple[StarCamera, ...]
    start: Rotation
    profiles: tuple[AttitudeSpline, ...] = ()

    @property
    def camera(self) -> StarCamera:
        """The main camera."""
        return self.cameras[0]

    @property
    def duration_s(self) -> float:
        """Duration of the motion: until the longest exposure of the last frame ends, of all cameras."""
        return max(duration_s(camera.scene) for camera in self.cameras)

    @property
    def history_s(self) -> float:
        """Duration of past states that a frame of any camera needs when it is due."""
        return max(history_s(camera.scene) for camera in self.cameras)

    @property
    def reference(self) -> guidance.Reference:
        """The attitude that the scene's maneuvers command."""
        return guidance.plan(self.scene.motion, self.start, self.profiles)

    @property
    def start_rate_rad_s(self) -> Floats:
        """(3,) rate of the vehicle at the start, in body axes."""
        return guidance.body_rate_rad_s(self.scene, self.start, self.profiles)

    def vibration(self, reference: guidance.Reference) -> Vibration:
        """The vibration of the run, with that of the maneuvers of its reference."""
        rng = random_stream(self.scene.seed, JITTER, 0)
        return Vibration(self.scene.motion, rng, reference)

    def in_run(self, seed: int) -> "Lab":
        """The same hardware in the run of another seed: other noise, vibration, timing, and phases of LED clocks."""
        lab = self.with_scene(self.scene.with_values(seed=seed))
        return replace(
            lab, cameras=tuple(replace(camera, run_seed=seed) for camera in lab.cameras)
        )

    def of_camera(self, number: int) -> "Lab":
        """The lab with only one of its cameras, which becomes the main one."""
        camera = self.cameras[number]
        return replace(self, scene=camera.scene, cameras=(camera,))

    def with_scene(self, scene: Scene) -> "Lab":
        """The same hardware with a scene that has the same hardware: other trackers, exposures or times."""
        scenes = [scene, *(scene.of_head(n) for n in range(len(scene.heads)))]
        cameras = tuple(
            replace(camera, scene=own)
            for camera, own in zip(self.cameras, scenes, strict=True)
        )
        return replace(self, scene=scene, cameras=cameras)

    def export_mjcf(self) -> str:
        """The lab as MJCF text, for MuJoCo's viewer and for pictures."""
        return mjcf_export.mjcf(
            self.vehicle, self.scene, self.camera.sources, self.start, self.start_rate_rad_s
        )


def build_lab(scene: Scene, parts: UserParts = NO_PARTS) -> Lab:
    """The laboratory of a scene.

    Parameters
    ----------
    scene
        The scene
    parts
        User's parts. A table of attitudes replaces the file of the first maneuver of kind profile; the names of the
        other parts are checked

    Raises
    ------
    InputError
        For wrong names of algorithms, trackers, controllers or catalogs and for an unreadable PSF or profile, before
        any long work.
    """
    # 1. Names and files.
    check_scene(scene)
    check_hardware(scene, parts.programs, parts.tracker is None)
    if scene.motion.control:
        CONTROLLERS.check_name(scene.motion.control.law, parts.programs)
    # 2. Vehicle.
    vehicle = multibody.build(scene.vehicle)
    mount = multibody.camera_mount(vehicle)
    profiles = load_profiles(scene, mount, parts.profile)
    # 3. Cameras.
    shown = None
    if not isinstance(scene.light, DomeConfig):
        shown = catalog.read_for("light.catalog", scene.light.catalog)
    band = Band.from_camera(scene.camera)
    orbit = build_orbit(scene.orbit, scene.start_time)
    viewpoint = Viewpoint(scene.start_time, scene.site, orbit)
    plan = LightPlan(scene, band, vehicle, viewpoint, shown)
    main = camera_of(MAIN, plan, mount, scene.seed)
    heads = [build_head(n, plan, main, parts.programs) for n in range(len(scene.heads))]
    start = lab_from_body_start(scene, mount, profiles)
    return Lab(scene, vehicle, (main, *heads), start, profiles)


def camera_of(
    name: str,
    plan: LightPlan,
    mount: Mount,
    run_seed: int,
    mount_error: Rotation | None = None,
) -> StarCamera:
    """The camera of a plan of its lights; the other arguments as in `StarCamera`."""
    camera = plan.scene.camera
    dtype = np.float32 if camera.detector.noise else np.float64
    # The red, green and blue pixels of a color camera.
    channels = []
    colors = camera.detector.quantum_efficiency
    for color, curve in colors if isinstance(colors, ColorEfficiencyConfig) else ():
        band = Band.from_camera(camera, curve)
        lights = build_lights(replace(plan, band=band, known=None))
        letters = enumerate(camera.detector.bayer or "")
        first_px = tuple(divmod(n, 2) for n, one in letters if one == color[0].upper())
        channels.append(ColorChannel(first_px, band, lights))
    return StarCamera(
        name,
        plan.scene,
        mount,
        Optics.from_camera(camera),
        Detector.from_camera(camera),
        plan.band,
        np.empty((camera.height_px, camera.width_px), dtype),
        build_lights(plan),
        tuple(channels),
        plan.viewpoint.orbit,
        run_seed,
        mount_error,
    )


def check_hardware(scene: Scene, programs: Programs, has_tracker: bool) -> None:
    """Raise InputError for unusable names and files of a camera and its tracker.

    has_tracker says whether the scene names the tracker; else the user gives it.
    """
    factory.assumed_settings(scene)  # checks the names of algorithms
    if has_tracker:
        TRACKERS.check_name(scene.tracker.name, programs)
    catalog.require_catalog("tracker.catalog", scene.tracker.catalog)
    EXTENT[scene.camera.psf.kind](
        scene.camera.psf, scene.camera
    )  # checks the file of the PSF


def build_head(n: int, plan: LightPlan, main: StarCamera, programs: Programs) -> StarCamera:
    """Head n of the scene: a further camera on the same vehicle under the same lights, from the plan of the main one.

    The strengths of the lights are those in the band of the head. A head without a camera of its own has the main
    camera's band and light.
    """
    head = plan.scene.heads[n]
    scene = plan.scene.of_head(n)
    main_from_head = Rotation.from_rotvec(head.rotation_deg, degrees=True)
    mount = Mount(np.array(head.position_m), main_from_head.inv() * main.mount.cam_from_body)
    with errors_under(f"heads.{n}"):
        check_hardware(scene, programs, True)
        band = Band.from_camera(scene.camera) if head.camera else main.band
        known = None if head.camera else main.known
        plan = replace(plan, scene=scene, band=band, known=known, mount=mount)
        turned = Rotation.from_rotvec(np.array(head.mount_error_arcsec) * ARCSEC_RAD)
        return camera_of(head.name, plan, mount, main.run_seed, turned)


def lab_from_body_start(
    scene: Scene, mount: Mount, profiles: Sequence[AttitudeSpline]
) -> Rotation:
    """lab_from_body at t = 0. In a star scene the lab frame is the ICRS."""
    start = scene.motion.start
    if isinstance(start, PointingConfig):
        cam_from_icrs = stars.cam_from_icrs(start.ra_deg, start.dec_deg, start.roll_deg)
        return cam_from_icrs.inv() * mount.cam_from_body
    return guidance.start_attitude(scene.motion, profiles)


def build_tracker(camera: StarCamera, programs: Programs = NO_PROGRAMS) -> factory.Estimator:
    """The star tracker of a camera, with the hardware parameters that it assumes (see tracking/factory.py).

    Parameters
    ----------
    camera
        Star camera
    programs
        External trackers by name
    """
    return factory.build_tracker(camera.scene, camera.mount, camera.sources, programs)
