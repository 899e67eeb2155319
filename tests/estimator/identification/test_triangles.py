"""Area and polar moment of planar and spherical triangles, against integration and their statistics."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.core.checks import Floats
from estimator.core.vectors import normalized
from tests.helpers.interpreted import interpreted

TRIANGLES = interpreted("estimator.identification.published.triangles")
CORNERS = normalized(np.array([[0.2, 0.0, 1.0], [-0.1, 0.15, 1.0], [0.0, -0.2, 1.0]]))


def inside(points: Floats, corners: Floats) -> Floats:
    """Whether directions are in a spherical triangle: on the same side of each arc as the third corner."""
    normal = np.cross(corners, np.roll(corners, -1, axis=0))
    return ((points @ normal.T) * (normal * np.roll(corners, 1, axis=0)).sum(axis=1) > 0).all(
        axis=1
    )


def test_area_and_moment_of_a_spherical_triangle_are_the_integrals_over_it() -> None:
    # A grid of equal solid angles: equal steps of z and of the azimuth.
    z = np.cos(0.3) + (1 - np.cos(0.3)) * (np.arange(700) + 0.5) / 700
    azimuth = 2 * np.pi * (np.arange(700) + 0.5) / 700
    across = np.sqrt(1 - z**2)
    points = np.stack(
        [np.outer(across, np.cos(azimuth)), np.outer(across, np.sin(azimuth))], axis=-1
    ).reshape(-1, 2)
    points = np.column_stack([points, np.repeat(z, 700)])
    points = points[inside(points, CORNERS)]
    step_sr = 2 * np.pi * (1 - np.cos(0.3)) / 700**2
    theta = np.arccos(points @ normalized(CORNERS.sum(axis=0)[None])[0])
    assert TRIANGLES.spherical_area(*CORNERS) == pytest.approx(
        len(points) * step_sr, rel=1e-3
    )
    wanted = (theta**2).sum() * step_sr
    assert TRIANGLES.spherical_moment(*CORNERS) == pytest.approx(wanted, rel=2e-3)


def test_the_area_is_lhuilier_s() -> None:
    a, b, c = np.arccos(
        np.sum(np.roll(CORNERS, 1, axis=0) * np.roll(CORNERS, 2, axis=0), axis=1)
    )
    s = (a + b + c) / 2
    product = np.prod(np.tan([s / 2, (s - a) / 2, (s - b) / 2, (s - c) / 2]))
    assert TRIANGLES.spherical_area(*CORNERS) == pytest.approx(
        4 * np.arctan(np.sqrt(product))
    )


def test_a_planar_triangle_has_the_area_and_moment_of_its_plate() -> None:
    """Heron's area, and the polar moment of the three mid-sides of a third of the area each (exact for a plate)."""
    area, moment = TRIANGLES.planar_features(*CORNERS)
    edges = CORNERS - np.roll(CORNERS, 1, axis=0)
    assert area == pytest.approx(np.linalg.norm(np.cross(edges[0], edges[1])) / 2, rel=1e-12)
    middles = (CORNERS + np.roll(CORNERS, 1, axis=0)) / 2 - CORNERS.mean(axis=0)
    assert moment == pytest.approx(area / 3 * np.sum(middles**2), rel=1e-12)


def test_small_triangles_are_the_same_on_the_plane_and_on_the_sphere() -> None:
    small = normalized(CORNERS * [1e-2, 1e-2, 1])
    planar = TRIANGLES.planar_features(*small)
    assert TRIANGLES.spherical_area(*small) == pytest.approx(planar[0], rel=1e-5)
    assert TRIANGLES.spherical_moment(*small) == pytest.approx(planar[1], rel=1e-5)


def test_area_and_moment_scatter_by_the_module_s_law() -> None:
    """Noise of sigma along both axes of each direction; 1,000 draws give a deviation to 2.2 %, three of them here."""
    rng = np.random.default_rng(48)
    sigma = 1e-5
    corners = normalized(CORNERS * [0.3, 0.3, 1])
    drawn = [
        TRIANGLES.planar_features(*normalized(corners + rng.normal(0, sigma, (3, 3))))
        for _ in range(1000)
    ]
    area, moment = TRIANGLES.planar_features(*corners)
    square = 36 * moment / area
    law = sigma * np.sqrt([square / 4, square * (square**2 + 144 * area**2) / 5184])
    np.testing.assert_allclose(np.std(drawn, axis=0), law, rtol=0.07)


def test_area_moment_and_longest_side_determine_the_shortest() -> None:
    rng = np.random.default_rng(49)
    for corners in normalized(rng.normal([0, 0, 5], 0.4, (200, 3, 3)).reshape(-1, 3)).reshape(
        -1, 3, 3
    ):
        p, q, r = TRIANGLES._corners(corners, np.arange(3))
        chord = [np.linalg.norm(corners[p] - corners[n]) for n in (q, r)]
        third = np.linalg.norm(corners[q] - corners[r])
        assert chord[1] <= third <= chord[0]
        area, moment = TRIANGLES.planar_features(*corners)
        low, high = TRIANGLES._shortest_side(chord[0], area, 36 * moment / area, 1e-9)
        assert low <= chord[1] <= high
        assert high - low < 1e-3 * chord[0]
