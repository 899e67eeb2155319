"""The page of a browser tab: builds the panels and passes key and mouse actions to the session."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Awaitable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui
from nicegui.events import KeyEventArguments

from skysim.apps.gui.messages import FrameView, SceneInfo
from skysim.apps.gui.page import forms, keys, style
from skysim.apps.gui.page.panels.attitude import AttitudeCard
from skysim.apps.gui.page.panels.monte_carlo import TrialPanel
from skysim.apps.gui.page.panels.photo import PhotoPanel
from skysim.apps.gui.page.panels.run import RunPanel
from skysim.apps.gui.page.panels.scene import ScenePanel
from skysim.apps.gui.page.panels.sensor import FRAMES, Sensor
from skysim.apps.gui.page.scene_3d import Space
from skysim.apps.gui.worker import export, pointing
from skysim.apps.gui.worker.session import Session, WorkerLost
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.scene.loader import find, load

PANELS = ("Lab", "Scene", "Run", "Monte Carlo", "Image", "Log")
LOGGED = 500


class Tab:
    """One tab: its worker, its scene, and its page elements.

    session : its worker; set when a browser has connected
    folder : where scenes are saved;  out : where studies are
    overrides : keys of the scene that differ from its file
    solving : whether every frame is solved
    steps : (3,) right, up, roll: movements asked for by keys that no frame shows yet
    """

    session: Session

    def __init__(self, scene: str, folder: Path, out: Path) -> None:
        self.id = secrets.token_hex(8)
        self.scene, self.folder, self.out = scene, folder, out
        self.overrides: dict[str, str] = {}
        self.setting: SceneInfo | None = None
        self.view: FrameView | None = None
        self.feedback: str | None = None
        self.solving, self.open_still = True, True
        self.steps, self.moving = np.zeros(3), False
        self.said = ""
        self.lines: list[str] = []

    def close(self) -> None:
        """Release the tab's resources after its browser has gone: frames, study and worker."""
        self.open_still = False
        FRAMES.pop(self.id, None)
        self.trials.trials.kill()
        self.session.close()

    # Page elements.

    def build(self) -> None:
        """Build all page elements."""
        ui.add_css(style.CSS)
        ui.add_body_html(f"<script>{keys.TAKEN}</script>")
        ui.colors(
            primary=style.INK["accent"],
            negative=style.INK["bad"],
            dark=style.INK["panel"],
            dark_page=style.INK["ground"],
        )
        with ui.element("div").classes("lab"):
            self.head()
            self.sensor = Sensor(self)
            with ui.element("div").classes("lab-side"):
                self.attitude = AttitudeCard(self)
                self.side()
            with ui.element("div").classes("lab-keys").mark("keys"):
                for key in keys.KEYS:
                    ui.html(f"<span><kbd>{key.shown}</kbd>{key.told}</span>", sanitize=False)
        self.help = self.dialog()
        ui.keyboard(on_key=self.key, ignore=["input", "textarea"])

    def head(self) -> None:
        """Build the head: scene list, title, message, progress, frame rate, export menu."""
        with ui.element("div").classes("lab-head"):
            ui.label("skysim lab").classes("lab-name")
            self.picker = ui.select(self.scenes(), value=self.scene, on_change=self.pick)
            self.picker.props('dense borderless options-dense aria-label="Scene"').classes("w-44").mark(
                "scene"
            )
            self.picker.on("popup-hide", js_handler=keys.LEAVE)
            self.title = ui.label().classes("lab-title quiet ellipsis")
            self.message = ui.label().classes("lab-said").props('role="status"').mark("message")
            self.busy = ui.spinner(size="16px").classes("lab-busy").mark("busy")
            self.rate = ui.label().classes("lab-rate mono quiet").mark("rate")
            self.rate.props('title="from asking for the newest frame to having it here"')
            self.every = ui.switch("identify", value=True, on_change=self.solve_every).props("dense size=xs")
            with ui.button("Export").props("dense flat size=sm").mark("export"), ui.menu():
                for name in export.KINDS:
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

    def side(self) -> None:
        """Build the panels below the attitude card."""
        with ui.element("div").style(
            "display: grid; grid-template: 34px minmax(0, 1fr) / minmax(0, 1fr); min-height: 0"
        ):
            with ui.tabs().props("dense align=left no-caps indicator-color=primary") as self.tabs:
                # Otherwise the arrow keys would select tabs.
                self.tabs.on("click", js_handler=keys.LEAVE)
                for name in PANELS:
                    ui.tab(name).mark(f"tab-{name}")
            with ui.tab_panels(self.tabs, value="Lab", animated=False, keep_alive=True).classes("lab-panels"):
                with ui.tab_panel("Lab").classes("relative-position"):
                    self.space = Space()
                    ui.label("drag turns · right drag shifts · wheel nears").classes("lab-turn quiet")
                with ui.tab_panel("Scene"):
                    self.form = ScenePanel(self)
                with ui.tab_panel("Run").classes("lab-run"):
                    self.flight = RunPanel(self)
                with ui.tab_panel("Monte Carlo"):
                    self.trials = TrialPanel(self)
                with ui.tab_panel("Image"):
                    self.photo = PhotoPanel(self)
                with ui.tab_panel("Log"):
                    self.told = ui.label("Nothing yet.").classes("mono lab-log").mark("log")

    def dialog(self) -> ui.dialog:
        """Build the help dialog: purpose and keys."""
        with ui.dialog() as dialog, ui.card().style("max-width: 600px; padding: 20px 24px; gap: 12px"):
            ui.label("skysim lab").style("font-weight: 600; font-size: 15px")
            ui.label(
                "You are the star sensor. Move it, see what it sees, let the tracker say where it looks, and how wrong"
                " it is. Under a dome the angles are the vehicle's; under the stars the camera's."
            )
            with ui.element("div").style("display: grid; grid-template-columns: 110px 1fr; gap: 4px 12px"):
                for key in keys.KEYS:
                    ui.html(
                        f'<span class="lab-keys" style="padding: 0; border: 0"><kbd>{key.shown}</kbd></span>',
                        sanitize=False,
                    )
                    ui.label(HELP[key.action if key.action != "move" else key.told])
        return dialog

    # Actions.

    async def pick(self) -> None:
        """Open the scene that was chosen in the list."""
        if self.picker.value != self.scene:
            await self.open(str(self.picker.value))

    async def open(self, scene: str, overrides: Mapping[str, str] | None = None) -> None:
        """Set up a scene and show a first frame; keep the old scene if that fails."""
        self.rest()
        before = self.scene, self.overrides
        self.scene, self.overrides = scene, dict(overrides or {})
        doing = (
            f"setting up {Path(scene).name} …" if self.view else ""
        )  # the first time the sensor view says so
        answer = await self.ask("open", self.scene_path, self.overrides, self.solving, doing=doing)
        if answer is None:
            self.scene, self.overrides = before
            self.picker.set_value(self.scene)
            if self.view is None:
                self.sensor.waiting(f"{Path(scene).name} could not be set up:", self.said)
            return
        self.setting, view = answer
        self.feedback = await self.fed_back()
        self.title.props["title"] = self.setting.title  # tooltip with the full title
        self.title.set_text(self.setting.title)
        self.attitude.set(self.setting)
        self.space.set(self.setting)
        self.sensor.rest()
        self.flight.set()
        self.trials.set()
        self.display(view)
        await self.form.set()
        self.log(
            f"opened {Path(scene).name}" + (f" with {', '.join(self.overrides)}" if self.overrides else "")
        )

    async def change(self, keys_: Mapping[str, str]) -> None:
        """Reopen the scene with further overrides."""
        await self.open(self.scene, {**self.overrides, **keys_})

    async def refield(self, field_deg: float) -> None:
        """Change the field of view by the focal length: f' = f tan(field / 2) / tan(field' / 2)."""
        if self.setting is None or not 0.5 <= field_deg <= 120:
            self.say("field: allowed: 0.5 to 120 deg")
            return
        camera = load(self.scene_path, self.overrides).camera
        longer = math.tan(math.radians(self.setting.field_deg / 2)) / math.tan(math.radians(field_deg / 2))
        await self.change({"camera.focal_length": f"{1e3 * camera.focal_length_m * longer:.5g} mm"})

    async def fed_back(self) -> str | None:
        """The feedback of the scene's controller; None without a controller."""
        control = load(self.scene_path, self.overrides).motion.control
        return control.feedback if control else None

    @property
    def scene_path(self) -> str:
        """Absolute path of the scene file, since study files are written to other folders."""
        return str(find(self.scene).resolve())

    async def show(self, asked: Awaitable[Any]) -> FrameView | None:
        """Wait for a frame and display it; None if the request failed or the tab has closed."""
        begin = time.perf_counter()
        view = await self.wait(asked)
        if view is not None:
            self.display(view)
            self.rate.set_text(f"{1e3 * (time.perf_counter() - begin):.0f} ms")
        return view

    def display(self, view: FrameView) -> None:
        """Display a frame in the sensor view, the attitude card and the 3-D view."""
        self.view = view
        self.sensor.show(view)
        self.attitude.show(view)
        self.space.show(view)

    def rest(self) -> None:
        """Stop playback and the live camera, because the sensor view is needed for something else."""
        self.flight.pause()
        self.photo.stop()

    async def ask(self, task: str, *arguments: Any, doing: str = "") -> Any:
        """Run a task in the worker and return its result, or None after an error, which is displayed.

        doing : message shown until the task ends
        """
        self.say(doing, "quiet")
        self.busy.set_visibility(True)
        try:
            return await self.wait(self.session.ask(task, *arguments))
        finally:
            if self.open_still:
                self.busy.set_visibility(False)
                if doing and self.said == doing:
                    self.say("")

    async def wait(self, asked: Awaitable[Any]) -> Any:
        """Await a result; display an error in one line and return None."""
        try:
            answer = await asked
        except (InputError, WorkerLost) as error:
            if self.open_still:
                self.say(str(error))
            return None
        return answer if self.open_still else None

    def say(self, text: str, ink: str = "warn") -> None:
        """Show a message in the head until the next action; warnings are also logged."""
        if text == self.said:
            return
        self.said = text
        self.message.props["title"] = text  # tooltip with the full text
        self.message.set_text(text)
        self.message.classes(remove="good warn quiet", add=ink)
        if text and ink == "warn":
            self.log(text)

    def log(self, text: str) -> None:
        """Add a line to the log, the newest first."""
        self.lines = [f"{time.strftime('%H:%M:%S')}  {text}", *self.lines[: LOGGED - 1]]
        self.told.set_text("\n".join(self.lines))

    async def solve_every(self) -> None:
        """Take over the switch that solves every frame."""
        self.solving = bool(self.every.value)

    async def export(self, kind: str) -> None:
        """Download files of the newest frame."""
        found = await self.ask("export")
        if not found:
            return
        name = export.KINDS[kind]
        if not name:
            ui.download(export.packed(found), f"{Path(self.scene).stem}.zip")
        elif name in found:
            ui.download(found[name], name)
        else:
            self.say("no solution yet: press 1")

    # Keys.

    async def key(self, event: KeyEventArguments) -> None:
        """Handle a key press."""
        name = event.key.name.lower() if len(event.key.name) == 1 else event.key.name
        action = keys.ACTION.get(name)
        if not event.action.keydown or action is None or event.modifiers.ctrl or event.modifiers.meta:
            return
        if self.help.value and action not in ("help", "close"):
            return
        if action == "move":
            right, up, turn = keys.MOVES[name]
            step = pointing.COARSE if event.modifiers.shift else pointing.FINE
            roll = pointing.ROLL_COARSE_DEG if event.modifiers.shift else pointing.ROLL_FINE_DEG
            await self.move(right * step, up * step, turn * roll)
        elif not event.action.repeat:
            await self.act(action)

    async def move(self, right: float, up: float, roll_deg: float) -> None:
        """Move the camera by these steps; steps asked for while a frame is rendered are summed for the next frame."""
        self.rest()
        self.say("")
        self.steps += (right, up, roll_deg)
        if self.moving:
            return
        self.moving = True
        try:
            while self.steps.any():
                steps, self.steps = self.steps.tolist(), np.zeros(3)
                await self.show(self.session.ask("move", *steps, self.solving))
                await self.sensor.ready()
        finally:
            self.moving = False

    async def act(self, action: str) -> None:
        """Perform the action of a key other than a movement."""
        self.say("")
        if action == "identify":
            self.rest()
            await self.show(self.session.ask("look", True))
            self.log(
                f"identify: {self.view.answer.status if self.view and self.view.answer else 'no answer'}"
            )
        elif action == "monte_carlo":
            self.tabs.set_value("Monte Carlo")
            await self.trials.start()
        elif action == "attitude":
            self.attitude.inputs[0].run_method("focus")
            self.attitude.inputs[0].run_method("select")
        elif action in ("sensor", "identifier"):
            self.attitude.stages["detector" if action == "sensor" else "identifier"].run_method("showPopup")
        elif action == "runs":
            self.tabs.set_value("Monte Carlo")
            self.trials.count.run_method("focus")
        elif action == "log":
            self.tabs.set_value("Log")
        elif action == "help":
            self.help.open()
        elif action == "close":
            self.help.close()


HELP = {
    "move": "move the boresight by a fiftieth of the field",
    "roll": "roll the camera by a degree: E one way, R clockwise",
    "coarse": "with an arrow, E or R: ten times as far",
    "identify": "a new frame, identified",
    "monte_carlo": "as many random attitudes as F8 says, identified",
    "attitude": "type an attitude; Enter looks there",
    "sensor": "the image processing: how lights are detected and centred",
    "identifier": "the star identification algorithm",
    "runs": "how many runs, and the field of view",
    "log": "what was done",
    "help": "this",
    "close": "close what is open",
}
