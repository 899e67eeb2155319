"""Build the star tracker of a scene, solve frames with it, and adapt external trackers.

`build_tracker` chooses the class by the scene: DomeTracker under LEDs, CodedTracker if it reads their codes,
StarTracker under stars, ExternalTracker for an external tracker. Each gets the camera and map (onboard_model.py) and
the settings (`assumed_settings`) that the tracker assumes, which may differ from the simulated hardware.

External star trackers are programs in their own process, or Python functions in this one. They get the same set-up and
frames as skysim's own tracker, and their answers become the same reports. Every failure of an external tracker becomes
the status of a frame.
"""

import inspect
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.nearfield import SOLVERS as NEAR_SOLVERS
from estimator.attitude.solvers import SOLVERS
from estimator.centroiding.centroid import CENTROIDERS
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids, FramePriors, RateEstimate
from estimator.detection.detect import DETECTORS
from estimator.identification.registry import IDENTIFIERS
from estimator.trackers.coded_tracker import CodedTracker, DecoderSettings
from estimator.trackers.dome_tracker import IDENTIFIERS as NEAR_IDENTIFIERS
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.exposure_control import (
    Control,
    NextExposure,
    Observation,
    observe,
    step,
)
from estimator.trackers.pipeline import Report, Settings, monochrome
from estimator.trackers.star_tracker import StarTracker
from skysim.camera.detector import saturation_dn
from skysim.core import errors
from skysim.core.errors import InputError, unknown_name
from skysim.core.plugins import (
    NO_PROGRAMS,
    ProgramError,
    Programs,
    describe_error,
    host_command,
)
from skysim.core.types import Frame, Mount, Record, Sources
from skysim.scene.scene import Scene
from skysim.scene.sections.tracker import OWN
from skysim.tracking.onboard_model import (
    OrbitStarTracker,
    assumed_air,
    assumed_camera,
    assumed_code,
    assumed_orbit,
    assumed_stars,
    onboard_dome,
    with_brightness,
    zero_point_mag,
)
from skysim.tracking.tracker_interface import (
    FAILED,
    TRACKERS,
    Answer,
    Leds,
    Picture,
    Setup,
    Stars,
    TrackerProgram,
    check_answer,
    split_command,
)


class FrameTracker:
    """A tracker that solves frames only: each must reach it once, in order.

    Attributes
    ----------
    name
        Name for messages and reports
    """

    name: str

    def solve_centroids(self, centroids: Centroids) -> Attitude:
        """Raise InputError: the tracker takes an image, not centroids."""
        raise InputError("tracker.name", f"{self.name} solves frames, not centroids", OWN)


class ExternalTracker(FrameTracker, TrackerProgram):
    """A tracker in its own process."""

    @classmethod
    def of_scene(cls, scene: Scene, setup: Setup, commands: Mapping[str, str]) -> Self:
        """Start the tracker that the scene names. Raises InputError if it is unknown or refuses the set-up."""
        name = scene.tracker.name
        TRACKERS.check_name(name, commands)
        image_format = None
        environment = None
        if name in commands:
            arguments, image_format = split_command(name, commands[name])
        else:
            arguments, environment = host_command("skysim.tracking.tracker_host", name)
        return cls(
            name, arguments, image_format, setup, scene.tracker.time_limit_s, environment
        )

    def solve_frame(
        self, frame: Frame, streak_px: tuple[float, float] | None = None
    ) -> Report:
        """The tracker's report on a frame; streak_px is as in `Picture`."""
        try:
            return to_report(self.solve(picture_of(frame, streak_px)))
        except ProgramError as error:
            return Report(Attitude(f"{FAILED}{error}"), Centroids.empty())


def picture_of(frame: Frame, streak_px: tuple[float, float] | None) -> Picture:
    """What a tracker gets of a frame."""
    return Picture(frame.image_dn, frame.index, frame.t_mid_s, frame.exposure_s, streak_px)


def to_report(answer: Answer) -> Report:
    """The report of a checked answer; it has no identifications, since external trackers do not return any."""
    xy_px = answer.centroids_px
    unmeasured = np.full(len(xy_px), np.nan)
    seconds = {} if answer.seconds is None else {"solve": answer.seconds}
    quaternion = answer.cam_from_ref_xyzw
    attitude = Attitude(
        answer.status,
        None if quaternion is None else Rotation.from_quat(quaternion),
        answer.covariance_rad2,
    )
    return Report(attitude, Centroids(xy_px, unmeasured, unmeasured), seconds)


# A tracker of one's own in this process.


def takes_setup(given: Any) -> bool:
    """Whether a callable's first parameter is named `setup`: it makes a tracker from a set-up."""
    try:
        return next(iter(inspect.signature(given).parameters), "") == "setup"
    except (TypeError, ValueError):  # no callable, or one without a signature
        return False


class FunctionTracker(FrameTracker):
    """A tracker that is a Python object in this process.

    Attributes
    ----------
    name
        Name for messages and reports
    function
        Function from an image (H, W) to the attitude, as `tracker_interface.to_answer` takes it; or one whose first
        parameter is named `setup`, from a `Setup` to a tracker: a `tracker_interface.Tracker`, or the function that its
        method `solve` would be
    takes_picture
        Whether the function takes a `Picture`, with image, time, exposure and streak, as one does after its set-up
    """

    def __init__(
        self, name: str, function: Callable[..., Any], takes_picture: bool = False
    ) -> None:
        self.name = name
        self.function = function
        self.takes_setup = takes_setup(function)
        self.takes_picture = takes_picture

    def set_up(self, setup: Setup) -> "FunctionTracker":
        """The tracker after its set-up: a function of a `Picture`. Raises InputError if it makes none."""
        made = self.function(setup)
        solve = getattr(made, "solve", made)
        if not callable(solve):
            raise InputError(
                "tracker",
                f"{self.name} made {type(made).__name__} of its set-up",
                "an object with a method solve, or a function",
            )
        return FunctionTracker(self.name, solve, takes_picture=True)

    def solve_frame(
        self, frame: Frame, streak_px: tuple[float, float] | None = None
    ) -> Report:
        """The tracker's report on a frame; the function gets a copy of the image."""
        picture = replace(picture_of(frame, streak_px), image_dn=np.array(frame.image_dn))
        begin_s = time.perf_counter()
        try:
            given = picture if self.takes_picture else picture.image_dn
            answer = check_answer(self.function(given))
        except Exception as error:
            errors.raise_wrapped(error)
            return Report(Attitude(f"{FAILED}{describe_error(error)}"), Centroids.empty())
        report = to_report(answer)
        report.seconds.setdefault("solve", time.perf_counter() - begin_s)
        return report


# Settings of the tracker from a scene.

DOME_SIGMA_PX = 0.2  # floor of the centroids' errors under a dome, where none is set
# Default algorithms under a dome; under stars each stage has one with the name "default".
DOME_ALGORITHMS = {
    "detector": "local",
    "centroider": "cog",
    "identifier": "led_pairs",
    "solver": "rotation_only",
}
STAR_ALGORITHMS: dict[str, Mapping[str, object]] = {
    "detector": DETECTORS,
    "centroider": CENTROIDERS,
    "identifier": IDENTIFIERS,
    "solver": SOLVERS,
}
NEAR_ALGORITHMS = STAR_ALGORITHMS | {"identifier": NEAR_IDENTIFIERS, "solver": NEAR_SOLVERS}


def assumed_settings(scene: Scene) -> Settings:
    """The tracker's algorithms and thresholds that the scene sets. Raises InputError for an unknown name.

    Defaults depend on the light: a dome uses the local detector, centers of gravity and LED pairs.
    """
    config = scene.tracker
    default = Settings()
    usual = DOME_ALGORITHMS if scene.dome else {}
    chosen = Record()
    for stage, table in algorithm_tables(scene).items():
        name = getattr(config, stage) or usual.get(stage, "default")
        # Only the estimator has the list, and the scene package may not import it, so the name is checked here.
        if name not in table:
            raise InputError(f"tracker.{stage}", *unknown_name(stage, name, table))
        chosen[stage] = name
    most = config.brightest or default.max_blobs
    return Settings(
        max_blobs=most,
        base_stars=min(most, default.base_stars),
        searched_stars=min(most, default.searched_stars),
        threshold_sigma=config.threshold_sigma,
        min_area_px=config.min_area_px,
        intensity_threshold=config.intensity_threshold,
        gain_e_dn=scene.camera.detector.gain_e_dn,
        saturation=saturation_dn(scene.camera.detector),
        centroid_sigma_px=config.centroid_sigma_px or (DOME_SIGMA_PX if scene.dome else None),
        acceptance=config.acceptance,
        cos_error=config.cos_error,
        bayer=scene.camera.detector.bayer,
        assumed_deg=config.assumed_attitude_deg,
        zero_point_mag=zero_point_mag(scene),
        magnitude_sigma=config.magnitude_sigma or default.magnitude_sigma,
        **chosen,
    )


def algorithm_tables(scene: Scene) -> dict[str, Mapping[str, object]]:
    """The algorithms that a scene's tracker may use: by stage, then by name."""
    return NEAR_ALGORITHMS if scene.dome else STAR_ALGORITHMS


def algorithm_names(scene: Scene) -> dict[str, tuple[str, ...]]:
    """The names of the algorithms that a scene's tracker may use, by stage."""
    return {stage: tuple(table) for stage, table in algorithm_tables(scene).items()}


# Trackers.

UserTracker = ExternalTracker | FunctionTracker  # each frame must reach it once, in order
Estimator = StarTracker | DomeTracker | CodedTracker | UserTracker


def tracker_of(name: str, given: Any) -> Estimator:
    """A star tracker given in Python, as `FunctionTracker` if it is a function or a class. Raises InputError."""
    if isinstance(given, StarTracker | DomeTracker | FunctionTracker):
        return given
    if callable(given) and (not isinstance(given, type) or takes_setup(given)):
        return FunctionTracker(name, given)
    what = f"the class {given.__name__}" if isinstance(given, type) else type(given).__name__
    raise InputError(
        "tracker",
        what,
        "a name, a function of an image, a function or class of a set-up (first parameter `setup`), a StarTracker or"
        " a DomeTracker",
    )


def setup_of(scene: Scene, mount: Mount, sources: Sources) -> Setup:
    """The set-up that a tracker of one's own gets: camera, catalog or map, and settings that skysim's would assume."""
    stars: Stars | None = None
    leds: Leds | None = None
    if dome := scene.dome:
        camera, led_map, lever = onboard_dome(scene, dome, mount, sources)
        axes_xyzw = lever.cam_from_body.as_quat()
        leds = Leds(led_map.id, led_map.position_m, lever.camera_body_m, axes_xyzw)
    else:
        camera = assumed_camera(scene)
        catalog, directions = assumed_stars(scene, assumed_orbit(scene))
        stars = Stars(catalog.id, directions, catalog.v_mag)
    settings = assumed_settings(scene)
    return Setup(
        "icrs" if scene.stars else "lab",
        scene.start_time.isoformat(),
        camera.width_px,
        camera.height_px,
        camera.focal_px,
        camera.center_px,
        camera.distortion,
        settings.gain_e_dn,
        settings.saturation,
        scene.seed,
        stars,
        leds,
        dict(scene.tracker.options),
    )


def build_tracker(
    scene: Scene, mount: Mount, sources: Sources, programs: Programs = NO_PROGRAMS
) -> Estimator:
    """The star tracker with the hardware parameters that it assumes: those of the scene's section `tracker`, or the
    true ones.

    Parameters
    ----------
    scene
        The scene
    mount
        Mount of the camera
    sources
        LEDs or stars of the scene's light
    programs
        Commands of external trackers, and trackers given in Python, by name, for `tracker.name`

    Raises
    ------
    InputError
        For a dome or a catalog that the tracker cannot use.
    """
    name = scene.tracker.name
    given = programs.get(name, "")
    if not isinstance(given, str):
        tracker = tracker_of(name, given)
        if isinstance(tracker, FunctionTracker) and tracker.takes_setup:
            return tracker.set_up(setup_of(scene, mount, sources))
        return tracker
    if name != OWN:
        return ExternalTracker.of_scene(scene, setup_of(scene, mount, sources), programs)
    settings = assumed_settings(scene)
    dome = scene.dome
    if dome is None:
        # Stars, with their apparent directions from the tracker's catalog.
        camera = assumed_camera(scene)
        orbit = assumed_orbit(scene)
        stars, directions = assumed_stars(scene, orbit)
        if orbit:
            return OrbitStarTracker(camera, stars, directions, settings, orbit)
        return StarTracker(camera, stars, directions, settings, air=assumed_air(scene))
    # LEDs, with map and lever from the survey or from a map's file.
    camera, leds, lever = onboard_dome(scene, dome, mount, sources)
    leds = with_brightness(scene, dome, leds, lever)
    try:
        if scene.tracker.decoder is None:
            return DomeTracker(camera, leds, lever, settings)
        code = assumed_code(dome, sources, leds)
        decoder = DecoderSettings(**scene.tracker.decoder.model_dump())
        return CodedTracker(camera, leds, lever, settings, code, decoder)
    except ImageError as error:
        raise InputError("light", f"the star tracker cannot use this dome: {error}") from None


def solve_frame(
    estimator: Estimator,
    frame: Frame,
    streak_px: tuple[float, float] | None = None,
    rate: RateEstimate | None = None,
) -> Report:
    """The tracker's report on a frame; for an image that it refuses (empty, saturated) the status is the reason.

    Parameters
    ----------
    estimator
        Star tracker
    frame
        The frame
    streak_px
        Motion (dx, dy) of the images in the exposure, if a gyro measures it
    rate
        Rate of the camera, if a gyro measures it; external trackers get only streak_px
    """
    if isinstance(estimator, UserTracker):
        return estimator.solve_frame(frame, streak_px)
    when = Record()
    if isinstance(estimator, StarTracker | CodedTracker):
        when["t_s"] = frame.t_mid_s
    if isinstance(estimator, CodedTracker):
        when["frame"] = frame.index
    try:
        return estimator.solve(frame.image_dn, streak_px, rate, frame.exposure_s, **when)
    except ImageError as error:
        return Report(Attitude(str(error)), Centroids.empty())


def solve_centroids(
    estimator: Estimator, centroids: Centroids, exposure_s: float
) -> Attitude:
    """The tracker's attitude from centroids; a dome tracker needs the exposure time for the lights' brightness."""
    if isinstance(estimator, DomeTracker):
        return estimator.solve_centroids(centroids, exposure_s=exposure_s)
    return estimator.solve_centroids(centroids)


# Automatic exposure.


class ExposureController:
    """The camera's exposure controller: sets the next exposure time from the last frame.

    Attributes
    ----------
    control
        Constants of the control law; None for fixed exposure times
    settings
        Settings of the tracker
    exposure_s
        Exposure time of the next frame; always the scene's `exposure.time` without `tracker.exposure_control`
    """

    def __init__(self, scene: Scene) -> None:
        self.control = control_settings(scene)
        self.settings = assumed_settings(scene)
        self.exposure_s = scene.exposure.time_s

    def update(self, frame: Frame) -> None:
        """Update the exposure time from a frame, which was exposed for `frame.exposure_s`."""
        if self.control:
            observed = observe_frame(self.settings, self.control, frame)
            last = NextExposure(frame.exposure_s)
            self.exposure_s = step(last, observed, self.control).time_s


def control_settings(scene: Scene) -> Control | None:
    """The constants of the control law from the scene; None for fixed exposure times."""
    config = scene.tracker.exposure_control
    return Control(**dict(config)) if config else None


def observe_frame(settings: Settings, control: Control, frame: Frame) -> Observation:
    """The input of the control law from a frame: brightness statistics of the detected blobs.

    Blobs that are not stars (defects, tracks, the Moon) are left out. A pixel near the camera's saturation value counts
    as saturated.
    """
    image_dn = monochrome(frame.image_dn, settings)
    box_px = np.empty((0, 4), np.int64)
    # A coarse converter may give a frame of one value: no blobs.
    with suppress(ImageError):
        blobs = DETECTORS[settings.detector](
            image_dn,
            settings.threshold_sigma,
            settings.min_area_px,
            settings.max_blobs,
            FramePriors(None, settings.saturation, 0.0, settings.intensity_threshold),
        )
        box_px = blobs.box_px[blobs.flag & settings.reject == 0]
    return observe(image_dn, box_px, settings.saturation, control)
