"""Significance of a match: binomial probability of as many matches by chance, and common terms of Bayes factors.

The published identifiers accept a match by the binomial tail (`log10_tail`). The searches for stars and for LEDs
compute a Bayes factor instead, whose common constants and terms are here; "dex" is its power of ten.
"""

from __future__ import annotations

from math import lgamma, log, log10, pi, sqrt

import numpy as np

from estimator.core.checks import Floats
from estimator.core.jit import jit

ACCEPT_LOG10_CHANCE = (
    -5.0
)  # log10 of the expected number of chance matches this good, over all hypotheses
MIN_MATCHES = 4

# Bayes factors
# Least log10 Bayes factor of an accepted attitude. By Markov's inequality, random detections reach it in at most one of
# 10^5 frames. With 4, a mirrored sky was solved in one of 10^5 adversarial images
# (docs/findings/robustness.md); 5 loses two in a thousand of the hardest frames (python -m benchmarks.lost_in_space),
# 6 would lose twelve.
ACCEPT_DEX = 5.0
GATE_SIGMA = 3.5  # matching radius in standard deviations: it loses one true match in 450
MIN_EVIDENCE_MATCHES = 3  # matches needed for a solution
SHORT_PAIR = 0.2  # of the field size: shorter pairs determine the roll poorly and are tried last


@jit
def log10_tail(trials: int, hits: int, p: float) -> float:
    """log10 of the probability of `hits` or more in `trials` at probability p each."""
    if hits <= 0 or p >= 1:
        return 0.0
    total = 0.0
    for k in range(hits, trials + 1):
        ways = lgamma(trials + 1.0) - lgamma(k + 1.0) - lgamma(trials - k + 1.0)
        total += np.exp(ways + k * log(p) + (trials - k) * log(1 - p))
    return np.log10(max(total, 1e-300))


@jit
def counts_dex(matched: int, missing: int) -> float:
    """log10 B(matched + 1, missing + 1): likelihood of the counts under a uniform prior of detection probability."""
    return (lgamma(matched + 1.0) + lgamma(missing + 1.0) - lgamma(matched + missing + 2.0)) / log(
        10.0
    )


@jit
def least(values: Floats) -> float:
    """Least of (N,) values."""
    found = np.inf
    for value in values:
        found = min(found, value)
    return found


@jit
def required_matches(
    sigma: Floats, field_area: float, attitude_dex: float, min_dex: float, light_dex: float = 0.0
) -> int:
    """Least number of matches that can reach min_dex, from an estimate of the greatest evidence.

    The estimate has no residuals and no missing sources: each match contributes the density ratio
    1 / (2 pi sigma^2 rho) of the least sigma of all detections and light_dex by its brightness, the attitude
    contributes attitude_dex.
    """
    total = len(sigma)
    match_dex = light_dex - log10(2 * pi * least(sigma) ** 2 * total / field_area)
    for count in range(MIN_EVIDENCE_MATCHES, total):
        if count * match_dex + attitude_dex - log10(count + 1.0) >= min_dex:
            return count
    return total


@jit
def middle(tangent: Floats, a: int, b: int) -> tuple[float, float]:
    """Midpoint of two detections, tangents."""
    return (tangent[a, 0] + tangent[b, 0]) / 2, (tangent[a, 1] + tangent[b, 1]) / 2


@jit
def squared_separation(tangent: Floats, a: int, b: int) -> float:
    """Squared distance between two detections, in tangents."""
    return (tangent[a, 0] - tangent[b, 0]) ** 2 + (tangent[a, 1] - tangent[b, 1]) ** 2


@jit
def separation(tangent: Floats, a: int, b: int) -> float:
    """Distance between two detections, in tangents."""
    return sqrt(squared_separation(tangent, a, b))
