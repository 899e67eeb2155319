"""Star tracker for the real sky: from a frame to an attitude, lost in space. `dome_tracker` does the same for a dome.

The stages are detection and centroiding (`pipeline`), identification, and solution. The default identifier computes
identity, attitude and covariance in one step by Bayesian evidence, from quads of stars
(`identification/star_quads.py`) and then from pairs (`identification/star_search.py`). If the focal length is
uncertain, the longer search by quads is first, and the camera is fitted to each frame's stars (`lens_fit`), as it is
where a calibrated camera does not fit the whole field. Quads also find a calibrated focal length that is wrong. The
candidates of a published identifier (`registry`) are matched to the full catalog, refined, and accepted if the match
is significant.
"""

from __future__ import annotations

import datetime
import functools
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike
from scipy.spatial.transform import Rotation

from estimator.attitude.rate import covariance_of
from estimator.attitude.solvers import SOLVERS, covariance
from estimator.attitude.systematic import focal_error_px, with_focal_error
from estimator.attitude.wahba import matrix_of
from estimator.catalog import catalog, index_file, pair_index, quad_index, sky_index
from estimator.catalog.refraction import SiteAir, solve_through_air
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints
from estimator.core.errors import ImageError
from estimator.core.least_squares import variance_factor
from estimator.core.types import Attitude, Centroids, RateEstimate, StarMatch
from estimator.core.vectors import lengths, rms, rotation_of
from estimator.identification import star_evidence, star_quads, star_search
from estimator.identification.refusals import (
    BUDGET,
    FALSE_LIGHTS,
    NO_MATCH,
    WRONG_SCALE,
    advice,
)
from estimator.identification.star_detections import (
    Detections,
    Sensor,
    detections_of,
    flat_centroids,
    gates_of,
    lights_of,
)
from estimator.identification.star_evidence import Solution
from estimator.trackers import misfit
from estimator.trackers.misfit import Refit
from estimator.trackers.pipeline import (
    Clock,
    FrameTracker,
    Settings,
    brightest,
    check_algorithms,
    run_all_stages,
)
from estimator.trackers.refinement import SHEARED, FieldMatcher
from estimator.trackers.rivals import with_rivals
from estimator.trackers.rolling_shutter import Lights, solve_lights
from estimator.trackers.search_models import (
    CALIBRATED_SEARCHES,
    DEEP_SEARCHES,
    FOCAL_MARGIN,
    MIN_ERROR_PX,
    UNCALIBRATED_SEARCHES,
    WRONG_SCALE_SEARCH,
    SearchModel,
)

# Greatest number of lights that are identified: the larger of a minimum and a multiple of the stars in a mean field
MIN_LIGHTS = 100
LIGHTS_PER_STAR = 4

SETTINGS = Settings()


class StarTracker(FrameTracker):
    """Lost-in-space star tracker for the real sky.

    Attributes
    ----------
    camera
        On-board calibration
    stars
        On-board star list
    vectors
        (N, 3) apparent directions of `stars` at the time of the frames
    settings
        Algorithms of the stages, and their parameters
    focal_uncertainty
        Relative uncertainty of the focal length: 0 for a calibrated camera, 0.05 if the field of view is only known to
        5 %. Unless it is 0, the focal length and, with enough stars, the radial distortion are fitted in each frame
    searches
        Searches of the default identifier; empty for those that suit the focal uncertainty
    air
        Air over the tracker's site, whose refraction is corrected; None in space

    Raises
    ------
    ImageError
        For anything that is not as described here, an unknown algorithm of the settings
        included.
    """

    def __init__(
        self,
        camera: Camera,
        stars: catalog.StarCatalog,
        vectors: Floats,
        settings: Settings = SETTINGS,
        focal_uncertainty: float = 0.0,
        searches: tuple[SearchModel, ...] = (),
        air: SiteAir | None = None,
    ) -> None:
        checks.of_type("camera", camera, Camera)
        default = getattr(settings, "identifier", "default") == "default"
        names = ["default"]
        if not default:
            from estimator.identification.registry import (
                IDENTIFIERS,
            )  # several compiled modules

            names = list(IDENTIFIERS)
        check_algorithms(settings, names, SOLVERS)
        focal_uncertainty = checks.number(
            "focal_uncertainty", focal_uncertainty, 0.0, 0.5, "0 to 0.5, relative"
        )
        vectors = checks.unit_rows("vectors", vectors, len(stars))
        stars = catalog.checked(stars)
        if air is not None:
            vectors = air.seen(vectors, 0.0)
        self.camera = camera
        self.settings = settings
        self.air = air
        self.focal_uncertainty = focal_uncertainty
        # Stars that a frame can show, and the brighter ones among them that form patterns
        self.stars = catalog.merge_doubles(
            replace(stars, vectors=vectors), settings.merge_px / camera.focal_px
        )
        paired = int(min(settings.field_stars * 4 * np.pi / camera.field_sr, len(self.stars)))
        # Of so many stars not all pairs are indexed, and a separation has hundreds of candidates.
        self.deep = paired >= index_file.FEW_STARS
        calibrated = DEEP_SEARCHES if self.deep else CALIBRATED_SEARCHES
        self.searches = searches or (
            UNCALIBRATED_SEARCHES if focal_uncertainty else calibrated
        )
        # Longest pair: the diagonal of the widest field that the camera may have
        longest_rad = 1.02 * camera.zoomed(1 - focal_uncertainty).diagonal_rad
        if all(model.by_quads for model in self.searches):
            longest_rad = quad_index.LONGEST * self._height_rad
        self.index: pair_index.PairIndex | None = None
        self.sky = sky_index.build(self.stars.vectors, self.stars.v_mag)
        self._pair_limits = longest_rad, paired
        bright = self.sky.vectors[:paired]
        if not default:
            unknown = settings.zero_point_mag is None
            magnitude = None if unknown else self.sky.mag[:paired]
            self.index = pair_index.build(bright, longest_rad, magnitude=magnitude)
            patterns = len(self.index.pair)
        elif self.deep:
            patterns = sky_index.count_pairs(bright, longest_rad)
        else:
            patterns = len(self._paired_sky().pair)
        self.field_matcher = FieldMatcher(camera, self.stars, focal_uncertainty, patterns)

    @functools.cached_property
    def most_lights(self) -> int:
        """Greatest number of lights of a frame that are searched."""
        mean_stars = len(self.stars) * self.camera.field_sr / (4 * np.pi)
        return max(MIN_LIGHTS, round(LIGHTS_PER_STAR * mean_stars))

    @functools.cached_property
    def sensor(self) -> Sensor:
        """Calibration and scale of the magnitudes, for compiled code."""
        # Field of view in tangents: least and largest x, least and largest y
        corners = self.camera.tangents(self.camera.corners_px)
        field = np.array([corners.min(axis=0), corners.max(axis=0)]).T.ravel()
        zero_mag = self.settings.zero_point_mag
        return Sensor(
            self.camera.focal_px,
            self.camera.center_px,
            self.camera.distortion,
            field,
            np.nan if zero_mag is None else zero_mag,
            self.settings.magnitude_sigma,
            self.camera.aspect,
        )

    @functools.cached_property
    def _known(self) -> misfit.Known:
        """What compiled code knows of the camera and the sky, with its pairs."""
        return tuple(self.sensor), tuple(self._paired_sky())

    @functools.cached_property
    def quads(self) -> quad_index.QuadIndex:
        """Quads of the stars that form pairs, built on first use."""
        return index_file.quads(self.sky, self._height_rad)

    def _paired_sky(self) -> sky_index.SkyIndex:
        """Return the index of stars with its pairs, which are added to that of a deep sky on first use."""
        if not self.sky.pair.size:
            index_file.release()  # makes room for them
            self.sky = sky_index.add_pairs(self.sky, *self._pair_limits)
        return self.sky

    @property
    def _height_rad(self) -> float:
        """The smaller side of the field of view."""
        side_px = min(self.camera.width_px, self.camera.height_px)
        return float(2 * np.arctan(side_px / 2 / self.camera.focal_px))

    @classmethod
    def for_sky(
        cls,
        camera: Camera,
        limit_mag: float | None = None,
        date: str | datetime.datetime = "2000-01-01T12:00",
        *,
        stars: catalog.StarCatalog | None = None,
        settings: Settings = SETTINGS,
        focal_uncertainty: float = 0.0,
    ) -> StarTracker:
        """Return a tracker for the sky as seen from the Earth at a date.

        Parameters
        ----------
        limit_mag
            Faintest V magnitude of the on-board catalog; None: 6 without `stars`, otherwise all stars
        date
            UTC, ISO 8601 or datetime, which determines proper motion, parallax and aberration
        stars
            Another catalog than the Hipparcos subset that comes with the package, which ends at Hp 6.5

        Raises
        ------
        ImageError
            For a date that cannot be read, or a catalog without a star as bright as limit_mag.
        """
        if limit_mag is not None or stars is None:
            limit_mag = checks.number(
                "limit_mag", 6.0 if limit_mag is None else limit_mag, -30, 30, "-30 to 30"
            )
        stars = (
            catalog.hipparcos() if stars is None else catalog.checked(stars).brightest_first()
        )
        if limit_mag is not None:
            stars = catalog.brighter_than(stars, limit_mag)
        vectors = catalog.apparent(stars, catalog.on_earth(catalog.utc(date)))
        return cls(camera, stars, vectors, settings, focal_uncertainty)

    def warm_up(self, dtype: DTypeLike = np.uint16) -> None:
        """Compile all that `solve` and `solve_centroids` use, and build the quads: call it before the flight.

        It takes up to a minute once, and a second where numba finds its code on disk. Without it the first frames
        take that time.

        Parameters
        ----------
        dtype
            Type of the frames' pixels
        """
        cam_from_ref, xy_px, light = self.rich_field()
        run_all_stages(self.camera, xy_px, light, dtype, self.solve)
        # Every error model of the search
        sigma_px = np.full(len(xy_px), 0.1)
        clean = Centroids(xy_px, sigma_px, light)
        for effort in range(self.efforts):
            self.solve_centroids(clean, effort=effort)
        # Residuals of two and of four standard deviations cause a new match and a new fit of the errors.
        for step_px in 0.2, 0.4:
            moved_px = xy_px + step_px * (-1.0) ** np.arange(len(xy_px))[:, None]
            self.solve_centroids(replace(clean, xy_px=moved_px))
        # As many false lights as stars cause a test whether the camera model fits the field.
        xy_px = np.concatenate([xy_px, xy_px[:, ::-1]])
        centroids = Centroids(xy_px, np.tile(sigma_px, 2), np.concatenate([light, light / 2]))
        self.solve_centroids(centroids)
        rows, _ = self.field_matcher.in_field(self.camera, cam_from_ref)
        self.solve_matches(centroids, np.arange(min(len(rows), 3)), rows[:3])

    def rich_field(self) -> tuple[Rotation, Floats, Floats]:
        """Return the attitude with most stars on the sensor, of forty, and their (N, 2) pixels and (N,) light.

        The stars are in the order of brightness.
        """
        fields = []
        for cam_from_ref in Rotation.random(40, np.random.Generator(np.random.PCG64(1))):
            rows, xy_px = self.field_matcher.in_field(self.camera, cam_from_ref)
            fields.append((cam_from_ref, xy_px, 10 ** (-0.4 * self.stars.v_mag[rows])))
        return max(fields, key=lambda one: len(one[1]))

    @property
    def efforts(self) -> int:
        """Number of searches, with different error models and efforts, before a frame is given up."""
        return len(self.searches) if self.index is None else 1

    def solve_centroids(
        self,
        centroids: Centroids,
        clock: Clock | None = None,
        effort: int | None = None,
        rate: RateEstimate | None = None,
        exposure_s: float | None = None,
        t_s: float = 0.0,
    ) -> Attitude:
        """Identify and solve centroids from any source (the truth included).

        Parameters
        ----------
        centroids
            Centroids of one frame
        clock
            Stopwatch of the stages; None: a new one
        effort
            Number of the only search to run, out of `efforts`, from 0; None: all of them in turn
        rate, exposure_s
            Rate and exposure time as in `solve`
        t_s
            Time of the frame since the air's epoch
        """
        if self.air is not None and t_s:
            solve = functools.partial(
                self.solve_centroids,
                clock=clock,
                effort=effort,
                rate=rate,
                exposure_s=exposure_s,
            )
            return solve_through_air(solve, self.camera, self.air, t_s, centroids)
        Centroids.check_values(centroids)
        if effort is not None:
            effort = checks.number(
                "effort",
                effort,
                0,
                self.efforts - 1,
                f"0 to {self.efforts - 1}, or None",
                True,
            )
        once = functools.partial(self._solve_global, clock=clock or Clock(), effort=effort)
        lights = Lights(
            self.stars.vectors, np.zeros(3), lambda seen, _: self.with_errors(seen)
        )
        return solve_lights(self.camera, lights, centroids, once, rate, exposure_s)

    def with_errors(self, centroids: Centroids) -> Centroids:
        """Return the centroids with their total errors as covariances."""
        sigma_px = self.sigma_px(centroids)
        excess_px2 = (sigma_px**2 - centroids.sigma_px**2)[:, None, None] * np.eye(2)
        covariance_px2 = covariance_of(centroids) + excess_px2
        return replace(centroids, sigma_px=sigma_px, covariance_px2=covariance_px2)

    def _solve_global(
        self, centroids: Centroids, clock: Clock, effort: int | None
    ) -> Attitude:
        """Identify and solve centroids of one time."""
        if self.index is None:
            return self._identify_lights(centroids, clock, effort)
        compared = np.zeros(1, np.int64)
        attitude = self._identify_by_paper(centroids, clock, self.index, compared)
        attitude = replace(attitude, angles_compared=int(compared[0]) or None)
        return self._with_rivals(attitude, centroids, clock)

    def _with_rivals(
        self, attitude: Attitude, centroids: Centroids, clock: Clock
    ) -> Attitude:
        """Return the attitude, or an ambiguous answer if the unmatched lights are those of another sky."""
        attitude = with_rivals(
            attitude,
            centroids,
            self.sigma_px,
            self.sensor,
            self.sky,
            self.field_matcher,
            self.quads if self.deep else None,
        )
        clock.lap("identify")
        return attitude

    def _identify_by_paper(
        self, centroids: Centroids, clock: Clock, index: pair_index.PairIndex, compared: Ints
    ) -> Attitude:
        """Solve by the published identifier of the settings; `compared` counts the angles that it compares."""
        from estimator.identification.registry import candidates  # several compiled modules

        settings = self.settings
        bright = brightest(centroids, settings)
        options: dict[str, Any] = {"base_stars": settings.base_stars}
        if settings.zero_point_mag is not None:
            options["magnitude"] = settings.zero_point_mag - 2.5 * np.log10(bright.flux)
            options["epsilon_mag"] = settings.magnitude_sigma
        for camera, match in candidates(
            settings.identifier,
            bright,
            self.camera,
            index,
            self.focal_uncertainty,
            settings.searched_sigma_px,
            settings.acceptance,
            cos_error=settings.cos_error,
            compared=compared,
            **options,
        ):
            clock.lap("identify")
            if settings.acceptance == "thesis":
                # The paper's rule has accepted this match: it is not tested with the whole field.
                attitude = self.solve_matches(centroids, match.observed, match.star)
            else:
                attitude = self._in_field(centroids, camera, match)
            clock.lap("solve")
            if attitude.solved:
                return attitude
        clock.lap("identify")
        in_field = len(index.vectors) * self.camera.field_sr / (4 * np.pi)
        why = advice(
            settings.identifier,
            len(bright),
            settings.acceptance,
            in_field,
            settings.cos_error,
        )
        return Attitude(f"{NO_MATCH}: {why}")

    def _in_field(self, centroids: Centroids, camera: Camera, match: StarMatch) -> Attitude:
        """Solve the candidate of a published identifier with the whole field and, if it is uncertain, with the lens."""
        matcher = self.field_matcher
        candidate = Solution(
            match.observed,
            match.star,
            match.cam_from_ref.as_quat(),
            np.zeros((3, 3)),
            camera.focal_px / self.camera.focal_px,
            0.0,
            1.0,
            -match.log10_chance,
        )
        sigma_px = self.sigma_px(centroids, 0.0)
        weight = self.detections(centroids, sigma_px).weight
        refitted = matcher.with_lens(candidate, centroids, weight, 1.0, False)
        reason = matcher.reason_against(refitted, centroids)
        return Attitude(reason) if reason else self.attitude_of(centroids, refitted, sigma_px)

    def solve_matches(self, centroids: Centroids, observed: Ints, star: Ints) -> Attitude:
        """Solve the attitude for given matches from any source (the truth included), without identification.

        The match is not tested against chance: its log10_chance is NaN.

        Parameters
        ----------
        observed, star
            (K,) rows of the centroids and of `self.stars`, K >= 2

        Raises
        ------
        ImageError
            For rows outside of the centroids or stars.
        """
        Centroids.check_values(centroids)
        observed = checks.row_numbers("observed", observed, len(centroids))
        star = checks.row_numbers("star", star, len(self.stars))
        if len(observed) != len(star):
            raise ImageError(
                f"{len(observed)} of observed, {len(star)} of star; allowed: equal numbers of both"
            )
        xy_px = centroids.xy_px[observed]
        vectors = self.stars.vectors[star]
        sigma_px = self.sigma_px(centroids)
        sigma_rad = sigma_px[observed] / self.camera.focal_px
        solver = self.settings.solver
        rays = self.camera.rays(xy_px)
        try:
            cam_from_ref = SOLVERS[solver](rays, vectors, sigma_rad)
        except ValueError as error:
            return Attitude(f"no attitude: {error}")
        # Errors that the residuals imply
        residual_px = self.camera.pixels(cam_from_ref.apply(vectors)) - xy_px
        chi2 = float(np.sum((residual_px / sigma_px[observed, None]) ** 2))
        variance = variance_factor(chi2, max(2 * len(star) - 3, 1))
        solution = Solution(
            observed,
            star,
            cam_from_ref.as_quat(),
            covariance(rays, np.sqrt(variance) * sigma_rad, solver),
            1.0,
            rms(residual_px) / self.camera.focal_px,
            chi2,
            float("nan"),
        )
        detections = self.detections(centroids, sigma_px)
        refitted = Refit(solution, self.camera, variance, detections=detections)
        return self.attitude_of(centroids, refitted, sigma_px)

    def sigma_px(
        self,
        centroids: Centroids,
        min_error_px: float = MIN_ERROR_PX,
        relative_error: float = 0.0,
    ) -> Floats:
        """Return the (N,) total centroid errors, px.

        They are the root of the sum of squares of the centroid's own error, a least error, and relative_error times the
        distance from the image center. The error of a calibrated focal length is the least relative_error.
        """
        sigma_px = np.hypot(
            centroids.sigma_px, max(self.settings.searched_sigma_px, min_error_px)
        )
        relative_error = max(relative_error, self.camera.focal_sigma)
        if relative_error == 0:
            return sigma_px
        radius_px = lengths(centroids.xy_px - self.camera.center_px)
        return np.hypot(sigma_px, relative_error * radius_px)

    def detections(
        self, centroids: Centroids, sigma_px: Floats, focal_uncertainty: float = 0.0
    ) -> Detections:
        """Return the centroids as input of the search, with magnitudes if the zero point is known.

        Parameters
        ----------
        sigma_px
            (N,) total errors
        focal_uncertainty
            Relative uncertainty of the focal length, if it is larger than that of the tracker
        """
        uncertainty = max(FOCAL_MARGIN * self.focal_uncertainty, focal_uncertainty)
        return detections_of(flat_centroids(centroids, sigma_px), self.sensor, uncertainty)

    def _identify_lights(
        self, centroids: Centroids, clock: Clock, effort: int | None
    ) -> Attitude:
        """Solve by the default identifier, without a surplus of lights, and with double images as one light.

        A refusal of all searches says whether another scale would be solved.
        """
        camera = self.camera
        lights = lights_of(centroids, camera.width_px, camera.height_px, self.most_lights)
        attitude = self._identify_by_evidence(lights.centroids, clock, effort)
        if effort is None and attitude.status in (BUDGET, FALSE_LIGHTS):
            # A short search whose focal length is hardly known may find a decisive one out of range.
            sigma_px = self.sigma_px(lights.centroids)
            found, _ = self._search(lights.centroids, sigma_px, WRONG_SCALE_SEARCH)
            is_decisive = found.dex >= star_search.DECISIVE_DEX
            if is_decisive and abs(found.focal_ratio - 1) > self.focal_uncertainty:
                return Attitude(WRONG_SCALE)
        attitude = self._with_rivals(attitude, lights.centroids, clock)
        rows = lights.rows
        if rows is None:
            return attitude
        # The common error turns the camera about the axes across it.
        x, y = lights.offset_px / camera.focal_px
        turn_rad = np.array([-y, x, 0.0])

        def of_frame(found: Attitude) -> Attitude:
            if found.match is None:
                return found
            return replace(
                found,
                match=replace(found.match, observed=rows[found.match.observed]),
                covariance_rad2=found.covariance_rad2 + np.outer(turn_rad, turn_rad),
            )

        return replace(of_frame(attitude), rivals=tuple(map(of_frame, attitude.rivals)))

    def _identify_by_evidence(
        self, centroids: Centroids, clock: Clock, effort: int | None
    ) -> Attitude:
        """Solve by the default identifier.

        Each search, until one gives an attitude:

        1. Search with this model of the errors (`_search`).
        2. Match and fit again by the residuals (`refit`).
        3. Drop the solution if the camera model fits only a part of the field or a sheared one; with a fitted camera,
           also a field of view outside of its bounds, and a match that is not beyond chance.
        """
        status = NO_MATCH
        own_px = self.sigma_px(centroids)
        for model in self.searches if effort is None else [self.searches[effort]]:
            # 1. Search
            sigma_px = own_px
            if model.min_error_px > MIN_ERROR_PX or model.relative_error:
                sigma_px = self.sigma_px(centroids, model.min_error_px, model.relative_error)
            solution, variance = self._search(centroids, sigma_px, model)
            clock.lap("identify")
            if not len(solution.star):
                continue
            # 2. Residuals
            refitted = self.refit(centroids, solution, sigma_px, variance, own_px)
            # 3. Wrong camera model
            reason = self.field_matcher.reason_against(refitted, centroids)
            if not reason:
                attitude = self.attitude_of(centroids, refitted, sigma_px)
                clock.lap("solve")
                return attitude
            status = reason if status == NO_MATCH else status
            clock.lap("solve")
            if reason == SHEARED:
                break
        if status == NO_MATCH:
            status = BUDGET if np.isnan(solution.dex) else FALSE_LIGHTS
        return Attitude(status)

    def _search(
        self, centroids: Centroids, sigma_px: Floats, model: SearchModel
    ) -> tuple[Solution, float]:
        """Return the solution of one search, and the factor of the variances if it is known, else 0."""
        effort = self.settings.searched_stars, model.max_checks
        found = None
        if not (model.by_quads or self.focal_uncertainty or self.camera.row_time_s):
            lights = flat_centroids(centroids, sigma_px)
            found = misfit.identify(lights, self._known, *effort)
        if found:
            solution, variance = found
            exact = model.min_error_px == MIN_ERROR_PX or model.relative_error
            if exact or not len(solution.star):
                return solution, variance
            # The larger errors have found the attitude; the residuals tell the errors.
            claimed = self.detections(centroids, self.sigma_px(centroids))
            R_cam_from_ref = matrix_of(solution.cam_from_ref_xyzw)
            again = star_evidence.evaluate(
                claimed, self.sky, R_cam_from_ref.copy(), 1.0, gates_of(claimed, 1.5), -np.inf
            )
            solution = star_evidence.build_solution(claimed, self.sky, again)
            return misfit.widened(solution, R_cam_from_ref, claimed, self.sky)
        detections = self.detections(centroids, sigma_px, model.focal_uncertainty)
        if not model.by_quads:
            return star_search.lost_in_space(detections, self._paired_sky(), *effort), 0.0
        detections = detections._replace(tangent=detections.tangent / [1.0, model.aspect])
        quads = self.quads, self.sky
        return star_quads.identify(
            detections, *quads, *effort, not self.focal_uncertainty
        ), 0.0

    def refit(
        self,
        centroids: Centroids,
        solution: Solution,
        sigma_px: Floats,
        variance: float = 0.0,
        own_px: Floats | None = None,
    ) -> Refit:
        """Return a solution with the errors and the camera that its residuals and the field imply.

        1. Match again with the errors of most evidence (`misfit`).
        2. Fit the camera with the match of the whole field (`FieldMatcher.with_lens`), unless the camera model explains
           the solution. That of a calibrated camera is doubted if the errors are larger than claimed, or if stars just
           miss detections.

        Parameters
        ----------
        sigma_px
            (N,) total errors of the centroids
        variance
            Factor of the variances if the solution has been matched again already; else 0
        own_px
            (N,) total errors with the least error of a star
        """
        matcher = self.field_matcher
        same_focal = solution.focal_ratio == 1
        camera = self.camera if same_focal else self.camera.zoomed(solution.focal_ratio)
        if not len(solution.star):
            return Refit(solution, camera, 1.0)
        # 1. Errors
        own_px = self.sigma_px(centroids) if own_px is None else own_px
        exact = own_px is sigma_px or np.array_equal(own_px, sigma_px)
        known = exact and not self.focal_uncertainty
        settled = known and 0 < variance < misfit.TELLING
        if (
            settled
            and len(solution.star) == len(centroids)
            and self.settings.centroid_sigma_px
        ):
            # Where all centroids match no star just misses one, and the floor of the errors is given.
            return Refit(solution, camera, variance)
        uncertainty = 0.0 if same_focal else star_search.WRONG_FOCAL
        detections = self.detections(centroids, sigma_px, uncertainty)
        if not variance:
            if exact:
                solution, detections = misfit.with_companions(solution, detections, self.sky)
            # A few stars may fit by luck within gates that are too narrow for the others.
            whole = len(solution.star) == len(centroids)
            if whole and solution.chi2 < misfit.DOUBTFUL and known:
                return Refit(solution, camera, 1.0, detections=detections)
            if known and not self.camera.row_time_s:
                R_cam_from_ref = matrix_of(solution.cam_from_ref_xyzw)
                solution, variance = misfit.widened(
                    solution, R_cam_from_ref, detections, self.sky
                )
            else:
                # The lens or the rate is fitted afterwards: matches beyond the gate belong to it.
                dof = max(2 * len(solution.star) - 4, 1)
                variance = variance_factor(dof * solution.chi2, dof)
                scaled = variance * solution.covariance_rad2
                solution = solution._replace(covariance_rad2=scaled)
        # 2. Camera
        weight = detections.weight if exact else self.detections(centroids, own_px).weight
        if self.focal_uncertainty:
            fits = exact and matcher.fits(solution, centroids, weight)
        else:
            fixed = bool(self.camera.focal_sigma or self.camera.row_time_s)
            few = len(solution.star) < misfit.LENS_MATCHES
            small = exact and variance < misfit.TELLING
            fits = (
                fixed or few or (small and not matcher.misfits(camera, solution, centroids))
            )
        if fits:
            own = detections if exact else None
            return Refit(solution, camera, variance, detections=own)
        start = variance if known else 1.0
        return matcher.with_lens(solution, centroids, weight, start, exact)

    def attitude_of(
        self, centroids: Centroids, refitted: Refit, sigma_px: Floats
    ) -> Attitude:
        """Return the attitude of a solution; solved again from its matches if the settings name another solver."""
        solution, camera, variance, _, detections = refitted
        has_floor = self.settings.centroid_sigma_px is None and detections is not None
        searched_px = self.settings.searched_sigma_px
        if has_floor and not camera.focal_sigma:
            solution, floor_px2 = misfit.with_floor(
                solution, detections, self.sky, searched_px, self.camera.focal_px
            )
            variance = 1.0
            sigma_px = np.sqrt(sigma_px**2 - searched_px**2 + floor_px2)
            if solution.focal_ratio != 1:
                camera = self.camera.zoomed(solution.focal_ratio)
        cam_from_ref = rotation_of(solution.cam_from_ref_xyzw)
        covariance_rad2 = solution.covariance_rad2
        common_rad2 = None
        solver = self.settings.solver
        if solver != "default" or camera.focal_sigma:
            xy_px = centroids.xy_px[solution.observed]
            vectors = self.stars.vectors[solution.star]
            sigma_rad = np.sqrt(variance) * sigma_px[solution.observed] / camera.focal_px
            if solver != "default":
                rays = camera.rays(xy_px)
                cam_from_ref = SOLVERS[solver](rays, vectors, sigma_rad)
                covariance_rad2 = covariance(rays, sigma_rad, solver)
            if camera.focal_sigma:
                # Variances of the centroids' noise, with the floor that the residuals imply. The error of the focal
                # length is common to all stars: an unknown of the residuals, not a noise.
                focal_px2 = focal_error_px(camera, centroids.xy_px) ** 2
                if has_floor:
                    noise_px2 = sigma_px**2 - focal_px2
                    free = self.detections(
                        centroids, np.sqrt(noise_px2), star_search.WRONG_FOCAL
                    )
                    _, floor_px2 = misfit.with_floor(
                        solution, free, self.sky, searched_px, self.camera.focal_px
                    )
                    noise_px2 = noise_px2 + floor_px2 - searched_px**2
                else:
                    noise_px2 = variance * sigma_px**2 - focal_px2
                noise_px2 = noise_px2[solution.observed]
                seen_cam = cam_from_ref.apply(vectors)
                covariance_rad2, common_rad2 = with_focal_error(
                    covariance_rad2, camera, seen_cam, sigma_rad, noise_px2
                )
        v_mag = self.stars.v_mag[solution.star]
        match = StarMatch(
            solution.observed, solution.star, cam_from_ref, -solution.dex, v_mag
        )
        rms_px = solution.rms * self.camera.focal_px
        return Attitude(
            "solved", cam_from_ref, covariance_rad2, match, rms_px, camera, common_rad2
        )
