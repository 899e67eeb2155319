"""Angular rate of the camera from the streaks of one smeared frame.

A light's streak is the path of its image over the exposure: the chord of its tangents is T times their velocity
(`motion.tangent_motion`), linear in the rate w. Weighted least squares over all streaks gives w: across the boresight
from their mean, about the boresight from how they vary over the field. A streak looks the same in both directions, so
that w and -w explain one frame equally well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.motion import STARS, Sight, streak_factor, tangent_motion
from estimator.core.arrays import Floats
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.least_squares import misfit_factor
from estimator.core.types import Centroids, RateEstimate

MIN_STREAKS = 3  # two vectors for each; three components of the rate, and a check
MAX_RATE_RAD_S = (
    10.0  # standard deviation of the prior: a component that no streak tells stays within it
)
OUTLIER_CHI2 = 16.0  # squared Mahalanobis distance of a streak that is not the light's own: of two lights, of noise
ROUNDS = 20
CONVERGED = 1e-13


def from_streaks(
    camera: Camera, centroids: Centroids, exposure_s: float, sight: Sight = STARS
) -> list[RateEstimate]:
    """The two rates of opposite sign that explain the streaks of a frame; none with fewer than MIN_STREAKS streaks.

    With a rolling shutter the two differ a little in size: a streak is longer if it moves with the readout. Raises
    ImageError for an exposure that is not finite and above 0.
    """
    if not 0 < exposure_s < np.inf:
        raise ImageError(f"exposure_s: {exposure_s}; allowed: finite, above 0")
    if centroids.streak_px is None or centroids.streak_covariance_px2 is None:
        return []
    measured = np.isfinite(centroids.streak_px[:, 0])
    if measured.sum() < MIN_STREAKS:
        return []
    chord, information = chords(camera, centroids.take(measured))
    motion = exposure_s * tangent_motion(
        camera.rays(centroids.xy_px[measured]), sight.take(measured)
    )
    axis = _common(chord, information)
    rates = [
        _fit(
            camera,
            aligned(chord, np.eye(2)[None], sign * axis[None]),
            information,
            motion,
            exposure_s,
        )
        for sign in (1, -1)
    ]
    return [rate for rate in rates if rate is not None]


def chords(camera: Camera, centroids: Centroids) -> tuple[Floats, Floats]:
    """(N, 2) chords of streaks as tangents, sign arbitrary, and (N, 2, 2) their information, the inverse covariance."""
    assert centroids.streak_px is not None
    assert centroids.streak_covariance_px2 is not None
    ends = [camera.tangents(centroids.xy_px + side * centroids.streak_px) for side in (-0.5, 0.5)]
    return ends[1] - ends[0], camera.focal_px**2 * inverses(centroids.streak_covariance_px2)


def inverses(matrices: Floats) -> Floats:
    """(N, 2, 2) inverses of covariances."""
    return np.asarray(np.linalg.inv(matrices), dtype=float)


def aligned(chord: Floats, information: Floats, predicted: Floats) -> Floats:
    """The chords (N, 2), each with the sign that is nearer to a predicted one."""
    along = np.einsum("ni,nij,nj->n", predicted, information, chord)
    return np.asarray(chord * np.where(along < 0, -1.0, 1.0)[:, None])


def inliers(residual: Floats, information: Floats) -> NDArray[np.bool_]:
    """(N,) whether a residual (N, 2) is within four standard deviations, or four medians where they are larger."""
    distance2 = np.einsum("ni,nij,nj->n", residual, information, residual)
    return np.asarray(distance2 < OUTLIER_CHI2 * max(1.0, float(np.median(distance2))))


def _common(chord: Floats, information: Floats) -> Floats:
    """(2,) direction that the chords share, sign arbitrary."""
    weighted = np.einsum("nij,nj,nk->ik", information, chord, chord)
    return np.asarray(np.linalg.eigh(weighted + weighted.T)[1][:, -1])


def _fit(
    camera: Camera, chord: Floats, information: Floats, motion: Floats, exposure_s: float
) -> RateEstimate | None:
    """Weighted least squares of the rate from chords of known sign; later rounds drop outliers and choose the signs."""
    keep = np.ones(len(chord), bool)
    factor = np.ones(len(chord))
    rate = np.zeros(3)
    for _ in range(ROUNDS):
        before = rate
        by_rate = motion * factor[:, None, None]
        weighted = np.swapaxes(by_rate, 1, 2) @ information * keep[:, None, None]
        normal = np.sum(weighted @ by_rate, axis=0) + np.eye(3) / MAX_RATE_RAD_S**2
        rate = np.linalg.solve(normal, np.einsum("nij,nj->i", weighted, chord))
        predicted = by_rate @ rate
        chord = aligned(chord, information, predicted)
        keep = inliers(chord - predicted, information)
        factor = streak_factor(camera, motion @ rate / exposure_s)
        if np.linalg.norm(rate - before) < CONVERGED * np.linalg.norm(rate):
            break
    count = int(keep.sum())
    if count < MIN_STREAKS:
        return None
    residual = (chord - predicted)[keep]
    chi2 = float(np.einsum("ni,nij,nj->", residual, information[keep], residual))
    return RateEstimate(
        rate, misfit_factor(chi2, 2 * count - 3) * np.linalg.inv(normal), sign_known=False
    )
