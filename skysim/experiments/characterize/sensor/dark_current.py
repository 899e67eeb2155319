"""Dark current, its scatter over the pixels, and hot pixels, from the rate of every pixel.

A pixel's dark current is lognormal over the chip, with the mean m and the relative standard deviation DSNU; hot pixels,
the fraction h, have an exponential of mean H beside it. A rate measured from darks of several exposures has Gaussian
noise of a variance v + w u at the rate u: of reading, and of counting. So the probability that it is below d is

    P(d) = (1 - h) E[Phi(z)] + h E[Phi(z) - exp(s^2 / 2 H^2 - (d - u) / H) Phi(z - s / H)],  z = (d - u) / s,

with s^2 = v + w u and the expectation over the lognormal u: the second term is an exponentially modified Gaussian. The
counts of pixels in bins are multinomial; Fisher's scoring maximizes their likelihood and gives the covariance, which
has the scatter of a chip's pixels in it (Rao 1973, Linear Statistical Inference, 5g). Frames have too few hot
pixels for H if they have fewer than LEAST_HOT: h is then their count, with the interval of Clopper & Pearson (1934).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from skysim.core.constants import MAD_PER_SIGMA
from skysim.core.types import Floats
from skysim.experiments.characterize.sensor.estimate import Estimate

LEAST_HOT = 10  # hot pixels for a fit of their scatter
# quantiles; the tail is the upper hundredth
CORE_BINS = 160
TAIL_BINS = 60
TAIL = 0.01
# of the lognormal's normal variable
NODES = 301
SPAN = 6.0
# scoring steps, and a step in standard deviations
STEPS = 60
CONVERGED = 1e-3
DIFFERENCE = 1e-4
# sigmas; standard error of a variance from medians over that from squares
RESOLVED = 5.0
MEDIAN_COST = 1.65
HOT_SIGMAS = 8.0  # above the core's width: where hot pixels begin, for the start of the fit


class RateNoise(NamedTuple):
    """Variance of a measured rate in (DN/s)^2: `reading`, and `counting` more for each DN/s of the rate."""

    reading: float
    counting: float


class DarkCurrent(NamedTuple):
    """Mean and DSNU over the pixels, fraction of hot pixels, and their mean excess if they are enough. Rates in DN/s.

    edges, counts, expected : histogram of the rates, and what the law expects
    """

    mean: Estimate
    dsnu: Estimate
    hot_pixels: Estimate
    hot: Estimate | None
    edges: Floats
    counts: Floats
    expected: Floats


def own_variance(rates: Floats, noise: RateNoise) -> tuple[float, float]:
    """Variance of the rates over the pixels beyond their noise, and its standard error, from medians."""
    median, spread = median_and_spread(rates)
    expected = noise.reading + noise.counting * max(median, 0.0)
    return spread**2 - expected, MEDIAN_COST * expected * math.sqrt(2 / rates.size)


def is_resolved(rates: Floats, noise: RateNoise) -> bool:
    """Whether there is dark current, and it scatters over the pixels by more than the noise, by RESOLVED sigmas."""
    variance, sigma = own_variance(rates, noise)
    return float(np.median(rates)) > 0 and variance > RESOLVED * sigma


def fit(rates: Floats, noise: RateNoise, greatest: float) -> DarkCurrent:
    """Fit the rates of all pixels, in DN/s. greatest : rate beyond which a pixel saturates in the longest dark"""
    start, hot = start_values(rates, noise)
    enough = hot >= LEAST_HOT
    kept = rates if enough else np.sort(rates)[: rates.size - hot]
    edges = bin_edges(kept, greatest)
    counts = np.bincount(np.searchsorted(edges, kept), minlength=len(edges) + 1).astype(np.float64)
    theta, covariance = maximize(start if enough else start[:2], edges, counts, noise)
    sigma = np.sqrt(np.diag(covariance))
    values = [
        Estimate.lognormal(math.exp(one), math.exp(one) * error)
        for one, error in zip(theta, sigma, strict=True)
    ]
    if enough:
        fraction = Estimate.logistic(theta[2], sigma[2])
    else:
        low, high = stats.beta.ppf(
            [0.025, 0.975], [max(hot, 1e-9), hot + 1], [rates.size - hot + 1, rates.size - hot]
        )
        fraction = Estimate(
            hot / rates.size, math.sqrt(max(hot, 1)) / rates.size, float(low), float(high)
        )
    expected = counts.sum() * probabilities(theta, edges, noise)
    return DarkCurrent(
        values[0], values[1], fraction, values[3] if enough else None, edges, counts, expected
    )


def median_and_spread(values: Floats) -> tuple[float, float]:
    """Median and robust standard deviation."""
    median = float(np.median(values))
    return median, float(np.median(np.abs(values - median))) / MAD_PER_SIGMA


def bin_edges(rates: Floats, greatest: float) -> Floats:
    """Edges at quantiles, denser in the tail, each midway between two measured values, which may be discrete."""
    pixels = rates.size
    tail = TAIL * np.geomspace(1.0, min(5 / (TAIL * pixels), 1.0), TAIL_BINS)
    at = np.concatenate([np.linspace(5 / pixels, 1 - TAIL, CORE_BINS), 1 - tail[1:]])
    ordered = np.sort(rates)
    index = np.unique(np.clip((at * pixels).astype(int), 1, pixels - 1))
    above = np.searchsorted(ordered, ordered[index], side="left")
    above = above[above > 0]
    edges = np.unique((ordered[above] + ordered[above - 1]) / 2)
    return edges[edges < greatest]


def probabilities(theta: Floats, edges: Floats, noise: RateNoise) -> Floats:
    """Probability of each bin, those below the first and above the last edge included."""
    mean = math.exp(theta[0])
    dsnu = math.exp(theta[1])
    width = math.sqrt(math.log1p(dsnu**2))
    z = np.linspace(-SPAN, SPAN, NODES)
    weight = np.exp(-(z**2) / 2)
    weight /= weight.sum()
    u = mean * np.exp(width * z - width**2 / 2)
    s = np.sqrt(noise.reading + noise.counting * u)
    normal = (edges[:, None] - u) / s
    below = special.ndtr(normal)
    if len(theta) == 4:
        share = special.expit(theta[2])
        excess = math.exp(theta[3])
        tail = np.exp(
            s**2 / (2 * excess**2)
            - (edges[:, None] - u) / excess
            + special.log_ndtr(normal - s / excess)
        )
        below -= share * tail
    cumulative = np.concatenate([[0.0], below @ weight, [1.0]])
    return np.maximum(np.diff(cumulative), 1e-15)


def maximize(
    start: Floats, edges: Floats, counts: Floats, noise: RateNoise
) -> tuple[Floats, Floats]:
    """The parameters of the greatest likelihood and their covariance, by Fisher's scoring with halved steps."""
    theta = start
    total = counts.sum()
    p = probabilities(theta, edges, noise)
    for _ in range(STEPS):
        slope = np.empty((len(theta), p.size))
        for n in range(len(theta)):
            moved = np.zeros(len(theta))
            moved[n] = DIFFERENCE
            slope[n] = (
                probabilities(theta + moved, edges, noise)
                - probabilities(theta - moved, edges, noise)
            ) / (2 * DIFFERENCE)
        information = total * (slope / p) @ slope.T
        score = slope @ (counts / p)
        step = np.linalg.solve(information, score)
        likelihood = counts @ np.log(p)
        for halving in 0.5 ** np.arange(12):
            trial = theta + halving * np.clip(step, -1.0, 1.0)
            trial_p = probabilities(trial, edges, noise)
            if counts @ np.log(trial_p) >= likelihood - 1e-9 * abs(likelihood):
                break
        theta = trial
        p = trial_p
        if step @ information @ step < CONVERGED**2:
            break
    return theta, np.linalg.inv(information)


def start_values(rates: Floats, noise: RateNoise) -> tuple[Floats, int]:
    """Parameters from moments of the core, and the number of pixels far above it."""
    median, spread = median_and_spread(rates)
    core = max(median, 1e-3 * spread, 1e-12)
    own = max(spread**2 - noise.reading - noise.counting * core, (0.02 * spread) ** 2)
    dsnu = min(math.sqrt(own) / core, 2.0)
    width = math.sqrt(math.log1p(dsnu**2))
    limit = max(core * math.exp(HOT_SIGMAS / 1.6 * width), core + HOT_SIGMAS * spread)
    hot = rates[rates > limit]
    excess = max(float(hot.mean()) - limit, spread) if hot.size else spread
    share = max(hot.size, 1) / rates.size * math.exp(min((limit - core) / excess, 3.0))
    return np.array(
        [math.log(core), math.log(dsnu), special.logit(min(share, 0.5)), math.log(excess)]
    ), hot.size
