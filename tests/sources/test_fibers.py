"""Holes that a laser marks on a shell: where they are, by the law of its errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.types import Floats, Sources
from skysim.scene import loader
from skysim.scene.sections.light import DomeConfig
from skysim.sources import dome
from skysim.sources.dome import surface
from skysim.sources.dome.layouts.led_list import led_list
from skysim.sources.photometry import Band

APEX_M = 1.2
SPHERE = {"kind": "sphere", "apex": "1.2 m", "radius": "1.2 m"}
OVAL = {"kind": "ellipsoid", "apex": "48 in", "semi_axes": ["38.88 in", "36 in", "28.60 in"]}
LASER_M = np.array([0.05, -0.02, 0.4])
POINTS = {"kind": "random", "cap_deg": 50, "count": 4000, "hardware_seed": 3}
LED = {"intensity": "13 ucd", "disk_diameter": "0.3 mm", "drive": {"kind": "direct"}}


def config(variation: float = 0.0, on: dict[str, Any] = SPHERE, **aiming: Any) -> DomeConfig:
    layout: dict[str, Any] = {
        "kind": "fibers",
        "points": POINTS,
        "radius_variation": variation,
    }
    if aiming:
        layout["aiming"] = {"laser": [f"{one} m" for one in LASER_M]} | aiming
    return DomeConfig.model_validate(
        {"kind": "dome", "surface": on, "layout": layout, "led": LED}
    )


def holes(variation: float = 0.0, on: dict[str, Any] = SPHERE, **aiming: Any) -> Sources:
    return dome.sources(config(variation, on, **aiming), Band.from_efficiency(0.5))


def places(variation: float = 0.0, on: dict[str, Any] = SPHERE, **aiming: Any) -> Floats:
    return holes(variation, on, **aiming).place[:, :3]


def unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@pytest.mark.parametrize("on", [SPHERE, OVAL], ids=["sphere", "ellipsoid"])
def test_an_angle_displaces_a_hole_by_its_arc_over_the_cosine_of_incidence(
    on: dict[str, Any],
) -> None:
    """Along the surface: D sigma out of the plane of incidence, D sigma / cos(incidence) in it; on the surface."""
    design = places(on=on)
    real = places(on=on, pointing_sigma_arcsec=60)
    shell = surface.build_surface(config(on=on).surface)
    normal = -shell.inward(design)
    sight = design - LASER_M
    distance_m = np.linalg.norm(sight, axis=1)
    line = unit(sight)
    out = unit(np.cross(normal, line))
    moved = (real - design) / (distance_m * 60 * ARCSEC_RAD)[:, None]
    across = np.sum(moved * out, axis=1)
    along = np.sum(moved * np.cross(out, normal), axis=1) * np.sum(normal * line, axis=1)
    bound = 4 * np.sqrt(2 / len(design))  # four deviations of a variance
    assert across.var() == pytest.approx(1, abs=bound)
    assert along.var() == pytest.approx(1, abs=bound)
    assert abs(np.mean(across * along)) < 4 / np.sqrt(len(design))
    again = shell.meet(LASER_M, real - LASER_M)
    np.testing.assert_allclose(real, again, rtol=0, atol=1e-12)


def test_a_shell_s_error_displaces_holes_along_the_laser_s_line() -> None:
    """v R outward by the normal: v R / cos(incidence) along the line. Without a laser it is seen from its place."""
    design = places()
    marked = places(0.004, pointing_sigma_arcsec=1e-9)
    built = places(0.004)
    np.testing.assert_allclose(
        unit(marked - LASER_M), unit(design - LASER_M), rtol=0, atol=1e-12
    )
    outward_m = np.linalg.norm(built, axis=1) - APEX_M
    cosine = np.sum(unit(design) * unit(design - LASER_M), axis=1)
    further_m = np.linalg.norm(marked - LASER_M, axis=1) - np.linalg.norm(
        design - LASER_M, axis=1
    )
    np.testing.assert_allclose(further_m, outward_m / cosine, rtol=1e-6, atol=1e-12)
    seen = np.linalg.norm(np.cross(unit(built - LASER_M), unit(design - LASER_M)), axis=1)
    assert seen.max() > 1e-4


def test_a_mount_s_orientation_rotates_all_holes_about_the_laser() -> None:
    """One rotation fits all directions from the laser; its size is that of three errors of 0.1 deg."""
    design = unit(places() - LASER_M)
    real = unit(places(orientation_sigma_arcsec=360) - LASER_M)
    by_axis = np.array([np.cross(axis, design).ravel() for axis in np.eye(3)])
    rotation, _, _, _ = np.linalg.lstsq(by_axis.T, (real - design).ravel())
    np.testing.assert_allclose(real, design + np.cross(rotation, design), rtol=0, atol=3e-5)
    assert 0.1 < np.linalg.norm(rotation) / (360 * ARCSEC_RAD) < 4


def test_the_drill_s_error_is_within_the_surface() -> None:
    design = places()
    moved = places(pointing_sigma_arcsec=1e-9, drill_sigma="0.1 mm") - design
    assert np.abs(np.sum(moved * unit(design), axis=1)).max() < 1e-12
    assert np.sum(moved**2, axis=1).mean() == pytest.approx(
        2e-8, rel=4 / np.sqrt(len(design))
    )
    bounded = (
        places(pointing_sigma_arcsec=1e-9, drill_sigma={"tolerance": "±0.1 mm"}) - design
    )
    assert np.linalg.norm(bounded, axis=1).max() < 0.1e-3 * np.sqrt(2) * (1 + 1e-9)


def test_laser_errors_do_not_change_the_fibers_light_and_numbers() -> None:
    design = holes()
    real = holes(0.004, pointing_sigma_arcsec=60, drill_sigma="0.1 mm")
    for name in ("id", "strength", "normal", "radius_m", "start_s"):
        np.testing.assert_array_equal(getattr(real, name), getattr(design, name))


@pytest.mark.parametrize(
    ("aiming", "says"),
    [
        (
            '{laser: ["0 m", "0 m", "2 m"], pointing_sigma_arcsec: 5}',
            r"aiming\.laser: .* is outside of the dome",
        ),
        (
            '{laser: ["0 m", "0 m", "0 m"], drill_sigma: "1 mm"}',
            "the laser's place has no effect",
        ),
        (
            '{laser: ["0 m", "0 m", "0 m"], pointing_sigma_arcsec: 90000}',
            "passes below the rim",
        ),
    ],
)
def test_invalid_laser_aiming_is_refused_in_one_line(aiming: str, says: str) -> None:
    overrides = {"light.layout.radius_variation": "0", "light.layout.aiming": aiming}
    with pytest.raises(InputError, match=says) as caught:
        dome_of(overrides)
    assert len(str(caught.value).splitlines()) == 1


def dome_of(overrides: dict[str, str]) -> Sources:
    scene = loader.load("apl_dome", overrides)
    assert isinstance(scene.light, DomeConfig)
    return dome.sources(scene.light, Band.from_camera(scene.camera))


def test_the_list_for_the_builder_has_the_design_not_the_laser_s_errors() -> None:
    text, _ = led_list(
        config(0.004, pointing_sigma_arcsec=60), Band.from_efficiency(0.5), "mine"
    )
    rows = np.genfromtxt(
        text.splitlines(), delimiter=",", names=True, skip_header=text.count("#")
    )
    listed = np.column_stack([rows[name] for name in ("x_m", "y_m", "z_m")])
    np.testing.assert_allclose(listed, places(), rtol=0, atol=1e-11)
