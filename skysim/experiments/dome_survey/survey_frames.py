"""Frames of a survey: the model that is assumed before it, the lights of each frame, and which LEDs they are."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.calibration import survey_plan
from estimator.calibration.survey_plan import SurveyModel
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.identification.led_codes import LedCode
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.core.constants import MAD_PER_SIGMA
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import (
    Array,
    Bools,
    Floats,
    Frame,
    Ints,
    Sources,
    Truth,
    around_z,
    frozen,
    lengths,
    median,
)
from skysim.core.units import quantities_within
from skysim.scene.scene import Scene
from skysim.scene.sections.light import DomeConfig
from skysim.scene.sections.tracker import SurveyErrorsConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab
from skysim.sources.dome import surface
from skysim.sources.dome.layouts import led_list, registry
from skysim.tracking import factory, onboard_model

# The model that is assumed before a survey of the dome, and its uncertainty.


BLUR_PX = 3.0  # width of an image's blurred edge

# Options: unit, quantity, example, minimum and maximum. The LED error must be > 0, because it weights the map.
UNCERTAINTY_RANGES = {
    "imu_sigma": ("rad", "plane angle", '"0.5 deg"', 0.0, 0.1),
    "led_sigma": ("m", "length", '"2 mm"', 1e-6, 0.1),
    "lever_sigma": ("m", "length", '"5 mm"', 0.0, 0.1),
    "focal_error": ("", "share", '"1%" or "0.01"', 0.0, 0.1),
}


class SurveyUncertainty(NamedTuple):
    """Uncertainty before the survey: standard deviations along or about each axis, and of the focal length.

    Attributes
    ----------
    imu_sigma_rad
        Attitude from the IMU at each frame
    led_sigma_m
        Position of each LED
    lever_sigma_m
        Position of the camera in the body
    focal_error
        Relative standard deviation of the assumed focal length
    fit_distortion
        Nothing is known of k1, k2, p1, p2, so that the survey fits them. A narrow field hardly
        determines them, and they correlate with the focal length: on the AFIT dome its sigma grows
        from 10 to 80 px, while the attitude does not change
    """

    imu_sigma_rad: float
    led_sigma_m: float
    lever_sigma_m: float
    focal_error: float
    fit_distortion: bool

    def focal_sigma_px(self, camera: Camera) -> float:
        """Standard deviation of the assumed focal length of a camera."""
        return self.focal_error * camera.focal_px


EXACT = SurveyUncertainty(0.0, 0.0, 0.0, 0.0, fit_distortion=False)


class CalibrationPrior(NamedTuple):
    """Assumed model of dome and camera, before a survey or from it.

    Attributes
    ----------
    floor_px
        Least standard deviation of the residuals of predictions, for the matching of lights
    disk_m
        Diameter of an LED's luminous disk
    levels
        (N,) relative nominal brightness of the LEDs
    code
        Code of the LEDs; None if all are steady
    uncertainty
        Errors of the model, which a survey needs
    """

    camera: Camera
    leds: LedMap
    lever: Lever
    floor_px: float
    disk_m: float
    levels: Floats
    code: LedCode | None = None
    uncertainty: SurveyUncertainty = EXACT

    def expected_light(self, index: Ints) -> Floats:
        """(F, N) relative light of each LED in frames of these numbers; 0 if its code switches it off."""
        if self.code is None or self.code.bit_time_s is not None:
            return np.tile(self.levels, (len(index), 1))
        return self.levels * self.code.levels[:, index % self.code.bits].T

    @property
    def nearest_m(self) -> float:
        """Least distance of an LED from the center of rotation."""
        return float(lengths(self.leds.position_m).min())

    @property
    def px_per_m(self) -> float:
        """Image scale in pixels per meter perpendicular to the line of sight, at the least distance of an LED."""
        return float(
            self.camera.focal_px / (self.nearest_m - np.linalg.norm(self.lever.camera_body_m))
        )

    @property
    def margin_px(self) -> float:
        """Margin from the chip's edge for a complete image: its radius at the least distance, and BLUR_PX of blur."""
        return self.disk_m / 2 * self.px_per_m + BLUR_PX

    def pixels(self, body_from_lab: Rotation) -> Floats:
        """(N, 2) pixel positions of the LEDs; far outside the image for LEDs behind the camera."""
        xy_px = project(body_from_lab, self.leds.position_m, self.lever, self.camera)
        return np.nan_to_num(xy_px, nan=-1e9)


def survey_uncertainty(
    imu_sigma: str = "0.5 deg",
    led_sigma: str = "2 mm",
    lever_sigma: str = "5 mm",
    focal_error: str = "1%",
    fit_distortion: bool = False,
) -> SurveyUncertainty:
    """Parse quantities with units. Raises InputError for an invalid or out-of-range value."""
    texts = imu_sigma, led_sigma, lever_sigma, focal_error
    sigmas = quantities_within("survey", UNCERTAINTY_RANGES, texts)
    return SurveyUncertainty._make([*sigmas, fit_distortion])


def before_text(scene: Scene, uncertainty: SurveyUncertainty) -> str:
    """The uncertainty before a survey in words, and that of the scene's tracker, which has no part in it."""
    text = (
        f"before the survey: LEDs to {1e3 * uncertainty.led_sigma_m:.3g} mm (--led-sigma), the lever to"
        f" {1e3 * uncertainty.lever_sigma_m:.3g} mm (--lever-sigma), the focal length to"
        f" {100 * uncertainty.focal_error:.3g} % (--focal-error)"
    )
    own = scene.tracker.survey
    if own == SurveyErrorsConfig(seed=own.seed):
        return text
    return (
        f"{text}; not the scene's tracker.survey (LEDs {1e3 * own.led_sigma_m:.3g} mm, lever"
        f" {1e3 * own.lever_sigma_m:.3g} mm), which is what its tracker flies with"
    )


def calibration_prior(lab: Lab) -> CalibrationPrior:
    """The onboard model of the tracker of a lab. Raises InputError for a scene without a dome."""
    light = require_dome(lab.scene)
    leds = onboard_model.assumed_dome(lab.scene, light, lab.camera.sources)
    return prior_of(lab, onboard_model.assumed_camera(lab.scene), leds)


def listed_prior(lab: Lab, camera: Camera) -> CalibrationPrior:
    """The model of a dome by its list, without the simulated errors of the scene, with this camera."""
    light = require_dome(lab.scene)
    inside = surface.build_surface(light.surface)
    design = design_of(lab)
    board = registry.board_of(light.layout, design.id)
    leds = LedMap(design.id, design.xyz, *inside.as_ellipsoid(), board)
    return prior_of(lab, camera, leds)


def prior_of(lab: Lab, camera: Camera, leds: LedMap) -> CalibrationPrior:
    """The prior with these LEDs, their nominal brightness and code, and the tracker's assumed lever."""
    scene = lab.scene
    design = design_of(lab)
    levels = design.strength[onboard_model.rows_of(leds.id, design.id)]
    lever = onboard_model.assumed_lever(scene, lab.camera.mount)
    light = require_dome(scene)
    code = (
        onboard_model.assumed_code(light, lab.camera.sources, leds)
        if light.led.code
        else None
    )
    floor_px = scene.tracker.centroid_sigma_px or factory.DOME_SIGMA_PX
    return CalibrationPrior(
        camera, leds, lever, floor_px, light.led.disk_diameter_m, levels / levels.max(), code
    )


def design_of(lab: Lab) -> Sources:
    """The LEDs of the dome as designed."""
    light = require_dome(lab.scene)
    return led_list.design_leds(light, surface.build_surface(light.surface), lab.camera.band)


def require_dome(scene: Scene) -> DomeConfig:
    """The dome of a scene. Raises InputError if its light is another."""
    if scene.dome is None:
        raise InputError("light.kind", f"a survey needs LEDs, not {scene.light.kind}", "dome")
    return scene.dome


def survey_model(known: CalibrationPrior, noise_px: float) -> SurveyModel:
    """The estimator's model for plans and predictions, with the knowledge before or after a survey."""
    uncertainty = known.uncertainty
    sigmas = (
        uncertainty.led_sigma_m,
        uncertainty.lever_sigma_m,
        uncertainty.focal_sigma_px(known.camera),
        uncertainty.fit_distortion,
    )
    return SurveyModel(known.camera, known.leds, known.lever, noise_px, *sigmas)


def with_survey_errors(scene: Scene, uncertainty: SurveyUncertainty) -> Scene:
    """The scene with the onboard model before a survey: errors of this size, drawn with `tracker.survey.seed`."""
    return with_map(scene, None).with_values(
        "tracker.survey",
        led_sigma_m=uncertainty.led_sigma_m,
        lever_sigma_m=uncertainty.lever_sigma_m,
        focal_length_sigma_m=scene.camera.focal_length_m * uncertainty.focal_error,
    )


def as_listed(scene: Scene) -> Scene:
    """The scene whose tracker assumes the LEDs of the list and the vehicle's lever, without simulated errors."""
    return scene.with_values("tracker", survey=SurveyErrorsConfig(), map=None)


def with_map(scene: Scene, path: str | None) -> Scene:
    """The scene whose tracker uses the map file of a surveyed dome, if any, without random errors of a survey."""
    scene = scene.with_values(
        "tracker.survey", led_sigma_m=0.0, lever_sigma_m=0.0, focal_length_sigma_m=0.0
    )
    return scene.with_values(
        "tracker",
        assumed_focal_length_m=None,
        assumed_camera_body_m=None,
        map=path,
    )


# Attitudes at which the vehicle is held for a survey: by a plan, or random.


CANDIDATES = 1000  # number of random attitudes among which a plan chooses
# Distinct from those in core/random_streams.py.
STREAM_KEYS = {
    "attitudes": 101,
    "imu": 102,
    "checks": 103,
    "candidates": 104,
    "noise": 105,
    "domes": 106,
}


def stop_attitudes(scene: Scene, stream_name: str, count: int, tilt_deg: float) -> Rotation:
    """Random lab_from_body at `count` stops: tilt uniform in solid angle up to tilt_deg, yaw uniform.

    Parameters
    ----------
    stream_name
        Random stream, a key of STREAM_KEYS

    Raises
    ------
    InputError
        If the tilt exceeds the vehicle's tilt stop.
    """
    stop_deg = scene.vehicle.tilt_stop_deg if scene.vehicle.mount == "air_bearing" else 90.0
    if not 0 < tilt_deg <= stop_deg:
        raise InputError(
            "survey.tilt_deg",
            f"{tilt_deg:g}",
            f"above 0, up to {stop_deg:g} degrees, the vehicle's stop",
        )
    rng = random_stream(scene.seed, STREAM_KEYS[stream_name])
    tilt = np.arccos(rng.uniform(np.cos(np.radians(tilt_deg)), 1, count))
    azimuth, yaw = rng.uniform(0, 2 * np.pi, (2, count))
    return Rotation.from_rotvec(around_z(tilt, azimuth, 0.0)) * Rotation.from_euler(
        "z", yaw[:, None]
    )


def planned_stops(
    scene: Scene,
    model: SurveyModel,
    margin_px: float,
    count: int,
    tilt_deg: float,
    held: Rotation | None = None,
    seen: Bools | None = None,
) -> Rotation:
    """lab_from_body at up to `count` stops that reduce the errors most, best first (`survey_plan.choose`).

    Parameters
    ----------
    margin_px
        Margin of the chip in which an image would be incomplete
    held, seen
        body_from_lab of frames taken before, and the LEDs identified in them

    Raises
    ------
    InputError
        If no attitude shows enough LEDs.
    """
    candidates = stop_attitudes(scene, "candidates", CANDIDATES, tilt_deg).inv()
    shown = model.visible(candidates, margin_px)
    chosen = survey_plan.choose(model, candidates, shown, count, held, seen)
    if not chosen:
        raise InputError(
            "survey",
            f"no attitude within {tilt_deg:g} degrees shows {survey_plan.MIN_SHARED} LEDs",
            "more LEDs, or a wider field",
        )
    return candidates[chosen].inv()


ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")


def from_angles(roll_pitch_yaw_deg: Floats) -> Rotation:
    """lab_from_body of (F, 3) roll, pitch and yaw."""
    return Rotation.from_euler("ZYX", roll_pitch_yaw_deg[:, ::-1], degrees=True)


def from_rows(rows: Sequence[Mapping[str, float]]) -> Rotation:
    """lab_from_body of rows with ANGLES."""
    return from_angles(np.array([[row[name] for name in ANGLES] for row in rows]))


NOISE_FRAMES = 4  # number of frames from which the noise of a centroid is determined
MIN_LIGHTS = 10
LEAST_NOISE_PX = 1e-4
SAME_LIGHT_PX = 2.0  # greatest distance of a centroid from the true image


@frozen
class SurveyFrame:
    """One frame of a survey: its detections, and the vehicle's attitude from the IMU or a previous adjustment.

    Attributes
    ----------
    index
        Number of the frame, from 0, which determines the light of coded LEDs
    """

    lights: Centroids
    body_from_lab: Rotation
    index: int


def render_stops(
    lab: Lab, lab_from_body: Rotation, first: int = 0
) -> Iterator[tuple[Frame, Truth]]:
    """Render a frame at each attitude with the vehicle at rest.

    `first` is the index of the first frame; the index of a frame also selects its noise.
    """
    for n, attitude in enumerate(lab_from_body):
        yield render_at_rest(lab.camera, attitude, first + n)


def take_frames(
    lab: Lab, lab_from_body: Rotation
) -> Iterator[tuple[Frame, Truth, Centroids]]:
    """Each frame at these stops, with its truth and its detections."""
    settings = factory.assumed_settings(lab.scene)
    camera = onboard_model.assumed_camera(lab.scene)
    for frame, truth in render_stops(lab, lab_from_body):
        yield frame, truth, detect_lights(settings, camera, frame.image_dn)


def centroid_noise_px(lab: Lab, tilt_deg: float) -> float:
    """Standard deviation of a centroid's coordinates, robust, from the true images in NOISE_FRAMES simulated frames.

    Raises
    ------
    InputError
        If the frames show too few lights.
    """
    errors = []
    for _, truth, lights in take_frames(
        lab, stop_attitudes(lab.scene, "noise", NOISE_FRAMES, tilt_deg)
    ):
        if len(truth.sources.id) and len(lights):
            distance_px, nearest = cKDTree(truth.sources.flux_xy_px).query(lights.xy_px)
            same = distance_px < SAME_LIGHT_PX
            errors.append((lights.xy_px - truth.sources.flux_xy_px[nearest])[same])
    error_px = np.concatenate([*errors, np.zeros((0, 2))])
    if len(error_px) < MIN_LIGHTS:
        raise InputError(
            "survey",
            f"{len(error_px)} lights in {NOISE_FRAMES} frames",
            f"{MIN_LIGHTS} or more: brighter LEDs, more of them, or a longer exposure",
        )
    return max(median(np.abs(error_px)) / MAD_PER_SIGMA, LEAST_NOISE_PX)


def imu_attitudes(scene: Scene, lab_from_body: Rotation, sigma_rad: float) -> Rotation:
    """body_from_lab at each stop from an IMU with independent Gaussian errors about each body axis."""
    error_rad = sigma_rad * random_stream(scene.seed, STREAM_KEYS["imu"]).standard_normal(
        (len(lab_from_body), 3)
    )
    return Rotation.from_rotvec(error_rad) * lab_from_body.inv()


def detect_lights(settings: Settings, camera: Camera, image_dn: Array) -> Centroids:
    """Centroids of an image; none if the tracker would reject it."""
    try:
        return detect_and_centroid(image_dn, camera, settings, Clock())
    except ImageError:
        return Centroids.empty()


# Identification of the LEDs in the frames.


GATE_SIGMAS = 3.5  # gate of a two-dimensional error; Gaussian noise exceeds it once in 450
# Number of central lights that are paired with every LED to find the common shift.
ANCHOR_LIGHTS = 10


class Correspondences(NamedTuple):
    """Correspondences: rows of a frame's detections, and rows of the map's LEDs that they are matched to."""

    light: Ints
    led: Ints


def prediction_sigmas_px(
    prior: CalibrationPrior, map_px: Floats | None = None
) -> tuple[float, Floats]:
    """Standard deviations per coordinate in pixels: of the common shift of a frame, and (N,) of each LED individually.

    The attitude error across the boresight and the lever arm error shift all lights alike. An attitude error also moves
    the camera: it turns the direction of an LED at the distance R from the center of rotation and d from the camera by
    R / d times the error. The LED position error, and the errors of roll and focal length (evaluated at the image
    corner, where they are largest), shift each light differently.

    Parameters
    ----------
    map_px
        (N,) standard deviation of each LED's place; as known before a survey if None
    """
    camera = prior.camera
    uncertainty = prior.uncertainty
    corner_px = np.hypot(camera.width_px, camera.height_px) / 2
    common = (
        np.hypot(uncertainty.imu_sigma_rad * prior.nearest_m, uncertainty.lever_sigma_m)
        * prior.px_per_m
    )
    roll_and_scale = corner_px * np.hypot(uncertainty.imu_sigma_rad, uncertainty.focal_error)
    if map_px is None:
        map_px = np.full(len(prior.leds.id), uncertainty.led_sigma_m * prior.px_per_m)
    return float(common), np.hypot(map_px, roll_and_scale)


def match_by_imu(
    frame: SurveyFrame,
    prior: CalibrationPrior,
    map_px: Floats | None = None,
) -> Correspondences:
    """Match detections to LEDs with the IMU attitude and the declared errors: common shift first, then assignment.

    Parameters
    ----------
    map_px
        See `prediction_sigmas_px`
    """
    common_px, individual_px = prediction_sigmas_px(prior, map_px)
    return match_by_survey(frame, prior, individual_px, common_px)


def common_shift_px(
    detected_px: Floats,
    predicted_px: Floats,
    common_px: float,
    individual_px: Floats,
    center_px: tuple[float, float],
) -> Floats:
    """(2,) most likely common shift of (P, 2) predictions onto (S, 2) detections, pixels.

    Candidates are the shifts that move a prediction onto one of the ANCHOR_LIGHTS detections nearest to the image
    center, where a roll error displaces least. The cost of a shift t is -2 ln of its likelihood,
    |t|^2 / common_px^2 + sum_i min(d_i^2 / s_i^2 + 4 ln(s_i / s), GATE_SIGMAS^2), where d_i is the distance of
    detection i from the nearest shifted prediction, s_i its individual_px and s the greatest of all. The best candidate
    is refined by the mean residual of the detections in the gate, weighted by 1 / s_i^2.
    """
    inner = np.argsort(lengths(detected_px - center_px))[:ANCHOR_LIGHTS]
    candidates = (detected_px[inner, None] - predicted_px).reshape(-1, 2)
    limit_px = GATE_SIGMAS * np.hypot(common_px, individual_px.max())
    candidates = candidates[lengths(candidates) < limit_px]
    candidates = np.vstack([np.zeros((1, 2)), candidates])  # no shift is also a candidate
    distance_px, nearest = cKDTree(predicted_px).query(detected_px - candidates[:, None])
    sigma_px = individual_px[nearest]
    cost = np.minimum(
        (distance_px / sigma_px) ** 2 + 4 * np.log(sigma_px / individual_px.max()),
        GATE_SIGMAS**2,
    )
    best = int(np.argmin(np.sum(candidates**2, axis=1) / common_px**2 + np.sum(cost, axis=1)))
    is_close = cost[best] < GATE_SIGMAS**2
    if not is_close.any():
        return candidates[best]
    led = nearest[best, is_close]
    return np.average(
        detected_px[is_close] - predicted_px[led], axis=0, weights=individual_px[led] ** -2.0
    )


def assign_lights(
    detected_px: Floats, predicted_px: Floats, gate_px: Floats
) -> tuple[Ints, Ints]:
    """Optimal one-to-one assignment of (S, 2) detections to (P, 2) predictions with (P,) gates; returns their rows.

    It minimizes the sum of min(distance / gate, 1)^2. Pairs beyond their gate are left out.
    """
    distance = lengths(detected_px[:, None] - predicted_px) / gate_px
    # Clipping at the gate keeps detections without a counterpart from pulling the other pairs apart.
    rows, column = linear_sum_assignment(np.minimum(distance, 1.0) ** 2)
    inside = distance[rows, column] < 1
    return rows[inside].astype(np.int64), column[inside].astype(np.int64)


def match_by_survey(
    frame: SurveyFrame,
    prior: CalibrationPrior,
    sigma_px: Floats,
    common_px: float | None = None,
) -> Correspondences:
    """Match detections to LEDs with the attitudes and map of an adjustment, or of a prior.

    Parameters
    ----------
    sigma_px
        (N,) standard deviation of each LED's predicted coordinates
    common_px
        Standard deviation of a shift of all of them, which is then found first
    """
    predicted = prior.pixels(frame.body_from_lab)
    margin_px = GATE_SIGMAS * ((common_px or 0.0) + float(sigma_px.max()))
    visible = np.flatnonzero(prior.camera.contains(predicted, -margin_px))
    predicted = predicted[visible]
    sigma_px = sigma_px[visible]
    detected = frame.lights.xy_px
    if common_px is not None and len(visible) and len(detected):
        predicted = predicted + common_shift_px(
            detected, predicted, common_px, sigma_px, prior.camera.center_px
        )
    light, led = assign_lights(detected, predicted, GATE_SIGMAS * sigma_px)
    return Correspondences(light, visible[led])
