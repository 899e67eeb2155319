"""The Earth under a camera in orbit: what it hides, and the light of its day side and its air."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skysim.camera.glow.earth_glow import earth_around, earth_light
from skysim.core.types import Floats
from skysim.scene.sections.light import BodiesConfig, StarsConfig
from skysim.scene.sections.surroundings import EarthConfig, SatellitesConfig
from skysim.simulation.lights.light import (
    EdgedGlow,
    Exposure,
    Light,
    LightPlan,
    Lit,
    Obstacle,
    Occluder,
)
from skysim.sources.bodies import bodies_from
from skysim.sources.camera_orbit import hidden_by_earth, sun_m
from skysim.sources.ephemeris import GcrsState
from skysim.sources.orbit_elements import MeanElements, read_elements
from skysim.sources.satellites import MovingLight, as_sources, known_satellites, random_satellites

NAME = "the Earth"


@dataclass(frozen=True)
class DarkEarth(Obstacle):
    """An Earth that only hides: stars one by one, and bodies as a whole.

    Satellites, which may be before it, come after it in the list of lights.
    """

    def during(self, exposure: Exposure) -> Lit:
        position_m = exposure.observer.from_earth.position_m

        def hides(place: Floats) -> NDArray[np.bool_]:
            return hidden_by_earth(position_m, place[:, :3]) & (place[:, 3] == 0)

        return Lit(NAME, hides=Occluder(NAME, hides, whole=True))


@dataclass(frozen=True)
class LitEarth(DarkEarth):
    """An Earth that also shines."""

    config: EarthConfig

    def during(self, exposure: Exposure) -> Lit:
        here = exposure.observer
        seen_from = (self.config, here.from_earth.position_m, sun_m(here.tt_jd))
        optics = exposure.optics
        cam_from_lab = exposure.cam_from_lab
        band = exposure.band
        return (
            super()
            .during(exposure)
            ._replace(
                edged=EdgedGlow(lambda: earth_light(*seen_from, optics, cam_from_lab, band)),
                around=lambda: earth_around(*seen_from, band),
            )
        )


def build_earth(plan: LightPlan) -> Iterator[Light]:
    orbit = plan.scene.orbit
    if orbit:
        yield LitEarth(orbit.earth) if orbit.earth else DarkEarth()


# Artificial satellites: those of a file, and random ones.


@dataclass(frozen=True)
class Satellites(Light):
    """Satellites that can cross the field, those of the file first.

    Attributes
    ----------
    elements
        Of the file; None without one
    """

    only_adds: ClassVar[bool] = True
    config: SatellitesConfig
    elements: MeanElements | None

    def during(self, exposure: Exposure) -> Lit:
        """Their streaks; with no seed without the random ones."""
        found: list[MovingLight] = []
        if self.elements:

            def observer_at(after_s: float) -> GcrsState:
                return exposure.viewpoint.state_at(exposure.t_s + after_s)

            known = known_satellites(
                self.elements, self.config.standard_mag, exposure.view, exposure.time, observer_at
            )
            found += known
        if self.config.random and exposure.seeds:
            found += random_satellites(
                self.config.random, exposure.view, exposure.seeds.camera, exposure.index
            )
        points = as_sources(found, exposure.band) if found else None
        return Lit("satellites", points=points, satellites=tuple(light.truth for light in found))


def build_satellites(plan: LightPlan) -> Iterator[Light]:
    light = plan.scene.light
    if isinstance(light, StarsConfig) and light.satellites:
        file = light.satellites.file
        yield Satellites(light.satellites, read_elements(file) if file else None)


# Sun, Moon and planets.


@dataclass(frozen=True)
class SolarSystem(Light):
    """The bodies that `light.bodies` chooses, seen from the camera's place."""

    config: BodiesConfig

    def during(self, exposure: Exposure) -> Lit:
        bodies = bodies_from(self.config, exposure.observer, exposure.band)
        return Lit("Sun, Moon and planets", discs=tuple(bodies))


def build_solar_system(plan: LightPlan) -> Iterator[Light]:
    light = plan.scene.light
    if isinstance(light, StarsConfig) and light.bodies:
        yield SolarSystem(light.bodies)
