"""Inclined LEDs against a ray tracer: points of the disk, one by one, through a pinhole, a blur and the pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from skysim.camera.optics import Optics
from skysim.camera.psf import kernel_cache
from skysim.camera.psf.kernel import DiskImages, disk_images
from skysim.camera.render import Window, render
from skysim.core.types import Floats, Mount, Sources, SourceTruth, Trajectory
from skysim.scene.sections.camera import CameraConfig
from skysim.scene.sections.leds import CosineLobeConfig
from skysim.sources.dome.led import Emitter

AT_CENTER = Mount(np.zeros(3), Rotation.identity())
STILL = Trajectory(np.linspace(0, 1, 11), Rotation.identity(11), np.zeros((11, 3)))
RADIUS_M = 5e-3
DEPTH_M = 1.0
PATCH = 48
CENTER = (319.9, 240.2)
CORNER = (600.3, 440.8)


def lens_of(**changes: Any) -> Optics:
    """A camera with a field of 44 deg, focused at the LEDs, whose pupil is taken for a square meter."""
    part = {
        "width_px": 640, "height_px": 480, "pixel": "10 um", "focal_length": "10 mm", "f_number": 2.8,
        "focus": f"{DEPTH_M} m", "psf": {"kind": "gaussian", "sigma_px": 0.7},
        "detector": {"quantum_efficiency": 0.5, "full_well_e": 4e4, "gain_e_dn": 10, "bits": 12},
    }  # fmt: skip
    return replace(
        Optics.from_camera(CameraConfig.model_validate(part | changes)), collecting_m2=1.0
    )


def led(
    lens: Optics, xy_px: tuple[float, float], incidence_deg: float, around_deg: float = 20.0
) -> Sources:
    """An LED of unit strength imaged at this place, with its normal inclined to the line of sight."""
    place = DEPTH_M * np.append(
        (np.array(xy_px) - lens.camera.center_px) / lens.camera.focal_px, 1.0
    )
    sight = place / np.linalg.norm(place)
    tilt = Rotation.from_rotvec(np.radians(around_deg) * sight).apply(
        np.cross(sight, [0.0, 1.0, 0.0])
    )
    normal = Rotation.from_rotvec(
        np.radians(incidence_deg) * tilt / np.linalg.norm(tilt)
    ).apply(-sight)
    one = np.ones(1)
    zero = np.zeros(1)
    return Sources(
        np.array([1]),
        np.append(place, 1)[None],
        normal[None],
        RADIUS_M * one,
        one,
        one,
        zero,
        one,
        np.array([0]),
        zero,
    )


def drawn(lens: Optics, source: Sources, exponent: float = 1.0) -> tuple[Floats, SourceTruth]:
    image = np.zeros((lens.camera.height_px, lens.camera.width_px))
    emitter = Emitter(lobe=CosineLobeConfig(kind="cosine", exponent=exponent))
    return image, render(image, source, lens, STILL, AT_CENTER, Window(0.0, 1.0), emitter)


def disk_points(rings: int, spokes: int) -> tuple[Floats, Floats]:
    """(2, N) points of the unit disk and their shares of its area: Gauss in the radius squared, even in angle."""
    node, weight = np.polynomial.legendre.leggauss(rings)
    angle = (np.arange(spokes) + 0.5) * 2 * np.pi / spokes
    polar = np.sqrt((node[:, None] + 1) / 2) * np.exp(1j * angle)
    return np.stack([polar.real.ravel(), polar.imag.ravel()]), np.repeat(
        weight / 2 / spokes, spokes
    )


def rays(camera: CameraConfig, source: Sources, exponent: float) -> tuple[Floats, Floats]:
    """(2, N) pixels and (N,) light of points of the LED: I cos^n(theta) cos(phi) / d^2 for each of them."""
    e, share = disk_points(24, 80)
    place = source.place[0, :3]
    normal = source.normal[0]
    across = np.cross(normal, [0.3, -0.8, 0.52])
    across /= np.linalg.norm(across)
    points = place[:, None] + RADIUS_M * (
        np.outer(across, e[0]) + np.outer(np.cross(normal, across), e[1])
    )
    distance = np.linalg.norm(points, axis=0)
    light = share * (-normal @ points / distance) ** exponent * points[2] / distance**3
    return camera.focal_px * points[:2] / points[2] + np.array(camera.center_px)[
        :, None
    ], light


def traced(
    camera: CameraConfig,
    source: Sources,
    exponent: float = 1.0,
    sigma_px: float = 0.7,
    shift_px: float = 0.0,
) -> tuple[Any, Floats]:
    """The pixels of a patch, as slices, and its light, shifted along x."""
    xy, light = rays(camera, source, exponent)
    xy[0] += shift_px
    pupil_m = camera.pupil_m
    image_m = camera.image_distance_m
    defocus_px = (
        pupil_m
        * image_m
        * abs(1 / source.place[0, 2] - 1 / camera.focus_m)
        / 2
        / camera.pixel_m
    )
    if defocus_px > 1e-9:
        e, share = disk_points(8, 20)
        xy = (xy[:, :, None] + defocus_px * e[:, None, :]).reshape(2, -1)
        light = np.outer(light, share).ravel()
    corner = np.rint(xy.mean(axis=1)).astype(int) - PATCH // 2
    total = np.zeros((PATCH, PATCH))
    edges = corner[:, None] + np.arange(PATCH + 1) - 0.5
    for part in np.array_split(np.arange(len(light)), max(1, len(light) // 20_000)):
        columns, rows = (
            np.diff(ndtr((edge[:, None] - at) / sigma_px), axis=0)
            for edge, at in zip(edges, xy[:, part], strict=True)
        )
        total += (rows * light[part]) @ columns.T
    x, y = corner
    return np.s_[y : y + PATCH, x : x + PATCH], total


@pytest.mark.parametrize(
    "focus", [f"{DEPTH_M} m", pytest.param("0.5 m", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("xy_px", [CENTER, CORNER])
@pytest.mark.parametrize(
    ("incidence_deg", "around_deg", "exponent"),
    [(0, 0, 1.0), (30, 20, 1.0), (30, 110, 3.0), (60, 75, 1.0), (60, 160, 3.0)],
)
def test_an_inclined_led_s_image_matches_ray_tracing(
    incidence_deg: float,
    around_deg: float,
    exponent: float,
    xy_px: tuple[float, float],
    focus: str,
) -> None:
    """To 5e-4 of the peak: in focus and 1.8 px out of it, on the axis and 19 deg off it, with two lobes. Drawn
    round, an LED at 30 deg is wrong by 0.4 of the peak. The mean of the light is right to 5e-4 px, where center and
    disk's center are 0.03 px apart.
    """
    lens = lens_of(focus=focus)
    source = led(lens, xy_px, incidence_deg, around_deg)
    image, seen = drawn(lens, source, exponent)
    where, true = traced(lens.camera, source, exponent)
    drawn_round = incidence_deg == 0 and xy_px == CENTER  # its sizes are in steps of 0.01 px
    assert np.abs(image[where] - true).max() < (1e-3 if drawn_round else 5e-4) * true.max()
    assert image.sum() == pytest.approx(true.sum(), rel=2e-4)
    xy, light = rays(lens.camera, source, exponent)
    np.testing.assert_allclose(
        seen.flux_xy_px[0], xy @ light / light.sum(), rtol=0, atol=5e-4
    )
    np.testing.assert_allclose(seen.xy_px[0], xy_px, rtol=0, atol=1e-9)


@pytest.mark.parametrize("sigma_px", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("radius_m", [3e-4, 1.2e-3, 2.5e-3])
def test_images_of_small_disks_and_other_blurs_match_ray_tracing(
    radius_m: float, sigma_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Disks of 0.3 to 2.5 px, narrower and wider than the blur."""
    monkeypatch.setattr(f"{__name__}.RADIUS_M", radius_m)
    lens = lens_of(psf={"kind": "gaussian", "sigma_px": sigma_px})
    source = led(lens, CORNER, 55)
    image, seen = drawn(lens, source, 2.0)
    where, true = traced(lens.camera, source, 2.0, sigma_px)
    assert np.abs(image[where] - true).max() < 5e-4 * true.max()
    xy, light = rays(lens.camera, source, 2.0)
    np.testing.assert_allclose(
        seen.flux_xy_px[0], xy @ light / light.sum(), rtol=0, atol=1e-4
    )


LENSES = {
    "gaussian": {"kind": "gaussian", "sigma_px": 0.7},
    "disk": {"kind": "disk", "radius_px": 1.5, "sigma_px": 0.6},
    "airy": {"kind": "airy", "wavelength": "550 nm", "sigma_px": 0.5},
    "moffat": {"kind": "moffat", "fwhm_px": 2.5, "beta": 3.0},
}


@pytest.mark.parametrize("kind", LENSES)
@pytest.mark.parametrize("focus", [f"{DEPTH_M} m", "0.5 m"])
def test_an_ellipse_of_equal_axes_equals_the_round_image(
    kind: str, focus: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An LED that faces the camera on its axis, drawn by either way, behind every lens: to 1e-3 of the peak, as the
    round kernels' sizes are in steps of 0.01 px.
    """
    lens = lens_of(psf=LENSES[kind], focus=focus)
    source = led(lens, CENTER, 0)
    monkeypatch.setattr(kernel_cache, "MAX_ROUND_ERROR", np.inf)
    round_image, _ = drawn(lens, source)
    monkeypatch.setattr(kernel_cache, "MAX_ROUND_ERROR", 0.0)
    image, _ = drawn(lens, source)
    assert np.abs(image - round_image).max() < 1e-3 * image.max()
    assert image.sum() == pytest.approx(round_image.sum(), rel=1e-5)


def test_a_measured_lens_that_is_not_round_draws_ellipses_too(tmp_path: Any) -> None:
    """A coma-like table, the sum of two Gaussians: the image is the sum of two traced ones, shifted."""
    x = np.arange(-32, 33) / 8
    spots = [(0.7, -0.3), (0.3, 0.7)]  # (light, x in px): mean 0
    cells = sum(
        light * np.exp(-((x - at) ** 2 + x[:, None] ** 2) / 2 / 0.7**2) for light, at in spots
    )
    np.savetxt(tmp_path / "psf.csv", cells, delimiter=",")
    lens = lens_of(
        psf={"kind": "measured", "file": str(tmp_path / "psf.csv"), "oversampling": 8}
    )
    source = led(lens, CENTER, 40)
    image, _ = drawn(lens, source, 2.0)
    true = np.zeros_like(image)
    for light, at in spots:
        where, part = traced(lens.camera, source, 2.0, shift_px=at)
        true[where] += light * part
    assert np.abs(image - true).max() < 1e-3 * true.max()


def test_a_moving_ellipse_is_the_mean_of_still_ones() -> None:
    """A streak of 6 px of an LED at 50 deg, and a rolling shutter that reads slowly enough to see it move."""
    lens = lens_of()
    source = led(lens_of(), CENTER, 50)
    t = np.linspace(0, 1, 41)
    rate = np.array([0.002, 0.006, 0.0])
    path = Trajectory(
        t, Rotation.from_rotvec((t[:, None] - 0.5) * rate), np.tile(rate, (41, 1))
    )
    image = np.zeros((480, 640))
    stills = np.zeros((480, 640))
    render(image, source, lens, path, AT_CENTER, Window(0.0, 1.0))
    times = (np.arange(64) + 0.5) / 64
    for pose in path.attitude_at(times):
        still = Trajectory(t, Rotation.concatenate([pose] * 41), np.zeros((41, 3)))
        render(stills, source, lens, still, AT_CENTER, Window(0.0, 1.0))
    assert np.abs(image - stills / 64).max() < 1e-3 * image.max()
    rolled = np.zeros((480, 640))
    render(rolled, source, lens, STILL, AT_CENTER, Window(0.2, 0.5, 1e-5, 480))
    np.testing.assert_allclose(
        rolled.sum(), drawn(lens, source)[0].sum() / 2, rtol=1e-5, atol=0
    )


@pytest.mark.slow
@settings(max_examples=40, derandomize=True, deadline=None)
@given(
    st.floats(0, 30),
    st.floats(0, 75),
    st.floats(0, 360),
    st.floats(0, 360),
    st.floats(0.5, 4),
)
def test_rim_and_mean_light_match_the_projected_disk(
    field_deg: float,
    incidence_deg: float,
    around_deg: float,
    azimuth_deg: float,
    exponent: float,
) -> None:
    """The rim's points are on the ellipse, whose area is cos i / cos^3 a of a circle of f r / d, and the mean of the
    light is center + A q / 4, all to third order in r / d.
    """
    lens = lens_of()
    out_px = lens.camera.focal_px * np.tan(np.radians(field_deg))
    angle = np.radians(azimuth_deg)
    xy_px = np.array(lens.camera.center_px) + out_px * np.array(
        [np.cos(angle), np.sin(angle)]
    )
    source = led(lens, (xy_px[0], xy_px[1]), incidence_deg, around_deg)
    emitter = Emitter(lobe=CosineLobeConfig(kind="cosine", exponent=exponent))
    images = disk_images(lens, emitter, source.place[:, :3], source.normal, source.radius_m)
    xy, light = rays(lens.camera, source, exponent)
    third = lens.camera.focal_px * RADIUS_M**3 * 40
    mean = images.center[0] + images.gradient[0] / 4
    np.testing.assert_allclose(mean, xy @ light / light.sum() - xy_px, rtol=0, atol=third)
    cos_i, cos_a = np.cos(np.radians([incidence_deg, field_deg]))
    circle_px = lens.camera.focal_px * RADIUS_M * cos_a / DEPTH_M  # f r / d
    assert np.prod(images.semi_axes_px()) == pytest.approx(
        circle_px**2 * cos_i / cos_a**3, rel=1e-3
    )
    normal = source.normal[0]
    place = source.place[0, :3]
    across = np.cross(normal, [0.3, -0.8, 0.52])
    across /= np.linalg.norm(across)
    t = np.linspace(0, 2 * np.pi, 100)
    rim = place[:, None] + RADIUS_M * (
        np.outer(across, np.cos(t)) + np.outer(np.cross(normal, across), np.sin(t))
    )
    offset = (
        lens.camera.focal_px * rim[:2] / rim[2]
        + np.array(lens.camera.center_px)[:, None]
        - xy_px[:, None]
    )
    unit = np.linalg.norm(
        np.linalg.solve(images.matrix[0], offset - images.center[0][:, None]), axis=0
    )
    np.testing.assert_allclose(
        unit, 1, rtol=0, atol=3 * RADIUS_M**2 / np.cos(np.radians(incidence_deg)) ** 2
    )


def test_a_disk_behind_the_camera_has_no_image() -> None:
    images = disk_images(
        lens_of(),
        Emitter(),
        np.array([[0, 0, 1e-3], [0, 0, -1.0]]),
        np.array([[0.8, 0, -0.6]] * 2),
        np.full(2, 2e-3),
    )
    assert isinstance(images, DiskImages)
    assert np.isnan(images.matrix).any(axis=(1, 2)).all()
    np.testing.assert_array_equal(images.semi_axes_px()[1], 0)
