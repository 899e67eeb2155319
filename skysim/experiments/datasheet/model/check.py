"""Compare a measurement model with frames that it was not fitted to: distribution by rate, and correlation.

The model is fitted to every second field of a datasheet, and compared with the others at the rates of the sequences,
which are of one unit, whose bias is taken from the fields of the fit; then the two halves change places. One frame of
each field gives independent errors for a two-sided Kolmogorov-Smirnov test; the frames of a sequence give the
correlation, the mean product of errors a number of frames apart over the mean square.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.datasheet.components import mean_known
from skysim.experiments.datasheet.model.errors import ErrorModel
from skysim.experiments.datasheet.model.fit import constants, sequences
from skysim.experiments.datasheet.run import Sheet
from skysim.experiments.datasheet.terms import term_errors

DRAWN = 200_000  # errors of the model for its distribution
APART_STEP_S = 1e9  # between draws, which then are of other fields


class Agreement(NamedTuple):
    """How well the model agrees with other fields at one rate.

    fitted      : the fields of the fit, even or odd;  frames : one of each other field
    p_values    : (3,) of x, y, roll, of the Kolmogorov-Smirnov tests
    correlation : mean over the axes and over all pairs of frames of a sequence, and that of the model
    """

    fitted: str
    rate_deg_s: float
    frames: int
    p_values: list[float]
    correlation: float
    expected_correlation: float


def some_fields(sheet: Sheet, fields: slice) -> Sheet:
    """The sheet of some of its fields."""
    columns = {name: values[:, fields] for name, values in sheet.columns.items()}
    count = len(range(sheet.size.fields)[fields])
    return replace(sheet, columns=columns, size=replace(sheet.size, fields=count))


def agreements(sheet: Sheet) -> list[Agreement]:
    """The agreement of each half of the fields with the other, at the rates of the sequences, from rest on."""
    even = some_fields(sheet, slice(0, None, 2))
    odd = some_fields(sheet, slice(1, None, 2))
    rates = sheet.levels("sequence", "rate_deg_s")
    return [
        agreement(of_one_unit(fitted), other, rate, name)
        for name, fitted, other in (("even", even, odd), ("odd", odd, even))
        for rate in rates
    ]


def of_one_unit(sheet: Sheet) -> ErrorModel:
    """The model of a sheet for the first of its units."""
    unit_mean = term_errors(sheet)[0][:, :, 0].mean(axis=(1, 2, 3, 4))
    return ErrorModel(constants(sheet) | {"mean": unit_mean.tolist(), "unit": [0.0, 0.0, 0.0]})


def agreement(model: ErrorModel, sheet: Sheet, rate_deg_s: float, fitted: str) -> Agreement:
    """The agreement with the sequences at one rate."""
    steps, errors = sequences(sheet, rate_deg_s)
    first = errors[:, 0][:, np.isfinite(errors[:, 0]).all(axis=0)]
    drawn = turning(model, rate_deg_s) if rate_deg_s else at_rest(model)
    p_values = [float(stats.ks_2samp(*pair).pvalue) for pair in zip(first, drawn.T, strict=True)]
    centered = errors - model.mean[:, None, None]
    found = []
    expected = []
    for one in range(len(steps)):
        for two in range(one + 1, len(steps)):
            angle_deg = rate_deg_s * (steps[two] - steps[one]) / sheet.scene.exposure.rate_hz
            found.append(
                mean_known(centered[:, one] * centered[:, two], 1) / mean_known(centered**2, (1, 2))
            )
            expected.append(model.correlation(angle_deg, rate_deg_s))
    return Agreement(
        fitted,
        rate_deg_s,
        first.shape[1],
        p_values,
        float(np.mean(found)),
        float(np.mean(expected)),
    )


def turning(model: ErrorModel, rate_deg_s: float) -> Floats:
    """(DRAWN, 3) errors at a rate, each in another field and about another axis."""
    rng = random_stream(1)
    axis_rad = rng.uniform(0, 2 * np.pi, DRAWN)
    return np.asarray(model.draw(np.full(DRAWN, rate_deg_s), APART_STEP_S, rng, axis_rad=axis_rad))


def at_rest(model: ErrorModel) -> Floats:
    """(DRAWN, 3) errors at rest, each in another field."""
    rates = len(model.noise)
    rest = {"noise": [model.noise[0].tolist()] * rates, "along": [model.along[0]] * rates}
    return turning(ErrorModel(model.constants | rest), 1.0)
