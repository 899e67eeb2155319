"""Fit of attitude and camera to the stars of a field, grown from the few stars of a candidate over the whole field.

A wrong camera model (pixels that are not square, a distortion, a drifted focal length) lets the stars of one part of
the field match, at an attitude that fits this part. Statistics of these stars cannot show it. `grow` therefore extends
the match over the field by the prediction's own uncertainty. The unknowns p are a small rotation, the logarithms of the
focal length and of the aspect, a shear s, a twist u, and the distortion's k1, k2, p1 and p2. With the distorted
tangents t' of a star,

    x = c_x + f (t'_x + s t'_y - u t'_y^2),    y = c_y + f (a t'_y + s t'_x + u t'_x t'_y)

The camera's numbers have normal priors about what the tracker was given. The steps:

1. Fit p to the matches: Gauss-Newton with the weights of a soft L1 loss, which gives the posterior covariance P.
2. Predict every star in the field. With the slopes J of its pixel, the prediction has the covariance J P J^T.
3. Match the stars whose uncertainty is less than the distance at which false lights become likely, each with a gate of
   its own uncertainty and the centroid's error: the field grows outward as P falls (the gate of a Kalman filter:
   Bar-Shalom & Fortmann, Tracking and Data Association, section 5.4).
4. Repeat from 1 until the matches stay the same.
5. Drop the unknowns that the matches do not ask for: those within few standard deviations of what was given.
6. Fit again without loss weights, and reject matches beyond GATE_SIGMA.

A camera has neither shear nor twist. Rows that are exposed one after another stretch, shear and twist the image of a
turning camera by its rates about x, y and z; refraction shears it, and so does the principal point of a wide lens. The
shear is symmetric: it has no part that looks like a rotation. Displaced rows, however, are this shear and a rotation by
s. The roll is therefore ambiguous by s, which is added to the covariance; beyond MAX_SHEAR the field is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import exp

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.systematic import geometry
from estimator.core.camera import Camera, distorted, distortion_slopes
from estimator.core.checks import Floats, frozen
from estimator.core.least_squares import variance_factor
from estimator.identification.chance import GATE_SIGMA, MIN_EVIDENCE_MATCHES

# Unknowns: rotation, log focal length, log aspect, shear, twist, k1, k2, p1, p2
UNKNOWNS = 11
FOCAL, ASPECT, SHEAR, TWIST, K1 = range(3, 8)
# Groups that are dropped together if the matches do not ask for them
GROUPS = [9, 10], [7, 8], [4, 5, 6]
# Least standard deviations of the priors: relative focal length, aspect and shear; relative distortion at the corner,
# radial and tangential
LEAST_PRIOR = 0.01
LEAST_TANGENTIAL = 0.002
WIDEST_PRIOR = 0.05  # largest for an uncertain camera: pixels are seldom farther off square
MAX_FALSE = 0.1  # greatest expected number of false lights within the reach of a match
LEAST_GATE_PX = 1.5  # least gate while the match grows
ROUNDS = 12
STEPS = 3  # Gauss-Newton steps
MEDIAN_CHI2 = 1.386  # of chi-square with two degrees of freedom
NEEDED_SIGMA = 2.0  # standard deviations within which a group of unknowns is dropped
MOST_SIGMA = 5.0  # largest change of a camera's number, in standard deviations of its prior
MAX_SHEAR = 1e-3
SHEAR_SIGMA = 4.5  # significance of a shear for which a field is refused

# Function of camera, attitude and radius in pixels that returns rows of centroids and of stars
Match = Callable[[Camera, Rotation, float], tuple[NDArray, NDArray]]


def prior_sigma(camera: Camera, focal_uncertainty: float) -> Floats:
    """Return the (UNKNOWNS,) standard deviations of the priors for a relative uncertainty of the focal length.

    A rolling shutter's shear and stretch belong to the rate, which is fitted elsewhere: they are then 0.
    """
    corner = float(np.tan(camera.diagonal_rad / 2))
    stretch = (
        0.0 if camera.row_time_s else np.clip(focal_uncertainty, LEAST_PRIOR, WIDEST_PRIOR)
    )
    radial = np.clip(2 * focal_uncertainty, LEAST_PRIOR, 2 * WIDEST_PRIOR)
    tangential = max(0.1 * radial, LEAST_TANGENTIAL) / corner
    return np.array(
        [np.inf] * 3
        + [max(focal_uncertainty, LEAST_PRIOR), stretch, stretch, stretch]
        + [radial / corner**2, radial / corner**4, tangential, tangential]
    )


@frozen
class FittedCamera:
    """A fitted attitude and camera.

    Attributes
    ----------
    given
        Camera about which the unknowns have their priors
    cam_from_ref
        Attitude
    change
        (UNKNOWNS,) changes of the camera's numbers; those of the rotation are 0
    covariance
        (UNKNOWNS, UNKNOWNS) posterior covariance, with the variances times `variance`
    variance
        Factor of the claimed variances
    """

    given: Camera
    cam_from_ref: Rotation
    change: Floats
    covariance: Floats
    variance: float

    @property
    def camera(self) -> Camera:
        """The fitted camera, without shear and twist."""
        distortion = np.add(self.given.distortion, np.append(self.change[K1:], 0.0))
        return replace(
            self.given,
            focal_px=self.given.focal_px * exp(self.change[FOCAL]),
            aspect=self.given.aspect * exp(self.change[ASPECT]),
            distortion=tuple(distortion.tolist()),
        )

    @property
    def sheared(self) -> bool:
        """Whether the field has a significant shear that is too great for an attitude."""
        sigma = np.sqrt(self.covariance[SHEAR, SHEAR])
        return bool(abs(self.change[SHEAR]) > max(MAX_SHEAR, SHEAR_SIGMA * sigma))

    @property
    def covariance_rad2(self) -> Floats:
        """(3, 3) covariance of the attitude, with the roll's ambiguity by the shear."""
        return self.covariance[:3, :3] + np.diag([0, 0, self.change[SHEAR] ** 2])

    def project(self, vectors_ref: Floats) -> tuple[Floats, Floats]:
        """Return the (K, 2) pixels of directions, and their (K, 2, UNKNOWNS) slopes by the unknowns."""
        camera = self.camera
        focal_px = camera.focal_px
        seen = self.cam_from_ref.apply(vectors_ref)
        jacobian, _, tangent = geometry(seen, seen)
        shear, twist = self.change[[SHEAR, TWIST]]
        stretch = focal_px * np.array([[1.0, shear], [shear, camera.aspect]])
        bent = distorted(tangent, camera.distortion)
        by_tangent, by_coefficients = distortion_slopes(tangent, camera.distortion)
        by_twist = focal_px * bent[:, 1:] * bent[:, ::-1] * [-1.0, 1.0]
        offset = bent @ stretch + twist * by_twist
        slopes = np.zeros((len(seen), 2, UNKNOWNS))
        slopes[:, :, :FOCAL] = stretch @ by_tangent @ jacobian
        slopes[:, :, FOCAL] = offset
        slopes[:, 1, ASPECT] = focal_px * camera.aspect * bent[:, 1]
        slopes[:, :, SHEAR] = focal_px * bent[:, ::-1]
        slopes[:, :, TWIST] = by_twist
        slopes[:, :, K1:] = stretch @ by_coefficients[:, :, :4]
        return offset + camera.center_px, slopes

    def needed(self, prior: Floats) -> NDArray:
        """Return (UNKNOWNS,) whether each unknown is kept: the rotation, what is uncertain, and significant groups.

        A group with the values p and the covariance block C has the squared significance p^T C^-1 p. Values and
        covariance of the others are conditioned on 0 for each group that is dropped.
        """
        keep = prior > 0
        change = self.change
        covariance = self.covariance
        for group in GROUPS if prior[FOCAL] > LEAST_PRIOR else (*GROUPS, [FOCAL]):
            rows = [n for n in group if keep[n]]
            inverse = np.linalg.inv(covariance[np.ix_(rows, rows)])
            if change[rows] @ inverse @ change[rows] <= NEEDED_SIGMA**2 * len(rows):
                gain = covariance[:, rows] @ inverse
                change = change - gain @ change[rows]
                covariance = covariance - gain @ covariance[rows]
                keep[rows] = False
        return keep


@frozen
class Sights:
    """Centroids and stars of a field.

    Attributes
    ----------
    xy_px
        (N, 2) centroids
    whiten
        (N, 2, 2) transposed Cholesky factors of the inverse covariances of the centroids, 1/px
    vectors_ref
        (M, 3) directions of the stars
    match
        Function that pairs centroids and stars
    """

    xy_px: Floats
    whiten: Floats
    vectors_ref: Floats
    match: Match

    def grow(
        self, lens: FittedCamera, pairs: NDArray, prior: Floats
    ) -> tuple[FittedCamera, NDArray, float]:
        """Extend a candidate over the field: the numbered steps of the module.

        Parameters
        ----------
        pairs
            (2, K) rows of the candidate's centroids and of its stars
        prior
            (UNKNOWNS,) standard deviations of the priors; 0 for what is not fitted

        Returns
        -------
        FittedCamera
            The fitted camera and attitude
        pairs
            (2, K) rows of the matched centroids and stars
        chi2
            Reduced chi-square of the claimed errors
        """
        # 1. to 4. Growth
        for _ in range(ROUNDS):
            lens, _, _ = self.fit(lens, pairs, prior, True)
            before = pairs
            pairs = self._matched(lens)
            if pairs.shape[1] < MIN_EVIDENCE_MATCHES:
                return lens, before, np.inf
            if np.array_equal(pairs, before):
                break
        # 5. Unknowns that are needed
        prior = np.where(lens.needed(prior), prior, 0.0)
        # 6. Final fit
        lens, _, _ = self.fit(lens, pairs, prior, True)
        pairs = self._matched(lens)
        for _ in range(STEPS):
            lens, distance2, chi2 = self.fit(lens, pairs, prior, False)
            near = distance2 <= GATE_SIGMA**2 * lens.variance
            if near.all() or near.sum() < MIN_EVIDENCE_MATCHES:
                break
            pairs = pairs[:, near]
        return lens, pairs, chi2

    def _matched(self, lens: FittedCamera) -> NDArray:
        """Return the pairs of centroids and stars within the gates of the prediction: steps 2 and 3."""
        # MAX_FALSE random lights are within this distance.
        pixels = lens.given.width_px * lens.given.height_px
        reach_px = np.sqrt(MAX_FALSE * pixels / np.pi / len(self.xy_px))
        pairs = np.array(self.match(lens.camera, lens.cam_from_ref, reach_px))
        observed, star = pairs
        seen_px, slopes = lens.project(self.vectors_ref[star])
        spread = slopes @ lens.covariance @ slopes.mT
        gate_px = GATE_SIGMA * np.sqrt(np.trace(spread, axis1=1, axis2=2))
        least = np.linalg.norm(self.whiten[observed], ord=-2, axis=(1, 2))
        own_px = np.maximum(GATE_SIGMA * np.sqrt(lens.variance) / least, LEAST_GATE_PX)
        distance_px = np.linalg.norm(self.xy_px[observed] - seen_px, axis=1)
        near = (distance_px <= np.hypot(gate_px, own_px)) & (gate_px <= reach_px)
        return pairs[:, near]

    def fit(
        self,
        lens: FittedCamera,
        pairs: NDArray,
        prior: Floats,
        robust: bool,
        steps: int = STEPS,
    ) -> tuple[FittedCamera, Floats, float]:
        """Fit the unknowns to matches by Gauss-Newton, with the factor of the variances that the residuals imply.

        Parameters
        ----------
        pairs
            (2, K) rows of the centroids and of the stars
        prior
            (UNKNOWNS,) standard deviations about the given camera; 0 for what is not fitted
        robust
            Whether matches have the weights 1 / sqrt(1 + d^2 / v) of a soft L1 loss, d the Mahalanobis distance and v
            the factor of the variances, which then is that of the median distance

        Returns
        -------
        FittedCamera
            The fitted camera and attitude
        distance2
            (K,) squared Mahalanobis distances
        chi2
            Reduced chi-square
        """
        observed, star = pairs
        free = prior > 0
        information = np.diag(1 / np.where(free, prior, 1.0) ** 2)
        for _ in range(steps):
            # Linearization: slopes and residual of each pair, whitened
            seen_px, slopes = lens.project(self.vectors_ref[star])
            residual = self.xy_px[observed] - seen_px
            rows = self.whiten[observed] @ np.dstack([slopes * free, residual])
            distance2 = np.sum(rows[:, :, -1] ** 2, axis=1) / lens.variance
            weight = 1 / np.sqrt(1 + robust * distance2) / lens.variance
            # Step
            normal = np.einsum("kia,k,kib->ab", rows, weight, rows)
            inverse = np.linalg.inv(normal[:-1, :-1] + information)
            step = inverse @ (normal[:-1, -1] - information @ lens.change)
            # Factor of the variances; `used` is the number of unknowns that the matches determine.
            distance2 = np.sum((rows @ np.append(-step, 1.0)) ** 2, axis=1)
            used = float(np.sum(inverse * normal[:-1, :-1]))
            dof = max(2 * len(star) - used, 1.0)
            chi2 = float(distance2.sum())
            if robust:
                median = float(np.median(distance2)) / MEDIAN_CHI2
                variance = max(1.0, median * 2 * len(star) / dof)
            else:
                variance = variance_factor(chi2, dof)
            most = MOST_SIGMA * prior[FOCAL:]
            lens = FittedCamera(
                lens.given,
                Rotation.from_rotvec(step[:FOCAL]) * lens.cam_from_ref,
                np.append(
                    np.zeros(FOCAL), np.clip((lens.change + step)[FOCAL:], -most, most)
                ),
                inverse * np.outer(free, free) * (variance / lens.variance),
                variance,
            )
        return lens, distance2, chi2 / dof
