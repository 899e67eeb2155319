"""The robust fit finds SciPy's minimum for any gross errors, with SciPy's loss function."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
import scipy.integrate
from hypothesis import given
from hypothesis import strategies as some

from estimator.core.checks import Floats
from estimator.core.least_squares import (
    MAX_VARIANCE_FACTOR,
    fit_soft_l1,
    soft_l1,
    variance_factor,
)
from tests.helpers.laws import SEEDS, law


@law(soft_l1)
@given(size=some.floats(1e-4, 1e6))
def test_the_loss_is_a_square_at_first_and_then_grows_as_the_residual(size: float) -> None:
    residual = np.array([size, -size])
    assert np.isclose(soft_l1(residual), 2 * 2 * (np.sqrt(1 + size**2) - 1), rtol=1e-12)
    assert soft_l1(residual) <= min(2 * size**2, 4 * size) * (1 + 1e-6)
    assert soft_l1(residual) >= min(2 * size**2, 4 * size) * 0.4


@law(fit_soft_l1)
@given(
    rng=SEEDS,
    count=some.integers(16, 60),
    gross=some.integers(0, 2),
    units=some.floats(-3, 3),
)
def test_the_robust_fit_finds_scipy_s_minimum(
    rng: np.random.Generator, count: int, gross: int, units: float
) -> None:
    """A wave a sin(b t + c) with noise and a few gross errors, its parameters in units a thousand times apart."""
    unit = 10.0 ** np.array([units, 0.0, -units])
    t = np.linspace(0, 3, count)
    truth = rng.uniform([1, 2, -1], [3, 3, 1])
    data = truth[0] * np.sin(truth[1] * t + truth[2]) + rng.normal(0, 0.1, count)
    data[rng.choice(count, gross, replace=False)] += rng.uniform(-50, 50, gross)

    def residual(p: Floats) -> Floats:
        a, b, c = p * unit
        return (a * np.sin(b * t + c) - data) / 0.1

    start = (truth + rng.normal(0, 0.1, 3)) / unit
    found = fit_soft_l1(residual, start, 1 / unit)
    oracle = scipy.optimize.least_squares(
        residual, start, loss="soft_l1", x_scale=1 / unit, xtol=1e-12, ftol=1e-12
    )
    assert soft_l1(residual(found)) <= soft_l1(residual(oracle.x)) * (1 + 1e-5)


@law(fit_soft_l1)
@given(rng=SEEDS)
def test_a_parameter_without_effect_keeps_its_value(rng: np.random.Generator) -> None:
    found = fit_soft_l1(
        lambda p: p[:1] - np.array([3.0, 3.0]), np.array([0.0, 7.0]), np.ones(2)
    )
    np.testing.assert_allclose(found, [3.0, 7.0], atol=1e-6)


@law(variance_factor)
@given(some.integers(1, 200), some.floats(0.0, 1e6))
def test_variance_factor_is_one_to_its_limit_and_grows_with_chi_square(
    dof: int, chi2: float
) -> None:
    assert 1 <= variance_factor(chi2, dof) <= MAX_VARIANCE_FACTOR
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
