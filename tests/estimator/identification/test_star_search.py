"""The default identifier: its sky against brute force, its evidence against chance, its errors against theory."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.catalog import sky_index
from estimator.core.errors import ImageError
from estimator.core.vectors import quaternion_xyzw
from estimator.identification.stars import evidence, search
from estimator.identification.stars.evidence import Solution

WIDE_RAD = np.radians(12.0)
FIELD = np.tan(np.radians([-5.0, 5.0, -4.0, 4.0]))
SIGMA = 2e-5
CHECKS = 200_000
BASE = 20


def random_sky(count: int, seed: int):
    """Uniform directions, and magnitudes that grow as the real sky's: ten to the half."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(count, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors, np.sort(6.0 + 2 * np.log10(rng.uniform(1e-4, 1, count)))


VECTORS, MAG = random_sky(6000, 1)
SKY = sky_index.build(VECTORS, MAG, WIDE_RAD)


def observe(truth: Rotation, rng, sigma=SIGMA, zoom=1.0, vectors=VECTORS, mag=MAG):
    """Tangents, magnitudes and rows of the stars in the field, brightest first, through a focal length `zoom` times."""
    x, y, z = truth.apply(vectors).T
    tangent = zoom * np.column_stack([x, y]) / np.where(z > 0.1, z, np.inf)[:, None]
    inside = (z > 0.1) & (tangent > FIELD[[0, 2]]).all(axis=1) & (tangent < FIELD[[1, 3]]).all(axis=1)
    row = np.flatnonzero(inside)
    noisy = tangent[row] + sigma * rng.standard_normal((len(row), 2))
    shown = mag[row] + 0.25 * rng.standard_normal(len(row))
    order = np.argsort(shown)
    return noisy[order], shown[order], row[order]


def detections_of(tangent, mag, sigma=SIGMA, zoom=0.0) -> evidence.Detections:
    sigmas = np.full(len(tangent), sigma)
    weight = np.stack([sigmas**-2, sigmas**-2, 0 * sigmas], axis=1)
    return evidence.Detections(np.ascontiguousarray(tangent), sigmas, weight, np.array(mag), 0.25, FIELD, zoom)


def solve(detections: evidence.Detections, sky: sky_index.SkyIndex = SKY) -> Solution:
    return search.lost_in_space(detections, sky, sky, BASE, CHECKS)


def attitude_error(solution: Solution, truth: Rotation):
    """The small turn from the truth to the answer, in camera axes."""
    return (Rotation.from_quat(solution.cam_from_ref_xyzw) * truth.inv()).as_rotvec()


def test_the_sky_holds_every_pair_in_its_bin() -> None:
    chord = 2 * np.sin(WIDE_RAD / 2)
    expected = {tuple(sorted(pair)) for pair in cKDTree(VECTORS).query_pairs(chord)}
    assert {tuple(sorted(pair)) for pair in SKY.pair.tolist()} == expected
    assert len(SKY.pair) == len(expected)
    one, other = VECTORS[SKY.pair].transpose(1, 0, 2)
    angle = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), np.sum(one * other, axis=1))
    number = np.repeat(np.arange(len(SKY.first) - 1), np.diff(SKY.first))
    offset = angle / SKY.bin_rad - number
    assert offset.min() > -1e-9  # rounding
    assert offset.max() < 1 + 1e-9


# Corners, edges and middles of the cube's faces are where a grid on it may fail.
coordinate = st.one_of(st.floats(-1, 1), st.sampled_from([-1.0, 0.0, 1.0]))


@settings(deadline=None)
@given(coordinate, coordinate, coordinate, st.floats(1e-4, 0.05))
@example(-1.0, -1.0, 0.921875, 0.046875)  # the star stands at a tangent of 1.13 of the face
def test_the_nearest_star_is_that_of_a_tree(x: float, y: float, z: float, gate: float) -> None:
    where = np.array([x, y, z]) + 1e-3
    where /= np.linalg.norm(where)
    star, chord2 = sky_index.nearest(SKY.vectors, SKY.cell_first, SKY.cell_star, SKY.side, *where, gate)
    chord, expected = cKDTree(VECTORS).query(where)
    inside = chord < gate
    assert star == (expected if inside else -1)
    assert chord2 == pytest.approx(chord**2 if inside else gate**2, rel=1e-9)


def test_a_sky_without_a_pattern_is_refused() -> None:
    in_a_row = Rotation.from_rotvec([[0, 0, 0], [0, 0.15, 0], [0, 0.3, 0]]).apply([0.0, 0.0, 1.0])
    with pytest.raises(ImageError, match=r"2 pairs of stars within 12\.00 deg are too few; allowed: 3 or more"):
        sky_index.build(in_a_row, MAG[:3], WIDE_RAD)


def test_lights_that_are_worse_along_than_across_count_as_they_are() -> None:
    """Smeared stars: about y, which errors along x turn, the attitude errs as it says, and about x too."""
    rng, scaled = np.random.default_rng(12), []
    along, across = 4 * SIGMA, SIGMA / 4
    for _ in range(150):
        truth = Rotation.random(rng=rng)
        tangent, mag, _ = observe(truth, rng, sigma=0.0)
        tangent = tangent + rng.standard_normal(tangent.shape) * [along, across]
        detections = detections_of(tangent, mag, along)
        solution = solve(detections._replace(weight=np.tile([along**-2, across**-2, 0], (len(mag), 1))))
        if len(solution.star):
            scaled.append(attitude_error(solution, truth) / np.sqrt(np.diag(solution.covariance_rad2)))
    assert len(scaled) > 140
    # A mean square of 140 numbers is 1 to 12 %; that of equal weights would be 2 and 1/8.
    np.testing.assert_allclose(np.mean(np.square(scaled), axis=0), 1, rtol=0, atol=0.4)


def test_true_lights_give_the_true_attitude_and_names() -> None:
    rng = np.random.default_rng(2)
    for _ in range(30):
        truth = Rotation.random(rng=rng)
        tangent, mag, row = observe(truth, rng, sigma=0.0)
        solution = solve(detections_of(tangent, mag))
        # Rounding over a field of a tenth of a radian.
        assert np.linalg.norm(attitude_error(solution, truth)) < 1e-12
        assert np.array_equal(row[solution.observed], solution.star)
        assert len(solution.star) == len(row)


@pytest.mark.parametrize("known", [True, False])
def test_half_of_the_lights_may_be_false(known: bool) -> None:
    rng, solved = np.random.default_rng(3), 0
    for _ in range(40):
        truth = Rotation.random(rng=rng)
        tangent, mag, _ = observe(truth, rng)
        while len(mag) < 7:
            truth = Rotation.random(rng=rng)
            tangent, mag, _ = observe(truth, rng)
        strays = rng.uniform(FIELD[[0, 2]], FIELD[[1, 3]], (7, 2))
        shown = np.concatenate([mag[:7], rng.choice(MAG, 7)])
        order = np.argsort(shown)
        shown = shown[order] if known else np.full(14, np.nan)
        solution = solve(detections_of(np.concatenate([tangent[:7], strays])[order], shown))
        # Seven stars of 4": a wrong attitude would be tens of degrees off.
        solved += len(solution.star) > 0 and np.linalg.norm(attitude_error(solution, truth)) < 50 * SIGMA
    assert solved == 40


@pytest.mark.parametrize("zoom", [0.0, 0.05])
def test_the_covariance_is_true(zoom: float) -> None:
    """NEES of 300 attitudes; with the focal length unknown to 5 % that of the zoom's own error too."""
    rng = np.random.default_rng(4)
    nees, focal_errors = [], []
    for _ in range(300):
        truth, true_ratio = Rotation.random(rng=rng), 1 + rng.uniform(-zoom, zoom)
        tangent, mag, row = observe(truth, rng, zoom=true_ratio)
        solution = solve(detections_of(tangent, mag, zoom=zoom))
        error = attitude_error(solution, truth)
        nees.append(error @ np.linalg.solve(solution.covariance_rad2, error))
        focal_errors.append((np.log(solution.focal_ratio / true_ratio)) / zoom_sigma(truth, row, true_ratio))
    # Chi-square of three degrees: mean 3, deviation sqrt(6 / 300) = 0.141; four of them.
    assert np.mean(nees) == pytest.approx(3, abs=0.57)
    # The mean square of 300 normal numbers: deviation sqrt(2 / 300) = 0.082.
    assert np.mean(np.square(focal_errors)) == pytest.approx(1 if zoom else 0, abs=0.33)


def zoom_sigma(truth: Rotation, row, zoom: float) -> float:
    """Of log zoom where the attitude is unknown too: least squares with slopes by differences."""

    def model(p):
        x, y, z = (Rotation.from_rotvec(p[:3]) * truth).apply(VECTORS[row]).T
        return zoom * np.exp(p[3]) * np.concatenate([x / z, y / z])

    slope = np.column_stack([(model(1e-6 * unit) - model(-1e-6 * unit)) / 2e-6 for unit in np.eye(4)])
    return SIGMA * float(np.sqrt(np.linalg.inv(slope.T @ slope)[3, 3]))


@pytest.mark.long
def test_lights_that_fell_anywhere_are_refused() -> None:
    """Evidence beyond 10^x is met in less than one of 10^x frames, and 10^4 is asked for: none of 200."""
    rng = np.random.default_rng(5)
    for _ in range(200):
        count = rng.integers(3, 21)
        tangent = rng.uniform(FIELD[[0, 2]], FIELD[[1, 3]], (count, 2))
        assert not len(solve(detections_of(tangent, np.sort(rng.choice(MAG, count)))).star)


def test_a_mirrored_sky_is_refused() -> None:
    rng = np.random.default_rng(6)
    for _ in range(40):
        tangent, mag, _ = observe(Rotation.random(rng=rng), rng)
        assert not len(solve(detections_of(tangent * [-1, 1], mag)).star)


def test_a_sky_that_repeats_is_ambiguous() -> None:
    """Stars that stand twice in the catalog are two attitudes: beyond chance, not decisive, and refused."""
    rng = np.random.default_rng(7)
    sparse, sparse_mag = random_sky(300, 8)
    once, loose = sky_index.build(sparse, sparse_mag, WIDE_RAD), 5e-4
    dex = np.inf
    while not search.ACCEPT_DEX < dex < search.DECISIVE_DEX:
        truth = Rotation.random(rng=rng)
        tangent, mag, row = observe(truth, rng, sigma=loose, vectors=sparse, mag=sparse_mag)
        dex = solve(detections_of(tangent, mag, sigma=loose), once).dex if len(row) > 3 else np.inf
    copied = Rotation.from_euler("xyz", [70, 20, 30], degrees=True).apply(sparse[row])
    clear = np.linalg.norm(sparse - copied.mean(axis=0), axis=1) > 0.2
    vectors, both = (
        np.concatenate([sparse[clear], copied]),
        np.concatenate([sparse_mag[clear], sparse_mag[row]]),
    )
    order = np.argsort(both, kind="stable")
    twice = sky_index.build(vectors[order], both[order], WIDE_RAD)
    assert not len(solve(detections_of(tangent, mag, sigma=loose), twice).star)


def test_one_light_of_another_brightness_costs_little() -> None:
    """A variable star, or a planet on a star: the others carry the answer, and it is matched all the same."""
    rng = np.random.default_rng(9)
    for _ in range(20):
        truth = Rotation.random(rng=rng)
        tangent, mag, row = observe(truth, rng)
        mag[3] -= 2.5
        solution = solve(detections_of(tangent, mag))
        assert np.linalg.norm(attitude_error(solution, truth)) < 50 * SIGMA
        assert row[3] in solution.star


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_normal_equations_are_solved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(4, 4))
    matrix, right = half @ half.T + 0.1 * np.eye(4), rng.normal(size=4)
    np.testing.assert_allclose(matrix @ evidence.cholesky_solve(matrix.copy(), right), right, rtol=0, atol=1e-10)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([None, [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0]]))
def test_a_matrix_is_its_quaternion(seed: int, axis) -> None:
    """Half turns, where the scalar part vanishes, as well."""
    rotation = Rotation.random(rng=seed) if axis is None else Rotation.from_rotvec(np.pi * np.array(axis))
    again = Rotation.from_quat(quaternion_xyzw(rotation.as_matrix()))
    assert (again * rotation.inv()).magnitude() < 1e-14 * 10
