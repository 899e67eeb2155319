"""Steps of the placement of LEDs against brute force; the compiled ones by the interpreter."""

from __future__ import annotations

import numpy as np
import pytest
from interpreted import interpreted
from scipy.spatial.distance import cdist, pdist

OPTIMIZE = interpreted("skysim.sources.dome.placement.optimize")


def test_a_site_has_room_beside_all_leds_but_the_one_that_moves() -> None:
    rng, found = np.random.default_rng(1), 0
    sites_m, chosen, spacing_m = rng.uniform(0, 1, (300, 3)), np.arange(0, 300, 20), 0.3
    near = cdist(sites_m, sites_m[chosen]) < spacing_m
    for without in (0, 7):
        others = np.delete(near, without, axis=1).any(axis=1)
        room = [OPTIMIZE.has_room(site, without, chosen, sites_m, spacing_m) for site in range(300)]
        np.testing.assert_array_equal(room, ~others)
        found += sum(room)
    assert 50 < found < 550


@pytest.mark.parametrize("count", [None, 9])
def test_sites_are_taken_in_order_if_none_before_is_within_the_spacing(count: int | None) -> None:
    sites_m = np.random.default_rng(2).uniform(0, 1, (200, 3))
    taken = OPTIMIZE.thin(sites_m, 0.3, count)
    whole: list[int] = []
    for site in range(200):
        if not whole or cdist(sites_m[[site]], sites_m[whole]).min() > 0.3:
            whole.append(site)
    assert len(whole) > 9
    assert taken.tolist() == whole[:count]


def test_sites_are_spread_as_widely_as_there_are_that_many() -> None:
    """Beyond the least distance of two of them thinning finds fewer; where there is no room, as many as there are."""
    sites_m = np.random.default_rng(3).uniform(0, 1, (200, 3))
    chosen = OPTIMIZE.spread(sites_m, 0.05, 20, 40)
    assert len(chosen) == 20
    widest_m = pdist(sites_m[chosen]).min()
    assert widest_m > 0.2
    assert len(OPTIMIZE.thin(sites_m, widest_m * (1 + 1e-9), 20)) < 20
    assert len(OPTIMIZE.spread(sites_m, 0.3, 190, 40)) == len(OPTIMIZE.thin(sites_m, 0.3))
