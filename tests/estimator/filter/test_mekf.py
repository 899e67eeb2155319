"""The attitude filter: Farrenkopf's steady state, Monte Carlo consistency, late solutions, saturation and the gate."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from estimator.core.types import FilterState
from estimator.filter.error_models import GyroModel
from estimator.filter.mekf import (
    HISTORY_S,
    OUTSIDE_GATE,
    RESET,
    TOO_OLD,
    USED,
    AttitudeFilter,
    Update,
)
from estimator.filter.states import transition
from tests.helpers.tumble import tumble_angle_rad, tumble_body_from_ref

ARCSEC_RAD = np.pi / 180 / 3600
DEG_H_RAD_S = np.pi / 180 / 3600
ARW_RAD_SQRT_S = np.radians(0.07) / 60  # the LN-200's 0.07 deg / sqrt(h)
HOME = Rotation.identity()
QUIET = GyroModel(ARW_RAD_SQRT_S, 0.0, np.inf)
TRACKER_RAD2 = np.diag([10.0, 10.0, 60.0]) ** 2 * ARCSEC_RAD**2


def error_rad(state: FilterState, body_from_ref: Rotation) -> np.ndarray:
    """Small rotation in body axes from the filter's attitude to the true one."""
    return (state.body_from_ref * body_from_ref.inv()).as_rotvec()


def measured(
    body_from_ref: Rotation, covariance_rad2: np.ndarray, rng: np.random.Generator | None
) -> Rotation:
    """A solution whose error in body axes has this covariance; exact without a generator."""
    if rng is None:
        return body_from_ref
    noise = np.linalg.cholesky(covariance_rad2) @ rng.normal(size=3)
    return Rotation.from_rotvec(-noise) * body_from_ref


# ---- A tumble, integrated by another method ----


def test_the_filter_integrates_the_gyro() -> None:
    t_s = np.arange(4001) / 400
    mekf = AttitudeFilter(QUIET, 0.0, HOME, 0.0, 0.0)
    mekf.propagate(t_s[1:], tumble_angle_rad(t_s), np.zeros(4000, bool))
    # Increments are no rotation vectors: coning, (w x w') T^3 / 12 a sample at most, 10 s of w w' = 0.02.
    assert (
        np.abs(error_rad(mekf.state, tumble_body_from_ref(t_s)[-1])).max()
        < 0.02 * 10 / 400**2 / 12
    )
    assert mekf.rate_rad_s == pytest.approx(tumble_angle_rad(t_s).sum(axis=0) / 10, abs=1e-12)


def test_the_rate_is_the_last_call_s_less_the_bias() -> None:
    mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 1e-3)
    assert not mekf.rate_rad_s.any()
    mekf.propagate([1.0], [[0.0, 0.0, 0.5]], [False])
    mekf.propagate([1.1, 1.2], [[0.01, 0.0, 0.0], [0.03, 0.0, 0.0]], [False, False])
    turned = Rotation.from_rotvec([1e-3, 0, 0]) * mekf.body_from_ref
    assert mekf.update(1.2, turned, TRACKER_RAD2).status == USED
    # The solution says that the vehicle turned less than the gyro says: the bias is positive.
    assert mekf.bias_rad_s[0] > 1e-4
    assert mekf.rate_rad_s == pytest.approx(
        np.array([0.2, 0, 0]) - mekf.bias_rad_s, abs=1e-12
    )


# ---- The covariance ----


@pytest.mark.slow
def test_an_error_common_to_all_solutions_remains_in_the_covariance() -> None:
    """Fifteen solutions with a common error of covariance S and noise of S / 9: NEES 3, less what S adds as noise."""
    rng = np.random.default_rng(15)
    common_rad2 = TRACKER_RAD2
    nees = []
    for _ in range(400):
        mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e-2, 0.0)
        shifted = measured(HOME, common_rad2, rng)
        for k in range(15):
            mekf.propagate([k + 1.0], np.zeros((1, 3)), [False])
            noisy = measured(shifted, common_rad2 / 9, rng)
            assert (
                mekf.update(k + 1.0, noisy, common_rad2 * 10 / 9, common_rad2).status == USED
            )
        error = error_rad(mekf.state, HOME)
        nees.append(error @ np.linalg.solve(mekf.state.covariance[:3, :3], error))
    assert np.mean(nees) == pytest.approx(
        3 * (1 + 1 / 135) / (1 + 10 / 135), abs=4 * np.sqrt(6 / 400)
    )


def test_the_covariance_obeys_riccati_s_equation_while_turning() -> None:
    gyro = GyroModel(1e-4, 2e-4, 20.0)
    rate = np.array([0.3, -0.8, 0.5])
    start = np.diag(np.array([1e-3, 2e-3, 3e-3, 1e-4, 2e-4, 3e-4]) ** 2)
    drift = np.zeros((6, 6))
    drift[:3, :3] = np.cross(rate, np.eye(3), axisb=0, axisc=0) * -1
    drift[:3, 3:] = -np.eye(3)
    drift[3:, 3:] = -np.eye(3) / 20
    noise = np.diag([1e-4**2] * 3 + [2 * 2e-4**2 / 20] * 3)

    def slope(_: float, p: np.ndarray) -> np.ndarray:
        half = drift @ p.reshape(6, 6)
        return (half + half.T + noise).ravel()

    oracle = (
        solve_ivp(slope, (0, 3), start.ravel(), "DOP853", rtol=1e-11, atol=1e-16)
        .y[:, -1]
        .reshape(6, 6)
    )
    mekf = AttitudeFilter(
        gyro, 0.0, HOME, np.sqrt(np.diag(start)[:3]), np.sqrt(np.diag(start)[3:])
    )
    t_s = np.arange(1, 1201) / 400
    mekf.propagate(t_s, np.tile(rate / 400, (1200, 1)), np.zeros(1200, bool))
    scale = np.sqrt(np.outer(np.diag(oracle), np.diag(oracle)))
    # The noise between angle and bias is not turned within a sample: w T / 3 of that noise alone.
    assert np.abs((mekf.state.covariance - oracle) / scale).max() < 1e-6


def farrenkopf(
    arw: float, walk: float, sigma_rad: float, period_s: float
) -> tuple[float, float, float, float]:
    """Steady sigmas before and after a solution: attitude, attitude, bias, bias (Farrenkopf 1978, in closed form).

    With s = p/R + 1 = x^2 the Riccati equation of one axis becomes quadratic in z = x + 1/x:
    z^2 - 4 = S_u z + S_v^2 - S_u^2 / 6, where S_u = walk T^(3/2) / sigma, S_v = arw T^(1/2) / sigma.
    """
    s_u = walk * period_s**1.5 / sigma_rad
    s_v = arw * period_s**0.5 / sigma_rad
    z = s_u / 2 + 2 * np.sqrt(1 + s_v**2 / 4 + s_u**2 / 48)
    x = (z + np.sqrt(z**2 - 4)) / 2
    bias2 = walk * sigma_rad / np.sqrt(period_s) * (x - 1 / x)
    half = walk**2 * period_s / 2
    return (
        sigma_rad * np.sqrt(x**2 - 1),
        sigma_rad * np.sqrt(1 - 1 / x**2),
        float(np.sqrt(bias2 + half)),
        float(np.sqrt(bias2 - half)),
    )


@pytest.mark.parametrize(
    ("s_u", "s_v", "period_s"), [(0.05, 0.3, 1.0), (1.0, 0.1, 1.0), (0.3, 2.0, 0.25)]
)
def test_the_variance_reaches_farrenkopf_s_steady_state(
    s_u: float, s_v: float, period_s: float
) -> None:
    sigma_rad = 20 * ARCSEC_RAD
    arw = s_v * sigma_rad / period_s**0.5
    walk = s_u * sigma_rad / period_s**1.5
    time_s = 1e9  # a random walk is the limit of a long correlation time
    mekf = AttitudeFilter(
        GyroModel(arw, walk * np.sqrt(time_s / 2), time_s), 0.0, HOME, 1e-3, 10 * walk
    )
    share = np.arange(1, 51) / 50
    for k in range(300):
        mekf.propagate((k + share) * period_s, np.zeros((50, 3)), np.zeros(50, bool))
        before = mekf.state
        assert mekf.update((k + 1) * period_s, HOME, np.eye(3) * sigma_rad**2).status == USED
    after = mekf.state
    oracle = np.array(farrenkopf(arw, walk, sigma_rad, period_s))
    ours = np.array(
        [
            before.sigma_attitude_rad,
            after.sigma_attitude_rad,
            before.sigma_bias_rad_s,
            after.sigma_bias_rad_s,
        ]
    )
    assert np.abs(ours / oracle[:, None] - 1).max() < 1e-6


@pytest.mark.parametrize("angle_rad", [5e-4, 1e-2, 0.5, 3.0])
def test_the_transition_is_the_exponential_of_the_error_s_equation(angle_rad: float) -> None:
    """e' = -[w] e - db with db constant: the matrix exponential, both where J is a series and where it is closed."""
    rotation = angle_rad * np.array([0.48, -0.6, 0.64])
    step_s = 0.2
    slope = np.zeros((6, 6))
    slope[:3, :3] = np.cross(rotation, np.eye(3), axisb=0, axisc=0) * -1
    slope[:3, 3:] = -step_s * np.eye(3)
    rows = np.empty((3, 6))
    transition(rotation, step_s, rows)
    assert np.abs(rows - expm(slope)[:3]).max() < 1e-14


def test_after_a_large_correction_the_covariance_is_the_solution_s() -> None:
    spread = np.diag([1.0, 4.0, 30.0]) ** 2 * 1e-8
    mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e3, 0.0, floor_rad=3e-4)
    attitude = Rotation.from_rotvec([1.0, -0.6, 0.8])
    assert mekf.update(0.0, attitude, spread).status == USED
    # In the axes of the body where it now is, not where it was thought to be a radian away.
    expected = spread + 3e-4**2 * np.eye(3)
    assert np.abs(error_rad(mekf.state, attitude)).max() < 1e-6
    assert np.abs(mekf.state.covariance[:3, :3] - expected).max() < 1e-6 * expected.max()


@dataclass(frozen=True)
class World:
    """One draw of a tumble with a random-walk bias: gyro samples and the truth."""

    t_s: np.ndarray
    angle_rad: np.ndarray
    bias_rad_s: np.ndarray


def drawn(
    gyro: GyroModel, sigma_bias: float, t_s: np.ndarray, rng: np.random.Generator
) -> World:
    step_s = float(t_s[1])
    count = len(t_s) - 1
    decay = np.exp(-step_s / gyro.bias_time_s)
    kicks = gyro.bias_rad_s * np.sqrt(1 - decay**2) * rng.normal(size=(count, 3))
    bias = np.empty((count + 1, 3))
    bias[0] = sigma_bias * rng.normal(size=3)
    for n in range(count):
        bias[n + 1] = decay * bias[n] + kicks[n]
    walk = gyro.arw_rad_sqrt_s * np.sqrt(step_s) * rng.normal(size=(count, 3))
    angle = tumble_angle_rad(t_s) + (bias[1:] + bias[:-1]) / 2 * step_s + walk
    return World(t_s, angle, bias)


@pytest.mark.long
def test_the_errors_match_the_covariance() -> None:
    # Solutions once a second, for a moment 0.3025 s ago, in the middle of a sample; 4 sigma of a chi-square's mean.
    runs = 300
    seconds = 5
    rate_hz = 200
    late_s = 0.3025
    gyro = GyroModel(1e-4, 3e-4, 20.0)
    floor_rad = 2e-5
    sigma_bias = 3e-4
    sigma_attitude = np.array([0.01, 0.02, 0.03])
    axes = Rotation.from_rotvec([0.3, 0.5, -0.4]).as_matrix()
    spread = axes @ np.diag([3e-5, 5e-5, 3e-4]) ** 2 @ axes.T
    t_s = np.arange(seconds * rate_hz + 1) / rate_hz
    truth = tumble_body_from_ref(t_s)
    seen = tumble_body_from_ref(np.arange(1, seconds + 1) - late_s)
    rng = np.random.default_rng(61)
    nees = np.empty((runs, 2))
    statuses = set()
    for run in range(runs):
        world = drawn(gyro, sigma_bias, t_s, rng)
        start = Rotation.from_rotvec(sigma_attitude * rng.normal(size=3)) * truth[0]
        mekf = AttitudeFilter(gyro, 0.0, start, sigma_attitude, sigma_bias, floor_rad)
        for k in range(seconds):
            rows = slice(k * rate_hz, (k + 1) * rate_hz)
            mekf.propagate(t_s[1:][rows], world.angle_rad[rows], np.zeros(rate_hz, bool))
            solution = measured(seen[k], spread + floor_rad**2 * np.eye(3), rng)
            statuses.add(mekf.update(k + 1 - late_s, solution, spread).status)
        state = mekf.state
        error = np.concatenate(
            [error_rad(state, truth[-1]), world.bias_rad_s[-1] - state.bias_rad_s]
        )
        nees[run, 0] = error[:3] @ np.linalg.solve(state.covariance[:3, :3], error[:3])
        nees[run, 1] = error @ np.linalg.solve(state.covariance, error)
    assert statuses == {USED}
    assert abs(nees[:, 0].mean() - 3) < 4 * np.sqrt(2 * 3 / runs)
    assert abs(nees[:, 1].mean() - 6) < 4 * np.sqrt(2 * 6 / runs)


@pytest.mark.long
def test_200_runs_are_within_their_bands_at_many_rates_with_frames_lost_and_out_of_order() -> (
    None
):
    # Bar-Shalom's tests: NEES at the end, NIS of each solution, both within the 95 % band of their chi-squares.
    # Gyro at 200 Hz, asked for in calls of 1 to 40 samples; solutions at 5 Hz of which a third never comes, and the
    # others 0.05 to 0.5 s late, so that they overtake one another.
    runs = 200
    seconds = 4
    rate_hz = 200
    gyro = GyroModel(1e-4, 3e-4, 20.0)
    sigma_bias = 3e-4
    sigma_attitude = 0.01
    spread = np.diag([3e-5, 5e-5, 3e-4]) ** 2
    t_s = np.arange(seconds * rate_hz + 1) / rate_hz
    truth = tumble_body_from_ref(t_s)
    seen_s = np.arange(0.1, seconds - 0.5, 0.2) + 1 / 3000
    seen = tumble_body_from_ref(np.append(seen_s, seconds))
    rng = np.random.default_rng(69)
    nees = np.empty(runs)
    nis = []
    overtaken = 0
    for run in range(runs):
        world = drawn(gyro, sigma_bias, t_s, rng)
        start = Rotation.from_rotvec(sigma_attitude * rng.normal(size=3)) * truth[0]
        mekf = AttitudeFilter(gyro, 0.0, start, sigma_attitude, sigma_bias)
        arrives_s = seen_s + rng.uniform(0.05, 0.5, len(seen_s))
        arrives_s[rng.random(len(seen_s)) < 1 / 3] = np.inf
        waiting = [int(k) for k in np.argsort(arrives_s) if arrives_s[k] < np.inf]
        overtaken += int(np.sum(np.diff(seen_s[waiting]) < 0))
        at = 0
        while at < len(t_s) - 1:
            rows = slice(at, min(at + int(rng.integers(1, 41)), len(t_s) - 1))
            mekf.propagate(
                t_s[1:][rows], world.angle_rad[rows], np.zeros(rows.stop - at, bool)
            )
            at = rows.stop
            while waiting and arrives_s[waiting[0]] <= t_s[at]:
                k = waiting.pop(0)
                nis.append(
                    mekf.update(seen_s[k], measured(seen[k], spread, rng), spread).distance
                    ** 2
                )
        state = mekf.state
        error = np.concatenate(
            [error_rad(state, truth[-1]), world.bias_rad_s[-1] - state.bias_rad_s]
        )
        nees[run] = error @ np.linalg.solve(state.covariance, error)
    assert overtaken > runs
    for squared, freedom in ((nees, 6), (np.array(nis), 3)):
        low, high = chi2.ppf([0.025, 0.975], freedom * len(squared)) / len(squared)
        assert low < squared.mean() < high
        # The distribution too, not its mean alone: Kolmogorov-Smirnov at 1 %.
        assert kstest(squared, chi2(freedom).cdf).pvalue > 0.01


@pytest.mark.long
def test_a_constant_bias_is_found_to_its_sigma() -> None:
    rng = np.random.default_rng(62)
    runs = 12
    bias = 5 * DEG_H_RAD_S
    z = np.empty((runs, 3))
    found = np.empty((runs, 3))
    samples = np.arange(1, 11) / 10
    for run in range(runs):
        mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 10 * DEG_H_RAD_S)
        for k in range(200):
            noise = ARW_RAD_SQRT_S * np.sqrt(0.1) * rng.normal(size=(10, 3))
            mekf.propagate(k + samples, bias * 0.1 + noise, np.zeros(10, bool))
            mekf.update(k + 1.0, measured(HOME, TRACKER_RAD2, rng), TRACKER_RAD2)
        found[run] = mekf.bias_rad_s
        z[run] = (found[run] - bias) / mekf.state.sigma_bias_rad_s
    # 200 s of 0.07 deg / sqrt(h) alone leave 0.30 deg / h; the start's 10 deg / h must be forgotten.
    sigma = mekf.state.sigma_bias_rad_s
    assert (sigma < 0.5 * DEG_H_RAD_S).all()
    assert (np.abs(found.mean(axis=0) - bias) < 4 * sigma / np.sqrt(runs)).all()
    assert abs(np.mean(z**2) - 1) < 4 * np.sqrt(2 / z.size)


def test_a_bias_that_is_no_longer_seen_is_forgotten_with_its_time() -> None:
    # E[b(t)] = b(0) exp(-t / time), and the attitude is corrected by its integral.
    time_s = 20.0
    bias = 1e-4
    mekf = AttitudeFilter(GyroModel(ARW_RAD_SQRT_S, 1e-4, time_s), 0.0, HOME, 1e-3, 1e-4)
    samples = np.arange(1, 101) / 100
    for k in range(10):
        mekf.propagate(k + samples, np.full((100, 3), bias / 100), np.zeros(100, bool))
        assert mekf.update(k + 1.0, HOME, TRACKER_RAD2).status == USED
    before = mekf.state
    assert (before.bias_rad_s > 0.5 * bias).all()
    mekf.propagate(10 + np.arange(1, 2001) / 100, np.zeros((2000, 3)), np.zeros(2000, bool))
    after = mekf.state
    assert after.bias_rad_s == pytest.approx(before.bias_rad_s / np.e, rel=1e-9)
    # 1e-6: the integral is a series in the sample interval over the time, 5e-4.
    turned = (before.body_from_ref * after.body_from_ref.inv()).as_rotvec()
    assert turned == pytest.approx(-before.bias_rad_s * time_s * (1 - 1 / np.e), rel=1e-6)


# ---- Late solutions ----


def same(a: FilterState, b: FilterState) -> None:
    """Equal to rounding."""
    assert a.t_s == b.t_s
    assert np.abs(a.body_from_ref.as_matrix() - b.body_from_ref.as_matrix()).max() < 1e-12
    assert np.abs(a.bias_rad_s - b.bias_rad_s).max() < 1e-12
    assert np.abs(a.covariance - b.covariance).max() < 1e-12 * np.abs(a.covariance).max()


@pytest.mark.parametrize("seen_s", [0.5, 0.50113, 0.7481, 1e-4, 1.0])
def test_a_late_solution_is_as_good_as_one_in_order(seen_s: float) -> None:
    gyro = GyroModel(1e-4, 3e-4, 20.0)
    t_s = np.arange(401) / 400
    angle = tumble_angle_rad(t_s)
    saturated = (t_s[1:] > 0.6) & (t_s[1:] < 0.8)
    wrong = Rotation.from_rotvec([0.002, 0.01, -0.004])
    seen, end = tumble_body_from_ref(np.array([seen_s, 1.001]))
    late, ordered = (AttitudeFilter(gyro, 0.0, wrong, 0.01, 1e-3) for _ in range(2))
    for k in range(100):
        rows = slice(4 * k, 4 * k + 4)
        late.propagate(t_s[1:][rows], angle[rows], saturated[rows])
    # The sample that contains it, or ends there.
    split = int(np.searchsorted(t_s[1:], seen_s, side="left"))
    share = (seen_s - t_s[split]) / (t_s[split + 1] - t_s[split])
    times = np.insert(t_s[1:], split, seen_s)
    angles = np.insert(angle, split, share * angle[split], axis=0)
    angles[split + 1] *= 1 - share
    flags = np.insert(saturated, split, saturated[split])
    ordered.propagate(times[: split + 1], angles[: split + 1], flags[: split + 1])
    rest = times > seen_s  # without a sample of no length where the solution falls on an end
    updates = [mekf.update(seen_s, seen, TRACKER_RAD2) for mekf in (late, ordered)]
    assert updates[0].status == updates[1].status == USED
    assert updates[0].distance == pytest.approx(updates[1].distance, rel=1e-9)
    for t, a, s in zip(times[rest], angles[rest], flags[rest], strict=True):
        ordered.propagate([t], [a], [s])
    same(late.state, ordered.state)
    # The samples after the first solution are still there for a second, a little later.
    for mekf in (late, ordered):
        assert mekf.update(1.0, end, TRACKER_RAD2).status == USED
    same(late.state, ordered.state)


def test_a_solution_from_before_the_memory_is_refused() -> None:
    mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 1e-5)
    t_s = np.arange(1, 2501) / 100
    for rows in np.arange(2500).reshape(-1, 10):
        mekf.propagate(t_s[rows], np.zeros((10, 3)), np.zeros(10, bool))
    before = mekf.state
    update = mekf.update(14.0, HOME, TRACKER_RAD2)
    assert update.status == TOO_OLD
    assert np.isnan([*update.residual_rad, update.distance]).all()
    same(before, mekf.state)
    assert mekf.update(20.5, HOME, TRACKER_RAD2).status == USED


def test_memory_does_not_grow_and_reaches_half_of_its_span_at_least() -> None:
    mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 1e-5)
    for k in range(60):
        mekf.propagate(k + np.arange(1, 11) / 10, np.zeros((10, 3)), np.zeros(10, bool))
        if k % 3:
            assert mekf.update(k + 0.95, HOME, TRACKER_RAD2).status == USED
        kept_s = 60 if k < 10 else HISTORY_S / 2
        assert (
            mekf.update(max(k + 1.0 - kept_s, 0.0) + 0.01, HOME, TRACKER_RAD2).status == USED
        )
    assert mekf.update(45.0, HOME, TRACKER_RAD2).status == TOO_OLD
    assert sum(len(segment.samples) for segment in mekf._segments) < 10 * (
        HISTORY_S + 3
    ) + 3 * len(mekf._segments)
    assert len(mekf._segments) < 3 * HISTORY_S


@pytest.mark.parametrize("order", [(1, 0, 2, 3), (3, 2, 1, 0), (2, 3, 0, 1)])
def test_solutions_in_any_order_end_where_the_right_order_ends(
    order: tuple[int, ...],
) -> None:
    gyro = GyroModel(1e-4, 3e-4, 20.0)
    rng = np.random.default_rng(68)
    t_s = np.arange(401) / 400
    angle = tumble_angle_rad(t_s)
    seen_s = np.array([0.2, 0.45125, 0.4513, 0.9])
    solutions = [
        measured(truth, TRACKER_RAD2, rng)
        for truth in tumble_body_from_ref(np.append(seen_s, 1.0))
    ]
    shuffled, ordered = (AttitudeFilter(gyro, 0.0, HOME, 0.01, 1e-3) for _ in range(2))
    for mekf, rows in ((shuffled, order), (ordered, range(4))):
        mekf.propagate(t_s[1:], angle, np.zeros(400, bool))
        for k in rows:
            assert mekf.update(seen_s[k], solutions[k], TRACKER_RAD2).status == USED
    # Each is as informative as its own noise, so that leaving one out would show.
    same(shuffled.state, ordered.state)
    lacking = AttitudeFilter(gyro, 0.0, HOME, 0.01, 1e-3)
    lacking.propagate(t_s[1:], angle, np.zeros(400, bool))
    for k in order[1:]:
        lacking.update(seen_s[k], solutions[k], TRACKER_RAD2)
    assert np.abs(lacking.state.covariance / ordered.state.covariance - 1).max() > 0.01


# ---- A blow beyond the gyro's limit ----


@dataclass
class Blow:
    """Rest, a blow about an axis at 3 times the limit for 0.2 s from 20.4 s on, and rest; the gyro at 400 Hz."""

    limit_rad_s: float
    bias_rad_s: float = 5 * DEG_H_RAD_S

    def rate_rad_s(self, t_s: np.ndarray) -> np.ndarray:
        blow = (t_s > 20.4) & (t_s < 20.6)
        return np.where(blow, 3 * self.limit_rad_s, 0.0)[:, None] * [1.0, 0, 0] + [
            0.0,
            0.02,
            -0.03,
        ]

    def body_from_ref(self, t_s: float) -> Rotation:
        """Attitude of three phases at constant rates."""
        attitude = HOME
        for a, b in ((0.0, 20.4), (20.4, 20.6), (20.6, 40.0)):
            rate = self.rate_rad_s(np.array([(a + b) / 2]))[0]
            attitude = Rotation.from_rotvec(-rate * np.clip(t_s - a, 0, b - a)) * attitude
        return attitude

    def fly(
        self,
        mekf: AttitudeFilter,
        from_s: int,
        to_s: int,
        flagged: bool,
        rng: np.random.Generator,
    ) -> list[str]:
        """Fly second by second with a solution after each; return their statuses."""
        statuses = []
        for k in range(from_s, to_s):
            middle_s = k + (np.arange(400) + 0.5) / 400
            rate = self.rate_rad_s(middle_s) + self.bias_rad_s
            limited = np.clip(rate, -self.limit_rad_s, self.limit_rad_s)
            noise = ARW_RAD_SQRT_S * np.sqrt(1 / 400) * rng.normal(size=(400, 3))
            saturated = (limited != rate).any(axis=1) & flagged
            mekf.propagate(middle_s + 0.5 / 400, limited / 400 + noise, saturated)
            solution = measured(self.body_from_ref(k + 1.0), TRACKER_RAD2, rng)
            statuses.append(mekf.update(k + 1.0, solution, TRACKER_RAD2).status)
        return statuses


@pytest.mark.parametrize("limit_deg_s", [10.0, 100.0])
def test_after_a_blow_the_filter_recovers_and_keeps_its_bias(limit_deg_s: float) -> None:
    blow = Blow(np.radians(limit_deg_s))
    rng = np.random.default_rng(67)
    mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 10 * DEG_H_RAD_S)
    assert set(blow.fly(mekf, 0, 20, True, rng)) == {USED}
    before = mekf.state
    assert blow.fly(mekf, 20, 22, True, rng) == [USED, USED]
    state = mekf.state
    assert (
        np.abs(error_rad(state, blow.body_from_ref(22.0))) < 4 * state.sigma_attitude_rad
    ).all()
    assert (state.sigma_attitude_rad < 2 * before.sigma_attitude_rad).all()
    assert (np.abs(state.bias_rad_s - blow.bias_rad_s) < 4 * state.sigma_bias_rad_s).all()
    assert (np.abs(state.bias_rad_s - before.bias_rad_s) < before.sigma_bias_rad_s).all()


def test_without_the_saturation_flag_the_blow_corrupts_the_bias() -> None:
    blow = Blow(np.radians(10.0))
    rng = np.random.default_rng(67)
    trusting = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 10 * DEG_H_RAD_S, gate_sigma=np.inf)
    assert set(blow.fly(trusting, 0, 22, False, rng)) == {USED}
    state = trusting.state
    assert np.abs((state.bias_rad_s - blow.bias_rad_s) / state.sigma_bias_rad_s).max() > 100
    # With the gate it is lost for two frames and found at the third.
    gated = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 10 * DEG_H_RAD_S)
    rng = np.random.default_rng(67)
    assert blow.fly(gated, 0, 24, False, rng)[20:] == [
        OUTSIDE_GATE,
        OUTSIDE_GATE,
        RESET,
        USED,
    ]
    state = gated.state
    assert (np.abs(state.bias_rad_s - blow.bias_rad_s) < 4 * state.sigma_bias_rad_s).all()


def test_plain_integration_keeps_the_missed_angle_as_an_error() -> None:
    blow = Blow(np.radians(10.0), bias_rad_s=0.0)
    plain = AttitudeFilter(QUIET, 0.0, HOME, 0.0, 0.0)
    missed_rad = 0.2 * 2 * blow.limit_rad_s
    for to_s, from_s in ((21, 0), (40, 21)):
        middle_s = from_s + (np.arange(400 * (to_s - from_s)) + 0.5) / 400
        rate = np.clip(blow.rate_rad_s(middle_s), -blow.limit_rad_s, blow.limit_rad_s)
        plain.propagate(middle_s + 0.5 / 400, rate / 400, np.zeros(len(rate), bool))
        # 1 %: about the other axes the vehicle turned 0.2 s x 0.036 rad/s while the gyro was lost.
        assert np.linalg.norm(
            error_rad(plain.state, blow.body_from_ref(to_s))
        ) == pytest.approx(missed_rad, rel=0.01)


@pytest.mark.parametrize("rate_hz", [100, 400])
def test_saturation_spreads_in_proportion_to_its_time(rate_hz: int) -> None:
    # 0.3 s at 2 rad/s, twice: a sigma of 0.6 rad each, independent; whatever the sample rate.
    mekf = AttitudeFilter(GyroModel(0.0, 0.0, np.inf), 0.0, HOME, 0.0, 0.0)
    t_s = np.arange(1, rate_hz + 1) / rate_hz
    middle_s = t_s - 0.5 / rate_hz
    saturated = ((middle_s > 0.1) & (middle_s < 0.4)) | ((middle_s > 0.5) & (middle_s < 0.8))
    angle = np.where(saturated, -2.0, 0.5)[:, None] / rate_hz * [1.0, 0, 0]
    mekf.propagate(t_s, angle, saturated)
    assert mekf.state.sigma_attitude_rad == pytest.approx(
        0.6 * np.sqrt(2) * np.ones(3), rel=1e-9
    )
    assert not mekf.state.sigma_bias_rad_s.any()


# ---- The gate ----


def turning() -> AttitudeFilter:
    """A filter after three solutions of a constant rate of 0.1 rad/s about z."""
    mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 10 * DEG_H_RAD_S)
    for k in range(3):
        assert after_turning(mekf, k).status == USED
    return mekf


def after_turning(
    mekf: AttitudeFilter, second: int, jump: Rotation = HOME, outage: int = 0
) -> Update:
    """Advance one second and update with jump * the true body_from_ref.

    outage : number of gyro samples that are missing at its end
    """
    t_s = second + np.arange(1, 101) / 100
    angle = np.tile([0.0, 0.0, 1e-3], (100, 1))
    missing = np.arange(100) >= 100 - outage
    angle[missing] = np.nan
    mekf.propagate(t_s, angle, np.zeros(100, bool), missing)
    return mekf.update(t_s[-1], true(second + 1, jump), TRACKER_RAD2)


def true(t_s: float, jump: Rotation = HOME) -> Rotation:
    """body_from_ref at the constant rate, with a jump on the reference side that rotates along."""
    return Rotation.from_rotvec([0.0, 0.0, -0.1 * t_s]) * jump


def wild(*rotvec: float) -> Rotation:
    return Rotation.from_rotvec(rotvec)


@pytest.mark.slow
def test_the_gate_rejects_as_rarely_as_its_number_of_sigma() -> None:
    # 1.5 sigma of one normal number is exceeded in 13.4 % of draws, here from the filter's own uncertainty.
    rng = np.random.default_rng(64)
    count = 500
    outside = 0
    spread = 1e-6 * np.eye(3) + TRACKER_RAD2
    for _ in range(count):
        mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 0.0, gate_sigma=1.5)
        outside += (
            mekf.update(0.0, measured(HOME, spread, rng), TRACKER_RAD2).status == OUTSIDE_GATE
        )
    assert abs(outside / count - 0.1336) < 4 * np.sqrt(0.1336 * 0.8664 / count)


def test_a_single_outlier_is_rejected_without_effect() -> None:
    mekf = turning()
    untouched = turning()
    update = after_turning(mekf, 3, wild(0.5, 0, 0))
    assert update.status == OUTSIDE_GATE
    # From the filter to the solution, in body axes; body_from_ref turns the other way.
    assert update.residual_rad == pytest.approx(true(3 + 1).apply([-0.5, 0, 0]), abs=1e-3)
    assert update.distance > 100
    t_s = 3 + np.arange(1, 101) / 100
    untouched.propagate(t_s, np.tile([0.0, 0.0, 1e-3], (100, 1)), np.zeros(100, bool))
    same(mekf.state, untouched.state)
    for k in range(4, 6):
        assert after_turning(mekf, k).status == after_turning(untouched, k).status == USED
        same(mekf.state, untouched.state)


def test_outliers_that_disagree_are_always_rejected() -> None:
    mekf = turning()
    rng = np.random.default_rng(65)
    for k in range(3, 15):
        assert after_turning(mekf, k, Rotation.random(rng=rng)).status == OUTSIDE_GATE
    assert after_turning(mekf, 15).status == USED


def test_constant_solutions_of_a_rotating_vehicle_do_not_agree() -> None:
    mekf = turning()
    for k in range(3, 9):
        still = true(k + 1).inv() * wild(0.5, 0, 0)
        assert after_turning(mekf, k, still).status == OUTSIDE_GATE


@pytest.mark.parametrize("outage", [5, 20, 50])
def test_a_jump_during_an_outage_is_taken_at_the_third_solution(outage: int) -> None:
    mekf = turning()
    jump = wild(0.3, -0.2, 0.6)
    assert after_turning(mekf, 3, jump, outage).status == OUTSIDE_GATE
    assert after_turning(mekf, 4, jump).status == OUTSIDE_GATE
    before = mekf.state
    assert after_turning(mekf, 5, jump).status == RESET
    state = mekf.state
    assert np.abs(error_rad(state, true(6, jump))).max() < 1e-9
    assert np.abs(state.covariance[:3, :3] - TRACKER_RAD2).max() < 1e-9 * TRACKER_RAD2.max()
    assert not state.covariance[:3, 3:].any()
    assert (state.bias_rad_s == before.bias_rad_s).all()
    # The last second's gyro noise does not touch a constant bias: its variance is the old one and the start's.
    inflated = before.covariance[3:, 3:] + np.eye(3) * (10 * DEG_H_RAD_S) ** 2
    assert np.abs(state.covariance[3:, 3:] - inflated).max() < 1e-9 * inflated.max()
    assert after_turning(mekf, 6, jump).status == USED


def test_a_good_solution_resets_the_count_of_agreeing_outliers() -> None:
    mekf = turning()
    jump = wild(0.3, -0.2, 0.6)
    got = [
        after_turning(mekf, 3 + k, turn).status
        for k, turn in enumerate([jump, jump, HOME, jump, jump])
    ]
    assert got == [OUTSIDE_GATE, OUTSIDE_GATE, USED, OUTSIDE_GATE, OUTSIDE_GATE]


# ---- Refused solutions that confirm each other ----


def refused_then(
    rate_rad_s: float,
    gap_s: float,
    spread: np.ndarray,
    sigma_bias: float,
    turns: list[Rotation],
) -> str:
    """Status of the last solution of a filter that the gyro turns about x, with one solution after each gap.

    turns : error of each solution, applied to an attitude that is half a radian from the filter's
    """
    mekf = AttitudeFilter(GyroModel(0.0, sigma_bias, np.inf), 0.0, HOME, 1e-3, sigma_bias)
    status = ""
    for k, turn in enumerate(turns):
        t_s = gap_s * (k + np.arange(1, 101) / 100)
        mekf.propagate(
            t_s, np.tile([rate_rad_s * gap_s / 100, 0.0, 0.0], (100, 1)), np.zeros(100, bool)
        )
        attitude = Rotation.from_rotvec([-rate_rad_s * t_s[-1], 0.0, 0.0]) * wild(
            0.0, 0.5, 0.0
        )
        status = mekf.update(t_s[-1], turn * attitude, spread).status
    return status


@pytest.mark.parametrize(
    ("axis", "status"), [((0.0, 0.0, 4e-3), RESET), ((0.0, 4e-3, 0.0), OUTSIDE_GATE)]
)
def test_an_earlier_residual_is_rotated_with_the_body_before_comparison(
    axis: tuple[float, ...], status: str
) -> None:
    """The first solution is 4 sigma off in roll about z (allowed), or as much about y (400 sigma).

    45 deg later its error is about an axis between y and z, where the second solution alone is 100 times as precise.
    """
    spread = np.diag([1e-5, 1e-5, 1e-3]) ** 2
    assert (
        refused_then(np.pi / 4, 1.0, spread, 0.0, [Rotation.from_rotvec(axis), HOME, HOME])
        == status
    )


@pytest.mark.parametrize(("sigmas", "status"), [(4.0, RESET), (8.0, OUTSIDE_GATE)])
def test_solutions_confirm_each_other_within_what_the_bias_turns(
    sigmas: float, status: str
) -> None:
    """A bias b rotates the prediction by 3 b in 3 s; the solutions err by less than 1 % of that."""
    sigma_bias = 1e-3
    gap_s = 3.0
    drift = [wild(0.0, 0.0, sigmas * sigma_bias * gap_s * k) for k in range(3)]
    assert refused_then(0.0, gap_s, 1e-10 * np.eye(3), sigma_bias, drift) == status


# ---- Bad input ----


@pytest.mark.parametrize(
    ("covariance", "what"),
    [
        (np.diag([1e-8, 1e-8, 0.0]), "positive definite"),
        (np.diag([1e-8, -1e-8, 1e-8]), "positive definite"),
        (np.diag([1e-8, np.nan, 1e-8]), "positive definite"),
        (np.eye(3) + np.diag([0.1, 0.1], 1), "symmetric"),
        (1e-10 * np.eye(3) + np.diag([1e-13, 1e-13], 1), "symmetric"),
        (np.eye(2), r"allowed: \(3, 3\)"),
    ],
)
def test_a_bad_covariance_is_refused_in_one_line(covariance: np.ndarray, what: str) -> None:
    with pytest.raises(ValueError, match=f"update: covariance_rad2 .*{what}") as caught:
        AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 1e-5).update(0.0, HOME, covariance)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("t_s", "angle", "saturated", "what"),
    [
        ([1.0], np.zeros((1, 3)), [False], "ends at 1.0 s is 0 s long"),
        ([1.1, 1.05], np.zeros((2, 3)), [False] * 2, "ends at 1.05 s is -0.05 s long"),
        ([np.nan], np.zeros((1, 3)), [False], "NaN"),
        ([1.1], np.full((1, 3), np.inf), [False], "infinite"),
        ([1.1], np.zeros(3), [False], r"allowed: \(N,\), \(N, 3\), \(N,\)"),
        ([1.1], np.zeros((1, 3)), False, r"allowed: \(N,\), \(N, 3\), \(N,\)"),
        ([], np.zeros((0, 3)), [], "N of 1 or more"),
        ([9.0], np.zeros((1, 3)), [False], "a tenth of bias_time_s"),
    ],
)
def test_bad_samples_are_refused_in_one_line(
    t_s: list, angle: np.ndarray, saturated: list, what: str
) -> None:
    mekf = AttitudeFilter(GyroModel(1e-5, 1e-6, 20.0), 1.0, HOME, 1e-3, 1e-5)
    with pytest.raises(ValueError, match=f"propagate: .*{what}") as caught:
        mekf.propagate(t_s, angle, saturated)
    assert "\n" not in str(caught.value)
    assert mekf.state.t_s == 1.0


def test_bad_settings_and_a_solution_from_the_future_are_named() -> None:
    mekf = AttitudeFilter(QUIET, 0.0, HOME, 1e-3, 1e-5)
    with pytest.raises(
        ValueError, match=r"a solution at 1.0 s; allowed: up to the last gyro sample, 0.0 s"
    ):
        mekf.update(1.0, HOME, TRACKER_RAD2)
    with pytest.raises(ValueError, match=r"sigma_attitude_rad is -1\.0"):
        AttitudeFilter(QUIET, 0.0, HOME, -1.0, 1e-5)
    with pytest.raises(ValueError, match="floor_rad is nan"):
        AttitudeFilter(QUIET, 0.0, HOME, 1.0, 1e-5, floor_rad=np.nan)
    with pytest.raises(ValueError, match="arw_rad_sqrt_s is -1"):
        GyroModel(-1.0, 0.0, 1.0)
    with pytest.raises(ValueError, match="bias_time_s is 0"):
        GyroModel(0.0, 0.0, 0.0)
