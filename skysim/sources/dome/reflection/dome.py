"""A dome that reflects, as a scene describes it."""

from __future__ import annotations

from typing import NamedTuple

from skysim.core.types import Sources
from skysim.scene.sections.light import DomeConfig, ReflectionConfig
from skysim.sources.dome.reflection.interreflection import DiffuseLight, diffuse_light
from skysim.sources.dome.shell.surface import Surface, build_surface


class ReflectingDome(NamedTuple):
    """Wall and floor; `diffuse` is their light, None if they only mirror."""

    config: ReflectionConfig
    wall: Surface
    diffuse: DiffuseLight | None


def reflecting_dome(light: object, leds: Sources) -> ReflectingDome | None:
    """The reflecting dome of a scene's light and its LEDs; None if nothing reflects."""
    if not isinstance(light, DomeConfig) or light.reflection is None:
        return None
    config = light.reflection
    wall = build_surface(light.surface)
    diffuse = (
        diffuse_light(config, wall, leds, light.led.lobe)
        if config.diffuse or config.floor
        else None
    )
    return ReflectingDome(config, wall, diffuse)
