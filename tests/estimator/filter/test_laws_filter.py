"""Laws of the attitude filter and of exposure control, for any input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.core.types import FilterState
from estimator.filter.error_models import GyroModel
from estimator.filter.mekf import USED, AttitudeFilter
from estimator.filter.states import inverse_response
from estimator.trackers import exposure_control
from estimator.trackers.exposure_control import Control, NextExposure, Observation
from tests.helpers import laws
from tests.helpers.laws import ANY, NUMBERS, SEEDS, answered, assert_covariance, law, turn

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
GYRO = GyroModel(1e-5, 1e-4, 1000.0)


def filtering(rng: np.random.Generator) -> AttitudeFilter:
    return AttitudeFilter(
        GYRO, 0.0, turn(rng), 10 ** rng.uniform(-5, 0), 10 ** rng.uniform(-6, -2)
    )


@law(inverse_response)
@given(seed=SEEDS, used=arrays(bool, 9))
def test_the_inverse_response_undoes_the_gyro_s_matrix(seed: int, used: NDArray) -> None:
    """The states of the matrix are anywhere among the values; elements that are no state are 0."""
    rng = np.random.default_rng(seed)
    values = 0.1 * rng.normal(size=20)
    columns = np.full(9, -1)
    columns[used] = rng.choice(20, used.sum(), replace=False)
    matrix = np.where(used, values[columns], 0.0).reshape(3, 3)
    np.testing.assert_allclose(
        inverse_response(values, columns) @ (np.eye(3) + matrix), np.eye(3), atol=1e-12
    )


def assert_sound(state: FilterState) -> None:
    assert_covariance(state.covariance)
    np.testing.assert_allclose(
        state.sigma_attitude_rad**2, np.diag(state.covariance)[:3], rtol=1e-12, atol=0
    )
    np.testing.assert_allclose(
        state.sigma_bias_rad_s**2, np.diag(state.covariance)[3:], rtol=1e-12, atol=0
    )


@law(
    AttitudeFilter.propagate,
    AttitudeFilter.state,
    AttitudeFilter.ref_from_body_wxyz,
    AttitudeFilter.body_from_ref,
    AttitudeFilter.bias_rad_s,
)
@given(
    rng=SEEDS, angle=arrays("f8", (7, 3), elements=some.floats(-10, 10)), full=arrays(bool, 7)
)
def test_any_finite_rotation_keeps_a_unit_attitude_and_a_valid_covariance(
    rng: np.random.Generator, angle: NDArray, full: NDArray
) -> None:
    mekf = filtering(rng)
    mekf.propagate(np.cumsum(rng.uniform(1e-4, 0.1, 7)), angle, full)
    assert_sound(mekf.state)
    np.testing.assert_allclose(np.linalg.norm(mekf.ref_from_body_wxyz), 1, rtol=0, atol=1e-12)
    same = Rotation.from_quat(mekf.ref_from_body_wxyz, scalar_first=True) * mekf.body_from_ref
    assert same.magnitude() < 1e-12
    # A gyro alone tells nothing of its bias.
    np.testing.assert_array_equal(mekf.bias_rad_s, np.zeros(3))


@law(AttitudeFilter.propagate, FilterState.sigma_attitude_rad, FilterState.sigma_bias_rad_s)
@given(rng=SEEDS, cut=some.integers(1, 9))
def test_the_result_does_not_depend_on_how_samples_are_split_into_calls(
    rng: np.random.Generator, cut: int
) -> None:
    t_s = np.cumsum(rng.uniform(1e-3, 0.1, 10))
    angle = rng.normal(0, 0.1, (10, 3))
    seed = int(rng.integers(2**32))
    once = filtering(np.random.default_rng(seed))
    twice = filtering(np.random.default_rng(seed))
    once.propagate(t_s, angle, np.zeros(10))
    for part in (slice(None, cut), slice(cut, None)):
        twice.propagate(t_s[part], angle[part], np.zeros(10)[part])
    np.testing.assert_array_equal(once.state.covariance, twice.state.covariance)
    np.testing.assert_array_equal(once.ref_from_body_wxyz, twice.ref_from_body_wxyz)


@law(AttitudeFilter.propagate, AttitudeFilter.rate_rad_s)
@given(t_s=NUMBERS, angle=NUMBERS, full=NUMBERS, rng=SEEDS)
def test_invalid_gyro_samples_are_refused_and_change_nothing(
    t_s: NDArray, angle: NDArray, full: NDArray, rng: np.random.Generator
) -> None:
    mekf = filtering(rng)
    before = mekf.state
    answered(lambda: mekf.propagate(t_s, angle, full))
    with pytest.raises(ValueError, match="NaN or infinite"):
        mekf.propagate([0.1], [[0, np.nan, 0]], [False])
    if mekf.state.t_s == before.t_s:
        np.testing.assert_array_equal(mekf.state.covariance, before.covariance)
    mekf.propagate([mekf.state.t_s + 0.5], [[0.1, 0.2, -0.3]], [False])
    np.testing.assert_allclose(mekf.rate_rad_s, [0.2, 0.4, -0.6], rtol=1e-9, atol=0)


@law(AttitudeFilter.update)
@given(rng=SEEDS, off_rad=some.floats(0, np.pi), sigma_rad=some.floats(1e-7, 1))
def test_an_accepted_solution_shrinks_the_covariance(
    rng: np.random.Generator, off_rad: float, sigma_rad: float
) -> None:
    mekf = filtering(rng)
    mekf.propagate([0.1, 0.2], rng.normal(0, 0.1, (2, 3)), [False, False])
    before = mekf.state
    measured = Rotation.from_rotvec(off_rad * laws.units(rng, 1)[0]) * before.body_from_ref
    update = mekf.update(0.2, measured, sigma_rad**2 * np.eye(3))
    after = mekf.state
    assert_sound(after)
    np.testing.assert_allclose(
        np.linalg.norm(update.residual_rad), off_rad, rtol=0, atol=1e-9
    )
    shrunk = np.trace(after.covariance[3:, 3:]) <= np.trace(before.covariance[3:, 3:]) * (
        1 + 1e-9
    )
    unchanged = np.array_equal(after.covariance, before.covariance)
    assert shrunk if update.status == USED else unchanged


@law(AttitudeFilter.update)
@given(rng=SEEDS, t_s=ANY, covariance=NUMBERS | arrays("f8", (3, 3), elements=ANY))
def test_any_solution_is_taken_or_refused(
    rng: np.random.Generator, t_s: float, covariance: NDArray
) -> None:
    mekf = filtering(rng)
    mekf.propagate([0.1, 0.2], rng.normal(0, 0.1, (2, 3)), [False, False])
    for when_s in (t_s, 0.15):
        answered(lambda: mekf.update(when_s, turn(rng), covariance))  # noqa: B023
    assert_sound(mekf.state)


# Exposure


@law(exposure_control.step)
@given(
    time_s=some.floats(0, 10),
    mean_dn=ANY,
    stars=some.integers(0, 99),
    overexposed=some.integers(0, 99),
    control=some.builds(Control, some.floats(0, 1e5), longest_s=some.floats(1e-3, 10)),
)
def test_an_exposure_stays_within_the_camera_s_limits(
    time_s: float, mean_dn: float, stars: int, overexposed: int, control: Control
) -> None:
    asked = exposure_control.step(
        NextExposure(time_s), Observation(mean_dn, stars, overexposed), control
    )
    assert control.shortest_s <= asked.time_s <= control.longest_s
    assert asked.no_stars == (stars < control.min_stars)
    assert asked.time_s <= max(time_s, control.shortest_s) + 1e-6 or (
        asked.no_stars and not asked.saturated
    )


@law(exposure_control.observe)
@given(
    image=arrays("u2", (20, 30)),
    boxes=arrays("i8", (4, 4), elements=some.integers(-3, 40)),
    full=some.floats(0, 7e4),
)
def test_an_observation_requires_boxes_inside_the_frame(
    image: NDArray, boxes: NDArray, full: float
) -> None:
    observation = answered(lambda: exposure_control.observe(image, boxes, full, Control(1e3)))
    inside = (boxes[:, :2] >= 0).all() and (boxes[:, 2:] < [30, 20]).all()
    assert (observation is not None) == inside
    everything = exposure_control.observe(
        image, np.array([[0, 0, 29, 19]]), full, Control(1e3)
    )
    np.testing.assert_allclose(everything.mean_dn, image.mean(), rtol=1e-12, atol=0)
    assert everything.overexposed == (np.count_nonzero(image >= full) > 1)
