"""AFIT's bump at position 5 (Padro 2012, 4.4, Table 14): the gyros saturate and the IMU loses part of the rotation.

A short motion is simulated without a bump, with a bump fitted to Table 14, and with the scene's assumed bump. The
error of the IMU alone is compared with Table 14; the errors of star tracker and filter after the bump are given too.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.papers.afit.test3 import angles_deg
from skysim.experiments.papers.compare import (Drawing, ExperimentOptions, ExperimentResult, RowResult, with_cause)
from skysim.experiments.papers.compare import prediction_interval
from skysim.experiments.papers.published import experiments
from skysim.results.plots import INK
from skysim.scene import loader
from skysim.simulation.flight import Shot, open_flight

BumpRate = tuple[float, float, float]
# deg/s about the body axes: fitted to Table 14's theta_2 and theta_3, and the scene's own.
FITTED_BUMP: BumpRate = (0.0, -12.1, -15.0)
ASSUMED_BUMP: BumpRate = (3.0, -2.0, 14.0)
BUMP_START_S = 1.5
BUMP_END_S = 2.0
NEXT_IMAGE_S = 2.5
CAUSE = f"a bump of {FITTED_BUMP} deg/s, gyros saturated at 10"


class BumpRun(NamedTuple):
    """A simulated motion of `simsat_bump`.

    t_s, imu_deg, filter_deg : (K,), (K, 3) roll, pitch and yaw of the IMU minus the true ones, (K,) the filter's error
    saturated_s : how long a gyro was saturated;  tracker_error_deg : the star tracker's worst error after the bump
    """

    t_s: Floats
    imu_deg: Floats
    filter_deg: Floats
    saturated_s: float
    tracker_error_deg: float


def bump(options: ExperimentOptions) -> ExperimentResult:
    """Errors without a bump, with the fitted bump and with the scene's bump, each with several IMUs."""
    runs = []
    for n, bump_deg_s in enumerate((None, FITTED_BUMP, ASSUMED_BUMP)):
        options.watch(n, 3)
        runs.append(simulate_bumps(bump_deg_s, options.trials(10, 2), options.seed))
    with_fitted = runs[1]
    # Absolute errors of the IMU's angles at the end, (runs, 3).
    without_deg, fitted_deg, assumed_deg = (
        np.abs([run.imu_deg[-1] for run in imus]) for imus in runs
    )
    results = {
        f"theta_{n + 1}": with_cause(
            CAUSE, prediction_interval, without_deg[:, n], fitted_deg[:, n]
        )
        for n in range(3)
    }
    cause = f"the scene's bump of {ASSUMED_BUMP} deg/s"
    results["order"] = with_cause(cause, prediction_interval, without_deg[:, 2], assumed_deg[:, 2])
    saturated_s = [[run.saturated_s for run in imus] for imus in runs[:2]]
    results["limited"] = with_cause(CAUSE, prediction_interval, *saturated_s)
    results["tracker"] = RowResult(
        prediction_interval([run.tracker_error_deg for run in with_fitted])
    )
    results["filter"] = RowResult(
        prediction_interval([filter_errors_after(run).max() for run in with_fitted])
    )
    caption = "The IMU loses 0.8 deg in the bump; the filter corrects it with the next image."
    return ExperimentResult(results, (Drawing(caption, lambda fig: draw(fig, with_fitted[0])),))


def simulate_bumps(bump_deg_s: BumpRate | None, imus: int, seed: int) -> list[BumpRun]:
    """Simulate the same motion with `imus` IMUs of random hardware seeds."""
    seeds = random_stream(seed, 14).integers(2**31, size=imus)
    return [simulate_bump(bump_deg_s, int(imu_seed)) for imu_seed in seeds]


def filter_errors_after(run: BumpRun) -> Floats:
    """(K,) the filter's errors after the first image that follows the bump."""
    return run.filter_deg[run.t_s > NEXT_IMAGE_S]


def simulate_bump(bump_deg_s: BumpRate | None, seed: int) -> BumpRun:
    """Simulate six seconds around a bump, with one image per second."""
    bump_leg = f'{{kind: bump, rate_deg_s: {list(bump_deg_s or ())}, duration: "40 ms", caught_after: "0.2 s"}}, '
    hold_leg = f'{{kind: hold, duration: "{BUMP_START_S} s"}}, '
    overrides = {
        "seed": str(seed),
        "vehicle.imu.hardware_seed": str(seed),
        "motion.maneuver": f'[{hold_leg}{bump_leg if bump_deg_s else ""}{{kind: hold, duration: "30 s"}}]',
        "exposure": '{time: "10 ms", rate_hz: 1, frames: 6, first: "0.4 s"}',
    }
    with open_flight(loader.load("simsat_bump", overrides)) as flight:
        errors_deg = [
            tracker_error_deg(shot) for shot in flight.shots() if shot.truth.t_s > BUMP_END_S
        ]
        log = flight.telemetry()
    assert log.lab_from_imu is not None
    assert log.lab_from_filter is not None
    assert log.saturated is not None
    return BumpRun(
        log.t_s,
        angles_deg(log.lab_from_imu) - angles_deg(log.lab_from_body),
        np.degrees((log.lab_from_filter * log.lab_from_body.inv()).magnitude()),
        float(log.saturated.sum() * log.period_s),
        max(errors_deg),
    )


def tracker_error_deg(shot: Shot) -> float:
    """The star tracker's error; infinite if the image was not solved."""
    assert shot.report is not None
    estimate = shot.report.attitude.cam_from_ref
    return (
        math.inf
        if estimate is None
        else float(np.degrees((estimate * shot.truth.cam_from_lab.inv()).magnitude()))
    )


def draw(fig: Any, run: BumpRun) -> None:
    axes = fig.subplots()
    rows = experiments()["afit-bump"].rows
    for axis in range(3):
        axes.plot(
            run.t_s,
            np.abs(run.imu_deg[:, axis]),
            color=INK[(0, 2, 5)[axis]],
            label=f"IMU, theta_{axis + 1}",
        )
        published = rows[f"theta_{axis + 1}"].published
        label = f"published, theta_{axis + 1}"
        axes.plot(run.t_s[-1] + 0.15, published, "os^"[axis], color=INK[1], label=label)
    axes.plot(run.t_s, run.filter_deg, color=INK[6], ls="--", label="filter with star tracker")
    axes.set(xlabel="time (s)", ylabel="error (deg)")
    axes.legend(ncols=2)
