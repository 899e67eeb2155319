"""What a light is asked, and what it answers: `Exposure`, `Lit`, and the `Beam` of all lights together.

A camera's lights are one tuple, from the farthest to the lens (registry.py has the order). For each exposure the light
goes through them in this order: one that shines adds what it gives (`Lit`), one that hides is added to what hides those
before it, and air, wall and lens change what the others gave. The renderer draws the beam that comes out, and the
forecast (`simulation.checks`) counts it.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.camera.discs.bodies import FEW
from skysim.camera.discs.disc_image import Exposed
from skysim.camera.optics import Optics
from skysim.camera.render import OcclusionTest, Poses, Window, poses
from skysim.core.types import Floats, Mount, SatelliteTruth, Sources, Trajectory
from skysim.scene.sections.camera import GlareConfig
from skysim.sources.dome.led import Emitter
from skysim.sources.orbit.satellites import View
from skysim.sources.orbit.viewpoint import Viewpoint
from skysim.sources.photometry import Band
from skysim.sources.solar_system.bodies import BodyLight
from skysim.sources.solar_system.observer import Observer


class Seeds(NamedTuple):
    """Seeds of a run: of what all cameras share (the LED controllers' clocks), and of this camera's own draws."""

    run: int
    camera: int


@dataclass(frozen=True)
class Exposure:
    """One exposure of one camera, as its lights see it.

    index      : of the frame
    window     : when it is exposed
    trajectory : of the vehicle
    mount, optics : at mid-exposure, as temperature and errors of the mount have them
    band       : of the chip
    viewpoint  : the camera's place on the Earth or in its orbit
    seeds      : of the run; None for the expectation, in which nothing is drawn at random
    """

    index: int
    window: Window
    trajectory: Trajectory
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
    def observer(self) -> Observer:
        """The camera among the bodies of the solar system at mid-exposure."""
        return self.viewpoint.observer_at(self.t_s)

    @cached_property
    def lab_from_body(self) -> Rotation:
        """The vehicle's attitude at mid-exposure."""
        return self.trajectory.attitude_at(self.t_s)

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
    def view(self) -> View:
        """What the camera can see from the first row's opening to the last row's end."""
        duration_s = self.window.close_s(self.optics.camera.height_px) - self.window.open_s
        turn_rad = float(np.linalg.norm(self.trajectory.rate_at(self.t_s))) * duration_s
        return View(self.boresight, self.optics.field_rad, turn_rad, duration_s)

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
    """What hides lights: its name for messages ("the Earth"), and the test for places."""

    name: str
    hides: OcclusionTest


class EdgedGlow(NamedTuple):
    """Extended light with edges.

    e_s   : (h, w) electrons s^-1 px^-1 at even nodes from the first pixel's center to the last one's, or of all pixels
    share : of that light that is left
    """

    e_s: Floats
    share: float = 1.0


class Lit(NamedTuple):
    """What one light gives to an exposure.

    name    : what it is, for messages
    points  : whose images are drawn along their paths
    emitter : how points in the laboratory shine
    discs   : resolved bodies, the farthest first
    glow    : smooth extended light, electrons s^-1 px^-1: a number, or (h, w) at `background.node_directions`
    edged   : extended light with edges
    around  : (M, 3) directions and (M,) irradiances, photo-electrons s^-1 m^-2, of extended light also beside the
        field, which a baffle may let through
    hides   : what it hides of the lights before it
    hidden_by : what may hide this light
    satellites : the truth of those of the points that are satellites
    """

    name: str
    points: Sources | None = None
    emitter: Emitter = Emitter()
    discs: tuple[BodyLight, ...] = ()
    glow: Floats | float = 0.0
    edged: tuple[EdgedGlow, ...] = ()
    around: Callable[[], tuple[Floats, Floats]] | None = None
    hides: Occluder | None = None
    hidden_by: tuple[Occluder, ...] = ()
    satellites: tuple[SatelliteTruth, ...] = ()

    def behind(self, occluder: Occluder) -> Lit:
        """The same light with one more thing that may hide it."""
        return self._replace(hidden_by=(*self.hidden_by, occluder))

    def occludes(self, place: Floats) -> NDArray[np.bool_]:
        """(N,) which of N places, as in `Sources`, anything hides."""
        hidden = np.zeros(len(place), bool)
        for occluder in self.hidden_by:
            hidden |= occluder.hides(place)
        return hidden

    @property
    def occlusion(self) -> OcclusionTest | None:
        """`occludes`; None if nothing can hide the light."""
        return self.occludes if self.hidden_by else None


class Path(NamedTuple):
    """One way of the light through the lens: 0 is the image, and the others, from 1, are ghosts."""

    number: int
    optics: Optics


class Beam(NamedTuple):
    """All light of an exposure on its way to the chip: of each light so far, the ways through the lens, its glare."""

    lits: tuple[Lit, ...]
    paths: tuple[Path, ...]
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
        """The discs of all lights, which hide what is at infinity behind them."""
        return tuple(disc for lit in self.lits for disc in lit.discs)


class Light:
    """Anything that shines, or hides or changes the light of those before it; made once, and asked for each exposure.

    A light that shines or hides overrides `during`; one that changes what others give overrides `through`. What is
    drawn at random is drawn from the exposure's seeds, so that the same lights serve any run.
    """

    def during(self, exposure: Exposure) -> Lit:
        """What it gives to an exposure."""
        raise NotImplementedError

    def through(self, beam: Beam, exposure: Exposure) -> Beam:
        """The beam after this light: what it gives is added."""
        return beam.plus(self.during(exposure))


@dataclass(frozen=True)
class KnownLight(Light):
    """The light of a scene by which a tracker can find itself: stars or LEDs.

    sources : all of them, at the scene's start
    emitter : how those in the laboratory shine
    """

    sources: Sources
    emitter: Emitter

    def with_sources(self, sources: Sources) -> Self:
        """The same light with other sources."""
        return replace(self, sources=sources)


def beam_of(lights: Iterable[Light], exposure: Exposure) -> Beam:
    """The light of all lights in an exposure."""
    beam = Beam((), (Path(0, exposure.optics),))
    for light in lights:
        beam = light.through(beam, exposure)
    return beam
