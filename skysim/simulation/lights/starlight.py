"""Stars of a catalog, as seen from the ground or from an orbit, and extended light of the scene's `background`."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.glow.background import glow_map
from skysim.core.errors import InputError
from skysim.core.types import Floats, StarSources, frozen
from skysim.scene.sections.light import StarsConfig
from skysim.scene.sections.surroundings import Glow
from skysim.simulation.lights.light import (
    AddedLight,
    Exposure,
    KnownLight,
    LightPlan,
    Lit,
)
from skysim.sources import stars
from skysim.sources.dome.led import Emitter


@frozen
class StarsInOrbit(KnownLight):
    """Stars displaced by the aberration of an orbit, whose velocity turns by a degree in 15 s in a low orbit.

    Attributes
    ----------
    velocity_m_s
        (3,) barycentric velocity at which `sources` are the apparent places
    """

    velocity_m_s: Floats

    def during(self, exposure: Exposure) -> Lit:
        """The stars near the field at the velocity of mid-exposure; in a second the aberration changes by 0.006"."""
        view = exposure.view
        # A margin for the corners of the field, and the rotation during the exposure.
        reach_rad = 1.25 * view.field_rad + 0.02 + view.turn_rad
        assert isinstance(self.sources, StarSources)
        near = self.sources.take(self.sources.within(view.boresight, reach_rad))
        now_m_s = 1e3 * exposure.observer.velocity_km_s
        direction = stars.seen_at_velocity(near.place[:, :3], self.velocity_m_s, now_m_s)
        place = np.column_stack([direction, np.zeros(len(near))])
        return Lit("stars", True, replace(near, place=place), self.emitter)


def stars_of(config: StarsConfig, plan: LightPlan) -> KnownLight:
    """The stars of a scene at its start, in the lab's axes, which are those of the ICRS.

    Raises InputError if variability is on and the catalog has no variable stars.
    """
    catalog = plan.catalog
    scene = plan.scene
    viewpoint = plan.viewpoint
    assert catalog is not None
    if config.variability_seed is not None:
        if not catalog.scatter_mag.any():
            raise InputError(
                "light.variability_seed",
                f"{config.catalog} has no variable stars",
                "gaia_v8.0",
            )
        catalog = stars.varied(catalog, config.variability_seed)
    # If other parts of the scene depend on the camera's place, the aberration by its velocity is included as well.
    velocity_m_s: Floats | tuple[float, ...] = stars.AT_REST
    if config.bodies or config.satellites or config.air or viewpoint.orbit:
        velocity_m_s = viewpoint.state_at(0.0).velocity_m_s
    shown = stars.sources(
        catalog,
        scene.start_time,
        config.limit_mag,
        Rotation.identity(),
        plan.band,
        velocity_m_s,
    )
    if viewpoint.orbit is None:
        return KnownLight(shown, Emitter())
    return StarsInOrbit(shown, Emitter(), 1e3 * viewpoint.observer_at(0.0).velocity_km_s)


# The scene's section `background`: light leaks and the glow of the sky.

BACKGROUND = "background"


@frozen
class BackgroundLight(AddedLight):
    """Extended light that does not change from frame to frame."""

    glows: tuple[Glow, ...]

    def during(self, exposure: Exposure) -> Lit:
        return Lit(BACKGROUND, glow=lambda: glow_map(self.glows, exposure.camera))
