"""Random streams: the only place where skysim makes a random generator.

A stream is identified by a seed and a key of integers: what is drawn and, where it applies, of which frame, trial or
stage. It is NumPy's `SeedSequence(seed, spawn_key=key)`: streams of different keys are independent, and none depends on
what was drawn before. Any frame therefore renders the same on its own, and a new kind of noise leaves the others as
they were.
"""

from __future__ import annotations

import numpy as np

# First number of the key under a scene's seed; the second is the frame, if it is drawn anew for each.
DETECTOR = 1
JITTER = 2
IMU = 3
AIR_CURRENT = 4
LED_CLOCKS = 5
CAMERA_TIMING = 6
SCINTILLATION = 10
BALANCE = 15  # what a lab assumes of a vehicle; the second key is 0, or 1 for the readings of wheel speeds
# the second key of LED_CODE is the bit
LED_CODE = 12
LED_CODE_CLOCK = 13
VARIABLE_STARS = 11  # under `light.variability_seed`
HEAD_SEED = 14  # seed of a further star camera; the second key is its number
SATELLITES = 7  # under the seed of `light.satellites.random`


def derived_seed(seed: int, *key: int) -> int:
    """A seed whose streams are independent of those of `seed`."""
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0])


def random_stream(seed: int, *key: int) -> np.random.Generator:
    """The random generator of one seed and key."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))  # noqa: TID251
