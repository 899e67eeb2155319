"""Warnings about LED disks, which are drawn round, against the disks' rims projected point by point."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skysim.camera.optics import disk_image_axes
from skysim.camera.psf.kernel import Kernel
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.simulation.checks import plan
from skysim.simulation.checks.dome import assumptions as checks
from skysim.simulation.testbed import Testbed, build_testbed

RIM_RAD = np.linspace(0, 2 * np.pi, 3600, endpoint=False)
# A panel above the camera, wide enough for the maneuver: level, then tilted by 30 deg.
PANEL = {
    "light.surface": "{kind: flat, apex: 1.2 m}",
    "light.layout": "{kind: fibonacci, count: 3000, cap_deg: 45}",
    "motion.start": "{pitch_deg: 30}",
    "motion.control": "none",
    "motion.maneuver": "[]",
}


def rim_image(offset_m: Floats, normal: Floats, radius_m: float) -> Floats:
    """(3600, 2) image of a disk's rim through a pinhole of focal length 1."""
    across = np.cross(normal, [0.6, -0.64, 0.48])
    across /= np.linalg.norm(across)
    rim = np.outer(np.cos(RIM_RAD), across) + np.outer(np.sin(RIM_RAD), np.cross(normal, across))
    points = offset_m + radius_m * rim
    return points[:, :2] / points[:, 2:]


def area(xy: Floats) -> float:
    """Area of a polygon (shoelace formula)."""
    x, y = xy.T
    return float(abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2)


@settings(max_examples=60, derandomize=True, deadline=None)
@given(st.floats(0, 50), st.floats(0, 75), st.floats(0, 360), st.floats(0, 360), st.floats(0.3, 3))
def test_a_disks_image_is_the_ellipse_of_its_projected_rim(
    field_deg: float, incidence_deg: float, around_deg: float, azimuth_deg: float, distance_m: float
) -> None:
    """Exact to second order in radius over distance, here 1e-4; the area is cos i / cos^3 a of the drawn circle's."""
    sight = Rotation.from_euler("yz", [field_deg, azimuth_deg], degrees=True).apply([0, 0, 1])
    across = np.cross(sight, [0.48, 0.6, 0.64])
    tilt = Rotation.from_rotvec(np.radians(around_deg) * sight).apply(across / np.linalg.norm(across))
    normal = Rotation.from_rotvec(np.radians(incidence_deg) * tilt).apply(-sight)
    axes = disk_image_axes(distance_m * sight[None], normal[None])[0]
    rim = rim_image(distance_m * sight, normal, 1e-4 * distance_m) / 1e-4  # in units of the drawn radius
    distance = np.linalg.norm(rim - rim.mean(axis=0), axis=1)
    np.testing.assert_allclose(axes, [distance.max(), distance.min()], rtol=0, atol=2e-4 * axes[0])
    cos_i, cos_a = np.cos(np.radians([incidence_deg, field_deg]))
    assert np.prod(axes) == pytest.approx(area(rim) / np.pi, rel=1e-5)
    assert np.prod(axes) == pytest.approx(cos_i / cos_a**3, rel=1e-9)


def panel(**changes: str) -> Testbed:
    return build_testbed(loader.load("afit_simsat", PANEL | {k.replace("__", "."): v for k, v in changes.items()}))


def views_of(testbed: Testbed) -> checks.RoundDisks:
    return checks.round_disks(testbed.scene, testbed.sources, testbed.mount)


def test_a_tilted_camera_sees_ellipses_on_a_panel() -> None:
    """At the tilt t all of a small field is seen at about that incidence: the drawn peak is cos t of the true one."""
    views = views_of(panel())
    assert len(views.axes) > 100
    assert np.median(views.peak_error) == pytest.approx(np.cos(np.radians(30)) - 1, abs=0.02)
    assert np.degrees(np.median(views.incidence_rad)) == pytest.approx(30, abs=1)
    assert np.degrees(views.field_rad).max() < 6.5  # 10.0 deg across, so 6.3 deg to the corners


def test_a_level_camera_sees_circles_on_a_panel_too_small_off_axis() -> None:
    """A plane parallel to the sensor has a similar image: circles of f r / Z, where f r / d is drawn."""
    views = views_of(panel(motion__start="{pitch_deg: 0}", camera__focal_length="8 mm", camera__focus="1 m"))
    drawn = np.cos(views.field_rad)
    np.testing.assert_allclose(views.axes, np.repeat(1 / drawn[:, None], 2, axis=1), rtol=1e-9)
    assert np.degrees(views.field_rad).max() > 20


def test_a_disk_that_is_not_resolved_is_not_wrong() -> None:
    """Its image is the lens's; half resolved it is wrong by less."""
    errors = [
        np.abs(np.median(views_of(panel(light__led__disk_diameter=size)).peak_error))
        for size in ("0.02 mm", "0.3 mm", "2 mm")
    ]
    assert errors[0] < 1e-3 < errors[1] < 0.9 * errors[2]


@pytest.mark.slow
@pytest.mark.parametrize("diameter_mm", [0.2, 1.0, 2.0])
def test_peaks_are_wrong_by_what_a_convolution_of_the_ellipse_says(diameter_mm: float) -> None:
    """The peak behind a Gaussian blur is its integral over the ellipse, over the area. The law takes disk and blur
    for Gaussians, which is wrong by up to 0.04 where disk and blur are of one size.
    """
    testbed = panel(light__led__disk_diameter=f"{diameter_mm} mm")
    camera, views = testbed.scene.camera, views_of(testbed)
    worst = int(np.abs(views.peak_error).argmax())
    offset_m = checks.led_views(testbed.scene, testbed.sources, testbed.mount)[worst, :3]
    drawn_px = camera.focal_px * diameter_mm / 2e3 / float(np.linalg.norm(offset_m))
    x = np.arange(-15, 15, 0.02)
    blur = np.exp(-(x[:, None] ** 2 + x**2) / 2 / (1 + 1 / 12))  # the scene's sigma of 1 px, and the pixel's variance

    def peak(p_px: float, q_px: float) -> float:
        return float(np.sum(blur[(x[:, None] / p_px) ** 2 + (x / q_px) ** 2 < 1]) / (p_px * q_px))

    error = peak(drawn_px, drawn_px) / peak(*(views.axes[worst] * drawn_px)) - 1
    assert views.peak_error[worst] == pytest.approx(error, abs=0.04)


def test_a_note_says_how_wrong_the_worst_disk_is() -> None:
    """In the facts: the attitude does not depend on it, so it is no warning."""
    testbed = panel()
    line = checks.round_disk_note(testbed.scene, testbed.sources, testbed.mount)
    result = plan.check(testbed)
    assert [one.lines for one in result.facts if one.name == "image shape"] == [[line]]
    assert not [one for one in result.findings if "circles" in one]
    worst = re.search(r"([\d.]+) % at (\d+)° of incidence and (\d+)° off axis", line)
    assert worst is not None
    error, incidence_deg, field_deg = (float(text) for text in worst.groups())
    assert 30 < incidence_deg < 37
    cos_i, cos_a = np.cos(np.radians([incidence_deg, field_deg]))
    assert error == pytest.approx(100 * (1 - cos_i / cos_a**3), abs=1.5)  # the angles are rounded to a degree


@pytest.mark.slow
@pytest.mark.parametrize("name", ["afit_simsat", "apl_dome", "nps_tas2", "celestial_dome", "tas2_vscmg"])
def test_no_shipped_dome_needs_the_note(name: str) -> None:
    """Their LEDs face the camera and are near the axis, or are not resolved."""
    testbed = build_testbed(loader.load(name))
    assert checks.round_disk_note(testbed.scene, testbed.sources, testbed.mount) == ""
    assert np.abs(views_of(testbed).peak_error).max() < 0.02


def test_a_kernels_peak_is_the_brightest_pixel_of_a_centered_image() -> None:
    """A Gaussian's: the integral over a pixel of 1 px, here by the midpoint rule."""
    empty = np.empty((0, 3), np.float32), np.empty((0, 0, 0, 0), np.float32)
    x = (np.arange(2000) + 0.5) / 2000 - 0.5
    wanted = (np.mean(np.exp(-(x**2) / 2 / 0.7**2)) / np.sqrt(2 * np.pi) / 0.7) ** 2
    assert Kernel(0.7, *empty).peak == pytest.approx(wanted, rel=1e-6)
