"""Error budget: Sobol indices of the attitude error for each factor (Sobol 1993).

For an output Y and a factor X_i the first-order index is Var(E[Y | X_i]) / Var(Y), the fraction of the variance that
would vanish if X_i were known. The total index is E[Var(Y | X_~i)] / Var(Y), the fraction that would remain if all
other factors were known.

There are many outputs: the error about each axis at each of the random attitudes (replicates). Their indices are
averaged with their variances as weights, which gives generalized indices (Lamboni, Monod & Makowski 2011; Gamboa et
al. 2014). Intervals come from a bootstrap over the rows of the sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.study.execution.store import Store
from skysim.experiments.study.plan import Plan
from skysim.results.metrics import CONFIDENCE, NO_VALUE, Summary

AXES = {"cross_arcsec": ("x_arcsec", "y_arcsec"), "roll_arcsec": ("roll_arcsec",)}
RESAMPLES = 200


class Index(NamedTuple):
    """Contribution of a factor to one error: its indices, and rms_arcsec, the error due to this factor alone.

    rms_arcsec is the standard deviation of the error times the square root of the first-order index.
    """

    factor: str
    response: str
    first: Summary
    total: Summary
    rms_arcsec: float


def indices(plan: Plan, store: Store) -> list[Index]:
    """Indices of every factor for the cross-boresight and roll errors. Raises InputError for another design."""
    kind = plan.study.design.kind
    if kind != "saltelli" or plan.study.optimize:
        raise InputError("design.kind", kind, "saltelli, without optimize, for Sobol indices")
    return [index for response in AXES for index in response_indices(plan, store, response)]


def response_indices(plan: Plan, store: Store, response: str) -> list[Index]:
    """Indices of every factor for one error; NaN if no replicate is complete."""
    a, b, ab = sample_outputs(plan, store, AXES[response])
    names = list(plan.study.factors)
    count = a.shape[1]
    if not len(a):
        return [Index(name, response, NO_VALUE, NO_VALUE, np.nan) for name in names]
    estimate = generalized(a, b, ab)
    rng = random_stream(1)
    # Resample rows of A, B and AB together, so that each resample is a valid Saltelli sample.
    selections = rng.integers(count, size=(RESAMPLES, count))
    resampled = np.array(
        [generalized(a[:, rows], b[:, rows], ab[:, :, rows]) for rows in selections]
    )
    low, high = np.quantile(resampled, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
    first, total = (
        [Summary(float(v), float(lo), float(hi), count) for v, lo, hi in zip(*index, strict=True)]
        for index in zip(estimate, low, high, strict=True)
    )
    # The variance of the cross-boresight error is the sum of the variances about its two axes.
    sigma_arcsec = float(
        np.sqrt(np.var(np.concatenate([a, b], axis=1), axis=1).mean() * len(AXES[response]))
    )
    rms_arcsec = [sigma_arcsec * float(np.sqrt(max(one.value, 0.0))) for one in first]
    columns = zip(names, first, total, rms_arcsec, strict=True)
    return [Index(name, response, one, other, rms) for name, one, other, rms in columns]


def sample_outputs(
    plan: Plan, store: Store, axes: tuple[str, ...]
) -> tuple[Floats, Floats, Floats]:
    """(S, N), (S, N) and (D, S, N) errors at A, at B, and at A with one column of B.

    There are N sample rows, D factors and S outputs, one per axis and replicate. A replicate is left out if any of its
    trials has no solution or is not done yet.
    """
    width = len(plan.study.factors)
    each = plan.study.replicates
    columns = store.columns()
    # Trial number = point * replicates + replicate, and points are in the order A, B, AB_1 .. AB_D.
    values = np.full((len(axes), plan.trials), np.nan)
    values[:, columns["trial"]] = [columns[name] for name in axes]
    grid = values.reshape(len(axes), -1, each).transpose(0, 2, 1).reshape(len(axes) * each, -1)
    complete = np.isfinite(grid).all(axis=1)
    blocks = grid[complete].reshape(int(complete.sum()), width + 2, len(plan.points) // (width + 2))
    return blocks[:, 0], blocks[:, 1], blocks[:, 2:].transpose(1, 0, 2)


def generalized(a: Floats, b: Floats, ab: Floats) -> NDArray[np.float64]:
    """(2, D) first-order and total indices, averaged over the outputs with their variances as weights.

    The estimators are those of Saltelli et al. (2010), from SciPy. Outputs without variance have weight zero.
    """
    estimate = scipy.stats.sobol_indices(func={"f_A": a, "f_B": b, "f_AB": ab}, n=a.shape[1])
    weight = np.var(np.concatenate([a, b], axis=1), axis=1)
    if weight.sum() == 0:
        return np.zeros((2, len(ab)))
    varying = weight > 0
    both = (estimate.first_order, estimate.total_order)
    return np.stack([weight[varying] @ index[varying] / weight.sum() for index in both])
