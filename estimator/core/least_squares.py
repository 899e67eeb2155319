"""Normal equations of small Gauss-Newton fits: a few parameters, fitted to the pixels of one source.

A fit linearizes its model at the current parameters p: with slopes J, residuals r and weights w, the step is
dp = N^-1 g, N = J^T W J, g = J^T W r. The functions compute

- N, g and chi-square r^T W r in one matrix (`normal_equations`), with priors (`add_prior`);
- dp by Cholesky factorization (`step`);
- the position's covariance from N^-1 (`position_covariance`);
- the factor of a covariance whose residuals exceed their errors (`misfit_factor`, `variance_factor`).
"""

from math import sqrt

import numpy as np

from estimator.core.checks import Floats
from estimator.core.jit import jit

# A fit has converged once a step is below a hundredth of a standard deviation (its square is the fall of chi-square),
# or below a thousandth of a pixel: convergence is quadratic where the model fits, so the next step is negligible.
CONVERGED_CHI2 = 1e-4
CONVERGED_PX = 1e-3

# Prior of the factor of claimed variances: the probability that it is 1. Otherwise it is from 1 to MAX_VARIANCE_FACTOR,
# evenly in its logarithm.
PRIOR_RIGHT = 0.5
MAX_VARIANCE_FACTOR = 1000.0
FACTORS = np.geomspace(1.0, MAX_VARIANCE_FACTOR, 60)


@jit(fastmath={"reassoc", "contract"})
def normal_equations(rows: Floats, weight: Floats, count: int, normal: Floats) -> None:
    """Fill the lower triangle of `normal` with sum(w r_i r_j) over `count` pixels: [[N, .], [g^T, chi2]].

    Parameters
    ----------
    rows
        (P + 1, K) derivatives of the model with respect to its P parameters, then the residual.
        The last row of `normal` is therefore the gradient, and its last element is chi-square
    weight
        (K,) weight of each pixel
    normal
        (P + 1, P + 1) matrix
    """
    for i in range(len(rows)):
        for j in range(i + 1):
            total = 0.0
            # The pixels are the inner loop, so that the compiler can vectorize the sum.
            for k in range(count):
                total += weight[k] * rows[i, k] * rows[j, k]
            normal[i, j] = total


@jit
def add_prior(normal: Floats, n: int, offset: float, sigma: float) -> None:
    """Add a Gaussian prior on parameter n: mean at `offset` from the current value, standard deviation sigma.

    It adds 1 / sigma^2 to the diagonal of N, offset / sigma^2 to g, and (offset / sigma)^2 to chi-square.
    """
    last = len(normal) - 1
    weight = 1 / sigma**2
    normal[n, n] += weight
    normal[last, n] += weight * offset
    normal[last, last] += weight * offset**2


@jit
def step(normal: Floats, out: Floats) -> float:
    """Compute the Gauss-Newton step into `out` from the matrix of `normal_equations`.

    Overwrites N with its Cholesky factor. Returns the predicted fall of chi-square, g^T N^-1 g, which is the squared
    length of the step in standard deviations; NaN if N is singular.
    """
    count = len(out)
    if not cholesky(normal[:count, :count]):
        return np.nan
    # N dp = g
    for i in range(count):
        out[i] = normal[count, i]
    cholesky_solve(normal, out)
    # g^T dp
    fall = 0.0
    for i in range(count):
        fall += normal[count, i] * out[i]
    return fall


@jit
def cholesky(normal: Floats, min_pivot: float = 1e-12) -> bool:
    """Replace the lower triangle of N = L L^T by its Cholesky factor L; return False if N is numerically singular.

    Parameters
    ----------
    min_pivot
        Smallest accepted ratio of a squared pivot to the diagonal element of N
    """
    for i in range(len(normal)):
        diagonal = normal[i, i]
        for j in range(i + 1):
            total = normal[i, j]
            for k in range(j):
                total -= normal[i, k] * normal[j, k]
            if i == j:
                if not total > min_pivot * diagonal:
                    return False
                normal[i, i] = sqrt(total)
            else:
                normal[i, j] = total / normal[j, j]
    return True


@jit
def cholesky_solve(factor: Floats, vector: Floats) -> None:
    """Replace v by N^-1 v, given the Cholesky factor of N: forward, then back substitution."""
    count = len(vector)
    # L y = v, then L^T x = y
    for i in range(count):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@jit
def position_covariance(factor: Floats, column: Floats) -> tuple[float, float, float]:
    """Return xx, yy and xy of N^-1 for the first two parameters, which are the position.

    With weights that are inverse variances this is the Cramer-Rao bound.
    """
    # Columns 0 and 1 of the inverse
    column[:] = 0.0
    column[0] = 1.0
    cholesky_solve(factor, column)
    xx = column[0]
    xy = column[1]
    column[:] = 0.0
    column[1] = 1.0
    cholesky_solve(factor, column)
    return xx, column[1], xy


@jit
def misfit_factor(chi2: float, degrees_of_freedom: int) -> float:
    """Return the factor that inflates a covariance where the model does not fit the pixels.

    It is the reduced chi-square if that exceeds 1 + 4 sqrt(2 / n), by four standard deviations with n degrees of
    freedom; otherwise 1.
    """
    if degrees_of_freedom < 1:
        return 1.0
    reduced = chi2 / degrees_of_freedom
    return reduced if reduced > 1 + 4 * sqrt(2 / degrees_of_freedom) else 1.0


def variance_factor(chi2: float, degrees_of_freedom: float) -> float:
    """Return the expected factor of the claimed variances, given the chi-square of residuals; 1 where both agree.

    The factor v is 1 with the probability PRIOR_RIGHT, else anything to MAX_VARIANCE_FACTOR with equal probabilities of
    equal ratios (Jeffreys' prior of a scale). With the likelihood v^(-n/2) exp(-chi2 / (2 v)), n degrees of freedom,

        E v = [p + (1 - p) <v L(v) / L(1)>] / [p + (1 - p) <L(v) / L(1)>].

    With many degrees of freedom it is the reduced chi-square, wherever that is significant (the ratio of R. T. Birge,
    Phys. Rev. 40, 207 (1932); Gelman et al., Bayesian Data Analysis, 3rd ed., sections 3.2 and 14.2).
    """
    # ln L(v) / L(1)
    log_ratio = 0.5 * (chi2 * (1 - 1 / FACTORS) - degrees_of_freedom * np.log(FACTORS))
    highest = max(float(log_ratio.max()), 0.0)
    wrong = (1 - PRIOR_RIGHT) * np.exp(log_ratio - highest) / len(FACTORS)
    right = PRIOR_RIGHT * np.exp(-highest)
    return float((right + wrong @ FACTORS) / (right + wrong.sum()))
