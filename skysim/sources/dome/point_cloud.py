"""Measured points of the dome's inside: read, and fitted by a smooth surface with residuals.

The points are those of a measuring arm.

1. A sphere is fitted (`fit_sphere`).
2. The distance from its center is fitted as a function of direction, r(u) = sum_k c_k Z_k, by linear least squares
   (`fit`). The Z_k are Zernike polynomials in the disk onto which Lambert's equal-area projection maps the cap.
3. `fit_ellipsoid` gives the nearest ellipsoid, for estimators that model no other surface.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from skysim.core.constants import INCH_M
from skysim.core.errors import InputError, errors_within
from skysim.core.text import cells_of, read_lines, to_numbers
from skysim.core.types import (
    Floats,
    around_z,
    azimuths_rad,
    frozen,
    homogeneous,
    lengths,
    polar_rad,
)

KEY = "light.surface.file"  # names the file of points
UNIT_M = {"m": 1.0, "cm": 0.01, "mm": 1e-3, "in": INCH_M}
POINTS_PER_TERM = 3  # fewer would leave too few degrees of freedom to judge the fit
MAX_CONDITION = 1e3  # of the fit; points spread evenly over the disk have about 5
SECTORS = 12  # of azimuth, in each of which points must reach the surface's edge
EDGE_POINTS = 72  # points on the edge of the fitted surface


class FittedSphere(NamedTuple):
    """The sphere nearest to points: its center (3,), its radius, and the rms of the points' distances from it."""

    center_m: Floats
    radius_m: float
    rms_m: float


class FittedEllipsoid(NamedTuple):
    """The ellipsoid, with axes along the lab's, that is nearest to a surface.

    Attributes
    ----------
    center_m, semi_axes_m
        (3,) each
    rms_m
        Rms of the surface's distances from the ellipsoid, over the surface within its rim as the bearing sees it
    """

    center_m: Floats
    semi_axes_m: Floats
    rms_m: float


def fit_sphere(points_m: Floats) -> FittedSphere:
    """The sphere with the least sum of squared distances from points (N, 3).

    1. Algebraic fit, linear in the center c and r^2 - |c|^2: |x|^2 = 2 c . x + (r^2 - |c|^2).
    2. Least squares of |x - c| - r, iterated from there.

    Raises
    ------
    ValueError
        For points in a plane.
    """
    # Points are scaled to 1 about their mean, for well-conditioned equations.
    mean_m = points_m.mean(axis=0)
    scale_m = np.ptp(points_m, axis=0).max()
    scaled = (points_m - mean_m) / scale_m
    # 1.
    design = homogeneous(2 * scaled, 1.0)
    algebraic, _, rank, _ = np.linalg.lstsq(design, np.sum(scaled**2, axis=1), rcond=1e-9)
    if rank < 4:
        raise ValueError("the points lie in a plane or on a line")
    radius = math.sqrt(algebraic[3] + algebraic[:3] @ algebraic[:3])

    # 2.
    def residual(parameters: Floats) -> Floats:
        return lengths(scaled - parameters[:3]) - parameters[3]

    start = np.append(algebraic[:3], radius)
    solution = scipy.optimize.least_squares(
        residual, start, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    rms_m = float(scale_m * np.sqrt(np.mean(solution.fun**2)))
    return FittedSphere(
        mean_m + scale_m * solution.x[:3], float(scale_m * solution.x[3]), rms_m
    )


def fit_ellipsoid(points_m: Floats) -> FittedEllipsoid:
    """The ellipsoid, with axes along the lab's, nearest to points: least squares of (|w| - 1) / |grad |w||.

    With w = (x - center) / semi_axes the residual is, to first order, the distance.

    Parameters
    ----------
    points_m
        (N, 3), N > 6
    """
    # The start is the nearest sphere; parameters are relative to it.
    sphere = fit_sphere(points_m)

    def residual_m(parameters: Floats) -> Floats:
        # Logarithms as parameters keep the semi-axes positive.
        axes = np.exp(parameters[3:]) * sphere.radius_m
        w = (points_m - sphere.center_m - sphere.radius_m * parameters[:3]) / axes
        norm = lengths(w)
        return (norm - 1) * norm / lengths(w / axes)

    solution = scipy.optimize.least_squares(
        residual_m,
        np.zeros(6),
        method="lm",
        xtol=1e-13,
        ftol=1e-13,
        gtol=1e-13,
        max_nfev=4000,
    )
    center_m = sphere.center_m + sphere.radius_m * solution.x[:3]
    rms_m = float(np.sqrt(np.mean(solution.fun**2)))
    return FittedEllipsoid(center_m, np.exp(solution.x[3:]) * sphere.radius_m, rms_m)


def zernike(degree: int, disk: Floats) -> tuple[Floats, Floats]:
    """Zernike polynomials over the unit disk to a degree, (N, K), and their gradients, (N, K, 2).

    Z = Re or Im of w^m R(q), with w = x + iy, q = |w|^2 and
    R(q) = sum_k (-1)^k (n - k)! / (k! ((n + m)/2 - k)! ((n - m)/2 - k)!) q^((n - m)/2 - k)  (Born & Wolf, sec. 9.2.1).
    K = (degree + 1)(degree + 2) / 2. The first is 1, and none exceeds 1 in the disk.

    Parameters
    ----------
    disk
        (N, 2) places x, y in the disk
    """
    w = disk[:, 0] + 1j * disk[:, 1]
    q = np.abs(w) ** 2
    values = []
    slopes = []
    for n in range(degree + 1):
        for m in range(n % 2, n + 1, 2):
            # Coefficients of R(q), and the polynomial with its derivative.
            pairs = (n - m) // 2
            powers = [
                (-1) ** k * math.comb(n - k, k) * math.comb(n - 2 * k, pairs - k)
                for k in range(pairs + 1)
            ]
            radial = np.polyval(powers, q)
            radial_slope = np.polyval(np.polyder(powers), q)
            # d(w^m R)/dx = m w^(m - 1) R + w^m R' 2 x, and likewise i m w^(m - 1) R + w^m R' 2 y.
            angular = m * w ** max(m - 1, 0) * radial
            value = w**m * radial
            slope = [
                angular + w**m * radial_slope * 2 * disk[:, 0],
                1j * angular + w**m * radial_slope * 2 * disk[:, 1],
            ]
            # For m = 0 there is no imaginary part.
            for component in (np.real, np.imag)[: 1 + (m > 0)]:
                values.append(component(value))
                slopes.append(
                    np.stack([component(derivative) for derivative in slope], axis=1)
                )
    return np.stack(values, axis=1), np.stack(slopes, axis=1)


@frozen
class Zernike:
    """Radius over a cap of directions about +z: Zernike polynomials in the cap's equal-area disk.

    The disk's radius is sin(angle / 2) / sin(half / 2), so the polynomials are orthogonal over the cap too.

    Attributes
    ----------
    half_rad
        Half angle of the cap, 1 in the disk; beyond it the radius keeps its value at the edge
    cover_rad
        Angle up to which there are points in every azimuth
    coefficient_m
        (K,) coefficients c_k
    """

    half_rad: float
    cover_rad: float
    degree: int
    coefficient_m: Floats

    @property
    def max_m(self) -> float:
        """Upper bound of the radius: no polynomial exceeds 1."""
        return float(np.abs(self.coefficient_m).sum())

    def evaluate(self, unit: Floats) -> tuple[Floats, Floats]:
        """(N,) radius over (N, 3) unit vectors, and (N, 3) its gradient."""
        # Directions beyond the cap get the radius of its edge.
        disk, stretch, log_slope = to_disk(unit, self.half_rad)
        distance = np.maximum(lengths(disk), 1.0)
        value, slope = zernike(self.degree, disk / distance[:, None])
        along = np.where(distance > 1, 0.0, np.einsum("nkj,k->jn", slope, self.coefficient_m))
        gradient = np.column_stack(
            [*(along * stretch), np.sum(along * disk.T, axis=0) * log_slope]
        )
        return value @ self.coefficient_m, gradient


def to_disk(unit: Floats, half_rad: float) -> tuple[Floats, Floats, Floats]:
    """Lambert's equal-area disk of a cap: place (x, y) k of a unit vector (x, y, z).

    k = 1 / (sqrt(2 (1 + z)) sin(half / 2)). It diverges straight down and is limited there.

    Returns
    -------
    tuple
        (N, 2) places in the disk, (N,) k, and (N,) d ln k / dz
    """
    up = np.maximum(1 + unit[:, 2], 1e-12)
    stretch = 1 / (np.sqrt(2 * up) * math.sin(half_rad / 2))
    return unit[:, :2] * stretch[:, None], stretch, -0.5 / up


@frozen
class SurfaceFit:
    """Measured points and the smooth surface fitted to them.

    Attributes
    ----------
    center_m
        (3,) center of the points' best sphere, in the points' own frame
    radius
        Radius over direction about that center
    residual_m
        (N,) radii of the points minus the radii of the surface
    sphere
        The best sphere, with its own rms
    """

    center_m: Floats
    radius: Zernike
    residual_m: Floats
    sphere: FittedSphere

    @property
    def rms_m(self) -> float:
        """Rms of the residuals. Noise of sigma leaves sigma sqrt(1 - K / N) here, sigma sqrt(K / N) in the surface."""
        return float(np.sqrt(np.mean(self.residual_m**2)))

    @property
    def max_residual_m(self) -> float:
        """The greatest absolute residual."""
        return float(np.abs(self.residual_m).max())

    def edge_m(self) -> Floats:
        """(M, 3) points on the edge of the area that the points cover, relative to its center."""
        azimuth = np.arange(EDGE_POINTS) * (2 * np.pi / EDGE_POINTS)
        cover_rad = self.radius.cover_rad
        unit = around_z(np.sin(cover_rad), azimuth, np.cos(cover_rad))
        return self.radius.evaluate(unit)[0][:, None] * unit


def read(file: str, unit: str) -> Floats:
    """(N, 3) points, m, of a file: comments (#), a line of names, then lines of x, y, z. Raises InputError."""
    with errors_within(KEY):
        rows = cells_of(read_lines(Path(file)))[1:]
        return to_numbers(file, rows, 3) * UNIT_M[unit]


def covered_rad(unit: Floats) -> tuple[float, float]:
    """Angles from +z up to which directions (N, 3) cover all azimuths, and of the farthest direction."""
    angle = polar_rad(unit)
    azimuth = azimuths_rad(unit)
    sector = np.floor((azimuth / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    # Of the farthest point in each sector of azimuth, the least.
    farthest = [float(angle[sector == n].max(initial=0.0)) for n in range(SECTORS)]
    return min(farthest), float(angle.max())


def fit(points_m: Floats, degree: int, file: str) -> SurfaceFit:
    """Smooth surface fitted to points of a dome whose axis is about +z: linear least squares in the radius.

    1. Best sphere of the points.
    2. Directions and distances of the points from its center; angle up to which they cover the cap.
    3. Zernike polynomials in the cap's disk, by least squares.
    4. Refuse points that leave a part of the surface open.

    Parameters
    ----------
    points_m
        (N, 3) in the arm's own frame
    degree
        Degree of the polynomials over direction, seen from the center of the points' best sphere
    file
        Name of the file, for messages

    Raises
    ------
    InputError
        For too few points, for points in a plane, and if parts of the surface have no points.
    """
    terms = (degree + 1) * (degree + 2) // 2
    needed = max(POINTS_PER_TERM * terms, 8)
    if len(points_m) < needed:
        raise InputError(
            KEY, f"{file}: {len(points_m)} points", f"at least {needed} for degree {degree}"
        )
    # 1.
    try:
        sphere = fit_sphere(points_m)
    except ValueError as error:
        raise InputError(
            KEY, f"{file}: {error}", "points of a dome (a panel is kind flat)"
        ) from None
    # 2.
    relative_m = points_m - sphere.center_m
    radius_m = np.linalg.norm(relative_m, axis=1)
    unit = relative_m / radius_m[:, None]
    cover_rad, half_rad = covered_rad(unit)
    # 3.
    design, _ = zernike(degree, to_disk(unit, half_rad)[0])
    coefficient, _, _, singular = np.linalg.lstsq(design, radius_m)
    # 4. A large ratio of singular values means polynomials that the points do not determine: an area without points.
    if cover_rad < half_rad / 2 or singular[-1] * MAX_CONDITION < singular[0]:
        raise InputError(
            KEY,
            f"{file}: parts of the dome have no points",
            f"points all around +z, or a degree below {degree}",
        )
    return SurfaceFit(
        sphere.center_m,
        Zernike(half_rad, cover_rad, degree, coefficient),
        radius_m - design @ coefficient,
        sphere,
    )
