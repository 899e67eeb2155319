"""The scene's own light, which a tracker can know: stars, LEDs of a dome, or stars on a collimated display."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skysim.scene.sections.light import (CollimatedDisplayConfig, DomeConfig)
from skysim.simulation.lights.dome import CollimatedDisplay, LedDome
from skysim.simulation.lights.light import KnownLight
from skysim.simulation.lights.light import Plan
from skysim.simulation.lights.stars import stars_of
from skysim.sources import dome
from skysim.sources.dome import display
from skysim.sources.dome.led import Emitter


def of_dome(config: DomeConfig, plan: Plan) -> KnownLight:
    """The LEDs of a dome. Raises InputError for LEDs off the surface, and for a dome that does not fit its room."""
    return LedDome(
        dome.sources(config, plan.band), Emitter.from_config(config.led), config, plan.scene.thermal
    )


def of_display(config: CollimatedDisplayConfig, plan: Plan) -> KnownLight:
    """The stars on a display at the scene's start."""
    assert plan.catalog is not None
    shown = display.display_sources(config, plan.catalog, plan.scene.start_time, plan.band)
    return CollimatedDisplay(shown, Emitter(), config)


# By the kind of the section `light`.
KNOWN: dict[str, Callable[[Any, Plan], KnownLight]] = {
    "dome": of_dome,
    "stars": stars_of,
    "collimated_display": of_display,
}


def known_light(plan: Plan) -> KnownLight:
    """The light of the section `light`; that of the plan, if it has been made."""
    return plan.known or KNOWN[plan.scene.light.kind](plan.scene.light, plan)
