"""Star tracker for an LED dome: from a frame to an attitude, with the camera on a lever arm about the bearing center.

1. Detect and centroid the lights (`pipeline`).
2. Identify LEDs among the brightest lights (IDENTIFIERS).
3. Match the whole field with the exact near-field geometry, with decreasing radii.
4. Reject blended LEDs by their residuals.
5. Solve the attitude with the solver of the settings (`attitude.nearfield`).
6. Compute the covariance with the errors of the survey, the focal length and the lever.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude import systematic
from estimator.attitude.dome_map import (
    LedMap,
    Lever,
    check_lever,
    common_images_px,
    common_shifts_m,
    led_sigma_rad,
    on_sphere,
    on_surface,
    project,
)
from estimator.attitude.nearfield import SOLVERS, fitted_sigma_rad
from estimator.attitude.rotation_fit import fit_focal_ratio
from estimator.catalog import pair_index
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Attitude, Centroids, RateEstimate, StarMatch
from estimator.core.vectors import lengths, normalized, rms
from estimator.identification import led_search
from estimator.identification.chance import MIN_EVIDENCE_MATCHES
from estimator.identification.direct_match import mutual_nearest
from estimator.identification.led_index import build_dome_index, inner_field
from estimator.identification.refusals import NO_MATCH, advice
from estimator.identification.registry import IDENTIFIERS as STAR_IDENTIFIERS
from estimator.trackers.pipeline import (
    Clock,
    FrameTracker,
    Settings,
    check_algorithms,
    run_all_stages,
)
from estimator.trackers.rolling_shutter import Lights, solve_lights

# Least centroid error of an LED, for effects outside of survey and calibration
MIN_ERROR_PX = 0.3
FOCAL_UNCERTAINTY = 0.12  # largest relative error of a focal length that is not calibrated
PAIR_CHECKS = 4_000_000  # largest number of checks of the search
FOCAL_CHECKS = 10_000_000  # largest number of checks of its search, which take a second
MAX_FOCAL_SIGMA = 0.5  # largest focal_sigma of a `Camera`
# Identifiers after which the focal length is fitted with the attitude.
FITS_FOCAL = ("non_dimensional",)
SETTINGS = Settings(identifier="led_pairs", solver="rotation_only")
Identify = Callable[[Floats, Floats, Floats | None], StarMatch | str]


def led_pairs(
    camera: Camera,
    leds: LedMap,
    lever: Lever,
    settings: Settings,
    focal_uncertainty: float = 0.0,
) -> Identify:
    """Return the default LED identifier: pair hypotheses and evidence; see `led_search.identify`.

    The index holds the pairs of the widest field that a camera of an uncertain focal length may have. It has the field
    of view of the assumed camera, in whose tangents the detections are.
    """
    sight = build_dome_index(leds, lever, camera.zoomed(1 - focal_uncertainty))
    field_tan, half_size = inner_field(camera.rays(camera.corners_px))
    sight = sight._replace(field_tan=field_tan, field_area=float(4 * half_size.prod()))
    least_rad = MIN_ERROR_PX / camera.focal_px
    return lambda rays_cam, sigma_rad, flux_s: led_search.identify(
        rays_cam,
        np.hypot(sigma_rad, least_rad),
        sight,
        FOCAL_CHECKS if focal_uncertainty else PAIR_CHECKS,
        flux_s,
        focal_uncertainty,
        2 * settings.base_stars,
    )


def non_dimensional(
    camera: Camera, leds: LedMap, lever: Lever, settings: Settings
) -> Identify:
    """Return `led_pairs` for a focal length with the uncertainty FOCAL_UNCERTAINTY, or three sigma if larger."""
    uncertainty = min(max(FOCAL_UNCERTAINTY, 3 * camera.focal_sigma), 0.5)
    return led_pairs(camera, leds, lever, settings, uncertainty)


def star_identifier(
    name: str, camera: Camera, leds: LedMap, lever: Lever, settings: Settings
) -> Identify:
    """Return a star identifier that works on directions from the bearing, where the rays meet one sphere.

    The sphere has the median radius of the LEDs. On a dome that is not a sphere this changes the angles; the tolerance
    therefore has a stretch, from the spread of the radii and the lever. With an assumed attitude the rays meet the
    dome's surface as seen from there (`assumed_directions`), and the stretch is that of the calibration alone.
    """
    radius = leds.radius_m
    median_radius_m = float(np.median(radius))
    pupil_m = lever.pupil_cam_m
    corners = camera.rays(camera.corners_px)
    points = on_sphere(corners, pupil_m, median_radius_m) / median_radius_m
    field_tan, _ = inner_field(points)
    reach_rad = np.arccos(np.clip((points @ points.T).min(), -1, 1))
    pairs = pair_index.build(leds.position_m / radius[:, None], reach_rad * 1.05, leds.board)
    stretch = 5e-4
    if settings.assumed_deg is None:
        spread_m = 2 * float(np.std(radius))
        stretch += spread_m / (median_radius_m - float(np.linalg.norm(pupil_m)))

    def identify(
        rays_cam: Floats, sigma_rad: Floats, flux_s: Floats | None
    ) -> StarMatch | str:
        rays_cam = rays_cam[: 2 * settings.base_stars]
        if settings.assumed_deg is None:
            directions = on_sphere(rays_cam, pupil_m, median_radius_m) / median_radius_m
        else:
            directions = assumed_directions(rays_cam, leds, lever, settings.assumed_deg)
        match = STAR_IDENTIFIERS[name](
            directions,
            pairs,
            max(1.0, 4 * settings.searched_sigma_px) / camera.focal_px,
            stretch=stretch,
            base_stars=settings.base_stars,
            missed_dex=settings.missed_dex,
            field_tan=tuple(field_tan),
            acceptance=settings.acceptance,
        )
        return match or f"{NO_MATCH}: {advice(name, len(rays_cam), settings.acceptance)}"

    return identify


def assumed_directions(
    rays_cam: Floats, leds: LedMap, lever: Lever, assumed_deg: tuple[float, float, float]
) -> Floats:
    """Return (N, 3) unit vectors from the bearing to lights, in camera axes, with distances from an assumed attitude.

    R_0 + alpha_i b_i = A beta_i r_i (Tappe 2009, by Padro 2012, eq. 33): the distance alpha_i from the camera at R_0 to
    light i along its ray b_i depends on the attitude A, and follows from the surface at an assumed A.
    """
    lab_from_body = Rotation.from_euler("ZYX", assumed_deg[::-1], degrees=True)
    lab_from_cam = lab_from_body * lever.body_from_cam
    origin_m = lab_from_body.apply(lever.camera_body_m)
    points_m = on_surface(lab_from_cam.apply(rays_cam), origin_m, leds)
    return lab_from_cam.inv().apply(normalized(points_m))


# Each entry maps (camera, leds, lever, settings) to a function that identifies (N, 3) rays with (N,) errors and, if the
# exposure is known, (N,) fluxes per second. That function returns the match, or the reason for a refusal.
IDENTIFIERS: dict[str, Callable[[Camera, LedMap, Lever, Settings], Identify]] = {
    "led_pairs": led_pairs,
    "non_dimensional": non_dimensional,
    **{
        name: partial(star_identifier, name)
        for name in ("pyramid", "saa", "master_star", "planar_triangle", "spherical_triangle")
    },
}


class DomeTracker(FrameTracker):
    """Lost-in-space tracker under an LED dome, with the camera on a lever arm about the bearing center.

    cam_from_ref of the result is cam_from_lab; `lever` converts it to the vehicle's attitude.

    Attributes
    ----------
    camera, leds, lever
        On-board calibration, map of the dome, and position and orientation of the camera
    settings
        Algorithms of the stages, and their parameters; `default` is led_pairs for the identifier, and rotation_only for
        the solver

    Raises
    ------
    ImageError
        If the lever is longer than the distance of the nearest LED, if there are too few LEDs, or
        for anything that is not as described.
    """

    def __init__(
        self,
        camera: Camera,
        leds: LedMap,
        lever: Lever,
        settings: Settings = SETTINGS,
    ) -> None:
        checks.of_type("camera", camera, Camera)
        for stage in ("identifier", "solver"):
            if getattr(settings, stage, "") == "default":
                settings = replace(settings, **{stage: getattr(SETTINGS, stage)})
        check_algorithms(settings, IDENTIFIERS, SOLVERS)
        check_lever(leds, lever)
        self.camera = camera
        self.leds = leds
        self.lever = lever
        self.settings = settings
        self.identify = IDENTIFIERS[settings.identifier](camera, leds, lever, settings)
        self.led_sigma_rad = led_sigma_rad(leds, lever)
        self.focal_fitted = False  # whether the camera's focal length is fitted to this frame

    def warm_up(self, dtype: DTypeLike = np.uint16) -> None:
        """Compile all that `solve` and `solve_centroids` use: call it before the experiment.

        It takes up to a minute once, and a second where numba finds its code on disk.

        Parameters
        ----------
        dtype
            Type of the frames' pixels
        """
        # The richest field of some forty with an LED on the boresight
        fields = []
        position_m = self.leds.position_m
        for toward_m in position_m[:: max(len(position_m) // 40, 1)]:
            cam_from_lab, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [toward_m])
            body_from_lab = self.lever.body_from_cam * cam_from_lab
            xy_px = project(body_from_lab, position_m, self.lever, self.camera)
            fields.append(xy_px[self.camera.contains(xy_px, 2.0)])
        xy_px = max(fields, key=len)
        run_all_stages(self.camera, xy_px, np.ones(len(xy_px)), dtype, self.solve)
        self.solve_centroids(Centroids(xy_px, np.full(len(xy_px), 0.1), np.ones(len(xy_px))))

    def solve_centroids(
        self,
        centroids: Centroids,
        clock: Clock | None = None,
        rate: RateEstimate | None = None,
        exposure_s: float | None = None,
    ) -> Attitude:
        """Identify and solve centroids from any source (the truth included).

        Parameters
        ----------
        rate, exposure_s
            Rate and exposure time as in `solve`
        """
        Centroids.check_values(centroids)
        clock = clock or Clock()
        lights = Lights(self.leds.position_m, self.lever.pupil_cam_m, self._with_errors)
        solve = partial(self._solve_global, clock=clock, exposure_s=exposure_s)
        return solve_lights(self.camera, lights, centroids, solve, rate, exposure_s)

    def _with_errors(self, centroids: Centroids, star: NDArray) -> Centroids:
        """Return K centroids with their total errors, those of the LEDs' positions and the focal length included."""
        sigma_rad = np.hypot(self._pixel_rad(centroids), self.led_sigma_rad[star])
        sigma_px = self.camera.focal_px * sigma_rad
        return replace(centroids, sigma_px=sigma_px, covariance_px2=None)

    def _solve_global(
        self, centroids: Centroids, clock: Clock, exposure_s: float | None
    ) -> Attitude:
        """Identify and solve centroids of one time."""
        if self.settings.identifier in FITS_FOCAL:
            sigma_rad = self.direction_sigma_rad(centroids)
        else:
            sigma_rad = self._pixel_rad(centroids)
        flux_s = centroids.flux / exposure_s if exposure_s else None
        match = self.identify(self.camera.rays(centroids.xy_px), sigma_rad, flux_s)
        return self._solve_identified(centroids, match, clock)

    def _solve_identified(
        self, centroids: Centroids, match: StarMatch | str, clock: Clock
    ) -> Attitude:
        """Return the attitude of a match, or the refusal."""
        clock.lap("identify")
        if isinstance(match, str):
            return Attitude(match)
        attitude = self.solve_match(centroids, match)
        clock.lap("solve")
        return attitude

    def solve_match(self, centroids: Centroids, match: StarMatch) -> Attitude:
        """Match every centroid with the exact geometry, then solve these matches with the solver of the settings.

        Where the focal length is uncertain (FITS_FOCAL), it is first fitted with the attitude to the identified LEDs,
        and once more to all that match, with the distortion at the new scale. The result's camera has the fitted focal
        length with its standard deviation, which is part of the covariance.
        """
        if self.settings.identifier not in FITS_FOCAL:
            return self._solve_calibrated(centroids, match)
        tracker = self
        attitude = Attitude(NO_MATCH)
        for _ in range(2):
            try:
                tracker = tracker._with_fitted_focal(centroids, match)
            except ValueError as error:
                return Attitude(f"no attitude: {error}")
            attitude = tracker._solve_calibrated(centroids, match)
            if attitude.match is None:
                break
            match = attitude.match
        return attitude

    def _with_fitted_focal(self, centroids: Centroids, match: StarMatch) -> DomeTracker:
        """Return this tracker with the focal length that fits the matches, and its error from centroids and map."""
        observed = match.observed
        star = match.star
        rays = self.camera.rays(centroids.xy_px[observed])
        pixel_rad = self.direction_sigma_rad(centroids)[observed]
        sigma_rad = np.hypot(pixel_rad, self.led_sigma_rad[star])
        body_from_lab = self.lever.body_from_cam * match.cam_from_ref
        ratio = fit_focal_ratio(
            rays, sigma_rad, self.leds.position_m[star], self.lever, body_from_lab
        )
        fitted = copy(self)
        fitted.camera = self.camera.zoomed(ratio)
        fitted.focal_fitted = True
        # Variance of the logarithm of the focal length, the fourth unknown of the fit
        view, common_rad = fitted._common_rad(match.cam_from_ref, star)
        view = systematic.with_focal(view)
        errors_rad2 = systematic.isotropic(sigma_rad)
        variance = systematic.from_independent(view, sigma_rad, errors_rad2)[3, 3]
        variance += systematic.from_common(view, sigma_rad, common_rad)[3, 3]
        focal_sigma = min(float(np.sqrt(variance)), MAX_FOCAL_SIGMA)
        fitted.camera = replace(fitted.camera, focal_sigma=focal_sigma)
        return fitted

    def _focal_rad(self, rays: Floats) -> Floats:
        """Return the (N,) `focal_error_rad` of rays; 0 where the focal length is fitted, as the fit has its error."""
        if self.focal_fitted:
            return np.zeros(len(rays))
        return systematic.focal_error_rad(rays, self.camera)

    def _pixel_rad(self, centroids: Centroids) -> Floats:
        """Return the (N,) standard deviations of the directions, from the centroids and the focal length."""
        return np.hypot(
            self.direction_sigma_rad(centroids),
            self._focal_rad(self.camera.rays(centroids.xy_px)),
        )

    def _solve_calibrated(self, centroids: Centroids, match: StarMatch) -> Attitude:
        """Return the attitude for a known focal length: steps 3 to 6 of the module.

        The matching always uses the exact solver: an approximate one could lose matches. All solvers are therefore
        compared on the same matches.
        """
        observed = match.observed
        star = match.star
        body_from_lab = self.lever.body_from_cam * match.cam_from_ref
        rays = self.camera.rays(centroids.xy_px)
        pixel_rad = self._pixel_rad(centroids)
        # Matching radius: four standard deviations, at least 4 px
        typical_rad = float(np.median(np.hypot(pixel_rad, self.led_sigma_rad.max())))
        radius_px = max(4.0, 4 * self.camera.focal_px * typical_rad)
        try:
            # 3. Matches of the whole field
            for factor in (3.0, 1.0):
                body_from_lab, _, _ = self._solve(
                    "rotation_only", rays, pixel_rad, observed, star, body_from_lab
                )
                xy_px = project(body_from_lab, self.leds.position_m, self.lever, self.camera)
                # An LED whose center is just off the chip may still have light on it.
                inside = np.flatnonzero(self.camera.contains(xy_px, -30.0))
                observed, star = mutual_nearest(
                    centroids.xy_px, xy_px[inside], factor * radius_px, inside
                )
                # The exact geometry must confirm as many matches as identification found.
                if len(observed) < len(match.observed):
                    return Attitude(NO_MATCH)
            # 4. Blends
            sigma_rad = np.hypot(pixel_rad[observed], self.led_sigma_rad[star])
            observed, star, misfit = self._reject_blends(
                centroids, sigma_rad, observed, star, body_from_lab
            )
            # 5. Attitude
            body_from_lab, covariance, sigma_rad = self._solve(
                self.settings.solver, rays, pixel_rad, observed, star, body_from_lab
            )
        except ValueError as error:
            return Attitude(f"no attitude: {error}")
        # 6. Covariance in camera axes
        cam_from_lab = self.lever.cam_from_body * body_from_lab
        R_cam_from_body = self.lever.cam_from_body.as_matrix()
        residual = self._residual_px(centroids, observed, star, body_from_lab)
        covariance = R_cam_from_body @ covariance @ R_cam_from_body.T
        covariance, shared = self._with_survey(
            covariance, misfit, cam_from_lab, rays[observed], sigma_rad, star
        )
        lever_covariance = self._lever_covariance(cam_from_lab, star)
        return Attitude(
            "solved",
            cam_from_lab,
            covariance + lever_covariance,
            StarMatch(observed, star, cam_from_lab, match.log10_chance),
            rms(residual),
            self.camera,
            shared + lever_covariance,
            constant_rad2=lever_covariance,
        )

    def _with_survey(
        self,
        covariance: Floats,
        misfit: float,
        cam_from_lab: Rotation,
        rays: Floats,
        sigma_rad: Floats,
        star: NDArray,
    ) -> tuple[Floats, Floats]:
        """Return the covariance of K matches with all errors of the survey, and the part that successive frames share.

        Parameters
        ----------
        covariance
            (3, 3) covariance in camera axes, in which each LED's error is independent of the
            others' and equal in all directions
        misfit
            Factor of `_reject_blends` on all but the common errors
        rays, sigma_rad, star
            (K, 3) rays, the (K,) errors on which the covariance is based, and (K,) rows of the LEDs
        """
        led_rad = self.led_sigma_rad[star]
        focal_rad = self._focal_rad(rays)
        simple = self.leds.covariance_m2 is None and self.leds.common_m is None
        if simple and not self.camera.focal_sigma:
            # The LEDs' share of the variance of a ray is their share of the covariance too, if all rays are alike.
            share = float(np.mean(led_rad**2 / sigma_rad**2))
            return misfit * covariance, share * misfit * covariance
        view, common_rad = self._common_rad(cam_from_lab, star)
        # Errors of each LED's own position, as tangents
        own_rad2 = systematic.isotropic(led_rad)
        if self.leds.covariance_m2 is not None:
            by_place = view.gradient @ cam_from_lab.as_matrix()
            own_rad2 = by_place @ self.leds.covariance_m2[star] @ by_place.mT
        # The rest of each ray's variance is noise of the frame.
        variance_rad2 = np.maximum(sigma_rad**2 - led_rad**2 - focal_rad**2, 0)
        noise_rad2 = systematic.isotropic(np.sqrt(variance_rad2))
        errors = misfit * noise_rad2, misfit * own_rad2, common_rad
        return systematic.with_survey(covariance, view, sigma_rad, *errors, self.focal_fitted)

    def _common_rad(
        self, cam_from_lab: Rotation, star: NDArray
    ) -> tuple[systematic.Geometry, Floats]:
        """Return the geometry of K LEDs, and the (M, K, 2) change of their tangents by the errors that all share.

        Each change is by one standard deviation: of the focal length first, unless it is fitted, then of the map's
        common errors, of which those of a survey by the camera contain lever and lens.
        """
        place_cam = cam_from_lab.apply(self.leds.position_m[star])
        ray_cam = place_cam - self.lever.pupil_cam_m
        view = systematic.geometry(place_cam, ray_cam)
        common_rad = self.camera.focal_sigma * view.tangent[None][int(self.focal_fitted) :]
        if self.leds.common_m is not None:
            shift_m = common_shifts_m(self.leds, star, self.lever, cam_from_lab)
            images_px = common_images_px(self.leds, self.camera, ray_cam)
            tangent = self.camera.tangents(images_px.reshape(-1, 2))
            moved = np.einsum("kij,mkj->mki", view.gradient, shift_m)
            moved += tangent.reshape(-1, *view.tangent.shape) - view.tangent
            common_rad = np.concatenate([common_rad, moved])
        return view, common_rad

    def _residual_px(
        self, centroids: Centroids, observed: NDArray, star: NDArray, body_from_lab: Rotation
    ) -> Floats:
        """Return the (K, 2) predicted minus observed pixels."""
        predicted = project(
            body_from_lab, self.leds.position_m[star], self.lever, self.camera
        )
        return predicted - centroids.xy_px[observed]

    def _reject_blends(
        self,
        centroids: Centroids,
        sigma_rad: Floats,
        observed: NDArray,
        star: NDArray,
        body_from_lab: Rotation,
    ) -> tuple[NDArray, NDArray, float]:
        """Reject matches with outlying residuals; return the others and a factor for their covariance.

        Two LEDs whose images touch form one blob at neither's position.

        a. Divide the residuals' lengths by their sigmas, and reject those above 5 times the median (above 5 if the
           median is below 1).
        b. Compute mean and standard deviation of the chi-square of the others. It has 2 K - 3 degrees of freedom, one
           less if the focal length is fitted; the part of the common errors that the fit cannot absorb increases both
           (`systematic.residual_products`).
        c. If chi-square exceeds its mean by more than 3 standard deviations, their ratio is the factor, else 1.
        """
        # a. Outliers
        residual = self._residual_px(centroids, observed, star, body_from_lab)
        length = lengths(residual) / (sigma_rad * self.camera.focal_px)
        inlier = length <= 5 * max(float(np.median(length)), 1.0)
        if inlier.sum() < max(MIN_EVIDENCE_MATCHES, len(inlier) / 2):
            inlier[:] = True
        # b. Mean and standard deviation of chi-square
        dof = 2 * int(inlier.sum()) - (4 if self.focal_fitted else 3)
        mean = float(dof)
        spread = np.sqrt(2 * dof)
        if self.leds.common_m is not None or self.camera.focal_sigma:
            view, common_rad = self._common_rad(
                self.lever.cam_from_body * body_from_lab, star[inlier]
            )
            fit = systematic.with_focal(view) if self.focal_fitted else view
            left = systematic.residual_products(fit, sigma_rad[inlier], common_rad)
            # The focal length's error is in the sigmas too, as if it were independent.
            focal_sigma = 0.0 if self.focal_fitted else self.camera.focal_sigma
            focal_rad = focal_sigma * lengths(view.tangent) / np.sqrt(2)
            noise = 1 - float(np.mean(focal_rad**2 / sigma_rad[inlier] ** 2))
            mean = noise * dof + float(np.trace(left))
            spread = np.sqrt(
                2 * noise**2 * dof + 4 * noise * np.trace(left) + 2 * np.trace(left @ left)
            )
        # c. Factor
        chi2 = float(np.sum(length[inlier] ** 2))
        return (
            observed[inlier],
            star[inlier],
            chi2 / mean if chi2 > mean + 3 * spread else 1.0,
        )

    def _lever_covariance(self, cam_from_lab: Rotation, star: NDArray) -> Floats:
        """Return the (3, 3) covariance in camera axes from the error of the pupil's position, common to all frames.

        A shift of the pupil has the same effect on a light at p from the bearing as a rotation by p x shift / |p|^2.
        For lights about the mean position p, and the shift's variance sigma^2 along each axis, the covariance is
        (sigma / |p|)^2 (I - u u^T), u = p / |p|. It is 0 if the map's common errors contain the lever.
        """
        if self.leds.common_camera is not None:
            return np.zeros((3, 3))
        mean_m = cam_from_lab.apply(self.leds.position_m[star].mean(axis=0))
        direction = normalized(mean_m)
        sigma_rad = self.lever.sigma_m / np.linalg.norm(mean_m)
        return sigma_rad**2 * (np.eye(3) - np.outer(direction, direction))

    def _solve(
        self,
        solver: str,
        rays: Floats,
        pixel_rad: Floats,
        observed: NDArray,
        star: NDArray,
        body_from_lab: Rotation,
    ) -> tuple[Rotation, Floats, Floats]:
        """Return body_from_lab, its covariance in body axes, and the (K,) standard deviations of the residuals.

        Those are of the centroids, (N,) `pixel_rad`, and of the LEDs' positions.
        """
        seen = rays[observed]
        by_centroid_rad = fitted_sigma_rad(solver, seen, pixel_rad[observed])
        sigma_rad = np.hypot(by_centroid_rad, self.led_sigma_rad[star])
        position_m = self.leds.position_m[star]
        solved = SOLVERS[solver](
            seen, sigma_rad, position_m, self.leds, self.lever, body_from_lab
        )
        return *solved, sigma_rad
