"""Primary pair of SAA: two observed stars, the geometry of all others about them, and the gates of the direct match."""

from typing import NamedTuple

import numpy as np

from estimator.catalog.sky_index import Cells
from estimator.core import vectors
from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.identification.direct_match import angle


class Gates(NamedTuple):
    """Standard deviations of an angle between stars, a direction, and a magnitude. A gate is three of them.

    Attributes
    ----------
    separation_rad, position_rad, magnitude
        Standard deviations
    stretch
        Relative tolerance of an angle: stretch * angle is added to its gate
    """

    separation_rad: float
    position_rad: float
    magnitude: float
    stretch: float


class SearchInput(NamedTuple):
    """The observed stars, brightest first, the catalog, and the gates.

    Attributes
    ----------
    vectors_cam, vectors
        (N, 3) unit vectors of the observed stars in camera axes, and (M, 3) of the catalog in the reference frame
    magnitude_cam, magnitude
        (N,) and (M,) magnitudes, NaN if unknown
    cells
        Spatial grid of the catalog's directions
    gates
        Tolerances
    """

    vectors_cam: Floats
    magnitude_cam: Floats
    vectors: Floats
    magnitude: Floats
    cells: Cells
    gates: Gates


class Primary(NamedTuple):
    """The primary pair A, B, and the geometry of the X other stars about it.

    Attributes
    ----------
    rows
        (2,) rows of A and B
    triad
        (3, 3) axes of A and B in camera axes (see `triad`)
    midpoint
        (3,) unit vector halfway between A and B
    others
        (X,) rows of the other stars
    corner_rad, gate_rad
        (2, X) their angles from A and from B, and the gates of these angles
    sigma_rad, radius_rad
        (X,) standard deviation of the predicted place, and its gate
    area_sr
        (X,) area inside all gates
    reach_rad
        Greatest angle of an observed star from the midpoint, with a gate added
    """

    rows: Ints
    triad: Floats
    midpoint: Floats
    others: Ints
    corner_rad: Floats
    gate_rad: Floats
    sigma_rad: Floats
    radius_rad: Floats
    area_sr: Floats
    reach_rad: float


@jit
def gate_rad(gates: Gates, angle_rad: float) -> float:
    """Tolerance of an angle: three standard deviations plus the stretch."""
    return 3 * gates.separation_rad + gates.stretch * angle_rad


@jit
def triad(a: Floats, b: Floats) -> Floats:
    """Axes of two unit vectors, in rows: along a + b, a - b and their cross product.

    The rotation that maps one pair's axes to another's is the solution of Wahba's problem for two stars of equal
    weight.
    """
    rows = np.empty((3, 3))
    rows[0] = a + b
    rows[1] = a - b
    rows[2] = np.cross(b, a)
    # Normalize.
    for n in range(3):
        rows[n] /= vectors.norm(rows[n])
    return rows


@jit
def build_primary(stars: SearchInput, row_a: int, row_b: int) -> Primary:
    """The geometry of an observed pair that the direct match needs; it is the same for all assumptions of the pair.

    The thesis's position gate is 3 epsilon_position everywhere. Needelman's epsilon_position(S) includes the error
    of the pair's attitude. With the noise s, a pair of separation b rotates by sqrt(2) s / b and shifts by s /
    sqrt(2). At the distance d from its middle the variance is s^2 (1 + 1/2 + 2 d^2 / b^2), which is used here.

    Parameters
    ----------
    row_a, row_b
        Rows of the observed stars A and B
    """
    gates = stars.gates
    vectors_cam = stars.vectors_cam
    a = vectors_cam[row_a]
    b = vectors_cam[row_b]
    count = len(vectors_cam) - 2
    axes = triad(a, b)
    midpoint = axes[0]
    base_rad = angle(a, b)
    reach_rad = 0.0
    others = np.empty(count, np.int64)
    corner = np.empty((2, count))
    gate = np.empty((2, count))
    sigma = np.empty(count)
    radius = np.empty(count)
    area = np.empty(count)
    k = 0
    for n in range(len(vectors_cam)):
        x = vectors_cam[n]
        from_midpoint_rad = angle(x, midpoint)
        reach_rad = max(reach_rad, from_midpoint_rad)
        if n in (row_a, row_b):
            continue
        # The angles to A and B, and their gates.
        others[k] = n
        corner[0, k] = angle(x, a)
        corner[1, k] = angle(x, b)
        gate[0, k] = gate_rad(gates, corner[0, k])
        gate[1, k] = gate_rad(gates, corner[1, k])
        # The predicted place, and its gate.
        sigma[k] = gates.position_rad * np.sqrt(1.5 + 2 * (from_midpoint_rad / base_rad) ** 2)
        radius[k] = 3 * sigma[k] + gates.stretch * from_midpoint_rad
        # The rings about A and B, of the gates' widths, cross at X in a rhombus; its angle is that of A and B seen
        # from X.
        sides = max(corner[0, k] * corner[1, k], 1e-20)
        sine = vectors.norm(np.cross(a - x, b - x)) / sides
        rhombus = 4 * gate[0, k] * gate[1, k] / max(sine, 1e-9)
        area[k] = min(np.pi * radius[k] ** 2, rhombus)
        k += 1
    rows = np.array([row_a, row_b])
    reach_rad += gate_rad(gates, 0.0)
    return Primary(rows, axes, midpoint, others, corner, gate, sigma, radius, area, reach_rad)
