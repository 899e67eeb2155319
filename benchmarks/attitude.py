"""Wahba's problem for ten stars, beside scipy's Rotation.align_vectors."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.timing import versus
from estimator.attitude import quest


def measure() -> list[dict[str, Any]]:
    """Ten directions within 10 deg, 10 arcsec of noise."""
    rng = np.random.default_rng(4)
    ref = rng.normal((0, 0, 1), (0.1, 0.1, 0), (10, 3))
    ref /= np.linalg.norm(ref, axis=1, keepdims=True)
    cam = Rotation.random(rng=rng).apply(ref) + 5e-5 * rng.standard_normal((10, 3))
    cam /= np.linalg.norm(cam, axis=1, keepdims=True)
    sigma = np.full(10, 5e-5)
    return [
        versus(
            "QUEST, 10 stars, 100 times",
            lambda: [quest(cam, ref, sigma) for _ in range(100)],
            "scipy align_vectors",
            lambda: [Rotation.align_vectors(cam, ref) for _ in range(100)],
        )
    ]
