"""All layouts of LEDs by name: LAYOUTS maps the scene's `light.layout.kind` to a function that returns all LEDs.

The real sky, and three kinds that take the points of another layout (fibers, panel, projector), are defined here,
the others in their own modules.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.random import Generator

from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Sources
from skysim.scene.sections.layouts import (
    HOLES,
    CelestialConfig,
    FibersConfig,
    Layout,
    LcdConfig,
    PatchBoardsConfig,
    ProjectorConfig,
)
from skysim.scene.sections.leds import LedConfig
from skysim.sources.dome import celestial as celestial_dome
from skysim.sources.dome.display import (
    ideal_led,
    panel_sources,
    panel_surface,
    projector_sources,
)
from skysim.sources.dome.layouts.boards import patch_boards
from skysim.sources.dome.layouts.listed import listed
from skysim.sources.dome.layouts.placing import Ints, PlacedLeds, dimmed, led_sources
from skysim.sources.dome.layouts.spreads import (
    fibonacci,
    geodesic,
    optimized,
    poisson_disk,
    random_places,
)
from skysim.sources.dome.layouts.string import displace_ends, string
from skysim.sources.dome.surface import Surface
from skysim.sources.photometry import Band

LayoutFunction = Callable[[Any, Surface, LedConfig, Band], Sources]


def fitted(place: Callable[[Any, Surface, Generator], PlacedLeds | Floats]) -> LayoutFunction:
    """The layout of the LEDs that a function places; all draws are from one stream of the hardware.

    LEDs of which it gives the places alone (N, 3) are `dimmed` by the layout's section.
    """

    def layout(config: Any, surface: Surface, led: LedConfig, band: Band) -> Sources:
        rng = random_stream(config.hardware_seed)
        placed = place(config, surface, rng)
        if not isinstance(placed, PlacedLeds):
            placed = dimmed(config, surface, placed, rng)
        return led_sources(placed, led, band, rng)

    return layout


def celestial(
    config: CelestialConfig, surface: Surface, led: LedConfig, band: Band
) -> Sources:
    """The real sky (JHU/APL's idea): an LED where the camera at its nominal place sees each of the brightest stars.

    LED numbers are Hipparcos numbers. Places are those of `celestial.project_stars`, levels those of
    `celestial.led_levels`.
    """
    stars = celestial_dome.project_stars(config, surface, led, band)
    normal = surface.inward(stars.place_m)
    level = celestial_dome.led_levels(config, stars, normal, led)
    placed = PlacedLeds(stars.hip, stars.place_m, normal, level, stars.v_mag)
    return led_sources(placed, led, band, random_stream(config.hardware_seed))


def fibers(config: FibersConfig, surface: Surface, led: LedConfig, band: Band) -> Sources:
    """Ends of optical fibers at another layout's points, with the errors of shell and holes: `displace_ends`."""
    designed = LAYOUTS[config.points.kind](config.points, surface, led, band)
    return displace_ends(config, surface, designed)


def lcd(config: LcdConfig, surface: Surface, led: LedConfig, band: Band) -> Sources:
    """Another layout's LEDs drawn on the nearest pixels of a panel: `display.panel_sources`."""
    # The points are placed on the panel as ideal LEDs, whose strengths are levels.
    panel = panel_surface(config, surface)
    stars = LAYOUTS[config.points.kind](config.points, panel, ideal_led(led), band)
    return panel_sources(config, panel, led, band, stars)


def projector(
    config: ProjectorConfig, surface: Surface, led: LedConfig, band: Band
) -> Sources:
    """Another layout's LEDs drawn on the nearest pixels of a projector: `display.projector_sources`."""
    stars = LAYOUTS[config.points.kind](config.points, surface, ideal_led(led), band)
    return projector_sources(config, surface, led, band, stars)


# Arguments: the layout's section of the scene, the surface, the LED section, the chip's band. Returns all LEDs.
LAYOUTS: dict[str, LayoutFunction] = {
    "patch_boards": fitted(patch_boards),
    "fibonacci": fitted(fibonacci),
    "poisson_disk": fitted(poisson_disk),
    "random": fitted(random_places),
    "geodesic": fitted(geodesic),
    "string": fitted(string),
    "optimized": fitted(optimized),
    "celestial": celestial,
    "listed": fitted(listed),
    "fibers": fibers,
    "lcd": lcd,
    "projector": projector,
}


def board_of(config: Layout, led_ids: Ints) -> Ints | None:
    """(N,) board of each of these LED numbers; None if boards cannot tell LEDs apart: no boards, or only one."""
    board = led_ids // HOLES
    return (
        board if isinstance(config, PatchBoardsConfig) and len(np.unique(board)) > 1 else None
    )
