"""Exact near-field fit of a camera that rotates about the bearing center, and the derivatives of its tangents.

`rotation_only` is the solver of that name of `nearfield`, whose arguments are described there. `fit_focal_ratio` also
fits the focal length.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.least_squares import cholesky_solve, normal_equations
from estimator.core.least_squares import step as least_squares_step
from estimator.core.vectors import quaternion_xyzw, rotate, rotate_in_place, row

CONVERGED_STEP_RAD = 1e-14  # of rotation_only, which converges in a few steps


def rotation_only(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> tuple[Rotation, Floats]:
    """Fit the exact model: body_from_lab and its (3, 3) covariance in body axes, from N >= 2 rays and their LEDs.

    The fit minimizes the weighted residuals of the tangents, sum |m_i - y_i|^2 / sigma_i^2, over the rotation A alone.
    In camera axes, with P the LED's position and r the lever arm,

        b = A P,  q = b - r,  y = (q_x / q_z, q_y / q_z),
        J = dy/dw = D(q) (-[b]x),  D = [[1/q_z, 0, -q_x/q_z^2], [0, 1/q_z, -q_y/q_z^2]],

    where w is a small rotation, A <- exp([w]) A. Gauss-Newton repeats four steps:

    1. Predict each LED's tangents y, their residuals m - y and their Jacobian J.
    2. Sum the normal equations N w = g, with N = sum(J^T J / sigma^2) and g = sum(J^T (m - y) / sigma^2), and solve.
    3. Rotate A by w.
    4. Stop if |w| is below CONVERGED_STEP_RAD.

    5. The covariance is N^-1.

    The method uses the LEDs' positions and the constraint that the camera rotates about the bearing center, but not
    the surface. The equations are derived here; the model is that of reference, section 5.

    Raises
    ------
    ValueError
        If the fit does not converge, or if the LEDs do not determine all three angles.
    """
    body_from_lab, _, covariance_cam = _fit_rotation(
        rays_cam, sigma_rad, position_m, lever, body_from_lab, False
    )
    return body_from_lab, in_body_axes(covariance_cam, lever)


def fit_focal_ratio(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    lever: Lever,
    body_from_lab: Rotation,
) -> float:
    """Return the ratio of the true focal length to the assumed one, from N >= 2 rays and their LEDs.

    This is the fit of `rotation_only` with one more unknown, the logarithm of the ratio rho. The tangents are
    y = rho (q_x / q_z, q_y / q_z), and their derivative with respect to log rho is y itself. The errors raised are
    those of `rotation_only`.
    """
    return _fit_rotation(rays_cam, sigma_rad, position_m, lever, body_from_lab, True)[1]


def _fit_rotation(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    lever: Lever,
    body_from_lab: Rotation,
    with_focal: bool,
) -> tuple[Rotation, float, Floats]:
    """Return body_from_lab, the focal ratio (1 unless `with_focal`), and the covariance of both in camera axes."""
    R_cam_from_lab = (lever.cam_from_body * body_from_lab).as_matrix()  # updated in place
    lever_cam_m = lever.pupil_cam_m
    ratio, step_rad, covariance_cam = _fitted_rotation(
        rays_cam,
        sigma_rad,
        np.ascontiguousarray(position_m),
        lever_cam_m,
        R_cam_from_lab,
        with_focal,
    )
    if np.isnan(step_rad):
        raise ValueError(
            f"{len(rays_cam)} rays do not determine a rotation; two LEDs in different directions are needed"
        )
    if not step_rad < 1e-9:
        raise ValueError(f"rotation_only: not converged, last step {step_rad:.1e} rad")
    cam_from_lab = Rotation.from_quat(quaternion_xyzw(R_cam_from_lab))
    return lever.body_from_cam * cam_from_lab, ratio, covariance_cam


@jit
def _fitted_rotation(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    lever_cam_m: Floats,
    R: Floats,
    with_focal: bool,
) -> tuple[float, float, Floats]:
    """Run the fit of `rotation_only`: the focal ratio, the last step's length, and the covariance in camera axes.

    The step's length is NaN if the rays do not determine the unknowns: all LEDs are in one direction from the bearing,
    and a rotation about that direction changes nothing. The covariance is (3, 3) of the rotation, rad^2, or (4, 4)
    with the logarithm of the ratio. The numbered steps are those of `rotation_only`.

    Parameters
    ----------
    R
        (3, 3) cam_from_lab, updated in place
    """
    unknowns = 4 if with_focal else 3
    normal = np.empty((unknowns + 1, unknowns + 1))
    rows = np.empty((unknowns + 1, 2 * len(rays_cam)))
    weight = np.repeat(1 / sigma_rad**2, 2)  # both tangents of a ray have the same weight
    step = np.empty(unknowns)
    covariance = np.eye(unknowns)
    log_ratio = 0.0
    length = np.nan
    for _ in range(30):
        # 1. Predicted tangents, residuals, Jacobian.
        _residual_rows(rays_cam, position_m, lever_cam_m, R, np.exp(log_ratio), rows)
        # 2. Normal equations; the solver leaves their Cholesky factor in `normal`.
        normal_equations(rows, weight, rows.shape[1], normal)
        if np.isnan(least_squares_step(normal, step)):
            return 1.0, np.nan, covariance
        # 3. Update. A step of the focal length is limited to a factor e.
        rotate_in_place(step[:3], R)
        if with_focal:
            log_ratio += min(max(step[3], -1.0), 1.0)
        # 4. Convergence
        length = np.sqrt(np.sum(step**2))
        if length < CONVERGED_STEP_RAD:
            break
    # 5. Covariance N^-1, column by column from the unit vectors.
    factor = normal[:unknowns, :unknowns]
    for i in range(unknowns):
        cholesky_solve(factor, covariance[i])
    return np.exp(log_ratio), length, covariance


@jit
def _residual_rows(
    rays_cam: Floats,
    position_m: Floats,
    lever_cam_m: Floats,
    R: Floats,
    ratio: float,
    rows: Floats,
) -> None:
    """Fill `rows` (4 or 5, 2 N): derivatives of the tangents by the rotation (and log ratio), then the residuals.

    Even columns are those of the tangents x, odd ones those of y.

    The tangent x = rho q_x / q_z has the gradient d = rho (1/q_z, 0, -q_x/q_z^2) with respect to q. A small rotation w
    moves q by w x b, so that dx = d . (w x b) = w . (b x d): the three derivatives are b x d. The same holds for y.
    """
    pairs = rows.reshape(len(rows), -1, 2)
    for n in range(len(rays_cam)):
        bx, by, bz = rotate(R, row(position_m, n))  # b = A P
        qx = bx - lever_cam_m[0]
        qy = by - lever_cam_m[1]
        qz = bz - lever_cam_m[2]
        x = ratio * qx / qz
        y = ratio * qy / qz
        scale = ratio / qz
        # b x d for both tangents
        pairs[0, n] = -by * x / qz, -by * y / qz - bz * scale
        pairs[1, n] = bz * scale + bx * x / qz, bx * y / qz
        pairs[2, n] = -by * scale, bx * scale
        # The derivative of rho (q_x / q_z) with respect to log rho is the tangent itself.
        if len(rows) == 5:
            pairs[3, n] = x, y
        # Residuals: measured minus predicted tangents
        u, v, w = row(rays_cam, n)
        pairs[-1, n] = u / w - x, v / w - y


def tangent_gradients(q: Floats) -> Floats:
    """Return the (N, 2, 3) derivative of the tangents (q_x / q_z, q_y / q_z) with respect to q."""
    inverse_z = 1 / q[:, 2]
    zero = np.zeros_like(inverse_z)
    d_x = np.column_stack([inverse_z, zero, -q[:, 0] * inverse_z**2])
    d_y = np.column_stack([zero, inverse_z, -q[:, 1] * inverse_z**2])
    return np.stack([d_x, d_y], axis=1)


def tangent_jacobian(b: Floats, q: Floats) -> Floats:
    """Return the (2 N, 3) derivative of the tangents of q = b - r with respect to a small rotation w: dq = w x b."""
    # With d the gradient of a tangent: d . (w x b) = w . (b x d).
    return np.cross(b[:, None, :], tangent_gradients(q)).reshape(-1, 3)


def in_body_axes(covariance_cam: np.ndarray, lever: Lever) -> Floats:
    """Return a (3, 3) covariance of a small rotation in body axes, from one in camera axes: R P R^T."""
    R_body_from_cam = lever.body_from_cam.as_matrix()
    return R_body_from_cam @ covariance_cam @ R_body_from_cam.T
