"""The Earth under a camera in orbit: what it hides, and the light of its day side and its air."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skysim.camera.glow.baffle import earth_around
from skysim.camera.glow.earth_glow import earth_light
from skysim.core.types import Floats
from skysim.scene.sections.orbit import EarthConfig
from skysim.simulation.lights.light import EdgedGlow, Exposure, Light, Lit, Obstacle, Occluder
from skysim.simulation.lights.plan import Plan
from skysim.sources.orbit.earth import hidden_by_earth, sun_m

NAME = "the Earth"


@dataclass(frozen=True)
class DarkEarth(Obstacle):
    """An Earth that only hides: stars one by one, and bodies as a whole.

    Satellites, which may be before it, come after it in the list of lights.
    """

    def during(self, exposure: Exposure) -> Lit:
        position_m = exposure.observer.from_earth.position_m

        def hides(place: Floats) -> NDArray[np.bool_]:
            return hidden_by_earth(position_m, place[:, :3]) & (place[:, 3] == 0)

        return Lit(NAME, hides=Occluder(NAME, hides, whole=True))


@dataclass(frozen=True)
class LitEarth(DarkEarth):
    """An Earth that also shines."""

    config: EarthConfig

    def during(self, exposure: Exposure) -> Lit:
        here = exposure.observer
        seen_from = (self.config, here.from_earth.position_m, sun_m(here.tt_jd))
        optics = exposure.optics
        cam_from_lab = exposure.cam_from_lab
        band = exposure.band
        return (
            super()
            .during(exposure)
            ._replace(
                edged=EdgedGlow(lambda: earth_light(*seen_from, optics, cam_from_lab, band)),
                around=lambda: earth_around(*seen_from, band),
            )
        )


def build(plan: Plan) -> Iterator[Light]:
    orbit = plan.scene.orbit
    if orbit:
        yield LitEarth(orbit.earth) if orbit.earth else DarkEarth()
