"""A projector onto a dome: spots and positions against traced rays, light against radiometry."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skysim.camera.glow import display_glow
from skysim.camera.glow.background import PointedCamera
from skysim.core.errors import InputError
from skysim.core.types import Floats, Sources
from skysim.scene import loader
from skysim.scene.sections.layouts import ProjectorConfig
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.lab import build_lab
from skysim.sources import dome
from skysim.sources.dome import display, surface
from skysim.sources.dome.led import full_strength_e_s_sr
from skysim.sources.photometry import Band

BAND = Band.from_efficiency(0.5)
OVAL = {
    "kind": "ellipsoid",
    "apex": "48 in",
    "semi_axes": ["38.88 in", "38.88 in", "28.60 in"],
}
PLACE_M = np.array([0.6, 0.1, 0.2])
AIM_M = np.array([0.1, 0.0, 1.15])
LED = {"intensity": "0.2 mcd", "disk_diameter": "1 um", "drive": {"kind": "direct"}}
POINTS = {"kind": "random", "cap_deg": 20, "count": 400, "hardware_seed": 3}


def meters(place_m: Floats) -> list[str]:
    return [f"{one} m" for one in place_m]


def config(
    points: dict[str, Any] | None = None, led: dict[str, Any] | None = None, **more: Any
) -> DomeConfig:
    layout = {
        "kind": "projector",
        "position": meters(PLACE_M),
        "aim": meters(AIM_M),
        "pixels": [1920, 1200],
    }
    layout |= {
        "pitch": "8 um",
        "focal_length": "8 mm",
        "f_number": 2,
        "falloff": 0,
        "distortion": 0.03,
    }
    layout |= {"points": points or POINTS} | more
    return DomeConfig.model_validate(
        {"kind": "dome", "surface": OVAL, "layout": layout, "led": LED | (led or {})}
    )


def shown(**more: Any) -> Sources:
    return dome.sources(config(**more), BAND)


def lens(**more: Any) -> ProjectorConfig:
    layout = config(**more).layout
    assert isinstance(layout, ProjectorConfig)
    return layout


def test_a_star_is_in_the_direction_of_a_whole_pixel_on_the_wall() -> None:
    """By the lens's law, c = f t (1 + k t^2): half a pixel off at most, uniformly; and on the surface."""
    made, design = (
        shown(),
        dome.sources(config().model_copy(update={"layout": config().layout.points}), BAND),
    )  # type: ignore[union-attr]
    chip_px = []
    for sources in (made, design):
        axis = (AIM_M - PLACE_M) / np.linalg.norm(AIM_M - PLACE_M)
        right = np.array([1, 0, 0]) - axis[0] * axis
        right /= np.linalg.norm(right)
        sight = sources.place[:, :3] - PLACE_M
        tangent = sight @ np.array([right, np.cross(axis, right)]).T / (sight @ axis)[:, None]
        chip_px.append(
            8e-3 * tangent * (1 + 0.03 * np.sum(tangent**2, axis=1, keepdims=True)) / 8e-6
            + [959.5, 599.5]
        )
    np.testing.assert_allclose(chip_px[0], np.rint(chip_px[0]), rtol=0, atol=1e-6)
    off = chip_px[0] - chip_px[1][np.searchsorted(design.id, made.id)]
    assert np.abs(off).max() < 0.5 + 1e-6
    assert off.var() == pytest.approx(1 / 12, rel=4 * np.sqrt(0.8 / off.size))
    shell = surface.build_surface(config().surface)
    again = shell.meet(PLACE_M, made.place[:, :3] - PLACE_M)
    np.testing.assert_allclose(made.place[:, :3], again, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("focus_m", "block"), [(1.07, 1), (0.8, 1), (1.3, 3)])
def test_a_spot_is_as_wide_as_ray_tracing_gives(focus_m: float, block: int) -> None:
    """Rays from all over the pupil through the sharp image of all over a block, to the wall; two moments of each."""
    places = [[0.3, 0.2, 1.1], [-0.35, 0.0, 1.1], [0.0, 0.4, 1.08], [0.1, 0.0, 1.21]]
    points = {
        "kind": "listed",
        "cap_deg": 40,
        "directions_deg": [_direction(np.array(one)) for one in places],
    }
    more: dict[str, Any] = {
        "points": points,
        "focus": f"{focus_m} m",
        "block": block,
        "distortion": 0,
    }
    made = shown(**more)
    shell = surface.build_surface(config().surface)
    rng = np.random.default_rng(1)
    R = display.own_from_lab(lens(**more)).as_matrix()
    for place_m, radius_m in zip(made.place[:, :3], made.radius_m, strict=True):
        own = R @ (place_m - PLACE_M)
        chip_m = 8e-3 * own[:2] / own[2] + rng.uniform(-0.5, 0.5, (500, 2)) * block * 8e-6
        sharp_m = np.column_stack([chip_m / 8e-3, np.ones(500)]) * focus_m
        angle = rng.uniform(0, 2 * np.pi, 500)
        radius = 2e-3 * np.sqrt(rng.uniform(0, 1, 500))
        pupil_m = np.column_stack(
            [radius * np.cos(angle), radius * np.sin(angle), np.zeros(500)]
        )
        start_m = PLACE_M + pupil_m @ R
        toward = (sharp_m - pupil_m) @ R
        hit_m = np.array(
            [shell.meet(a, b[None])[0] for a, b in zip(start_m, toward, strict=True)]
        )
        assert np.linalg.norm(hit_m.mean(axis=0) - place_m) < 0.15 * radius_m
        square_m2 = np.sum((hit_m - hit_m.mean(axis=0)) ** 2, axis=1).mean()
        assert radius_m == pytest.approx(np.sqrt(2 * square_m2), rel=0.06)


def _direction(place_m: Floats) -> list[float]:
    """Azimuth and tilt from the bearing, degrees."""
    azimuth = np.arctan2(place_m[1], place_m[0])
    tilt = np.arctan2(np.hypot(*place_m[:2]), place_m[2])
    return np.degrees([azimuth, tilt]).tolist()


def test_lens_and_paint_widen_a_spot_in_quadrature() -> None:
    sharp = shown()
    soft = shown(led={"disk_diameter": "2 mm"})
    np.testing.assert_allclose(soft.radius_m, np.hypot(sharp.radius_m, 1e-3), rtol=1e-6)


@pytest.mark.parametrize("falloff", [0.0, 4.0])
def test_a_pixel_s_light_is_lost_by_the_lens_alone(falloff: float) -> None:
    """cos^n of the angle from the axis, whatever distance and incidence; a block of n x n pixels has n^2 of it."""
    made = shown(falloff=falloff)
    axis = (AIM_M - PLACE_M) / np.linalg.norm(AIM_M - PLACE_M)
    sight = made.place[:, :3] - PLACE_M
    cosine = sight @ axis / np.linalg.norm(sight, axis=1)
    single = full_strength_e_s_sr(config().led, BAND)
    np.testing.assert_allclose(made.strength, single * cosine**falloff, rtol=1e-12)
    assert cosine.min() < 0.95
    assert shown(falloff=0, block=3).strength[0] == pytest.approx(9 * single, rel=1e-12)


def test_illuminance_of_the_wall_follows_distance_squared_and_incidence() -> None:
    """All pixels' light over the wall is that of all of them: I cos(i) / D^2 integrated over the picture."""
    rng = np.random.default_rng(2)
    shell = surface.build_surface(config().surface)
    one = lens(falloff=2)
    half_m = np.array([1920, 1200]) * 8e-6 / 2
    chip_m = rng.uniform(-1, 1, (2000, 2)) * half_m
    ray = display.rays(one, chip_m)
    distance_m = shell.exit_m(PLACE_M, ray)
    place_m = PLACE_M + distance_m[:, None] * ray
    normal = shell.inward(place_m)
    per_m2 = display.white_wall_per_m2(one, place_m, normal)
    # The area of one pixel by differences of four traced corners' rays.
    ends = [
        display.rays(one, chip_m + 4e-6 * np.array(side))
        for side in ([1, 0], [-1, 0], [0, 1], [0, -1])
    ]
    hits = [shell.exit_m(PLACE_M, end)[:, None] * end for end in ends]
    area_m2 = np.linalg.norm(np.cross(hits[0] - hits[1], hits[2] - hits[3]), axis=1)
    cosine = ray @ display.own_from_lab(one).as_matrix()[2]
    np.testing.assert_allclose(per_m2, cosine**2 / area_m2, rtol=1e-4)
    outside = PLACE_M + np.array([[0.9, 0.0, 0.1]])
    assert display.white_wall_per_m2(one, outside, np.array([[-1.0, 0.0, 0.0]]))[0] == 0


@pytest.mark.slow
def test_black_has_the_light_of_all_pixels_over_the_contrast() -> None:
    """A Lambertian wall of the radiance L = J / A of white pixels: its electrons are L times the camera's etendue.

    In the frame's middle, and nothing beside the picture.
    """
    changes = {
        "light.layout.contrast": "500",
        "light.led.drive": "{kind: direct}",
        "light.led.lobe.exponent": "1",
    }
    lab = build_lab(loader.load("projected_dome", changes))
    scene = lab.scene
    camera = lab.camera
    assert isinstance(scene.light, DomeConfig)
    assert isinstance(scene.light.layout, ProjectorConfig)
    camera_m = lab.start.apply(camera.mount.camera_body_m)
    cam_from_lab = camera.mount.cam_from_body * lab.start.inv()
    glow = display_glow.black_glow(
        scene.light, PointedCamera(camera.optics, cam_from_lab, camera_m, camera.band)
    )
    assert glow is not None
    shell = surface.build_surface(scene.light.surface)
    axis = cam_from_lab.inv().apply([0.0, 0.0, 1.0])
    place_m = shell.meet(camera_m, axis[None])
    per_m2 = display.white_wall_per_m2(scene.light.layout, place_m, shell.inward(place_m))[0]
    radiance = full_strength_e_s_sr(scene.light.led, camera.band) * per_m2 / 500
    etendue = (
        camera.optics.collecting_m2
        * camera.optics.throughput(np.ones(1))[0]
        / scene.camera.focal_px**2
    )
    x, y = np.rint(scene.camera.center_px).astype(int)
    assert glow[y, x] == pytest.approx(radiance * etendue, rel=2e-3)
    spot = {
        "light.layout.points.cap_deg": "1.5",
        "light.layout.points.count": "10",
        "light.layout.focal_length": "0.1 m",
    }
    narrow = build_lab(
        loader.load(
            "projected_dome", changes | spot | {"light.layout.aim": "[0 m, 0 m, 1.2 m]"}
        )
    )
    assert isinstance(narrow.scene.light, DomeConfig)
    dark = display_glow.black_glow(
        narrow.scene.light,
        PointedCamera(narrow.camera.optics, cam_from_lab, camera_m, narrow.camera.band),
    )
    assert dark is not None
    assert (dark == 0).any()


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (
            {"position": ["2 m", "0 m", "0 m"]},
            "light.layout.position: .* outside of the dome",
        ),
        ({"focal_length": "40 mm"}, "stars are outside of the projector's picture"),
        ({"aim": ["1 m", "0.1 m", "0.2 m"]}, "straight along x"),
        ({"distortion": -0.9}, "folds the picture's corners back"),
        ({"points": POINTS | {"levels": [1.0, 1e-9]}}, "is black on 256 gray levels"),
    ],
)
def test_a_wrong_projector_is_refused(more: dict[str, Any], says: str) -> None:
    with pytest.raises((InputError, ValueError), match=says):
        shown(**more)


def test_the_projector_s_light_does_not_pulse() -> None:
    with pytest.raises(
        InputError, match="pwm cannot drive a projector; allowed: direct, refresh"
    ):
        loader.load("projected_dome", {"light.led.drive": "{kind: pwm}"})
    with pytest.raises(
        InputError, match=r"light\.led\.color_scatter: has no effect.*share their light"
    ):
        loader.load(
            "projected_dome",
            {"light.led.spectrum": "630 nm", "light.led.color_scatter": "3 nm"},
        )
