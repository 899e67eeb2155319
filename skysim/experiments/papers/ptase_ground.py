"""PTASE's camera on the ground (Fialho & Saotome 2005, section 4, table 2): attitudes from a fixed camera at night.

The camera is fixed to the Earth, so its right ascension grows at the sidereal rate. Frames are rendered with the
Earth's attitude from SOFA (precession, nutation, rotation) and solved: with a calibrated camera at rest, and with
uncalibrated decentering distortion and vibration as the cause of the paper's larger scatter.
"""

from __future__ import annotations

import datetime
from typing import Any, NamedTuple

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import ra_dec_roll_rad
from skysim.core.constants import DAY_S, EARTH_RATE_RAD_S
from skysim.core.random_streams import JITTER, random_stream
from skysim.core.time import J2000_JD, tt_days, utc_days
from skysim.core.types import Floats, Trajectory
from skysim.dynamics.jitter import Vibration
from skysim.experiments.papers.compare import (
    Cause,
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    RowResult,
    bootstrap_interval,
    sample_std,
    symmetric_interval,
)
from skysim.experiments.papers.published import experiments, published_values
from skysim.experiments.study.execution.trials import constant_rate
from skysim.results.metrics import WRONG_RAD, extremum, proportion, rms
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.simulation.exposure import render_frame
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.sources import stars
from skysim.tracking import factory

SITE_DEG = (-23.2, -45.9)  # latitude, longitude of Sao Jose dos Campos
UTC_LESS_LOCAL = datetime.timedelta(hours=3)
UT1_LESS_UTC_S = -0.36  # in October 2003 (IERS)
LOCAL_TIMES = [
    datetime.datetime(2003, 10, 2, *at)
    for at in ((19, 55, 22), (20, 1, 56), (20, 7, 0), (20, 11, 30))
]
ROWS = ("1", "2", "3", "4")
ANGLES = ("ra", "dec", "roll")
ATTEMPTS = 18
# Table 2: right ascension, declination, roll, deg.
TABLE_2 = published_values(
    "ptase-table-2", *(f"{angle}_{row}" for row in ROWS for angle in ANGLES)
).reshape(-1, 3)
# "Very clear and dark": the air of the place and the Moon of the date, at its first quarter, 62 to 66 degrees high.
NIGHT = {
    "background": "[]",
    "site": f"{{latitude_deg: {SITE_DEG[0]}, longitude_deg: {SITE_DEG[1]}, height: 600 m}}",
    "light.air": "{glow: {dark_mag_arcsec2: 21}}",
}
FITTED_DECENTERING = (
    0.0018  # sqrt(p1^2 + p2^2), uncalibrated: about 0.4 px at the detector's corner
)
FITTED_JITTER = (
    "[{kind: line, frequency_hz: 1, rms_arcsec: [22, 22, 22]}]"  # a vibrating floor
)


def itrs_from_icrs(local: datetime.datetime) -> Rotation:
    """The Earth's attitude: precession, nutation and rotation (SOFA's c2t06a); polar motion is neglected."""
    utc = local + UTC_LESS_LOCAL
    ut1_days = utc_days(utc) + UT1_LESS_UTC_S / DAY_S
    return Rotation.from_matrix(
        erfa.c2t06a(J2000_JD, tt_days(utc), J2000_JD, ut1_days, 0.0, 0.0)
    )


def cam_from_itrs() -> Rotation:
    """Attitude of the camera on its tripod, fitted so that the mean of the table's rows is met at their mean time."""
    ra_deg, dec_deg, roll_deg = TABLE_2.mean(axis=0)
    since_first = [time - LOCAL_TIMES[0] for time in LOCAL_TIMES]
    mean_time = LOCAL_TIMES[0] + sum(since_first, datetime.timedelta()) / len(since_first)
    return stars.cam_from_icrs(ra_deg, dec_deg, -roll_deg) * itrs_from_icrs(mean_time).inv()


def paper_angles_deg(cam_from_icrs: Rotation) -> Floats:
    """(3,) right ascension, declination, roll in degrees as in Table 2; the roll of eq. 5 is minus ours."""
    ra, dec, roll = np.degrees(ra_dec_roll_rad(cam_from_icrs))
    return np.array([(ra + 180) % 360 - 180, dec, -roll])


class FrameSolutions(NamedTuple):
    """Solutions of N frames.

    Attributes
    ----------
    local
        (N,) local times
    estimated_deg, true_deg
        (N, 3) estimated and true angles as in Table 2
    error_rad
        (N,) error angle. Estimates and errors are NaN for unsolved frames.
    """

    local: list[datetime.datetime]
    estimated_deg: Floats
    true_deg: Floats
    error_rad: Floats

    @property
    def minutes(self) -> Floats:
        """(N,) time since the first row of Table 2."""
        return np.array([(time - LOCAL_TIMES[0]).total_seconds() / 60 for time in self.local])

    @property
    def errors_arcsec(self) -> Floats:
        """(M, 3) errors of the solved frames minus their mean: RA times cos(dec), declination, roll."""
        error_deg = (self.estimated_deg - self.true_deg) * [
            np.cos(np.radians(TABLE_2[0, 1])),
            1,
            1,
        ]
        error_deg = error_deg[np.isfinite(error_deg[:, 0])] * 3600
        return error_deg - error_deg.mean(axis=0)


def uncalibrated_overrides(direction_rad: float) -> dict[str, str]:
    """Overrides for the cause: decentering distortion that the tracker does not know, and vibration."""
    p1, p2 = FITTED_DECENTERING * np.array([np.sin(direction_rad), np.cos(direction_rad)])
    return {
        "camera.distortion": f"[0, 0, {p1:.9f}, {p2:.9f}, 0]",
        "tracker.assumed_distortion": "[0, 0, 0, 0, 0]",
        "motion.jitter": FITTED_JITTER,
    }


def photograph_and_solve(
    overrides: dict[str, str], local: list[datetime.datetime], seed: int
) -> FrameSolutions:
    """Render and solve a frame at each time from the Earth-fixed camera."""
    lab = build_lab(loader.load("ptase_2003", NIGHT | overrides))
    tracker = build_tracker(lab.camera)
    tripod = cam_from_itrs()
    estimated_deg = np.full((len(local), 3), np.nan)
    true_deg = np.empty((len(local), 3))
    error_rad = np.full(len(local), np.nan)
    for n, time in enumerate(local):
        cam_from_icrs = tripod * itrs_from_icrs(time)
        lab_then = at_time(lab.in_run(seed + n), time)
        frame, _ = render_frame(lab_then.camera, earth_fixed(lab_then, cam_from_icrs), 0)
        solution = factory.solve_frame(tracker, frame).attitude
        true_deg[n] = paper_angles_deg(cam_from_icrs)
        if solution.cam_from_ref is not None:
            estimated_deg[n] = paper_angles_deg(solution.cam_from_ref)
            error_rad[n] = (solution.cam_from_ref * cam_from_icrs.inv()).magnitude()
    return FrameSolutions(local, estimated_deg, true_deg, error_rad)


def at_time(lab: Lab, local: datetime.datetime) -> Lab:
    """The lab under the air and the Moon of a local time."""
    return lab.with_scene(lab.scene.model_copy(update={"start_time": local + UTC_LESS_LOCAL}))


def earth_fixed(lab: Lab, cam_from_icrs: Rotation) -> Trajectory:
    """A motion around the first frame's exposure: the given attitude at mid-exposure, rotation at the
    sidereal rate, and the scene's vibration."""
    body_at_middle = cam_from_icrs.inv() * lab.camera.mount.cam_from_body
    # The sky turns at the sidereal rate about the celestial pole, the z axis of ICRS (precession neglected).
    rate_body = EARTH_RATE_RAD_S * body_at_middle.inv().apply([0.0, 0.0, 1.0])
    vibration = Vibration.draw(lab.scene.motion, random_stream(lab.scene.seed, JITTER, 0))
    return vibration.add_to(constant_rate(lab.scene, body_at_middle, rate_body))


def table_2(options: ExperimentOptions) -> ExperimentResult:
    """Table 2: eighteen frames with a calibrated camera at rest, and as many with each of several decentered lenses."""
    rng = random_stream(options.seed, 2003)
    span = LOCAL_TIMES[3] - LOCAL_TIMES[0]
    local = LOCAL_TIMES + [
        LOCAL_TIMES[0] + n / 13 * span for n in range(ATTEMPTS - len(LOCAL_TIMES))
    ]
    lenses = options.trials(10, 2)
    calibrated = photograph_and_solve({}, local, int(rng.integers(2**31)))
    uncalibrated = []
    for n in range(lenses):
        overrides = uncalibrated_overrides(rng.uniform(0, 2 * np.pi))
        uncalibrated.append(photograph_and_solve(overrides, local, int(rng.integers(2**31))))
        options.watch(n + 1, lenses)
    results: Results = {
        f"{angle}_{row}": RowResult(
            extremum(calibrated.estimated_deg[n : n + 1, axis], np.max), "of one frame"
        )
        for n, row in enumerate(ROWS)
        for axis, angle in enumerate(ANGLES)
    }
    zenith_deg = zenith_distance_deg(calibrated.estimated_deg[0])
    results["zenith"] = extremum(np.array([zenith_deg]), np.max)
    # Least-squares slope of the right ascension, with the 95 % interval from its residuals.
    slope, covariance = np.polyfit(
        calibrated.minutes, calibrated.estimated_deg[:, 0], 1, cov=True
    )
    rate = symmetric_interval(slope[0], 1.96 * np.sqrt(covariance[0, 0]), len(local))
    results["rate"] = results["rate_fit"] = rate
    results |= scatter_results(calibrated, uncalibrated)
    error_rad = np.concatenate([solutions.error_rad for solutions in uncalibrated])
    for key, is_hit in (("failed", np.isnan(error_rad)), ("wrong", error_rad > WRONG_RAD)):
        results[key] = proportion(int(is_hit.sum()), len(is_hit))
    return ExperimentResult(results, drawings(calibrated, uncalibrated))


def scatter_results(
    calibrated: FrameSolutions, uncalibrated: list[FrameSolutions]
) -> Results:
    """Standard deviation of each angle, and mean error. The interval with the cause is over lenses, because the frames
    of one lens share its distortion."""
    name = "optics decentered and not calibrated, and vibration, fitted"
    results: Results = {}
    for axis, angle in enumerate(ANGLES):
        stds = np.array(
            [sample_std(solutions.errors_arcsec[:, axis]) for solutions in uncalibrated]
        )
        ours = bootstrap_interval(calibrated.errors_arcsec[:, axis], sample_std)
        results[f"{angle}_sd"] = RowResult(
            ours, cause=Cause(name, bootstrap_interval(stds, rms))
        )
    norms, *uncalibrated_norms = (
        np.linalg.norm(one.errors_arcsec, axis=1) for one in (calibrated, *uncalibrated)
    )
    means = np.array([one.mean() for one in uncalibrated_norms])
    cause = Cause(name, bootstrap_interval(means, np.mean))
    results["noise"] = RowResult(bootstrap_interval(norms, np.mean), cause=cause)
    return results


def zenith_distance_deg(angles_deg: Floats) -> float:
    """Zenith distance of the boresight at the first row's time, at the site."""
    latitude, longitude = np.radians(SITE_DEG)
    up = np.array(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ]
    )
    boresight = (
        stars.cam_from_icrs(angles_deg[0], angles_deg[1], 0.0).inv().apply([0.0, 0.0, 1.0])
    )
    return float(np.degrees(np.arccos(itrs_from_icrs(LOCAL_TIMES[0]).apply(boresight) @ up)))


def drawings(
    calibrated: FrameSolutions, uncalibrated: list[FrameSolutions]
) -> tuple[FigureDrawing, ...]:
    return (
        FigureDrawing(
            "Right ascension of the fixed camera against time: Table 2 and ours.",
            lambda fig: draw_rate(fig, calibrated),
        ),
        FigureDrawing(
            "Errors about their mean: of Table 2 about the sidereal rate, and ours with and without the causes.",
            lambda fig: draw_errors(fig, calibrated, uncalibrated),
            (7.4, 4.6),
        ),
    )


def draw_rate(fig: Any, calibrated: FrameSolutions) -> None:
    axes = fig.subplots()
    axes.plot(
        calibrated.minutes,
        calibrated.estimated_deg[:, 0],
        MARKS[0],
        color=INK[0],
        label="ours",
    )
    axes.plot(
        calibrated.minutes[:4], TABLE_2[:, 0], "*", ms=11, color=INK[1], label="published"
    )
    time_range = np.array([0, calibrated.minutes.max()])
    published_rate = experiments()["ptase-table-2"].rows["rate"].published or 0.0
    sidereal_deg = calibrated.estimated_deg[0, 0] + published_rate * time_range
    axes.plot(
        time_range, sidereal_deg, color=INK[6], lw=0.8, label=f"{published_rate} deg/min"
    )
    axes.set(xlabel="minutes after 19:55:22", ylabel="right ascension (deg)")
    axes.legend()


def draw_errors(
    fig: Any, calibrated: FrameSolutions, uncalibrated: list[FrameSolutions]
) -> None:
    panels = fig.subplots(3, 1, sharex=True)
    minutes = calibrated.minutes[:4]
    published = (TABLE_2 - TABLE_2.mean(axis=0)) * 3600
    published[:, 0] -= 0.250684 * (minutes - minutes.mean()) * 3600
    published[:, 0] *= np.cos(np.radians(TABLE_2[0, 1]))
    for axis, (axes, name) in enumerate(
        zip(panels, ("RA cos(dec)", "dec", "roll"), strict=True)
    ):
        for solutions in (*uncalibrated, calibrated):
            style = (
                (MARKS[0], INK[0], 4.5)
                if solutions is calibrated
                else (MARKS[1], INK[2], 2.5)
            )
            solved = solutions.minutes[np.isfinite(solutions.error_rad)]
            axes.plot(
                solved,
                solutions.errors_arcsec[:, axis],
                style[0],
                color=style[1],
                ms=style[2],
            )
        axes.plot(minutes, published[:, axis], "*", ms=10, color=INK[1])
        axes.set(ylabel=f"{name} (arcsec)")
    panels[-1].set(xlabel="minutes after 19:55:22")
    names = ("ours, uncalibrated and shaken", "ours, calibrated and at rest", "published")
    fig.legend(
        [panels[0].lines[n] for n in (0, -2, -1)], names, ncols=3, loc="outside upper center"
    )
