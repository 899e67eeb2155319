"""Run one trial: draw a random attitude, simulate centroids or a frame (or a complete run), solve, and score.

A trial depends only on its recipe, design point and seed, not on the order of trials or the worker.
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
from skysim.camera.render import Poses, follow, in_view
from skysim.core import quaternion
from skysim.core.paths import ROOT
from skysim.core.types import Floats, Frame, Sources, Trajectory, Truth
from skysim.core.units import ARCSEC_RAD
from skysim.dynamics import multibody
from skysim.experiments.study.factors import Settings
from skysim.experiments.study.plan import CentroidTrial, FlightTrial, FrameTrial, TrialSpec
from skysim.experiments.study.setups import Setup, code_version, prepared_setup, seed_of
from skysim.results import metrics
from skysim.scene.light import DomeConfig
from skysim.scene.scene import Scene
from skysim.simulation import exposure, run, testbed
from skysim.simulation.testbed import SPARE_S, Testbed
from skysim.tracking import factory

KNOTS = 9  # samples of a frame trial's trajectory
ANY_TIME_S = np.array([0.0, 1.0])  # the pose does not change, so the times are arbitrary


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a trial. For a flight trial, errors are RMS over the solved frames and counts are sums unless noted.

    status   : "solved", the reason why there is no attitude, or "failed" if the trial raised an exception
    frames, solved, wrong : number of frames, of solved frames, and of solutions more than ten arcminutes off
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


def work(recipe: TrialSpec, segments: tuple[Segment, ...]) -> list[Row]:
    """Run all trials of some segments, in order."""
    return [
        one(recipe, segment, segment.first + n, replicate)
        for segment in segments
        for n, replicate in enumerate(segment.replicates)
    ]


def one(recipe: TrialSpec, segment: Segment, trial: int, replicate: int) -> Row:
    """Run one trial; an exception is stored in its row as a traceback."""
    seed = seed_of(recipe, segment.point, replicate)
    scene, outcome, error, begin = "", FAILED, None, time.perf_counter()
    try:
        ready = prepared_setup(recipe, segment.settings)
        scene, begin = ready.scene_hash, time.perf_counter()
        outcome = TRIALS[ready.trial.kind](ready, seed)
    except Exception:
        error = traceback.format_exc().replace(f"{ROOT}/", "")  # independent of the installation path
    spent = time.perf_counter() - begin
    return Row(trial, segment.point, replicate, seed, scene, code_version(), outcome, error, spent)


def centroids(ready: Setup, seed: int) -> Outcome:
    """Centroid trial: random attitude, noisy true detections and false ones; identified and solved."""
    lab_from_body, xy_px, seen = sight(ready, seed)
    answer = ready.estimator.solve_centroids(seen)
    return scored(answer, cam_from_lab_wxyz(ready.lab, lab_from_body), len(xy_px), len(seen))


def sight(ready: Setup, seed: int) -> tuple[Rotation, Floats, Centroids]:
    """Inputs of a centroid trial: lab_from_body, (N, 2) true pixel positions, and the simulated detections."""
    trial, (where, noise) = ready.trial, streams(ready, seed)
    assert isinstance(trial, CentroidTrial)
    lab_from_body = attitude(ready, where)
    xy_px, electrons = lights(ready.lab, lab_from_body)
    return lab_from_body, xy_px, spoilt(trial, xy_px, electrons, ready.lab.scene, noise)


def streams(ready: Setup, seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Random generators of a trial's attitude and of its noise; `noise_seed` changes the noise only."""
    trial = ready.trial
    assert isinstance(trial, CentroidTrial | FrameTrial)
    return np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1, trial.noise_seed])


def frames(ready: Setup, seed: int) -> Outcome:
    """Frame trial: random attitude, one rendered frame, solved."""
    frame, truth, streak_px = shot(ready, seed)
    return answered(factory.solve_frame(ready.estimator, frame, streak_px), truth)


def answered(report: Report, truth: Truth) -> Outcome:
    """Outcome of a frame from the tracker's report and the truth."""
    truly = quaternion.of(truth.cam_from_lab)
    return scored(report.attitude, truly, len(truth.seen.id), len(report.centroids))


def flight(ready: Setup, seed: int) -> Outcome:
    """Flight trial: the complete scene with another seed."""
    trial = ready.trial
    assert isinstance(trial, FlightTrial)
    lab = run.simulate_motion(reseeded(ready.lab, seed))
    came = [one for t_s, one in scores(lab, ready.estimator) if t_s >= trial.settle_s]
    return summed(lab, came, trial.settle_s)


def scores(lab: Testbed, estimator: factory.Estimator) -> Iterator[tuple[float, Outcome]]:
    """Mid-exposure time and outcome of every frame.

    Frames already solved during the motion simulation (`lab.reports`) are not rendered again.
    """
    if not lab.reports:
        for shot in run.run(lab, estimator):
            yield shot.truth.t_s, answered(shot.report, shot.truth)
    for index, answer in lab.reports.items():
        when = testbed.window(lab.scene, index, lab.exposures_s[index])
        t_s = when.middle_s(lab.scene.camera.height_px)
        lab_from_body = lab.trajectory.at(t_s)
        truly, stars = cam_from_lab_wxyz(lab, lab_from_body), len(lights(lab, lab_from_body)[0])
        yield t_s, scored(answer.attitude, truly, stars, len(answer.centroids))


TRIALS: dict[str, Callable[[Setup, int], Outcome]] = {
    "centroids": centroids,
    "frames": frames,
    "flight": flight,
}


# Parts of trials.


def attitude(ready: Setup, rng: np.random.Generator) -> Rotation:
    """Random lab_from_body.

    Under a dome: tilt uniform in solid angle within `tilt_deg`, tilt direction and yaw uniform. Otherwise: boresight
    uniform over the sphere within `dec_deg`, roll uniform.
    """
    trial = ready.trial
    assert isinstance(trial, CentroidTrial | FrameTrial)
    first, last = rng.uniform(0, 2 * math.pi, 2)
    # A uniform cosine of the tilt, or sine of the declination, is uniform in solid angle.
    if isinstance(ready.lab.scene.light, DomeConfig):
        low, high = trial.tilt_deg if isinstance(trial.tilt_deg, tuple) else (trial.tilt_deg,) * 2
        cosine = rng.uniform(math.cos(math.radians(high)), math.cos(math.radians(low)))
        return quaternion.rotation(zyz(first, math.acos(min(cosine, 1.0)), last - first))
    low, high = (math.sin(math.radians(dec)) for dec in trial.dec_deg)
    zenith = math.acos(min(max(rng.uniform(low, high), -1.0), 1.0))
    lab_from_cam = zyz(first, zenith, last)
    cam_from_body = quaternion.of(ready.lab.mount.cam_from_body)
    return quaternion.rotation(quaternion.multiply(lab_from_cam, cam_from_body))


def zyz(first_rad: float, second_rad: float, third_rad: float) -> Floats:
    """(4,) wxyz of Rz(first) Ry(second) Rz(third), which rotates z to azimuth `first` and zenith angle `second`."""
    half, both, unlike = second_rad / 2, (first_rad + third_rad) / 2, (first_rad - third_rad) / 2
    sine, cosine = math.sin(half), math.cos(half)
    return np.array(
        [cosine * math.cos(both), -sine * math.sin(unlike), sine * math.cos(unlike), cosine * math.sin(both)]
    )


def cam_from_lab_wxyz(lab: Testbed, lab_from_body: Rotation) -> Floats:
    """(4,) quaternion wxyz of cam_from_lab."""
    cam_from_body = quaternion.of(lab.mount.cam_from_body)
    return quaternion.multiply(cam_from_body, quaternion.inverse(quaternion.of(lab_from_body)))


def lights(lab: Testbed, lab_from_body: Rotation) -> tuple[Floats, Floats]:
    """(N, 2) pixel positions and (N,) photoelectrons of the visible sources whose center is on the detector.

    Occluded sources are left out.
    """
    R_lab_from_body = lab_from_body.as_matrix()
    R_cam_from_lab = lab.mount.cam_from_body.as_matrix() @ R_lab_from_body.T
    here = Poses(R_cam_from_lab[None], (R_lab_from_body @ lab.mount.camera_body_m)[None])
    near = lab.sources.take(in_view(lab.sources, lab.optics, here))
    paths, _, _ = follow(near, lab.optics, here, ANY_TIME_S, lab.emitter)
    xy_px, (width_px, height_px) = paths.xy_px[0], lab.canvas.shape[::-1]
    x, y = xy_px.T
    seen = np.flatnonzero((x > -0.5) & (y > -0.5) & (x < width_px - 0.5) & (y < height_px - 0.5))
    if lab.obstacles is not None:
        seen = seen[~multibody.hidden(lab.obstacles, lab_from_body, near.take(seen))]
    electrons = paths.rate_e_s[0] * lit_share(near) * lab.scene.exposure.time_s
    return xy_px[seen], electrons[seen]


def lit_share(sources: Sources) -> Floats:
    """(N,) duty cycle of each source, at most 1."""
    return np.minimum(sources.on_s / sources.period_s, 1.0)


def spoilt(
    trial: CentroidTrial, xy_px: Floats, electrons: Floats, scene: Scene, rng: np.random.Generator
) -> Centroids:
    """Simulated detections, brightest first: some true sources missed, all with noise, false detections added.

    The flux of a false detection is that of a random true source, including those that `lights` leaves out.
    """
    # Draw noise for all sources, also the missing ones, so that the stream does not depend on which are missing.
    kept = np.flatnonzero(rng.random(len(xy_px)) >= trial.missing)
    flux = electrons * 10 ** (0.4 * trial.magnitude_sigma * rng.standard_normal(len(xy_px)))
    xy_px = xy_px + trial.noise_px * rng.standard_normal(xy_px.shape)
    kept = kept[np.argsort(-flux[kept], kind="stable")][: trial.lights]
    false = trial.false_lights + round(len(kept) * trial.false_share / (1 - trial.false_share))
    if not false:
        return Centroids(xy_px[kept], np.full(len(kept), trial.noise_px), flux[kept])
    strays_px = rng.random((false, 2)) * [scene.camera.width_px, scene.camera.height_px] - 0.5
    bright = flux[rng.integers(len(flux), size=false)] if len(flux) else rng.random(false) + 1.0
    everything = np.concatenate([flux[kept], bright])
    order = np.argsort(-everything, kind="stable")
    sigma_px = np.full(len(order), trial.noise_px)
    return Centroids(np.concatenate([xy_px[kept], strays_px])[order], sigma_px, everything[order])


def shot(ready: Setup, seed: int) -> tuple[Frame, Truth, tuple[float, float] | None]:
    """Frame of a frame trial, its truth and, with a gyro, the streak vector (dx, dy) in pixels at the image center."""
    trial, (where, noise) = ready.trial, streams(ready, seed)
    assert isinstance(trial, FrameTrial)
    lab = reseeded(ready.lab, int(noise.integers(2**62)))
    middle, towards = attitude(ready, where), where.uniform(0, 2 * math.pi)
    rate_cam = math.radians(trial.rate_deg_s) * np.array([math.cos(towards), math.sin(towards), 0.0])
    rate_body = lab.mount.cam_from_body.inv().apply(rate_cam)
    when, rows = testbed.window(lab.scene, 0), lab.scene.camera.height_px
    # A trajectory at constant rate around the exposure, with the drawn attitude at mid-exposure.
    t_s = np.linspace(when.open_s - SPARE_S, when.close_s(rows) + SPARE_S, KNOTS)
    turned = Rotation.from_rotvec(np.outer(t_s - when.middle_s(rows), rate_body))
    path = Trajectory(t_s, middle * turned, np.tile(rate_body, (KNOTS, 1)))
    frame, truth = exposure.render_frame(replace(lab, trajectory=path), 0)
    reach_px = when.exposure_s * lab.scene.camera.focal_px
    # For a star on the boresight: d(x / z)/dt = -w_y, d(y / z)/dt = w_x.
    return frame, truth, (-rate_cam[1] * reach_px, rate_cam[0] * reach_px) if trial.gyro else None


def reseeded(lab: Testbed, seed: int) -> Testbed:
    """The same hardware with another seed for noise, jitter and IMU."""
    return replace(lab, scene=lab.scene.model_copy(update={"seed": seed}))


def scored(answer: Attitude, cam_from_lab_wxyz: Floats, stars: int, detected: int) -> Outcome:
    """Outcome of one solution compared with the truth, a quaternion wxyz.

    Quaternions are NumPy arrays because SciPy's Rotation would take a tenth of a trial's time.
    """
    matched = len(answer.match.observed) if answer.match else 0
    if answer.cam_from_ref is None:
        return Outcome(answer.status, 1, stars=stars, detected=detected, matched=matched)
    estimate = quaternion.of(answer.cam_from_ref)
    off = quaternion.to_rotvec(quaternion.multiply(estimate, quaternion.inverse(cam_from_lab_wxyz)))
    nees = (
        math.nan
        if answer.covariance_rad2 is None
        else float(off @ np.linalg.solve(answer.covariance_rad2, off))
    )
    wrong = int(math.hypot(*off) > metrics.WRONG_RAD)
    x, y, roll = (off / ARCSEC_RAD).tolist()
    return Outcome("solved", 1, 1, wrong, x, y, roll, nees, stars, detected, matched)


def summed(lab: Testbed, came: list[Outcome], settle_s: float) -> Outcome:
    """Outcome of a flight trial from the outcomes of its frames and, with a filter, from its error at every tick."""
    solved = [outcome for outcome in came if outcome.solved]
    x, y, roll = (
        _rms([getattr(one, name) for one in solved]) for name in ("x_arcsec", "y_arcsec", "roll_arcsec")
    )
    good = [bool(one.solved and not one.wrong) for one in came]
    off = filter_off_arcsec(lab, settle_s)
    quarter = len(off) // 4
    limit = metrics.WRONG_RAD / ARCSEC_RAD
    return Outcome(
        "solved" if solved else came[-1].status if came else "no frame after it settled",
        len(came),
        len(solved),
        sum(one.wrong for one in came),
        x,
        y,
        roll,
        _mean([one.nees for one in solved]),
        min((one.stars for one in came), default=math.nan),
        _mean([one.detected for one in came]),
        _mean([one.matched for one in came]),
        _mean(off < limit) if len(off) else _mean(good),
        _rms(off),
        float(off.max(initial=-np.inf)) if len(off) else math.nan,
        _rms(off[-quarter:]) - _rms(off[:quarter]) if quarter else math.nan,
    )


def filter_off_arcsec(lab: Testbed, settle_s: float) -> Floats:
    """(K,) angular error of the filter at the ticks from `settle_s` on; empty without a filter."""
    log = lab.log
    if log.lab_from_filter is None:
        return np.empty(0)
    off = (log.lab_from_filter * log.lab_from_body.inv()).magnitude() / ARCSEC_RAD
    return np.asarray(off[log.t_s >= settle_s])


def _rms(values: list[float] | NDArray[Any]) -> float:
    return float(metrics.rms(np.asarray(values))) if len(values) else math.nan


def _mean(values: list[Any] | NDArray[Any]) -> float:
    return float(np.mean(values)) if len(values) else math.nan
