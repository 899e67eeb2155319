"""The terms of a datasheet: sizes, sum against the total, what would lower them, and what disturbances do."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.experiments.datasheet.components import (
    Bounded,
    Components,
    mean_known,
    mean_square_ratio,
    sum_over_total,
    with_intervals,
)
from skysim.experiments.datasheet.run import Sheet

GROUPS = {"across": slice(0, 2), "about": slice(2, 3)}  # axes across and about the boresight
MIN_FIELDS = 10  # in which all frames of the terms are solved

TERMS = {
    "bias": "mean over fields, attitudes and time, and its scatter among units",
    "thermal": "changes with the thermal state",
    "field": "field-of-view spatial: changes from field to field",
    "pixel": "pixel spatial: changes over a few pixels",
    "temporal": "temporal noise: changes from frame to frame",
}


class TermTable(NamedTuple):
    """The terms about one group of axes.

    squares : mean squares of terms and total, arcsec^2 of one axis, with intervals
    ratio   : sum of the terms over the mean square of independent frames
    """

    squares: dict[str, Bounded]
    ratio: Bounded

    @property
    def dominant(self) -> str:
        """The largest term."""
        return max(Components._fields, key=lambda name: self.squares[name].value)


def term_errors(sheet: Sheet) -> tuple[Floats, np.ndarray]:
    """(3, fields, units, states, attitudes, frames) errors of the fields in which all frames are solved, and which.

    Raises InputError where they are too few for a statement.
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


def term_tables(sheet: Sheet) -> dict[str, TermTable]:
    """The terms across and about the boresight."""
    errors, solved = term_errors(sheet)
    at_once = np.moveaxis(sheet.errors(sheet.rows("total")), 1, 2)[:, solved]
    return {
        name: TermTable(with_intervals(errors[axes]), sum_over_total(errors[axes], at_once[axes]))
        for name, axes in GROUPS.items()
    }


def mean_errors(sheet: Sheet) -> list[Bounded]:
    """The mean error about each axis of the camera, arcseconds, with its interval (Student's, over the fields)."""
    from scipy.special import stdtrit

    errors, _ = term_errors(sheet)
    means = errors.reshape(*errors.shape[:2], -1).mean(axis=2)
    half = (
        stdtrit(means.shape[1] - 1, 0.975) * means.std(axis=1, ddof=1) / math.sqrt(means.shape[1])
    )
    return [
        Bounded(float(m), float(m - h), float(m + h))
        for m, h in zip(means.mean(axis=1), half, strict=True)
    ]


def squares_by_field(sheet: Sheet, rows: list[int], axes: slice) -> Floats:
    """(fields,) mean squares of one axis, NaN in fields without an attitude."""
    return np.asarray(mean_known(sheet.errors(rows)[axes] ** 2, (0, 1)))


def causes(sheet: Sheet) -> list[dict[str, Any]]:
    """Each change of the scene with the mean square that is left of the total's, across and about the boresight."""
    found = []
    for name in sheet.levels("cause", "cause"):
        rows = sheet.rows("cause", cause=name)
        before = [row for row in sheet.rows("total") if sheet.cells[row].levels["draw"] < len(rows)]
        left = {
            group: mean_square_ratio(
                squares_by_field(sheet, rows, axes), squares_by_field(sheet, before, axes)
            )
            for group, axes in GROUPS.items()
        }
        found.append({"cause": name, **left})
    return sorted(found, key=lambda one: one["across"].value + one["about"].value)


def rms(sheet: Sheet, rows: list[int], axes: slice) -> float:
    """Root mean square of the errors about one axis, arcseconds, over all frames with a right attitude."""
    return float(np.sqrt(mean_known(sheet.errors(rows)[axes] ** 2)))
