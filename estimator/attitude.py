"""Wahba's problem: the rotation that best carries reference vectors into observed ones, with its covariance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.types import Floats

Solver = Callable[..., Rotation]


def quest(vectors_cam: Floats, vectors_ref: Floats, sigma_rad: Floats) -> Rotation:
    """QUEST (Shuster & Oh 1981): cam_from_ref from (N, 3) unit vectors, N >= 2, weighted by 1 / sigma^2.

    The quartic for Davenport's greatest eigenvalue is solved by Newton from 1; the Gibbs vector's singularity
    at half a turn is avoided by solving in the one of four frames, each turned by half a turn about an axis,
    in which the quaternion's scalar part is the greatest. Directions close together make the two greatest
    eigenvalues nearly equal, and the quartic loses digits as the fourth power of their spread: Gauss-Newton
    on the directions themselves brings them back. Raises ValueError for fewer than two directions.
    """
    weight = 1 / np.asarray(sigma_rad) ** 2
    weight = weight / weight.sum()
    profile = (weight[:, None] * vectors_cam).T @ vectors_ref
    if np.linalg.svd(profile, compute_uv=False)[1] < PARALLEL:
        raise ValueError(
            "all vectors are parallel: the roll about them is unknown; two directions are needed"
        )
    # The scalar parts are compared before the quaternions are normalised: in a frame where the turn is half a
    # turn, all four numbers vanish, and their ratios are noise.
    frames = [(_quest_once(profile * turn), turn) for turn in HALF_TURNS]
    quaternion_xyzw, turn = max(frames, key=lambda frame: abs(frame[0][3]))
    cam_from_ref = Rotation.from_quat(quaternion_xyzw) * Rotation.from_matrix(np.diag(turn))
    return _polished(cam_from_ref, vectors_cam, vectors_ref, weight)


# Least second singular value of the profile matrix, about a quarter of the squared angle between two directions.
PARALLEL = 1e-9
# Half-turns of the reference frame about nothing, x, y and z: they flip two columns of the profile matrix.
HALF_TURNS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)


def _quest_once(profile: Floats) -> Floats:
    """QUEST's quaternion (x, y, z, w), not normalised, for a profile matrix B = sum(w cam ref^T)."""
    # Shuster's quaternion carries ref into cam as A(q), the transpose of the active matrix: hence B's order.
    symmetric = profile + profile.T
    trace = np.trace(profile)
    z = np.array(
        [profile[2, 1] - profile[1, 2], profile[0, 2] - profile[2, 0], profile[1, 0] - profile[0, 1]]
    )
    kappa = (np.trace(symmetric) ** 2 - np.sum(symmetric**2)) / 2  # the trace of its adjugate
    delta = np.linalg.det(symmetric)
    a, b = trace**2 - kappa, trace**2 + z @ z
    c, d = delta + z @ symmetric @ z, z @ symmetric @ symmetric @ z
    eigenvalue = _newton(a, b, c, d, trace)
    alpha = eigenvalue**2 - trace**2 + kappa
    gamma = (eigenvalue + trace) * alpha - delta
    vector = (alpha * np.eye(3) + (eigenvalue - trace) * symmetric + symmetric @ symmetric) @ z
    return np.array([*vector, gamma])


def _polished(cam_from_ref: Rotation, vectors_cam: Floats, vectors_ref: Floats, weight: Floats) -> Rotation:
    """Gauss-Newton on sum(w |cam - A ref|^2): the turn w with sum(I - a a^T) w = sum(a x cam), a = A ref."""
    for _ in range(20):
        turned = cam_from_ref.apply(vectors_ref)
        information = np.eye(3) - (weight[:, None] * turned).T @ turned
        step = np.linalg.solve(information, weight @ np.cross(turned, vectors_cam))
        cam_from_ref = Rotation.from_rotvec(step) * cam_from_ref
        if step @ step < 1e-26:
            break
    return cam_from_ref


def _newton(a: float, b: float, c: float, d: float, trace: float) -> float:
    """Greatest root of the characteristic equation, from 1 downwards."""
    x = 1.0
    for _ in range(50):
        value = x**4 - (a + b) * x**2 - c * x + (a * b + c * trace - d)
        slope = 4 * x**3 - 2 * (a + b) * x - c
        if slope == 0:
            break
        step = value / slope
        x -= step
        if abs(step) < 1e-16:
            break
    return x


SOLVERS: dict[str, Solver] = {"quest": quest}


def covariance(vectors_cam: Floats, sigma_rad: Floats) -> Floats:
    """(3, 3) covariance of the small rotation in camera axes: [sum((I - b b^T) / sigma^2)]^-1, rad^2.

    QUEST's measurement model (Shuster & Oh 1981, eq. 97), confirmed by Monte Carlo in the tests.
    """
    weight = 1 / np.asarray(sigma_rad) ** 2
    outer = np.einsum("ni,nj->nij", vectors_cam, vectors_cam)
    information = (weight[:, None, None] * (np.eye(3) - outer)).sum(axis=0)
    return np.linalg.inv(information)


def radecroll_rad(cam_from_icrs: Rotation) -> tuple[float, float, float]:
    """Right ascension, declination of the boresight, and the position angle of the image's up direction.

    The roll is measured at the boresight from north through east; radians, ra in [0, 2 pi), roll in (-pi, pi].
    """
    _, down, sight = cam_from_icrs.as_matrix()
    ra = np.arctan2(sight[1], sight[0]) % (2 * np.pi) % (2 * np.pi)  # once more: -1e-17 % 2 pi is 2 pi
    dec = np.arctan2(sight[2], np.hypot(sight[0], sight[1]))
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    # A sine of -0 would make a half turn -pi.
    return float(ra), float(dec), float(np.arctan2(0.0 - down @ east, -down @ north))
