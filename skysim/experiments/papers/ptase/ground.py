"""PTASE's camera on the ground (Fialho & Saotome 2005, section 4, table 2): attitudes from a fixed camera at night.

The camera is fixed to the Earth, so its right ascension grows at the sidereal rate. Frames are rendered with the
Earth's attitude from SOFA (precession, nutation, rotation) and solved: with a calibrated camera at rest, and with
uncalibrated decentering distortion and vibration as the cause of the paper's larger scatter.
"""

from __future__ import annotations

import datetime
from dataclasses import replace
from typing import Any, NamedTuple

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import ra_dec_roll_rad
from skysim.core.types import Floats, Trajectory
from skysim.dynamics.jitter import Vibration
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import resampled
from skysim.experiments.papers.published import experiments
from skysim.experiments.study.trials import KNOTS, reseeded
from skysim.results.metrics import WRONG_RAD, Summary, extreme, rms, share
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.simulation import exposure, random_streams, testbed
from skysim.simulation.testbed import SPARE_S, Testbed
from skysim.sources import stars
from skysim.tracking import factory

SITE_DEG = (-23.2, -45.9)  # latitude, longitude of Sao Jose dos Campos
UTC_LESS_LOCAL = datetime.timedelta(hours=3)
TT_LESS_UTC_S, UT1_LESS_UTC_S = 64.184, -0.36  # in October 2003
LOCAL = [datetime.datetime(2003, 10, 2, *at) for at in ((19, 55, 22), (20, 1, 56), (20, 7, 0), (20, 11, 30))]
ROWS, ANGLES = ("1", "2", "3", "4"), ("ra", "dec", "roll")
ATTEMPTS = 18
# Table 2: right ascension, declination, roll, deg.
TOLD = experiments()["ptase-table-2"].rows
TABLE_2 = np.array(
    [[TOLD[f"{angle}_{n}"].published for angle in ("ra", "dec", "roll")] for n in range(1, 5)], dtype=float
)
NIGHT = {"background": "[{kind: sky, mag_arcsec2: 21}]"}  # "very clear and dark"
FITTED_DECENTRING = 0.0018  # sqrt(p1^2 + p2^2), uncalibrated: about 0.4 px at the detector's corner
FITTED_JITTER = "[{kind: line, frequency_hz: 1, rms_arcsec: [22, 22, 22]}]"  # a vibrating floor


def itrs_from_icrs(local: datetime.datetime) -> Rotation:
    """The Earth's attitude: precession, nutation and rotation (SOFA's c2t06a); polar motion is neglected."""
    j2000, days = (
        erfa.DJ00,
        (local + UTC_LESS_LOCAL - datetime.datetime(2000, 1, 1, 12)) / datetime.timedelta(1),
    )
    tt, ut1 = days + TT_LESS_UTC_S / erfa.DAYSEC, days + UT1_LESS_UTC_S / erfa.DAYSEC
    return Rotation.from_matrix(erfa.c2t06a(j2000, tt, j2000, ut1, 0.0, 0.0))


def cam_from_itrs() -> Rotation:
    """Attitude of the camera on its tripod, fitted so that the mean of the table's rows is met at their mean time."""
    ra_deg, dec_deg, roll_deg = TABLE_2.mean(axis=0)
    middle = LOCAL[0] + sum((at - LOCAL[0] for at in LOCAL), datetime.timedelta()) / len(LOCAL)
    return stars.cam_from_icrs(ra_deg, dec_deg, -roll_deg) * itrs_from_icrs(middle).inv()


def their_angles_deg(cam_from_icrs: Rotation) -> Floats:
    """(3,) right ascension, declination, roll in degrees as in Table 2; the roll of eq. 5 is minus ours."""
    ra, dec, roll = np.degrees(ra_dec_roll_rad(cam_from_icrs))
    return np.array([(ra + 180) % 360 - 180, dec, -roll])


class Evening(NamedTuple):
    """Solutions of N frames.

    local : (N,) local times;  told_deg, true_deg : (N, 3) estimated and true angles as in Table 2
    off_rad : (N,) error angle. Estimates and errors are NaN for unsolved frames.
    """

    local: list[datetime.datetime]
    told_deg: Floats
    true_deg: Floats
    off_rad: Floats

    @property
    def minutes(self) -> Floats:
        return np.array([(at - LOCAL[0]).total_seconds() / 60 for at in self.local])

    @property
    def errors_arcsec(self) -> Floats:
        """(M, 3) errors of the solved frames minus their mean: RA times cos(dec), declination, roll."""
        off = (self.told_deg - self.true_deg) * [np.cos(np.radians(TABLE_2[0, 1])), 1, 1]
        off = off[np.isfinite(off[:, 0])] * 3600
        return np.asarray(off - off.mean(axis=0))


def as_they_had(towards_rad: float) -> dict[str, str]:
    """Overrides for the cause: decentering distortion that the tracker does not know, and vibration."""
    p1, p2 = FITTED_DECENTRING * np.array([np.sin(towards_rad), np.cos(towards_rad)])
    return {
        "camera.distortion": f"[0, 0, {p1:.9f}, {p2:.9f}, 0]",
        "tracker.believed_distortion": "[0, 0, 0, 0, 0]",
        "motion.jitter": FITTED_JITTER,
    }


def photographed(overrides: dict[str, str], local: list[datetime.datetime], seed: int) -> Evening:
    """Render and solve a frame at each time from the Earth-fixed camera."""
    lab = testbed.build_testbed(loader.load("ptase_2003", NIGHT | overrides))
    tracker, tripod = testbed.tracker(lab), cam_from_itrs()
    told, true, off = np.full((len(local), 3), np.nan), np.empty((len(local), 3)), np.full(len(local), np.nan)
    for n, at in enumerate(local):
        cam_from_icrs = tripod * itrs_from_icrs(at)
        here = standing(reseeded(lab, seed + n), cam_from_icrs)
        frame, _ = exposure.render_frame(here, 0)
        answer = factory.solve_frame(tracker, frame).attitude
        true[n] = their_angles_deg(cam_from_icrs)
        if answer.cam_from_ref is not None:
            told[n] = their_angles_deg(answer.cam_from_ref)
            off[n] = (answer.cam_from_ref * cam_from_icrs.inv()).magnitude()
    return Evening(local, told, true, off)


def standing(lab: Testbed, cam_from_icrs: Rotation) -> Testbed:
    """Testbed with a motion around the first frame's exposure: the given attitude at mid-exposure, rotation at the
    sidereal rate, and the scene's vibration."""
    when, rows = testbed.window(lab.scene, 0), lab.scene.camera.height_px
    t_s = np.linspace(when.open_s - SPARE_S, when.close_s(rows) + SPARE_S, KNOTS)
    middle = cam_from_icrs.inv() * lab.mount.cam_from_body
    earth_rad_s = 2 * np.pi * 1.00273781191135448 / erfa.DAYSEC
    # The sky turns at the sidereal rate about the celestial pole, the z axis of ICRS (precession neglected).
    rate_body = earth_rad_s * middle.inv().apply([0.0, 0.0, 1.0])
    turned = Rotation.from_rotvec(np.outer(t_s - when.middle_s(rows), rate_body))
    path = Trajectory(t_s, middle * turned, np.tile(rate_body, (KNOTS, 1)))
    shaken = Vibration.of(lab.scene.motion, random_streams.rng(lab.scene.seed, "jitter", 0))
    return replace(lab, trajectory=shaken.lay_over(path))


def ground(ask: Ask) -> Found:
    """Table 2: eighteen frames with a calibrated camera at rest, and as many with each of several decentered lenses."""
    rng = np.random.default_rng([ask.seed, 2003])
    between = [LOCAL[0] + n / 13 * (LOCAL[3] - LOCAL[0]) for n in range(ATTEMPTS - len(LOCAL))]
    local, lenses = LOCAL + between, ask.trials(10, 2)
    still = photographed({}, local, int(rng.integers(2**31)))
    theirs = []
    for n in range(lenses):
        had = as_they_had(rng.uniform(0, 2 * np.pi))
        theirs.append(photographed(had, local, int(rng.integers(2**31))))
        ask.watch(n + 1, lenses)
    answers = {
        f"{what}_{row}": Answer(extreme(still.told_deg[n : n + 1, axis], np.max), "of one frame")
        for n, row in enumerate(ROWS)
        for axis, what in enumerate(ANGLES)
    }
    answers["zenith"] = Answer(extreme(np.array([zenith_distance_deg(still.told_deg[0])]), np.max))
    answers |= {"rate": Answer(rate(still)), "rate_fit": Answer(rate(still))}
    answers |= scatters(still, theirs)
    off = np.concatenate([one.off_rad for one in theirs])
    for what, hits in (("failed", np.isnan(off)), ("wrong", off > WRONG_RAD)):
        answers[what] = Answer(share(int(hits.sum()), len(hits)))
    return Found(answers, drawings(still, theirs))


def scatters(still: Evening, theirs: list[Evening]) -> dict[str, Answer]:
    """Standard deviation of each angle, and mean error. The interval with the cause is over lenses, because the frames
    of one lens share its distortion."""
    name, answers = "optics decentred and not calibrated, and vibration, fitted", {}
    for axis, what in enumerate(ANGLES):
        each = np.array([deviation(one.errors_arcsec[:, axis]) for one in theirs])
        cause = Cause(name, resampled(each, rms))
        answers[f"{what}_sd"] = Answer(resampled(still.errors_arcsec[:, axis], deviation), cause=cause)
    sizes = [np.linalg.norm(one.errors_arcsec, axis=1) for one in (still, *theirs)]
    cause = Cause(name, resampled(np.array([one.mean() for one in sizes[1:]]), np.mean))
    answers["noise"] = Answer(resampled(sizes[0], np.mean), cause=cause)
    return answers


def deviation(values: Floats, axis: int = -1) -> Any:
    """Standard deviation (n - 1)."""
    return np.std(values, axis=axis, ddof=1)


def rate(one: Evening) -> Summary:
    """Least-squares slope of the right ascension, deg/min, with the 95 % interval from its residuals."""
    slope, scatter = np.polyfit(one.minutes, one.told_deg[:, 0], 1, cov=True)
    return Summary(
        slope[0],
        slope[0] - 1.96 * np.sqrt(scatter[0, 0]),
        slope[0] + 1.96 * np.sqrt(scatter[0, 0]),
        len(one.local),
    )


def zenith_distance_deg(angles_deg: Floats) -> float:
    """Zenith distance of the boresight at the first row's time, at the site."""
    latitude, longitude = np.radians(SITE_DEG)
    up = np.array(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    )
    sight = stars.cam_from_icrs(angles_deg[0], angles_deg[1], 0.0).inv().apply([0.0, 0.0, 1.0])
    return float(np.degrees(np.arccos(itrs_from_icrs(LOCAL[0]).apply(sight) @ up)))


def drawings(still: Evening, theirs: list[Evening]) -> tuple[Drawing, ...]:
    """Figures: right ascension against time, and errors."""
    return (
        Drawing(
            "Right ascension of the standing camera against time: Table 2 on ours.",
            lambda fig: draw_rate(fig, still),
        ),
        Drawing(
            "Errors about their mean: of Table 2 about the sidereal rate, and ours with the causes and without.",
            lambda fig: draw_errors(fig, still, theirs),
            (7.4, 4.6),
        ),
    )


def draw_rate(fig: Any, still: Evening) -> None:
    """Our right ascensions, the four published ones, and the sidereal line."""
    axes = fig.subplots()
    axes.plot(still.minutes, still.told_deg[:, 0], MARKS[0], color=INK[0], label="ours")
    axes.plot(still.minutes[:4], TABLE_2[:, 0], "*", ms=11, color=INK[1], label="published")
    ends = np.array([0, still.minutes.max()])
    told = experiments()["ptase-table-2"].rows["rate"].published or 0.0
    axes.plot(ends, still.told_deg[0, 0] + told * ends, color=INK[6], lw=0.8, label=f"{told} deg/min")
    axes.set(xlabel="minutes after 19:55:22", ylabel="right ascension (deg)")
    axes.legend()


def draw_errors(fig: Any, still: Evening, theirs: list[Evening]) -> None:
    """Errors of all three angles against time."""
    panels = fig.subplots(3, 1, sharex=True)
    minutes = still.minutes[:4]
    published = (TABLE_2 - TABLE_2.mean(axis=0)) * 3600
    published[:, 0] -= 0.250684 * (minutes - minutes.mean()) * 3600
    published[:, 0] *= np.cos(np.radians(TABLE_2[0, 1]))
    for axis, (axes, what) in enumerate(zip(panels, ("RA cos(dec)", "dec", "roll"), strict=True)):
        for one in (*theirs, still):
            style = (MARKS[0], INK[0], 4.5) if one is still else (MARKS[1], INK[2], 2.5)
            solved = one.minutes[np.isfinite(one.off_rad)]
            axes.plot(solved, one.errors_arcsec[:, axis], style[0], color=style[1], ms=style[2])
        axes.plot(minutes, published[:, axis], "*", ms=10, color=INK[1])
        axes.set(ylabel=f"{what} (arcsec)")
    panels[-1].set(xlabel="minutes after 19:55:22")
    names = ("ours, uncalibrated and shaken", "ours, calibrated and at rest", "published")
    fig.legend([panels[0].lines[n] for n in (0, -2, -1)], names, ncols=3, loc="outside upper center")
