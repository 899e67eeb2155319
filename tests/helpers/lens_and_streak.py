"""How far two cameras differ, and the two ends of fitted streaks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.attitude import wahba
from estimator.centroiding import centroid
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import NO_PRIORS, Blobs, FramePriors


def disagreement_px(camera: Camera, other: Camera, nodes: int = 41) -> float:
    """Return the rms distance over the sensor between the projections of two cameras, after the best rotation, px.

    The rotation is removed because it is not a property of the lens: every attitude absorbs it.

    Parameters
    ----------
    nodes
        Number of points along each side of the sensor
    """
    x = np.linspace(-0.5, camera.width_px - 0.5, nodes)
    y = np.linspace(-0.5, camera.height_px - 0.5, nodes)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = camera.rays(xy)
    R_other_from_camera, _ = wahba.wahba(other.rays(xy), rays, np.ones(len(xy)))
    shift_px = other.pixels(rays @ R_other_from_camera.T) - xy
    return float(np.sqrt(np.mean(np.sum(shift_px**2, axis=1))))


def streak_ends(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, priors: FramePriors = NO_PRIORS
) -> tuple[Floats, Floats]:
    """Return the two ends of each streak, (N, 2) each, in arbitrary order; NaN for a blob that is not a streak."""
    image = centroid.prepare(image, blobs, gain_e_dn, priors)
    rows = centroid._fit_streaks(image, blobs, gain_e_dn, priors)
    # Center minus and plus half the streak
    return rows[:, :2] - rows[:, 3:5] / 2, rows[:, :2] + rows[:, 3:5] / 2
