"""Sun, Moon and planets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from skysim.scene.sections.light import BodiesConfig, StarsConfig
from skysim.simulation.lights.light import Exposure, Light, Lit
from skysim.simulation.lights.plan import Plan
from skysim.sources.solar_system.bodies import bodies_from


@dataclass(frozen=True)
class SolarSystem(Light):
    """The bodies that `light.bodies` chooses, seen from the camera's place."""

    config: BodiesConfig

    def during(self, exposure: Exposure) -> Lit:
        bodies = bodies_from(self.config, exposure.observer, exposure.band)
        return Lit("Sun, Moon and planets", discs=tuple(bodies))


def build(plan: Plan) -> Iterator[Light]:
    light = plan.scene.light
    if isinstance(light, StarsConfig) and light.bodies:
        yield SolarSystem(light.bodies)
