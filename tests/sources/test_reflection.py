"""Reflections of the dome: the law of the integrating sphere, and mirror images against brute-force ray tracing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from skysim.core.types import Floats, Sources
from skysim.scene.sections.leds import CosineLobeConfig, LobeTableConfig
from skysim.scene.sections.light import ReflectionConfig
from skysim.sources.dome.interreflection import DiffuseLight, diffuse_light, spiral
from skysim.sources.dome.mirror import mirrored, reflectance
from skysim.sources.dome.surface import Cylinder, Ellipsoid, Plane, Rim, Surface
from skysim.sources.satellites import MIRRORED, light_name

LAMBERT = CosineLobeConfig()
# of a sphere, and of its center above the bearing
RADIUS_M = 1.3
HEIGHT_M = 0.3


def leds(place_m: Floats, normal: Floats, on: float = 1.0) -> Sources:
    """LEDs of 1 e- s^-1 sr^-1 while lit, for this fraction of the time."""
    ones = np.ones(len(place_m))
    place = np.column_stack([place_m, ones])
    clock = np.zeros(len(ones), np.int64)
    return Sources(
        np.arange(len(ones)),
        place,
        normal,
        1e-3 * ones,
        ones,
        ones,
        0 * ones,
        on * ones,
        clock,
        np.nan * ones,
    )


def sphere(rim_deg: float = 180.0) -> Surface:
    rim = Rim(np.array([0.0, 0.0, -HEIGHT_M]), half_rad=math.radians(rim_deg))
    return Ellipsoid(
        np.array([0.0, 0.0, HEIGHT_M]), semi_axes_m=np.full(3, RADIUS_M), rim=rim
    )


def on_wall(wall: Surface, count: int) -> tuple[Floats, Floats]:
    """Points of the wall and normals toward the inside."""
    points = wall.meet(np.zeros(3), spiral(count))
    points = points[np.isfinite(points[:, 0])]
    return points, wall.inward(points)


def glow(wall: Surface, sources: Sources, **config: object) -> DiffuseLight:
    return diffuse_light(ReflectionConfig.model_validate(config), wall, sources, LAMBERT)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_an_integrating_sphere_has_its_textbook_irradiance(share: float) -> None:
    """E = P / (A (1 - rho)), everywhere, wherever the LEDs are; a Lambertian LED of 1 / sr has P = pi."""
    wall = sphere()
    points, normals = on_wall(wall, 7)
    diffuse = glow(wall, leds(*on_wall(wall, 40), on=0.25), diffuse=share)
    expected = 0.25 * 40 * math.pi / (4 * math.pi * RADIUS_M**2) / (1 - share)
    np.testing.assert_allclose(
        diffuse.irradiance_e_s_m2(points, normals), expected, rtol=1e-4
    )


@pytest.mark.parametrize("rim_deg", [50.0, 90.0, 120.0])
def test_diffuse_light_in_a_spherical_cap_matches_theory(rim_deg: float) -> None:
    """E = P / (A (1 - rho f)), with f the cap's share of the sphere A."""
    wall = sphere(rim_deg)
    share = 0.6
    edge_m = wall.meet(
        np.zeros(3),
        np.array(
            [[math.sin(math.radians(rim_deg) - 1e-9), 0.0, math.cos(math.radians(rim_deg))]]
        ),
    )
    fraction = (1 - (edge_m[0, 2] - HEIGHT_M) / RADIUS_M) / 2
    placed = on_wall(wall, 60)
    diffuse = glow(wall, leds(*placed), diffuse=share)
    points, normals = on_wall(wall, 9)
    expected = len(placed[0]) * math.pi / (4 * math.pi * RADIUS_M**2) / (1 - share * fraction)
    np.testing.assert_allclose(
        diffuse.irradiance_e_s_m2(points, normals), expected, rtol=1e-3
    )


def test_light_is_conserved_in_an_ellipsoid() -> None:
    """What the closed wall absorbs, (1 - rho) E over its area, is what its LEDs emit, whatever their lobe."""
    wall = Ellipsoid(np.array([0.1, 0.0, 0.2]), semi_axes_m=np.array([1.6, 1.1, 0.9]))
    sources = leds(*on_wall(wall, 60))
    share = 0.7
    lobe = LobeTableConfig.model_validate(
        {"kind": "table", "angle_deg": [0, 30, 60, 90], "intensity": [1, 0.8, 0.3, 0]}
    )
    diffuse = diffuse_light(ReflectionConfig(diffuse=share), wall, sources, lobe)
    directions = spiral(20_000)
    points = wall.meet(np.zeros(3), directions)
    normals = wall.inward(points)
    area_m2 = (
        np.sum(points**2, axis=1)
        * (4 * np.pi / len(points))
        / -np.sum(directions * normals, axis=1)
    )
    absorbed = (1 - share) * np.sum(area_m2 * diffuse.irradiance_e_s_m2(points, normals))
    angle = np.linspace(0, np.pi / 2, 20_001)
    relative = np.interp(np.degrees(angle), lobe.angle_deg, lobe.intensity) * np.sin(angle)
    emitted = len(sources) * 2 * np.pi * np.trapezoid(relative, angle)
    assert absorbed == pytest.approx(emitted, rel=5e-3)


def test_diffuse_light_of_a_floor_under_one_led_matches_a_hand_calculation() -> None:
    """An LED at the height h above a black room's floor: E = I cos^4 / h^2, and a flat panel sees the floor's light.

    A Lambertian floor of the exitance rho E(x) lights a point above the LED's foot with rho E(x) cos cos / (pi d^2) dA.
    """
    wall = Plane(np.array([0.0, 0.0, 1.5]))
    source = leds(np.array([[0.0, 0.0, 1.5]]), np.array([[0.0, 0.0, -1.0]]))
    diffuse = glow(wall, source, floor={"share": 0.5, "depth": "1 m", "radius": "3 m"})
    radius = np.linspace(0, 3, 60_001)
    on_floor = 2.5**2 / (radius**2 + 2.5**2) ** 2
    back = np.trapezoid(
        0.5 * on_floor * 2.5**2 / (radius**2 + 2.5**2) ** 2 / np.pi * 2 * np.pi * radius,
        radius,
    )
    at_led = diffuse.irradiance_e_s_m2(
        np.array([[1e-9, 0.0, 1.5]]), np.array([[0.0, 0.0, -1.0]])
    )
    assert at_led[0] == pytest.approx(back, rel=2e-3)
    at_floor = diffuse.irradiance_e_s_m2(
        np.array([[0.7, 0.0, -1.0]]), np.array([[0.0, 0.0, 1.0]])
    )
    assert at_floor[0] == pytest.approx(2.5**2 / (0.7**2 + 2.5**2) ** 2, rel=1e-9)


@pytest.mark.slow
def test_a_dome_on_the_floor_conserves_its_light() -> None:
    """Wall and floor absorb what the LED emits; patches beside the edge, where K is singular, make 3 %."""
    rim = Rim(half_rad=math.radians(120))
    wall = Ellipsoid(np.zeros(3), semi_axes_m=np.full(3, 1.0), rim=rim)
    source = leds(np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]]))
    diffuse = glow(
        wall,
        source,
        diffuse=0.7,
        floor={"share": 0.7, "depth": "0.5 m", "radius": f"{math.sqrt(0.75)} m"},
    )
    on_cap = diffuse.irradiance_e_s_m2(*on_wall(wall, 4001)).mean() * 3 * math.pi
    turns = np.arange(900) * 2.4
    radius = np.sqrt(0.75 * (np.arange(900) + 0.5) / 900)
    places = np.column_stack(
        [radius * np.cos(turns), radius * np.sin(turns), np.full(900, -0.5)]
    )
    on_floor = (
        diffuse.irradiance_e_s_m2(places, np.tile([0.0, 0.0, 1.0], (900, 1))).mean()
        * 0.75
        * math.pi
    )
    assert 0.3 * (on_cap + on_floor) == pytest.approx(math.pi, rel=0.05)


# Mirror images against rays traced by other code, from the LED's side and from the camera's.

CAMERA_M = np.array([0.15, -0.1, 0.25])
QUADRICS = {
    "sphere": (
        Ellipsoid(np.array([0.0, 0.0, 0.3]), semi_axes_m=np.full(3, 1.3)),
        np.array([-0.2, 0.15, 0.1]),
    ),
    "ellipsoid": (
        Ellipsoid(np.array([0.05, 0.0, 0.1]), semi_axes_m=np.array([1.4, 1.1, 0.9])),
        np.array([0.4, 0.2, 0.5]),
    ),
    "cylinder": (
        Cylinder(np.array([0.0, 0.0, 0.2]), semi_axes_m=np.array([np.inf, 1.2, 1.2])),
        np.array([-0.1, 0.1, 0.0]),
    ),
    "flat": (Plane(np.array([0.0, 0.0, 1.2])), np.array([0.3, 0.2, 0.9])),
}
BORESIGHT = np.array([0.1, 0.05, 1.0])


def grid(half_rad: float = 0.6, count: int = 33) -> Floats:
    """Directions over a square field about the boresight."""
    tangent = np.tan(np.linspace(-half_rad, half_rad, count))
    x, y = np.meshgrid(tangent, tangent)
    z_axis = BORESIGHT / np.linalg.norm(BORESIGHT)
    x_axis = np.cross([0.0, 1.0, 0.0], z_axis)
    x_axis /= np.linalg.norm(x_axis)
    rays = z_axis + x[..., None] * x_axis + y[..., None] * np.cross(z_axis, x_axis)
    return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


def bounce(name: str, start: Floats, toward: Floats) -> tuple[Floats, Floats]:
    """Places on the wall and directions after it of rays (N, 3) from a point, by the textbook quadratic equation."""
    wall = QUADRICS[name][0]
    if isinstance(wall, Plane):
        steps = (wall.center_m[2] - start[2]) / toward[:, 2]
        normal = np.tile([0.0, 0.0, -1.0], (len(toward), 1))
        hit = start + steps[:, None] * toward
    else:
        assert isinstance(wall, Ellipsoid)
        weights = 1 / wall.semi_axes_m**2
        a = (toward**2) @ weights
        b = 2 * (toward * (start - wall.center_m)) @ weights
        c = (start - wall.center_m) ** 2 @ weights - 1
        hit = start + ((-b + np.sqrt(b**2 - 4 * a * c)) / (2 * a))[:, None] * toward
        normal = -(hit - wall.center_m) * weights
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return hit, toward - 2 * np.sum(toward * normal, axis=1, keepdims=True) * normal


def miss(name: str, toward: Floats, led_m: Floats) -> Floats:
    """(N,) miss distance of reflected rays from the camera to an LED ahead of them."""
    hit, along = bounce(name, CAMERA_M, toward)
    to_led = led_m - hit
    ahead = np.sum(to_led * along, axis=1)
    return np.where(
        ahead > 0, np.linalg.norm(to_led - ahead[:, None] * along, axis=1), np.inf
    )


def brute_force(name: str, led_m: Floats) -> Floats:
    """Directions in the field whose reflected rays pass through the LED, by successively finer searches."""
    count = 241
    rays = grid(count=count)
    missed = miss(name, rays.reshape(-1, 3), led_m).reshape(count, count)
    inner = missed[1:-1, 1:-1]
    around = [
        np.roll(np.roll(missed, i, 0), j, 1)[1:-1, 1:-1]
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
        if i or j
    ]
    found = []
    for row, column in np.argwhere((inner < np.min(around, axis=0)) & (inner < 0.2)):
        best = rays[row + 1, column + 1]
        width = 0.01
        for _ in range(40):
            steps = np.linspace(-width, width, 9)
            axes = np.linalg.svd(best[None])[2][1:]
            i, j = (part.ravel() for part in np.meshgrid(steps, steps))
            near = best + i[:, None] * axes[0] + j[:, None] * axes[1]
            near /= np.linalg.norm(near, axis=1, keepdims=True)
            best = near[miss(name, near, led_m).argmin()]
            width = 0.5 * width
        if miss(name, best[None], led_m)[0] < 1e-8:
            found.append(best)
    return np.array(found)


@pytest.mark.parametrize("name", list(QUADRICS))
def test_reflected_images_match_brute_force(name: str) -> None:
    """All of them, and no other, within 1e-7 rad."""
    wall, led_m = QUADRICS[name]
    source = leds(led_m[None], np.array([[0.0, 0.0, 1.0]]))
    images = mirrored(ReflectionConfig(specular=0.04), wall, source, CAMERA_M, grid())
    toward = images.place[:, :3] - CAMERA_M
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    expected = brute_force(name, led_m)
    assert len(expected) >= 1
    assert len(toward) == len(expected)
    nearest = np.arccos(np.clip(toward @ expected.T, -1, 1)).min(axis=0)
    np.testing.assert_allclose(nearest, 0, atol=1e-7)
    assert images.id.tolist() == [MIRRORED * (n + 1) for n in range(len(expected))]


@pytest.mark.parametrize("name", list(QUADRICS))
def test_reflected_images_are_as_bright_as_traced_rays(name: str) -> None:
    """A narrow cone of random rays from the LED: the density where they cross the plane of the camera's pupil."""
    wall, led_m = QUADRICS[name]
    normal = np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])
    images = mirrored(
        ReflectionConfig(specular=0.04),
        wall,
        leds(led_m[None], normal[None]),
        CAMERA_M,
        grid(),
    )
    rng = np.random.default_rng(8)
    for n in range(len(images)):
        toward = images.place[n, :3] - CAMERA_M
        distance_m = float(np.linalg.norm(toward))
        toward /= distance_m
        mirror_m = bounce(name, CAMERA_M, toward[None])[0][0]
        axis = (mirror_m - led_m) / np.linalg.norm(mirror_m - led_m)
        half = 0.02
        count = 400_000
        radius_m = 0.1 * 0.02 * distance_m
        # Even in solid angle.
        rays = axis + rng.uniform(-half, half, (count, 2)) @ np.linalg.svd(axis[None])[2][1:]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        hit, along = bounce(name, led_m, rays)
        steps = np.sum((CAMERA_M - hit) * toward, axis=1) / np.sum(along * toward, axis=1)
        caught = (
            np.linalg.norm(hit + steps[:, None] * along - CAMERA_M, axis=1) < radius_m
        ).sum()
        irradiance = caught / count * (2 * half) ** 2 / (math.pi * radius_m**2)
        assert 1 / distance_m**2 == pytest.approx(
            irradiance, rel=5 / math.sqrt(caught) + 0.01
        ), caught
        assert images.normal[n] @ -toward == pytest.approx(normal @ axis, abs=1e-6)
        assert images.strength[n] == pytest.approx(0.04)


def test_a_flat_wall_mirrors_at_the_same_distance_behind_it() -> None:
    wall, led_m = QUADRICS["flat"]
    images = mirrored(
        ReflectionConfig(specular=0.04),
        wall,
        leds(led_m[None], np.array([[0.0, 0.0, 1.0]])),
        CAMERA_M,
        grid(),
    )
    np.testing.assert_allclose(images.place[0], [0.3, 0.2, 1.5, 1.0], atol=1e-9)
    np.testing.assert_allclose(images.normal[0], [0.0, 0.0, -1.0], atol=1e-12)


def test_leds_on_a_flat_wall_have_no_image() -> None:
    place = np.array([[0.1, 0.2, 1.2], [0.0, 0.0, 1.2]])
    images = mirrored(
        ReflectionConfig(specular=0.04),
        QUADRICS["flat"][0],
        leds(place, np.array([[0, 0, -1.0]] * 2)),
        CAMERA_M,
        grid(),
    )
    assert len(images) == 0


def test_fresnel_reflectances_match_the_textbook() -> None:
    """((n - 1) / (n + 1))^2 at normal incidence, all at grazing, half the s component's at Brewster's angle."""
    n = 1.49
    config = ReflectionConfig(refractive_index=n)
    brewster = math.atan(n)
    # r_p = 0, r_s = sin(i - t) / sin(i + t), i + t = 90 deg.
    s = math.sin(brewster - math.asin(math.sin(brewster) / n)) ** 2
    expected = [((n - 1) / (n + 1)) ** 2, s / 2, 1.0]
    np.testing.assert_allclose(
        reflectance(config, np.array([1.0, math.cos(brewster), 0.0])), expected, atol=1e-12
    )


def test_reflections_and_ghosts_have_names() -> None:
    assert light_name(17) == "17"
    assert light_name(2 * MIRRORED + 17) == "reflection of 17"
    assert light_name(3_000_000_000_000 + MIRRORED + 5) == "ghost of reflection of 5"
