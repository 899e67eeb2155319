"""Mass properties on an air bearing against analytic motions, an independent integration, and claimed errors."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipkinc
from scipy.stats import chi2

from estimator.calibration import mass_properties
from estimator.calibration.mass_dynamics import (
    BearingRecord,
    EquationsOfMotion,
    MassEstimate,
    States,
)
from estimator.calibration.mass_properties import (
    MISFIT_TOLERANCE,
    estimate_mass,
    estimate_with_noise,
    filter_mass,
)
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from tests.helpers.bearing_motion import GRAVITY_M_S2, INERTIA, SMALL, Vehicle, prior, record

NINE = slice(0, 9)


def flown(vehicle: Vehicle, rate_rad_s: Floats, t_s: Floats) -> tuple[States, Floats]:
    """Motion from level attitude with wheels at rest and this rate: states at all times and rates (3, N)."""
    still = replace(
        record(SMALL, np.random.default_rng(0), 4.0), wheel_momentum_nms=np.zeros((41, 3))
    )
    equations = EquationsOfMotion(
        still, vehicle.known, np.tile(vehicle.truth[:, None], len(t_s))
    )
    count = len(t_s)
    momentum = np.tile((vehicle.inertia_kg_m2 @ rate_rad_s)[:, None], count)
    start = States(np.tile([[0.0], [0], [0], [1]], count), momentum, np.zeros((3, count)))
    states = equations.integrate(np.zeros(count), t_s, start, 1.0)
    return states, equations.rate(states, np.zeros((3, count)))


def test_free_rigid_body_follows_jacobis_elliptic_functions() -> None:
    """Landau & Lifshitz, Mechanics, 37.10: rates of an asymmetric top about its principal axes, I1 < I2 < I3."""
    I1 = 0.09
    I2 = 0.11
    I3 = 0.13
    w0 = np.array([0.3, 0.0, 0.4])
    energy2 = I1 * w0[0] ** 2 + I3 * w0[2] ** 2
    square = (I1 * w0[0]) ** 2 + (I3 * w0[2]) ** 2
    assert square > energy2 * I2
    t_s = np.linspace(0.5, 20, 9)
    tau = t_s * np.sqrt((I3 - I2) * (square - energy2 * I1) / (I1 * I2 * I3))
    sn, cn, dn, _ = ellipj(
        tau, (I2 - I1) * (energy2 * I3 - square) / ((I3 - I2) * (square - energy2 * I1))
    )
    expected = [
        np.sqrt((energy2 * I3 - square) / (I1 * (I3 - I1))) * cn,
        np.sqrt((energy2 * I3 - square) / (I2 * (I3 - I2))) * sn,
        np.sqrt((square - energy2 * I1) / (I3 * (I3 - I1))) * dn,
    ]
    _, rate = flown(Vehicle(np.diag([I1, I2, I3]), np.zeros(3), np.zeros(3)), w0, t_s)
    np.testing.assert_allclose(rate, expected, rtol=0, atol=1e-6)


def test_unbalanced_body_swings_with_a_pendulums_period() -> None:
    """theta'' = -(m g r / J) sin(theta): a quarter period from the bottom to the amplitude theta0 takes
    sqrt(J / (m g r)) K(sin(theta0 / 2)).
    """
    J = 0.1
    moment = 4e-4
    amplitude = 0.3
    frequency = np.sqrt(moment * GRAVITY_M_S2 / J)
    quarter_s = ellipkinc(np.pi / 2, np.sin(amplitude / 2) ** 2) / frequency
    rate = np.array([2 * frequency * np.sin(amplitude / 2), 0, 0])
    vehicle = Vehicle(np.diag([J, 0.12, 0.09]), np.array([0, 0, -moment]), np.zeros(3))
    states, rates = flown(vehicle, rate, np.array([quarter_s, 4 * quarter_s]))
    assert states.rotation[0].as_rotvec() == pytest.approx([amplitude, 0, 0], abs=1e-6)
    assert states.rotation[1].as_rotvec() == pytest.approx(np.zeros(3), abs=1e-6)
    assert rates[:, 1] == pytest.approx(rate, abs=1e-7)


def nees(estimate: MassEstimate, vehicle: Vehicle) -> float:
    """Squared error of the nine mass properties in units of their covariance."""
    error = (estimate.values - vehicle.truth)[NINE]
    return float(error @ np.linalg.solve(estimate.covariance[NINE, NINE], error))


def draws(count: int, seed: int) -> list[tuple[BearingRecord, float, MassEstimate]]:
    """Records with random noise, torque and assumptions, each with the NEES of the batch estimate."""
    rows = []
    for child in np.random.SeedSequence(seed).spawn(count):
        rng = np.random.default_rng(child)
        assumed, vehicle = prior(SMALL, rng)
        one = record(vehicle, rng)
        estimate = estimate_mass([one], assumed)
        rows.append((one, nees(estimate, vehicle), estimate))
    return rows


def test_inertia_and_offset_are_found_with_errors_as_claimed() -> None:
    """Inertia to 1 % of the largest, the horizontal moment to 1e-6 kg m; squared errors as their covariance says."""
    rng = np.random.default_rng(7)
    assumed, vehicle = prior(SMALL, rng)
    estimate = estimate_mass([record(vehicle, rng)], assumed)
    assert nees(estimate, vehicle) < chi2.ppf(0.9999, 9)
    assert estimate.misfit == pytest.approx(1, abs=0.35)
    assert (estimate.sigma[:6] < 0.01 * np.max(INERTIA)).all()
    assert (estimate.sigma[6:8] < 1e-6).all()
    np.testing.assert_allclose(
        estimate.inertia_kg_m2, INERTIA, rtol=0, atol=0.03 * np.max(INERTIA)
    )


@pytest.mark.long
def test_the_errors_of_a_hundred_draws_match_their_covariance() -> None:
    """The sum of 100 NEES of nine values is chi-square of 900 degrees of freedom."""
    values = [value for _, value, _ in draws(100, 1)]
    assert chi2.ppf(1e-4, 900) < sum(values) < chi2.ppf(1 - 1e-4, 900)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_wrong_tracker_covariance_is_found_from_the_misfit(factor: float) -> None:
    rng = np.random.default_rng(10)
    assumed, vehicle = prior(SMALL, rng)
    one = record(vehicle, rng)
    wrong = replace(one, covariance_rad2=factor * one.covariance_rad2)
    estimate = estimate_with_noise([wrong], assumed)
    right = estimate_mass([one], assumed)
    assert abs(np.log(estimate.misfit)) < MISFIT_TOLERANCE
    assert nees(estimate, vehicle) < chi2.ppf(0.9999, 9)
    np.testing.assert_allclose(estimate.sigma[NINE], right.sigma[NINE], rtol=0.3)


@pytest.mark.parametrize("true_factor", [1e-4, 0.03, 1.0, 40.0, 1e5])
def test_the_noise_is_found_in_two_fits(
    true_factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A misfit (true / assumed)^(2/3), of attitudes that give part of the information, ends within the limits."""
    tried: list[float] = []

    def fit(records: list[float], *_: object) -> SimpleNamespace:
        tried.extend(records)
        return SimpleNamespace(misfit=(true_factor / records[0]) ** (2 / 3))

    monkeypatch.setattr(mass_properties, "estimate_mass", fit)
    one: Any = SimpleNamespace(with_noise=float)
    nothing: Any = None
    estimate_with_noise([one], nothing)
    limited = float(np.clip(true_factor, 1e-3, 1e3))
    assert tried[0] == 1.0
    assert len(tried) <= (1 if true_factor == 1 else 8 if limited != true_factor else 2)
    assert tried[-1] == pytest.approx(limited, rel=1e-12)


@pytest.mark.slow
def test_the_filter_ends_at_the_batch_solution() -> None:
    for one, _, batch in draws(3, 2):
        rng = np.random.default_rng(5)
        *_, last = filter_mass(one, prior(SMALL, rng)[0])
        assert (np.abs(last.values - batch.values)[NINE] < 3 * batch.sigma[NINE]).all()
        np.testing.assert_allclose(last.sigma[NINE], batch.sigma[NINE], rtol=0.25)


def test_a_free_swing_determines_only_the_ratio_of_inertia_and_offset() -> None:
    """Without wheels the equations are homogeneous in J and m r: their common scale stays as uncertain as assumed."""
    rng = np.random.default_rng(8)
    vehicle = replace(
        SMALL, moment_kg_m=np.array([1e-5, -2e-5, -4e-4]), lab_torque_nm=np.zeros(3)
    )
    assumed, _ = prior(vehicle, rng)
    estimate = estimate_mass([record(vehicle, rng, wheels=False)], assumed)
    scale = vehicle.truth[NINE] / np.linalg.norm(vehicle.truth[NINE])
    information = np.linalg.inv(estimate.covariance[NINE, NINE])
    assumed_information = np.sum((scale / assumed.sigma[NINE]) ** 2)
    assert scale @ information @ scale < 2 * assumed_information
    vertical = estimate.values[8] / estimate.values[0]
    assert vertical == pytest.approx(vehicle.truth[8] / vehicle.truth[0], rel=0.02)


@pytest.mark.slow
def test_the_scale_of_free_swings_is_not_biased_to_small_inertias() -> None:
    """Errors of the common scale over 16 draws in the claimed standard deviations: mean 0, mean square 1.

    With a random torque in place of an acceleration a smaller scale explains every motion by smaller torques: the mean
    is -1.
    """
    scaled = []
    values = []
    for child in np.random.SeedSequence(11).spawn(16):
        rng = np.random.default_rng(child)
        still = replace(
            SMALL, moment_kg_m=np.array([1e-5, -2e-5, -4e-4]), lab_torque_nm=np.zeros(3)
        )
        assumed, vehicle = prior(still, rng)
        estimate = estimate_mass([record(vehicle, rng, wheels=False)], assumed)
        largest = estimate.values[0] / vehicle.truth[0] - 1
        scaled.append(largest * vehicle.truth[0] / estimate.sigma[0])
        values.append(nees(estimate, vehicle))
    assert np.mean(scaled) == pytest.approx(0, abs=0.75)
    assert np.mean(np.square(scaled)) < 2.2
    assert sum(values) < chi2.ppf(0.9999, 9 * 16)


@pytest.mark.slow
def test_a_motion_of_known_trim_adds_the_scale() -> None:
    """Two free swings, the second with a known moment added: the inertia follows without wheels."""
    rng = np.random.default_rng(9)
    vehicle = replace(
        SMALL, moment_kg_m=np.array([1e-5, -2e-5, -4e-4]), lab_torque_nm=np.zeros(3)
    )
    added = np.array([5e-5, 3e-5, -4e-4])
    assumed, vehicle = prior(vehicle, rng)
    trimmed = replace(vehicle, moment_kg_m=vehicle.moment_kg_m + added)
    one = record(vehicle, rng, wheels=False)
    two = record(trimmed, rng, wheels=False)
    alone = estimate_mass([one], assumed)
    both = estimate_mass([one, replace(two, added_moment_kg_m=added)], assumed)
    assert both.sigma[0] < alone.sigma[0] / 5
    assert nees(both, vehicle) < chi2.ppf(0.9999, 9)


def test_too_few_attitudes_and_missing_wheel_speeds_are_refused() -> None:
    whole = record(SMALL, np.random.default_rng(0), 10.0)
    with pytest.raises(
        ImageError, match=r"^mass properties: 3 attitudes; allowed: 4 or more$"
    ):
        replace(whole, t_s=whole.t_s[:3])
    with pytest.raises(
        ImageError,
        match=r"wheel speeds from 0 to 5 s; allowed: over all attitudes, 0 to 10 s$",
    ):
        replace(whole, wheel_t_s=whole.wheel_t_s[:51])
    with pytest.raises(ImageError, match=r"^mass properties: times do not ascend$"):
        replace(whole, t_s=whole.t_s[::-1])
    assumed, _ = prior(SMALL, np.random.default_rng(1))
    with pytest.raises(ImageError, match=r"11 attitudes; allowed for a filter: 24 or more$"):
        next(filter_mass(whole, assumed))
    with pytest.raises(ImageError, match=r"standard deviations above 0$"):
        replace(assumed, sigma=0 * assumed.sigma)


def shared_errors(attitudes: Rotation, sigma_rad: float, rng: np.random.Generator) -> Floats:
    """(N, 3) errors whose correlation falls with the rotation between two attitudes, exp(-rotation / 0.2 rad)."""
    turned = np.array(
        [(attitudes[n].inv() * attitudes).magnitude() for n in range(len(attitudes))]
    )
    correlation = np.exp(-turned / 0.2) + 1e-9 * np.eye(len(attitudes))
    return np.asarray(
        sigma_rad * np.linalg.cholesky(correlation) @ rng.standard_normal((len(attitudes), 3))
    )


@pytest.mark.long
def test_errors_common_to_all_attitudes_are_in_the_covariance() -> None:
    """Shared errors five times as large as the noise: of 12 draws the sum of 9 NEES each is as claimed.

    Without their part the covariance claims too little.
    """
    rng = np.random.default_rng(21)
    honest = 0.0
    blind = 0.0
    for _ in range(12):
        assumed, vehicle = prior(SMALL, rng)
        one = record(vehicle, rng)
        sigma_rad = 5 * vehicle.attitude_sigma_rad
        errors = shared_errors(one.lab_from_body, sigma_rad, rng)
        shared = np.tile(sigma_rad**2 * np.eye(3), (len(errors), 1, 1))
        one = replace(
            one,
            lab_from_body=one.lab_from_body * Rotation.from_rotvec(errors),
            covariance_rad2=one.covariance_rad2 + shared,
            systematic_rad2=shared,
        )
        honest += nees(estimate_with_noise([one], assumed), vehicle)
        unshared = replace(one, covariance_rad2=one.noise_rad2, systematic_rad2=None)
        blind += nees(estimate_with_noise([unshared], assumed), vehicle)
    assert chi2.ppf(1e-4, 108) < honest < chi2.ppf(1 - 1e-4, 108)
    assert blind > chi2.ppf(1 - 1e-4, 108)


@pytest.mark.long
def test_errors_of_common_lights_and_of_the_place_are_counted_once() -> None:
    """Each attitude has the mean error of the lights around its z axis and one error that never changes.

    Of 12 draws the sum of 9 NEES each is as claimed. If these errors are taken as one process that falls with the
    rotation, on top of the noise that explains the residuals, the covariance claims too much.
    """
    rng = np.random.default_rng(23)
    honest = 0.0
    wide = 0.0
    for _ in range(12):
        assumed, vehicle = prior(SMALL, rng)
        one = record(vehicle, rng)
        sigma_rad = 20 * vehicle.attitude_sigma_rad
        direction = rng.standard_normal((6000, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        z = one.lab_from_body.apply([0.0, 0.0, 1.0])
        lights = (z @ direction.T > np.cos(0.1)).astype(float)
        count = lights.sum(axis=1)
        errors = lights @ rng.normal(0, sigma_rad, direction.shape) / count[:, None]
        errors += rng.normal(0, sigma_rad, 3)
        own = (sigma_rad**2 / count)[:, None, None] * np.eye(3)
        constant = np.tile(sigma_rad**2 * np.eye(3), (len(errors), 1, 1))
        one = replace(
            one,
            lab_from_body=one.lab_from_body * Rotation.from_rotvec(errors),
            covariance_rad2=one.covariance_rad2 + own + constant,
            systematic_rad2=own + constant,
            constant_rad2=constant,
            lights=lights,
        )
        honest += nees(estimate_with_noise([one], assumed), vehicle)
        unsplit = replace(one, constant_rad2=None, lights=None)
        wide += nees(estimate_with_noise([unsplit], assumed), vehicle)
    assert chi2.ppf(1e-4, 108) < honest < chi2.ppf(1 - 1e-4, 108)
    assert wide < chi2.ppf(1e-4, 108)
