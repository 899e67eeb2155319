"""Invariants of groups of lights, of `tests.helpers.group_invariants`: which transforms leave them alone."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.core.checks import Floats
from tests.helpers import group_invariants

AFFINE = np.array([[1.1, 0.2, 0.3], [-0.1, 0.9, -0.2], [0.0, 0.0, 1.0]])
HOMOGRAPHY = AFFINE + np.outer([0.0, 0.0, 1.0], [0.3, -0.2, 0.0])


def image(x: Floats, matrix: Floats) -> Floats:
    y = x @ matrix.T
    return y / y[..., 2:]


@pytest.mark.parametrize(("name", "matrix"), [("projective", HOMOGRAPHY), ("affine", AFFINE)])
def test_a_family_s_transforms_do_not_change_its_invariants(
    name: str, matrix: Floats
) -> None:
    """And the lights that fix a transform predict the image of every other one."""
    family = group_invariants.TRANSFORMS[name]
    x = np.concatenate(
        [
            np.random.default_rng(3).uniform(-0.4, 0.4, (9, family.lights, 2)),
            np.ones((9, family.lights, 1)),
        ],
        axis=2,
    )
    y = image(x, matrix)
    before, after = (group_invariants.invariants(one, name) for one in (x, y))
    np.testing.assert_allclose(after, before, rtol=1e-9)
    for source, target in zip(x, y, strict=True):
        found = group_invariants.predicted(
            name, source[: family.fixed_by], target[: family.fixed_by], source
        )
        np.testing.assert_allclose(found, target[:, :2], atol=1e-9)
    mirrored = group_invariants.invariants(np.roll(x, 1, axis=1), name)
    assert np.abs(mirrored - before).min() > 1e-6  # the order of the lights counts


def test_perspective_changes_the_ratios_of_areas() -> None:
    x = np.array([[0.1, 0.2, 1], [-0.3, 0.1, 1], [0.2, -0.3, 1], [0.3, 0.35, 1]])
    before, after = (
        group_invariants.invariants(one, "affine") for one in (x, image(x, HOMOGRAPHY))
    )
    assert np.abs(after / before - 1).max() > 0.01
