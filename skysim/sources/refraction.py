"""Astronomical refraction: the bending of light in a standard atmosphere, by quadrature along the ray.

1. `Atmosphere` gives the refractive index n and its slope at any radius r, in a troposphere and a stratosphere.
2. `refraction_rad` integrates the bending along rays that arrive at chosen apparent zenith distances,

       R = - integral of (r dn/dr) / (n + r dn/dr) dz,    n r sin z = n0 r0 sin z0.

3. `Refraction` tabulates R against the zenith distance without air, and turns directions toward the zenith.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy

from skysim.core.constants import (
    STANDARD_PRESSURE_HPA,
    STANDARD_TEMPERATURE_K,
    ZERO_CELSIUS_K,
)
from skysim.core.types import Floats, frozen, lengths

# The model's own numbers (Hohenkerk & Sinclair 1985): gas constant, molar masses, radius and lapse rate.
GAS_J_KMOL_K = 8314.32
DRY_KG_KMOL = 28.9644
WATER_KG_KMOL = 18.0152
EARTH_M = 6_378_120.0
TROPOPAUSE_M = 11_000.0
TOP_M = 80_000.0
LAPSE_K_M = 0.0065  # also that of ISO 2533
VAPOR_EXPONENT = 18.36  # power of the temperature with which the water vapor's pressure falls
NODES = 24  # of the Gauss-Legendre rule in each layer
LOWEST_RAD = np.radians(90.0)  # apparent zenith distance of the last ray
RAYS = 181

Layer = Callable[[Floats], tuple[Floats, Floats]]  # refractive index n and r dn/dr at radii


class Weather(NamedTuple):
    """Air at a site, and the wavelength of the light. Humidity is relative, height above the sea."""

    height_m: float
    latitude_rad: float
    pressure_hpa: float
    temperature_c: float
    humidity: float
    wavelength_m: float


def standard_pressure_hpa(height_m: float) -> float:
    """Pressure of the International Standard Atmosphere (ISO 2533) in the troposphere."""
    return float(
        STANDARD_PRESSURE_HPA * (1 - LAPSE_K_M * height_m / STANDARD_TEMPERATURE_K) ** 5.25588
    )


def standard_temperature_c(height_m: float) -> float:
    """Temperature of the International Standard Atmosphere (ISO 2533) in the troposphere."""
    return 15.0 - LAPSE_K_M * height_m


def refractivity(wavelength_m: float | Floats) -> Floats:
    """n - 1 of dry air at 0 deg C and the standard pressure, by its dispersion (IAG 1999)."""
    um2 = (np.asarray(wavelength_m) * 1e6) ** 2
    return 1e-6 * (287.6155 + (1.62887 + 0.0136 / um2) / um2)


@frozen
class Atmosphere:
    """A troposphere with a constant lapse rate and water vapor, and an isothermal stratosphere.

    Refractivity n - 1 = C1 (T / T0)^(gamma - 1) - C2 (T / T0)^(delta - 1) with T = T0 - lapse (r - r0); above the
    tropopause it falls exponentially. Dry air's dispersion is that of IAG 1999. Source: Hohenkerk & Sinclair (1985),
    NAO Technical Note 63; Explanatory Supplement to the Astronomical Almanac (1992), section 3.281.

    Attributes
    ----------
    r0_m, t0_k
        Distance of the site from the Earth's center, and temperature there
    gamma
        Exponent of the pressure in the temperature
    scale_per_k
        g M / R: minus the gradient of the logarithm of the pressure, times the temperature
    dry, wet
        C1 and C2
    """

    r0_m: float
    t0_k: float
    gamma: float
    scale_per_k: float
    dry: float
    wet: float

    @classmethod
    def from_weather(cls, weather: Weather) -> "Atmosphere":
        """The atmosphere above a site."""
        t_c = weather.temperature_c
        t0_k = weather.temperature_c + ZERO_CELSIUS_K
        p_hpa = weather.pressure_hpa
        gravity = 9.784 * (
            1 - 0.0026 * np.cos(2 * weather.latitude_rad) - 2.8e-7 * weather.height_m
        )
        scale_per_k = gravity * DRY_KG_KMOL / GAS_J_KMOL_K
        gamma = scale_per_k / LAPSE_K_M
        # Refractivity per hPa at 1 K.
        per_hpa = (
            float(refractivity(weather.wavelength_m)) * ZERO_CELSIUS_K / STANDARD_PRESSURE_HPA
        )
        # Pressure of saturated vapor, and that of the vapor at this humidity.
        saturated_hpa = 10 ** ((0.7859 + 0.03477 * t_c) / (1 + 0.00412 * t_c))
        saturated_hpa *= 1 + p_hpa * (4.5e-6 + 6e-10 * t_c**2)
        humidity = weather.humidity
        vapor_hpa = 0.0
        if p_hpa > 0:
            vapor_hpa = (
                humidity * saturated_hpa / (1 - (1 - humidity) * saturated_hpa / p_hpa)
            )
        # Vapor is lighter than dry air, so it changes the fall of the pressure with height.
        lighter_hpa = (
            vapor_hpa * (1 - WATER_KG_KMOL / DRY_KG_KMOL) * gamma / (VAPOR_EXPONENT - gamma)
        )
        dry = per_hpa * (p_hpa + lighter_hpa) / t0_k
        wet = (per_hpa * lighter_hpa + 1.12684e-5 * vapor_hpa) / t0_k
        return cls(EARTH_M + weather.height_m, t0_k, gamma, scale_per_k, dry, wet)

    def troposphere(self, r_m: Floats) -> tuple[Floats, Floats]:
        """Refractive index n and r dn/dr at radii; T / T0 is limited to what occurs in the troposphere."""
        relative = np.clip((self.t0_k - LAPSE_K_M * (r_m - self.r0_m)) / self.t0_k, 0.3, 1.2)
        dry = self.dry * relative ** (self.gamma - 1)
        wet = self.wet * relative ** (VAPOR_EXPONENT - 1)
        slope = (self.gamma - 1) * dry - (VAPOR_EXPONENT - 1) * wet
        return 1 + dry - wet, -r_m * LAPSE_K_M / self.t0_k * slope / relative

    def stratosphere(self, r_m: Floats) -> tuple[Floats, Floats]:
        """Refractive index n and r dn/dr at radii, continuous at the tropopause."""
        tropopause = np.array(EARTH_M + TROPOPAUSE_M)
        t_k = self.t0_k - LAPSE_K_M * (float(tropopause) - self.r0_m)
        fall_per_m = self.scale_per_k / t_k
        excess = (self.troposphere(tropopause)[0] - 1) * np.exp(
            -fall_per_m * (r_m - tropopause)
        )
        return 1 + excess, -r_m * fall_per_m * excess


def refraction_rad(apparent_zenith_rad: Floats, atmosphere: Atmosphere) -> Floats:
    """(N,) refraction of rays that arrive at these apparent zenith distances.

    The integral over the local zenith distance z of the ray is smooth down to the horizon (Auer & Standish 2000, AJ
    119, 2472); a Gauss-Legendre rule gives it in each layer.

    1. The invariant n r sin z of each ray.
    2. Its zenith distances at the tropopause and at the top.
    3. The sum of both layers' integrals.
    """
    # 1.
    n0 = atmosphere.troposphere(np.array(atmosphere.r0_m))[0]
    invariant = n0 * atmosphere.r0_m * np.sin(apparent_zenith_rad)
    # 2.
    tropopause_m = EARTH_M + TROPOPAUSE_M
    top_m = EARTH_M + TOP_M
    at_tropopause = atmosphere.troposphere(np.array(tropopause_m))[0]
    z_tropopause = np.arcsin(invariant / (at_tropopause * tropopause_m))
    z_top = np.arcsin(invariant / (atmosphere.stratosphere(np.array(top_m))[0] * top_m))
    # 3.
    low = layer_rad(
        atmosphere.troposphere, invariant, apparent_zenith_rad, z_tropopause, tropopause_m
    )
    return low + layer_rad(atmosphere.stratosphere, invariant, z_tropopause, z_top, top_m)


def layer_rad(
    layer: Layer, invariant: Floats, z_low: Floats, z_high: Floats, top_m: float
) -> Floats:
    """(N,) the integral over one layer between the ray's zenith distances at its ends.

    At each node z of the rule the radius solves n r = invariant / sin z, by Newton's method.
    """
    x, weight = np.polynomial.legendre.leggauss(NODES)
    half = (z_low - z_high)[:, None] / 2
    z = (z_low + z_high)[:, None] / 2 + half * x
    sine = np.maximum(np.sin(z), 1e-12)
    r_m = np.minimum(invariant[:, None] / sine, top_m)
    for _ in range(6):
        n, slope = layer(r_m)
        r_m = r_m - (n * r_m - invariant[:, None] / sine) / (n + slope)
    n, slope = layer(r_m)
    return -(slope / (n + slope)) @ weight * half[:, 0]


class Refraction:
    """Refraction against the zenith distance of the source without air, tabulated once; 0.001" from the integral.

    Below the horizon, where nothing is seen, the refraction is that of the horizon.
    """

    def __init__(self, weather: Weather) -> None:
        # Rays are densest at the horizon, where refraction changes most.
        apparent_rad = LOWEST_RAD * np.sin(np.linspace(0, np.pi / 2, RAYS))
        bending_rad = np.zeros(RAYS)
        if weather.pressure_hpa > 0:
            bending_rad[1:] = refraction_rad(
                apparent_rad[1:], Atmosphere.from_weather(weather)
            )
        true_rad = apparent_rad + bending_rad
        self.last_rad = float(true_rad[-1])
        self.spline = scipy.interpolate.CubicSpline(true_rad, bending_rad)

    def bending_rad(self, zenith_rad: Floats) -> Floats:
        """(N,) angles by which sources appear nearer to the zenith, at (N,) zenith distances without air."""
        return self.spline(np.minimum(zenith_rad, self.last_rad))

    def apparent(
        self, directions: Floats, zenith: Floats, scale: float | Floats = 1.0
    ) -> Floats:
        """Turn directions toward the zenith, each in its vertical plane.

        Light of another color, with s times the refractivity, is bent by s R(z - (s - 1) R(z) / 2): to second order in
        the refractivity a, refraction is a f(z - R / 2) of the zenith distance z without air, since it is
        a tan z' + a^2 / 2 tan^3 z' of the apparent one, z' = z - R, apart from terms that are linear in a (Stone 1996,
        PASP 108, 1051, equation 4). The difference between colors is within 0.1 % above an altitude of 2 deg.

        Parameters
        ----------
        directions
            (N, 3) unit vectors as without air
        zenith
            (3,) unit vector in the same axes
        scale
            (N,) refractivities for the sources' colors, over that for the weather's wavelength

        Returns
        -------
        Floats
            (N, 3) unit vectors as seen through the air
        """
        cosine = directions @ zenith
        across = zenith - cosine[:, None] * directions
        sine = lengths(across)
        zenith_rad = np.arctan2(sine, cosine)
        bending = scale * self.bending_rad(
            zenith_rad - (scale - 1) / 2 * self.bending_rad(zenith_rad)
        )
        along = np.sin(bending) / np.maximum(sine, 1e-12)
        return np.cos(bending)[:, None] * directions + along[:, None] * across
