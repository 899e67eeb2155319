"""How much stars twinkle, for any aperture and exposure, in weak turbulence.

A layer of the strength Cn^2 dz at the distance z along the ray gives a star's light the power spectrum

    1.534 lambda^-2 f^(-11/3) sin^2(pi lambda z f^2) Cn^2 dz

over the spatial frequencies f. An aperture D averages it by (2 J1(pi D f) / (pi D f))^2, and an exposure t, in which
the wind V carries the pattern past, by sinc^2(f_x V t), whose mean over the directions of f is 2 (∫ J0 - J1) / x, with
the integral from 0 to x = 2 pi f V t. The variance is the integral over frequencies and layers. Its limits are

    19.12 lambda^(-7/6) X^(11/6) ∫ Cn^2 h^(5/6) dh            a point, an instant (Rytov)
    10.66 D^(-4/3) t^-1 X^3 ∫ Cn^2 h^2 / V dh                 a wide aperture, a long exposure (Young)

at the air mass X. Sources: Roddier 1981, Progress in Optics 19, 281, section 8; Dravins et al. 1998, PASP 110, 610.
"""

from __future__ import annotations

from functools import lru_cache
import numpy as np
from scipy import special
from scipy.interpolate import RectBivariateSpline
from skysim.core.types import Floats



SPECTRUM = 1.534  # 4 x 0.3834
YOUNG = 10.66
YOUNG_M_S = 10e-6  # of the variance at D = 1 m, t = 1 s, m^(4/3) s
C_Y = 1.56  # median of the sites in Osborn et al. (2015)
SCALE_HEIGHT_M = 8000.0  # of the turbulence in Young's law
TOP_M = 25_000.0
# within 0.3 % of finer ones
LAYERS = 20
FREQUENCIES = 300
FREQUENCY_1_M = 1e-2, 3e3  # lowest and highest
AIR_MASSES = np.geomspace(1.0, 40.0, 12)
EXPOSURES_S = np.geomspace(1e-5, 1e2, 22)


def variance(
    air_masses: Floats, aperture_m: float, exposure_s: float, height_m: float, wavelength_m: float
) -> Floats:
    """(N,) relative variances of stars' light at these air masses, from a site at a height."""
    spline = variance_table(aperture_m, height_m, wavelength_m)
    within_s = min(max(exposure_s, EXPOSURES_S[0]), EXPOSURES_S[-1])
    at_masses = spline.ev(np.log(np.clip(air_masses, 1.0, AIR_MASSES[-1])), np.log(within_s))
    return np.asarray(np.exp(at_masses) * min(within_s / exposure_s, 1.0))


@lru_cache(maxsize=8)
def variance_table(aperture_m: float, height_m: float, wavelength_m: float) -> RectBivariateSpline:
    """The logarithm of the variance against those of air mass and exposure.

    The turbulence is scaled so that the limit of wide apertures and long exposures is Young's law, 10^-5 C_Y^2 D^(-4/3)
    t^-1 X^3 exp(-2 h / 8 km) (Young 1967, AJ 72, 747; Osborn et al. 2015, MNRAS 452, 1707, equation 7).
    """
    above_m, strength = layers(height_m)
    wind_m_s = wind(height_m + above_m)
    scale = YOUNG_M_S * C_Y**2 * np.exp(-2 * height_m / SCALE_HEIGHT_M)
    scale /= YOUNG * float(np.sum(strength * above_m**2 / wind_m_s))
    f = np.geomspace(*FREQUENCY_1_M, FREQUENCIES)
    # The integral of S(f) 2 pi f df in even steps of ln f.
    density = (
        SPECTRUM
        * wavelength_m**-2
        * f ** (-5 / 3)
        * 2
        * np.pi
        * np.log(f[1] / f[0])
        * airy(aperture_m * f) ** 2
    )
    distance_m = AIR_MASSES[:, None] * above_m
    fresnel = np.sin(np.pi * wavelength_m * distance_m[..., None] * f**2) ** 2
    spectra = AIR_MASSES[:, None, None] * (scale * strength)[:, None] * fresnel * density
    moved = exposure_filter(EXPOSURES_S[:, None, None] * wind_m_s[:, None] * f)
    found = spectra.reshape(len(AIR_MASSES), -1) @ moved.reshape(len(EXPOSURES_S), -1).T
    return RectBivariateSpline(np.log(AIR_MASSES), np.log(EXPOSURES_S), np.log(found))


def layers(height_m: float) -> tuple[Floats, Floats]:
    """(L,) heights above a site, and Cn^2 dh of the layers there: a Gauss-Legendre rule in the root of the height."""
    x, weight = np.polynomial.legendre.leggauss(LAYERS)
    root = (1 + x) / 2
    above_m = TOP_M * root**2
    return above_m, hufnagel_valley(height_m + above_m, above_m) * TOP_M * root * weight


def hufnagel_valley(sea_m: Floats, above_m: Floats) -> Floats:
    """Cn^2 in m^(-2/3) of the model Hufnagel-Valley 5/7 at heights above the sea and above the ground.

    Source: Andrews & Phillips 2005, Laser Beam Propagation through Random Media, section 12.2.
    """
    high = 0.00594 * (21 / 27) ** 2 * (1e-5 * sea_m) ** 10 * np.exp(-sea_m / 1000)
    return np.asarray(high + 2.7e-16 * np.exp(-sea_m / 1500) + 1.7e-14 * np.exp(-above_m / 100))


def wind(sea_m: Floats) -> Floats:
    """Bufton's wind in m/s at heights above the sea, 5 on the ground (Andrews & Phillips 2005, section 12.2)."""
    return np.asarray(5 + 30 * np.exp(-(((sea_m - 9400) / 4800) ** 2)))


def airy(x: Floats) -> Floats:
    """2 J1(pi x) / (pi x)."""
    u = np.pi * np.maximum(x, 1e-9)
    return np.asarray(2 * special.j1(u) / u)


def exposure_filter(turns: Floats) -> Floats:
    """Mean of sinc^2(turns cos phi) over phi: 2 (∫ J0 - J1) / x, x = 2 pi turns."""
    x = 2 * np.pi * np.maximum(turns, 1e-4)
    return np.asarray(2 * (special.itj0y0(x)[0] - special.j1(x)) / x)


def factors(variances: Floats, rng: np.random.Generator) -> Floats:
    """(N,) factors of stars' light with mean 1 and these variances, log-normal (Dravins et al. 1997, PASP 109, 173)."""
    log_variance = np.log1p(variances)
    return np.asarray(
        np.exp(np.sqrt(log_variance) * rng.standard_normal(len(variances)) - log_variance / 2)
    )


