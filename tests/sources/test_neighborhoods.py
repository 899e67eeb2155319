"""Levels that make every LED's neighborhood unique, compared pair by pair by angles."""

from __future__ import annotations

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.sources.dome.layouts.ambiguity import unique_levels
from skysim.sources.dome.layouts.placing import cap

SCENE = "coded_spiral"


def surroundings(
    place: np.ndarray, level: np.ndarray, led: int, nearest: int
) -> tuple[tuple[int, ...], ...]:
    """All rotations of the levels of the nearest LEDs, ordered by angle in a camera that looks at one."""
    others = np.argsort(np.linalg.norm(place - place[led], axis=1))[1 : nearest + 1]
    up = place[led]
    right = np.cross([0.3, 0.5, 0.8], up)
    flat = place[others] @ np.column_stack([right, np.cross(up, right)])
    ring = level[others][np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))]
    return tuple(tuple(np.roll(ring, turn).tolist()) for turn in range(nearest))


def test_no_two_neighborhoods_are_equal_under_rotation() -> None:
    place = cap(150, 0.6)
    level = unique_levels(3, 6, place, np.random.default_rng(2))
    assert set(level.tolist()) == {0, 1, 2}
    words = [(int(level[n]), surroundings(place, level, n, 6)) for n in range(150)]
    for n, (own, turns) in enumerate(words):
        assert not any(
            own == other and turns[0] in others for other, others in words[n + 1 :]
        )


@pytest.mark.parametrize(
    ("layout", "reason"),
    [
        (
            "{kind: fibonacci, count: 400, cap_deg: 34, unique_neighbors: 6}",
            "all LEDs are equally bright",
        ),
        (
            "{kind: fibonacci, count: 400, cap_deg: 34, levels: [1, 0.5], unique_neighbors: 17}",
            "less than or equal to 16",
        ),
        (
            "{kind: listed, cap_deg: 34, directions_deg: [[0, 0], [0, 9]], levels: [1, 0.5], unique_neighbors: 3}",
            "a list has its own levels",
        ),
    ],
)
def test_layouts_without_distinguishable_neighborhoods_are_refused(
    layout: str, reason: str
) -> None:
    with pytest.raises(InputError, match=reason):
        loader.load(SCENE, {"light.layout": layout})


def test_too_few_levels_or_leds_are_refused() -> None:
    rng = np.random.default_rng(2)
    with pytest.raises(
        InputError, match=r"3 with 2 levels leave some of 60 LEDs alike; allowed: more levels"
    ):
        unique_levels(2, 3, cap(60, 0.6), rng)
    with pytest.raises(InputError, match=r"unique_neighbors: 6 of 6 LEDs; allowed: fewer"):
        unique_levels(3, 6, cap(6, 0.6), rng)
