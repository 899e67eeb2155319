"""Angular rate of the camera from the shape of round lights in one frame of a rolling shutter: a first guess.

A round image of variance a along each axis that moves by (u, w) = v tau from row to row is stretched and sheared to
a D D', D = [[1, u g], [0, g]], g = 1 / (1 - w), and smeared by a streak k g (u, w), k = T / tau. To first order in w,
with z = u + i w, its second moments are

    (xx - yy) + 2 i xy = k^2 / 12 z^2 + 2 i a z,    xx + yy = 2 a + 2 a w + k^2 / 12 |z|^2.

The terms of higher order are subtracted by iteration. Of the two roots z only one is about zero for a camera at rest:
they are not opposite to each other as the two rates of a streak are, and only one fits the places of the lights.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from estimator.attitude.motion import STARS, Sight, tangent_motion
from estimator.core.arrays import Floats
from estimator.core.camera import Camera
from estimator.core.types import Centroids, RateEstimate

MIN_LIGHTS = 3
ROUNDS = 30
MIN_MOMENT_PX2 = 8.0  # xx + yy of a disk of 4 px: those of smaller images are of pixels and noise
MOMENT_ERROR = (
    0.01  # of moments, as a fraction of xx + yy: common to all lights, as no light is round
)


def from_moments(
    camera: Camera, centroids: Centroids, exposure_s: float, sight: Sight = STARS
) -> list[RateEstimate]:
    """The two rates that explain the moments of the lights; none without a rolling shutter, or if they are points."""
    if centroids.moments_px2 is None or len(centroids) < MIN_LIGHTS or not camera.row_time_s:
        return []
    if np.median(centroids.moments_px2[:, 2]) < MIN_MOMENT_PX2:
        return []
    moments = centroids.moments_px2
    rows = exposure_s / camera.row_time_s
    roots = np.stack([_roots(moments, rows, side) for side in (1, -1)])
    twice_a = moments[:, 2] - np.hypot(moments[:, 0], moments[:, 1])
    sigma_px = MOMENT_ERROR * moments[:, 2] / np.abs(rows**2 / 6 * roots + 1j * twice_a)
    motion_px = (
        camera.focal_px * camera.row_time_s * tangent_motion(camera.rays(centroids.xy_px), sight)
    )
    starts = [_roots(np.median(moments, axis=0)[None], rows, side)[0] for side in (1, -1)]
    rates = [_fit(roots, sigma_px, motion_px, start) for start in starts]
    return [rate for rate in rates if rate is not None]


def _roots(moments_px2: Floats, rows: float, side: int) -> Any:
    """The (N,) complex roots z of N moments, on one side of the mean of both."""
    shape = moments_px2[:, 0] + 1j * moments_px2[:, 1]
    total = moments_px2[:, 2]
    a = (total - np.abs(shape)) / 2
    higher = np.zeros(len(shape), complex)
    quadratic = rows**2 / 12
    for _ in range(ROUNDS):
        z = (side * np.sqrt(quadratic * (shape - higher) - a**2) - 1j * a) / quadratic
        g2 = 1 / (1 - z.imag) ** 2
        exact = a * (1 + z.real**2 * g2 - g2) + 2j * a * z.real * g2 + quadratic * g2 * z**2
        higher = exact - (quadratic * z**2 + 2j * a * z)
        a = (total - quadratic * g2 * np.abs(z) ** 2) / (1 + z.real**2 * g2 + g2)
    return z


def _fit(roots: Any, sigma_px: Floats, motion_px: Floats, start: complex) -> RateEstimate | None:
    """The rate from one of the two roots (2, N) of each light: the one nearer to the motion by the last rate.

    sigma_px  : (2, N) of the roots
    motion_px : (N, 2, 3) motion of each image from row to row, by the rate
    start     : root of the median moments
    """
    near = np.full(roots.shape[1], start)
    for _ in range(ROUNDS):
        side = np.argmin(np.abs(roots - near), axis=0)[None]
        z, sigma = (np.take_along_axis(table, side, axis=0)[0] for table in (roots, sigma_px))
        usable = np.isfinite(z) & (sigma > 0)
        if usable.sum() < MIN_LIGHTS:
            return None
        weighted = motion_px[usable] / sigma[usable, None, None] ** 2
        normal = np.einsum("nij,nik->jk", weighted, motion_px[usable])
        measured = np.column_stack([z.real, z.imag])[usable]
        rate = np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, measured))
        near = (motion_px @ rate) @ np.array([1, 1j])
    return RateEstimate(rate, np.asarray(usable.sum() * np.linalg.inv(normal), dtype=float))
