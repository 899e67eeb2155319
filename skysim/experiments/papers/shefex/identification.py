"""SHEFEX-2's star identification: time, success, false matches, attitude errors (Samaan & Theil 2011, 3.4, figs 7-10).

Star positions at random attitudes get centroid noise and false stars ("spikes") and go through the paper's identifier
and ESOQ2. The identifier's tolerance cosError (on cosines of angles) is varied. Run time is measured by the number of
angles compared, which does not depend on the computer.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from estimator.attitude.solvers import SOLVERS
from estimator.catalog import pair_index
from estimator.identification.chance import ACCEPT_LOG10_CHANCE
from estimator.identification.published.shefex import FOURTH_STAR, Rules, cos_error, gate, sought
from skysim.core.types import Floats
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import of_means
from skysim.experiments.papers.shefex.setup import (
    CHOSEN,
    MOST,
    PIXEL_RAD,
    PRINTED_FIELD_RAD,
    PUBLISHED,
    UNLIMITED,
    Field,
    fields,
    lab,
    line,
    pairs,
    slack_rad,
)
from skysim.experiments.study.report.figures import logarithmic
from skysim.results.metrics import Summary, exact, extreme, share
from skysim.tracking import onboard_model

COS_ERRORS = np.array([5e-6, 1e-5, 1.5e-5, 2e-5, 3e-5, 4e-5, 5.5e-5, 8e-5, 1.2e-4, 2e-4])
AT = {float(one): n for n, one in enumerate(COS_ERRORS)}
CENTROID_PX = (0.1, 0.2, 0.3)
SPIKES, SPIKED = (0, 2, 4, 6, 8, 10), (4e-5, CHOSEN, 8e-5, 1.2e-4)
ERRORS_PX = np.array([0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])
AT_LIMIT = 3  # index of 0.45 px
LIMIT_DEG = 0.1
EQ3 = 2.47  # c of eq. 3 that gives the chosen cosError for 0.2 px
ASTRAY_RAD = np.radians(1.0)  # a larger error is a false identification, not an inaccurate attitude


class Tried(NamedTuple):
    """One identification: work, 1 or 0 for right and for wrong, (3,) errors about camera x, y, z in degrees or NaN."""

    work: float
    right: float
    wrong: float
    off_deg: Floats


def attempt(
    field: Field, centroid_px: float, error: float, spikes: int, accept: float, rng: np.random.Generator
) -> Tried:
    """Identify noisy stars of a field among spikes, and solve with ESOQ2.

    At most 15 lights are used: stars in the order of brightness, with spikes inserted at random ranks. Work is the
    number of compared angles: those of candidates, and three for each triangle tested.
    """
    camera = onboard_model.calibration(lab().scene.camera)
    xy_px = field.xy_px + centroid_px * rng.standard_normal(field.xy_px.shape)
    if spikes:
        strays_px = rng.random((spikes, 2)) * [camera.width_px, camera.height_px] - 0.5
        place = np.sort(rng.integers(0, len(xy_px) + 1, spikes))
        xy_px = np.insert(xy_px, place, strays_px, axis=0)
    xy_px = xy_px[:MOST]
    if len(xy_px) < 4:
        return Tried(np.nan, 0.0, 0.0, np.full(3, np.nan))
    known, rays, tried = pairs(), camera.rays(xy_px), np.zeros(3, np.int64)
    by = Rules(error, slack_rad(known, error), UNLIMITED, UNLIMITED, len(xy_px), accept)
    observed, star, _, _ = sought(rays, known, by, tried)
    work = float(tried[1] + 3 * tried[2])
    if not len(observed):
        return Tried(work, 0.0, 0.0, np.full(3, np.nan))
    sigma_rad = np.full(len(observed), centroid_px / camera.focal_px)
    found = SOLVERS["esoq2"](rays[observed], known.vectors[star], sigma_rad)
    off_rad = (found * field.cam_from_ref.inv()).as_rotvec()
    if np.linalg.norm(off_rad) > ASTRAY_RAD:
        return Tried(work, 0.0, 1.0, np.full(3, np.nan))
    return Tried(work, 1.0, 0.0, np.degrees(off_rad))


class Curves(NamedTuple):
    """Results for N attitudes. The paper accepts a match with a fourth star; our rule requires significance.

    work, right : (centroid errors, cosErrors, N) by the paper's rule; careful : right by our rule at 0.2 px
    wrong, strict : (spikes, cosErrors of SPIKED, N) by the paper's rule, (spikes, N) by ours, both at 0.2 px
    off_deg     : (centroid errors of ERRORS_PX, N, 3);  enough : (N,) whether four stars are on the detector
    """

    work: Floats
    right: Floats
    careful: Floats
    wrong: Floats
    strict: Floats
    off_deg: Floats
    enough: Floats


class Sky:
    """The attitudes of an experiment. Each has its own noise seed, the same at every point of a curve, so that points
    differ by their parameters only."""

    def __init__(self, ask: Ask, count: int, points: int) -> None:
        self.seen, self.seed = fields(count, ask.seed), ask.seed
        self.watch, self.points, self.done = ask.watch, points, 0

    def through(
        self, centroid_px: float, error: float, spikes: int = 0, accept: float = FOURTH_STAR
    ) -> dict[str, Floats]:
        """Results of all attitudes at one point of a curve, as arrays by the field names of `Tried`."""
        told = [
            attempt(field, centroid_px, error, spikes, accept, np.random.default_rng([self.seed, 1, n]))
            for n, field in enumerate(self.seen)
        ]
        self.done += 1
        self.watch(self.done, self.points)
        return {name: np.array([getattr(one, name) for one in told]) for name in Tried._fields}


def run(ask: Ask) -> Curves:
    """Compute all curves."""
    careful = ACCEPT_LOG10_CHANCE
    points = 4 * len(COS_ERRORS) + len(SPIKES) * (len(SPIKED) + 1) + len(ERRORS_PX)
    sky = Sky(ask, ask.trials(1000, 60), points)
    plain = [[sky.through(one, error) for error in COS_ERRORS] for one in CENTROID_PX]
    return Curves(
        work=np.array([[at["work"] for at in row] for row in plain]),
        right=np.array([[at["right"] for at in row] for row in plain]),
        careful=np.array([sky.through(0.2, error, 0, careful)["right"] for error in COS_ERRORS]),
        wrong=np.array([[sky.through(0.2, error, n)["wrong"] for error in SPIKED] for n in SPIKES]),
        strict=np.array([sky.through(0.2, CHOSEN, n, careful)["wrong"] for n in SPIKES]),
        off_deg=np.array([sky.through(one, eq3(one, EQ3))["off_deg"] for one in ERRORS_PX]),
        enough=np.array([len(field.xy_px) >= 4 for field in sky.seen]),
    )


def eq3(centroid_px: float, factor: float) -> float:
    """cosError by eq. 3 for a centroid error, with the paper's field of view and angle per pixel."""
    return cos_error(PRINTED_FIELD_RAD, centroid_px * PIXEL_RAD, factor)


def figures(ask: Ask) -> Found:
    """Figs 7 to 10, the choice of cosError, and the equations it is based on."""
    curves = run(ask)
    answers = of_time(curves) | of_success(curves) | of_wrong(curves) | of_attitude(curves)
    answers |= of_equations(np.random.default_rng([ask.seed, 2]))
    drawings = (
        Drawing(
            "Fig. 7: angles compared by an identification, against cosError.", partial(draw_time, curves)
        ),
        Drawing("Fig. 8: success rate against cosError.", partial(draw_success, curves)),
        Drawing(
            "Fig. 9: wrong recognitions against the spikes among the stars.", partial(draw_wrong, curves)
        ),
        Drawing("Fig. 10: attitude error against the centroid error.", partial(draw_attitude, curves)),
    )
    return Found(answers, drawings)


def of_time(curves: Curves) -> dict[str, Answer]:
    """Fig. 7: the ends of the curves relative to their minimum, and how far the minimum moves with centroid error."""
    low = [of_means(work.T, lambda m: m[..., 0] / m.min(axis=-1)) for work in curves.work]
    high = [of_means(work.T, lambda m: m[..., -1] / m.min(axis=-1)) for work in curves.work]
    sharp, blurred = curves.work[0].T, curves.work[-1].T
    count = len(COS_ERRORS)

    def moved(means: Floats) -> Floats:
        first, last = means[..., :count].argmin(axis=-1), means[..., count:].argmin(axis=-1)
        return np.asarray(COS_ERRORS[last] / COS_ERRORS[first])

    return {
        "least_low": Answer(min(low), "least of the three centroid errors"),
        "least_high": Answer(min(high), "least of the three centroid errors"),
        "optimum": Answer(of_means(np.hstack([sharp, blurred]), moved)),
    }


def of_success(curves: Curves) -> dict[str, Answer]:
    """Fig. 8: rise with cosError, order of the curves, and the success rate at the chosen cosError."""
    chosen, four = curves.right[1, AT[CHOSEN]], curves.enough
    rise = chosen - curves.right[1, AT[1e-5]]
    above = curves.right[0, AT[2e-5]] - curves.right[2, AT[2e-5]]
    return {
        "success_rises": Answer(of_means(rise[:, None], lambda m: m[..., 0])),
        "success_sharper": Answer(of_means(above[:, None], lambda m: m[..., 0])),
        "success_chosen": Answer(
            share(chosen[four].sum(), four.sum()),
            f"of all attitudes, {1 - four.mean():.0%} with fewer than four stars: {chosen.mean():.3f}",
        ),
    }


def of_wrong(curves: Curves) -> dict[str, Answer]:
    """Fig. 9: rise with the number of spikes and with cosError, and the rate at the chosen cosError."""
    more = curves.wrong[-1, -1] - curves.wrong[0, -1]
    wider = curves.wrong[-1, -1] - curves.wrong[-1, 0]
    at = SPIKED.index(CHOSEN)
    ours = f"by our rule, which weighs a match against chance: {int(curves.strict.sum())} wrong at any"
    return {
        "wrong_spikes": Answer(of_means(more[:, None], lambda m: m[..., 0]), ours),
        "wrong_cos_error": Answer(of_means(wider[:, None], lambda m: m[..., 0])),
        "wrong_chosen": Answer(share(curves.wrong[SPIKES.index(4), at].sum(), len(curves.enough))),
    }


def of_attitude(curves: Curves) -> dict[str, Answer]:
    """Fig. 10: errors at 0.45 px, and the centroid error at which yaw exceeds the limit, as rms and as 2 sigma."""
    yaw, cross = curves.off_deg[:, :, 2].T, np.hypot(curves.off_deg[:, :, 0], curves.off_deg[:, :, 1]).T
    here, square = yaw[:, [AT_LIMIT]], yaw**2

    def steps(means: Floats) -> Floats:
        return np.asarray(np.diff(np.sqrt(means), axis=-1).min(axis=-1))

    both = np.hstack([square[:, [AT_LIMIT]], cross[:, [AT_LIMIT]] ** 2 / 2])
    twice = of_means(square, partial(passes, 2.0))
    return {
        "yaw_mean": Answer(of_means(np.abs(here), lambda m: m[..., 0])),
        "yaw_rms": Answer(of_means(here**2, partial(sigmas, 1.0))),
        "yaw_2_sigma": Answer(of_means(here**2, partial(sigmas, 2.0))),
        "passes": Answer(
            of_means(square, partial(passes, 1.0)), cause=Cause("2 sigma drawn, not rms", twice)
        ),
        "increasing": Answer(of_means(square, steps)),
        "yaw_over_pitch": Answer(of_means(both, lambda m: np.sqrt(m[..., 0] / m[..., 1]))),
        "pitch": Answer(of_means(both[:, 1:], partial(sigmas, 1.0))),
    }


def passes(times: float, squares: Floats) -> Floats:
    """Centroid error in px at which `times` times the rms reaches the limit; the largest one if it never does."""
    yaw_deg = times * np.sqrt(squares)
    rows = yaw_deg.reshape(-1, yaw_deg.shape[-1])
    found = [np.interp(LIMIT_DEG, row, ERRORS_PX) for row in rows]
    return np.reshape(found, yaw_deg.shape[:-1])


def of_equations(rng: np.random.Generator) -> dict[str, Answer]:
    """Eq. 1 by a search that finds nothing, eqs 3 and 4 by our k-vector's ranges, eq. 5 as printed and corrected."""
    answers = {f"c_{n}": Answer(exact(CHOSEN / eq3(one, 1.0))) for n, one in enumerate(CENTROID_PX, 1)}
    answers |= {f"gate_{name}": Answer(exact(gate_deg(angle))) for name, angle in GATES.items()}
    answers["triangles"] = Answer(exact(triangles(rng)))
    beyond, missed = eq5(rng)
    answers["eq5_printed"] = Answer(extreme(np.array([beyond]), np.max))
    answers["eq5_mended"] = Answer(extreme(np.array([missed]), np.max))
    return answers


GATES = {"2": 2.0, "5": 5.0, "10": 10.0, "18": 18.4}


def gate_deg(angle_deg: float) -> float:
    """Half the range of catalog angles that a k-vector search returns for an angle, degrees (eqs 4, 5 corrected)."""
    known = pairs()
    low, high = pair_index.between(known, *gate(np.radians(angle_deg), CHOSEN))
    return float(np.degrees(known.angle_rad[high - 1] - known.angle_rad[low]) / 2)


def triangles(rng: np.random.Generator) -> int:
    """Number of base triangles that a search tests for 15 spikes."""
    camera, tried = onboard_model.calibration(lab().scene.camera), np.zeros(3, np.int64)
    rays = camera.rays(rng.random((MOST, 2)) * [camera.width_px, camera.height_px] - 0.5)
    none = Rules(CHOSEN, slack_rad(pairs(), CHOSEN), UNLIMITED, UNLIMITED, MOST, -np.inf)
    sought(rays, pairs(), none, tried)
    return int(tried[2])


def eq5(rng: np.random.Generator, count: int = 2000) -> tuple[int, int]:
    """Test eq. 5 on `count` measured pairs: number of upper indices outside the k-vector with the printed equation, and
    number of true pairs outside the range with the corrected one."""
    cosines = np.sort(np.cos(pairs().angle_rad))
    kvector, slope, offset = pair_index.line(cosines)
    true = rng.integers(0, len(cosines), count)
    seen = cosines[true] + CHOSEN * rng.uniform(-1, 1, count)
    last = len(kvector) - 1
    printed = np.ceil((seen - CHOSEN) / slope + offset / slope)
    low, high = np.floor((seen - CHOSEN - offset) / slope), np.ceil((seen + CHOSEN - offset) / slope)
    begin = np.where(low < 0, 0, kvector[np.clip(low, 0, last).astype(int)])
    end = kvector[np.clip(high, 0, last).astype(int)]
    return int(np.sum((printed < 0) | (printed > last))), int(np.sum((true < begin) | (true >= end)))


def draw_time(curves: Curves, fig: Any) -> None:
    axes = fig.subplots()
    for n, one in enumerate(CENTROID_PX):
        told = [of_means(row[:, None], lambda m: m[..., 0]) for row in curves.work[n]]
        line(axes, COS_ERRORS, told, n, f"ours, centroid error {one} px")
    axes.axvspan(5e-5, 6e-5, color=PUBLISHED, alpha=0.25, lw=0, label="published choice")
    logarithmic(axes, "x", 4e-6, 2.5e-4)
    logarithmic(axes, "y", 20, 1000)
    axes.set(xlabel="cosError", ylabel="angles an identification")
    axes.legend()


def draw_success(curves: Curves, fig: Any) -> None:
    axes = fig.subplots()
    for n, one in enumerate(CENTROID_PX):
        line(axes, COS_ERRORS, shares(curves.right[n]), n, f"ours, fourth star, {one} px")
    line(axes, COS_ERRORS, shares(curves.careful), 4, "ours, beyond chance, 0.2 px")
    axes.axvspan(5e-5, 6e-5, color=PUBLISHED, alpha=0.25, lw=0, label="published choice")
    logarithmic(axes, "x", 4e-6, 2.5e-4)
    axes.set(xlabel="cosError", ylabel="success rate", ylim=(0, 1.02))
    axes.legend()


def draw_wrong(curves: Curves, fig: Any) -> None:
    axes = fig.subplots()
    for n, error in enumerate(SPIKED):
        line(axes, SPIKES, shares(curves.wrong[:, n]), n, f"ours, fourth star, cosError {error:g}")
    line(axes, SPIKES, shares(curves.strict), 4, f"ours, beyond chance, {CHOSEN:g}")
    axes.set(xlabel="spikes", ylabel="wrong recognition rate")
    axes.legend()


def draw_attitude(curves: Curves, fig: Any) -> None:
    axes = fig.subplots()
    for n, name in ((0, "roll or pitch"), (2, "yaw, about the boresight")):
        for times, style in ((2, "2 sigma"), (1, "rms")):
            told = [of_means(row[:, None] ** 2, partial(sigmas, times)) for row in curves.off_deg[:, :, n]]
            line(axes, ERRORS_PX, told, n + 2 - times, f"ours, {style}, {name}")
    axes.axhline(LIMIT_DEG, color="#888888", lw=0.8, ls="--")
    axes.plot(
        [0.45],
        [LIMIT_DEG],
        "*",
        color=PUBLISHED,
        markersize=12,
        zorder=5,
        label="published: yaw passes 0.1 deg",
    )
    axes.set(xlabel="centroid error (px)", ylabel="attitude error (deg)", ylim=(0, None))
    axes.legend()


def sigmas(times: float, squares: Floats) -> Floats:
    """`times` times the root of the mean square in the first column."""
    return np.asarray(times * np.sqrt(squares[..., 0]))


def shares(rows: Floats) -> list[Summary]:
    """Fraction of ones with its interval, for each row."""
    return [share(row.sum(), len(row)) for row in rows]
