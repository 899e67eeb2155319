"""3-vectors and small rotations for compiled code, without allocating arrays."""

from math import sqrt

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.checks import Floats
from estimator.core.jit import jit

Vector = tuple[float, float, float]


def lengths(vectors: Floats) -> Floats:
    """Return (...) lengths of (..., K) vectors."""
    return np.linalg.norm(vectors, axis=-1)


def normalized(vectors: Floats) -> Floats:
    """Return (..., K) vectors, divided by their lengths."""
    return vectors / lengths(vectors)[..., None]


def rms(values: Floats) -> float:
    """Return the root mean square of all values."""
    return float(np.sqrt(np.mean(values**2)))


def rotation_of(xyzw: Floats) -> Rotation:
    """Return the rotation of a unit quaternion (4,): `Rotation.from_quat` without its checks, in a sixth of the time.

    It sets the state that a pickled Rotation has.
    """
    rotation = Rotation.__new__(Rotation)
    rotation.__setstate__((xyzw[None], True))
    return rotation


@jit
def row(array: Floats, n: int) -> Vector:
    """Return row n of an (N, 3) array as a tuple."""
    return array[n, 0], array[n, 1], array[n, 2]


@jit
def dot(u: Vector, v: Vector) -> float:
    """Return the scalar product u . v."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@jit
def cross(u: Vector, v: Vector) -> Vector:
    """Return the vector product u x v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@jit
def norm(u: Vector) -> float:
    """Return the length of a vector."""
    return sqrt(dot(u, u))


@jit
def squared_chord(u: Vector, v: Vector) -> float:
    """Return the squared length of u - v."""
    difference = (u[0] - v[0], u[1] - v[1], u[2] - v[2])
    return dot(difference, difference)


@jit
def chord(u: Vector, v: Vector) -> float:
    """Return the chord |u - v| of two unit vectors: 2 sin(angle / 2), never larger than the angle."""
    return sqrt(squared_chord(u, v))


@jit
def rotate(matrix: Floats, u: Vector) -> Vector:
    """Multiply a (3, 3) matrix by a vector."""
    return dot(row(matrix, 0), u), dot(row(matrix, 1), u), dot(row(matrix, 2), u)


@jit
def set_row(matrix: Floats, n: int, u: Vector) -> None:
    """Set row n of a matrix (N, 3); numba compiles `matrix[n] = u` for any shapes, in four times the time."""
    for k in range(3):
        matrix[n, k] = u[k]


@jit
def pair_frame(u: Vector, v: Vector, out: Floats) -> None:
    """Write right-handed axes to the columns of out (3, 3): bisector of two unit vectors, their normal, third axis."""
    bisector = _unit((u[0] + v[0], u[1] + v[1], u[2] + v[2]))
    normal = _unit(cross(u, v))
    third = cross(bisector, normal)
    for n in range(3):
        set_row(out, n, (bisector[n], normal[n], third[n]))


@jit
def _unit(u: Vector) -> Vector:
    """Return the unit vector in the direction of a vector."""
    inverse = 1 / norm(u)
    return u[0] * inverse, u[1] * inverse, u[2] * inverse


@jit
def multiply_transposed(a: Floats, b: Floats, out: Floats) -> None:
    """Compute out = a b^T for (3, 3) matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = dot(row(a, i), row(b, j))


@jit
def rotate_in_place(w: Floats, matrix: Floats) -> None:
    """Left-multiply a rotation matrix by exp([w]) in place, to second order, then orthonormalize it.

    1. Multiply each column v: v <- v + w x v + w x (w x v) / 2, whose error is of order |w|^3.
    2. Orthonormalize the rows (Gram-Schmidt), which removes the remaining loss of orthogonality.
    """
    # 1. Second-order rotation
    for c in range(3):
        v = (matrix[0, c], matrix[1, c], matrix[2, c])
        once = cross(w, v)
        twice = cross(w, once)
        for k in range(3):
            matrix[k, c] = v[k] + once[k] + twice[k] / 2
    # 2. First row: unit length. Second row: without its part along the first one. Third row: the cross product
    first = _unit(row(matrix, 0))
    x, y, z = row(matrix, 1)
    part = dot(first, (x, y, z))
    second = _unit((x - part * first[0], y - part * first[1], z - part * first[2]))
    third = cross(first, second)
    set_row(matrix, 0, first)
    set_row(matrix, 1, second)
    set_row(matrix, 2, third)


@jit
def quaternion_xyzw(R: Floats) -> Floats:
    """Return the (4,) quaternion (x, y, z, w) of a rotation matrix (Shepperd 1978, J. Guidance 1, 223).

    The diagonal shows which component is largest. Solving for that one first, 4 q_i q_j of all j, avoids a division by
    a small number; the result is normalized.
    """
    # Largest diagonal element, against the trace
    trace = np.trace(R)
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
    return q / sqrt(np.sum(q**2))
