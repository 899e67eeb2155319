"""The air over a site at a time: refraction, extinction, scintillation and seeing of stars and bodies."""

import datetime
from dataclasses import replace
from functools import lru_cache

import erfa
import numpy as np
import scipy
from numpy.random import Generator
from scipy import special

from skysim.core.time import tt_jd, ut1_jd
from skysim.core.types import Bools, Floats, Ints, Sources, frozen
from skysim.scene.sections.surroundings import AirConfig, HorizonConfig
from skysim.scene.sections.vehicle import SiteConfig
from skysim.sources.bodies import BODIES, BodyLight
from skysim.sources.catalog import Catalog
from skysim.sources.photometry import (
    SUN,
    Band,
    Curve,
    Reals,
    black_body_v0,
    complete_colors,
    temperature_k,
)
from skysim.sources.refraction import (
    Refraction,
    Weather,
    refractivity,
    standard_pressure_hpa,
    standard_temperature_c,
)
from skysim.sources.stars import sky_axes

# Scintillation, for any aperture and exposure, in weak turbulence. A layer of the strength Cn^2 dz at the distance z
# along the ray gives a star's light the power spectrum
#
#     S(f) = 1.534 lambda^-2 f^(-11/3) sin^2(pi lambda z f^2) Cn^2 dz
#
# over the spatial frequencies f. An aperture D averages it by (2 J1(pi D f) / (pi D f))^2, and an exposure t, in which
# the wind V carries the pattern past, by sinc^2(f_x V t), whose mean over the directions of f is 2 (int J0 - J1) / x,
# with the integral from 0 to x = 2 pi f V t. The variance is the integral over frequencies and layers. Its limits are
#
#     19.12 lambda^(-7/6) X^(11/6) int Cn^2 h^(5/6) dh           a point, an instant (Rytov)
#     10.66 D^(-4/3) t^-1 X^3 int Cn^2 h^2 / V dh                a wide aperture, a long exposure (Young)
#
# at the air mass X. Sources: Roddier 1981, Progress in Optics 19, 281, section 8; Dravins et al. 1998, PASP 110, 610.


SPECTRUM = 1.534  # 4 x 0.3834
YOUNG = 10.66
YOUNG_M_S = 10e-6  # of the variance at D = 1 m, t = 1 s, m^(4/3) s
C_Y = 1.56  # median of the sites in Osborn et al. (2015)
SCALE_HEIGHT_M = 8000.0  # of the turbulence in Young's law
TOP_M = 25_000.0
# Numbers of layers and frequencies: within 0.3 % of finer ones.
LAYERS = 20
FREQUENCIES = 300
FREQUENCY_1_M = 1e-2, 3e3  # lowest and highest
NODES_K = np.geomspace(2600, 34_000, 64)  # temperatures at which the dispersion is computed
# Nodes of the table.
AIR_MASSES = np.geomspace(1.0, 40.0, 12)
EXPOSURES_S = np.geomspace(1e-5, 1e2, 22)


def variance(
    air_masses: Floats,
    aperture_m: float,
    exposure_s: float,
    height_m: float,
    wavelength_m: float,
) -> Floats:
    """(N,) relative variances of stars' light at these air masses, seen from a site at a height above the sea."""
    spline = variance_table(aperture_m, height_m, wavelength_m)
    within_s = min(max(exposure_s, EXPOSURES_S[0]), EXPOSURES_S[-1])
    at_masses = spline.ev(np.log(np.clip(air_masses, 1.0, AIR_MASSES[-1])), np.log(within_s))
    # Beyond the table's longest exposure the variance falls with its inverse.
    return np.exp(at_masses) * min(within_s / exposure_s, 1.0)


@lru_cache(maxsize=8)
def variance_table(
    aperture_m: float, height_m: float, wavelength_m: float
) -> "scipy.interpolate.RectBivariateSpline":
    """The logarithm of the variance as a spline in the logarithms of air mass and exposure.

    1. Layers of the model atmosphere, scaled so that the limit of wide apertures and long exposures is Young's law,
       10^-5 C_Y^2 D^(-4/3) t^-1 X^3 exp(-2 h / 8 km) (Young 1967, AJ 72, 747; Osborn et al. 2015, MNRAS 452, 1707,
       equation 7).
    2. The spectrum behind the aperture, integrated as S(f) 2 pi f df in even steps of ln f.
    3. Its sum over layers and frequencies, each weighted with the filter of the exposure.
    """
    # 1.
    above_m, strength = layers(height_m)
    wind_m_s = wind(height_m + above_m)
    scale = YOUNG_M_S * C_Y**2 * np.exp(-2 * height_m / SCALE_HEIGHT_M)
    scale /= YOUNG * float(np.sum(strength * above_m**2 / wind_m_s))
    f = np.geomspace(*FREQUENCY_1_M, FREQUENCIES)
    # 2. f^(-5/3) is f^(-11/3) f df / d(ln f).
    spectrum = SPECTRUM * wavelength_m**-2 * f ** (-5 / 3)
    density = spectrum * 2 * np.pi * np.log(f[1] / f[0]) * airy(aperture_m * f) ** 2
    distance_m = AIR_MASSES[:, None] * above_m
    fresnel = np.sin(np.pi * wavelength_m * distance_m[..., None] * f**2) ** 2
    spectra = AIR_MASSES[:, None, None] * (scale * strength)[:, None] * fresnel * density
    # 3. (air masses, exposures), as a product of matrices.
    moved = exposure_filter(EXPOSURES_S[:, None, None] * wind_m_s[:, None] * f)
    found = spectra.reshape(len(AIR_MASSES), -1) @ moved.reshape(len(EXPOSURES_S), -1).T
    return scipy.interpolate.RectBivariateSpline(
        np.log(AIR_MASSES), np.log(EXPOSURES_S), np.log(found)
    )


def layers(height_m: float) -> tuple[Floats, Floats]:
    """(L,) heights above a site, and Cn^2 dh of the layers there: a Gauss-Legendre rule in the root of the height.

    With h = top s^2, dh = 2 top s ds; the root puts more layers near the ground.
    """
    x, weight = np.polynomial.legendre.leggauss(LAYERS)
    root = (1 + x) / 2
    above_m = TOP_M * root**2
    return above_m, hufnagel_valley(height_m + above_m, above_m) * TOP_M * root * weight


def hufnagel_valley(sea_m: Floats, above_m: Floats) -> Floats:
    """Cn^2 in m^(-2/3) of the model Hufnagel-Valley 5/7 at heights above the sea and above the ground.

    Source: Andrews & Phillips 2005, Laser Beam Propagation through Random Media, section 12.2.
    """
    high = 0.00594 * (21 / 27) ** 2 * (1e-5 * sea_m) ** 10 * np.exp(-sea_m / 1000)
    return high + 2.7e-16 * np.exp(-sea_m / 1500) + 1.7e-14 * np.exp(-above_m / 100)


def wind(sea_m: Floats) -> Floats:
    """Bufton's wind in m/s at heights above the sea; 5 on the ground (Andrews & Phillips 2005, section 12.2)."""
    return 5 + 30 * np.exp(-(((sea_m - 9400) / 4800) ** 2))


def airy(x: Floats) -> Floats:
    """2 J1(pi x) / (pi x), the amplitude that a round aperture of x cycles across passes."""
    u = np.pi * np.maximum(x, 1e-9)
    return 2 * special.j1(u) / u


def exposure_filter(turns: Floats) -> Floats:
    """Mean of sinc^2(turns cos phi) over phi: 2 (int J0 - J1) / x, x = 2 pi turns."""
    x = 2 * np.pi * np.maximum(turns, 1e-4)
    return 2 * (special.itj0y0(x)[0] - special.j1(x)) / x


def factors(variances: Floats, rng: Generator) -> Floats:
    """(N,) factors of stars' light with mean 1 and these variances, log-normal (Dravins et al. 1997, PASP 109, 173).

    exp(s g - s^2 / 2) with s^2 = ln(1 + variance) and g standard normal.
    """
    log_variance = np.log1p(variances)
    normal = rng.standard_normal(len(variances))
    return np.exp(np.sqrt(log_variance) * normal - log_variance / 2)


# Extinction: the light that the air absorbs and scatters.


def air_mass(altitude_rad: Floats) -> Floats:
    """Air masses along the line of sight, relative to the zenith: X = 1 / sin(h + 244 / (165 + 47 h^1.1)).

    h is the apparent altitude in degrees. X is 38.75 on the horizon, and the same below it.
    Source: Pickering (2002), DIO 12, 20.
    """
    h_deg = np.degrees(np.maximum(altitude_rad, 0.0))
    return 1 / np.sin(np.radians(h_deg + 244 / (165 + 47 * h_deg**1.1)))


def transmission(air_masses: Floats, extinction_mag: Reals) -> Floats:
    """Bouguer's law: the fraction 10^(-0.4 k X) of the light passes X air masses."""
    return 10 ** (-0.4 * extinction_mag * air_masses)


@frozen
class Air:
    """The air of a scene.

    Attributes
    ----------
    site
        Place on the ground, with a longitude
    refraction
        Refraction for the site's weather and the camera's band
    star_id
        (N,) ascending numbers of the catalog's stars
    b_v
        (N + 1,) their colors, and the Sun's
    wavelength_m
        Wavelength of scintillation: the mean of a G2 star's photo-electrons
    dispersion
        (N + 1,) refractivity at the stars' mean colors, over that at the weather's wavelength; the Sun's is the last
    """

    config: AirConfig
    site: SiteConfig
    refraction: Refraction
    star_id: Ints
    b_v: Floats
    wavelength_m: float
    dispersion: Floats

    @classmethod
    def from_config(
        cls, config: AirConfig, site: SiteConfig, stars: Catalog, band: Band
    ) -> "Air":
        """The air over a site for a catalog's stars and a chip's band."""
        order = np.argsort(stars.hip)
        # The stars' colors, and the Sun's at the end.
        colors = np.column_stack([stars.b_v[order], stars.v_i[order]])
        b_v, v_i = np.vstack([colors, SUN]).T
        weather = weather_of(config, site, band)
        relative = np.ones(len(b_v))
        if config.dispersion:
            own = mean_of(band, refractivity, NODES_K) / refractivity(weather.wavelength_m)
            relative = np.interp(temperature_k(b_v, v_i), NODES_K, own)
        return cls(
            config,
            site,
            Refraction(weather),
            stars.hip[order],
            complete_colors(b_v, v_i)[0],
            mean_wavelength_m(band),
            relative,
        )

    def at(self, time: datetime.datetime) -> "Sky":
        """The sky at a time."""
        return Sky(self, time, topocentric_axes(time, self.site))

    def rows(self, ids: Ints) -> Ints:
        """(M,) rows of lights by their numbers; lights that are no star of the catalog have the Sun's, the last."""
        row = np.minimum(np.searchsorted(self.star_id, ids), len(self.star_id) - 1)
        return np.where(self.star_id[row] == ids, row, -1)

    def extinction_mag(self, b_v: Reals) -> Reals:
        """Magnitudes of extinction per air mass: k' + k'' (B-V)."""
        return self.config.extinction_mag + self.config.color_extinction_mag * b_v


@frozen
class Sky:
    """The air at a time.

    Attributes
    ----------
    axes
        (3, 3) rows north, east and zenith of the site in ICRS axes
    """

    air: Air
    time: datetime.datetime
    axes: Floats

    @property
    def zenith(self) -> Floats:
        return self.axes[2]

    def altitude_rad(self, directions: Floats) -> Floats:
        """(N,) apparent altitudes of apparent directions (N, 3)."""
        return np.arcsin(np.clip(directions @ self.zenith, -1, 1))

    def air_mass(self, directions: Floats) -> Floats:
        """(N,) air masses in apparent directions (N, 3)."""
        return air_mass(self.altitude_rad(directions))

    def below_horizon(self, directions: Floats) -> Bools:
        """(N,) whether apparent directions (N, 3) are below the skyline."""
        north, east, up = self.axes @ directions.T
        limit_rad = horizon_rad(self.air.config.horizon, np.arctan2(east, north))
        return up < np.sin(limit_rad)

    def points_seen(self, lights: Sources) -> Sources:
        """Lights at infinity, raised by refraction and dimmed by extinction, in their order; motions are unchanged."""
        row = self.air.rows(lights.id)
        b_v = self.air.b_v[row]
        directions = self.air.refraction.apparent(
            lights.xyz, self.zenith, self.air.dispersion[row]
        )
        passed = transmission(self.air_mass(directions), self.air.extinction_mag(b_v))
        place = np.column_stack([directions, lights.place[:, 3]])
        return replace(lights, place=place, strength=lights.strength * passed)

    def twinkling(
        self, seen: Sources, aperture_m: float, exposure_s: float, rng: Generator
    ) -> Sources:
        """The stars of `points_seen` with the scintillation of one exposure through an aperture of this diameter.

        Each star's light is multiplied by a random factor of mean 1.
        """
        air_masses = self.air_mass(seen.xyz)
        optics = aperture_m, exposure_s, self.air.site.height_m, self.air.wavelength_m
        variances = variance(air_masses, *optics)
        return replace(seen, strength=seen.strength * factors(variances, rng))

    def body_seen(self, body: BodyLight) -> BodyLight:
        """A body raised by refraction and dimmed by extinction; its disc stays round and does not twinkle."""
        direction = self.air.refraction.apparent(
            body.place.direction[None], self.zenith, self.air.dispersion[-1:]
        )[0]
        # The bright limb stays perpendicular to the new direction.
        along = body.place.toward_sun - (body.place.toward_sun @ direction) * direction
        place = body.place._replace(
            direction=direction, toward_sun=along / np.linalg.norm(along)
        )
        # The body's color: the Sun's, and the ratio of its albedos.
        blue, visual = BODIES[body.name].albedo[:2]
        b_v = SUN[0] - 2.5 * np.log10(blue / visual)
        passed = transmission(self.air_mass(direction[None]), self.air.extinction_mag(b_v))
        return replace(body, place=place, flux_e_s_m2=body.flux_e_s_m2 * float(passed[0]))

    def seeing_px(self, boresight: Floats, focal_px: float) -> float:
        """Standard deviation of the seeing at the boresight in pixels: that at the zenith times X^0.6 (Fried 1966)."""
        at_zenith_px = self.air.config.seeing_px(focal_px)
        return at_zenith_px and at_zenith_px * float(self.air_mass(boresight[None])[0] ** 0.6)


@lru_cache(maxsize=8)  # a frame asks several times
def topocentric_axes(time: datetime.datetime, site: SiteConfig) -> Floats:
    """(3, 3) rows north, east and the ellipsoid's zenith at a site, in ICRS axes at a time.

    Earth rotation angle of UT1, precession and nutation of IAU 2006/2000A, as in `ephemeris.site_in_gcrs`. Polar motion
    (0.3") and the deflection of the vertical (some arcseconds) are neglected: they move the zenith, and so change the
    refraction by less than 0.01".
    """
    assert site.longitude_deg is not None  # the scene's validation requires it
    longitude, latitude = np.radians([site.longitude_deg, site.latitude_deg])
    sidereal = longitude + erfa.era00(ut1_jd(time), 0.0)
    # At the site in axes of the intermediate equator.
    east, north, zenith = sky_axes(sidereal, latitude)
    return np.array([north, east, zenith]) @ erfa.c2i06a(tt_jd(time), 0.0)


def horizon_rad(config: HorizonConfig | None, azimuth_rad: Floats) -> Floats:
    """(N,) altitudes of the skyline at azimuths, linear between the rows of its table and across north."""
    if config is None:
        return np.zeros(len(azimuth_rad))
    table_rad = np.radians(config.azimuth_deg)
    return np.interp(
        azimuth_rad, table_rad, np.radians(config.altitude_deg), period=2 * np.pi
    )


def weather_of(config: AirConfig, site: SiteConfig, band: Band) -> Weather:
    """The weather at a site: that of the scene's section, with the standard atmosphere for what it leaves out."""
    pressure_hpa = config.pressure_hpa
    temperature_c = config.temperature_c
    return Weather(
        site.height_m,
        float(np.radians(site.latitude_deg)),
        standard_pressure_hpa(site.height_m) if pressure_hpa is None else pressure_hpa,
        standard_temperature_c(site.height_m) if temperature_c is None else temperature_c,
        config.humidity,
        mean_wavelength_m(band) if config.wavelength_m is None else config.wavelength_m,
    )


def mean_wavelength_m(band: Band) -> float:
    """Mean wavelength of a G2 star's photo-electrons."""
    return float(mean_of(band, lambda wavelength_m: wavelength_m, temperature_k(*SUN)))


def mean_of(band: Band, value: Curve, kelvin: Floats) -> Floats:
    """Mean of a function f of the wavelength over black bodies' photo-electrons: int f n R / int n R."""
    total = band.integral(lambda wavelength_m: black_body_v0(wavelength_m, kelvin))
    weighted = band.integral(
        lambda wavelength_m: value(wavelength_m) * black_body_v0(wavelength_m, kelvin)
    )
    return weighted / total
