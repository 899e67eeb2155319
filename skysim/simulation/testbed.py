"""The test bed of a scene: vehicle, sources, optics, detector and trajectory."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.trackers.pipeline import Report
from skysim.camera.detector.detector import Detector
from skysim.camera.optics import Optics
from skysim.camera.psf.otf import EXTENT
from skysim.camera.render import Window
from skysim.core.errors import InputError
from skysim.core.quantities.tolerance import scaled_errors
from skysim.core.quantities.units import ARCSEC_RAD
from skysim.core.random_streams import CAMERA_TIMING, random_stream
from skysim.core.types import Floats, Mount, Sources, StarSources, Telemetry, Trajectory
from skysim.dynamics import guidance, imu, multibody
from skysim.dynamics.controllers.adapter import ControllerSource
from skysim.dynamics.controllers.interface import Factory
from skysim.dynamics.multibody.view import mjcf_export
from skysim.dynamics.profiles.load import load_profiles
from skysim.dynamics.profiles.spline import AttitudeSpline
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import RollingShutterConfig
from skysim.scene.sections.light import CollimatedDisplayConfig, DomeConfig, StarsConfig
from skysim.scene.sections.motion import PointingConfig
from skysim.sources import catalog, dome
from skysim.sources import stars as star_sources
from skysim.sources.air.air import Air, Sky
from skysim.sources.dome.displays import display
from skysim.sources.dome.layouts.led_list import led_list
from skysim.sources.dome.led import Emitter
from skysim.sources.dome.reflection.dome import ReflectingDome, reflecting_dome
from skysim.sources.dome.shell import surface
from skysim.sources.dome.timing.clocks import Clocks, build_clocks
from skysim.sources.dome.timing.codes import LedCodes, build_codes
from skysim.sources.orbit.camera_orbit import CameraOrbit, build_orbit, state_at
from skysim.sources.orbit.earth import hidden_by_earth
from skysim.sources.orbit.elements import Elements, read_elements
from skysim.sources.orbit.satellites import MovingLight, View, known_satellites, random_satellites
from skysim.sources.photometry import Band
from skysim.sources.solar_system.bodies import BodyLight, bodies_from
from skysim.sources.solar_system.observer import GcrsState, Observer, observe_at, site_in_gcrs, tt_jd
from skysim.tracking import factory, settings
from skysim.tracking.external.interface import TRACKERS


def exposure_window(scene: Scene, index: int, exposure_s: float | None = None) -> Window:
    """The exposure window of a frame, opened late by its jitter; as long as the scene's if no time is given."""
    shutter = scene.camera.shutter
    row_time_s = shutter.row_time_s if isinstance(shutter, RollingShutterConfig) else 0.0
    jitter_s = scene.exposure.trigger_jitter_s
    late_s = jitter_s * timing_draws(scene.seed, index)[0] if jitter_s else 0.0
    begin_s = scene.exposure.first_s + index / scene.exposure.rate_hz + late_s
    return Window(begin_s, scene.exposure.time_s if exposure_s is None else exposure_s, row_time_s)


def time_tag_error_s(scene: Scene, index: int) -> float:
    """The time that the camera gives to a frame minus the true time of mid-exposure."""
    exposure = scene.exposure
    if not exposure.time_tag_jitter_s:
        return exposure.time_tag_offset_s
    drawn = np.array(timing_draws(scene.seed, index)[1])
    return exposure.time_tag_offset_s + float(scaled_errors(exposure.time_tag_jitter_s, drawn))


@lru_cache(maxsize=64)
def timing_draws(seed: int, index: int) -> tuple[float, float]:
    """The uniform number of a frame's trigger and the normal one of its time tag; asked for in every control period."""
    trigger, tag = (random_stream(seed, CAMERA_TIMING, index, part) for part in range(2))
    return trigger.random(), float(tag.standard_normal())


MARGIN_S = 2e-3  # simulated beyond the last exposure


@dataclass(frozen=True, slots=True)
class Testbed:
    """Hardware, light sources and trajectory of a scene, before or after its motion is simulated.

    canvas    : (H, W) array in which every frame's light is drawn; float64 where noise is off, since such a frame
                is the expectation itself, and float32 otherwise
    trajectory: the simulated motion, jitter included; telemetry: what the vehicle's computers did in it
    clocks    : the LED controllers' oscillators in this run; None where all light is steady
    codes     : the LEDs' words and the clock of their bits in this run; None without light.led.code
    air       : over the site of a sky scene with `light.air`
    obstacles : occluders of the sources; None where the scene has light.occlusion off
    reflecting : the dome's reflections; None without light.reflection
    imu_samples: every sample of the IMU; None without one
    reports   : the star tracker's reports on frames solved during the motion (for the filter), by frame index
    update_statuses: the filter's status of each of those updates
    exposures_s: exposure time of each of those frames
    programs  : commands of external trackers and controllers by name; only the user's command line sets them
    profiles  : attitude profiles of the maneuvers of that kind, in their order
    controller, tracker : given to `skysim.simulate` in place of those that the scene names
    endless   : frames continue without end, whatever the scene's number; only for `live`
    orbit     : the camera's; None without the section
    satellites: elements of `light.satellites.file`
    heads     : the same with each of the scene's further star cameras in place of the main one
    mount_error : rotation of the real camera from the assumed mount; None for none
    """

    scene: Scene
    vehicle: multibody.VehicleModel
    mount: Mount
    sources: Sources
    emitter: Emitter
    optics: Optics
    detector: Detector
    band: Band
    canvas: NDArray[Any]
    trajectory: Trajectory
    clocks: Clocks | None = None
    codes: LedCodes | None = None
    air: Air | None = None
    obstacles: multibody.Obstacles | None = None
    reflecting: ReflectingDome | None = None
    telemetry: Telemetry | None = None
    imu_samples: imu.Increments | None = None
    reports: dict[int, Report] = field(default_factory=dict)
    update_statuses: dict[int, str] = field(default_factory=dict)
    exposures_s: dict[int, float] = field(default_factory=dict)
    programs: Mapping[str, str] = field(default_factory=dict)
    profiles: tuple[AttitudeSpline, ...] = ()
    controller: Factory | None = None
    tracker: factory.Estimator | None = None
    endless: bool = False
    orbit: CameraOrbit | None = None
    satellites: Elements | None = None
    heads: tuple[Testbed, ...] = ()
    mount_error: Rotation | None = None

    @property
    def cameras(self) -> tuple[Testbed, ...]:
        """The test beds of all cameras, that of the main one first."""
        return self, *self.heads

    @property
    def frames(self) -> float:
        """Number of frames; infinite if endless."""
        return math.inf if self.endless else self.scene.exposure.frames

    @property
    def duration_s(self) -> float:
        """Duration to simulate, s: to the end of the last frame's longest exposure, of all cameras."""
        if self.endless:
            return math.inf
        config = self.scene.tracker.exposure_control
        last = exposure_window(self.scene, self.scene.exposure.frames - 1, config.longest_s if config else None)
        own_s = last.close_s(self.scene.camera.height_px) + MARGIN_S
        return max(own_s, *(head.duration_s for head in self.heads)) if self.heads else own_s

    @property
    def controllers(self) -> ControllerSource:
        """Where external controllers come from, beside entry points."""
        return ControllerSource(self.programs, self.controller)

    def in_run(self, seed: int) -> Testbed:
        """The same hardware in the run of another seed: other noise, jitter, timing and phases of the LEDs' clocks."""
        scene = self.scene.model_copy(update={"seed": seed})
        clocks = build_clocks(scene.light, self.sources, seed)
        codes = build_codes(scene.light, self.sources, seed)
        heads = tuple(
            replace(head, scene=scene.of_head(n), clocks=clocks, codes=codes) for n, head in enumerate(self.heads)
        )
        return replace(self, scene=scene, clocks=clocks, codes=codes, heads=heads)

    def at_rest(self, lab_from_body: Rotation, index: int = 0) -> Testbed:
        """The test bed with the vehicle at rest at this attitude, until after the exposure of a frame."""
        end_s = exposure_window(self.scene, index).close_s(self.scene.camera.height_px) + MARGIN_S
        return replace(self, trajectory=Trajectory.at_rest(lab_from_body, end_s))

    @property
    def log(self) -> Telemetry:
        """The telemetry; only after `simulate_motion`."""
        assert self.telemetry is not None, "motion not simulated yet"
        return self.telemetry


def build_testbed(
    scene: Scene,
    programs: Mapping[str, str] = factory.NO_PROGRAMS,
    *,
    controller: Factory | None = None,
    tracker: factory.Estimator | None = None,
    profile: Any = None,
) -> Testbed:
    """Build hardware, sources and the initial attitude; do not simulate the motion.

    controller, tracker : in place of those that the scene names
    profile             : table of attitudes in place of the file of the first maneuver of kind profile
    Raises InputError for wrong names of algorithms, trackers, controllers or catalogs and for an unreadable PSF or
    profile, before any long work.
    """
    check_hardware(scene, programs, tracker is None)
    if scene.motion.control:
        ControllerSource(programs, controller).check_name(scene.motion.control.law)
    vehicle = multibody.build(scene.vehicle)
    band = Band.from_camera(scene.camera)
    dtype = np.float32 if scene.camera.detector.noise else np.float64
    mount = multibody.camera_mount(vehicle)
    profiles = load_profiles(scene, mount, profile)
    orbit, satellites = build_orbit(scene.orbit, scene.start_time), getattr(scene.light, "satellites", None)
    stars = scene_stars(scene)
    sources = light_sources(scene, band, orbit, stars)
    testbed = Testbed(
        scene,
        vehicle,
        mount,
        sources,
        Emitter.from_config(scene.light.led) if isinstance(scene.light, DomeConfig) else Emitter(),
        Optics.from_camera(scene.camera),
        Detector.from_camera(scene.camera),
        band,
        np.empty((scene.camera.height_px, scene.camera.width_px), dtype),
        Trajectory.at_rest(lab_from_body_start(scene, mount, profiles), 1.0),
        build_clocks(scene.light, sources, scene.seed),
        build_codes(scene.light, sources, scene.seed),
        build_air(scene, band, stars),
        build_obstacles(scene, vehicle),
        reflecting_dome(scene.light, sources),
        programs=programs,
        profiles=profiles,
        controller=controller,
        tracker=tracker,
        orbit=orbit,
        satellites=read_elements(satellites.file) if satellites and satellites.file else None,
    )
    return replace(testbed, heads=tuple(build_head(testbed, n, stars) for n in range(len(scene.heads))))


def check_hardware(scene: Scene, programs: Mapping[str, str], has_tracker: bool) -> None:
    """Raise InputError for unusable names and files of the camera and, if it is the scene's, of the tracker."""
    settings.assumed_settings(scene)  # raises for a wrong algorithm name
    if has_tracker:
        TRACKERS.check_name(scene.tracker.name, programs)
    catalog.require_catalog("tracker.catalog", scene.tracker.catalog)
    EXTENT[scene.camera.psf.kind](scene.camera.psf, scene.camera)  # raises for a bad PSF file


def build_head(testbed: Testbed, n: int, stars: catalog.Catalog | None) -> Testbed:
    """The test bed with head n of the scene as its camera: the same vehicle, motion and lights.

    The lights' strengths are those in the band of the head's camera.
    """
    head, scene = testbed.scene.heads[n], testbed.scene.of_head(n)
    try:
        check_hardware(scene, testbed.programs, True)
        band, sources = testbed.band, testbed.sources
        if head.camera:
            band = Band.from_camera(scene.camera)
            sources = light_sources(scene, band, testbed.orbit, stars)
    except InputError as error:
        raise InputError("", f"heads.{n}.{error}") from None
    main_from_head = Rotation.from_rotvec(head.rotation_deg, degrees=True)
    mount = Mount(np.array(head.position_m), main_from_head.inv() * testbed.mount.cam_from_body)
    dtype = np.float32 if scene.camera.detector.noise else np.float64
    return replace(
        testbed,
        scene=scene,
        mount=mount,
        sources=sources,
        optics=Optics.from_camera(scene.camera),
        detector=Detector.from_camera(scene.camera),
        band=band,
        canvas=np.empty((scene.camera.height_px, scene.camera.width_px), dtype),
        air=build_air(scene, band, stars),
        obstacles=build_obstacles(scene, testbed.vehicle, mount),
        reflecting=reflecting_dome(scene.light, sources),
        tracker=None,
        heads=(),
        mount_error=Rotation.from_rotvec(np.array(head.mount_error_arcsec) * ARCSEC_RAD),
    )


def build_air(scene: Scene, band: Band, stars: catalog.Catalog | None) -> Air | None:
    """The air over the scene's site; None without the section `light.air`."""
    if not isinstance(scene.light, StarsConfig) or scene.light.air is None or stars is None:
        return None
    return Air.from_config(scene.light.air, scene.site, stars, band)


def build_obstacles(
    scene: Scene, vehicle: multibody.VehicleModel, mount: Mount | None = None
) -> multibody.Obstacles | None:
    """Occluders, or None if `light.occlusion` is off (a collimated display has none). mount : of a further camera."""
    if not getattr(scene.light, "occlusion", False):
        return None
    return multibody.build_obstacles(
        vehicle, surface.build_surface(scene.light.surface) if isinstance(scene.light, DomeConfig) else None, mount
    )


def export_mjcf(testbed: Testbed) -> str:
    """The test bed as MJCF text, for MuJoCo's viewer and for pictures."""
    return mjcf_export.mjcf(testbed.vehicle, testbed.scene, testbed.sources, testbed.trajectory.lab_from_body[0])


def export_leds(testbed: Testbed) -> tuple[str, int]:
    """The LEDs of the test bed's dome as `led_list` returns them. Raises InputError without a dome."""
    scene = testbed.scene
    if not isinstance(scene.light, DomeConfig):
        raise InputError("light.kind", f"{scene.light.kind} has no list of LEDs", "dome")
    return led_list(scene.light, testbed.band, scene.name)


def lab_from_body_start(scene: Scene, mount: Mount, profiles: Sequence[AttitudeSpline] = ()) -> Rotation:
    """The attitude at t = 0. For a star scene the lab frame is the ICRS."""
    start = scene.motion.start
    if isinstance(start, PointingConfig):
        return star_sources.cam_from_icrs(start.ra_deg, start.dec_deg, start.roll_deg).inv() * mount.cam_from_body
    return guidance.start_attitude(scene.motion, profiles)


def scene_stars(scene: Scene) -> catalog.Catalog | None:
    """The catalog of the scene's light; None for a dome."""
    if isinstance(scene.light, DomeConfig):
        return None
    return catalog.read_for("light.catalog", scene.light.catalog)


def light_sources(
    scene: Scene, band: Band, orbit: CameraOrbit | None = None, stars: catalog.Catalog | None = None
) -> Sources:
    """All light sources of the scene at its start, with strengths in the camera's band.

    stars : those of `scene_stars`, which are read if they are left out
    """
    if isinstance(scene.light, DomeConfig):
        return dome.sources(scene.light, band)
    if stars is None:
        stars = catalog.read_for("light.catalog", scene.light.catalog)
    if isinstance(scene.light, CollimatedDisplayConfig):
        return display.display_sources(scene.light, stars, scene.start_time, band)
    if scene.light.variability_seed is not None:
        if not stars.scatter_mag.any():
            raise InputError("light.variability_seed", f"{scene.light.catalog} has no variable stars", "gaia_v8.0")
        stars = star_sources.varied(stars, scene.light.variability_seed)
    velocity_m_s: Floats | tuple[float, ...] = star_sources.AT_REST
    if scene.light.bodies or scene.light.satellites or scene.light.air or orbit:
        velocity_m_s = state_from_earth(scene, orbit, 0.0).velocity_m_s
    return star_sources.sources(stars, scene.start_time, scene.light.limit_mag, Rotation.identity(), band, velocity_m_s)


def bodies_during(testbed: Testbed, t_s: float) -> list[BodyLight]:
    """Sun, Moon and planets at a time since the scene's start; none where the scene has no `light.bodies`.

    In an orbit those whose center is behind the Earth are left out.
    """
    scene = testbed.scene
    if not isinstance(scene.light, StarsConfig) or scene.light.bodies is None:
        return []
    observer = observer_during(testbed, t_s)
    bodies = bodies_from(scene.light.bodies, observer, testbed.band)
    if sky := sky_during(testbed, t_s):
        return [sky.body_seen(body) for body in bodies]
    if testbed.orbit is None:
        return bodies
    return [body for body in bodies if not hidden_by_earth(observer.from_earth.position_m, body.place.direction)]


def state_from_earth(scene: Scene, orbit: CameraOrbit | None, t_s: float) -> GcrsState:
    """The camera's state in the GCRS at a time since the scene's start: in its orbit, else at the site."""
    if orbit:
        return state_at(orbit, t_s)
    time = time_at(scene, t_s)
    return site_in_gcrs(time, tt_jd(time), scene.site)


def observer_during(testbed: Testbed, t_s: float) -> Observer:
    """The camera among the bodies of the solar system, at a time since the scene's start."""
    time = time_at(testbed.scene, t_s)
    return observe_at(time, state_from_earth(testbed.scene, testbed.orbit, t_s))


def satellites_during(testbed: Testbed, view: View, t_s: float, index: int) -> list[MovingLight]:
    """The satellites in a frame, those of the file first; none where the scene has no `light.satellites`."""
    scene, found = testbed.scene, list[MovingLight]()
    config = scene.light.satellites if isinstance(scene.light, StarsConfig) else None
    if config and testbed.satellites:
        time = time_at(scene, t_s)

        def observer_at(after_s: float) -> GcrsState:
            return state_from_earth(scene, testbed.orbit, t_s + after_s)

        found += known_satellites(testbed.satellites, config.standard_mag, view, time, observer_at)
    if config and config.random:
        found += random_satellites(config.random, view, scene.seed, index)
    return found


def lights_during(testbed: Testbed, view: View, t_s: float, exposure_s: float) -> Sources:
    """The light sources as they are in a frame: LEDs with their clocks' pulses, stars by the velocity in the orbit.

    In a low orbit the velocity turns by a degree in 15 s, so the aberration is each frame's own. It is that of
    mid-exposure: in a second a star moves by 0.006".
    """
    if testbed.clocks:
        return testbed.clocks.lights_at(testbed.sources, t_s, exposure_s)
    if testbed.orbit is None or not isinstance(testbed.sources, StarSources):
        return testbed.sources
    reach_rad = 1.25 * view.field_rad + 0.02 + view.turn_rad
    near = testbed.sources.take(testbed.sources.within(view.boresight, reach_rad))
    before, now = (1e3 * observer_during(testbed, t).velocity_km_s for t in (0.0, t_s))
    direction = star_sources.seen_at_velocity(near.place[:, :3], before, now)
    visible = ~hidden_by_earth(state_at(testbed.orbit, t_s).position_m, direction)
    return replace(near, place=np.column_stack([direction, np.zeros(len(near))])).take(visible)


def time_at(scene: Scene, t_s: float) -> datetime.datetime:
    """UTC at a time since the scene's start."""
    return scene.start_time + datetime.timedelta(seconds=t_s)


def sky_during(testbed: Testbed, t_s: float) -> Sky | None:
    """The air at a time since the scene's start; None where the scene has none."""
    return testbed.air.at(time_at(testbed.scene, t_s)) if testbed.air else None


def build_tracker(testbed: Testbed) -> factory.Estimator:
    """The star tracker: the user's, or with the hardware parameters that it assumes (see tracking/factory.py)."""
    if testbed.tracker is not None:
        return testbed.tracker
    return factory.build_tracker(testbed.scene, testbed.mount, testbed.sources, testbed.programs)
