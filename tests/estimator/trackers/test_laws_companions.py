"""Double stars do not bias the attitude, and the covariance includes them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from scipy.spatial.transform import Rotation

from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.types import Centroids
from estimator.identification.star_detections import information_of
from estimator.identification.star_evidence import Solution
from estimator.trackers import misfit
from estimator.trackers.misfit import ARCSEC_RAD, ERROR_RAD, SHARE
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.paths import CATALOGS
from tests.helpers.laws import law

CAMERA = Camera.from_fov(4056, 3040, np.radians(22))  # 20 arcseconds a pixel
NOISE_PX = 0.05
BRIGHT_PX = 0.0115
FIELDS = 100
OFF_RAD = 2.2 * ARCSEC_RAD


@pytest.fixture(scope="module")
def tracker() -> StarTracker:
    stars = catalog.brighter_than(catalog.hipparcos(), 5.0)
    return StarTracker(
        CAMERA, stars, stars.vectors, Settings(centroid_sigma_px=0.0, merge_px=0.0)
    )


def test_a_bright_double_star_does_not_bias_the_attitude(tracker: StarTracker) -> None:
    """A double 2.2" off, with half of the field's information: the NEES is 13, without the model of companions 25."""
    nees = []
    for seed in range(FIELDS):
        rng = np.random.default_rng([25, seed])
        truth = Rotation.random(rng=rng)
        stars = tracker.stars
        xy_px = np.nan_to_num(CAMERA.pixels(truth.apply(stars.vectors)), nan=-1e9)
        star = np.flatnonzero(CAMERA.contains(xy_px))
        sigma_px = np.full(len(star), NOISE_PX)
        sigma_px[0] = BRIGHT_PX
        noisy_px = xy_px[star] + sigma_px[:, None] * rng.standard_normal((len(star), 2))
        azimuth = rng.uniform(0, 2 * np.pi)
        noisy_px[0] += (
            OFF_RAD * CAMERA.focal_px * np.array([np.cos(azimuth), np.sin(azimuth)])
        )
        answer = tracker.solve_centroids(
            Centroids(noisy_px, sigma_px, 10 ** (-0.4 * stars.v_mag[star]))
        )
        if answer.cam_from_ref is not None:
            error = (answer.cam_from_ref * truth.inv()).as_rotvec()
            nees.append(error @ np.linalg.solve(answer.covariance_rad2, error))
    assert len(nees) >= 0.9 * FIELDS
    assert np.mean(nees) < 18


@law(misfit.with_companions)
@given(seed=some.integers(0, 10**6))
def test_coarse_centroids_ignore_companions(tracker: StarTracker, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = Rotation.random(rng=rng)
    stars = tracker.stars
    xy_px = np.nan_to_num(CAMERA.pixels(truth.apply(stars.vectors)), nan=-1e9)
    star = np.flatnonzero(CAMERA.contains(xy_px))
    noise_px = 0.5  # 10 arcseconds
    noisy_px = xy_px[star] + noise_px * rng.standard_normal((len(star), 2))
    centroids = Centroids(noisy_px, np.full(len(star), noise_px), np.ones(len(star)))
    detections = tracker.detections(centroids, tracker.sigma_px(centroids))
    solution, _ = tracker._search(centroids, tracker.sigma_px(centroids), tracker.searches[0])
    after, errors = misfit.with_companions(solution, detections, tracker.sky)
    assert misfit.are_small(detections.sigma)
    assert not misfit.are_small(detections.sigma / 3)
    assert after is solution
    assert errors is detections


@law(misfit.with_companions)
@given(seed=some.integers(0, 10**6))
def test_three_others_tell_that_a_star_is_double_and_two_do_not(
    tracker: StarTracker, seed: int
) -> None:
    """Four stars of 0.2" each, one of them 10" off: it loses its information. Of three, each keeps its own."""
    rng = np.random.default_rng(seed)
    truth = Rotation.random(rng=rng)
    xy_px = np.nan_to_num(CAMERA.pixels(truth.apply(tracker.stars.vectors)), nan=-1e9)
    star = rng.permutation(np.flatnonzero(CAMERA.contains(xy_px)))[:4]
    seen_px = xy_px[star]
    seen_px[0, 0] += 0.5
    sigma_px = np.full(4, 0.01)
    for count in (4, 3):
        centroids = Centroids(seen_px[:count], sigma_px[:count], np.ones(count))
        detections = tracker.detections(centroids, sigma_px[:count])
        solution = Solution(
            np.arange(count), star[:count], truth.as_quat(), np.eye(3), 1.0, 0.0, 0.0, 0.0
        )
        after, errors = misfit.with_companions(solution, detections, tracker.sky)
        if count == 3:
            assert after is solution
            assert errors is detections
        else:
            share = errors.weight[:, :2] / detections.weight[:, :2]
            assert np.all(share[0] < 0.1)
            assert np.all(share[1:] > 0.5)


@law(information_of)
@given(seed=some.integers(0, 10**6))
def test_the_information_matrix_has_the_weights_as_elements(seed: int) -> None:
    weight = np.random.default_rng(seed).standard_normal((5, 3))
    for row, matrix in zip(weight, information_of(weight), strict=True):
        assert matrix.tolist() == [[row[0], row[2]], [row[2], row[1]]]


@law(misfit.prediction_by_others)
@given(seed=some.integers(0, 10**6), count=some.integers(4, 12))
def test_a_star_s_prediction_comes_from_a_fit_without_it(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((count, 2, 3))
    residual = rng.standard_normal((count, 2))
    root = rng.standard_normal((count, 2, 2)) + 2 * np.eye(2)
    information = root @ np.swapaxes(root, 1, 2)

    def fit(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        weighted = np.swapaxes(jacobian[rows], 1, 2) @ information[rows]
        normal = np.sum(weighted @ jacobian[rows], axis=0)
        return np.linalg.solve(
            normal, np.einsum("nij,nj->i", weighted, residual[rows])
        ), np.linalg.inv(normal)

    every = np.arange(count)
    at_best = residual - jacobian @ fit(every)[0]
    alone, spread = (
        one.T
        for one in misfit.prediction_by_others(
            at_best.T, np.moveaxis(jacobian, 0, 2), information.T
        )
    )
    for k in range(count):
        step, covariance = fit(np.delete(every, k))
        assert alone[k] == pytest.approx(residual[k] - jacobian[k] @ step, rel=1e-3, abs=1e-3)
        assert spread[k] == pytest.approx(
            jacobian[k] @ covariance @ jacobian[k].T, rel=1e-3, abs=1e-6
        )


@law(misfit.mean_information)
@given(sigma=some.floats(0.02, 2.0), off=some.floats(0.0, 20.0), spread=some.floats(0.0, 2.0))
def test_a_star_loses_information_only_by_what_companions_explain(
    sigma: float, off: float, spread: float
) -> None:
    """In arcseconds: between that of its centroid and that of a star with the greatest error."""
    unit = np.eye(2)[:, :, None]
    own = unit / (sigma * ARCSEC_RAD) ** 2
    residual = np.array([[off], [0.0]]) * ARCSEC_RAD
    mean = misfit.mean_information(own, residual, (spread * ARCSEC_RAD) ** 2 * unit)[:, :, 0]
    least = 1 / (sigma**2 + (ERROR_RAD.max() / ARCSEC_RAD) ** 2)
    share = np.diag(mean) * (sigma * ARCSEC_RAD) ** 2
    assert (share <= 1 + 1e-9).all()
    assert (share >= least * sigma**2 - 1e-9).all()
    if off > 6 * np.hypot(sigma, spread) + 3:
        assert share[0] < 0.6
    if off < np.hypot(sigma, spread) and np.hypot(sigma, spread) < 0.5:
        assert share[0] > 0.6


@pytest.mark.slow
def test_shares_of_companions_match_the_catalogs() -> None:
    """Hipparcos' entries against the center of light of Gaia's stars: shares beyond 0.5 and 1.5 seconds of arc."""
    entries = catalog.brighter_than(catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv"), 5.75)
    when = catalog.on_earth(catalog.utc("2012-06-22T21:00"))
    sky = catalog.read(CATALOGS / "gaia_v8.0.ecsv")
    seen = catalog.apparent(entries, when)
    stars = catalog.apparent(sky, when)
    flux = 10 ** (-0.4 * sky.v_mag)
    off_arcsec = []
    for vector in seen:
        near = np.flatnonzero(stars @ vector > np.cos(40 * ARCSEC_RAD))
        center = flux[near] @ stars[near]
        off_arcsec.append(
            np.linalg.norm(center / np.linalg.norm(center) - vector) / ARCSEC_RAD
        )
    for limit in (0.5, 1.5):
        found = float(np.mean(np.array(off_arcsec) > limit))
        expected = SHARE @ np.exp(
            -0.5 * (limit / np.maximum(ERROR_RAD / ARCSEC_RAD, 1e-9)) ** 2
        )
        assert expected == pytest.approx(found, rel=0.5)
