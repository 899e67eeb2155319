"""Boards on the dome's surface, and their tilt by the glue."""

from __future__ import annotations

import numpy as np
from scipy import stats

from skysim.sources.dome.layouts.boards import Boards, tilt_boards


def test_glue_tilts_are_uniform_over_a_cap_without_rotation_about_the_normal() -> None:
    """The normal is uniform over the cap: its height and its azimuth are uniform. The rotation is the shortest one."""
    count = 20_000
    most_rad = 0.3
    flat = Boards(
        np.zeros((count, 3)), *(np.tile(axis, (count, 1)) for axis in np.eye(3)[[2, 0, 1]])
    )
    tilted = tilt_boards(flat, most_rad, np.random.default_rng(1))
    x, y, z = tilted.normal.T
    height = (1 - z) / (1 - np.cos(most_rad))
    azimuth = (np.arctan2(y, x) / (2 * np.pi)) % 1
    for uniform in (height, azimuth):
        assert stats.kstest(uniform, "uniform").pvalue > 1e-4
    frame = np.stack([tilted.u, tilted.v, tilted.normal], axis=2)
    np.testing.assert_allclose(
        frame @ frame.swapaxes(1, 2), np.tile(np.eye(3), (count, 1, 1)), rtol=0, atol=1e-14
    )
    # No turn about the normal.
    np.testing.assert_allclose(tilted.u[:, 1], tilted.v[:, 0], rtol=0, atol=1e-15)
