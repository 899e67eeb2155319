"""Components of errors by hand, and the chi-square of a true covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from skysim.results import metrics

ARCMIN_RAD = np.radians(1 / 60)
TRUTH = Rotation.from_rotvec([0.4, -1.1, 2.0])


def turned(x: float, y: float, z: float) -> Rotation:
    """The truth followed by a rotation in camera axes."""
    return Rotation.from_rotvec([x, y, z]) * TRUTH


def test_equal_attitudes_have_zero_error() -> None:
    assert metrics.cross_and_roll_rad(TRUTH, TRUTH) == pytest.approx((0, 0), abs=1e-15)


def test_cross_and_roll_are_the_components_of_the_rotation() -> None:
    assert metrics.cross_and_roll_rad(turned(3e-4, -4e-4, 0), TRUTH) == pytest.approx(
        (5e-4, 0), abs=1e-15
    )
    assert metrics.cross_and_roll_rad(turned(0, 0, 7e-4), TRUTH) == pytest.approx(
        (0, 7e-4), abs=1e-15
    )
    assert metrics.cross_and_roll_rad(turned(0, 0, -7e-4), TRUTH) == pytest.approx(
        (0, -7e-4), abs=1e-15
    )


small = st.floats(-1e-4, 1e-4)


@settings(max_examples=100, derandomize=True)
@given(small, small, small)
def test_cross_is_the_angle_between_the_boresights(x: float, y: float, z: float) -> None:
    """The angle between the two boresights on the sky, for small errors to their third power."""
    estimate = turned(x, y, z)
    sights = [rotation.inv().apply([0, 0, 1.0]) for rotation in (estimate, TRUTH)]
    apart = np.linalg.norm(np.cross(*sights))
    assert metrics.cross_and_roll_rad(estimate, TRUTH)[0] == pytest.approx(apart, abs=2e-12)


@settings(max_examples=50, derandomize=True)
@given(st.tuples(small, small, small))
def test_error_does_not_depend_on_the_reference_frame(
    turn: tuple[float, float, float],
) -> None:
    other = Rotation.from_rotvec([1.0, 0.2, -0.7])
    here = metrics.cross_and_roll_rad(turned(*turn), TRUTH)
    there = metrics.cross_and_roll_rad(turned(*turn) * other, TRUTH * other)
    assert here == pytest.approx(there, abs=1e-15)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0.6, 0.8), (0, 0, -1)])
def test_wrong_begins_at_ten_arc_minutes_about_any_axis(axis: tuple[float, ...]) -> None:
    for arcmin, wrong in ((9.99, False), (10.01, True)):
        error = turned(*(arcmin * ARCMIN_RAD * np.array(axis))) * TRUTH.inv()
        assert metrics.is_wrong(error.magnitude()) == wrong


def test_an_error_that_the_tracker_claims_is_wrong_beyond_one_degree() -> None:
    """Chi-square of 3 degrees of freedom exceeds x with probability erfc(sqrt(x / 2)) + sqrt(2 x / pi) e^(-x / 2)."""
    limit = 40.13
    tail = math.erfc(math.sqrt(limit / 2)) + math.sqrt(2 * limit / math.pi) * math.exp(
        -limit / 2
    )
    assert tail == pytest.approx(1e-8, rel=1e-3)
    cases = [
        (11, limit - 0.01, False),
        (11, limit + 0.01, True),
        (59.9, 3, False),
        (60.1, 3, True),
        (9, 1e9, False),
    ]
    for arcmin, nees, wrong in cases:
        assert metrics.is_wrong(arcmin * ARCMIN_RAD, nees) == wrong


def test_the_normalized_error_matches_a_hand_calculation() -> None:
    covariance = np.diag([1e-8, 4e-8, 9e-8])
    nees = metrics.normalized_error_squared(turned(1e-4, 2e-4, 3e-4), TRUTH, covariance)
    assert nees == pytest.approx(1 + 1 + 1, rel=1e-10)


@pytest.mark.slow
def test_normalized_error_is_chi_square_of_three_for_a_true_covariance() -> None:
    rng = np.random.default_rng(6)
    root = 1e-5 * np.array([[1, 0, 0], [0.3, 2, 0], [-0.5, 0.4, 8]])
    draws = rng.standard_normal((3000, 3)) @ root.T
    nees = [metrics.normalized_error_squared(turned(*e), TRUTH, root @ root.T) for e in draws]
    # Mean 3 and variance 6 of chi-square, to four sigmas of 3,000 draws.
    assert np.mean(nees) == pytest.approx(3, abs=4 * np.sqrt(6 / 3000))
    assert np.var(nees) == pytest.approx(6, abs=4 * np.sqrt(252 / 3000))


def test_overconfident_means_rarer_than_one_correct_error_in_1e8() -> None:
    """The tail of chi-square with three degrees of freedom, erfc(sqrt(x / 2)) + sqrt(2 x / pi) exp(-x / 2), is 1e-8."""

    def tail(x: float) -> float:
        return math.erfc(math.sqrt(x / 2)) + math.sqrt(2 * x / math.pi) * math.exp(-x / 2)

    limit = float(brentq(lambda x: math.log(tail(x) / 1e-8), 10.0, 100.0))
    nees = np.array([0.1, 0.99 * limit, 1.01 * limit, 2 * limit, np.nan, 2 * limit])
    # No solution in the fifth trial, a mean over many frames in the sixth.
    frames = np.array([1, 1, 1, 1, 1, 20])
    share = metrics.overconfident({"nees": nees, "frames": frames})
    assert (share.value, share.trials) == (0.5, 4)
