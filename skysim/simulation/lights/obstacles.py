"""What stands in the laboratory between a light and the camera: the vehicle's parts, and the dome's wall."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from skysim.core.types import Floats
from skysim.dynamics import multibody
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.lights.light import (Exposure, Light, Lit, Obstacle, Occluder)
from skysim.simulation.lights.light import Plan
from skysim.sources.dome.surface import (Surface, build_surface)

INWARD_FRACTION = (
    1e-6  # an LED is moved off its wall by this fraction of its distance from the bearing
)


@dataclass(frozen=True)
class Vehicle(Obstacle):
    """Parts of the vehicle that are in the way at mid-exposure."""

    obstacles: multibody.Obstacles

    def during(self, exposure: Exposure) -> Lit:
        hides = partial(multibody.occluded, self.obstacles, exposure.lab_from_body)
        return Lit("the vehicle", hides=Occluder("the vehicle", hides))


@dataclass(frozen=True)
class DomeWall(Obstacle):
    """The dome's wall before its own LEDs, for a camera that is outside of it."""

    wall: Surface

    def during(self, exposure: Exposure) -> Lit:
        def hides(place: Floats) -> NDArray[np.bool_]:
            hidden = place[:, 3] > 0
            hidden[hidden] = behind_wall(self.wall, exposure.camera_m, place[hidden, :3])
            return hidden

        return Lit("the dome's wall", hides=Occluder("the dome's wall", hides))


def behind_wall(wall: Surface, camera_m: Floats, position_m: Floats) -> NDArray[np.bool_]:
    """(N,) whether the line from LEDs at (N, 3) to the camera passes through the dome's wall (not beneath its rim).

    A camera inside sees no LED through the wall, as convex surfaces cannot hide their inside; all surfaces here are
    convex, except for the millimeters of a surveyed one.
    """
    behind = np.zeros(len(position_m), dtype=bool)
    if wall.inside(camera_m):
        return behind
    for n, led_m in enumerate(position_m * (1 - INWARD_FRACTION)):
        ray = (camera_m - led_m)[None]
        wall_m = wall.meet(led_m, ray)[0]
        behind[n] = np.linalg.norm(wall_m - led_m) < np.linalg.norm(
            ray
        )  # NaN, beneath the rim, is not
    return behind


def build(plan: Plan) -> Iterator[Light]:
    """What `light.occlusion` lets hide a light; a collimated display has nothing in its beam."""
    light = plan.scene.light
    if getattr(light, "occlusion", False):
        yield Vehicle(multibody.build_obstacles(plan.vehicle, plan.mount))
        if isinstance(light, DomeConfig):
            yield DomeWall(build_surface(light.surface))
