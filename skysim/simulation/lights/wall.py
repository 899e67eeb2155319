"""Light that a dome's wall and floor send on: a glow, and images of LEDs in a wall that mirrors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from skysim.camera.glow.stray import (images_in_wall, wall_glow)
from skysim.core.types import Floats
from skysim.scene.sections.leds import WarmUpConfig
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.lights.known import known_light
from skysim.simulation.lights.light import (Beam, Exposure, Light, Lit)
from skysim.simulation.lights.light import Plan
from skysim.sources.dome.led import warm_up_factor
from skysim.sources.dome.interreflection import (ReflectingDome, reflecting_dome)


def images_of(name: str) -> str:
    """The name of the images of lights in the wall."""
    return f"images of {name} in the wall"


IMAGES = images_of("LEDs")


@dataclass(frozen=True)
class WallGlow(Light):
    """The glow of wall and floor, which wanes with the LEDs as they warm up."""

    only_adds: ClassVar[bool] = True
    dome: ReflectingDome
    warm_up: WarmUpConfig | None

    def during(self, exposure: Exposure) -> Lit:
        return Lit("the dome's wall", glow=lambda: self.glow(exposure))

    def glow(self, exposure: Exposure) -> Floats:
        """(h, w) electrons s^-1 px^-1 at the nodes of the background."""
        full = wall_glow(
            self.dome, exposure.optics, exposure.cam_from_lab, exposure.camera_m, exposure.band
        )
        return warm_up_factor(self.warm_up, exposure.t_s) * full


@dataclass(frozen=True)
class Mirror(Light):
    """The images of the LEDs, and of other lights in the laboratory, in the wall."""

    only_adds: ClassVar[bool] = True
    dome: ReflectingDome

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        for lit in beam.lits:
            if lit.points is not None and len(lit.points):
                beam = beam.plus(self.image(lit, exposure))
        return beam

    def image(self, lit: Lit, exposure: Exposure) -> Lit:
        """The images of one light, which the same things hide."""
        assert lit.points is not None
        images = images_in_wall(
            self.dome, lit.points, exposure.optics, exposure.cam_from_lab, exposure.camera_m
        )
        return Lit(images_of(lit.name), False, images, lit.emitter, hidden_by=lit.hidden_by)


def build(plan: Plan) -> Iterator[Light]:
    """What a wall or a floor reflects: a glow if it scatters, images if it mirrors."""
    light = plan.scene.light
    dome = reflecting_dome(light, known_light(plan).sources)
    if isinstance(light, DomeConfig) and dome is not None:
        if dome.diffuse is not None:
            yield WallGlow(dome, light.led.warm_up)
        if dome.config.mirrors:
            yield Mirror(dome)
