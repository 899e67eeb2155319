"""Command palette: a list of every action with its key, filtered while the user types (Ctrl-K)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import NamedTuple

from nicegui import ui

# Ctrl-K also from a field; the browser's own action is suppressed.
OPEN_JS = """
document.addEventListener("keydown", event => {
  if (!(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "k") return;
  event.preventDefault();
  emitEvent("palette", null);
}, true);
"""


class Command(NamedTuple):
    """An entry: its name, the label of its key if it has one, and what it does."""

    name: str
    key: str
    action: Callable[[], Awaitable[None] | None]


def matching(commands: list[Command], text: str) -> list[Command]:
    """The commands whose name has every word of a text, in the order of the list."""
    words = text.lower().split()
    return [command for command in commands if all(word in command.name.lower() for word in words)]


class Palette:
    """The dialog. Arrows choose, Enter or a click does.

    found : commands that match;  chosen : index of the one that Enter does
    """

    def __init__(self, commands: Callable[[], list[Command]]) -> None:
        self.commands, self.found, self.chosen = commands, list[Command](), 0
        with ui.dialog().props("position=top no-shake") as self.dialog, ui.card().classes("lab-palette"):
            self.field = ui.input(placeholder="type an action", on_change=self.filter)
            self.field.props('dense borderless autofocus aria-label="Action"').classes("w-full").mark("palette")
            self.field.on("keydown.down.prevent", lambda: self.choose(self.chosen + 1))
            self.field.on("keydown.up.prevent", lambda: self.choose(self.chosen - 1))
            self.field.on("keydown.enter.prevent", self.enter)
            self.list = ui.element("div").classes("lab-commands").props('role="listbox"')
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
        """Mark an entry as the one that Enter does, and draw the list."""
        self.chosen = min(max(index, 0), max(len(self.found) - 1, 0))
        self.list.clear()
        with self.list:
            if not self.found:
                ui.label("No such action.").classes("quiet")
            for n, command in enumerate(self.found):
                row = ui.element("div").props(f'role="option" aria-selected="{str(n == self.chosen).lower()}"')
                row.classes("lab-command" + " chosen" * (n == self.chosen)).on("click", lambda n=n: self.do(n))
                with row:
                    ui.label(command.name).classes("ellipsis")
                    if command.key:
                        ui.html(f"<kbd>{command.key}</kbd>", sanitize=False)

    async def enter(self) -> None:
        if self.found:
            await self.do(self.chosen)

    async def do(self, index: int) -> None:
        self.dialog.close()
        done = self.found[index].action()
        if done is not None:
            await done
