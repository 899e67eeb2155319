"""The interface of lights: `Exposure` is their input, `Lit` the output of one, and `Beam` that of all together.

A camera's lights are one tuple, from the farthest to the lens (registry.py has the order). `beam_of` passes the beam of
an exposure through them in this order:

1. A source adds its light (`Lit`).
2. An obstacle is added to the occluders of all lights before it.
3. Air, wall and lens change the lights before them.

The renderer draws the final beam, and `simulation.checks` predicts from it.
"""

import datetime
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.discs import Exposed, centers_of
from skysim.camera.glow.background import PointedCamera
from skysim.camera.optics import Optics
from skysim.camera.projection import Poses
from skysim.camera.render import OcclusionTest, Window
from skysim.core.types import (
    UP,
    Bools,
    Floats,
    Mount,
    SatelliteTruth,
    Sources,
    Trajectory,
    frozen,
)
from skysim.dynamics.multibody.model import VehicleModel
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import GlareConfig
from skysim.sources.bodies import BodyLight
from skysim.sources.camera_orbit import Viewpoint
from skysim.sources.catalog import Catalog
from skysim.sources.dome.led import Emitter
from skysim.sources.ephemeris import ObserverPlace
from skysim.sources.photometry import Band
from skysim.sources.satellites import ExposureView


class Seeds(NamedTuple):
    """Seeds of a run.

    Attributes
    ----------
    run
        Seed of the draws that all cameras share (clocks of the LED controllers)
    camera
        Seed of this camera's own draws
    """

    run: int
    camera: int


@dataclass(frozen=True)
class Exposure:
    """One exposure of one camera: the input of its lights.

    Attributes
    ----------
    index
        Index of the frame
    window
        Exposure window
    trajectory
        Motion of the vehicle
    lab_from_body
        Attitude of the vehicle at mid-exposure
    mount, optics
        True mount and optics at mid-exposure, with temperature and mount error
    band
        Spectral band of the camera
    viewpoint
        Place of the camera on the Earth or in its orbit
    seeds
        Seeds of the run; None for the expectation, without random draws
    """

    index: int
    window: Window
    trajectory: Trajectory
    lab_from_body: Rotation
    mount: Mount
    optics: Optics
    band: Band
    viewpoint: Viewpoint
    seeds: Seeds | None

    @cached_property
    def t_s(self) -> float:
        """Mid-exposure of the middle row, in seconds from the scene's start."""
        return self.window.middle_s

    @cached_property
    def time(self) -> datetime.datetime:
        """UTC at mid-exposure."""
        return self.viewpoint.time_at(self.t_s)

    @cached_property
    def observer(self) -> ObserverPlace:
        """Place and velocity of the camera in the solar system at mid-exposure."""
        return self.viewpoint.observer_at(self.t_s)

    @cached_property
    def cam_from_lab(self) -> Rotation:
        """Attitude of the camera at mid-exposure."""
        return self.mount.cam_from_body * self.lab_from_body.inv()

    @cached_property
    def camera_m(self) -> Floats:
        """(3,) position of the entrance pupil in the lab at mid-exposure."""
        return self.lab_from_body.apply(self.mount.camera_body_m)

    @cached_property
    def camera(self) -> PointedCamera:
        """The camera as it is at mid-exposure."""
        return PointedCamera(self.optics, self.cam_from_lab, self.camera_m, self.band)

    @cached_property
    def boresight(self) -> Floats:
        """(3,) unit vector of the boresight in lab axes at mid-exposure."""
        return self.cam_from_lab.inv().apply(UP)

    @cached_property
    def view(self) -> ExposureView:
        """Region of the sky that the camera sees from the opening of the first row to the end of the last row."""
        duration_s = self.window.close_s - self.window.open_s
        turn_rad = float(np.linalg.norm(self.trajectory.rate_at(self.t_s))) * duration_s
        return ExposureView(self.boresight, self.optics.field_rad, turn_rad, duration_s)

    @cached_property
    def few_poses(self) -> Poses:
        """Poses over the exposure, to find sources near the field."""
        return self.exposed(self.optics).few_poses()

    @cached_property
    def pose(self) -> Poses:
        """The pose at mid-exposure."""
        return Poses(self.cam_from_lab.as_matrix()[None], self.camera_m[None])

    def exposed(self, optics: Optics) -> Exposed:
        """The camera with these optics, for the renderer."""
        return Exposed(optics, self.trajectory, self.mount, self.window)


class Occluder(NamedTuple):
    """An object that hides lights.

    Attributes
    ----------
    name
        Name for messages, such as "the Earth"
    hides
        Function from places (N, 4), as in `Sources`, to (N,) whether each is behind it
    whole
        Whether it hides a disc as a whole, if its center is behind it
    """

    name: str
    hides: OcclusionTest
    whole: bool = False


def any_of(occluders: Sequence[Occluder]) -> OcclusionTest | None:
    """The test for places that any of the occluders hides; None without occluders."""

    def hidden(place: Floats) -> Bools:
        return np.any([occluder.hides(place) for occluder in occluders], axis=0)

    return hidden if occluders else None


class Lit(NamedTuple):
    """The light that one `Light` adds to an exposure. Extended light is slow, so functions compute it when needed.

    Attributes
    ----------
    name
        Name for messages
    known
        Whether a tracker can determine the attitude from it
    points
        Point sources
    emitter
        Angular emission of points in the laboratory
    discs
        Resolved bodies, the farthest first
    glow
        Returns smooth extended light in electrons s^-1 px^-1: a number, or (h, w) at `background.node_directions`
    edged
        Returns extended light with edges: (h, w) electrons s^-1 px^-1 at evenly spaced nodes from the center of the
        first pixel to that of the last, or of all pixels; None if no light is in the field
    around
        Returns directions (M, 3) and irradiances (M,), photo-electrons s^-1 m^-2, of extended light inside and
        outside the field, which a baffle may let through
    hides
        Occluder that this object is for the lights before it
    hidden_by
        Occluders that may hide this light
    satellites
        Truth of the points that are satellites
    """

    name: str
    known: bool = False
    points: Sources | None = None
    emitter: Emitter = Emitter()
    discs: tuple[BodyLight, ...] = ()
    glow: Callable[[], Floats | float] | None = None
    edged: Callable[[], Floats | None] | None = None
    around: Callable[[], tuple[Floats, Floats]] | None = None
    hides: Occluder | None = None
    hidden_by: tuple[Occluder, ...] = ()
    satellites: tuple[SatelliteTruth, ...] = ()

    def behind(self, occluder: Occluder) -> "Lit":
        """The same light with one more occluder."""
        if occluder.whole and self.discs:
            hidden = occluder.hides(centers_of(self.discs).place)
            return self._replace(discs=tuple(itertools.compress(self.discs, ~hidden)))
        return self._replace(hidden_by=(*self.hidden_by, occluder))

    @property
    def occlusion(self) -> OcclusionTest | None:
        """The test for places that any occluder hides; None if nothing can hide the light."""
        return any_of(self.hidden_by)


class Beam(NamedTuple):
    """All light of an exposure on its way to the detector.

    Attributes
    ----------
    lits
        Light of each source so far
    paths
        Optics of each path through the lens: number 0 is the image, the others are ghosts
    glares
        Veiling glares of the lens
    """

    lits: tuple[Lit, ...]
    paths: tuple[Optics, ...]
    glares: tuple[GlareConfig, ...] = ()

    def plus(self, lit: Lit) -> "Beam":
        """The beam with one more light, which becomes an occluder of the lights before it if it hides."""
        occluder = lit.hides
        before = self.changed(lambda one: one.behind(occluder)) if occluder else self
        return before._replace(lits=(*before.lits, lit))

    def changed(self, change: Callable[[Lit], Lit]) -> "Beam":
        """The beam with a function applied to each light."""
        return self._replace(lits=tuple(change(lit) for lit in self.lits))

    def blurred(self, blur_px: float) -> "Beam":
        """The beam with the blur of the air in its image, a Gaussian of this standard deviation."""
        image, *ghosts = self.paths
        return self._replace(paths=(replace(image, blur_px=blur_px), *ghosts))

    @property
    def discs(self) -> tuple[BodyLight, ...]:
        """The discs of all lights."""
        return tuple(disc for lit in self.lits for disc in lit.discs)

    def before(self, lit: Lit) -> tuple[Occluder, ...]:
        """Occluders of the points of a light: its own, and all discs, which hide points at infinity."""
        return (
            *lit.hidden_by,
            *(Occluder(disc.title, partial(behind_disc, disc)) for disc in self.discs),
        )


def behind_disc(disc: BodyLight, place: Floats) -> Bools:
    """(N,) whether each place (N, 4) is at infinity and behind a disc."""
    return (place[:, 3] == 0) & disc.hides(place[:, :3])


AnyLight = TypeVar("AnyLight", bound="Light")


class Light:
    """A source, an obstacle, or an effect on the lights before it. It is made once and evaluated for each exposure.

    Sources and obstacles override `during`, effects override `through`. Random draws use the seeds of the exposure, so
    the same lights serve any run.

    Attributes
    ----------
    only_adds
        Whether it neither hides nor changes other lights, and no tracker knows it
    """

    only_adds = False

    def during(self, exposure: Exposure) -> Lit:
        """The light of this source in an exposure."""
        raise NotImplementedError

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        """The beam after this light: with its own light added, and with its effect on the lights before it."""
        return beam.plus(self.during(exposure))


class AddedLight(Light):
    """A light that only adds; see `Light.only_adds`."""

    only_adds = True


@frozen
class KnownLight(Light):
    """The light of a scene from which a tracker can determine the attitude: stars or LEDs.

    Attributes
    ----------
    sources
        All sources at the scene's start
    emitter
        Angular emission of sources in the laboratory
    """

    sources: Sources
    emitter: Emitter

    def during(self, exposure: Exposure) -> Lit:
        """Stars whose places are constant during the scene."""
        return Lit("stars", True, self.sources, self.emitter)


class Obstacle(Light):
    """An object that hides lights; `during` returns its occluder, and is fast."""


def find_light(lights: Iterable[Light], kind: type[AnyLight]) -> AnyLight | None:
    """The first light of a class; None if there is none."""
    return next((light for light in lights if isinstance(light, kind)), None)


def beam_of(lights: Iterable[Light], exposure: Exposure) -> Beam:
    """The beam of an exposure after all lights."""
    beam = Beam((), (exposure.optics,))
    for light in lights:
        beam = light.through(beam, exposure)
    return beam


@frozen
class LightPlan:
    """The input from which the lights of a camera are built.

    Attributes
    ----------
    scene
        The scene with the camera's settings, see `Scene.of_head`
    band
        Spectral band of the camera
    vehicle
        Vehicle that carries the camera
    viewpoint
        Place of the camera on the Earth or in its orbit
    catalog
        Catalog of the scene's light; None under a dome
    known
        The scene's light in this band, if another camera has it already
    mount
        Mount of a further camera; None for the main one
    """

    scene: Scene
    band: Band
    vehicle: VehicleModel
    viewpoint: Viewpoint
    catalog: Catalog | None
    known: KnownLight | None = None
    mount: Mount | None = None
