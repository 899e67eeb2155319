"""Significance of a match: binomial probability of as many matches by chance, and the acceptance threshold."""

from __future__ import annotations

from math import lgamma, log

import numpy as np

from estimator.core.jit import jit

ACCEPT_LOG10_CHANCE = -5.0  # log10 of the expected number of chance matches this good, over all hypotheses
MIN_MATCHES = 4


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
