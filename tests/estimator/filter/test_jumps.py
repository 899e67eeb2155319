"""Jumps: missed rotation against wrong solutions that agree with each other."""

from __future__ import annotations

import math
from itertools import groupby

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.filter.consistency import CONFIRMATIONS, ENOUGH, Jump, log_odds, shock_rad
from estimator.filter.error_models import GyroModel, JumpModel
from estimator.filter.mekf import DISPUTED, OUTSIDE_GATE, RESET, USED, AttitudeFilter, Update

ARCSEC_RAD = np.pi / 180 / 3600
ARW_RAD_SQRT_S = np.radians(0.07) / 60
LIMIT_RAD_S = np.radians(10.0)
GYRO = GyroModel(ARW_RAD_SQRT_S, 0.0, np.inf)
NOISE_RAD2 = np.diag([10.0, 10.0, 60.0]) ** 2 * ARCSEC_RAD**2
HOME = Rotation.identity()
KNOCKS = [(1.5, 3), (3.0, 20), (20.0, 3), (20.0, 20)]  # rate in limits of the gyro, samples
WRONG = Rotation.from_rotvec(np.radians([3.0, -4.0, 0.0]))  # 5 degrees


class Vehicle:
    """A vehicle at rest with a noisy gyro at 100 Hz and a solution each second."""

    def __init__(
        self,
        seed: int,
        gyro: GyroModel = GYRO,
        start: Rotation = HOME,
        sigma_rad: float = 1e-3,
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.second = 0
        self.mekf = AttitudeFilter(gyro, 0.0, start, sigma_rad, 1e-5)

    def update(
        self, attitude: Rotation, turn: np.ndarray | None = None, saturated: slice = slice(0)
    ) -> Update:
        """Advance one second with gyro increments (100, 3) and a solution of the attitude."""
        t_s = self.second + np.arange(1, 101) / 100
        flags = np.zeros(100, bool)
        flags[saturated] = True
        angle = (0 if turn is None else turn) + ARW_RAD_SQRT_S * 0.1 * self.rng.normal(
            size=(100, 3)
        )
        self.mekf.propagate(t_s, angle, flags)
        self.second += 1
        noise = np.sqrt(np.diag(NOISE_RAD2)) * self.rng.normal(size=3)
        return self.mekf.update(
            float(self.second), Rotation.from_rotvec(noise) * attitude, NOISE_RAD2
        )

    def updates(self, attitude: Rotation, count: int) -> list[Update]:
        return [self.update(attitude) for _ in range(count)]

    def error_rad(self, attitude: Rotation = HOME) -> float:
        return float((self.mekf.body_from_ref * attitude.inv()).magnitude())


def statuses(updates: list[Update]) -> list[tuple[str, int]]:
    """Each status with its number of successive repetitions."""
    return [
        (status, len(list(group)))
        for status, group in groupby(update.status for update in updates)
    ]


@pytest.mark.parametrize(("right", "wrong"), [(1, 3), (1, 10), (4, 10), (20, 3), (20, 20)])
def test_wrong_solutions_that_agree_do_not_pull_a_filter_with_a_quiet_gyro(
    wrong: int, right: int
) -> None:
    vehicle = Vehicle(1)
    assert statuses(vehicle.updates(HOME, right)) == [(USED, right)]
    updates = vehicle.updates(WRONG, wrong)
    refused = [(OUTSIDE_GATE, 2), (DISPUTED, wrong - 2)]
    assert statuses(updates) == refused
    assert [update.agreeing for update in updates] == list(range(1, wrong + 1))
    assert (np.diff([update.log_odds for update in updates]) > 0).all()
    assert updates[-1].log_odds < ENOUGH
    assert statuses(vehicle.updates(HOME, 3)) == [(USED, 3)]
    assert vehicle.error_rad() < 5 * np.linalg.norm(vehicle.mekf.state.sigma_attitude_rad)


def test_the_filter_adopts_a_persistently_wrong_tracker_after_half_a_minute() -> None:
    """The filter cannot distinguish this from a gyro that failed without a flag."""
    vehicle = Vehicle(2)
    vehicle.updates(HOME, 60)
    runs = statuses(vehicle.updates(WRONG, 60))
    assert [status for status, _ in runs] == [OUTSIDE_GATE, DISPUTED, RESET, USED]
    assert 25 <= runs[1][1] <= 40


@pytest.mark.parametrize("off", [0.01, 0.1, 3.0])
def test_a_wrong_start_is_given_up_at_the_third_solution(off: float) -> None:
    vehicle = Vehicle(3, start=Rotation.from_rotvec([off, 0, 0]))
    assert statuses(vehicle.updates(HOME, 6)) == [(OUTSIDE_GATE, 2), (RESET, 1), (USED, 3)]
    assert vehicle.error_rad() < 5 * np.linalg.norm(vehicle.mekf.state.sigma_attitude_rad)


def test_after_a_restart_ten_wrong_solutions_do_not_cause_another() -> None:
    vehicle = Vehicle(9, start=WRONG.inv())
    assert vehicle.updates(HOME, 3)[-1].status == RESET
    assert RESET not in [update.status for update in vehicle.updates(WRONG, 10)]
    assert vehicle.update(HOME).status == USED


def test_solutions_agree_within_the_error_that_each_names_as_systematic() -> None:
    """They differ by 200 arcsec, with 1 of noise: 4.7 sigma of two slow errors of 30 about each axis."""
    unit = ARCSEC_RAD**2 * np.eye(3)
    for systematic, last in ((30.0, RESET), (6.0, OUTSIDE_GATE)):
        mekf = AttitudeFilter(GYRO, 0.0, WRONG, 1e-3, 0.0)
        for k, off in enumerate((100.0, -100.0, 100.0)):
            mekf.propagate([k + 1.0], np.zeros((1, 3)), [False])
            seen = Rotation.from_rotvec([0.0, off * ARCSEC_RAD, 0.0])
            update = mekf.update(
                k + 1.0, seen, (1 + systematic**2) * unit, systematic**2 * unit
            )
        assert update.status == last


@pytest.mark.parametrize("wrong", [1, 3])
def test_a_wrong_first_answer_is_abandoned_once_outnumbered_by_right_ones(wrong: int) -> None:
    vehicle = Vehicle(4, sigma_rad=2.0)  # knows nothing at the start
    assert statuses(vehicle.updates(WRONG, wrong)) == [(USED, wrong)]
    runs = statuses(vehicle.updates(HOME, 30))
    assert [status for status, _ in runs] == [OUTSIDE_GATE, DISPUTED, RESET, USED]
    # log(100) / -log(wrong_repeat) = 16.0 more than the wrong ones.
    assert runs[0][1] + runs[1][1] + runs[2][1] - wrong in (16, 17)
    assert vehicle.error_rad() < 5 * np.linalg.norm(vehicle.mekf.state.sigma_attitude_rad)


# ---- A knock ----


def knock(rate_rad_s: float, samples: int) -> tuple[np.ndarray, Rotation]:
    """(100, 3) increments of a limited gyro in a rotation about x, and the attitude after it."""
    rate = np.zeros((100, 3))
    rate[40 : 40 + samples, 0] = rate_rad_s
    after = Rotation.from_rotvec([-rate_rad_s * samples / 100, 0, 0])
    return np.clip(rate, -LIMIT_RAD_S, LIMIT_RAD_S) / 100, after


@pytest.mark.parametrize(
    ("times_limit", "samples", "known_by"),
    [
        *(
            (times, samples, how)
            for times, samples in KNOCKS
            for how in ("the flag", "the limit")
        ),
        *((times, samples, "the shock") for times, samples in KNOCKS[:3]),
    ],
)
def test_after_a_knock_the_filter_is_back_within_three_solutions(
    times_limit: float, samples: int, known_by: str
) -> None:
    gyro = (
        GyroModel(ARW_RAD_SQRT_S, 0.0, np.inf, limit_rad_s=LIMIT_RAD_S)
        if known_by == "the limit"
        else GYRO
    )
    vehicle = Vehicle(5, gyro)
    vehicle.updates(HOME, 40)
    turn, after = knock(times_limit * LIMIT_RAD_S, samples)
    flagged = slice(40, 40 + samples) if known_by == "the flag" else slice(0)
    updates = [vehicle.update(after, turn, flagged), *vehicle.updates(after, 3)]
    assert updates[2].status in (USED, RESET)
    assert updates[3].status == USED
    assert vehicle.error_rad(after) < 5 * np.linalg.norm(
        vehicle.mekf.state.sigma_attitude_rad
    )


def test_a_measured_knock_does_not_admit_a_wrong_solution() -> None:
    """A turn of 20 degrees below the limit, at rates that change smoothly, and ten wrong solutions after it."""
    gyro = GyroModel(ARW_RAD_SQRT_S, 0.0, np.inf, limit_rad_s=10.0)
    vehicle = Vehicle(6, gyro)
    vehicle.updates(HOME, 20)
    smooth = np.sin(np.pi * (np.arange(100) + 0.5) / 100) ** 2
    turn = np.zeros((100, 3))
    turn[:, 0] = np.radians(20.0) * smooth / smooth.sum()
    after = Rotation.from_rotvec([-np.radians(20.0), 0, 0])
    assert vehicle.update(WRONG * after, turn).status == OUTSIDE_GATE
    assert RESET not in [update.status for update in vehicle.updates(WRONG * after, 9)]
    assert vehicle.update(after).status == USED


def test_a_lost_rotation_counts_until_a_solution_is_used() -> None:
    vehicle = Vehicle(7)
    vehicle.updates(HOME, 20)
    saturating, _ = knock(LIMIT_RAD_S, 3)
    vehicle.update(HOME, saturating, slice(40, 43))
    assert vehicle.mekf._current.lost_rad == 0.0
    assert vehicle.mekf._current.support == 1
    assert RESET not in [update.status for update in vehicle.updates(WRONG, 10)]


def test_an_outage_grows_by_its_rate_and_keeps_the_bias() -> None:
    gyro = GyroModel(0.0, 0.0, np.inf, outage_rad_s=0.3)
    mekf = AttitudeFilter(gyro, 0.0, HOME, 0.0, 0.0)
    t_s = np.arange(1, 101) / 100
    missing = t_s > 0.5
    mekf.propagate(
        t_s,
        np.where(missing[:, None], np.nan, 0.0) * np.ones((100, 3)),
        np.zeros(100, bool),
        missing,
    )
    assert mekf.state.sigma_attitude_rad == pytest.approx(0.15 * np.ones(3), rel=1e-9)
    assert not mekf.state.sigma_bias_rad_s.any()
    # A guess is used as such.
    mekf.propagate([1.1], [[0.02, 0.0, 0.0]], [False], [True])
    assert mekf.body_from_ref.as_rotvec() == pytest.approx([-0.02, 0.0, 0.0], abs=1e-12)


# ---- The odds themselves ----


def jump(**changes: float) -> Jump:
    """Five degrees off a filter of 10 arcsec that many solutions confirmed, with a quiet gyro."""
    return Jump(np.radians(5.0), 1800.0, 3, 3.0, 0.0, 100)._replace(**changes)  # type: ignore[arg-type]


def test_the_odds_match_the_docstring_s_formula() -> None:
    model = JumpModel(1e-6, 1e-3, 0.5, 0.02)
    wrong = math.log(1e-3) + 2 * math.log(0.5)
    assert log_odds(jump(), model) == pytest.approx(math.log(3e-6) - wrong, rel=1e-9)
    lost = log_odds(jump(lost_rad=np.radians(5.0) / 3), model)
    assert lost == pytest.approx(math.log(0.25) - wrong, rel=1e-4)
    assert log_odds(jump(support=0), model) == pytest.approx(math.log(0.02) - wrong, rel=1e-3)
    assert log_odds(jump(support=2, since_s=0.0), model) == pytest.approx(
        math.log(5e-4) - wrong, rel=1e-9
    )
    assert log_odds(jump(distance=10.0), model) == pytest.approx(-2 - wrong, rel=1e-3)
    assert math.isfinite(log_odds(jump(since_s=0.0, support=10**6), model))


def test_a_small_jump_is_attributed_to_the_filter_s_model_at_the_third_solution() -> None:
    assert log_odds(jump(distance=20.0, agreeing=CONFIRMATIONS), JumpModel()) > ENOUGH
    assert log_odds(jump(distance=40.0, agreeing=CONFIRMATIONS), JumpModel()) < ENOUGH


def test_a_shock_is_the_largest_change_of_rate_above_noise() -> None:
    rng = np.random.default_rng(8)
    samples = np.zeros((100, 5))
    samples[:, 0] = 2.0 + np.cumsum(rng.uniform(0.005, 0.015, 100))
    step_s = np.diff(samples[:, 0], prepend=2.0)
    samples[:, 1:4] = ARW_RAD_SQRT_S * np.sqrt(step_s)[:, None] * rng.normal(size=(100, 3))
    assert shock_rad(2.0, samples, ARW_RAD_SQRT_S) == 0.0
    samples[60:, 2] += 0.5 * step_s[60:]
    assert shock_rad(2.0, samples, ARW_RAD_SQRT_S) == pytest.approx(
        0.5 * step_s[60], rel=0.01
    )
    assert shock_rad(2.0, samples[:60], ARW_RAD_SQRT_S) == 0.0
    assert shock_rad(2.0, samples[:0], ARW_RAD_SQRT_S) == 0.0


@pytest.mark.parametrize(
    "name", ["missed_per_s", "wrong_share", "wrong_repeat", "wrong_start"]
)
@pytest.mark.parametrize("value", [0.0, 1.0, -1.0, np.nan])
def test_a_bad_probability_is_refused_in_one_line(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"jumps: {name} is .*; allowed: above 0, below 1$"):
        JumpModel(**{name: value})
