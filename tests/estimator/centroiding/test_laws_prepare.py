"""Every centroider refuses invalid images, blobs and gains before compiled code could read outside of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given

from estimator.centroiding import centroid
from estimator.centroiding.centroid import CENTROIDERS
from estimator.core.errors import ImageError
from estimator.core.types import NO_PRIORS, Background, Blobs, Centroids
from tests.helpers.laws import SEEDS, law


def blobs(box: list[int]) -> Blobs:
    sky = Background(np.zeros((1, 1)), np.ones((1, 1)))
    return Blobs(
        np.array([box]),
        np.array([[5.0, 5.0]]),
        np.ones(1),
        np.ones(1),
        np.ones(1, int),
        sky,
        np.zeros(1, int),
    )


@law(centroid.prepare)
@given(rng=SEEDS)
def test_blobs_within_an_image_pass_and_others_do_not(rng: np.random.Generator) -> None:
    height, width = rng.integers(16, 40, 2)
    image = rng.uniform(0, 99, (height, width))
    inside = blobs([0, 0, int(width) - 1, int(height) - 1])
    assert centroid.prepare(image, inside, 1.0, NO_PRIORS) is image
    for box in ([-1, 0, 3, 3], [0, -1, 3, 3], [0, 0, int(width), 3], [0, 0, 3, int(height)]):
        with pytest.raises(
            ImageError, match=f"blobs reach beyond the image of {width}x{height} pixels"
        ):
            centroid.prepare(image, blobs(box), 1.0, NO_PRIORS)


IMAGE = np.random.default_rng(1).normal(100, 3, (30, 40))


@pytest.mark.parametrize("name", CENTROIDERS)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": None}, "the image is a NoneType"),
        ({"image": IMAGE[None]}, r"an image of shape \(1, 30, 40\)"),
        ({"image": IMAGE * 1j}, "pixels of type complex128"),
        ({"blobs": None}, "blobs is None of type NoneType"),
        ({"blobs": blobs([0, 0, 40, 5])}, "blobs reach beyond"),
        ({"gain_e_dn": 0.0}, "gain_e_dn is 0"),
        ({"gain_e_dn": np.nan}, "gain_e_dn is nan"),
        ({"priors": None}, "priors is None"),
    ],
)
def test_a_centroider_refuses_invalid_blobs(
    name: str, change: dict[str, Any], message: str
) -> None:
    good = {
        "image": IMAGE,
        "blobs": blobs([2, 2, 9, 9]),
        "gain_e_dn": 1.0,
        "priors": NO_PRIORS,
    }
    with pytest.raises(ImageError, match=message):
        CENTROIDERS[name](**good | change)


def moved_light(
    shape: tuple[int, int], middle_px: np.ndarray, velocity: np.ndarray, fading: float
) -> np.ndarray:
    """A Gaussian of 1e5 that moves by `velocity` with the acceleration fading * velocity, sampled at pixels."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    light = np.zeros(shape)
    for t in (np.arange(80) + 0.5) / 80 - 0.5:
        at = middle_px + velocity * (t + fading * t * t / 2)
        light += np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 2 / 0.8**2)
    return 1e5 * light / light.sum()


def lines(image: np.ndarray, centers_px: np.ndarray) -> Blobs:
    """Blobs at centers, whose boxes are small."""
    count = len(centers_px)
    low = np.rint(centers_px - 2).astype(int)
    sky = Background(np.zeros((1, 1)), np.full((1, 1), 3.0))
    one = np.ones(count)
    box = np.concatenate([low, low + 4], axis=1)
    return Blobs(box, centers_px, one, one, one.astype(int), sky, np.zeros(count, int))


@pytest.mark.slow
@law(centroid.known_streaks, slow=True)
@given(rng=SEEDS)
def test_known_streaks_end_up_at_their_centers_of_light(rng: np.random.Generator) -> None:
    """Three accelerated streaks, and two blobs that are fragments of the first one."""
    angle = rng.uniform(0, np.pi)
    velocity = rng.uniform(28, 36) * np.array([np.cos(angle), np.sin(angle)])
    fading = rng.uniform(0.1, 0.3) * rng.choice([-1, 1])
    middle_px = np.array([[40.0, 40.0], [110.0, 40.0], [75.0, 110.0]]) + rng.uniform(
        -3, 3, (3, 2)
    )
    image = sum(moved_light((150, 150), one, velocity, fading) for one in middle_px)
    image = image + rng.normal(0, 8, (150, 150))
    fragments_px = middle_px[:1] + np.array([[-0.3], [0.25]]) * velocity
    seen = lines(image, np.concatenate([middle_px, fragments_px]))
    start = Centroids(seen.xy_px, np.ones(5), np.ones(5))
    paths = np.tile(velocity, (5, 1)), np.zeros((5, 2))
    found = centroid.known_streaks(image, seen, start, paths, np.inf, NO_PRIORS)
    # The center of light is ahead of the position at mid-exposure by a 24th of the acceleration.
    light_px = middle_px + fading * velocity / 24
    assert np.isfinite(found.sigma_px).tolist() == [True, True, True, False, False]
    off_px = found.xy_px[:3] - light_px
    ends_px = np.linalg.norm(fading * velocity) / 12
    assert np.linalg.norm(off_px, axis=1).max() < 0.25 * ends_px + 0.02
