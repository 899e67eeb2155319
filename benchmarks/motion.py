"""Whether the covariance is honest while the camera moves: long streaks, angular acceleration, and tracking mode.

Errors are those against the mean attitude of the exposure. NEES is 3 for an honest covariance. A frame is wrong if its
error is above 10', or above 30" and beyond five of its sigmas.

- Streaks: single frames at a constant rate about a random axis, mostly perpendicular to the boresight.
- Acceleration: single frames whose rate changes along their axis.
- Tracking: sequences that accelerate from rest, followed in tracking mode without a gyro; the time of its frames is
  compared with that of the frames that it has to solve lost in space.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.rolling import Work, row
from estimator.core.errors import ImageError
from estimator.core.types import Attitude
from estimator.trackers.tracking_mode import Health, TrackingMode
from skysim.core.types import Truth
from skysim.experiments.study.execution.trials import constant_acceleration
from skysim.results import metrics
from skysim.simulation.exposure import render_frame
from skysim.simulation.lab import Lab
from skysim.tracking import factory

RATES_DEG_S = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 11.0, 12.0)
ACCELERATIONS_DEG_S2 = (2.0, 5.0)
TRACKED_DEG_S2 = (0.0, 5.0, 27.0, 54.0)
FRAMES = 60
SEQUENCE = 6  # frames of a sequence
NEES_RANGE = 2.5, 3.5
LONG = {"exposure.time": "100 ms"}
FIVE_MEGAPIXELS = {
    "camera.preset": "imx250",
    "camera.focal_length": "25 mm",
    "tracker.limit_mag": "6",
}
STILLS = (
    Work("SHEFEX, 100 ms", "shefex2", "80 us", FRAMES, LONG),
    Work("IMX250, 25 mm, 100 ms", "shefex2", "20 us", FRAMES, FIVE_MEGAPIXELS | LONG),
)
SEQUENCES = (
    Work("SHEFEX", "shefex2", "80 us", FRAMES),
    Work("SHEFEX, sigma 0.3 px", "shefex2", "80 us", FRAMES, {"camera.psf.sigma_px": "0.3"}),
)


class Score(NamedTuple):
    """NEES of a solved frame, and whether it is wrong."""

    nees: float
    wrong: bool


def measure(count: int = FRAMES, seed: int = 51) -> list[dict[str, Any]]:
    """NEES and wrong answers of `count` frames for each camera, rate and acceleration."""
    rows = []
    for work in STILLS:
        lab = work.lab(False)
        for rate in RATES_DEG_S:
            rows += _stills(f"{work.name}, {rate:g} deg/s", lab, (rate, 0.0), count, seed)
        for acceleration in ACCELERATIONS_DEG_S2:
            for rate in (2.0, 8.0):
                name = f"{work.name}, {rate:g} deg/s, {acceleration:g} deg/s2"
                rows += _stills(name, lab, (rate, acceleration), count, seed)
    for work in SEQUENCES:
        lab = Work(
            work.name, work.scene, work.row_time, count, work.changes | _frames(SEQUENCE)
        ).lab(False)
        for acceleration in TRACKED_DEG_S2:
            name = f"{work.name}, tracking, {acceleration:g} deg/s2"
            rows += _tracked(name, lab, acceleration, max(count // SEQUENCE, 1), seed)
    return rows


def _frames(count: int) -> dict[str, str]:
    """Changes of a scene with this many frames."""
    return {"exposure.first": "0 s", "exposure.frames": str(count)}


def _stills(
    name: str, lab: Lab, motion_deg: tuple[float, float], count: int, seed: int
) -> list[dict[str, Any]]:
    """Rows of single frames at a rate, deg/s, and an acceleration, deg/s2."""
    scores = []
    for n in range(count):
        frame, truth, tracker = _moving(lab, motion_deg, 1, np.random.default_rng([seed, n]))[
            0
        ]
        score = scored(factory.solve_frame(tracker, frame).attitude, truth)
        scores += [score] if score else []
    return _rows(name, scores, count)


def _moving(
    lab: Lab, motion_deg: tuple[float, float], frames: int, rng: np.random.Generator
) -> list[Any]:
    """Frames with their truths and tracker; the rate is that of the first frame, the axis random."""
    camera = lab.in_run(int(rng.integers(2**62))).camera
    scene = camera.scene
    middle = Rotation.random(rng=rng)
    axis = rng.standard_normal(3) * [1, 1, 0.2]
    body_from_cam = camera.mount.cam_from_body.inv()
    rate, acceleration = (
        body_from_cam.apply(np.radians(one) * axis / np.linalg.norm(axis))
        for one in motion_deg
    )
    last_rate = rate + acceleration * (frames - 1) / scene.exposure.rate_hz
    trajectory = constant_acceleration(scene, middle, last_rate, acceleration, frames - 1)
    tracker = factory.build_tracker(scene, camera.mount, camera.sources)
    return [(*render_frame(camera, trajectory, n), tracker) for n in range(frames)]


def scored(attitude: Attitude, truth: Truth) -> Score | None:
    """The score against the mean attitude of the exposure; None without a solution."""
    if attitude.cam_from_ref is None or attitude.covariance_rad2 is None:
        return None
    mean = truth.mean_cam_from_lab
    nees = metrics.normalized_error_squared(
        attitude.cam_from_ref, mean, attitude.covariance_rad2
    )
    error_rad = float((attitude.cam_from_ref * mean.inv()).magnitude())
    return Score(nees, metrics.is_wrong(error_rad, nees))


def _tracked(
    name: str, lab: Lab, acceleration_deg_s2: float, count: int, seed: int
) -> list[dict[str, Any]]:
    """Rows of sequences in tracking mode."""
    scores = []
    seconds: dict[bool, list[float]] = {True: [], False: []}
    for n in range(count):
        rng = np.random.default_rng([seed, n])
        shots = _moving(lab, (0.0, acceleration_deg_s2), SEQUENCE, rng)
        follower = TrackingMode(shots[0][2])
        for frame, truth, _ in shots:
            begin_s = time.perf_counter()
            try:
                report = follower.solve(
                    frame.image_dn, frame.t_mid_s, exposure_s=frame.exposure_s
                )
            except ImageError:
                continue
            lost = bool(report.health & Health.SEARCHED)
            seconds[lost].append(time.perf_counter() - begin_s)
            score = scored(report.attitude, truth)
            scores += [score] if score else []
    rows = _rows(name, scores, count * SEQUENCE)
    if seconds[False]:
        tracked_ms, lost_ms = (
            1e3 * float(np.median(seconds[lost])) for lost in (False, True)
        )
        rows.append(
            row(
                f"{name}: tracked frame",
                tracked_ms,
                "ms",
                None,
                lost_ms,
                tracked_ms < lost_ms,
            )
        )
    return rows


def _rows(name: str, scores: list[Score], count: int) -> list[dict[str, Any]]:
    """Rows of solved and wrong shares and of the mean NEES."""
    wrong = sum(score.wrong for score in scores)
    rows = [
        row(f"{name}: solved", 100 * len(scores) / count, "%", None, None, None),
        row(f"{name}: wrong", wrong, "frames", None, 0, wrong == 0),
    ]
    if scores:
        nees = float(np.mean([score.nees for score in scores]))
        low, high = NEES_RANGE
        rows.append(row(f"{name}: NEES", nees, "", None, high, low <= nees <= high))
    return rows
