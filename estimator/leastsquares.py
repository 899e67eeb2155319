"""Small normal equations, for fits of a few parameters to the pixels of one light."""

from __future__ import annotations

from math import sqrt

import numba

from estimator.types import Floats


@numba.njit(cache=True)
def add(normal: Floats, gradient: Floats, slope: Floats, rest: float, weight: float) -> None:
    """One pixel into the normal equations: sum(w s s^T), the lower half, and sum(w s rest)."""
    for i in range(len(slope)):
        part = weight * slope[i]
        gradient[i] += part * rest
        for j in range(i + 1):
            normal[i, j] += part * slope[j]


@numba.njit(cache=True)
def factorise(normal: Floats) -> bool:
    """Cholesky's L in place of the lower half of N = L L^T; False where N has no inverse worth the name."""
    for i in range(len(normal)):
        diagonal = normal[i, i]
        for j in range(i + 1):
            total = normal[i, j]
            for k in range(j):
                total -= normal[i, k] * normal[j, k]
            if i == j:
                if not total > 1e-12 * diagonal:
                    return False
                normal[i, i] = sqrt(total)
            else:
                normal[i, j] = total / normal[j, j]
    return True


@numba.njit(cache=True)
def solve(factor: Floats, vector: Floats) -> None:
    """Replace v by N^-1 v, for Cholesky's factor of N."""
    count = len(vector)
    for i in range(count):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@numba.njit(cache=True)
def place_covariance(factor: Floats, column: Floats) -> tuple[float, float, float]:
    """xx, yy and xy of N^-1 for the first two parameters: where the weights are inverse variances, Cramer and Rao's."""
    column[:] = 0.0
    column[0] = 1.0
    solve(factor, column)
    xx, xy = column[0], column[1]
    column[:] = 0.0
    column[1] = 1.0
    solve(factor, column)
    return xx, column[1], xy


@numba.njit(cache=True)
def misfit_factor(chi2: float, freedom: int) -> float:
    """By how much a covariance grows where the model is not the light: chi-square a degree, if that is no accident.

    Beyond four standard deviations of a chi-square, 1 + 4 sqrt(2 / freedom); else 1.
    """
    if freedom < 1:
        return 1.0
    each = chi2 / freedom
    return each if each > 1 + 4 * sqrt(2 / freedom) else 1.0
