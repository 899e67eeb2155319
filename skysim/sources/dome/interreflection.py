"""Diffuse light inside the dome: LEDs shine on wall and floor, which scatter it to each other again and again.

The irradiance E of Lambertian surfaces of reflectance rho obeys

    E(x) = E_0(x) + integral rho(y) E(y) K(x, y) dA(y),    K = cos(theta_x) cos(theta_y) / (pi d^2),

with E_0 from the LEDs directly (the radiosity equation; Siegel & Howell, Thermal Radiation Heat Transfer, ch. 7).

1. Divide wall and floor into patches (`wall_patches`, `floor_patches`).
2. Light of the LEDs on each patch, E_0 (`irradiance`).
3. Solve the equation at the patches, (1 - K rho A) E = E_0 (Nystroem's method).
4. Any other point gets its light from LEDs and patches by the same sum.

On a sphere K = 1 / (4 pi R^2) everywhere, so LEDs of the power P in a sphere of the area A give
E = P / (A (1 - rho)), the law of the integrating sphere.
"""

from typing import Any, NamedTuple

import numba
import numpy as np

from skysim.core.constants import GOLDEN_ANGLE_RAD
from skysim.core.jit import jit
from skysim.core.types import UP, Floats, Sources, around_z, joined
from skysim.scene.sections.leds import Lobe
from skysim.scene.sections.light import DomeConfig, FloorConfig, ReflectionConfig
from skysim.sources.dome.led import LOBES
from skysim.sources.dome.surface import Surface, build_surface, unit_vectors

PATCHES = 700  # on the wall, and as many on the floor
MAX_DIRECTIONS = 20_000  # from the bearing, for a wall that fills a small part of its sky
LOBE_SAMPLES = 2049  # of a lobe, at evenly spaced cosines: within 1e-5 of cos^10


class Emitters(NamedTuple):
    """N small emitters.

    Attributes
    ----------
    place_m, normal
        (N, 3) places and unit normals
    strength
        (N,) photo-electrons s^-1 sr^-1 along the normals
    lobe
        (K,) relative intensity of all emitters at evenly spaced cosines of the emission angle, from 0 to 1
    """

    place_m: Floats
    normal: Floats
    strength: Floats
    lobe: Floats


class Patches(NamedTuple):
    """P patches of wall and floor: places and unit normals (P, 3), areas and diffuse reflectances (P,)."""

    place_m: Floats
    normal: Floats
    area_m2: Floats
    reflectance: Floats


class DiffuseLight(NamedTuple):
    """All diffuse light of a dome: the LEDs, and the patches as emitters."""

    leds: Emitters
    patches: Emitters

    def irradiance_e_s_m2(self, points_m: Floats, normals: Floats) -> Floats:
        """(M,) mean irradiance of points (M, 3) on the wall or the floor, in photo-electrons s^-1 m^-2 (step 4)."""
        by_leds = irradiance(points_m, normals, self.leds)
        return by_leds + irradiance(points_m, normals, self.patches)


def diffuse_light(
    config: ReflectionConfig, wall: Surface, leds: Sources, lobe: Lobe
) -> DiffuseLight:
    """Solve the radiosity equation for the mean light of a dome's LEDs, without their flicker."""
    # 1. Patches.
    patches = wall_patches(wall, config.diffuse)
    if config.floor:
        patches = joined([patches, floor_patches(config.floor)])
    # 2. Direct light, with the strengths averaged over the pulses.
    sampled = LOBES[lobe.kind](lobe, np.linspace(0, 1, LOBE_SAMPLES))
    place_m = np.ascontiguousarray(leds.xyz)
    emitters = Emitters(place_m, leds.normal, leds.strength * leds.duty, sampled)
    direct = irradiance(patches.place_m, patches.normal, emitters)
    # 3. Sum over the patches: K rho A E.
    transfer = kernel(patches) * (patches.reflectance * patches.area_m2)
    total = np.linalg.solve(np.eye(len(transfer)) - transfer, direct)
    # Lambertian patches of this irradiance have the radiance rho E / pi.
    strength = patches.reflectance * total * patches.area_m2 / np.pi
    linear = np.linspace(0, 1, 2)
    return DiffuseLight(emitters, Emitters(patches.place_m, patches.normal, strength, linear))


def wall_patches(wall: Surface, reflectance: float) -> Patches:
    """About PATCHES patches of the wall, of equal solid angle as seen from the bearing's center.

    A solid angle w at the distance r covers the area r^2 w / cos(incidence).
    """
    # The fraction of the sky that the wall fills gives the number of directions.
    share = max(
        float(np.isfinite(wall.from_bearing(spiral(2000))[:, 0]).mean()),
        PATCHES / MAX_DIRECTIONS,
    )
    toward = spiral(round(PATCHES / share))
    met = wall.from_bearing(toward)
    on_wall = np.isfinite(met[:, 0])
    place_m = met[on_wall]
    normal = wall.inward(place_m)
    cosine = -np.sum(toward[on_wall] * normal, axis=1)
    area_m2 = np.sum(place_m**2, axis=1) * (4 * np.pi / len(toward)) / cosine
    return Patches(place_m, normal, area_m2, np.full(len(area_m2), reflectance))


def floor_patches(config: FloorConfig) -> Patches:
    """PATCHES patches of the floor, of equal area, on a Fibonacci spiral."""
    radius_m = config.radius_m * np.sqrt((np.arange(PATCHES) + 0.5) / PATCHES)
    azimuth = np.arange(PATCHES) * GOLDEN_ANGLE_RAD
    place_m = around_z(radius_m, azimuth, -config.depth_m)
    area_m2 = np.full(PATCHES, np.pi * config.radius_m**2 / PATCHES)
    return Patches(
        place_m,
        np.tile(UP, (PATCHES, 1)),
        area_m2,
        np.full(PATCHES, config.share),
    )


def spiral(count: int) -> Floats:
    """(N, 3) unit vectors of a Fibonacci spiral over the sphere, each for nearly the same solid angle 4 pi / N."""
    z = 1 - (2 * np.arange(count) + 1) / count
    azimuth = np.arange(count) * GOLDEN_ANGLE_RAD
    return unit_vectors(z, azimuth)


def kernel(patches: Patches) -> Floats:
    """(N, N) K between patches. No patch hides another.

    The diagonal has K to the nearest other patch. K of a smooth surface has a finite limit, its mean squared curvature
    over 4 pi, which a neighbor has nearly too.
    """
    offset = patches.place_m[None] - patches.place_m[:, None]
    square = np.sum(offset**2, axis=2)
    np.fill_diagonal(square, np.inf)
    # Positive where the patches face each other.
    cos_from = np.einsum("ijk,ik->ij", offset, patches.normal)
    cos_to = -np.einsum("ijk,jk->ij", offset, patches.normal)
    values = np.maximum(cos_from, 0) * np.maximum(cos_to, 0) / (np.pi * square**2)
    np.fill_diagonal(values, values[np.arange(len(values)), square.argmin(axis=1)])
    return values


def irradiance(points_m: Floats, normals: Floats, emitters: Emitters) -> Floats:
    """(M,) irradiance of points with unit normals (M, 3) by all emitters, in photo-electrons s^-1 m^-2.

    E = sum over emitters of I(theta) cos(phi) / d^2.
    """
    return _irradiance(
        np.ascontiguousarray(points_m), np.ascontiguousarray(normals), *emitters
    )


@jit(parallel=True)
def _irradiance(
    points_m: Floats,
    normals: Floats,
    place_m: Floats,
    emitter_normal: Floats,
    strength: Floats,
    lobe: Floats,
) -> Any:
    """The sum of `irradiance`, points in parallel."""
    out = np.zeros(len(points_m))
    last = len(lobe) - 1
    for m in numba.prange(len(points_m)):
        total = 0.0
        for n in range(len(place_m)):
            x = points_m[m, 0] - place_m[n, 0]
            y = points_m[m, 1] - place_m[n, 1]
            z = points_m[m, 2] - place_m[n, 2]
            square = x * x + y * y + z * z
            # A point on the emitter itself gets no light from it.
            if square < 1e-24:
                continue
            distance = np.sqrt(square)
            emission = (
                x * emitter_normal[n, 0] + y * emitter_normal[n, 1] + z * emitter_normal[n, 2]
            ) / distance
            incidence = (
                -(x * normals[m, 0] + y * normals[m, 1] + z * normals[m, 2]) / distance
            )
            if emission > 0 and incidence > 0:
                # The lobe between its samples.
                at = min(emission, 1.0) * last
                k = min(int(at), last - 1)
                intensity = lobe[k] + (at - k) * (lobe[k + 1] - lobe[k])
                total += strength[n] * intensity * incidence / square
        out[m] = total
    return out


# A dome that reflects, as a scene gives it.


class ReflectingDome(NamedTuple):
    """Wall and floor of a dome; `diffuse` is the light that they scatter, None if they only mirror."""

    config: ReflectionConfig
    wall: Surface
    diffuse: DiffuseLight | None


def reflecting_dome(
    light: DomeConfig, config: ReflectionConfig, leds: Sources
) -> ReflectingDome:
    """The dome of a scene's light, which reflects by its section `config`, and its LEDs."""
    wall = build_surface(light.surface)
    diffuse = None
    if config.diffuse or config.floor:
        diffuse = diffuse_light(config, wall, leds, light.led.lobe)
    return ReflectingDome(config, wall, diffuse)
