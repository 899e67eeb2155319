"""Invariants of groups of lights, of `benchmarks.dome_invariants`: which transforms do not change them."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import dome_invariants
from estimator.core.checks import Floats

AFFINE = np.array([[1.1, 0.2, 0.3], [-0.1, 0.9, -0.2], [0.0, 0.0, 1.0]])
HOMOGRAPHY = AFFINE + np.outer([0.0, 0.0, 1.0], [0.3, -0.2, 0.0])


def image(x: Floats, matrix: Floats) -> Floats:
    y = x @ matrix.T
    return y / y[..., 2:]


@pytest.mark.parametrize(("name", "matrix"), [("projective", HOMOGRAPHY), ("affine", AFFINE)])
def test_a_family_s_transforms_do_not_change_its_invariants(name: str, matrix: Floats) -> None:
    """The lights that determine a transform predict the images of all others."""
    family = dome_invariants.TRANSFORMS[name]
    x = np.concatenate(
        [
            np.random.default_rng(3).uniform(-0.4, 0.4, (9, family.lights, 2)),
            np.ones((9, family.lights, 1)),
        ],
        axis=2,
    )
    y = image(x, matrix)
    before, after = (dome_invariants.invariants(one, name) for one in (x, y))
    np.testing.assert_allclose(after, before, rtol=1e-9)
    for source, target in zip(x, y, strict=True):
        found = dome_invariants.predicted(
            name, source[: family.fixed_by], target[: family.fixed_by], source
        )
        np.testing.assert_allclose(found, target[:, :2], atol=1e-9)
    mirrored = dome_invariants.invariants(np.roll(x, 1, axis=1), name)
    assert np.abs(mirrored - before).min() > 1e-6  # the order of the lights counts


def test_perspective_changes_the_ratios_of_areas() -> None:
    x = np.array([[0.1, 0.2, 1], [-0.3, 0.1, 1], [0.2, -0.3, 1], [0.3, 0.35, 1]])
    before, after = (dome_invariants.invariants(one, "affine") for one in (x, image(x, HOMOGRAPHY)))
    assert np.abs(after / before - 1).max() > 0.01
