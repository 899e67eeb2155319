"""Every centroider refuses invalid images, blobs and gains before compiled code could read outside of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given

from estimator.centroiding import centroid
from estimator.centroiding.centroid import CENTROIDERS
from estimator.core.errors import ImageError
from estimator.core.types import NO_PRIORS, Background, Blobs
from tests.helpers.laws import SEEDS, law


def blobs(box: list[int]) -> Blobs:
    sky = Background(np.zeros((1, 1)), np.ones((1, 1)), 30)
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
