"""Random streams: one generator for each stage and frame, independent of the order of rendering."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    pass


STAGE_ID = {"detector": 1, "jitter": 2, "imu": 3, "draught": 4}


def rng(seed: int, stage: str, frame: int) -> np.random.Generator:
    """A stage's random stream for one frame, the same whatever was drawn before: frame 57 renders alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STAGE_ID[stage], frame)))
