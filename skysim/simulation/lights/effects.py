"""What changes or hides the lights before it: wall, floor and obstacles of the laboratory, the air, and the lens.

The air over the site is computed for mid-exposure. The site rotates by 15" in a second, which changes the refraction by
less than 0.02" at an altitude of 15 deg.
"""

import itertools
from collections.abc import Sequence
from functools import partial

import numpy as np

from skysim.camera.discs import centers_of
from skysim.camera.glow.earth_glow import (
    air_glow,
    stray_around_e_s_m2,
    stray_of_bodies_e_s_m2,
)
from skysim.camera.glow.stray import GRID, MARGIN, chip_grid, ghost_optics, wall_glow
from skysim.camera.projection import in_view
from skysim.core.random_streams import SCINTILLATION, random_stream
from skysim.core.types import Bools, Floats, Sources, frozen
from skysim.dynamics import multibody
from skysim.scene.sections.camera import BaffleConfig, GhostConfig, GlareConfig
from skysim.scene.sections.leds import WarmUpConfig
from skysim.scene.sections.surroundings import AirGlowConfig
from skysim.simulation.lights.light import (
    AddedLight,
    Beam,
    Exposure,
    Light,
    Lit,
    Obstacle,
    Occluder,
    beam_of,
)
from skysim.sources.air import Air, Sky
from skysim.sources.bodies import BodyLight
from skysim.sources.dome.interreflection import ReflectingDome
from skysim.sources.dome.led import warm_up_factor
from skysim.sources.dome.mirror import mirrored
from skysim.sources.dome.surface import Surface

# Reflections: a glow if the surface scatters, images if it mirrors.


def images_of(name: str) -> str:
    """The name of the images of the lights with this name in the wall."""
    return f"images of {name} in the wall"


IMAGES = images_of("LEDs")


@frozen
class WallGlow(AddedLight):
    """The glow of wall and floor, which decreases with the strength of the LEDs as they warm up."""

    dome: ReflectingDome
    warm_up: WarmUpConfig | None

    def during(self, exposure: Exposure) -> Lit:
        warm = warm_up_factor(self.warm_up, exposure.t_s)
        return Lit(
            "the dome's wall", glow=lambda: warm * wall_glow(self.dome, exposure.camera)
        )


@frozen
class Mirror(AddedLight):
    """The images of the LEDs, and of other lights in the laboratory, in the wall."""

    dome: ReflectingDome

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        for lit in beam.lits:
            if lit.points is not None and len(lit.points):
                beam = beam.plus(self.image(lit, exposure))
        return beam

    def image(self, lit: Lit, exposure: Exposure) -> Lit:
        """The images of one light in the wall that are in the field; the same obstacles hide them.

        They keep their virtual places while the camera moves during the exposure, which is exact for a flat wall.
        """
        assert lit.points is not None
        grid = chip_grid(exposure.optics, GRID, MARGIN) @ exposure.cam_from_lab.as_matrix()
        images = mirrored(
            self.dome.config, self.dome.wall, lit.points, exposure.camera_m, grid
        )
        return Lit(images_of(lit.name), False, images, lit.emitter, hidden_by=lit.hidden_by)


# Obstacles between a light and the camera: parts of the vehicle, and the dome's wall.

# For the ray to the camera, an LED is moved off its wall by this fraction of its distance from the bearing.
INWARD_FRACTION = 1e-6


@frozen
class Vehicle(Obstacle):
    """The parts of the vehicle, at mid-exposure."""

    obstacles: multibody.Obstacles

    def during(self, exposure: Exposure) -> Lit:
        hides = partial(multibody.occluded, self.obstacles, exposure.lab_from_body)
        return Lit("the vehicle", hides=Occluder("the vehicle", hides))


@frozen
class DomeWall(Obstacle):
    """The wall of the dome, which hides its own LEDs from a camera outside of it."""

    wall: Surface

    def during(self, exposure: Exposure) -> Lit:
        def hides(place: Floats) -> Bools:
            """(N,) whether a place (N, 4) is that of an LED behind the wall."""
            hidden = place[:, 3] > 0
            hidden[hidden] = behind_wall(self.wall, exposure.camera_m, place[hidden, :3])
            return hidden

        return Lit("the dome's wall", hides=Occluder("the dome's wall", hides))


def behind_wall(wall: Surface, camera_m: Floats, position_m: Floats) -> Bools:
    """(N,) whether the line from an LED at (N, 3) to the camera passes through the dome's wall (not beneath its rim).

    The wall hides nothing from a camera inside, since a convex surface cannot hide its inside. All surfaces here are
    convex, except for the millimeters of a surveyed one.
    """
    behind = np.zeros(len(position_m), dtype=bool)
    if wall.inside(camera_m):
        return behind
    for n, led_m in enumerate(position_m * (1 - INWARD_FRACTION)):
        ray = (camera_m - led_m)[None]
        wall_m = wall.meet(led_m, ray)[0]
        # A ray beneath the rim meets no wall: its distance is NaN, which is not smaller.
        behind[n] = np.linalg.norm(wall_m - led_m) < np.linalg.norm(ray)
    return behind


# The air: refraction, extinction, scintillation, seeing and airglow, and the skyline.


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
        sky = self.air.at(exposure.time)
        return Lit(
            "the air", glow=lambda: air_glow(self.config, sky, exposure.camera.nodes())
        )


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


# The lens and its baffle: stray light from outside the field, ghosts, and veiling glare.


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
