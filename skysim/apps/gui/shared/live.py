"""Texts and fields that change with every frame.

NiceGUI's page renders all of its elements again when one of them is updated, which takes a browser as long as a frame.
So these contents travel with the frame's pixels, and the browser sets them when it draws the frame; without a new frame
a message brings them.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from nicegui import ui


class Contents:
    """The contents of a tab's live fields. send : called with all of them when some have changed without a frame"""

    def __init__(self) -> None:
        self.all = dict[int, dict[str, str]]()
        self.send: Callable[[dict[int, dict[str, str]]], Any] = lambda _: None
        self.waits = False

    def set(self, number: int, content: dict[str, str]) -> None:
        """Change the content of a field: its text and state, or its value; of the strips the moment that is shown."""
        if self.all.get(number) == content:
            return
        self.all[number] = content
        if not self.waits and asyncio._get_running_loop() is not None:
            self.waits = True
            asyncio.get_running_loop().call_soon(self.flush)

    def take(self) -> dict[int, dict[str, str]]:
        """All contents, for a frame."""
        self.waits = False
        return dict(self.all)

    def flush(self) -> None:
        """Send the contents, unless a frame has taken them."""
        if self.waits:
            self.send(self.take())


class LiveField(ui.element, component="js/live_field.js", esm={"skysim-live": "js"}):  # type: ignore[call-arg]
    """An element whose content travels with the frames."""

    def __init__(self, contents: Contents, tag: str, type: str = "") -> None:
        super().__init__()
        self.contents = contents
        self.props["tag"] = tag
        self.props["type"] = type
        self.props["number"] = self.id


class LiveText(LiveField):
    """A text. state : its style class, such as good or warn"""

    def __init__(self, contents: Contents, text: str = "") -> None:
        super().__init__(contents, "div")
        self.set_text(text)

    def set_text(self, text: str, state: str = "") -> None:
        self.contents.set(self.id, {"text": text, "state": state})


class LiveInput(LiveField):
    """A field to type into, or a slider. type : as in HTML"""

    def __init__(self, contents: Contents, type: str) -> None:
        super().__init__(contents, "input", type)

    def set_value(self, value: object) -> None:
        self.contents.set(self.id, {"value": str(value)})
