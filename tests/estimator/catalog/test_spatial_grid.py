"""Stars near a direction: cells against brute force anywhere on the sphere and at any radius."""

import numpy as np
import pytest

from estimator.catalog import sky_index
from estimator.core.checks import Floats


def directions(rng: np.random.Generator, count: int) -> Floats:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def patch(rng: np.random.Generator, count: int) -> Floats:
    vectors = np.column_stack([rng.uniform(-0.02, 0.02, (count, 2)), np.ones(count)])
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("chord", [1e-4, 0.01, 0.2, 1.9, 2.0])
@pytest.mark.parametrize("make", [directions, patch])
def test_the_stars_within_a_distance_match_brute_force(make, chord: float) -> None:
    rng = np.random.default_rng(1)
    vectors = make(rng, 700)
    known = sky_index.build_grid(vectors)
    out = np.empty(700, np.int64)
    # Some of the stars themselves, the poles of the axes, and anywhere.
    for place in np.vstack([vectors[:40], np.eye(3), -np.eye(3), directions(rng, 100)]):
        count = sky_index.within(known, vectors, *place, chord, out)
        off = np.linalg.norm(vectors - place, axis=1)
        assert sorted(out[:count]) == np.flatnonzero(off <= chord).tolist()
        near, apart2 = sky_index.nearest(
            vectors, known.first, known.row, known.side, *place, chord
        )
        assert near == (off.argmin() if off.min() < chord else -1)
        assert apart2 == pytest.approx(min(off.min(), chord) ** 2, rel=1e-12, abs=1e-30)


def test_every_star_is_in_one_cell() -> None:
    vectors = directions(np.random.default_rng(2), 5000)
    known = sky_index.build_grid(vectors)
    assert sorted(known.row) == list(range(5000))
    assert known.first[-1] == 5000
    assert np.all(np.diff(known.first) >= 0)


def test_a_short_list_keeps_the_count() -> None:
    vectors = patch(np.random.default_rng(3), 50)
    out = np.full(10, -1)
    assert (
        sky_index.within(sky_index.build_grid(vectors), vectors, 0.0, 0.0, 1.0, 0.5, out)
        == 50
    )
    assert len(set(out)) == 10
