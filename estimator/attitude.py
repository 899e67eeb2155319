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
    in which the quaternion's scalar part is the greatest. Raises ValueError for fewer than two directions.
    """
    weight = 1 / np.asarray(sigma_rad) ** 2
    weight = weight / weight.sum()
    profile = (weight[:, None] * vectors_cam).T @ vectors_ref
    if np.linalg.svd(profile, compute_uv=False)[1] < 1e-14:
        raise ValueError(
            "all vectors are parallel: the roll about them is unknown; two directions are needed"
        )
    best, scalar = Rotation.identity(), -1.0
    for turn in HALF_TURNS:
        quaternion_xyzw = _quest_once(profile * turn)
        if abs(quaternion_xyzw[3]) > scalar:
            scalar = abs(quaternion_xyzw[3])
            best = Rotation.from_quat(quaternion_xyzw) * Rotation.from_matrix(np.diag(turn))
    return best


# Half-turns of the reference frame about nothing, x, y and z: they flip two columns of the profile matrix.
HALF_TURNS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)


def _quest_once(profile: Floats) -> Floats:
    """QUEST's quaternion (x, y, z, w) for a profile matrix B = sum(w cam ref^T)."""
    # Shuster's quaternion carries ref into cam as A(q), the transpose of the active matrix: hence B's order.
    symmetric = profile + profile.T
    trace = np.trace(profile)
    z = np.array(
        [profile[2, 1] - profile[1, 2], profile[0, 2] - profile[2, 0], profile[1, 0] - profile[0, 1]]
    )
    kappa = np.trace(_adjugate(symmetric))
    delta = np.linalg.det(symmetric)
    a, b = trace**2 - kappa, trace**2 + z @ z
    c, d = delta + z @ symmetric @ z, z @ symmetric @ symmetric @ z
    eigenvalue = _newton(a, b, c, d, trace)
    alpha = eigenvalue**2 - trace**2 + kappa
    gamma = (eigenvalue + trace) * alpha - delta
    vector = (alpha * np.eye(3) + (eigenvalue - trace) * symmetric + symmetric @ symmetric) @ z
    norm = np.sqrt(gamma**2 + vector @ vector)
    return np.array([*vector, gamma]) / norm if norm > 0 else np.array([0.0, 0.0, 0.0, 0.0])


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


def _adjugate(m: Floats) -> Floats:
    return np.array(
        [
            np.cross(m[1], m[2]),
            np.cross(m[2], m[0]),
            np.cross(m[0], m[1]),
        ]
    ).T


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
    ra, dec = np.arctan2(sight[1], sight[0]), np.arcsin(np.clip(sight[2], -1, 1))
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    return float(ra % (2 * np.pi)), float(dec), float(np.arctan2(-down @ east, -down @ north))
