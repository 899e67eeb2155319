"""Robustness of `skysim solve` against the adversarial and malformed images of `tests.helpers.hostile`.

None may be solved wrongly, raise an exception, take too long, or use too much memory.
"""

from __future__ import annotations

import sys
from typing import Any

from benchmarks.timing import figure, verdict
from tests.helpers.hostile import judged

IMAGES = 10_000


def measure(count: int = IMAGES, seed: int = 1) -> list[dict[str, Any]]:
    """Defects, true skies found, and the worst time and memory of each family; defects are printed to stderr."""
    rows = []
    for name, one in judged(count, seed, quiet=False).items():
        print(
            *(f"{name}, input {defect}" for defect in one.defects), sep="\n", file=sys.stderr
        )
        what = f"{one.looked} images"
        rows += [
            verdict(f"{name}: defects", len(one.defects), "images", what, 0),
            figure(f"{name}: a true sky found", one.right, "images", what),
            figure(f"{name}: worst time", one.worst_s, "s of CPU", what),
            figure(f"{name}: most memory", one.most_frames, "frames", what),
        ]
    return rows
