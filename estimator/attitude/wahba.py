"""Compiled kernels for Wahba's problem: attitude profile, classical solvers, refinement and covariance.

Wahba's problem (1965) is to find the rotation A = R_cam_from_ref that minimizes the loss sum(w |cam - A ref|^2). Since
cam and ref are unit vectors, this is the rotation that maximizes tr(A B^T), where B = sum(w cam ref^T) / sum(w) is the
attitude profile matrix. In terms of the quaternion q the gain is q^T K q with Davenport's symmetric 4x4 matrix K, so
the optimal q is the eigenvector of K's largest eigenvalue. The methods differ in how they find it: Davenport's
q-method by an eigensolver, QUEST and ESOQ2 from the characteristic polynomial, SVD from the singular vectors of B.
TRIAD uses two stars only.

The elements of B lose the small differences between vectors of a narrow field, so `refine` improves the solution by
Gauss-Newton on the vectors themselves. The covariance is the inverse of the Fisher information, sum(w (I - b b^T)).

All kernels take unit vectors as C-ordered (N, 3) arrays; `weight` is (N,), in rad^-2 where a covariance is computed.
The tracker's own solution (`wahba`) takes three steps:

1. Sum the attitude profile B (`profile`), which also checks the directions.
2. Solve it by QUEST (`raw_quest`).
3. Refine the rotation on the vectors, and compute its covariance (`refine`, `attitude_covariance`).
"""

from math import isfinite, sqrt

import numpy as np

from estimator.core import least_squares
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.vectors import cross, dot, norm, rotate, rotate_in_place, row, set_row

Quaternion = tuple[float, float, float, float]

# Limit of the squared sine of the largest angle to the first direction: smaller ones are refused. It is 13 arcsec.
MIN_SINE2 = 4e-9
LENGTH_TOLERANCE = 1e-2  # largest deviation of a unit vector's squared length from 1
MAX_STEPS = 30  # of the refinement
MIN_STEP2_RAD2 = 1e-26  # squared length of a step below double precision


@jit
def wahba(cam: Floats, ref: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return R_cam_from_ref (3, 3) that minimizes sum(w |cam - A ref|^2), and its (3, 3) camera-axes covariance, rad^2.

    It takes a few microseconds for twenty stars.

    Raises
    ------
    ValueError
        If the directions do not determine the rotation.
    """
    # 1. Profile and 2. QUEST
    R_cam_from_ref = raw_quest(profile(cam, ref, weight))
    # 3. Refinement and covariance
    refine(R_cam_from_ref, cam, ref, weight)
    return R_cam_from_ref, attitude_covariance(cam, weight)


@jit
def weights(sigma_rad: Floats) -> Floats:
    """Return (N,) 1 / sigma^2. Raises ValueError for a sigma that is not finite and above 0."""
    # Its square neither overflows nor underflows.
    if not ((sigma_rad > 1e-150) & (sigma_rad < 1e150)).all():
        raise ValueError("a sigma_rad is not usable; allowed: finite, above 0")
    return 1 / sigma_rad**2


@jit
def profile(cam: Floats, ref: Floats, weight: Floats) -> Floats:
    """Return the attitude profile (3, 3) B = sum(w cam ref^T) / sum(w).

    Raises
    ------
    ValueError
        For directions that are not unit vectors or do not determine a rotation.
    """
    if len(cam) < 2:
        raise ValueError(
            "all vectors are parallel: fewer than two directions leave the roll unknown"
        )
    B = np.zeros((3, 3))
    max_sine2 = 0.0
    total = 0.0
    length_error = 0.0
    for n in range(len(cam)):
        total += weight[n]
        # | |v|^2 - 1 | of both vectors
        for v in (row(cam, n), row(ref, n)):
            length_error = max(length_error, abs(dot(v, v) - 1))
        # The directions must differ from the first one in both frames.
        max_sine2 = max(max_sine2, min(_sine2(cam, 0, n), _sine2(ref, 0, n)))
        for i in range(3):
            for j in range(3):
                B[i, j] += weight[n] * cam[n, i] * ref[n, j]
    B /= total
    # A single NaN or infinity makes the sum of the elements non-finite.
    if not isfinite(B.sum()):
        raise ValueError("a direction is NaN or infinite; allowed: unit vectors")
    if length_error > LENGTH_TOLERANCE:
        raise ValueError("a direction is not of unit length; allowed: unit vectors")
    if max_sine2 < MIN_SINE2:
        raise ValueError(
            "all vectors are parallel: the roll about them is unknown; two directions are needed"
        )
    return B


@jit
def _sine2(vectors: Floats, m: int, n: int) -> float:
    """Squared sine of the angle between unit vectors m and n, from their cross product."""
    normal = cross(row(vectors, m), row(vectors, n))
    return dot(normal, normal)


@jit
def largest_eigenvalue(B: Floats) -> float:
    """Return the largest eigenvalue of Davenport's matrix, by Newton's method from 1 downwards.

    With normalized weights the eigenvalue is at most 1, and close to 1 for small errors. The characteristic equation
    is (x^2 - |B|^2)^2 - 8 x det B - 4 |adj B|^2 = 0 (Markley 1993, J. Astronautical Sciences 41, 261), the same
    polynomial as QUEST's quartic.
    """
    square = 0.0  # |B|^2
    minors = 0.0  # |adj B|^2
    det = 0.0
    for i in range(3):
        for j in range(3):
            square += B[i, j] ** 2
            cofactor = _cofactor(B, i, j)
            minors += cofactor**2
            if i == 0:
                det += B[0, j] * cofactor
    # Newton's method on f(x): x <- x - f / f'
    x = 1.0
    for _ in range(50):
        inner = x * x - square
        slope = 4 * x * inner - 8 * det
        if slope <= 0:  # rounding has carried x past a double root
            break
        step = (inner * inner - 8 * x * det - 4 * minors) / slope
        x -= step
        if abs(step) < 1e-16:
            break
    return x


@jit
def _cofactor(matrix: Floats, i: int, j: int) -> float:
    """Return the cofactor of element (i, j) of a (3, 3) matrix."""
    # Cyclic indices give the minor with the cofactor's sign.
    a = (i + 1) % 3
    b = (i + 2) % 3
    c = (j + 1) % 3
    d = (j + 2) % 3
    return matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]


@jit
def _rotated_profile(B: Floats, axis: int) -> Floats:
    """Return the profile for a reference frame rotated by 180 degrees about axis 0, 1 or 2; unchanged for 3."""
    out = B.copy()
    for j in range(3):
        if axis < 3 and j != axis:
            out[:, j] *= -1
    return out


@jit
def _undo_rotation(q: Quaternion, axis: int) -> Quaternion:
    """Undo `_rotated_profile`: Hamilton product of a quaternion (x, y, z, w) and a 180-degree rotation."""
    x, y, z, w = q
    if axis == 0:
        return w, z, -y, -x
    if axis == 1:
        return -z, w, x, -y
    if axis == 2:
        return y, -x, w, -z
    return q


@jit
def _symmetric(B: Floats) -> tuple[Floats, Floats, float]:
    """Return S = B + B^T, z (3,) and the trace, the parts of Davenport's matrix K = [[S - tr I, z], [z^T, tr]].

    Shuster's attitude matrix A(q) is the transpose of the active rotation matrix used here, hence the sign of z.
    """
    z = np.array([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])
    return B + B.T, z, np.trace(B)


@jit
def raw_quest(B: Floats) -> Floats:
    """Solve the profile by QUEST (Shuster & Oh 1981, J. Guidance & Control 4, 70): the Gibbs vector of the eigenvalue.

    The Gibbs vector is infinite at a rotation of 180 degrees. It is therefore computed in four reference frames, the
    original one and those rotated by 180 degrees about each axis ("sequential rotations"), and the solution with the
    largest scalar part of the quaternion is returned. The scalar parts are compared before normalization: at 180
    degrees all four components of the quaternion vanish, and their ratios are rounding noise.
    """
    x = largest_eigenvalue(B)  # the same in all four frames
    best = (0.0, 0.0, 0.0, 0.0)
    frame = 3
    for axis in (3, 0, 1, 2):
        q = _quest_once(_rotated_profile(B, axis), x)
        if abs(q[3]) > abs(best[3]):
            best = q
            frame = axis
    return matrix_of(_undo_rotation(best, frame))


@jit
def _quest_once(B: Floats, x: float) -> Quaternion:
    """Return QUEST's quaternion (v, gamma), not normalized, for the eigenvalue x (Shuster & Oh 1981).

    With S, z and the trace t of `_symmetric`, and kappa = tr(adj S):

        alpha = x^2 - t^2 + kappa,  gamma = (x + t) alpha - det S,  v = [alpha I + (x - t) S + S^2] z.
    """
    S, z, trace = _symmetric(B)
    det = 0.0
    kappa = 0.0
    for j in range(3):
        det += S[0, j] * _cofactor(S, 0, j)
        kappa += _cofactor(S, j, j)
    alpha = x * x - trace * trace + kappa
    gamma = (x + trace) * alpha - det
    Sz = np.array(rotate(S, z))
    SSz = np.array(rotate(S, Sz))
    v = alpha * z + (x - trace) * Sz + SSz
    return v[0], v[1], v[2], gamma


@jit
def raw_esoq2(B: Floats) -> Floats:
    """Solve the profile by ESOQ2 (Mortari 1997; Markley & Mortari 2000, J. Astronautical Sciences 48, 359).

    From Davenport's equations, M e = 0 for the rotation axis e, with M = (x - tr)((x + tr) I - S) - z z^T.

    1. Rotate the reference frame by the 180-degree rotation that gives the smallest trace: M vanishes for the identity
       rotation.
    2. Compute M.
    3. Take the longest of the cross products of M's rows as e.
    4. The quaternion is ((x - tr) e, z . e), to be normalized.
    """
    # 1. A rotation by 180 degrees about an axis keeps that diagonal element and negates the two others.
    x = largest_eigenvalue(B)
    frame = 3
    least = np.trace(B)
    for axis in range(3):
        trace = 2 * B[axis, axis] - np.trace(B)
        if trace < least:
            frame = axis
            least = trace
    # 2. M = (x - tr)((x + tr) I - S) - z z^T
    S, z, trace = _symmetric(_rotated_profile(B, frame))
    M = -(x - trace) * S - np.outer(z, z)
    for i in range(3):
        M[i, i] += (x - trace) * (x + trace)
    # 3. Row i of the cofactors of M is the cross product of the two other rows.
    e = np.zeros(3)
    length2 = -1.0
    for i in range(3):
        u = _cofactor(M, i, 0)
        v = _cofactor(M, i, 1)
        w = _cofactor(M, i, 2)
        if u * u + v * v + w * w > length2:
            length2 = u * u + v * v + w * w
            e[:] = u, v, w
    # 4. Quaternion
    q = (x - trace) * e[0], (x - trace) * e[1], (x - trace) * e[2], dot(z, e)
    return matrix_of(_undo_rotation(q, frame))


@jit
def raw_davenport(B: Floats) -> Floats:
    """Solve the profile by Davenport's q-method (Keat 1977, CSC/TM-77/6034).

    The quaternion (x, y, z, w) is the eigenvector of the largest eigenvalue of K = [[S - tr I, z], [z^T, tr]].
    """
    S, z, trace = _symmetric(B)
    K = np.empty((4, 4))
    K[:3, :3] = S - trace * np.eye(3)
    K[3, :3] = z
    K[:3, 3] = z
    K[3, 3] = trace
    _, vectors = np.linalg.eigh(K)  # in the order of increasing eigenvalues
    return matrix_of(vectors[:, 3])


@jit
def raw_svd(B: Floats) -> Floats:
    """Solve the profile by singular value decomposition (Markley 1988, J. Astronautical Sciences 36, 245).

    With B = U S V^T the rotation is A = U diag(1, 1, det U det V) V^T.
    """
    U, _, Vt = np.linalg.svd(B)
    # The determinants are 1 or -1: their product keeps A a rotation rather than a reflection.
    determinant = np.linalg.det(U) * np.linalg.det(Vt)
    R = np.outer(U[:, 0], Vt[0]) + np.outer(U[:, 1], Vt[1])
    return R + np.outer(determinant * U[:, 2], Vt[2])


@jit
def best_pair(cam: Floats, weight: Floats) -> tuple[int, int]:
    """Return the pair of stars with the smallest variance about the worst axis.

    The smallest eigenvalue of a pair's information matrix is (p + q - sqrt((p + q)^2 - 4 p q sin^2 s)) / 2, with the
    weights p and q and the separation s. The best pair is that with the largest one.
    """
    first = 0
    second = 1
    best = -1.0
    for m in range(len(cam)):
        for n in range(m + 1, len(cam)):
            p = weight[m]
            q = weight[n]
            product = p * q * _sine2(cam, m, n)
            # The same eigenvalue in a form without cancellation.
            least = 2 * product / (p + q + sqrt(max((p + q) ** 2 - 4 * product, 0.0)))
            if least > best:
                first = m
                second = n
                best = least
    return first, second


@jit
def raw_triad(cam: Floats, ref: Floats, weight: Floats) -> Floats:
    """Solve for the rotation from two stars by TRIAD in its optimal form (Markley 2002, J. Guidance 25, 411).

    With b3, r3 the normals of the planes that the two stars span, w the weights and l a normalization factor,

        A = b3 r3^T + sum over the two of (w / l) [b r^T + (b x b3)(r x r3)^T].

    This is the optimum of Wahba's problem for two stars, and Black's (1964) TRIAD if one weight is zero.

    1. Select the best pair, and compute the normals b3 and r3.
    2. Sum the bracket over the two stars.
    3. Normalize it, and add b3 r3^T.
    """
    # 1. Pair and normals
    m, n = best_pair(cam, weight)
    b = cam[np.array([m, n])]
    r = ref[np.array([m, n])]
    b3 = _normal(b[0], b[1])
    r3 = _normal(r[0], r[1])
    # 2. w [b r^T + (b x b3)(r x r3)^T]
    along = np.zeros((3, 3))
    for k in range(2):
        c = np.cross(b[k], b3)
        s = np.cross(r[k], r3)
        weight_k = weight[m] if k == 0 else weight[n]
        along += weight_k * (b[k].reshape(3, 1) * r[k] + c.reshape(3, 1) * s)
    # 3. `along` is l times a rotation of the plane: the sum of its squared entries is 2 l^2.
    scale = sqrt(2 / (along**2).sum())
    return scale * along + b3.reshape(3, 1) * r3


@jit
def _normal(u: Floats, v: Floats) -> Floats:
    """Return the unit vector along u x v."""
    w = np.cross(u, v)
    return w / norm(w)


@jit
def refine(R_cam_from_ref: Floats, cam: Floats, ref: Floats, weight: Floats) -> None:
    """Refine `R_cam_from_ref` in place by Gauss-Newton on sum(w |cam - A ref|^2).

    With a = A ref, each step:

    1. Sum the gradient sum(w a x cam) and the information sum(w (I - a a^T)).
    2. Solve for the small rotation: information step = gradient.
    3. Rotate A by the step; stop if it is below double precision.

    If the directions are close together, the two largest eigenvalues of Davenport's matrix are nearly equal, and
    methods based on the profile lose precision as the inverse square of the directions' spread. Here the small
    differences a x cam are computed star by star, which keeps the precision. Wahba's problem has no other local
    minimum, so the iteration cannot converge to a wrong one.
    """
    R = R_cam_from_ref
    gradient = np.empty(3)
    normal = np.empty((3, 3))
    step = np.empty(3)
    for _ in range(MAX_STEPS):
        # 1. Gradient and information
        gradient.fill(0.0)
        normal.fill(0.0)
        for n in range(len(cam)):
            w = weight[n]
            a = rotate(R, row(ref, n))
            turn = cross(a, row(cam, n))
            for i in range(3):
                gradient[i] += w * turn[i]
            _add_information(normal, a, w)
        # 2. Step
        _factorize(normal)
        step[:] = gradient
        least_squares.cholesky_solve(normal, step)
        # 3. Rotation
        rotate_in_place(step, R)
        if dot(step, step) < MIN_STEP2_RAD2:
            break


@jit
def _add_information(matrix: Floats, v: Floats, w: float) -> None:
    """Add w (|v|^2 I - v v^T) to the lower triangle of `matrix`, without cancellation on the diagonal."""
    matrix[0, 0] += w * (v[1] * v[1] + v[2] * v[2])
    matrix[1, 1] += w * (v[0] * v[0] + v[2] * v[2])
    matrix[2, 2] += w * (v[0] * v[0] + v[1] * v[1])
    matrix[1, 0] -= w * v[1] * v[0]
    matrix[2, 0] -= w * v[2] * v[0]
    matrix[2, 1] -= w * v[2] * v[1]


@jit
def attitude_covariance(cam: Floats, weight: Floats) -> Floats:
    """Return the (3, 3) covariance P = [sum(w (I - b b^T))]^-1. Raises ValueError if the sum is singular."""
    factor = np.zeros((3, 3))
    out = np.eye(3)
    for n in range(len(cam)):
        _add_information(factor, cam[n], weight[n])
    _factorize(factor)
    # Column j of the inverse solves N x = e_j.
    for j in range(3):
        least_squares.cholesky_solve(factor, out[j])
    # Rounding leaves it slightly asymmetric.
    return (out + out.T) / 2


@jit
def _factorize(information: Floats) -> None:
    """Replace the lower triangle by its Cholesky factor. Raises ValueError unless the matrix is positive definite."""
    if not least_squares.cholesky(information, 0.0):
        raise ValueError("all vectors are parallel: the roll about them is unknown")


@jit
def matrix_of(q: Quaternion | Floats) -> Floats:
    """Return the (3, 3) rotation matrix of a quaternion (x, y, z, w) of any norm, a tuple or an array."""
    x, y, z, w = q
    s = 2 / (x * x + y * y + z * z + w * w)
    R = np.empty((3, 3))
    set_row(R, 0, (1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)))
    set_row(R, 1, (s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)))
    set_row(R, 2, (s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)))
    return R
