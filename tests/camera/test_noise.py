"""Random numbers for pixels: the whole histogram against the law."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from skysim.camera.detector import noise

ROWS, COLUMNS = 1000, 1000
N = ROWS * COLUMNS


def drawn_counts(mean: float, seed: int = 0) -> np.ndarray:
    out = np.full((ROWS, COLUMNS), mean, np.float32)
    for row, state in zip(out, noise.seeds(np.random.default_rng(seed), ROWS), strict=True):
        noise.count(row, state, noise.tables())
    return out.astype(float)


def drawn_normals(seed: int = 0) -> np.ndarray:
    out = np.empty((ROWS, COLUMNS), np.float32)
    for row, state in zip(out, noise.seeds(np.random.default_rng(seed), ROWS), strict=True):
        noise.normal(row, state, noise.tables())
    return out.astype(float)


def chi_square(numbers: np.ndarray, probability: np.ndarray) -> float:
    """Share of honest draws that are farther from the law than these; bins of less than 10 are one."""
    found, wanted = np.bincount(numbers, minlength=len(probability)), probability * len(numbers)
    assert len(found) == len(wanted), "a number that the law does not have"
    common = wanted >= 10
    found = np.append(found[common], found[~common].sum())
    wanted = np.append(wanted[common], max(wanted[~common].sum(), 1e-9))
    return float(stats.chi2.sf(((found - wanted) ** 2 / wanted).sum(), max(len(found) - 1, 1)))


# On both sides of the change of method at 16, in the middle and at the very edge of a guide's step.
@pytest.mark.parametrize("mean", [0.0, 0.004, 0.25, 1.0, 2.9921875, 7.77, 15.999, 16.0, 17.3, 32.2, 100, 1e3, 4e4])
def test_counts_are_poisson(mean: float) -> None:
    numbers = drawn_counts(mean, seed=int(mean * 1000)).astype(np.int64).ravel()
    law = stats.poisson.pmf(np.arange(int(mean + 12 * np.sqrt(mean)) + 12), np.float32(mean))
    assert chi_square(numbers, law) > 1e-4


def test_normal_numbers_are_normal() -> None:
    """Equal shares in a thousand bins, and ten in the tails that only the slow branches reach."""
    edges = stats.norm.ppf(np.linspace(0, 1, 1001))
    edges = np.sort(np.append(edges, [*np.linspace(-4.5, -3.2, 5), *np.linspace(3.2, 4.5, 5)]))
    bins = np.digitize(drawn_normals().ravel(), edges) - 1
    assert chi_square(bins, np.diff(stats.norm.cdf(edges))) > 1e-4


def test_the_ziggurat_s_layers_have_one_area() -> None:
    x = noise.ziggurat()
    height = np.exp(-(x**2) / 2)
    area = x[1:-1] * np.diff(height[1:])
    tail = x[1] * height[1] + np.sqrt(2 * np.pi) * stats.norm.sf(x[1])
    np.testing.assert_allclose(area, tail, rtol=1e-9, atol=0)
    assert x[0] * height[1] == pytest.approx(tail, rel=1e-12)


def test_neighbors_and_rows_know_nothing_of_each_other() -> None:
    made = drawn_normals(3)
    for a, b in ((made[:, 1:], made[:, :-1]), (made[1:], made[:-1]), (made[:, 7:], made[:, :-7])):
        for power in (1, 2):
            r = np.corrcoef(a.ravel() ** power, b.ravel() ** power)[0, 1]
            assert abs(r) < 4.5 / np.sqrt(a.size)


def test_counts_and_the_numbers_that_follow_are_independent() -> None:
    """A bright pixel must not tell the next one's fortune, though both come of one stream."""
    for mean in (0.3, 5.0, 50.0):
        made = drawn_counts(mean, seed=9)
        r = np.corrcoef(made[:, 1:].ravel(), made[:, :-1].ravel())[0, 1]
        assert abs(r) < 4.5 / np.sqrt(N)


def test_a_seed_is_a_stream() -> None:
    np.testing.assert_array_equal(drawn_normals(5), drawn_normals(5))
    assert np.mean(drawn_normals(5) == drawn_normals(6)) < 1e-3


def test_a_guide_is_certain_exactly_where_every_mean_of_its_row_gives_one_count() -> None:
    """n is certain where F(n - 1) of the least mean is below the bucket, and F(n) of the greatest mean above it."""
    guide, bucket = noise.tables().guide, np.arange(noise.BUCKETS) / noise.BUCKETS
    counts = np.arange(80)
    for k in (0, 1, 37, 128, 500, 1777, len(guide) - 1):
        low, high = k / noise.GUIDES_PER_E, (k + 1) / noise.GUIDES_PER_E
        below = stats.poisson.cdf(counts - 1, low)[:, None] <= bucket + 1e-12
        above = stats.poisson.cdf(counts, high)[:, None] >= bucket + 1 / noise.BUCKETS - 1e-12
        certain = below & above
        assert certain.sum(axis=0).max() == 1
        wanted = np.where(certain.any(axis=0), certain.argmax(axis=0), noise.AMBIGUOUS)
        np.testing.assert_array_equal(guide[k], wanted)


@pytest.mark.parametrize("mean", [10.0, 37.4, 1e3, 1e6])
def test_procedure_f_is_the_poisson_law_and_nearly_its_hat(mean: float) -> None:
    """py exp(px) to the next term of Stirling's series, 1 / (1680 k^7); by the interpreter."""
    counts = np.unique(np.floor(mean + np.sqrt(mean) * np.linspace(-3, 3, 25)))
    for k in counts[counts >= 0]:
        px, py, fx, fy = noise._densities.py_func(mean, np.sqrt(mean), k)
        law = stats.poisson.logpmf(k, mean)
        assert px + np.log(py) == pytest.approx(law, rel=0, abs=1e-10 + 1e-14 * mean)
        assert fy * np.exp(fx) == pytest.approx(np.exp(law), rel=0, abs=0.1 / mean)
