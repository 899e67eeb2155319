"""Compiled propagation of the filter: gyro samples advance attitude, other states and covariance between solutions.

Each gyro sample is a rotation vector. Less its bias, its exponential multiplies the quaternion; the
covariance is multiplied by the discrete transition of the error state, with the right Jacobian of the rotation, and the
process noise is added. While the gyro is saturated the attitude's covariance grows as the square of the time, by the
measured rate.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.core.checks import (Floats, Ints)
from estimator.core.jit import jit

# The last column of a sample.
MEASURED = 0
SATURATED = 1
MISSING = 2


@jit
def advance(
    state: tuple[float, Floats, Floats, Floats, float, float],
    samples: Floats,
    noise: tuple[float, float, float, float, float],
    columns: Ints,
    inverse: Floats,
    slow: tuple[int, int],
) -> tuple[Floats, Floats, Floats, float, float]:
    """Return attitude, values, covariance, saturation_rad and lost_rad after the samples; equations: AttitudeFilter.

    state   : t_s, ref_from_body_wxyz, values (N,), covariance (N, N), saturation_rad, lost_rad
    samples : (M, 5) rows of t_s, the rotation in the interval that ends there (3), and MEASURED, SATURATED or MISSING
    noise   : arw^2, bias^2, 1 / bias_time, 1 / systematic_time, outage_rad_s
    columns : (9,) state of each element of the gyro's matrix M, row by row; -1 if it is none
    inverse : (3, 3) `inverse_response` of the values, of which no element of M changes here
    slow    : first and last + 1 of the normalized systematic states
    """
    t_s, wxyz, values, covariance, saturation_rad, lost_rad = state
    arw2, bias2, decay_per_s, slow_per_s, outage_rad_s = noise
    wxyz = wxyz.copy()
    values = values.copy()
    covariance = covariance.copy()
    size = len(values)
    rotation = np.empty(3)
    rows = np.zeros((3, size))
    buffer = np.empty((3, size))
    exponential = np.empty((3, 6))
    decay = np.ones(size)
    for n in range(len(samples)):
        step_s = samples[n, 0] - t_s
        t_s = samples[n, 0]
        # Integral of the decaying bias over the interval, divided by the bias.
        effective_s = step_s * (1 - step_s * decay_per_s / 2)
        remove_errors(samples[n, 1:4], effective_s, values, inverse, rotation)
        rotate_quaternion(wxyz, rotation)
        transition(rotation, 1.0, exponential)
        fill_rows(exponential, inverse, rotation, effective_s, columns, rows)
        decay[3:6] = math.exp(-step_s * decay_per_s)
        decay[slow[0] : slow[1]] = math.exp(-step_s * slow_per_s)
        for i in range(3, size):
            values[i] *= decay[i]
        propagate_covariance(rows, decay, covariance, buffer)
        # While the rate is unknown the standard deviation grows linearly: the variance by a difference of squares.
        previous_rad = saturation_rad
        grown_rad = unknown_rad(samples[n], outage_rad_s * step_s)
        saturation_rad = previous_rad + grown_rad if grown_rad > 0 else 0.0
        lost_rad += grown_rad
        # The variance gained by the bias in the interval, u^2 T to first order.
        bias_variance = -bias2 * math.expm1(-2 * step_s * decay_per_s)
        missed_variance = saturation_rad**2 - min(previous_rad, saturation_rad) ** 2
        add_noise(covariance, arw2 * step_s + missed_variance, bias_variance, step_s)
        for i in range(slow[0], slow[1]):
            covariance[i, i] -= math.expm1(-2 * step_s * slow_per_s)
    return wxyz, values, covariance, saturation_rad, lost_rad


@jit
def remove_errors(
    angle: Floats, effective_s: float, values: Floats, inverse: Floats, out: Floats
) -> None:
    """Fill the rotation (3,) A (a - T b) of a measured angle a."""
    for i in range(3):
        out[i] = 0.0
        for j in range(3):
            out[i] += inverse[i, j] * (angle[j] - effective_s * values[3 + j])


@jit
def unknown_rad(sample: Floats, outage_rad: float) -> float:
    """Standard deviation of the rotation that a sample leaves unknown: 0, or while saturated as much as is measured."""
    if sample[4] == MISSING:
        return outage_rad
    return max(abs(sample[1]), abs(sample[2]), abs(sample[3])) if sample[4] == SATURATED else 0.0


@jit
def add_noise(
    covariance: Floats, angle_variance: float, bias_variance: float, step_s: float
) -> None:
    """Add Farrenkopf's process noise of an interval to attitude and bias; `angle_variance` without the bias's part."""
    for i in range(3):
        covariance[i, i] += angle_variance + bias_variance * step_s**2 / 3
        covariance[i, i + 3] -= bias_variance * step_s / 2
        covariance[i + 3, i] -= bias_variance * step_s / 2
        covariance[i + 3, i + 3] += bias_variance


def inverse_response(values: Floats, columns: Ints) -> Floats:
    """(3, 3) inverse of I + M, with the elements of M among the values."""
    used = columns >= 0
    if not used.any():
        return np.eye(3)
    response = np.eye(3).ravel()
    response[used] += values[columns[used]]
    return np.asarray(np.linalg.inv(response.reshape(3, 3)), dtype=float)


@jit
def fill_rows(
    exponential: Floats, inverse: Floats, p: Floats, effective_s: float, columns: Ints, rows: Floats
) -> None:
    """Fill the attitude rows (3, N) of the transition matrix: exp(-[p]), -T J A, and -(J A)_i p_j for M_ij.

    exponential : (3, 6) of `transition` with an effective time of 1;  inverse : A = (I + M)^-1
    """
    for i in range(3):
        for j in range(3):
            rows[i, j] = exponential[i, j]
            total = 0.0
            for k in range(3):
                total += exponential[i, 3 + k] * inverse[k, j]
            rows[i, 3 + j] = effective_s * total
            for k in range(3):
                if columns[3 * j + k] >= 0:
                    rows[i, columns[3 * j + k]] = total * p[k]


@jit
def propagate_covariance(rows: Floats, decay: Floats, covariance: Floats, buffer: Floats) -> None:
    """covariance <- F covariance F^T, exactly symmetric; F has these three rows, and below them `decay` as diagonal."""
    size = len(decay)
    for i in range(3):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += rows[i, k] * covariance[k, j]
            buffer[i, j] = total
    for i in range(3):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += buffer[i, k] * rows[j, k]
            covariance[i, j] = covariance[j, i] = total
        for j in range(3, size):
            covariance[i, j] = covariance[j, i] = buffer[i, j] * decay[j]
    for i in range(3, size):
        for j in range(3, i + 1):
            covariance[i, j] = covariance[j, i] = covariance[i, j] * decay[i] * decay[j]


@jit
def transition(p: Floats, effective_s: float, out: Floats) -> None:
    """Fill the attitude rows of the transition matrix: out[:3] = [exp(-[p]), -effective_s J(p)], with [p] v = p x v."""
    square = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    if (
        square < 1e-6
    ):  # series, whose error in `out` is below 1e-16; the quotients would lose digits
        sine = 1 - square / 6
        cosine = 0.5 - square / 24
        cubic = 1 / 6 - square / 120
    else:
        angle = math.sqrt(square)
        sine = math.sin(angle) / angle
        cosine = (1 - math.cos(angle)) / square
        cubic = (1 - sine) / square
    for i in range(3):
        for j in range(3):
            # Element (i, j) of [p] is the third axis' component with the sign of the permutation; [p]^2 = p p^T -
            # |p|^2 I.
            cross = 0.0 if i == j else p[3 - i - j] * (1.0 if (j - i) % 3 == 2 else -1.0)
            identity = 1.0 if i == j else 0.0
            cross_squared = p[i] * p[j] - square * identity
            out[i, j] = identity - sine * cross + cosine * cross_squared
            out[i, j + 3] = -effective_s * (identity - cosine * cross + cubic * cross_squared)


@jit
def rotate_quaternion(ref_from_body_wxyz: Floats, rotation_rad: Floats) -> None:
    """Multiply the unit quaternion by that of a rotation vector in body axes (Hamilton product), in place."""
    q = ref_from_body_wxyz
    (x, y, z) = rotation_rad
    half = math.sqrt(x * x + y * y + z * z) / 2
    scale = math.sin(half) / (2 * half) if half > 1e-9 else 0.5
    w = math.cos(half)
    x = scale * x
    y = scale * y
    z = scale * z
    a, b, c, d = q
    q[0] = a * w - b * x - c * y - d * z
    q[1] = a * x + b * w + c * z - d * y
    q[2] = a * y - b * z + c * w + d * x
    q[3] = a * z + b * y - c * x + d * w
    norm = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] /= norm
