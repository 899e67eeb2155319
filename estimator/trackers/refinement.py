"""Match of a field of stars to the full catalog, with a fit of the attitude and, where it is uncertain, of the lens.

From a candidate attitude, `FieldMatcher.refine` takes these steps:

1. Predict the pixels of the catalog stars, and match mutual nearest neighbors within a radius.
2. Fit the lens, if it is uncertain, and the attitude; repeat with a smaller radius.
3. Accept the match if it is significant: the expected number of matches this good by chance follows from the binomial
   distribution (`log10_chance`).
4. Compute the covariance, with the errors that the residuals imply.

`misfits` uses the same predictions to find whether the camera model explains the whole field or only a part of it.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import SOLVERS, covariance
from estimator.attitude.systematic import focal_error_px, with_focal_error
from estimator.catalog.catalog import StarCatalog
from estimator.catalog.sky_index import SkyIndex
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.least_squares import fit_soft_l1
from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.identification.direct_match import mutual_nearest
from estimator.identification.refusals import NO_MATCH
from estimator.identification.star_evidence import Solution
from estimator.trackers import misfit
from estimator.trackers.pipeline import Settings, direction_sigma_rad

# Least number of near misses per match for a wrong camera model; centroid errors that are claimed three times too small
# give up to 0.75.
MISFIT_SHARE = 0.8
# Largest radial distortion of an undistorted lens, in standard deviations
MAX_DISTORTION_SIGMA = 1.5
# A detection brighter than its star by this much is a mismatch: colors, variables and doubles explain less.
TOO_BRIGHT_MAG = 2.0
BEHIND = 1e-3  # least z of a direction in the lens fit
# The lens fit ends at a step that lowers the loss by this fraction: sqrt(N / 10^6) standard deviations for N stars.
CONVERGED_FALL = 1e-6


@dataclass(frozen=True)
class FieldMatcher:
    """Matches detections to the catalog stars that a candidate attitude predicts on the sensor.

    Attributes
    ----------
    camera
        On-board calibration
    stars
        Catalog stars with apparent directions and magnitudes
    sky
        Index of the same stars
    focal_uncertainty
        Relative uncertainty of the focal length; unless it is 0, the lens is fitted with the
        attitude
    patterns
        Number of patterns that were searched, for the expected number of chance matches
    """

    camera: Camera
    stars: StarCatalog
    sky: SkyIndex
    settings: Settings
    focal_uncertainty: float
    patterns: int

    @cached_property
    def tree(self) -> cKDTree:
        """Directions of the stars, to find those of a field."""
        return cKDTree(self.stars.vectors)

    @property
    def lens_radii_px(self) -> list[float]:
        """Matching radii with an uncertain lens: the first allow for its error at the corner; each fit reduces it."""
        reach_px = np.hypot(self.camera.width_px, self.camera.height_px) / 2
        return [0.008 * reach_px + 2, 0.004 * reach_px + 2, 4, 3, 2.5, 2.5]

    def refine(
        self, centroids: Centroids, camera: Camera, cam_from_ref: Rotation
    ) -> Attitude:
        """Refine a candidate attitude, or refuse it: the numbered steps of the module.

        If the focal length is uncertain, each round also fits the camera (`fit_camera`), and the result must be within
        1.2 times the uncertainty.
        """
        fit_lens = self.focal_uncertainty > 0
        for radius_px in self.lens_radii_px if fit_lens else [3, 2.5, 2.5]:
            # 1. Matches
            observed, star = self.nearest(centroids, camera, cam_from_ref, radius_px)
            if len(observed) < MIN_MATCHES:
                return Attitude(NO_MATCH)
            # 2. Lens and attitude
            xy = centroids.xy_px[observed]
            vectors = self.stars.vectors[star]
            if fit_lens:
                camera, cam_from_ref = fit_camera(camera, cam_from_ref, xy, vectors)
            rays = camera.rays(xy)
            centroid_rad = direction_sigma_rad(
                centroids.take(observed), camera, self.settings
            )
            sigma_rad = np.hypot(centroid_rad, focal_error_px(camera, xy) / camera.focal_px)
            try:
                cam_from_ref = SOLVERS[self.settings.solver](rays, vectors, sigma_rad)
            except ValueError as error:
                return Attitude(f"no attitude: {error}")
        # 3. Significance
        rows, _ = self.in_field(camera, cam_from_ref)
        chance = log10_chance(
            observed, len(centroids), len(rows), radius_px, camera, self.patterns
        )
        if chance > ACCEPT_LOG10_CHANCE:
            return Attitude(NO_MATCH)
        # The field, not the focal length: a distortion changes what a focal length means.
        if (
            abs(self.camera.fov_rad / camera.fov_rad - 1)
            > 1.2 * self.focal_uncertainty + 1e-9
        ):
            return Attitude(NO_MATCH)
        # 4. Covariance
        match = StarMatch(observed, star, cam_from_ref, chance, self.stars.v_mag[star])
        parameters = 5 if fit_lens else 3
        return solved_attitude(
            match, vectors, xy, camera, sigma_rad, self.settings.solver, parameters
        )

    def in_field(self, camera: Camera, cam_from_ref: Rotation) -> tuple[NDArray, Floats]:
        """Return rows and pixels of the catalog stars on the sensor, brightest first."""
        # Stars within half the diagonal of the boresight, as a chord with a margin
        boresight = cam_from_ref.inv().apply([0.0, 0.0, 1.0])
        chord = 2 * np.sin(camera.diagonal_rad / 4) * 1.05
        rows = np.array(self.tree.query_ball_point(boresight, chord), int)
        rows.sort()
        xy = np.empty((0, 2))
        if len(rows):
            xy = camera.pixels(cam_from_ref.apply(self.stars.vectors[rows]))
        inside = camera.contains(xy, -2.0)
        return rows[inside], xy[inside]

    def nearest(
        self, centroids: Centroids, camera: Camera, cam_from_ref: Rotation, radius_px: float
    ) -> tuple[NDArray, NDArray]:
        """Return mutual nearest neighbors of centroids and catalog stars within a radius, without much too bright ones.

        They are given as rows of the centroids and of the stars.
        """
        rows, xy = self.in_field(camera, cam_from_ref)
        observed, star = mutual_nearest(centroids.xy_px, xy, radius_px, rows)
        if len(star) < MIN_MATCHES:
            return observed, star
        # The zero point from each match is about the same for all stars; saturation loses flux and makes it smaller.
        # One far above the median is a planet, a lamp or a reflection near a faint star.
        zero_mag = self.stars.v_mag[star] + 2.5 * np.log10(centroids.flux[observed])
        excess_mag = zero_mag - np.median(zero_mag)
        plausible = excess_mag < max(TOO_BRIGHT_MAG, 4 * float(np.median(np.abs(excess_mag))))
        return observed[plausible], star[plausible]

    def fits(self, solution: Solution, centroids: Centroids, sigma_px: Floats) -> bool:
        """Return whether an undistorted lens explains a solution.

        1. The residuals have their expected size.
        2. They have no significant part q = r^3 - c r from a radial distortion; c makes q orthogonal to r, which a
           focal length explains.
        3. No more unmatched detections than by chance are near stars.
        """
        # 1. Size
        count = len(solution.star)
        observed = solution.observed
        if solution.chi2 > 1 + 1 / np.sqrt(count):
            return False
        # 2. Radial distortion: the projection of the residuals on q over its standard deviation
        camera = self.camera.zoomed(solution.focal_ratio)
        cam_from_ref = Rotation.from_quat(solution.cam_from_ref_xyzw)
        xy_px = centroids.xy_px[observed]
        residual_px = xy_px - camera.pixels(
            cam_from_ref.apply(self.stars.vectors[solution.star])
        )
        offset = (xy_px - camera.center_px) / camera.focal_px
        r2 = np.sum(offset**2, axis=1)
        q = r2 - np.sum(r2**2) / np.sum(r2)  # over r
        projection = np.sum(q * np.sum(offset * residual_px, axis=1))
        score = projection / np.sqrt(np.sum(q**2 * r2 * sigma_px[observed] ** 2))
        if abs(score) > MAX_DISTORTION_SIGMA:
            return False
        # 3. Near misses
        near, by_chance = self.near_misses(solution, centroids)
        return near <= 1 + 2 * by_chance

    def misfits(self, solution: Solution, centroids: Centroids) -> bool:
        """Return whether stars that just miss a detection are about as many as stars that match one.

        The camera model is then wrong (a rotating camera with a rolling shutter, a strong distortion). The stars that
        match are those of a part of the field, and their attitude is that of this part.
        """
        matched = len(solution.star)
        if len(centroids) - matched < MISFIT_SHARE * matched:
            return False
        near, by_chance = self.near_misses(solution, centroids)
        return bool(near - by_chance > max(MISFIT_SHARE * matched, 3 * np.sqrt(by_chance)))

    def near_misses(self, solution: Solution, centroids: Centroids) -> tuple[int, float]:
        """Return the number of unmatched detections beside a star, and the number expected by chance."""
        gate_rad = min(self.lens_radii_px[0] / self.camera.focal_px, 0.05)
        tangent = self.camera.tangents(centroids.xy_px)
        gates = np.full(len(centroids), gate_rad)
        R = Rotation.from_quat(solution.cam_from_ref_xyzw).as_matrix()
        near = misfit.count_near(
            tangent, self.sky, R, solution.focal_ratio, solution.observed, gates
        )
        # The gates of all stars cover the share N pi gate^2 / (4 pi) of the sky.
        covered = min(len(self.stars) * gate_rad**2 / 4, 1.0)
        return near, (len(centroids) - len(solution.star)) * covered


def solved_attitude(
    match: StarMatch,
    vectors_ref: Floats,
    xy_px: Floats,
    camera: Camera,
    sigma_rad: Floats,
    solver: str,
    parameters: int,
) -> Attitude:
    """Return the attitude of K matches with its covariance, for the errors that the residuals imply.

    Parameters
    ----------
    vectors_ref, xy_px, sigma_rad
        (K, 3) directions of the stars, (K, 2) centroids, and their (K,) claimed errors
    solver
        Solver of the attitude
    parameters
        Number of parameters of the fit
    """
    seen_cam = match.cam_from_ref.apply(vectors_ref)
    residual_px = camera.pixels(seen_cam) - xy_px
    residual = residual_px / (camera.focal_px * sigma_rad)[:, None]
    sigma_rad = sigma_rad * np.sqrt(misfit.variance_of(residual, parameters))
    covariance_rad2 = covariance(camera.rays(xy_px), sigma_rad, solver)
    covariance_rad2, common_rad2 = with_focal_error(
        covariance_rad2, camera, xy_px, seen_cam, sigma_rad
    )
    rms_px = float(np.sqrt(np.mean(residual_px**2)))
    return Attitude(
        "solved", match.cam_from_ref, covariance_rad2, match, rms_px, camera, common_rad2
    )


def log10_chance(
    observed: NDArray,
    blobs: int,
    predicted: int,
    radius_px: float,
    camera: Camera,
    patterns: int,
) -> float:
    """Return log10 of the expected number of matches this good by chance, over all patterns tried.

    A false blob falls within the radius of a predicted star with the probability p, the fraction of the sensor that the
    circles cover. Two matches define the attitude and do not count. Faint blobs are mostly false, so the binomial tail
    is computed among the brightest 15, 30, 60 and all of the blobs; the result is the least of these, multiplied by
    their number.

    Parameters
    ----------
    observed
        (K,) rows of the matched blobs, which are in the order of brightness
    blobs, predicted
        Numbers of blobs and of predicted stars in the field
    radius_px
        Matching radius
    patterns
        Number of patterns that were tried
    """
    # Covered fraction, with circles that may overlap
    p = 1 - np.exp(-predicted * np.pi * radius_px**2 / (camera.width_px * camera.height_px))
    counts = [count for count in (15, 30, 60) if count < blobs] + [blobs]
    tails = []
    for count in counts:
        matches = int((observed < count).sum())
        tails.append(log10_tail(max(count - 2, 0), matches - 2, p))
    return float(min(tails) + np.log10(len(counts)) + np.log10(patterns))


def fit_camera(
    camera: Camera, cam_from_ref: Rotation, xy_px: Floats, vectors_ref: Floats
) -> tuple[Camera, Rotation]:
    """Fit attitude, focal length and (with 12 stars or more) the first radial distortion coefficient to the pixels.

    The fit is robust (soft L1 loss beyond one pixel), so that a wrong match has little effect on the lens.
    """
    count = 5 if len(xy_px) >= 12 else 4
    k1 = camera.distortion[0]
    start = np.zeros(count)
    start[4:] = k1
    R_cam_from_ref = cam_from_ref.as_matrix()

    def residual(p: Floats) -> Floats:
        # As `Camera.pixels`, without its checks: this runs a hundred times a frame.
        x, y, z = Rotation.from_rotvec(p[:3]).as_matrix() @ R_cam_from_ref @ vectors_ref.T
        tangent = np.column_stack([x, y]) / np.maximum(z, BEHIND)[:, None]
        radial = 1 + (p[4] if count == 5 else k1) * np.sum(tangent**2, axis=1)
        pixels = camera.focal_px * np.exp(p[3]) * radial[:, None] * tangent + camera.center_px
        return (pixels - xy_px).ravel()

    # Rotation (rad), log focal length, k1
    scale = np.array([1e-3, 1e-3, 1e-3, 1e-2, 0.3])[:count]
    found = fit_soft_l1(residual, start, scale, CONVERGED_FALL)
    k1 = float(found[4]) if count == 5 else k1
    lens = replace(
        camera,
        focal_px=camera.focal_px * float(np.exp(found[3])),
        distortion=(k1, 0.0, 0.0, 0.0, 0.0),
    )
    return lens, Rotation.from_rotvec(found[:3]) * cam_from_ref
