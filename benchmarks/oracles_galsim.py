"""Skies rendered by GalSim, solved by the estimator: the second table of docs/findings/oracles.md.

`tests.helpers.galsim_sky` draws them. Needs the extra `oracle`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.oracles_frames import agreement_rows
from benchmarks.timing import figure, verdict
from tests.helpers.galsim_sky import SETUPS, WAYS, compare

FRAMES = 200


def measure(count: int = FRAMES, seed: int = 1) -> list[dict[str, Any]]:
    """Agreement with GalSim's projection, over `count` frames of all cameras; a fifth of them mirrored as well."""
    frames = -(-count // len(SETUPS))
    rows = []
    for name, setup in SETUPS.items():
        ways = [way(setup) for way in WAYS.values()]
        outcomes = compare(setup, ways, frames, seed, frames // 5)
        for label, one in zip(WAYS, outcomes, strict=True):
            case = f"{name}, {label}"
            rows += [
                *agreement_rows(case, frames, one.solved),
                figure(f"{case}: NEES", np.mean(one.nees), "", "3 for an honest covariance"),
                verdict(f"{case}: mirrored frames answered", one.mirrored, "frames", "", 0),
            ]
    return rows
