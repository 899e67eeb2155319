"""Detection in windows, step by step, against scipy.ndimage; by the interpreter."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from estimator.detection import components
from tests.helpers.interpreted import interpreted

WINDOWS = interpreted("estimator.detection.windows")
EIGHT = np.ones((3, 3), int)
SKY = np.zeros((3, 3))  # level; its noise is 1


def crowded(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image of blobs that touch all four edges, its filtered values and the labels of those above 3 sigma."""
    rng = np.random.default_rng(seed)
    image = np.where(rng.random((13, 17)) < 0.12, rng.uniform(20, 40, (13, 17)), 0.0)
    image[[0, 0, 12, 12, 6, 6], [0, 8, 16, 5, 0, 16]] = 50.0
    above = np.array([[WINDOWS.filtered(image, y, x) for x in range(17)] for y in range(13)])
    return image, above, ndimage.label(above > WINDOWS.GROW_SIGMA, EIGHT)[0]


def test_a_blob_holds_all_pixels_connected_with_its_peak() -> None:
    """Up to the first and the last row and column."""
    touched = np.zeros(4, bool)
    for seed in range(5):
        image, _, label = crowded(seed)
        for number in range(1, label.max() + 1):
            y, x = np.nonzero(label == number)
            box = np.empty(4, np.int64)
            total = np.empty(WINDOWS.SUMS)
            assigned = np.zeros(image.shape, np.uint8)
            stack = np.empty((image.size, 2), np.int32)
            above_sky = SKY + WINDOWS.GROW_SIGMA
            WINDOWS.flood_fill(
                image, SKY, above_sky, True, y[0], x[0], assigned, stack, box, total
            )
            light = image[y, x]
            sums = [len(x), light.sum(), light @ x, light @ y, light.max()]
            at = [
                components.AREA,
                components.FLUX,
                components.X,
                components.Y,
                components.PEAK,
            ]
            np.testing.assert_allclose(total[at], sums, rtol=1e-12)
            assert box.tolist() == [x.min(), y.min(), x.max(), y.max()]
            touched |= [x.min() == 0, y.min() == 0, x.max() == 16, y.max() == 12]
    assert touched.all()


def test_a_window_spans_the_pixels_from_its_lower_end_to_its_upper_one() -> None:
    """Both rounded down; none outside of the frame. An upper end of 0 to 1 px is within the first pixel."""
    for low in np.arange(-6.0, 20.0, 0.25):
        high = low + 4.0
        first, last = WINDOWS._span(low + 2.0, 2.0, 17)
        if high >= 0:
            assert list(range(first, last + 1)) == [
                k for k in range(17) if np.floor(low) <= k <= high
            ]
        if high <= -1:
            assert first > last
    assert WINDOWS._span(np.nan, 2.0, 17) == (0, -1)


def test_each_window_gives_the_blob_of_its_brightest_pixel_once() -> None:
    """Windows over the edges and outside of the frame too; where none is above the threshold there is no blob."""
    rng = np.random.default_rng(9)
    found = 0
    empty = 0
    for seed in range(20):
        image, above, label = crowded(seed)
        center = rng.uniform(-4, [21, 17])
        half = 2.0
        x, y = np.meshgrid(np.arange(17), np.arange(13))
        # A window's first pixel is its lower end rounded down, its last one the upper end rounded down.
        low = np.maximum(center - half, 0).astype(int)
        high = np.minimum(center + half, [16, 12]).astype(int)
        inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]) & (above > 6)
        boxes, _, count = WINDOWS._brightest(
            image, np.array([center, center]), half, SKY, SKY + 1, 6.0
        )
        assert count == inside.any()
        empty += count == 0
        if count:
            peak = np.unravel_index(np.where(inside, above, -1).argmax(), above.shape)
            rows, columns = np.nonzero(label == label[peak])
            assert boxes[0].tolist() == [columns.min(), rows.min(), columns.max(), rows.max()]
            found += 1
    assert found > 5
    assert empty > 1
