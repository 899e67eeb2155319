"""Spreads of single LEDs over the cap: Fibonacci spiral, random, Poisson disk, optimized, geodesic sphere."""

from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.spatial import ConvexHull

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, around_z, azimuths_rad, normalized
from skysim.scene.sections.layouts import (
    FibonacciConfig,
    GeodesicConfig,
    OptimizedConfig,
    PoissonDiskConfig,
    RandomPlacesConfig,
)
from skysim.sources.dome.layouts import optimize
from skysim.sources.dome.layouts.placing import (
    cap,
    project_from_bearing,
    scattered_cap,
    spread,
    thin,
    tilts_rad,
)
from skysim.sources.dome.surface import Surface, circle_rad, directions

# Random points per spacing^2: a gap of .03 of that area is found with probability .95.
DARTS_PER_SPACING2 = 100
MAX_DARTS = 3_000_000
DARTS_PER_LED = 30  # random points per LED, if a count is given
# Brightness does not move an LED, so places are cached without it.
UNDIMMED = {"levels": None, "magnitudes": None, "unique_neighbors": None}
BISECTIONS = 14  # bisection steps from the dome's width: to some tenths of a millimeter


# Arguments: the layout's section of the scene, the surface, and the hardware's random stream.


def fibonacci(config: FibonacciConfig, surface: Surface, rng: Generator) -> Floats:
    """LEDs on a Fibonacci spiral: equal solid angles about the bearing contain equal numbers, to within a few."""
    return project_from_bearing(surface, cap(config.count, np.radians(config.cap_deg)))


def random_places(config: RandomPlacesConfig, surface: Surface, rng: Generator) -> Floats:
    """Independent LEDs, uniform in solid angle about the bearing: a Poisson field, like that of real stars."""
    directions = scattered_cap(config.count, np.radians(config.cap_deg), rng)
    return project_from_bearing(surface, directions)


def poisson_disk(config: PoissonDiskConfig, surface: Surface, rng: Generator) -> Floats:
    """LEDs at random with a least spacing, as many as fit: random sequential adsorption.

    Random points, uniform over the cap, are taken in turn; each is accepted if no accepted one is within the spacing.
    Disks of that diameter would jam at a coverage of .547 (Feder 1980, J. theor. Biol. 87, 237; assumed).
    DARTS_PER_SPACING2 points per square of the spacing reach .52, that is .66 LEDs per square of the spacing, and a
    higher density along the rim.
    If a count is given instead, the result is the first `count` points accepted at the widest spacing that has room
    for them.

    Raises
    ------
    InputError
        For a spacing that makes more LEDs than fit into memory.
    """
    half = np.radians(config.cap_deg)
    # A count: the widest spacing by bisection.
    if config.spacing_m is None:
        count = config.count or 1
        darts_m = project_from_bearing(
            surface, scattered_cap(DARTS_PER_LED * count, half, rng)
        )
        chosen = spread(darts_m, 0.0, count, BISECTIONS)
        return darts_m[chosen]
    directions = cap(1000, half)
    points = project_from_bearing(surface, directions)
    # Surface area per steradian seen from the bearing, r^2 / cos(incidence). Where it is greatest, points uniform in
    # solid angle are sparsest on the surface, so this maximum sets how many are needed.
    slant = -np.einsum("nj,nj->n", surface.inward(points), directions)
    meters2_sr = np.sum(points**2, axis=1) / slant
    dart_count = DARTS_PER_SPACING2 * 2 * np.pi * (1 - np.cos(half)) * meters2_sr.max()
    dart_count /= config.spacing_m**2
    if not 0 < dart_count <= MAX_DARTS:
        min_spacing_m = np.inf
        if dart_count > 0:
            min_spacing_m = config.spacing_m * np.sqrt(dart_count / MAX_DARTS)
        raise InputError(
            "light.layout.spacing",
            f"{config.spacing_m:g} m gives too many LEDs",
            f"{min_spacing_m:.3g} m or more",
        )
    darts_m = project_from_bearing(surface, scattered_cap(max(int(dart_count), 1), half, rng))
    return darts_m[thin(darts_m, config.spacing_m)]


def optimized(config: OptimizedConfig, surface: Surface, rng: Generator) -> Floats:
    """LEDs at the places that make the camera's worst attitudes most accurate: `optimize.optimize_places`.

    No LED is placed where no attitude's field reaches. In the mean of the worst attitudes the layout is not worse
    than a Fibonacci spiral.
    """
    config_of_places = config.with_values(**UNDIMMED)
    reach = optimize.field_reach_rad(config, surface)
    sites = project_from_bearing(
        surface, scattered_cap(optimize.SITES_PER_LED * config.count, reach, rng)
    )
    spirals = [
        project_from_bearing(surface, cap(config.count, half))
        for half in (np.radians(config.cap_deg), reach)
    ]
    points = (points_m.tobytes() for points_m in (sites, *spirals))
    place_m, state = optimized_places(config_of_places, *points)
    # The random stream goes on as if the search had not been cached.
    rng.bit_generator.state = state
    return place_m


# A search takes seconds; a study's trials, its costs and its report ask for the same places.
@lru_cache(maxsize=32)
def optimized_places(
    config: OptimizedConfig, sites: bytes, *spirals: bytes
) -> tuple[Floats, Mapping[str, Any]]:
    """(N, 3) read-only places of `optimized` in m, and the state of the hardware's random stream after the search.

    Parameters
    ----------
    sites, spirals
        (K, 3) points in m as bytes, because arrays have no hash
    """
    rng = random_stream(config.hardware_seed)
    points = [np.frombuffer(text).reshape(-1, 3) for text in (sites, *spirals)]
    rng.random(2 * len(points[0]))  # the numbers that the sites were drawn with
    place_m = optimize.optimize_places(config, points[0], points[1:], rng)
    place_m.flags.writeable = False
    return place_m, rng.bit_generator.state


# Geodesic sphere: LEDs at the vertices of an icosahedron with divided faces, projected on the surface. The division of
# a face is a triangular lattice. In barycentric coordinates over the face's corners, a point is (i, j, k) / (i + j + k)
# with whole numbers i, j, k >= 0:
#
#     class I   i + j + k = frequency
#     class II  i + j + k = 3 frequency / 2, and i, j, k leave the same remainder by 3
#
# (Kenner 1976, Geodesic Math and How to Use It, ch. 6 and 8; Coxeter 1971, Virus macromolecules and geodesic domes).
# With T triangles in each face the sphere has 10 T + 2 vertices: T = frequency^2 in class I, 3 frequency^2 / 4 in class
# II. Points of the flat faces are moved to the sphere along its radius, so edges differ in length: in class I between
# .85 and 1.26 of the icosahedron's edge over the frequency, in the limit of high frequencies.


CAP_SLACK = 1e-12  # relative rounding error of a vertex on the rim of the cap


def geodesic(config: GeodesicConfig, surface: Surface, rng: Generator) -> Floats:
    """LEDs at the geodesic vertices within the cap, numbered from the zenith, then by azimuth."""
    vertices = geodesic_vertices(config.frequency, config.class_)
    tilt_rad = tilts_rad(vertices)
    azimuth_rad = azimuths_rad(vertices)
    # Rounded, so that vertices of equal tilt are in the order of their azimuths.
    order = np.lexsort((np.round(azimuth_rad, 9), np.round(tilt_rad, 9)))
    order = order[tilt_rad[order] <= np.radians(config.cap_deg) * (1 + CAP_SLACK)]
    turned = azimuth_rad[order] + np.radians(config.rotation_deg)
    return project_from_bearing(surface, directions(tilt_rad[order], turned))


def geodesic_vertices(frequency: int, class_: str) -> Floats:
    """(10 T + 2, 3) unit vectors of all vertices of a geodesic sphere. The frequency is even in class II."""
    corners = icosahedron()
    # Corners with their weights: a vertex on an edge is the same from both faces.
    weights = set[tuple[tuple[int, int], ...]]()
    for face in ConvexHull(corners).simplices.tolist():
        for lattice in lattice_points(frequency, class_):
            pairs = zip(face, lattice, strict=True)
            weights.add(tuple(sorted((corner, n) for corner, n in pairs if n)))
    points = np.array(
        [sum(n * corners[corner] for corner, n in each) for each in sorted(weights)]
    )
    return normalized(points)


def lattice_points(frequency: int, class_: str) -> Iterator[tuple[int, int, int]]:
    """Yield the whole barycentric coordinates of a face's lattice points, its edges and corners included."""
    total = frequency if class_ == "I" else 3 * frequency // 2
    for i in range(total + 1):
        for j in range(total + 1 - i):
            k = total - i - j
            if class_ == "I" or i % 3 == j % 3 == k % 3:
                yield i, j, k


def icosahedron() -> Floats:
    """(12, 3) unit vectors: the zenith, five at z = 1 / sqrt 5, five at -1 / sqrt 5 between them, the nadir."""
    z = 1 / np.sqrt(5)
    ring = 2 / np.sqrt(5)
    azimuth = circle_rad(5)
    upper = around_z(ring, azimuth, z)
    lower = around_z(ring, azimuth + np.pi / 5, -z)
    return np.vstack([[0.0, 0.0, 1.0], upper, lower, [0.0, 0.0, -1.0]])
