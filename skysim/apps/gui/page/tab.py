"""The page of a browser tab: builds its parts, opens scenes, and shows frames in all views.

Its view is in the browser's address, history and storage (`History`). The browser's history serves for undo and redo:
Ctrl-Z goes back, Ctrl-Shift-Z forward. So a reload, the back button, a shared link and undo all read a view from the
address in the same way.
"""

import asyncio
import json
import secrets
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import app, run, ui

from skysim.apps.gui.messages import FrameView, SceneInfo, Triple
from skysim.apps.gui.page import (
    head,
    monte_carlo_panel,
    photo_panel,
    plan_panel,
    readouts,
    real_panel,
    run_panel,
    settings_panel,
)
from skysim.apps.gui.page.actions import Action, Actions, Command
from skysim.apps.gui.views import (
    context,
    forms,
    keys,
    overlay,
    sensor,
    space,
    style,
    widgets,
)
from skysim.apps.gui.views.context import PageView
from skysim.apps.gui.worker import photo
from skysim.apps.gui.worker.photo import Photo
from skysim.apps.gui.worker.session import Session
from skysim.core.errors import InputError
from skysim.core.yaml_reader import OverrideTexts
from skysim.simulation.lab import MAIN

PAUSE_S = 0.005  # pause between building parts of a page, in which the keys of other pages are served
PANELS = ("Run", "Lights", "Scene", "Check", "Survey", "Monte Carlo", "Image", "Log")


class Tab(context.PageContext):
    """One tab: its worker, its scene, and its page elements.

    Attributes
    ----------
    new_session
        Function that returns another worker, None if there are too many
    cameras
        Live cameras that it may watch
    filling
        Lock that is held while a form of the scene's keys is filled
    naming
        What stands for the reading of LEDs' codes that goes on
    """

    naming: object = None
    new_session: Callable[[], Session | None]

    def __init__(
        self, scene: str, folder: Path, out: Path, cameras: Sequence[str] = (), user: str = ""
    ) -> None:
        self.id = secrets.token_hex(8)
        self.user = user
        self.folder = folder
        self.out = out
        self.cameras = cameras
        self.state = PageView(scene)
        self.derived = []
        self.contents = widgets.Contents()
        self.editing = asyncio.Lock()
        self.filling = asyncio.Lock()

    async def close(self) -> None:
        """Release frames, study and worker of the tab after its browser has gone."""
        self.is_open = False
        overlay.FRAMES.pop(self.id, None)
        self.study_panel.close()
        if hasattr(self, "session"):
            await asyncio.to_thread(self.session.close)

    def use(self, session: Session) -> None:
        """Use a worker."""
        self.session = session
        self.sensor.source = session

    async def restart(self) -> None:
        """Show the view again with a new worker after the old one has ended."""
        lost = self.session
        session = self.new_session()
        await asyncio.to_thread(lost.close)
        if session is None:
            self.show_message(
                "the worker of this page has stopped, and all others are in use: reload to wait for one"
            )
            return
        self.use(session)
        self.view = None
        wanted = self.state
        self.log("the worker of this page has stopped; a new one shows the view again")
        await self.restore(wanted)

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
        with widgets.div("lab"):
            self.head = head.Head(self)
            self.sensor = sensor.SensorView(self.id, self.contents)
            self.sensor.show_setting_up(self.state.scene)
            self.derive(lambda view: view.image, self.sensor.empty)
            await asyncio.sleep(PAUSE_S)
            with widgets.div("lab-side"):
                head.Arrangement.splitter("side", "vertical", "Width of the panels")
                self.attitude = readouts.AttitudeCard(self)
                await self.build_panels()
            with widgets.div("lab-keys"):
                for key in keys.KEYS:
                    if key.description:
                        ui.html(
                            f"<span><kbd>{key.label}</kbd>{key.description}</span>",
                            sanitize=False,
                        )
        await asyncio.sleep(PAUSE_S)
        self.history = History(self, self.show_query, self.is_settling)
        self.end_step = self.history.end_step
        self.arrangement = head.Arrangement(self.study_panel.chart)
        self.actions = Actions(self, self.run_panel.step, self.performers(), self.commands())
        # A timer waits for the browser, and NiceGUI then sends the unfinished page. So timers come after all pauses.
        ui.timer(readouts.UPDATE_S, self.update_lights)
        ui.timer(monte_carlo_panel.POLL_S, self.study_panel.poll)
        ui.timer(real_panel.BLINK_S, self.photo.real.blink)

    async def build_panels(self) -> None:
        with widgets.div("lab-panes"):
            with widgets.div("lab-space-pane"):
                self.scene_3d = space.Scene3D(self)
            head.Arrangement.splitter("space", "horizontal", "Height of the 3-D view")
            with ui.tabs().props(
                "dense align=left no-caps indicator-color=primary"
            ) as self.tabs:
                # Otherwise the arrow keys would select tabs.
                self.tabs.on("click", js_handler=keys.BLUR_JS)
                for name in PANELS:
                    ui.tab(name)
            with ui.tab_panels(
                self.tabs, value=PANELS[0], animated=False, keep_alive=True
            ).classes("lab-panels"):
                with ui.tab_panel("Lights"):
                    self.lights = readouts.LightsPanel(self)
                with ui.tab_panel("Scene"):
                    self.form = settings_panel.ScenePanel(self, self.head.update_scenes)
                await asyncio.sleep(PAUSE_S)
                with ui.tab_panel("Run").classes("lab-run"):
                    self.run_panel = run_panel.RunPanel(self)
                with ui.tab_panel("Check"):
                    plan_panel.CheckPanel(self, self.scene_3d)
                with ui.tab_panel("Survey"):
                    plan_panel.SurveyPanel(self, self.scene_3d, self.run_panel)
                await asyncio.sleep(PAUSE_S)
                with ui.tab_panel("Monte Carlo"):
                    self.study_panel = monte_carlo_panel.MonteCarloPanel(self)
                await asyncio.sleep(PAUSE_S)
                with ui.tab_panel("Image"):
                    self.photo = photo_panel.PhotoPanel(self, self.cameras)
                with ui.tab_panel("Log"):
                    self.log_panel = readouts.LogPanel(self)
                    self.log = self.log_panel.add
        self.tabs.on_value_change(self.fill_form)

    def update_lights(self) -> None:
        """Timer: fill the table of lights while it is open."""
        if self.tabs.value == "Lights":
            self.lights.update()

    # Actions of keys and of the command palette.

    def performers(self) -> dict[str, Action]:
        """Functions of the keys by the names of their actions."""
        return {
            "identify": self.identify,
            "noise": self.head.toggle_noise,
            "monte_carlo": self.start_study,
            "play": self.run_panel.toggle,
            "undo": self.history.undo,
            "live": self.head.go_live,
            "attitude": self.attitude.focus,
            "sensor": partial(self.set_up_tracker, "F6"),
            "identifier": partial(self.set_up_tracker, "F7"),
            "runs": self.set_up_study,
            "log": partial(self.show_panel, "Log"),
        }

    def commands(self) -> list[Command]:
        """Further commands: flight, history, arrangement, panels and exports."""
        return [
            Command(
                "show the next frame of the flight", partial(self.run_panel.step, 1), "."
            ),
            Command(
                "show the previous frame of the flight", partial(self.run_panel.step, -1), ","
            ),
            Command("redo the change that was undone", self.history.redo, "Ctrl Shift Z"),
            Command("compute the flight of the scene, or stop that", self.run_panel.simulate),
            Command("change between the dark and the light theme", self.arrangement.toggle),
            Command(
                "give frame, 3-D view and panels their first sizes", self.arrangement.reset
            ),
            *(Command(f"panel: {name}", partial(self.show_panel, name)) for name in PANELS),
            *(
                Command(f"export: {name}", partial(self.head.export, name))
                for name in photo.FILE_BY_ITEM
            ),
        ]

    async def identify(self) -> None:
        """Render a new frame of the live scene, solve it, and log the result.

        Where LEDs blink codes, further frames follow until the LEDs are named.
        """
        self.stop_playback()
        naming = self.naming = object()
        view: FrameView | None = await self.show_live("render", solve=True)
        info = self.scene_info
        frames = 1
        while (
            info
            and frames < info.code_frames
            and self.naming is naming
            and not is_solved(view)
        ):
            text = (
                f"reading the LEDs' codes: frame {frames + 1} of at most {info.code_frames}"
            )
            self.show_message(f"{text}; a movement stops it", "quiet")
            view = await self.show_live("render_next", frames, solve=True)
            await self.sensor.wait_drawn()
            frames += 1
        if view and view.result and info:
            self.log_panel.identified(view, info)
            names = [
                self.sensor.name(one.id) for one in view.result.detections if one.id >= 0
            ]
            if frames > 1 and self.naming is naming:
                found = ", ".join(names) or view.result.row.status
                self.show_message(f"after {frames} frames: {found}", "quiet")

    async def start_study(self) -> None:
        self.show_panel("Monte Carlo")
        await self.study_panel.start()

    def set_up_study(self) -> None:
        self.show_panel("Monte Carlo")
        self.study_panel.focus()

    async def set_up_tracker(self, key: str) -> None:
        """Open the form at the keys of F6 or F7."""
        self.show_panel("Scene")
        await self.fill_form()
        self.form.open(key)

    # The view of the page's address.

    async def start(
        self, session: Session, new_session: Callable[[], Session | None]
    ) -> None:
        """Show the first view: that of the page's address, or of the browser's storage, or the server's scene."""
        self.use(session)
        self.new_session = new_session
        await self.arrangement.restore()
        # Without a browser there is no storage.
        if ui.context.client.has_socket_connection:
            self.log_panel.keep(app.storage.tab)
        await self.show_query(await self.history.read())
        refusal = self.message_text
        if self.is_open and self.view is None and await self.open(self.state.scene):
            self.show_message(refusal)

    async def show_query(self, query: str) -> None:
        """Show the view of an address; refuse an address that this server does not have."""
        try:
            wanted = PageView.from_query(query, self.head.scenes())
            if wanted:
                await asyncio.to_thread(forms.validated_scene, *wanted.opened)
        except InputError as error:
            self.show_message(widgets.for_page(error))
            return
        if wanted:
            await self.restore(wanted)

    async def restore(self, wanted: PageView) -> None:
        """Restore a view: open its scene if it is another one, point the camera, then fly or replay."""
        now = self.state
        is_same = now.opened == wanted.opened and now.head == wanted.head
        is_shown = self.view is not None and is_same
        if not is_shown or wanted.angles_deg is None:
            if not await self.open(*wanted.opened, wanted.angles_deg, wanted.head):
                return
        elif wanted.kind == "live" and (
            now.kind != "live" or now.angles_deg != wanted.angles_deg
        ):
            self.stop_playback()
            await self.show_live("point", wanted.angles_deg)
        if wanted.study != self.state.study:
            await self.study_panel.show_study(wanted.study)
        if wanted.kind == "flight":
            await self.run_panel.restore(wanted.t_s, self.history.adopt)
        elif wanted.kind == "replay" and wanted.study == self.state.study:
            await self.study_panel.replay(wanted.trial)
        elif wanted.kind == "photo":
            self.show_message(f"{wanted.photo}: show the image again to see it", "quiet")

    def is_settling(self) -> bool:
        """Whether the page does not show its state yet."""
        return self.view is None or self.run_panel.wanted_s is not None

    # The scene.

    async def open(
        self,
        scene: str,
        overrides: OverrideTexts | None = None,
        angles_deg: Triple | None = None,
        head: str = MAIN,
    ) -> bool:
        """Set up a scene and show a first frame, at its start or at other angles; keep the old scene if that fails."""
        self.stop_playback()
        self.run_panel.stop_computing()
        overrides = dict(overrides or {})
        name = Path(scene).name
        if not self.view:  # the sensor view shows the message
            self.sensor.show_setting_up(scene)
        path = forms.absolute_path(scene)
        activity = f"setting up {name} …" if self.view else ""
        asked = path, overrides, self.solving, angles_deg, head
        result = await self.run_task("open", *asked, activity=activity)
        if result is None:
            self.head.picker.set_value(self.state.scene)
            if self.view is None:
                self.sensor.show_waiting(
                    f"{name} cannot be set up:", self.message_text, in_vain=True
                )
            return False
        self.end_step()  # the former view is a step, however short it was shown
        self.scene_info, view = result
        shown = self.scene_info.head
        running = self.study_panel.running
        self.set_state(scene=scene, overrides=overrides, study=running, head=shown)
        self.set_scene(self.scene_info)
        self.show_frame(view, kind="live", angles_deg=view.angles_deg)
        self.form.hide_others(scene)
        await self.fill_form()
        self.log(f"opened {name}" + (f" with {', '.join(overrides)}" if overrides else ""))
        if head != shown:
            self.show_message(
                f"{name} has no camera {head!r}; allowed: {', '.join(self.scene_info.heads)}"
            )
        return True

    def set_scene(self, info: SceneInfo) -> None:
        """Show a new scene in all parts of the page."""
        self.head.set_scene(info)
        self.attitude.set_scene(info)
        self.sensor.clear_zoom()
        self.run_panel.set_scene(info)
        self.study_panel.set_scene()

    async def fill_form(self) -> None:
        """Show the keys of the current scene in their panel while it is open, as it takes a while.

        When it is left, the keys of F6 or F7 are no longer the only ones.
        """
        if self.tabs.value != "Scene" and self.form.find.value in settings_panel.KEYS_OF:
            self.form.find.set_value("")
        async with self.filling:
            while (
                self.tabs.value == "Scene"
                and self.view
                and self.is_open
                and self.form.shown != self.state.opened
            ):
                current = self.state.opened
                fields = await run.io_bound(forms.fields, *current)
                if self.is_open and self.state.opened == current:
                    self.form.set_scene(fields)
                    self.form.shown = current

    # Contents of the page.

    def set_state(self, **changes: Any) -> None:
        """Change fields of the page's view, and the banner."""
        super().set_state(**changes)
        self.head.set_state(self.state)

    def show_frame(self, view: FrameView, **state: Any) -> None:
        """Show a frame of the scene, live or of its flight.

        Parameters
        ----------
        state
            Changes of the fields of `PageView`
        """
        self.set_state(**state)
        self.view = view
        assert self.scene_info is not None
        self.attitude.show(view, self.scene_info)
        self.scene_3d.show(view)
        self.sensor.show(view, self.scene_info)

    def show_photo(self, photo: Photo, /, **state: Any) -> None:
        """Show an image that is not of the current scene: a photograph, or a replayed trial.

        Parameters
        ----------
        state
            Changes of the fields of `PageView`
        """
        self.set_state(**state)
        self.attitude.show(photo, photo)
        self.sensor.show(photo, photo)

    def stop_playback(self) -> None:
        """Stop playback, a pushed vehicle and the live camera before the sensor view shows something else."""
        self.naming = None
        self.run_panel.pause()
        self.scene_3d.push.stop()
        self.photo.stop()


def is_solved(view: FrameView | None) -> bool:
    """Whether a frame has an attitude, or there is none to wait for."""
    return view is None or view.result is None or view.result.row.estimate_deg is not None


SETTLED = (
    3  # number of timer calls without a change after which the next change is a new step
)
WRITE_S = 0.4  # interval of the timer; browsers refuse more than about 200 entries in 30 s
HISTORY_JS = """
window.skysimHistory = {
  index: () => (history.state && history.state.skysim) || 0,
  write(query, push, home) {
    const at = this.index() + (push ? 1 : 0);
    history[push ? "pushState" : "replaceState"]({ skysim: at }, "", query);
    try { localStorage.setItem("skysim.view", JSON.stringify({ home, query })); } catch { /* storage is off */ }
  },
  read(home) {
    if (/[?&]scene=/.test(location.search)) return location.search;
    try {
      const kept = JSON.parse(localStorage.getItem("skysim.view") || "{}");
      return kept.home === home ? kept.query : "";
    } catch { return ""; }
  },
  undo() { if (this.index() > 0) history.back(); },
  redo() { history.forward(); },
};
window.addEventListener("popstate", () => emitEvent("view", location.search));
document.addEventListener("keydown", event => {
  const typing = event.target.closest && event.target.closest("input, textarea, [contenteditable]");
  if (typing || !(event.ctrlKey || event.metaKey)) return;
  const key = event.key.toLowerCase(), redo = key === "y" || (key === "z" && event.shiftKey);
  if (key !== "z" && key !== "y") return;
  event.preventDefault();
  skysimHistory[redo ? "redo" : "undo"]();
}, true);
"""


class History:
    """Writes a page's view to the browser, and shows the view of an address.

    Attributes
    ----------
    home
        The server's scene; a stored view is used only by a server of the same scene
    show_query
        Function that shows the view of an address
    is_settling
        Function that returns whether the page does not yet show its view
    written
        View in the address
    pending
        Newest query that was requested while another one is being shown
    moving
        Whether the last change was only of attitude or time
    unchanged
        Number of timer calls since the last change
    """

    written: context.PageView | None = None
    showing = False
    moving = False
    unchanged = 0
    pending: str | None = None

    def __init__(
        self,
        page: context.PageContext,
        show_query: Callable[[str], Awaitable[None]],
        is_settling: Callable[[], bool],
    ) -> None:
        self.page = page
        self.home = page.state.scene
        self.show_query = show_query
        self.is_settling = is_settling
        ui.add_body_html(f"<script>{HISTORY_JS}</script>")
        ui.on("view", self.asked)
        ui.timer(WRITE_S, self.write)

    async def read(self) -> str:
        """The query of the page's address; if it has none, that of the stored view."""
        return str(
            await ui.run_javascript(
                f"skysimHistory.read({json.dumps(self.home)})", timeout=10
            )
            or ""
        )

    def write(self) -> None:
        """Timer: write a changed view. A continued movement replaces the address; other changes add a step."""
        view = self.page.state
        if view is self.written or self.showing or self.is_settling():
            self.unchanged += 1
            return
        before = self.written
        self.written = view
        moves = before is not None and view.same_step(before)
        goes_on = moves and self.moving and self.unchanged < SETTLED
        push = before is not None and before != view and not goes_on
        self.moving = moves
        self.unchanged = 0
        arguments = ", ".join(json.dumps(value) for value in (view.query(), push, self.home))
        ui.run_javascript(f"skysimHistory.write({arguments})")

    def end_step(self) -> None:
        """Make the next change a step of its own, because another action makes it."""
        self.write()
        self.moving = False

    def undo(self) -> None:
        ui.run_javascript("skysimHistory.undo()")

    def redo(self) -> None:
        ui.run_javascript("skysimHistory.redo()")

    def adopt(self) -> None:
        """Take the page's view as the one that is already in the address."""
        self.written = self.page.state
        self.moving = False

    async def asked(self, event: Any) -> None:
        """Show the view after the browser has gone to another address of this page; if to several, the newest one."""
        self.pending = str(event.args)
        if self.showing:
            return
        self.showing = True
        try:
            while self.pending is not None:
                query = self.pending
                self.pending = None
                await self.show_query(query)
                self.adopt()
        finally:
            self.showing = False
