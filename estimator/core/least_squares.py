"""Small normal equations, for fits of a few parameters to the pixels of one light."""

from __future__ import annotations

from math import sqrt

import numpy as np

from estimator.core.arrays import Floats
from estimator.core.jit import jit

# A fit has settled once a step is a hundredth of the standard deviation of what is fitted, or a thousandth of a
# pixel: where the model fits, Newton's next step is its square.
SETTLED_CHI2, SETTLED_PX = 1e-4, 1e-3


@jit(fastmath={"reassoc", "contract"})
def normal_equations(rows: Floats, weight: Floats, count: int, normal: Floats) -> None:
    """sum(w r_i r_j) over `count` pixels, the lower half.

    rows : (P + 1, K) a model's slopes by its P parameters, and last what it leaves over. So the last row of `normal`
        is the gradient, and its corner the chi-square. The pixels are innermost: so they pass through a vector unit
    """
    for i in range(len(rows)):
        for j in range(i + 1):
            total = 0.0
            for k in range(count):
                total += weight[k] * rows[i, k] * rows[j, k]
            normal[i, j] = total


@jit
def expect(normal: Floats, n: int, off: float, sigma: float) -> None:
    """Add what is known of parameter n beforehand: that it lies `off` from here, give or take sigma."""
    last, weight = len(normal) - 1, 1 / sigma**2
    normal[n, n] += weight
    normal[last, n] += weight * off
    normal[last, last] += weight * off**2


@jit
def step(normal: Floats, out: Floats) -> float:
    """Gauss-Newton's step from the matrix of `normal_equations`, which keeps Cholesky's factor; NaN if singular.

    What it returns is by how much chi-square falls, g^T N^-1 g: the step's square in standard deviations.
    """
    count = len(out)
    if not factorise(normal[:count, :count]):
        return np.nan
    out[:] = normal[count, :count]
    solve(normal, out)
    fall = 0.0
    for i in range(count):
        fall += normal[count, i] * out[i]
    return fall


@jit
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


@jit
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


@jit
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


@jit
def misfit_factor(chi2: float, freedom: int) -> float:
    """By how much a covariance grows where the model is not the light: chi-square a degree, if that is no accident.

    Beyond four standard deviations of a chi-square, 1 + 4 sqrt(2 / freedom); else 1.
    """
    if freedom < 1:
        return 1.0
    each = chi2 / freedom
    return each if each > 1 + 4 * sqrt(2 / freedom) else 1.0
