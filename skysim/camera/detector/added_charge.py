"""Pixels to which something other than light adds charge: smear of the shutter and particles, for labelled frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

SMEAR = "smear"
PARTICLES = "cosmic_ray"


class AddedCharge:
    """Masks of the pixels that gain more than threshold_e electrons while they are watched, by what adds them.

    A frame is watched only where its masks are wanted, since that takes a copy of it.
    """

    def __init__(self, threshold_e: float) -> None:
        self.threshold_e = threshold_e
        self.masks = dict[str, NDArray[np.bool_]]()

    @contextmanager
    def watch(self, name: str, electrons: NDArray[Any]) -> Iterator[None]:
        """Compare a frame of electrons before and after the body of this context, which changes it in place."""
        before = electrons.copy()
        yield
        np.subtract(electrons, before, out=before)
        self.masks[name] = before > self.threshold_e
