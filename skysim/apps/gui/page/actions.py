"""Actions of the user, by keys or by a palette (Ctrl-K, F1) that lists all actions and filters them by typed text."""

from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from nicegui import ui
from nicegui.events import KeyEventArguments

from skysim.apps.gui.views import context, keys, widgets
from skysim.apps.gui.worker import geometry

Action = Callable[[], Awaitable[None] | None]

# Ctrl-K also acts in a field; the browser's own action is suppressed.
OPEN_JS = """
document.addEventListener("keydown", event => {
  if (!(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "k") return;
  event.preventDefault();
  emitEvent("palette", null);
}, true);
"""


class Command(NamedTuple):
    """An entry: its name, its action, and the label of its key if it has one."""

    name: str
    action: Action
    key: str = ""


async def perform(action: Action) -> None:
    """Do an action, and wait for its end if it is asynchronous."""
    done = action()
    if done is not None:
        await done


def matching(commands: list[Command], text: str) -> list[Command]:
    """The commands whose name has every word of a text, in the order of the list."""
    words = text.lower().split()
    return [
        command for command in commands if all(word in command.name.lower() for word in words)
    ]


class Palette:
    """The dialog. Arrow keys choose an entry; Enter or a click performs it.

    Attributes
    ----------
    found
        Commands that match the typed text
    chosen
        Index of the command that Enter performs
    """

    def __init__(self, commands: Callable[[], list[Command]]) -> None:
        self.commands = commands
        self.found: list[Command] = []
        self.chosen = 0
        with (
            ui.dialog().props("position=top no-shake") as self.dialog,
            ui.card().classes("lab-palette"),
        ):
            self.field = ui.input(placeholder="type an action", on_change=self.filter)
            self.field.props('dense borderless autofocus aria-label="Action"').classes(
                "w-full"
            )
            self.field.on("keydown.down.prevent", lambda: self.choose(self.chosen + 1))
            self.field.on("keydown.up.prevent", lambda: self.choose(self.chosen - 1))
            self.field.on("keydown.enter.prevent", self.enter)
            self.list = widgets.div("lab-commands").props('role="listbox"')
            widgets.quiet(keys.PURPOSE)
        ui.add_body_html(f"<script>{OPEN_JS}</script>")
        ui.on("palette", self.open)

    def open(self) -> None:
        self.field.set_value("")
        self.filter()
        self.dialog.open()

    def filter(self) -> None:
        self.found = matching(self.commands(), str(self.field.value or ""))
        self.choose(0)

    def choose(self, index: int) -> None:
        """Mark the entry that Enter performs, and draw the list."""
        self.chosen = min(max(index, 0), max(len(self.found) - 1, 0))
        self.list.clear()
        with self.list:
            if not self.found:
                widgets.quiet("No such action.")
            for n, command in enumerate(self.found):
                row = ui.element("div").props(
                    f'role="option" aria-selected="{str(n == self.chosen).lower()}"'
                )
                row.classes("lab-command" + " chosen" * (n == self.chosen)).on(
                    "click", lambda n=n: self.do(n)
                )
                with row:
                    ui.label(command.name).classes("ellipsis")
                    if command.key:
                        ui.html(f"<kbd>{command.key}</kbd>", sanitize=False)

    async def enter(self) -> None:
        if self.found:
            await self.do(self.chosen)

    async def do(self, index: int) -> None:
        self.dialog.close()
        await perform(self.found[index].action)


class Actions:
    """Actions of the keys and commands on a page.

    Attributes
    ----------
    step
        Shows the next or the previous frame of the flight (1 or -1)
    performers
        Functions by the action of a key, for keys that are also commands
    others
        Commands that are not in `keys.KEYS`
    steps
        (3,) right, up, roll: movements requested by keys, which no frame shows yet
    moving
        Whether such a frame is being rendered
    """

    def __init__(
        self,
        page: context.PageContext,
        step: Callable[[int], Awaitable[None]],
        performers: Mapping[str, Action],
        others: Sequence[Command],
    ) -> None:
        self.page = page
        self.step = step
        self.palette = Palette(self.commands)
        self.performers = {**performers, "help": self.palette.open}
        self.others = others
        self.steps = np.zeros(3)
        self.moving = False
        ui.keyboard(on_key=self.key, ignore=["input", "textarea"])

    def commands(self) -> list[Command]:
        """Every action with its key; that of a key that is held, such as an arrow, is only named."""
        return [
            *(
                Command(key.help, partial(self.perform, key.action), key.label)
                for key in keys.KEYS
            ),
            *self.others,
        ]

    async def key(self, event: KeyEventArguments) -> None:
        """Perform the action of a pressed key, unless the palette is open."""
        name = event.key.name.lower() if len(event.key.name) == 1 else event.key.name
        action = keys.ACTION_BY_KEY.get(name)
        if (
            not event.action.keydown
            or action is None
            or event.modifiers.ctrl
            or event.modifiers.meta
            or self.palette.dialog.value
        ):
            return
        if action == "move":
            right, up, roll_sign = keys.MOVES[name]
            step = geometry.COARSE if event.modifiers.shift else geometry.FINE
            roll = (
                geometry.ROLL_COARSE_DEG if event.modifiers.shift else geometry.ROLL_FINE_DEG
            )
            await self.move(right * step, up * step, roll_sign * roll)
        elif action == "step":
            await self.step(1 if name == "." else -1)
        elif not event.action.repeat:
            await self.perform(action)

    async def move(self, right: float, up: float, roll_deg: float) -> None:
        """Move the camera; steps requested while a frame is rendered are summed for the next frame."""
        self.page.stop_playback()
        self.page.show_message("")
        self.steps += (right, up, roll_deg)
        if self.moving:
            return
        self.moving = True
        try:
            while self.steps.any():
                steps = self.steps.tolist()
                self.steps = np.zeros(3)
                await self.page.show_live("move", *steps)
                await self.page.sensor.wait_drawn()
        finally:
            self.moving = False

    async def perform(self, action: str) -> None:
        """Clear an older message and perform the action of a key."""
        self.page.show_message("")
        if action in self.performers:
            await perform(self.performers[action])
