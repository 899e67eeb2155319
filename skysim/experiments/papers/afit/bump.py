"""AFIT's bump at position 5 (Padro 2012, 4.4, Table 14): the gyros saturate and the IMU loses part of the rotation.

A short motion is simulated without a bump, with a bump fitted to Table 14, and with the scene's assumed bump. The
error of the IMU alone is compared with Table 14; the errors of star tracker and filter after the bump are given too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from skysim.core.types import Floats
from skysim.experiments.papers.afit.still import angles_deg
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import another
from skysim.experiments.papers.published import experiments
from skysim.results.plots import INK
from skysim.scene import loader
from skysim.simulation import run, testbed
from skysim.simulation.testbed import Testbed

Knock = tuple[float, float, float]
FITTED: Knock = (
    0.0,
    -12.1,
    -15.0,
)  # deg/s about the body axes, fitted to Table 14's theta_2 and theta_3
ASSUMED: Knock = (3.0, -2.0, 14.0)  # the scene's own
BEGIN_S, OVER_S, SEEN_S = 1.5, 2.0, 2.5
CAUSE = f"a knock of {FITTED} deg/s, gyros that stop at 10"


class Flight(NamedTuple):
    """A simulated motion of `simsat_bump`.

    t_s, imu_deg, filter_deg : (K,), (K, 3) roll, pitch and yaw of the IMU minus the true ones, (K,) the filter's error
    limited_s : how long a gyro was saturated;  tracker_deg : the star tracker's worst error after the bump
    """

    t_s: Floats
    imu_deg: Floats
    filter_deg: Floats
    limited_s: float
    tracker_deg: float


def bump(ask: Ask) -> Found:
    """Errors without a bump, with the fitted bump and with the scene's bump, each with several IMUs."""
    found = []
    for n, knock in enumerate((None, FITTED, ASSUMED)):
        ask.watch(n, 3)
        found.append(flights(knock, ask.trials(10, 2), ask.seed))
    calm, fitted, assumed = found

    def answer(
        figure: Callable[[Flight], float], knocked: list[Flight] = fitted, cause: str = CAUSE
    ) -> Answer:
        ours, bumped = (another(np.array([figure(one) for one in flights])) for flights in (calm, knocked))
        return Answer(ours, cause=Cause(cause, bumped))

    answers = {
        f"theta_{axis + 1}": answer(lambda one, axis=axis: lost_deg(one, axis))  # type: ignore[misc]
        for axis in range(3)
    }
    answers["order"] = answer(lambda one: lost_deg(one, 2), assumed, f"the scene's knock of {ASSUMED} deg/s")
    answers["limited"] = answer(lambda one: one.limited_s)
    answers["tracker"] = Answer(another(np.array([one.tracker_deg for one in fitted])))
    answers["filter"] = Answer(another(np.array([after(one).max() for one in fitted])))
    return Found(
        answers,
        (
            Drawing(
                "The IMU loses 0.8 deg in the bump; the filter has it back with the next image.",
                lambda fig: draw(fig, fitted[0]),
            ),
        ),
    )


def flights(knock_deg_s: Knock | None, units: int, seed: int) -> list[Flight]:
    """Simulate the same motion with `units` IMUs of random hardware seeds."""
    seeds = np.random.default_rng([seed, 14]).integers(2**31, size=units)
    return [flown(knock_deg_s, int(one)) for one in seeds]


def lost_deg(one: Flight, axis: int) -> float:
    """Absolute error of one of the IMU's angles at the end."""
    return float(abs(one.imu_deg[-1, axis]))


def after(one: Flight) -> Floats:
    """(K,) the filter's errors after the first image that follows the bump."""
    return one.filter_deg[one.t_s > SEEN_S]


def flown(knock_deg_s: Knock | None, seed: int) -> Flight:
    """Simulate six seconds around a bump, with one image per second."""
    kind = (
        f'{{kind: bump, rate_deg_s: {list(knock_deg_s or ())}, duration: "40 ms", caught_after: "0.2 s"}}, '
    )
    lab = run.prepare(
        loader.load(
            "simsat_bump",
            {
                "seed": str(seed),
                "vehicle.imu.hardware_seed": str(seed),
                "motion.manoeuvre": f'[{{kind: hold, duration: "{BEGIN_S} s"}}, {kind if knock_deg_s else ""}'
                '{kind: hold, duration: "30 s"}]',
                "exposure": '{time: "10 ms", rate_hz: 1, frames: 6, first: "0.4 s"}',
            },
        )
    )
    log = lab.log
    assert log.lab_from_imu is not None
    assert log.lab_from_filter is not None
    assert log.saturated is not None
    return Flight(
        log.t_s,
        angles_deg(log.lab_from_imu) - angles_deg(log.lab_from_body),
        np.degrees((log.lab_from_filter * log.lab_from_body.inv()).magnitude()),
        float(log.saturated.sum() * log.period_s),
        tracker_deg(lab),
    )


def tracker_deg(lab: Testbed) -> float:
    """The star tracker's worst error after the bump; infinite if an image was not solved."""
    off = []
    for index, report in lab.reports.items():
        t_s = testbed.window(lab.scene, index).middle_s(lab.scene.camera.height_px)
        if t_s > OVER_S:
            estimate = report.attitude.cam_from_ref
            truly = lab.mount.cam_from_body * lab.trajectory.at(t_s).inv()
            off.append(np.inf if estimate is None else np.degrees((estimate * truly.inv()).magnitude()))
    return float(max(off))


def draw(fig: Any, one: Flight) -> None:
    """Errors against time."""
    axes, rows = fig.subplots(), experiments()["afit-bump"].rows
    for axis in range(3):
        axes.plot(
            one.t_s, np.abs(one.imu_deg[:, axis]), color=INK[(0, 2, 5)[axis]], label=f"IMU, theta_{axis + 1}"
        )
        axes.plot(
            one.t_s[-1] + 0.15,
            rows[f"theta_{axis + 1}"].published,
            "os^"[axis],
            color=INK[1],
            label=f"published, theta_{axis + 1}",
        )
    axes.plot(one.t_s, one.filter_deg, color=INK[6], ls="--", label="filter with star tracker")
    axes.set(xlabel="time (s)", ylabel="error (deg)")
    axes.legend(ncols=2)
