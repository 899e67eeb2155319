"""The covariance is correct under a wrong error model: NEES over centroids of random fields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from scipy import stats
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import covariance
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids
from estimator.identification import star_evidence, star_search
from estimator.identification.star_detections import changed
from estimator.trackers import misfit
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from tests.helpers.laws import law

CAMERA = Camera.from_fov(1024, 780, np.radians(17))
NOISE_PX = 0.2
FIELDS = 120
MEAN_SIGMA = np.sqrt(6 / FIELDS)  # of the mean NEES of an honest covariance, 0.22


@pytest.fixture(scope="module")
def tracker() -> StarTracker:
    stars = catalog.brighter_than(catalog.hipparcos(), 6.0)
    return StarTracker(
        CAMERA, stars, stars.vectors, Settings(centroid_sigma_px=0.0, zero_point_mag=0.0)
    )


def field(
    tracker: StarTracker, seed: int, lens: Camera, claimed: float = 1.0
) -> tuple[Rotation, Centroids]:
    """A random attitude and its stars' centroids through a lens, with under- or overstated noise."""
    rng = np.random.default_rng([7, seed])
    truth = Rotation.random(rng=rng)
    stars = tracker.stars
    xy_px = np.nan_to_num(lens.pixels(truth.apply(stars.vectors)), nan=-1e9)
    star = np.flatnonzero(lens.contains(xy_px))
    noisy_px = xy_px[star] + NOISE_PX * rng.standard_normal((len(star), 2))
    return truth, Centroids(
        noisy_px, np.full(len(star), claimed * NOISE_PX), 10 ** (-0.4 * stars.v_mag[star])
    )


def errors_squared(tracker: StarTracker, lens: Camera, claimed: float = 1.0) -> Floats:
    """NEES of the fields that are solved; at least nine of ten are."""
    found = []
    for seed in range(FIELDS):
        truth, centroids = field(tracker, seed, lens, claimed)
        answer = tracker.solve_centroids(centroids)
        if answer.cam_from_ref is not None:
            error = (answer.cam_from_ref * truth.inv()).as_rotvec()
            found.append(error @ np.linalg.solve(answer.covariance_rad2, error))
    assert len(found) >= 0.9 * FIELDS
    return np.array(found)


def test_right_model_keeps_its_covariance(tracker: StarTracker) -> None:
    nees = errors_squared(tracker, CAMERA)
    assert abs(nees.mean() - 3) < 0.5 + MEAN_SIGMA
    assert stats.kstest(nees, stats.chi2(3).cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    "times", [3, *(pytest.param(times, marks=pytest.mark.slow) for times in (2, 5))]
)
def test_understated_noise_is_found_from_the_misfit(tracker: StarTracker, times: int) -> None:
    assert 2 < errors_squared(tracker, CAMERA, 1 / times).mean() < 4.5


@pytest.mark.parametrize(
    "lens",
    [CAMERA.zoomed(1.003), replace(CAMERA, distortion=(0.15, 0.0, 0.0, 0.0, 0.0))],
    ids=["focal", "distortion"],
)
def test_a_drifted_lens_is_found_from_the_misfit(tracker: StarTracker, lens: Camera) -> None:
    assert 2 < errors_squared(tracker, lens).mean() < 4
    _, centroids = field(tracker, 3, lens)
    found = tracker.solve_centroids(centroids).camera
    corners = np.array([[0.0, 0.0], [1023.0, 779.0]])
    lost_px, left_px = (
        CAMERA.focal_px * np.abs(one.tangents(corners) - lens.tangents(corners)).max()
        for one in (CAMERA, found)
    )
    assert left_px < 0.5 * lost_px


@pytest.mark.parametrize("claimed", [1.0, 0.8])
def test_wider_errors_in_closed_form_match_the_full_evaluation(
    tracker: StarTracker, claimed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The closed form agrees with the evaluation of every factor, which an unmatched light beside a star asks for."""
    _, centroids = field(tracker, 5, CAMERA, claimed)
    detections = tracker.detections(centroids, tracker.sigma_px(centroids))
    wide = changed(detections, 25.0, 0.0)
    found = star_search.lost_in_space(wide, tracker.sky, 80, 100_000)
    R_cam_from_ref = Rotation.from_quat(found.cam_from_ref_xyzw).as_matrix()
    gates = np.full(len(centroids), 0.01)
    hypothesis = star_evidence.evaluate(
        detections, tracker.sky, R_cam_from_ref, 1.0, gates, -np.inf
    )
    kept = centroids.take(hypothesis.observed)
    detections = tracker.detections(kept, tracker.sigma_px(kept))
    hypothesis = star_evidence.evaluate(
        detections, tracker.sky, hypothesis.R_cam_from_ref, 1.0, gates[: len(kept)], -np.inf
    )
    matched = star_evidence.build_solution(detections, tracker.sky, hypothesis)
    quick, quick_factor = misfit.widened(
        matched, hypothesis.R_cam_from_ref, detections, tracker.sky
    )
    monkeypatch.setattr(misfit, "count_near", lambda *_: 1)
    slow, slow_factor = misfit.widened.py_func(
        matched, hypothesis.R_cam_from_ref, detections, tracker.sky
    )
    assert len(matched.star) == len(slow.star)
    assert quick_factor == pytest.approx(slow_factor, rel=1e-3)
    assert quick.dex == pytest.approx(slow.dex, abs=1e-2)
    np.testing.assert_allclose(
        quick.covariance_rad2, slow.covariance_rad2, rtol=1e-2, atol=1e-16
    )
    assert quick.chi2 == pytest.approx(slow.chi2, rel=1e-2)


@law(misfit.refit, misfit.with_lens, misfit.variance_of, StarTracker.refit, slow=True)
@given(seed=some.integers(0, 10**6), claimed=some.floats(0.2, 3.0))
def test_the_covariance_is_never_below_the_model_s(
    tracker: StarTracker, seed: int, claimed: float
) -> None:
    _, centroids = field(tracker, seed, CAMERA, claimed)
    answer = tracker.solve_centroids(centroids)
    if answer.match is not None:
        seen = centroids.take(answer.match.observed)
        model = covariance(CAMERA.rays(seen.xy_px), tracker.sigma_px(seen) / CAMERA.focal_px)
        assert (np.diag(answer.covariance_rad2) > 0.8 * np.diag(model)).all()
    residual = np.random.default_rng(seed).standard_normal((50, 2)) / claimed
    assert misfit.variance_of(residual, 3) >= 1
    assert claimed > 0.5 or abs(misfit.variance_of(residual, 3) * claimed**2 - 1) < 0.8
