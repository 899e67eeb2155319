"""Kernel of each source, and which sources may share one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skysim.camera.optics import Optics
from skysim.camera.psf.kernel import GAUSS, GRID, ROUND, build_kernel, gaussian_kernel
from skysim.camera.psf.kernel_cache import source_kernels
from skysim.core.errors import InputError
from skysim.scene.sections.camera import CameraConfig
from skysim.sources.stars import steady_points


def camera(**changes: Any) -> CameraConfig:
    part = {
        "width_px": 640, "height_px": 480, "pixel": "4 um", "focal_length": "35 mm", "f_number": 8, "focus": "1 m",
        "detector": {"quantum_efficiency": 0.5, "full_well_e": 4e4, "gain_e_dn": 10, "bits": 12},
    }  # fmt: skip
    return CameraConfig.model_validate(part | changes)


def shapes(
    lens: CameraConfig, radius_m: list[float], near: list[bool], distance_m: list[float]
) -> Any:
    count = len(radius_m)
    ones = np.ones(count)
    sources = steady_points(np.arange(count), np.zeros((count, 3)), ones, ones)
    sources.place[:, 3] = near
    sources.radius_m[:] = radius_m
    return source_kernels(
        sources, Optics.from_camera(lens), np.tile(lens.center_px, (count, 1)), np.array(distance_m), ones
    )  # fmt: skip


def test_a_focused_star_has_a_gaussian_kernel_and_a_lamp_a_disk() -> None:
    sharp = shapes(camera(focus="infinity"), [0.0], [False], [1.0])
    assert sharp.kind.tolist() == [GAUSS]
    both = shapes(camera(), [0.0, 1e-3], [False, True], [1.0, 1.0])
    # Focused on the lamp, the star is a disk of confusion.
    assert both.kind.tolist() == [ROUND, ROUND]
    assert both.reach_px[0] != both.reach_px[1]


def test_nearly_equal_sizes_share_a_table() -> None:
    near = [True] * 3
    made = shapes(camera(), [1e-3, 1e-3, 1.2e-3], near, [1.0, 1.0 + 1e-7, 1.0])
    np.testing.assert_array_equal(made.table[0], made.table[1])
    assert made.table[0, 0] != made.table[2, 0]
    again = shapes(camera(), [1.2e-3], near[:1], [1.0])
    np.testing.assert_array_equal(again.table[0], made.table[2])


def test_a_far_lamp_is_smaller() -> None:
    made = shapes(camera(focus="infinity"), [1e-2, 1e-2], [True, True], [20.0, 40.0])
    assert made.reach_px[0] > made.reach_px[1] + 2


def test_a_gaussian_widens_towards_the_corner_and_keeps_its_reach() -> None:
    lens = camera(
        focus="infinity", psf={"kind": "gaussian", "sigma_px": 0.7, "corner_sigma_px": 2.4}
    )
    place = np.array([lens.center_px, (-0.5, -0.5)])
    ones = np.ones(2)
    stars = steady_points(np.arange(2), np.zeros((2, 3)), ones, ones)
    made = source_kernels(stars, Optics.from_camera(lens), place, ones, ones)
    np.testing.assert_allclose(made.sigma_px, [0.7, 2.5], rtol=1e-12, atol=0)
    assert made.reach_px[1] >= 6.5 * 2.5


def test_sharpness_is_the_sigma_of_a_gaussian_and_of_an_edge() -> None:
    assert build_kernel(camera().psf, camera()).sharp_px == pytest.approx(
        np.sqrt(0.49 + 1 / 12), rel=1e-12
    )
    edge = build_kernel(camera().psf, camera(), emitter_radius_px=12.0).sharp_px
    assert edge == pytest.approx(1.25 * np.sqrt(0.49 + 1 / 12), rel=0.03)


def test_sharpness_of_a_grid_equals_that_of_its_table(tmp_path: Any) -> None:
    """Half the peak of a Gaussian over its steepest slope is sigma sqrt(e) / 2, the pixel included."""
    at = np.arange(-24, 25) / 4
    np.savetxt(tmp_path / "psf.csv", np.exp(-(at**2 + at[:, None] ** 2) / 2), delimiter=",")
    lens = camera(
        focus="infinity",
        psf={"kind": "measured", "file": str(tmp_path / "psf.csv"), "oversampling": 4},
    )
    wanted = np.sqrt(np.e) / 2 * np.sqrt(1 + 1 / 12)
    assert build_kernel(lens.psf, lens).sharp_px == pytest.approx(wanted, rel=0.02)


def test_a_measured_image_is_a_grid(tmp_path: Any) -> None:
    y, x = np.mgrid[-6:7, -6:7]
    np.savetxt(tmp_path / "psf.csv", np.exp(-(x**2) / 2 - y**2 / 8), delimiter=",")
    lens = camera(
        focus="infinity", psf={"kind": "measured", "file": str(tmp_path / "psf.csv")}
    )
    assert shapes(lens, [0.0], [False], [1.0]).kind.tolist() == [GRID]


def test_a_full_cache_is_cleared_and_gives_the_same_images(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = shapes(camera(), [1e-3], [True], [1.0])
    table = first.tables[slice(*first.table[0, :2])].copy()
    monkeypatch.setattr("skysim.camera.psf.kernel_cache.CACHE_BYTES", first.tables.nbytes - 1)
    again = shapes(camera(), [1e-3], [True], [1.0])
    np.testing.assert_array_equal(again.tables[slice(*again.table[0, :2])], table)


def test_a_lamp_far_out_of_focus_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match=r"camera\.focus: .* px; allowed: up to 500 px"):
        shapes(camera(focus="infinity", f_number=1.0), [1e-3], [True], [0.08])


def test_a_kernel_s_peak_is_the_brightest_pixel_of_a_centered_image() -> None:
    """A Gaussian's: the integral over a pixel of 1 px, here by the midpoint rule."""
    x = (np.arange(2000) + 0.5) / 2000 - 0.5
    wanted = (np.mean(np.exp(-(x**2) / 2 / 0.7**2)) / np.sqrt(2 * np.pi) / 0.7) ** 2
    assert gaussian_kernel(0.7).peak == pytest.approx(wanted, rel=1e-6)
