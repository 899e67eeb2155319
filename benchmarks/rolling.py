"""Attitude under a rolling shutter against the same frames with a global one, by rate: stars and a dome.

Every frame is rendered twice with the same seeds, with the camera's rolling shutter and with a global one, at a random
attitude and a constant rate about a random axis, of stars mostly perpendicular to the boresight. The tracker gets the
rate from a gyro (0.01 deg/s about each axis) or takes it from the frame. NEES is 3 for an honest covariance; errors are
compared over the frames that both solve.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, RateEstimate
from skysim.core.quantities.units import ARCSEC_RAD
from skysim.core.types import Floats, Frame, Truth
from skysim.experiments.study.execution.trials import constant_rate
from skysim.results import metrics
from skysim.scene.loader import load
from skysim.simulation import exposure
from skysim.simulation.testbed import Testbed, build_testbed
from skysim.tracking import factory

RATES_DEG_S = (0.0, 1.0, 2.0, 5.0, 10.0)
GYRO_RAD_S = np.radians(0.01)
ROLL_SHARE = 0.2  # of the boresight in a random axis, if stars are smeared: streaks are then nearly parallel
BAR_NEES, BAR_ERROR = 0.3, 1.2
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

    def testbed(self, rolling: bool) -> Testbed:
        shutter = f"{{kind: rolling, row_time: '{self.row_time}'}}" if rolling else "{kind: global}"
        return build_testbed(load(self.scene, ONE_FRAME | self.changes | {"camera.shutter": shutter}))


PHONE = {"camera.preset": "imx477", "camera.focal_length": "16 mm", "camera.f_number": "1.4", "exposure.time": "20 ms"}
SURVEY = {"tracker.survey.lever_sigma": "0 mm", "tracker.survey.led_sigma": "0.02 mm"}
WORKS = (
    Work("SHEFEX", "shefex2", "80 us", 100, {"exposure.time": "50 ms"}),
    Work("IMX477, 16 mm", "shefex2", "28.57 us", 16, PHONE),
    Work("AFIT dome", "afit_simsat", "83 us", 60, SURVEY, 20.0),
)


class Solved(NamedTuple):
    """Errors of one frame: NEES, cross-boresight and roll in arcseconds; NaN if it was not solved."""

    nees: float
    cross_arcsec: float
    roll_arcsec: float


NOT_SOLVED = Solved(np.nan, np.nan, np.nan)


def measure(works: tuple[Work, ...] = WORKS, rates_deg_s: tuple[float, ...] = RATES_DEG_S) -> list[dict[str, Any]]:
    """NEES, error ratios and solved share of each scene, rate and source of the rate."""
    rows = []
    for work in works:
        beds = work.testbed(True), work.testbed(False)
        for rate_deg_s in rates_deg_s:
            for mode, ours, peer in _compare(work, beds, rate_deg_s):
                rows += _rows(f"{work.name}, {rate_deg_s:g} deg/s, {mode}", ours, peer)
    return rows


def _compare(work: Work, beds: tuple[Testbed, Testbed], rate_deg_s: float) -> Iterator[tuple[str, Floats, Floats]]:
    """Yield each source of the rate with (N, 3) errors of the rolling and of the global shutter."""
    errors: dict[tuple[str, int], list[Solved]] = {}
    for seed in range(work.frames):
        for n, bed in enumerate(beds):
            frame, truth, tracker = frame_of(work, bed, rate_deg_s, seed)
            for mode, rate in ("gyro", gyro(truth, seed)), ("frame only", None):
                attitude = factory.solve_frame(tracker, frame, None, rate).attitude
                errors.setdefault((mode, n), []).append(score(attitude, truth))
    for mode in ("gyro", "frame only"):
        yield mode, np.array(errors[mode, 0]), np.array(errors[mode, 1])


def frame_of(work: Work, bed: Testbed, rate_deg_s: float, seed: int) -> tuple[Frame, Truth, factory.Estimator]:
    """One frame at a random attitude and axis, and its tracker; a dome is surveyed anew for each."""
    rng = np.random.default_rng([seed, 1])
    bed = bed.in_run(int(rng.integers(2**62)))
    middle = Rotation.random(rng=rng)
    if work.tilt_deg is not None:
        azimuth, yaw = rng.uniform(0, 2 * np.pi, 2)
        tilt = np.radians(work.tilt_deg) * rng.uniform() * np.array([np.cos(azimuth), np.sin(azimuth), 0])
        middle = Rotation.from_rotvec(tilt) * Rotation.from_rotvec([0, 0, yaw])
    axis = rng.standard_normal(3) * ([1, 1, ROLL_SHARE] if work.tilt_deg is None else [1, 1, 1])
    rate_cam = np.radians(rate_deg_s) * axis / np.linalg.norm(axis)
    trajectory = constant_rate(bed.scene, middle, bed.mount.cam_from_body.inv().apply(rate_cam))
    frame, truth = exposure.render_frame(replace(bed, trajectory=trajectory), 0)
    tracker = bed.scene.tracker
    surveyed = tracker.model_copy(update={"survey": tracker.survey.model_copy(update={"seed": seed})})
    scene = bed.scene.model_copy(update={"tracker": surveyed})
    return frame, truth, factory.build_tracker(scene, bed.mount, bed.sources)


def gyro(truth: Truth, seed: int) -> RateEstimate:
    """The rate as a gyro measures it."""
    error = GYRO_RAD_S * np.random.default_rng([seed, 2]).standard_normal(3)
    return RateEstimate(truth.rate_cam_rad_s + error, GYRO_RAD_S**2 * np.eye(3))


def score(attitude: Attitude, truth: Truth) -> Solved:
    """The errors of an attitude."""
    if attitude.cam_from_ref is None or attitude.covariance_rad2 is None:
        return NOT_SOLVED
    cross, roll = metrics.cross_and_roll_rad(attitude.cam_from_ref, truth.cam_from_lab)
    nees = metrics.normalized_error_squared(attitude.cam_from_ref, truth.cam_from_lab, attitude.covariance_rad2)
    return Solved(nees, cross / ARCSEC_RAD, roll / ARCSEC_RAD)


def _rows(name: str, ours: Floats, peer: Floats) -> list[dict[str, Any]]:
    solved, by_peer = np.isfinite(ours[:, 0]), np.isfinite(peer[:, 0])
    both = solved & by_peer
    rows = [
        row(f"{name}: solved", 100 * solved.mean(), "%", 100 * by_peer.mean(), None, solved.sum() >= by_peer.sum()),
        nees_row(f"{name}: NEES", ours[solved, 0], peer[by_peer, 0]),
    ]
    for column, angle in (1, "cross"), (2, "roll"):
        value, others = (float(np.median(np.abs(errors[both, column]))) for errors in (ours, peer))
        rows.append(row(f"{name}: {angle}", value, "arcsec median", others, BAR_ERROR, value <= BAR_ERROR * others))
    return rows


def nees_row(name: str, ours: Floats, peer: Floats | None = None) -> dict[str, Any]:
    """A row of a mean NEES, met if it is within BAR_NEES of 3."""
    value = float(np.mean(ours)) if len(ours) else float("nan")
    others = float(np.mean(peer)) if peer is not None and len(peer) else None
    return row(name, value, "", others, 3 + BAR_NEES, abs(value - 3) <= BAR_NEES)


def row(name: str, value: float, unit: str, peer: float | None, bar: float | None, met: bool | None) -> dict[str, Any]:
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
