"""The papers' component scans: SHEFEX-2's sequential pass against another and scipy, the thesis's two thresholds."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.special import erf

from estimator.core.errors import ImageError
from estimator.core.types import FramePriors
from estimator.detection import detect
from estimator.detection.background import interpolate
from estimator.detection.components import FIRST_RUNS, label_runs, runs_above
from estimator.detection.shefex_detection import maximum_scan, sequential_scan
from tests.helpers.interpreted import interpreted

BINOMIAL = np.outer([1, 2, 1], [1, 2, 1]) / 16


def star(shape: tuple[int, int], x: float, y: float, flux: float, sigma: float) -> np.ndarray:
    down, across = (
        np.diff(erf((np.arange(n + 1) - 0.5 - at) / (sigma * 2**0.5))) / 2
        for n, at in zip(shape, (y, x), strict=True)
    )
    return flux * np.outer(down, across)


def field(seed: int, sigma: float = 0.8) -> np.ndarray:
    """A 200x240 frame of 20 stars of different light, none touching another."""
    rng = np.random.default_rng(seed)
    lattice = np.array(
        [(x, y) for y in range(25, 190, 40) for x in range(30, 230, 45)], float
    )
    light = np.full((200, 240), 100.0)
    for k, (x, y) in enumerate(rng.permutation(lattice)[:20] + rng.uniform(-8, 8, (20, 2))):
        light += star(light.shape, x, y, 3000 * 1.2**k, sigma)
    return np.rint(rng.poisson(light) + rng.normal(200, 6, light.shape)).astype(np.uint16)


@pytest.mark.compiles
@pytest.mark.parametrize("seed", range(4))
def test_both_component_scans_find_the_same_objects(seed: int) -> None:
    image = field(seed)
    once = detect.sequential(image)
    again = detect.maximum(image)
    assert len(once) == 20
    for name in ("box_px", "xy_px", "flux", "peak", "area_px"):
        np.testing.assert_array_equal(
            getattr(once, name).round(6), getattr(again, name).round(6)
        )


@pytest.mark.slow
@pytest.mark.parametrize("scan", [sequential_scan, maximum_scan])
@pytest.mark.parametrize("seed", range(3))
def test_the_objects_match_scipy_s_labels(scan, seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    image = rng.integers(0, 100, (60, 70)).astype(np.uint8)
    boxes, sums = scan(image, 10.0, 70.0, 1, 2000)
    labels, count = ndimage.label(image > 70, np.ones((3, 3)))
    every = np.arange(1, count + 1)
    light = image - 10.0
    wanted = np.column_stack(
        [ndimage.sum(labels > 0, labels, every)]
        + [ndimage.sum(part, labels, every) for part in (light, light * np.arange(70))]
    )
    assert len(sums) == count > 50
    assert np.all(np.diff(sums[:, 2]) <= 0)
    np.testing.assert_allclose(  # rounding of sums of some thousands
        sums[np.lexsort(sums[:, [1, 3, 2]].T)][:, [0, 2, 3]],
        wanted[np.lexsort(np.column_stack([np.zeros(count), wanted[:, [2, 1]]]).T)],
        rtol=1e-12,
    )
    assert boxes[:, 2].max() <= 69


def test_a_full_table_keeps_the_brightest_objects_not_the_first() -> None:
    image = field(9)
    every = detect.sequential(image)
    few = detect.sequential(image, max_blobs=5)
    np.testing.assert_array_equal(few.flux, every.flux[:5])
    # All are of one shape, so that the highest peaks are the brightest, but for a pixel's phase.
    np.testing.assert_allclose(
        detect.maximum(image, max_blobs=5).flux.sum(), few.flux.sum(), rtol=0.1
    )


def test_the_thesis_keeps_fifty_pixels_above_four_per_cent() -> None:
    # 8 bits: 4 % is 10.2 units. Squares of 7x7 and 8x8 at 40 units, and one of 12x12 at 8.
    image = np.random.default_rng(14).integers(0, 2, (120, 160)).astype(np.uint8)
    image[20:27, 20:27] += 40
    image[20:28, 60:68] += 40
    image[60:72, 60:72] += 8
    blobs = detect.thesis(image)
    # The filter rounds corners and spreads edges by a pixel: 7x7 stays below 50 + 4 sides, see the next line.
    mask = ndimage.correlate(image.astype(float), BINOMIAL) > 10.2
    labels, count = ndimage.label(mask, np.ones((3, 3)))
    areas = ndimage.sum(mask, labels, np.arange(1, count + 1))
    assert sorted(blobs.area_px) == sorted(areas[areas >= 50])
    assert any(np.hypot(*(blobs.xy_px - (63.5, 23.5)).T) < 0.2)
    assert not any(np.hypot(*(blobs.xy_px - (65.5, 65.5)).T) < 5)


def test_the_thesis_takes_full_scale_from_the_saturation() -> None:
    image = np.random.default_rng(15).normal(0, 1, (120, 160))
    image[40:50, 40:50] += 60
    assert len(detect.thesis(image, priors=FramePriors(saturation=1000))) == 1
    assert len(detect.thesis(image, priors=FramePriors(saturation=4000))) == 0
    with pytest.raises(ImageError, match="pixels of type float64 have no full scale"):
        detect.thesis(image)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["u2", "i4", "f8"])
def test_runs_match_scipy_s_mask_under_a_bilinear_threshold(dtype: str) -> None:
    rng = np.random.default_rng(16)
    image = rng.integers(0, 120, (101, 133)).astype(dtype)
    grid = rng.uniform(50, 90, (3, 4))
    y, x = np.mgrid[:101, :133]
    place = (
        np.clip((y + 0.5) * 3 / 101 - 0.5, 0, 2),
        np.clip((x + 0.5) * 4 / 133 - 0.5, 0, 3),
    )
    threshold = ndimage.map_coordinates(grid, place, order=1)
    wanted = ndimage.correlate(image.astype(float), BINOMIAL, mode="nearest") > threshold
    mask = np.zeros_like(wanted)
    for row, first, last in runs_above(image, grid):
        mask[row, first : last + 1] = True
    assert 500 < wanted.sum() < wanted.size - 500
    np.testing.assert_array_equal(mask, wanted)


def test_runs_beyond_the_first_allocation_are_all_kept() -> None:
    image = np.zeros((300, 300))
    image[::2, ::4] = 100.0
    runs = runs_above(image, np.full((1, 1), 20.0))
    assert len(runs) > FIRST_RUNS
    smooth = ndimage.correlate(image, BINOMIAL, mode="nearest")
    assert (runs[:, 2] - runs[:, 1] + 1).sum() == (smooth > 20).sum()


@pytest.mark.parametrize("seed", range(4))
def test_labels_match_scipy(seed: int) -> None:
    rng = np.random.default_rng(200 + seed)
    image = ndimage.gaussian_filter(rng.normal(0, 1, (120, 150)), 1.2)
    runs = runs_above(image, np.full((1, 1), 0.1 * seed - 0.1))
    blob, count = label_runs(runs)
    labels = np.zeros(image.shape, int)
    for (y, x0, x1), mine in zip(runs, blob, strict=True):
        labels[y, x0 : x1 + 1] = mine + 1
    wanted, wanted_count = ndimage.label(labels > 0, np.ones((3, 3)))
    assert count == wanted_count > 3
    # The same partition: every pair of labels meets one to one.
    pairs = np.unique(np.column_stack([labels.ravel(), wanted.ravel()]), axis=0)
    assert len(pairs) == count + 1


@pytest.mark.parametrize(
    ("shape", "rows", "columns"),
    [((48, 61), 3, 4), ((40, 64), 2, 4), ((30, 47), 2, 3), ((9, 9), 1, 1)],
)
def test_a_row_s_lower_bounds_are_the_least_corners_of_its_cells(
    shape: tuple[int, int], rows: int, columns: int
) -> None:
    """Nowhere above the interpolated threshold, nor below the least of the four tile centers about a pixel."""
    grid = np.random.default_rng(8).uniform(10, 90, (rows, columns))
    bounds = interpreted("estimator.detection.components")._lower_bounds
    (height, width) = shape
    u = np.clip((np.arange(width) + 0.5) * columns / width - 0.5, 0, columns - 1)
    for y in range(height):
        bound = np.full(width, np.nan)
        v = np.clip((y + 0.5) * rows / height - 0.5, 0, rows - 1)
        bounds(grid, height, y, -1, 1.0, bound)
        assert (
            bound <= [interpolate(grid, height, width, y, x) + 1e-12 for x in range(width)]
        ).all()
        corners = grid[
            np.array([[np.floor(v)], [np.ceil(v)]], int),
            np.array([np.floor(u), np.ceil(u)], int)[:, None],
        ]
        inner = (u % 1 > 0) & (v % 1 > 0)
        np.testing.assert_allclose(bound[inner], corners.min(axis=(0, 1))[inner], rtol=1e-12)
