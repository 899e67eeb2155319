"""Refraction as a tracker on the ground corrects it: the zenith at a time, and directions without air.

The refraction is R = A tan z + B tan^3 z (`refraction_constants`). The zenith in ICRS axes follows from sidereal time
and precession (`zenith_icrs`).

This code is independent of the simulator's. It uses a two-term formula with the refractivity of Edlen, and
low-precision sidereal time and precession; the simulator integrates the refraction along the ray, and has nutation.
"""

import datetime
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.catalog.catalog import days_after_j2000, from_angles, utc
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Allowed, Floats, frozen
from estimator.core.constants import (
    ARCSEC_RAD,
    DAY_S,
    JULIAN_CENTURY_DAY,
    STANDARD_PRESSURE_HPA,
    STANDARD_TEMPERATURE_K,
    ZERO_CELSIUS_K,
)
from estimator.core.types import Attitude, Centroids

# Greatest apparent zenith distance: the formula fails nearer to the horizon.
LOWEST_RAD = np.radians(85.0)
AIR_ROUNDS = 2  # number of corrections for refraction at another time than the air's epoch
SAME_AIR_S = 1.0  # time in which the zenith moves by 15", and a refraction changes by 0.02"
NUMBERS = {
    "latitude_deg": Allowed(-90, 90, "-90 to 90"),
    "longitude_deg": Allowed(-360, 360, "-360 to 360"),
    "pressure_hpa": Allowed(0, 1200, "0 to 1200"),
    "temperature_c": Allowed(-100, 60, "-100 to 60"),
    "wavelength_m": Allowed(3e-7, 3e-6, "3e-7 to 3e-6"),
}
RAISING_STEPS = 6  # iterations of `raised`


@frozen
class SiteAir:
    """The air over a site, as a tracker there knows it.

    Attributes
    ----------
    latitude_deg, longitude_deg
        Geodetic coordinates of the site, east positive
    epoch
        UTC of t = 0, naive or aware
    pressure_hpa, temperature_c
        Pressure and temperature at the site
    wavelength_m
        Wavelength of the refracted light

    Raises
    ------
    ImageError
        For a number out of range or a date that cannot be read.
    """

    latitude_deg: float
    longitude_deg: float
    epoch: datetime.datetime | str
    pressure_hpa: float = STANDARD_PRESSURE_HPA
    temperature_c: float = 15.0
    wavelength_m: float = 600e-9

    def __post_init__(self) -> None:
        checks.store_numbers(self, "", NUMBERS)
        utc(self.epoch)

    def zenith(self, t_s: float) -> Floats:
        """The (3,) zenith in ICRS axes t_s seconds after the epoch."""
        days = days_after_j2000(utc(self.epoch)) + t_s / DAY_S
        return zenith_icrs(
            days, np.radians(self.latitude_deg), np.radians(self.longitude_deg)
        )

    def seen(self, directions: Floats, t_s: float) -> Floats:
        """The (N, 3) unit vectors of stars as they are seen, from those without air (N, 3), in ICRS axes."""
        return raised(directions, self.zenith(t_s), *self._constants)

    def without_air(self, directions: Floats, t_s: float) -> Floats:
        """The (N, 3) unit vectors of stars without air, from those seen (N, 3), in ICRS axes."""
        return lowered(directions, self.zenith(t_s), *self._constants)

    @property
    def _constants(self) -> tuple[float, float]:
        return refraction_constants(self.pressure_hpa, self.temperature_c, self.wavelength_m)


def zenith_icrs(days: float, latitude_rad: float, longitude_rad: float) -> Floats:
    """The (3,) zenith of a site in ICRS axes, within 20" (nutation, UT1 - UTC are neglected).

    Greenwich mean sidereal time is 280.46061837 + 360.98564736629 d + 0.000387933 T^2 degrees, with d days and T Julian
    centuries after J2000.0. Precession turns the mean equator of date by the angles of IAU 1976 (Lieske et al. 1977,
    A&A 58, 1). Source: Meeus (1998), ch. 12, 21.

    Parameters
    ----------
    days
        Days after J2000.0 in UTC
    latitude_rad, longitude_rad
        Geodetic coordinates of the site, east positive
    """
    centuries = days / JULIAN_CENTURY_DAY
    # Zenith in the mean equator of date.
    sidereal_deg = 280.46061837 + 360.98564736629 * days + 0.000387933 * centuries**2
    hour = np.radians(sidereal_deg % 360) + longitude_rad
    of_date = from_angles(hour, latitude_rad)
    # Precession from the equator of date to that of J2000.0.
    zeta, z, theta = ARCSEC_RAD * np.array(
        [
            2306.2181 * centuries + 0.30188 * centuries**2,
            2306.2181 * centuries + 1.09468 * centuries**2,
            2004.3109 * centuries - 0.42665 * centuries**2,
        ]
    )
    return Rotation.from_euler("ZYZ", [-zeta, theta, -z]).apply(of_date)


def refraction_constants(
    pressure_hpa: float, temperature_c: float, wavelength_m: float
) -> tuple[float, float]:
    """A and B, in radians, of the refraction R = A tan z + B tan^3 z at the apparent zenith distance z.

        A = g (1 - beta),   B = -g (beta - g / 2)

    g is the refractivity of dry air (Edlen 1953, as in Stone 1996, PASP 108, 1051), which is proportional to the
    pressure over the temperature. beta = 0.001254 T / 273.15 K is the scale height of the air over the Earth's
    radius. The formula is within 0.2" of ray tracing above 15 degrees of altitude.
    """
    per_um2 = (1e-6 / wavelength_m) ** 2
    t_k = temperature_c + ZERO_CELSIUS_K
    standard = 1e-6 * (64.328 + 29498.1 / (146 - per_um2) + 255.4 / (41 - per_um2))
    refractivity = (
        standard * pressure_hpa / STANDARD_PRESSURE_HPA * STANDARD_TEMPERATURE_K / t_k
    )
    beta = 0.001254 * t_k / ZERO_CELSIUS_K
    return refractivity * (1 - beta), -refractivity * (beta - refractivity / 2)


def lowered(directions: Floats, zenith: Floats, a_rad: float, b_rad: float) -> Floats:
    """The (N, 3) unit vectors turned away from the zenith (3,) by the refraction of the constants A and B."""
    directions, zenith_rad, up = _vertical(directions, zenith)
    bending = _bending(zenith_rad, a_rad, b_rad)
    return np.cos(bending)[:, None] * directions - np.sin(bending)[:, None] * up


def raised(directions: Floats, zenith: Floats, a_rad: float, b_rad: float) -> Floats:
    """The (N, 3) unit vectors turned toward the zenith (3,): the inverse of `lowered`, by iteration to 1e-9 rad."""
    directions, zenith_rad, up = _vertical(directions, zenith)
    bending = np.zeros(len(directions))
    # The refraction depends on the apparent zenith distance: iterate from the true one.
    for _ in range(RAISING_STEPS):
        bending = _bending(np.maximum(zenith_rad - bending, 0.0), a_rad, b_rad)
    return np.cos(bending)[:, None] * directions + np.sin(bending)[:, None] * up


def _vertical(directions: Floats, zenith: Floats) -> tuple[Floats, Floats, Floats]:
    """The vertical plane of each direction.

    Returns
    -------
    directions
        (N, 3) unit vectors, checked
    zenith_rad
        (N,) zenith distances
    up
        (N, 3) unit vectors across the directions, toward the zenith
    """
    directions = checks.floats("directions", directions, (None, 3))
    cosine = directions @ zenith
    across = zenith - cosine[:, None] * directions
    sine = np.linalg.norm(across, axis=1)
    return directions, np.arctan2(sine, cosine), across / np.maximum(sine, 1e-12)[:, None]


def _bending(zenith_rad: Floats, a_rad: float, b_rad: float) -> Floats:
    """(N,) refraction A tan z + B tan^3 z, constant beyond LOWEST_RAD."""
    tangent = np.tan(np.minimum(zenith_rad, LOWEST_RAD))
    return a_rad * tangent + b_rad * tangent**3


def solve_through_air(
    solve: Callable[[Centroids], Attitude],
    camera: Camera,
    air: SiteAir,
    t_s: float,
    centroids: Centroids,
) -> Attitude:
    """Solve centroids seen through the air at t_s after the epoch for which the catalog has been refracted.

    1. Solve with the catalog as it is; the Earth has rotated since the epoch.
    2. The attitude determines the zenith, and so the directions in which the stars would have been seen at the epoch.
       Move the centroids there.
    3. Solve again; a second round makes the error of the first attitude's refraction, some arcseconds, negligible.
    """
    # 1. Catalog of the epoch
    attitude = solve(centroids)
    for _ in range(AIR_ROUNDS if abs(t_s) > SAME_AIR_S else 0):
        if attitude.cam_from_ref is None:
            break
        # 2. Refraction now removed, that of the epoch applied
        now = attitude.cam_from_ref.inv().apply(camera.rays(centroids.xy_px))
        at_epoch = air.seen(air.without_air(now, t_s), 0.0)
        xy_px = camera.pixels(attitude.cam_from_ref.apply(at_epoch))
        # 3. Solution
        attitude = solve(replace(centroids, xy_px=xy_px))
    return attitude
