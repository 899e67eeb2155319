"""PTASE's Monte Carlo simulation (Fialho & Saotome 2005, section 4, table 1).

Each run draws a uniform random attitude, projects the catalog's stars into a field of 20 x 20 degrees, adds noise to
their directions and magnitudes, and identifies them with one of the paper's four algorithm versions. Errors follow
the paper's definitions (eqs. 7-9). No images are rendered.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from estimator.catalog import pair_index, published_catalogs
from estimator.catalog.pair_index import PairIndex
from estimator.core.checks import Ints
from estimator.identification.chance import ACCEPT_LOG10_CHANCE
from estimator.identification.published.fialho import (
    MIN_FRACTION_BASIC,
    MIN_FRACTION_FALSE_STARS,
    VERSIONS,
    FialhoOptions,
    search,
    search_options,
)
from estimator.identification.solver_options import Options
from skysim.core.constants import ARCSEC_RAD
from skysim.core.jit import jit
from skysim.core.paths import CATALOGS
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.papers.compare import (
    Cause,
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    RowResult,
    bootstrap_interval,
    percent,
    sample_std,
)
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import WRONG_RAD, Summary, proportion
from skysim.results.plots import INK, MARKS

HALF_FIELD_TAN = float(np.tan(np.radians(10)))
SIGMA_RAD = 3 * ARCSEC_RAD
SIGMA_MAG = 0.25
TOLERANCE_RAD = (
    5 * SIGMA_RAD
)  # one star in 3e5 is outside; failures are due to the magnitude gate
DIAGONAL_RAD = 2 * np.arctan(np.sqrt(2) * HALF_FIELD_TAN)
DOUBLES_RAD = 30 * ARCSEC_RAD
FITTED_LIMIT_MAG = 5.1
FITTED_GATE_SIGMAS = 3.2
SIMULATION_RUNS = 1000
# Table 1: success (%), mean attitude, roll and axis error (arcsec) of its five simulations.
TABLE_1 = np.array(experiments()["ptase-table-1"].data["simulations"])


def catalog(limit_mag: float) -> PairIndex:
    """Hipparcos by READCAT and PROC_CAT to a limiting magnitude, doubles within 30 arcsec merged, with a pair index."""
    stars = published_catalogs.proc_cat(
        published_catalogs.read_cat(CATALOGS / "hipparcos_hp6.5.ecsv", limit_mag), DOUBLES_RAD
    )
    return pair_index.build(stars.vectors, float(DIAGONAL_RAD), magnitude=stars.magnitude)


def version(name: str) -> FialhoOptions:
    """Parameters of one of the paper's versions, as in estimator.identification.published.fialho."""
    options = Options(epsilon_mag=SIGMA_MAG)
    falls_back = name in ("fialho_3", "fialho_4")
    fraction = MIN_FRACTION_FALSE_STARS if falls_back else MIN_FRACTION_BASIC
    return search_options(TOLERANCE_RAD, options, fraction, name != "fialho_1", falls_back)


@jit
def simulate(
    index: PairIndex, parameters: FialhoOptions, runs: int, seed: int
) -> tuple[Floats, Floats, Ints]:
    """True and estimated R_cam_from_icrs (runs, 3, 3), the latter NaN if unsolved; (runs,) number of stars in view.

    Attitudes are uniform over all rotations (see `_attitude`).
    """
    np.random.seed(seed)  # noqa: NPY002  (numba has no other generator that is seeded inside)
    true = np.empty((runs, 3, 3))
    estimated = np.full((runs, 3, 3), np.nan)
    stars = np.zeros(runs, np.int64)
    for run in range(runs):
        true[run] = _attitude()
        directions, magnitudes = _field(true[run], index)
        stars[run] = len(directions)
        if len(directions) < 4:
            continue
        solution = search(directions, magnitudes, index, parameters)
        if solution[3] <= ACCEPT_LOG10_CHANCE:
            estimated[run] = solution[2]
    return true, estimated, stars


@jit
def _attitude() -> Floats:
    """A rotation matrix uniform over all rotations: its quaternion is a normalized vector of four normal numbers."""
    a, b, c, d = np.random.standard_normal(4)  # noqa: NPY002
    length = np.sqrt(a * a + b * b + c * c + d * d)
    a = a / length
    b = b / length
    c = c / length
    d = d / length
    R = np.empty((3, 3))
    R[0, 0] = 1 - 2 * (c * c + d * d)
    R[0, 1] = 2 * (b * c - a * d)
    R[0, 2] = 2 * (b * d + a * c)
    R[1, 0] = 2 * (b * c + a * d)
    R[1, 1] = 1 - 2 * (b * b + d * d)
    R[1, 2] = 2 * (c * d - a * b)
    R[2, 0] = 2 * (b * d - a * c)
    R[2, 1] = 2 * (c * d + a * b)
    R[2, 2] = 1 - 2 * (b * b + c * c)
    return R


@jit
def _field(R: Floats, index: PairIndex) -> tuple[Floats, Floats]:
    """PTASE's gen_sia_input2: noisy directions and magnitudes of the stars in the field, brightest first."""
    directions = np.empty((len(index.vectors), 3))
    magnitudes = np.empty(len(index.vectors))
    # Cosine of the angle to the field's corner: rejects most stars by their z alone.
    min_cos = 1 / np.sqrt(1 + 2 * HALF_FIELD_TAN**2)
    count = 0
    for star in range(len(index.vectors)):
        u, v, w = index.vectors[star]
        z = R[2, 0] * u + R[2, 1] * v + R[2, 2] * w
        if z < min_cos:
            continue
        x = R[0, 0] * u + R[0, 1] * v + R[0, 2] * w
        y = R[1, 0] * u + R[1, 1] * v + R[1, 2] * w
        if abs(x) > HALF_FIELD_TAN * z or abs(y) > HALF_FIELD_TAN * z:
            continue
        x += SIGMA_RAD * np.random.standard_normal()  # noqa: NPY002
        y += SIGMA_RAD * np.random.standard_normal()  # noqa: NPY002
        z += SIGMA_RAD * np.random.standard_normal()  # noqa: NPY002
        length = np.sqrt(x * x + y * y + z * z)
        directions[count, 0] = x / length
        directions[count, 1] = y / length
        directions[count, 2] = z / length
        magnitudes[count] = index.magnitude[star] + SIGMA_MAG * np.random.standard_normal()  # noqa: NPY002
        count += 1
    order = np.argsort(magnitudes[:count])
    return directions[:count][order], magnitudes[:count][order]


class RunErrors(NamedTuple):
    """(N,) errors of the solved runs in arcsec, as the paper defines them (eqs. 7-9), and the rotation angle.

    Attributes
    ----------
    attitude
        |M_true - M_est|, Frobenius norm, sqrt(2) times the rotation angle for small angles
    angle
        Rotation angle of the error
    roll
        |phi_true - phi_est| of eq. 5's angle, which counts from north
    axis
        |Z_true - Z_est|
    """

    attitude: Floats
    angle: Floats
    roll: Floats
    axis: Floats


def errors(true: Floats, estimated: Floats) -> RunErrors:
    """Errors of (N, 3, 3) attitude matrices.

    The rotation angle is 2 arcsin(|M_est - M_true| / sqrt(8)). Our image axes differ from those of eq. 5 by a constant
    rotation, which cancels in the roll error.
    """
    norm = np.linalg.norm(estimated - true, axis=(1, 2))
    angle = 2 * np.arcsin(np.minimum(norm / np.sqrt(8), 1))
    phi = [np.arctan2(R[:, 0, 2], R[:, 1, 2]) for R in (true, estimated)]
    roll = np.abs(np.mod(phi[1] - phi[0] + np.pi, 2 * np.pi) - np.pi)
    axis = np.linalg.norm(estimated[:, 2] - true[:, 2], axis=1)
    return RunErrors(*(error / ARCSEC_RAD for error in (norm, angle, roll, axis)))


# Table 1.


class VersionRuns(NamedTuple):
    """Runs of one version: number of runs, of solved ones, of wrong ones, and the errors of the correct solutions."""

    runs: int
    solved: int
    wrong: int
    right: RunErrors


def run_version(
    index: PairIndex, parameters: FialhoOptions, runs: int, seed: int
) -> VersionRuns:
    """Simulate and count. As in the paper, a wrong solution counts as solved."""
    true, estimated, _ = simulate(index, parameters, runs, seed)
    is_solved = np.isfinite(estimated[:, 0, 0])
    all_errors = errors(true[is_solved], estimated[is_solved])
    is_wrong = all_errors.angle > WRONG_RAD / ARCSEC_RAD
    right = RunErrors(*(values[~is_wrong] for values in all_errors))
    return VersionRuns(runs, int(is_solved.sum()), int(is_wrong.sum()), right)


def table_1(options: ExperimentOptions) -> ExperimentResult:
    """Table 1: all four versions, and the second with a wider magnitude gate as the cause."""
    index = catalog(FITTED_LIMIT_MAG)
    by_version = {}
    seeds = random_stream(options.seed, 1).integers(2**31, size=len(VERSIONS) + 1)
    for n, (name, seed) in enumerate(zip(VERSIONS, seeds, strict=False)):
        runs = options.trials(
            5000 if name == "fialho_1" else 10_000, 300 if name == "fialho_1" else 1000
        )
        by_version[name] = run_version(index, version(name), runs, int(seed))
        options.watch(n + 1, len(VERSIONS) + 1)
    wider_parameters = version("fialho_2")._replace(gate_mag=FITTED_GATE_SIGMAS * SIGMA_MAG)
    wider_gate = run_version(
        index, wider_parameters, options.trials(10_000, 1000), int(seeds[-1])
    )
    cause = Cause(
        f"a gate for magnitudes of {FITTED_GATE_SIGMAS} sigma, fitted",
        success_percent(wider_gate),
    )
    results: Results = {}
    for name, runs_of_version in by_version.items():
        number = name[-1]
        success = success_percent(runs_of_version)
        results[f"success_{number}"] = RowResult(
            success, cause=cause if number in "12" else None
        )
        for statistic, values in runs_of_version.right._asdict().items():
            results[f"{statistic}_{number}"] = bootstrap_interval(values, np.mean)
    versions = by_version.values()
    results["wrong"] = proportion(
        sum(one.wrong for one in versions), sum(one.runs for one in versions)
    )
    results |= scatter(by_version["fialho_2"])
    return ExperimentResult(results, drawings(by_version))


def success_percent(runs_of_version: VersionRuns) -> Summary:
    """Success rate in percent."""
    return percent(proportion(runs_of_version.solved, runs_of_version.runs))


def scatter(runs_of_version: VersionRuns) -> Results:
    """Standard deviation of a simulation's mean over 1000 runs: that of one run divided by sqrt(1000)."""
    values = {
        name: getattr(runs_of_version.right, name) for name in ("attitude", "roll", "axis")
    }
    values["success"] = np.where(
        np.arange(runs_of_version.runs) < runs_of_version.solved, 100.0, 0.0
    )

    def std_of_mean(samples: Floats, axis: int = -1) -> Any:
        return sample_std(samples, axis) / np.sqrt(SIMULATION_RUNS)

    return {
        f"{name}_sd": bootstrap_interval(samples, std_of_mean)
        for name, samples in values.items()
    }


def drawings(by_version: dict[str, VersionRuns]) -> tuple[FigureDrawing, ...]:
    second = by_version["fialho_2"].right
    return (
        FigureDrawing(
            "Histogram of the attitude error of alg_ide_mf1_2, which PTASE writes into its log file.",
            lambda fig: draw_histogram(fig, second),
        ),
        FigureDrawing(
            "Every simulation of a thousand runs: the paper's five, and ours of all versions.",
            lambda fig: draw_simulations(fig, by_version),
        ),
    )


def draw_histogram(fig: Any, right: RunErrors) -> None:
    """Histogram of the Frobenius norm, with our mean and the published one."""
    axes = fig.subplots()
    bins = np.arange(0, 25.5, 0.5)
    axes.hist(
        np.minimum(right.attitude, bins[-1]), bins, color=INK[0], alpha=0.5, label="ours"
    )
    axes.axvline(
        right.attitude.mean(), color=INK[0], label=f"ours, mean {right.attitude.mean():.2f}"
    )
    published = experiments()["ptase-table-1"].rows["attitude_2"].published
    axes.axvline(published, color=INK[1], ls="--", label=f"published mean {published:.2f}")
    axes.set(
        xlabel="attitude error |M true - M est| (arcsec; the last bin is all beyond)",
        ylabel="runs",
    )
    axes.legend()


def draw_simulations(fig: Any, by_version: dict[str, VersionRuns]) -> None:
    """Mean attitude error against mean roll error of each simulation."""
    axes = fig.subplots()
    for n, (name, runs_of_version) in enumerate(by_version.items()):
        batches = max(1, runs_of_version.runs // SIMULATION_RUNS)
        means = [
            [batch.mean() for batch in np.array_split(values, batches)]
            for values in (runs_of_version.right.roll, runs_of_version.right.attitude)
        ]
        axes.plot(
            *means, MARKS[n], color=INK[(0, 2, 3, 4)[n]], alpha=0.7, label=f"ours, {name}"
        )
    axes.plot(TABLE_1[:, 2], TABLE_1[:, 1], "*", color=INK[1], ms=9, label="published")
    axes.set(xlabel="mean roll error (arcsec)", ylabel="mean |M true - M est| (arcsec)")
    axes.legend()
