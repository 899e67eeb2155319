"""Tasks of a worker, by name in TASKS. Each takes the state that the worker keeps between tasks, and its arguments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from skysim.apps.gui.messages import FrameView, MotionLog, PixelWindow, SceneInfo, Triple
from skysim.apps.gui.worker import export, photo
from skysim.apps.gui.worker.playback import MotionPlayback
from skysim.apps.gui.worker.workbench import Workbench, pixel_window
from skysim.core.errors import InputError
from skysim.core.images import LiveCamera

Progress = Callable[[float, float], None]


@dataclass
class WorkerState:
    """State between tasks: the workbench, its simulated motion, and the other image if the page shows one.

    report_progress : reports progress (done, total) of a long task; raises Stopped if the task shall end
    image : (H, W) pixels of an image that is not of the scene;  camera : an open live camera
    """

    report_progress: Progress
    workbench: Workbench | None = None
    playback: MotionPlayback | None = None
    image: NDArray | None = None
    scene: str = ""
    overrides: Mapping[str, str] | None = None
    camera: LiveCamera | None = None

    def require_workbench(self) -> Workbench:
        """Return the workbench. Raises InputError if no scene is set up."""
        if self.workbench is None:
            raise InputError("no scene is set up")
        return self.workbench

    def show_frame(self, view: FrameView) -> FrameView:
        """Return the view, and forget the other image, because the page now shows the scene."""
        self.image = None
        return view

    def show_photo(self, photo_pixels: photo.PhotoPixels) -> photo.Photo:
        """Keep an image that is not of the scene, and return it with its JPEG."""
        shown, self.image = photo_pixels
        return replace(shown, jpeg=self.jpeg())

    def jpeg(self) -> bytes:
        """JPEG of the shown image, with the workbench's stretch."""
        workbench = self.require_workbench()
        if self.image is not None:
            return workbench.to_jpeg(self.image)
        assert workbench.frame is not None
        return workbench.to_jpeg(workbench.frame.image_dn)


class Stopped(Exception):
    """Raised in a task that the user has stopped."""


def warm_up(_: WorkerState, scene: str) -> None:
    """Warm up: set up a scene and solve one frame, so that code is imported and compiled."""
    Workbench.open(scene, {}).render_at_rest(solve=True)


def open_scene(
    state: WorkerState, scene: str, overrides: Mapping[str, str], solve: bool
) -> tuple[SceneInfo, FrameView]:
    """Set up a scene and render a first frame."""
    state.workbench = Workbench.open(scene, overrides, state.workbench)
    state.scene, state.overrides, state.playback = scene, dict(overrides), None
    return state.workbench.scene_info, render(state, solve)


def render(state: WorkerState, solve: bool) -> FrameView:
    return state.show_frame(state.require_workbench().render_at_rest(solve))


def point(state: WorkerState, angles_deg: Triple, solve: bool) -> FrameView:
    state.require_workbench().point(angles_deg)
    return render(state, solve)


def move(state: WorkerState, right: float, up: float, roll_deg: float, solve: bool) -> FrameView:
    state.require_workbench().move(right, up, roll_deg)
    return render(state, solve)


def show(state: WorkerState, stretch: str, brightness: float) -> bytes:
    """Change stretch and brightness; return the shown image as JPEG."""
    workbench = state.require_workbench()
    workbench.stretch, workbench.brightness = stretch, brightness
    return state.jpeg()


def fit(state: WorkerState, widest_px: int) -> bytes:
    """Limit the image's width to the pixels that the screen has for it; return the shown image as JPEG."""
    state.require_workbench().widest_px = widest_px
    return state.jpeg()


def zoom(state: WorkerState, x: float, y: float) -> PixelWindow:
    """The pixels of the shown image around (x, y)."""
    frame = state.require_workbench().frame
    assert frame is not None
    return pixel_window(frame.image_dn if state.image is None else state.image, x, y)


def simulate(state: WorkerState) -> MotionLog:
    """Simulate the whole motion, for playback."""
    state.playback = MotionPlayback.simulate(state.require_workbench(), state.report_progress)
    return state.playback.curves


def play(state: WorkerState, t_s: float, solve: bool) -> FrameView:
    """Render the frame at time t_s of the motion. Raises InputError if none was simulated."""
    if state.playback is None:
        raise InputError("no motion has been simulated yet")
    return state.show_frame(state.playback.render_at(state.require_workbench(), t_s, solve))


def replay(state: WorkerState, study: str, folder: str, trial: int) -> photo.Photo:
    """Repeat a study's trial; the page shows its frame."""
    return state.show_photo(photo.photo_from_trial(study, Path(folder), trial))


def export_files(state: WorkerState) -> dict[str, bytes]:
    return export.frame_files(state.require_workbench(), state.scene, dict(state.overrides or {}))


def solve_file(
    state: WorkerState, name: str, data: bytes, fov_deg: float | None, stages: dict[str, str]
) -> photo.Photo:
    return state.show_photo(photo.photo_from_file(name, data, fov_deg, stages))


def solve_camera(state: WorkerState, source: str, fov_deg: float | None, stages: dict[str, str]) -> photo.Photo:
    """Solve the next frame of a live camera, which stays open."""
    if state.camera is None:
        state.camera = LiveCamera(source)
    return state.show_photo(photo.photo_from_camera(state.camera, fov_deg, stages))


def release(state: WorkerState) -> None:
    """Close the live camera."""
    if state.camera:
        state.camera.close()
    state.camera = None


TASKS: dict[str, Callable[..., Any]] = {
    "warm_up": warm_up,
    "open": open_scene,
    "render": render,
    "point": point,
    "move": move,
    "show": show,
    "fit": fit,
    "zoom": zoom,
    "simulate": simulate,
    "play": play,
    "replay": replay,
    "export": export_files,
    "solve_file": solve_file,
    "solve_camera": solve_camera,
    "release": release,
}
