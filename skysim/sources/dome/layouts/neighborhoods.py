"""Neighborhood codes: levels of brightness by which every LED is known by its surroundings.

The neighborhood of an LED is its own level and those of its nearest LEDs, in the order of their azimuths about it
and however the field is turned: of all turns the least word stands for it. Levels are drawn at random; as long as
two neighborhoods are alike, an LED of one gets another level if no more are alike then, as in the pseudorandom
patterns of structured light (Morano et al. 1998, IEEE Trans. Pattern Analysis and Machine Intelligence 20, 322).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from skysim.core.errors import InputError
from skysim.core.types import Floats



Ints = NDArray[np.int64]

ROUNDS = 5000  # of new levels before it is given up


def unique_levels(levels: int, nearest: int, position_m: Floats, rng: np.random.Generator) -> Ints:
    """(N,) number of the level of each LED at (N, 3) places. Raises InputError if no pattern is found."""
    count = len(position_m)
    if count <= nearest:
        raise InputError("light.layout.unique_neighbors", f"{nearest} of {count} LEDs", "fewer")
    around = neighbors(position_m, nearest)
    level = rng.integers(0, levels, count)
    alike = alike_leds(level, around, levels)
    for _ in range(ROUNDS):
        if not len(alike):
            return level
        tried = level.copy()
        some = rng.permutation(alike)[: max(len(alike) // 10, 1)]  # fewer at a time toward the end
        tried[rng.choice(np.append(around[some].ravel(), some), len(some))] = rng.integers(
            0, levels, len(some)
        )
        after = alike_leds(tried, around, levels)
        if len(after) <= len(alike):
            level = tried
            alike = after
    raise InputError(
        "light.layout.unique_neighbors",
        f"{nearest} with {levels} levels leave some of {count} LEDs alike",
        "more levels or neighbors",
    )


def neighbors(position_m: Floats, nearest: int) -> Ints:
    """(N, nearest) the nearest LEDs of each, by increasing azimuth about its direction from the bearing."""
    direction = position_m / np.linalg.norm(position_m, axis=1, keepdims=True)
    near = KDTree(direction).query(direction, nearest + 1)[1][:, 1:]
    offset = direction[near] - direction[:, None]
    # Any two axes across the direction will do: the comparison is of all turns.
    x = np.cross(direction, np.where(np.abs(direction[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    y = np.cross(direction, x)
    azimuth = np.arctan2(np.einsum("nki,ni->nk", offset, y), np.einsum("nki,ni->nk", offset, x))
    return np.take_along_axis(near, np.argsort(azimuth, axis=1), axis=1)


def alike_leds(level: Ints, around: Ints, levels: int) -> Ints:
    """LEDs with a neighborhood that another LED has too."""
    _, number, count = np.unique(
        neighborhoods(level, around, levels), return_inverse=True, return_counts=True
    )
    return np.flatnonzero(count[number] > 1)


def neighborhoods(level: Ints, around: Ints, levels: int) -> Ints:
    """(N,) number of each neighborhood, the same for all turns: its LEDs' levels as digits, the least of all turns."""
    nearest = around.shape[1]
    power = levels ** np.arange(nearest)
    ring = np.min([np.roll(level[around], turn, axis=1) @ power for turn in range(nearest)], axis=0)
    return level * levels**nearest + ring


