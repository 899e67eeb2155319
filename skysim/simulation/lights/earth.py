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
from skysim.simulation.lights.light import Beam, EdgedGlow, Exposure, Light, Lit, Occluder
from skysim.simulation.lights.plan import Plan
from skysim.sources.orbit.earth import hidden_by_earth, sun_m

NAME = "the Earth"


@dataclass(frozen=True)
class DarkEarth(Light):
    """An Earth that only hides: stars one by one, and the disc of a body as a whole, by its center.

    Satellites, which may be before it, come after it in the list of lights.
    """

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        position_m = exposure.observer.from_earth.position_m

        def hides(place: Floats) -> NDArray[np.bool_]:
            return hidden_by_earth(position_m, place[:, :3]) & (place[:, 3] == 0)

        occluder = Occluder(NAME, hides)

        def change(lit: Lit) -> Lit:
            if not lit.discs:
                return lit.behind(occluder)
            return lit._replace(
                discs=tuple(disc for disc in lit.discs if not hidden_by_earth(position_m, disc.place.direction))
            )

        return beam.changed(change).plus(self.during(exposure))

    def during(self, exposure: Exposure) -> Lit:
        return Lit(NAME)


@dataclass(frozen=True)
class LitEarth(DarkEarth):
    """An Earth that also shines."""

    config: EarthConfig

    def during(self, exposure: Exposure) -> Lit:
        position_m = exposure.observer.from_earth.position_m
        seen_from = (self.config, position_m, sun_m(exposure.observer.tt_jd))
        glow = earth_light(*seen_from, exposure.optics, exposure.cam_from_lab, exposure.band)
        edged = () if glow is None else (EdgedGlow(glow),)
        return Lit(NAME, edged=edged, around=lambda: earth_around(*seen_from, exposure.band))


def build(plan: Plan) -> Iterator[Light]:
    orbit = plan.scene.orbit
    if orbit:
        yield LitEarth(orbit.earth) if orbit.earth else DarkEarth()
