"""All kinds of lights, in the order in which their light passes to the lens, and the kinds that programs add.

`build_lights` makes them from a `LightPlan`. An obstacle hides the lights before it; air, wall and lens change the
lights before them. Lights are drawn in this order.

`register` adds a kind of the scene's list `lights`. Any imported module may call it, or a module of an installed
package that an entry point of the group `skysim.lights` names (see scene/sections/light.py).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

from skysim.dynamics import multibody
from skysim.scene.sections.light import CONFIGS, LightConfig
from skysim.simulation.lights.effects import (
    AirEffects,
    AirGlow,
    Baffle,
    DomeWall,
    Ghosts,
    Glare,
    Mirror,
    Skyline,
    Vehicle,
    WallGlow,
)
from skysim.simulation.lights.emitters import (
    BackgroundLight,
    Earth,
    Satellites,
    SolarSystem,
    known_light,
)
from skysim.simulation.lights.light import Light, LightPlan
from skysim.sources.air import Air
from skysim.sources.dome.interreflection import reflecting_dome
from skysim.sources.dome.surface import build_surface
from skysim.sources.orbit_elements import check_epochs, read_elements

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
    (kind,) = get_args(config.model_fields["kind"].annotation)
    CONFIGS[kind] = config
    KINDS[kind] = build


def build_lights(plan: LightPlan) -> tuple[Light, ...]:
    """All lights of a camera. Raises InputError for unreadable files, and for a dome that does not fit its room."""
    scene = plan.scene
    camera = scene.camera
    dome = scene.dome
    sky = scene.stars
    # Light leaks and the glow of the sky; stars, LEDs or a display.
    known = known_light(plan)
    plan = replace(plan, known=known)
    found: list[Light] = [BackgroundLight(scene.background), known]
    if sky and sky.bodies:
        found.append(SolarSystem(sky.bodies))
    if scene.orbit:
        found.append(Earth(scene.orbit.earth))
    if sky and sky.satellites:
        elements = []
        if file := sky.satellites.file:
            elements = read_elements(file)
            check_epochs(file, elements, scene.start_time)
        found.append(Satellites(sky.satellites, elements))
    if sky and sky.air and plan.catalog is not None:
        air = Air.from_config(sky.air, scene.site, plan.catalog, plan.band)
        found += [AirEffects(air), Skyline(air)]
        if sky.air.glow:
            found.append(AirGlow(air, sky.air.glow))
    found += [KINDS[config.kind](config, plan) for config in scene.lights]
    # Light that the wall or the floor of a dome reflects.
    if dome and dome.reflection:
        wall = reflecting_dome(dome, dome.reflection, known.sources)
        if wall.diffuse is not None:
            found.append(WallGlow(wall, dome.led.warm_up))
        if wall.config.mirrors:
            found.append(Mirror(wall))
    if camera.baffle:
        found.append(Baffle(camera.baffle))
    # A collimated display has no obstacles in its beam.
    if getattr(scene.light, "occlusion", False):
        found.append(Vehicle(multibody.Obstacles(plan.vehicle, plan.mount)))
        if dome:
            found.append(DomeWall(build_surface(dome.surface)))
    if camera.ghosts:
        found.append(Ghosts(camera.ghosts))
    if camera.glare:
        found.append(Glare(camera.glare))
    return tuple(found)
