"""The tracker's models of its camera, lever arm, dome and sky: the true values with calibration and survey errors.

Functions `assumed_...` return the model of a scene. `OrbitStarTracker` is the tracker in an orbit.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.catalog import cat_file, catalog
from estimator.catalog.refraction import SiteAir
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Attitude
from estimator.identification.led_codes import LedCode
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.camera.optics import Optics
from skysim.core.errors import InputError, refusing
from skysim.core.types import UP, Floats, Ints, Mount, Sources, median
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import CameraConfig
from skysim.scene.sections.light import CollimatedDisplayConfig, DomeConfig
from skysim.sources.air import weather_of
from skysim.sources.camera_orbit import CameraOrbit, build_orbit, state_at
from skysim.sources.catalog import require_catalog
from skysim.sources.dome import display, surface, survey_errors
from skysim.sources.dome.codebooks import codebook, light_levels
from skysim.sources.dome.layouts import led_list, registry
from skysim.sources.dome.led import Emitter, irradiance_e_s_m2
from skysim.sources.photometry import SUN, Band, star_flux_e_s_m2
from skysim.tracking import dome_map_file


def assumed_dome(scene: Scene, light: DomeConfig, sources: Sources) -> LedMap:
    """The dome map that the tracker uses: the true LED positions and surface with the errors of the survey.

    If an instrument measured the LEDs, the map's single sigma is the greatest one across the line from the bearing. It
    sets the matching radius of the identification, which must not exceed that of the final match
    (`DomeTracker.solve_match`): an LED that only the first one admits makes the tracker refuse the frame.
    """
    inside = surface.build_surface(light.surface)
    survey = scene.tracker.survey
    position_m = survey_errors.assumed_leds_m(inside, sources.xyz, survey)
    board = registry.board_of(light.layout, sources.id)
    ellipsoid = survey_errors.assumed_ellipsoid(inside, survey)
    covariance_m2 = survey_errors.led_covariance_m2(sources.xyz, survey)
    common_m = survey_errors.common_displacements_m(inside, sources.xyz, survey)
    sigma_m = float(survey.led_sigma_m)
    if covariance_m2 is not None:
        sigma_m = float(survey_errors.across_sigma_m(position_m, covariance_m2).max())
    return LedMap(sources.id, position_m, *ellipsoid, board, sigma_m, covariance_m2, common_m)


def with_brightness(scene: Scene, light: DomeConfig, leds: LedMap, lever: Lever) -> LedMap:
    """The map with the flux of each LED in DN per second of exposure by the data sheets, without scatter.

    The camera points at each LED and sees it along its normal, at its distance from the bearing minus the lever.
    """
    if scene.tracker.brightness_sigma is None:
        return leds
    nominal = led_list.design_leds(
        light, surface.build_surface(light.surface), Band.from_camera(scene.camera)
    )
    nominal = nominal.take(rows_of(leds.id, nominal.id))
    distance_m = leds.radius_m - np.linalg.norm(lever.camera_body_m)
    strength = nominal.strength * nominal.duty
    light_e_s_m2 = irradiance_e_s_m2(
        strength, Emitter.from_config(light.led), np.ones(1), np.ones(1), distance_m
    )
    collecting_m2 = Optics.from_camera(scene.camera).collecting_m2
    flux_s = light_e_s_m2 * collecting_m2 / scene.camera.detector.gain_e_dn
    return replace(leds, flux_s=flux_s, flux_sigma=scene.tracker.brightness_sigma)


def rows_of(wanted: Sequence[int] | Ints, ids: Ints) -> Ints:
    """Row of each wanted number among the numbers ids; any row for one that is not among them."""
    order = np.argsort(ids)
    return order[np.minimum(np.searchsorted(ids, wanted, sorter=order), len(order) - 1)]


def zero_point_mag(scene: Scene) -> float | None:
    """The magnitude of a star of the Sun's color with a flux of one DN in an exposure; None if magnitudes are not used.

    2.5 log10 of the DN of a star of V = 0: its electrons s^-1 m^-2, times the collecting area and the exposure time,
    over the gain.
    """
    if scene.tracker.magnitude_sigma is None:
        return None
    return float(2.5 * np.log10(bright_star_e(scene) / scene.camera.detector.gain_e_dn))


def bright_star_e(scene: Scene) -> float:
    """Electrons of a star of V = 0 and the Sun's color in an exposure."""
    light_e_s_m2 = float(star_flux_e_s_m2(0.0, *SUN, Band.from_camera(scene.camera)))
    collecting_m2 = Optics.from_camera(scene.camera).collecting_m2
    return light_e_s_m2 * collecting_m2 * scene.exposure.time_s


def assumed_code(light: DomeConfig, sources: Sources, leds: LedMap) -> LedCode:
    """The code words of the LEDs in the tracker's map, which are those of the dome."""
    assert light.led.code is not None
    code = light.led.code
    words = codebook(code, len(sources))[rows_of(leds.id, sources.id)]
    levels = light_levels(code, words)
    return LedCode(levels, None if code.bit_time_s == "frame" else code.bit_time_s)


def assumed_air(scene: Scene) -> SiteAir | None:
    """The air whose refraction the tracker corrects, with the true site, date and weather.

    None without `tracker.refraction`.
    """
    stars = scene.stars
    site = scene.site
    if not (scene.tracker.refraction and stars and stars.air) or site.longitude_deg is None:
        return None
    weather = weather_of(stars.air, site, Band.from_camera(scene.camera))
    return SiteAir(
        site.latitude_deg,
        site.longitude_deg,
        scene.start_time,
        weather.pressure_hpa,
        weather.temperature_c,
        weather.wavelength_m,
    )


def assumed_lever(scene: Scene, mount: Mount) -> Lever:
    """The lever arm of the camera that the tracker assumes: `assumed_camera_body_m`, or the true one with survey error.

    The tracker knows the camera's attitude on the vehicle exactly.
    """
    survey = scene.tracker.survey
    lever_m = scene.tracker.assumed_camera_body_m or survey_errors.assumed_m(
        mount.camera_body_m, survey.lever_sigma_m, survey.seed, "lever"
    )
    return Lever(np.array(lever_m), mount.cam_from_body, float(survey.lever_sigma_m))


def onboard_dome(
    scene: Scene, light: DomeConfig, mount: Mount, sources: Sources
) -> tuple[Camera, LedMap, Lever]:
    """Camera, LED map and lever arm that the tracker assumes, from the survey or a map's file. Raises InputError."""
    leds = assumed_dome(scene, light, sources)
    lever = assumed_lever(scene, mount)
    if scene.tracker.map:
        return surveyed_dome(scene, scene.tracker.map, leds, lever)
    return assumed_camera(scene), leds, lever


def surveyed_dome(
    scene: Scene, path: str, leds: LedMap, lever: Lever
) -> tuple[Camera, LedMap, Lever]:
    """Camera, LED map and lever arm from the file of a survey; surface and boards stay those of the given map.

    The single sigma of the map is the median of the file's, and no greater than that of the final match (see
    `assumed_dome`). Raises InputError for a file of another dome or camera.
    """
    # 1. The file is of this camera and of LEDs of this dome.
    dome_map = dome_map_file.read_dome_map(Path(path))
    size_px = scene.camera.size_px
    if dome_map.size_px != size_px:
        raise InputError(
            "tracker.map",
            f"{path}: surveyed with a camera of {dome_map.size_px} px",
            f"{size_px} px",
        )
    row = rows_of(dome_map.id, leds.id)
    unknown = dome_map.id[leds.id[row] != dome_map.id]
    if len(unknown):
        raise InputError(
            "tracker.map",
            f"{path}: unknown LED {unknown[0]}",
            f"the {len(leds.id)} LEDs of this dome",
        )
    nearest = cKDTree(leds.position_m).query(dome_map.position_m)[1]
    others = int(np.sum(nearest != row))
    if others > len(row) / 2:
        raise InputError(
            "tracker.map",
            f"{path}: of another dome: {others} of its {len(row)} LEDs are nearer to the places of others",
            "a map of this dome",
        )
    # 2. The surveyed values.
    board = None if leds.board is None else leds.board[row]
    own_m2 = dome_map.own_m2
    sigma_m = median(dome_map.sigma_m)
    if own_m2 is not None:
        across_m = survey_errors.across_sigma_m(dome_map.position_m, own_m2)
        sigma_m = min(sigma_m, float(across_m.max()))
    surveyed = replace(
        leds,
        id=dome_map.id,
        position_m=dome_map.position_m,
        board=board,
        sigma_m=sigma_m,
        covariance_m2=own_m2,
        common_m=dome_map.common_m,
        common_camera=dome_map.common_camera,
    )
    camera = replace(
        calibration(scene.camera),
        focal_px=dome_map.focal_px,
        center_px=dome_map.center_px,
        distortion=dome_map.distortion,
    )
    lever = Lever(dome_map.camera_body_m, lever.cam_from_body, dome_map.lever_sigma_m)
    return camera, surveyed, lever


def assumed_camera(scene: Scene) -> Camera:
    """The camera calibration that the tracker assumes: `tracker.assumed_...`, or the true one with survey error."""
    config = scene.tracker
    camera = calibration(scene.camera)
    if config.assumed_distortion is not None:
        camera = replace(camera, distortion=config.assumed_distortion)
    if config.assumed_row_time_s is not None:
        camera = replace(camera, row_time_s=config.assumed_row_time_s)
    focal_m = scene.camera.focal_length_m
    assumed_m = config.assumed_focal_length_m or survey_errors.assumed_focal_length_m(
        focal_m, config.survey
    )
    return replace(
        camera.zoomed(assumed_m / focal_m),
        focal_sigma=float(config.survey.focal_length_sigma_m) / focal_m,
    )


def calibration(camera: CameraConfig) -> Camera:
    """The exact calibration of a camera, as the estimator's Camera."""
    return Camera(
        camera.width_px,
        camera.height_px,
        camera.focal_px,
        camera.center_px,
        camera.distortion,
        row_time_s=camera.row_delay_s,
    )


def onboard_catalog(key: str, name: str) -> catalog.StarCatalog:
    """The tracker's star catalog, read by the estimator's own reader. Raises InputError.

    Parameters
    ----------
    key
        Key of the scene, or option, that names the catalog, for the error message
    name
        Name in data/catalogs/, or a file, .ecsv or .cat
    """
    path = require_catalog(key, name)
    with refusing(ImageError, key):
        if path.suffix.lower() == ".cat":
            return cat_file.read_stars(path)
        return catalog.read(path)


# A star tracker in orbit that gets the camera's velocity from the vehicle's navigation.


class OrbitStarTracker(StarTracker):
    """A StarTracker whose attitudes are corrected for the orbit's velocity at each frame.

    Its catalog has the apparent directions at the start of the orbit. Since then the velocity has changed by dv, which
    displaces a star in direction u by (dv - (dv.u) u) / c. At the boresight b this is the rotation b x dv / c, by which
    the attitude is corrected. At an angle a from the boresight up to 5" sin a (10" sin a after half an orbit) remains.
    It is the same on opposite sides, which is a change of scale.
    """

    def __init__(
        self,
        camera: Camera,
        stars: catalog.StarCatalog,
        vectors: Floats,
        settings: Settings,
        orbit: CameraOrbit,
    ) -> None:
        super().__init__(camera, stars, vectors, settings)
        self.orbit = orbit
        self.start_m_s = state_at(orbit, 0.0).velocity_m_s

    def solve_centroids(self, *args: Any, t_s: float = 0.0, **named: Any) -> Attitude:
        """As `StarTracker.solve_centroids`; t_s is the time of the frame since the start of the orbit."""
        return self.corrected(super().solve_centroids(*args, **named), t_s)

    def corrected(self, attitude: Attitude, t_s: float) -> Attitude:
        """The attitude of a frame at a time since the start, corrected by the rotation b x dv / c."""
        if attitude.cam_from_ref is None:
            return attitude
        boresight = attitude.cam_from_ref.inv().apply(UP)
        changed_m_s = state_at(self.orbit, t_s).velocity_m_s - self.start_m_s
        changed = changed_m_s / catalog.SPEED_OF_LIGHT_M_S
        now_from_start = Rotation.from_rotvec(np.cross(boresight, changed))
        return replace(attitude, cam_from_ref=attitude.cam_from_ref * now_from_start.inv())


def assumed_orbit(scene: Scene) -> CameraOrbit | None:
    """The orbit whose velocity the tracker knows; None on the ground, or without `tracker.orbit_velocity`."""
    return (
        build_orbit(scene.orbit, scene.start_time) if scene.tracker.orbit_velocity else None
    )


def assumed_stars(
    scene: Scene, orbit: CameraOrbit | None
) -> tuple[catalog.StarCatalog, Floats]:
    """The tracker's stars and their apparent directions (N, 3) at the scene's start, in lab axes. Raises InputError."""
    stars = catalog.brighter_than(
        onboard_catalog("tracker.catalog", scene.tracker.catalog), scene.tracker.limit_mag
    )
    # The observer is at the Earth's center, with the orbit's velocity.
    observer = catalog.on_earth(scene.start_time)
    if orbit:
        velocity_m_s = observer.velocity_m_s + state_at(orbit, 0.0).velocity_m_s
        observer = replace(observer, velocity_m_s=velocity_m_s)
    directions = catalog.apparent(stars, observer)
    if isinstance(scene.light, CollimatedDisplayConfig):
        # The mounting of the display defines the stars' directions in the lab frame.
        directions = display.lab_from_icrs(scene.light).apply(directions)
    return stars, directions
