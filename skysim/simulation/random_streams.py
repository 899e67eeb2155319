"""Random streams: one generator for each stage and frame, independent of the order of rendering."""

from __future__ import annotations

import numpy as np

STAGE_ID = {"detector": 1, "jitter": 2, "imu": 3, "air_current": 4}


def rng(seed: int, stage: str, frame: int) -> np.random.Generator:
    """The random generator of one stage for one frame.

    The SeedSequence is keyed by stage and frame, not by what was drawn before, so that any frame renders the same
    on its own.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STAGE_ID[stage], frame)))
