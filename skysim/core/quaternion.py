"""Single unit quaternions for the loops of every control period; arrays of rotations use SciPy's `Rotation`.

A quaternion is (4,) w, x, y, z (scalar first, Hamilton's product), named a_from_b like every rotation. SciPy takes
14-35 us to multiply or construct one, which would add up to a tenth of a control period of 10 ms.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.jit import jit

Floats = NDArray[np.float64]


def from_rotation(a_from_b: Rotation) -> Floats:
    """(..., 4) wxyz of one Rotation or of many. It reorders them itself, since SciPy's scalar_first takes 30 us."""
    return a_from_b.as_quat().take((3, 0, 1, 2), -1)


def to_rotation(a_from_b: Floats) -> Rotation:
    """One Rotation from (4,) wxyz, or N from (N, 4)."""
    return Rotation.from_quat(a_from_b.take((1, 2, 3, 0), -1))


@jit
def multiply(a_from_b: Floats, b_from_c: Floats) -> Floats:
    """(4,) a_from_c = a_from_b * b_from_c:

    w = aw bw - a . b,    v = aw b + bw a + a x b    with the vector parts a and b
    """
    aw = a_from_b[0]
    ax = a_from_b[1]
    ay = a_from_b[2]
    az = a_from_b[3]
    bw = b_from_c[0]
    bx = b_from_c[1]
    by = b_from_c[2]
    bz = b_from_c[3]
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


@jit
def inverse(a_from_b: Floats) -> Floats:
    """(4,) b_from_a, the conjugate."""
    return np.array([a_from_b[0], -a_from_b[1], -a_from_b[2], -a_from_b[3]])


@jit
def apply(a_from_b: Floats, v_b: Floats) -> Floats:
    """(3,) v_a of v_b: v + 2 w (u x v) + 2 u x (u x v), with the vector part u."""
    # (a, b, c) = 2 u x v.
    w = a_from_b[0]
    x = a_from_b[1]
    y = a_from_b[2]
    z = a_from_b[3]
    p = v_b[0]
    q = v_b[1]
    r = v_b[2]
    a = 2 * (y * r - z * q)
    b = 2 * (z * p - x * r)
    c = 2 * (x * q - y * p)
    return np.array(
        [p + w * a + y * c - z * b, q + w * b + z * a - x * c, r + w * c + x * b - y * a]
    )


@jit
def to_matrix(a_from_b: Floats) -> Floats:
    """(3, 3) matrix a_from_b."""
    w = a_from_b[0]
    x = a_from_b[1]
    y = a_from_b[2]
    z = a_from_b[3]
    matrix = np.empty((3, 3))
    matrix[0, 0] = 1 - 2 * (y * y + z * z)
    matrix[0, 1] = 2 * (x * y - w * z)
    matrix[0, 2] = 2 * (x * z + w * y)
    matrix[1, 0] = 2 * (x * y + w * z)
    matrix[1, 1] = 1 - 2 * (x * x + z * z)
    matrix[1, 2] = 2 * (y * z - w * x)
    matrix[2, 0] = 2 * (x * z - w * y)
    matrix[2, 1] = 2 * (y * z + w * x)
    matrix[2, 2] = 1 - 2 * (x * x + y * y)
    return matrix


@jit
def from_rotvec(rotvec_rad: Floats) -> Floats:
    """(4,) rotation by a rotation vector (3,) of length a: (cos(a / 2), sin(a / 2) axis)."""
    angle = math.sqrt(rotvec_rad[0] ** 2 + rotvec_rad[1] ** 2 + rotvec_rad[2] ** 2)
    # sin(a / 2) / a tends to 1 / 2.
    scale = math.sin(angle / 2) / angle if angle > 1e-9 else 0.5
    return np.array(
        [
            math.cos(angle / 2),
            scale * rotvec_rad[0],
            scale * rotvec_rad[1],
            scale * rotvec_rad[2],
        ]
    )


@jit
def to_rotvec(a_from_b: Floats) -> Floats:
    """(3,) rotation vector: axis times angle, at most pi."""
    # q and -q are the same rotation: take the one with w >= 0.
    sign = 1.0 if a_from_b[0] >= 0 else -1.0
    x = sign * a_from_b[1]
    y = sign * a_from_b[2]
    z = sign * a_from_b[3]
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2 * math.atan2(sine, sign * a_from_b[0]) / sine if sine > 1e-12 else 2.0
    return np.array([scale * x, scale * y, scale * z])


@jit
def cross(a: Floats, b: Floats) -> Floats:
    """(3,) a x b; np.cross takes ten times as long for a single pair."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


@jit
def matrix_vector(matrix: Floats, v: Floats) -> Floats:
    """(3,) matrix (3, 3) times v (3,)."""
    out = np.empty(3)
    for n in range(3):
        out[n] = matrix[n, 0] * v[0] + matrix[n, 1] * v[1] + matrix[n, 2] * v[2]
    return out


@jit
def interpolate(
    t_s: Floats,
    knots_s: Floats,
    knots_wxyz: Floats,
    rotvec_rad: Floats,
    rates_rad_s: Floats,
) -> Floats:
    """(M, 4) attitudes at times (M,) between N knots: cubic Hermite in the rotation vector from the previous knot.

    With the elapsed fraction s of a step h, the rotation vector r to the next knot and its derivatives r0', r1':

        r(s) = s^2 (3 - 2 s) r + s (1 - s)^2 h r0' - s^2 (1 - s) h r1',    r0' = w0, r1' = w1 + r x w1 / 2 + ...

    Parameters
    ----------
    knots_s, knots_wxyz
        (N,) times and (N, 4) attitudes of the knots
    rotvec_rad
        (N - 1, 3) rotation vectors to the next knot
    rates_rad_s
        (N, 3) rates w at the knots, in their own axes
    """
    out = np.empty((len(t_s), 4))
    for m in range(len(t_s)):
        after = np.searchsorted(knots_s, t_s[m], side="right")
        k = min(max(after - 1, 0), len(knots_s) - 2)
        step_s = knots_s[k + 1] - knots_s[k]
        s = (t_s[m] - knots_s[k]) / step_s
        # Hermite basis: value at the end, slopes at the beginning and the end. The value at the beginning is zero.
        a = s * s * (3 - 2 * s)
        b = s * (1 - s) ** 2
        c = -s * s * (1 - s)
        rotvec = rotvec_rad[k]
        end = rates_rad_s[k + 1] * step_s
        end = end + cross(rotvec, end) / 2
        vector = a * rotvec + b * (rates_rad_s[k] * step_s) + c * end
        attitude = multiply(knots_wxyz[k], from_rotvec(vector))
        # An assignment to the row would take longer to compile than the rest of the function.
        for n in range(4):
            out[m, n] = attitude[n]
    return out
