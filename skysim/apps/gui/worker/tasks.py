"""Tasks of a worker, by name in TASKS. Each takes the state that the worker keeps between tasks, and its arguments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from skysim.apps.gui.messages import FlightLog, FrameView, SceneInfo, Triple, Zoom
from skysim.apps.gui.worker import export, photo
from skysim.apps.gui.worker.flight import Flown
from skysim.apps.gui.worker.workbench import Workbench, zoomed
from skysim.core.errors import InputError
from skysim.core.images import LiveCamera

Watch = Callable[[float, float], None]


@dataclass
class Kept:
    """State between tasks: the workbench, its simulated motion, and the other image if the page shows one.

    watch : reports progress(done, total) of a long task; raises Stopped if the task shall end
    image : (H, W) pixels of an image that is not of the scene;  camera : an open live camera
    """

    watch: Watch
    desk: Workbench | None = None
    flown: Flown | None = None
    image: NDArray | None = None
    scene: str = ""
    overrides: Mapping[str, str] | None = None
    camera: LiveCamera | None = None

    def ready(self) -> Workbench:
        """Return the workbench. Raises InputError if no scene is set up."""
        if self.desk is None:
            raise InputError("no scene is set up")
        return self.desk

    def seen(self, view: FrameView) -> FrameView:
        """Return the view, and forget the other image, because the page now shows the scene."""
        self.image = None
        return view

    def pictured(self, seen: photo.Seen) -> photo.Photo:
        """Keep an image that is not of the scene, and return it with its JPEG."""
        told, self.image = seen
        return replace(told, jpeg=self.packed())

    def packed(self) -> bytes:
        """JPEG of the shown image, with the workbench's stretch."""
        desk = self.ready()
        if self.image is not None:
            return desk.packed(self.image)
        assert desk.frame is not None
        return desk.packed(desk.frame.image_dn)


class Stopped(Exception):
    """Raised in a task that the user has stopped."""


def warm(_: Kept, scene: str) -> None:
    """Warm up: set up a scene and solve one frame, so that code is imported and compiled."""
    Workbench.of(scene, {}).look(solve=True)


def open_scene(
    kept: Kept, scene: str, overrides: Mapping[str, str], solve: bool
) -> tuple[SceneInfo, FrameView]:
    """Set up a scene and render a first frame."""
    kept.desk = Workbench.of(scene, overrides, kept.desk)
    kept.scene, kept.overrides, kept.flown = scene, dict(overrides), None
    return kept.desk.setting, look(kept, solve)


def look(kept: Kept, solve: bool) -> FrameView:
    return kept.seen(kept.ready().look(solve))


def point(kept: Kept, angles_deg: Triple, solve: bool) -> FrameView:
    kept.ready().point(angles_deg)
    return look(kept, solve)


def move(kept: Kept, right: float, up: float, roll_deg: float, solve: bool) -> FrameView:
    kept.ready().move(right, up, roll_deg)
    return look(kept, solve)


def show(kept: Kept, stretch: str, bright: float) -> bytes:
    """Change stretch and brightness; return the shown image as JPEG."""
    desk = kept.ready()
    desk.stretch, desk.bright = stretch, bright
    return kept.packed()


def fit(kept: Kept, widest_px: int) -> bytes:
    """Limit the image's width to the pixels that the screen has for it; return the shown image as JPEG."""
    kept.ready().widest_px = widest_px
    return kept.packed()


def zoom(kept: Kept, x: float, y: float) -> Zoom:
    """The pixels of the shown image around (x, y)."""
    frame = kept.ready().frame
    assert frame is not None
    return zoomed(frame.image_dn if kept.image is None else kept.image, x, y)


def fly(kept: Kept) -> FlightLog:
    """Simulate the whole motion, for playback."""
    kept.flown = Flown.of(kept.ready(), kept.watch)
    return kept.flown.curves


def play(kept: Kept, t_s: float, solve: bool) -> FrameView:
    """Render the frame at time t_s of the motion. Raises InputError if none was simulated."""
    if kept.flown is None:
        raise InputError("nothing was flown yet")
    return kept.seen(kept.flown.at(kept.ready(), t_s, solve))


def replay(kept: Kept, study: str, folder: str, trial: int) -> photo.Photo:
    """Repeat a study's trial; the page shows its frame."""
    return kept.pictured(photo.of_trial(study, Path(folder), trial))


def export_files(kept: Kept) -> dict[str, bytes]:
    return export.files(kept.ready(), kept.scene, dict(kept.overrides or {}))


def solve_file(
    kept: Kept, name: str, data: bytes, fov_deg: float | None, stages: dict[str, str]
) -> photo.Photo:
    return kept.pictured(photo.of_file(name, data, fov_deg, stages))


def solve_camera(kept: Kept, source: str, fov_deg: float | None, stages: dict[str, str]) -> photo.Photo:
    """Solve the next frame of a live camera, which stays open."""
    if kept.camera is None:
        kept.camera = LiveCamera(source)
    return kept.pictured(photo.of_camera(kept.camera, fov_deg, stages))


def release(kept: Kept) -> None:
    """Close the live camera."""
    if kept.camera:
        kept.camera.close()
    kept.camera = None


TASKS: dict[str, Callable[..., Any]] = {
    "warm": warm,
    "open": open_scene,
    "look": look,
    "point": point,
    "move": move,
    "show": show,
    "fit": fit,
    "zoom": zoom,
    "fly": fly,
    "play": play,
    "replay": replay,
    "export": export_files,
    "solve_file": solve_file,
    "solve_camera": solve_camera,
    "release": release,
}
