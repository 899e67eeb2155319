"""Measured points of the dome's inside: read, and fitted by a smooth surface with residuals.

The points are those of a measuring arm. A sphere is fitted first. The distance from its center is then fitted as a
function of direction: Zernike polynomials in the disc onto which Lambert's equal-area projection maps the cap,
r(u) = sum_k c_k Z_k, by linear least squares (`fit`). `fit_ellipsoid` gives the nearest ellipsoid, for estimators
that know no other surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from skysim.core.errors import InputError
from skysim.core.types import Floats

UNIT_M = {"m": 1.0, "cm": 0.01, "mm": 1e-3, "in": 0.0254}
POINTS_PER_TERM = 3  # fewer would leave too few degrees of freedom to judge the fit
WORST_CONDITION = 1e3  # of the fit; points spread evenly over the disc have about 5
SECTORS = 12  # of azimuth, in each of which points must reach the surface's edge
AROUND = 72  # points on the edge of the fitted surface


class Ball(NamedTuple):
    """The sphere nearest to points: its center (3,), radius, and the rms of the points' distances from it."""

    centre_m: Floats
    radius_m: float
    rms_m: float


class Believed(NamedTuple):
    """The ellipsoid, with axes along the lab's, that is nearest to a surface.

    centre_m, semi_axes_m : (3,) each
    rms_m                 : of the surface's distances from it, over the surface within its rim as the bearing sees it
    """

    centre_m: Floats
    semi_axes_m: Floats
    rms_m: float


def fit_sphere(points_m: Floats) -> Ball:
    """The sphere with the least sum of squared distances from points (N, 3), iterated from the algebraic fit.

    Raises ValueError for points in a plane.
    """
    middle, size = points_m.mean(axis=0), np.ptp(points_m, axis=0).max()
    near = (points_m - middle) / size
    # Algebraic fit, linear in the center c and r^2 - |c|^2: |x|^2 = 2 c . x + (r^2 - |c|^2).
    table = np.column_stack([2 * near, np.ones(len(near))])
    first, _, rank, _ = np.linalg.lstsq(table, np.sum(near**2, axis=1), rcond=1e-9)
    if rank < 4:
        raise ValueError("the points lie in a plane or on a line")
    radius = math.sqrt(first[3] + first[:3] @ first[:3])

    def apart(told: Floats) -> Floats:
        return np.asarray(np.linalg.norm(near - told[:3], axis=1) - told[3])

    start = np.append(first[:3], radius)
    found = least_squares(apart, start, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    rms_m = float(size * np.sqrt(np.mean(found.fun**2)))
    return Ball(middle + size * found.x[:3], float(size * found.x[3]), rms_m)


def fit_ellipsoid(points_m: Floats) -> Believed:
    """The ellipsoid, with axes along the lab's, nearest to points: least squares of (|w| - 1) / |grad |w||.

    points_m : (N, 3), N > 6;  w = (x - center) / semi_axes. To first order the residual is the distance.
    """
    ball = fit_sphere(points_m)

    def apart_m(told: Floats) -> Floats:
        axes = np.exp(told[3:]) * ball.radius_m  # logarithms as parameters keep the semi-axes positive
        w = (points_m - ball.centre_m - ball.radius_m * told[:3]) / axes
        size = np.linalg.norm(w, axis=1)
        return np.asarray((size - 1) * size / np.linalg.norm(w / axes, axis=1))

    found = least_squares(
        apart_m, np.zeros(6), method="lm", xtol=1e-13, ftol=1e-13, gtol=1e-13, max_nfev=4000
    )
    centre_m = ball.centre_m + ball.radius_m * found.x[:3]
    rms_m = float(np.sqrt(np.mean(found.fun**2)))
    return Believed(centre_m, np.exp(found.x[3:]) * ball.radius_m, rms_m)


def zernike(degree: int, disc: Floats) -> tuple[Floats, Floats]:
    """Zernike polynomials over the unit disc to a degree, (N, K), and their gradients, (N, K, 2).

    disc : (N, 2). K = (degree + 1)(degree + 2) / 2; none exceeds 1 in the disc. The first is 1.
    Z = Re or Im of w^m R(q), w = x + iy, q = |w|^2,
    R(q) = sum_k (-1)^k (n - k)! / (k! ((n + m)/2 - k)! ((n - m)/2 - k)!) q^((n - m)/2 - k)  (Born & Wolf, sec. 9.2.1)
    """
    w = disc[:, 0] + 1j * disc[:, 1]
    q = np.abs(w) ** 2
    values, slopes = [], []
    for n in range(degree + 1):
        for m in range(n % 2, n + 1, 2):
            half = (n - m) // 2
            powers = [
                (-1) ** k * math.comb(n - k, k) * math.comb(n - 2 * k, half - k) for k in range(half + 1)
            ]
            radial, steep = np.polyval(powers, q), np.polyval(np.polyder(powers), q)
            turn = m * w ** max(m - 1, 0) * radial
            value = w**m * radial
            slope = [turn + w**m * steep * 2 * disc[:, 0], 1j * turn + w**m * steep * 2 * disc[:, 1]]
            for part in (np.real, np.imag)[: 1 + (m > 0)]:
                values.append(part(value))
                slopes.append(np.stack([part(one) for one in slope], axis=1))
    return np.stack(values, axis=1), np.stack(slopes, axis=1)


@dataclass(frozen=True, slots=True)
class Zernike:
    """Radius over a cap of directions about +z: Zernike polynomials in the cap's equal-area disc.

    The disc's radius is sin(angle / 2) / sin(half / 2), so the polynomials are orthogonal over the cap too.

    half_rad     : the cap's half angle, 1 in the disc; beyond it the radius keeps its value at the edge
    cover_rad    : angle to which the points reach in every azimuth
    coefficient_m : (K,)
    """

    half_rad: float
    cover_rad: float
    degree: int
    coefficient_m: Floats

    @property
    def most_m(self) -> float:
        """Upper bound of the radius: no polynomial exceeds 1."""
        return float(np.abs(self.coefficient_m).sum())

    def at(self, unit: Floats) -> tuple[Floats, Floats]:
        """(N,) radius over (N, 3) unit vectors, and (N, 3) its gradient."""
        disc, stretch, fall = to_disc(unit, self.half_rad)
        out = np.maximum(np.linalg.norm(disc, axis=1), 1.0)
        value, slope = zernike(self.degree, disc / out[:, None])
        along = np.where(out > 1, 0.0, np.einsum("nkj,k->jn", slope, self.coefficient_m))
        gradient = np.column_stack([*(along * stretch), np.sum(along * disc.T, axis=0) * fall])
        return value @ self.coefficient_m, gradient


def to_disc(unit: Floats, half_rad: float) -> tuple[Floats, Floats, Floats]:
    """Lambert's equal-area disc of a cap: (N, 2) x, y of unit vectors (N, 3) times (N,) k; k; (N,) d ln k / dz.

    k = 1 / (sqrt(2 (1 + z)) sin(half / 2)). It diverges straight down and is limited there.
    """
    up = np.maximum(1 + unit[:, 2], 1e-12)
    stretch = 1 / (np.sqrt(2 * up) * math.sin(half_rad / 2))
    return unit[:, :2] * stretch[:, None], stretch, -0.5 / up


@dataclass(frozen=True, slots=True)
class Survey:
    """Measured points and the smooth surface fitted to them.

    centre_m   : (3,) of their best sphere, in the points' own frame
    law        : radius over direction about it
    residual_m : (N,) points' radii minus the surface's
    ball       : that best sphere, with its own rms
    """

    centre_m: Floats
    law: Zernike
    residual_m: Floats
    ball: Ball

    @property
    def rms_m(self) -> float:
        """Rms of the residuals. Noise of sigma leaves sigma sqrt(1 - K / N) here, sigma sqrt(K / N) in the surface."""
        return float(np.sqrt(np.mean(self.residual_m**2)))

    @property
    def worst_m(self) -> float:
        """The greatest absolute residual."""
        return float(np.abs(self.residual_m).max())

    def edge_m(self) -> Floats:
        """(M, 3) points on the edge of the area that the points cover, relative to its center."""
        azimuth = np.arange(AROUND) * (2 * np.pi / AROUND)
        out, up = np.sin(self.law.cover_rad), np.full(AROUND, np.cos(self.law.cover_rad))
        unit = np.column_stack([out * np.cos(azimuth), out * np.sin(azimuth), up])
        return np.asarray(self.law.at(unit)[0][:, None] * unit)


def read(file: str, unit: str) -> Floats:
    """(N, 3) points, m, of a file: comments (#), a line of names, then lines of x, y, z. Raises InputError."""
    try:
        lines = Path(file).read_text(encoding="utf-8").splitlines()
        rows = [line for line in lines if line.strip() and not line.startswith("#")][1:]
        if not rows:
            raise ValueError("it has no points")
        points = np.loadtxt(rows, delimiter=",", ndmin=2)
        if points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError("not three finite numbers in each line")
    except (OSError, ValueError) as error:
        raise InputError(
            f"light.surface.file: {file}: allowed: a line of names, then lines of x,y,z ({error})"
        ) from None
    return points * UNIT_M[unit]


def fit(points_m: Floats, degree: int, file: str) -> Survey:
    """Smooth surface fitted to points of a dome whose axis is about +z: linear least squares in the radius.

    points_m : (N, 3) in the arm's own frame
    degree   : of the polynomials over direction, seen from the center of the points' best sphere
    file     : to name in messages
    Raises InputError for too few points, for points in a plane, and if the points leave parts of the surface bare.
    """
    terms = (degree + 1) * (degree + 2) // 2
    place = f"light.surface.file: {file}: "
    if len(points_m) < max(POINTS_PER_TERM * terms, 8):
        need = max(POINTS_PER_TERM * terms, 8)
        raise InputError(f"{place}{len(points_m)} points; allowed: at least {need} for degree {degree}")
    try:
        ball = fit_sphere(points_m)
    except ValueError as error:
        raise InputError(f"{place}{error}; allowed: points of a dome (a panel is kind flat)") from None
    seen = points_m - ball.centre_m
    radius_m = np.linalg.norm(seen, axis=1)
    unit = seen / radius_m[:, None]
    angle = np.arctan2(np.hypot(unit[:, 0], unit[:, 1]), unit[:, 2])
    sector = (
        np.floor((np.arctan2(unit[:, 1], unit[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    )
    # Covered angle: of the farthest point in each sector of azimuth, the least.
    cover = min(float(angle[sector == one].max(initial=0.0)) for one in range(SECTORS))
    half = float(angle.max())
    table, _ = zernike(degree, to_disc(unit, half)[0])
    coefficient, _, _, sizes = np.linalg.lstsq(table, radius_m)
    # A large ratio of singular values means polynomials that the points do not determine: an area without points.
    if cover < half / 2 or sizes[-1] * WORST_CONDITION < sizes[0]:
        raise InputError(
            f"{place}the points leave parts of the dome bare; allowed: points all around +z, or a degree below {degree}"
        )
    return Survey(
        ball.centre_m, Zernike(half, cover, degree, coefficient), radius_m - table @ coefficient, ball
    )
