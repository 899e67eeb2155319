"""A tumble with a smooth rate, integrated by another method than the filter's."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation


def tumble_rad_s(t_s: np.ndarray) -> np.ndarray:
    """(..., 3) rate in body axes."""
    return np.stack(
        [0.2 * np.sin(0.5 * t_s), 0.1 * np.cos(0.4 * t_s), 0.05 + 0.1 * np.sin(0.3 * t_s)], -1
    )


def tumble_angle_rad(t_s: np.ndarray) -> np.ndarray:
    """The gyro's perfect increments: the integral of each rate between the times."""
    integral = np.stack(
        [
            -0.4 * np.cos(0.5 * t_s),
            0.25 * np.sin(0.4 * t_s),
            0.05 * t_s - np.cos(0.3 * t_s) / 3,
        ],
        -1,
    )
    return np.diff(integral, axis=0)


def tumble_body_from_ref(t_s: np.ndarray) -> Rotation:
    """Poisson's equation C' = -[w] C by an eighth-order Runge-Kutta on the matrix, from the identity at time 0."""

    def slope(t: float, c: np.ndarray) -> np.ndarray:
        return -np.cross(tumble_rad_s(t), c.reshape(3, 3), axisb=0, axisc=0).ravel()

    ivp = solve_ivp(
        slope, (0, t_s[-1]), np.eye(3).ravel(), "DOP853", t_s, rtol=1e-12, atol=1e-13
    )
    return Rotation.from_matrix(ivp.y.T.reshape(-1, 3, 3))
