"""Numbers of lights that no star and no LED has, in the truth of frames: reflections of LEDs and ghosts of a lens."""

from __future__ import annotations

from skysim.sources.orbit.satellites import ID_BASE
from skysim.sources.bodies import NAMES

MIRRORED = 10_000_000  # the n-th image of an LED in the wall has n times this number and the LED's
GHOST = 1_000_000_000_000  # the n-th ghost of a light has n times this number and the light's


def light_name(id: int) -> str:
    """What a number of the truth stands for: a body's name, a reflection's or a ghost's source; else the number."""
    if id >= GHOST:
        return f"ghost of {light_name(id % GHOST)}"
    if MIRRORED <= id < ID_BASE:
        return f"reflection of {id % MIRRORED}"
    return NAMES.get(id, str(id))
