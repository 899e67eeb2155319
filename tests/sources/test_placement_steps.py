"""Steps of the placement of LEDs against brute force; the compiled ones by the interpreter."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import Rotation

from tests.helpers.interpreted import interpreted

OPTIMIZE, AMBIGUITY, PLACING = (
    interpreted(f"skysim.sources.dome.layouts.{name}")
    for name in ("optimize", "ambiguity", "placing")
)


def test_a_site_is_free_if_only_the_moving_led_is_near() -> None:
    rng = np.random.default_rng(1)
    found = 0
    sites_m = rng.uniform(0, 1, (300, 3))
    chosen = np.arange(0, 300, 20)
    spacing_m = 0.3
    near = cdist(sites_m, sites_m[chosen]) < spacing_m
    for without in (0, 7):
        others = np.delete(near, without, axis=1).any(axis=1)
        room = [
            OPTIMIZE.has_room(site, without, chosen, sites_m, spacing_m)
            for site in range(300)
        ]
        np.testing.assert_array_equal(room, ~others)
        found += sum(room)
    assert 50 < found < 550


@pytest.mark.parametrize("count", [0, 9])
def test_sites_are_taken_in_order_if_none_before_is_within_the_spacing(count: int) -> None:
    sites_m = np.random.default_rng(2).uniform(0, 1, (200, 3))
    taken = PLACING.thin(sites_m, 0.3, count)
    whole: list[int] = []
    for site in range(200):
        if not whole or cdist(sites_m[[site]], sites_m[whole]).min() > 0.3:
            whole.append(site)
    assert len(whole) > 9
    assert taken.tolist() == (whole[:count] if count else whole)


def test_sites_are_spread_as_widely_as_there_are_that_many() -> None:
    """Beyond the least distance of two of them thinning finds fewer; where there is no room, as many as there are."""
    sites_m = np.random.default_rng(3).uniform(0, 1, (200, 3))
    chosen = PLACING.spread(sites_m, 0.05, 20, 40)
    assert len(chosen) == 20
    widest_m = pdist(sites_m[chosen]).min()
    assert widest_m > 0.2
    assert len(PLACING.thin(sites_m, widest_m * (1 + 1e-9), 20)) < 20
    assert len(PLACING.spread(sites_m, 0.3, 190, 40)) == len(PLACING.thin(sites_m, 0.3))


def test_attitudes_with_less_than_two_leds_in_the_inner_field_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The inner field is 0.8 of the tangents of half of 20 x 15 deg; some attitudes see none, one, two and more."""
    rng = np.random.default_rng(4)
    place_m = rng.normal([0, 0, 1.2], [0.4, 0.4, 0], (60, 3))
    R = Rotation.from_rotvec(rng.normal(0, 0.2, (100, 3))).as_matrix()
    x, y, z = np.moveaxis(np.einsum("aij,kj->aki", R, place_m) - [0.02, 0.01, 0.3], 2, 0)
    half_x, half_y = 0.8 * np.tan(np.radians([10, 7.5]))
    seen = np.sum((np.abs(x) <= half_x * z) & (np.abs(y) <= half_y * z), axis=1)
    assert {0, 1, 2, 3} <= set(seen)
    config = SimpleNamespace(camera_m=(0.02, 0.01, 0.3), field_deg=(20.0, 15.0))
    monkeypatch.setattr(OPTIMIZE, "INNER_FIELD", 0.8)
    score = OPTIMIZE.PlacementScore(config, R)
    assert score.under_two(place_m) == np.sum(seen < 2)


def test_the_largest_common_share_of_two_fields_is_over_all_rotations() -> None:
    """Fields of two rings, at any angles: every neighbor of each field is laid on every one of the other."""
    rng = np.random.default_rng(5)
    counts = rng.integers(3, 6, (8, 2))
    fields = [
        np.repeat([0.2, 0.3], count) * np.exp(2j * np.pi * rng.random(count.sum()))
        for count in counts
    ]
    every = np.concatenate(fields)
    first = np.cumsum([0, *map(len, fields)])
    given = AMBIGUITY.Fields(
        np.arange(8), first, np.abs(every).round(9), np.angle(every), np.full(8, 0.02)
    )

    def shown(i: int, j: int) -> float:
        """Largest common share of two fields at any rotation, except of a field with itself without rotation."""
        turn = fields[j] / fields[i][:, None]
        unit = np.isclose(np.abs(turn), 1) & ~(np.eye(*turn.shape, dtype=bool) & (i == j))
        # (turns, of i, of j).
        far = np.abs(fields[i][:, None] * turn[unit][:, None, None] - fields[j])
        return float(
            (1 + (far.min(axis=2) < 0.02).sum(axis=1).max())
            / (1 + max(len(fields[i]), len(fields[j])))
        )

    fraction, other = AMBIGUITY.most_similar(given, 0.0)
    wanted = np.array([[shown(*sorted((i, j))) for j in range(8)] for i in range(8)])
    np.testing.assert_allclose(fraction, wanted.max(axis=1), rtol=1e-12)
    np.testing.assert_allclose(wanted[np.arange(8), other], fraction, rtol=1e-12)
    assert len(set(fraction)) > 3


def test_leds_are_moved_to_reduce_an_ambiguity_where_their_spacing_allows_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A stand-in for the overlap that falls with an LED's height, so that every move up is wanted."""
    sites_m = np.random.default_rng(6).uniform(0, 1, (400, 3))
    place_m = sites_m[PLACING.thin(sites_m, 0.2, 20)]
    config = SimpleNamespace(count=20, spacing_m=0.2)
    monkeypatch.setattr(OPTIMIZE, "AMBIGUITY_TRIALS", 300)
    scorer = SimpleNamespace(
        config=config, tail_variance=lambda _: 0.5, under_two=lambda _: 0
    )
    layouts = []

    def overlap(_: object, at_m: np.ndarray) -> object:
        layouts.append(at_m)
        return AMBIGUITY.Ambiguity(
            np.arange(20), np.arange(20), OPTIMIZE.MAX_OVERLAP + (0.9 - at_m[:, 2]).clip(0)
        )

    monkeypatch.setattr(OPTIMIZE, "layout_ambiguity", overlap)
    moved_m = OPTIMIZE.reduce_ambiguity(scorer, place_m, sites_m, np.random.default_rng(7))
    assert moved_m[:, 2].mean() > place_m[:, 2].mean() + 0.1
    assert pdist(moved_m).min() >= 0.2
    # An overlap of the limit is none too many.
    layouts.clear()
    place_m[:, 2] = 0.95
    np.testing.assert_array_equal(
        OPTIMIZE.reduce_ambiguity(scorer, place_m, sites_m, None), place_m
    )
    assert len(layouts) == 1
