"""Fialho's triangles: triplets against brute force and theory, differences of the four versions, PTASE's success."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.catalog import pair_index
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.vectors import normalized
from estimator.identification.published.fialho import (
    MAG_GATE_SIGMA,
    MIN_SIDE_FRACTION,
    fialho_1,
    fialho_2,
    fialho_3,
    fialho_4,
    search_options,
    triplets,
)
from estimator.identification.solver_options import Options

pytestmark = pytest.mark.slow  # much is compiled

SIGMA_RAD = np.radians(5 / 3600)
EPSILON_MAG = 0.25
HALF_TAN = np.tan(np.radians(10))
DIAGONAL_RAD = 2 * np.arctan(np.sqrt(2) * HALF_TAN)
NEVER = 2.0  # a share of the stars that no match has: every triplet is tried


def uniform_sky(count: int, seed: int) -> pair_index.PairIndex:
    """Uniform random stars, three times as many for each magnitude."""
    rng = np.random.default_rng(seed)
    vectors = normalized(rng.normal(size=(count, 3)))
    return pair_index.build(
        vectors, DIAGONAL_RAD, magnitude=np.sort(5 + np.log(rng.random(count)) / np.log(3))
    )


@pytest.fixture(scope="module")
def sky() -> pair_index.PairIndex:
    return uniform_sky(1500, 100)


def field(
    rng: np.random.Generator, sky: pair_index.PairIndex, attitude: Rotation | None = None
) -> tuple[Floats, Floats, Floats, Rotation]:
    """Noisy directions, brightest first, their magnitudes and rows, and the truth."""
    truth = attitude or Rotation.random(rng=rng)
    x, y, z = truth.apply(sky.vectors).T
    row = np.flatnonzero((z > 0) & (abs(x) < HALF_TAN * z) & (abs(y) < HALF_TAN * z))
    seen = normalized(truth.apply(sky.vectors[row]) + rng.normal(0, SIGMA_RAD, (len(row), 3)))
    light = sky.magnitude[row] + rng.normal(0, EPSILON_MAG, len(row))
    order = np.argsort(light)
    return seen[order], light[order], row[order], truth


def counted(
    seen: Floats,
    light: Floats,
    sky: pair_index.PairIndex,
    eps: float,
    gate: float,
    optimized: bool,
) -> int:
    """Number of catalog triplets similar to a triangle of three stars, by the module's search."""
    settings = Options(epsilon_mag=gate / MAG_GATE_SIGMA, max_checks=10**12)
    parameters = search_options(eps / np.sqrt(2), settings, NEVER, optimized, False)
    tried = np.zeros(2, np.int64)
    triplets(seen, light, sky, np.arange(3), parameters, tried)
    return int(tried[0])


def triangle(rng: np.random.Generator) -> Floats:
    """Three directions 5 to 9 degrees apart, in no catalog."""
    while True:
        tangents = rng.uniform(-0.12, 0.12, (3, 2))
        seen = normalized(np.column_stack([tangents, np.ones(3)]))
        sides = np.linalg.norm(seen - seen[[1, 2, 0]], axis=1)
        if sides.min() > np.radians(5) and sides.max() < np.radians(9):
            return seen


def by_brute_force(
    seen: Floats, light: Floats, sky: pair_index.PairIndex, eps: float, gate: float
) -> int:
    """Every ordered triplet of stars by angles from arctan2, magnitudes and handedness."""
    cross = np.linalg.norm(np.cross(sky.vectors[:, None], sky.vectors), axis=2)
    separation = np.arctan2(cross, sky.vectors @ sky.vectors.T)
    similar = np.abs(sky.magnitude - light[:, None]) <= gate
    side = [
        np.arctan2(np.linalg.norm(np.cross(seen[i], seen[j])), seen[i] @ seen[j])
        for i, j in PAIRS
    ]
    ab, ac, bc = (np.abs(separation - one) <= eps for one in side)
    handed = np.linalg.det(seen)
    count = 0
    for a in np.flatnonzero(similar[0]):
        for b in np.flatnonzero(ab[a] & similar[1]):
            for c in np.flatnonzero(ac[a] & bc[b] & similar[2]):
                count += handed * np.linalg.det(sky.vectors[[a, b, c]]) > 0
    return count


PAIRS = [(0, 1), (0, 2), (1, 2)]


@pytest.mark.parametrize("optimized", [False, True])
@pytest.mark.parametrize("gate", [1.0, np.inf])
def test_the_triplets_match_brute_force(gate: float, optimized: bool) -> None:
    rng = np.random.default_rng(101)
    known = uniform_sky(250, 102)
    total = 0
    for _ in range(12):
        seen = triangle(rng)
        light = np.sort(rng.uniform(2, 5, 3))
        expected = by_brute_force(seen, light, known, np.radians(1.2), gate)
        assert counted(seen, light, known, np.radians(1.2), gate, optimized) == expected
        total += expected
    assert total > 5


def test_the_number_of_triplets_matches_theory(sky: pair_index.PairIndex) -> None:
    # Reference section 4: f3 = N (N-1) (N-2) sin(a) sin(eps) 2 (2 eps)^2 / (4 pi sin K), halved by handedness.
    rng = np.random.default_rng(103)
    eps = np.radians(0.1)
    n = len(sky.vectors)
    expected = found = 0.0
    for _ in range(150):
        seen = triangle(rng)
        a, b, c = seen
        side = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
        to_a = np.cross(a, c)
        to_b = np.cross(b, c)
        sin_k = np.linalg.norm(np.cross(to_a, to_b)) / (
            np.linalg.norm(to_a) * np.linalg.norm(to_b)
        )
        expected += (
            n
            * (n - 1)
            * (n - 2)
            * np.sin(side)
            * np.sin(eps)
            * (2 * eps) ** 2
            / (4 * np.pi * sin_k)
        )
        found += counted(seen, np.full(3, np.nan), sky, eps, np.inf, True)
    assert expected > 50
    # Poisson, five deviations; the formula itself holds to 3 % where K is not near 0.
    assert found == pytest.approx(expected, abs=5 * np.sqrt(expected) + 0.03 * expected)


def test_lists_from_neighbors_answer_as_lists_from_the_whole_catalog(
    sky: pair_index.PairIndex,
) -> None:
    rng = np.random.default_rng(104)
    for _ in range(60):
        seen, light, _, _ = field(rng, sky)
        known = {"magnitude": light, "epsilon_mag": EPSILON_MAG}
        one, two = (
            method(seen, sky, 5 * SIGMA_RAD, **known) for method in (fialho_1, fialho_2)
        )
        assert (one is None) == (two is None)
        if one is not None and two is not None:
            np.testing.assert_array_equal(one.star, two.star)


@pytest.mark.long
def test_one_triangle_succeeds_as_often_as_its_three_magnitudes_pass(
    sky: pair_index.PairIndex,
) -> None:
    # 0.9973^3 = 99.19 %: PTASE's 99.12 +- 0.25 % with mf1_2. Another triangle repairs it.
    rng = np.random.default_rng(105)
    runs = 2000
    found = np.zeros(2)
    for _ in range(runs):
        seen, light, row, _ = field(rng, sky)
        for n, method in enumerate((fialho_2, fialho_3)):
            match = method(seen, sky, 6 * SIGMA_RAD, magnitude=light, epsilon_mag=EPSILON_MAG)
            found[n] += match is not None
            assert match is None or (match.star == row[match.observed]).mean() > 0.8
    passes = 0.9973002**3
    assert found[0] == pytest.approx(
        runs * passes, abs=4 * np.sqrt(runs * passes * (1 - passes))
    )
    # Of six stars or fewer, one field in a hundred, some are not beyond chance.
    assert found[1] > 0.997 * runs


def test_a_false_star_among_the_brightest_stops_one_triangle_but_not_the_next(
    sky: pair_index.PairIndex,
) -> None:
    rng = np.random.default_rng(106)
    found = np.zeros(2)
    for _ in range(30):
        seen, light, _, _ = field(rng, sky)
        far = normalized(np.array([[*rng.uniform(-HALF_TAN, HALF_TAN, 2), 1.0]]))
        seen = np.vstack([far, seen])
        light = np.concatenate([[light[0] - 0.5], light])
        known = {"magnitude": light, "epsilon_mag": EPSILON_MAG}
        for n, method in enumerate((fialho_2, fialho_3)):
            found[n] += method(seen, sky, 5 * SIGMA_RAD, **known) is not None
    # The false star may be too close to another for the triangle, and is then passed over.
    assert found[0] <= 6
    assert found[1] == 30


@pytest.mark.long
def test_a_hint_lets_only_stars_near_the_boresight_be_candidates(
    sky: pair_index.PairIndex,
) -> None:
    rng = np.random.default_rng(107)
    for _ in range(20):
        seen, light, _, truth = field(rng, sky)
        known = {"magnitude": light, "epsilon_mag": 3 * EPSILON_MAG}
        boresight = truth.inv().apply([0.0, 0.0, 1.0])
        near = {"boresight_ref": boresight, "within_rad": DIAGONAL_RAD / 2 + 0.02}
        wrong = {"boresight_ref": -boresight, "within_rad": np.radians(60)}
        for method in (fialho_2, fialho_3, fialho_4):
            plain, hinted = (
                method(seen, sky, 5 * SIGMA_RAD, **known, **more) for more in ({}, near)
            )
            np.testing.assert_array_equal(plain.star, hinted.star)
            assert method(seen, sky, 5 * SIGMA_RAD, **known, **wrong) is None
        # The first version takes no hint, not even a wrong one.
        assert fialho_1(seen, sky, 5 * SIGMA_RAD, **known, **wrong) is not None


def test_the_fourth_version_measures_the_camera_s_magnitudes(
    sky: pair_index.PairIndex,
) -> None:
    # Twice its error bars: of n stars the mean is known to sigma / sqrt(n), the variance to sigma^2 sqrt(2 / (n - 1)).
    rng = np.random.default_rng(109)
    offset = 0.3
    mean = []
    variance = []
    stars = []
    for _ in range(200):
        seen, light, _, _ = field(rng, sky)
        match = fialho_4(
            seen, sky, 5 * SIGMA_RAD, magnitude=light + offset, epsilon_mag=2 * EPSILON_MAG
        )
        if match is not None:
            mean.append(match.offset_mag)
            variance.append(match.variance_mag2)
            stars.append(len(match.star))
    total = np.sum(stars)
    assert np.average(mean, weights=stars) == pytest.approx(
        offset, abs=4 * EPSILON_MAG / np.sqrt(total)
    )
    sigma2 = EPSILON_MAG**2
    assert np.average(variance, weights=stars) == pytest.approx(
        sigma2, abs=4 * sigma2 * np.sqrt(2 / total)
    )


def test_without_magnitudes_the_fourth_version_has_no_magnitude_offset(
    sky: pair_index.PairIndex,
) -> None:
    seen, _, _, _ = field(np.random.default_rng(110), sky)
    match = fialho_4(seen, sky, 5 * SIGMA_RAD)
    assert match is not None
    assert np.isnan(match.offset_mag)
    assert np.isnan(match.variance_mag2)


def test_stars_too_close_for_a_triangle_are_passed_over_or_refused(
    sky: pair_index.PairIndex,
) -> None:
    rng = np.random.default_rng(111)
    seen, light, row, _ = field(rng, sky)
    # A companion of the brightest, nearly as bright, a quarter of the least angle away.
    close = normalized(seen[:1] + np.array([0.25 * MIN_SIDE_FRACTION * DIAGONAL_RAD, 0, 0]))
    both = np.vstack([seen[:1], close, seen[1:]])
    match = fialho_2(
        both,
        sky,
        5 * SIGMA_RAD,
        magnitude=np.insert(light, 1, light[0]),
        epsilon_mag=EPSILON_MAG,
    )
    assert match is not None
    assert row[0] in match.star
    cluster = normalized(
        np.array([0, 0, 1.0])
        + rng.normal(0, 0.2 * MIN_SIDE_FRACTION * DIAGONAL_RAD / 3, (8, 3))
    )
    assert fialho_3(cluster, sky, 5 * SIGMA_RAD) is None


def test_an_invalid_magnitude_error_is_refused(sky: pair_index.PairIndex) -> None:
    seen, light, _, _ = field(np.random.default_rng(112), sky)
    with pytest.raises(
        ImageError,
        match=r"fialho: tolerance 0\.1 rad, magnitude error 0; allowed: more than 0",
    ):
        fialho_2(seen, sky, 0.1, magnitude=light, epsilon_mag=0)
