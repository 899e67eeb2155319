"""Sunlight from moons, planets and asteroids: V magnitudes by phase, and how brightness is distributed over a disc.

The disc's plane is spanned by x, toward the Sun (the bright limb), and y; its rim is the unit circle. At (x, y) the
cosine of the emission angle is mu = sqrt(1 - x^2 - y^2), and at a phase angle a that of the incidence angle is
mu0 = x sin a + mu cos a; the terminator, mu0 = 0, is half an ellipse of semi-axes 1 and |cos a|.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from math import cos, sin, sqrt
from typing import Any, NamedTuple

import numba
import numpy as np

from skysim.core.constants import AU_KM, JULIAN_YEAR_DAY, SUN_V_MAG
from skysim.core.jit import jit
from skysim.core.time import J2000_JD
from skysim.core.types import Floats
from skysim.sources.ephemeris import Place
from skysim.sources.stars import directions

# Laws of `brightness`.
LIMB_DARKENED = 0
LOMMEL_SEELIGER = 1
LAMBERT = 2
ACROSS = 12  # elements on the diameter of a small disc
SAMPLES = 16  # points across an element at which the brightness is sampled
RIM = 20  # number of cells next to the rim in which the mean over a cell matters
# Phases of small discs are rounded to this, so that frames share their elements.
PHASE_STEP_DEG = 0.05


@jit
def brightness(law: int, mu: float, mu0: float) -> float:
    """Relative brightness of a surface by one of three laws.

    LIMB_DARKENED: the Sun at 550 nm, 0.30 + 0.93 mu - 0.23 mu^2 (Cox 2000, Allen's Astrophysical Quantities).
    LOMMEL_SEELIGER: a dark rough surface, in which light is scattered once, mu0 / (mu0 + mu) (Hapke 1981, JGR 86,
    3039); the full disc is uniform, as the full Moon's is; the maria are left out.
    LAMBERT: a bright cloud deck, in which light is scattered many times, mu0.
    """
    if law == LIMB_DARKENED:
        return 0.30 + 0.93 * mu - 0.23 * mu**2
    if mu0 <= 0:
        return 0.0
    return mu0 / (mu0 + mu) if law == LOMMEL_SEELIGER else mu0


class DiscSurface(NamedTuple):
    """How a disc shines.

    Attributes
    ----------
    law
        Law of `brightness`
    phase_rad
        Phase angle
    earthshine
        Ratio of the light of the disc lit from the observer's side to that of the sunlit disc
    """

    law: int
    phase_rad: float
    earthshine: float = 0.0


def light_map(surface: DiscSurface, axis: Floats) -> Floats:
    """Fractions of the disc's light at the points of a square lattice that covers it, (n, n), [y, x]; their sum is 1.

    Parameters
    ----------
    axis
        (n,) evenly spaced coordinates of the lattice in both directions, in units of the disc's radius
    """
    step = axis[1] - axis[0]
    slope = sin(surface.phase_rad), cos(surface.phase_rad)
    sunlit, earthlit = np.vectorize(cell_light)(
        surface.law, *slope, axis, axis[:, None], step, inner_radius2(step)
    )
    light = sunlit / max(float(sunlit.sum()), 1e-300)
    if surface.earthshine:
        light += earthlit * (surface.earthshine / float(earthlit.sum()))
        light /= 1 + surface.earthshine
    return light


@jit
def inner_radius2(step: float) -> float:
    """Square of the radius up to which the brightness at a cell's center is taken for its mean."""
    return max(1 - RIM * step, 0.0) ** 2


@jit
def cell_light(
    law: int, sine: float, cosine: float, x: float, y: float, step: float, inner: float
) -> tuple[float, float]:
    """Light of a cell of width `step` at (x, y): its mean brightness times its part on the disc.

    Near the rim mu varies as a square root: the mean of mu over the cell's radial extent on the disc, from m1 inside
    to m2, is 2/3 (m1^2 + m1 m2 + m2^2) / (m1 + m2), as mu^2 is linear in the radius there.

    Returns the light for the Sun at the phase angle with this sine and cosine, and for a light at the observer.
    """
    rho2 = x * x + y * y
    if rho2 > (1 + step / 2) ** 2:
        return 0.0, 0.0
    covered = 1.0
    inward = 1.0
    mu = 0.0
    # Away from the rim the center's brightness is the mean.
    if rho2 < inner:
        mu = sqrt(1 - rho2)
    else:
        # At the rim: the part of the cell on the disc, the mean of mu, and the center of that part.
        rho = sqrt(rho2)
        covered = min(max(0.5 + (1 - rho) / step, 0.0), 1.0)
        m1 = sqrt(max(1 - max(rho - step / 2, 0.0) ** 2, 0.0))
        m2 = sqrt(max(1 - (rho + step / 2) ** 2, 0.0))
        mu = 2 / 3 * (m1 * m1 + m1 * m2 + m2 * m2) / (m1 + m2) if m1 > 0 else 0.0
        inward = 1.0 if covered == 1 else (1 + rho - step / 2) / (2 * rho)
    mu0 = inward * x * sine + mu * cosine
    return covered * brightness(law, mu, mu0), covered * brightness(law, mu, mu)


class DiscElements(NamedTuple):
    """M elements of a disc: centers of light (M, 2) in units of its radius, and fractions of the light (M,)."""

    xy: Floats
    share: Floats

    def merged(self) -> "DiscElements":
        """One element with all light, at the center of light."""
        return DiscElements((self.share @ self.xy)[None], np.array([self.share.sum()]))


def disc_elements(surface: DiscSurface) -> DiscElements:
    """A small disc as elements on a square lattice, ACROSS on its diameter, without the dark ones.

    An element has the light of its cell and is at the center of that light. Phase and earthshine are rounded.
    """
    phase_steps = round(np.degrees(surface.phase_rad) / PHASE_STEP_DEG)
    return _elements(surface.law, phase_steps, float(f"{surface.earthshine:.2g}"))


@lru_cache(maxsize=32)
def _elements(law: int, phase_steps: int, earthshine: float) -> DiscElements:
    """`disc_elements` for a phase angle in steps of PHASE_STEP_DEG; cached."""
    fine = ACROSS * SAMPLES
    axis = np.asarray((np.arange(fine) + 0.5) * (2 / fine) - 1, float)
    phase_rad = float(np.radians(phase_steps * PHASE_STEP_DEG))
    light = light_map(DiscSurface(law, phase_rad, earthshine), axis)
    # Light and its first moments in each element.
    cells = (ACROSS, SAMPLES, ACROSS, SAMPLES)
    weighted = (light, light * axis, light * axis[:, None])
    share, share_x, share_y = (
        one.reshape(cells).sum(axis=(1, 3)).ravel() for one in weighted
    )
    lit = share > 0
    center = np.column_stack([share_x[lit], share_y[lit]]) / share[lit, None]
    return DiscElements(center, share[lit])


# A large disc: its light on a lattice of sub-pixels, with several samples per point where that is needed.


REACH = 3  # a sample's light is shared among this many points to either side


def lattice_light(
    surface: DiscSurface,
    count: int,
    subsamples: int,
    axis_px: Floats,
    radius_from_px: Floats,
    shown: Any,
) -> Floats:
    """Map a disc's light on a square lattice of points, [y, x]; the disc must not reach the lattice's edge.

    1. Sample the brightness at `subsamples` places per point in both directions (`cell_light`).
    2. Share each sample's light among the columns (`_light_rows`), then among the rows (`_add_columns`).
    3. Scale to unit sum of what the disc emits, hidden or not: sunlight 1 / (1 + e) and earthshine e / (1 + e).

    Parameters
    ----------
    axis_px
        (count * subsamples,) evenly spaced coordinates of the samples in both directions, px from the disc's center
    radius_from_px
        (2, 2) coordinates on the disc, in units of its radius, from pixels
    shown
        (len(axis_px), len(axis_px)) fraction of each sample that nothing hides; (0, 0) where nothing is hidden

    Returns
    -------
    Floats
        (count, count) fractions of the disc's light
    """
    fine = len(axis_px)
    weights = sharing_weights(subsamples)
    # Side of a sample's cell in units of the disc's radius.
    step = float(axis_px[1] - axis_px[0]) * math.sqrt(
        abs(float(np.linalg.det(radius_from_px)))
    )
    matrix = np.ascontiguousarray(radius_from_px)
    rows = np.empty((2 if surface.earthshine else 1, fine, count))
    totals = np.empty((fine, 2))
    # 1. and 2. Sunlight and earthshine apart: each is scaled by its own sum.
    _light_rows(
        rows,
        totals,
        surface.law,
        surface.phase_rad,
        axis_px,
        matrix,
        step,
        weights,
        shown,
    )
    # 3. The sum may be 0 for a vanishing crescent.
    light = np.zeros((count, count))
    of_all = (1 + surface.earthshine) * np.maximum(totals.sum(axis=0), 1e-300)
    scales = np.array([1.0, surface.earthshine]) / of_all
    for one, scale in zip(rows, scales, strict=False):
        _add_columns(light, one, weights, scale)
    return light


def sharing_weights(subsamples: int) -> Floats:
    """(subsamples, 2 REACH + 1) weights of a sample's light at the points -REACH to REACH from its own.

    Linear weights share the light between the two points next to a sample: a triangular filter, whose spectrum sinc^2
    suppresses the frequencies that the lattice folds back. Second differences D = -delta^2 undo it at the lower
    frequencies: 1 / sinc^2 = 1 + D / 12 + D^2 / 90 + ...
    """
    # The triangle's weights at the points before, at and after the sample's own.
    offset = (np.arange(subsamples) + 0.5) / subsamples - 0.5
    linear = np.stack(
        [np.maximum(-offset, 0), 1 - np.abs(offset), np.maximum(offset, 0)], axis=1
    )
    # 1 + D / 12 + D^2 / 90 as weights of the points -2 to 2.
    second = np.array([-1.0, 2.0, -1.0])
    undone = np.convolve(second, second) / 90
    undone[1:4] += second / 12
    undone[2] += 1
    return np.stack([np.convolve(row, undone) for row in linear])


@jit(parallel=True)
def _light_rows(
    rows: Any,
    totals: Any,
    law: int,
    phase_rad: float,
    axis_px: Floats,
    matrix: Floats,
    step: float,
    weights: Floats,
    shown: Any,
) -> None:
    """Light of each row of samples, shared among the lattice's columns.

    Parameters
    ----------
    rows
        (1 or 2, fine, count) receive the light from the Sun and, if two, from the observer's side (earthshine)
    totals
        (fine, 2) receive the sums of each row, hidden light included
    """
    count = rows.shape[2]
    subsamples = len(weights)
    sine = sin(phase_rad)
    cosine = cos(phase_rad)
    inner = inner_radius2(step)
    masked = len(shown) > 0
    for j in numba.prange(len(axis_px)):
        # The margin spares tests for the ends of the row.
        own = np.zeros((2, subsamples, count + 2 * REACH))
        of_sun = of_earth = 0.0
        for k in range(count):
            for m in range(subsamples):
                i = k * subsamples + m
                # The sample's coordinates on the disc, in units of its radius.
                x = matrix[0, 0] * axis_px[i] + matrix[0, 1] * axis_px[j]
                y = matrix[1, 0] * axis_px[i] + matrix[1, 1] * axis_px[j]
                from_sun, from_earth = cell_light(law, sine, cosine, x, y, step, inner)
                of_sun += from_sun
                of_earth += from_earth
                part = shown[j, i] if masked else 1.0
                own[0, m, k + REACH] = part * from_sun
                own[1, m, k + REACH] = part * from_earth
        totals[j, 0] = of_sun
        totals[j, 1] = of_earth
        for n in range(len(rows)):
            _share(rows[n, j], own[n], weights)


@jit
def _share(points: Any, samples: Floats, weights: Floats) -> None:
    """Share the light of (subsamples, count + 2 REACH) samples among (count,) points, in place."""
    for k in range(len(points)):
        points[k] = 0.0
    for d in range(2 * REACH + 1):
        for m in range(len(weights)):
            weight = weights[m, d]
            for k in range(len(points)):
                points[k] += weight * samples[m, k + 2 * REACH - d]


@jit(parallel=True)
def _add_columns(light: Any, rows: Floats, weights: Floats, scale: float) -> None:
    """Share rows of samples among the lattice's rows, scaled, and add them to `light`."""
    count = light.shape[1]
    subsamples = len(weights)
    for k in numba.prange(count):
        # Only rows of the lattice that exist: no margin here.
        for d in range(max(k + REACH - count + 1, 0), min(2 * REACH, k + REACH) + 1):
            for m in range(subsamples):
                weight = scale * weights[m, d]
                j = (k + REACH - d) * subsamples + m
                for i in range(count):
                    light[k, i] += weight * rows[j, i]


# V magnitudes. A body at r au from the Sun and d au from the observer, at a phase angle of a degrees, has
#
#     V = 5 log10(r d) + V(1, 0) + f(a).
#
# The planets' polynomials are those of the Astronomical Almanac: Mallama & Hilton 2018, Astronomy and Computing 25, 10
# (arXiv:1808.01973). The rotation of Mars (0.06 mag) is left out.


MOON_KM = 384400.0  # mean distance
FULL_MOON_MAG = -12.73  # at this distance, the Sun at 1 au
EARTH = (-3.99, -1.060e-3, 2.054e-4)  # polynomial of the Earth as a planet
# Right ascension and declination of the planets' poles (IAU WGCCRE 2015).
POLES_DEG = {"saturn": (40.589, 83.537), "uranus": (257.311, -15.175)}
URANUS_FLATTENING = 0.0022927


def magnitude(name: str, place: Place, tt_jd: float) -> float:
    """V of a body above the atmosphere. The laws are extrapolated to phase angles that the Earth never sees."""
    if name == "sun":
        return float(SUN_V_MAG + 5 * np.log10(place.distance_km / AU_KM))
    sun_au = place.sun_distance_km / AU_KM
    phase_deg = float(np.degrees(place.phase_rad))
    if name == "moon":
        return moon_magnitude(place.distance_km, sun_au, phase_deg)
    if name in PLANETS:
        at_1_au = PLANETS[name](phase_deg, place, tt_jd)
    elif name in ASTEROIDS:
        at_1_au = asteroid(phase_deg, *ASTEROIDS[name])
    else:
        at_1_au = by_phase(name, phase_deg)
    return float(5 * np.log10(sun_au * place.distance_km / AU_KM) + at_1_au)


def moon_magnitude(distance_km: float, sun_au: float, phase_deg: float) -> float:
    """V = -12.73 + 0.026 a + 4e-9 a^4 at the mean distance.

    Source: Allen 1976, as in Krisciunas & Schaefer 1991, PASP 103, 1033. Within 7 degrees of full the Moon is up to
    35 % brighter than this (its opposition surge); beyond 150 degrees the law is extrapolated. An eclipse is not
    computed.
    """
    law = FULL_MOON_MAG + 0.026 * phase_deg + 4e-9 * phase_deg**4
    return float(law + 5 * np.log10(distance_km / MOON_KM * sun_au))


def earthshine_fraction(moon: Place) -> float:
    """Ratio of the light of the earthlit Moon to that of the sunlit Moon.

    The phase angles of the Earth, seen from the Moon, and of the Moon add up to 180 degrees. The Earth shines on the
    Moon from the observer's direction, so the earthlit Moon is a full Moon (phase angle 0). It is fainter than the
    sunlit full Moon by the difference in magnitude of Earth and Sun, both seen from the Moon.
    """
    sun_au = moon.sun_distance_km / AU_KM
    moon_au = moon.distance_km / AU_KM
    phase_deg = float(np.degrees(moon.phase_rad))
    earth_mag = polynomial(180 - phase_deg, EARTH) + 5 * np.log10(moon_au * sun_au)
    fainter = earth_mag - (SUN_V_MAG + 5 * np.log10(sun_au))
    full = moon_magnitude(moon.distance_km, sun_au, 0.0)
    sunlit = moon_magnitude(moon.distance_km, sun_au, phase_deg)
    return float(10 ** (-0.4 * (full + fainter - sunlit)))


def polynomial(phase_deg: float, coefficients: tuple[float, ...]) -> float:
    """The sum of c_k a^k of the phase angle a in degrees."""
    return float(sum(c * phase_deg**k for k, c in enumerate(coefficients)))


# Coefficients of f(a) + V(1, 0), of Uranus and Neptune of f(a) alone, by the phase angle in degrees up to which they
# hold. Near inferior conjunction the clouds of Venus scatter sunlight forward.
PHASE_LAWS: dict[str, dict[float, tuple[float, ...]]] = {
    "mercury": {
        180.0: (
            -0.613,
            6.3280e-2,
            -1.6336e-3,
            3.3644e-5,
            -3.4265e-7,
            1.6893e-9,
            -3.0334e-12,
        )
    },
    "venus": {
        163.7: (-4.384, -1.044e-3, 3.687e-4, -2.814e-6, 8.938e-9),
        180.0: (236.05828, -2.81914, 8.39034e-3),
    },
    "mars": {50.0: (-1.601, 2.267e-2, -1.302e-4), 180.0: (-0.367, -2.573e-2, 3.445e-4)},
    "jupiter": {180.0: (-9.395, -3.7e-4, 6.16e-4)},
    "uranus": {3.1: (0.0,), 180.0: (0.0, 6.587e-3, 1.045e-4)},
    "neptune": {1.9: (0.0,), 180.0: (0.0, 7.944e-3, 9.617e-5)},
    "io": {180.0: (-1.68, 0.046, -0.0010)},
    "europa": {180.0: (-1.41, 0.0312, -0.00125)},
    "ganymede": {180.0: (-2.09, 0.0323, -0.00066)},
    "callisto": {180.0: (-1.05, 0.078, -0.00274)},
}


def by_phase(name: str, phase_deg: float) -> float:
    """The polynomial of PHASE_LAWS at a phase angle."""
    laws = PHASE_LAWS[name].items()
    return polynomial(phase_deg, next(law for limit, law in laws if phase_deg <= limit))


def saturn(phase_deg: float, place: Place, _tt_jd: float) -> float:
    """V magnitude of Saturn's globe and rings at 1 au from Sun and observer.

        -8.914 - 1.825 sin b + 0.026 a - 0.378 sin b exp(-2.25 a)

    b is the geometric mean of the latitudes of Sun and observer, 0 if the rings are seen from their unlit side.
    """
    to_sun, to_observer = latitudes_rad("saturn", place)
    tilt = math.sin(math.sqrt(max(to_sun * to_observer, 0.0)))
    return (
        -8.914 - 1.825 * tilt + 0.026 * phase_deg - 0.378 * tilt * math.exp(-2.25 * phase_deg)
    )


def uranus(phase_deg: float, place: Place, _tt_jd: float) -> float:
    """V magnitude of Uranus at 1 au from Sun and observer.

    The poles are brighter: the magnitude depends on the mean planetographic latitude of Sun and observer.
    """
    latitudes_deg = np.degrees(
        np.arctan(np.tan(latitudes_rad("uranus", place)) / (1 - URANUS_FLATTENING) ** 2)
    )
    along_equator = -7.110 + by_phase("uranus", phase_deg)
    return along_equator - 8.4e-4 * float(np.abs(latitudes_deg).mean())


def neptune(phase_deg: float, _place: Place, tt_jd: float) -> float:
    """V magnitude of Neptune at 1 au from Sun and observer. Neptune brightened from 1980 to 2000."""
    year = 2000 + (tt_jd - J2000_JD) / JULIAN_YEAR_DAY
    at_full = min(max(-6.89 - 0.0054 * (year - 1980), -7.0), -6.89)
    return at_full + by_phase("neptune", phase_deg)


def asteroid(phase_deg: float, h_mag: float, slope: float) -> float:
    """V magnitude of an asteroid at 1 au from Sun and observer, by its H and G (Bowell et al. 1989, Asteroids II, 524).

    H - 2.5 log10((1 - G) exp(-3.33 t^0.63) + G exp(-1.87 t^1.22)), with t = tan(a / 2) of the phase angle.
    """
    tangent = math.tan(math.radians(phase_deg) / 2)
    steep = (1 - slope) * math.exp(-3.33 * tangent**0.63)
    return h_mag - 2.5 * math.log10(steep + slope * math.exp(-1.87 * tangent**1.22))


# H and G of asteroids (Minor Planet Center).
ASTEROIDS = {"ceres": (3.34, 0.12), "vesta": (3.20, 0.32)}

# Planets whose magnitude depends on more than the phase.
PLANETS: dict[str, Callable[[float, Place, float], float]] = {
    "saturn": saturn,
    "uranus": uranus,
    "neptune": neptune,
}


def latitudes_rad(name: str, place: Place) -> Floats:
    """(2,) planetocentric latitudes of the Sun and of the observer above the planet's equator."""
    pole = directions(*POLES_DEG[name])
    sines = [
        -(vector @ pole) / np.linalg.norm(vector)
        for vector in (place.from_sun_km, place.to_body_km)
    ]
    return np.arcsin(sines)
