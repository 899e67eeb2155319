"""Sky frames rendered by skysim, solved by tetra3rs and astrometry.net: the first table of docs/findings/oracles.md.

`tests.helpers.oracles` says what is compared. A solver that is not installed has no rows.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.timing import figure, verdict
from skysim.core.constants import ARCSEC_RAD
from tests.helpers.oracles import ORACLES, SCENES, Agreement, confront, squares

FRAMES = 200


def measure(count: int = FRAMES, seed: int = 1) -> list[dict[str, Any]]:
    """Agreement of each solver with our truth in `count` frames of each scene: by its coordinates, and by its stars."""
    rows = []
    for scene in SCENES:
        for who, build in ORACLES.items():
            solve = build(scene)
            if solve is None:
                print(f"{who}: not installed", file=sys.stderr)
                continue
            both = zip(*confront(scene, who, solve, count, seed), strict=True)
            for what, pairs in zip(("its coordinates", "its stars"), both, strict=True):
                rows += agreement_rows(f"{who}, {scene}, {what}", count, pairs)
    return rows


def agreement_rows(
    name: str, frames: int, solved: Sequence[Agreement]
) -> list[dict[str, Any]]:
    """The rows of one comparison; medians and worst errors are in arcseconds."""
    cross = np.array([one.cross_rad for one in solved]) / ARCSEC_RAD
    roll = np.abs([one.roll_rad for one in solved]) / ARCSEC_RAD
    cross_square, roll_square = squares(solved)
    what = f"{frames} frames"
    return [
        figure(f"{name}: solved", len(solved), "frames", what),
        figure(f"{name}: within 3 sigma", sum(one.within for one in solved), "frames", what),
        figure(f"{name}: cross, median", np.median(cross), "arcsec", what),
        figure(f"{name}: cross, worst", cross.max(), "arcsec", what),
        figure(f"{name}: roll, median", np.median(roll), "arcsec", what),
        figure(f"{name}: roll, worst", roll.max(), "arcsec", what),
        figure(f"{name}: cross squared over predicted", cross_square, "", what),
        figure(f"{name}: roll squared over predicted", roll_square, "", what),
        verdict(f"{name}: wrong", sum(one.wrong for one in solved), "frames", what, 0),
    ]
