"""The sequence of stages, from a frame to an attitude, for stars at infinity; `dometracker` has that for a dome."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator import catalog, index, ledpairs
from estimator.attitude import SOLVERS, covariance
from estimator.camera import Camera
from estimator.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.identify import IDENTIFIERS
from estimator.ledsight import sky_of
from estimator.stages import Clock, Report, Settings, brightest, direction_sigma_rad, look
from estimator.types import Attitude, Centroids, Floats, StarMatch

NO_STARS = "too few stars detected"
NO_MATCH = "no identification beyond chance"
LEAST_ERROR_PX = 0.1  # of a star, for what no calibration knows of
SETTINGS = Settings()


class StarTracker:
    """Lost in space under the real sky.

    camera  : the believed calibration
    stars   : the on-board star list
    vectors : (N, 3) apparent directions of `stars` at the time of the frames
    focal_uncertainty : relative; 0 for a calibrated camera, 0.05 where only the field of view is known to 5 %.
        Where it is not 0 the focal length and, with enough stars, the radial distortion are fitted in each frame.
    """

    def __init__(
        self,
        camera: Camera,
        stars: catalog.StarList,
        vectors: Floats,
        settings: Settings = SETTINGS,
        focal_uncertainty: float = 0.0,
    ) -> None:
        self.camera, self.settings = camera, settings
        self.focal_uncertainty = focal_uncertainty
        self.stars = replace(stars, vectors=vectors)
        widest = camera.zoomed(1 - focal_uncertainty)
        field_sr = camera.width_px * camera.height_px / camera.focal_px**2
        limit = catalog.limit_for_density(stars, field_sr, settings.field_stars)
        bright = catalog.brighter(self.stars, limit)
        patterns = catalog.merge_doubles(bright, 3 / camera.focal_px).vectors
        by_evidence = settings.identifier == "default" and focal_uncertainty == 0
        self.sight = sky_of(patterns, camera) if by_evidence else None
        self.index = self.sight.pairs if self.sight else index.build(patterns, widest.diagonal_rad * 1.02)
        self.stars = catalog.merge_doubles(self.stars, 2 / camera.focal_px)
        self.tree = cKDTree(self.stars.vectors)

    def solve(self, image: NDArray) -> Report:
        """One frame to an attitude. Raises BadImage for bad input; anything else that fails is a status."""
        return look(image, self.camera, self.settings, self.solve_centroids)

    def solve_centroids(self, centroids: Centroids, clock: Clock | None = None) -> Attitude:
        """The stages after centroiding, for centroids from anywhere (the truth included)."""
        clock = clock or Clock()
        if len(centroids) < MIN_MATCHES:
            return Attitude(NO_STARS)
        for camera, cam_from_ref in self._lost_in_space(centroids):
            clock.lap("identify")
            attitude = self._refined(centroids, camera, cam_from_ref)
            clock.lap("solve")
            if attitude.solved:
                return attitude
        clock.lap("identify")
        return Attitude(NO_MATCH)

    def _lost_in_space(self, centroids: Centroids) -> Iterator[tuple[Camera, Rotation]]:
        """Attitudes worth refining: by evidence for a camera that is known, else by triangles at each focal length.

        Of those that are possible: a little effort at all before much at any.
        """
        if self.sight:
            few = centroids.take(np.arange(min(len(centroids), self.settings.base_stars)))
            sigma_rad = np.hypot(
                direction_sigma_rad(few, self.camera, self.settings), LEAST_ERROR_PX / self.camera.focal_px
            )
            found = ledpairs.identify(self.camera.rays(few.xy_px), sigma_rad, self.sight)
            if isinstance(found, StarMatch):
                yield self.camera, found.cam_from_ref
            return
        identify = IDENTIFIERS[self.settings.identifier]
        step, stretch = 0.02, 0.011 if self.focal_uncertainty else 5e-4
        reach = int(np.ceil(self.focal_uncertainty / step - 0.5))
        zooms = sorted((n * step for n in range(-reach, reach + 1)), key=abs)
        few = brightest(centroids, self.settings)
        for triangles, checks in ((60, 1_500_000), (600, 3_000_000), (3000, 4_000_000)):
            for zoom in zooms:
                camera = self.camera.zoomed(1 + zoom)
                tolerance_rad = (
                    max(1.5 if reach else 1.0, 4 * self.settings.centroid_sigma_px) / camera.focal_px
                )
                match = identify(
                    camera.rays(few.xy_px),
                    self.index,
                    tolerance_rad,
                    stretch=stretch,
                    zooms=reach > 0,
                    max_triangles=triangles,
                    max_checks=checks,
                    base_stars=self.settings.base_stars,
                )
                if match:
                    yield camera, match.cam_from_ref

    def _refined(self, centroids: Centroids, camera: Camera, cam_from_ref: Rotation) -> Attitude:
        """Match the whole field to the full catalogue, fit, tighten, and weigh the result against chance."""
        fits = self.focal_uncertainty > 0
        reach_px = np.hypot(camera.width_px, camera.height_px) / 2
        radii_px = [0.008 * reach_px + 2, 0.004 * reach_px + 2, 4, 3, 2.5, 2.5] if fits else [3, 2.5, 2.5]
        for radius_px in radii_px:
            observed, star = self._nearest(centroids, camera, cam_from_ref, radius_px)
            if len(observed) < MIN_MATCHES:
                return Attitude(NO_MATCH)
            xy, vectors = centroids.xy_px[observed], self.stars.vectors[star]
            if fits:
                camera, cam_from_ref = fit_camera(camera, cam_from_ref, xy, vectors)
            sigma_rad = direction_sigma_rad(centroids.take(observed), camera, self.settings)
            rays = camera.rays(xy)
            try:
                cam_from_ref = SOLVERS[self.settings.solver](rays, vectors, sigma_rad)
            except ValueError as error:
                return Attitude(f"no attitude: {error}")
        rows, _ = self._in_field(camera, cam_from_ref)
        chance = log10_chance(observed, len(centroids), len(rows), radius_px, camera, len(self.index.pair))
        if chance > ACCEPT_LOG10_CHANCE:
            return Attitude(NO_MATCH)
        if abs(camera.fov_rad / self.camera.fov_rad - 1) > 1.2 * self.focal_uncertainty + 1e-9:
            return Attitude(NO_MATCH)
        residual = camera.pixels(cam_from_ref.apply(vectors)) - xy
        return Attitude(
            "solved",
            cam_from_ref,
            covariance(rays, sigma_rad),
            StarMatch(observed, star, cam_from_ref, chance),
            float(np.sqrt(np.mean(residual**2))),
            camera,
        )

    def _in_field(self, camera: Camera, cam_from_ref: Rotation) -> tuple[NDArray, Floats]:
        """Rows and pixels of the catalogue stars on the sensor."""
        boresight = cam_from_ref.inv().apply([0.0, 0.0, 1.0])
        rows = np.array(
            self.tree.query_ball_point(boresight, 2 * np.sin(camera.diagonal_rad / 4) * 1.05), int
        )
        rows.sort()
        xy = camera.pixels(cam_from_ref.apply(self.stars.vectors[rows])) if len(rows) else np.empty((0, 2))
        inside = camera.contains(xy, -2.0)
        return rows[inside], xy[inside]

    def _nearest(
        self, centroids: Centroids, camera: Camera, cam_from_ref: Rotation, radius_px: float
    ) -> tuple[NDArray, NDArray]:
        """Pairs of centroid and catalogue star that are each other's nearest within a radius."""
        rows, xy = self._in_field(camera, cam_from_ref)
        return mutual(centroids.xy_px, xy, radius_px, rows)


def log10_chance(
    observed: NDArray, blobs: int, predicted: int, radius_px: float, camera: Camera, patterns: int
) -> float:
    """log10 of how many matches this good were to be expected by chance among all patterns tried.

    A false blob falls within the radius of one of the predicted stars with the probability p = share of the
    sensor that the circles cover; two matches are spent on the attitude itself. Faint blobs are mostly false, so
    the matches are weighed among the brightest 15, 30, 60 and all of the blobs, the best counts, and the choice
    among four is paid for.
    """
    p = 1 - np.exp(-predicted * np.pi * radius_px**2 / (camera.width_px * camera.height_px))
    heads = [head for head in (15, 30, 60) if head < blobs] + [blobs]
    tails = [log10_tail(max(head - 2, 0), int((observed < head).sum()) - 2, p) for head in heads]
    return float(min(tails) + np.log10(len(heads)) + np.log10(patterns))


def mutual(seen_px: Floats, predicted_px: Floats, radius_px: float, rows: NDArray) -> tuple[NDArray, NDArray]:
    """Indices of pixels and the rows of predictions that are each other's nearest within a radius."""
    if not len(predicted_px) or not len(seen_px):
        return np.empty(0, int), np.empty(0, int)
    apart, nearest = cKDTree(predicted_px).query(seen_px, distance_upper_bound=radius_px)
    _, back = cKDTree(seen_px).query(predicted_px)
    hit = np.flatnonzero(np.isfinite(apart))
    hit = hit[back[nearest[hit]] == hit]
    return hit, rows[nearest[hit]]


def fit_camera(
    camera: Camera, cam_from_ref: Rotation, xy_px: Floats, vectors_ref: Floats
) -> tuple[Camera, Rotation]:
    """Attitude, focal length and (from 12 stars on) the first radial coefficient that fit the pixels best.

    Robust (soft L1 beyond a pixel), so that a wrong pair does not bend the lens.
    """
    radial = len(xy_px) >= 12
    start = np.zeros(5 if radial else 4)
    start[4:] = camera.distortion[0]

    def model(p: Floats) -> tuple[Camera, Rotation]:
        k1 = float(p[4]) if radial else camera.distortion[0]
        lens = replace(camera, focal_px=camera.focal_px * float(np.exp(p[3])), distortion=(k1, 0, 0, 0, 0))
        return lens, Rotation.from_rotvec(p[:3]) * cam_from_ref

    def residual(p: Floats) -> Floats:
        lens, turned = model(p)
        return np.nan_to_num(lens.pixels(turned.apply(vectors_ref)) - xy_px, nan=1e3).ravel()

    scale = np.array([1e-3, 1e-3, 1e-3, 1e-2, 0.3])[: len(start)]
    return model(least_squares(residual, start, loss="soft_l1", x_scale=scale, max_nfev=40).x)
