"""The page of a browser tab: builds the panels and passes key and mouse actions to the session."""

from __future__ import annotations

import asyncio
import secrets
import signal
import time
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from nicegui import run, ui

from skysim.apps.gui.messages import FrameView, SceneInfo, Triple
from skysim.apps.gui.page import forms, keys, style
from skysim.apps.gui.page.frame.live import Contents, LiveText
from skysim.apps.gui.page.frame.sensor import FRAMES, Sensor
from skysim.apps.gui.page.panels import lights, monte_carlo
from skysim.apps.gui.page.panels.attitude import AttitudeCard
from skysim.apps.gui.page.panels.lights import LightsPanel
from skysim.apps.gui.page.panels.monte_carlo import MonteCarloPanel
from skysim.apps.gui.page.panels.photo import PhotoPanel
from skysim.apps.gui.page.panels.plan import PlanPanel
from skysim.apps.gui.page.panels.run import RunPanel
from skysim.apps.gui.page.settings.scene import ScenePanel
from skysim.apps.gui.page.settings.tracker import TrackerPanel
from skysim.apps.gui.page.shell.actions import Actions
from skysim.apps.gui.page.shell.arrangement import Arrangement
from skysim.apps.gui.page.shell.help import help_dialog
from skysim.apps.gui.page.shell.history import History
from skysim.apps.gui.page.shell.log import LogPanel
from skysim.apps.gui.page.shell.palette import Palette
from skysim.apps.gui.page.shell.wording import for_page
from skysim.apps.gui.page.space.space import Scene3D
from skysim.apps.gui.state import View
from skysim.apps.gui.worker import export
from skysim.apps.gui.worker.photo import Photo
from skysim.apps.gui.worker.session import Session, WorkerLost
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.scene.loader import find, load

PAUSE_S = 0.005  # between the parts of a page that is built, in which the keys of other pages are answered
PANELS = ("Run", "Lights", "Scene", "Tracker", "Plan", "Monte Carlo", "Image", "Log")


class Tab:
    """One tab: its worker, its scene, and its page elements.

    session : its worker, set when it has got one
    new_session : gives another worker, None if there are too many
    folder : where scenes are saved;  out : where studies are;  cameras : live ones that it may watch
    user : its browser, see `server.user_of`
    state : what the page shows;  view : the newest frame of the scene
    feedback : of the scene's controller; None without a controller
    solving : whether every frame is solved;  contents : of the fields that change with every frame
    editing, filling : held while the scene is changed, or a form of its keys is filled
    """

    session: Session
    new_session: Callable[[], Session | None]

    def __init__(self, scene: str, folder: Path, out: Path, cameras: Sequence[str] = (), user: str = "") -> None:
        self.id, self.user = secrets.token_hex(8), user
        self.folder, self.out, self.cameras = folder, out, cameras
        self.state = View(scene)
        self.scene_info: SceneInfo | None = None
        self.view: FrameView | None = None
        self.feedback: str | None = None
        self.solving, self.is_open, self.restarting = True, True, False
        self.message_text, self.contents = "", Contents()
        self.editing, self.filling = asyncio.Lock(), asyncio.Lock()

    async def close(self) -> None:
        """Release the tab's resources after its browser has gone: frames, study and worker."""
        self.is_open = False
        FRAMES.pop(self.id, None)
        self.study_panel.process.stop(signal.SIGTERM)
        if hasattr(self, "session"):
            await asyncio.to_thread(self.session.close)

    async def restart(self) -> None:
        """Show the view again with a new worker after the old one has ended."""
        lost, session = self.session, self.new_session()
        await asyncio.to_thread(lost.close)
        if session is None:
            self.show_message("the worker of this page has stopped, and all others are in use: reload to wait for one")
            return
        self.session, self.view, wanted = session, None, self.state
        self.log("the worker of this page has stopped; a new one shows the view again")
        await self.restore(wanted)

    @property
    def scene(self) -> str:
        return self.state.scene

    @property
    def overrides(self) -> Mapping[str, str]:
        """Keys of the scene that differ from its file."""
        return self.state.overrides

    # Page elements.

    async def build(self) -> None:
        """Build all elements, in parts between which other pages get their turn."""
        ui.add_css(style.CSS)
        ui.add_body_html(f"<script>{keys.SUPPRESS_DEFAULTS_JS}</script>")
        ui.colors(
            primary=style.DARK["accent"],
            negative=style.DARK["bad"],
            dark=style.DARK["panel"],
            dark_page=style.DARK["ground"],
        )
        with ui.element("div").classes("lab"):
            self.build_header()
            self.sensor = Sensor(self)
            await asyncio.sleep(PAUSE_S)
            with ui.element("div").classes("lab-side"):
                Arrangement.splitter("side", "vertical", "Width of the panels")
                self.attitude = AttitudeCard(self)
                await self.build_panels()
            with ui.element("div").classes("lab-keys").mark("keys"):
                for key in keys.KEYS:
                    if key.description:
                        ui.html(f"<span><kbd>{key.label}</kbd>{key.description}</span>", sanitize=False)
        await asyncio.sleep(PAUSE_S)
        self.help = help_dialog()
        self.actions = Actions(self, PANELS)
        ui.keyboard(on_key=self.actions.key, ignore=["input", "textarea"])
        self.history = History(self, self.scene)
        self.palette = Palette(self.actions.commands)
        self.arrangement = Arrangement([self.run_panel.strips.chart, self.study_panel.chart])
        # A timer waits for the browser, whereupon NiceGUI sends the page as it is: so timers come after all pauses.
        ui.timer(lights.UPDATE_S, self.lights.update)
        ui.timer(monte_carlo.POLL_S, self.study_panel.poll)

    def build_header(self) -> None:
        with ui.element("div").classes("lab-head"):
            ui.label("skysim gui").classes("lab-name")
            self.picker = ui.select(self.scenes(), value=self.scene, on_change=self.scene_picked)
            self.picker.props('dense borderless options-dense aria-label="Scene"').classes("w-44").mark("scene")
            self.picker.on("popup-hide", js_handler=keys.BLUR_JS)
            self.banner = LiveText(self.contents, "live").classes("lab-banner").mark("banner")
            self.live_button = ui.button("Live", on_click=self.go_live).props("dense outline size=sm").mark("live")
            self.live_button.set_visibility(False)
            self.title = ui.label().classes("lab-title quiet ellipsis")
            self.message = ui.label().classes("lab-said").props('role="status"').mark("message")
            self.busy = ui.icon("hourglass_empty", size="16px").classes("lab-busy").mark("busy")
            self.latency = LiveText(self.contents).classes("lab-rate mono quiet").mark("rate")
            self.latency.props('title="latency: from the request for a frame to its arrival"')
            self.noise = ui.switch("noise", value=True, on_change=self.switch_noise).props("dense size=xs")
            ui.switch("identify", value=True).bind_value_to(self, "solving").props("dense size=xs")
            with ui.button("Export").props("dense flat size=sm").mark("export"), ui.menu():
                for name in export.FILE_BY_ITEM:
                    item = ui.menu_item(name, on_click=lambda name=name: self.export(name))
                    item.props("dense").style("white-space: nowrap")

    def scenes(self) -> dict[str, str]:
        """Scenes to choose from and their labels: shipped ones, those saved in the folder, and the current one."""
        own = [path for path in sorted(self.folder.glob("*.yaml")) if forms.is_scene(path)]
        return (
            {path.stem: path.stem for path in sorted(SCENES.glob("*.yaml"))}
            | {str(path): path.name for path in own}
            | {self.scene: Path(self.scene).name}
        )

    async def build_panels(self) -> None:
        with ui.element("div").classes("lab-panes"):
            with ui.element("div").classes("lab-space-pane"):
                self.scene_3d = Scene3D(self)
            Arrangement.splitter("space", "horizontal", "Height of the 3-D view")
            with ui.tabs().props("dense align=left no-caps indicator-color=primary") as self.tabs:
                # Otherwise the arrow keys would select tabs.
                self.tabs.on("click", js_handler=keys.BLUR_JS)
                for name in PANELS:
                    ui.tab(name).mark(f"tab-{name}")
            with ui.tab_panels(self.tabs, value=PANELS[0], animated=False, keep_alive=True).classes("lab-panels"):
                with ui.tab_panel("Lights"):
                    self.lights = LightsPanel(self)
                with ui.tab_panel("Scene"):
                    self.scene_panel = ScenePanel(self)
                with ui.tab_panel("Plan"):
                    self.plan_panel = PlanPanel(self)
                await asyncio.sleep(PAUSE_S)
                with ui.tab_panel("Run").classes("lab-run"):
                    self.run_panel = RunPanel(self)
                await asyncio.sleep(PAUSE_S)
                with ui.tab_panel("Monte Carlo"):
                    self.study_panel = MonteCarloPanel(self)
                await asyncio.sleep(PAUSE_S)
                with ui.tab_panel("Tracker"):
                    self.tracker_panel = TrackerPanel(self)
                with ui.tab_panel("Image"):
                    self.photo = PhotoPanel(self)
                with ui.tab_panel("Log"):
                    self.log_panel = LogPanel(self)
        self.tabs.on_value_change(self.fill_form)

    # Actions.

    async def scene_picked(self) -> None:
        if self.picker.value != self.scene:
            await self.open(str(self.picker.value))

    async def start(self) -> None:
        """Show the first view: that of the page's address or of the browser's storage, else the server's scene."""
        await self.arrangement.restore()
        await self.show_query(await self.history.read())
        refusal = self.message_text
        if self.is_open and self.view is None and await self.open(self.scene):
            self.show_message(refusal)

    async def show_query(self, query: str) -> None:
        """Show the view of an address; refuse one that is not of this server."""
        try:
            wanted = View.from_query(query, self.scenes())
            if wanted:
                await asyncio.to_thread(forms.validated_scene, wanted.scene, wanted.overrides)
        except InputError as error:
            self.show_message(for_page(error))
            return
        if wanted:
            await self.restore(wanted)

    async def restore(self, wanted: View) -> None:
        """Show a view again: open its scene if it is another, point there, then fly or replay."""
        now = self.state
        is_open = self.view is not None and (now.scene, now.overrides) == (wanted.scene, wanted.overrides)
        if not is_open or wanted.angles_deg is None:
            if not await self.open(wanted.scene, wanted.overrides, wanted.angles_deg):
                return
        elif wanted.kind == "live" and (now.kind != "live" or now.angles_deg != wanted.angles_deg):
            self.stop_playback()
            await self.show_live(self.session.run("point", wanted.angles_deg, self.solving))
        if wanted.study != self.state.study:
            await self.study_panel.show_study(wanted.study)
        if wanted.kind == "flight":
            await self.run_panel.restore(wanted.t_s)
        elif wanted.kind == "replay" and wanted.study == self.state.study:
            await self.study_panel.replay(wanted.trial)
        elif wanted.kind == "photo":
            self.show_message(f"{wanted.photo}: drop the image again to see it", "quiet")

    def set_state(self, **changes: Any) -> None:
        """Change what the page shows, as the banner says."""
        self.state = replace(self.state, **changes)
        self.banner.set_text(self.state.banner, self.state.kind)
        self.live_button.set_visibility(self.state.kind != "live")

    async def open(
        self, scene: str, overrides: Mapping[str, str] | None = None, angles_deg: Triple | None = None
    ) -> bool:
        """Set up a scene and show a first frame, at its start or at other angles; keep the old scene if that fails."""
        self.stop_playback()
        self.run_panel.stop_computing()
        overrides = dict(overrides or {})
        activity = f"setting up {Path(scene).name} …" if self.view else ""
        if not self.view:  # the sensor view shows the message
            self.sensor.show_setting_up(scene)
        path = str(find(scene).resolve())
        result = await self.run_task("open", path, overrides, self.solving, angles_deg, activity=activity)
        if result is None:
            self.picker.set_value(self.scene)
            if self.view is None:
                self.sensor.show_waiting(f"{Path(scene).name} cannot be set up:", self.message_text, in_vain=True)
            return False
        self.scene_info, view = result
        control = (await asyncio.to_thread(load, path, overrides)).motion.control
        self.feedback = control.feedback if control else None
        self.set_state(scene=scene, overrides=overrides)
        self.picker.set_value(scene)
        self.title.props["title"] = self.scene_info.title  # tooltip with the full title
        self.title.set_text(self.scene_info.title)
        self.noise.set_value(self.scene_info.noise)
        self.attitude.set_scene(self.scene_info)
        self.scene_3d.set_scene(self.scene_info)
        self.sensor.clear_zoom()
        self.run_panel.set_scene()
        self.plan_panel.set_scene()
        self.study_panel.set_scene()
        self.display_live(view)
        self.scene_panel.shown = self.tracker_panel.shown = None  # the file may be another one under the same name
        await self.fill_form()
        self.log(f"opened {Path(scene).name}" + (f" with {', '.join(overrides)}" if overrides else ""))
        return True

    async def fill_form(self) -> None:
        """Show the keys of the current scene in the panel of them that is open; it takes a while, so not in others."""
        panels: dict[str, ScenePanel | TrackerPanel] = {"Scene": self.scene_panel, "Tracker": self.tracker_panel}
        panel = panels.get(str(self.tabs.value))
        async with self.filling:
            while panel and self.view and self.is_open and panel.shown != (current := (self.scene, self.overrides)):
                fields = await run.io_bound(forms.fields, *current)
                if self.is_open and (self.scene, self.overrides) == current:
                    panel.set_scene(fields)
                    panel.shown = current

    async def apply_overrides(self, overrides: Mapping[str, str], dropped: Collection[str] = ()) -> None:
        """Reopen the scene with further overrides and without some; edits made meanwhile follow one after the other."""
        async with self.editing:
            kept = {key: text for key, text in self.overrides.items() if key not in dropped}
            await self.open(self.scene, {**kept, **overrides})

    async def switch_noise(self) -> None:
        """Render with the camera's noise, or each pixel's expected value; the attitude is kept."""
        info = self.scene_info
        if info and info.noise != self.noise.value:
            await self.apply_overrides({"camera.detector.noise": str(bool(self.noise.value)).lower()})
            self.noise.set_value(self.scene_info.noise if self.scene_info else True)

    @property
    def scene_path(self) -> str:
        """Absolute path of the scene file, since study files are written to other folders."""
        return str(find(self.scene).resolve())

    async def show_live(self, pending: Awaitable[Any]) -> FrameView | None:
        """Wait for a frame of the live scene and display it; None if the request failed or the tab has closed."""
        begin = time.perf_counter()
        view = await self.await_result(pending)
        if view is not None:
            self.latency.set_text(f"{1e3 * (time.perf_counter() - begin):.0f} ms")
            self.display_live(view)
        return view

    def display_live(self, view: FrameView) -> None:
        self.set_state(kind="live", angles_deg=view.angles_deg)
        self.display_frame(view)

    def display_frame(self, view: FrameView) -> None:
        """Show a frame of the scene: live, or of its flight."""
        self.view = view
        self.attitude.show(view)
        self.scene_3d.show(view)
        self.sensor.show(view)

    def display_photo(self, photo: Photo, /, **state: Any) -> None:
        """Show an image that is not of the scene as it is now: a photograph, or a trial again.

        state : what the page shows thereby
        """
        self.set_state(**state)
        self.attitude.show_photo(photo)
        self.sensor.show_photo(photo)

    async def go_live(self) -> None:
        """Return to the live scene at the newest attitude."""
        self.stop_playback()
        await self.show_live(self.session.run("render", self.solving))

    def stop_playback(self) -> None:
        """Stop playback, a pushed vehicle and the live camera, because the sensor view is needed for something else."""
        self.run_panel.pause()
        self.scene_3d.push.stop()
        self.photo.stop()

    async def run_task(self, task: str, *arguments: Any, activity: str = "") -> Any:
        """Run a task in the worker and return its result, or None after an error, which is displayed.

        activity : message shown until the task ends
        """
        self.show_message(activity, "quiet")
        self.busy.set_visibility(True)
        try:
            return await self.await_result(self.session.run(task, *arguments))
        finally:
            if self.is_open:
                self.busy.set_visibility(False)
                if activity and self.message_text == activity:
                    self.show_message("")

    async def await_result(self, pending: Awaitable[Any]) -> Any:
        """Await a result; display an error in one line and return None."""
        try:
            result = await pending
        except InputError as error:
            if self.is_open:
                self.show_message(for_page(error))
            return None
        except WorkerLost as error:
            if self.is_open and not self.restarting:
                self.restarting = True
                self.show_message(f"{error}; a new one shows the view again")
                try:
                    await self.restart()
                finally:
                    self.restarting = False
            return None
        return result if self.is_open else None

    def show_message(self, text: str, color: str = "warn") -> None:
        """Show a message in the head until the next action; warnings are also logged."""
        if text == self.message_text:
            return
        self.message_text = text
        self.message.props["title"] = text  # tooltip with the full text
        self.message.set_text(text)
        self.message.classes(remove="good warn quiet", add=color)
        if text and color == "warn":
            self.log(text)

    def log(self, text: str) -> None:
        """Add a line to the log."""
        self.log_panel.add(text)

    async def export(self, kind: str) -> None:
        files = await self.run_task("export")
        if not files:
            return
        name = export.FILE_BY_ITEM[kind]
        if not name:
            ui.download(export.zip_archive(files), f"{Path(self.scene).stem}.zip")
        elif name in files:
            ui.download(files[name], name)
        else:
            reason = "no solution yet: press 1" if name == "solution.json" else "not known of an image from elsewhere"
            self.show_message(f"{kind}: {reason}")
