"""Wahba's problem: all solvers for ten stars against SciPy's Rotation.align_vectors; the compiled core for twenty."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.timing import verdict, versus
from estimator.attitude.solvers import SOLVERS
from estimator.attitude.wahba import wahba
from estimator.core.checks import Floats

# The solver's budget in microseconds, out of one millisecond from image to attitude.
BUDGET_US = 10.0


def measure() -> list[dict[str, Any]]:
    """Every solver, with directions within about 10 deg and 10 arcsec of noise; then the compiled core."""
    cam, ref, sigma = random_directions(10)

    def align() -> None:
        for _ in range(100):
            Rotation.align_vectors(cam, ref)

    def hundred(name: str) -> None:
        for _ in range(100):
            SOLVERS[name](cam, ref, sigma)

    results = [
        versus(
            f"{name}, 10 stars, 100 times",
            partial(hundred, name),
            "scipy align_vectors",
            align,
        )
        for name in SOLVERS
    ]
    spent = core_us(20)
    results.append(
        verdict("wahba, 20 stars, with covariance", spent, "us", "budget", BUDGET_US)
    )
    return results


def random_directions(count: int) -> tuple[Floats, Floats, Floats]:
    """(count, 3) noisy unit vectors in camera axes, the same in reference axes, and (count,) sigmas in rad."""
    rng = np.random.default_rng(4)
    ref = rng.normal((0, 0, 1), (0.1, 0.1, 0), (count, 3))
    ref /= np.linalg.norm(ref, axis=1, keepdims=True)
    cam = Rotation.random(rng=rng).apply(ref) + 5e-5 * rng.standard_normal((count, 3))
    cam /= np.linalg.norm(cam, axis=1, keepdims=True)
    return cam, ref, np.full(count, 5e-5)


def core_us(count: int, repeats: int = 30) -> float:
    """Microseconds per call of the compiled core, the minimum over all repeats."""
    cam, ref, sigma = random_directions(count)
    weight = sigma**-2
    wahba(cam, ref, weight)
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        for _ in range(100):
            wahba(cam, ref, weight)
        best = min(best, (time.perf_counter() - begin) / 100)
    return 1e6 * best
