"""Image panel: solves an uploaded image or frames of a live camera; shows the solution or the reason for none."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nicegui import ui

from skysim.apps.gui.worker.photo import SUFFIXES

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab
    from skysim.apps.gui.worker.photo import Photo

LIMIT_BYTES = 64 * 2**20


class PhotoPanel:
    """Panel with upload area, live camera and result text."""

    def __init__(self, tab: Tab) -> None:
        self.tab, self.live, self.logged = tab, False, ""
        self.fov = ui.number("field of view, deg (empty: 5 to 40 are tried)", min=1, max=120)
        self.fov.props("dense outlined clearable").classes("w-full").mark("fov")
        self.upload = ui.upload(
            label="Drop a FITS, PNG, JPEG, TIFF or BMP here",
            auto_upload=True,
            max_file_size=LIMIT_BYTES,
            on_upload=self.dropped,
            on_rejected=lambda: tab.say(f"not taken: allowed: {', '.join(SUFFIXES)}, at most 64 MB"),
        )
        self.upload.props(f'flat bordered accept="{",".join(SUFFIXES)}"').classes("w-full").style(
            "margin: 10px 0"
        )
        self.upload.mark("upload")
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            self.source = (
                ui.input("live camera: index, file or address").props("dense outlined").classes("flex-grow")
            )
            self.button = ui.button("Look", on_click=self.watch).props("dense outline size=sm").mark("camera")
        self.facts = (
            ui.label(
                "No picture yet. It is solved without being told where it looks; a wrong answer is worse "
                "than none, so it may be refused."
            )
            .classes("mono quiet")
            .style("margin-top: 10px; white-space: pre-wrap")
        )
        self.facts.mark("facts")

    async def dropped(self, event: Any) -> None:
        """Solve an uploaded file."""
        data = await event.file.read()
        name = str(event.file.name)
        self.upload.reset()
        if len(data) > LIMIT_BYTES:
            self.tab.say(f"{name}: larger than 64 MB")
            return
        self.tab.rest()
        self.say(f"solving {name} …", "quiet")
        self.show(
            name, await self.tab.ask("solve_file", name, data, self.fov.value, {}, doing=f"solving {name} …")
        )

    def stop(self) -> None:
        """Stop the live camera after the current frame."""
        if self.live:
            self.live = False
            self.button.disable()

    async def watch(self) -> None:
        """Solve frames of a live camera until the button is pressed again or a frame fails."""
        if self.live:
            self.stop()
            return
        self.tab.rest()
        self.live, seen, source = True, 0, (self.source.value or "0").strip()
        self.button.set_text("Stop")
        while self.live:
            photo = await self.tab.ask("solve_camera", source, self.fov.value, {})
            if not self.tab.open_still:
                return
            if photo or not seen:  # a camera that ends keeps its last result on the page
                self.show("camera", photo)
            seen += 1
            self.live = self.live and photo is not None
        self.button.disable()
        await self.tab.wait(self.tab.session.ask("release"))
        self.button.set_text("Look")
        self.button.enable()

    def show(self, name: str, photo: Photo | None) -> None:
        """Display the image with its marks, and the solution."""
        if photo is None:
            self.say(self.tab.said if self.tab.said.startswith(name) else f"{name}: {self.tab.said}", "warn")
            return
        self.tab.sensor.show_photo(photo)
        self.tab.attitude.show_photo(photo)
        told = f"{name}: {photo.answer.status}"
        if told != self.logged:  # log the repeated status of a live camera once
            self.logged = told
            self.tab.log(told)
        found = photo.solution
        if not found:
            self.say(f"{told}\nRefused: a wrong attitude is worse than none.", "warn")
            return
        where = f"RA {found['ra_deg']:.4f}°  Dec {found['dec_deg']:+.4f}°  roll {found['roll_deg']:.3f}°"
        how = f"field {found['fov_deg']:.3f}°  {found['matches']} stars  rms {found['rms_arcsec']:.1f}″"
        self.say(f"{told}\n{where}\n{how}", "good")

    def say(self, text: str, ink: str) -> None:
        """Set the result text."""
        self.facts.set_text(text)
        self.facts.classes(remove="quiet good warn", add=ink)
