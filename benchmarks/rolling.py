"""Attitude under a rolling shutter against the same frames with a global one, by rate: stars and a dome.

Every frame is rendered twice with the same seeds, with the camera's rolling shutter and with a global one, at a random
attitude and a constant rate about a random axis, of stars mostly perpendicular to the boresight. Each frame of each
rate has attitude, noise and survey of its own, so that the means over rates are of independent frames. The tracker gets
the rate from a gyro (0.01 deg/s about each axis) or takes it from the frame. NEES is 3 for an honest covariance; errors
are compared over the frames that both solve. A frame without a gyro must tell three unknowns more: its errors are
compared with the Cramer-Rao bound of rows and streaks (median of the normalized error, 1 at the bound), and that bound
of the roll with what it were if the rate were known, which no tracker of one frame can better.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.rate import chords, covariance_of, error_gain, streak_factor
from estimator.attitude.rotation_fit import tangent_jacobian
from estimator.core.types import Attitude, RateEstimate
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats, Frame, Truth
from skysim.experiments.study.execution.trials import constant_acceleration
from skysim.results import metrics
from skysim.scene.loader import load
from skysim.simulation.exposure import render_frame
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking import factory

RATES_DEG_S = (0.0, 1.0, 2.0, 5.0, 10.0)
GYRO_RAD_S = np.radians(0.01)
ROLL_SHARE = 0.2  # of the boresight in a random axis, if stars are smeared: streaks are then nearly parallel
BAR_NEES = 0.3
BAR_ERROR = 1.2
CHI2_MEDIAN = 2.366  # of chi-square with three degrees of freedom: double stars do not count in a median
ONE_FRAME = {"exposure.first": "0 s", "exposure.frames": "1"}


@dataclass(frozen=True)
class Work:
    """A scene with a rolling shutter: how many frames at each rate, and the largest tilt of its vehicle.

    tilt_deg : None for any attitude
    """

    name: str
    scene: str
    row_time: str
    frames: int
    changes: dict[str, str] = field(default_factory=dict)
    tilt_deg: float | None = None

    def lab(self, rolling: bool) -> Lab:
        shutter = (
            f"{{kind: rolling, row_time: '{self.row_time}'}}" if rolling else "{kind: global}"
        )
        return build_lab(
            load(self.scene, ONE_FRAME | self.changes | {"camera.shutter": shutter})
        )


PHONE = {
    "camera.preset": "imx477",
    "camera.focal_length": "16 mm",
    "camera.f_number": "1.4",
    "exposure.time": "20 ms",
}
SURVEY = {"tracker.survey.lever_sigma": "0 mm", "tracker.survey.led_sigma": "0.02 mm"}
WORKS = (
    Work("SHEFEX", "shefex2", "80 us", 100, {"exposure.time": "50 ms"}),
    Work("IMX477, 16 mm", "shefex2", "28.57 us", 16, PHONE),
    Work("AFIT dome", "afit_simsat", "83 us", 60, SURVEY, 20.0),
)


class Solved(NamedTuple):
    """Errors of one frame: NEES, cross-boresight and roll in arcseconds; NaN if it was not solved.

    bound : NEES by the Cramer-Rao bound of the frame alone;  roll_ratio : bound of the roll, over that of a known rate
    """

    nees: float
    cross_arcsec: float
    roll_arcsec: float
    bound: float = np.nan
    roll_ratio: float = np.nan


NOT_SOLVED = Solved(np.nan, np.nan, np.nan)


def measure(
    works: tuple[Work, ...] = WORKS, rates_deg_s: tuple[float, ...] = RATES_DEG_S
) -> list[dict[str, Any]]:
    """NEES, error ratios and solved share of each scene, rate and source of the rate."""
    rows = []
    for work in works:
        labs = work.lab(True), work.lab(False)
        pooled: dict[str, list[tuple[Floats, Floats]]] = {}
        for n, rate_deg_s in enumerate(rates_deg_s):
            for mode, ours, peer in _compare(work, labs, rate_deg_s, n * work.frames):
                rows += _rows(f"{work.name}, {rate_deg_s:g} deg/s, {mode}", ours, peer)
                pooled.setdefault(mode, []).append((ours[:, 0], peer[:, 0]))
        for mode, nees in pooled.items():
            both = (np.concatenate(each) for each in zip(*nees, strict=True))
            rows.append(
                nees_row(
                    f"{work.name}, all rates, {mode}: NEES",
                    *(each[np.isfinite(each)] for each in both),
                )
            )
    return rows


def _compare(
    work: Work, labs: tuple[Lab, Lab], rate_deg_s: float, first_seed: int
) -> Iterator[tuple[str, Floats, Floats]]:
    """Yield each source of the rate with (N, 5) rows of Solved under the rolling and under the global shutter."""
    errors: dict[tuple[str, int], list[Solved]] = {}
    for seed in range(first_seed, first_seed + work.frames):
        for n, lab in enumerate(labs):
            frame, truth, tracker = frame_of(work, lab, rate_deg_s, seed)
            for mode, rate in ("gyro", gyro(truth, seed)), ("frame only", None):
                report = factory.solve_frame(tracker, frame, None, rate)
                solved = score(report.attitude, truth)
                if rate is None and n == 0 and np.isfinite(solved.nees):
                    solved = with_bound(solved, tracker, report, truth, frame.exposure_s)
                errors.setdefault((mode, n), []).append(solved)
    for mode in ("gyro", "frame only"):
        yield mode, np.array(errors[mode, 0]), np.array(errors[mode, 1])


def frame_of(
    work: Work, lab: Lab, rate_deg_s: float, seed: int
) -> tuple[Frame, Truth, factory.Estimator]:
    """One frame at a random attitude and axis, and its tracker; a dome is surveyed anew for each."""
    rng = np.random.default_rng([seed, 1])
    camera = lab.in_run(int(rng.integers(2**62))).camera
    middle = Rotation.random(rng=rng)
    if work.tilt_deg is not None:
        azimuth, yaw = rng.uniform(0, 2 * np.pi, 2)
        tilt = (
            np.radians(work.tilt_deg)
            * rng.uniform()
            * np.array([np.cos(azimuth), np.sin(azimuth), 0])
        )
        middle = Rotation.from_rotvec(tilt) * Rotation.from_rotvec([0, 0, yaw])
    axis = rng.standard_normal(3) * (
        [1, 1, ROLL_SHARE] if work.tilt_deg is None else [1, 1, 1]
    )
    rate_cam = np.radians(rate_deg_s) * axis / np.linalg.norm(axis)
    rate_body = camera.mount.cam_from_body.inv().apply(rate_cam)
    trajectory = constant_acceleration(camera.scene, middle, rate_body, np.zeros(3))
    frame, truth = render_frame(camera, trajectory, 0)
    tracker = camera.scene.tracker
    surveyed = tracker.model_copy(
        update={"survey": tracker.survey.model_copy(update={"seed": seed})}
    )
    scene = camera.scene.model_copy(update={"tracker": surveyed})
    return frame, truth, factory.build_tracker(scene, camera.mount, camera.sources)


def gyro(truth: Truth, seed: int) -> RateEstimate:
    """The rate as a gyro measures it."""
    error = GYRO_RAD_S * np.random.default_rng([seed, 2]).standard_normal(3)
    return RateEstimate(truth.rate_cam_rad_s + error, GYRO_RAD_S**2 * np.eye(3))


def score(attitude: Attitude, truth: Truth) -> Solved:
    """The errors of an attitude."""
    if attitude.cam_from_ref is None or attitude.covariance_rad2 is None:
        return NOT_SOLVED
    cross, roll = metrics.cross_and_roll_rad(attitude.cam_from_ref, truth.cam_from_lab)
    nees = metrics.normalized_error_squared(
        attitude.cam_from_ref, truth.cam_from_lab, attitude.covariance_rad2
    )
    return Solved(nees, cross / ARCSEC_RAD, roll / ARCSEC_RAD)


def with_bound(
    solved: Solved,
    tracker: factory.Estimator,
    report: Report,
    truth: Truth,
    exposure_s: float,
) -> Solved:
    """The errors of a frame with its bound, from the information of its matched lights about attitude and rate."""
    attitude = report.attitude
    match = report.attitude.match
    assert match is not None
    assert attitude.cam_from_ref is not None
    camera = tracker.camera
    seen = report.centroids.take(match.observed)
    if isinstance(tracker, StarTracker):
        seen = tracker.with_errors(seen)
        place_ref = tracker.stars.vectors[match.star]
        lever_m = np.zeros(3)
    else:
        assert isinstance(tracker, DomeTracker)
        seen = tracker._with_errors(seen, match.star)
        place_ref = tracker.leds.position_m[match.star]
        lever_m = tracker.lever.cam_from_body.apply(tracker.lever.camera_body_m)
    place = truth.cam_from_lab.apply(place_ref)
    jacobian = tangent_jacobian(place, place - lever_m).reshape(-1, 2, 3)
    velocity = -jacobian @ truth.rate_cam_rad_s
    gain = error_gain(camera, velocity)
    delay_s = camera.row_delays_s(seen.xy_px)[:, None, None]
    information = camera.focal_px**2 * np.linalg.inv(
        gain @ covariance_of(seen) @ np.swapaxes(gain, 1, 2)
    )
    slopes = np.concatenate([jacobian, -delay_s * jacobian], axis=2)
    normal = np.sum(np.swapaxes(slopes, 1, 2) @ information @ slopes, axis=0)
    rate_known = np.linalg.inv(normal[:3, :3])
    if seen.streak_px is not None:
        told = np.isfinite(seen.streak_px[:, 0])
        by_rate = (
            exposure_s * streak_factor(camera, velocity[told])[:, None, None] * jacobian[told]
        )
        normal[3:, 3:] += np.sum(
            np.swapaxes(by_rate, 1, 2) @ chords(camera, seen.take(told))[1] @ by_rate, axis=0
        )
    bound = np.linalg.inv(normal)[:3, :3]
    error = (attitude.cam_from_ref * truth.cam_from_lab.inv()).as_rotvec()
    ratio = float(np.sqrt(bound[2, 2] / rate_known[2, 2]))
    return solved._replace(
        bound=float(error @ np.linalg.solve(bound, error)), roll_ratio=ratio
    )


def _rows(name: str, ours: Floats, peer: Floats) -> list[dict[str, Any]]:
    solved = np.isfinite(ours[:, 0])
    by_peer = np.isfinite(peer[:, 0])
    both = solved & by_peer
    rows = [
        row(
            f"{name}: solved",
            100 * solved.mean(),
            "%",
            100 * by_peer.mean(),
            None,
            solved.sum() >= by_peer.sum(),
        ),
        nees_row(f"{name}: NEES", ours[solved, 0], peer[by_peer, 0]),
    ]
    if np.isfinite(ours[:, 3]).any():
        by_bound = np.sqrt(np.nanmedian(ours[:, 3]) / CHI2_MEDIAN)
        ratio = np.nanmedian(ours[:, 4])
        rows.append(
            row(
                f"{name}: error over its bound",
                by_bound,
                "",
                None,
                BAR_ERROR,
                by_bound <= BAR_ERROR,
            )
        )
        rows.append(
            row(
                f"{name}: bound of the roll over that of a known rate",
                ratio,
                "",
                None,
                None,
                None,
            )
        )
    for column, angle in (1, "cross"), (2, "roll"):
        value, others = (
            float(np.median(np.abs(errors[both, column]))) for errors in (ours, peer)
        )
        rows.append(
            row(
                f"{name}: {angle}",
                value,
                "arcsec median",
                others,
                BAR_ERROR,
                value <= BAR_ERROR * others,
            )
        )
    return rows


def nees_row(name: str, ours: Floats, peer: Floats | None = None) -> dict[str, Any]:
    """A row of a mean NEES with its standard error over frames, met if it is within BAR_NEES of 3."""
    value = float(np.mean(ours)) if len(ours) else float("nan")
    error = f"± {np.std(ours, ddof=1) / np.sqrt(len(ours)):.2f}" if len(ours) > 1 else ""
    others = float(np.mean(peer)) if peer is not None and len(peer) else None
    return row(name, value, error, others, 3 + BAR_NEES, abs(value - 3) <= BAR_NEES)


def row(
    name: str,
    value: float,
    unit: str,
    peer: float | None,
    bar: float | None,
    met: bool | None,
) -> dict[str, Any]:
    """A row as `python -m benchmarks` prints it; the peer is a global shutter."""
    return {
        "name": name,
        "value": float(value),
        "unit": unit,
        "peer": None if peer is None else "global shutter",
        "peer_value": None if peer is None else float(peer),
        "ratio": float(value / peer) if peer else None,
        "bar": bar,
        "met": None if met is None else bool(met),
    }
