"""Dark current, its scatter over the pixels, and hot pixels, from the rate of every pixel.

A pixel's dark current is lognormal over the chip, with the mean m and the relative standard deviation DSNU. Hot pixels,
the fraction h, have an additional exponential rate of mean H. A rate u measured from darks of several exposures has
Gaussian noise of the variance v + w u, from reading and counting. So the probability that it is below d is

    P(d) = (1 - h) E[Phi(z)] + h E[Phi(z) - exp(s^2 / 2 H^2 - (d - u) / H) Phi(z - s / H)],  z = (d - u) / s,

with s^2 = v + w u and the expectation over the lognormal u: the second term is an exponentially modified Gaussian. The
counts of pixels in bins are multinomial; Fisher's scoring maximizes their likelihood and gives the covariance, which
includes the scatter of a chip's pixels (Rao 1973, Linear Statistical Inference, 5g). With fewer than LEAST_HOT hot
pixels H is not fitted, and h is their fraction, with the interval of Clopper & Pearson (1934).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial
from scipy import special

from skysim.core.types import Bools, Floats, median
from skysim.experiments.characterize.photon_transfer import (
    BLACK,
    Estimate,
    Level,
    Transfer,
    blocks,
    exposures_s,
    median_and_spread,
    slopes,
)
from skysim.results import metrics

LEAST_HOT = 10  # least number of hot pixels for a fit of their mean
# Bins of the rates below the quantile 1 - TAIL, and above it.
CORE_BINS = 160
TAIL_BINS = 60
TAIL = 0.01
# Nodes of the expectation over the lognormal, and its limit in standard deviations of the normal variable.
NODES = 301
SPAN = 6.0
STEPS = 60  # most scoring steps
CONVERGED = 1e-3  # length of the last step, in standard deviations
DIFFERENCE = 1e-4  # step of the numerical derivatives
RESOLVED = 5.0  # standard errors by which a scatter must exceed the noise
CORE = 4.0  # standard deviations within which pixels are no hot ones, and the variance there over that of the whole law
CORE_VARIANCE = 0.998929
# Ratio of the standard errors of that variance beyond the noise, whose gain is measured too, and of a plain one.
CORE_COST = 1.1
# Core widths above the median beyond which pixels are hot, at the start of the fit.
HOT_SIGMAS = 8.0


class RateNoise(NamedTuple):
    """Variance of a measured rate in (DN/s)^2: `reading`, and `counting` more for each DN/s of the rate."""

    reading: float
    counting: float


class DarkCurrent(NamedTuple):
    """Mean and DSNU over the pixels, fraction of hot pixels, and their mean excess if it was fitted. Rates in DN/s.

    Attributes
    ----------
    edges, counts, expected
        Histogram of the rates, and the numbers that the law expects
    """

    mean: Estimate
    dsnu: Estimate
    hot_pixels: Estimate
    hot: Estimate | None
    edges: Floats
    counts: Floats
    expected: Floats


def own_variance(rates: Floats, noise: RateNoise) -> tuple[float, float]:
    """Variance of the rates over the pixels beyond their noise, and its standard error.

    It is that of the pixels within CORE standard deviations c, where a normal law has the variance
    1 - 2 c phi(c) / (2 Phi(c) - 1). The median of the deviations alone is wrong by a step of the digital numbers.
    """
    middle, spread = median_and_spread(rates)
    expected = noise.reading + noise.counting * max(middle, 0.0)
    core = rates[np.abs(rates - middle) <= CORE * spread]
    variance = float(core.var(dtype=np.float64)) / CORE_VARIANCE
    return variance - expected, CORE_COST * expected * math.sqrt(2 / rates.size)


def is_resolved(rates: Floats, noise: RateNoise) -> bool:
    """Whether there is dark current, and it scatters over the pixels by more than the noise, by RESOLVED sigmas."""
    variance, sigma = own_variance(rates, noise)
    return median(rates) > 0 and variance > RESOLVED * sigma


def fit(rates: Floats, noise: RateNoise, greatest: float) -> DarkCurrent:
    """Fit the rates of all pixels, in DN/s.

    Parameters
    ----------
    greatest
        The rate in DN/s beyond which a pixel saturates in the longest dark
    """
    start, hot = start_values(rates, noise)
    enough = hot >= LEAST_HOT
    kept = rates
    if not enough:
        kept = np.sort(rates)[: rates.size - hot]
        start = start[:2]
    edges = bin_edges(kept, greatest)
    bins = np.searchsorted(edges, kept)
    counts = np.bincount(bins, minlength=len(edges) + 1).astype(np.float64)
    theta, covariance = maximize(start, edges, counts, noise)
    sigma = np.sqrt(np.diag(covariance))
    values = [
        Estimate.lognormal(math.exp(one), math.exp(one) * error)
        for one, error in zip(theta, sigma, strict=True)
    ]
    if enough:
        fraction = Estimate.logistic(theta[2], sigma[2])
    else:
        fraction = counted(hot, rates.size)
    expected = counts.sum() * probabilities(theta, edges, noise)
    return DarkCurrent(
        values[0], values[1], fraction, values[3] if enough else None, edges, counts, expected
    )


def counted(hot: int, pixels: int) -> Estimate:
    """The fraction of pixels that were counted, with Clopper & Pearson's interval."""
    low, high = metrics.exact_bounds(hot, pixels, metrics.TAILS[1])
    return Estimate(hot / pixels, math.sqrt(max(hot, 1)) / pixels, low, high)


def hot_tail(
    rates: Floats, noise: RateNoise, greatest: float
) -> tuple[Estimate, Estimate | None]:
    """Fraction of hot pixels and mean H of their excess, without the law of the others: from rates beyond a limit.

    An exponential has no memory: the excess over the limit has the mean H too, and the fraction
    exp(-(limit - core) / H) of the hot pixels is beyond it. Rates beyond `greatest` count as at least that.
    """
    core, _, limit, _ = core_values(rates, noise)
    hot = rates[rates > limit]
    below = int(np.count_nonzero(hot < greatest))
    if below < LEAST_HOT:
        return counted(hot.size, rates.size), None
    mean = float(np.sum(np.minimum(hot, greatest) - limit)) / below
    depth = (limit - core) / mean
    share = hot.size / rates.size * math.exp(depth)
    sigma = share * math.sqrt(1 / hot.size + depth**2 / below)
    return Estimate.lognormal(share, sigma), Estimate.lognormal(mean, mean / math.sqrt(below))


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
        # The factors alone would overflow.
        log_tail = s**2 / (2 * excess**2) - (edges[:, None] - u) / excess
        log_tail += special.log_ndtr(normal - s / excess)
        below -= share * np.exp(log_tail)
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
        step = np.full(len(theta), DIFFERENCE)
        slope = slopes(lambda one: probabilities(one, edges, noise), theta, step)
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


def core_values(rates: Floats, noise: RateNoise) -> tuple[float, float, float, float]:
    """Mean and DSNU of the core from robust moments, the rate above which pixels are hot, and the robust deviation."""
    middle, spread = median_and_spread(rates)
    core = max(middle, 1e-3 * spread, 1e-12)
    own = max(spread**2 - noise.reading - noise.counting * core, (0.02 * spread) ** 2)
    dsnu = min(math.sqrt(own) / core, 2.0)
    width = math.sqrt(math.log1p(dsnu**2))
    limit = max(core * math.exp(HOT_SIGMAS / 1.6 * width), core + HOT_SIGMAS * spread)
    return core, dsnu, limit, spread


def start_values(rates: Floats, noise: RateNoise) -> tuple[Floats, int]:
    """Parameters from moments of the core, and the number of pixels far above it."""
    core, dsnu, limit, spread = core_values(rates, noise)
    hot = rates[rates > limit]
    excess = max(float(hot.mean()) - limit, spread) if hot.size else spread
    share = max(hot.size, 1) / rates.size * math.exp(min((limit - core) / excess, 3.0))
    logit = special.logit(min(share, 0.5))
    return np.array([math.log(core), math.log(dsnu), logit, math.log(excess)]), hot.size


# Fixed pattern of the black level by columns, and of the sensitivity (PRNU).


ORDER = 4  # total order of the polynomial that models the light over the chip
SAMPLE = 8  # rows and columns of a block, for the fit of the polynomial

# (2, H, W) signal at exposure 0 in DN and rate in DN/s, of the two halves of the frames; (L,) weights of the levels in
# the rate.
Planes = tuple[Floats, Floats, Floats]


def dark_planes(darks: Sequence[Level], transfer: Transfer) -> Planes:
    """Line of every pixel against the exposure, by weighted least squares over the darks of one temperature."""
    times = exposures_s(darks)
    every = np.ones(darks[0].mean_dn.shape, bool)
    weight = np.array([one.count / one.point(every).variance_dn2[0] for one in darks])
    weight /= weight.sum()
    middle = weight @ times
    spread = weight @ (times - middle) ** 2
    slopes = weight * (times - middle) / spread
    at_zero = weight - slopes * middle
    base = np.zeros((2, *every.shape))
    rate = np.zeros((2, *every.shape))
    for one, by_slope, by_zero in zip(darks, slopes, at_zero, strict=True):
        frame = transfer.linear_dn(one.halves_dn - transfer.values[BLACK])
        base += by_zero * frame
        rate += by_slope * frame
    return base, rate, slopes


def column_offset(base: Floats, usable: Bools, gain_e_dn: float) -> Estimate:
    """Standard deviation of the columns' black levels, in electrons, from the (2, H, W) darks at exposure 0."""
    means = np.where(usable, base, 0.0).sum(axis=1) / np.maximum(usable.sum(axis=0), 1)
    a, b = means - means.mean(axis=1, keepdims=True)
    columns = len(a)
    product = a * b * columns / (columns - 1)
    variance = gain_e_dn**2 * product.mean()
    sigma = gain_e_dn**2 * product.std() / np.sqrt(columns)
    if variance > 3 * sigma:
        return Estimate.lognormal(math.sqrt(variance), sigma / (2 * math.sqrt(variance)))
    return Estimate.root(variance, sigma)


def prnu(
    flats: Sequence[Level], transfer: Transfer, dark: Planes, dark_ratio: float, usable: Bools
) -> Estimate:
    """Relative standard deviation of the sensitivity, from the rate of every pixel in the light.

    The rate, in DN/s without black level and dark, is by weighted least squares through 0.

    Parameters
    ----------
    dark_ratio
        Ratio of the dark currents at the temperatures of the flats and of the darks
    """
    base, dark_rate, _ = dark
    times = exposures_s(flats)
    weight = np.array([one.count / one.variance_dn2.mean(dtype=np.float64) for one in flats])
    weight = weight * times / np.sum(weight * times**2)
    rate = np.zeros(base.shape)
    for one, by in zip(flats, weight, strict=True):
        signal = transfer.linear_dn(one.halves_dn - transfer.values[BLACK] - base)
        rate += by * (signal - dark_ratio * one.exposure_s * dark_rate)
    trend = smooth(rate.mean(axis=0), usable)[usable]
    a, b = rate[:, usable] / trend - 1
    product = (a - a.mean()) * (b - b.mean())
    return Estimate.root(product.mean(), product.std() / math.sqrt(product.size))


def smooth(image: Floats, usable: Bools) -> Floats:
    """The polynomial in x and y of total order ORDER, fitted to means of blocks of usable pixels."""
    count, total = (
        blocks(plane, SAMPLE).sum(axis=(1, 3)) for plane in (usable, usable * image)
    )
    mean = total.ravel() / np.maximum(count.ravel(), 1)
    middle = np.indices(count.shape).reshape(2, -1) * SAMPLE + (SAMPLE - 1) / 2
    # Powers of y and x, from -1 to 1 over the chip, of total order ORDER at most.
    low = np.add.outer(*[np.arange(ORDER + 1)] * 2) <= ORDER
    y, x = 2 * middle / np.array(image.shape)[:, None] - 1
    design = polynomial.polyvander2d(y, x, (ORDER, ORDER))[:, low.ravel()]
    root = np.sqrt(count.ravel())
    matrix = np.zeros(low.shape)
    matrix[low] = np.linalg.lstsq(design * root[:, None], mean * root, rcond=None)[0]
    down, across = (2 * np.arange(size) / size - 1 for size in image.shape)
    return np.asarray(polynomial.polygrid2d(down, across, matrix), dtype=np.float64)
