"""Variance components of an attitude error: which part of its mean square belongs to which cause.

The error about one axis is measured in a crossed and nested design: fields x units x thermal states, in each of these
combinations the same attitudes a few pixels apart, at each some frames with new noise. Fields, units, attitudes
and noise are drawn, and their effects are random (Searle, Casella & McCulloch 1992, Variance Components, chapter 4).
The thermal states are the whole history at equal steps, a fixed factor: its variance is the mean square over them.
All terms are estimated without bias, and their sum is the mean square of the design's errors. A term may come out
slightly negative where it is smaller than its error.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Record
from skysim.experiments.datasheet.cells import MIN_FIELDS, MeasuredFrames, require_fields
from skysim.results.metrics import CONFIDENCE

RESAMPLES = 2000


class Components(NamedTuple):
    """Mean square of each term of the error, in squared units of the error; see `contributions`."""

    bias: Any
    thermal: Any
    field: Any
    pixel: Any
    temporal: Any


class Bounded(NamedTuple):
    """A value with its interval at `metrics.CONFIDENCE`."""

    value: float
    low: float
    high: float


def contributions(errors: Floats) -> Components:
    """Each field's share in the error's terms, whose mean over the fields is the estimate.

    Parameters
    ----------
    errors
        (..., fields, units, states, attitudes, frames), at least three fields, two attitudes and frames

    Returns
    -------
    Components
        (..., fields) each. bias: constant over fields, attitudes and time, mean's square and variance among units;
        thermal: all that changes with the thermal state; field: changes from field to field, for one unit (catalog,
        distortion, map of the LEDs, geometry of the stars); pixel: changes over a few pixels (centroiding, fixed
        pattern); temporal: changes from frame to frame
    """
    *_, attitudes, frames = errors.shape
    temporal = np.var(errors, axis=-1, ddof=1).mean(axis=(-1, -2, -3))
    cells = errors.mean(axis=-1)
    between = np.var(cells, axis=-1, ddof=1).mean(axis=(-1, -2))
    # The same attitudes are used in all states: this part of their variance is common to the states.
    common = np.var(cells.mean(axis=-2), axis=-1, ddof=1).mean(axis=-1)
    by_state = cells.mean(axis=-1)
    # The states are all that there are, so their mean square is divided by their number.
    thermal = np.var(by_state, axis=-1).mean(axis=-1) - (between - common) / attitudes
    means = by_state.mean(axis=-1)
    bias = common_square(means).mean(axis=-1)
    field = np.mean(means**2, axis=-1) - common / attitudes - bias
    return Components(bias, thermal, field, between - temporal / frames, temporal)


def common_square(means: Floats) -> Floats:
    """Each field's share in the square of the (..., fields, units) means' expectation over the fields.

    The square is the mean product of two different fields, which has no bias; shares are the jackknife's pseudo-values
    (Efron & Stein 1981).
    """
    fields = means.shape[-2]
    total = means.sum(axis=-2, keepdims=True)
    products = means * (total - means) / (fields - 1)
    square = products.mean(axis=-2, keepdims=True)
    return square + 2 * (fields - 1) / (fields - 2) * (products - square)


def bounded(shares: Floats, verdicts: int = 1) -> Bounded:
    """The mean of (fields,) shares with its bootstrap-t interval (Efron & Tibshirani 1993, section 12.5).

    Fields are the independent draws; units and states are those that were measured. The Student statistic of resampled
    fields has the skewness of the shares: fields with few stars err more. Shares without scatter have an interval of
    zero width, and fewer than MIN_FIELDS none.

    Parameters
    ----------
    verdicts
        Number of intervals that hold together at CONFIDENCE (Bonferroni)
    """
    count = len(shares)
    value = mean_known(shares)
    if count < MIN_FIELDS:
        return Bounded(float(value), math.nan, math.nan)
    drawn = shares[random_stream(1).integers(count, size=(RESAMPLES, count))]
    deviation = drawn.std(axis=1)
    # A sample of one field many times over tells nothing of the scatter.
    varied = deviation > 1e-6 * shares.std()
    if not varied.any():
        return Bounded(*[float(value)] * 3)
    student = (drawn[varied].mean(axis=1) - value) / deviation[varied]
    tail = (1 - CONFIDENCE) / 2 / verdicts
    above, below = np.quantile(student, [1 - tail, tail]) * shares.std()
    return Bounded(float(value), float(value - above), float(value - below))


def mean_known(values: Floats, axis: int | tuple[int, ...] | None = None) -> Any:
    """The mean over the values that are finite; NaN where none is."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    return np.sum(np.where(known, values, 0.0), axis=axis) / np.where(count, count, np.nan)


def mean_square_ratio(numerator: Floats, denominator: Floats, verdicts: int = 1) -> Bounded:
    """Ratio of two mean squares that were measured in the same fields, with the interval of its logarithm.

    Parameters
    ----------
    numerator, denominator
        (fields,) mean squares; fields without one of them are left out
    verdicts
        As for `bounded`
    """
    known = np.isfinite(numerator) & np.isfinite(denominator)
    if not known.any():
        return Bounded(math.nan, math.nan, math.nan)
    top, bottom = (one[known] / one[known].mean() for one in (numerator, denominator))
    ratio = float(numerator[known].mean() / denominator[known].mean())
    ends = np.exp(bounded(top - bottom, verdicts))
    return Bounded(*(ratio * ends).tolist())


# The terms of a datasheet: their sizes, their sum against the total, and the effect of each cause.


GROUPS = {"across": slice(0, 2), "about": slice(2, 3)}  # axes across and about the boresight

TERMS = {
    "bias": "mean over fields, attitudes and time, and its scatter among units",
    "thermal": "changes with the thermal state",
    "field": "field-of-view spatial: changes from field to field",
    "pixel": "pixel spatial: changes over a few pixels",
    "temporal": "temporal noise: changes from frame to frame",
}


class TermTable(NamedTuple):
    """The terms about one group of axes.

    Attributes
    ----------
    squares
        Mean squares of terms and total, arcsec^2 of one axis, with intervals
    signs
        1 where a term is above 0, -1 where it is below, 0 where the fields do not tell: at
        CONFIDENCE for all terms of both groups together
    ratio
        Sum of the terms over the mean square of independent frames, whose intervals hold
        together for both groups
    """

    squares: dict[str, Bounded]
    signs: dict[str, int]
    ratio: Bounded

    @property
    def dominant(self) -> str:
        """The largest term."""
        return max(Components._fields, key=lambda name: self.squares[name].value)


def term_errors(sheet: MeasuredFrames, least: int = MIN_FIELDS) -> tuple[Floats, np.ndarray]:
    """(3, fields, units, states, attitudes, frames) errors of the fields in which all frames are solved, and which.

    Raises
    ------
    InputError
        Where they are fewer than `least`.
    """
    rows = sheet.rows("terms")
    designer = sheet.designer
    size = sheet.size
    errors = sheet.errors(rows)
    shape = (3, designer.units, designer.states, size.attitudes, size.frames, size.fields)
    errors = np.moveaxis(errors.reshape(shape), -1, 1)
    solved = np.asarray(np.isfinite(errors).all(axis=(0, 2, 3, 4, 5)))
    require_fields(
        size.fields,
        int(solved.sum()),
        least,
        f"{solved.sum()} of them are solved in all {len(rows)} frames of the error terms",
    )
    return errors[:, solved], solved


def term_tables(sheet: MeasuredFrames) -> dict[str, TermTable]:
    """The terms across and about the boresight."""
    errors, solved = term_errors(sheet)
    at_once = np.moveaxis(sheet.errors(sheet.rows("total")), 1, 2)[:, solved]
    return {name: term_table(errors[axes], at_once[axes]) for name, axes in GROUPS.items()}


def term_table(errors: Floats, at_once: Floats) -> TermTable:
    """The terms of (axes, fields, ...) errors beside (axes, fields, draws) of other frames, NaN where not solved."""
    shares = {name: one.mean(axis=0) for name, one in contributions(errors)._asdict().items()}
    shares["total"] = sum(shares.values())
    verdicts = len(Components._fields) * len(GROUPS)
    return TermTable(
        {name: bounded(one) for name, one in shares.items()},
        {name: sign(bounded(one, verdicts)) for name, one in shares.items()},
        mean_square_ratio(shares["total"], mean_known(at_once**2, (0, 2)), len(GROUPS)),
    )


def sign(value: Bounded, zero: float = 0.0) -> int:
    """1 where an interval is above `zero`, -1 where it is below, 0 where it holds it or is not known."""
    return int(value.low > zero) - int(value.high < zero)


def mean_errors(sheet: MeasuredFrames) -> list[Bounded]:
    """The mean error about each axis of the camera, arcseconds, with its interval."""
    errors, _ = term_errors(sheet)
    means = errors.reshape(*errors.shape[:2], -1).mean(axis=2)
    return [bounded(one) for one in means]


def squares_by_field(sheet: MeasuredFrames, rows: list[int], axes: slice) -> Floats:
    """(fields,) mean squares of one axis, NaN in fields without an attitude."""
    return mean_known(sheet.errors(rows)[axes] ** 2, (0, 1))


def causes(sheet: MeasuredFrames) -> list[Record]:
    """Each change of the scene with the ratio of the mean square after it to that of the unchanged scene.

    Across and about the boresight, the least first.
    """
    found = []
    for name in sheet.levels("cause", "cause"):
        rows = sheet.rows("cause", cause=name)
        draws = sheet.rows("total")
        before = [draw for draw in draws if sheet.cells[draw].levels["draw"] < len(rows)]
        row: Record = {"cause": name}
        for group, axes in GROUPS.items():
            squares = squares_by_field(sheet, rows, axes)
            row[group] = mean_square_ratio(squares, squares_by_field(sheet, before, axes))
        found.append(row)
    return sorted(found, key=lambda one: one["across"].value + one["about"].value)
