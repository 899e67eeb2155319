"""Mass properties from whole records: the most probable motion and parameters (multiple shooting).

A rate found by differencing attitudes has errors that bias a regression on it. Here the motion itself is fitted: the
unknowns are the states at every attitude (`dynamics.States`) and the parameters, and the residuals are

    attitudes measured minus fitted,                         weighted by the tracker's covariance,
    states integrated from the last attitude minus fitted,   weighted by the covariance of the random torque,
    parameters assumed minus fitted,                         weighted by the prior.

Their weighted sum of squares is minimized by the Gauss-Newton method, which for a motion with random forces is the
iterated Kalman smoother (Bell, SIAM J. Optimization 4, 1994, 626; Bock's multiple shooting, 1983). The states of a
record form a banded matrix and are eliminated, so that records of different trim add their information on the
parameters, whose covariance is the inverse of the sum.

Errors that attitudes share, of a map of LEDs or a lens, are not fitted, but considered (Schmidt 1966): the weights are
those of the noise alone, and the covariance of the parameters has what the shared errors add to it (`considered`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, solveh_banded
from scipy.spatial.transform import Rotation

from estimator.calibration.mass_properties.dynamics import (
    STATE,
    Motion,
    States,
    inverse_inertia,
    momentum_scale,
    transition,
    turn,
)
from estimator.calibration.mass_properties.record import (
    BIAS,
    BearingRecord,
    Lab,
    MassEstimate,
    Prior,
    inertia_matrix,
)
from estimator.core.arrays import Floats
from estimator.core.errors import ImageError
from estimator.filter.models import TrackerModel

MAX_ITERATIONS = 30
CONVERGED_SIGMA = 0.01  # largest step of a parameter, in its standard deviations
# of the logarithm of the misfit; fits to reach it
MISFIT_TOLERANCE = 0.1
MAX_FACTORS = 8
# above 1: the random torque's share of the misfit stays
FACTOR_POWER = 1.5
FACTOR_LIMITS = (1e-3, 1e3)
MOMENTUM = slice(3, 6)  # of a state
BANDS = 2 * STATE  # of the normal matrix: a state and its neighbor


class Reduced(NamedTuple):
    """A record's normal equations on the parameters after its states are eliminated.

    normal (P, P), gradient (P,) : of the parameters;  states_step (9 N,), states_by_parameter (9 N, P) : the states'
    step is the first minus the second times the parameters' step;  chi2 : of the residuals before the step
    """

    normal: Floats
    gradient: Floats
    states_step: Floats
    states_by_parameter: Floats
    chi2: float


def estimate_mass(records: Sequence[BearingRecord], lab: Lab, prior: Prior) -> MassEstimate:
    """The mass properties from one or several records. Raises ImageError if the fit does not converge."""
    values = prior.values.copy()
    motions = [first_states(record, lab, values) for record in records]
    information = np.diag(prior.sigma**-2)
    attitudes = sum(len(record.t_s) for record in records)
    for iteration in range(1, MAX_ITERATIONS + 1):
        parts = [reduced(*one, lab, values, prior) for one in zip(records, motions, strict=True)]
        normal = information + sum(part.normal for part in parts)
        gradient = information @ (prior.values - values) + sum(part.gradient for part in parts)
        covariance: Floats = np.asarray(np.linalg.inv(normal))
        step = covariance @ gradient
        motions = [
            states.moved((part.states_step - part.states_by_parameter @ step).reshape(-1, STATE).T)
            for states, part in zip(motions, parts, strict=True)
        ]
        values = values + step
        if np.all(np.abs(step) < CONVERGED_SIGMA * np.sqrt(np.diag(covariance))):
            covariance = covariance + considered(records, parts, covariance)
            chi2 = sum(part.chi2 for part in parts) + np.sum(
                ((prior.values - values) / prior.sigma) ** 2
            )
            return MassEstimate(
                values, covariance, float(chi2 / (3 * attitudes - 6 * len(records))), iteration
            )
        if not np.all(np.isfinite(values)):
            break
    raise ImageError(
        "mass properties: the fit does not converge; allowed: a motion that the assumed values describe"
    )


def estimate_with_noise(records: Sequence[BearingRecord], lab: Lab, prior: Prior) -> MassEstimate:
    """The mass properties, with the attitudes' noise scaled by a factor at which the misfit is 1.

    A tracker's own covariance is too small where an error is unknown to it, and too large where it is cautious. The
    level of the random torque is taken as known. Raises ImageError as `estimate_mass`.
    """
    factor = 1.0
    for _ in range(MAX_FACTORS):
        estimate = estimate_mass([one.with_noise(factor) for one in records], lab, prior)
        if abs(np.log(estimate.misfit)) < MISFIT_TOLERANCE:
            break
        factor = float(np.clip(factor * estimate.misfit**FACTOR_POWER, *FACTOR_LIMITS))
    return replace(estimate, attitude_factor=factor)


def considered(
    records: Sequence[BearingRecord], parts: Sequence[Reduced], covariance: Floats
) -> Floats:
    """(P, P) what errors that attitudes share add to the covariance of the parameters.

    An attitude's error e_n changes the parameters by K_n e_n = C (B - X_n)^T W_n e_n: C their covariance by the noise,
    W_n the weight, B the derivatives of a measured attitude by the parameters (those of the bias) and X_n those of the
    fitted one. Errors of covariance S_n = L_n L_n^T whose correlation r falls with the rotation between two attitudes
    add sum K_m L_m r_mn L_n^T K_n^T. The process is that of `filter.models.TrackerModel`, without its time.
    """
    size = len(covariance)
    effects = []
    attitudes = []
    by_bias = np.zeros((3, size))
    by_bias[:, BIAS] = np.eye(3)
    for record, part in zip(records, parts, strict=True):
        if record.systematic_rad2 is None:
            continue
        fitted = part.states_by_parameter.reshape(-1, STATE, size)[:, :3]
        gain = covariance @ (by_bias - fitted).transpose(0, 2, 1) @ np.linalg.inv(record.noise_rad2)
        values, axes = np.linalg.eigh(record.systematic_rad2)
        effects.append(
            gain @ (axes * np.sqrt(np.maximum(values, 0))[:, None]) @ axes.transpose(0, 2, 1)
        )
        attitudes.append(record.lab_from_body)
    if not effects:
        return np.zeros((size, size))
    effect = np.concatenate(effects)
    quaternion = Rotation.concatenate(attitudes).as_quat()
    angle_rad = 2 * np.arccos(np.minimum(np.abs(quaternion @ quaternion.T), 1))
    shared = np.exp(-angle_rad / TrackerModel().systematic_angle_rad)
    return np.asarray(np.einsum("mpk,mn,nqk->pq", effect, shared, effect, optimize=True))


def first_states(record: BearingRecord, lab: Lab, values: Floats) -> States:
    """States to begin with: the measured attitudes, the momentum of their differences, no random torque."""
    motion = Motion(record, lab, values[:, None], values)
    turned = (record.lab_from_body[:-1].inv() * record.lab_from_body[1:]).as_rotvec() / np.diff(
        record.t_s
    )[:, None]
    middle_s = (record.t_s[1:] + record.t_s[:-1]) / 2
    rate = np.array([np.interp(record.t_s, middle_s, one) for one in turned.T])
    inertia = inertia_matrix(values[:6]) + record.added_inertia_kg_m2
    quaternion = record.lab_from_body.as_quat().T
    own = inertia @ rate + motion.stored(record.t_s)
    return States(quaternion, turn(quaternion, own), np.zeros_like(rate))


def reduced(
    record: BearingRecord, states: States, lab: Lab, values: Floats, prior: Prior
) -> Reduced:
    """Linearize a record's residuals and eliminate its states."""
    count = len(record.t_s)
    size = len(values)
    rows = whitened_links(record, states, lab, values, prior)
    products = rows.transpose(0, 2, 1) @ rows
    before = slice(0, STATE)
    after = slice(STATE, 2 * STATE)
    rest = slice(2 * STATE, None)
    diagonal = np.zeros((count, STATE, STATE))
    border = np.zeros((count, STATE, size + 1))
    for block, to in ((before, slice(None, -1)), (after, slice(1, None))):
        diagonal[to] += products[:, block, block]
        border[to] += products[:, block, rest]
    corner = products[:, rest, rest].sum(axis=0)
    chi2 = float(np.sum(rows[:, :, -1] ** 2)) + add_measured(
        record, states, lab, values, (diagonal, border, corner)
    )
    flat = border.reshape(-1, size + 1)
    try:
        solved = solveh_banded(lower_band(diagonal, products[:, before, after]), flat, lower=True)
    except LinAlgError as error:
        raise ImageError(f"mass properties: {error}") from error
    corner -= flat.T @ solved
    return Reduced(corner[:-1, :-1], -corner[:-1, -1], -solved[:, -1], solved[:, :-1], chi2)


def whitened_links(
    record: BearingRecord, states: States, lab: Lab, values: Floats, prior: Prior
) -> Floats:
    """(N - 1, 9, 18 + P + 1) slopes of the transitions' residuals by state before, state after and parameters, and the
    residuals, in standard deviations.

    Residuals of momentum m are those of the assumed inertia, R J0 J^-1 R^T m, whose noise does not depend on J; their
    slopes by the elements of J are those of m and -R J0 J^-1 (dJ) J^-1 R^T m.
    """
    before = states.take(slice(None, -1))
    link = transition(record, lab, 0, before, values, prior)
    misfit = link.after.minus(states.take(slice(1, None))).T[:, :, None]
    by_after = np.broadcast_to(-np.eye(STATE), link.by_state.shape)
    rows = np.concatenate([link.by_state, by_after, link.by_parameter, misfit], axis=2)
    scale = np.tile(np.eye(STATE), (len(misfit), 1, 1))
    scale[:, MOMENTUM, MOMENTUM] = momentum_scale(record, before, values, prior.values)
    R_lab_from_body = before.rotation.as_matrix()
    in_body = R_lab_from_body.transpose(0, 2, 1) @ misfit[:, MOMENTUM]
    turned = np.einsum(
        "ijp,kjl->kip", inertia_matrix(np.eye(6)), inverse_inertia(record, values) @ in_body
    )
    rows[:, MOMENTUM, 2 * STATE : 2 * STATE + 6] -= R_lab_from_body @ turned
    noise = scale @ link.noise @ scale.transpose(0, 2, 1)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(noise)) @ scale @ rows)


def add_measured(
    record: BearingRecord,
    states: States,
    lab: Lab,
    values: Floats,
    to: tuple[Floats, Floats, Floats],
) -> float:
    """Add the attitudes (N), and what is known of the first random torque; return their chi-square.

    A measured attitude is R exp(bias) exp(noise). `to` are the blocks that are added to: diagonal (N, 9, 9), border
    (N, 9, P + 1) and corner (P + 1, P + 1); the last column is the gradient.
    """
    diagonal, border, corner = to
    weight = np.linalg.inv(record.noise_rad2)
    torque_weight = lab.torque_rms_nm**-2.0
    off = measured_minus(record.lab_from_body, states.rotation, values[BIAS])
    pull = np.einsum("nij,nj->ni", weight, off)
    diagonal[:, :3, :3] += weight
    border[:, :3, BIAS] += weight
    border[:, :3, -1] -= pull
    corner[BIAS, BIAS] += weight.sum(axis=0)
    corner[BIAS, -1] -= pull.sum(axis=0)
    corner[-1, BIAS] -= pull.sum(axis=0)
    diagonal[0, 6:, 6:] += np.diag(torque_weight)
    border[0, 6:, -1] += torque_weight * states.torque[:, 0]
    return float(np.sum(off * pull) + torque_weight @ states.torque[:, 0] ** 2)


def measured_minus(measured: Rotation, lab_from_body: Rotation, bias_rad: Floats) -> Floats:
    """(N, 3) rotation vectors of attitudes measured minus those of the states with the tracker's bias."""
    return np.asarray(
        ((lab_from_body * Rotation.from_rotvec(bias_rad)).inv() * measured).as_rotvec()
    )


def lower_band(diagonal: Floats, beside: Floats) -> Floats:
    """(18, 9 N) lower band of a normal matrix from its diagonal blocks (N, 9, 9) and those right of them."""
    band = np.zeros((BANDS, STATE * len(diagonal)))
    for i in range(STATE):
        for j in range(STATE):
            if i >= j:
                band[i - j, j::STATE] = diagonal[:, i, j]
            band[STATE + i - j, j:-STATE:STATE] = beside[:, j, i]
    return band
