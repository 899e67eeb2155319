"""The lights of a frame that are identified: double images become one light, and other frames stay as they are."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as some

from estimator.core.types import Centroids
from estimator.identification.star_detections import CELLS, lights_of, spread
from tests.helpers.laws import SEEDS, law


@law(lights_of)
@given(some.booleans(), SEEDS)
def test_double_images_become_one_light_whose_error_reaches_both(
    ghost: bool, rng: np.random.Generator
) -> None:
    true = np.array(
        [[x, y] for x in range(100, 1000, 100) for y in range(100, 1000, 300)], float
    )
    offset = np.array([3.0, 4.0]) * 0.8
    if not ghost:
        angle = rng.uniform(0, 2 * np.pi, len(true))
        offset = 4 * np.column_stack([np.cos(angle), np.sin(angle)])
    seen = Centroids(
        np.vstack([true, true + offset]), np.full(54, 0.1), np.linspace(54, 1, 54)
    )
    lights = lights_of(seen, 1100, 1100, 100)
    assert lights.rows.tolist() == list(range(27))
    np.testing.assert_allclose(lights.centroids.xy_px, true + offset / 2, rtol=0, atol=1e-12)
    np.testing.assert_allclose(lights.centroids.sigma_px, np.hypot(2, 0.1), rtol=1e-12)
    # The images of a reflection have the same error; 27 random directions cancel but for a part of about 1 / sqrt(27).
    if ghost:
        np.testing.assert_allclose(np.abs(lights.offset_px), [1.2, 1.6], rtol=1e-12)
    else:
        assert np.sum(lights.offset_px**2) < 2 * 4 * 3 / np.sqrt(27)


def test_pairs_of_some_stars_and_of_chance_stay_apart() -> None:
    """Ten double stars among 40 lights, and 1,500 lights of which most are near another one."""
    rng = np.random.default_rng(5)
    places = rng.uniform(0, 4000, (30, 2))
    for size, xy_px in (
        (4000, np.vstack([places, places[:10] + 3])),
        (200, rng.uniform(0, 200, (1500, 2))),
    ):
        count = len(xy_px)
        seen = Centroids(xy_px, np.full(count, 0.1), np.linspace(count, 1, count))
        whole = lights_of(seen, size, size, count)
        assert whole.centroids is seen
        assert whole.rows is None


def test_each_part_of_the_field_gives_its_brightest_before_any_gives_more() -> None:
    """Against a stable sort by the number of brighter lights in the same cell."""
    rng = np.random.default_rng(56)
    field = np.array([-1.0, 1.0, -2.0, 2.0])
    for total in (3, 16, 60):
        # A third is a clump.
        places = rng.uniform(field[::2], field[1::2], (total, 2))
        places[::3] = 0.3 + rng.normal(0, 0.01, places[::3].shape)
        column, row = (CELLS * (places - field[::2]) / (field[1::2] - field[::2])).T.astype(
            int
        )
        cell = CELLS * row + column
        rank = [np.sum(cell[:n] == cell[n]) for n in range(total)]
        for count in (1, 10, 40):
            expected = np.sort(np.argsort(rank, kind="stable")[:count])
            np.testing.assert_array_equal(spread(places, field, count), expected)
