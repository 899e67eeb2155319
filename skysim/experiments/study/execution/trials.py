"""Run one trial: draw a random attitude, simulate centroids or a frame (or a complete run), solve, and score.

A trial depends only on its specification, design point and seed, not on the order of trials or the worker.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Report
from skysim.camera.render import Poses, image_tracks, in_view
from skysim.core import quaternion
from skysim.core.paths import ROOT
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Frame, Mount, Trajectory, Truth
from skysim.core.units import ARCSEC_RAD
from skysim.dynamics import multibody
from skysim.experiments.study.execution.setups import Setup, code_version, prepared_setup, seed_of
from skysim.experiments.study.factors import Settings
from skysim.experiments.study.plan import (
    AxisConfig,
    CentroidTrial,
    FlightTrial,
    FrameTrial,
    TrialSpec,
)
from skysim.results import metrics
from skysim.scene.light import DomeConfig
from skysim.scene.scene import Scene
from skysim.simulation import exposure, run
from skysim.simulation.testbed import MARGIN_S, Testbed, exposure_window
from skysim.tracking import factory

KNOTS = 9  # samples of a frame trial's trajectory
ANY_TIME_S = np.array([0.0, 1.0])  # the pose does not change, so the times are arbitrary


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a trial. For a flight trial, errors are RMS over the solved frames and counts are sums unless noted.

    status   : "solved", the reason why there is no attitude, or "failed" if the trial raised an exception
    frames, solved, wrong : number of frames, of solved frames, and of wrong solutions (`metrics.is_wrong`)
    x_arcsec, y_arcsec, roll_arcsec : error in camera axes, signed (RMS for a flight); NaN without a solution
    nees     : e^T P^-1 e with three degrees of freedom and the tracker's covariance P; mean for a flight
    stars    : true sources on the detector, minimum for a flight.  detected, matched : numbers, means for a flight
    availability : fraction of a flight's ticks with a filter error below ten arcminutes; without a filter, fraction
               of its frames solved correctly
    filter_arcsec, filter_worst_arcsec : angular error of a flight's filter, RMS and worst
    drift_arcsec : filter_arcsec of the last quarter of a flight minus that of the first quarter
    """

    status: str
    frames: int = 0
    solved: int = 0
    wrong: int = 0
    x_arcsec: float = math.nan
    y_arcsec: float = math.nan
    roll_arcsec: float = math.nan
    nees: float = math.nan
    stars: float = math.nan
    detected: float = math.nan
    matched: float = math.nan
    availability: float = math.nan
    filter_arcsec: float = math.nan
    filter_worst_arcsec: float = math.nan
    drift_arcsec: float = math.nan


FIELDS = tuple(field.name for field in fields(Outcome))
FAILED = Outcome("failed")


class Row(NamedTuple):
    """One trial as stored."""

    trial: int
    point: int
    replicate: int
    seed: int
    scene: str
    code: str
    outcome: Outcome
    error: str | None
    seconds: float


class Segment(NamedTuple):
    """Consecutive replicates of one point, starting with trial number `first`; chunks of these go to workers."""

    point: int
    settings: Settings
    first: int
    replicates: range


# Running trials.


def run_segments(spec: TrialSpec, segments: tuple[Segment, ...]) -> list[Row]:
    """Run all trials of some segments, in order."""
    return [
        run_trial(spec, segment, segment.first + n, replicate)
        for segment in segments
        for n, replicate in enumerate(segment.replicates)
    ]


def run_trial(spec: TrialSpec, segment: Segment, trial: int, replicate: int) -> Row:
    """Run one trial; an exception is stored in its row as a traceback."""
    seed = seed_of(spec, segment.point, replicate)
    scene, outcome, error, start_s = "", FAILED, None, time.perf_counter()
    try:
        setup = prepared_setup(spec, segment.settings)
        scene, start_s = setup.scene_hash, time.perf_counter()
        outcome = TRIALS[setup.trial.kind](setup, seed)
    except Exception:
        error = traceback.format_exc().replace(f"{ROOT}/", "")  # independent of the installation path
    seconds = time.perf_counter() - start_s
    return Row(trial, segment.point, replicate, seed, scene, code_version(), outcome, error, seconds)


def run_centroid_trial(setup: Setup, seed: int) -> Outcome:
    """Centroid trial: random attitude, noisy true detections and false ones; identified and solved."""
    lab_from_body, xy_px, detections = simulate_centroids(setup, seed)
    solution = setup.estimator.solve_centroids(detections)
    truth = cam_from_lab_wxyz(setup.testbed, lab_from_body)
    return score(solution, truth, len(xy_px), len(detections))


def simulate_centroids(setup: Setup, seed: int) -> tuple[Rotation, Floats, Centroids]:
    """Inputs of a centroid trial: lab_from_body, (N, 2) true pixel positions, and the simulated detections."""
    trial, (attitude_rng, noise) = setup.trial, streams(setup, seed)
    assert isinstance(trial, CentroidTrial)
    lab_from_body = random_attitude(setup, attitude_rng)
    xy_px, electrons = visible_sources(setup.testbed, lab_from_body)
    return lab_from_body, xy_px, simulate_detections(trial, xy_px, electrons, setup.testbed.scene, noise)


def streams(setup: Setup, seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Random generators of a trial's attitude and of its noise; `noise_seed` changes the noise only."""
    trial = setup.trial
    assert isinstance(trial, CentroidTrial | FrameTrial)
    return random_stream(seed, 0), random_stream(seed, 1, trial.noise_seed)


def run_frame_trial(setup: Setup, seed: int) -> Outcome:
    """Frame trial: random attitude, one rendered frame, solved."""
    frame, truth, streak_px = render_trial_frame(setup, seed)
    return frame_outcome(factory.solve_frame(setup.estimator, frame, streak_px), truth)


def frame_outcome(report: Report, truth: Truth) -> Outcome:
    """Outcome of a frame from the tracker's report and the truth."""
    cam_from_lab = quaternion.from_rotation(truth.cam_from_lab)
    return score(report.attitude, cam_from_lab, len(truth.sources.id), len(report.centroids))


def run_flight_trial(setup: Setup, seed: int) -> Outcome:
    """Flight trial: the complete scene with another seed, and with a random start if the trial has one."""
    trial = setup.trial
    assert isinstance(trial, FlightTrial)
    testbed = run.simulate_motion(flight_testbed(setup, seed))
    outcomes = [one for t_s, one in flight_outcomes(testbed, setup.estimator) if t_s >= trial.settle_s]
    return summarize_flight(testbed, outcomes, trial.settle_s)


def flight_testbed(setup: Setup, seed: int) -> Testbed:
    """The test bed of a flight trial at its start."""
    trial, testbed = setup.trial, setup.testbed.in_run(seed)
    assert isinstance(trial, FlightTrial)
    if trial.start is None:
        return testbed
    lab_from_body = random_attitude(setup, random_stream(seed, 0))
    return replace(testbed, trajectory=Trajectory.at_rest(lab_from_body, 1.0))


def flight_outcomes(testbed: Testbed, estimator: factory.Estimator) -> Iterator[tuple[float, Outcome]]:
    """Mid-exposure time and outcome of every frame.

    Frames already solved during the motion simulation (`testbed.reports`) are not rendered again.
    """
    if not testbed.reports:
        for result in run.run(testbed, estimator):
            yield result.truth.t_s, frame_outcome(result.report, result.truth)
    for index, report in testbed.reports.items():
        window = exposure_window(testbed.scene, index, testbed.exposures_s[index])
        t_s = window.middle_s(testbed.scene.camera.height_px)
        lab_from_body = testbed.trajectory.attitude_at(t_s)
        stars = len(visible_sources(testbed, lab_from_body)[0])
        yield t_s, score(report.attitude, cam_from_lab_wxyz(testbed, lab_from_body), stars, len(report.centroids))


TRIALS: dict[str, Callable[[Setup, int], Outcome]] = {
    "centroids": run_centroid_trial,
    "frames": run_frame_trial,
    "flight": run_flight_trial,
}


# Parts of trials.


def random_attitude(setup: Setup, rng: np.random.Generator) -> Rotation:
    """Random lab_from_body.

    Under a dome: tilt uniform in solid angle within `tilt_deg`, tilt direction and yaw uniform. Otherwise: boresight
    uniform over the sphere within `dec_deg`, roll uniform.
    """
    trial, testbed = setup.trial, setup.testbed
    attitudes = trial.start if isinstance(trial, FlightTrial) else trial
    assert attitudes is not None
    first, last = rng.uniform(0, 2 * math.pi, 2)
    # A uniform cosine of the tilt, or sine of the declination, is uniform in solid angle.
    if isinstance(testbed.scene.light, DomeConfig):
        tilt_deg = attitudes.tilt_deg
        low, high = tilt_deg if isinstance(tilt_deg, tuple) else (tilt_deg,) * 2
        cosine = rng.uniform(math.cos(math.radians(high)), math.cos(math.radians(low)))
        return quaternion.to_rotation(zyz(first, math.acos(min(cosine, 1.0)), last - first))
    low, high = (math.sin(math.radians(dec)) for dec in attitudes.dec_deg)
    zenith = math.acos(min(max(rng.uniform(low, high), -1.0), 1.0))
    lab_from_cam = zyz(first, zenith, last)
    cam_from_body = quaternion.from_rotation(testbed.mount.cam_from_body)
    return quaternion.to_rotation(quaternion.multiply(lab_from_cam, cam_from_body))


def zyz(first_rad: float, second_rad: float, third_rad: float) -> Floats:
    """(4,) wxyz of Rz(first) Ry(second) Rz(third), which rotates z to azimuth `first` and zenith angle `second`."""
    half, sum_, difference = second_rad / 2, (first_rad + third_rad) / 2, (first_rad - third_rad) / 2
    sine, cosine = math.sin(half), math.cos(half)
    x, y = -sine * math.sin(difference), sine * math.cos(difference)
    return np.array([cosine * math.cos(sum_), x, y, cosine * math.sin(sum_)])


def cam_from_lab_wxyz(testbed: Testbed, lab_from_body: Rotation) -> Floats:
    """(4,) quaternion wxyz of cam_from_lab."""
    cam_from_body = quaternion.from_rotation(testbed.mount.cam_from_body)
    return quaternion.multiply(cam_from_body, quaternion.inverse(quaternion.from_rotation(lab_from_body)))


def visible_sources(testbed: Testbed, lab_from_body: Rotation) -> tuple[Floats, Floats]:
    """(N, 2) pixel positions and (N,) photoelectrons of the visible sources whose center is on the detector.

    Occluded sources are left out.
    """
    R_lab_from_body = lab_from_body.as_matrix()
    R_cam_from_lab = testbed.mount.cam_from_body.as_matrix() @ R_lab_from_body.T
    poses = Poses(R_cam_from_lab[None], (R_lab_from_body @ testbed.mount.camera_body_m)[None])
    near = testbed.sources.take(in_view(testbed.sources, testbed.optics, poses))
    tracks, _, _ = image_tracks(near, testbed.optics, poses, ANY_TIME_S, testbed.emitter)
    xy_px, (width_px, height_px) = tracks.xy_px[0], testbed.canvas.shape[::-1]
    x, y = xy_px.T
    visible = np.flatnonzero((x > -0.5) & (y > -0.5) & (x < width_px - 0.5) & (y < height_px - 0.5))
    if testbed.obstacles is not None:
        visible = visible[~multibody.occluded(testbed.obstacles, lab_from_body, near.take(visible))]
    duty_cycle = np.minimum(near.on_s / near.period_s, 1.0)
    electrons = tracks.rate_e_s[0] * duty_cycle * testbed.scene.exposure.time_s
    return xy_px[visible], electrons[visible]


def simulate_detections(
    trial: CentroidTrial, xy_px: Floats, electrons: Floats, scene: Scene, rng: np.random.Generator
) -> Centroids:
    """Simulated detections, brightest first: some true sources missed, all with noise, false detections added.

    The flux of a false detection is that of a random true source, including those that `visible_sources` leaves out.
    """
    # Draw noise for all sources, also the missing ones, so that the stream does not depend on which are missing.
    detected = np.flatnonzero(rng.random(len(xy_px)) >= trial.missing)
    flux = electrons * 10 ** (0.4 * trial.magnitude_sigma * rng.standard_normal(len(xy_px)))
    xy_px = xy_px + trial.noise_px * rng.standard_normal(xy_px.shape)
    detected = detected[np.argsort(-flux[detected], kind="stable")][: trial.lights]
    false = trial.false_lights + round(len(detected) * trial.false_share / (1 - trial.false_share))
    if not false:
        return Centroids(xy_px[detected], np.full(len(detected), trial.noise_px), flux[detected])
    false_px = rng.random((false, 2)) * [scene.camera.width_px, scene.camera.height_px] - 0.5
    false_flux = flux[rng.integers(len(flux), size=false)] if len(flux) else rng.random(false) + 1.0
    all_flux = np.concatenate([flux[detected], false_flux])
    order = np.argsort(-all_flux, kind="stable")
    sigma_px = np.full(len(order), trial.noise_px)
    return Centroids(np.concatenate([xy_px[detected], false_px])[order], sigma_px, all_flux[order])


def render_trial_frame(setup: Setup, seed: int) -> tuple[Frame, Truth, tuple[float, float] | None]:
    """Frame of a frame trial, its truth and, with a gyro, the streak vector (dx, dy) in pixels at the image center."""
    trial, (attitude_rng, noise) = setup.trial, streams(setup, seed)
    assert isinstance(trial, FrameTrial)
    testbed = setup.testbed.in_run(int(noise.integers(2**62)))
    middle = random_attitude(setup, attitude_rng)
    axis_cam = rate_axis(trial.rate_axis, attitude_rng.uniform(0, 2 * math.pi), testbed.mount)
    rate_cam = math.radians(trial.rate_deg_s) * axis_cam
    rate_body = testbed.mount.cam_from_body.inv().apply(rate_cam)
    frame, truth = exposure.render_frame(
        replace(testbed, trajectory=constant_rate(testbed.scene, middle, rate_body)), 0
    )
    streak_px = exposure_window(testbed.scene, 0).exposure_s * testbed.scene.camera.focal_px
    # For a star on the boresight: d(x / z)/dt = -w_y, d(y / z)/dt = w_x.
    return frame, truth, (-rate_cam[1] * streak_px, rate_cam[0] * streak_px) if trial.gyro else None


def rate_axis(axis: str | AxisConfig, azimuth_rad: float, mount: Mount) -> Floats:
    """(3,) unit axis of rotation in camera axes; azimuth_rad is that of one perpendicular to the boresight."""
    if not isinstance(axis, AxisConfig):
        boresight = np.array([0.0, 0.0, 1.0])
        return boresight if axis == "boresight" else np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
    vector = mount.cam_from_body.apply(axis.body) if axis.body is not None else np.array(axis.camera, dtype=float)
    return np.asarray(vector / np.linalg.norm(vector))


def constant_rate(scene: Scene, middle: Rotation, rate_body: Floats) -> Trajectory:
    """A trajectory around the first frame's exposure: lab_from_body `middle` at mid-exposure, and a constant rate."""
    window, rows = exposure_window(scene, 0), scene.camera.height_px
    t_s = np.linspace(window.open_s - MARGIN_S, window.close_s(rows) + MARGIN_S, KNOTS)
    rotation = Rotation.from_rotvec(np.outer(t_s - window.middle_s(rows), rate_body))
    return Trajectory(t_s, middle * rotation, np.tile(rate_body, (KNOTS, 1)))


def score(solution: Attitude, cam_from_lab_wxyz: Floats, stars: int, detected: int) -> Outcome:
    """Outcome of one solution compared with the truth, a quaternion wxyz.

    Quaternions are NumPy arrays because SciPy's Rotation would take a tenth of a trial's time.
    """
    matched = len(solution.match.observed) if solution.match else 0
    if solution.cam_from_ref is None:
        return Outcome(solution.status, 1, stars=stars, detected=detected, matched=matched)
    estimate = quaternion.from_rotation(solution.cam_from_ref)
    error = quaternion.to_rotvec(quaternion.multiply(estimate, quaternion.inverse(cam_from_lab_wxyz)))
    covariance = solution.covariance_rad2
    nees = math.nan if covariance is None else float(error @ np.linalg.solve(covariance, error))
    wrong = int(metrics.is_wrong(math.hypot(*error), math.inf if covariance is None else nees))
    x, y, roll = (error / ARCSEC_RAD).tolist()
    return Outcome("solved", 1, 1, wrong, x, y, roll, nees, stars, detected, matched)


def summarize_flight(testbed: Testbed, outcomes: list[Outcome], settle_s: float) -> Outcome:
    """Outcome of a flight trial from the outcomes of its frames and, with a filter, from its error at every tick."""
    solved = [outcome for outcome in outcomes if outcome.solved]
    x, y, roll = (_rms([getattr(one, name) for one in solved]) for name in ("x_arcsec", "y_arcsec", "roll_arcsec"))
    good = [bool(one.solved and not one.wrong) for one in outcomes]
    # (K,) angular error of the filter at the ticks from settle_s on; empty without a filter.
    log, error = testbed.log, np.empty(0)
    if log.lab_from_filter is not None:
        error = (log.lab_from_filter * log.lab_from_body.inv()).magnitude()[log.t_s >= settle_s] / ARCSEC_RAD
    quarter = len(error) // 4
    limit = metrics.WRONG_RAD / ARCSEC_RAD
    return Outcome(
        "solved" if solved else outcomes[-1].status if outcomes else "no frame after it settled",
        len(outcomes),
        len(solved),
        sum(one.wrong for one in outcomes),
        x,
        y,
        roll,
        _mean([one.nees for one in solved]),
        min((one.stars for one in outcomes), default=math.nan),
        _mean([one.detected for one in outcomes]),
        _mean([one.matched for one in outcomes]),
        _mean(error < limit) if len(error) else _mean(good),
        _rms(error),
        float(error.max(initial=-np.inf)) if len(error) else math.nan,
        _rms(error[-quarter:]) - _rms(error[:quarter]) if quarter else math.nan,
    )


def _rms(values: list[float] | NDArray[Any]) -> float:
    return float(metrics.rms(np.asarray(values))) if len(values) else math.nan


def _mean(values: list[Any] | NDArray[Any]) -> float:
    return float(np.mean(values)) if len(values) else math.nan
