"""Laws of the mass properties on an air bearing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from scipy import linalg
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from estimator.calibration import mass_dynamics, mass_properties
from estimator.calibration.mass_dynamics import (
    STATE,
    BearingRecord,
    EquationsOfMotion,
    LabConstants,
    MassEstimate,
    Prior,
    States,
    inertia_matrix,
    inertia_six,
)
from estimator.core.errors import ImageError
from estimator.filter import correct
from estimator.filter.error_models import TrackerModel
from tests.helpers.bearing_motion import SMALL, prior, record
from tests.helpers.laws import SEEDS, assert_covariance, law, turn

RECORD = record(SMALL, np.random.default_rng(11), 26.0)


def drawn_states(rng: np.random.Generator, count: int) -> States:
    rotations = Rotation.concatenate([turn(rng) for _ in range(count)])
    return States(rotations.as_quat().T, *(1e-2 * rng.standard_normal((2, 3, count))))


@law(
    States.take,
    States.rotation,
    States.moved,
    States.minus,
    mass_dynamics.cross,
    mass_dynamics.turn,
    mass_dynamics.moved_on,
)
@given(rng=SEEDS)
def test_a_change_of_states_is_recovered(rng: np.random.Generator) -> None:
    states = drawn_states(rng, 5)
    change = 0.1 * rng.standard_normal((STATE, 5))
    np.testing.assert_allclose(states.moved(change).minus(states), change, rtol=0, atol=1e-12)
    a, b = rng.standard_normal((2, 3, 5))
    np.testing.assert_allclose(
        mass_dynamics.cross(a, b), np.cross(a, b, axis=0), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        mass_dynamics.turn(states.quaternion, a).T,
        states.rotation.apply(a.T),
        rtol=0,
        atol=1e-12,
    )
    back = mass_dynamics.turn(
        states.quaternion, mass_dynamics.turn(states.quaternion, a), inverse=True
    )
    np.testing.assert_allclose(back, a, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(states.take(slice(1, 3)).momentum, states.momentum[:, 1:3])
    moved = mass_dynamics.moved_on(states, states, 2.0)
    np.testing.assert_allclose(moved.torque, 3 * states.torque, rtol=1e-12)


@law(
    EquationsOfMotion.stored,
    EquationsOfMotion.rate,
    EquationsOfMotion.slope,
    EquationsOfMotion.integrate,
)
@given(rng=SEEDS)
def test_momentum_in_the_lab_changes_by_external_torques_only(
    rng: np.random.Generator,
) -> None:
    """Without gravity's moment, drag and torques H stays, whatever the wheels do; rate and slope agree."""
    free = SMALL.truth.copy()
    free[6:14] = 0
    motion = EquationsOfMotion(
        RECORD, replace(SMALL.known, values=free), np.tile(free[:, None], 4)
    )
    states = drawn_states(rng, 4)._replace(torque=np.zeros((3, 4)))
    begin = rng.uniform(0, 10, 4)
    after = motion.integrate(begin, begin + 3.0, states, 2.0)
    np.testing.assert_allclose(after.momentum, states.momentum, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(after.quaternion, axis=0), 1, rtol=1e-12)
    rate = motion.rate(states, motion.stored(begin))
    short = 1e-5
    turned = motion.integrate(begin, begin + short, states, 2.0).minus(states)[:3] / short
    np.testing.assert_allclose(turned, rate, rtol=0, atol=1e-4)
    spin = motion.slope(begin, states).quaternion
    np.testing.assert_allclose(
        np.sum(spin * states.quaternion, axis=0), 0, rtol=0, atol=1e-12
    )


def test_a_free_body_turns_against_the_stars_and_not_with_the_earth() -> None:
    """A sphere without torque: its momentum and its rate stay fixed among the stars, while the lab turns by exp([W] t).

    On an Earth that turns once in 200 s, in closed form.
    """
    earth = np.array([0.01, -0.02, 0.022])
    sphere = SMALL.truth.copy()
    sphere[:6] = [0.1, 0.1, 0.1, 0.0, 0.0, 0.0]
    sphere[6:] = 0.0
    still = replace(RECORD, wheel_momentum_nms=0 * RECORD.wheel_momentum_nms)
    lab = replace(SMALL.lab, earth_lab_rad_s=earth)
    known = replace(SMALL.known, values=sphere, lab=lab)
    motion = EquationsOfMotion(still, known, sphere[:, None])
    states = drawn_states(np.random.default_rng(4), 1)._replace(torque=np.zeros((3, 1)))
    duration_s = 20.0
    after = motion.integrate(np.zeros(1), np.full(1, duration_s), states, 2.0)
    lab_from_first = Rotation.from_rotvec(-earth * duration_s)
    np.testing.assert_allclose(
        after.momentum[:, 0], lab_from_first.apply(states.momentum[:, 0]), rtol=0, atol=1e-10
    )
    among_stars = Rotation.from_rotvec(states.momentum[:, 0] / 0.1 * duration_s)
    expected = lab_from_first * among_stars * states.rotation[0]
    assert (after.rotation[0] * expected.inv()).magnitude() < 1e-7


AT_REST = States(np.array([[0.0], [0.0], [0.0], [1.0]]), np.zeros((3, 1)), np.zeros((3, 1)))


def noise_after(duration_s: float) -> np.ndarray:
    """(9, 9) covariance of the states after a time, from no attitude error, momentum and torque."""
    return mass_dynamics.torque_noise(
        np.array([duration_s]), RECORD, AT_REST, SMALL.truth, SMALL.known
    )[0]


@pytest.mark.parametrize("duration_s", [0.5, 3.0])
def test_the_random_torque_adds_the_variances_of_an_ornstein_uhlenbeck_process(
    duration_s: float,
) -> None:
    """With r the rms and x = T / tau, torque and its integral: r^2 (1 - e^-2x), r^2 tau^2 (2 x - 3 + 4 e^-x - e^-2x).

    Source: Gillespie 1996, Phys. Rev. E 54, 2084.
    """
    noise = noise_after(duration_s)
    x = duration_s / SMALL.correlation_s
    torque = SMALL.torque_rms_nm**2 * (1 - np.exp(-2 * x))
    momentum = 2 * x - 3 + 4 * np.exp(-x) - np.exp(-2 * x)
    momentum *= (SMALL.torque_rms_nm * SMALL.correlation_s) ** 2
    np.testing.assert_allclose(noise[6:, 6:], torque * np.eye(3), rtol=1e-6, atol=1e-20)
    np.testing.assert_allclose(noise[3:6, 3:6], momentum * np.eye(3), rtol=1e-6, atol=1e-20)


@pytest.mark.parametrize("duration_s", [0.5, 3.0, 20.0])
def test_the_random_torque_s_noise_is_van_loan_s(duration_s: float) -> None:
    """Of angle, momentum and torque, a linear system at rest: J a' = h, h' = d, d' = -d / tau + noise.

    By the exponential of one matrix of twice the size (Van Loan 1978, IEEE Trans. Automatic Control 23, 395).
    """
    tau = SMALL.correlation_s
    system = np.zeros((STATE, STATE))
    system[:3, 3:6] = np.linalg.inv(SMALL.inertia_kg_m2)
    system[3:6, 6:] = np.eye(3)
    system[6:, 6:] = -np.eye(3) / tau
    white = np.zeros((STATE, STATE))
    white[6:, 6:] = 2 * SMALL.torque_rms_nm**2 / tau * np.eye(3)
    whole = np.block([[-system, white], [np.zeros((STATE, STATE)), system.T]])
    exponential = linalg.expm(whole * duration_s)
    expected = exponential[STATE:, STATE:].T @ exponential[:STATE, STATE:]
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(
        noise_after(duration_s) / size, expected / size, rtol=0, atol=1e-4
    )


@pytest.mark.parametrize("sample_s", [0.1, 0.02])
def test_the_noise_of_wheel_speeds_is_a_random_walk_of_the_attitude(sample_s: float) -> None:
    """A sample's error of s stays for its time dt, so that n samples turn a body by J^-1 s dt sqrt(n)."""
    sigma_nms = 3e-4
    wheel_t_s = np.arange(0.0, 30.0, sample_s)
    sampled = replace(
        RECORD, wheel_t_s=wheel_t_s, wheel_momentum_nms=np.zeros((len(wheel_t_s), 3))
    )
    lab = replace(SMALL.lab, wheel_sigma_nms=sigma_nms, torque_rms_nm=np.full(3, 1e-15))
    noise = mass_dynamics.torque_noise(
        np.array([2.0]), sampled, AT_REST, SMALL.truth, replace(SMALL.known, lab=lab)
    )[0]
    inverse = np.linalg.inv(SMALL.inertia_kg_m2)
    one = inverse * sigma_nms * sample_s
    np.testing.assert_allclose(noise[:3, :3], 2.0 / sample_s * one @ one.T, rtol=1e-6)


@law(mass_dynamics.difference_steps, mass_dynamics.transition, mass_dynamics.torque_noise)
@given(rng=SEEDS)
def test_a_transition_matrix_predicts_small_changes(rng: np.random.Generator) -> None:
    """Of a state and of the parameters, by its derivatives; its noise is a covariance."""
    assumed, _ = prior(SMALL, rng)
    states = mass_properties.first_states(RECORD, assumed, assumed.values).take(slice(0, 6))
    link = mass_dynamics.transition(RECORD, 0, states, assumed.values, assumed)
    change = np.outer(np.repeat([1e-4, 1e-6, 1e-8], 3), np.ones(6)) * rng.standard_normal(
        (STATE, 6)
    )
    by = 1e-3 * assumed.sigma * rng.standard_normal(20)
    other = mass_dynamics.transition(
        RECORD, 0, states.moved(change), assumed.values + by, assumed
    )
    expected = np.einsum("kij,jk->ik", link.by_state, change) + (link.by_parameter @ by).T
    scale = np.repeat([1e-6, 1e-8, 1e-10], 3)[:, None]
    np.testing.assert_allclose((other.after.minus(link.after) - expected) / scale, 0, atol=1)
    for one in link.noise:
        assert_covariance(one)
    steps = mass_dynamics.difference_steps(assumed.values, assumed.sigma, 1.0, 1.0)
    assert all((step > 0).all() for step in steps)


@law(
    mass_properties.estimate_mass,
    mass_properties.estimate_with_noise,
    mass_properties.first_states,
    mass_properties.reduced,
    mass_properties.whitened_links,
    mass_properties.add_measured,
    mass_properties.lower_band,
    mass_properties.measured_minus,
)
@given(rng=SEEDS)
def test_elimination_equals_the_whole_normal_matrix(rng: np.random.Generator) -> None:
    """The band of the states and their elimination against a dense inverse; more records, smaller errors."""
    assumed, _ = prior(SMALL, rng)
    values = assumed.values
    states = mass_properties.first_states(RECORD, assumed, values)
    part = mass_properties.reduced(RECORD, states, values, assumed)
    rows = mass_properties.whitened_links(RECORD, states, values, assumed)
    count = len(RECORD.t_s)
    size = len(values)
    whole = np.zeros((STATE * count + size + 1,) * 2)
    for k, row in enumerate(rows):
        at = np.r_[STATE * k : STATE * (k + 2), STATE * count : len(whole)]
        whole[np.ix_(at, at)] += row.T @ row
    diagonal = np.zeros((count, STATE, STATE))
    border = np.zeros((count, STATE, size + 1))
    corner = np.zeros((size + 1, size + 1))
    blocks = diagonal, border, corner
    chi2 = mass_properties.add_measured(RECORD, states, values, assumed, blocks)
    # A first torque of two standard deviations about each axis adds four for each.
    pushed = states._replace(torque=states.torque + 2 * assumed.lab.torque_rms_nm[:, None])
    without = tuple(map(np.copy, blocks))
    added = mass_properties.add_measured(RECORD, pushed, values, assumed, without)
    assert added - chi2 == pytest.approx(12)
    whole[STATE * count :, STATE * count :] += corner
    for k in range(count):
        at = slice(STATE * k, STATE * (k + 1))
        whole[at, at] += diagonal[k]
        whole[at, STATE * count :] += border[k]
    inner = whole[: STATE * count, : STATE * count]
    outer = whole[: STATE * count, STATE * count :]
    schur = whole[STATE * count :, STATE * count :] - outer.T @ np.linalg.solve(inner, outer)
    scale = np.outer(assumed.sigma, assumed.sigma)
    np.testing.assert_allclose(
        part.normal * scale, schur[:-1, :-1] * scale, rtol=1e-4, atol=1e-4
    )
    band = mass_properties.lower_band(diagonal, np.zeros((count - 1, STATE, STATE)))
    np.testing.assert_array_equal(band[0], diagonal[:, range(STATE), range(STATE)].ravel())


@law(
    mass_properties.considered,
    BearingRecord.noise_rad2,
    BearingRecord.varying_rad2,
    BearingRecord.with_noise,
    slow=True,
)
@given(rng=SEEDS, at=some.integers(2, 24))
def test_consider_covariance_is_the_effect_of_attitude_errors(
    rng: np.random.Generator, at: int
) -> None:
    """The covariance e e^T of a constant error adds d d^T, with d the change of the estimate by the error e.

    To 12 %, at errors of any size: Gauss and Newton leave out the curvature times the residuals.
    """
    assumed, _ = prior(SMALL, rng)
    error = 2e-5 * rng.standard_normal(3)
    systematic = np.zeros((len(RECORD.t_s), 3, 3))
    systematic[at] = np.outer(error, error)
    shared = replace(
        RECORD,
        covariance_rad2=RECORD.covariance_rad2 + systematic,
        systematic_rad2=systematic,
        constant_rad2=systematic,
    )
    np.testing.assert_allclose(shared.varying_rad2, RECORD.covariance_rad2, rtol=1e-12)
    np.testing.assert_allclose(shared.noise_rad2, RECORD.covariance_rad2, rtol=1e-12)
    np.testing.assert_allclose(
        shared.with_noise(3.0).noise_rad2, 3 * shared.noise_rad2, rtol=1e-12
    )
    np.testing.assert_array_equal(shared.with_noise(3.0).systematic_rad2, systematic)
    turns = np.zeros((len(RECORD.t_s), 3))
    turns[at] = error
    turned = replace(RECORD, lab_from_body=RECORD.lab_from_body * Rotation.from_rotvec(turns))
    before, after, considered = (
        mass_properties.estimate_mass([one], assumed) for one in (RECORD, turned, shared)
    )
    change = (after.values - before.values) / before.sigma
    added = (considered.covariance - before.covariance) / np.outer(before.sigma, before.sigma)
    np.testing.assert_allclose(
        added, np.outer(change, change), rtol=0.05, atol=0.12 * change @ change
    )


@pytest.mark.parametrize("other", [7, 10, 26])
def test_errors_are_shared_by_the_rotation_between_two_attitudes(other: int) -> None:
    """By exp(-rotation / angle) of what two attitudes share that are from the same lights, 4 to 7 degrees apart."""
    assumed, _ = prior(SMALL, np.random.default_rng(5))
    error = np.array([1e-5, -6e-6, 2e-5])
    systematic = np.zeros((len(RECORD.t_s), 3, 3))
    systematic[[2, other]] = np.outer(error, error)
    independent = replace(RECORD, covariance_rad2=RECORD.covariance_rad2 + systematic)
    by_rotation = replace(independent, systematic_rad2=systematic)
    by_lights = replace(by_rotation, lights=np.ones((len(RECORD.t_s), 4)))
    apart, near, same = (
        mass_properties.estimate_mass([one], assumed)
        for one in (independent, by_rotation, by_lights)
    )
    scale = np.outer(apart.sigma, apart.sigma)
    added = (near.covariance - apart.covariance) / scale
    whole = (same.covariance - apart.covariance) / scale
    between = RECORD.lab_from_body[2].inv() * RECORD.lab_from_body[other]
    correlation = np.exp(-between.magnitude() / TrackerModel().systematic_angle_rad)
    assert correlation < 0.8
    size = float(np.abs(whole).max())
    np.testing.assert_allclose(added, correlation * whole, rtol=0, atol=1e-5 * size)


def test_the_first_momentum_of_a_filter_is_as_uncertain_as_its_rate() -> None:
    """0.01 rad/s about any body axis, times the inertia, if the mass properties are known: over drawn rates."""
    assumed, _ = prior(SMALL, np.random.default_rng(6))
    known = MassEstimate(assumed.values, 1e-20 * np.eye(20), 1.0)
    covariance = mass_properties.first_covariance(known, RECORD, assumed)[3:6, 3:6]
    rates = 0.01 * np.random.default_rng(7).standard_normal((200_000, 3))
    momenta = RECORD.lab_from_body[1].apply(rates @ inertia_matrix(assumed.values[:6]))
    size = float(np.abs(covariance).max())
    np.testing.assert_allclose(np.cov(momenta.T), covariance, rtol=0, atol=0.02 * size)


@law(correct.root)
@given(rng=SEEDS)
def test_the_square_of_a_symmetric_root_is_the_matrix(rng: np.random.Generator) -> None:
    half = rng.standard_normal((4, 3, 2))  # of rank 2
    matrix = half @ half.transpose(0, 2, 1)
    root = correct.root(matrix)
    np.testing.assert_allclose(root @ root, matrix, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(root, root.transpose(0, 2, 1), rtol=0, atol=1e-12)


@law(
    MassEstimate.inertia_kg_m2,
    MassEstimate.moment_kg_m,
    MassEstimate.sigma,
    inertia_matrix,
    inertia_six,
)
@given(rng=SEEDS)
def test_an_estimate_is_read_from_its_state_vector(rng: np.random.Generator) -> None:
    half = rng.standard_normal((3, 3))
    values = rng.standard_normal(20)
    values[:6] = inertia_six(half + half.T)
    estimate = MassEstimate(values, np.diag(np.arange(1.0, 21.0) ** 2), 1.0)
    np.testing.assert_array_equal(estimate.inertia_kg_m2, inertia_matrix(values[:6]))
    np.testing.assert_array_equal(estimate.inertia_kg_m2, half + half.T)
    np.testing.assert_array_equal(estimate.moment_kg_m, values[6:9])
    np.testing.assert_allclose(estimate.sigma, np.arange(1.0, 21.0))


@law(
    mass_properties.filter_mass,
    mass_properties.filter_from,
    mass_properties.cut,
    mass_properties.first_covariance,
    mass_properties.joseph,
    slow=True,
)
@given(rng=SEEDS)
def test_the_covariance_of_a_filter_never_grows(rng: np.random.Generator) -> None:
    assumed, _ = prior(SMALL, rng)
    estimates = list(mass_properties.filter_mass(RECORD, assumed))
    assert len(estimates) == len(RECORD.t_s) - mass_properties.START - 2
    last = assumed.sigma
    for one in estimates:
        assert_covariance(one.covariance / np.outer(assumed.sigma, assumed.sigma))
        assert (one.sigma <= last * (1 + 1e-9)).all()
        last = one.sigma
    begun = mass_properties.estimate_mass(
        [mass_properties.cut(RECORD, slice(0, 20))], assumed
    )
    whole = mass_properties.first_covariance(begun, RECORD, assumed)
    scale = np.sqrt(np.diag(whole))
    assert_covariance(whole / np.outer(scale, scale))
    rest = mass_properties.cut(RECORD, slice(20, None))
    first = next(mass_properties.filter_from(begun, rest, assumed))
    np.testing.assert_array_equal(first.values, estimates[0].values)


def test_a_filter_s_misfit_is_the_chi_square_of_each_number_of_its_innovations() -> None:
    """Attitudes of 1,000 rad, from the third on, change nothing: the innovations are those of an integrated motion.

    Three numbers an attitude, from the first innovation on.
    """
    assumed, _ = prior(SMALL, np.random.default_rng(12))
    part = mass_properties.cut(RECORD, slice(0, 6))
    sigma_rad = 1e3
    covariance_rad2 = part.covariance_rad2.copy()
    covariance_rad2[2:] = sigma_rad**2 * np.eye(3)
    blind = replace(part, covariance_rad2=covariance_rad2)
    known = MassEstimate(assumed.values, 1e-12 * np.diag(assumed.sigma**2), 1.0)
    bias = Rotation.from_rotvec(assumed.values[mass_dynamics.BIAS])
    states = mass_properties.first_states(blind, assumed, assumed.values).take(slice(1, 2))
    chi2 = 0.0
    estimates = list(mass_properties.filter_from(known, blind, assumed))
    assert len(estimates) == 4
    for n, one in enumerate(estimates, 1):
        states = mass_dynamics.transition(blind, n, states, assumed.values, assumed).after
        off = (states.rotation[0] * bias).inv() * part.lab_from_body[n + 1]
        chi2 += off.magnitude() ** 2 / sigma_rad**2
        assert one.misfit / chi2 == pytest.approx(1 / (3 * n), rel=1e-3)


def test_a_longer_record_has_smaller_errors() -> None:
    assumed, _ = prior(SMALL, np.random.default_rng(3))
    short, long = (
        mass_properties.estimate_mass(
            [mass_properties.cut(RECORD, slice(0, n))],
            Prior(SMALL.truth, assumed.sigma, SMALL.lab),
        ).sigma
        for n in (12, 26)
    )
    assert (long <= short * (1 + 1e-3)).all()


@law(mass_dynamics.inverse_inertia, mass_dynamics.momentum_scale)
@given(rng=SEEDS, factor=some.floats(0.1, 10))
def test_momentum_scales_with_the_inertia(rng: np.random.Generator, factor: float) -> None:
    """By the assumed over the estimated inertia, whatever the attitudes; the inverse is that of the inertia."""
    assumed, _ = prior(SMALL, rng)
    scaled = np.concatenate([factor * assumed.values[:6], assumed.values[6:]])
    states = drawn_states(rng, 4)
    found = mass_dynamics.momentum_scale(RECORD, states, scaled, assumed.values)
    np.testing.assert_allclose(
        found, np.tile(np.eye(3) / factor, (4, 1, 1)), rtol=0, atol=1e-9 / factor
    )
    inverse = mass_dynamics.inverse_inertia(RECORD, scaled)
    np.testing.assert_allclose(
        inverse @ inertia_matrix(scaled[:6]), np.eye(3), rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("duration_s", [0.35, 2.0])
def test_a_motion_under_all_torques_is_that_of_its_equations(duration_s: float) -> None:
    """Against SciPy's integration with matrices: skew wheels, trim masses, drag, gravity, lab, Earth, random torque.

    The random torque is that of the assumed inertia, and decays meanwhile.
    """
    rng = np.random.default_rng(40)
    axes = np.array([[1.0, 0.2, 0.0, 0.5], [0.0, 0.9, 0.3, 0.5], [0.1, 0.0, 0.8, 0.7]])
    axes /= np.linalg.norm(axes, axis=0)
    wheel_t_s = np.arange(0.0, 4.0, 0.001)
    momenta = 2e-3 * np.sin(wheel_t_s[:, None] * [1.0, 0.7, 1.3, 0.5] + [0.1, 0.2, 0.3, 0.4])
    added = np.array([[2e-3, 3e-4, -1e-4], [3e-4, 1e-3, 2e-4], [-1e-4, 2e-4, 3e-3]])
    full = replace(
        RECORD,
        t_s=np.arange(4.0) * 0.9,
        lab_from_body=RECORD.lab_from_body[:4],
        covariance_rad2=RECORD.covariance_rad2[:4],
        wheel_t_s=wheel_t_s,
        wheel_momentum_nms=momenta,
        added_inertia_kg_m2=added,
        added_moment_kg_m=np.array([1e-4, -2e-4, 3e-4]),
    )
    earth = np.array([3e-2, -1e-2, 2e-2])
    tau = 1.7
    lab = LabConstants(9.8, axes, np.full(3, 1e-4), tau, earth)
    values = np.concatenate(
        [
            [0.1, 0.13, 0.09, 0.004, -0.002, 0.003],
            [2e-3, -1e-3, -3e-3],
            [3e-4, -2e-4, 5e-4],
            [2e-3, 4e-3],
            [0.0, 0.0, 0.0],
            [0.02, -0.01, 0.03, 0.05],
        ]
    )
    assumed = values.copy()
    assumed[:6] = [0.12, 0.12, 0.1, -0.003, 0.001, 0.002]
    states = drawn_states(rng, 3)
    states = states._replace(momentum=3 * states.momentum, torque=0.02 * states.torque)
    begin_s = np.array([0.1, 0.6, 1.3])
    known = Prior(assumed, np.ones(len(assumed)), lab)
    motion = EquationsOfMotion(full, known, np.tile(values[:, None], 3))
    after = motion.integrate(begin_s, begin_s + duration_s, states, tau)
    J = inertia_matrix(values[:6]) + added
    J0 = inertia_matrix(assumed[:6]) + added
    moment = values[6:9] + full.added_moment_kg_m
    for n in range(3):
        first_torque = states.torque[:, n]

        def slope(
            t_s: float,
            state: np.ndarray,
            d: np.ndarray = first_torque,
            begin: float = begin_s[n],
        ) -> np.ndarray:
            R = state[:9].reshape(3, 3)
            H = state[9:]
            h = [np.interp(t_s, wheel_t_s, one) for one in momenta.T]
            stored = axes @ ((1 + values[17:]) * h)
            w = np.linalg.inv(J) @ (R.T @ H - stored) - R.T @ earth
            random = R @ J @ np.linalg.inv(J0) @ R.T @ d * np.exp(-(t_s - begin) / tau)
            drag = R @ ((values[12] + values[13] * np.abs(w)) * w)
            weight = np.cross(R @ moment, [0.0, 0.0, -9.8])
            torque = weight - np.cross(earth, H) + values[9:12] + random - drag
            skew = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
            return np.concatenate([(R @ skew).ravel(), torque])

        start = np.concatenate(
            [states.rotation[n].as_matrix().ravel(), states.momentum[:, n]]
        )
        times = (begin_s[n], begin_s[n] + duration_s)
        exact = solve_ivp(slope, times, start, rtol=1e-10, atol=1e-13, max_step=0.02).y[:, -1]
        turned = Rotation.from_matrix(exact[:9].reshape(3, 3)).inv() * after.rotation[n]
        # Each step feels the mean of the random torque.
        assert turned.magnitude() < 2e-6
        np.testing.assert_allclose(after.momentum[:, n], exact[9:], rtol=0, atol=1e-7)
        np.testing.assert_allclose(
            after.torque[:, n], first_torque * np.exp(-duration_s / tau), rtol=1e-9
        )


def test_first_states_have_the_momentum_of_body_and_wheels() -> None:
    """The mean rate between two attitudes holds in the middle; at the ends that of the first and the last pair."""
    t_s = np.array([0.0, 1.0, 3.0, 4.0, 4.5])
    axis = np.array([0.0, 0.6, 0.8])
    rates = np.array([0.01, 0.02, 0.04, 0.01])
    angles = np.concatenate([[0.0], np.cumsum(rates * np.diff(t_s))])
    start = Rotation.from_euler("xyz", [0.2, -0.4, 0.9])
    attitudes = start * Rotation.from_rotvec(np.outer(angles, axis))
    wheels = np.tile([1e-3, -2e-3, 3e-3], (6, 1))
    flown = BearingRecord(
        t_s,
        attitudes,
        np.tile(1e-9 * np.eye(3), (5, 1, 1)),
        np.arange(6.0),
        wheels,
        added_inertia_kg_m2=np.diag([1e-3, 2e-3, 3e-3]),
    )
    values = SMALL.truth.copy()
    values[17:] = [0.1, 0.0, -0.1]
    found = mass_properties.first_states(flown, SMALL.known, values)
    middle_s = np.array([0.5, 2.0, 3.5, 4.25])
    rate = np.interp(t_s, middle_s, rates)
    inertia = SMALL.inertia_kg_m2 + np.diag([1e-3, 2e-3, 3e-3])
    own = rate[:, None] * (inertia @ axis) + [1.1e-3, -2e-3, 2.7e-3]
    np.testing.assert_allclose(found.momentum.T, attitudes.apply(own), rtol=1e-9)
    assert not found.torque.any()
    np.testing.assert_allclose(found.rotation.as_matrix(), attitudes.as_matrix(), atol=1e-12)


def test_a_record_s_times_ascend_within_those_of_its_wheels() -> None:
    attitudes = RECORD.lab_from_body[:4]
    covariance = np.tile(1e-9 * np.eye(3), (4, 1, 1))
    wheels = np.zeros((5, 3))

    def record_of(t_s: list[float], wheel_t_s: list[float], count: int = 4) -> BearingRecord:
        return BearingRecord(
            np.array(t_s), attitudes[:count], covariance[:count], np.array(wheel_t_s), wheels
        )

    record_of([0, 1, 2, 4], [0, 1, 2, 3, 4])
    for t_s, wheel_t_s in (
        ([0.0, 1, 1, 4], [0.0, 1, 2, 3, 4]),
        ([0.0, 1, 2, 4], [0.0, 1, 1, 3, 4]),
        ([0.0, 2, 1, 4], [0.0, 1, 2, 3, 4]),
    ):
        with pytest.raises(ImageError, match="do not ascend"):
            record_of(t_s, wheel_t_s)
    for t_s in ([-0.1, 1, 2, 4], [0, 1, 2, 4.1]):
        with pytest.raises(ImageError, match="wheel speeds from 0 to 4 s"):
            record_of(t_s, [0.0, 1, 2, 3, 4])
    with pytest.raises(ImageError, match="3 attitudes; allowed: 4 or more"):
        record_of([0, 1, 2], [0, 1, 2, 3, 4], 3)


@pytest.mark.slow
def test_the_misfit_of_a_fit_is_one_where_the_errors_are_as_assumed() -> None:
    """Three numbers an attitude less six of the start: of 40 records with drawn noise; less with more noise."""
    found = []
    for seed in range(40):
        rng = np.random.default_rng([41, seed])
        short = mass_properties.cut(record(SMALL, rng, 26.0), slice(0, 9))
        assumed, _ = prior(SMALL, rng)
        drawn = SMALL.truth + assumed.sigma * rng.standard_normal(20)
        known = Prior(drawn, assumed.sigma, SMALL.lab)
        one = mass_properties.estimate_mass([short], known)
        found.append(one.misfit)
        if seed == 0:
            twice = mass_properties.estimate_mass([short, short], known)
            assert twice.misfit == pytest.approx(one.misfit, rel=0.3)
            doubled = short.with_noise(9.0)
            quiet = mass_properties.estimate_mass([doubled], known).misfit
            assert quiet < one.misfit
    # The chi-square of 21 numbers
    assert np.mean(found) == pytest.approx(1, abs=4 * np.sqrt(2 / 21 / 40))


def test_the_noise_is_scaled_until_the_misfit_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A misfit of 5 over the factor: the next is the last one times misfit^1.5, within a thousand; eight fits."""
    factors: list[float] = []

    def fit(records: list[BearingRecord], *_: object) -> MassEstimate:
        factors.append(
            float(records[0].covariance_rad2[0, 0, 0] / RECORD.covariance_rad2[0, 0, 0])
        )
        return MassEstimate(SMALL.truth, np.eye(20), 5.0 / factors[-1])

    monkeypatch.setattr(mass_properties, "estimate_mass", fit)
    assumed, _ = prior(SMALL, np.random.default_rng(3))
    last = mass_properties.estimate_with_noise([RECORD], assumed)
    assert abs(np.log(last.misfit)) < 0.1
    expected = [1.0]
    while abs(np.log(5 / expected[-1])) >= 0.1:
        expected.append(expected[-1] * (5 / expected[-1]) ** 1.5)
    np.testing.assert_allclose(factors, expected, rtol=1e-9)
    for misfit, bound in ((1e9, 1e3), (1e-9, 1e-3)):
        factors.clear()
        monkeypatch.setattr(
            mass_properties,
            "estimate_mass",
            lambda records, *_, m=misfit: replace(fit(records), misfit=m),
        )
        mass_properties.estimate_with_noise([RECORD], assumed)
        np.testing.assert_allclose(factors, [1.0] + 7 * [bound], rtol=1e-9)


def test_a_misfit_falls_with_the_assumed_noise_where_attitudes_tell_little() -> None:
    """Nine attitudes hardly move the parameters: the fit goes on until the states have settled too."""
    rng = np.random.default_rng([41, 0])
    short = mass_properties.cut(record(SMALL, rng, 26.0), slice(0, 9))
    assumed, _ = prior(SMALL, rng)
    known = Prior(SMALL.truth, assumed.sigma, SMALL.lab)
    misfits = [
        mass_properties.estimate_mass([short.with_noise(factor)], known).misfit
        for factor in (1.0, 9.0, 81.0)
    ]
    # Of nearly the same residuals
    assert misfits[0] > 3 * misfits[1] > 9 * misfits[2]


def test_steps_of_difference_quotients_are_small_beside_values_and_deviations() -> None:
    """At most a thousandth of a deviation, and 1e-5 of the larger of value and deviation; 1e-5 rad and of momentum."""
    values = np.array([1.0, 1.0, 0.0, -50.0])
    sigma = np.array([1e-6, 1.0, 0.1, 0.2])
    state, step = mass_dynamics.difference_steps(values, sigma, 0.3, 2e-6)
    np.testing.assert_allclose(step, [1e-9, 1e-5, 1e-6, 2e-4])
    np.testing.assert_allclose(state, np.repeat([1e-5, 3e-6, 2e-6], 3))
