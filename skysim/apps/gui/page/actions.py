"""Actions of the user by keys and by the command palette."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from nicegui.events import KeyEventArguments

from skysim.apps.gui.page.palette import Command
from skysim.apps.gui.shared import keys
from skysim.apps.gui.worker import export
from skysim.apps.gui.worker.scene import pointing

if TYPE_CHECKING:
    from skysim.apps.gui.page.tab import Tab


class Actions:
    """What keys and commands do on a tab.

    panels : names of its panels
    steps : (3,) right, up, roll: movements requested by keys that no frame shows yet
    """

    def __init__(self, tab: Tab, panels: Sequence[str]) -> None:
        self.tab, self.panels = tab, panels
        self.steps, self.moving = np.zeros(3), False

    def commands(self) -> list[Command]:
        """Every action with its key: those of keys, the panels, the exports."""
        found = [
            Command(key.help, key.label, partial(self.perform, key.action))
            for key in keys.KEYS
            if key.action in keys.PERFORMED
        ]
        found += [
            Command("show the next frame of the flight", ".", partial(self.tab.run_panel.step, 1)),
            Command("show the previous frame of the flight", ",", partial(self.tab.run_panel.step, -1)),
            Command("undo the last change", "Ctrl Z", self.tab.history.undo),
            Command("redo the change that was undone", "Ctrl Shift Z", self.tab.history.redo),
            Command("compute the flight of the scene, or stop that", "", self.tab.run_panel.simulate),
            Command("change between the dark and the light theme", "", self.tab.arrangement.toggle),
            Command("give frame, 3-D view and panels their first sizes", "", self.tab.arrangement.reset),
        ]
        found += [Command(f"panel: {name}", "", partial(self.tab.tabs.set_value, name)) for name in self.panels]
        return found + [Command(f"export: {name}", "", partial(self.tab.export, name)) for name in export.FILE_BY_ITEM]

    async def key(self, event: KeyEventArguments) -> None:
        name = event.key.name.lower() if len(event.key.name) == 1 else event.key.name
        action = keys.ACTION_BY_KEY.get(name)
        if not event.action.keydown or action is None or event.modifiers.ctrl or event.modifiers.meta:
            return
        if self.tab.palette.dialog.value or (self.tab.help.value and action not in ("help", "close")):
            return
        if action == "move":
            right, up, roll_sign = keys.MOVES[name]
            step = pointing.COARSE if event.modifiers.shift else pointing.FINE
            roll = pointing.ROLL_COARSE_DEG if event.modifiers.shift else pointing.ROLL_FINE_DEG
            await self.move(right * step, up * step, roll_sign * roll)
        elif action == "step":
            await self.tab.run_panel.step(1 if name == "." else -1)
        elif not event.action.repeat:
            await self.perform(action)

    async def move(self, right: float, up: float, roll_deg: float) -> None:
        """Move the camera; steps requested while a frame is rendered are summed for the next frame."""
        self.tab.stop_playback()
        self.tab.show_message("")
        self.steps += (right, up, roll_deg)
        if self.moving:
            return
        self.moving = True
        try:
            while self.steps.any():
                steps, self.steps = self.steps.tolist(), np.zeros(3)
                await self.tab.show_live(self.tab.session.run("move", *steps, self.tab.solving))
                await self.tab.sensor.wait_drawn()
        finally:
            self.moving = False

    async def perform(self, action: str) -> None:
        self.tab.show_message("")
        if action == "identify":
            self.tab.stop_playback()
            await self.tab.show_live(self.tab.session.run("render", True))
            if self.tab.view and self.tab.view.result and self.tab.scene_info:
                self.tab.log_panel.identified(self.tab.view, self.tab.scene_info)
        elif action == "noise":
            self.tab.noise.set_value(not self.tab.noise.value)
        elif action == "monte_carlo":
            self.tab.tabs.set_value("Monte Carlo")
            await self.tab.study_panel.start()
        elif action == "play":
            self.tab.run_panel.toggle()
        elif action == "live":
            await self.tab.go_live()
        elif action == "attitude":
            self.tab.attitude.inputs[0].run_method("focus")
        elif action in ("sensor", "identifier"):
            self.tab.tabs.set_value("Tracker")
            await self.tab.tracker_panel.open(action)
        elif action == "runs":
            self.tab.tabs.set_value("Monte Carlo")
            keys.focus(self.tab.study_panel.count)
        elif action == "log":
            self.tab.tabs.set_value("Log")
        elif action == "help":
            self.tab.help.set_value(not self.tab.help.value)
        elif action == "close":
            self.tab.help.close()
