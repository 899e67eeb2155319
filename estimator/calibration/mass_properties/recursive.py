"""Mass properties in flight: an extended Kalman filter of state and parameters, one attitude after another.

State and parameters are those of `batch`; the parameters are constant. Between attitudes the estimate is integrated
(`dynamics.transition`) and its covariance becomes F P F^T + Q; an attitude with the residual r and the covariance S
corrects it by K r, K = P H^T (H P H^T + S)^-1 (Gelb, Applied Optimal Estimation, 1974, ch. 6), where H selects the
attitude's error plus the tracker's bias. The filter linearizes once, at its estimate of the moment. It diverges from
assumptions that are far off, since the rate is the ratio of two unknowns, momentum and inertia; a batch over the first
attitudes begins it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from estimator.calibration.mass_properties.batch import estimate_mass, first_states, measured_minus
from estimator.calibration.mass_properties.dynamics import STATE, transition
from estimator.calibration.mass_properties.record import (
    BIAS,
    MIN_ATTITUDES,
    BearingRecord,
    Lab,
    MassEstimate,
    Prior,
)
from estimator.core.arrays import Floats
from estimator.core.errors import ImageError

START = 20  # attitudes for the batch that begins the filter
RATE_SIGMA_RAD_S = 0.01  # of the rate by the difference of the attitudes before and after


def filter_mass(record: BearingRecord, lab: Lab, prior: Prior) -> Iterator[MassEstimate]:
    """Yield the estimate after each attitude from number START + 2 on; its misfit is that of the innovations so far.

    The parameters begin with the batch estimate from the first START attitudes, the state with the next three alone.
    """
    least = START + MIN_ATTITUDES
    if len(record.t_s) < least:
        raise ImageError(
            f"mass properties: {len(record.t_s)} attitudes; allowed for a filter: {least} or more"
        )
    begun = estimate_mass([cut(record, slice(0, START))], lab, prior)
    rest = cut(record, slice(START, None))
    yield from filter_from(begun, rest, lab, prior)


def cut(record: BearingRecord, which: slice) -> BearingRecord:
    """Some of the attitudes."""
    return replace(
        record,
        t_s=record.t_s[which],
        lab_from_body=record.lab_from_body[which],
        covariance_rad2=record.covariance_rad2[which],
        systematic_rad2=None if record.systematic_rad2 is None else record.systematic_rad2[which],
    )


def filter_from(
    begun: MassEstimate, record: BearingRecord, lab: Lab, prior: Prior
) -> Iterator[MassEstimate]:
    """Yield the estimate after each attitude but the first two, from earlier parameters and their covariance."""
    size = len(begun.values)
    values = begun.values
    states = first_states(record, lab, values).take(slice(1, 2))
    covariance = first_covariance(begun, record, lab)
    at_bias = slice(STATE + BIAS.start, STATE + BIAS.stop)
    chi2 = 0.0
    for n in range(2, len(record.t_s)):
        link = transition(record, lab, n - 1, states, values, prior)
        F = np.eye(STATE + size)
        F[:STATE] = np.hstack([link.by_state[0], link.by_parameter[0]])
        covariance = F @ covariance @ F.T
        covariance[:STATE, :STATE] += link.noise[0]
        off = measured_minus(record.lab_from_body[n], link.after.rotation, values[BIAS])[0]
        seen = covariance[:3] + covariance[at_bias]
        innovation = seen[:, :3] + seen[:, at_bias] + record.covariance_rad2[n]
        gain = np.linalg.solve(innovation, seen).T
        chi2 += float(off @ np.linalg.solve(innovation, off))
        change = gain @ off
        covariance = joseph(covariance, gain, record.covariance_rad2[n])
        states = link.after.moved(change[:STATE, None])
        values = values + change[STATE:]
        yield MassEstimate(values, covariance[STATE:, STATE:], chi2 / (3 * (n - 1)))


def first_covariance(begun: MassEstimate, record: BearingRecord, lab: Lab) -> Floats:
    """(9 + P, 9 + P) at the second attitude. H = R (J w + A (1 + e) h): its errors are those of rate and parameters."""
    values = begun.values
    P = begun.covariance
    one = cut(record, slice(0, MIN_ATTITUDES))
    step = begun.sigma
    momenta = [
        first_states(one, lab, each).momentum[:, 1] for each in (values, *(values + np.diag(step)))
    ]
    slope = np.zeros((STATE, len(values)))
    slope[3:6] = ((np.array(momenta[1:]) - momenta[0]) / step[:, None]).T
    own = np.zeros((STATE, STATE))
    own[:3, :3] = record.covariance_rad2[1]
    R_inertia = record.lab_from_body[1].as_matrix() @ begun.inertia_kg_m2
    own[3:6, 3:6] = RATE_SIGMA_RAD_S**2 * R_inertia @ R_inertia.T
    own[6:, 6:] = np.diag(lab.torque_rms_nm**2)
    return np.block([[own + slope @ P @ slope.T, slope @ P], [P @ slope.T, P]])


def joseph(covariance: Floats, gain: Floats, noise: Floats) -> Floats:
    """The covariance after an attitude, (I - K H) P (I - K H)^T + K S K^T, which stays positive."""
    kept = np.eye(len(covariance))
    kept[:, :3] -= gain
    kept[:, STATE + BIAS.start : STATE + BIAS.stop] -= gain
    return np.asarray(kept @ covariance @ kept.T + gain @ noise @ gain.T)
