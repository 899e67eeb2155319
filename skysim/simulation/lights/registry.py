"""All kinds of lights, in the order in which their light passes to the lens, and the kinds that programs add.

An entry of `LIGHTS` makes none, one or more lights from a `LightPlan`. An obstacle hides the lights before it; air,
wall and lens change the lights before them. Lights are drawn in this order.

`register` adds a kind of the scene's list `lights`. Any imported module may call it, or a module of an installed
package that an entry point of the group `skysim.lights` names (see scene/sections/light.py).
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

from skysim.scene.sections.light import LightConfig, add_kind
from skysim.simulation.lights import atmosphere, lab_room, lens, sky_bodies, starlight
from skysim.simulation.lights.dome import known_light
from skysim.simulation.lights.light import Light, LightPlan

KINDS: dict[str, Callable[[Any, LightPlan], Light]] = {}


def register(config: type[LightConfig], build: Callable[[Any, LightPlan], Light]) -> None:
    """Add a kind of light to those of the scene's list `lights`.

    Parameters
    ----------
    config
        Schema of its section, with a literal `kind`
    build
        Function from a section and a plan to the light
    """
    KINDS[add_kind(config)] = build


def further_lights(plan: LightPlan) -> Iterator[Light]:
    """The lights of the scene's list `lights`."""
    for config in plan.scene.lights:
        yield KINDS[config.kind](config, plan)


LIGHTS: dict[str, Callable[[LightPlan], Iterable[Light]]] = {
    "background": starlight.build,
    "stars, LEDs or a display": lambda plan: [known_light(plan)],
    "Sun, Moon and planets": sky_bodies.build_solar_system,
    "Earth": sky_bodies.build_earth,
    "satellites": sky_bodies.build_satellites,
    "air": atmosphere.build,
    "further lights": further_lights,
    "wall": lab_room.build_wall,
    "baffle": lens.build_baffle,
    "vehicle and dome": lab_room.build_obstacles,
    "lens": lens.build,
}


def build_lights(plan: LightPlan) -> tuple[Light, ...]:
    """All lights of a camera. Raises InputError for unreadable files, and for a dome that does not fit its room."""
    # Several entries need the known light; make it once.
    plan = replace(plan, known=known_light(plan))
    return tuple(light for build in LIGHTS.values() for light in build(plan))
