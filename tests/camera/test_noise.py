"""Random numbers for pixels: the whole histogram against the law."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from skysim.camera import noise

ROWS = 1000
COLUMNS = 1000
N = ROWS * COLUMNS
MEMORY = noise.scratch(COLUMNS)


def drawn_counts(mean: float, seed: int = 0) -> np.ndarray:
    out = np.full((ROWS, COLUMNS), mean, np.float32)
    for row, state in zip(out, noise.seeds(np.random.default_rng(seed), ROWS), strict=True):
        noise.count(row, state, noise.guide(), MEMORY)
    return out.astype(float)


def drawn_normals(seed: int = 0) -> np.ndarray:
    out = np.empty((ROWS, COLUMNS), np.float32)
    for row, state in zip(out, noise.seeds(np.random.default_rng(seed), ROWS), strict=True):
        noise.normal(row, state, MEMORY)
    return out.astype(float)


def chi_square(numbers: np.ndarray, probability: np.ndarray) -> float:
    """Probability that draws of the law deviate more than these; bins below 10 are merged."""
    found = np.bincount(numbers, minlength=len(probability))
    wanted = probability * len(numbers)
    assert len(found) == len(wanted), "a number that the law does not have"
    common = wanted >= 10
    found = np.append(found[common], found[~common].sum())
    wanted = np.append(wanted[common], max(wanted[~common].sum(), 1e-9))
    return float(
        stats.chi2.sf(((found - wanted) ** 2 / wanted).sum(), max(len(found) - 1, 1))
    )


# On both sides of the change of method at 16, in the middle and at the very edge of a guide's step.
@pytest.mark.parametrize(
    "mean", [0.0, 0.004, 0.25, 1.0, 2.9921875, 7.77, 15.999, 16.0, 17.3, 32.2, 100, 1e3, 4e4]
)
def test_counts_are_poisson(mean: float) -> None:
    numbers = drawn_counts(mean, seed=int(mean * 1000)).astype(np.int64).ravel()
    law = stats.poisson.pmf(np.arange(int(mean + 12 * np.sqrt(mean)) + 12), np.float32(mean))
    assert chi_square(numbers, law) > 1e-4


def test_normal_numbers_are_normal() -> None:
    """Equal shares in a thousand bins, and ten in the tails that only the slow branches reach."""
    edges = stats.norm.ppf(np.linspace(0, 1, 1001))
    edges = np.sort(
        np.append(edges, [*np.linspace(-4.5, -3.2, 5), *np.linspace(3.2, 4.5, 5)])
    )
    bins = np.digitize(drawn_normals().ravel(), edges) - 1
    assert chi_square(bins, np.diff(stats.norm.cdf(edges))) > 1e-4


def test_the_fast_logarithm_matches_double_precision() -> None:
    """Of mantissa and exponent as `normal` takes a number apart; relative, also near 1, where it vanishes."""
    u = np.concatenate(
        [np.geomspace(2.0**-32, 0.999, 2000), 1 - np.geomspace(2.0**-24, 0.3, 2000)]
    ).astype(np.float32)
    above = u.view(np.int32) - np.int32(noise.ROOT_HALF_BITS)
    exponent = (above >> 23).astype(np.float32)
    mantissa = ((above & 0x7FFFFF) + np.int32(noise.ROOT_HALF_BITS)).view(np.float32)
    assert mantissa.min() >= np.sqrt(0.5) - 1e-7
    assert mantissa.max() <= np.sqrt(2) + 1e-7
    found = [noise._log(*each) for each in zip(mantissa, exponent, strict=True)]
    np.testing.assert_allclose(found, np.log(u.astype(float)), rtol=3e-7, atol=0)


def test_random_directions_cover_the_circle_once() -> None:
    """Words in equal steps: unit vectors whose angles, in order, are equally far apart."""
    words = np.arange(-(2**31) + 2**20, 2**31, 2**21, dtype=np.int64).astype(np.int32)
    x, y = np.array([noise._direction(word) for word in words]).T
    np.testing.assert_allclose(np.hypot(x, y), 1, atol=3e-7)
    angles = np.sort(np.arctan2(y, x))
    np.testing.assert_allclose(np.diff(angles), 2 * np.pi / len(words), atol=2e-6)


def test_the_least_uniform_numbers_have_the_law_s_tail() -> None:
    """Radii beyond that of RARE steps: r^2 / 2 less its least value is exponential."""
    steps = np.random.default_rng(4).integers(0, noise.RARE, 20_000).astype(np.int32)
    radius = np.zeros(len(steps), np.float32)
    noise._lengthen(radius, steps, np.uint64(5))
    beyond = radius.astype(float) ** 2 / 2 + np.log(noise.RARE * 2.0**-31)
    assert beyond.min() > -1e-5
    assert stats.kstest(beyond, stats.expon.cdf).pvalue > 1e-3
    above = np.array([noise.RARE, 2**30], np.int32)
    radius = np.full(2, 7, np.float32)
    assert noise._lengthen(radius, above, np.uint64(5)) == 5
    assert (radius == 7).all()


@pytest.mark.parametrize("width", [1, 2, 3, 7, 8, 9, 31, 33])
def test_rows_of_any_width_are_normally_distributed(width: int) -> None:
    """This includes the last pixel of an odd row, and adjacent small and large means."""
    memory = noise.scratch(width)
    seeds = noise.seeds(np.random.default_rng(width), 4000)
    normals = np.empty((4000, width), np.float32)
    counts = np.empty((4000, width), np.float32)
    means = np.where(np.arange(width) % 3 == 1, 40.0, 3.0)
    counts[:] = means
    for normal_row, count_row, seed in zip(normals, counts, seeds, strict=True):
        noise.normal(normal_row, seed, memory)
        noise.count(count_row, seed, noise.guide(), memory)
    sigma = 1 / np.sqrt(4000)
    assert np.abs(normals.mean(axis=0)).max() < 4.5 * sigma
    assert np.abs(normals.var(axis=0) - 1).max() < 4.5 * np.sqrt(2) * sigma
    assert (np.abs(counts.mean(axis=0) - means) < 4.5 * np.sqrt(means) * sigma).all()
    assert (
        np.abs(counts.var(axis=0) / means - 1) < 4.5 * np.sqrt(2 + 1 / means) * sigma
    ).all()


def test_noise_of_neighbors_and_rows_is_independent() -> None:
    made = drawn_normals(3)
    for a, b in (
        (made[:, 1:], made[:, :-1]),
        (made[1:], made[:-1]),
        (made[:, 7:], made[:, :-7]),
        (made[:, 500:], made[:, :500]),
    ):
        for power in (1, 2):
            r = np.corrcoef(a.ravel() ** power, b.ravel() ** power)[0, 1]
            assert abs(r) < 4.5 / np.sqrt(a.size)


@pytest.mark.parametrize("mean", [0.003, 0.8, 4.9, 5.1, 15.99])
def test_the_count_of_a_uniform_number_is_the_quantile_of_the_law(mean: float) -> None:
    """Also where it takes more steps than the few without branches, and at the ends of every step."""
    ends = stats.poisson.cdf(np.arange(40), mean)
    ends = ends[ends < 1 - 1e-12]
    uniform = np.concatenate([[0.0], ends * (1 - 1e-13), ends * (1 + 1e-13), ends[1:] / 2])
    counts = [noise._invert(mean, u) for u in uniform]
    np.testing.assert_array_equal(counts, np.searchsorted(ends, uniform, side="right"))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 1.0])
def test_marked_entries_are_found_in_order(share: float) -> None:
    rng = np.random.default_rng(6)
    found = rng.integers(0, noise.LARGE_BIT, 1600, dtype=np.uint8)
    found[rng.random(1600) < share] |= noise.LARGE_BIT
    late = np.empty(1600, np.int32)
    count = noise._marked(found, late)
    np.testing.assert_array_equal(late[:count], np.flatnonzero(found >= noise.LARGE_BIT))


def test_counts_and_the_numbers_that_follow_are_independent() -> None:
    """A bright pixel must be independent of the next one, though both use one random stream."""
    for mean in (0.3, 5.0, 50.0):
        made = drawn_counts(mean, seed=9)
        r = np.corrcoef(made[:, 1:].ravel(), made[:, :-1].ravel())[0, 1]
        assert abs(r) < 4.5 / np.sqrt(N)


def test_a_seed_determines_the_noise() -> None:
    np.testing.assert_array_equal(drawn_normals(5), drawn_normals(5))
    assert np.mean(drawn_normals(5) == drawn_normals(6)) < 1e-3


def test_a_guide_is_certain_exactly_where_every_mean_of_its_row_gives_one_count() -> None:
    """n is certain where F(n - 1) of the least mean is below the bucket, and F(n) of the greatest mean above it."""
    guide = noise.guide()
    bucket = np.arange(noise.BUCKETS) / noise.BUCKETS
    counts = np.arange(80)
    for k in (0, 1, 37, 128, 500, 1777, len(guide) - 2):
        low = k / noise.GUIDES_PER_E
        high = (k + 1) / noise.GUIDES_PER_E
        below = stats.poisson.cdf(counts - 1, low)[:, None] <= bucket + 1e-12
        above = stats.poisson.cdf(counts, high)[:, None] >= bucket + 1 / noise.BUCKETS - 1e-12
        certain = below & above
        assert certain.sum(axis=0).max() == 1
        wanted = np.where(certain.any(axis=0), certain.argmax(axis=0), noise.AMBIGUOUS)
        np.testing.assert_array_equal(guide[k], wanted)
    assert (guide[-1] == noise.LARGE).all()


@pytest.mark.parametrize("mean", [10.0, 37.4, 1e3, 1e6])
def test_procedure_f_gives_the_poisson_law_below_its_hat_function(mean: float) -> None:
    """py exp(px) to the next term of Stirling's series, 1 / (1680 k^7); by the interpreter."""
    counts = np.unique(np.floor(mean + np.sqrt(mean) * np.linspace(-3, 3, 25)))
    for k in counts[counts >= 0]:
        px, py, fx, fy = noise._densities.py_func(mean, np.sqrt(mean), k)
        law = stats.poisson.logpmf(k, mean)
        assert px + np.log(py) == pytest.approx(law, rel=0, abs=1e-10 + 1e-14 * mean)
        assert fy * np.exp(fx) == pytest.approx(np.exp(law), rel=0, abs=0.1 / mean)
