"""AFIT's Test 3, attitudes (Padro 2012, 4.4.2, Tables 10-15): the thesis's algorithm against the IMU.

The thesis gives the attitude by its algorithm and by the IMU at five positions. Our baseline repeats the algorithm on
clean images with a perfect IMU. Then the likely causes of the differences are simulated together: camera noise with
two LEDs under a rolling shutter, drift of an LN-200 during a stay at each position, and the bump at position 5
(module `bump`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import quest
from estimator.catalog.catalog import unit
from estimator.catalog.pair_index import PairCatalog, build_pair_catalog, candidates
from estimator.core.checks import Ints
from estimator.identification.published.primary_pair import (
    Gates,
    SearchInput,
    build_primary,
    gate_rad,
)
from estimator.identification.published.saa import match_assumptions
from skysim.core.constants import ARCSEC_RAD, INCH_M
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.dynamics import guidance, imu
from skysim.dynamics.multibody import imu_position_m
from skysim.experiments.papers.afit.test3 import (
    ALGORITHM_DEG,
    EPSILON_MAG,
    EPSILON_POS_M,
    EPSILON_SEP_ARCSEC,
    FITTED_IMAGING,
    HOME,
    IMU_DEG,
    LEDS,
    build_test3,
    lab_from_body,
    photograph,
)
from skysim.experiments.papers.afit.test_stand import light_positions_m
from skysim.experiments.papers.compare import (
    Cause,
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    RowResult,
    percent,
    prediction_interval,
    sample_std,
    with_cause,
)
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import proportion
from skysim.results.plots import INK
from skysim.results.telemetry_report import euler_deg
from skysim.scene import loader
from skysim.simulation.flight import Shot, open_flight
from skysim.simulation.lab import Lab, build_lab

# AFIT's bump at position 5 (Padro 2012, 4.4, Table 14): the gyros saturate and the IMU loses part
# of the rotation.


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

    Attributes
    ----------
    t_s, imu_deg, filter_deg
        (K,), (K, 3) roll, pitch and yaw of the IMU minus the true ones, (K,) the filter's error
    saturated_s
        How long a gyro was saturated
    tracker_error_deg
        The star tracker's worst error after the bump
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
    # Absolute errors of the IMU's angles at the end, (3, runs).
    without_deg, fitted_deg, assumed_deg = (
        np.abs([run.imu_deg[-1] for run in imus]).T for imus in runs
    )
    results: Results = {}
    for n, pair in enumerate(zip(without_deg, fitted_deg, strict=True), 1):
        results[f"theta_{n}"] = with_cause(CAUSE, prediction_interval, *pair)
    cause = f"the scene's bump of {ASSUMED_BUMP} deg/s"
    results["order"] = with_cause(cause, prediction_interval, without_deg[2], assumed_deg[2])
    saturated_s = [[run.saturated_s for run in imus] for imus in runs[:2]]
    results["limited"] = with_cause(CAUSE, prediction_interval, *saturated_s)
    results["tracker"] = prediction_interval([run.tracker_error_deg for run in with_fitted])
    after_deg = [run.filter_deg[run.t_s > NEXT_IMAGE_S].max() for run in with_fitted]
    results["filter"] = prediction_interval(after_deg)
    caption = "The IMU loses 0.8 deg in the bump; the filter corrects it with the next image."
    return ExperimentResult(
        results, (FigureDrawing(caption, lambda fig: draw(fig, with_fitted[0])),)
    )


def simulate_bumps(bump_deg_s: BumpRate | None, imus: int, seed: int) -> list[BumpRun]:
    """Simulate the same motion with `imus` IMUs of random hardware seeds."""
    seeds = random_stream(seed, 14).integers(2**31, size=imus)
    return [simulate_bump(bump_deg_s, int(imu_seed)) for imu_seed in seeds]


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
        euler_deg(log.lab_from_imu) - euler_deg(log.lab_from_body),
        np.degrees((log.lab_from_filter * log.lab_from_body.inv()).magnitude()),
        float(log.saturated.sum() * log.period_s),
        max(errors_deg),
    )


def tracker_error_deg(shot: Shot) -> float:
    """The star tracker's error; infinite if the image was not solved."""
    assert shot.report is not None
    estimate = shot.report.attitude.cam_from_ref
    if estimate is None:
        return math.inf
    return float(np.degrees((estimate * shot.truth.cam_from_lab.inv()).magnitude()))


def draw(fig: Any, run: BumpRun) -> None:
    axes = fig.subplots()
    rows = experiments()["afit-bump"].rows
    for axis in range(3):
        error_deg = np.abs(run.imu_deg[:, axis])
        color = INK[(0, 2, 5)[axis]]
        axes.plot(run.t_s, error_deg, color=color, label=f"IMU, theta_{axis + 1}")
        published = rows[f"theta_{axis + 1}"].published
        label = f"published, theta_{axis + 1}"
        axes.plot(run.t_s[-1] + 0.15, published, "os^"[axis], color=INK[1], label=label)
    axes.plot(
        run.t_s, run.filter_deg, color=INK[6], ls="--", label="filter with star tracker"
    )
    axes.set(xlabel="time (s)", ylabel="error (deg)")
    axes.legend(ncols=2)


HOLD_MIN = 0.75  # time at a position: fitted, see `draw_holds`
HOLDS_MIN = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
SITE_AZIMUTH_DEG = "0"  # of the lab's x axis: fitted
KNOT_S = 0.05  # the vehicle turns at 2 deg/s at most
STATISTICS: dict[str, Callable[..., Any]] = {
    "min": np.min,
    "max": np.max,
    "mean": np.mean,
    "sd": sample_std,
}
ANGLES = {"theta_1": [0], "theta_2": [1], "theta_3": [2], "averaged": [0, 1, 2]}  # columns
CAUSE_CAMERA = "two LEDs under a rolling shutter"
CAUSE_IMU = f"{CAUSE_CAMERA}, an LN-200 with {HOLD_MIN} min per position"
CAUSE_BUMP = f"{CAUSE_IMU}, position 5 bumped"


class AlgorithmErrors(NamedTuple):
    """D sets of five images, one per position; the catalog is from the home position's image.

    Attributes
    ----------
    error_deg
        (D, 5, 3) roll, pitch, yaw by the algorithm minus the true ones
    named
        Number of images with all LEDs identified correctly, and number of images
    """

    error_deg: Floats
    named: tuple[int, int]


class AllCauses(NamedTuple):
    """Results with all causes simulated together.

    Attributes
    ----------
    error_deg
        (K, 5, 3) attitude by the algorithm minus that of the IMU
    images
        Number of independent draws for positions 1 to 4 (the fewer of images and IMUs)
    bumps
        Number of independent draws for position 5 (the fewest of images, IMUs and bumps)
    earth_deg
        (5, 3) what an uncorrected Earth rate in the IMU would add
    """

    error_deg: Floats
    images: int
    bumps: int
    earth_deg: Floats


def tables_10_to_15(options: ExperimentOptions) -> ExperimentResult:
    """Tables 10-15: with clean images and a perfect IMU; with camera noise, IMU drift and the bump as the cause."""
    images = options.trials(50, 3)
    units = options.trials(60, 8)
    clean = algorithm_errors(build_test3(), images, LEDS, random_stream(options.seed, 0))
    options.watch(1, 4)
    camera = algorithm_errors(
        build_test3(FITTED_IMAGING), images, 2, random_stream(options.seed, 1)
    )
    options.watch(2, 4)
    holds = (HOLD_MIN,) if options.quick else HOLDS_MIN
    drift_deg = {
        hold: imu_drift(hold, units, random_stream(options.seed, 2)) for hold in holds
    }
    drift_without_earth_deg = imu_drift(
        HOLD_MIN, units, random_stream(options.seed, 2), earth=False
    )
    options.watch(3, 4)
    bump_runs = simulate_bumps(FITTED_BUMP, options.trials(10, 3), options.seed)
    bump_deg = np.array([run.imu_deg[-1] for run in bump_runs])
    earth_deg = (drift_without_earth_deg - drift_deg[HOLD_MIN]).mean(axis=0)
    causes = combine_causes(camera.error_deg, drift_without_earth_deg, bump_deg, earth_deg)
    results = tables_10_to_14(clean.error_deg, causes) | table_15(clean.error_deg, causes)
    worst = [np.abs(one).max(axis=(1, 2)) for one in (clean.error_deg, causes.error_deg)]
    results["worst"] = with_draws(CAUSE_BUMP, worst[0], worst[1], causes.bumps)
    named, named_with_noise = (percent(proportion(*one.named)) for one in (clean, camera))
    results["named"] = RowResult(named, cause=Cause(CAUSE_CAMERA, named_with_noise))
    change, change_with_causes = (
        one[:, 3, 0] - one[:, 2, 0] for one in (clean.error_deg, causes.error_deg)
    )
    with_earth = change_with_causes.mean() + earth_deg[3, 0] - earth_deg[2, 0]
    results["turns_back"] = with_draws(
        CAUSE_IMU, change, change_with_causes, causes.images, with_earth
    )
    drawings = (
        FigureDrawing(
            "Tables 10-14: the algorithm minus the IMU, and 95 % of ours with camera noise, the IMU's drift and the"
            " bump; diamonds: with the Earth rate in the IMU too.",
            lambda fig: draw_differences(fig, causes),
            (7.4, 3.5),
        ),
        FigureDrawing(
            "Errors of an IMU that measures the Earth rate against the time at a position, and those of Table 15.",
            lambda fig: draw_holds(fig, drift_deg),
            (7.4, 3.3),
        ),
    )
    return ExperimentResult(results, drawings)


def with_draws(
    cause: str,
    clean: Floats,
    with_causes: Floats,
    draws: int,
    with_earth: float | None = None,
) -> RowResult:
    """Prediction intervals of clean values, and of those with the causes, which have fewer independent `draws`.

    Parameters
    ----------
    with_earth
        The value if the IMU also contained the Earth rate, for the note
    """
    note = (
        "" if with_earth is None else f"with the Earth rate in the IMU too: {with_earth:.3f}"
    )
    return RowResult(
        prediction_interval(clean),
        note,
        Cause(cause, prediction_interval(with_causes, draws)),
    )


def combine_causes(
    camera_deg: Floats, drift_deg: Floats, bump_deg: Floats, earth_deg: Floats
) -> AllCauses:
    """Combine images, IMUs and bumps by cycling through each; a bump adds to the IMU's error at position 5."""
    counts = len(camera_deg), len(drift_deg), len(bump_deg)
    draw = np.arange(max(counts))
    # The algorithm's errors minus the IMU's, each sequence repeated to the length of the longest.
    error_deg = camera_deg[draw % counts[0]] - drift_deg[draw % counts[1]]
    error_deg[:, -1] -= bump_deg[draw % counts[2]]
    return AllCauses(error_deg, min(counts[:2]), min(counts), earth_deg)


def tables_10_to_14(clean: Floats, causes: AllCauses) -> Results:
    """Tables 10-14: the algorithm's angles minus the IMU's."""
    results: Results = {}
    for position, axis in np.ndindex(clean.shape[1:]):
        key = f"position_{position + 1}_theta_{axis + 1}"
        ours = clean[:, position, axis]
        if position == HOME:
            results[key] = prediction_interval(ours)
            continue
        error_deg = causes.error_deg[:, position, axis]
        with_earth = error_deg.mean() + causes.earth_deg[position, axis]
        last = position == len(IMU_DEG) - 1
        name, draws = (CAUSE_BUMP, causes.bumps) if last else (CAUSE_IMU, causes.images)
        results[key] = with_draws(name, ours, error_deg, draws, with_earth)
    return results


def table_15(clean: Floats, causes: AllCauses) -> Results:
    """Minimum, maximum, mean and standard deviation (n - 1) of an angle's five differences, and the angles' average."""
    results: Results = {}
    cases = (clean, causes.error_deg, causes.error_deg + causes.earth_deg)
    for name, statistic in STATISTICS.items():
        ours, with_causes, with_earth = (statistic(np.abs(one), axis=1) for one in cases)
        for key, columns in ANGLES.items():
            clean_deg, causes_deg, earth_deg = (
                one[:, columns].mean(axis=1) for one in (ours, with_causes, with_earth)
            )
            results[f"{name}_{key}"] = with_draws(
                CAUSE_BUMP, clean_deg, causes_deg, causes.bumps, earth_deg.mean()
            )
    return results


# The camera.


def algorithm_errors(
    lab: Lab, images: int, lights: int, rng: np.random.Generator
) -> AlgorithmErrors:
    """The thesis's processing: eqs 43-44, SAA with Table 9's epsilons, QUEST with the `lights` brightest LEDs.

    Parameters
    ----------
    images
        Number of images per position
    """
    sightings = [
        photograph(lab, n, lab_from_body(angles), images, rng)
        for n, angles in enumerate(IMU_DEG)
    ]
    sets = list(zip(*sightings, strict=False))
    error_deg = np.empty((len(sets), len(IMU_DEG), 3))
    correct = 0
    for n_set, sightings_of_set in enumerate(sets):
        # The home image is the map: all attitudes of a set are relative to it, as in the thesis (3.6.4).
        home = sightings_of_set[HOME]
        catalog = build_pair_catalog(
            unit(light_positions_m(lab, home.xy_px)), home.brightness
        )
        for n, sighting in enumerate(sightings_of_set):
            order = np.argsort(-sighting.brightness, kind="stable")
            vectors = unit(light_positions_m(lab, sighting.xy_px[order]))
            star = identify_leds(vectors, sighting.brightness[order], catalog)
            correct += int(np.array_equal(star, order))
            rows = order[:lights]
            body_from_home = quest(vectors[:lights], catalog.vectors[rows], np.ones(lights))
            error_deg[n_set, n] = euler_deg(body_from_home.inv()) - IMU_DEG[n]
    return AlgorithmErrors(error_deg, (correct, len(sets) * len(IMU_DEG)))


def identify_leds(vectors: Floats, magnitude: Floats, catalog: PairCatalog) -> Ints:
    """(N,) catalog row of each observed LED, brightest first, -1 for none, by SAA from the two brightest.

    As in the thesis, the hypothesis of lowest cost is accepted. Our own SAA also requires that a match is significant
    against chance, which five LEDs with errors of 2 mm in a cross of 8 mm rarely are.
    """
    gates = Gates(
        EPSILON_SEP_ARCSEC * ARCSEC_RAD, EPSILON_POS_M / (48 * INCH_M), EPSILON_MAG, 0.0
    )
    stars = SearchInput(
        vectors, magnitude, catalog.vectors, catalog.magnitude, catalog.cells, gates
    )
    separation_rad = float(2 * np.arcsin(np.linalg.norm(vectors[0] - vectors[1]) / 2))
    tolerance_rad = gate_rad(gates, separation_rad)
    begin, end = candidates(
        catalog, separation_rad - tolerance_rad, separation_rad + tolerance_rad
    )
    star, cost, _ = match_assumptions(
        stars, build_primary(stars, 0, 1), catalog.pair[begin:end]
    )
    return star[cost.argmin()].astype(np.int64) if len(cost) else np.full(len(vectors), -1)


# The IMU.


def imu_drift(
    hold_min: float, units: int, rng: np.random.Generator, earth: bool = True
) -> Floats:
    """(U, 5, 3) error of U random IMUs at the end of each stay: roll, pitch, yaw in degrees.

    The vehicle follows Test 3's commanded attitudes exactly; each IMU has its own hardware seed.

    Parameters
    ----------
    earth
        Measure the Earth rate and do not correct for it
    """
    lab = build_lab(loader.load("afit_test3_ideal", {"site.x_azimuth_deg": SITE_AZIMUTH_DEG}))
    config = lab.scene.vehicle.imu
    assert config is not None
    legs = lab.scene.motion.maneuver[1:]  # the IMU is zeroed as the vehicle leaves home
    timed_legs = [
        leg.model_copy(update={"duration_s": 60 * hold_min}) if leg.kind == "hold" else leg
        for leg in legs
    ]
    reference = guidance.plan(
        lab.scene.motion.model_copy(update={"maneuver": tuple(timed_legs)})
    )
    t_s = np.arange(0, reference.duration_s, KNOT_S)
    wxyz, rate, _ = (
        np.array(column) for column in zip(*map(reference.state_at, t_s), strict=True)
    )
    earth_rad_s = imu.earth_rate_lab_rad_s(lab.scene.site) * earth
    vehicle = lab.vehicle
    increments = imu.ideal_increments(
        t_s,
        wxyz,
        rate,
        t_s[1:],
        KNOT_S,
        imu_position_m(vehicle),
        vehicle.gravity_m_s2,
        earth_rad_s,
    )
    # Every second start is the end of a hold, and the first that of home.
    stops = np.searchsorted(t_s[1:], np.array(reference.start_s[::2]) - KNOT_S)
    errors_deg = []
    for seed in rng.integers(2**31, size=units).tolist():
        unit_config = config.model_copy(update={"hardware_seed": seed})
        measured = imu.Imu.from_config(unit_config, rng).measure(increments)
        errors_deg.append(integrated_angles(measured, stops) - IMU_DEG)
    return np.array(errors_deg)


def integrated_angles(measured: imu.Increments, stops: Ints) -> Floats:
    """(5, 3) roll, pitch, yaw in degrees from integrated IMU increments, after each number of samples in `stops`."""
    wxyz = np.array([1.0, 0.0, 0.0, 0.0])
    attitudes = []
    for increments in np.split(measured.angle_rad, stops)[: len(stops)]:
        wxyz = imu.integrate_attitude(wxyz, increments, np.zeros(3), measured.step_s)
        attitudes.append(wxyz)
    return euler_deg(Rotation.from_quat(attitudes, scalar_first=True))


# Figures.


def plot_quantiles(axes: Any, x: Any, values: Floats, **style: Any) -> None:
    """Median and central 95 % of each column."""
    low, median, high = np.quantile(values, [0.025, 0.5, 0.975], axis=0)
    axes.errorbar(x, median, [median - low, high - median], color=INK[0], **style)


def draw_differences(fig: Any, causes: AllCauses) -> None:
    position = np.arange(1, len(IMU_DEG) + 1)
    published_deg = np.subtract(ALGORITHM_DEG, IMU_DEG)
    panels = fig.subplots(1, 3, sharey=True)
    for axis, axes in enumerate(panels):
        error_deg = causes.error_deg[:, :, axis]
        plot_quantiles(
            axes, position + 0.1, error_deg, fmt="s", ms=4, label="ours with the causes"
        )
        earth = error_deg.mean(axis=0) + causes.earth_deg[:, axis]
        axes.plot(
            position + 0.25, earth, "D", ms=4, color=INK[5], label="and the Earth's turning"
        )
        axes.plot(
            position - 0.1, published_deg[:, axis], "o", color=INK[1], label="published"
        )
        axes.set(xlabel="position", xticks=position, title=f"theta_{axis + 1}")
    panels[0].set(ylabel="algorithm less IMU (deg)")
    fig.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)


def draw_holds(fig: Any, drift: dict[float, Floats]) -> None:
    """Mean absolute difference of roll and of pitch against the duration of a stay."""
    published = np.abs(np.subtract(ALGORITHM_DEG, IMU_DEG)).mean(axis=0)
    for axis, axes in enumerate(fig.subplots(1, 2, sharey=True)):
        mean = [np.abs(error_deg[:, :, axis]).mean(axis=1) for error_deg in drift.values()]
        plot_quantiles(
            axes, list(drift), np.transpose(mean), fmt="s-", label="ours, 95 % of IMUs"
        )
        axes.axhline(published[axis], color=INK[1], label="published")
        axes.set(xlabel="minutes at a position", title=f"theta_{axis + 1}")
    fig.axes[0].set(ylabel="mean difference (deg)")
    fig.axes[0].legend(loc="upper left")
