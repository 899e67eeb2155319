"""Compiled propagation of the filter: gyro samples advance attitude, bias and covariance between two solutions.

Each gyro sample is a rotation vector. The quaternion is multiplied by its exponential, the bias subtracted; the
covariance is multiplied by the discrete transition of the error state, with the right Jacobian of the rotation, and
Farrenkopf's process noise is added. While the gyro is saturated the attitude's covariance grows as the square of the
time, by the measured rate.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.core.arrays import Floats
from estimator.core.jit import jit


@jit
def advance(
    state: tuple[float, Floats, Floats, Floats, float],
    samples: Floats,
    noise: tuple[float, float, float],
) -> tuple[Floats, Floats, Floats, float]:
    """Return attitude, bias, covariance and saturation_rad after the samples; equations: see AttitudeFilter.

    state   : t_s, ref_from_body_wxyz, bias_rad_s, covariance, saturation_rad
    samples : (N, 5) rows of t_s, the rotation in the interval that ends there (3), and whether the gyro was saturated
    noise   : arw^2, bias^2, 1 / bias_time
    """
    t_s, wxyz, bias, covariance, saturation_rad = state
    arw2, bias2, decay_per_s = noise
    wxyz, bias, covariance = wxyz.copy(), bias.copy(), covariance.copy()
    rotation, matrix, buffer = np.empty(3), np.zeros((6, 6)), np.empty((6, 6))
    for n in range(len(samples)):
        step_s = samples[n, 0] - t_s
        t_s = samples[n, 0]
        # Integral of the decaying bias over the interval, divided by the bias.
        effective_s = step_s * (1 - step_s * decay_per_s / 2)
        decay = math.exp(-step_s * decay_per_s)
        for i in range(3):
            rotation[i] = samples[n, 1 + i] - effective_s * bias[i]
            bias[i] *= decay
            matrix[i + 3, i + 3] = decay
        rotate_quaternion(wxyz, rotation)
        transition(rotation, effective_s, matrix)
        propagate_covariance(matrix, covariance, buffer)
        # Process noise: `bias_variance` is the variance gained by the bias in the interval, u^2 T to first order.
        bias_variance = -bias2 * math.expm1(-2 * step_s * decay_per_s)
        angle_variance = arw2 * step_s + bias_variance * step_s**2 / 3
        # In saturation the attitude's standard deviation grows linearly: the variance grows by a difference of squares.
        previous_rad = saturation_rad
        saturation_rad = 0.0
        if samples[n, 4]:
            saturation_rad = previous_rad + max(abs(samples[n, 1]), abs(samples[n, 2]), abs(samples[n, 3]))
            angle_variance += saturation_rad**2 - previous_rad**2
        for i in range(3):
            covariance[i, i] += angle_variance
            covariance[i, i + 3] -= bias_variance * step_s / 2
            covariance[i + 3, i] -= bias_variance * step_s / 2
            covariance[i + 3, i + 3] += bias_variance
    return wxyz, bias, covariance, saturation_rad


@jit
def propagate_covariance(matrix: Floats, covariance: Floats, buffer: Floats) -> None:
    """covariance <- matrix covariance matrix^T, exactly symmetric; `buffer` holds the first product."""
    size = len(matrix)
    for i in range(size):
        for j in range(size):
            buffer[i, j] = 0.0
            for k in range(size):
                buffer[i, j] += matrix[i, k] * covariance[k, j]
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += buffer[i, k] * matrix[j, k]
            covariance[i, j] = covariance[j, i] = total


@jit
def transition(p: Floats, effective_s: float, out: Floats) -> None:
    """Fill the attitude rows of the transition matrix: out[:3] = [exp(-[p]), -effective_s J(p)], with [p] v = p x v."""
    square = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    if square < 1e-6:  # series, whose error in `out` is below 1e-16; the quotients would lose digits
        sine, cosine, cubic = 1 - square / 6, 0.5 - square / 24, 1 / 6 - square / 120
    else:
        angle = math.sqrt(square)
        sine, cosine = math.sin(angle) / angle, (1 - math.cos(angle)) / square
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
    q, (x, y, z) = ref_from_body_wxyz, rotation_rad
    half = math.sqrt(x * x + y * y + z * z) / 2
    scale = math.sin(half) / (2 * half) if half > 1e-9 else 0.5
    w, x, y, z = math.cos(half), scale * x, scale * y, scale * z
    a, b, c, d = q
    q[0], q[1] = a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y
    q[2], q[3] = a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w
    q /= math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
