"""The Earth under a camera in orbit, artificial satellites, and Sun, Moon and planets."""

from collections.abc import Sequence

from skysim.camera.glow.earth_glow import earth_around, earth_light
from skysim.core.types import Bools, Floats, frozen
from skysim.scene.sections.light import BodiesConfig
from skysim.scene.sections.surroundings import EarthConfig, SatellitesConfig
from skysim.simulation.lights.light import (
    AddedLight,
    Exposure,
    Light,
    Lit,
    Obstacle,
    Occluder,
)
from skysim.sources.bodies import bodies_from
from skysim.sources.camera_orbit import hidden_by_earth, sun_m
from skysim.sources.ephemeris import GcrsState
from skysim.sources.orbit_elements import MeanElements
from skysim.sources.satellites import (
    MovingLight,
    as_sources,
    known_satellites,
    random_satellites,
)

# The Earth under a camera in orbit: it hides stars, and its day side and its air shine.

NAME = "the Earth"


@frozen
class Earth(Obstacle):
    """The Earth, which hides stars one by one and bodies as a whole, and shines if it has a section `earth`."""

    config: EarthConfig | None

    def during(self, exposure: Exposure) -> Lit:
        here = exposure.observer
        position_m = here.from_earth.position_m

        def hides(place: Floats) -> Bools:
            return hidden_by_earth(position_m, place[:, :3]) & (place[:, 3] == 0)

        dark = Lit(NAME, hides=Occluder(NAME, hides, whole=True))
        if self.config is None:
            return dark
        seen_from = (self.config, position_m, sun_m(here.tt_jd))
        camera = exposure.camera
        return dark._replace(
            edged=lambda: earth_light(*seen_from, camera),
            around=lambda: earth_around(*seen_from, camera.band),
        )


# Artificial satellites: those of a file, and random ones.


@frozen
class Satellites(AddedLight):
    """Artificial satellites that can cross the field: those of a file, then random ones.

    Attributes
    ----------
    config
        The scene's section `light.satellites`
    elements
        Orbital elements of the file; empty without a file
    """

    config: SatellitesConfig
    elements: Sequence[MeanElements]

    def during(self, exposure: Exposure) -> Lit:
        """The satellites in the exposure; in the expectation, without seeds, there are no random ones."""

        def observer_at(after_s: float) -> GcrsState:
            """The camera's state at a time after mid-exposure."""
            return exposure.viewpoint.state_at(exposure.t_s + after_s)

        found: list[MovingLight] = []
        if self.elements:
            found += known_satellites(
                self.elements,
                self.config.standard_mag,
                exposure.view,
                exposure.time,
                observer_at,
            )
        if self.config.random and exposure.seeds:
            found += random_satellites(
                self.config.random, exposure.view, exposure.seeds.camera, exposure.index
            )
        points = as_sources(found, exposure.band) if found else None
        return Lit(
            "satellites", points=points, satellites=tuple(light.truth for light in found)
        )


# Sun, Moon and planets.


@frozen
class SolarSystem(Light):
    """The bodies that `light.bodies` selects, as seen from the camera's place."""

    config: BodiesConfig

    def during(self, exposure: Exposure) -> Lit:
        bodies = bodies_from(self.config, exposure.observer, exposure.band)
        return Lit("Sun, Moon and planets", discs=tuple(bodies))
