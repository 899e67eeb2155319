"""Laws of the filter's parts: its checks, its states, the correction by a solution, the odds of a jump."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from estimator.core.types import FilterState
from estimator.filter import consistency, correct, states
from estimator.filter.error_models import GyroModel, JumpModel, TrackerModel
from estimator.filter.mekf import AttitudeFilter
from estimator.filter.states import STATES
from tests.helpers.laws import ANY, NUMBERS, SEEDS, answered, assert_covariance, law, turn

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
GYRO = GyroModel(1e-5, 1e-4, 1000.0, scale=1e-3, misalignment_rad=1e-3)
TRACKER = TrackerModel(1e-4, 100.0, 0.3, 1e-3)
CHOICES = some.sets(some.sampled_from(STATES)).map(lambda names: tuple(sorted(names)))


def covariance(rng: np.random.Generator, size: int, scale: float = 1e-3) -> NDArray:
    root = rng.normal(0, scale, (size, size))
    return root @ root.T + 1e-3 * scale**2 * np.eye(size)


def state_of(rng: np.random.Generator, layout: states.Layout) -> states.MekfState:
    """A state with some attitude, values, correlations and history."""
    values = rng.normal(0, 1e-3, layout.size)
    values[:3] = 0.0
    started = states.start_state(
        1.0, correct.wxyz_of(turn(rng)), dict.fromkeys(layout.slices, 1.0), layout
    )
    used = correct.wxyz_of(turn(rng))
    return started._replace(
        values=values, covariance=covariance(rng, layout.size), used_wxyz=used, support=5
    )


def solution_near(
    rng: np.random.Generator, state: states.MekfState, off_rad: float
) -> correct.AttitudeFix:
    near = Rotation.from_rotvec(rng.normal(0, off_rad, 3)) * state.body_from_ref
    return correct.AttitudeFix(near, covariance(rng, 3), covariance(rng, 3))


# States of several heads


@law(states.of_head, states.build_layout)
@given(heads=some.integers(1, 8), considered=CHOICES)
def test_every_head_has_its_own_mounting_and_slow_error_states(
    heads: int, considered: tuple[str, ...]
) -> None:
    """They share no row; only the first mounting can be considered, the slow errors all together."""
    layout = states.build_layout(GYRO, TRACKER, considered, heads)
    names = [
        states.of_head(name, head)
        for head in range(heads)
        for name in ("mounting", "systematic")
    ]
    rows = np.concatenate([np.arange(layout.size)[layout.slices[name]] for name in names])
    assert len(set(names)) == len(names)
    assert (
        len(set(rows.tolist()))
        == 6 * heads
        == len(layout.mountings) + layout.slow.stop - layout.slow.start
    )
    for name in ("mounting", "systematic"):
        fixed = [
            not layout.estimated[layout.slices[states.of_head(name, head)]].any()
            for head in range(heads)
        ]
        others = name in considered and name == "systematic"
        assert fixed == [name in considered, *[others] * (heads - 1)]


# What is accepted


@law(consistency.not_negative)
@given(value=ANY | NUMBERS)
def test_standard_deviations_are_kept_or_refused(value: float | NDArray) -> None:
    checked = answered(lambda: consistency.not_negative("sigma", value))
    good = np.shape(value) in ((), (3,)) and bool((np.asarray(value) >= 0).all())
    assert (checked is not None) == good
    np.testing.assert_array_equal(checked if good else value, value)


@law(consistency.checked_samples)
@given(
    rng=SEEDS, angle=arrays("f8", (5, 3), elements=some.floats(-1, 1)), lost=arrays(bool, 5)
)
def test_checked_samples_keep_measured_angles_and_mark_lost_and_limited_ones(
    rng: np.random.Generator, angle: NDArray, lost: NDArray
) -> None:
    t_s = np.cumsum(rng.uniform(0.01, 0.1, 5))
    saturated = rng.random(5) < 0.5
    gyro = replace(GYRO, limit_rad_s=3.0)
    holes = np.where(lost[:, None], np.nan, angle)
    samples = consistency.checked_samples(0.0, t_s, holes, saturated, lost, gyro)
    np.testing.assert_array_equal(samples[:, 0], t_s)
    np.testing.assert_array_equal(samples[:, 1:4], np.where(lost[:, None], 0.0, angle))
    rate_rad_s = np.abs(angle).max(axis=1) / np.diff(t_s, prepend=0.0)
    limited = saturated | (rate_rad_s >= consistency.NEAR_LIMIT * 3.0)
    np.testing.assert_array_equal(samples[:, 4], np.where(lost, 2, limited))
    np.testing.assert_array_equal(
        consistency.checked_samples(0.0, t_s, angle, saturated, None, gyro)[:, 4],
        limited.astype(float),
    )


@law(consistency.checked_covariances, consistency.is_covariance)
@given(rng=SEEDS, any_matrix=NUMBERS | arrays("f8", (3, 3), elements=ANY))
def test_a_solution_s_covariance_is_the_sum_of_noise_and_common_errors(
    rng: np.random.Generator, any_matrix: NDArray
) -> None:
    noise = covariance(rng, 3)
    common = covariance(rng, 3)
    covariances = consistency.checked_covariances(noise + common, common)
    np.testing.assert_allclose(
        covariances[0], noise, rtol=0, atol=1e-12 * np.trace(noise + common)
    )
    np.testing.assert_array_equal(covariances[1], covariances[1].T)
    assert consistency.is_covariance(noise)
    assert not consistency.is_covariance(noise - 2 * np.trace(noise) * np.eye(3))
    assert consistency.is_covariance(np.outer(noise[0], noise[0]), singular=True)
    found = answered(lambda: consistency.checked_covariances(any_matrix, None))
    assert (found is not None) == consistency.is_covariance(any_matrix)


# States


@law(states.build_layout, states.start_state, states.Layout.reported)
@given(considered=CHOICES, used=some.sets(some.sampled_from(STATES[1:4])))
def test_the_states_fill_the_covariance_without_gap_or_overlap(
    considered: tuple[str, ...], used: set[str]
) -> None:
    gyro = replace(GYRO, scale="scale" in used, misalignment_rad="misalignment" in used)
    layout = states.build_layout(
        gyro, replace(TRACKER, mounting_rad="mounting" in used), considered
    )
    assert set(layout.slices) == {"attitude", "bias", "systematic"} | used
    rows = np.concatenate(
        [np.arange(part.start, part.stop) for part in layout.slices.values()]
    )
    np.testing.assert_array_equal(rows, np.arange(layout.size))
    assert set(layout.reported) == set(layout.slices) - {"systematic"}
    assert max(part.stop for part in layout.reported.values()) == layout.size - 3
    sigmas = {name: 1.0 + k for k, name in enumerate(layout.slices)}
    started = states.start_state(2.0, np.array([1.0, 0, 0, 0]), sigmas, layout)
    for name, part in layout.slices.items():
        assert (layout.estimated[part] == (name not in considered)).all()
        assert (np.diag(started.covariance)[part] == sigmas[name] ** 2).all()
    inside = layout.columns[layout.columns >= 0]
    assert (
        len(set(inside))
        == len(inside)
        == 3 * ("scale" in used) + 6 * ("misalignment" in used)
    )


@law(states.propagate_state, states.MekfState.body_from_ref)
@given(rng=SEEDS, considered=CHOICES)
def test_a_gyro_sample_moves_the_errors_as_it_moves_the_truth(
    rng: np.random.Generator, considered: tuple[str, ...]
) -> None:
    """A small error in each state before, against the difference of two propagations."""
    layout = states.build_layout(GYRO, TRACKER, considered)
    quiet = replace(GYRO, arw_rad_sqrt_s=0.0, bias_rad_s=0.0)
    known = replace(TRACKER, systematic_time_s=np.inf)
    before = state_of(rng, layout)
    samples = np.column_stack(
        [1.0 + np.arange(1, 5) / 20, rng.normal(0, 0.2, (4, 3)), np.zeros(4)]
    )
    error = rng.normal(0, 1e-6, layout.size)
    true = before._replace(
        ref_from_body_wxyz=correct.wxyz_of(
            Rotation.from_rotvec(-error[:3]) * before.body_from_ref
        ),
        values=before.values + np.r_[np.zeros(3), error[3:]],
        covariance=np.zeros((layout.size, layout.size)),
    )
    single = before._replace(covariance=np.outer(error, error))
    moved = states.propagate_state(single, samples, quiet, known, layout)
    truth = states.propagate_state(true, samples, quiet, known, layout)
    after = np.r_[
        (moved.body_from_ref * truth.body_from_ref.inv()).as_rotvec(),
        (truth.values - moved.values)[3:],
    ]
    np.testing.assert_allclose(
        moved.covariance, np.outer(after, after), rtol=0, atol=1e-4 * (after @ after)
    )
    assert states.propagate_state(before, samples[:0], quiet, known, layout) is before


@law(states.propagate_state)
@given(rng=SEEDS, share=some.floats(0, 1), time_s=some.floats(0.1, 100))
def test_the_slow_error_returns_to_its_unit_variance(
    rng: np.random.Generator, share: float, time_s: float
) -> None:
    layout = states.build_layout(GYRO, TRACKER, ())
    tracker = replace(TRACKER, systematic_time_s=time_s)
    before = state_of(rng, layout)
    slow = layout.slices["systematic"]
    before.covariance[slow] = before.covariance[:, slow] = 0.0
    before.covariance[slow, slow] = share * np.eye(3)
    samples = np.column_stack([1.0 + np.arange(1, 5) / 20, np.zeros((4, 4))])
    after = states.propagate_state(before, samples, GYRO, tracker, layout)
    kept = np.exp(-0.2 / time_s)
    np.testing.assert_allclose(
        after.values[slow], kept * before.values[slow], rtol=1e-9, atol=0
    )
    variance = share * kept**2 + 1 - kept**2
    np.testing.assert_allclose(
        after.covariance[slow, slow], variance * np.eye(3), rtol=1e-9, atol=1e-15
    )


@law(states.decorrelate)
@given(rng=SEEDS)
def test_a_rotation_decorrelates_the_slow_error_alone(rng: np.random.Generator) -> None:
    layout = states.build_layout(GYRO, TRACKER, ())
    before = state_of(rng, layout)
    after = states.decorrelate(before, TRACKER, layout)
    slow = layout.slices["systematic"]
    used = Rotation.from_quat(before.used_wxyz, scalar_first=True)
    kept = math.exp(-(before.body_from_ref * used).magnitude() / TRACKER.systematic_angle_rad)
    np.testing.assert_allclose(
        after.values[slow], kept * before.values[slow], rtol=1e-9, atol=0
    )
    variance = kept**2 * before.covariance[slow, slow] + (1 - kept**2) * np.eye(3)
    np.testing.assert_allclose(after.covariance[slow, slow], variance, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(
        after.covariance[: slow.start, : slow.start], before.covariance[:-3, :-3]
    )
    assert_covariance(after.covariance)


# The correction


@law(correct.innovation, correct.offset_rows)
@given(rng=SEEDS, off_rad=some.floats(0, 0.5))
def test_the_residual_is_linear_in_the_error_states(
    rng: np.random.Generator, off_rad: float
) -> None:
    layout = states.build_layout(GYRO, TRACKER, ())
    prior = state_of(rng, layout)
    solution = solution_near(rng, prior, off_rad)
    found = correct.innovation(prior, solution, layout)
    rows = correct.offset_rows(solution, layout)
    slow = rows[:, layout.slices["systematic"]]
    np.testing.assert_allclose(
        slow @ slow.T, solution.systematic_rad2, rtol=0, atol=1e-9 * np.trace(slow @ slow.T)
    )
    assert not rows[:, :6].any()
    # The residual by H of a change of the offset's values: to the second order in them.
    change = np.r_[np.zeros(6), rng.normal(0, 1e-7, layout.size - 6)]
    less = correct.innovation(
        prior._replace(values=prior.values + change), solution, layout
    ).residual_rad
    np.testing.assert_allclose(
        found.residual_rad - less,
        found.H @ change,
        rtol=0,
        atol=3e-3 * np.linalg.norm(change),
    )
    apart = found.distance2
    assert apart >= 0
    larger = correct.innovation(
        prior, solution._replace(noise_rad2=10 * solution.noise_rad2), layout
    )
    assert larger.distance2 <= apart


@law(correct.correct)
@given(rng=SEEDS, considered=CHOICES)
def test_a_correction_shrinks_estimated_states_and_keeps_considered_ones(
    rng: np.random.Generator, considered: tuple[str, ...]
) -> None:
    layout = states.build_layout(GYRO, TRACKER, considered)
    prior = state_of(rng, layout)
    found = correct.innovation(prior, solution_near(rng, prior, 1e-4), layout)
    after = correct.correct(prior, found, layout)
    kept = layout.estimated == 0
    np.testing.assert_array_equal(after.values[kept], prior.values[kept])
    inside = np.ix_(kept, kept)
    np.testing.assert_allclose(
        after.covariance[inside], prior.covariance[inside], rtol=1e-9, atol=1e-15
    )
    assert_covariance(after.covariance)
    np.testing.assert_allclose(
        np.linalg.norm(after.ref_from_body_wxyz), 1, rtol=0, atol=1e-12
    )
    assert (np.diag(after.covariance)[3:] <= np.diag(prior.covariance)[3:] * (1 + 1e-9)).all()
    assert (after.support, after.lost_rad, after.used_s) == (6, 0.0, prior.t_s)
    assert correct.correct(prior._replace(lost_rad=0.1), found, layout).support == 1


@law(correct.adopt)
@given(rng=SEEDS)
def test_an_adopted_solution_leaves_no_residual_and_its_own_covariance(
    rng: np.random.Generator,
) -> None:
    layout = states.build_layout(GYRO, TRACKER, ())
    prior = state_of(rng, layout)
    solution = solution_near(rng, prior, 1.0)
    after = correct.adopt(prior, solution, layout, np.full(3, 1e-8), 4)
    assert np.linalg.norm(correct.innovation(after, solution, layout).residual_rad) < 1e-9
    rows = correct.offset_rows(solution, layout)
    expected = rows @ prior.covariance @ rows.T + solution.noise_rad2
    np.testing.assert_allclose(after.covariance[:3, :3], expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(
        np.diag(after.covariance - prior.covariance)[3:6], 1e-8, rtol=1e-6, atol=0
    )
    np.testing.assert_array_equal(after.values, prior.values)
    assert_covariance(after.covariance)
    # The error is the offset's and the noise, with opposite sign: their sum with the offset is the noise alone.
    both = rows.copy()
    both[:, :3] = np.eye(3)
    left = both @ after.covariance @ both.T
    np.testing.assert_allclose(
        left, solution.noise_rad2, rtol=0, atol=1e-9 * np.trace(expected)
    )


@law(correct.wxyz_of, correct.right_jacobian, correct.root)
@given(rng=SEEDS, length=some.floats(0, 3))
def test_rotation_vectors_and_matrix_roots_reproduce_their_arguments(
    rng: np.random.Generator, length: float
) -> None:
    some_turn = turn(rng)
    same = Rotation.from_quat(correct.wxyz_of(some_turn), scalar_first=True) * some_turn
    assert same.magnitude() < 1e-12
    # exp(p + d) = exp(p) exp(J d), with J as the mean of exp(-[p] s) over s.
    p = length * Rotation.random(rng=rng).apply([0, 0, 1.0])
    cross = np.cross(p, np.eye(3), axisb=0, axisc=0)
    block = np.zeros((6, 6))
    block[:3, :3] = -cross
    block[:3, 3:] = np.eye(3)
    np.testing.assert_allclose(
        correct.right_jacobian(p), expm(block)[:3, 3:], rtol=0, atol=1e-12
    )
    matrix = covariance(rng, 3)
    root = correct.root(matrix)
    np.testing.assert_array_equal(correct.root(np.zeros((3, 3))), np.zeros((3, 3)))
    np.testing.assert_allclose(root @ root, matrix, rtol=0, atol=1e-12 * np.trace(matrix))
    np.testing.assert_allclose(root, root.T, rtol=0, atol=1e-12 * np.trace(root))


# Jumps


@law(consistency.log_odds)
@given(
    angle=some.floats(1e-6, np.pi),
    distance=some.floats(5, 1e5),
    agreeing=some.integers(1, 1000),
    since_s=some.floats(0, 1e5),
    lost=some.floats(0, 10),
    support=some.integers(0, 10000),
)
def test_odds_rise_with_evidence_against_the_filter(
    angle: float, distance: float, agreeing: int, since_s: float, lost: float, support: int
) -> None:
    model = JumpModel()
    one = consistency.Jump(angle, distance, agreeing, since_s, lost, support)
    odds = consistency.log_odds(one, model)
    assert math.isfinite(odds)
    assert consistency.log_odds(one._replace(agreeing=agreeing + 1), model) > odds
    rising = {
        "since_s": since_s + 1,
        "lost_rad": lost + 0.1,
        "angle_rad": angle / 2,
        "distance": distance / 2,
    }
    for name, value in rising.items():
        assert consistency.log_odds(one._replace(**{name: value}), model) >= odds  # type: ignore[arg-type]
    assert consistency.log_odds(one._replace(support=support + 1), model) <= odds
    # A tracker that is wrong more often is believed less.
    assert consistency.log_odds(one, replace(model, wrong_share=1e-2)) <= odds + 1e-9


@law(consistency.shock_rad)
@given(rng=SEEDS, step=some.floats(1e-3, 1.0), slope=some.floats(-10, 10))
def test_a_step_of_the_rate_is_a_shock_and_a_slope_is_not(
    rng: np.random.Generator, step: float, slope: float
) -> None:
    at = int(rng.integers(2, 18))
    t_s = 5.0 + np.arange(1, 21) * 0.01
    rate = slope * (t_s - 5.0)[:, None] * turn(rng).apply([1.0, 0, 0])
    samples = np.column_stack([t_s, 0.01 * rate, np.zeros(20)])
    assert consistency.shock_rad(5.0, samples, 1e-9) < 1e-6
    samples[at:, 1:4] += 0.01 * step * turn(rng).apply([1.0, 0, 0])
    np.testing.assert_allclose(
        consistency.shock_rad(5.0, samples, 1e-9), 0.01 * step, rtol=1e-3, atol=0
    )
    assert consistency.shock_rad(5.0, samples, 1.0) == 0.0


@law(FilterState.sigma, AttitudeFilter.state)
@given(rng=SEEDS)
def test_the_sigma_of_each_state_is_its_part_of_the_covariance(
    rng: np.random.Generator,
) -> None:
    state = AttitudeFilter(GYRO, 0.0, turn(rng), 0.1, 0.2, tracker=TRACKER).state
    parts = [
        state.sigma_attitude_rad,
        state.sigma_bias_rad_s,
        *(state.sigma(name) for name in state.others),
    ]
    np.testing.assert_allclose(
        np.concatenate(parts) ** 2, np.diag(state.covariance), rtol=1e-12, atol=0
    )
    assert list(state.others) == ["scale", "misalignment", "mounting"]
    with pytest.raises(KeyError):
        state.sigma("attitude")
