"""What a light is asked, and what it answers: `Exposure`, `Lit`, and the `Beam` of all lights together.

A camera's lights are one tuple, from the farthest to the lens (registry.py has the order). For each exposure the light
goes through them in this order: one that shines adds what it gives (`Lit`), one that hides is added to what hides those
before it, and air, wall and lens change what the others gave. The renderer draws the beam that comes out, and the
forecast (`simulation.checks`) counts it.
"""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import ClassVar, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.camera.discs import FEW, Exposed, centers_of
from skysim.camera.optics import Optics
from skysim.camera.render import OcclusionTest, Poses, Window, poses
from skysim.core.types import Floats, Mount, SatelliteTruth, Sources, Trajectory
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
    """Seeds of a run: of what all cameras share (the LED controllers' clocks), and of this camera's own draws."""

    run: int
    camera: int


@dataclass(frozen=True)
class Exposure:
    """One exposure of one camera, as its lights see it.

    Attributes
    ----------
    index
        Of the frame
    window
        When it is exposed
    trajectory
        Of the vehicle
    lab_from_body
        Its attitude at mid-exposure
    mount, optics
        At mid-exposure, as temperature and errors of the mount have them
    band
        Of the chip
    viewpoint
        The camera's place on the Earth or in its orbit
    seeds
        Of the run; None for the expectation, in which nothing is drawn at random
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
        """Mid-exposure of the middle row, seconds from the scene's start."""
        return self.window.middle_s(self.optics.camera.height_px)

    @cached_property
    def time(self) -> datetime.datetime:
        """UTC at mid-exposure."""
        return self.viewpoint.time_at(self.t_s)

    @cached_property
    def observer(self) -> ObserverPlace:
        """The camera among the bodies of the solar system at mid-exposure."""
        return self.viewpoint.observer_at(self.t_s)

    @cached_property
    def cam_from_lab(self) -> Rotation:
        """The camera's attitude at mid-exposure."""
        return self.mount.cam_from_body * self.lab_from_body.inv()

    @cached_property
    def camera_m(self) -> Floats:
        """(3,) the entrance pupil in the lab at mid-exposure."""
        return self.lab_from_body.apply(self.mount.camera_body_m)

    @cached_property
    def boresight(self) -> Floats:
        """(3,) unit vector in lab axes at mid-exposure."""
        return self.cam_from_lab.inv().apply([0.0, 0.0, 1.0])

    @cached_property
    def view(self) -> ExposureView:
        """What the camera can see from the first row's opening to the last row's end."""
        duration_s = self.window.close_s(self.optics.camera.height_px) - self.window.open_s
        turn_rad = float(np.linalg.norm(self.trajectory.rate_at(self.t_s))) * duration_s
        return ExposureView(self.boresight, self.optics.field_rad, turn_rad, duration_s)

    @cached_property
    def few_poses(self) -> Poses:
        """FEW poses over the exposure, to look for what is near the field."""
        end_s = self.window.close_s(self.optics.camera.height_px)
        return poses(self.trajectory, self.mount, np.linspace(self.window.open_s, end_s, FEW))

    @cached_property
    def pose(self) -> Poses:
        """The one pose of mid-exposure."""
        return Poses(self.cam_from_lab.as_matrix()[None], self.camera_m[None])

    def exposed(self, optics: Optics) -> Exposed:
        """The camera with these optics, for the renderer."""
        return Exposed(optics, self.trajectory, self.mount, self.window)


class Occluder(NamedTuple):
    """What hides lights.

    Attributes
    ----------
    name
        For messages, such as "the Earth"
    hides
        Which of N places, as in `Sources`, are behind it
    whole
        Whether it hides a disc as a whole, by its center
    """

    name: str
    hides: OcclusionTest
    whole: bool = False


def any_of(occluders: Sequence[Occluder]) -> OcclusionTest | None:
    """The test for places that any of these hides; None for none of them."""

    def hidden(place: Floats) -> NDArray[np.bool_]:
        return np.any([occluder.hides(place) for occluder in occluders], axis=0)

    return hidden if occluders else None


class EdgedGlow(NamedTuple):
    """Extended light with edges.

    Attributes
    ----------
    e_s
        Gives (h, w) electrons s^-1 px^-1 at even nodes from the first pixel's center to the
        last one's, or of all pixels; None if none of it is in the field
    share
        Of that light that is left
    """

    e_s: Callable[[], Floats | None]
    share: float = 1.0


class Lit(NamedTuple):
    """What one light gives to an exposure. Extended light, which takes longest, is computed when it is asked for.

    Attributes
    ----------
    name
        What it is, for messages
    known
        Whether a tracker can find itself by it
    points
        Whose images are drawn along their paths
    emitter
        How points in the laboratory shine
    discs
        Resolved bodies, the farthest first
    glow
        Gives its smooth extended light, electrons s^-1 px^-1: a number, or (h, w) at
        `background.node_directions`
    edged
        Its extended light with edges
    around
        Gives (M, 3) directions and (M,) irradiances, photo-electrons s^-1 m^-2, of extended
        light also beside the field, which a baffle may let through
    hides
        What it hides of the lights before it
    hidden_by
        What may hide this light
    satellites
        The truth of those of the points that are satellites
    """

    name: str
    known: bool = False
    points: Sources | None = None
    emitter: Emitter = Emitter()
    discs: tuple[BodyLight, ...] = ()
    glow: Callable[[], Floats | float] | None = None
    edged: EdgedGlow | None = None
    around: Callable[[], tuple[Floats, Floats]] | None = None
    hides: Occluder | None = None
    hidden_by: tuple[Occluder, ...] = ()
    satellites: tuple[SatelliteTruth, ...] = ()

    def behind(self, occluder: Occluder) -> Lit:
        """The same light with one more thing that may hide it."""
        if occluder.whole and self.discs:
            hidden = occluder.hides(centers_of(self.discs).place)
            return self._replace(discs=tuple(itertools.compress(self.discs, ~hidden)))
        return self._replace(hidden_by=(*self.hidden_by, occluder))

    @property
    def occlusion(self) -> OcclusionTest | None:
        """The test for places that anything hides; None if nothing can hide the light."""
        return any_of(self.hidden_by)


class LightPath(NamedTuple):
    """One way of the light through the lens: 0 is the image, and the others, from 1, are ghosts."""

    number: int
    optics: Optics


class Beam(NamedTuple):
    """All light of an exposure on its way to the chip: of each light so far, the ways through the lens, its glare."""

    lits: tuple[Lit, ...]
    paths: tuple[LightPath, ...]
    glares: tuple[GlareConfig, ...] = ()

    def plus(self, lit: Lit) -> Beam:
        """The beam with the light of one more, which hides what it can of those before."""
        occluder = lit.hides
        before = self.changed(lambda one: one.behind(occluder)) if occluder else self
        return before._replace(lits=(*before.lits, lit))

    def changed(self, change: Callable[[Lit], Lit]) -> Beam:
        """The beam with each light changed."""
        return self._replace(lits=tuple(change(lit) for lit in self.lits))

    def blurred(self, blur_px: float) -> Beam:
        """The beam with the blur of the air, a Gaussian of this standard deviation, in its image."""
        image, *ghosts = self.paths
        blurred = image._replace(optics=replace(image.optics, blur_px=blur_px))
        return self._replace(paths=(blurred, *ghosts))

    @property
    def discs(self) -> tuple[BodyLight, ...]:
        """The discs of all lights."""
        return tuple(disc for lit in self.lits for disc in lit.discs)

    def before(self, lit: Lit) -> tuple[Occluder, ...]:
        """All that may hide the points of a light: what it is behind, and the discs, if it is at infinity."""
        return (
            *lit.hidden_by,
            *(Occluder(disc.title, partial(behind_disc, disc)) for disc in self.discs),
        )


def behind_disc(disc: BodyLight, place: Floats) -> NDArray[np.bool_]:
    """(N,) which of N places are at infinity and behind a disc."""
    return (place[:, 3] == 0) & disc.hides(place[:, :3])


AnyLight = TypeVar("AnyLight", bound="Light")


class Light:
    """Anything that shines, or hides or changes the light of those before it; made once, and asked for each exposure.

    A light that shines or hides overrides `during`; one that changes what others give overrides `through`. What is
    drawn at random is drawn from the exposure's seeds, so that the same lights serve any run.

    Attributes
    ----------
    only_adds
        Whether it neither hides nor changes others, and no tracker knows it
    """

    only_adds: ClassVar[bool] = False

    def during(self, exposure: Exposure) -> Lit:
        """What it gives to an exposure."""
        raise NotImplementedError

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        """The beam after this light: what it gives is added, and it hides what it can of those before."""
        return beam.plus(self.during(exposure))


@dataclass(frozen=True)
class KnownLight(Light):
    """The light of a scene by which a tracker can find itself: stars or LEDs.

    Attributes
    ----------
    sources
        All of them, at the scene's start
    emitter
        How those in the laboratory shine
    """

    sources: Sources
    emitter: Emitter

    def with_sources(self, sources: Sources) -> Self:
        """The same light with other sources."""
        return replace(self, sources=sources)


class Obstacle(Light):
    """Something that hides lights; `during` gives its occluder, and is quick."""


def find_light(lights: Iterable[Light], kind: type[AnyLight]) -> AnyLight | None:
    """The first light of a class; None if there is none."""
    return next((light for light in lights if isinstance(light, kind)), None)


def beam_of(lights: Iterable[Light], exposure: Exposure) -> Beam:
    """The light of all lights in an exposure."""
    beam = Beam((), (LightPath(0, exposure.optics),))
    for light in lights:
        beam = light.through(beam, exposure)
    return beam


# What a camera's lights are built from.


@dataclass(frozen=True, slots=True)
class LightPlan:
    """The scene and the hardware around a camera.

    Attributes
    ----------
    scene
        As the camera sees it, see `Scene.of_head`
    band
        Of its chip
    vehicle
        That carries it
    viewpoint
        Its place on the Earth or in its orbit
    catalog
        The stars of the scene's light; None under a dome
    known
        The scene's light in this band, where another camera has it already
    mount
        Of a further camera; None for the main one
    """

    scene: Scene
    band: Band
    vehicle: VehicleModel
    viewpoint: Viewpoint
    catalog: Catalog | None
    known: KnownLight | None = None
    mount: Mount | None = None
