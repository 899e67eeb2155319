"""Mass properties from whole records: the most probable motion and parameters (multiple shooting).

A rate from differences of attitudes has errors that bias a regression on it. Here the motion itself is fitted: the
unknowns are the states at every attitude (`mass_dynamics.States`) and the parameters, and the residuals are

    attitudes measured minus fitted,                         weighted by the tracker's covariance,
    states integrated from the last attitude minus fitted,   weighted by the covariance of the random torque,
    parameters assumed minus fitted,                         weighted by the prior.

The Gauss-Newton method minimizes their weighted sum of squares; for a motion with random forces it is the iterated
Kalman smoother (Bell, SIAM J. Optimization 4, 1994, 626; Bock's multiple shooting, 1983). `estimate_mass` repeats:

1. Linearize each record's residuals, and eliminate its states, which form a banded matrix (`reduced`).
2. Add the records' information on the parameters to that of the prior. Records of different trim add up.
3. Solve for the parameters; their covariance is the inverse of the sum.
4. Substitute back for the states.

Errors that attitudes share, of a map of LEDs or a lens, are not fitted, but considered (Schmidt 1966): the weights take
those that vary with the attitude as independent, and their correlation, with the errors that all attitudes share, adds
to the covariance of the parameters (`considered`).

In flight `filter_mass` estimates the same parameters by an extended Kalman filter.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, solveh_banded
from scipy.spatial.transform import Rotation

from estimator.calibration.mass_dynamics import (
    BIAS,
    MIN_ATTITUDES,
    STATE,
    BearingRecord,
    EquationsOfMotion,
    MassEstimate,
    Prior,
    States,
    inertia_matrix,
    inverse_inertia,
    momentum_scale,
    transition,
    turn,
)
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.vectors import normalized
from estimator.filter.correct import root
from estimator.filter.error_models import TrackerModel

MAX_ITERATIONS = 30
# Largest step of a parameter at convergence, in its standard deviations
CONVERGED_SIGMA = 0.01
# Tolerance of the logarithm of the misfit, and the largest number of fits to reach it.
MISFIT_TOLERANCE = 0.1
MAX_FACTORS = 8
# Power of the misfit in the next factor. It is above 1, because the random torque's share of the misfit stays.
FACTOR_POWER = 1.5
FACTOR_LIMITS = (1e-3, 1e3)
MOMENTUM = slice(3, 6)  # elements of a state
BANDS = 2 * STATE  # width of the normal matrix's band: a state and its neighbor


class Reduced(NamedTuple):
    """A record's normal equations on the parameters after its states are eliminated.

    Attributes
    ----------
    normal, gradient
        (P, P) normal matrix and (P,) gradient of the parameters
    states_step, states_by_parameter
        (9 N,) a and (9 N, P) B: the states' step is a - B times the parameters' step
    chi2
        Chi-square of the residuals before the step
    """

    normal: Floats
    gradient: Floats
    states_step: Floats
    states_by_parameter: Floats
    chi2: float


def estimate_mass(records: Sequence[BearingRecord], prior: Prior) -> MassEstimate:
    """Return the mass properties from one or several records: the numbered steps of the module.

    Raises
    ------
    ImageError
        If the fit does not converge.
    """
    values = prior.values.copy()
    motions = [first_states(record, prior, values) for record in records]
    information = np.diag(prior.sigma**-2)
    attitudes = sum(len(record.t_s) for record in records)
    small = False
    for _ in range(MAX_ITERATIONS):
        # 1. Linearization and elimination
        parts = [reduced(*one, values, prior) for one in zip(records, motions, strict=True)]
        # 2. Information
        normal = information + sum(part.normal for part in parts)
        gradient = information @ (prior.values - values) + sum(
            part.gradient for part in parts
        )
        # 3. Parameters
        covariance: Floats = np.asarray(np.linalg.inv(normal))
        step = covariance @ gradient
        values = values + step
        # 4. States
        for k, part in enumerate(parts):
            change = part.states_step - part.states_by_parameter @ step
            motions[k] = motions[k].moved(change.reshape(-1, STATE).T)
        # Chi-square is that before the step: the states of a small step have taken part in one before.
        was_small = small
        small = bool(np.all(np.abs(step) < CONVERGED_SIGMA * np.sqrt(np.diag(covariance))))
        if small and was_small:
            covariance = covariance + considered(records, parts, covariance)
            from_prior = np.sum(((prior.values - values) / prior.sigma) ** 2)
            chi2 = sum(part.chi2 for part in parts) + from_prior
            # Three numbers an attitude, less attitude and momentum at the start of each record.
            misfit = float(chi2 / (3 * attitudes - 6 * len(records)))
            return MassEstimate(values, covariance, misfit)
        if not np.all(np.isfinite(values)):
            break
    raise ImageError(
        "mass properties: the fit does not converge; allowed: a motion that the assumed values describe"
    )


def estimate_with_noise(records: Sequence[BearingRecord], prior: Prior) -> MassEstimate:
    """Return the mass properties, with the attitudes' noise scaled by a factor at which the misfit is 1.

    A tracker's own covariance is too small where it does not model an error, and too large where it is cautious. The
    level of the random torque is taken as known. The errors raised are those of `estimate_mass`.
    """
    factor = 1.0
    for _ in range(MAX_FACTORS):
        estimate = estimate_mass([one.with_noise(factor) for one in records], prior)
        if abs(np.log(estimate.misfit)) < MISFIT_TOLERANCE:
            break
        factor = float(np.clip(factor * estimate.misfit**FACTOR_POWER, *FACTOR_LIMITS))
    return estimate


def considered(
    records: Sequence[BearingRecord], parts: Sequence[Reduced], covariance: Floats
) -> Floats:
    """Return the (P, P) change of the parameters' covariance by errors that attitudes share.

    1. An attitude's error e_n changes the parameters by K_n e_n, K_n = C (B - X_n)^T W_n: C is their covariance from
       independent errors, W_n the weight, B the derivative of a measured attitude by the parameters (those of the
       bias), and X_n that of the fitted one.
    2. The constant errors have the covariance S_n = L_n L_n^T and the correlation r = 1 of two attitudes. For the
       varying ones r is the share of their common lights, c / sqrt(n m) of the n and m of the attitudes, if these are
       known. Else it is exp(-rotation / angle), the process of `filter.error_models.TrackerModel`, without its time.
    3. They add sum_mn K_m L_m r_mn L_n^T K_n^T, where C already has the terms m = n of the varying errors.
    """
    size = len(covariance)
    varying = []
    constant = []
    attitudes = []
    lights = []
    by_bias = np.zeros((3, size))
    by_bias[:, BIAS] = np.eye(3)
    for record, part in zip(records, parts, strict=True):
        if record.systematic_rad2 is None:
            continue
        # 1. K_n
        fitted = part.states_by_parameter.reshape(-1, STATE, size)[:, :3]
        gain = covariance @ (by_bias - fitted).mT @ np.linalg.inv(record.varying_rad2)
        # 2. K_n L_n
        varying.append(gain @ root(record.varying_rad2 - record.noise_rad2))
        constant.append(gain @ root(record.covariance_rad2 - record.varying_rad2))
        attitudes.append(record.lab_from_body)
        if record.lights is not None:
            lights.append(record.lights)
    if not varying:
        return np.zeros((size, size))
    # 3. Sum over all pairs of attitudes, of all records
    effect = np.concatenate(varying)
    if len(lights) == len(varying):
        used = normalized(np.concatenate(lights))
        shared = used @ used.T
    else:
        quaternion = Rotation.concatenate(attitudes).as_quat()
        cosine = np.abs(quaternion @ quaternion.T)  # of half the angle
        angle_rad = 2 * np.arccos(np.minimum(cosine, 1))
        shared = np.exp(-angle_rad / TrackerModel().systematic_angle_rad)
    np.fill_diagonal(shared, 0.0)
    total = np.concatenate(constant).sum(axis=0)
    added = np.einsum("mpk,mn,nqk->pq", effect, shared, effect, optimize=True)
    return added + total @ total.T


def first_states(record: BearingRecord, prior: Prior, values: Floats) -> States:
    """Return the start states: the measured attitudes, the momentum from their differences, no random torque."""
    motion = EquationsOfMotion(record, prior, values[:, None])
    # Mean rate between two attitudes, interpolated to their times
    turned = (record.lab_from_body[:-1].inv() * record.lab_from_body[1:]).as_rotvec()
    mean_rate = turned / np.diff(record.t_s)[:, None]
    middle_s = (record.t_s[1:] + record.t_s[:-1]) / 2
    rate = np.array([np.interp(record.t_s, middle_s, one) for one in mean_rate.T])
    # H = R (J w + wheels)
    inertia = inertia_matrix(values[:6]) + record.added_inertia_kg_m2
    quaternion = record.lab_from_body.as_quat().T
    own = inertia @ rate + motion.stored(record.t_s)
    return States(quaternion, turn(quaternion, own), np.zeros_like(rate))


def reduced(record: BearingRecord, states: States, values: Floats, prior: Prior) -> Reduced:
    """Linearize a record's residuals and eliminate its states.

    1. Compute the residuals of the transitions and their slopes, in standard deviations (`whitened_links`).
    2. Sum the normal equations: the states' blocks on the diagonal, their `border` with the parameters and the
       residuals, and the `corner` of these.
    3. Add the measured attitudes (`add_measured`).
    4. Eliminate the states: corner - border^T A^-1 border, with the states' banded matrix A.
    """
    count = len(record.t_s)
    size = len(values)
    # 1. Residuals and slopes
    rows = whitened_links(record, states, values, prior)
    # 2. Normal equations; columns are the state before, the state after, the parameters and the residual.
    products = rows.mT @ rows
    before = slice(0, STATE)
    after = slice(STATE, 2 * STATE)
    rest = slice(2 * STATE, None)
    diagonal = np.zeros((count, STATE, STATE))
    border = np.zeros((count, STATE, size + 1))
    diagonal[:-1] += products[:, before, before]
    diagonal[1:] += products[:, after, after]
    border[:-1] += products[:, before, rest]
    border[1:] += products[:, after, rest]
    corner = products[:, rest, rest].sum(axis=0)
    # 3. Attitudes
    chi2 = float(np.sum(rows[:, :, -1] ** 2))
    chi2 += add_measured(record, states, values, prior, (diagonal, border, corner))
    # 4. Elimination
    flat = border.reshape(-1, size + 1)
    try:
        solved = solveh_banded(
            lower_band(diagonal, products[:, before, after]), flat, lower=True
        )
    except LinAlgError as error:
        raise ImageError(f"mass properties: {error}") from error
    corner -= flat.T @ solved
    return Reduced(corner[:-1, :-1], -corner[:-1, -1], -solved[:, -1], solved[:, :-1], chi2)


def whitened_links(
    record: BearingRecord, states: States, values: Floats, prior: Prior
) -> Floats:
    """Return the slopes of the transitions' residuals, and the residuals, in standard deviations.

    The array is (N - 1, 9, 18 + P + 1): slopes by the state before, the state after and the parameters; residuals.

    Residuals of momentum m are those of the assumed inertia, R J0 J^-1 R^T m, whose noise does not depend on J; their
    slopes by the elements of J are those of m and -R J0 J^-1 (dJ) J^-1 R^T m.
    """
    # Residuals: integrated minus fitted state
    before = states.take(slice(None, -1))
    link = transition(record, 0, before, values, prior)
    misfit = link.after.minus(states.take(slice(1, None))).T[:, :, None]
    by_after = np.broadcast_to(-np.eye(STATE), link.by_state.shape)
    rows = np.concatenate([link.by_state, by_after, link.by_parameter, misfit], axis=2)
    # R J0 J^-1 R^T of the momentum's rows, and its derivative by J
    scale = np.tile(np.eye(STATE), (len(misfit), 1, 1))
    scale[:, MOMENTUM, MOMENTUM] = momentum_scale(record, before, values, prior.values)
    R_lab_from_body = before.rotation.as_matrix()
    in_body = R_lab_from_body.mT @ misfit[:, MOMENTUM]
    turned = np.einsum(
        "ijp,kjl->kip", inertia_matrix(np.eye(6)), inverse_inertia(record, values) @ in_body
    )
    rows[:, MOMENTUM, 2 * STATE : 2 * STATE + 6] -= R_lab_from_body @ turned
    # Division by the Cholesky factor of the noise
    noise = scale @ link.noise @ scale.mT
    return np.linalg.inv(np.linalg.cholesky(noise)) @ scale @ rows


def add_measured(
    record: BearingRecord,
    states: States,
    values: Floats,
    prior: Prior,
    to: tuple[Floats, Floats, Floats],
) -> float:
    """Add the N attitudes, and the prior of the first random torque, to the normal equations; return their chi-square.

    A measured attitude is R exp(bias) exp(noise).

    Parameters
    ----------
    to
        Blocks that are added to in place: diagonal (N, 9, 9), border (N, 9, P + 1) and corner
        (P + 1, P + 1); the last column is the gradient
    """
    diagonal, border, corner = to
    # The residual depends on the attitude and on the bias with the same derivative, -I.
    weight = np.linalg.inv(record.varying_rad2)
    torque_weight = prior.lab.torque_rms_nm**-2.0
    off = measured_minus(record.lab_from_body, states.rotation, values[BIAS])
    pull = np.einsum("nij,nj->ni", weight, off)
    diagonal[:, :3, :3] += weight
    border[:, :3, BIAS] += weight
    border[:, :3, -1] -= pull
    corner[BIAS, BIAS] += weight.sum(axis=0)
    corner[BIAS, -1] -= pull.sum(axis=0)
    corner[-1, BIAS] -= pull.sum(axis=0)
    # First random torque: mean 0, variance rms^2
    diagonal[0, 6:, 6:] += np.diag(torque_weight)
    border[0, 6:, -1] += torque_weight * states.torque[:, 0]
    return float(np.sum(off * pull) + torque_weight @ states.torque[:, 0] ** 2)


def measured_minus(measured: Rotation, lab_from_body: Rotation, bias_rad: Floats) -> Floats:
    """Return the (N, 3) rotation vectors from the states' attitudes, with the tracker's bias, to the measured ones."""
    predicted = lab_from_body * Rotation.from_rotvec(bias_rad)
    return (predicted.inv() * measured).as_rotvec()


def lower_band(diagonal: Floats, beside: Floats) -> Floats:
    """Return the (18, 9 N) lower band of a normal matrix from its diagonal blocks (N, 9, 9) and those right of them.

    Element (i, j) of the matrix is in row i - j and column j of the band, as `solveh_banded` requires.
    """
    band = np.zeros((BANDS, STATE * len(diagonal)))
    for i in range(STATE):
        for j in range(STATE):
            if i >= j:
                band[i - j, j::STATE] = diagonal[:, i, j]
            band[STATE + i - j, j:-STATE:STATE] = beside[:, j, i]
    return band


# Mass properties in flight: an extended Kalman filter of state and parameters, one attitude after another.

START = 20  # number of attitudes of the batch that begins the filter
AT_BIAS = slice(
    STATE + BIAS.start, STATE + BIAS.stop
)  # rows of the bias after those of the state
RATE_SIGMA_RAD_S = 0.01  # standard deviation of the rate from the attitudes before and after


def filter_mass(record: BearingRecord, prior: Prior) -> Iterator[MassEstimate]:
    """Yield the estimate after each attitude from number START + 2 on; its misfit is that of the innovations so far.

    State and parameters are those of `estimate_mass`; the parameters are constant.

    1. Estimate the parameters by a batch over the first START attitudes, since the filter linearizes only once, at its
       current estimate. It diverges from assumptions that are far off, since the rate is the ratio of two unknowns,
       momentum and inertia.
    2. Start the state from the next three attitudes.
    3. Integrate to the next attitude; the covariance becomes F P F^T + Q (`transition`).
    4. Correct state and parameters by K r for an attitude with the residual r and the covariance S:
       K = P H^T (H P H^T + S)^-1 (Gelb, Applied Optimal Estimation, 1974, ch. 6). H selects the attitude's error plus
       the tracker's bias. Then repeat from step 3.

    Raises
    ------
    ImageError
        For too few attitudes, and if the batch does not converge.
    """
    least = START + MIN_ATTITUDES
    if len(record.t_s) < least:
        raise ImageError(
            f"mass properties: {len(record.t_s)} attitudes; allowed for a filter: {least} or more"
        )
    # 1. Batch
    begun = estimate_mass([cut(record, slice(0, START))], prior)
    # 2. to 4. Filter
    rest = cut(record, slice(START, None))
    yield from filter_from(begun, rest, prior)


def cut(record: BearingRecord, which: slice) -> BearingRecord:
    """Return the record with some of its attitudes."""
    names = (
        "t_s",
        "lab_from_body",
        "covariance_rad2",
        "systematic_rad2",
        "constant_rad2",
        "lights",
    )
    parts: dict[str, Any] = {
        name: None if (part := getattr(record, name)) is None else part[which]
        for name in names
    }
    return replace(record, **parts)


def filter_from(
    begun: MassEstimate, record: BearingRecord, prior: Prior
) -> Iterator[MassEstimate]:
    """Yield the estimate after each attitude but the first two, from earlier parameters and their covariance.

    The numbered steps are those of `filter_mass`.
    """
    size = len(begun.values)
    values = begun.values
    # 2. State at the second attitude
    states = first_states(record, prior, values).take(slice(1, 2))
    covariance = first_covariance(begun, record, prior)
    chi2 = 0.0
    for n in range(2, len(record.t_s)):
        # 3. Integration: P <- F P F^T + Q
        link = transition(record, n - 1, states, values, prior)
        F = np.eye(STATE + size)
        F[:STATE] = np.hstack([link.by_state[0], link.by_parameter[0]])
        covariance = F @ covariance @ F.T
        covariance[:STATE, :STATE] += link.noise[0]
        # 4. Correction, with P H^T in `seen`
        off = measured_minus(record.lab_from_body[n], link.after.rotation, values[BIAS])[0]
        seen = covariance[:3] + covariance[AT_BIAS]
        innovation = seen[:, :3] + seen[:, AT_BIAS] + record.covariance_rad2[n]
        gain = np.linalg.solve(innovation, seen).T
        chi2 += float(off @ np.linalg.solve(innovation, off))
        change = gain @ off
        covariance = joseph(covariance, gain, record.covariance_rad2[n])
        states = link.after.moved(change[:STATE, None])
        values = values + change[STATE:]
        yield MassEstimate(values, covariance[STATE:, STATE:], chi2 / (3 * (n - 1)))


def first_covariance(begun: MassEstimate, record: BearingRecord, prior: Prior) -> Floats:
    """Return the (9 + P, 9 + P) covariance of state and parameters at the second attitude.

    The momentum H = R (J w + A (1 + e) h) has the errors of the rate and of the parameters, so it is correlated with
    the parameters. Its derivative by them is a difference quotient over one standard deviation.
    """
    values = begun.values
    P = begun.covariance
    # Derivative of the momentum by the parameters
    one = cut(record, slice(0, MIN_ATTITUDES))
    step = begun.sigma
    changed = (values, *(values + np.diag(step)))
    momenta = [first_states(one, prior, each).momentum[:, 1] for each in changed]
    slope = np.zeros((STATE, len(values)))
    difference = np.array(momenta[1:]) - momenta[0]
    slope[3:6] = difference.T / step
    # Errors that are independent of the parameters: attitude, rate and torque
    own = np.zeros((STATE, STATE))
    own[:3, :3] = record.covariance_rad2[1]
    R_inertia = record.lab_from_body[1].as_matrix() @ begun.inertia_kg_m2
    own[3:6, 3:6] = RATE_SIGMA_RAD_S**2 * R_inertia @ R_inertia.T
    own[6:, 6:] = np.diag(prior.lab.torque_rms_nm**2)
    return np.block([[own + slope @ P @ slope.T, slope @ P], [P @ slope.T, P]])


def joseph(covariance: Floats, gain: Floats, noise: Floats) -> Floats:
    """Return the covariance after an attitude, (I - K H) P (I - K H)^T + K S K^T, which stays positive."""
    kept = np.eye(len(covariance))
    kept[:, :3] -= gain
    kept[:, AT_BIAS] -= gain
    return kept @ covariance @ kept.T + gain @ noise @ gain.T
