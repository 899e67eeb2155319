"""Angular rate of the camera from one frame: from streaks, or from the shape of round lights in a rolling shutter.

Motion of images. A camera that rotates at the rate w, in its own axes, sees a place b from the bearing move as
db/dt = -w x b. The ray is that of q = b - r, with r the lever arm; a star is infinitely far, b = q. The tangents
(q_x / q_z, q_y / q_z) move by -J w, with J the Jacobian of `systematic.geometry` (`tangent_motion`).

Rolling shutter. Row y is exposed tau (y - y_mid) after the middle row. An image that moves at v px/s is found where it
is at mid-exposure of the row in which it is found. This is exact for a constant v and an image that is symmetric about
its center. Its streak in an exposure T is longer than in a global shutter if it moves with the readout:
v T / (1 - v_y tau).

Streaks (`from_streaks`). A light's streak is the path of its image over the exposure: the chord of its tangents is T
times their velocity, linear in w. Weighted least squares over all streaks gives w: across the boresight from their
mean, about the boresight from how they vary over the field. A streak looks the same in both directions, so w and -w
explain one frame equally well.

Round lights (`from_moments`). A rolling shutter stretches and shears the image of a moving disk; its second moments
give a first guess of the rate.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import on_sphere
from estimator.attitude.systematic import geometry
from estimator.core.camera import Camera
from estimator.core.checks import Bools, Floats
from estimator.core.errors import ImageError
from estimator.core.least_squares import misfit_factor
from estimator.core.types import Centroids, RateEstimate

# Motion of the images of a rotating camera.


class Sight(NamedTuple):
    """Geometry of the lights that a camera sees.

    Attributes
    ----------
    lever_cam_m
        (3,) position of the camera from the bearing, in camera axes
    radius_m
        Distance of the lights from the bearing: one number for all, or (N,)
    """

    lever_cam_m: Floats
    radius_m: Floats | float

    def take(self, which: NDArray) -> Sight:
        """Select lights by mask or index."""
        if not isinstance(self.radius_m, np.ndarray):
            return self
        return self._replace(radius_m=self.radius_m[which])


STARS = Sight(np.zeros(3), 1.0)  # without a lever arm the distance has no effect


def places_cam(rays_cam: Floats, sight: Sight) -> Floats:
    """Return the (N, 3) positions b of lights from the bearing, in camera axes, from their rays (N, 3).

    Raises
    ------
    ValueError
        If the camera is farther from the bearing than a light.
    """
    return on_sphere(rays_cam, sight.lever_cam_m, sight.radius_m)


def tangent_motion(rays_cam: Floats, sight: Sight = STARS) -> Floats:
    """Return -J, (N, 2, 3): the derivative of the tangents' velocity, 1/s, with respect to the rate of the camera.

    The errors raised are those of `places_cam`.
    """
    place = places_cam(rays_cam, sight)
    return -geometry(place, place - sight.lever_cam_m).jacobian


def center_streak_px(
    camera: Camera, rate: RateEstimate, exposure_s: float
) -> tuple[float, float]:
    """Return (dx, dy), px, of the streak of a star at the boresight over an exposure."""
    by_rate = tangent_motion(np.array([[0.0, 0.0, 1.0]]))[0]
    dx, dy = camera.focal_px * exposure_s * by_rate @ rate.rate_rad_s
    return float(dx), float(dy)


def streak_factor(camera: Camera, velocity_tan_s: Floats) -> Floats:
    """Return the (N,) ratio of streak lengths in the rolling and in a global shutter: 1 / (1 - v_y tau).

    Parameters
    ----------
    velocity_tan_s
        (N, 2) velocity of the tangents, 1/s
    """
    rows = camera.focal_px * camera.row_time_s * velocity_tan_s[:, 1]  # v_y tau
    return 1 / (1 - rows)


def at_middle_row(
    camera: Camera, centroids: Centroids, rate: RateEstimate, sight: Sight = STARS
) -> Centroids:
    """Return the centroids moved to where they are at mid-exposure of the middle row, as in a global shutter.

    1. Rotate each light's position from the bearing by exp([w] t), with t the delay of its row, and project it.
    2. Propagate the centroid's error e. The time depends on the row in which the centroid is found, so e becomes
       (I - tau v e_y^T) e (`error_gain`).
    3. Add the rate's covariance to each centroid, as if its effects on them were independent.
    """
    if not camera.row_time_s:
        return centroids
    # 1. Position at the time of the middle row; a light that cannot be projected there keeps its own.
    xy_px = centroids.xy_px
    delay_s = camera.row_delays_s(centroids.xy_px)
    rays = camera.rays(xy_px)
    place = places_cam(rays, sight)
    turn = Rotation.from_rotvec(delay_s[:, None] * rate.rate_rad_s)
    moved_px = camera.pixels(turn.apply(place) - sight.lever_cam_m)
    moved_px = np.where(np.isfinite(moved_px), moved_px, xy_px)
    # 2. Error of the centroid
    motion = tangent_motion(rays, sight)
    gain = error_gain(camera, motion @ rate.rate_rad_s)
    covariance_px2 = gain @ covariance_of(centroids) @ gain.mT
    # 3. Error of the rate
    by_rate = camera.focal_px * motion * delay_s[:, None, None]
    covariance_px2 += by_rate @ rate.covariance_rad2_s2 @ by_rate.mT
    sigma_px = np.sqrt(np.trace(covariance_px2, axis1=1, axis2=2) / 2)
    return replace(
        centroids, xy_px=moved_px, sigma_px=sigma_px, covariance_px2=covariance_px2
    )


def error_gain(camera: Camera, velocity_tan_s: Floats) -> Floats:
    """Return I - tau v e_y^T, (N, 2, 2): the map from a centroid's error to that of its position at the middle row."""
    gain = np.tile(np.eye(2), (len(velocity_tan_s), 1, 1))
    gain[:, :, 1] -= camera.focal_px * camera.row_time_s * velocity_tan_s
    return gain


def covariance_of(centroids: Centroids) -> Floats:
    """Return the (N, 2, 2) covariance of each centroid, px^2."""
    if centroids.covariance_px2 is not None:
        return centroids.covariance_px2
    return centroids.sigma_px[:, None, None] ** 2 * np.eye(2)


# Angular rate from streaks.

MIN_STREAKS = 3  # two numbers each, for three components of the rate and a check
# Standard deviation of the prior of each component: it bounds a component that the streaks do not determine.
MAX_RATE_RAD_S = 10.0
# Squared Mahalanobis distance of an outlier: a streak of two lights, or of noise.
OUTLIER_CHI2 = 16.0
ROUNDS = 20  # largest number of iterations of the fit
CONVERGED = 1e-13  # relative change of the rate at which they stop


def from_streaks(
    camera: Camera, centroids: Centroids, exposure_s: float, sight: Sight = STARS
) -> list[RateEstimate]:
    """Return the two rates of opposite sign that explain the streaks of a frame; none with too few streaks.

    1. Convert the streaks to chords in tangents, with their inverse covariances.
    2. Give all chords the sign of their common direction, the eigenvector of sum(W c c^T); then the opposite one.
    3. For each sign, fit the rate by weighted least squares (`_fit`).

    With a rolling shutter the two rates differ a little in size: a streak is longer if it moves with the readout.

    Raises
    ------
    ImageError
        For an exposure that is not finite and above 0.
    """
    if not 0 < exposure_s < np.inf:
        raise ImageError(f"exposure_s: {exposure_s}; allowed: finite, above 0")
    if centroids.streak_px is None or centroids.streak_covariance_px2 is None:
        return []
    measured = np.isfinite(centroids.streak_px[:, 0])
    if measured.sum() < MIN_STREAKS:
        return []
    # 1. Chords, and their derivatives by the rate in a global shutter
    seen = centroids.take(measured)
    chord, information = chords(camera, seen)
    motion = exposure_s * tangent_motion(camera.rays(seen.xy_px), sight.take(measured))
    # 2. Common direction
    weighted = np.einsum("nij,nj,nk->ik", information, chord, chord)
    axis = np.linalg.eigh(weighted + weighted.T)[1][:, -1]
    # 3. One fit for each sign
    signed = (aligned(chord, np.eye(2)[None], sign * axis[None]) for sign in (1, -1))
    rates = [_fit(camera, one, information, motion, exposure_s) for one in signed]
    return [rate for rate in rates if rate is not None]


def image_paths(
    camera: Camera, centroids: Centroids, exposure_s: float
) -> tuple[Floats, Floats, Floats] | None:
    """Return each light's streak (N, 2), px, and by how far its center is off; None without a rate from the streaks.

    The rate that fits all streaks gives those of all lights. The center is off from where the mean attitude of the
    exposure puts the light, by one vector (N, 2) for all images, and by another one along streaks. A camera that
    rotates by the vector r in the exposure, at a constant rate, sees a ray q along exp(-[r] t) q, t from -1/2 to 1/2.
    Its image p(t) is bent, and not equally fast everywhere: with the acceleration a = p'' and t in units of the
    exposure, the image's center of light is at p(0) + a / 24, and the middle between its ends at p(0) + a / 8. The fit
    of a straight streak of equal brightness finds the middle of the ends along the streak, and the center of light
    across it. A rate and its negative have the same a.
    """
    rates = from_streaks(camera, centroids, exposure_s)
    if not rates:
        return None
    rate = rates[0].rate_rad_s
    ray = camera.rays(centroids.xy_px)
    half = Rotation.from_rotvec(0.5 * exposure_s * rate)
    middle, begin, end = (
        camera.pixels(turn.apply(ray)) for turn in (half * half.inv(), half, half.inv())
    )
    # p'' is 4 (p(-1/2) - 2 p(0) + p(1/2))
    bend_px = 4 * (begin + end - 2 * middle)
    streak_px = end - begin
    along = streak_px / np.maximum(np.linalg.norm(streak_px, axis=1), 1e-9)[:, None]
    along_px = np.sum(bend_px * along, axis=1)[:, None] * along
    factor = streak_factor(camera, tangent_motion(ray) @ rate)
    return factor[:, None] * streak_px, bend_px / 24, along_px * (1 / 8 - 1 / 24)


def chords(camera: Camera, centroids: Centroids) -> tuple[Floats, Floats]:
    """Return the (N, 2) chords of streaks in tangents, sign arbitrary, and their (N, 2, 2) inverse covariances."""
    assert centroids.streak_px is not None
    assert centroids.streak_covariance_px2 is not None
    half_px = 0.5 * centroids.streak_px
    begin = camera.tangents(centroids.xy_px - half_px)
    end = camera.tangents(centroids.xy_px + half_px)
    return end - begin, camera.focal_px**2 * inverses(centroids.streak_covariance_px2)


def inverses(matrices: Floats) -> Floats:
    """Return the (N, 2, 2) inverses of covariances."""
    return np.asarray(np.linalg.inv(matrices), dtype=float)


def aligned(chord: Floats, information: Floats, predicted: Floats) -> Floats:
    """Return the (N, 2) chords, each with the sign that is nearer to a predicted one."""
    along = np.einsum("ni,nij,nj->n", predicted, information, chord)
    return chord * np.where(along < 0, -1.0, 1.0)[:, None]


def inliers(residual: Floats, information: Floats) -> Bools:
    """Return (N,) whether a residual (N, 2) is no outlier.

    The limit of the squared Mahalanobis distance is OUTLIER_CHI2, times the median of all where that is above 1: it
    is then the noise that is larger than assumed.
    """
    distance2 = np.einsum("ni,nij,nj->n", residual, information, residual)
    excess = max(1.0, float(np.median(distance2)))
    return distance2 < OUTLIER_CHI2 * excess


def _fit(
    camera: Camera, chord: Floats, information: Floats, motion: Floats, exposure_s: float
) -> RateEstimate | None:
    """Fit the rate to chords by iterated weighted least squares; None if fewer than MIN_STREAKS fit.

    With the derivatives M_i of the chords c_i, their inverse covariances W_i and the prior w ~ N(0, MAX_RATE^2 I),
    the rate is w = N^-1 sum(M_i^T W_i c_i), N = sum(M_i^T W_i M_i) + I / MAX_RATE^2. Each round:

    1. Solve for the rate with the inliers.
    2. Choose each chord's sign by its prediction M_i w.
    3. Reject outliers.
    4. Update the factor by which the rolling shutter changes a streak's length.

    5. The covariance is N^-1, inflated where the chords do not fit (`misfit_factor`).
    """
    keep = np.ones(len(chord), bool)
    factor = np.ones(len(chord))
    rate = np.zeros(3)
    for _ in range(ROUNDS):
        before = rate
        # 1. Least squares
        by_rate = motion * factor[:, None, None]
        weighted = by_rate.mT @ information * keep[:, None, None]
        normal = np.sum(weighted @ by_rate, axis=0) + np.eye(3) / MAX_RATE_RAD_S**2
        rate = np.linalg.solve(normal, np.einsum("nij,nj->i", weighted, chord))
        # 2. Signs
        predicted = by_rate @ rate
        chord = aligned(chord, information, predicted)
        # 3. Outliers
        keep = inliers(chord - predicted, information)
        # 4. Rolling shutter
        factor = streak_factor(camera, motion @ rate / exposure_s)
        if np.linalg.norm(rate - before) < CONVERGED * np.linalg.norm(rate):
            break
    count = int(keep.sum())
    if count < MIN_STREAKS:
        return None
    # 5. Covariance: two residuals a streak, three unknowns
    residual = (chord - predicted)[keep]
    chi2 = float(np.einsum("ni,nij,nj->", residual, information[keep], residual))
    covariance = misfit_factor(chi2, 2 * count - 3) * np.linalg.inv(normal)
    return RateEstimate(rate, covariance, sign_known=False)


# Angular rate from the shape of round lights in one frame of a rolling shutter: a first guess.

MIN_LIGHTS = 3
DISK_ROUNDS = 30
# xx + yy of a disk of 4 px. Pixels and noise dominate the moments of smaller images.
MIN_MOMENT_PX2 = 8.0
# Error of the moments as a fraction of xx + yy. It is common to all lights, as no light is exactly round.
MOMENT_ERROR = 0.01


def from_moments(
    camera: Camera, centroids: Centroids, exposure_s: float, sight: Sight = STARS
) -> list[RateEstimate]:
    """Return the two rates that explain the moments of round lights; none for points or without a rolling shutter.

    A round image of variance a along each axis that moves by (u, w) = v tau from row to row is stretched and sheared to
    a D D^T, D = [[1, u g], [0, g]], g = 1 / (1 - w), and smeared by a streak k g (u, w), with k = T / tau rows. To
    first order in w, with z = u + i w, its second moments are

        (xx - yy) + 2 i xy = k^2 / 12 z^2 + 2 i a z,    xx + yy = 2 a + 2 a w + k^2 / 12 |z|^2.

    1. Solve for both roots z of each light; an iteration subtracts the terms of higher order (`_roots`).
    2. Compute each root's error from that of the moments: the derivative of the first equation is k^2 / 6 z + 2 i a.
    3. Fit a rate to each of the two roots of the median moments, as in `_fit_disks`.

    The two rates of a streak are opposite; the two roots z are not. For a camera at rest only one root is about zero,
    and only one fits the places of the lights.
    """
    if centroids.moments_px2 is None or len(centroids) < MIN_LIGHTS or not camera.row_time_s:
        return []
    if np.median(centroids.moments_px2[:, 2]) < MIN_MOMENT_PX2:
        return []
    # 1. Roots
    moments = centroids.moments_px2
    rows = exposure_s / camera.row_time_s  # k
    roots = np.stack([_roots(moments, rows, side) for side in (1, -1)])
    # 2. Errors of the roots, with 2 a to lowest order
    twice_a = moments[:, 2] - np.hypot(*moments.T[:2])
    sigma_px = MOMENT_ERROR * moments[:, 2] / np.abs(rows**2 / 6 * roots + 1j * twice_a)
    # 3. Rates
    by_rate = tangent_motion(camera.rays(centroids.xy_px), sight)
    motion_px = camera.focal_px * camera.row_time_s * by_rate
    median = np.median(moments, axis=0)[None]
    starts = [_roots(median, rows, side)[0] for side in (1, -1)]
    rates = [_fit_disks(roots, sigma_px, motion_px, start) for start in starts]
    return [rate for rate in rates if rate is not None]


def _roots(moments_px2: Floats, rows: float, side: int) -> Any:
    """Return the (N,) complex roots z of the equation of `from_moments`, on one side of the mean of both.

    The quadratic equation k^2 / 12 z^2 + 2 i a z = shape - higher is solved by fixed-point iteration: `higher` and a
    follow from the exact moments of the last z.
    """
    shape = moments_px2[:, 0] + 1j * moments_px2[:, 1]  # (xx - yy) + 2 i xy
    total = moments_px2[:, 2]
    a = (total - np.abs(shape)) / 2
    higher = np.zeros(len(shape), complex)
    quadratic = rows**2 / 12
    for _ in range(DISK_ROUNDS):
        z = (side * np.sqrt(quadratic * (shape - higher) - a**2) - 1j * a) / quadratic
        # Exact moments of a D D^T plus the streak's, with g^2 = 1 / (1 - w)^2
        g2 = 1 / (1 - z.imag) ** 2
        exact = a * (1 + z.real**2 * g2 - g2) + 2j * a * z.real * g2 + quadratic * g2 * z**2
        higher = exact - (quadratic * z**2 + 2j * a * z)
        a = (total - quadratic * g2 * np.abs(z) ** 2) / (1 + z.real**2 * g2 + g2)
    return z


def _fit_disks(
    roots: Any, sigma_px: Floats, motion_px: Floats, start: complex
) -> RateEstimate | None:
    """Fit the rate to one of the two roots of each light; None if fewer than MIN_LIGHTS are usable.

    Each round:

    1. Take each light's root that is nearer to its motion at the last rate.
    2. Fit the rate to these roots by weighted least squares.

    Parameters
    ----------
    roots
        (2, N) roots, px
    sigma_px
        (2, N) standard deviations of the roots
    motion_px
        (N, 2, 3) derivative of each image's motion from row to row, with respect to the rate
    start
        Root of the median moments
    """
    near = np.full(roots.shape[1], start)
    for _ in range(DISK_ROUNDS):
        # 1. Choice of the root
        side = np.argmin(np.abs(roots - near), axis=0)[None]
        z = np.take_along_axis(roots, side, axis=0)[0]
        sigma = np.take_along_axis(sigma_px, side, axis=0)[0]
        usable = np.isfinite(z) & (sigma > 0)
        if usable.sum() < MIN_LIGHTS:
            return None
        # 2. Weighted least squares
        weighted = motion_px[usable] / sigma[usable, None, None] ** 2
        normal = np.einsum("nij,nik->jk", weighted, motion_px[usable])
        measured = np.column_stack([z.real, z.imag])[usable]
        rate = np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, measured))
        near = (motion_px @ rate) @ np.array([1, 1j])
    # The error of the moments is common to the lights: more of them do not reduce it.
    covariance = usable.sum() * np.linalg.inv(normal)
    return RateEstimate(rate, np.asarray(covariance, dtype=float))
