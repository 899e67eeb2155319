"""Image panel: solves an uploaded image or frames of a live camera; shows the solution or the reason for a refusal."""

import asyncio
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import ui

from skysim.apps.gui.page import real_panel
from skysim.apps.gui.views import context, widgets
from skysim.apps.gui.worker.photo import SUFFIXES, Photo, Stages

POLL_S = 0.5  # time between two looks at a folder
LIMIT_BYTES = 64 * 2**20
NO_IMAGE = (
    "No image on the page. Images are solved lost in space; uncertain matches are rejected."
)


def weak_handler(method: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A handler that does not keep its panel alive, because FastAPI never drops the route of an upload area."""
    reference = weakref.WeakMethod(method)

    def handler(event: Any) -> Any:
        alive = reference()
        return alive(event) if alive else None

    return handler


class PhotoPanel:
    """Panel with upload area, live camera and result text.

    Attributes
    ----------
    cameras
        Live cameras that may be watched
    live
        Whether one is being watched
    logged
        Status that was logged last
    """

    def __init__(self, page: context.PageContext, cameras: Sequence[str]) -> None:
        self.page = page
        self.cameras = cameras
        self.live = False
        self.logged = ""
        self.fov = ui.number("field of view, deg (empty: 2 to 100 are tried)", min=1, max=120)
        self.fov.props("dense outlined clearable").classes("w-full")
        self.upload = ui.upload(
            label="Drop a FITS, PNG, JPEG, TIFF or BMP here",
            auto_upload=True,
            max_file_size=LIMIT_BYTES,
            on_upload=weak_handler(self.uploaded),
            on_rejected=weak_handler(self.rejected),
        )
        self.upload.props(f'flat bordered accept="{",".join(SUFFIXES)}"').classes(
            "w-full"
        ).style("margin: 10px 0")
        with widgets.row():
            self.source = widgets.select(
                list(cameras), label="live camera", value=next(iter(cameras), None)
            ).classes("flex-grow min-w-0")
            self.button = widgets.button("Watch", self.watch)
            if not cameras:
                self.source.set_visibility(False)
                self.button.set_visibility(False)
                widgets.quiet(
                    "No live camera is offered here. Cameras are named when the lab is started."
                )
        self.real = real_panel.RealPanel(page)
        self.real.compares.set_visibility(bool(cameras))
        self.result_text = ui.label(NO_IMAGE)
        self.result_text.classes("mono quiet").style(
            "margin-top: 10px; white-space: pre-wrap"
        )
        page.derive(lambda view: view.image, partial(self.show_text, NO_IMAGE, "quiet"))

    def rejected(self, _: Any) -> None:
        self.page.show_message(f"refused; allowed: {', '.join(SUFFIXES)}, at most 64 MB")

    async def uploaded(self, event: Any) -> None:
        data = await event.file.read()
        name = str(event.file.name)
        self.upload.reset()
        if len(data) > LIMIT_BYTES:
            self.page.show_message(f"{name}: larger than 64 MB")
            return
        self.page.stop_playback()
        self.page.set_state(kind="photo", photo=name)
        solving = f"solving {name} …"
        self.show_text(solving, "quiet")
        self.page.sensor.show_waiting(solving, in_vain=True)
        photo = await self.page.run_task(
            "solve_file",
            name,
            data,
            self.fov.value,
            self.stages,
            activity=solving,
        )
        self.show(name, photo)
        if photo is None:
            self.page.sensor.show_waiting(self.page.message_text, in_vain=True)

    @property
    def stages(self) -> Stages:
        """The algorithms that the user has chosen for stars; a dome's do not solve photographs."""
        info = self.page.scene_info
        chosen = info.stages if info and info.scene.stars else {}
        return tuple((stage, name) for stage, name in chosen.items() if name != "default")

    def stop(self) -> None:
        """Stop the live camera after the current frame."""
        if self.live:
            self.live = False
            self.button.disable()

    async def watch(self) -> None:
        """Solve frames of a live camera until the button is pressed again or a frame fails.

        A folder is watched on after a failure, and while it has no further frame.
        """
        if self.live:
            self.stop()
            return
        # A browser may send any value: only cameras that the command line named are opened.
        if self.source.value not in self.cameras:
            self.page.show_message("live camera: allowed: one of those in the list")
            return
        self.page.stop_playback()
        self.live = True
        solved_count = 0
        source = str(self.source.value)
        self.button.set_text("Stop")
        is_folder = Path(source).is_dir()
        while self.live:
            as_scene = self.real.compares.value
            photo = await self.page.ask(
                "solve_next",
                source,
                self.fov.value,
                self.stages,
                as_scene,
                self.real.follows.value,
            )
            if not self.page.is_open:
                return
            if photo and as_scene:
                self.real.show(photo)
                await self.real.choose()
            elif photo:
                self.show(photo.name, photo)
            elif is_folder:
                await asyncio.sleep(POLL_S)
            elif not solved_count:  # a camera that ends keeps its last result on the page
                self.show("camera", None)
            solved_count += 1
            self.live = self.live and (is_folder or photo is not None)
        self.button.disable()
        await self.page.ask("release")
        self.button.set_text("Watch")
        self.button.enable()

    def show(self, name: str, photo: Photo | None) -> None:
        if photo is None:
            self.show_text(self.page.message_text, "warn")
            return
        self.page.show_photo(photo, kind="photo", photo=name)
        stages = "".join(f"; {stage} {algorithm}" for stage, algorithm in self.stages)
        status_text = f"{name}: {photo.result.row.status}{stages}"
        if status_text != self.logged:  # log the repeated status of a live camera once
            self.logged = status_text
            self.page.log(status_text)
        solution = photo.solution
        if not solution:
            hint = photo.hint or "Rejected: the match is not significant."
            self.show_text(f"{status_text}\n{hint}", "warn")
            return
        pointing = f"RA {solution['ra_deg']:.4f}°  Dec {solution['dec_deg']:+.4f}°  roll {solution['roll_deg']:.3f}°"
        quality = f"field {solution['fov_deg']:.3f}°  {solution['matches']} stars  rms {solution['rms_arcsec']:.1f}″"
        self.show_text(f"{status_text}\n{pointing}\n{quality}", "good")

    def show_text(self, text: str, color: str) -> None:
        self.result_text.set_text(text)
        self.result_text.classes(remove="quiet good warn", add=color)
