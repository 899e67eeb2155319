"""The air over the site: refraction, extinction, scintillation, seeing and airglow, and the skyline.

Everything is computed for mid-exposure. The site rotates by 15" in a second, which changes the refraction by less than
0.02" at an altitude of 15 deg.
"""

from skysim.camera.glow.air_glow import air_glow
from skysim.camera.projection import in_view
from skysim.core.random_streams import SCINTILLATION, random_stream
from skysim.core.types import Floats, Sources, frozen
from skysim.scene.sections.surroundings import AirGlowConfig
from skysim.simulation.lights.light import (
    AddedLight,
    Beam,
    Exposure,
    Light,
    Lit,
    Obstacle,
    Occluder,
)
from skysim.sources.air import Air, Sky


@frozen
class AirEffects(Light):
    """Refraction, extinction, scintillation and seeing of all lights before it in the list."""

    air: Air

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        sky = self.air.at(exposure.time)
        blur_px = sky.seeing_px(exposure.boresight, exposure.optics.camera.focal_px)
        return beam.changed(lambda lit: seen_through(sky, lit, exposure)).blurred(blur_px)


@frozen
class Skyline(Obstacle):
    """The horizon, or the hills of `light.air.horizon`."""

    air: Air

    def during(self, exposure: Exposure) -> Lit:
        sky = self.air.at(exposure.time)
        return Lit(
            "the skyline",
            hides=Occluder("the skyline", lambda place: sky.below_horizon(place[:, :3])),
        )


@frozen
class AirGlow(AddedLight):
    """Airglow, moonlight and twilight."""

    air: Air
    config: AirGlowConfig

    def during(self, exposure: Exposure) -> Lit:
        return Lit("the air", glow=lambda: self.glow(exposure))

    def glow(self, exposure: Exposure) -> Floats:
        """(h, w) electrons s^-1 px^-1 at the nodes of the background."""
        view = exposure.camera.nodes()
        return air_glow(self.config, self.air.at(exposure.time), view).reshape(view.shape)


def seen_through(sky: Sky, lit: Lit, exposure: Exposure) -> Lit:
    """The light with the refraction and extinction of the air."""
    points = None if lit.points is None else seen_points(sky, lit.points, exposure)
    return lit._replace(points=points, discs=tuple(sky.body_seen(disc) for disc in lit.discs))


def seen_points(sky: Sky, points: Sources, exposure: Exposure) -> Sources:
    """Points with refraction and extinction; of points at rest those near the field, with scintillation."""
    if points.motion is not None:
        return sky.points_seen(points)
    # In the expectation, without seeds, nothing scintillates.
    seen = sky.points_seen(points.take(in_view(points, exposure.optics, exposure.few_poses)))
    if not sky.air.config.scintillation or exposure.seeds is None:
        return seen
    rng = random_stream(exposure.seeds.camera, SCINTILLATION, exposure.index)
    return sky.twinkling(
        seen, exposure.optics.camera.pupil_m, exposure.window.exposure_s, rng
    )
