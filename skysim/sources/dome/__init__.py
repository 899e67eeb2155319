"""The dome's inside and the LEDs on it, in the lab frame.

surface.py: the wall as a surface; layouts/: places of the LEDs; led.py: their light; codes.py: their clocks and codes;
display.py: stars on panels and projectors; interreflection.py and mirror.py: light that the wall sends back;
survey_errors.py: what a survey of it all yields.
"""

from skysim.core.types import Sources
from skysim.scene.sections import light
from skysim.sources.dome.layouts.registry import LAYOUTS
from skysim.sources.dome.room import check_room
from skysim.sources.dome.surface import build_surface
from skysim.sources.photometry import Band


def sources(config: light.DomeConfig, band: Band) -> Sources:
    """All LEDs of a scene's dome; strength is in photo-electrons s^-1 sr^-1 in the chip's band.

    Raises
    ------
    InputError
        For LEDs off the surface, and for a dome that does not fit into its room.
    """
    surface = build_surface(config.surface)
    if config.room is not None:
        check_room(config.room, surface, config.points.cap_deg)
    return LAYOUTS[config.layout.kind](config.layout, surface, config.led, band)
