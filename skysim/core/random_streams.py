"""Random streams. Only this module makes random generators in skysim.

A seed and a key of integers identify a stream: the key names the quantity and, if it has them, the frame, trial or
stage. It is NumPy's `SeedSequence(seed, spawn_key=key)`: streams of different keys are independent, and none depends on
earlier draws. Any frame therefore renders the same on its own, and a new kind of noise does not change the others.
"""

import numpy as np

# First number of the key under a scene's seed; the second is the frame, if each frame has its own draws.
DETECTOR = 1
JITTER = 2
IMU = 3
AIR_CURRENT = 4
LED_CLOCKS = 5
CAMERA_TIMING = 6
SCINTILLATION = 10
BALANCE = 15  # assumptions about a vehicle; the second number is 0, or 1 for the readings of wheel speeds
LED_CODE = 12  # the second number is the bit
LED_CODE_CLOCK = 13
VARIABLE_STARS = 11  # under `light.variability_seed`
HEAD_SEED = 14  # seed of a further star camera; the second number is that of the camera
SATELLITES = 7  # under the seed of `light.satellites.random`


def derived_seed(seed: int, *key: int) -> int:
    """A seed whose streams are independent of those of `seed`."""
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0])


def random_stream(seed: int, *key: int) -> np.random.Generator:
    """The random generator of a seed and a key."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))  # noqa: TID251
