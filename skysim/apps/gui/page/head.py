"""The head of the page: its scene, what it shows, its messages, noise, identification, and export."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui

from skysim.apps.gui.messages import SceneInfo
from skysim.apps.gui.shared import forms, keys
from skysim.apps.gui.shared.context import PageContext
from skysim.apps.gui.shared.live import Contents, LiveText
from skysim.apps.gui.shared.state import View
from skysim.apps.gui.worker import export
from skysim.core.paths import SCENES


class Head:
    """The elements of the head, and what they do.

    folder : where scenes are saved;  message_text : the message
    """

    def __init__(self, page: PageContext, contents: Contents, folder: Path) -> None:
        self.page = page
        self.folder = folder
        self.message_text = ""
        with ui.element("div").classes("lab-head"):
            ui.label("skysim gui").classes("lab-name")
            self.picker = ui.select(
                self.scenes(), value=page.state.scene, on_change=self.scene_picked
            )
            self.picker.props('dense borderless options-dense aria-label="Scene"').classes(
                "w-44"
            ).mark("scene")
            self.picker.on("popup-hide", js_handler=keys.BLUR_JS)
            self.banner = LiveText(contents, "live").classes("lab-banner").mark("banner")
            self.live_button = (
                ui.button("Live", on_click=self.go_live).props("dense outline size=sm").mark("live")
            )
            self.live_button.set_visibility(False)
            self.title = ui.label().classes("lab-title quiet ellipsis")
            self.message = ui.label().classes("lab-said").props('role="status"').mark("message")
            self.busy = ui.icon("hourglass_empty", size="16px").classes("lab-busy").mark("busy")
            self.latency = LiveText(contents).classes("lab-rate mono quiet").mark("rate")
            self.latency.props('title="latency: from the request for a frame to its arrival"')
            self.noise = ui.switch("noise", value=True, on_change=self.switch_noise).props(
                "dense size=xs"
            )
            self.identify = ui.switch("identify", value=True).props("dense size=xs")
            with ui.button("Export").props("dense flat size=sm").mark("export"), ui.menu():
                for name in export.FILE_BY_ITEM:
                    item = ui.menu_item(name, on_click=lambda name=name: self.export(name))
                    item.props("dense").style("white-space: nowrap")

    def scenes(self) -> dict[str, str]:
        """Scenes to choose from and their labels: shipped ones, those saved in the folder, and the current one."""
        current = self.page.state.scene
        own = [path for path in sorted(self.folder.glob("*.yaml")) if forms.is_scene(path)]
        return (
            {path.stem: path.stem for path in sorted(SCENES.glob("*.yaml"))}
            | {str(path): path.name for path in own}
            | {current: Path(current).name}
        )

    def update_scenes(self) -> None:
        """Offer a scene that was saved meanwhile."""
        self.picker.set_options(self.scenes())

    async def scene_picked(self) -> None:
        if self.picker.value != self.page.state.scene:
            await self.page.open(str(self.picker.value))

    # What it shows.

    def set_scene(self, info: SceneInfo) -> None:
        """Show the name, the title and the noise of the scene that is open now."""
        self.picker.set_value(self.page.state.scene)
        self.title.props["title"] = info.title  # tooltip with the full title
        self.title.set_text(info.title)
        self.noise.set_value(info.noise)

    def set_state(self, state: View) -> None:
        """Say in the banner what the page shows."""
        self.banner.set_text(state.banner, state.kind)
        self.live_button.set_visibility(state.kind != "live")

    def set_message(self, text: str, color: str) -> None:
        self.message_text = text
        self.message.props["title"] = text  # tooltip with the full text
        self.message.set_text(text)
        self.message.classes(remove="good warn quiet", add=color)

    # What its elements do.

    async def go_live(self) -> None:
        """Return to the live scene at the newest attitude."""
        self.page.stop_playback()
        await self.page.show_live("render", self.page.solving)

    def toggle_noise(self) -> None:
        self.noise.set_value(not self.noise.value)

    async def switch_noise(self) -> None:
        """Render with the camera's noise, or each pixel's expected value; the attitude is kept."""
        info = self.page.scene_info
        if info and info.noise != self.noise.value:
            await self.page.apply_overrides(
                {"camera.detector.noise": str(bool(self.noise.value)).lower()}
            )
            info = self.page.scene_info
            self.noise.set_value(info.noise if info else True)

    async def export(self, item: str) -> None:
        """Download a file of the image on the page, or all of them. item : of the menu"""
        files = await self.page.run_task("export")
        if not files:
            return
        name = export.FILE_BY_ITEM[item]
        if not name:
            ui.download(export.zip_archive(files), f"{Path(self.page.state.scene).stem}.zip")
        elif name in files:
            ui.download(files[name], name)
        else:
            reason = (
                "no solution yet: press 1"
                if name == "solution.json"
                else "not known of an image from elsewhere"
            )
            self.page.show_message(f"{item}: {reason}")
