"""The inside of the dome and the LEDs on it, in the lab frame."""

from __future__ import annotations

from skysim import light
from skysim.layout import HOLES as HOLES
from skysim.layout import LAYOUTS as LAYOUTS
from skysim.layout import board_of as board_of
from skysim.layout import cap as cap
from skysim.layout import patch_boards as patch_boards
from skysim.photometry import Band
from skysim.surface import SURFACES as SURFACES
from skysim.surface import Ellipsoid as Ellipsoid
from skysim.surface import Plane as Plane
from skysim.surface import Surface as Surface
from skysim.surface import surface as surface
from skysim.types import Sources


def sources(part: light.Dome, band: Band) -> Sources:
    """Every LED of the dome, as bright as the chip's band makes it: strength is photo-electrons s^-1 sr^-1."""
    return LAYOUTS[part.layout.kind](part.layout, surface(part.surface), part.led, band)
