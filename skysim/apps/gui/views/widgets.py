"""Small elements in the style of the page that the panels share: rows, buttons, texts, lists, numbers.

Some texts and fields change with every frame. When one element of NiceGUI's page is updated, the browser renders all of
them, which takes as long as a frame. So these contents are sent with the frame's pixels, and the browser sets them when
it draws the frame. Without a new frame they are sent in a message.
"""

import asyncio
import csv
import io
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from nicegui import ui

from skysim.apps.gui.views import keys
from skysim.core.errors import OVERRIDES, InputError


def div(classes: str) -> ui.element:
    """A box with style classes of the page."""
    return ui.element("div").classes(classes)


def row(gap: int = 2) -> ui.row:
    """A row as wide as its panel, without wrapping.

    Parameters
    ----------
    gap
        Distance between its elements, in units of the page's grid
    """
    return ui.row().classes(f"w-full no-wrap items-center gap-{gap}")


def quiet(text: str = "") -> ui.label:
    """A text in the subdued color."""
    return ui.label(text).classes("quiet")


def button(label: str, action: Callable[[], Any], look: str = "outline") -> ui.button:
    """A small button.

    Parameters
    ----------
    action
        Function that is called (and awaited, if it is asynchronous) when the button is pressed
    look
        Quasar's style: outline or flat
    """
    return ui.button(label, on_click=action).props(f"dense {look} size=sm")


def select(options: Any, look: str = "outlined", **settings: Any) -> ui.select:
    """A list to choose from, which returns the keyboard focus to the page after a choice.

    Parameters
    ----------
    look
        Quasar's style: outlined or borderless
    settings
        Passed on to `ui.select`
    """
    chosen = ui.select(options, **settings).props(f"dense {look} options-dense")
    return chosen.on("popup-hide", js_handler=keys.BLUR_JS)


def number(label: str, **settings: Any) -> ui.number:
    """A field for a number. `settings` are passed on to `ui.number`."""
    return ui.number(label, **settings).props("dense outlined")


def checkbox(label: str, value: bool = False, **settings: Any) -> ui.checkbox:
    """A small checkbox. `settings` are passed on to `ui.checkbox`."""
    return ui.checkbox(label, value=value, **settings).props("dense size=xs")


LiveContents = dict[int, dict[str, str]]  # by the number of a field


class Contents:
    """The contents of a tab's live fields.

    Attributes
    ----------
    send
        Function that is called with all contents if some have changed without a frame
    """

    def __init__(self) -> None:
        self.all = LiveContents()
        self.send: Callable[[LiveContents], Any] = lambda _: None
        self.waits = False

    def set(self, number: int, content: dict[str, str]) -> None:
        """Change the content of a field: text and state, or value, or the shown moment of the strips."""
        if self.all.get(number) == content:
            return
        self.all[number] = content
        if not self.waits and asyncio._get_running_loop() is not None:
            self.waits = True
            asyncio.get_running_loop().call_soon(self.flush)

    def take(self) -> LiveContents:
        """All contents, for a frame."""
        self.waits = False
        return dict(self.all)

    def flush(self) -> None:
        """Send the contents, unless a frame has taken them."""
        if self.waits:
            self.send(self.take())


class LiveField(ui.element, component="js/live_field.js", esm={"skysim-views": "js"}):  # type: ignore[call-arg]
    """An element whose content is sent with the frames."""

    def __init__(self, contents: Contents, tag: str, type: str = "") -> None:
        super().__init__()
        self.contents = contents
        self.props["tag"] = tag
        self.props["type"] = type
        self.props["number"] = self.id


class LiveText(LiveField):
    """A text, with a style class as its state, such as good or warn."""

    def __init__(self, contents: Contents, text: str = "") -> None:
        super().__init__(contents, "div")
        self.set_text(text)

    def set_text(self, text: str, state: str = "") -> None:
        self.contents.set(self.id, {"text": text, "state": state})


class LiveInput(LiveField):
    """A field to type into, or a slider, by the `type` of HTML."""

    def __init__(self, contents: Contents, type: str) -> None:
        super().__init__(contents, "input", type)

    def set_value(self, value: object) -> None:
        self.contents.set(self.id, {"value": str(value)})


# Texts of the page: errors, numbers, and tables as CSV files.


LABELS = {  # labels of fields by parameter; the label of a scene's key is the key
    "solve.fov_deg": "the field of view",
    "solve.near_deg": "the circle of the sky",
    "solve.time_utc": "the date",
    "solve.catalog": "the star catalog",
    "solve.detector": "the detector",
    "solve.centroider": "the centroider",
    "solve.identifier": "the identifier",
    "solve.solver": "the solver",
    "survey.tilt_deg": "the tilt",
}


def for_page(error: InputError) -> str:
    """An error with the label of the field at fault; without file and line if the value was typed in the page."""
    where = None if error.where == OVERRIDES else error.where
    return str(
        InputError(LABELS.get(error.key, error.key), error.problem, error.allowed, where)
    )


def format_number(value: float) -> str:
    """Format with three significant digits; from 100 up, as an integer."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def csv_table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    """A table with its heads; numbers with nine digits, unknown values (NaN, None) as empty cells."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows([cell(value) for value in row] for row in rows)
    return text.getvalue().encode()


def cell(value: Any) -> str:
    if value is None or value != value:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)
