"""What a camera's lights are built from."""

from __future__ import annotations

from dataclasses import dataclass

from skysim.core.types import Mount
from skysim.dynamics.multibody.model import VehicleModel
from skysim.scene.scene import Scene
from skysim.simulation.lights.light import KnownLight
from skysim.sources.catalog import Catalog
from skysim.sources.orbit.viewpoint import Viewpoint
from skysim.sources.photometry import Band


@dataclass(frozen=True, slots=True)
class Plan:
    """The scene and the hardware around a camera.

    scene     : as the camera sees it, see `Scene.of_head`
    band      : of its chip
    vehicle   : that carries it
    viewpoint : its place on the Earth or in its orbit
    catalog   : the stars of the scene's light; None under a dome
    known     : the scene's light in this band, where another camera has it already
    mount     : of a further camera; None for the main one
    """

    scene: Scene
    band: Band
    vehicle: VehicleModel
    viewpoint: Viewpoint
    catalog: Catalog | None
    known: KnownLight | None = None
    mount: Mount | None = None
