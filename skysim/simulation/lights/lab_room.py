"""The laboratory around the lights: wall and floor that reflect them, and obstacles that hide them."""

from functools import partial

import numpy as np

from skysim.camera.glow.stray import GRID, MARGIN, chip_grid, wall_glow
from skysim.core.types import Bools, Floats, frozen
from skysim.dynamics import multibody
from skysim.scene.sections.leds import WarmUpConfig
from skysim.simulation.lights.light import (
    AddedLight,
    Beam,
    Exposure,
    Lit,
    Obstacle,
    Occluder,
)
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
        return Lit("the dome's wall", glow=lambda: self.glow(exposure))

    def glow(self, exposure: Exposure) -> Floats:
        """(h, w) electrons s^-1 px^-1 at the nodes of the background."""
        full = wall_glow(self.dome, exposure.camera)
        return warm_up_factor(self.warm_up, exposure.t_s) * full


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
