"""Match of a field of stars to the full catalog, with a fit of the attitude and, where it is wrong, of the camera.

`FieldMatcher.fits` finds whether the camera model explains a solution and all detections near stars. If not,
`FieldMatcher.with_lens` extends the solution over the field with a fit of the camera (`lens_fit`), and `misfits` finds
whether that explains the whole field or only a part of it.

From a candidate attitude of a calibrated camera, `FieldMatcher.refine` takes these steps:

1. Predict the pixels of the catalog stars, and match mutual nearest neighbors within a radius.
2. Fit the attitude; repeat with a smaller radius.
3. Accept the match if it is significant: the expected number of matches this good by chance follows from the binomial
   distribution (`log10_chance`).
4. Compute the covariance, with the errors that the residuals imply.
"""

from dataclasses import dataclass
from functools import cached_property, partial

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
from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.identification.direct_match import mutual_nearest
from estimator.identification.star_detections import information_of
from estimator.identification.star_evidence import Solution
from estimator.trackers import lens_fit, misfit
from estimator.trackers.misfit import Refit
from estimator.trackers.pipeline import Settings, direction_sigma_rad

NO_MATCH = "no identification beyond chance"
MISFIT = "the camera model does not fit the field"
SHEARED = f"{MISFIT}: it is sheared, as by a rolling shutter of a camera that turns"
PARTIAL = f"{MISFIT}: only a part of the stars matches; calibrate the lens"
# Least number of near misses per match for a wrong camera model; centroid errors that are claimed three times too small
# give up to 0.75.
MISFIT_SHARE = 0.8
# Greatest fall of chi-square by the unknowns of the camera with which it is not fitted: 6 degrees of freedom
MAX_FALL = 12.0
# Largest distance of a near miss, as a share of half the diagonal: of a calibrated and of an uncertain camera
NEAR = 0.008
NEAR_UNCERTAIN = 0.03
RADIUS_PX = 2.5  # of a match, for its chance
# A detection brighter than its star by this much is a mismatch: colors, variables and doubles explain less.
TOO_BRIGHT_MAG = 2.0


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
        Relative uncertainty of the focal length
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

    @cached_property
    def prior(self) -> Floats:
        """Standard deviations of the priors of a camera's fit (`lens_fit.prior_sigma`)."""
        return lens_fit.prior_sigma(self.camera, self.focal_uncertainty)

    def refine(
        self, centroids: Centroids, camera: Camera, cam_from_ref: Rotation
    ) -> Attitude:
        """Refine a candidate attitude of a known camera, or refuse it: the numbered steps of the module."""
        for radius_px in [3, 2.5, 2.5]:
            # 1. Matches
            observed, star = self.nearest(centroids, camera, cam_from_ref, radius_px)
            if len(observed) < MIN_MATCHES:
                return Attitude(NO_MATCH)
            # 2. Attitude
            xy = centroids.xy_px[observed]
            vectors = self.stars.vectors[star]
            centroid_rad = direction_sigma_rad(
                centroids.take(observed), camera, self.settings
            )
            sigma_rad = np.hypot(centroid_rad, focal_error_px(camera, xy) / camera.focal_px)
            solver = self.settings.solver
            try:
                cam_from_ref = SOLVERS[solver](camera.rays(xy), vectors, sigma_rad)
            except ValueError as error:
                return Attitude(f"no attitude: {error}")
        # 3. Significance
        chance = self.log10_chance(observed, len(centroids), camera, cam_from_ref, radius_px)
        if chance > ACCEPT_LOG10_CHANCE:
            return Attitude(NO_MATCH)
        # 4. Covariance
        match = StarMatch(observed, star, cam_from_ref, chance, self.stars.v_mag[star])
        return solved_attitude(match, vectors, xy, camera, sigma_rad, solver, 3)

    def with_lens(
        self,
        solution: Solution,
        centroids: Centroids,
        weight: Floats,
        variance: float,
        exact: bool = True,
    ) -> Refit:
        """Extend a solution over the field with a fit of the camera (`lens_fit.grow`).

        Parameters
        ----------
        solution
            Solution by some of the stars
        weight
            (N, 3) inverse covariances of the tangents, as `Detections.weight`
        variance
            Factor of the claimed variances
        exact
            Whether the solution's evidence is by these errors
        """
        information = information_of(weight) / self.camera.focal_px**2
        whiten = np.asarray(np.linalg.cholesky(information), dtype=float).swapaxes(1, 2)
        start = lens_fit.start_of(
            self.camera,
            Rotation.from_quat(solution.cam_from_ref_xyzw),
            solution.focal_ratio,
            variance,
        )
        lens, observed, star, chi2 = lens_fit.grow(
            start,
            lens_fit.Sights(centroids.xy_px, whiten, self.stars.vectors),
            partial(self.nearest, centroids),
            (solution.observed, solution.star),
            self.prior,
            lens_fit.reach_of(len(centroids), self.camera),
        )
        camera = lens.camera
        dex = solution.dex
        if self.focal_uncertainty or not exact:
            chance = self.log10_chance(
                observed,
                len(centroids),
                camera,
                lens.cam_from_ref,
                RADIUS_PX,
                np.count_nonzero(np.diag(lens.covariance)) // 2,
            )
            # A few stars that are kept have their evidence by the search.
            dex = max(-chance, dex if exact and len(star) >= len(solution.star) else -np.inf)
        residual_px = centroids.xy_px[observed] - lens.project(self.stars.vectors[star])[0]
        fitted = Solution(
            observed,
            star,
            lens.cam_from_ref.as_quat(),
            lens.covariance_rad2,
            solution.focal_ratio,
            float(np.sqrt(np.mean(residual_px**2))) / self.camera.focal_px,
            chi2,
            dex,
        )
        return Refit(fitted, camera, lens.variance, lens.sheared)

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

    def fits(self, solution: Solution, centroids: Centroids, weight: Floats) -> bool:
        """Return whether the camera model explains a solution.

        1. The residuals have their expected size.
        2. They have no significant part that the unknowns of `lens_fit` explain: these reduce chi-square by no more
           than MAX_FALL.
        3. No more unmatched detections than by chance are near stars.
        """
        # 1. Size
        count = len(solution.star)
        if solution.chi2 > 1 + 1 / np.sqrt(count):
            return False
        # 2. Fall of chi-square
        cam_from_ref = Rotation.from_quat(solution.cam_from_ref_xyzw)
        start = lens_fit.start_of(self.camera, cam_from_ref, solution.focal_ratio, 1.0)
        pixels, slopes = start.project(self.stars.vectors[solution.star])
        information = information_of(weight[solution.observed]) / self.camera.focal_px**2
        residual = centroids.xy_px[solution.observed] - pixels
        weighted = np.swapaxes(slopes, 1, 2) @ information
        gradient = (weighted @ residual[:, :, None]).sum(axis=0)[:, 0]
        normal = (weighted @ slopes).sum(axis=0)
        falls = []
        for free in range(lens_fit.FOCAL + (self.focal_uncertainty > 0)), self.prior > 0:
            prior = np.diag(1 / self.prior[free] ** 2)
            falls.append(
                gradient[free]
                @ np.linalg.solve(normal[free][:, free] + prior, gradient[free])
            )
        if falls[1] - falls[0] > MAX_FALL:
            return False
        # 3. Near misses
        near, by_chance = self.near_misses(start.camera, solution, centroids)
        return near <= 1 + 2 * by_chance

    def misfits(self, camera: Camera, solution: Solution, centroids: Centroids) -> bool:
        """Return whether stars that just miss a detection are about as many as stars that match one.

        The camera model is then wrong (a rotating camera with a rolling shutter, a strong distortion). The stars that
        match are those of a part of the field, and their attitude is that of this part.
        """
        matched = len(solution.star)
        if len(centroids) - matched < MISFIT_SHARE * matched:
            return False
        near, by_chance = self.near_misses(camera, solution, centroids)
        return bool(near - by_chance > max(MISFIT_SHARE * matched, 3 * np.sqrt(by_chance)))

    def reason_against(self, refitted: Refit, centroids: Centroids) -> str:
        """Return the reason to refuse a solution with its camera; empty if there is none."""
        solution, camera, _, sheared = refitted
        # The field, not the focal length: a distortion changes what a focal length means.
        change = abs(self.camera.fov_rad / camera.fov_rad - 1)
        if self.focal_uncertainty and change > 1.2 * self.focal_uncertainty + 1e-9:
            return NO_MATCH
        if solution.dex < -ACCEPT_LOG10_CHANCE:
            return NO_MATCH
        if sheared:
            return SHEARED
        return PARTIAL if self.misfits(camera, solution, centroids) else ""

    def near_misses(
        self, camera: Camera, solution: Solution, centroids: Centroids
    ) -> tuple[int, float]:
        """Return the number of unmatched detections beside a star, and the number expected by chance."""
        reach_px = np.hypot(self.camera.width_px, self.camera.height_px) / 2
        share = NEAR_UNCERTAIN if self.focal_uncertainty else NEAR
        gate_rad = min((share * reach_px + 2) / self.camera.focal_px, 0.05)
        tangent = camera.tangents(centroids.xy_px)
        gates = np.full(len(centroids), gate_rad)
        R = Rotation.from_quat(solution.cam_from_ref_xyzw).as_matrix()
        near = misfit.count_near(tangent, self.sky, R, 1.0, solution.observed, gates)
        # The gates of all stars cover the share N pi gate^2 / (4 pi) of the sky.
        covered = min(len(self.stars) * gate_rad**2 / 4, 1.0)
        return near, (len(centroids) - len(solution.star)) * covered

    def log10_chance(
        self,
        observed: NDArray,
        blobs: int,
        camera: Camera,
        cam_from_ref: Rotation,
        radius_px: float,
        defining: int = 2,
    ) -> float:
        """Return log10 of the expected number of matches this good by chance, over all patterns tried.

        A false blob falls within the radius of a predicted star with the probability p, the fraction of the sensor that
        the circles cover. The matches that define the unknowns do not count. Faint blobs are mostly false, so the
        binomial tail is computed among the brightest 15, 30, 60 and all of the blobs; the result is the least of these,
        multiplied by their number.

        Parameters
        ----------
        observed
            (K,) rows of the matched blobs, which are in the order of brightness
        blobs
            Number of blobs
        radius_px
            Matching radius
        defining
            Number of matches that define attitude and camera
        """
        rows, _ = self.in_field(camera, cam_from_ref)
        # Covered fraction, with circles that may overlap
        circles = len(rows) * np.pi * radius_px**2
        p = 1 - np.exp(-circles / (camera.width_px * camera.height_px))
        counts = [count for count in (15, 30, 60) if count < blobs] + [blobs]
        tails = []
        for count in counts:
            matches = int((observed < count).sum())
            tails.append(log10_tail(max(count - defining, 0), matches - defining, p))
        return float(min(tails) + np.log10(len(counts)) + np.log10(self.patterns))


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
