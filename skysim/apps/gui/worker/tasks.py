"""Tasks of a worker process: methods of `Worker`, called by name, which keeps its state between them."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from skysim.apps.gui.messages import (
    ALL_PIXELS,
    AmbiguityMap,
    Display,
    FlightStep,
    FrameView,
    Pixels,
    PushedView,
    SceneInfo,
    SurveyFound,
    SurveyPlan,
    Triple,
)
from skysim.apps.gui.worker import (
    geometry,
    photo,
    pixels,
    playback,
    real,
)
from skysim.apps.gui.worker.workbench import Workbench, ambiguity
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.core.yaml_reader import OverrideTexts
from skysim.results.scoring import FrameRow
from skysim.simulation import checks
from skysim.simulation.checks.plan_check import Check
from skysim.simulation.lab import MAIN

KEPT_IMAGES = 3  # number of newest images that are kept: the page may show an earlier one


@dataclass
class Worker:
    """State between tasks: the workbench, its flight, and another image if the page shows one.

    Attributes
    ----------
    display
        Display of the browser, for which frames are made, if it is known
    shown
        Newest images for the page by number, each with its saturation value
    number
        Number of the last image
    flight, reference
        The scene's flight, and the one that is kept for comparison
    pushed
        Motion of the pushed vehicle, as long as the workbench has its attitude
    surveyed
        Survey of the scene's dome, if one was planned
    other
        Image that is not of the scene, if the page shows one, and its (H, W) pixels
    source
        Folder that is watched, or open camera
    compared
        Its frames beside those of the scene
    """

    current: Workbench | None = None
    display: Display | None = None
    shown: dict[int, tuple[pixels.PixelLevels, float]] = field(default_factory=dict)
    number: int = 0
    flight: playback.Playback | None = None
    reference: playback.Playback | None = None
    pushed: geometry.Push | None = None
    surveyed: playback.Survey | None = None
    other: photo.PhotoPixels | None = None
    scene: str = ""
    overrides: dict[str, str] = field(default_factory=dict)
    source: real.RealSource | None = None
    compared: real.RealComparison | None = None

    @property
    def workbench(self) -> Workbench:
        """The current workbench. Raises InputError if no scene is set up."""
        if self.current is None:
            raise InputError("", "no scene is set up")
        return self.current

    def show_frame(self, view: FrameView, levels: pixels.PixelLevels) -> FrameView:
        """Return the view with its pixels, and drop the other image, because the page now shows the scene."""
        self.other = None
        return view._replace(pixels=self.show(levels, view.saturation_dn))

    def show_photo(self, photo_pixels: photo.PhotoPixels) -> photo.Photo:
        """Keep an image that is not of the scene, and return its view."""
        self.other = photo_pixels
        other, image = photo_pixels
        return replace(other, pixels=self.show(pixels.levels_of(image), other.saturation_dn))

    def show(self, levels: pixels.PixelLevels, saturation_dn: float) -> Pixels:
        """Keep an image for the page, and return its pixels for the browser's display."""
        self.number += 1
        self.shown[self.number] = levels, saturation_dn
        self.shown.pop(self.number - KEPT_IMAGES, None)
        return pixels.pixels_for(
            self.display or ALL_PIXELS, levels, saturation_dn, self.number
        )

    @property
    def survey_of_scene(self) -> playback.Survey:
        """The survey of the current scene. Raises InputError if none was planned."""
        if self.surveyed is None or not self.surveyed.is_of(self.workbench.whole.scene):
            raise InputError("", "no survey of this scene: plan one")
        return self.surveyed

    @property
    def levels(self) -> pixels.PixelLevels:
        """The newest frame of the workbench."""
        frame = self.workbench.frame
        assert frame is not None
        return pixels.levels_of(frame.image_dn)

    # Tasks.

    def warm_up(self, scene: str) -> None:
        """Set up a scene that a page will probably open and solve a frame, so that code is imported and compiled."""
        self.current = Workbench.open(scene, {})
        view = self.current.render_at_rest(solve=True)
        pixels.pixels_for(Display((8, 8)), self.levels, view.saturation_dn)

    def all_pixels(self, number: int, display: Display) -> Pixels | None:
        """All pixels of the image with a number; None if it is no longer among the newest."""
        if number not in self.shown:
            return None
        return pixels.pixels_for(
            display._replace(screen_px=(0, 0)), *self.shown[number], number
        )

    def open(
        self,
        scene: str,
        overrides: OverrideTexts,
        solve: bool,
        angles_deg: Triple | None = None,
        head: str = MAIN,
    ) -> tuple[SceneInfo, FrameView]:
        """Set up a scene and render a first frame.

        Parameters
        ----------
        angles_deg
            Attitude, if it is neither the kept one nor the start
        head
            Name of the camera; the main one if there is no such head
        """
        bench = Workbench.open(scene, overrides, self.current, head)
        if angles_deg is not None:
            bench.lab_from_body = geometry.from_angles(bench.lab, angles_deg)
        self.current = bench
        self.scene = scene
        self.overrides = dict(overrides)
        self.flight = None
        self.pushed = None
        surveyed = self.surveyed is not None and self.surveyed.is_of(bench.whole.scene)
        return bench.scene_info._replace(surveyed=surveyed), self.render(solve)

    def render(self, solve: bool, index: int = 0) -> FrameView:
        view = self.workbench.render_at_rest(solve, index)
        return self.show_frame(view, self.levels)

    def render_next(self, index: int, solve: bool) -> FrameView:
        """Render a later frame of the run at rest that `render` has begun."""
        return self.render(solve, index)

    def point(self, angles_deg: Triple, solve: bool) -> FrameView:
        bench = self.workbench
        bench.lab_from_body = geometry.from_angles(bench.lab, angles_deg)
        return self.render(solve)

    def move(self, right: float, up: float, roll_deg: float, solve: bool) -> FrameView:
        bench = self.workbench
        bench.lab_from_body = geometry.moved(
            bench.lab, bench.lab_from_body, right, up, roll_deg
        )
        return self.render(solve)

    def push(self, grip: geometry.Grip | None, elapsed_s: float, solve: bool) -> PushedView:
        """Integrate the motion of the pushed vehicle for a time, and render the frame whose exposure ends then.

        The motion begins at rest, also after the camera was moved in another way. Raises InputError.
        """
        bench = self.workbench
        if self.pushed is None or self.pushed.lab_from_body is not bench.lab_from_body:
            self.pushed = geometry.Push(bench.lab, bench.lab_from_body)
        self.pushed.advance(grip, elapsed_s)
        bench.lab_from_body = self.pushed.lab_from_body
        view = bench.render(bench.next_run().camera, self.pushed.seen(), solve)
        view = self.show_frame(view, self.levels)
        rate_rad_s = np.linalg.norm(self.pushed.simulation.rate_body_rad_s)
        return PushedView(
            view, float(np.linalg.norm(self.pushed.torque_nm)), math.degrees(rate_rad_s)
        )

    def check(self) -> Check:
        """The facts of the scene and its warnings, as `skysim check` prints them."""
        return checks.check(self.workbench.whole)

    def ambiguity(self) -> AmbiguityMap:
        return ambiguity(self.workbench.lab)

    def reach(self) -> tuple[list[Triple], Floats]:
        """Attitudes in reach of the vehicle, and boresights."""
        return geometry.in_reach(self.workbench.lab)

    def cover(self, angles_deg: Triple) -> tuple[int, FrameRow]:
        """Number of lights in the field at an attitude, and the tracker's result there."""
        bench = self.workbench
        return bench.cover(geometry.from_angles(bench.lab, angles_deg))

    def plan_survey(self, frames: int) -> SurveyPlan:
        """Begin a survey of the scene's dome."""
        self.surveyed, plan = playback.begin(self.workbench.whole.scene, frames)
        return plan

    def adjust_survey(self, frames: int) -> SurveyFound:
        """Adjust the dome to the frames flown so far, and plan further ones. Raises InputError if none are new."""
        if self.flight is None:
            raise InputError("", "no flight: fly the survey's attitudes")
        views = [kept.view for kept in self.flight.frames]
        return self.survey_of_scene.adjust(self.flight.flight, views, frames)

    def survey_map(self) -> bytes:
        """The file for `tracker.map`. Raises InputError if nothing is measured."""
        return self.survey_of_scene.map_file()

    def begin_flight(self) -> FlightStep:
        """Begin to compute the scene's flight; `advance_flight` does the work."""
        self.flight = playback.Playback(self.workbench)
        return self.flight.advance(0.0)

    def advance_flight(self, budget_s: float) -> FlightStep:
        """Compute the flight for about budget_s. Raises InputError if none has begun."""
        if self.flight is None:
            raise InputError(
                "", "the flight was lost with its worker: Simulate computes it again"
            )
        return self.flight.advance(budget_s)

    def flight_frame(self, index: int) -> FrameView:
        """A kept frame of the flight. Raises InputError if it has not been computed."""
        if self.flight is None or not 0 <= index < len(self.flight.frames):
            raise InputError("", f"the flight has no frame {index}")
        return self.show_frame(*self.flight.show(index))

    def keep_flight(self, keeps: bool) -> None:
        """Keep the flight as the reference of further ones, or keep none."""
        self.reference = self.flight if keeps else None

    def kept_frame(self, index: int) -> photo.Photo:
        """A frame of the reference. Raises InputError if there is none."""
        kept = self.reference
        if kept is None:
            raise InputError("", "the reference's frames were lost with their worker")
        picture = photo.scene_photo(kept.bench, kept.frames[index].view)
        frame, _ = kept.flight.render(index, kept.bench.head)
        return self.show_photo((picture, frame.image_dn))

    def replay(self, study: str, folder: str, trial: int) -> photo.Photo:
        """Repeat a study's trial; the page shows its frame."""
        return self.show_photo(photo.photo_from_trial(study, Path(folder), trial))

    def export(self) -> dict[str, bytes]:
        """The files of the image on the page."""
        if self.other:
            return photo.photo_files(*self.other)
        bench = self.workbench
        overrides = self.overrides
        if self.flight:
            self.flight.render()
        if self.flight is None or not self.flight.is_shown:
            overrides = overrides | bench.scene_at_rest()
        return photo.frame_files(bench, self.scene, overrides)

    def solve_file(
        self, name: str, data: bytes, fov_deg: float | None, stages: photo.Stages = ()
    ) -> photo.Photo:
        return self.show_photo(photo.photo_from_file(name, data, fov_deg, stages))

    def solve_next(
        self,
        source: str,
        fov_deg: float | None,
        stages: photo.Stages = (),
        as_scene: bool = False,
        follow: bool = False,
    ) -> photo.Photo | bool:
        """Solve the next frame of a source, which stays open; False if there is none yet.

        Parameters
        ----------
        as_scene
            Whether it is of the scene's camera, else of any camera under the sky
        follow
            Whether the scene takes its attitude
        """
        if self.source is None:
            self.source = real.RealSource(source)
        found = self.source.picture()
        if found is None:
            return False
        if as_scene:
            return self.show_photo(self.comparison.solve(self.workbench, *found, follow))
        name, picture = found
        solved, image = photo.solve_frame(picture.pixels, fov_deg, stages)
        return self.show_photo((replace(solved, name=name), image))

    @property
    def comparison(self) -> real.RealComparison:
        """The real frames of the scene."""
        scene = self.workbench.scene
        if self.compared is None or self.compared.scene != scene:
            self.compared = real.RealComparison(scene)
        return self.compared

    def real_view(self, name: str) -> photo.Photo:
        """The newest real frame as one of REAL_VIEWS."""
        return self.show_photo(self.comparison.show(name))

    def explain(self) -> str:
        """What would explain the residuals of the real frames."""
        return self.comparison.explain()

    def release(self) -> None:
        """Close the source."""
        if self.source:
            self.source.close()
        self.source = None
