"""Artificial satellites: those of a file, and random ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from skysim.scene.sections.light import StarsConfig
from skysim.scene.sections.orbit import SatellitesConfig
from skysim.simulation.lights.light import Exposure, Light, Lit
from skysim.simulation.lights.plan import Plan
from skysim.sources.orbit.elements import Elements, read_elements
from skysim.sources.orbit.satellites import (
    MovingLight,
    as_sources,
    known_satellites,
    random_satellites,
)
from skysim.sources.solar_system.observer import GcrsState


@dataclass(frozen=True)
class Satellites(Light):
    """Satellites that can cross the field, those of the file first.

    elements : of the file; None without one
    """

    only_adds: ClassVar[bool] = True
    config: SatellitesConfig
    elements: Elements | None

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


def build(plan: Plan) -> Iterator[Light]:
    light = plan.scene.light
    if isinstance(light, StarsConfig) and light.satellites:
        file = light.satellites.file
        yield Satellites(light.satellites, read_elements(file) if file else None)
