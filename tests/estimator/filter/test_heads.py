"""Attitude filter with several star cameras on the body: fused covariance, mountings, and their random walk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.filter.error_models import GyroModel, TrackerModel
from estimator.filter.mekf import USED, AttitudeFilter
from tests.helpers.tumble import tumble_angle_rad, tumble_body_from_ref

ARCSEC_RAD = np.pi / 180 / 3600
CROSS = 10 * ARCSEC_RAD
ROLL = 60 * ARCSEC_RAD
# The boresight of the first head is the body's z axis, that of the second its x axis.
NOISE_RAD2 = np.diag([CROSS, CROSS, ROLL]) ** 2, np.diag([ROLL, CROSS, CROSS]) ** 2
GYRO = GyroModel(np.radians(0.07) / 60, 0.0, np.inf)
MOUNTED = TrackerModel(mounting_rad=1e-3)
WALKING = replace(MOUNTED, mounting_drift_rad_sqrt_s=5 * ARCSEC_RAD)
RATE_HZ = 20
SECONDS = 15
T_S = np.arange(SECONDS * RATE_HZ + 1) / RATE_HZ


def test_two_heads_at_a_right_angle_have_the_sum_of_their_information() -> None:
    """P^-1 = P1^-1 + P2^-1: the roll about the first boresight becomes (1 / roll^2 + 1 / cross^2)^(-1/2)."""
    mekf = AttitudeFilter(GYRO, 0.0, Rotation.identity(), 1.0, 1e-5, considered=(), heads=2)
    for head, noise in enumerate(NOISE_RAD2):
        assert mekf.update(0.0, Rotation.identity(), noise, head=head).status == USED
    summed = np.linalg.inv(sum(np.linalg.inv(noise) for noise in NOISE_RAD2))
    np.testing.assert_allclose(mekf.state.covariance[:3, :3], summed, rtol=1e-6, atol=1e-18)
    np.testing.assert_allclose(
        mekf.state.sigma_attitude_rad[2], (ROLL**-2 + CROSS**-2) ** -0.5, rtol=1e-6
    )


def squared(
    tracker: TrackerModel, considered: tuple[str, ...], runs: int
) -> tuple[float, float, int]:
    """Mean NEES of the attitude and of all states of flights with two heads, and the number of states."""
    rng = np.random.default_rng(3)
    truth = tumble_body_from_ref(np.arange(SECONDS + 1.0))
    nees = []
    for _ in range(runs):
        mounts = tracker.mounting_rad * rng.normal(
            size=(2, 3)
        )  # the second relative to the first
        noise = GYRO.arw_rad_sqrt_s / np.sqrt(RATE_HZ) * rng.normal(size=(len(T_S) - 1, 3))
        angle = tumble_angle_rad(T_S) + noise
        start = Rotation.from_rotvec(1e-3 * rng.normal(size=3)) * truth[0]
        mekf = AttitudeFilter(
            GYRO, 0.0, start, 1e-3, 0.0, 0.0, np.inf, tracker, considered=considered, heads=2
        )
        for k in range(SECONDS):
            rows = slice(k * RATE_HZ, (k + 1) * RATE_HZ)
            mekf.propagate(T_S[1:][rows], angle[rows], np.zeros(RATE_HZ, bool))
            mounts += tracker.mounting_drift_rad_sqrt_s * rng.normal(size=(2, 3))
            for head in range(2):
                error = mounts[: head + 1].sum(axis=0) + np.sqrt(
                    np.diag(NOISE_RAD2[head])
                ) * rng.normal(size=3)
                measured = Rotation.from_rotvec(-error) * truth[k + 1]
                assert (
                    mekf.update(k + 1.0, measured, NOISE_RAD2[head], head=head).status == USED
                )
        state = mekf.state
        turned = (state.body_from_ref * truth[-1].inv()).as_rotvec()
        errors = [
            mount - state.others[name]
            for mount, name in zip(mounts, ("mounting", "mounting_1"), strict=True)
        ]
        error = np.concatenate([turned, *errors])
        used = [0, 1, 2, 6, 7, 8, 9, 10, 11]  # the bias has no error here
        covariance = state.covariance[np.ix_(used, used)]
        nees.append(
            (
                turned @ np.linalg.solve(covariance[:3, :3], turned),
                error @ np.linalg.solve(covariance, error),
            )
        )
    attitude, every = np.mean(nees, axis=0)
    return float(attitude), float(every), len(used)


@pytest.mark.slow
@pytest.mark.parametrize("tracker", [MOUNTED, WALKING], ids=["constant", "walking"])
@pytest.mark.parametrize("considered", [(), ("mounting",)], ids=["estimated", "considered"])
def test_errors_of_two_mountings_match_the_covariance(
    tracker: TrackerModel, considered: tuple[str, ...]
) -> None:
    attitude, every, states = squared(tracker, considered, runs=150)
    assert 2.5 < attitude < 3.5
    assert abs(every - states) < 4 * np.sqrt(2 * states / 150)


@pytest.mark.compiles
def test_a_constant_model_does_not_claim_a_walk() -> None:
    """The same flights with mountings that drift: a filter without the random walk understates their errors."""
    rng = np.random.default_rng(3)
    truth = Rotation.identity()
    mekf = AttitudeFilter(
        GYRO, 0.0, truth, 1e-6, 0.0, 0.0, np.inf, MOUNTED, considered=(), heads=2
    )
    walking = AttitudeFilter(
        GYRO, 0.0, truth, 1e-6, 0.0, 0.0, np.inf, WALKING, considered=(), heads=2
    )
    mount = np.zeros(3)
    for k in range(60):
        mount += WALKING.mounting_drift_rad_sqrt_s * rng.normal(size=3)
        for each in (mekf, walking):
            each.propagate([k + 1.0], np.zeros((1, 3)), [False])
            each.update(k + 1.0, truth, NOISE_RAD2[0], head=0)
            each.update(k + 1.0, Rotation.from_rotvec(-mount), NOISE_RAD2[1], head=1)
    errors = [
        (mount - each.state.others["mounting_1"]) / each.state.sigma("mounting_1")
        for each in (mekf, walking)
    ]
    assert np.abs(errors[0]).max() > 5
    assert np.abs(errors[1]).max() < 4


def test_the_second_mounting_tends_to_its_rotation_relative_to_the_first() -> None:
    """The first mounting is considered and off by 100 arcsec, too: at rest only the difference is observable."""
    first, second = np.array([[100.0, 0.0, -50.0], [-40.0, 30.0, 80.0]]) * ARCSEC_RAD
    mekf = AttitudeFilter(GYRO, 0.0, Rotation.identity(), 1.0, 0.0, tracker=MOUNTED, heads=2)
    for k in range(400):
        mekf.propagate([k + 1.0], np.zeros((1, 3)), [False])
        mekf.update(k + 1.0, Rotation.from_rotvec(-first), NOISE_RAD2[0], head=0)
        mekf.update(k + 1.0, Rotation.from_rotvec(-second), NOISE_RAD2[1], head=1)
    np.testing.assert_allclose(
        mekf.state.others["mounting_1"], second - first, atol=2 * ARCSEC_RAD
    )
    np.testing.assert_array_equal(mekf.state.others["mounting"], np.zeros(3))


def test_an_unknown_head_is_refused() -> None:
    mekf = AttitudeFilter(GYRO, 0.0, Rotation.identity(), 1e-3, 0.0, heads=2)
    with pytest.raises(ValueError, match="update: head 2; allowed: 0 to 1"):
        mekf.update(0.0, Rotation.identity(), NOISE_RAD2[0], head=2)


def test_a_walk_of_a_mounting_that_is_known_exactly_is_refused() -> None:
    with pytest.raises(
        ValueError, match="mounting_drift_rad_sqrt_s needs mounting_rad above 0"
    ):
        TrackerModel(mounting_drift_rad_sqrt_s=1e-6)
