"""Intervals of proportions, means and quantiles: against their equations, and their coverage."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.special import comb

from skysim.results import metrics


@pytest.mark.parametrize(("hits", "of"), [(1, 30), (15, 30), (29, 30), (999, 1000)])
def test_a_share_has_wilsons_interval(hits, of):
    """The roots of (p - x)^2 = z^2 x (1 - x) / n (Wilson 1927), solved here."""
    z2 = stats.norm.ppf(0.975) ** 2
    p = hits / of
    roots = np.sort(np.roots([1 + z2 / of, -(2 * p + z2 / of), p**2]).real)
    share = metrics.proportion(hits, of)
    assert (share.low, share.high) == pytest.approx(tuple(roots), abs=1e-9)
    assert (share.value, share.trials) == (p, of)


@pytest.mark.parametrize("count", [1, 12, 1200])
def test_none_and_all_have_the_stated_exact_bound(count: int) -> None:
    """0 of n: 1 - 0.05^(1/n), the same in tables and in words; n of n mirrored."""
    assert metrics.proportion(0, count) == (
        0.0,
        0.0,
        pytest.approx(1 - 0.05 ** (1 / count)),
        count,
        0,
    )
    assert metrics.proportion(count, count) == (
        1.0,
        pytest.approx(0.05 ** (1 / count)),
        1.0,
        count,
        0,
    )


@pytest.mark.parametrize(("share", "count"), [(0.001, 2995), (0.01, 299), (0.05, 59)])
def test_a_claim_needs_as_many_trials_as_its_bound(share: float, count: int) -> None:
    """n = ln 0.05 / ln(1 - p), rounded up; one fewer is not enough."""
    assert metrics.trials_needed(share) == count
    assert metrics.exact_bounds(0, count)[1] <= share < metrics.exact_bounds(0, count - 1)[1]


@pytest.mark.long
def test_intervals_have_their_stated_coverage():
    """Of 400 samples of 60 each: how often the truth is inside, within four standard errors of 95 % or above it."""
    rng = np.random.default_rng(2)
    # Of an exponential.
    truth = {"mean": 1.0, "rms": math.sqrt(2), "median": math.log(2), "p90": math.log(10)}
    inside = dict.fromkeys(truth, 0)
    for _ in range(400):
        sample = rng.exponential(size=60)
        for name, value in truth.items():
            estimate = metrics.STATISTICS[name](sample)
            inside[name] += estimate.low <= value <= estimate.high
    error = math.sqrt(0.95 * 0.05 / 400)
    # At least, for they are ranks.
    assert min(inside["median"], inside["p90"]) / 400 > 0.95 - 4 * error
    # The bootstrap's is short on few of a skew law.
    assert 0.85 < inside["mean"] / 400 < 0.95 + 4 * error
    assert 0.80 < inside["rms"] / 400 < 0.95 + 4 * error


@pytest.mark.parametrize(("hits", "total"), [(0, 10_000), (0, 100), (3, 40), (40, 40)])
def test_exact_bounds_have_the_binomial_tail_of_their_confidence(
    hits: int, total: int
) -> None:
    """Clopper and Pearson: at the upper bound, hits or fewer have the probability 5 %; at the lower one, or more."""
    low, high = metrics.exact_bounds(hits, total)
    if hits < total:
        tail = sum(
            comb(total, k) * high**k * (1 - high) ** (total - k) for k in range(hits + 1)
        )
        assert tail == pytest.approx(0.05, rel=1e-6)
    else:
        assert (low, high) == (pytest.approx(0.05 ** (1 / total), rel=1e-9), 1.0)
    if hits == 0:
        assert (low, high) == (0.0, pytest.approx(1 - 0.05 ** (1 / total), rel=1e-9))


def test_none_in_ten_thousand_is_less_than_three_hundredths_of_a_percent() -> None:
    assert 2.9e-4 < metrics.exact_bounds(0, 10_000)[1] < 3.0e-4


@pytest.mark.parametrize(
    ("probability", "fewest"), [(0.5, 6), (0.9, 29), (0.95, 59), (0.99, 299)]
)
def test_a_quantile_has_an_interval_from_the_number_of_values_by_wilks(
    probability: float, fewest: int
) -> None:
    """n with 1 - p^n >= 95 % (Wilks 1941: 59 and 299); at the median both ends count, 1 - 2 / 2^n."""
    values = np.arange(float(fewest))
    enough, too_few = (
        metrics.quantile(values[:count], probability) for count in (fewest, fewest - 1)
    )
    assert (enough.high, enough.needs) == (fewest - 1, 0)
    assert math.isnan(too_few.low)
    assert math.isnan(too_few.high)
    assert too_few.needs == 1
    assert metrics.quantile(values[:5], probability).needs == fewest - 5


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.integers(1, 400), st.sampled_from([0.05, 0.5, 0.9, 0.95, 0.99]))
def test_no_pair_of_ranks_with_the_confidence_is_closer(
    count: int, probability: float
) -> None:
    """By enumeration of all pairs, with the binomial's own sum."""
    mass = stats.binom.pmf(np.arange(count + 1), count, probability)
    pairs = [
        (r, s)
        for r in range(1, count + 1)
        for s in range(r + 1, count + 1)
        if mass[r:s].sum() >= 0.95
    ]
    found = metrics.quantile_ranks(count, probability)
    assert (found is None) == (not pairs)
    if found is not None:
        low, high = found
        assert mass[low + 1 : high + 1].sum() >= 0.95 - 1e-9
        closest = min(s - r for r, s in pairs)
        below = np.cumsum(mass)
        uneven = {
            (r, s): abs(below[r - 1] - (1 - below[s - 1]))
            for r, s in pairs
            if s - r == closest
        }
        assert uneven[low + 1, high + 1] == pytest.approx(min(uneven.values()), abs=1e-9)


@pytest.mark.long
def test_the_interval_of_a_p95_covers_it() -> None:
    """Of 2,000 samples of 100 from a skew law: at least 95 %, to four standard errors, and not always."""
    rng = np.random.default_rng(5)
    truth = math.log(20)
    inside = 0
    for sample in rng.exponential(size=(2000, 100)):
        estimate = metrics.STATISTICS["p95"](sample)
        inside += estimate.low <= truth <= estimate.high
    assert 0.95 - 4 * math.sqrt(0.95 * 0.05 / 2000) < inside / 2000 < 0.99


def test_a_single_value_has_no_interval_and_names_the_values_needed() -> None:
    one = metrics.resampled(np.array([3.0]), np.mean)
    assert (one.value, one.trials, one.needs) == (3.0, 1, 1)
    assert math.isnan(one.low)


SKEW = {  # samples of a size, from a generator
    "normal": lambda rng, n: rng.normal(5, 2, n),
    "exponential": lambda rng, n: rng.exponential(size=n),
    "counts": lambda rng, n: rng.poisson(9, n).astype(float),
    "rare": lambda rng, n: (np.arange(n) < 7).astype(float),
    "one of degrees": lambda rng, n: np.where(np.arange(n) < 1, 1e5, rng.rayleigh(10, n)),
    "five of degrees": lambda rng, n: np.where(
        np.arange(n) < 5, rng.uniform(1e4, 4e5, n), rng.rayleigh(10, n)
    ),
}


@pytest.mark.parametrize("name", SKEW)
@pytest.mark.parametrize("statistic", [np.mean, metrics.rms])
def test_the_fast_bootstrap_of_many_values_matches_the_plain_one_where_it_starts(
    name: str, statistic
) -> None:
    """Each end within the scatter of 999 resamples: sqrt(0.025 0.975 / 999) / phi(1.96) = 0.085 sigma, 0.022 of the
    width, for a normal law, of two of them, four times; more where tails are longer."""
    values = SKEW[name](np.random.default_rng(4), metrics.MANY_VALUES)
    by_hand = metrics.resampled(values, statistic)
    many = metrics.STATISTICS["mean" if statistic is np.mean else "rms"]
    more = np.append(values, values.mean())
    found = many(more)
    assert found.trials == metrics.MANY_VALUES + 1
    width = by_hand.high - by_hand.low
    assert found.value == pytest.approx(float(statistic(more)), rel=1e-12)
    assert [found.low, found.high] == pytest.approx(
        [by_hand.low, by_hand.high], abs=4 * math.sqrt(2) * 0.022 * width
    )


@pytest.mark.parametrize("name", SKEW)
@pytest.mark.parametrize("count", [2, 3, 100, metrics.MANY_VALUES])
def test_the_bootstrap_of_few_values_matches_scipy(name: str, count: int) -> None:
    """With the same draws, but for the order of additions."""
    values = SKEW[name](np.random.default_rng(count), count)
    for found, statistic in (
        (metrics.mean_of(values), np.mean),
        (metrics.STATISTICS["rms"](values), metrics.rms),
    ):
        assert found == pytest.approx(
            metrics.resampled(values, statistic), rel=1e-12, nan_ok=True
        )


def test_the_interval_of_many_values_is_as_skewed_as_the_bootstrap_s() -> None:
    """One error of 1e5 among n of nothing: it is drawn k times with the probability of Poisson's law, e^-1 / k!, so the
    interval of the mean is 0 to 3 e5 / n; the normal one would be symmetrical and reach below zero."""
    n = 1_000_000
    values = np.zeros(n)
    values[17] = 1e5
    found = metrics.mean_of(values)
    assert (found.low, found.value) == (0.0, 1e5 / n)
    assert found.high == pytest.approx(3e5 / n)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["exponential", "five of degrees"])
def test_the_interval_of_many_values_covers_the_truth(name: str) -> None:
    """Of 1,000 samples: 95 % to four standard errors for an exponential law. Rare wrong attitudes are of a number that
    is itself random, and seldom none at all."""
    rng = np.random.default_rng(6)
    inside = 0
    runs = 1000
    rate = 5 / 3000
    truth = {"exponential": 1.0, "five of degrees": rate * 1e4}[name]
    for _ in range(runs):
        values = (
            rng.exponential(size=3000)
            if name == "exponential"
            else 1e4 * (rng.random(3000) < rate)
        )
        estimate = metrics.mean_of(values)
        inside += estimate.low <= truth <= estimate.high
    assert (
        inside / runs
        > {"exponential": 0.95 - 4 * math.sqrt(0.95 * 0.05 / runs), "five of degrees": 0.85}[
            name
        ]
    )
