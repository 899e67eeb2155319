"""Pairs of stars in buckets of their angle: against brute force and the published example."""

import numpy as np
import pytest

from estimator.catalog.pair_index import ARCSEC_RAD, PairCatalog
from estimator.core.checks import Floats
from tests.helpers.interpreted import interpreted

PLAIN = interpreted("estimator.catalog.pair_index")
bucket_of = PLAIN.bucket_of
candidates = PLAIN.candidates
build_pair_catalog = PLAIN.build_pair_catalog


def in_a_cap(rng: np.random.Generator, count: int, radius_rad: float) -> Floats:
    """Unit vectors uniform over a cap about z."""
    z = rng.uniform(np.cos(radius_rad), 1, count)
    about = rng.uniform(0, 2 * np.pi, count)
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(about), across * np.sin(about), z])


def all_pairs(vectors: Floats) -> tuple[Floats, Floats]:
    """Every pair's rows (P, 2) and its angle by the cross product: brute force, another formula."""
    i, j = np.triu_indices(len(vectors), 1)
    cross = np.linalg.norm(np.cross(vectors[i], vectors[j]), axis=1)
    return np.column_stack([i, j]), np.arctan2(cross, np.sum(vectors[i] * vectors[j], axis=1))


def names(pair: Floats) -> Floats:
    """Sorted numbers of pairs, independent of the order within a pair."""
    low, high = np.sort(pair, axis=1).astype(int).T
    return np.sort(low * 10_000 + high)


@pytest.fixture(scope="module")
def crowd() -> Floats:
    return in_a_cap(np.random.default_rng(70), 500, np.radians(6))


@pytest.fixture(scope="module")
def published(crowd: Floats) -> PairCatalog:
    """Angles from 1.5 to 8 degrees in buckets of 5 arcsec (Padro 2012, section 2.4.6)."""
    return build_pair_catalog(
        crowd, np.zeros(500), 5 * ARCSEC_RAD, (np.radians(1.5), np.radians(8))
    )


def test_the_published_range_has_4680_buckets(published: PairCatalog) -> None:
    assert len(published.table) - 1 == 4680  # A13
    assert published.table[0] == 0
    assert published.table[-1] == len(published.pair)
    assert np.diff(published.table).min() >= 0


def test_eq_12_s_example_takes_the_third_and_second_bucket_from_the_end() -> None:
    # theta_max - 1.7 D with 3 epsilon = .6 D: PC range [theta_max - 2.3 D, theta_max - 1.1 D] (A14), of M = 40.
    top = 0.1
    width = 2e-3
    angles = np.array([top - 1.7 * width - 0.6 * width, top - 1.7 * width + 0.6 * width])
    np.testing.assert_allclose((top - angles) / width, [2.3, 1.1], rtol=1e-12)  # rounding
    # From the first entry of bucket M - 2 to before that of bucket M, counted from 1; from 0: M - 3 and M - 2.
    assert bucket_of(angles, top, width, 40).tolist() == [37, 38]
    # Stars on an arc, each bucket one pair with the first star: the entries are those two buckets' pairs.
    # The first star only pairs with the others if those are out of range of one another: range from 60 mrad.
    arc = np.concatenate([[0.0], top - width * (np.arange(20) + 0.5)])
    stars = np.column_stack([np.sin(arc), np.zeros(21), np.cos(arc)])
    known = build_pair_catalog(stars, np.zeros(21), width, (top - 20 * width, top))
    begin, end = candidates(known, *angles)
    # With star 0, at theta_max - 2.5 D and - 1.5 D.
    assert names(known.pair[begin:end]).tolist() == [2, 3]


@pytest.mark.parametrize("width_arcsec", [5, 100, 3600, 1e6])
def test_nothing_within_the_gate_is_missed(crowd: Floats, width_arcsec: float) -> None:
    rng = np.random.default_rng(71)
    crowd = crowd[:200]
    known = build_pair_catalog(crowd, np.zeros(200), width_arcsec * ARCSEC_RAD)
    pair, angle = all_pairs(crowd)
    np.testing.assert_array_equal(names(known.pair), names(pair))
    # the two formulae differ by rounding
    gate = 29 * ARCSEC_RAD
    slack = 1e-12
    keys = {}
    for theta in np.concatenate(
        [rng.uniform(0, np.radians(12.5), 60), rng.choice(angle, 20)]
    ):
        window = candidates(known, theta - gate, theta + gate)
        if window not in keys:
            keys[window] = names(known.pair[slice(*window)])
        inside = (angle > theta - gate + slack) & (angle < theta + gate - slack)
        assert np.isin(names(pair[inside]), keys[window]).all()


def test_an_angle_that_ends_a_gate_exactly_is_not_missed(crowd: Floats) -> None:
    # Gates whose ends are the angles themselves and buckets whose ends are too: rounding must not lose them.
    known = build_pair_catalog(crowd[:60], np.zeros(60), 100 * ARCSEC_RAD)
    buckets = len(known.table) - 1
    for number in range(buckets):
        edge = known.max_rad - (buckets - number) * known.width_rad
        assert bucket_of(np.array([edge]), known.max_rad, known.width_rad, buckets)[0] in (
            number - 1,
            number,
            0,
        )
    for p, q in known.pair:
        angle = 2 * np.arcsin(np.linalg.norm(crowd[p] - crowd[q]) / 2)
        begin, end = candidates(known, angle, angle)
        assert (p, q) in {(int(a), int(b)) for a, b in known.pair[begin:end]}


def test_buckets_of_a_quarter_gate_look_at_an_eighth_too_many(
    published: PairCatalog, crowd: Floats
) -> None:
    # Half a bucket at either end of a 40 arcsec gate: 5 / 40 = 12.5 % (A13).
    rng = np.random.default_rng(72)
    gate = 20 * ARCSEC_RAD
    angle = np.sort(all_pairs(crowd)[1])
    looked = expected = 0
    thetas = rng.uniform(np.radians(1.6), np.radians(7.9), 4000)
    for theta in thetas:
        begin, end = candidates(published, theta - gate, theta + gate)
        looked += end - begin
        expected += np.searchsorted(angle, theta + gate) - np.searchsorted(
            angle, theta - gate
        )
    # Of N wanted an eighth is Poisson, and less is repeated as the gates overlap: five deviations of that eighth.
    pairs_once = len(published.pair)
    assert abs(looked / expected - 1.125) < 5 * np.sqrt(0.125 / pairs_once)


def test_pairs_are_limited_by_magnitude_and_angle(crowd: Floats) -> None:
    magnitude = np.random.default_rng(73).uniform(0, 100, 500)
    limits = np.radians(2), np.radians(5)
    known = build_pair_catalog(crowd, magnitude, range_rad=limits, magnitudes=(20, 90))
    pair, angle = all_pairs(crowd)
    shines = (magnitude >= 20) & (magnitude <= 90)
    in_range = (angle >= limits[0]) & (angle <= limits[1]) & shines[pair].all(axis=1)
    np.testing.assert_array_equal(names(known.pair), names(pair[in_range]))


def test_settings_that_leave_no_catalog_are_refused(crowd: Floats) -> None:
    with pytest.raises(
        PLAIN.ImageError, match=r"no pair of stars from 20\.000 to 30\.000 deg"
    ):
        build_pair_catalog(crowd, np.zeros(500), range_rad=(np.radians(20), np.radians(30)))
    with pytest.raises(PLAIN.ImageError, match="bucket width 0 rad; allowed: more than 0"):
        build_pair_catalog(crowd, np.zeros(500), 0)
