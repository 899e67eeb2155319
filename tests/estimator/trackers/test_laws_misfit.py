"""The covariance is correct under a wrong error model: NEES over centroids of random fields."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from numba import types
from scipy import linalg, stats
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import covariance
from estimator.attitude.systematic import geometry
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids
from estimator.identification import star_evidence, star_search
from estimator.identification.star_detections import changed, flat_centroids, gates_of
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


@pytest.mark.slow
@pytest.mark.parametrize("times", [3, 2, 5])
def test_understated_noise_is_found_from_the_misfit(tracker: StarTracker, times: int) -> None:
    assert 2 < errors_squared(tracker, CAMERA, 1 / times).mean() < 4.5


@pytest.mark.slow
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


@pytest.mark.parametrize(("claimed", "uncertainty"), [(1.0, 0.0), (0.8, 0.0), (0.65, 0.01)])
def test_wider_errors_in_closed_form_match_the_full_evaluation(
    tracker: StarTracker,
    claimed: float,
    uncertainty: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The closed form agrees with the evaluation of every factor, which an unmatched light beside a star asks for.

    Also where the focal length is fitted, a fourth unknown, and the errors are wrong by a factor.
    """
    _, centroids = field(tracker, 5, CAMERA, claimed)
    detections = tracker.detections(centroids, tracker.sigma_px(centroids))
    detections = changed(detections, 1.0, uncertainty)
    wide = changed(detections, 25.0, 0.0)
    found = star_search.lost_in_space(wide, tracker.sky, 80, 100_000)
    R_cam_from_ref = Rotation.from_quat(found.cam_from_ref_xyzw).as_matrix()
    gates = np.full(len(centroids), 0.01)
    hypothesis = star_evidence.evaluate(
        detections, tracker.sky, R_cam_from_ref, 1.0, gates, -np.inf
    )
    kept = centroids.take(hypothesis.observed)
    detections = changed(tracker.detections(kept, tracker.sigma_px(kept)), 1.0, uncertainty)
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


@law(StarTracker.refit, slow=True)
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


@pytest.mark.parametrize("uncertainty", [0.0, 0.02])
def test_the_floor_of_the_errors_has_the_restricted_likelihood(
    tracker: StarTracker, uncertainty: float
) -> None:
    """Against the density of error contrasts, which do not depend on the attitude, and a fit with each floor.

    Nor do they depend on the focal length, where that is uncertain.
    """
    _, centroids = field(tracker, 2, CAMERA, 0.5)
    detections = tracker.detections(centroids, tracker.sigma_px(centroids))
    found = star_search.lost_in_space(detections, tracker.sky, 80, 100_000)
    answer, floor_px2 = misfit.with_floor(
        found, changed(detections, 1.0, uncertainty), tracker.sky, 0.0, CAMERA.focal_px
    )
    # Linear model of the matches, in pixels
    seen = Rotation.from_quat(found.cam_from_ref_xyzw).apply(tracker.sky.vectors[found.star])
    view = geometry(seen, seen)
    design = CAMERA.focal_px * np.column_stack(
        [view.jacobian.reshape(-1, 3), view.tangent.ravel()]
    )
    design = design[:, : 4 if uncertainty else 3]
    tangents = CAMERA.tangents(centroids.xy_px[found.observed])
    error_px = CAMERA.focal_px * (tangents - view.tangent).ravel()
    own_px2 = np.repeat(tracker.sigma_px(centroids)[found.observed] ** 2, 2)
    contrasts = linalg.null_space(design.T)
    log_density = []
    fits = []
    for floor_px in misfit.FLOORS_PX:
        covariance_px2 = np.diag(own_px2 + floor_px**2)
        left = stats.multivariate_normal(cov=contrasts.T @ covariance_px2 @ contrasts)
        log_density.append(left.logpdf(contrasts.T @ error_px))
        weighted = np.linalg.inv(covariance_px2) @ design
        fits.append(
            np.linalg.inv(design.T @ weighted)
            @ np.column_stack([weighted.T @ error_px, np.eye(design.shape[1])])
        )
    share = np.exp(np.array(log_density) - max(log_density))
    share /= share.sum()
    assert floor_px2 == pytest.approx(share @ misfit.FLOORS_PX**2, rel=1e-4)
    steps, inverses = np.array(fits)[:, :3, 0], np.array(fits)[:, :3, 1:4]
    mean = share @ steps
    scatter = steps - mean
    wanted = np.einsum("f,fij->ij", share, inverses) + (share * scatter.T) @ scatter
    np.testing.assert_allclose(
        answer.covariance_rad2, wanted, rtol=1e-3, atol=1e-5 * wanted.max()
    )
    moved = (
        Rotation.from_quat(answer.cam_from_ref_xyzw)
        * Rotation.from_quat(found.cam_from_ref_xyzw).inv()
    )
    np.testing.assert_allclose(moved.as_rotvec(), mean, atol=1e-3 * np.sqrt(wanted.max()))


@pytest.mark.parametrize("ratio", [1.0, 1.02])
def test_the_two_axes_of_an_error_ellipse_hold_a_match_s_whole_information(
    tracker: StarTracker, ratio: float
) -> None:
    """[J r]^T W [J r] of rotation, focal length and residual is the sum over both axes, each with its own variance."""
    _, centroids = field(tracker, 2, CAMERA)
    detections = tracker.detections(centroids, tracker.sigma_px(centroids))
    found = star_search.lost_in_space(detections, tracker.sky, 80, 100_000)
    found = found._replace(focal_ratio=ratio)
    rng = np.random.default_rng(9)
    focal_px = CAMERA.focal_px
    covariances_px2 = []
    for n in range(len(detections.weight)):
        root = rng.standard_normal((2, 2))
        covariances_px2.append(root @ root.T + 0.1 * np.eye(2))
        weight = focal_px**2 * np.linalg.inv(covariances_px2[n])
        detections.weight[n] = weight[0, 0], weight[1, 1], weight[0, 1]
    rotation = Rotation.from_quat(found.cam_from_ref_xyzw)
    seen = rotation.apply(tracker.sky.vectors[found.star])
    view = geometry(seen, seen)
    for k, n in enumerate(found.observed):
        whole = focal_px * np.column_stack(
            [
                ratio * view.jacobian.reshape(-1, 2, 3)[k],
                ratio * view.tangent[k],
                detections.tangent[n] - ratio * view.tangent[k],
            ]
        )
        expected = whole.T @ np.linalg.inv(covariances_px2[n]) @ whole
        total = np.zeros((5, 5))
        variances_px2 = []
        for axis in range(2):
            row = np.empty(5)
            variance_px2 = misfit._principal_row.py_func(
                found,
                detections,
                tracker.sky,
                rotation.as_matrix(),
                2 * k + axis,
                focal_px,
                row,
            )
            total += np.outer(row, row) / variance_px2
            variances_px2.append(variance_px2)
        np.testing.assert_allclose(
            variances_px2, np.linalg.eigvalsh(covariances_px2[n]), rtol=1e-9
        )
        np.testing.assert_allclose(total, expected, rtol=1e-8, atol=1e-8 * expected.max())


def test_unmatched_detections_near_a_star_are_counted_within_their_gates(
    tracker: StarTracker,
) -> None:
    """By the angles to all stars; gates of more than 0.05 rad count as 0.05."""
    truth, _ = field(tracker, 2, CAMERA)
    rng = np.random.default_rng(10)
    tangent = rng.uniform(-0.1, 0.1, (60, 2))
    rays = np.column_stack([tangent / 1.03, np.ones(60)])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    stars = truth.apply(tracker.sky.vectors)
    nearest = np.arccos(np.minimum(rays @ stars.T, 1.0)).min(axis=1)
    matched = np.array([3, 7, 20])
    for gates in (np.full(60, 0.03), rng.uniform(0, 0.04, 60), np.full(60, 1.0)):
        close = nearest < np.minimum(gates, 0.05)
        close[matched] = False
        assert misfit.count_near.py_func(
            tangent, tracker.sky, truth.as_matrix(), 1.03, matched, gates
        ) == np.count_nonzero(close)
    assert 5 < np.count_nonzero(nearest < 0.03) < 55
    # The catalog's first star too
    for star in (0, 1):
        ray = tracker.sky.vectors[star]
        beside = Rotation.align_vectors([[0.0, 0.0, 1.0]], [ray])[0].as_matrix()
        none = np.zeros(0, int)
        assert (
            misfit.count_near.py_func(
                np.full((1, 2), 1e-6), tracker.sky, beside, 1.0, none, np.full(1, 1e-4)
            )
            == 1
        )


def test_a_search_takes_plain_tuples_and_no_centroids_that_show_companions(
    tracker: StarTracker,
) -> None:
    """numba takes three times as long to read a named tuple as a plain one, in each call."""
    _, centroids = field(tracker, 5, CAMERA)
    assert tracker.solve_centroids(centroids).solved
    assert misfit.identify.signatures
    for lights, (sensor, sky), *_ in misfit.identify.signatures:
        for read in (lights, sensor, sky):
            assert not isinstance(read, types.NamedTuple | types.NamedUniTuple)
    angle_rad = misfit.ERROR_RAD[-1]
    for factor, searched in ((0.99, False), (1.01, True)):
        sigma_px = np.full(len(centroids), factor * angle_rad * CAMERA.focal_px)
        lights = flat_centroids(centroids, sigma_px)
        found = misfit.identify(lights, tracker._known, 80, 600)
        assert (found is not None) is searched


def test_the_widest_gates_are_those_of_the_largest_errors_that_are_tried(
    tracker: StarTracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond them no factor changes the matches; 32 times the errors, with the margin of each factor's own gates."""
    _, centroids = field(tracker, 5, CAMERA)
    detections = tracker.detections(centroids, tracker.sigma_px(centroids))
    found = star_search.lost_in_space(detections, tracker.sky, 80, 100_000)
    asked: list[Floats] = []
    monkeypatch.setattr(misfit, "count_near", lambda *those: asked.append(those[-1]) or 0)
    R_cam_from_ref = Rotation.from_quat(found.cam_from_ref_xyzw).as_matrix()
    misfit.widened.py_func(found, R_cam_from_ref, detections, tracker.sky)
    wide = changed(detections, float(misfit.TRIED[-1]), detections.focal_uncertainty)
    np.testing.assert_allclose(asked[0], gates_of(wide, 1.5), rtol=1e-9)
    np.testing.assert_allclose(wide.sigma, 32 * detections.sigma, rtol=1e-9)


@pytest.mark.parametrize("count", [1, 4, 25])
def test_residuals_are_too_great_beyond_three_deviations_of_their_chi_square(
    count: int,
) -> None:
    """Of two numbers a star, divided by their number: a deviation of sqrt(2 / 2 n)."""
    deviation = float(stats.chi2(2 * count).std()) / (2 * count)
    for factor, great in ((2.9, False), (3.1, True)):
        solution = SimpleNamespace(star=np.arange(count), chi2=1 + factor * deviation)
        assert misfit.residuals_too_great.py_func(solution) == great


@pytest.mark.parametrize("floor_px", [0.01, 0.1])
def test_the_default_settings_claim_what_the_frame_shows(floor_px: float) -> None:
    """An honest mean NEES where the errors have an unknown floor, below and at that of the search."""
    stars = catalog.brighter_than(catalog.hipparcos(), 5.0)
    eye = StarTracker(CAMERA, stars, stars.vectors, Settings(zero_point_mag=0.0))
    nees = []
    for seed in range(FIELDS):
        truth, centroids = field(eye, seed, CAMERA)
        rng = np.random.default_rng([8, seed])
        noise_px = rng.standard_normal(centroids.xy_px.shape) * np.hypot(floor_px, 0.02)
        true_px = np.nan_to_num(CAMERA.pixels(truth.apply(eye.stars.vectors)), nan=-1e9)
        true_px = true_px[CAMERA.contains(true_px)]
        some = Centroids(true_px + noise_px, np.full(len(true_px), 0.02), centroids.flux)
        answer = eye.solve_centroids(some)
        if answer.cam_from_ref is not None:
            error = (answer.cam_from_ref * truth.inv()).as_rotvec()
            nees.append(error @ np.linalg.solve(answer.covariance_rad2, error))
    assert len(nees) > 0.9 * FIELDS
    assert abs(np.mean(nees) - 3) < 0.5 + MEAN_SIGMA
