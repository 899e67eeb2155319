"""A camera whose model is wrong is fitted with the match of the whole field, or refused by name."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.lenses import LENSES, WORKS, Lens, frames, judge
from benchmarks.lost_in_space import Workload
from estimator.catalog import catalog
from estimator.core.camera import Camera, distortion_slopes
from estimator.core.checks import Floats
from estimator.core.types import Centroids
from estimator.trackers import lens_fit
from estimator.trackers.lens_fit import FOCAL, SHEAR, UNKNOWNS
from estimator.trackers.pipeline import Settings
from estimator.trackers.refinement import SHEARED, FieldMatcher
from estimator.trackers.star_tracker import StarTracker
from tests.helpers.laws import SEEDS, law

CAMERA = Camera.from_fov(1024, 780, np.radians(17))
SIGMA_PX = 0.2
FIELDS = 12


def sky(limit_mag: float = 6.0) -> catalog.StarCatalog:
    return catalog.brighter_than(catalog.hipparcos(), limit_mag)


def lens_at(rng: np.random.Generator, given: Camera = CAMERA) -> lens_fit.FittedCamera:
    """A camera with all errors, as large as their priors."""
    sigma = lens_fit.prior_sigma(given, 0.0)
    change = np.where(np.isfinite(sigma), sigma, 0.0) * rng.uniform(-1, 1, UNKNOWNS)
    truth = Rotation.random(rng=rng)
    return lens_fit.FittedCamera(given, truth, change, np.zeros((UNKNOWNS, UNKNOWNS)), 1.0)


def seen_by(
    lens: lens_fit.FittedCamera, rng: np.random.Generator, count: int
) -> tuple[Floats, lens_fit.Sights]:
    """Directions within the field, and their noisy centroids."""
    rays = CAMERA.rays(rng.uniform(0, [1023, 779], (count, 2)))
    vectors = lens.cam_from_ref.inv().apply(rays)
    pixels, _ = lens.project(vectors)
    xy_px = pixels + SIGMA_PX * rng.standard_normal((count, 2))
    whiten = np.tile(np.eye(2) / SIGMA_PX, (count, 1, 1))

    def match(
        camera: Camera, cam_from_ref: Rotation, reach_px: float
    ) -> tuple[NDArray, NDArray]:
        apart = xy_px[:, None] - camera.pixels(cam_from_ref.apply(vectors))
        distance = np.linalg.norm(apart, axis=2)
        near = np.flatnonzero(distance.min(axis=1) < reach_px)
        return near, distance[near].argmin(axis=1)

    return vectors, lens_fit.Sights(xy_px, whiten, vectors, match)


@law(lens_fit.FittedCamera.project)
@given(rng=SEEDS)
def test_slopes_are_difference_quotients(rng: np.random.Generator) -> None:
    lens = lens_at(rng)
    vectors, _ = seen_by(lens, rng, 10)
    _, slopes = lens.project(vectors)
    for unknown in range(UNKNOWNS):
        if unknown == lens_fit.TWIST:
            continue  # its effect on the other slopes is left out
        sides = []
        for step in -1e-6, 1e-6:
            turn = np.zeros(3)
            change = lens.change.copy()
            change[unknown] += step * (unknown >= FOCAL)
            turn[unknown : unknown + 1] = step
            turned = Rotation.from_rotvec(turn) * lens.cam_from_ref
            sides.append(
                replace(lens, change=change, cam_from_ref=turned).project(vectors)[0]
            )
        numeric = (sides[1] - sides[0]) / 2e-6
        scale = max(np.abs(numeric).max(), 1.0)
        np.testing.assert_allclose(slopes[:, :, unknown], numeric, rtol=0, atol=0.01 * scale)


@law(lens_fit.FittedCamera.camera)
@given(rng=SEEDS)
def test_a_camera_without_shear_projects_as_the_model(rng: np.random.Generator) -> None:
    lens = lens_at(rng)
    lens.change[[SHEAR, lens_fit.TWIST]] = 0.0
    vectors, _ = seen_by(lens, rng, 10)
    pixels, _ = lens.project(vectors)
    camera = lens.camera
    seen = lens.cam_from_ref.apply(vectors)
    np.testing.assert_allclose(camera.pixels(seen), pixels, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        camera.tangents(pixels), seen[:, :2] / seen[:, 2:], rtol=0, atol=1e-12
    )


@law(lens_fit.Sights.fit, lens_fit.prior_sigma, lens_fit.FittedCamera.covariance_rad2)
@given(rng=SEEDS)
def test_the_fitted_camera_has_an_honest_covariance(rng: np.random.Generator) -> None:
    """Errors of all unknowns, whitened by their covariance, are a chi-square with as many degrees of freedom."""
    prior = lens_fit.prior_sigma(CAMERA, 0.0)
    errors = []
    for _ in range(20):
        sigma = np.where(np.isfinite(prior), prior, 0.0)
        true = replace(lens_at(rng), change=sigma * rng.standard_normal(UNKNOWNS))
        _, sights = seen_by(true, rng, 60)
        rows = np.arange(60)
        start = replace(true, change=np.zeros(UNKNOWNS))
        found, _, chi2 = sights.fit(start, np.array([rows, rows]), prior, False, 6)
        assert 0.5 < chi2 < 1.6
        turn = (found.cam_from_ref * true.cam_from_ref.inv()).as_rotvec()
        error = np.append(turn, (found.change - true.change)[3:])
        errors.append(error @ np.linalg.solve(found.covariance, error))
        assert found.covariance_rad2[2, 2] >= found.covariance[2, 2]
    assert abs(np.mean(errors) - UNKNOWNS) < 5 * np.sqrt(2 * UNKNOWNS / 20)


@law(lens_fit.Sights.grow, lens_fit.FittedCamera.needed, lens_fit.FittedCamera.sheared)
@given(rng=SEEDS, far=some.booleans())
def test_a_match_grows_from_a_corner_to_the_field(
    rng: np.random.Generator, far: bool
) -> None:
    """Pixels 4 % off square: from eight stars at one place, all are matched, and nothing else is fitted to them."""
    prior = lens_fit.prior_sigma(CAMERA, 0.05)
    true = lens_at(rng)
    true.change[:] = 0.0
    true.change[lens_fit.ASPECT] = 0.04 * far
    _, sights = seen_by(true, rng, 40)
    corner = np.argsort(np.linalg.norm(sights.xy_px - [200, 200], axis=1))[:8]
    start = replace(true, change=np.zeros(UNKNOWNS))
    lens, (observed, star), chi2 = sights.grow(start, np.array([corner, corner]), prior)
    assert len(star) >= 38
    assert np.array_equal(observed, star)
    assert chi2 < 2
    assert not lens.sheared
    assert lens.camera.aspect == pytest.approx(np.exp(0.04 * far), abs=2e-3)
    free = np.where(np.diag(lens.covariance) > 0, prior, 0.0)
    assert lens.needed(free)[: lens_fit.ASPECT].all()


@law(distortion_slopes)
@given(rng=SEEDS)
def test_slopes_of_the_distortion_are_difference_quotients(rng: np.random.Generator) -> None:
    tangent = rng.uniform(-0.4, 0.4, (5, 2))
    k = rng.uniform(-0.1, 0.1, 5)
    by_tangent, by_coefficients = distortion_slopes(tangent, tuple(k.tolist()))

    def bent(at: Floats, by: Floats) -> Floats:
        return Camera(9, 9, 1.0, (0.0, 0.0), tuple(by.tolist())).pixels(
            np.column_stack([at, np.ones(len(at))])
        )

    for unit, slope in (
        *((1e-6 * np.eye(2)[n], by_tangent[:, :, n]) for n in range(2)),
        *((1e-6 * np.eye(5)[n], by_coefficients[:, :, n]) for n in range(5)),
    ):
        step = partial(bent, by=k) if len(unit) == 2 else partial(bent, tangent)
        at = tangent if len(unit) == 2 else k
        numeric = (step(at + unit) - step(at - unit)) / 2e-6
        np.testing.assert_allclose(slope, numeric, rtol=0, atol=1e-8)


@pytest.mark.slow
@law(FieldMatcher.with_lens, FieldMatcher.reason_against, slow=True)
@pytest.mark.parametrize(
    "lens", [one for one in LENSES if "square" not in one.name], ids=lambda one: one.name
)
@given(work=some.sampled_from(WORKS[1:3]))
def test_a_wrong_camera_is_fitted_or_refused_by_name(lens: Lens, work: Workload) -> None:
    stars = sky(work.limit_mag)
    settings = Settings(centroid_sigma_px=0.0, field_stars=1e9, merge_px=0.0)
    tracker = StarTracker(work.camera, stars, stars.vectors, settings, lens.uncertainty)
    told = 0
    nees = []
    for frame in frames(work, lens, stars, FIELDS, 7):
        answer = tracker.solve_centroids(frame.centroids)
        wrong, size = judge(answer, frame)
        assert not wrong
        told += answer.solved or "camera model" in answer.status
        nees.append(size)
    assert told >= FIELDS - 2
    if np.isfinite(nees).sum() > FIELDS / 2:
        assert np.nanmean(nees) < 3 + 4 * np.sqrt(6 / FIELDS)


def test_a_sheared_field_is_refused_by_name() -> None:
    stars = sky()
    tracker = StarTracker(CAMERA, stars, stars.vectors)
    truth = Rotation.from_euler("zyx", [0.3, 1.2, -0.4])
    rows, xy_px = tracker.field_matcher.in_field(CAMERA, truth)
    xy_px[:, 0] += 0.005 * (xy_px[:, 1] - CAMERA.center_px[1])
    light = 10 ** (-0.4 * tracker.stars.v_mag[rows])
    answer = tracker.solve_centroids(Centroids(xy_px, np.full(len(rows), 0.1), light))
    assert answer.status == SHEARED
