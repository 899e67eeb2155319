"""Outcome of a trial: errors of its solution, whether the right lights were identified, and the attitude it had."""

import math
from dataclasses import field, fields
from math import nan
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, StarMatch
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from skysim.core import quaternion
from skysim.core.constants import ARCSEC_RAD
from skysim.core.jit import jit
from skysim.core.types import (
    UP,
    Array,
    Floats,
    Ints,
    Record,
    Telemetry,
    Truth,
    frozen,
    lengths,
    median,
)
from skysim.results import metrics
from skysim.results.telemetry_report import attitude_error_deg, saturated_s
from skysim.simulation.lab import Lab
from skysim.tracking import factory
from skysim.tracking.computer_time import total
from skysim.tracking.onboard_model import rows_of

# A centroid is a light's own if it is within this distance of its true image, and half of its streak. Errors of
# centroids are below it even where two images touch; neighboring stars or LEDs are usually farther apart.
SAME_LIGHT_PX = 3.0
AMBIGUOUS = "ambiguous"  # beginning of the status of such a refusal


@frozen
class Outcome:
    """Result of a trial. For a flight trial, errors are RMS over the solved frames and counts are sums unless noted.

    Attributes
    ----------
    status
        "solved", the reason why there is no attitude, or "failed" if the trial raised an
        exception
    frames, solved, wrong
        Number of frames, of solved frames, and of wrong solutions (`metrics.is_wrong`)
    x_arcsec, y_arcsec, roll_arcsec
        Error in camera axes, signed (RMS for a flight); NaN without a solution
    nees
        e^T P^-1 e with three degrees of freedom and the tracker's covariance P; mean for a
        flight
    stars
        Number of true sources on the detector; minimum for a flight
    detected, matched
        Numbers of detections and of lights matched with a star or LED; means for a flight
    availability
        Fraction of a flight's ticks with a filter error below ten arcminutes; without a filter,
        fraction of its frames solved correctly
    filter_arcsec, filter_worst_arcsec
        Angular error of a flight's filter, RMS and worst
    drift_arcsec
        filter_arcsec of the last quarter of a flight minus that of the first quarter
    pointing_arcsec, pointing_worst_arcsec
        Angle between a flight's attitude and the commanded one, RMS and worst; NaN without a
        maneuver
    saturated_s
        Time of a flight during which an actuator of the controller was at its limit
    ambiguous
        Number of frames refused because another attitude fits the lights as well
    misidentified
        Number of frames solved with a light that is matched with a wrong star or LED, more than
        SAME_LIGHT_PX from the true image of that star or LED; NaN if the tracker does not name
        its lights
    roll_noise
        Number of frames solved with the right lights and a roll error beyond ten arcminutes
        that the covariance allows; NaN if the tracker does not name its lights
    misled
        Number of misidentified frames whose error the covariance does not allow: the wrong
        lights moved the attitude beyond what the tracker claims; NaN as above
    wrong_matches
        Number of lights that are matched with a wrong star or LED; NaN as above
    centroid_px
        RMS error of the centroids about each axis, of those within SAME_LIGHT_PX of a true
        image
    lights_detected, false_detections
        Number of true images with a centroid within SAME_LIGHT_PX, and of centroids without such an
        image; means for a flight
    streak_px
        Path length of the lights over the exposure, back and forth if they vibrate: median of a frame and mean for a
        flight; NaN for centroid trials
    angles_compared
        Number of angles that the identifier compared, mean for a flight; NaN if it does not count
        them
    exposure_ms
        Exposure time of a flight's last frame; NaN for other trials
    detect_ms, computer_ms
        Computing time of the detection, and of the tracker on the scene's `tracker.computer`, mean for a flight; not
        the same in every run
    lab_from_body_w, _x, _y, _z
        True attitude at mid-exposure; for a flight, that of its worst frame (`worst_frame`)
    body_tilt_deg, body_azimuth_deg
        Under a dome, angle of the body's z axis from vertical, and its azimuth from the lab's x
        toward y
    boresight_ra_deg, boresight_dec_deg
        Under the stars, direction of the camera
    """

    status: str
    frames: int = 0
    solved: int = 0
    wrong: int = 0
    x_arcsec: float = nan
    y_arcsec: float = nan
    roll_arcsec: float = nan
    nees: float = nan
    stars: float = nan
    detected: float = nan
    matched: float = nan
    availability: float = nan
    filter_arcsec: float = nan
    filter_worst_arcsec: float = nan
    drift_arcsec: float = nan
    pointing_arcsec: float = nan
    pointing_worst_arcsec: float = nan
    saturated_s: float = nan
    ambiguous: int = 0
    misidentified: float = nan
    roll_noise: float = nan
    misled: float = nan
    wrong_matches: float = nan
    centroid_px: float = nan
    lights_detected: float = nan
    false_detections: float = nan
    streak_px: float = nan
    angles_compared: float = nan
    exposure_ms: float = nan
    lab_from_body_w: float = nan
    lab_from_body_x: float = nan
    lab_from_body_y: float = nan
    lab_from_body_z: float = nan
    body_tilt_deg: float = nan
    body_azimuth_deg: float = nan
    boresight_ra_deg: float = nan
    boresight_dec_deg: float = nan
    detect_ms: float = field(default=nan, compare=False)
    computer_ms: float = field(default=nan, compare=False)


FIELDS = tuple(one.name for one in fields(Outcome) if one.compare)
# Values that are unknown for an external tracker.
IDENTITY = ("misidentified", "roll_noise", "misled", "wrong_matches")
FAILED = Outcome("failed")
DIRECTION = FIELDS[-8:]  # attitude and direction
# Values of which a flight has the mean over the frames that have one.
MEANS = (
    "detected",
    "matched",
    "lights_detected",
    "false_detections",
    "streak_px",
    "angles_compared",
    "detect_ms",
    "computer_ms",
)


class TrueLights(NamedTuple):
    """True state of a frame: attitude at mid-exposure and its mean over the exposure, and N lights on the detector.

    Attributes
    ----------
    xy_px
        (N, 2) image at mid-exposure
    flux_xy_px
        (N, 2) flux-weighted mean of the image over the exposure: the perfect centroid
    streak_px
        (N,) length of its path over the exposure; None if there is no exposure
    """

    lab_from_body: Rotation
    mean_lab_from_body: Rotation
    xy_px: Floats
    flux_xy_px: Floats
    streak_px: Floats | None


def true_lights(truth: Truth) -> TrueLights:
    """The lights of a rendered frame."""
    sources = truth.sources
    return TrueLights(
        truth.lab_from_body,
        truth.mean_lab_from_body,
        sources.xy_px,
        sources.flux_xy_px,
        sources.streak_px,
    )


def score(
    lab: Lab, estimator: factory.Estimator, report: Report, lights: TrueLights
) -> Outcome:
    """Outcome of one frame from the tracker's report and the truth.

    Quaternions are NumPy arrays because SciPy's Rotation would take a tenth of a trial's time.
    """
    solution = report.attitude
    centroids_px = report.centroids.xy_px
    lab_from_body = quaternion.from_rotation(lights.lab_from_body)
    cam_from_body = quaternion.from_rotation(lab.camera.mount.cam_from_body)
    cam_from_lab = quaternion.multiply(cam_from_body, quaternion.inverse(lab_from_body))
    streak_px = nan
    if lights.streak_px is not None and len(lights.streak_px):
        streak_px = median(lights.streak_px)
    reach_px = SAME_LIGHT_PX + (0.0 if math.isnan(streak_px) else streak_px / 2)
    own_tracker = isinstance(estimator, StarTracker | DomeTracker)
    errors_px = distances_px(centroids_px, lights.flux_xy_px, reach_px)
    common: Record = {
        "stars": len(lights.xy_px),
        "detected": len(centroids_px),
        "matched": len(solution.match.observed) if solution.match else 0,
        "ambiguous": int(solution.status.startswith(AMBIGUOUS)),
        **dict.fromkeys(IDENTITY, 0.0 if own_tracker else nan),
        "centroid_px": rms(errors_px) / math.sqrt(2),
        "lights_detected": len(distances_px(lights.flux_xy_px, centroids_px, reach_px)),
        "false_detections": len(centroids_px) - len(errors_px),
        "streak_px": streak_px,
        "angles_compared": solution.angles_compared or nan,
        "detect_ms": 1e3 * report.seconds.get("detect", nan),
        "computer_ms": 1e3 * total(lab.scene.tracker.computer, report.seconds),
        **directions(lab, lab_from_body, cam_from_lab),
    }
    if solution.cam_from_ref is None:
        return Outcome(solution.status, 1, **common)
    mean_lab_from_body = quaternion.from_rotation(lights.mean_lab_from_body)
    error, nees = error_and_nees(
        solution, quaternion.multiply(cam_from_body, quaternion.inverse(mean_lab_from_body))
    )
    wrong = metrics.is_wrong(math.hypot(*error), math.inf if math.isnan(nees) else nees)
    if solution.match is not None and own_tracker:
        claimed_px = claimed_image_px(
            lab, estimator, solution.match, lab_from_body, cam_from_lab
        )
        observed_px = centroids_px[solution.match.observed]
        wrong_matches = count_wrong_matches(observed_px, claimed_px, lights, reach_px)
        allowed = nees <= metrics.OVERCONFIDENT_NEES
        noise = not wrong_matches and abs(error[2]) > metrics.WRONG_RAD and allowed
        found = (wrong_matches > 0, noise, wrong_matches > 0 and not allowed, wrong_matches)
        common |= dict(zip(IDENTITY, map(float, found), strict=True))
    x, y, roll = (error / ARCSEC_RAD).tolist()
    return Outcome("solved", 1, 1, int(wrong), x, y, roll, nees, **common)


def error_and_nees(solution: Attitude, cam_from_lab: Floats) -> tuple[Floats, float]:
    """(3,) error rotation vector in camera axes, rad, and its NEES, NaN without a covariance."""
    estimate = quaternion.from_rotation(solution.cam_from_ref)
    error = quaternion.to_rotvec(
        quaternion.multiply(estimate, quaternion.inverse(cam_from_lab))
    )
    covariance = solution.covariance_rad2
    return error, nan if covariance is None else float(
        error @ np.linalg.solve(covariance, error)
    )


# Identity of the lights.


def claimed_image_px(
    lab: Lab,
    estimator: factory.Estimator,
    match: StarMatch,
    lab_from_body: Floats,
    cam_from_lab: Floats,
) -> Floats:
    """(K, 2) true images at mid-exposure of the stars or LEDs with which the tracker matched its lights.

    They are projected with the true attitude and the true optics. LEDs are at their true places. Stars have the
    directions of the tracker's catalog, which is independent of the simulated sky and may have merged a double.
    """
    if isinstance(estimator, DomeTracker):
        rows = rows_of(estimator.leds.id[match.star], lab.camera.sources.id)
        camera_m = quaternion.apply(lab_from_body, lab.camera.mount.camera_body_m)
        offset_lab = lab.camera.sources.xyz[rows] - camera_m
    else:
        assert isinstance(estimator, StarTracker)
        offset_lab = estimator.stars.vectors[match.star]
    return lab.camera.optics.project(offset_lab @ quaternion.to_matrix(cam_from_lab).T)


def count_wrong_matches(
    observed_px: Floats, claimed_px: Floats, lights: TrueLights, reach_px: float
) -> int:
    """Number of K lights that are matched with a star or LED whose true image is farther than reach_px from them.

    The mean image of a pulsed LED, or under a rolling shutter, is displaced from that at mid-exposure. The displacement
    of the light nearest to the claimed image is added to it.

    Parameters
    ----------
    observed_px
        (K, 2) centroids
    claimed_px
        (K, 2) true images at mid-exposure of the matched stars or LEDs
    """
    if not len(lights.xy_px):
        return len(observed_px)
    nearest, _ = nearest_light(claimed_px, lights.xy_px)
    expected_px = claimed_px + lights.flux_xy_px[nearest] - lights.xy_px[nearest]
    # NaN counts as wrong.
    return int(np.sum(~(lengths(observed_px - expected_px) <= reach_px)))


def distances_px(xy_px: Floats, others_px: Floats, reach_px: float) -> Floats:
    """(K,) distances of positions from the nearest other one, of those within reach_px of it."""
    _, distance_px = nearest_light(xy_px, others_px)
    return distance_px[distance_px <= reach_px]


@jit
def nearest_light(xy_px: Floats, lights_px: Floats) -> tuple[Ints, Floats]:
    """(K,) row of the light nearest to each position, and its distance; 0 and infinity without lights."""
    nearest = np.zeros(len(xy_px), np.int64)
    distance_px = np.full(len(xy_px), math.inf)
    for k in range(len(xy_px)):
        least_px2 = math.inf
        for n in range(len(lights_px)):
            away_px2 = (xy_px[k, 0] - lights_px[n, 0]) ** 2 + (
                xy_px[k, 1] - lights_px[n, 1]
            ) ** 2
            if away_px2 < least_px2:  # never for a position behind the camera, which is NaN
                nearest[k] = n
                least_px2 = away_px2
        distance_px[k] = math.sqrt(least_px2)
    return nearest, distance_px


# Attitudes.


def directions(lab: Lab, lab_from_body: Floats, cam_from_lab: Floats) -> dict[str, float]:
    """The columns DIRECTION of an attitude."""
    values = dict(zip(DIRECTION[:4], lab_from_body.tolist(), strict=True))
    dome = lab.scene.dome
    turn = lab_from_body if dome else quaternion.inverse(cam_from_lab)
    x, y, z = quaternion.apply(turn, UP).tolist()
    around_deg = math.degrees(math.atan2(y, x)) % 360
    across = math.hypot(x, y)
    if dome:
        tilt_deg = math.degrees(math.atan2(across, z))
        return values | {"body_tilt_deg": tilt_deg, "body_azimuth_deg": around_deg}
    dec_deg = math.degrees(math.atan2(z, across))
    return values | {"boresight_ra_deg": around_deg, "boresight_dec_deg": dec_deg}


# Flights.


def angles_arcsec(lab_from_other: Rotation | None, log: Telemetry, settle_s: float) -> Floats:
    """(K,) angle between another attitude and the true one at the ticks from settle_s on; empty without the other."""
    error_deg = attitude_error_deg(lab_from_other, log.lab_from_body)
    return np.empty(0) if error_deg is None else 3600 * error_deg[log.t_s >= settle_s]


def summarize_flight(log: Telemetry, outcomes: list[Outcome], settle_s: float) -> Outcome:
    """Outcome of a flight trial from the outcomes of its frames and, with a filter, from its error at every tick."""

    def known(name: str) -> Floats:
        """The values of the frames that have one."""
        values = np.array([getattr(one, name) for one in outcomes], dtype=float)
        return values[np.isfinite(values)]

    solved = [one for one in outcomes if one.solved]
    last = outcomes[-1] if outcomes else Outcome("no frame after it settled")
    x, y, roll = (rms(known(name)) for name in ("x_arcsec", "y_arcsec", "roll_arcsec"))
    good = known("solved") > known("wrong")
    error = angles_arcsec(log.lab_from_filter, log, settle_s)
    pointing = angles_arcsec(log.lab_from_ref, log, settle_s)
    quarter = len(error) // 4
    limit = metrics.WRONG_RAD / ARCSEC_RAD
    worst = worst_frame(outcomes)
    return Outcome(
        "solved" if solved else last.status,
        len(outcomes),
        len(solved),
        int(known("wrong").sum()),
        x,
        y,
        roll,
        mean([one.nees for one in solved]),
        min(known("stars").tolist(), default=nan),
        availability=mean(error < limit if len(error) else good),
        filter_arcsec=rms(error),
        filter_worst_arcsec=max(error.tolist(), default=nan),
        drift_arcsec=rms(error[-quarter:]) - rms(error[:quarter]) if quarter else nan,
        pointing_arcsec=rms(pointing),
        pointing_worst_arcsec=max(pointing.tolist(), default=nan),
        saturated_s=saturated_s(log, settle_s) if len(pointing) else nan,
        ambiguous=int(known("ambiguous").sum()),
        **{
            name: sum(getattr(one, name) for one in outcomes) if outcomes else nan
            for name in IDENTITY
        },
        centroid_px=rms(known("centroid_px")),
        **{name: mean(known(name)) for name in MEANS},
        exposure_ms=last.exposure_ms,
        **{name: getattr(worst, name) for name in DIRECTION},
    )


def worst_frame(outcomes: list[Outcome]) -> Outcome:
    """The worst frame of a flight; FAILED if there is no frame.

    It is a misidentified or wrong one, else the first without a solution, else the one with the largest error.
    """

    def badness(one: Outcome) -> tuple[bool, bool, float]:
        error = math.hypot(one.x_arcsec, one.y_arcsec, one.roll_arcsec)
        return (
            bool(one.wrong or one.misidentified == 1),
            not one.solved,
            0.0 if math.isnan(error) else error,
        )

    return max(outcomes, key=badness, default=FAILED)


def rms(values: Floats) -> float:
    """Root mean square; NaN without values."""
    return float(metrics.rms(values)) if len(values) else nan


def mean(values: list[Any] | Array) -> float:
    """Mean; NaN without values."""
    return float(np.mean(values)) if len(values) else nan
