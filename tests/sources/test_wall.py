"""Size of a formed wall against the closed form of a spherical shell, at any rim and place; a fact of `check`."""

from __future__ import annotations

import json
import math
from typing import Any, cast

import numpy as np
import pytest
from scipy.integrate import dblquad

from skysim.scene import loader
from skysim.scene.sections.light import SphereSurfaceConfig
from skysim.simulation.checks import facts
from skysim.simulation.checks.detection import context_of
from skysim.simulation.checks.sampling import Plan
from skysim.simulation.lab import build_lab
from skysim.sources.dome.surface import Radial, build_surface
from skysim.sources.dome.wall import WallSize, wall_size

RADIUS_M = 1.2
THICK_M = 0.006
UNIFORM = {"thickness_apex": "6 mm", "thickness_base": "6 mm", "base_deg": 40}


def size(cap_deg: float = 30.0, **keys: Any) -> WallSize:
    """Of a sphere whose inside has its center at the bearing, unless `keys` say otherwise."""
    section = {"kind": "sphere", "radius": "1.2 m", "apex": "1.194 m", "wall": UNIFORM} | keys
    surface = build_surface(SphereSurfaceConfig.model_validate(section))
    assert isinstance(surface, Radial)
    return wall_size(surface, cap_deg)


def spherical_shell(inner_m: float, outer_m: float, edge_deg: float) -> tuple[float, float]:
    """2 pi r^2 (1 - cos a), and 2 pi / 3 (R^3 - r^3) (1 - cos a)."""
    share = 2 * math.pi * (1 - math.cos(math.radians(edge_deg)))
    return share * inner_m**2, share * (outer_m**3 - inner_m**3) / 3


@pytest.mark.parametrize("edge_deg", [25.0, 40.0, 75.0, 150.0])
def test_an_even_wall_is_a_spherical_shell(edge_deg: float) -> None:
    """Before, at and beyond the angle where the thickness would stop to grow, and without a rim to the cap."""
    expected = pytest.approx(
        spherical_shell(RADIUS_M - THICK_M, RADIUS_M, edge_deg), rel=1e-9
    )
    assert size(rim_deg=edge_deg) == expected
    if edge_deg <= 90:
        assert size(edge_deg) == expected


def test_half_of_the_wall_is_outside_of_its_middle() -> None:
    assert size(
        rim_deg=35, apex="1.197 m", wall=UNIFORM | {"radius_of": "mid_wall"}
    ) == pytest.approx(spherical_shell(1.197, 1.203, 35), rel=1e-9)


def test_a_rim_at_a_height_is_a_rim_at_its_angle_and_moves_with_the_dome() -> None:
    height_m = 1.194 * math.cos(math.radians(33))
    expected = pytest.approx(size(rim_deg=33), rel=1e-9)
    assert size(rim_height=f"{height_m!r} m") == expected
    assert size(rim_deg=33, offset=["1 cm", "-2 cm", "3 mm"], tilt_deg=[3, -2]) == expected


def test_the_rim_is_seen_from_the_bearing() -> None:
    """With the bearing b below the sphere's center the rim is at t - asin(b sin(t) / r) from the axis there."""
    below_m = 0.2
    tilt_rad = math.radians(30)
    angle = tilt_rad + math.asin(below_m * math.sin(tilt_rad) / 1.194)
    assert size(rim_deg=30, apex="1.394 m") == pytest.approx(
        spherical_shell(1.194, 1.2, math.degrees(angle)), rel=1e-9
    )


def test_a_growing_wall_is_the_integral_over_its_solid() -> None:
    """By a double integral in spherical coordinates, with the thickness 4 mm to 8 mm at 30 deg and 8 mm beyond."""
    wall = {"thickness_apex": "4 mm", "thickness_base": "8 mm", "base_deg": 30}
    edge_rad = math.radians(50)

    def inner_m(angle_rad: float) -> float:
        return RADIUS_M - 4e-3 - 4e-3 * min(math.degrees(angle_rad) / 30, 1)

    volume_m3 = sum(
        dblquad(
            lambda r, a: 2 * math.pi * r**2 * math.sin(a),
            *part,
            inner_m,
            lambda _: RADIUS_M,
        )[0]
        for part in ((0, math.radians(30)), (math.radians(30), edge_rad))
    )
    # Area of the cones between many points of the meridian.
    angle = np.linspace(0, edge_rad, 20_001)
    radius_m = np.array([inner_m(one) for one in angle])
    x, z = radius_m * np.sin(angle), radius_m * np.cos(angle)
    area_m2 = np.sum(np.pi * (x[1:] + x[:-1]) * np.hypot(np.diff(x), np.diff(z)))
    found = size(rim_deg=50, apex="1.196 m", wall=wall)
    assert found.volume_m3 == pytest.approx(volume_m3, rel=1e-9)
    assert found.area_m2 == pytest.approx(area_m2, rel=1e-7)


@pytest.mark.parametrize("density", [None, 1190])
def test_a_check_states_the_size_of_a_formed_wall(density: float | None) -> None:
    surface = {"kind": "sphere", "radius": "1.2 m", "apex": "1.194 m", "rim_deg": 40}
    wall = UNIFORM | ({"density_kg_m3": density} if density else {})
    scene = loader.load("afit_test3", {"light.surface": json.dumps(surface | {"wall": wall})})
    fact = facts.wall(cast(Plan, context_of(build_lab(scene))))
    assert fact is not None
    assert facts.wall in facts.FACTS
    area_m2, volume_m3 = spherical_shell(1.194, 1.2, 40)
    expected = {"area_m2": area_m2, "volume_m3": volume_m3}
    expected |= {"mass_kg": 1190 * volume_m3} if density else {}
    assert fact.values == pytest.approx(expected)
    assert ("kg" in fact.lines[0]) == bool(density)
