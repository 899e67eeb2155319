"""SHEFEX-2's star identification: time, success, false matches, attitude errors (Samaan & Theil 2011, 3.4, figs 7-10).

Star positions at random attitudes get centroid noise and false stars ("spikes") and go through the paper's identifier
and ESOQ2. The identifier's tolerance cosError (on cosines of angles) is varied. Run time is measured by the number of
angles compared, which does not depend on the computer.
"""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from estimator.catalog import pair_index
from estimator.identification.chance import ACCEPT_LOG10_CHANCE
from estimator.identification.published.shefex import (
    FOURTH_STAR,
    angle_interval,
    cos_error,
    search,
)
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.papers.compare import (
    Cause,
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    RowResult,
    bootstrap_of_means,
)
from skysim.experiments.papers.shefex_setup import (
    CHOSEN_COS_ERROR,
    MAX_CENTROIDS,
    PIXEL_RAD,
    PRINTED_FIELD_RAD,
    PUBLISHED,
    StarField,
    identify_and_solve,
    pairs,
    plot_curve,
    random_fields,
    search_options,
    shefex_lab,
)
from skysim.experiments.study.report.figures import logarithmic
from skysim.results.metrics import Summary, exact, extremum, proportion
from skysim.tracking import onboard_model

COS_ERRORS = np.array([5e-6, 1e-5, 1.5e-5, 2e-5, 3e-5, 4e-5, 5.5e-5, 8e-5, 1.2e-4, 2e-4])
INDEX_OF = {float(one): n for n, one in enumerate(COS_ERRORS)}
CENTROID_PX = (0.1, 0.2, 0.3)
SPIKES = (0, 2, 4, 6, 8, 10)
SPIKE_COS_ERRORS = (4e-5, CHOSEN_COS_ERROR, 8e-5, 1.2e-4)
ERRORS_PX = np.array([0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])
LIMIT_INDEX = 3  # index of 0.45 px
LIMIT_DEG = 0.1
EQ3_FACTOR = 2.47  # c of eq. 3 that gives the chosen cosError for 0.2 px
WRONG_RAD = np.radians(
    1.0
)  # a larger error is a false identification, not an inaccurate attitude


class Identification(NamedTuple):
    """One identification: work, 1 or 0 for right and for wrong, (3,) errors about camera x, y, z in degrees or NaN."""

    work: float
    right: float
    wrong: float
    error_deg: Floats


def identify(
    field: StarField,
    centroid_px: float,
    cosine_error: float,
    spikes: int,
    accept_log10_chance: float,
    rng: np.random.Generator,
) -> Identification:
    """Identify noisy stars of a field among spikes, and solve with ESOQ2.

    At most 15 lights are used: stars in the order of brightness, with spikes inserted at random ranks. Work is the
    number of compared angles: those of candidates, and three for each triangle tested.
    """
    camera = onboard_model.calibration(shefex_lab().scene.camera)
    xy_px = field.xy_px + centroid_px * rng.standard_normal(field.xy_px.shape)
    if spikes:
        spikes_px = rng.random((spikes, 2)) * [camera.width_px, camera.height_px] - 0.5
        ranks = np.sort(rng.integers(0, len(xy_px) + 1, spikes))
        xy_px = np.insert(xy_px, ranks, spikes_px, axis=0)
    xy_px = xy_px[:MAX_CENTROIDS]
    if len(xy_px) < 4:
        return Identification(np.nan, 0.0, 0.0, np.full(3, np.nan))
    rays = camera.rays(xy_px)
    sigma_rad = centroid_px / camera.focal_px
    counters = np.zeros(3, np.int64)
    _, cam_from_ref = identify_and_solve(
        rays, pairs(), cosine_error, accept_log10_chance, sigma_rad, counters
    )
    work = float(counters[1] + 3 * counters[2])
    if cam_from_ref is None:
        return Identification(work, 0.0, 0.0, np.full(3, np.nan))
    error_rad = (cam_from_ref * field.cam_from_ref.inv()).as_rotvec()
    if np.linalg.norm(error_rad) > WRONG_RAD:
        return Identification(work, 0.0, 1.0, np.full(3, np.nan))
    return Identification(work, 1.0, 0.0, np.degrees(error_rad))


class Curves(NamedTuple):
    """Results for N attitudes. The paper accepts a match with a fourth star; our rule requires significance.

    Attributes
    ----------
    work, right
        (centroid errors, cosErrors, N) by the paper's rule
    right_significant
        (cosErrors, N) by our rule, at 0.2 px
    wrong
        (spikes, cosErrors of SPIKE_COS_ERRORS, N) by the paper's rule, at 0.2 px
    wrong_significant
        (spikes, N) by our rule, at 0.2 px
    error_deg
        (centroid errors of ERRORS_PX, N, 3)
    has_four_stars
        (N,) whether four stars are on the detector
    """

    work: Floats
    right: Floats
    right_significant: Floats
    wrong: Floats
    wrong_significant: Floats
    error_deg: Floats
    has_four_stars: Floats


def compute_curves(options: ExperimentOptions) -> Curves:
    """Compute all curves.

    Each attitude has its own noise seed, the same at every point of a curve, so that points differ by their
    parameters only.
    """
    points = 4 * len(COS_ERRORS) + len(SPIKES) * (len(SPIKE_COS_ERRORS) + 1) + len(ERRORS_PX)
    fields = random_fields(options.trials(1000, 60), options.seed)
    completed = itertools.count(1)

    def results_at(
        centroid_px: float, cosine_error: float, spikes: int = 0, accept: float = FOURTH_STAR
    ) -> list[Floats]:
        """Work, right, wrong and errors of all attitudes at one point of a curve."""
        results = [
            identify(
                field,
                centroid_px,
                cosine_error,
                spikes,
                accept,
                random_stream(options.seed, 1, n),
            )
            for n, field in enumerate(fields)
        ]
        options.watch(next(completed), points)
        return [np.array(column) for column in zip(*results, strict=True)]

    significant = ACCEPT_LOG10_CHANCE
    work, right = np.array(
        [[results_at(px, error)[:2] for error in COS_ERRORS] for px in CENTROID_PX]
    ).transpose(2, 0, 1, 3)
    right_significant = [results_at(0.2, error, 0, significant)[1] for error in COS_ERRORS]
    wrong = [[results_at(0.2, error, n)[2] for error in SPIKE_COS_ERRORS] for n in SPIKES]
    wrong_significant = [results_at(0.2, CHOSEN_COS_ERROR, n, significant)[2] for n in SPIKES]
    error_deg = [results_at(px, eq3_cos_error(px, EQ3_FACTOR))[3] for px in ERRORS_PX]
    has_four_stars = [len(field.xy_px) >= 4 for field in fields]
    columns = (
        work,
        right,
        right_significant,
        wrong,
        wrong_significant,
        error_deg,
        has_four_stars,
    )
    return Curves(*map(np.array, columns))


def eq3_cos_error(centroid_px: float, factor: float) -> float:
    """cosError by eq. 3 for a centroid error, with the paper's field of view and angle per pixel."""
    return cos_error(PRINTED_FIELD_RAD, centroid_px * PIXEL_RAD, factor)


def figs_7_to_10(options: ExperimentOptions) -> ExperimentResult:
    """Figs 7 to 10, the choice of cosError, and the equations it is based on."""
    curves = compute_curves(options)
    results = (
        time_results(curves)
        | success_results(curves)
        | wrong_results(curves)
        | attitude_results(curves)
    )
    results |= equation_results(random_stream(options.seed, 2))
    drawings = (
        FigureDrawing(
            "Fig. 7: angles compared by an identification, against cosError.",
            partial(draw_time, curves),
        ),
        FigureDrawing(
            "Fig. 8: success rate against cosError.", partial(draw_success, curves)
        ),
        FigureDrawing(
            "Fig. 9: wrong recognitions against the spikes among the stars.",
            partial(draw_wrong, curves),
        ),
        FigureDrawing(
            "Fig. 10: attitude error against the centroid error.",
            partial(draw_attitude, curves),
        ),
    )
    return ExperimentResult(results, drawings)


def time_results(curves: Curves) -> Results:
    """Fig. 7: the ends of the curves relative to their minimum, and how far the minimum moves with centroid error."""
    low = [
        bootstrap_of_means(work.T, lambda m: m[..., 0] / m.min(axis=-1))
        for work in curves.work
    ]
    high = [
        bootstrap_of_means(work.T, lambda m: m[..., -1] / m.min(axis=-1))
        for work in curves.work
    ]

    def moved(means: Floats) -> Floats:
        first, last = (half.argmin(axis=-1) for half in np.split(means, 2, axis=-1))
        return COS_ERRORS[last] / COS_ERRORS[first]

    return {
        "least_low": RowResult(min(low), "smallest of the three centroid errors"),
        "least_high": RowResult(min(high), "smallest of the three centroid errors"),
        "optimum": bootstrap_of_means(np.vstack([curves.work[0], curves.work[-1]]).T, moved),
    }


def success_results(curves: Curves) -> Results:
    """Fig. 8: rise with cosError, order of the curves, and the success rate at the chosen cosError."""
    chosen = curves.right[1, INDEX_OF[CHOSEN_COS_ERROR]]
    has_four_stars = curves.has_four_stars
    increase = chosen - curves.right[1, INDEX_OF[1e-5]]
    difference = curves.right[0, INDEX_OF[2e-5]] - curves.right[2, INDEX_OF[2e-5]]
    return {
        "success_rises": bootstrap_of_mean(increase),
        "success_sharper": bootstrap_of_mean(difference),
        "success_chosen": RowResult(
            proportion(chosen[has_four_stars].sum(), has_four_stars.sum()),
            f"over all attitudes, {1 - has_four_stars.mean():.0%} with fewer than four stars: {chosen.mean():.3f}",
        ),
    }


def wrong_results(curves: Curves) -> Results:
    """Fig. 9: rise with the number of spikes and with cosError, and the rate at the chosen cosError."""
    by_spikes = curves.wrong[-1, -1] - curves.wrong[0, -1]
    by_cos_error = curves.wrong[-1, -1] - curves.wrong[-1, 0]
    chosen = SPIKE_COS_ERRORS.index(CHOSEN_COS_ERROR)
    wrong_by_our_rule = int(curves.wrong_significant.sum())
    note = f"our rule, which requires significance: {wrong_by_our_rule} wrong at any number of spikes"
    return {
        "wrong_spikes": RowResult(bootstrap_of_mean(by_spikes), note),
        "wrong_cos_error": bootstrap_of_mean(by_cos_error),
        "wrong_chosen": proportion(
            curves.wrong[SPIKES.index(4), chosen].sum(), len(curves.has_four_stars)
        ),
    }


def attitude_results(curves: Curves) -> Results:
    """Fig. 10: errors at 0.45 px, and the centroid error at which yaw exceeds the limit, as rms and as 2 sigma."""
    yaw = curves.error_deg[:, :, 2].T
    cross = np.hypot(curves.error_deg[:, :, 0], curves.error_deg[:, :, 1]).T
    yaw_at_limit = yaw[:, LIMIT_INDEX]
    yaw_squared = yaw**2
    yaw_and_cross = np.column_stack([yaw_at_limit**2, cross[:, LIMIT_INDEX] ** 2 / 2])
    one_sigma, two_sigma = (
        bootstrap_of_means(yaw_squared, partial(error_at_limit, times))
        for times in (1.0, 2.0)
    )
    return {
        "yaw_mean": bootstrap_of_mean(np.abs(yaw_at_limit)),
        "yaw_rms": bootstrap_of_rms(yaw_at_limit),
        "yaw_2_sigma": bootstrap_of_rms(yaw_at_limit, 2.0),
        "passes": RowResult(one_sigma, cause=Cause("2 sigma drawn, not rms", two_sigma)),
        "increasing": bootstrap_of_means(
            yaw_squared, lambda m: np.diff(np.sqrt(m), axis=-1).min(axis=-1)
        ),
        "yaw_over_pitch": bootstrap_of_means(
            yaw_and_cross, lambda m: np.sqrt(m[..., 0] / m[..., 1])
        ),
        "pitch": bootstrap_of_means(yaw_and_cross[:, 1:], lambda m: np.sqrt(m[..., 0])),
    }


def bootstrap_of_mean(values: Floats) -> Summary:
    """The mean of (N,) values with its bootstrap interval; NaNs are left out."""
    return bootstrap_of_means(values[:, None], lambda m: m[..., 0])


def bootstrap_of_rms(values: Floats, times: float = 1.0) -> Summary:
    """`times` times the rms of (N,) values with its bootstrap interval; NaNs are left out."""
    return bootstrap_of_means(values[:, None] ** 2, lambda m: times * np.sqrt(m[..., 0]))


def error_at_limit(times: float, squares: Floats) -> Floats:
    """Centroid error in px at which `times` times the rms reaches the limit; the largest one if it never does."""
    yaw_deg = times * np.sqrt(squares)
    return np.apply_along_axis(lambda row: np.interp(LIMIT_DEG, row, ERRORS_PX), -1, yaw_deg)


def equation_results(rng: np.random.Generator) -> Results:
    """Eq. 1 by a search that finds nothing, eqs 3 and 4 by our k-vector's ranges, eq. 5 as printed and corrected."""
    results: Results = {
        f"c_{n}": exact(CHOSEN_COS_ERROR / eq3_cos_error(centroid_px, 1.0))
        for n, centroid_px in enumerate(CENTROID_PX, 1)
    }
    # Half the range of catalog angles that a k-vector search returns for an angle (eqs 4, 5 corrected).
    for name, angle_deg in GATE_ANGLES_DEG.items():
        interval = angle_interval(np.radians(angle_deg), CHOSEN_COS_ERROR)
        low, high = pair_index.pair_range(pairs(), *interval)
        half_rad = (pairs().angle_rad[high - 1] - pairs().angle_rad[low]) / 2
        results[f"gate_{name}"] = exact(np.degrees(half_rad))
    results["triangles"] = exact(count_triangles(rng))
    for key, failures in zip(("eq5_printed", "eq5_mended"), eq5_failures(rng), strict=True):
        results[key] = extremum(np.array([failures]), np.max)
    return results


GATE_ANGLES_DEG = {"2": 2.0, "5": 5.0, "10": 10.0, "18": 18.4}


def count_triangles(rng: np.random.Generator) -> int:
    """Number of base triangles that a search tests for 15 spikes."""
    camera = onboard_model.calibration(shefex_lab().scene.camera)
    counters = np.zeros(3, np.int64)
    rays = camera.rays(
        rng.random((MAX_CENTROIDS, 2)) * [camera.width_px, camera.height_px] - 0.5
    )
    search_limits = search_options(pairs(), CHOSEN_COS_ERROR, MAX_CENTROIDS, -np.inf)
    search(rays, pairs(), search_limits, counters)
    return int(counters[2])


def eq5_failures(rng: np.random.Generator, count: int = 2000) -> tuple[int, int]:
    """Test eq. 5 on `count` measured pairs: number of upper indices outside the k-vector with the printed equation, and
    number of true pairs outside the range with the corrected one."""
    cosines = np.sort(np.cos(pairs().angle_rad))
    kvector, slope, offset = pair_index.k_vector(cosines)
    true_pair = rng.integers(0, len(cosines), count)
    measured = cosines[true_pair] + CHOSEN_COS_ERROR * rng.uniform(-1, 1, count)
    last = len(kvector) - 1
    printed_upper = np.ceil((measured - CHOSEN_COS_ERROR) / slope + offset / slope)
    low = np.floor((measured - CHOSEN_COS_ERROR - offset) / slope)
    high = np.ceil((measured + CHOSEN_COS_ERROR - offset) / slope)
    begin = np.where(low < 0, 0, kvector[np.clip(low, 0, last).astype(int)])
    end = kvector[np.clip(high, 0, last).astype(int)]
    outside = (printed_upper < 0) | (printed_upper > last)
    return int(np.sum(outside)), int(np.sum((true_pair < begin) | (true_pair >= end)))


def draw_time(curves: Curves, fig: Any) -> None:
    axes = fig.subplots()
    for n, centroid_px in enumerate(CENTROID_PX):
        summaries = [bootstrap_of_mean(row) for row in curves.work[n]]
        plot_curve(axes, COS_ERRORS, summaries, n, f"ours, centroid error {centroid_px} px")
    set_up_cos_error_axis(axes)
    logarithmic(axes, "y", 20, 1000)
    axes.set(ylabel="angles an identification")
    axes.legend()


def set_up_cos_error_axis(axes: Any) -> None:
    """A logarithmic x axis of cosError with the paper's choice."""
    axes.axvspan(5e-5, 6e-5, color=PUBLISHED, alpha=0.25, lw=0, label="published choice")
    logarithmic(axes, "x", 4e-6, 2.5e-4)
    axes.set(xlabel="cosError")


def draw_success(curves: Curves, fig: Any) -> None:
    axes = fig.subplots()
    for n, centroid_px in enumerate(CENTROID_PX):
        plot_curve(
            axes,
            COS_ERRORS,
            fractions(curves.right[n]),
            n,
            f"ours, fourth star, {centroid_px} px",
        )
    plot_curve(
        axes,
        COS_ERRORS,
        fractions(curves.right_significant),
        4,
        "ours, beyond chance, 0.2 px",
    )
    set_up_cos_error_axis(axes)
    axes.set(ylabel="success rate", ylim=(0, 1.02))
    axes.legend()


def draw_wrong(curves: Curves, fig: Any) -> None:
    axes = fig.subplots()
    for n, cosine_error in enumerate(SPIKE_COS_ERRORS):
        plot_curve(
            axes,
            SPIKES,
            fractions(curves.wrong[:, n]),
            n,
            f"ours, fourth star, cosError {cosine_error:g}",
        )
    plot_curve(
        axes,
        SPIKES,
        fractions(curves.wrong_significant),
        4,
        f"ours, beyond chance, {CHOSEN_COS_ERROR:g}",
    )
    axes.set(xlabel="spikes", ylabel="wrong recognition rate")
    axes.legend()


def draw_attitude(curves: Curves, fig: Any) -> None:
    axes = fig.subplots()
    for n, name in ((0, "roll or pitch"), (2, "yaw, about the boresight")):
        for times, style in ((2, "2 sigma"), (1, "rms")):
            summaries = [bootstrap_of_rms(row, times) for row in curves.error_deg[:, :, n]]
            plot_curve(axes, ERRORS_PX, summaries, n + 2 - times, f"ours, {style}, {name}")
    axes.axhline(LIMIT_DEG, color="#888888", lw=0.8, ls="--")
    label = "published: yaw passes 0.1 deg"
    axes.plot([0.45], [LIMIT_DEG], "*", color=PUBLISHED, markersize=12, zorder=5, label=label)
    axes.set(xlabel="centroid error (px)", ylabel="attitude error (deg)", ylim=(0, None))
    axes.legend()


def fractions(rows: Floats) -> list[Summary]:
    """Fraction of ones with its interval, for each row."""
    return [proportion(row.sum(), len(row)) for row in rows]
