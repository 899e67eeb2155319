"""Texts of the page: errors in its words, numbers, and tables as CSV files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

from skysim.core.errors import OVERRIDES, InputError

LABELS = {  # of the fields, by the parameter's key; a key of a scene is the label of its field
    "solve.fov_deg": "the field of view",
    "solve.time_utc": "the date",
    "solve.catalog": "the star catalog",
    "solve.detector": "the detector",
    "solve.centroider": "the centroider",
    "solve.identifier": "the identifier",
    "solve.solver": "the solver",
    "survey.tilt_deg": "the tilt",
}


def for_page(error: InputError) -> str:
    """An error with the label of the field at fault; without a place if the value was typed in the page."""
    where = None if error.where == OVERRIDES else error.where
    return str(InputError(LABELS.get(error.key, error.key), error.problem, error.allowed, where))


def format_number(value: float) -> str:
    """Format with three significant digits, from 100 up as an integer."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def csv_table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    """A table with its heads; numbers with nine digits, unknown values (NaN, None) as empty cells."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows([cell(value) for value in row] for row in rows)
    return text.getvalue().encode()


def cell(value: Any) -> str:
    if value is None or value != value:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)
