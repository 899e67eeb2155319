"""Tasks of a worker process: methods of `Worker`, called by name, which keeps its state between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from numpy.typing import NDArray

from skysim.apps.gui.messages import FrameView, MotionLog, SceneInfo, Triple
from skysim.apps.gui.worker import export, photo, playback, pointing
from skysim.apps.gui.worker.workbench import Workbench
from skysim.core.errors import InputError
from skysim.core.io import images
from skysim.simulation import run
from skysim.simulation.testbed import Testbed


class Stopped(Exception):
    """Raised in a task that the user has stopped."""


@dataclass
class Worker:
    """State between tasks: the workbench, its simulated motion, and the other image if the page shows one.

    report_progress : reports progress (done, total) of a long task; raises Stopped if the task shall end
    moved : the testbed after the simulation of its motion
    other, image : an image that is not of the scene, and its (H, W) pixels;  camera : an open live camera
    """

    report_progress: Callable[[float, float], None]
    current: Workbench | None = None
    moved: Testbed | None = None
    other: photo.Photo | None = None
    image: NDArray | None = None
    scene: str = ""
    overrides: Mapping[str, str] | None = None
    camera: images.LiveCamera | None = None

    @property
    def workbench(self) -> Workbench:
        """The current workbench. Raises InputError if no scene is set up."""
        if self.current is None:
            raise InputError("no scene is set up")
        return self.current

    def show_frame(self, view: FrameView) -> FrameView:
        """Return the view, and forget the other image, because the page now shows the scene."""
        self.other = self.image = None
        return view

    def show_photo(self, photo_pixels: photo.PhotoPixels) -> photo.Photo:
        """Keep an image that is not of the scene, and return its view."""
        self.other, self.image = photo_pixels
        return self.other

    # Tasks.

    def warm_up(self, scene: str) -> None:
        """Set up a scene and solve one frame, so that code is imported and compiled."""
        Workbench.open(scene, {}).render_at_rest(solve=True)

    def open(self, scene: str, overrides: Mapping[str, str], solve: bool) -> tuple[SceneInfo, FrameView]:
        """Set up a scene and render a first frame."""
        self.current = Workbench.open(scene, overrides, self.current)
        self.scene, self.overrides, self.moved = scene, dict(overrides), None
        return self.current.scene_info, self.render(solve)

    def render(self, solve: bool) -> FrameView:
        return self.show_frame(self.workbench.render_at_rest(solve))

    def point(self, angles_deg: Triple, solve: bool) -> FrameView:
        bench = self.workbench
        bench.lab_from_body = pointing.from_angles(bench.scene, bench.testbed.mount, angles_deg)
        return self.render(solve)

    def move(self, right: float, up: float, roll_deg: float, solve: bool) -> FrameView:
        bench = self.workbench
        bench.lab_from_body = pointing.moved(bench.scene, bench.testbed.mount, bench.lab_from_body, right, up, roll_deg)
        return self.render(solve)

    def simulate(self) -> MotionLog:
        """Simulate the whole motion, for playback."""
        self.moved = run.simulate_motion(self.workbench.testbed, self.report_progress)
        return playback.curves(self.moved.log)

    def play(self, t_s: float, solve: bool) -> FrameView:
        """Render the frame at time t_s of the motion. Raises InputError if none was simulated."""
        if self.moved is None:
            raise InputError("no motion has been simulated yet")
        return self.show_frame(playback.render_at(self.workbench, self.moved, t_s, solve))

    def replay(self, study: str, folder: str, trial: int) -> photo.Photo:
        """Repeat a study's trial; the page shows its frame."""
        return self.show_photo(photo.photo_from_trial(study, Path(folder), trial))

    def export(self) -> dict[str, bytes]:
        """The files of the image on the page."""
        if self.other is not None and self.image is not None:
            return export.photo_files(self.other, self.image)
        return export.frame_files(self.workbench, self.scene, dict(self.overrides or {}))

    def solve_file(self, name: str, data: bytes, fov_deg: float | None) -> photo.Photo:
        """Solve an uploaded file by the algorithms that the page shows."""
        return self.show_photo(photo.photo_from_file(name, data, fov_deg, self.workbench.stages))

    def solve_camera(self, source: str, fov_deg: float | None) -> photo.Photo:
        """Solve the next frame of a live camera, which stays open."""
        if self.camera is None:
            self.camera = images.LiveCamera(source)
        return self.show_photo(
            photo.solve_frame(images.monochrome(self.camera.frame()), fov_deg, self.workbench.stages)
        )

    def release(self) -> None:
        """Close the live camera."""
        if self.camera:
            self.camera.close()
        self.camera = None
