"""Normal equations of small fits against numpy.linalg, by the interpreter."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.interpreted import interpreted

FIT = interpreted("estimator.core.least_squares")


def test_a_step_is_the_least_squares_solution_and_priors_are_further_measurements() -> None:
    """Five parameters, of which two have a prior; the step, its fall of chi-square and the position's covariance."""
    rng = np.random.default_rng(1)
    offset = (0.3, -2.0)
    sigma = (0.5, 0.7)
    rows = rng.normal(size=(6, 40))
    weight = rng.uniform(0.5, 2, 40)
    rows[:, 30:] = 99.0  # beyond the count
    normal = np.full((6, 6), np.nan)
    step = np.empty(5)
    column = np.empty(5)
    FIT.normal_equations(rows, weight, 30, normal)
    priors = np.zeros((2, 6))
    for prior, n, off, width in zip(priors, (1, 4), offset, sigma, strict=True):
        FIT.add_prior(normal, n, off, width)
        prior[n] = 1 / width
        prior[5] = off / width
    measured = np.vstack([np.sqrt(weight[:30, None]) * rows[:, :30].T, priors])
    np.testing.assert_allclose(
        normal[np.tril_indices(6)], (measured.T @ measured)[np.tril_indices(6)], rtol=1e-12
    )
    fall = FIT.step(normal, step)
    wanted, left, *_ = np.linalg.lstsq(measured[:, :5], measured[:, 5], rcond=None)
    np.testing.assert_allclose(step, wanted, rtol=1e-10)
    assert fall == pytest.approx(np.sum(measured[:, 5] ** 2) - left[0], rel=1e-10)
    covariance = np.linalg.inv(measured[:, :5].T @ measured[:, :5])
    np.testing.assert_allclose(
        FIT.position_covariance(normal, column), covariance[[0, 1, 0], [0, 1, 1]], rtol=1e-10
    )


@pytest.mark.parametrize(("ratio", "regular"), [(1e-10, True), (1e-14, False)])
def test_a_matrix_is_singular_where_a_pivot_is_1e12_times_below_its_diagonal(
    ratio: float, regular: bool
) -> None:
    """Two parallel rows but for an angle whose squared sine is `ratio`."""
    normal = np.array([[1.0, 0.0], [1.0, 1.0 + ratio]])
    assert FIT.cholesky(normal) == regular
