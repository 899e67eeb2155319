"""A lab whose main camera sees other light."""

from dataclasses import replace

from skysim.core.types import Sources
from skysim.simulation.lab import Lab
from skysim.simulation.lights.light import Light


def with_lights(lab: Lab, lights: tuple[Light, ...]) -> Lab:
    """The lab with other lights for its main camera."""
    return replace(lab, cameras=(replace(lab.camera, lights=lights), *lab.cameras[1:]))


def with_light(lab: Lab, light: Light) -> Lab:
    """The lab with one light of the main camera replaced: that of the same class."""
    return with_lights(
        lab, tuple(light if type(one) is type(light) else one for one in lab.camera.lights)
    )


def with_sources(lab: Lab, sources: Sources) -> Lab:
    """The lab with other stars or LEDs for its main camera."""
    return with_light(lab, replace(lab.camera.known, sources=sources))
