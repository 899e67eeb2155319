"""The bodies of a scene at a time, as light sources: points, or discs of many points."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from skysim.core.types import BodyTruth, Bools, Floats, frozen, normalized
from skysim.scene.sections.light import BodiesConfig
from skysim.sources.body_discs import (
    LAMBERT,
    LIMB_DARKENED,
    LOMMEL_SEELIGER,
    DiscSurface,
    earthshine_fraction,
    magnitude,
)
from skysim.sources.ephemeris import ObserverPlace, Place, place
from skysim.sources.photometry import (
    SUN,
    Band,
    black_body_v0,
    chromatic_moments,
    temperature_k,
)

# Reflected sunlight in photo-electrons, by the albedo of a body at four wavelengths. A planet is no star: methane makes
# Uranus brightest in blue and dark beyond 700 nm, a color that no black body has.


Albedo = tuple[float, float, float, float]

# Effective wavelengths of B, V, Cousins' R and I (Bessell 2005, ARA&A 43, 293).
BANDS_M = (438e-9, 545e-9, 641e-9, 798e-9)
WHITE: Albedo = (1.0, 1.0, 1.0, 1.0)


def reflected_flux_e_s_m2(v_mag: float, albedo: Albedo, band: Band) -> float:
    """Photo-electrons s^-1 m^-2 of a body of this V magnitude: 10^(-0.4 V) int n(l) p(l) / p(V) R(l) dl.

    n is the photon flux of a star like the Sun of V = 0 at the wavelength l, R the band's response, and p the albedo,
    linear between the four bands and constant beyond them.
    """
    return float(_flux_v0_e_s_m2(albedo, band) * 10 ** (-0.4 * v_mag))


@lru_cache(maxsize=64)
def _flux_v0_e_s_m2(albedo: Albedo, band: Band) -> float:
    """`reflected_flux_e_s_m2` for V = 0."""
    return float(band.integral(lambda wavelength_m: reflected_v0(wavelength_m, albedo)))


def reflected_v0(wavelength_m: Floats, albedo: Albedo) -> Floats:
    """Spectral photon flux of a body of V = 0, in the units of `black_body_v0`."""
    # Relative to V, in which the magnitude is given.
    relative = np.array(albedo) / albedo[1]
    return black_body_v0(wavelength_m, temperature_k(*SUN)) * np.interp(
        wavelength_m, BANDS_M, relative
    )


@lru_cache(maxsize=64)
def reflected_chromatic(albedo: Albedo, band: Band) -> Floats | None:
    """(4 + 2 K,) `chromatic_moments` of a body; None for a lens without chromatic aberration."""
    if band.chromatic is None:
        return None
    return chromatic_moments(band, lambda wavelength_m: reflected_v0(wavelength_m, albedo))


# Bodies of the solar system as light sources: points, or discs of many points.


ID_BASE = 9_000_000  # a body's number is this + NAIF's


class Body(NamedTuple):
    """Properties of a body.

    Radii: IAU WGCCRE 2015 (Archinal et al. 2018, Celest. Mech. 130, 22), the Sun's IAU 2015 B3.

    Attributes
    ----------
    naif
        NAIF's number of the body; an asteroid's is less 2,000,000
    radius_km
        Mean radius
    law
        Law of its surface's brightness, see `body_discs.brightness`
    albedo
        Albedos at BANDS_M; only their ratios count. If not given, B-V is 0.85, as that of Europa, Ganymede and Callisto
        within 0.02 (Io's is 1.17, Vesta's 0.78 and Ceres's 0.71), and they are gray beyond V
    """

    naif: int
    radius_km: float
    law: int = LOMMEL_SEELIGER
    albedo: Albedo = (0.832, 1.0, 1.0, 1.0)

    @property
    def id(self) -> int:
        return ID_BASE + self.naif


# Planets: geometric albedos of Mallama, Krobusek & Pavlov 2017, Icarus 282, 19 (arXiv:1609.05048), table 7. The Moon,
# relative to V: Kieffer & Stone 2005, AJ 129, 2887, equation 10 and table 4 at a phase angle of 45 degrees without
# libration, smoothed by a parabola in the logarithms; it reddens by 0.1 mag in V-I from full to quarter.
PLANETS = {
    "mercury": Body(199, 2439.4, LOMMEL_SEELIGER, (0.105, 0.142, 0.158, 0.180)),
    "venus": Body(299, 6051.8, LAMBERT, (0.658, 0.689, 0.658, 0.640)),
    "mars": Body(499, 3389.5, LOMMEL_SEELIGER, (0.088, 0.170, 0.250, 0.285)),
    "jupiter": Body(599, 69_911.0, LAMBERT, (0.443, 0.538, 0.513, 0.389)),
    "saturn": Body(699, 58_232.0, LAMBERT, (0.339, 0.499, 0.646, 0.543)),
    "uranus": Body(799, 25_362.0, LAMBERT, (0.561, 0.488, 0.264, 0.089)),
    "neptune": Body(899, 24_622.0, LAMBERT, (0.562, 0.442, 0.226, 0.072)),
}
MINOR = {
    "io": Body(501, 1821.5),
    "europa": Body(502, 1560.8),
    "ganymede": Body(503, 2631.2),
    "callisto": Body(504, 2410.3),
    "ceres": Body(1, 470.0),
    "vesta": Body(4, 255.0),
}
BODIES = {
    "sun": Body(10, 695_700.0, LIMB_DARKENED, WHITE),
    "moon": Body(301, 1737.4, LOMMEL_SEELIGER, (0.786, 1.0, 1.169, 1.402)),
    **PLANETS,
    **MINOR,
}
NAMES = {body.id: name.capitalize() for name, body in BODIES.items()}


@frozen
class BodyLight:
    """One body in the sky, in the lab's axes (the ICRS).

    Attributes
    ----------
    radius_rad
        Angular radius of the disc
    flux_e_s_m2
        Photo-electrons s^-1 m^-2 at the aperture
    earthshine
        As in `DiscSurface`
    chromatic
        (4 + 2 K,) a row of `Sources.chromatic`
    """

    name: str
    place: Place
    magnitude: float
    radius_rad: float
    flux_e_s_m2: float
    earthshine: float = 0.0
    chromatic: Floats | None = None

    @property
    def id(self) -> int:
        return BODIES[self.name].id

    @property
    def title(self) -> str:
        """The body's name within a sentence."""
        return {"sun": "the Sun", "moon": "the Moon"}.get(self.name, self.name.capitalize())

    @property
    def surface(self) -> DiscSurface:
        return DiscSurface(BODIES[self.name].law, self.place.phase_rad, self.earthshine)

    def truth(self) -> BodyTruth:
        """The body's row in a frame's truth."""
        x, y, z = self.place.direction
        ra_deg = np.degrees(np.arctan2(y, x)) % 360
        dec_deg = np.degrees(np.arcsin(z))
        diameter_arcsec = np.degrees(2 * self.radius_rad) * 3600
        phase_deg = np.degrees(self.place.phase_rad)
        numbers = map(float, (self.magnitude, ra_deg, dec_deg, diameter_arcsec, phase_deg))
        return BodyTruth(self.id, self.name, *numbers)

    def directions(self, xy: Floats) -> Floats:
        """(M, 3) unit vectors toward points (M, 2) of the disc, whose x points to the Sun, in units of its radius."""
        x_axis = self.place.toward_sun
        center = self.place.direction
        # From the disc's plane to directions: x toward the Sun, y across.
        offset = xy @ np.stack([x_axis, np.cross(center, x_axis)])
        # On the tangent plane at the disc's center.
        vectors = center + np.tan(self.radius_rad) * offset
        return normalized(vectors)

    def overlaps(self, other: "BodyLight") -> bool:
        """Whether the disc overlaps another body's disc."""
        cosine = float(self.place.direction @ other.place.direction)
        return cosine > np.cos(self.radius_rad + other.radius_rad)

    def hides(self, directions: Floats) -> Bools:
        """(M,) which of the unit vectors (M, 3) point to the disc, so that what is behind it is hidden."""
        return directions @ self.place.direction > np.cos(self.radius_rad)


def bodies_from(config: BodiesConfig, observer: ObserverPlace, band: Band) -> list[BodyLight]:
    """The chosen bodies as an observer sees them, the farthest first, so that nearer ones are drawn over them."""
    lights = [
        body_light(name, place(name, observer), observer.tt_jd, band)
        for name in chosen(config)
    ]
    return sorted(lights, key=lambda light: -light.place.distance_km)


def chosen(config: BodiesConfig) -> list[str]:
    """The names of the bodies that the section switches on."""
    return (
        ["sun"] * config.sun
        + ["moon"] * config.moon
        + list(PLANETS) * config.planets
        + list(MINOR) * config.minor
    )


def body_light(name: str, at: Place, tt_jd: float, band: Band) -> BodyLight:
    """The light of a body at its place."""
    body = BODIES[name]
    v_mag = magnitude(name, at, tt_jd)
    # Earthshine is modeled for the Moon alone.
    earthshine = earthshine_fraction(at) if name == "moon" else 0.0
    flux = reflected_flux_e_s_m2(v_mag, body.albedo, band)
    radius_rad = float(np.arcsin(body.radius_km / at.distance_km))
    colors = reflected_chromatic(body.albedo, band)
    return BodyLight(name, at, v_mag, radius_rad, flux * (1 + earthshine), earthshine, colors)
