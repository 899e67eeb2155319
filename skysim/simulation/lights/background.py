"""The scene's section `background`: light leaks and the glow of the sky."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from skysim.camera.glow.background import glow_map
from skysim.scene.sections.light import Glow
from skysim.simulation.lights.light import Exposure, Light, Lit
from skysim.simulation.lights.plan import Plan

BACKGROUND = "background"


@dataclass(frozen=True)
class Background(Light):
    """Extended light that does not change from frame to frame."""

    only_adds: ClassVar[bool] = True
    glows: tuple[Glow, ...]

    def during(self, exposure: Exposure) -> Lit:
        return Lit(
            BACKGROUND,
            glow=lambda: glow_map(
                self.glows, exposure.optics, exposure.cam_from_lab, exposure.band
            ),
        )


def build(plan: Plan) -> Iterator[Light]:
    yield Background(plan.scene.background)
