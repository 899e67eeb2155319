"""Fit the constants of the error model (`error_model`) to the frames of a datasheet, test the fit, and write it."""

import math
from itertools import combinations, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from skysim.core.files import make_folder, write_json, write_text
from skysim.core.paths import DATA
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Record
from skysim.experiments.datasheet.cells import MIN_FIELDS, MODEL_FIELDS, MeasuredFrames
from skysim.experiments.datasheet.error_model import AXES, ErrorModel
from skysim.experiments.datasheet.scene_changes import half_field_deg
from skysim.experiments.datasheet.variance_components import (
    GROUPS,
    common_square,
    contributions,
    mean_known,
    term_errors,
)
from skysim.experiments.study.execution import trials
from skysim.results.files.fmu import require_builder

GRID = 60  # number of correlation angles that are tried
LEAST_NOISE = 0.05  # of the mean square at a rate: noise below it cannot be separated from the slow terms


def constants(sheet: MeasuredFrames) -> Record:
    """The constants of `error_model.ErrorModel` for the scene of a datasheet."""
    errors, _ = term_errors(sheet)
    terms = contributions(errors)
    thermal, field, pixel, rest = (rms_of_term(one) for one in terms[1:])
    mean = unit_mean(sheet)
    across, about = (log_scale(*field_variances(sheet, axes)) for axes in GROUPS.values())
    by_rate = errors_by_rate(sheet)
    squares = np.array([mean_known(one**2, (1, 2)) for one in by_rate.values()])
    along = np.array(
        [along_square(sheet, rate, mean, found) for rate, found in by_rate.items()]
    )
    slow = np.square(mean) + field**2 + pixel**2 + np.outer(along / 2, [1.0, 1.0, 0.0])
    noise = np.sqrt(np.maximum(squares - slow, LEAST_NOISE * squares))
    return {
        "scene": sheet.scene.name,
        "axes": AXES,
        "mean": errors.mean(axis=(1, 2, 3, 4, 5)),
        "unit": unit_scatter(errors),
        "thermal": thermal,
        "field": field,
        "pixel": pixel,
        "scale": [across, across, about],
        "field_deg": field_angle_deg(sheet, field, pixel, mean),
        "pixel_deg": sheet.designer.pixel_deg,
        "scale_deg": half_field_deg(sheet.scene),
        "rates_deg_s": list(by_rate),
        "noise": [rest, *noise[1:]],
        "along": np.sqrt(along),
    }


def rms_of_term(shares: Floats) -> Floats:
    """(3,) root mean square of a term about x, y and roll from its (3, fields) shares; 0 where they are negative."""
    return np.sqrt(np.maximum(shares.mean(axis=-1), 0))


def unit_mean(sheet: MeasuredFrames) -> Floats:
    """(3,) mean error of the first unit in the first thermal state, which the frames at rates have."""
    return term_errors(sheet)[0][:, :, 0, 0].mean(axis=(1, 2, 3))


def unit_scatter(errors: Floats) -> Floats:
    """(3,) standard deviation among units of the (3, fields, units, states, attitudes, frames) errors' means."""
    means = errors.mean(axis=(3, 4, 5))
    apart = means - means.mean(axis=2, keepdims=True)
    return rms_of_term(common_square(apart).sum(axis=2) / max(means.shape[2] - 1, 1))


def log_scale(first: Floats, second: Floats) -> float:
    """Standard deviation of the logarithm of a field's noise variance, from two estimates of it in each of (F,) fields.

    A lognormal variance has E[v^2] / E[v]^2 = exp(scale^2). The estimates are of other frames, so their errors are
    independent and the mean of their product is E[v^2].
    """
    ratio = float(np.mean(first * second) / (first.mean() * second.mean()))
    return math.sqrt(math.log(max(ratio, 1.0)))


def field_variances(sheet: MeasuredFrames, axes: slice) -> tuple[Floats, Floats]:
    """Two estimates of the noise variance in each field: from the terms' frames, and from the sequence at rest."""
    errors, solved = term_errors(sheet)
    terms = np.var(errors[axes], axis=-1, ddof=1).mean(axis=(0, 2, 3, 4))
    rest = sequences(sheet, 0.0)[1][axes][:, :, solved]
    known = np.isfinite(rest).all(axis=(0, 1))
    return terms[known], np.var(rest[:, :, known], axis=1, ddof=1).mean(axis=0)


def rate_rows(sheet: MeasuredFrames, rate_deg_s: float) -> list[int]:
    """Rows of the sequence at a rate, or of the pair of frames at a faster one."""
    sequence = sheet.rows("sequence", rate_deg_s=rate_deg_s)
    return sequence or sheet.rows("rate", rate_deg_s=rate_deg_s)


def sequences(sheet: MeasuredFrames, rate_deg_s: float) -> tuple[list[int], Floats]:
    """Steps and (3, steps, fields) errors of the frames at one rate; those of a pair have the same attitude."""
    rows = rate_rows(sheet, rate_deg_s)
    return [sheet.cells[row].levels.get("step", 0) for row in rows], sheet.errors(rows)


def errors_by_rate(sheet: MeasuredFrames) -> dict[float, Floats]:
    """(3, frames, fields) errors by rate, rest first: of the sequences, and of the pairs of frames at faster rates.

    The last rate is the fastest one up to which at least MIN_FIELDS fields have a right attitude at every rate.
    """
    sequenced = sheet.levels("sequence", "rate_deg_s")
    faster = [rate for rate in sheet.levels("rate", "rate_deg_s") if rate > max(sequenced)]
    found = {rate: sequences(sheet, rate)[1] for rate in [*sequenced, *faster]}
    solved = takewhile(
        lambda rate: np.isfinite(found[rate][0]).any(axis=0).sum() >= MIN_FIELDS, found
    )
    return {rate: found[rate] for rate in solved}


def along_square(
    sheet: MeasuredFrames, rate_deg_s: float, mean: Floats, errors: Floats
) -> float:
    """Mean square of the errors about the rate's axis beyond that about the other axis across the boresight.

    It is 0 at rest, and where the difference is negative.

    Parameters
    ----------
    mean
        (3,) mean error, which is subtracted
    errors
        (3, frames, fields)
    """
    if not rate_deg_s:
        return 0.0
    angle_rad = axes_rad(sheet, rate_deg_s)
    x, y = errors[:2] - mean[:2, None, None]
    about = x * np.cos(angle_rad) + y * np.sin(angle_rad)
    other = y * np.cos(angle_rad) - x * np.sin(angle_rad)
    return max(float(mean_known(about**2) - mean_known(other**2)), 0.0)


def axes_rad(sheet: MeasuredFrames, rate_deg_s: float) -> Floats:
    """(fields,) angle of the axis of a rate from the camera's x toward y, as the trials at this rate draw it again."""
    row = rate_rows(sheet, rate_deg_s)[0]
    setup = trials.prepared_setup(sheet.spec, sheet.cells[row].settings)
    seeds = sheet.columns["seed"][[row]][0].tolist()
    rngs = (trials.streams(setup, seed)[0] for seed in seeds)
    x, y, _ = np.transpose([trials.attitude_and_axis(setup, rng)[1] for rng in rngs])
    return np.arctan2(y, x)


def lagged(sheet: MeasuredFrames, mean: Floats) -> tuple[Floats, Floats, Floats]:
    """Angles in degrees between frames of the sequences, the products of their errors, and the mean square at the rate.

    (M,) each. Products and squares are means over the fields and the axes across the boresight, in arcsec^2, after the
    mean error is subtracted.
    """
    angles = []
    products = []
    squares = []
    for rate in sheet.levels("sequence", "rate_deg_s"):
        steps, errors = sequences(sheet, rate)
        errors = errors[:2] - mean[:2, None, None]
        square = mean_known(errors**2)
        for first, second in combinations(range(len(steps)), 2):
            apart = steps[second] - steps[first]
            angles.append(rate * apart / sheet.scene.exposure.rate_hz)
            products.append(mean_known(errors[:, first] * errors[:, second]))
            squares.append(square)
    return np.array(angles), np.array(products), np.array(squares)


def field_angle_deg(
    sheet: MeasuredFrames, field: Floats, pixel: Floats, mean: Floats
) -> float:
    """The correlation angle of the field term, from a least-squares fit to the lagged products.

    The model is a exp(-angle / field_deg) + b exp(-angle / pixel_deg); the ratio a / b is that of the terms at rest.
    Each product is divided by the mean square at its rate, to which its error is proportional. Angles from one pixel to
    four fields are tried.
    """
    angles, products, squares = lagged(sheet, mean)
    pixel_deg = sheet.designer.pixel_deg
    weight = float(np.sum(field[:2] ** 2))
    total = weight + float(np.sum(pixel[:2] ** 2))
    trials_deg = np.geomspace(pixel_deg, 8 * half_field_deg(sheet.scene), GRID)
    if not total:
        return float(trials_deg[-1])
    found = products / squares
    by_pixel = (total - weight) * np.exp(-angles / pixel_deg)
    left = []
    for angle in trials_deg:
        by_field = weight * np.exp(-angles / angle)
        shape = (by_field + by_pixel) / total / squares
        fitted = shape * (shape @ found) / (shape @ shape)
        left.append(float(np.sum((found - fitted) ** 2)))
    return float(trials_deg[int(np.argmin(left))])


# Compare the model with frames that it was not fitted to: distribution by rate, and correlation.


DRAWN = 200_000  # number of errors drawn from the model for its distribution
APART_STEP_S = 1e12  # step between draws, so long that each is in another field
SLOW_DEG_S = 1e-7  # rate of such draws that have the noise at rest


class Agreement(NamedTuple):
    """How well the model agrees with other fields at one rate.

    Attributes
    ----------
    fitted
        The fields of the fit, even or odd
    frames
        Number of frames that are compared, one of each other field
    p_values
        (3,) of the Kolmogorov-Smirnov tests of x, y and roll
    correlation, expected_correlation
        Mean over the axes and over all pairs of frames of a sequence, or of the pair of one
        attitude at a faster rate: measured, and of the model
    """

    fitted: str
    rate_deg_s: float
    frames: int
    p_values: list[float]
    correlation: float
    expected_correlation: float


def some_fields(sheet: MeasuredFrames, fields: Any) -> MeasuredFrames:
    """The part of a sheet with the fields of these numbers."""
    columns = {name: values[:, fields] for name, values in sheet.columns.items()}
    return sheet._replace(columns=columns, size=sheet.size._replace(fields=len(fields)))


def agreements(sheet: MeasuredFrames) -> list[Agreement]:
    """The agreement of each half of the fields with the other, at all rates of its model, rest first.

    Raises
    ------
    InputError
        If too few fields are solved for two halves.
    """
    _, solved = term_errors(sheet, MODEL_FIELDS)
    # Every second of the solved fields, then of the others, so that both halves have terms.
    order = np.argsort(~solved, kind="stable")
    even, odd = (some_fields(sheet, order[first::2]) for first in range(2))
    return [
        agreement(of_one_unit(fitted), other, rate, name)
        for name, fitted, other in (("even", even, odd), ("odd", odd, even))
        for rate in errors_by_rate(fitted)
        if np.isfinite(sequences(other, rate)[1][:, 0]).any()
    ]


def of_one_unit(sheet: MeasuredFrames) -> ErrorModel:
    """The model of a sheet for the first of its units in its first thermal state."""
    none = [0.0, 0.0, 0.0]
    own = {"mean": unit_mean(sheet), "unit": none, "thermal": none}
    return ErrorModel(constants(sheet) | own)


def agreement(
    model: ErrorModel, sheet: MeasuredFrames, rate_deg_s: float, fitted: str
) -> Agreement:
    """The agreement with the frames at one rate."""
    steps, errors = sequences(sheet, rate_deg_s)
    first = errors[:, 0][:, np.isfinite(errors[:, 0]).all(axis=0)]
    # Each in another field and about another axis.
    rng = random_stream(1)
    axis_rad = rng.uniform(0, 2 * np.pi, DRAWN)
    rates = np.full(DRAWN, max(rate_deg_s, SLOW_DEG_S))
    drawn = model.draw(rates, APART_STEP_S, rng, axis_rad=axis_rad)
    p_values = [
        float(stats.ks_2samp(measured, modeled).pvalue)
        for measured, modeled in zip(first, drawn.T, strict=True)
    ]
    centered = errors - model.mean[:, None, None]
    squares = mean_known(centered**2, (1, 2))
    found = []
    expected = []
    for one, two in combinations(range(len(steps)), 2):
        products = mean_known(centered[:, one] * centered[:, two], 1)
        found.append(products / squares)
        angle_deg = rate_deg_s * (steps[two] - steps[one]) / sheet.scene.exposure.rate_hz
        expected.append(model.correlation(angle_deg, rate_deg_s))
    return Agreement(
        fitted,
        rate_deg_s,
        first.shape[1],
        p_values,
        float(np.mean(found)),
        float(np.mean(expected)),
    )


# Write the model: a Python module that needs NumPy alone, its constants as JSON, a co-simulation unit.


MODULE = "tracker_error.py"
CONSTANTS = "tracker_error.json"
HERE = Path(__file__).parent


def write_model(folder: Path, constants: Record) -> list[Path]:
    """Write the module and its constants to a folder; return their paths."""
    paths = [make_folder(folder) / MODULE, folder / CONSTANTS]
    write_text(paths[0], (HERE / "error_model.py").read_text(encoding="utf-8"))
    write_json(paths[1], constants)
    return paths


def write_fmu(folder: Path) -> Path:
    """Build the co-simulation unit (FMI 3) from a folder of `write_model`; return its path.

    It runs in a Python with NumPy on the machine of the importer.
    """
    require_builder("datasheet.fmu")
    from pythonfmu3.builder import FmuBuilder

    script = folder / "fmu_slave.py"
    write_text(script, (DATA / "fmu" / "fmu_slave.py").read_text(encoding="utf-8"))
    return Path(
        FmuBuilder.build_FMU(
            script, dest=folder, project_files=[folder / MODULE, folder / CONSTANTS]
        )
    )
