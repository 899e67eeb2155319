"""The Bayes factor of a candidate attitude under the stars: each of its terms against an integral or a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import betaln
from scipy.stats import norm

from estimator.catalog import sky_index
from estimator.identification import star_evidence
from tests.helpers.interpreted import interpreted

FIELD = np.tan(np.radians([-5.0, 5.0, -4.0, 4.0]))
AREA = float((FIELD[1] - FIELD[0]) * (FIELD[3] - FIELD[2]))
SIGMA = 1e-4
TRUTH = Rotation.from_rotvec([0.3, -0.8, 0.5])
# Seven stars in the field, brightest first, and one far outside of it.
TANGENT = np.array(
    [
        [0.01, 0.02],
        [-0.06, 0.05],
        [0.07, -0.03],
        [-0.04, -0.05],
        [0.03, 0.06],
        [0.05, 0.01],
        [-0.02, 0.0],
        [0.5, 0.5],
    ]
)
RAYS = np.column_stack([TANGENT, np.ones(len(TANGENT))])
RAYS /= np.linalg.norm(RAYS, axis=1, keepdims=True)
SKY = sky_index.build(TRUTH.inv().apply(RAYS), np.arange(1.0, 9.0))


def seen(tangent: np.ndarray) -> star_evidence.Detections:
    """Detections without magnitudes and with isotropic errors."""
    sigma = np.full(len(tangent), SIGMA)
    weight = np.column_stack([sigma**-2, sigma**-2, 0 * sigma])
    return star_evidence.Detections(
        tangent.copy(), sigma, weight, np.full(len(tangent), np.nan), 0.25, FIELD, 0.0, np.nan
    )


def evaluated(tangent: np.ndarray) -> star_evidence.Hypothesis:
    """Hypothesis of the true attitude, without a limit of its evidence."""
    gates = np.full(len(tangent), 0.01)
    return star_evidence.evaluate(seen(tangent), SKY, TRUTH.as_matrix(), 1.0, gates, -np.inf)


def test_evidence_is_the_integral_over_all_attitudes() -> None:
    """Mean over the 8 pi^2 of attitudes of the likelihood of four matches, over that of any places on the sensor.

    Summed here over a lattice of small turns about the best attitude; Laplace's approximation is an ellipsoid. The
    four have no missing star, so that their counts give B(5, 1) = 1 / 5, and their places 4! / area^4.
    """
    stars = np.arange(4)
    offset = SIGMA * np.array([[0.8, -0.3], [-0.5, 0.4], [0.1, 0.9], [-0.6, -0.7]])
    hypothesis = evaluated(TANGENT[stars] + offset)
    assert hypothesis.star.tolist() == stars.tolist()
    # Turn about each axis to 6 sigma of it, in steps of half a sigma, along the principal axes of the information.
    spread, axes = np.linalg.eigh(np.linalg.inv(hypothesis.info[:3, :3]))
    step = np.arange(-6, 6.1, 0.5)
    lattice = (
        np.stack(np.meshgrid(step, step, step), axis=-1).reshape(-1, 3)
        * np.sqrt(spread)
        @ axes.T
    )
    rays = Rotation.from_matrix(hypothesis.R_cam_from_ref).apply(SKY.vectors[stars])
    turned = np.einsum("nij,kj->nki", Rotation.from_rotvec(lattice).as_matrix(), rays)
    residual = TANGENT[stars] + offset - turned[:, :, :2] / turned[:, :, 2:]
    density = np.exp(-0.5 * np.sum((residual / SIGMA) ** 2, axis=2)) / (2 * np.pi * SIGMA**2)
    volume = np.prod(0.5 * np.sqrt(spread))
    mean = np.sum(np.prod(density, axis=1)) * volume / (8 * np.pi**2)
    chance = 24 / AREA**4
    assert hypothesis.dex == pytest.approx(np.log10(mean / chance / 5), abs=1e-3)


@pytest.mark.parametrize("missing", [1, 2, 3])
def test_missing_stars_cost_the_beta_function_of_the_counts(missing: int) -> None:
    """Stars 0, 1, 2 and 6 are seen; of 3, 4 and 5, which are brighter than 6, some are not in the sky at all."""
    tangent = TANGENT[[0, 1, 2, 6]]
    gone = np.arange(3, 6)[missing:]
    kept = np.setdiff1d(np.arange(len(TANGENT)), gone)
    fewer = sky_index.build(SKY.vectors[kept], SKY.mag[kept])
    gates = np.full(4, 0.01)
    here = star_evidence.evaluate(
        seen(tangent), fewer, TRUTH.as_matrix(), 1.0, gates, -np.inf
    )
    none = np.setdiff1d(np.arange(len(TANGENT)), [3, 4, 5])
    bare = sky_index.build(SKY.vectors[none], SKY.mag[none])
    whole = star_evidence.evaluate(
        seen(tangent), bare, TRUTH.as_matrix(), 1.0, gates, -np.inf
    )
    toll = (betaln(5, missing + 1) - betaln(5, 1)) / np.log(10)
    assert here.dex - whole.dex == pytest.approx(toll, abs=1e-9)


@pytest.mark.parametrize(
    ("limit_mag", "missing"), [(4.4, 0), (5.4, 1), (6.4, 2), (np.nan, 0)]
)
def test_stars_to_the_limiting_magnitude_are_missed(limit_mag: float, missing: int) -> None:
    """Stars 0 to 3, of magnitudes 1 to 4, are seen; stars 4 and 5 are not."""
    lights = seen(TANGENT[:4])
    gates = np.full(4, 0.01)
    dex = []
    for limit in 4.4, limit_mag:
        found = star_evidence.evaluate(
            lights._replace(limit_mag=limit), SKY, TRUTH.as_matrix(), 1.0, gates, -np.inf
        )
        assert found.star.tolist() == [0, 1, 2, 3]
        dex.append(found.dex)
    toll = (betaln(5, missing + 1) - betaln(5, 1)) / np.log(10)
    assert dex[1] - dex[0] == pytest.approx(toll, abs=1e-9)


def test_stars_outside_of_the_field_are_not_missed() -> None:
    """The faintest match is fainter than all; the eighth star is out of the field, one more is behind the camera."""
    behind = np.vstack([-SKY.vectors[:1], SKY.vectors[:7]])
    sky = sky_index.build(behind, np.arange(1.0, 9.0))
    hypothesis = star_evidence.evaluate(
        seen(TANGENT[:7]), sky, TRUTH.as_matrix(), 1.0, np.full(7, 0.01), -np.inf
    )
    assert hypothesis.dex == pytest.approx(evaluated(TANGENT[:7]).dex, abs=1e-9)


def test_bright_strays_cost_half_a_power_of_ten_each_beyond_the_matches() -> None:
    """Four matches after 4, 5 and 7 strays, which also make the detections denser: by the ratio of the counts."""
    places = np.array([[0.01 * n, -0.06] for n in range(-3, 4)])
    dex = []
    for strays in (4, 5, 7):
        hypothesis = evaluated(np.concatenate([places[:strays], TANGENT[:4]]))
        assert hypothesis.star.tolist() == [0, 1, 2, 3]
        total = strays + 4
        dex.append(hypothesis.dex + sum(np.log10(total - k) for k in range(4)))
    np.testing.assert_allclose(np.diff(dex), [-0.5, -1.0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("ratio", [0.98, 0.991, 1.0, 1.009, 1.02])
def test_the_focal_length_is_measured_within_its_uncertainty(ratio: float) -> None:
    """All tangents are `ratio` times those of the assumed focal length, known to 0.01; twice that is no solution."""
    detections = seen(ratio * TANGENT[:7])._replace(focal_uncertainty=0.01)
    hypothesis = star_evidence.evaluate(
        detections, SKY, TRUTH.as_matrix(), 1.0, np.full(7, 0.01), -np.inf
    )
    solved = abs(ratio - 1) < 0.01
    assert hypothesis.star.tolist() == list(range(7) if solved else [])
    # Of two Gauss-Newton steps.
    assert hypothesis.focal_ratio == pytest.approx(ratio if solved else 1.0, abs=1e-6)


@pytest.mark.parametrize(("sigmas", "matched"), [(3.4, 7), (3.6, 6)])
def test_only_stars_within_three_and_a_half_sigma_match(sigmas: float, matched: int) -> None:
    """Of the fitted place. The seventh star's error ellipse is wide and weighs a hundredth in the fit."""
    wide = 10 * SIGMA
    detections = seen(TANGENT[:7])
    detections.tangent[6] += sigmas * wide * np.array([0.6, 0.8])
    detections.sigma[6], detections.weight[6, :2] = wide, wide**-2
    hypothesis = star_evidence.evaluate(
        detections, SKY, TRUTH.as_matrix(), 1.0, np.full(7, 0.01), -np.inf
    )
    assert len(hypothesis.star) == matched


def test_the_magnitudes_density_is_the_smoothed_catalog_s() -> None:
    """A normal law of the smoothing about each star's magnitude; below and above all stars, that of the end."""
    rng = np.random.default_rng(2)
    vectors = rng.normal(size=(2000, 3))
    mag = np.sort(6 + 2 * np.log10(rng.uniform(1e-3, 1, 2000)))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    sky = sky_index.build(vectors, mag)
    for value in (3.0, 4.0, 5.0, 5.5):
        wanted = np.mean(norm.pdf(value, mag, sky_index.MAG_SMOOTHING))
        # Of bins of MAG_STEP.
        assert sky_index.magnitude_density(sky, value) == pytest.approx(wanted, rel=0.1)
    assert sky_index.magnitude_density(sky, -9.0) == sky_index.magnitude_density(sky, mag[0])
    assert sky_index.magnitude_density(sky, 30.0) == sky_index.magnitude_density(
        sky, mag[-1] + 2
    )


@pytest.mark.parametrize("star", [0, 20, 59])
def test_a_magnitude_s_likelihoods_of_one_star_add_up_to_one(star: int) -> None:
    """The ratio is p(mag | star) / p(mag): times the density of the stars seen it is a density of magnitudes."""
    vectors = np.random.default_rng(1).normal(size=(60, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    sky = sky_index.build(vectors, np.linspace(2, 6, 60))
    mag = np.arange(-2, 10, 1e-3)
    share = 0.8
    detections = seen(np.zeros((len(mag), 2)))._replace(mag=mag)
    ratio = [
        star_evidence._magnitude_ratio(detections, sky, n, star, share)
        for n in range(len(mag))
    ]
    density = [sky_index.magnitude_density(sky, value) / share for value in mag]
    # Of 5 stars in 100, variable ones and the like, the magnitude is any of those seen.
    assert np.dot(ratio, density) * 1e-3 == pytest.approx(
        0.95 + 0.05 * np.sum(density) * 1e-3, rel=2e-3
    )


@pytest.mark.parametrize("uncertain", [0.0, 0.01])
def test_the_information_matches_the_projection_s_derivatives(uncertain: float) -> None:
    """J' W J of the tangents' derivatives by rotation and log focal length, by differences; in the interpreter."""
    plain = interpreted("estimator.identification.star_evidence")
    detections = seen(1.01 * TANGENT[:7])
    rows = np.arange(7)
    R = TRUTH.as_matrix()
    detections.weight[:, 1] *= 0.25
    detections.weight[:, 2] = 0.2 / SIGMA**2

    def tangents(p: np.ndarray) -> np.ndarray:
        x, y, z = (Rotation.from_rotvec(p[:3]) * TRUTH).apply(SKY.vectors[:7]).T
        return np.exp(p[3]) * np.column_stack([x / z, y / z])

    slopes = np.array([(tangents(1e-6 * e) - tangents(-1e-6 * e)) / 2e-6 for e in np.eye(4)])
    xx, yy, xy = detections.weight.T
    weights = np.moveaxis(np.array([[xx, xy], [xy, yy]]), 2, 0)
    wanted = np.einsum("ink,nkl,jnl->ij", slopes, weights, slopes)
    count = 4 if uncertain else 3
    info = np.zeros((4, 4))
    ratio, _ = plain._fit(
        detections._replace(focal_uncertainty=uncertain), SKY, R, 1.0, rows, rows, info
    )
    np.testing.assert_allclose(
        info[:count, :count], wanted[:count, :count], rtol=0, atol=1e-6 * np.abs(wanted).max()
    )
    assert (info[count:] == 0).all()
    assert ratio == pytest.approx(1.01 if uncertain else 1.0, abs=1e-4)
