"""Effects of the lens and its baffle: stray light from outside the field, ghosts, and veiling glare."""

import itertools
from collections.abc import Sequence

import numpy as np

from skysim.camera.discs import centers_of
from skysim.camera.glow.earth_glow import stray_around_e_s_m2, stray_of_bodies_e_s_m2
from skysim.camera.glow.stray import ghost_optics
from skysim.core.types import frozen
from skysim.scene.sections.camera import BaffleConfig, GhostConfig, GlareConfig
from skysim.simulation.lights.light import (
    AddedLight,
    Beam,
    Exposure,
    Light,
    Lit,
    beam_of,
)
from skysim.sources.bodies import BodyLight

STRAY_LIGHT = "stray light"


@frozen
class Baffle(AddedLight):
    """Stray light past the baffle from all bodies that nothing hides, and from the Earth, uniform over the detector."""

    config: BaffleConfig

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        return beam.plus(
            Lit(STRAY_LIGHT, glow=lambda: float(sum(self.stray_e_s(beam, exposure).values())))
        )

    def stray_e_s(self, beam: Beam, exposure: Exposure) -> dict[str, float]:
        """Stray light in electrons s^-1 px^-1, by the name of the body that emits it."""
        bodies: list[BodyLight] = []
        for lit in beam.lits:
            occludes = lit.occlusion
            hidden = np.zeros(len(lit.discs), bool)
            if occludes:
                hidden = occludes(centers_of(lit.discs).place)
            bodies += itertools.compress(lit.discs, ~hidden)
        found = stray_of_bodies_e_s_m2(self.config, bodies, exposure.boresight)
        for lit in beam.lits:
            if lit.around is not None:
                found[lit.name] = stray_around_e_s_m2(
                    self.config, *lit.around(), exposure.boresight
                )
        pixel_m2 = exposure.optics.camera.pixel_m**2
        return {name: light * pixel_m2 for name, light in found.items()}


def stray_e_s(lights: Sequence[Light], exposure: Exposure) -> dict[str, float]:
    """Stray light past the baffle in electrons s^-1 px^-1, by name of the body; empty without a baffle."""
    for n, light in enumerate(lights):
        if isinstance(light, Baffle):
            return light.stray_e_s(beam_of(lights[:n], exposure), exposure)
    return {}


@frozen
class Ghosts(AddedLight):
    """Ghost images: pairs of surfaces of the lens reflect light onto the detector a second time."""

    ghosts: tuple[GhostConfig, ...]

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        paths = (ghost_optics(exposure.optics, ghost) for ghost in self.ghosts)
        return beam._replace(paths=(*beam.paths, *paths))


@frozen
class Glare(AddedLight):
    """Veiling glare: light that the lens scatters over the detector."""

    config: GlareConfig

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        return beam._replace(glares=(*beam.glares, self.config))
