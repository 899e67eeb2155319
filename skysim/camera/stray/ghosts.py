"""Ghosts: light that two surfaces of a lens reflect, so that it reaches the chip a second time.

To first order the reflected light has a focal length of its own: a pair of surfaces images the field again, m times as
large, through the same axis, and out of focus. A light at x on the chip has its ghost at

    c - m (x - c),

with c the principal point; m > 0 puts it on the other side. A ghost takes part in everything else as its light does:
motion, pulses, shutter, vignetting.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

from skysim.camera.optics import Optics, ScaledOptics
from skysim.core.types import SourceTruth
from skysim.scene.sections.camera import DiskPsfConfig, GhostConfig
from skysim.sources.false_lights import GHOST

BLUR_PX = 0.7  # of a ghost's edge


@lru_cache(maxsize=64)
def ghost_optics(optics: Optics, ghost: GhostConfig) -> ScaledOptics:
    """The lens by the pair of surfaces of a ghost: its light is a share of the image's, spread over a disk.

    Its field is that of all lights whose ghosts reach the chip.
    """
    blur = DiskPsfConfig(kind="disk", radius_px=ghost.radius_px, sigma_px=BLUR_PX)
    camera = optics.camera.model_copy(update={"psf": blur})
    reach = (1 + ghost.radius_px / camera.corner_px) / abs(ghost.magnification)
    field_rad = math.atan(math.tan(optics.field_rad) * reach)
    scale = -ghost.magnification * getattr(optics, "scale", 1.0)
    return ScaledOptics(
        camera, optics.collecting_m2 * ghost.share, optics.fold_r, field_rad, scale=scale
    )


def as_ghosts(lights: SourceTruth, number: int) -> SourceTruth:
    """The truth of the lights of a pair of surfaces, as that of its ghosts; pairs are numbered from 1."""
    return replace(lights, id=lights.id + number * GHOST)
