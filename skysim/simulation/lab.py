"""The laboratory of a scene: the vehicle and its star cameras, with the lights that they see."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.camera.detector.detector import Detector
from skysim.camera.optics import Optics
from skysim.camera.psf.otf import EXTENT
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.time import tt_jd
from skysim.core.types import Floats, Mount, Sources, StarSources
from skysim.dynamics import guidance, multibody
from skysim.dynamics.multibody.view import mjcf_export
from skysim.dynamics.profiles.load import load_profiles
from skysim.dynamics.profiles.spline import AttitudeSpline
from skysim.scene.scene import Scene
from skysim.scene.sections.light import CollimatedDisplayConfig, DomeConfig, StarsConfig
from skysim.scene.sections.motion import PointingConfig
from skysim.simulation import timing
from skysim.simulation.user_parts import NO_PARTS, UserParts
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
from skysim.sources.solar_system.observer import GcrsState, Observer, observe_at, site_in_gcrs
from skysim.tracking import factory, settings
from skysim.tracking.external.interface import TRACKERS

MAIN = "main"  # name of the camera of the scene's section `camera`


@dataclass(frozen=True, slots=True)
class StarCamera:
    """A camera of the lab: its hardware and the light that reaches it, without time, motion or results.

    name    : "main" for the camera of the scene's section `camera`, else that of the head
    scene   : as this camera sees it, see `Scene.of_head`
    canvas  : (H, W) array in which every frame's light is drawn; float64 where noise is off, since such a frame
              is the expectation itself, and float32 otherwise
    sources : with strengths in this camera's band
    clocks  : the LED controllers' oscillators in this run; None where all light is steady
    codes   : the LEDs' words and the clock of their bits in this run; None without light.led.code
    air     : over the site of a sky scene with `light.air`
    obstacles  : occluders of the sources; None where the scene has light.occlusion off
    reflecting : the dome's reflections; None without light.reflection
    orbit      : of the camera; None without the section
    satellites : elements of `light.satellites.file`
    mount_error : rotation of the real camera from the assumed mount; None for none
    """

    name: str
    scene: Scene
    mount: Mount
    sources: Sources
    emitter: Emitter
    optics: Optics
    detector: Detector
    band: Band
    canvas: NDArray[Any]
    clocks: Clocks | None = None
    codes: LedCodes | None = None
    air: Air | None = None
    obstacles: multibody.Obstacles | None = None
    reflecting: ReflectingDome | None = None
    orbit: CameraOrbit | None = None
    satellites: Elements | None = None
    mount_error: Rotation | None = None


@dataclass(frozen=True, slots=True)
class Lab:
    """What is in the laboratory: the vehicle and its cameras. It has no time and no results; a `Flight` moves it.

    cameras  : the main one first, then the scene's heads in their order
    start    : lab_from_body at t = 0
    profiles : attitude profiles of the maneuvers of that kind, in their order
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
        """Duration of the motion: to the end of the last frame's longest exposure, of all cameras."""
        return max(timing.duration_s(camera.scene) for camera in self.cameras)

    def in_run(self, seed: int) -> Lab:
        """The same hardware in the run of another seed: other noise, jitter, timing and phases of the LEDs' clocks."""
        scene = self.scene.model_copy(update={"seed": seed})
        clocks = build_clocks(scene.light, self.camera.sources, seed)
        codes = build_codes(scene.light, self.camera.sources, seed)
        scenes = [scene, *(scene.of_head(n) for n in range(len(scene.heads)))]
        cameras = tuple(
            replace(camera, scene=own_scene, clocks=clocks, codes=codes)
            for camera, own_scene in zip(self.cameras, scenes, strict=True)
        )
        return replace(self, scene=scene, cameras=cameras)

    def with_camera(self, **changes: Any) -> Lab:
        """The lab with changed fields of its main camera."""
        return replace(self, cameras=(replace(self.camera, **changes), *self.cameras[1:]))

    def of_camera(self, number: int) -> Lab:
        """The lab with one of its cameras only."""
        camera = self.cameras[number]
        return replace(self, scene=camera.scene, cameras=(camera,))

    def with_scene(self, scene: Scene) -> Lab:
        """The same hardware for another scene, of which it would be built alike: other trackers, exposures or times."""
        scenes = [scene, *(scene.of_head(n) for n in range(len(scene.heads)))]
        cameras = tuple(replace(camera, scene=own) for camera, own in zip(self.cameras, scenes, strict=True))
        return replace(self, scene=scene, cameras=cameras)

    def export_mjcf(self) -> str:
        """The lab as MJCF text, for MuJoCo's viewer and for pictures."""
        return mjcf_export.mjcf(self.vehicle, self.scene, self.camera.sources, self.start)

    def export_leds(self) -> tuple[str, int]:
        """The LEDs of the dome as `led_list` returns them. Raises InputError without a dome."""
        scene = self.scene
        if not isinstance(scene.light, DomeConfig):
            raise InputError("light.kind", f"{scene.light.kind} has no list of LEDs", "dome")
        return led_list(scene.light, self.camera.band, scene.name)


def build_lab(scene: Scene, parts: UserParts = NO_PARTS) -> Lab:
    """Build the vehicle and the cameras of a scene.

    parts : what the user gives in place of the scene's own. A table of attitudes replaces the file of the first
        maneuver of kind profile; of the others only the names are checked
    Raises InputError for wrong names of algorithms, trackers, controllers or catalogs and for an unreadable PSF or
    profile, before any long work.
    """
    check_hardware(scene, parts.programs, parts.tracker is None)
    if scene.motion.control:
        parts.controllers.check_name(scene.motion.control.law)
    vehicle = multibody.build(scene.vehicle)
    mount = multibody.camera_mount(vehicle)
    profiles = load_profiles(scene, mount, parts.profile)
    stars = scene_stars(scene)
    main = build_camera(scene, vehicle, mount, stars)
    heads = [build_head(scene, n, vehicle, main, stars, parts.programs) for n in range(len(scene.heads))]
    return Lab(scene, vehicle, (main, *heads), lab_from_body_start(scene, mount, profiles), tuple(profiles))


def build_camera(
    scene: Scene, vehicle: multibody.VehicleModel, mount: Mount, stars: catalog.Catalog | None
) -> StarCamera:
    """The main camera of a scene, with the light in its band."""
    band = Band.from_camera(scene.camera)
    orbit = build_orbit(scene.orbit, scene.start_time)
    satellites = getattr(scene.light, "satellites", None)
    sources = light_sources(scene, band, orbit, stars)
    return StarCamera(
        name=MAIN,
        scene=scene,
        mount=mount,
        sources=sources,
        emitter=Emitter.from_config(scene.light.led) if isinstance(scene.light, DomeConfig) else Emitter(),
        optics=Optics.from_camera(scene.camera),
        detector=Detector.from_camera(scene.camera),
        band=band,
        canvas=build_canvas(scene),
        clocks=build_clocks(scene.light, sources, scene.seed),
        codes=build_codes(scene.light, sources, scene.seed),
        air=build_air(scene, band, stars),
        obstacles=build_obstacles(scene, vehicle),
        reflecting=reflecting_dome(scene.light, sources),
        orbit=orbit,
        satellites=read_elements(satellites.file) if satellites and satellites.file else None,
    )


def build_canvas(scene: Scene) -> NDArray[Any]:
    """The array in which a camera's frames are drawn, see `StarCamera`."""
    dtype = np.float32 if scene.camera.detector.noise else np.float64
    return np.empty((scene.camera.height_px, scene.camera.width_px), dtype)


def check_hardware(scene: Scene, programs: Mapping[str, str], has_tracker: bool) -> None:
    """Raise InputError for unusable names and files of the camera and, if it is the scene's, of the tracker."""
    settings.assumed_settings(scene)  # raises for a wrong algorithm name
    if has_tracker:
        TRACKERS.check_name(scene.tracker.name, programs)
    catalog.require_catalog("tracker.catalog", scene.tracker.catalog)
    EXTENT[scene.camera.psf.kind](scene.camera.psf, scene.camera)  # raises for a bad PSF file


def build_head(
    main_scene: Scene,
    n: int,
    vehicle: multibody.VehicleModel,
    main: StarCamera,
    stars: catalog.Catalog | None,
    programs: Mapping[str, str],
) -> StarCamera:
    """Head n of the scene: a further camera on the same vehicle under the same lights.

    The lights' strengths are those in the band of the head's camera.
    """
    head = main_scene.heads[n]
    scene = main_scene.of_head(n)
    try:
        check_hardware(scene, programs, True)
        band = main.band
        sources = main.sources
        if head.camera:
            band = Band.from_camera(scene.camera)
            sources = light_sources(scene, band, main.orbit, stars)
    except InputError as error:
        raise error.under(f"heads.{n}") from None
    main_from_head = Rotation.from_rotvec(head.rotation_deg, degrees=True)
    mount = Mount(np.array(head.position_m), main_from_head.inv() * main.mount.cam_from_body)
    return replace(
        main,
        name=head.name,
        scene=scene,
        mount=mount,
        sources=sources,
        optics=Optics.from_camera(scene.camera),
        detector=Detector.from_camera(scene.camera),
        band=band,
        canvas=build_canvas(scene),
        air=build_air(scene, band, stars),
        obstacles=build_obstacles(scene, vehicle, mount),
        reflecting=reflecting_dome(scene.light, sources),
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


def bodies_during(camera: StarCamera, t_s: float) -> list[BodyLight]:
    """Sun, Moon and planets at a time since the scene's start; none where the scene has no `light.bodies`.

    In an orbit those whose center is behind the Earth are left out.
    """
    scene = camera.scene
    if not isinstance(scene.light, StarsConfig) or scene.light.bodies is None:
        return []
    observer = observer_during(camera, t_s)
    bodies = bodies_from(scene.light.bodies, observer, camera.band)
    if sky := sky_during(camera, t_s):
        return [sky.body_seen(body) for body in bodies]
    if camera.orbit is None:
        return bodies
    return [body for body in bodies if not hidden_by_earth(observer.from_earth.position_m, body.place.direction)]


def state_from_earth(scene: Scene, orbit: CameraOrbit | None, t_s: float) -> GcrsState:
    """The camera's state in the GCRS at a time since the scene's start: in its orbit, else at the site."""
    if orbit:
        return state_at(orbit, t_s)
    time = time_at(scene, t_s)
    return site_in_gcrs(time, tt_jd(time), scene.site)


def observer_during(camera: StarCamera, t_s: float) -> Observer:
    """The camera among the bodies of the solar system, at a time since the scene's start."""
    time = time_at(camera.scene, t_s)
    return observe_at(time, state_from_earth(camera.scene, camera.orbit, t_s))


def satellites_during(camera: StarCamera, view: View, t_s: float, index: int) -> list[MovingLight]:
    """The satellites in a frame, those of the file first; none where the scene has no `light.satellites`."""
    scene, found = camera.scene, list[MovingLight]()
    config = scene.light.satellites if isinstance(scene.light, StarsConfig) else None
    if config and camera.satellites:
        time = time_at(scene, t_s)

        def observer_at(after_s: float) -> GcrsState:
            return state_from_earth(scene, camera.orbit, t_s + after_s)

        found += known_satellites(camera.satellites, config.standard_mag, view, time, observer_at)
    if config and config.random:
        found += random_satellites(config.random, view, scene.seed, index)
    return found


def lights_during(camera: StarCamera, view: View, t_s: float, exposure_s: float) -> Sources:
    """The light sources as they are in a frame: LEDs with their clocks' pulses, stars by the velocity in the orbit.

    In a low orbit the velocity turns by a degree in 15 s, so the aberration is each frame's own. It is that of
    mid-exposure: in a second a star moves by 0.006".
    """
    if camera.clocks:
        return camera.clocks.lights_at(camera.sources, t_s, exposure_s)
    if camera.orbit is None or not isinstance(camera.sources, StarSources):
        return camera.sources
    reach_rad = 1.25 * view.field_rad + 0.02 + view.turn_rad
    near = camera.sources.take(camera.sources.within(view.boresight, reach_rad))
    before, now = (1e3 * observer_during(camera, t).velocity_km_s for t in (0.0, t_s))
    direction = star_sources.seen_at_velocity(near.place[:, :3], before, now)
    visible = ~hidden_by_earth(state_at(camera.orbit, t_s).position_m, direction)
    return replace(near, place=np.column_stack([direction, np.zeros(len(near))])).take(visible)


def time_at(scene: Scene, t_s: float) -> datetime.datetime:
    """UTC at a time since the scene's start."""
    return scene.start_time + datetime.timedelta(seconds=t_s)


def sky_during(camera: StarCamera, t_s: float) -> Sky | None:
    """The air at a time since the scene's start; None where the scene has none."""
    return camera.air.at(time_at(camera.scene, t_s)) if camera.air else None


def build_tracker(camera: StarCamera, programs: Mapping[str, str] = factory.NO_PROGRAMS) -> factory.Estimator:
    """The star tracker of a camera, with the hardware parameters that it assumes (see tracking/factory.py).

    programs : commands of external trackers by name
    """
    return factory.build_tracker(camera.scene, camera.mount, camera.sources, programs)
