"""What a worker can be asked, by name. Each is given what the worker keeps between tasks, and how to tell progress."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from skysim.apps.gui.messages import FlightLog, Setting, Triple, View, Zoom
from skysim.apps.gui.worker import export, photo
from skysim.apps.gui.worker.flight import Flown
from skysim.apps.gui.worker.workbench import Desk, zoomed
from skysim.core.errors import InputError
from skysim.core.images import LiveCamera

Watch = Callable[[float, float], None]


@dataclass
class Kept:
    """Between tasks: the desk, the flight that was flown on it, and the user's picture while the page shows one.

    watch : tells how far a long task is; raises Stopped where it is to end
    image : (H, W) of that picture;  camera : a live one that is open
    """

    watch: Watch
    desk: Desk | None = None
    flown: Flown | None = None
    image: NDArray | None = None
    scene: str = ""
    overrides: Mapping[str, str] | None = None
    camera: LiveCamera | None = None

    def ready(self) -> Desk:
        """The desk, once a scene is set up."""
        if self.desk is None:
            raise InputError("no scene is set up")
        return self.desk

    def seen(self, view: View) -> View:
        """The page shows the scene: the user's picture is put away."""
        self.image = None
        return view

    def pictured(self, seen: photo.Seen) -> photo.Photo:
        """A picture of the user's, packed for the page."""
        told, self.image = seen
        return replace(told, jpeg=self.packed())

    def packed(self) -> bytes:
        """What the page shows, as the desk has it stretched."""
        desk = self.ready()
        if self.image is not None:
            return desk.packed(self.image)
        assert desk.frame is not None
        return desk.packed(desk.frame.image_dn)


class Stopped(Exception):
    """The user has stopped a task."""


def warm(_: Kept, scene: str) -> None:
    """Do once what a tab will do, for nobody."""
    Desk.of(scene, {}).look(solve=True)


def open_scene(kept: Kept, scene: str, overrides: Mapping[str, str], solve: bool) -> tuple[Setting, View]:
    """Set a scene up and look."""
    kept.desk = Desk.of(scene, overrides, kept.desk)
    kept.scene, kept.overrides, kept.flown = scene, dict(overrides), None
    return kept.desk.setting, look(kept, solve)


def look(kept: Kept, solve: bool) -> View:
    return kept.seen(kept.ready().look(solve))


def point(kept: Kept, angles_deg: Triple, solve: bool) -> View:
    kept.ready().point(angles_deg)
    return look(kept, solve)


def move(kept: Kept, right: float, up: float, roll_deg: float, solve: bool) -> View:
    kept.ready().move(right, up, roll_deg)
    return look(kept, solve)


def show(kept: Kept, stretch: str, bright: float) -> bytes:
    """What is shown as JPEG, stretched otherwise."""
    desk = kept.ready()
    desk.stretch, desk.bright = stretch, bright
    return kept.packed()


def fit(kept: Kept, widest_px: int) -> bytes:
    """What is shown, for a screen that has so many pixels for it."""
    kept.ready().widest_px = widest_px
    return kept.packed()


def zoom(kept: Kept, x: float, y: float) -> Zoom:
    """The pixels around one of what is shown."""
    frame = kept.ready().frame
    assert frame is not None
    return zoomed(frame.image_dn if kept.image is None else kept.image, x, y)


def fly(kept: Kept) -> FlightLog:
    """The whole flight, to be played."""
    kept.flown = Flown.of(kept.ready(), kept.watch)
    return kept.flown.curves


def play(kept: Kept, t_s: float, solve: bool) -> View:
    """A moment of the flight."""
    if kept.flown is None:
        raise InputError("nothing was flown yet")
    return kept.seen(kept.flown.at(kept.ready(), t_s, solve))


def replay(kept: Kept, study: str, folder: str, trial: int) -> photo.Photo:
    """A trial of a study again, as the page shows a picture."""
    return kept.pictured(photo.of_trial(study, Path(folder), trial))


def export_files(kept: Kept) -> dict[str, bytes]:
    return export.files(kept.ready(), kept.scene, dict(kept.overrides or {}))


def solve_file(
    kept: Kept, name: str, data: bytes, fov_deg: float | None, stages: dict[str, str]
) -> photo.Photo:
    return kept.pictured(photo.of_file(name, data, fov_deg, stages))


def solve_camera(kept: Kept, source: str, fov_deg: float | None, stages: dict[str, str]) -> photo.Photo:
    """The next frame of a camera, which stays open."""
    if kept.camera is None:
        kept.camera = LiveCamera(source)
    return kept.pictured(photo.of_camera(kept.camera, fov_deg, stages))


def release(kept: Kept) -> None:
    """The camera is no longer wanted."""
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
