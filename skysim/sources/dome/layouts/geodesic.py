"""LEDs at the vertices of a geodesic sphere: an icosahedron with divided faces, projected on the surface.

The division of a face is a triangular lattice. In barycentric coordinates over the face's corners, a point is
(i, j, k) / (i + j + k) with whole numbers i, j, k >= 0:

    class I   i + j + k = frequency
    class II  i + j + k = 3 frequency / 2, and i, j, k leave the same remainder by 3

(Kenner 1976, Geodesic Math and How to Use It, ch. 6 and 8; Coxeter 1971, Virus macromolecules and geodesic domes).
With T triangles in each face the sphere has 10 T + 2 vertices: T = frequency^2 in class I, 3 frequency^2 / 4 in class
II. Points of the flat faces are moved to the sphere along its radius, so edges differ in length: in class I between
.85 and 1.26 of the icosahedron's edge over the frequency, in the limit of high frequencies.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from skysim.core.types import Floats, Sources
from skysim.scene.sections.layouts import GeodesicConfig
from skysim.scene.sections.leds import LedConfig
from skysim.sources.dome.layouts.placing import lit_sources, project_from_bearing
from skysim.sources.dome.shell.surface import Surface
from skysim.sources.photometry import Band

CAP_SLACK = 1e-12  # relative rounding of a vertex on the rim of the cap


def geodesic(config: GeodesicConfig, surface: Surface, led: LedConfig, band: Band) -> Sources:
    """LEDs at the geodesic vertices within the cap, numbered from the zenith, then by azimuth."""
    vertices = geodesic_vertices(config.frequency, config.class_)
    tilt_rad = np.arctan2(np.hypot(vertices[:, 0], vertices[:, 1]), vertices[:, 2])
    azimuth_rad = np.arctan2(vertices[:, 1], vertices[:, 0])
    order = np.lexsort((np.round(azimuth_rad, 9), np.round(tilt_rad, 9)))
    order = order[tilt_rad[order] <= np.radians(config.cap_deg) * (1 + CAP_SLACK)]
    turned = azimuth_rad[order] + np.radians(config.rotation_deg)
    ring = np.sin(tilt_rad[order])
    z = np.cos(tilt_rad[order])
    directions = np.column_stack([ring * np.cos(turned), ring * np.sin(turned), z])
    return lit_sources(config, surface, project_from_bearing(surface, directions), led, band)


def geodesic_vertices(frequency: int, class_: str) -> Floats:
    """(10 T + 2, 3) unit vectors of all vertices; see the module's docstring. frequency is even in class II."""
    corners = icosahedron()
    weights: set[tuple[tuple[int, int], ...]] = (
        set()
    )  # corners with their weights: the same from every face
    for face in icosahedron_faces():
        for lattice in lattice_points(frequency, class_):
            weights.add(
                tuple(sorted((corner, n) for corner, n in zip(face, lattice, strict=True) if n))
            )
    points = np.array([sum(n * corners[corner] for corner, n in each) for each in sorted(weights)])
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def lattice_points(frequency: int, class_: str) -> Iterator[tuple[int, int, int]]:
    """Whole barycentric coordinates of a face's lattice points, its edges and corners included."""
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
    azimuth = np.arange(5) * (2 * np.pi / 5)
    upper = np.column_stack([ring * np.cos(azimuth), ring * np.sin(azimuth), np.full(5, z)])
    between = azimuth + np.pi / 5
    lower = np.column_stack([ring * np.cos(between), ring * np.sin(between), np.full(5, -z)])
    return np.vstack([[0.0, 0.0, 1.0], upper, lower, [0.0, 0.0, -1.0]])


def icosahedron_faces() -> list[tuple[int, int, int]]:
    """The corners of its 20 faces, as rows of `icosahedron`."""
    faces = []
    for n in range(5):
        following = (n + 1) % 5
        upper = 1 + n
        next_upper = 1 + following
        lower = 6 + n
        next_lower = 6 + following
        faces += [(0, upper, next_upper), (upper, lower, next_upper)]
        faces += [(lower, next_lower, next_upper), (11, lower, next_lower)]
    return faces
