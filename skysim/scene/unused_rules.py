"""Rules of the options that have no effect: keys, the scenes in which they change neither the motion nor a frame nor a
solution, and the reason.

Keys that have a use outside of a run have no rule: the time tags of frames and `start_time`, which are written to the
results, and limits of actuators, which other controllers and the exported model obey.
"""

from collections.abc import Callable
from typing import NamedTuple

from skysim.scene.scene import Scene
from skysim.scene.sections.camera import DetectorConfig
from skysim.scene.sections.layouts import (
    CelestialConfig,
    FibersConfig,
    FibonacciConfig,
    ListedConfig,
    PatchBoardsConfig,
    PixelsConfig,
)
from skysim.scene.sections.leds import DirectConfig
from skysim.scene.sections.surroundings import NEGLIGIBLE_PX
from skysim.scene.sections.tracker import OWN

SURFACE_SOLVERS = ("thesis", "ray_on_surface")  # solvers that use the surveyed surface
OWN_RULES = ("saa", "shefex", "master_star", "fialho")  # identifiers with their paper's rule


class Rule(NamedTuple):
    """Keys that have no effect in some scenes.

    Attributes
    ----------
    keys
        Dotted keys; the key of a section stands for all keys in it
    applies
        Function of a scene that has one of the keys (for a study's rule, of the scene and the trial): whether the keys
        have no effect
    reason, allowed
        Reason and alternative for the error message
    """

    keys: tuple[str, ...]
    applies: Callable[..., bool]
    reason: str
    allowed: str


# Conditions of the rules.


def without_dome(scene: Scene) -> bool:
    """Whether there are no LEDs."""
    return scene.dome is None


def steady(scene: Scene) -> bool:
    """Whether all light is steady."""
    return scene.dome is not None and isinstance(scene.dome.led.drive, DirectConfig)


def equally_bright(scene: Scene) -> bool:
    """Whether all LEDs of a dome have one nominal brightness; those of a file and of a sky do not."""
    if scene.dome is None or scene.dome.led.types:
        return False
    points = scene.dome.points
    if isinstance(points, PatchBoardsConfig):
        levels = {level for board in points.boards or () for level in board.levels or (1.0,)}
        return len(levels or set(points.pwm_levels)) == 1
    return (
        not isinstance(points, CelestialConfig)
        and not getattr(points, "file", None)
        and len(set(points.dimming)) == 1
    )


def external(scene: Scene) -> bool:
    """Whether the tracker is an external one."""
    return scene.tracker.name != OWN


def survey_draws_nothing(scene: Scene) -> bool:
    """Whether `tracker.survey.seed` draws no survey error."""
    survey = scene.tracker.survey
    surface_m = scene.dome.surface.error_m if scene.dome else 0.0
    drawn = (
        survey.led_sigma_m,
        survey.lever_sigma_m,
        survey.focal_length_sigma_m,
        survey.instrument,
    )
    return not (any(drawn) or (surface_m and survey.surface_seed is None))


def dome_draws_nothing(scene: Scene) -> bool:
    """Whether neither the places of the LEDs nor their brightness nor their pulses are random."""
    if scene.dome is None or not steady(scene):
        return False
    led = scene.dome.led
    layout = scene.dome.layout
    if led.scatter or led.color_scatter_m or (led.aging and led.aging.scatter):
        return False
    if isinstance(layout, FibersConfig) and (layout.radius_variation or layout.aiming):
        return False
    points = scene.dome.points
    # The level of each LED of a spiral is drawn from the list.
    if isinstance(points, FibonacciConfig):
        return len(set(points.dimming)) == 1
    return isinstance(points, ListedConfig | CelestialConfig)


def cold(detector: DetectorConfig) -> bool:
    """Whether there is no dark current."""
    return not (detector.dark_e_s or (detector.hot_pixels and detector.hot_e_s))


def uniform_chip(detector: DetectorConfig) -> bool:
    """Whether the detector has no fixed pattern."""
    dsnu = detector.dsnu and detector.dark_e_s
    hot = detector.hot_pixels and detector.hot_e_s
    return not (detector.prnu or detector.column_offset_e or dsnu or hot)


def earth_unused(scene: Scene) -> bool:
    """Whether neither the dynamics nor the IMU has the Earth's rotation."""
    imu = scene.vehicle.imu
    sensed = imu is not None and imu.earth_rate != "none"
    return not (scene.vehicle.disturbances.earth_rotation or sensed)


def flat_wall(scene: Scene) -> bool:
    """Whether the LEDs are on a flat wall."""
    return scene.dome is not None and scene.dome.surface.kind == "flat"


def seen_from_earth(scene: Scene) -> bool:
    """Whether bodies or satellites are seen from the Earth: from its center, or from a site."""
    bodies, satellites = (getattr(scene.light, key, None) for key in ("bodies", "satellites"))
    return scene.orbit is None and bool(bodies or (satellites and satellites.file))


def has_air(scene: Scene) -> bool:
    """Whether there is air between the camera and the stars."""
    return getattr(scene.light, "air", None) is not None


def seen_from_ground(scene: Scene) -> bool:
    """Whether the view depends on the place on the Earth."""
    return has_air(scene) or (seen_from_earth(scene) and scene.site.longitude_deg is not None)


# The rules, by section of the scene.
RULES = (
    Rule(
        ("tracker.catalog", "tracker.limit_mag"),
        lambda scene: scene.dome is not None,
        "under a dome the tracker's map is of LEDs",
        "light of kind stars or collimated_display",
    ),
    Rule(
        ("tracker.assumed_camera_body",),
        without_dome,
        "the tracker takes stars to be at infinity, whatever the camera's place",
        "light of kind dome",
    ),
    Rule(
        ("tracker.options", "tracker.time_limit"),
        lambda scene: not external(scene),
        "skysim's own tracker takes no options and has no time limit",
        "tracker.name: an external tracker",
    ),
    Rule(
        (
            "tracker.centroider",
            "tracker.identifier",
            "tracker.acceptance",
            "tracker.solver",
            "tracker.centroid_sigma_px",
        ),
        external,
        "an external tracker has its own algorithms",
        "tracker.name: own, or tracker.options",
    ),
    Rule(
        ("tracker.decoder", "tracker.brightness_sigma"),
        external,
        "an external tracker has its own algorithms",
        "tracker.name: own",
    ),
    Rule(
        ("tracker.identifier", "tracker.acceptance", "tracker.brightness_sigma"),
        lambda scene: scene.tracker.decoder is not None,
        "the LEDs are identified by their codes",
        "no tracker.decoder",
    ),
    Rule(
        ("tracker.brightness_sigma",),
        without_dome,
        "stars are identified by their places",
        "a dome",
    ),
    Rule(
        ("tracker.brightness_sigma",),
        lambda scene: scene.tracker.identifier not in (None, "led_pairs", "non_dimensional"),
        "this identifier does not use brightness",
        "tracker.identifier: led_pairs or non_dimensional",
    ),
    Rule(
        ("tracker.cos_error",),
        lambda scene: scene.tracker.identifier != "shefex",
        "this identifier has no tolerance of cosines",
        "tracker.identifier: shefex",
    ),
    Rule(
        ("tracker.acceptance",),
        lambda scene: not str(scene.tracker.identifier).startswith(OWN_RULES),
        "this identifier has no rule of its paper beside the test against chance",
        "tracker.identifier: saa, shefex, master_star or fialho_1 to fialho_4",
    ),
    Rule(
        ("tracker.brightness_sigma",),
        equally_bright,
        "all LEDs are equally bright",
        "two levels of brightness in light.layout",
    ),
    Rule(
        ("tracker.assumed_attitude_deg",),
        lambda scene: (
            scene.dome is None
            or external(scene)
            or scene.tracker.identifier in (None, "led_pairs", "non_dimensional")
        ),
        "this identifier needs no attitude",
        "a dome with tracker.identifier: pyramid, saa or master_star",
    ),
    Rule(
        ("tracker.magnitude_sigma",),
        lambda scene: scene.light.kind != "stars" or external(scene),
        "only skysim's own tracker of stars uses it",
        "light.kind: stars",
    ),
    Rule(
        ("tracker.magnitude_sigma",),
        lambda scene: scene.tracker.identifier in ("pyramid", "shefex"),
        "this identifier does not use magnitudes",
        "tracker.identifier: default, saa, master_star or fialho_1 to fialho_4",
    ),
    Rule(
        ("tracker.gyro",),
        external,
        "an external tracker gets no rate",
        "tracker.name: own",
    ),
    Rule(
        (
            "tracker.detector",
            "tracker.threshold_sigma",
            "tracker.min_area_px",
            "tracker.intensity_threshold",
            "tracker.brightest",
        ),
        lambda scene: external(scene) and scene.tracker.exposure_control is None,
        "an external tracker has its own detection",
        "tracker.name: own, or tracker.options",
    ),
    Rule(
        ("tracker.threshold_sigma", "tracker.min_area_px"),
        lambda scene: scene.tracker.detector == "thesis",
        "the detector thesis has its own thresholds",
        "tracker.intensity_threshold, or another tracker.detector, e.g. threshold",
    ),
    Rule(
        ("tracker.intensity_threshold",),
        lambda scene: scene.tracker.detector != "thesis",
        "it is a threshold of the detector thesis",
        "tracker.detector: thesis, or tracker.threshold_sigma",
    ),
    Rule(
        (
            "tracker.survey.rotation_deg",
            "tracker.survey.seed",
            "tracker.survey.surface_seed",
            "light.surface.error",
        ),
        lambda scene: (
            scene.tracker.map is not None
            and (external(scene) or scene.tracker.solver not in SURFACE_SOLVERS)
        ),
        "tracker.map replaces the survey of the LEDs, and the solver does not use the surface",
        f"no tracker.map, or tracker.solver {' or '.join(SURFACE_SOLVERS)}",
    ),
    Rule(
        ("tracker.survey.seed",),
        survey_draws_nothing,
        "no survey error is drawn from it",
        "tracker.survey.led_sigma, tracker.survey.lever_sigma or light.surface.error above 0",
    ),
    Rule(
        ("tracker.survey.surface_seed",),
        lambda scene: not (scene.dome and scene.dome.surface.error_m),
        "it draws light.surface.error, which is 0",
        "light.surface.error above 0",
    ),
    Rule(
        ("light.led.pwm_period",),
        lambda scene: scene.light.led.drive.kind != "pwm",
        "it is the period of the drive pwm",
        "light.led.drive: {kind: pwm}",
    ),
    Rule(
        ("light.led.color_scatter", "light.led.aging.scatter"),
        lambda scene: isinstance(scene.light.layout, PixelsConfig),
        "the pixels of a display share their light",
        "another light.layout",
    ),
    Rule(
        ("light.led.clock",),
        lambda scene: (
            steady(scene) and getattr(scene.light.led.code, "bit_time_s", "frame") == "frame"
        ),
        "the drive direct has no pulses to time",
        "another light.led.drive",
    ),
    Rule(
        ("light.reflection.specular", "light.reflection.refractive_index"),
        flat_wall,
        "a flat wall has no image of the LEDs on it",
        "another light.surface",
    ),
    Rule(
        ("light.reflection.diffuse",),
        lambda scene: flat_wall(scene) and not scene.light.reflection.floor,
        "the LEDs on a flat wall do not shine on it",
        "light.reflection.floor, or another light.surface",
    ),
    Rule(
        (
            "light.layout.spacing",
            "light.layout.spread",
            "light.layout.lit",
            "light.layout.pwm_levels",
        ),
        lambda scene: bool(getattr(scene.light.layout, "boards", ())),
        "light.layout.boards lists the boards",
        "no light.layout.boards",
    ),
    Rule(
        ("light.layout.hardware_seed", "light.layout.points.hardware_seed"),
        dome_draws_nothing,
        "nothing of this dome is random",
        "light.led.scatter, pulsed LEDs or a random layout",
    ),
    Rule(
        ("camera.baffle",),
        lambda scene: (
            not (getattr(scene.light, "bodies", None) or (scene.orbit and scene.orbit.earth))
        ),
        "neither a body nor the lit Earth is in the scene",
        "light.bodies or orbit.earth",
    ),
    Rule(
        ("camera.detector.dsnu",),
        lambda scene: not scene.camera.detector.dark_e_s,
        "it is relative to camera.detector.dark_e_s, which is 0",
        "camera.detector.dark_e_s above 0",
    ),
    Rule(
        ("camera.detector.hot_pixels",),
        lambda scene: not scene.camera.detector.hot_e_s,
        "the mean of their dark current, camera.detector.hot_e_s, is 0",
        "camera.detector.hot_e_s above 0",
    ),
    Rule(
        ("camera.detector.hot_e_s",),
        lambda scene: not scene.camera.detector.hot_pixels,
        "there is no hot pixel",
        "camera.detector.hot_pixels above 0",
    ),
    Rule(
        ("camera.detector.dark_temperature_c", "camera.detector.dark_doubling_c"),
        lambda scene: scene.camera.detector.temperature_c is None,
        "the chip has no temperature of its own",
        "camera.detector.temperature_c",
    ),
    Rule(
        (
            "camera.detector.temperature_c",
            "camera.detector.dark_temperature_c",
            "camera.detector.dark_doubling_c",
        ),
        lambda scene: cold(scene.camera.detector),
        "the chip has no dark current",
        "camera.detector.dark_e_s above 0",
    ),
    Rule(
        ("camera.detector.hardware_seed",),
        lambda scene: uniform_chip(scene.camera.detector),
        "the chip has no fixed pattern",
        "camera.detector.prnu, dsnu, column_offset_e or hot_pixels above 0",
    ),
    Rule(
        (
            "camera.detector.blooming",
            "camera.detector.anti_blooming",
            "camera.detector.particles",
        ),
        lambda scene: not scene.camera.detector.noise,
        "with camera.detector.noise: false a frame is the expected value without full well and particles",
        "camera.detector.noise: true",
    ),
    Rule(
        ("camera.detector.anti_blooming",),
        lambda scene: scene.camera.detector.blooming == "none",
        "charge beyond a full well is clipped",
        "camera.detector.blooming: column",
    ),
    Rule(
        ("site.longitude_deg", "site.height"),
        lambda scene: not (seen_from_earth(scene) or has_air(scene)),
        "nothing depends on the place on the Earth",
        "light.bodies, light.satellites.file or light.air, without an orbit",
    ),
    Rule(
        ("site.height",),
        lambda scene: scene.site.longitude_deg is None,
        "without a longitude the bodies are seen from the Earth's center",
        "site.longitude_deg",
    ),
    Rule(
        ("site.latitude_deg",),
        lambda scene: earth_unused(scene) and not seen_from_ground(scene),
        "nothing depends on the Earth's rotation",
        "vehicle.disturbances.earth_rotation, a vehicle.imu whose earth_rate is not none, or light.bodies or light.air"
        " with a site.longitude_deg",
    ),
    Rule(
        ("tracker.refraction",),
        lambda scene: not has_air(scene) or external(scene),
        "there is no air, or the tracker is external and does not get the weather",
        "light.air and tracker.name: own",
    ),
    Rule(
        ("light.air.seeing_arcsec",),
        lambda scene: not scene.light.air.seeing_px(scene.camera.focal_px),
        f"its standard deviation is below {NEGLIGIBLE_PX:g} px",
        "a longer camera.focal_length or smaller camera.pixel",
    ),
    Rule(
        ("site.x_azimuth_deg",),
        earth_unused,
        "nothing depends on the Earth's rotation",
        "vehicle.disturbances.earth_rotation, or a vehicle.imu whose earth_rate is not none",
    ),
    Rule(
        ("vehicle.mast",),
        lambda scene: not any(scene.vehicle.sag_arcsec),
        "nothing bends",
        "vehicle.sag_arcsec",
    ),
    Rule(
        ("camera.pupil_walk",),
        without_dome,
        "light from infinity passes any place of the pupil alike",
        "light of kind dome",
    ),
    Rule(
        ("thermal.dome_ppm_k", "thermal.anchor_height", "thermal.creep"),
        without_dome,
        "there is no dome to move",
        "light of kind dome",
    ),
    Rule(
        ("thermal.anchor_height",),
        lambda scene: not scene.thermal.dome_ppm_k,
        "the dome does not expand",
        "thermal.dome_ppm_k",
    ),
    Rule(
        ("thermal.speed",),
        lambda scene: scene.thermal.temperature.kind == "steady",
        "the temperature is steady",
        "another thermal.temperature",
    ),
    Rule(
        ("tracker.orbit_velocity",),
        lambda scene: scene.orbit is None,
        "the camera is on the ground",
        "the section orbit",
    ),
    Rule(
        ("light.satellites.standard_mag",),
        lambda scene: not scene.light.satellites.file,
        "random satellites have their own magnitudes",
        "light.satellites.file",
    ),
    Rule(
        ("vehicle.tilt_stop_deg",),
        lambda scene: scene.vehicle.mount == "free",
        "a free vehicle has no tilt stop",
        "vehicle.mount: air_bearing",
    ),
    Rule(
        ("vehicle.cmgs.gimbal_rate_limit_deg_s", "vehicle.cmgs.steering"),
        lambda scene: not (scene.motion.control and scene.motion.control.actuators == "cmgs"),
        "nothing commands the CMGs",
        "motion.control with actuators: cmgs",
    ),
    Rule(
        ("vehicle.imu.gyro.bias_time",),
        lambda scene: not scene.vehicle.imu.gyro.bias_deg_h,
        "the bias does not vary",
        "vehicle.imu.gyro.bias_deg_h above 0",
    ),
    Rule(
        ("vehicle.imu.accelerometer.bias_time",),
        lambda scene: not scene.vehicle.imu.accelerometer.bias_ug,
        "the bias does not vary",
        "vehicle.imu.accelerometer.bias_ug above 0",
    ),
    Rule(
        ("motion.control.integral_rad_s",),
        lambda scene: scene.motion.control.law == "pd",
        "the law pd has no integral",
        "motion.control.law: pid",
    ),
)
