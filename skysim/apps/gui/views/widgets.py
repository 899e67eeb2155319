"""Small elements in the style of the page that the panels share: rows, buttons, texts, lists, numbers."""

from collections.abc import Callable
from typing import Any

from nicegui import ui

from skysim.apps.gui.views import keys


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


def button(
    label: str, action: Callable[[], Any], mark: str = "", look: str = "outline"
) -> ui.button:
    """A small button.

    Parameters
    ----------
    action
        Function that is called (and awaited, if it is asynchronous) when the button is pressed
    mark
        Name by which tests find the button
    look
        Quasar's style: outline or flat
    """
    return ui.button(label, on_click=action).props(f"dense {look} size=sm").mark(mark)


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
