"""The expected factor of claimed variances is the mean of its posterior."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
import scipy.integrate
from hypothesis import given
from hypothesis import strategies as some

from estimator.core.least_squares import MAX_VARIANCE_FACTOR, variance_factor
from tests.helpers.laws import law


@law(variance_factor)
@given(some.integers(1, 200), some.floats(0.0, 1e6))
def test_variance_factor_is_one_to_its_limit_and_grows_with_chi_square(
    dof: int, chi2: float
) -> None:
    assert 1 <= variance_factor(chi2, dof) <= MAX_VARIANCE_FACTOR * (1 + 1e-12)
    assert variance_factor(chi2, dof) <= variance_factor(1.1 * chi2 + 1, dof) + 1e-9


@pytest.mark.parametrize("factor", [4.0, 9.0, 25.0])
def test_variance_factor_is_the_reduced_chi_square_with_many_degrees_of_freedom(
    factor: float,
) -> None:
    assert abs(variance_factor(factor * 1000, 1000) / factor - 1) < 0.02


def test_variance_factor_of_a_right_claim_is_about_one() -> None:
    chi2 = np.random.default_rng(3).chisquare(27, 2000)
    assert np.mean([variance_factor(one, 27) for one in chi2]) < 1.1


@pytest.mark.parametrize(
    ("chi2", "dof"), [(2.0, 5), (12.0, 5), (30.0, 5), (40.0, 27), (200.0, 27), (1e4, 27)]
)
def test_variance_factor_is_the_mean_of_bayes_posterior(chi2: float, dof: int) -> None:
    """By quadrature over the factor: half of the prior at 1, half even in its logarithm from 1 to the limit."""

    def moment(power: int) -> float:
        span = np.log(MAX_VARIANCE_FACTOR)
        scale = max(-dof / 2 * np.log(max(chi2 / dof, 1.0)) - dof / 2, -chi2 / 2)

        def integrand(u: float) -> float:
            return np.exp(power * u - dof * u / 2 - chi2 / 2 * np.exp(-u) - scale) / span

        return 0.5 * scipy.integrate.quad(integrand, 0, span, limit=200)[0] + 0.5 * np.exp(
            -chi2 / 2 - scale
        )

    assert variance_factor(chi2, dof) == pytest.approx(moment(1) / moment(0), rel=0.03)
