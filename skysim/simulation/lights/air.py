"""The air over the site: it raises and dims what is above it, glows, blurs, and the skyline hides what is low."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from skysim.camera.glow.air_glow import air_glow
from skysim.camera.glow.background import node_directions, viewing_geometry
from skysim.camera.render import in_view
from skysim.core.random_streams import SCINTILLATION, random_stream
from skysim.core.types import Floats, Sources
from skysim.scene.sections.light import StarsConfig
from skysim.simulation.lights.light import Beam, Exposure, Light, Lit, Occluder
from skysim.simulation.lights.plan import Plan
from skysim.sources.air.air import Air, Sky


@dataclass(frozen=True)
class Atmosphere(Light):
    """The air of mid-exposure, on the way of all lights before it.

    The site turns by 15" in a second, which changes a refraction by less than 0.02" at 15 degrees of altitude.
    """

    air: Air

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        sky = self.air.at(exposure.time)
        blur_px = sky.seeing_px(exposure.boresight, exposure.optics.camera.focal_px)
        seen = beam.changed(lambda lit: seen_through(sky, lit, exposure)).blurred(blur_px)
        skyline = Occluder("the skyline", lambda place: sky.below_horizon(place[:, :3]))
        return seen.plus(Lit("the air", glow=glow(sky, exposure), hides=skyline))


def seen_through(sky: Sky, lit: Lit, exposure: Exposure) -> Lit:
    """A light raised and dimmed by the air."""
    points = None if lit.points is None else seen_points(sky, lit.points, exposure)
    return lit._replace(points=points, discs=tuple(sky.body_seen(disc) for disc in lit.discs))


def seen_points(sky: Sky, points: Sources, exposure: Exposure) -> Sources:
    """Points raised and dimmed: of those at rest the ones near the field, which twinkle."""
    if points.motion is not None:
        return sky.points_seen(points)
    seen = sky.points_seen(points.take(in_view(points, exposure.optics, exposure.few_poses)))
    if not sky.air.config.scintillation or exposure.seeds is None:
        return seen
    rng = random_stream(exposure.seeds.camera, SCINTILLATION, exposure.index)
    return sky.twinkling(seen, exposure.optics.camera.pupil_m, exposure.window.exposure_s, rng)


def glow(sky: Sky, exposure: Exposure) -> Floats | float:
    """The sky's glow at the nodes of the background; 0 where the scene has none."""
    if sky.air.config.glow is None:
        return 0.0
    toward, pixel_sr, shape = node_directions(exposure.optics)
    view = viewing_geometry(toward, pixel_sr, exposure.optics, exposure.cam_from_lab, exposure.band)
    return air_glow(sky.air.config.glow, sky, view).reshape(shape)


def build(plan: Plan) -> Iterator[Light]:
    light = plan.scene.light
    if isinstance(light, StarsConfig) and light.air and plan.catalog is not None:
        yield Atmosphere(Air.from_config(light.air, plan.scene.site, plan.catalog, plan.band))
