"""Simulated survey of an LED dome with the vehicle's own camera: render frames, identify LEDs, adjust, and check.

The vehicle is held still at many attitudes and takes a frame at each; the IMU gives the attitude to about half a
degree. At first the detections are matched to LEDs with the IMU attitude. Its error shifts all lights of a frame
together by more than the LED spacing, so the most likely common shift is found first (`shift_px`). Then
`estimator.calibration.dome_survey.survey` adjusts LED positions, lever arm, lens and attitudes together by least
squares. Identification and adjustment are repeated with the improved values, ROUNDS times. The result is a `DomeMap`,
the file that `tracker.map` reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.calibration import dome_survey
from estimator.calibration.dome_survey import DomeFrame, Survey
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.core.errors import InputError
from skysim.core.types import Floats, Frame, Trajectory, Truth
from skysim.core.units import quantity
from skysim.scene.light import DomeConfig
from skysim.scene.scene import Scene
from skysim.simulation import exposure, testbed
from skysim.simulation.testbed import SPARE_S, Testbed
from skysim.tracking import onboard_model
from skysim.tracking import settings as tracker_settings
from skysim.tracking.dome_map_file import DomeMap

Ints = NDArray[np.int64]
STREAM = {"attitudes": 101, "imu": 102, "checks": 103}  # distinct from random_streams.STAGE_ID
GATE = 3.5  # sigmas of a two-dimensional error; Gaussian noise exceeds it once in 450
ANCHORS = 10  # number of central lights that are paired with every LED to find the common shift
# Lights that a frame must share with others: two determine its attitude; a misidentified patch board accounts for six.
LINKS = (3, 8)

CROSSING_RAD = (
    0.01  # minimum rms angle between an LED's rays for its distance; dome_survey.survey requires half of it
)

# Options: unit, quantity, example, minimum and maximum. The LED error must be > 0, because it weights the map.
DOUBTS = {
    "imu_sigma": ("rad", "plane angle", '"0.5 deg"', 0.0, 0.1),
    "led_sigma": ("m", "length", '"2 mm"', 1e-6, 0.1),
    "lever_sigma": ("m", "length", '"5 mm"', 0.0, 0.1),
    "focal_error": ("", "share", '"1%" or "0.01"', -0.1, 0.1),
}

ROUNDS = 3  # rounds of identification and adjustment; from the second on with the adjusted values


@dataclass(frozen=True, slots=True)
class SurveyUncertainty:
    """Uncertainty before the survey: standard deviations per axis, and a focal length error.

    imu_sigma_rad : attitude from the IMU at each frame;  led_sigma_m : position of each LED
    lever_sigma_m : position of the camera in the body;  focal_error : relative error of the assumed focal length
    """

    imu_sigma_rad: float
    led_sigma_m: float
    lever_sigma_m: float
    focal_error: float


def doubt(imu_sigma: str, led_sigma: str, lever_sigma: str, focal_error: str) -> SurveyUncertainty:
    """Parse the quantities of the command line. Raises InputError for an invalid or out-of-range value."""
    told = {
        "imu_sigma": imu_sigma,
        "led_sigma": led_sigma,
        "lever_sigma": lever_sigma,
        "focal_error": focal_error,
    }
    value: dict[str, float] = {}
    for name, text in told.items():
        unit, what, example, low, high = DOUBTS[name]
        option = f"--{name.replace('_', '-')}"
        try:
            value[name] = quantity(unit, what, example)(text)
        except ValueError as error:
            raise InputError(f"{option}: {error}") from None
        if not low <= value[name] <= high:
            raise InputError(f"{option} {text}: allowed: {low:g} to {high:g} {unit or 'of it'}")
    return SurveyUncertainty(*value.values())


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """Assumed model of dome and camera, before a survey or from it.

    floor_px : added in quadrature to each centroid's sigma, for errors that its noise does not cover
    """

    camera: Camera
    leds: LedMap
    lever: Lever
    floor_px: float

    @property
    def px_per_m(self) -> float:
        """Image scale in pixels per meter perpendicular to the line of sight, at the least distance of an LED."""
        nearest_m = np.linalg.norm(self.leds.position_m, axis=1).min()
        return float(self.camera.focal_px / (nearest_m - np.linalg.norm(self.lever.camera_body_m)))

    def pixels(self, body_from_lab: Rotation) -> Floats:
        """(N, 2) pixel positions of the LEDs; a value far outside the image for LEDs behind the camera."""
        in_body = body_from_lab.apply(self.leds.position_m) - self.lever.camera_body_m
        xy_px = self.camera.pixels(self.lever.cam_from_body.apply(in_body))
        return np.nan_to_num(xy_px, nan=-1e9)


@dataclass(frozen=True, slots=True)
class SurveyFrame:
    """One frame of a survey: its detections, and the vehicle's attitude from the IMU or a previous adjustment."""

    lights: Centroids
    body_from_lab: Rotation


def belief_of(lab: Testbed) -> CalibrationPrior:
    """The onboard model of the tracker of a test bed. Raises InputError for a scene without a dome."""
    light = lab.scene.light
    if not isinstance(light, DomeConfig):
        raise InputError(f"light.kind: {light.kind} has nothing to survey; allowed: dome")
    return CalibrationPrior(
        onboard_model.believed_camera(lab.scene),
        onboard_model.believed_dome(lab.scene, light, lab.sources),
        onboard_model.believed_lever(lab.scene, lab.mount),
        lab.scene.tracker.centroid_sigma_px,
    )


class Correspondences(NamedTuple):
    """Correspondences: rows of a frame's detections, and rows of the map's LEDs that they are matched to."""

    light: Ints
    led: Ints


def with_survey_errors(scene: Scene, doubt: SurveyUncertainty) -> Scene:
    """The scene with the onboard model before a survey: errors of size `doubt`, drawn with `tracker.survey.seed`."""
    errors = {"led_sigma_m": doubt.led_sigma_m, "lever_sigma_m": doubt.lever_sigma_m}
    believed = {
        "survey": scene.tracker.survey.model_copy(update=errors),
        "believed_focal_length_m": scene.camera.focal_length_m * (1 + doubt.focal_error),
        "believed_camera_body_m": None,
        "map": None,
    }
    return scene.model_copy(update={"tracker": scene.tracker.model_copy(update=believed)})


def with_map(scene: Scene, path: str) -> Scene:
    """The scene whose tracker uses the map file of a surveyed dome, and no other onboard errors."""
    none = {"led_sigma_m": 0.0, "lever_sigma_m": 0.0}
    believed = {
        "survey": scene.tracker.survey.model_copy(update=none),
        "believed_focal_length_m": None,
        "believed_camera_body_m": None,
        "map": path,
    }
    return scene.model_copy(update={"tracker": scene.tracker.model_copy(update=believed)})


def attitudes(scene: Scene, what: str, count: int, tilt_deg: float) -> Rotation:
    """Random lab_from_body at `count` stops: tilt uniform in solid angle up to tilt_deg, yaw uniform.

    what : random stream, a key of STREAM. Raises InputError if the tilt exceeds the vehicle's tilt stop.
    """
    stop_deg = scene.vehicle.tilt_stop_deg if scene.vehicle.mount == "air_bearing" else 90.0
    if not 0 < tilt_deg <= stop_deg:
        raise InputError(
            f"--tilt {tilt_deg:g}: allowed: above 0, up to {stop_deg:g} degrees, the vehicle's stop"
        )
    rng = stream(scene.seed, what)
    tilt = np.arccos(rng.uniform(np.cos(np.radians(tilt_deg)), 1, count))
    about, yaw = rng.uniform(0, 2 * np.pi, (2, count))
    lean = np.column_stack([tilt * np.cos(about), tilt * np.sin(about), np.zeros(count)])
    return Rotation.from_rotvec(lean) * Rotation.from_euler("z", yaw[:, None])


def stream(seed: int, what: str) -> np.random.Generator:
    """Random generator for one purpose (a key of STREAM), independent of the other streams of the seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM[what],)))


def frames(lab: Testbed, lab_from_body: Rotation, first: int = 0) -> Iterator[tuple[Frame, Truth]]:
    """Render a frame at each attitude with the vehicle at rest. `first` is the index of the first frame, which also
    selects its noise."""
    for n, turned in enumerate(lab_from_body):
        end_s = testbed.window(lab.scene, first + n).close_s(lab.scene.camera.height_px) + SPARE_S
        still = Trajectory(np.array([0.0, end_s]), Rotation.concatenate([turned, turned]), np.zeros((2, 3)))
        yield exposure.render_frame(replace(lab, trajectory=still), first + n)


def looks(
    lab: Testbed, belief: CalibrationPrior, doubt: SurveyUncertainty, count: int, tilt_deg: float
) -> Iterator[SurveyFrame]:
    """Detections and IMU attitude at each of `count` random stops."""
    lab_from_body = attitudes(lab.scene, "attitudes", count, tilt_deg)
    told, settings = (
        hints(lab.scene, lab_from_body, doubt.imu_sigma_rad),
        tracker_settings.believed_settings(lab.scene),
    )
    for (frame, _), body_from_lab in zip(frames(lab, lab_from_body), told, strict=True):
        yield SurveyFrame(detect_lights(settings, belief.camera, frame), body_from_lab)


def hints(scene: Scene, lab_from_body: Rotation, sigma_rad: float) -> Rotation:
    """body_from_lab at each stop from an IMU with independent Gaussian errors about each body axis."""
    wrong = sigma_rad * stream(scene.seed, "imu").standard_normal((len(lab_from_body), 3))
    return Rotation.from_rotvec(wrong) * lab_from_body.inv()


# --- identification of the LEDs -------------------------------------------------------------------------------


def expected_px(belief: CalibrationPrior, doubt: SurveyUncertainty) -> tuple[float, float]:
    """Standard deviations per coordinate in pixels: of the common shift of a frame, and of each light individually.

    The attitude error across the boresight and the lever arm error shift all lights alike. The LED position error, and
    the roll and focal length errors (largest, and evaluated, at the image corner), act on each light differently.
    """
    camera = belief.camera
    corner_px = np.hypot(camera.width_px, camera.height_px) / 2
    common = np.hypot(doubt.imu_sigma_rad * camera.focal_px, doubt.lever_sigma_m * belief.px_per_m)
    aside = corner_px * np.hypot(doubt.imu_sigma_rad, doubt.focal_error)
    return float(common), float(np.hypot(doubt.led_sigma_m * belief.px_per_m, aside))


def by_hint(look: SurveyFrame, belief: CalibrationPrior, doubt: SurveyUncertainty) -> Correspondences:
    """Match detections to LEDs with the IMU attitude and the declared errors: common shift first, then assignment."""
    common_px, own_px = expected_px(belief, doubt)
    predicted = belief.pixels(look.body_from_lab)
    near = np.flatnonzero(belief.camera.contains(predicted, -GATE * (common_px + own_px)))
    seen = look.lights.xy_px
    if not len(near) or not len(seen):
        return Correspondences(np.zeros(0, np.int64), np.zeros(0, np.int64))
    moved = predicted[near] + shift_px(seen, predicted[near], common_px, own_px, belief.camera.centre_px)
    light, led = paired(seen, moved, np.full(len(near), GATE * own_px))
    return Correspondences(light, near[led])


def shift_px(
    seen_px: Floats, predicted_px: Floats, common_px: float, own_px: float, middle_px: tuple[float, float]
) -> Floats:
    """(2,) most likely common shift of (P, 2) predictions onto (S, 2) detections, pixels.

    Candidates are the shifts that move a prediction onto one of the ANCHORS detections nearest to the image center,
    where a roll error displaces least. The cost of a shift t is
    |t|^2 / common_px^2 + sum_i min(d_i / own_px, GATE)^2, where d_i is the distance of detection i from the nearest
    shifted prediction. The best candidate is refined by the mean residual of the detections inside the gate.
    """
    inner = np.argsort(np.linalg.norm(seen_px - middle_px, axis=1))[:ANCHORS]
    tried = (seen_px[inner, None] - predicted_px).reshape(-1, 2)
    tried = tried[np.linalg.norm(tried, axis=1) < GATE * np.hypot(common_px, own_px)]
    tried = np.vstack([np.zeros((1, 2)), tried])  # no shift is a candidate too
    apart, nearest = cKDTree(predicted_px).query(seen_px - tried[:, None])
    off = np.minimum(apart / own_px, GATE)
    best = int(np.argmin(np.sum(tried**2, axis=1) / common_px**2 + np.sum(off**2, axis=1)))
    close = off[best] < GATE
    if not close.any():
        return tried[best]
    return np.mean(seen_px[close] - predicted_px[nearest[best, close]], axis=0)


def paired(seen_px: Floats, predicted_px: Floats, gate_px: Floats) -> tuple[Ints, Ints]:
    """Optimal one-to-one assignment of (S, 2) detections to (P, 2) predictions with (P,) gates; returns their rows.

    It minimizes the sum of min(distance / gate, 1)^2. Pairs beyond their gate are left out.
    """
    apart = np.linalg.norm(seen_px[:, None] - predicted_px, axis=2) / gate_px
    # Clipping at the gate keeps detections without a counterpart from pulling the other pairs apart.
    rows, column = linear_sum_assignment(np.minimum(apart, 1.0) ** 2)
    inside = apart[rows, column] < 1
    return rows[inside].astype(np.int64), column[inside].astype(np.int64)


def by_survey(look: SurveyFrame, belief: CalibrationPrior, sigma_px: Floats) -> Correspondences:
    """Match detections to LEDs with the attitudes and map of an adjustment.

    sigma_px : (N,) standard deviation of each LED's predicted coordinates
    """
    predicted = belief.pixels(look.body_from_lab)
    near = np.flatnonzero(belief.camera.contains(predicted, -GATE * float(sigma_px.max())))
    light, led = paired(look.lights.xy_px, predicted[near], GATE * sigma_px[near])
    return Correspondences(light, near[led])


# --- the survey ---------------------------------------------------------------------------------------------


def surveyed(
    looks: Sequence[SurveyFrame],
    belief: CalibrationPrior,
    doubt: SurveyUncertainty,
    fit_distortion: bool = False,
    watch: Callable[[float, float], None] | None = None,
) -> Survey:
    """Survey LEDs, lever arm, lens and attitudes from all frames, starting from `belief` with the errors of `doubt`.

    fit_distortion : fit k1, k2, p1, p2 as well. A narrow field hardly determines them, and they correlate with the
        focal length: on the AFIT dome its sigma grows from 10 to 80 px, while the attitude does not change
    watch(rounds done, rounds) is called after each round of identification and adjustment
    Raises InputError if the frames do not determine the unknowns.
    """
    found, floor_px, names = None, belief.floor_px, [by_hint(look, belief, doubt) for look in looks]
    for done in range(ROUNDS):
        if found:
            better = CalibrationPrior(found.camera, found.leds, found.lever, floor_px)
            # The attitudes are adjusted now, so only the map's and the residual error remain in the predictions.
            sigma_px = np.hypot(led_sigma_m(found, doubt) * better.px_per_m, max(found.rms_px, floor_px))
            looks = [
                replace(looks[k], body_from_lab=found.body_from_lab[k])
                for k in np.flatnonzero(found.tied).tolist()
            ]
            names = [by_survey(look, better, sigma_px) for look in looks]
            belief = replace(
                better, leds=belief.leds
            )  # keep the map from before the survey: it enters each adjustment as a measurement
        looks, found = adjusted(looks, names, belief, doubt, fit_distortion)
        if watch:
            watch(done + 1, ROUNDS)
    assert found, "there is a round"
    return found


def adjusted(
    looks: Sequence[SurveyFrame],
    names: Sequence[Correspondences],
    belief: CalibrationPrior,
    doubt: SurveyUncertainty,
    fit_distortion: bool,
) -> tuple[list[SurveyFrame], Survey]:
    """Adjust the largest group of connected frames. Returns its frames and the survey.

    A frame may be connected only by misidentified lights. The adjustment rejects these and then fails, so it is tried
    again with a larger minimum number of shared lights (LINKS). Raises InputError if the last attempt fails.
    """
    shown = led_visibility(looks, names, belief)
    for links in LINKS:
        kept = largest_connected_group(shown, links)
        sightings = [
            sighting(looks[k].lights, names[k].light, names[k].led, looks[k].body_from_lab, belief.floor_px)
            for k in kept
        ]
        try:
            found = robust_survey(
                sightings, belief.leds, belief.lever, belief.camera, doubt.led_sigma_m, fit_distortion
            )
        except InputError:
            if links == LINKS[-1]:
                raise
        else:
            break
    return [looks[k] for k in kept], found


def led_visibility(
    looks: Sequence[SurveyFrame], names: Sequence[Correspondences], belief: CalibrationPrior
) -> NDArray[np.bool_]:
    """(F, N) mask of the LEDs in each frame, without LEDs whose rays are nearly parallel in all frames.

    Such an LED, seen from camera positions close together, has no measurable distance and connects no frames.
    """
    shown = np.zeros((len(names), len(belief.leds.id)), dtype=bool)
    for frame, name in zip(shown, names, strict=True):
        frame[name.led] = True
    # RMS spread of the camera positions over the frames that show an LED, as an angle seen from the nearest LED.
    arm_m = belief.lever.camera_body_m
    camera_m = np.array([look.body_from_lab.inv().apply(arm_m) for look in looks])
    count = np.maximum(shown.sum(axis=0), 1)[:, None]
    spread_m2 = np.sum((shown.T @ camera_m**2) / count - ((shown.T @ camera_m) / count) ** 2, axis=1)
    angle_rad = np.sqrt(np.maximum(spread_m2, 0)) * belief.px_per_m / belief.camera.focal_px
    return shown & (angle_rad > CROSSING_RAD)


def largest_connected_group(shown: NDArray[np.bool_], links: int) -> list[int]:
    """Indices of the largest group of frames connected by shared LEDs.

    shown : (F, N) mask of the LEDs in each frame
    links : minimum number of LEDs that a frame shares with the rest of the group

    Frames outside the group have an undetermined position relative to it, which `dome_survey.survey` rejects. A group
    grows from the frame with the most LEDs, adding connected frames until none is left.
    """
    frames = len(shown)
    left, best = np.ones(frames, dtype=bool), np.zeros(frames, dtype=bool)
    while left.any():
        group = np.zeros(frames, dtype=bool)
        group[np.argmax(left * (1 + shown.sum(axis=1)))] = True
        # Add frames that share enough LEDs with the group until it no longer grows.
        while True:
            known = shown[group].any(axis=0)
            grown = group | (left & ((shown & known).sum(axis=1) >= links))
            if (grown == group).all():
                break
            group = grown
        left &= ~group
        best = group if group.sum() > best.sum() else best
    return np.flatnonzero(best).tolist()


def led_sigma_m(found: Survey, doubt: SurveyUncertainty) -> Floats:
    """(N,) standard deviation of each LED's position, RMS of three axes; that before the survey if not surveyed."""
    variance_m2 = np.einsum("nii->n", found.led_covariance_m2) / 3
    return np.sqrt(np.where(found.surveyed, variance_m2, doubt.led_sigma_m**2))


def lens_sigma(found: Survey) -> Floats:
    """(8,) standard deviations of focal_px, center x and y, k1, k2, p1, p2, k3; 0 for those not fitted."""
    fitted = np.sqrt(np.maximum(np.diag(found.lens_covariance), 0))
    return np.concatenate([fitted, np.zeros(8 - len(fitted))])


def dome_map(found: Survey, doubt: SurveyUncertainty) -> DomeMap:
    """The map file of a survey for the tracker: surveyed LEDs, lever arm, lens, and their standard deviations."""
    kept = found.surveyed
    focal_sigma_px, x_sigma_px, y_sigma_px, *k_sigma = lens_sigma(found).tolist()
    return DomeMap(
        id=found.leds.id[kept],
        position_m=found.leds.position_m[kept],
        sigma_m=led_sigma_m(found, doubt)[kept],
        camera_body_m=found.lever.camera_body_m,
        lever_sigma_m=float(np.sqrt(np.trace(found.lever_covariance_m2) / 3)),
        size_px=(found.camera.width_px, found.camera.height_px),
        focal_px=found.camera.focal_px,
        focal_sigma_px=focal_sigma_px,
        centre_px=found.camera.centre_px,
        centre_sigma_px=(x_sigma_px, y_sigma_px),
        distortion=found.camera.distortion,
        distortion_sigma=tuple(k_sigma),
    )


def detect_lights(settings: Settings, camera: Camera, frame: Frame) -> Centroids:
    """Centroids of a frame; none if the tracker would reject the image."""
    try:
        return detect_and_centroid(frame.image_dn, camera, settings, Clock())
    except ImageError:
        return Centroids.none()


def sighting(
    seen: Centroids,
    light: NDArray[np.int64],
    led: NDArray[np.int64],
    body_from_lab: Rotation,
    floor_px: float,
) -> DomeFrame:
    """Input frame of the adjustment: matched detections `light`, their LEDs `led`, and the start attitude."""
    sigma_px = np.hypot(seen.sigma_px[light], floor_px)
    return DomeFrame(led, seen.xy_px[light], sigma_px, body_from_lab)


def robust_survey(
    frames: list[DomeFrame],
    leds: LedMap,
    lever: Lever,
    camera: Camera,
    led_sigma_m: float,
    fit_distortion: bool,
) -> Survey:
    """`dome_survey.survey` with a robust (Cauchy) loss and the prior map as a measurement. Raises InputError."""
    try:
        return dome_survey.survey(
            frames, leds, lever, camera, None, fit_distortion, loss="cauchy", leds_sigma_m=led_sigma_m
        )
    except ValueError as error:
        raise InputError(str(error)) from None
