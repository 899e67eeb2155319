"""3-vectors and small rotations for compiled code, without allocating arrays."""

from __future__ import annotations

from math import sqrt

import numpy as np

from estimator.core.checks import Floats
from estimator.core.jit import jit

Vector = tuple[float, float, float]


@jit
def row(array: Floats, n: int) -> Vector:
    """Return row n of an (N, 3) array as a tuple."""
    return array[n, 0], array[n, 1], array[n, 2]


@jit
def chord(u: Vector, v: Vector) -> float:
    """Return the chord |u - v| of two unit vectors: 2 sin(angle / 2), never larger than the angle."""
    return sqrt((u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2)


@jit
def rotate(matrix: Floats, u: Vector) -> Vector:
    """Multiply a (3, 3) matrix by a vector."""
    return (
        matrix[0, 0] * u[0] + matrix[0, 1] * u[1] + matrix[0, 2] * u[2],
        matrix[1, 0] * u[0] + matrix[1, 1] * u[1] + matrix[1, 2] * u[2],
        matrix[2, 0] * u[0] + matrix[2, 1] * u[1] + matrix[2, 2] * u[2],
    )


@jit
def pair_frame(u: Vector, v: Vector, out: Floats) -> None:
    """Write right-handed axes to the columns of out (3, 3): bisector of two unit vectors, their normal, third axis."""
    # u + v and u x v, then normalized
    out[0, 0] = u[0] + v[0]
    out[1, 0] = u[1] + v[1]
    out[2, 0] = u[2] + v[2]
    out[0, 1] = u[1] * v[2] - u[2] * v[1]
    out[1, 1] = u[2] * v[0] - u[0] * v[2]
    out[2, 1] = u[0] * v[1] - u[1] * v[0]
    for c in range(2):
        inverse = 1 / sqrt(out[0, c] ** 2 + out[1, c] ** 2 + out[2, c] ** 2)
        for k in range(3):
            out[k, c] *= inverse
    # The cross product of the first two
    out[0, 2] = out[1, 0] * out[2, 1] - out[2, 0] * out[1, 1]
    out[1, 2] = out[2, 0] * out[0, 1] - out[0, 0] * out[2, 1]
    out[2, 2] = out[0, 0] * out[1, 1] - out[1, 0] * out[0, 1]


@jit
def multiply_transposed(a: Floats, b: Floats, out: Floats) -> None:
    """Compute out = a b^T for (3, 3) matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]


@jit
def rotate_in_place(w: Floats, matrix: Floats) -> None:
    """Left-multiply a rotation matrix by exp([w]) in place, to second order, then orthonormalize it.

    1. Multiply each column v: v <- v + w x v + w x (w x v) / 2, whose error is of order |w|^3.
    2. Orthonormalize the rows (Gram-Schmidt), which removes the remaining loss of orthogonality.
    """
    # 1. Second-order rotation
    for c in range(3):
        x = matrix[0, c]
        y = matrix[1, c]
        z = matrix[2, c]
        cx = w[1] * z - w[2] * y
        cy = w[2] * x - w[0] * z
        cz = w[0] * y - w[1] * x
        matrix[0, c] = x + cx + (w[1] * cz - w[2] * cy) / 2
        matrix[1, c] = y + cy + (w[2] * cx - w[0] * cz) / 2
        matrix[2, c] = z + cz + (w[0] * cy - w[1] * cx) / 2
    # 2. First row: unit length
    u = row(matrix, 0)
    inverse = 1 / sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2)
    for c in range(3):
        matrix[0, c] *= inverse
    # Second row: without its part along the first one, unit length
    projection = (
        matrix[0, 0] * matrix[1, 0] + matrix[0, 1] * matrix[1, 1] + matrix[0, 2] * matrix[1, 2]
    )
    for c in range(3):
        matrix[1, c] -= projection * matrix[0, c]
    inverse = 1 / sqrt(matrix[1, 0] ** 2 + matrix[1, 1] ** 2 + matrix[1, 2] ** 2)
    for c in range(3):
        matrix[1, c] *= inverse
    # Third row: the cross product
    for c in range(3):
        n = (c + 1) % 3
        m = (c + 2) % 3
        matrix[2, c] = matrix[0, n] * matrix[1, m] - matrix[0, m] * matrix[1, n]


@jit
def quaternion_xyzw(R: Floats) -> Floats:
    """Return the (4,) quaternion (x, y, z, w) of a rotation matrix (Shepperd 1978, J. Guidance 1, 223).

    The diagonal shows which component is largest. Solving for that one first, 4 q_i q_j of all j, avoids a division by
    a small number; the result is normalized.
    """
    # Largest diagonal element, against the trace
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    q = np.empty(4)
    i = 0 if R[0, 0] >= R[1, 1] else 1
    i = i if R[i, i] >= R[2, 2] else 2
    if trace >= R[i, i]:
        q[3] = 1 + trace
        q[0] = R[2, 1] - R[1, 2]
        q[1] = R[0, 2] - R[2, 0]
        q[2] = R[1, 0] - R[0, 1]
    else:
        j = (i + 1) % 3
        k = (i + 2) % 3
        q[i] = 1 + 2 * R[i, i] - trace
        q[j] = R[j, i] + R[i, j]
        q[k] = R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    return q / sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
