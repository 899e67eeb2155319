"""Visibility and information of LEDs: against projection, differences and brute force; by the interpreter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers.interpreted import interpreted

FISHER = interpreted("skysim.sources.dome.layouts.fisher")
CAMERA_M = np.array([0.03, -0.02, 0.3])
TAN_HALF = np.array([0.2, 0.1])


def dome(rng: np.random.Generator, count: int) -> np.ndarray:
    """Sites of 1.0 to 1.4 m about the bearing, down to 78 degrees from the zenith."""
    z = rng.uniform(0.2, 1, count)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    across = np.sqrt(1 - z**2)
    return rng.uniform(1, 1.4, (count, 1)) * np.column_stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), z]
    )


def attitudes(rng: np.random.Generator, count: int) -> np.ndarray:
    return Rotation.from_rotvec(rng.normal(0, 0.6, (count, 3))).as_matrix()


def seen(R: np.ndarray, sites_m: np.ndarray) -> np.ndarray:
    """(A, K) whether each attitude has each site in its field."""
    x, y, z = np.moveaxis(np.einsum("aij,kj->aki", R, sites_m) - CAMERA_M, 2, 0)
    return (z > 0) & (np.abs(x) <= TAN_HALF[0] * z) & (np.abs(y) <= TAN_HALF[1] * z)


def test_each_site_is_seen_by_the_attitudes_whose_field_contains_it() -> None:
    rng = np.random.default_rng(1)
    sites_m = dome(rng, 100)
    R = attitudes(rng, 300)
    start, attitude, information = FISHER.visible_from(sites_m, R, CAMERA_M, TAN_HALF)
    assert len(start) == 101
    assert start[0] == 0
    assert start[-1] == len(attitude) == len(information)
    wanted = seen(R, sites_m)
    assert 100 < wanted.sum() < 0.1 * wanted.size
    for k in range(100):
        assert (
            sorted(attitude[start[k] : start[k + 1]]) == np.flatnonzero(wanted[:, k]).tolist()
        )


def test_a_point_behind_the_camera_is_in_no_field() -> None:
    b = np.empty(3)
    for z_m, visible in ((1.0, True), (0.31, True), (0.29, False), (-1.0, False)):
        point_m = np.array([CAMERA_M[0], CAMERA_M[1], z_m])
        assert FISHER.in_field(np.eye(3), point_m, CAMERA_M, TAN_HALF, b) == visible


def test_an_led_s_information_matches_the_derivatives_of_its_tangents() -> None:
    """J'J by differences of small rotations in body axes; the sum's variance is the trace of the inverse."""
    b = np.array([[0.2, -0.1, 1.2], [-0.1, 0.05, 1.1]])
    out = np.empty(7)
    total = np.zeros(7)
    information = 0.0

    def tangents(rotvec: np.ndarray, point: np.ndarray) -> np.ndarray:
        x, y, z = Rotation.from_rotvec(rotvec).apply(point) - CAMERA_M
        return np.array([x / z, y / z])

    for point in b:
        FISHER.led_information(point, CAMERA_M, out)
        slopes = np.array(
            [
                (tangents(1e-6 * e, point) - tangents(-1e-6 * e, point)) / 2e-6
                for e in np.eye(3)
            ]
        )
        wanted = slopes @ slopes.T
        np.testing.assert_allclose(out[:3], np.diag(wanted), rtol=1e-8)
        np.testing.assert_allclose(out[3:6], wanted[[0, 0, 1], [1, 2, 2]], rtol=0, atol=1e-8)
        assert out[6] == 1
        total = total + out
        information = information + wanted
    prior = FISHER.PRIOR_INFORMATION * np.eye(3)
    assert FISHER.variance(total[:6]) == pytest.approx(
        np.trace(np.linalg.inv(information + prior)), rel=1e-9
    )
