"""Significance of a match: the binomial chance of as many matches, and what Bayes factors of stars and LEDs share.

The published identifiers accept a match by the binomial tail (`log10_tail`). The searches for stars and for LEDs
compute a Bayes factor instead: the probability of the detections at a candidate attitude over that of detections at
random places. Its common constants and terms are here. "dex" is the base-10 logarithm of a Bayes factor.
"""

from math import lgamma, log, log10, pi, sqrt

import numpy as np

from estimator.core.checks import Floats
from estimator.core.jit import jit

# The published identifiers: greatest log10 of the expected number of chance matches, over all hypotheses tried.
ACCEPT_LOG10_CHANCE = -5.0
MIN_MATCHES = 4  # matches that they need

# The searches by Bayes factors: least log10 Bayes factor of an accepted attitude. By Markov's inequality, random
# detections reach it in at most one of 10^5 frames. With 4, a mirrored sky was solved in one of 10^5 adversarial images
# (docs/findings/robustness.md); 5 loses two in a thousand of the hardest frames (python -m benchmarks lost_in_space),
# 6 would lose twelve.
ACCEPT_DEX = 5.0
GATE_SIGMA = 3.5  # matching radius in standard deviations: it loses one true match in 450
MIN_EVIDENCE_MATCHES = 3  # matches needed for a solution
SHORT_PAIR = (
    0.2  # of the field size: shorter pairs determine the roll poorly and are tried last
)


@jit
def log10_tail(trials: int, hits: int, p: float) -> float:
    """log10 of the binomial tail: the probability of `hits` or more in `trials`, each with probability p.

        P = sum over k from hits to trials of  C(trials, k) p^k (1 - p)^(trials - k)

    The binomial coefficients are computed as logarithms, so that many trials do not overflow.
    """
    if hits <= 0 or p >= 1:
        return 0.0
    total = 0.0
    for k in range(hits, trials + 1):
        # ln C(trials, k)
        ways = lgamma(trials + 1.0) - lgamma(k + 1.0) - lgamma(trials - k + 1.0)
        total += np.exp(ways + k * log(p) + (trials - k) * log(1 - p))
    # The floor keeps a hopeless match finite.
    return np.log10(max(total, 1e-300))


@jit
def counts_dex(matched: int, missing: int) -> float:
    """log10 B(m + 1, k + 1): likelihood of m matched and k missing sources.

    The detection probability is unknown, with a uniform prior: the integral of p^m (1 - p)^k over p is the Beta
    function m! k! / (m + k + 1)!.
    """
    # ln B = ln m! + ln k! - ln (m + k + 1)!, with n! = gamma(n + 1).
    return (
        lgamma(matched + 1.0) + lgamma(missing + 1.0) - lgamma(matched + missing + 2.0)
    ) / log(10.0)


@jit
def least(values: Floats) -> float:
    """Least of (N,) values; infinity without any."""
    found = np.inf
    for value in values:
        found = min(found, value)
    return found


@jit
def attitude_dex(
    tangent: Floats,
    sigma: Floats,
    a: int,
    b: int,
    prior_volume: float,
    focal_uncertainty: float,
) -> float:
    """Contribution of a pair's attitude alone to the evidence, for `required_matches`.

        log10( (2 pi)^(3/2) (s / sqrt(2))^2 (sqrt(2) s / D) / V )

    The pair determines the two axes across the boresight to s / sqrt(2), and the roll to sqrt(2) s / D, D the
    separation. s is the least sigma of all detections, taken as isotropic, which gives a lower bound of the
    uncertainty. V is the prior volume of attitudes. An uncertain focal length, known to sqrt(2) s / D from the pair,
    adds sqrt(2 pi) sqrt(2) s / D over the width of its range, twice `focal_uncertainty`.
    """
    smallest = least(sigma)
    direction_sigma = sqrt(2.0) * smallest / separation(tangent, a, b)
    dex = 1.5 * log10(2 * pi) + log10(smallest**2 / 2 * direction_sigma / prior_volume)
    if focal_uncertainty > 0:
        dex += log10(sqrt(2 * pi) * direction_sigma / (2 * focal_uncertainty))
    return dex


@jit
def required_matches(
    sigma: Floats,
    field_area: float,
    attitude_dex: float,
    min_dex: float,
    light_dex: float = 0.0,
) -> int:
    """Least number of matches with which the evidence can reach `min_dex`.

    The evidence is estimated from above, without residuals and without missing sources:

        dex(k) = k match_dex + attitude_dex - log10(k + 1)
        match_dex = light_dex - log10(2 pi sigma^2 rho)

    sigma is the least one of all detections and rho = N / field_area their density. log10(k + 1) is `counts_dex` of k
    matches without a missing source.

    Parameters
    ----------
    sigma
        (N,) standard deviations of the detections, tangents
    field_area
        Area of the sensor, tangents squared
    attitude_dex
        Contribution of the attitude to the evidence
    min_dex
        Evidence to reach
    light_dex
        Greatest contribution of the brightness of a match

    Returns
    -------
    int
        From MIN_EVIDENCE_MATCHES to N; N if no number of matches suffices
    """
    total = len(sigma)
    match_dex = light_dex - log10(2 * pi * least(sigma) ** 2 * total / field_area)
    # The least count whose evidence suffices.
    for count in range(MIN_EVIDENCE_MATCHES, total):
        if count * match_dex + attitude_dex - log10(count + 1.0) >= min_dex:
            return count
    return total


@jit
def middle(tangent: Floats, a: int, b: int) -> tuple[float, float]:
    """Midpoint (x, y) of two detections, tangents."""
    return (tangent[a, 0] + tangent[b, 0]) / 2, (tangent[a, 1] + tangent[b, 1]) / 2


@jit
def squared_separation(tangent: Floats, a: int, b: int) -> float:
    """Squared distance between two detections, tangents squared."""
    return (tangent[a, 0] - tangent[b, 0]) ** 2 + (tangent[a, 1] - tangent[b, 1]) ** 2


@jit
def separation(tangent: Floats, a: int, b: int) -> float:
    """Distance between two detections, tangents."""
    return sqrt(squared_separation(tangent, a, b))
