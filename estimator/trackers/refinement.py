"""Match of a field of stars to the full catalog, with a fit of the attitude and, where it is wrong, of the camera.

`FieldMatcher.fits` finds whether the camera model explains a solution and all detections near stars. If not,
`FieldMatcher.with_lens` extends the solution over the field with a fit of the camera (`lens_fit`), and `misfits` finds
whether that explains the whole field or only a part of it.
The match of candidates that have no evidence of their own is accepted if it is significant: the expected number of
matches this good by chance follows from the binomial distribution (`log10_chance`).
"""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.catalog.catalog import StarCatalog
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids
from estimator.core.vectors import rms
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.identification.direct_match import mutual_nearest
from estimator.identification.refusals import NO_MATCH, WRONG_SCALE
from estimator.identification.star_detections import information_of
from estimator.identification.star_evidence import Solution
from estimator.identification.star_search import WRONG_FOCAL
from estimator.trackers import lens_fit
from estimator.trackers.misfit import Refit, residuals_too_great

MISFIT = "the camera model does not fit the field"
SHEARED = f"{MISFIT}: it is sheared, as by a rolling shutter of a camera that turns"
PARTIAL = f"{MISFIT}: only a part of the stars matches; calibrate the lens"
# Least number of near misses per match for a wrong camera model; centroid errors that are claimed three times too small
# give up to 0.75.
MISFIT_SHARE = 0.8
# Largest distances of a near miss, as shares of half the diagonal: of a calibrated and of an uncertain camera
NEAR = (0.008, 0.03)
NEAR_UNCERTAIN = (0.03, 0.06)
RADIUS_PX = 2.5  # of a match, for its chance
KEPT_VARIANCE = 4.0  # factor of the variances to which a search's evidence holds after the fit of the camera
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
    focal_uncertainty
        Relative uncertainty of the focal length
    patterns
        Number of patterns that were searched, for the expected number of chance matches
    """

    camera: Camera
    stars: StarCatalog
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
        sights, start, pairs = self._start(solution, centroids, weight, variance)
        lens, pairs, chi2 = sights.grow(start, pairs, self.prior)
        observed, star = np.ascontiguousarray(pairs)  # compiled functions have one layout
        camera = lens.camera
        dex = solution.dex
        if self.focal_uncertainty or not exact:
            chance = log10_chance(
                observed,
                len(centroids),
                len(self.in_field(camera, lens.cam_from_ref)[0]),
                RADIUS_PX,
                camera,
                self.patterns,
                int(np.count_nonzero(np.diag(lens.covariance))) // 2,
            )
            # A few stars that are kept, with their claimed errors, have their evidence by the search.
            kept = len(star) >= len(solution.star) and lens.variance < KEPT_VARIANCE
            dex = max(-chance, dex if kept else -np.inf)
            # The field, not the focal length: a distortion changes what a focal length means.
            change = abs(self.camera.fov_rad / camera.fov_rad - 1)
            if change > 1.2 * (self.focal_uncertainty or WRONG_FOCAL):
                dex = -np.inf
        residual_px = centroids.xy_px[observed] - lens.project(self.stars.vectors[star])[0]
        fitted = Solution(
            observed,
            star,
            lens.cam_from_ref.as_quat(),
            lens.covariance_rad2,
            solution.focal_ratio,
            rms(residual_px) / self.camera.focal_px,
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

    def _start(
        self, solution: Solution, centroids: Centroids, weight: Floats, variance: float
    ) -> tuple[lens_fit.Sights, lens_fit.FittedCamera, NDArray]:
        """Return centroids and a solution as input of the fit of the camera; parameters as of `with_lens`."""
        information = information_of(weight) / self.camera.focal_px**2
        whiten = np.asarray(np.linalg.cholesky(information), dtype=float).mT
        change = np.zeros(lens_fit.UNKNOWNS)
        change[lens_fit.FOCAL] = np.log(solution.focal_ratio)
        cam_from_ref = Rotation.from_quat(solution.cam_from_ref_xyzw)
        unknown = np.zeros(2 * change.shape)
        return (
            lens_fit.Sights(
                centroids.xy_px, whiten, self.stars.vectors, partial(self.nearest, centroids)
            ),
            lens_fit.FittedCamera(self.camera, cam_from_ref, change, unknown, variance),
            np.array([solution.observed, solution.star]),
        )

    def fits(self, solution: Solution, centroids: Centroids, weight: Floats) -> bool:
        """Return whether a camera with another focal length explains a solution.

        1. The residuals have their expected size.
        2. They ask for none of the other unknowns of the fit of the camera (`lens_fit.needed_of`).
        3. No more unmatched detections than by chance are near stars.
        """
        # 1. Size
        if residuals_too_great(solution):
            return False
        # 2. Unknowns
        sights, start, pairs = self._start(solution, centroids, weight, 1.0)
        lens, _, _ = sights.fit(start, pairs, self.prior, False, 1)
        if lens.needed(self.prior)[lens_fit.ASPECT :].any():
            return False
        # 3. Near misses
        near, by_chance = self.near_misses(start.camera, solution, centroids)[0]
        return near <= 1 + 2 * by_chance

    def misfits(self, camera: Camera, solution: Solution, centroids: Centroids) -> bool:
        """Return whether stars that just miss a detection are about as many as stars that match one.

        The camera model is then wrong (a rotating camera with a rolling shutter, a strong distortion). The stars that
        match are those of a part of the field, and their attitude is that of this part.
        """
        matched = len(solution.star)
        if len(centroids) - matched < MISFIT_SHARE * matched:
            return False
        return any(
            near - by_chance > max(MISFIT_SHARE * matched, 3 * np.sqrt(by_chance))
            for near, by_chance in self.near_misses(camera, solution, centroids)
        )

    def reason_against(self, refitted: Refit, centroids: Centroids) -> str:
        """Return the reason to refuse a solution with its camera; empty if there is none."""
        solution, camera, _, sheared, _ = refitted
        if solution.dex < -ACCEPT_LOG10_CHANCE:
            return WRONG_SCALE if solution.dex == -np.inf else NO_MATCH
        if sheared:
            return SHEARED
        return PARTIAL if self.misfits(camera, solution, centroids) else ""

    def near_misses(
        self, camera: Camera, solution: Solution, centroids: Centroids
    ) -> list[tuple[int, float]]:
        """Return the number of unmatched detections beside an unmatched star, and that by chance, for each distance."""
        size_px = self.camera.width_px, self.camera.height_px
        cam_from_ref = Rotation.from_quat(solution.cam_from_ref_xyzw)
        rows, star_px = self.in_field(camera, cam_from_ref)
        star_px = star_px[~np.isin(rows, solution.star)]
        others_px = np.delete(centroids.xy_px, solution.observed, axis=0)
        if not len(star_px):
            return [(0, 0.0)]
        distance_px, _ = cKDTree(star_px).query(others_px)
        found = []
        for share in NEAR_UNCERTAIN if self.focal_uncertainty else NEAR:
            gate_px = share * np.hypot(*size_px) / 2 + 2
            # The gates of all stars cover this share of the sensor.
            covered = min(len(star_px) * np.pi * gate_px**2 / np.prod(size_px), 1.0)
            found.append((int(np.sum(distance_px < gate_px)), len(others_px) * covered))
        return found


def log10_chance(
    observed: NDArray,
    blobs: int,
    predicted: int,
    radius_px: float,
    camera: Camera,
    patterns: int,
    defining: int = 2,
) -> float:
    """Return log10 of the expected number of matches this good by chance, over all patterns tried.

    A false blob falls within the radius of a predicted star with the probability p, the fraction of the sensor that the
    circles cover. The matches that define attitude and camera do not count. Faint blobs are mostly false, so the
    binomial tail is computed among the brightest 15, 30, 60 and all of the blobs; the result is the least of these,
    multiplied by their number.

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
    defining
        Number of matches that define attitude and camera
    """
    # Covered fraction, with circles that may overlap
    p = 1 - np.exp(-predicted * np.pi * radius_px**2 / (camera.width_px * camera.height_px))
    counts = [count for count in (15, 30, 60) if count < blobs] + [blobs]
    tails = []
    for count in counts:
        matches = int((observed < count).sum())
        tails.append(log10_tail(max(count - defining, 0), matches - defining, p))
    return float(min(tails) + np.log10(len(counts)) + np.log10(patterns))
