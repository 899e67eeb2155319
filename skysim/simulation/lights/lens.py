"""What the lens and its baffle make of the light: light from beside the field, ghosts, and veiling glare."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skysim.camera.glow.baffle import stray_around_e_s_m2, stray_of_bodies_e_s_m2
from skysim.camera.stray.ghosts import ghost_optics
from skysim.scene.sections.camera import BaffleConfig, GhostConfig, GlareConfig
from skysim.simulation.lights.light import Beam, Exposure, Light, Lit, Path
from skysim.simulation.lights.plan import Plan


@dataclass(frozen=True)
class Baffle(Light):
    """Light past the baffle: of all bodies that nothing hides, and of the Earth, even over the chip."""

    config: BaffleConfig

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        return beam.plus(Lit("stray light", glow=float(sum(self.stray_e_s(beam, exposure).values()))))

    def stray_e_s(self, beam: Beam, exposure: Exposure) -> dict[str, float]:
        """Electrons s^-1 px^-1 by the name of the body that sends them."""
        bodies = [
            disc
            for lit in beam.lits
            for disc in lit.discs
            if not lit.occludes(np.append(disc.place.direction, 0.0)[None])[0]
        ]
        found = stray_of_bodies_e_s_m2(self.config, bodies, exposure.boresight)
        for lit in beam.lits:
            if lit.around is not None:
                found[lit.name] = stray_around_e_s_m2(self.config, *lit.around(), exposure.boresight)
        pixel_m2 = exposure.optics.camera.pixel_m**2
        return {name: light * pixel_m2 for name, light in found.items()}


@dataclass(frozen=True)
class Ghosts(Light):
    """Pairs of surfaces of the lens by which light reaches the chip a second time."""

    ghosts: tuple[GhostConfig, ...]

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        paths = (Path(n, ghost_optics(exposure.optics, ghost)) for n, ghost in enumerate(self.ghosts, 1))
        return beam._replace(paths=(*beam.paths, *paths))


@dataclass(frozen=True)
class Glare(Light):
    """Light that the lens scatters over the chip."""

    config: GlareConfig

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        return beam._replace(glares=(*beam.glares, self.config))


def build_baffle(plan: Plan) -> Iterator[Light]:
    baffle = plan.scene.camera.baffle
    if baffle:
        yield Baffle(baffle)


def build(plan: Plan) -> Iterator[Light]:
    camera = plan.scene.camera
    if camera.ghosts:
        yield Ghosts(camera.ghosts)
    if camera.glare:
        yield Glare(camera.glare)
