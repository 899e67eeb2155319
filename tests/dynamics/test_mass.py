"""Moments of inertia that a rigid body can have."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.dynamics.multibody.mass import is_possible


@pytest.mark.parametrize(
    ("second_moments", "possible"),
    [
        ([1.0, 2.0, 3.0], True),
        ([0.0, 2.0, 3.0], True),  # a plate
        ([-1e-9, 2.0, 3.0], False),
        ([-1.0, 2.0, 3.0], False),
        ([0.0, 0.0, 3.0], False),  # a rod: none about its axis
        ([-1.0, -2.0, -3.0], False),
    ],
)
def test_a_body_s_moments_are_sums_of_two_positive_second_moments(
    second_moments: list[float], possible: bool
) -> None:
    """About x: the sum of m y^2 and m z^2; so the largest moment is at most the sum of the others."""
    moments = np.sort(np.sum(second_moments) - np.array(second_moments))
    assert is_possible(moments) == possible


def test_a_flat_plate_in_any_axes_is_a_valid_inertia() -> None:
    """Its largest moment is the sum of the others; eigenvalues of the turned tensor are so but for rounding."""
    axes = Rotation.random(200, rng=np.random.default_rng(1)).as_matrix()
    moments = np.linalg.eigvalsh(axes @ np.diag([1.0, 2.0, 3.0]) @ axes.swapaxes(1, 2))
    assert (moments[:, 2] > moments[:, 0] + moments[:, 1]).any()
    assert all(map(is_possible, moments))
