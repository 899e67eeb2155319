"""The bodies of a scene at a time, as light sources: points, or discs of many points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.core.types import BodyTruth, Floats
from skysim.scene.sections.light import BodiesConfig
from skysim.sources.photometry import Band
from skysim.sources.solar_system.colors import ALBEDO, reflected_chromatic, reflected_flux_e_s_m2
from skysim.sources.solar_system.discs import LAMBERT, LIMB_DARKENED, LOMMEL_SEELIGER, Surface
from skysim.sources.solar_system.magnitudes import earthshine_fraction, magnitude
from skysim.sources.solar_system.observer import Observer
from skysim.sources.solar_system.places import Place, place

ID_BASE = 9_000_000  # a body's number is this + NAIF's


class Body(NamedTuple):
    """Properties of a body: NAIF's number, mean radius, and how its surface scatters.

    Radii: IAU WGCCRE 2015 (Archinal et al. 2018, Celest. Mech. 130, 22), the Sun's IAU 2015 B3.
    """

    naif: int
    radius_km: float
    law: int

    @property
    def id(self) -> int:
        return ID_BASE + self.naif


BODIES = {
    "sun": Body(10, 695_700.0, LIMB_DARKENED),
    "moon": Body(301, 1737.4, LOMMEL_SEELIGER),
    "mercury": Body(199, 2439.4, LOMMEL_SEELIGER),
    "venus": Body(299, 6051.8, LAMBERT),
    "mars": Body(499, 3389.5, LOMMEL_SEELIGER),
    "jupiter": Body(599, 69_911.0, LAMBERT),
    "saturn": Body(699, 58_232.0, LAMBERT),
    "uranus": Body(799, 25_362.0, LAMBERT),
    "neptune": Body(899, 24_622.0, LAMBERT),
}
NAMES = {body.id: name.capitalize() for name, body in BODIES.items()}


@dataclass(frozen=True, slots=True)
class BodyLight:
    """One body in the sky, in the lab's axes (the ICRS).

    radius_rad : of its disc;  flux_e_s_m2 : photo-electrons at the aperture;  earthshine : see `Surface`
    chromatic  : (4,) a row of `Sources.chromatic`
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
        """Its name in a sentence."""
        return {"sun": "the Sun", "moon": "the Moon"}.get(self.name, self.name.capitalize())

    @property
    def surface(self) -> Surface:
        return Surface(BODIES[self.name].law, self.place.phase_rad, self.earthshine)

    def truth(self) -> BodyTruth:
        """What a frame's truth says of the body."""
        x, y, z = self.place.direction
        ra_deg = np.degrees(np.arctan2(y, x)) % 360
        dec_deg = np.degrees(np.arcsin(z))
        diameter_arcsec = np.degrees(2 * self.radius_rad) * 3600
        phase_deg = np.degrees(self.place.phase_rad)
        numbers = map(float, (self.magnitude, ra_deg, dec_deg, diameter_arcsec, phase_deg))
        return BodyTruth(self.id, self.name, *numbers)

    def directions(self, xy: Floats) -> Floats:
        """(M, 3) unit vectors toward points (M, 2) of the disc, in units of its radius."""
        x_axis = self.place.toward_sun
        center = self.place.direction
        offset = xy @ np.stack([x_axis, np.cross(center, x_axis)])
        vectors = center + np.tan(self.radius_rad) * offset
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))

    def overlaps(self, other: BodyLight) -> bool:
        """Whether two discs overlap."""
        cosine = float(self.place.direction @ other.place.direction)
        return cosine > np.cos(self.radius_rad + other.radius_rad)

    def hides(self, directions: Floats) -> NDArray[np.bool_]:
        """(M,) which of these unit vectors (M, 3) lie behind the disc."""
        return directions @ self.place.direction > np.cos(self.radius_rad)


def bodies_from(config: BodiesConfig, observer: Observer, band: Band) -> list[BodyLight]:
    """The chosen bodies as an observer sees them, the farthest first."""
    lights = [
        body_light(name, place(name, observer), observer.tt_jd, band) for name in chosen(config)
    ]
    return sorted(lights, key=lambda light: -light.place.distance_km)


def chosen(config: BodiesConfig) -> list[str]:
    """The names of the bodies that the section switches on."""
    planets = [name for name in BODIES if name not in ("sun", "moon")]
    return ["sun"] * config.sun + ["moon"] * config.moon + planets * config.planets


def body_light(name: str, at: Place, tt_jd: float, band: Band) -> BodyLight:
    """The light of a body at its place."""
    body = BODIES[name]
    v_mag = magnitude(name, at, tt_jd)
    earthshine = earthshine_fraction(at) if name == "moon" else 0.0
    flux = reflected_flux_e_s_m2(v_mag, ALBEDO[name], band)
    radius_rad = float(np.arcsin(body.radius_km / at.distance_km))
    colors = reflected_chromatic(ALBEDO[name], band)
    return BodyLight(name, at, v_mag, radius_rad, flux * (1 + earthshine), earthshine, colors)
