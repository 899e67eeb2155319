"""What the attitude filter accepts: standard deviations, gyro samples, covariances. Every refusal is one line."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.core.arrays import Floats
from estimator.filter.models import GyroModel
from estimator.filter.propagate import MISSING, SATURATED

# Share of the gyro's limit from which a sample's mean rate counts as saturated (`assumed`).
NEAR_LIMIT = 0.9


def not_negative(name: str, value: ArrayLike) -> NDArray:
    """Convert standard deviations to an array. Raises ValueError unless they are 0 or more, one or three."""
    array = np.asarray(value, dtype=float)
    if array.shape not in ((), (3,)) or not (array >= 0).all():
        raise ValueError(
            f"{name} is {array.tolist()}; allowed: 0 or more, one number or one for each axis"
        )
    return array


def checked_samples(
    start_s: float,
    t_s: ArrayLike,
    angle_rad: ArrayLike,
    saturated: ArrayLike,
    missing: ArrayLike | None,
    gyro: GyroModel,
) -> Floats:
    """Return (N, 5) gyro samples: end of the interval, rotation about x, y, z, and how it was measured (`propagate`).

    A missing sample keeps the rotation that was given, and 0 for NaN. Raises ValueError for wrong shapes, non-finite
    numbers, and intervals not above 0 and up to a tenth of the bias's time: the process noise is a series in the ratio
    of the two.
    """
    ends_s = np.asarray(t_s, float)
    angle = np.asarray(angle_rad, float)
    absent = np.zeros(ends_s.shape) if missing is None else np.asarray(missing)
    count = ends_s.size
    shapes = [ends_s.shape, angle.shape, np.shape(saturated), absent.shape]
    if not count or shapes != [(count,), (count, 3), (count,), (count,)]:
        raise ValueError(
            f"propagate: shapes {shapes}; allowed: (N,), (N, 3), (N,), (N,) with N of 1 or more"
        )
    samples = np.empty((count, 5))
    lost = absent != 0
    samples[:, 0] = ends_s
    samples[:, 1:4] = np.where(lost[:, None] & np.isnan(angle), 0.0, angle)
    if not (np.isfinite(samples[:, :4]).all() and np.isfinite(np.asarray(saturated, float)).all()):
        raise ValueError("propagate: NaN or infinite times or angles; allowed: finite ones")
    step_s = np.diff(ends_s, prepend=start_s)
    longest_s = 0.1 * gyro.bias_time_s
    if not (step_s.min() > 0 and step_s.max() <= longest_s):
        bad = int(np.argmax(~((step_s > 0) & (step_s <= longest_s))))
        raise ValueError(
            f"propagate: the sample that ends at {ends_s[bad]} s is {step_s[bad]:g} s long; "
            f"allowed: above 0, up to {longest_s:g} s (a tenth of bias_time_s)"
        )
    limited = np.abs(samples[:, 1:4]).max(axis=1) >= NEAR_LIMIT * gyro.limit_rad_s * step_s
    samples[:, 4] = np.where(lost, MISSING, SATURATED * (limited | (np.asarray(saturated) != 0)))
    return samples


def checked_covariances(
    covariance_rad2: ArrayLike, systematic_rad2: ArrayLike | None
) -> tuple[Floats, Floats]:
    """Return the covariance without its systematic part, and that part, (3, 3) each.

    Raises ValueError unless the first is symmetric and positive definite, and the second symmetric and without negative
    eigenvalues.
    """
    total = np.asarray(covariance_rad2, dtype=float)
    if not is_covariance(total):
        raise ValueError(
            f"update: covariance_rad2 {total.tolist()}; allowed: (3, 3), symmetric, positive definite"
        )
    systematic = (
        np.zeros((3, 3)) if systematic_rad2 is None else np.asarray(systematic_rad2, dtype=float)
    )
    if systematic_rad2 is not None and not (
        is_covariance(systematic, singular=True) and is_covariance(total - systematic)
    ):
        raise ValueError(
            f"update: systematic_rad2 {systematic.tolist()}; "
            "allowed: (3, 3), symmetric, not negative, less than covariance_rad2"
        )
    return (total - systematic + (total - systematic).T) / 2, (systematic + systematic.T) / 2


def is_covariance(matrix: NDArray, singular: bool = False) -> bool:
    """Whether a matrix is (3, 3), finite, symmetric and positive definite, or `singular` to rounding."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    scale = max(np.trace(matrix), 0.0)
    least = np.linalg.eigvalsh(matrix)[0]
    return bool(
        np.abs(matrix - matrix.T).max() <= 1e-9 * scale
        and (least > 0 or (singular and least >= -1e-9 * scale))
    )
