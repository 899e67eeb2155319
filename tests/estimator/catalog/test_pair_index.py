"""Pairs of stars: the k-vector against brute force, neighbors in order, counts against geometry."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.catalog import pair_index


def uniform_sky(count: int, seed: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def angles(vectors: np.ndarray) -> np.ndarray:
    """All angles between rows by the cross product, a formula that the index does not use."""
    cross = np.linalg.norm(np.cross(vectors[:, None], vectors[None]), axis=2)
    return np.arctan2(cross, vectors @ vectors.T)


def of_angles(angle_rad: np.ndarray) -> pair_index.PairIndex:
    """An index with these sorted angles and arbitrary stars."""
    count, slope, offset = pair_index.k_vector(angle_rad)
    any_sky = pair_index.build(np.eye(3), 2.0)
    return any_sky._replace(
        angle_rad=angle_rad, kvector=count, slope_rad=slope, offset_rad=offset
    )


@pytest.fixture(scope="module")
def sky() -> pair_index.PairIndex:
    return pair_index.build(uniform_sky(600, seed=30), np.radians(18.0))


def test_the_pairs_match_brute_force(sky: pair_index.PairIndex) -> None:
    every = angles(sky.vectors)
    i, j = np.nonzero(np.triu(every <= np.radians(18.0), 1))
    wanted = sorted(zip(i.tolist(), j.tolist(), strict=True))
    assert sorted(map(tuple, np.sort(sky.pair, axis=1).tolist())) == wanted
    # 1e-15: rounding of two formulas of the same angle.
    np.testing.assert_allclose(
        sky.angle_rad, every[sky.pair[:, 0], sky.pair[:, 1]], rtol=0, atol=1e-15
    )


def test_the_pairs_are_sorted_by_angle(sky: pair_index.PairIndex) -> None:
    assert np.all(np.diff(sky.angle_rad) >= 0)


def test_every_star_has_all_its_neighbors_sorted_by_angle(sky: pair_index.PairIndex) -> None:
    every = angles(sky.vectors)
    np.fill_diagonal(every, np.inf)
    for star in range(len(sky.vectors)):
        mine = slice(sky.first[star], sky.first[star + 1])
        near = np.flatnonzero(every[star] <= np.radians(18.0))
        assert sorted(sky.neighbor[mine].tolist()) == near.tolist()
        assert np.all(np.diff(sky.separation_rad[mine]) >= 0)
        # 1e-15: rounding of two formulas of the same angle.
        np.testing.assert_allclose(
            sky.separation_rad[mine], every[star, sky.neighbor[mine]], rtol=0, atol=1e-15
        )


def test_bisection_finds_the_first_neighbor_beyond_an_angle(
    sky: pair_index.PairIndex,
) -> None:
    rng = np.random.default_rng(31)
    for star, low in zip(
        rng.integers(0, 600, 300), rng.uniform(-0.01, 0.33, 300), strict=True
    ):
        mine = sky.separation_rad[sky.first[star] : sky.first[star + 1]]
        begin, _ = pair_index.neighbor_range(sky, star, low, 1.0)
        assert begin - sky.first[star] == np.searchsorted(mine, low)


# Sixty-fourths are exact in binary, so that angles fall on one another, on the query's ends and on the line's nodes.
SIXTY_FOURTHS = st.integers(0, 64).map(lambda n: n / 64)
ANY_ANGLE = st.floats(0, 1, allow_subnormal=False) | SIXTY_FOURTHS


@pytest.mark.long
@settings(max_examples=400, deadline=None, derandomize=True)
@given(st.lists(ANY_ANGLE, min_size=3, max_size=40).map(sorted), ANY_ANGLE, ANY_ANGLE)
def test_the_k_vector_misses_no_pair_and_adds_few(
    given_rad: list, one: float, other: float
) -> None:
    low = min(one, other)
    high = max(one, other)
    angle = np.array(given_rad)
    known = of_angles(angle)
    begin, end = pair_index.pair_range(known, low, high)
    inside = np.flatnonzero((angle >= low) & (angle <= high))
    assert 0 <= begin <= end <= len(angle)
    assert set(inside) <= set(range(begin, end))
    # What it takes in beside the range lies within one step of the line (and rounding) from its ends.
    step = 1.001 * known.slope_rad
    assert np.all((angle[begin:end] >= low - step) & (angle[begin:end] <= high + step))


def test_an_angle_on_a_node_of_the_line_is_found() -> None:
    # Three angles evenly apart: the middle one lies on the middle node, and is the query's own end.
    angle = np.array([0.25, 0.5, 0.75])
    known = of_angles(angle)
    assert pair_index.pair_range(known, 0.5, 0.6)[0] <= 1
    assert pair_index.pair_range(known, 0.4, 0.5)[1] >= 2


def test_a_range_of_the_real_index_holds_brute_force_s_pairs_and_few_more(
    sky: pair_index.PairIndex,
) -> None:
    rng = np.random.default_rng(32)
    extra = []
    for middle, half in zip(
        rng.uniform(0, 0.33, 500), rng.uniform(1e-5, 1e-3, 500), strict=True
    ):
        begin, end = pair_index.pair_range(sky, middle - half, middle + half)
        first, last = np.searchsorted(sky.angle_rad, [middle - half, middle + half])
        assert set(range(first, last)) <= set(range(begin, end))
        extra.append((end - begin) - (last - first))
    # One step of the line holds one pair on average, twice that at wide angles: half a step at either end.
    assert np.mean(extra) < 3


def test_ranges_off_either_end_are_empty_or_all(sky: pair_index.PairIndex) -> None:
    count = len(sky.angle_rad)
    empty = [pair_index.pair_range(sky, *ends) for ends in [(-2.0, -1.0), (1.0, 2.0)]]
    assert [end - begin for begin, end in empty] == [0, 0]
    assert pair_index.pair_range(sky, -1.0, 2.0) == (0, count)


def test_the_number_of_pairs_follows_from_the_solid_angle() -> None:
    # A uniform sky of N stars has N (N - 1) / 2 (1 - cos theta) / 2 pairs closer than theta, Poisson nearly.
    known = pair_index.build(uniform_sky(2000, seed=33), np.radians(10.0))
    expected = 2000 * 1999 / 2 * (1 - np.cos(np.radians(10))) / 2
    assert len(known.pair) == pytest.approx(expected, abs=4 * np.sqrt(expected))


@pytest.mark.parametrize("theta_deg", [3.0, 6.0, 9.0])
def test_the_candidates_of_one_angle_match_reference_f2(theta_deg: float) -> None:
    # Reference section 4: f2 = N (N - 1) / 2 sin(theta) sin(eps).
    known = pair_index.build(uniform_sky(2000, seed=34), np.radians(10.0))
    eps = np.radians(0.1)
    begin, end = pair_index.pair_range(
        known, np.radians(theta_deg) - eps, np.radians(theta_deg) + eps
    )
    expected = 2000 * 1999 / 2 * np.sin(np.radians(theta_deg)) * np.sin(eps)
    assert end - begin == pytest.approx(expected, abs=4 * np.sqrt(expected))


def test_small_angles_keep_their_digits() -> None:
    # Stars 1e-8 rad apart, where arccos of the dot product would read 0 or 1.5e-8.
    vectors = np.array([[0.0, 0, 1], [1e-8, 0, 1], [0, 3e-8, 1]])
    known = pair_index.build(vectors, 1e-3)
    # Rounding of 1.
    np.testing.assert_allclose(
        known.angle_rad, [1e-8, 3e-8, np.sqrt(10) * 1e-8], rtol=1e-8, atol=0
    )


def test_a_sky_without_patterns_is_refused() -> None:
    with pytest.raises(ValueError, match=r"1 pairs .*within 1\.00 deg"):
        pair_index.build(
            np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0.001, 1]]), np.radians(1.0)
        )


@pytest.mark.slow
def test_a_range_of_magnitudes_matches_brute_force() -> None:
    rng = np.random.default_rng(35)
    magnitude = np.sort(np.round(rng.uniform(0, 6, 300), 1))  # many are equal
    known = pair_index.build(uniform_sky(300, seed=36), np.radians(20.0), magnitude=magnitude)
    for middle, gate in zip(rng.uniform(-1, 7, 100), rng.uniform(0, 1, 100), strict=True):
        inside = np.flatnonzero((magnitude >= middle - gate) & (magnitude <= middle + gate))
        begin, end = pair_index.magnitude_range(known, middle, gate)
        assert list(range(begin, end)) == inside.tolist()


def test_without_magnitudes_or_a_gate_no_star_is_excluded(sky: pair_index.PairIndex) -> None:
    known = pair_index.build(
        uniform_sky(50, seed=37), np.radians(60.0), magnitude=np.linspace(0, 5, 50)
    )
    assert pair_index.magnitude_range(sky, 3.0, 0.1) == (0, 600)
    assert pair_index.magnitude_range(known, np.nan, 0.1) == (0, 50)
    assert pair_index.magnitude_range(known, 3.0, np.inf) == (0, 50)


@pytest.mark.parametrize("magnitude", [np.linspace(5, 0, 600), np.zeros(3)])
def test_magnitudes_that_fall_or_are_too_few_are_refused(magnitude: np.ndarray) -> None:
    with pytest.raises(
        ValueError, match=r"of 600 stars; allowed: one for each, the brightest first"
    ):
        pair_index.build(uniform_sky(600, seed=30), np.radians(18.0), magnitude=magnitude)
