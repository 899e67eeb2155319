"""Mirror images of LEDs in the dome's wall, as lights at virtual places.

A ray from the camera in the direction u meets the wall at Q, with the inward normal N, and goes on along

    r = u - 2 (u . N) N .

An LED at P is seen in the wall if P is on that ray (the law of reflection, by which the length of the path is
stationary, Fermat's principle; Alhazen's problem on a sphere). The LED's offset from the ray is
F = P - Q - ((P - Q) . r) r.

1. Reflect the rays of a grid, and start at each at which the LED is nearest to the ray (`nearest_rays`).
2. Bring F to zero by Newton's method for the two angles of u (`linearized`).
3. Keep the solutions that converged, are on the wall and in the field, each once.
4. Place a virtual LED in the direction u at the distance d below.

A bundle of rays of the solid angle dOmega from the camera has the cross-section dA = |det dF / du| dOmega at the LED.
By reciprocity a bundle from the LED spreads as much on its way to the camera. So the LED's image is as bright and, in
area, as large as an LED at the distance

    d = sqrt(dA / dOmega),

seen under the angle at which the light leaves the LED: |Q - C| + |P - Q| for a flat wall. A curved wall stretches the
image along one of two directions, at equal area; that is neglected.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from skysim.core.types import Bools, Floats, Ints, Sources, homogeneous, lengths, normalized
from skysim.scene.sections.light import ReflectionConfig
from skysim.sources.dome.surface import Surface, perpendicular
from skysim.sources.satellites import MIRRORED

STEP_RAD = 1e-5  # of the difference quotients: error 1e-10
STEPS = 12  # of Newton's method
REACH = 12.0  # largest angle from an LED to a ray of the grid to start from, in the grid's spacing
TOUCHING = 1e-4  # an image nearer to the LED itself, in units of the camera's distance, is no reflection
SAME_RAD = 1e-7  # two solutions for an LED nearer to each other are one image
CLOSE = 1e-9  # largest offset of a solution from the ray, in units of the LED's distance


class Rays(NamedTuple):
    """N rays from the camera after their reflection: places on the wall, directions, cosines of the incidence."""

    wall_m: Floats
    along: Floats
    cosine: Floats


def mirrored(
    config: ReflectionConfig, wall: Surface, leds: Sources, camera_m: Floats, grid: Floats
) -> Sources:
    """The images of the LEDs that the camera sees in the wall; their numbers are `satellites.MIRRORED` and the LED's.

    Images closer together than the grid's directions, near a caustic, can be missed. No images for a camera outside.

    Parameters
    ----------
    camera_m
        (3,) entrance pupil
    grid
        (h, w, 3) unit vectors that cover the field
    """
    if not wall.inside(camera_m):
        return leds.take(np.zeros(0, np.int64))
    # 1.
    led, start = nearest_rays(wall, leds.xyz, camera_m, grid)
    led_m = leds.xyz[led]
    toward = grid.reshape(-1, 3)[start]
    # 2. A step is limited, since far from the solution the linear law may lead anywhere.
    for _ in range(STEPS):
        offset, jacobian, axes = linearized(wall, led_m, camera_m, toward)
        with np.errstate(invalid="ignore", divide="ignore"):
            step = -np.einsum("kij,kj->ki", inverse(jacobian), offset)
        toward = toward + np.einsum("ki,kij->kj", np.clip(step, -0.1, 0.1), axes)
        toward = normalized(toward)
    # 3. What a solution must satisfy: F = 0, an LED off the wall and ahead of the reflected ray, in the field.
    offset, jacobian, _ = linearized(wall, led_m, camera_m, toward)
    rays = reflect(wall, camera_m, toward)
    to_led = led_m - rays.wall_m
    far_m = lengths(to_led)
    path_m = lengths(rays.wall_m - camera_m)
    solved = (lengths(offset) < CLOSE * far_m) & (far_m > TOUCHING * path_m)
    solved &= np.isfinite(wall.meet(camera_m, toward)[:, 0])
    solved &= np.sum(to_led * rays.along, axis=1) > 0
    solved &= cosines_to_grid(toward, grid) > 0
    # d = sqrt(|det dF / du|).
    distance_m = np.sqrt(np.abs(np.linalg.det(np.nan_to_num(jacobian))))
    found = distinct(led, toward, solved & (distance_m > 0))
    # 4. The virtual LED's normal is the LED's, mirrored at the wall.
    sources = leds.take(led[found])
    wall_m = rays.wall_m[found]
    normal = wall.inward(wall_m) if len(found) else np.zeros((0, 3))
    across = np.sum(sources.normal * normal, axis=1, keepdims=True)
    virtual_m = camera_m + toward[found] * distance_m[found, None]
    return replace(
        sources,
        id=sources.id + MIRRORED * numbered(led[found]),
        place=homogeneous(virtual_m, 1.0),
        normal=sources.normal - 2 * across * normal,
        strength=sources.strength * reflectance(config, rays.cosine[found]),
    )


def numbered(led: Ints) -> Ints:
    """(K,) number of each image among those of its LED, from 1, for `led` (K,) in ascending order."""
    return np.arange(len(led)) - np.searchsorted(led, led) + 1


def reflectance(config: ReflectionConfig, cosine: Floats) -> Floats:
    """Fraction of the light that the wall mirrors at these cosines of the incidence: constant, or Fresnel's law.

    R = (r_s^2 + r_p^2) / 2, r_s = (cos i - n cos t) / (cos i + n cos t), r_p = (n cos i - cos t) / (n cos i + cos t).
    """
    n = config.refractive_index
    if n is None:
        return np.full(len(cosine), config.specular)
    # Snell's law: sin t = sin i / n.
    refracted = np.sqrt(1 - (1 - cosine**2) / n**2)
    r_s = (cosine - n * refracted) / (cosine + n * refracted)
    r_p = (n * cosine - refracted) / (n * cosine + refracted)
    return (r_s**2 + r_p**2) / 2


def distinct(led: Ints, toward: Floats, solved: Bools) -> Ints:
    """Rows of the solutions, each image once, sorted by LED and direction."""
    rows = np.flatnonzero(solved)
    rows = rows[np.lexsort([*np.round(toward[rows] / SAME_RAD).T, led[rows]])]
    same_led = np.diff(led[rows]) == 0
    apart = lengths(np.diff(toward[rows], axis=0))
    same = same_led & (apart < 3 * SAME_RAD)
    return rows[~np.concatenate([[False], same])] if len(rows) else rows


def reflect(wall: Surface, camera_m: Floats, toward: Floats) -> Rays:
    """Reflect rays from the camera at the wall, its rim ignored: r = u - 2 (u . N) N; NaN where they miss it."""
    wall_m = camera_m + wall.exit_m(camera_m, toward)[:, None] * toward
    normal = wall.inward(wall_m)
    cosine = -np.sum(toward * normal, axis=1)
    return Rays(wall_m, toward + 2 * cosine[:, None] * normal, cosine)


def nearest_rays(
    wall: Surface, led_m: Floats, camera_m: Floats, grid: Floats
) -> tuple[Ints, Ints]:
    """LEDs (K,) and rays (K,), as flat indices of the grid, at which an LED's angle from the reflected ray is least."""
    rays = reflect(wall, camera_m, grid.reshape(-1, 3))
    between = np.sum(grid[1:] * grid[:-1], axis=2)
    spacing_rad = float(np.arccos(np.clip(between, -1, 1)).max())
    # (N, h, w) cosine of each LED's angle from each reflected ray; NaN, a ray without a wall, is no maximum.
    along_m = led_m @ rays.along.T - np.sum(rays.wall_m * rays.along, axis=1)
    distance_m = np.maximum(cdist(led_m, rays.wall_m), 1e-300)
    cosine = np.nan_to_num(along_m / distance_m, nan=-1.0).reshape(-1, *grid.shape[:2])
    # Maxima among a ray and its eight neighbors.
    around = np.pad(cosine, ((0, 0), (1, 1), (1, 1)), constant_values=-1.0)
    around = np.maximum.reduce([around[:, :-2], around[:, 1:-1], around[:, 2:]])
    around = np.maximum.reduce([around[..., :-2], around[..., 1:-1], around[..., 2:]])
    limit = np.cos(min(REACH * spacing_rad, np.pi))
    led, row, column = np.nonzero((cosine >= around) & (cosine >= limit))
    return led, row * grid.shape[1] + column


def linearized(
    wall: Surface, led_m: Floats, camera_m: Floats, toward: Floats
) -> tuple[Floats, Floats, Floats]:
    """Offsets of LEDs from the reflected rays, and how they change with the rays' directions.

    Returns
    -------
    tuple
        (K, 2) offsets F across the rays, (K, 2, 2) their derivatives with respect to two angles of the direction,
        (K, 2, 3) axes of these angles
    """
    # The ray itself, and one to either side along both axes.
    axes = axes_across(toward)
    first, second = STEP_RAD * np.moveaxis(axes, 1, 0)
    shifted = toward + np.stack([0 * toward, first, -first, second, -second])
    shifted = normalized(shifted)
    rays = reflect(wall, camera_m, shifted.reshape(-1, 3))
    wall_m = rays.wall_m.reshape(shifted.shape)
    along = rays.along.reshape(shifted.shape)
    # The LEDs' offsets from the nearest points of the rays.
    to_led = led_m - wall_m
    offset = to_led - np.sum(to_led * along, axis=2, keepdims=True) * along
    # In axes across the middle ray; derivatives by central differences.
    center, *ends = np.einsum("kij,skj->ski", axes_across(along[0]), offset)
    columns = [(ends[0] - ends[1]) / (2 * STEP_RAD), (ends[2] - ends[3]) / (2 * STEP_RAD)]
    return center, np.stack(columns, axis=2), axes


def axes_across(unit: Floats) -> Floats:
    """(K, 2, 3) two unit vectors perpendicular to each of (K, 3) unit vectors and to each other."""
    first = perpendicular(unit)
    return np.stack([first, np.cross(unit, first)], axis=1)


def inverse(matrix: Floats) -> Floats:
    """(K, 2, 2) inverses [[d, -b], [-c, a]] / (a d - b c); infinite for singular matrices."""
    (a, b), (c, d) = np.moveaxis(matrix, 0, 2)
    return np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), 2, 0)


def cosines_to_grid(toward: Floats, grid: Floats) -> Floats:
    """(K,) numbers that are positive for directions within the cone about the grid's middle that contains the grid."""
    middle = grid.reshape(-1, 3).mean(axis=0)
    middle /= np.linalg.norm(middle)
    return toward @ middle - (grid @ middle).min() * (1 - 1e-12)
