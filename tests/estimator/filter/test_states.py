"""States of the filter beside attitude and bias: errors against the claimed covariance, estimated and considered."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.core.types import FilterState
from estimator.filter.error_models import GyroModel, TrackerModel
from estimator.filter.mekf import USED, AttitudeFilter
from tests.helpers.tumble import tumble_angle_rad, tumble_body_from_ref

ARCSEC_RAD = np.pi / 180 / 3600
ARW_RAD_SQRT_S = np.radians(0.07) / 60
RATE_HZ = 50
SECONDS = 12
RUNS = 200
NOISE_RAD2 = np.diag([10.0, 10.0, 60.0]) ** 2 * ARCSEC_RAD**2
GYRO = GyroModel(ARW_RAD_SQRT_S, 0.0, np.inf)
SIGMA_RAD = 1e-3
SIGMA_BIAS = 1e-5
SCALE = replace(GYRO, scale=1e-3)
ASKEW = replace(GYRO, misalignment_rad=1e-3)
SLOW = TrackerModel(
    systematic_rad=30 * ARCSEC_RAD, systematic_time_s=30.0, systematic_angle_rad=5.0
)
MOUNTED = TrackerModel(mounting_rad=1e-3)
EVERYTHING = replace(SLOW, mounting_rad=1e-3)
T_S = np.arange(SECONDS * RATE_HZ + 1) / RATE_HZ


@dataclass(frozen=True)
class Flight:
    """One draw of the errors: gyro increments, solutions at each second, and the truth of the states."""

    angle_rad: np.ndarray
    solutions: list[Rotation]
    bias_rad_s: np.ndarray
    others: dict[str, np.ndarray]


def drawn(
    gyro: GyroModel, tracker: TrackerModel, truth: Rotation, rng: np.random.Generator
) -> Flight:
    """Errors of the models about the tumble; `truth` at each second, from 0 on."""
    bias = SIGMA_BIAS * rng.normal(size=3)
    scale = gyro.scale * rng.normal(size=3)
    askew = gyro.misalignment_rad * rng.normal(size=6)
    mount = tracker.mounting_rad * rng.normal(size=3)
    response = np.eye(3) + np.diag(scale)
    response[~np.eye(3, dtype=bool)] += askew
    noise = gyro.arw_rad_sqrt_s / np.sqrt(RATE_HZ) * rng.normal(size=(len(T_S) - 1, 3))
    angle = tumble_angle_rad(T_S) @ response.T + bias / RATE_HZ + noise
    slow = rng.normal(size=3)
    solutions = []
    for k in range(1, SECONDS + 1):
        turned = (truth[k] * truth[k - 1].inv()).magnitude()
        kept = np.exp(-1 / tracker.systematic_time_s - turned / tracker.systematic_angle_rad)
        slow = kept * slow + np.sqrt(1 - kept**2) * rng.normal(size=3)
        error = (
            mount
            + tracker.systematic_rad * slow
            + np.sqrt(np.diag(NOISE_RAD2)) * rng.normal(size=3)
        )
        solutions.append(Rotation.from_rotvec(-error) * truth[k])
    return Flight(
        angle, solutions, bias, {"scale": scale, "misalignment": askew, "mounting": mount}
    )


def flown(flight: Flight, mekf: AttitudeFilter) -> FilterState:
    for k, solution in enumerate(flight.solutions):
        rows = slice(k * RATE_HZ, (k + 1) * RATE_HZ)
        mekf.propagate(T_S[1:][rows], flight.angle_rad[rows], np.zeros(RATE_HZ, bool))
        assert mekf.update(k + 1.0, solution, NOISE_RAD2).status == USED
    return mekf.state


def squared(
    drawing: tuple[GyroModel, TrackerModel],
    assumed: tuple[GyroModel, TrackerModel],
    considered: tuple[str, ...],
    runs: int = RUNS,
) -> tuple[float, float, int]:
    """Mean NEES of the attitude (3 degrees of freedom) and of all states, and the number of states."""
    rng = np.random.default_rng(7)
    nees = []
    truth = tumble_body_from_ref(np.arange(SECONDS + 1.0))
    for _ in range(runs):
        flight = drawn(*drawing, truth, rng)
        start = Rotation.from_rotvec(SIGMA_RAD * rng.normal(size=3)) * truth[0]
        # Without a gate: a wrong model is to be seen in the errors.
        gyro, tracker = assumed
        mekf = AttitudeFilter(
            gyro,
            0.0,
            start,
            SIGMA_RAD,
            SIGMA_BIAS,
            0.0,
            np.inf,
            tracker,
            considered=considered,
        )
        state = flown(flight, mekf)
        turned = (state.body_from_ref * truth[-1].inv()).as_rotvec()
        others = [flight.others[name] - values for name, values in state.others.items()]
        error = np.concatenate([turned, flight.bias_rad_s - state.bias_rad_s, *others])
        attitude = turned @ np.linalg.solve(state.covariance[:3, :3], turned)
        nees.append((attitude, error @ np.linalg.solve(state.covariance, error)))
    return float(np.mean(nees, axis=0)[0]), float(np.mean(nees, axis=0)[1]), len(error)


MODELS = {
    "scale": (SCALE, TrackerModel()),
    "misalignment": (ASKEW, TrackerModel()),
    "mounting": (GYRO, MOUNTED),
    "systematic": (GYRO, SLOW),
    "bias": (GYRO, TrackerModel()),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("considers", [False, True])
def test_each_state_s_errors_match_its_covariance(name: str, considers: bool) -> None:
    attitude, every, states = squared(
        MODELS[name], MODELS[name], (name,) if considers else ()
    )
    assert 2.5 < attitude < 3.5
    assert abs(every - states) < 4 * np.sqrt(2 * states / RUNS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "considered", [(), ("mounting", "systematic"), ("scale", "misalignment", "systematic")]
)
def test_all_states_together_match_their_covariance(considered: tuple[str, ...]) -> None:
    gyro = replace(SCALE, misalignment_rad=1e-3)
    attitude, every, states = squared((gyro, EVERYTHING), (gyro, EVERYTHING), considered)
    assert states == 18
    assert 2.5 < attitude < 3.5
    assert abs(every - states) < 4 * np.sqrt(2 * states / RUNS)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scale", "misalignment", "mounting", "systematic"])
def test_an_error_without_a_state_is_not_in_the_covariance(name: str) -> None:
    attitude, _, _ = squared(MODELS[name], (GYRO, TrackerModel()), (), runs=20)
    assert attitude > 10


# ---- A tracker's constant error ----


@pytest.mark.slow
@pytest.mark.parametrize("named_by", ["the filter's model", "the solutions", "half each"])
def test_a_constant_tracker_error_is_not_averaged_down(named_by: str) -> None:
    """30 arcsec about each axis, in 60 solutions of 10 arcsec at rest: NEES 3, and the claim is 30 to 32 arcsec."""
    rng = np.random.default_rng(30)
    nees = []
    common = 30 * ARCSEC_RAD
    noise_rad2 = (10 * ARCSEC_RAD) ** 2 * np.eye(3)
    share = {"the filter's model": 1.0, "the solutions": 0.0, "half each": 0.5}[named_by]
    tracker = TrackerModel(systematic_rad=common * np.sqrt(share))
    named_rad2 = (1 - share) * common**2 * np.eye(3)
    for _ in range(100):
        mekf = AttitudeFilter(
            GYRO, 0.0, Rotation.identity(), SIGMA_RAD, SIGMA_BIAS, tracker=tracker
        )
        offset = common * rng.normal(size=3)
        for k in range(60):
            mekf.propagate(
                [k + 1.0], SIGMA_BIAS + ARW_RAD_SQRT_S * rng.normal(size=(1, 3)), [False]
            )
            seen = Rotation.from_rotvec(-offset - 10 * ARCSEC_RAD * rng.normal(size=3))
            assert (
                mekf.update(k + 1.0, seen, noise_rad2 + named_rad2, named_rad2).status == USED
            )
        state = mekf.state
        error = state.body_from_ref.as_rotvec()
        nees.append(error @ np.linalg.solve(state.covariance[:3, :3], error))
    assert (state.sigma_attitude_rad / ARCSEC_RAD > 30).all()
    assert (state.sigma_attitude_rad < 32 * ARCSEC_RAD).all()
    assert np.mean(nees) == pytest.approx(3, abs=4 * np.sqrt(6 / 100))


def test_an_error_that_changes_faster_than_assumed_does_not_close_the_gate() -> None:
    """A slow error, assumed constant, is the opposite after a minute: 6.4 sigma, or 4.5 of two independent ones."""
    noise_rad2 = (2 * ARCSEC_RAD) ** 2 * np.eye(3)
    tracker = TrackerModel(200 * ARCSEC_RAD, np.inf, np.inf)
    mekf = AttitudeFilter(GYRO, 0.0, Rotation.identity(), 1.0, 0.0, tracker=tracker)
    for k in range(80):
        mekf.propagate([k + 1.0], np.zeros((1, 3)), [False])
        offset = np.array([360.0, -400.0, 350.0]) * ARCSEC_RAD * (1 if k < 60 else -1)
        assert mekf.update(k + 1.0, Rotation.from_rotvec(-offset), noise_rad2).status == USED
    assert (
        np.abs(mekf.state.body_from_ref.as_rotvec()) < 2.5 * mekf.state.sigma_attitude_rad
    ).all()


def test_a_rotation_decorrelates_the_slow_error_of_the_tracker() -> None:
    """Two solutions with the same slow error S average to S, and to S / 2 if the vehicle turned a long way between."""
    noise_rad2 = (0.1 * ARCSEC_RAD) ** 2 * np.eye(3)
    sigma = 30 * ARCSEC_RAD
    still = GyroModel(0.0, 0.0, np.inf)
    claims = {}
    for turned in (0.0, 0.2, 3.0):
        tracker = TrackerModel(sigma, np.inf, 0.2)
        mekf = AttitudeFilter(still, 0.0, Rotation.identity(), 1.0, 0.0, tracker=tracker)
        assert mekf.update(0.0, Rotation.identity(), noise_rad2).status == USED
        mekf.propagate([1.0], [[turned, 0.0, 0.0]], [False])
        assert (
            mekf.update(1.0, Rotation.from_rotvec([-turned, 0.0, 0.0]), noise_rad2).status
            == USED
        )
        claims[turned] = mekf.state.sigma_attitude_rad[0] / sigma
    # The mean of two errors of correlation r has the variance S (1 + r) / 2.
    for turned, claim in claims.items():
        assert claim == pytest.approx(np.sqrt((1 + np.exp(-turned / 0.2)) / 2), rel=1e-3)


# ---- Observability ----


def turning_about(
    axis: int, seconds: int, gyro: GyroModel, considered: tuple[str, ...] = ()
) -> FilterState:
    """State after rotation at 0.3 rad/s about one axis, with a gyro scale factor error of 800 ppm on it alone."""
    mekf = AttitudeFilter(
        gyro, 0.0, Rotation.identity(), SIGMA_RAD, SIGMA_BIAS, considered=considered
    )
    step = np.zeros((RATE_HZ, 3))
    step[:, axis] = 0.3 / RATE_HZ
    for k in range(seconds):
        mekf.propagate(
            k + np.arange(1, RATE_HZ + 1) / RATE_HZ,
            step * (1 + 8e-4),
            np.zeros(RATE_HZ, bool),
        )
        turned = np.zeros(3)
        turned[axis] = -0.3 * (k + 1)
        assert mekf.update(k + 1.0, Rotation.from_rotvec(turned), NOISE_RAD2).status == USED
    return mekf.state


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rotation_makes_only_its_axis_scale_factor_observable(axis: int) -> None:
    state = turning_about(axis, 40, replace(SCALE, misalignment_rad=1e-3))
    sigma = state.sigma("scale")
    elsewhere = np.arange(3) != axis
    # The bias hides behind it: SIGMA_BIAS / 0.3 rad/s = 33 ppm is what remains, at most.
    assert sigma[axis] < 50e-6
    assert abs(state.others["scale"][axis] - 8e-4) < 3 * sigma[axis]
    assert (sigma[elsewhere] > 0.99e-3).all()
    # The column of M at this axis: its misalignments in the two other rows are seen too.
    column = np.zeros((3, 3), dtype=bool)
    column[elsewhere, axis] = True
    seen = column[~np.eye(3, dtype=bool)]
    assert (state.sigma("misalignment")[seen] < 1e-4).all()
    assert (state.sigma("misalignment")[~seen] > 0.9e-3).all()


def test_at_rest_no_scale_or_misalignment_is_observable() -> None:
    gyro = replace(SCALE, misalignment_rad=1e-3)
    mekf = AttitudeFilter(gyro, 0.0, Rotation.identity(), SIGMA_RAD, SIGMA_BIAS)
    for k in range(20):
        mekf.propagate([k + 1.0], np.zeros((1, 3)), [False])
        assert (
            mekf.update(k + 1.0, Rotation.from_rotvec([1e-5, 0, 0]), NOISE_RAD2).status
            == USED
        )
    for name in ("scale", "misalignment"):
        assert mekf.state.sigma(name) == pytest.approx(1e-3, rel=1e-9)
        assert (
            np.abs(mekf.state.others[name]).max() < 1e-12
        )  # the filter turns by an arcsecond


def test_a_considered_state_keeps_its_value_and_its_variance() -> None:
    gyro = replace(SCALE, misalignment_rad=1e-3)
    state = turning_about(2, 20, gyro, considered=("scale", "misalignment"))
    for name in ("scale", "misalignment"):
        assert not state.others[name].any()
        assert state.sigma(name) == pytest.approx(1e-3, rel=1e-9)
    # The attitude's claim allows for what it turns in a second, which the estimated one has removed.
    estimated = turning_about(2, 20, gyro)
    assert state.sigma_attitude_rad[2] > 1.2 * estimated.sigma_attitude_rad[2]
    known = turning_about(2, 20, GYRO, considered=("bias",))
    assert not known.bias_rad_s.any()
    assert known.sigma_bias_rad_s == pytest.approx(SIGMA_BIAS, rel=1e-9)


def test_the_rate_is_corrected_by_the_gyro_s_matrix() -> None:
    mekf = AttitudeFilter(SCALE, 0.0, Rotation.identity(), 1e-6, 0.0, considered=())
    for k in range(30):
        mekf.propagate([k + 1.0], [[0.3 * 1.001, 0.0, 0.0]], [False])
        assert (
            mekf.update(
                k + 1.0, Rotation.from_rotvec([-0.3 * (k + 1), 0, 0]), NOISE_RAD2 / 100
            ).status
            == USED
        )
    assert mekf.rate_rad_s == pytest.approx([0.3, 0.0, 0.0], abs=3e-6)


# ---- Bad options ----


def test_bad_options_are_refused_in_one_line() -> None:
    def built(**options: object) -> AttitudeFilter:
        return AttitudeFilter(
            GYRO, 0.0, Rotation.identity(), SIGMA_RAD, SIGMA_BIAS, **options
        )  # type: ignore[arg-type]

    with pytest.raises(
        ValueError,
        match=r"considered: 'gain'; allowed: bias, scale, misalignment, mounting, systematic",
    ):
        built(considered=("scale", "gain"))
    with pytest.raises(ValueError, match=r"gyro: scale is -1; allowed: finite, 0 or more"):
        replace(GYRO, scale=-1)
    with pytest.raises(
        ValueError, match=r"gyro: limit_rad_s is 0; allowed: above 0, also inf"
    ):
        replace(GYRO, limit_rad_s=0)
    with pytest.raises(
        ValueError, match=r"tracker: systematic_rad is inf; allowed: finite, 0 or more"
    ):
        TrackerModel(np.inf)
    with pytest.raises(
        ValueError, match=r"tracker: systematic_time_s is nan; allowed: above 0, also inf"
    ):
        TrackerModel(systematic_time_s=np.nan)
    with pytest.raises(
        ValueError, match=r"update: systematic_rad2 .*allowed: .* less than covariance_rad2"
    ):
        built().update(0.0, Rotation.identity(), NOISE_RAD2, NOISE_RAD2)
    with pytest.raises(
        ValueError,
        match=r"update: systematic_rad2 .*allowed: \(3, 3\), symmetric, not negative",
    ):
        built().update(0.0, Rotation.identity(), NOISE_RAD2, -NOISE_RAD2)
    with pytest.raises(KeyError, match="gain"):
        built().state.sigma("gain")
