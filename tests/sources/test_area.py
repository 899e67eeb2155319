"""Area of a dome over a cap, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import TypeAdapter

from skysim.scene.sections.light import AnySurface
from skysim.sources.dome.surface import Surface, build_surface, cap_area_m2


def surface(**config: object) -> Surface:
    return build_surface(TypeAdapter(AnySurface).validate_python(config))


@pytest.mark.parametrize(
    ("apex_m", "radius_m", "cap_deg"), [(1.2, 1.2, 40), (1.2, 1.0, 70), (1.5, 3.0, 90)]
)
def test_a_cap_of_a_sphere_has_two_pi_r_h(
    apex_m: float, radius_m: float, cap_deg: float
) -> None:
    """Also where the bearing is not in the sphere's center: h is from the apex to the cap's edge."""
    center_m = apex_m - radius_m
    tilt_rad = math.radians(cap_deg)
    along_m = center_m * math.cos(tilt_rad) + math.sqrt(
        radius_m**2 - (center_m * math.sin(tilt_rad)) ** 2
    )
    height_m = apex_m - along_m * math.cos(tilt_rad)
    found_m2 = cap_area_m2(
        surface(kind="sphere", apex=f"{apex_m} m", radius=f"{radius_m} m"), cap_deg
    )
    assert found_m2 == pytest.approx(2 * math.pi * radius_m * height_m, rel=1e-12)


def test_a_half_spheroid_has_its_textbook_area() -> None:
    """Oblate, a > c: pi a^2 (1 + (1 - e^2) / e artanh e) (Beyer, CRC Standard Mathematical Tables)."""
    a_m = 1.3
    c_m = 0.9
    e = math.sqrt(1 - (c_m / a_m) ** 2)
    expected_m2 = math.pi * a_m**2 * (1 + (1 - e**2) / e * math.atanh(e))
    dome = surface(
        kind="ellipsoid", apex=f"{c_m} m", semi_axes=[f"{a_m} m", f"{a_m} m", f"{c_m} m"]
    )
    assert cap_area_m2(dome, 90) == pytest.approx(expected_m2, rel=1e-10)


def test_displacement_and_tilt_do_not_change_the_area() -> None:
    """Half of it above a plane through the bearing that is its center's too."""
    dome = surface(
        kind="sphere",
        apex="1.2 m",
        radius="1.2 m",
        offset=["0.2 m", "-0.1 m", "0 m"],
        tilt_deg=[20, 5],
    )
    assert cap_area_m2(dome, 90) == pytest.approx(2 * math.pi * 1.2**2, rel=1e-10)


def test_a_flat_panel_has_the_area_of_its_disk_or_rectangle() -> None:
    assert cap_area_m2(surface(kind="flat", apex="1.5 m"), 40) == pytest.approx(
        math.pi * (1.5 * math.tan(math.radians(40))) ** 2, rel=1e-10
    )
    whole = surface(kind="flat", apex="1.5 m", width="0.8 m", height="0.5 m")
    assert cap_area_m2(whole, 40) == pytest.approx(0.4, rel=1e-12)


def test_the_area_ends_at_the_rim() -> None:
    dome = surface(kind="sphere", apex="1 m", radius="1 m", rim_height="0.5 m")
    assert cap_area_m2(dome, 90) == pytest.approx(2 * math.pi * 0.5, rel=5e-3)
    assert np.isclose(cap_area_m2(dome, 45), 2 * math.pi * (1 - math.sqrt(0.5)), rtol=1e-12)
