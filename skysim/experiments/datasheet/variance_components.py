"""Variance components of an attitude error: which part of its mean square belongs to which cause.

The error about one axis is measured in a crossed and nested design: fields x units x thermal states, in each of these
combinations some attitudes a few pixels apart, at each of these some frames with new noise. The model is that of random
effects (Searle, Casella & McCulloch 1992, Variance Components, chapter 4),

    e = mu + sum over A of a_A + p + t,    A the subsets of {field, unit, state},

with an attitude's effect p and the noise t. All are estimated without bias from mean squares, so their sum is the
unbiased estimate of E[e^2], and a component may come out slightly negative where it is smaller than its error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.datasheet.cells import MeasuredFrames
from skysim.results.metrics import TAILS

FIELD, UNIT, STATE = range(3)
Subset = tuple[int, ...]
RESAMPLES = 400


class Components(NamedTuple):
    """Mean square of each term of the error, in squared units of the error; see `components`."""

    bias: float
    thermal: float
    field: float
    pixel: float
    temporal: float

    @property
    def total(self) -> float:
        """Sum of the terms."""
        return float(sum(self))


class Bounded(NamedTuple):
    """A value with its interval at `metrics.CONFIDENCE`."""

    value: float
    low: float
    high: float


def subsets(present: list[int]) -> Iterator[Subset]:
    """All subsets, the largest first."""
    for size in range(len(present), -1, -1):
        yield from combinations(present, size)


def effects(means: Floats, present: list[int]) -> dict[Subset, float]:
    """Variance of each crossed effect plus what is left in the means of nested ones, by subset of the factors.

    The mean squares of the orthogonal decomposition (inclusion and exclusion of marginal means) have
    E[MS_A] = sum over B containing A of var_B times the number of cells that share one level of B; they are solved from
    the largest subset down. var_() is the square of the mean.

    Parameters
    ----------
    means
        (fields, units, states)
    present
        Factors with more than one level
    """
    found: dict[Subset, float] = {}
    counts = np.array(means.shape)
    for subset in subsets(present):
        effect = np.zeros_like(means)
        for part in subsets(list(subset)):
            others = tuple(axis for axis in range(means.ndim) if axis not in part)
            sign = (-1) ** (len(subset) - len(part))
            effect += sign * means.mean(axis=others, keepdims=True)
        freedom = np.prod([counts[axis] - 1 for axis in subset])
        square = float(np.sum(np.broadcast_to(effect, means.shape) ** 2) / freedom)
        larger = [one for one in found if set(subset) < set(one)]
        shared = sum(found[one] * float(np.prod(np.delete(counts, one))) for one in larger)
        found[subset] = (square - shared) / float(np.prod(np.delete(counts, subset)))
    return found


def components(errors: Floats) -> Components:
    """The error's terms from (fields, units, states, attitudes, frames) values, at least two fields, attitudes, frames.

    Returns
    -------
    bias
        Constant over fields, attitudes and time: the mean's square and the variance among units
    thermal
        All that changes with the thermal state
    field
        Changes from field to field, for one unit: catalog, distortion, map of the LEDs,
        geometry of the stars
    pixel
        Changes over a few pixels: centroiding, fixed pattern
    temporal
        Changes from frame to frame
    """
    temporal = float(np.mean(np.var(errors, axis=-1, ddof=1)))
    cells = errors.mean(axis=-1)
    frames = errors.shape[-1]
    attitudes = errors.shape[-2]
    between = float(np.mean(np.var(cells, axis=-1, ddof=1)))
    means = cells.mean(axis=-1)
    present = [axis for axis in (FIELD, UNIT, STATE) if means.shape[axis] > 1]
    found = effects(means, present)
    # What attitudes and noise leave in a mean is in the smallest of the crossed effects.
    found[tuple(present)] -= between / attitudes
    bias = by_state = by_field = 0.0
    for subset, value in found.items():
        if STATE in subset:
            by_state += value
        elif FIELD in subset:
            by_field += value
        else:
            bias += value
    return Components(bias, by_state, by_field, between - temporal / frames, temporal)


def of_axes(errors: Floats) -> Components:
    """The components of (axes, fields, ...) errors, the mean over the axes."""
    return Components(*np.mean([components(one) for one in errors], axis=0).tolist())


def with_intervals(errors: Floats) -> dict[str, Bounded]:
    """The components of (axes, fields, ...) errors and their total, each with its bootstrap interval over the fields.

    Fields are the independent draws; units and states are those that were measured.
    """
    drawn = [of_axes(errors[:, rows]) for rows in resamples(errors.shape[1])]
    values = of_axes(errors)
    found = {}
    for name in (*Components._fields, "total"):
        samples = np.array([getattr(one, name) for one in drawn])
        found[name] = bounded(getattr(values, name), samples)
    return found


def resamples(count: int) -> Iterator[NDArray[np.int64]]:
    """Rows of each sample of the bootstrap over `count` fields."""
    rng = random_stream(1)
    return (rng.integers(count, size=count) for _ in range(RESAMPLES))


def bounded(value: float, drawn: Floats) -> Bounded:
    """A value with the percentile interval of its bootstrap samples."""
    low, high = np.quantile(drawn, TAILS)
    return Bounded(float(value), float(low), float(high))


def mean_known(values: Floats, axis: int | tuple[int, ...] | None = None) -> Any:
    """The mean over the values that are finite; NaN where none is."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    return np.sum(np.where(known, values, 0.0), axis=axis) / np.where(count, count, np.nan)


def sum_over_total(errors: Floats, at_once: Floats) -> Bounded:
    """Ratio of the sum of the terms to the mean square error of independent frames of the same fields.

    Parameters
    ----------
    errors
        (axes, fields, ...) of the design
    at_once
        (axes, fields, draws), NaN where there is no attitude
    """
    squares = mean_known(at_once**2, (0, 2))
    known = np.isfinite(squares)
    errors = errors[:, known]
    squares = squares[known]
    drawn = []
    for rows in resamples(len(squares)):
        total = of_axes(errors[:, rows]).total
        drawn.append(total / squares[rows].mean())
    return bounded(of_axes(errors).total / float(squares.mean()), np.array(drawn))


def mean_square_ratio(numerator: Floats, denominator: Floats) -> Bounded:
    """Ratio of two mean squares that were measured in the same fields, with its bootstrap interval over the fields.

    Parameters
    ----------
    numerator, denominator
        (fields,) mean squares; fields without one of them are left out
    """
    known = np.isfinite(numerator) & np.isfinite(denominator)
    top = numerator[known]
    bottom = denominator[known]
    if not len(top):
        return Bounded(math.nan, math.nan, math.nan)
    drawn = [top[rows].mean() / bottom[rows].mean() for rows in resamples(len(top))]
    return bounded(top.mean() / bottom.mean(), np.array(drawn))


# The terms of a datasheet: their sizes, their sum against the total, and the effect of each cause.


GROUPS = {"across": slice(0, 2), "about": slice(2, 3)}  # axes across and about the boresight
MIN_FIELDS = 10  # minimum number of fields in which all frames of the terms are solved

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
    ratio
        Sum of the terms over the mean square of independent frames
    """

    squares: dict[str, Bounded]
    ratio: Bounded

    @property
    def dominant(self) -> str:
        """The largest term."""
        return max(Components._fields, key=lambda name: self.squares[name].value)


def term_errors(sheet: MeasuredFrames) -> tuple[Floats, np.ndarray]:
    """(3, fields, units, states, attitudes, frames) errors of the fields in which all frames are solved, and which.

    Raises
    ------
    InputError
        Where they are too few for a statement.
    """
    rows = sheet.rows("terms")
    designer = sheet.designer
    size = sheet.size
    errors = sheet.errors(rows)
    shape = (3, designer.units, designer.states, size.attitudes, size.frames, size.fields)
    errors = np.moveaxis(errors.reshape(shape), -1, 1)
    solved = np.asarray(np.isfinite(errors).all(axis=(0, 2, 3, 4, 5)))
    if solved.sum() < MIN_FIELDS:
        share = max(float(solved.mean()), 1 / size.fields)
        raise InputError(
            "datasheet.fields",
            f"{size.fields}: {solved.sum()} fields are solved in all {len(rows)} frames",
            f"{MIN_FIELDS} of them or more, as with {math.ceil(1.5 * MIN_FIELDS / share)} fields",
        )
    return errors[:, solved], solved


def term_tables(sheet: MeasuredFrames) -> dict[str, TermTable]:
    """The terms across and about the boresight."""
    errors, solved = term_errors(sheet)
    at_once = np.moveaxis(sheet.errors(sheet.rows("total")), 1, 2)[:, solved]
    tables = {}
    for name, axes in GROUPS.items():
        ratio = sum_over_total(errors[axes], at_once[axes])
        tables[name] = TermTable(with_intervals(errors[axes]), ratio)
    return tables


def mean_errors(sheet: MeasuredFrames) -> list[Bounded]:
    """The mean error about each axis of the camera, arcseconds, with its interval (Student's, over the fields)."""
    from scipy.special import stdtrit

    errors, _ = term_errors(sheet)
    means = errors.reshape(*errors.shape[:2], -1).mean(axis=2)
    fields = means.shape[1]
    mean = means.mean(axis=1)
    half = stdtrit(fields - 1, TAILS[1]) * means.std(axis=1, ddof=1) / math.sqrt(fields)
    ends = np.column_stack([mean, mean - half, mean + half])
    return [Bounded(*one) for one in ends.tolist()]


def squares_by_field(sheet: MeasuredFrames, rows: list[int], axes: slice) -> Floats:
    """(fields,) mean squares of one axis, NaN in fields without an attitude."""
    return mean_known(sheet.errors(rows)[axes] ** 2, (0, 1))


def causes(sheet: MeasuredFrames) -> list[dict[str, Any]]:
    """Each change of the scene with the ratio of the mean square after it to that of the unchanged scene.

    Across and about the boresight.
    """
    found = []
    for name in sheet.levels("cause", "cause"):
        rows = sheet.rows("cause", cause=name)
        draws = sheet.rows("total")
        before = [draw for draw in draws if sheet.cells[draw].levels["draw"] < len(rows)]
        row: dict[str, Any] = {"cause": name}
        for group, axes in GROUPS.items():
            squares = squares_by_field(sheet, rows, axes)
            row[group] = mean_square_ratio(squares, squares_by_field(sheet, before, axes))
        found.append(row)
    return sorted(found, key=lambda one: one["across"].value + one["about"].value)


def rms(sheet: MeasuredFrames, rows: list[int], axes: slice) -> float:
    """Root mean square of the errors about one axis, arcseconds, over all frames with a right attitude."""
    return math.sqrt(mean_known(sheet.errors(rows)[axes] ** 2))
