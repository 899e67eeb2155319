"""Angular rate of the camera from the streaks of one smeared frame.

A light's streak is the path of its image over the exposure: the chord of its tangents is T times their velocity
(`motion.tangent_motion`), linear in the rate w. Weighted least squares over all streaks gives w: across the boresight
from their mean, about the boresight from how they vary over the field. A streak looks the same in both directions, so
that w and -w explain one frame equally well.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import on_sphere
from estimator.attitude.nearfield import tangent_jacobian
from estimator.core.camera import Camera
from estimator.core.checks import Floats, ImageError
from estimator.core.least_squares import misfit_factor
from estimator.core.types import Centroids, RateEstimate

# Motion of the images of a turning camera: velocities, the rows' times of a rolling shutter, a
# frame at one time.


class Sight(NamedTuple):
    """Where the lights are that a camera sees.

    Attributes
    ----------
    lever_cam_m
        (3,) the camera from the bearing, in camera axes
    radius_m
        Distance of the lights from the bearing: of all, or (N,) of each
    """

    lever_cam_m: Floats
    radius_m: Floats | float

    def take(self, which: NDArray[Any]) -> Sight:
        """The sight of some of the lights, by mask or index."""
        return (
            self._replace(radius_m=self.radius_m[which])
            if isinstance(self.radius_m, np.ndarray)
            else self
        )


STARS = Sight(np.zeros(3), 1.0)  # without a lever arm the distance has no effect


def places_cam(rays_cam: Floats, sight: Sight) -> Floats:
    """(N, 3) places of lights from the bearing, in camera axes, from their rays (N, 3).

    Raises
    ------
    ValueError
        If the camera is farther from the bearing than a light.
    """
    return on_sphere(rays_cam, sight.lever_cam_m, sight.radius_m)


def tangent_motion(rays_cam: Floats, sight: Sight = STARS) -> Floats:
    """(N, 2, 3) derivative of the tangents' velocity, 1/s, by the rate of the camera. Errors as `places_cam`."""
    place = places_cam(rays_cam, sight)
    return -tangent_jacobian(place, place - sight.lever_cam_m).reshape(-1, 2, 3)


def center_streak_px(camera: Camera, rate: RateEstimate, exposure_s: float) -> tuple[float, float]:
    """(dx, dy) of the streak of a star at the boresight over an exposure."""
    dx, dy = (
        camera.focal_px
        * exposure_s
        * tangent_motion(np.array([[0.0, 0.0, 1.0]]))[0]
        @ rate.rate_rad_s
    )
    return float(dx), float(dy)


def streak_factor(camera: Camera, velocity_tan_s: Floats) -> Floats:
    """(N,) length of streaks of a velocity (N, 2) in tangents/s, over that in a global shutter: 1 / (1 - v_y tau)."""
    return np.asarray(1 / (1 - camera.focal_px * camera.row_time_s * velocity_tan_s[:, 1]))


def at_middle_row(
    camera: Camera, centroids: Centroids, rate: RateEstimate, sight: Sight = STARS
) -> Centroids:
    """The centroids where they are at mid-exposure of the middle row, as in a global shutter.

    Each ray's place is turned by exp([w] t), t its row's delay. The position depends on the row in which it is found,
    so that its error e becomes (I - tau v e_y') e. The rate's covariance is added to each, as if it were independent.
    """
    if not camera.row_time_s:
        return centroids
    xy_px = centroids.xy_px
    delay_s = camera.row_delays_s(centroids.xy_px)
    rays = camera.rays(xy_px)
    place = places_cam(rays, sight)
    moved_px = camera.pixels(
        Rotation.from_rotvec(delay_s[:, None] * rate.rate_rad_s).apply(place) - sight.lever_cam_m
    )
    moved_px = np.where(np.isfinite(moved_px), moved_px, xy_px)
    motion = tangent_motion(rays, sight)
    gain = error_gain(camera, motion @ rate.rate_rad_s)
    covariance_px2 = gain @ covariance_of(centroids) @ np.swapaxes(gain, 1, 2)
    by_rate = camera.focal_px * motion * delay_s[:, None, None]
    covariance_px2 += by_rate @ rate.covariance_rad2_s2 @ np.swapaxes(by_rate, 1, 2)
    sigma_px = np.sqrt(np.trace(covariance_px2, axis1=1, axis2=2) / 2)
    return replace(centroids, xy_px=moved_px, sigma_px=sigma_px, covariance_px2=covariance_px2)


def error_gain(camera: Camera, velocity_tan_s: Floats) -> Floats:
    """(N, 2, 2) I - tau v e_y': error of a light's position at the middle row by that of its centroid."""
    gain = np.tile(np.eye(2), (len(velocity_tan_s), 1, 1))
    gain[:, :, 1] -= camera.focal_px * camera.row_time_s * velocity_tan_s
    return gain


def covariance_of(centroids: Centroids) -> Floats:
    """(N, 2, 2) covariance of each centroid, px^2."""
    if centroids.covariance_px2 is not None:
        return centroids.covariance_px2
    return np.asarray(centroids.sigma_px[:, None, None] ** 2 * np.eye(2))


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


# Angular rate of the camera from the shape of round lights in one frame of a rolling shutter: a
# first guess.


MIN_LIGHTS = 3
DISK_ROUNDS = 30
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
    rates = [_fit_disks(roots, sigma_px, motion_px, start) for start in starts]
    return [rate for rate in rates if rate is not None]


def _roots(moments_px2: Floats, rows: float, side: int) -> Any:
    """The (N,) complex roots z of N moments, on one side of the mean of both."""
    shape = moments_px2[:, 0] + 1j * moments_px2[:, 1]
    total = moments_px2[:, 2]
    a = (total - np.abs(shape)) / 2
    higher = np.zeros(len(shape), complex)
    quadratic = rows**2 / 12
    for _ in range(DISK_ROUNDS):
        z = (side * np.sqrt(quadratic * (shape - higher) - a**2) - 1j * a) / quadratic
        g2 = 1 / (1 - z.imag) ** 2
        exact = a * (1 + z.real**2 * g2 - g2) + 2j * a * z.real * g2 + quadratic * g2 * z**2
        higher = exact - (quadratic * z**2 + 2j * a * z)
        a = (total - quadratic * g2 * np.abs(z) ** 2) / (1 + z.real**2 * g2 + g2)
    return z


def _fit_disks(
    roots: Any, sigma_px: Floats, motion_px: Floats, start: complex
) -> RateEstimate | None:
    """The rate from one of the two roots (2, N) of each light: the one nearer to the motion by the last rate.

    Parameters
    ----------
    sigma_px
        (2, N) of the roots
    motion_px
        (N, 2, 3) motion of each image from row to row, by the rate
    start
        Root of the median moments
    """
    near = np.full(roots.shape[1], start)
    for _ in range(DISK_ROUNDS):
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
