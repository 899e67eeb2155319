"""Compiled propagation of the filter: gyro samples advance attitude, bias and covariance between two solutions."""

from __future__ import annotations

import math

import numpy as np

from estimator.core.arrays import Floats
from estimator.core.jit import jit


@jit
def advance(
    moment: tuple[float, Floats, Floats, Floats, float],
    samples: Floats,
    noise: tuple[float, float, float],
) -> tuple[Floats, Floats, Floats, float]:
    """Return attitude, bias, covariance and missed angle after the samples; the equations are in Mekf's docstring.

    moment  : t_s, ref_from_body_wxyz, bias_rad_s, covariance, missed_rad
    samples : (N, 5) rows of t_s, the rotation in the interval that ends there (3), and whether the gyro was saturated
    noise   : arw^2, bias^2, 1 / bias_time
    """
    t_s, wxyz, bias, covariance, missed_rad = moment
    arw2, bias2, forget_per_s = noise
    wxyz, bias, covariance = wxyz.copy(), bias.copy(), covariance.copy()
    turn, matrix, passed = np.empty(3), np.zeros((6, 6)), np.empty((6, 6))
    for n in range(len(samples)):
        step_s = samples[n, 0] - t_s
        t_s = samples[n, 0]
        acting_s = step_s * (
            1 - step_s * forget_per_s / 2
        )  # integral of the decaying bias over the interval, divided by the bias
        decay = math.exp(-step_s * forget_per_s)
        for i in range(3):
            turn[i] = samples[n, 1 + i] - acting_s * bias[i]
            bias[i] *= decay
            matrix[i + 3, i + 3] = decay
        turn_on(wxyz, turn)
        transition(turn, acting_s, matrix)
        congruent(matrix, covariance, passed)
        # Process noise: `walk` is the variance gained by the bias in the interval, u^2 T to first order.
        walk = -bias2 * math.expm1(-2 * step_s * forget_per_s)
        grown = arw2 * step_s + walk * step_s**2 / 3
        # In saturation the attitude's standard deviation grows linearly: the variance grows by a difference of squares.
        before = missed_rad
        missed_rad = 0.0
        if samples[n, 4]:
            missed_rad = before + max(abs(samples[n, 1]), abs(samples[n, 2]), abs(samples[n, 3]))
            grown += missed_rad**2 - before**2
        for i in range(3):
            covariance[i, i] += grown
            covariance[i, i + 3] -= walk * step_s / 2
            covariance[i + 3, i] -= walk * step_s / 2
            covariance[i + 3, i + 3] += walk
    return wxyz, bias, covariance, missed_rad


@jit
def congruent(matrix: Floats, covariance: Floats, passed: Floats) -> None:
    """covariance <- matrix covariance matrix^T, exactly symmetric; `passed` is a buffer for the first product."""
    size = len(matrix)
    for i in range(size):
        for j in range(size):
            passed[i, j] = 0.0
            for k in range(size):
                passed[i, j] += matrix[i, k] * covariance[k, j]
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += passed[i, k] * matrix[j, k]
            covariance[i, j] = covariance[j, i] = total


@jit
def transition(p: Floats, acting_s: float, out: Floats) -> None:
    """Fill the attitude rows of the transition matrix: out[:3] = [exp(-[p]), -acting_s J(p)], with [p] v = p x v."""
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
            crossed = 0.0 if i == j else p[3 - i - j] * (1.0 if (j - i) % 3 == 2 else -1.0)
            one = 1.0 if i == j else 0.0
            twice = p[i] * p[j] - square * one
            out[i, j] = one - sine * crossed + cosine * twice
            out[i, j + 3] = -acting_s * (one - cosine * crossed + cubic * twice)


@jit
def turn_on(ref_from_body_wxyz: Floats, turn_rad: Floats) -> None:
    """Multiply the unit quaternion by that of a rotation vector in body axes (Hamilton product), in place."""
    q, (x, y, z) = ref_from_body_wxyz, turn_rad
    half = math.sqrt(x * x + y * y + z * z) / 2
    scale = math.sin(half) / (2 * half) if half > 1e-9 else 0.5
    w, x, y, z = math.cos(half), scale * x, scale * y, scale * z
    a, b, c, d = q
    q[0], q[1] = a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y
    q[2], q[3] = a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w
    q /= math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
