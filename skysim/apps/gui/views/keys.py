"""Keyboard map and its help, with the keys of PTASE where it has them (Fialho & Saotome 2005, section 3.1)."""

from typing import NamedTuple

from nicegui import ui


class Key(NamedTuple):
    """Keys as the browser names them, their action, their label and description on the screen, and a line of help.

    A key without a description is only in the list of actions, which has the lines of help.
    """

    keys: tuple[str, ...]
    label: str
    action: str
    description: str
    help: str


MOVES = {  # right, up, roll clockwise; unit: one step of a key press
    "ArrowLeft": (-1, 0, 0),
    "ArrowRight": (1, 0, 0),
    "ArrowUp": (0, 1, 0),
    "ArrowDown": (0, -1, 0),
    "e": (0, 0, -1),
    "r": (0, 0, 1),
}
PURPOSE = (
    "Point the star sensor, view its frame, and compare the tracker's attitude with the true one. Under a"
    " dome the angles are the vehicle's (roll, pitch, yaw); under the stars the camera's (RA, Dec, roll)."
)
KEYS = (
    Key(
        tuple(MOVES)[:4],
        "← ↑ ↓ →",
        "move",
        "move",
        "move the boresight by a fiftieth of the field of view",
    ),
    Key(
        ("e", "r"),
        "E R",
        "move",
        "roll",
        "roll the camera by a degree: E counterclockwise, R clockwise",
    ),
    Key(
        ("Shift",), "⇧", "coarse", "coarse", "with an arrow, E or R: steps ten times as large"
    ),
    Key(("1",), "1", "identify", "identify", "render a new frame and solve it"),
    Key(("n",), "N", "noise", "noise", "render without the camera's noise, or with it again"),
    Key(
        ("2",),
        "2",
        "monte_carlo",
        "Monte Carlo",
        "start a Monte Carlo study; F8 sets its number of trials",
    ),
    Key(
        ("F5",),
        "F5",
        "attitude",
        "attitude",
        "type an attitude; Enter points the camera there",
    ),
    Key(("F6",), "F6", "sensor", "sensor", "set up image processing and the sensor's noise"),
    Key(
        ("F7",),
        "F7",
        "identifier",
        "identifier",
        "set up star identification: algorithm, tolerance, magnitudes",
    ),
    Key(("F8",), "F8", "runs", "runs, field", "set the number of runs and the field of view"),
    Key(("p",), "P", "play", "", "play the flight, or pause"),
    Key((",", "."), ", .", "step", "", "show the previous or the next frame of the flight"),
    Key(("l",), "L", "live", "", "return to the live scene"),
    Key(("Ctrl+z",), "Ctrl Z", "undo", "", "undo the last change; Ctrl Shift Z: redo"),
    Key(
        ("Ctrl+k",),
        "Ctrl K",
        "palette",
        "actions",
        "list every action; type a part of its name",
    ),
    Key(("F10",), "F10", "log", "log", "show the log of this session"),
    Key(("F1",), "F1", "help", "help", "list every action with its key"),
    Key(("Escape",), "Esc", "close", "close", "close the list of actions"),
)
ACTION_BY_KEY = {name: key.action for key in KEYS for name in key.keys}

# A list or tab keeps the keyboard focus after a choice, so the focus is removed from it.
BLUR_JS = "() => document.activeElement.closest('.q-select__focus-target, .q-tab') && document.activeElement.blur()"

# Suppress the browser's own actions for these keys unless the user types in a field. F keys and Esc remove the focus
# from a field first, in the capture phase, because the page's own listener ignores events from fields.
SUPPRESS_DEFAULTS_JS = """
document.addEventListener("keydown", event => {
  const typing = event.target.closest && event.target.closest("input, textarea, [contenteditable], .q-menu, .q-tab");
  const ours = %s, named = /^F\\d/.test(event.key);
  if (typing && ((named && ours.includes(event.key)) || event.key === "Escape")) document.activeElement.blur();
  if (ours.includes(event.key) && (named || !typing)) event.preventDefault();
}, true);
""" % [name for key in KEYS for name in key.keys if name.startswith(("F", "Arrow"))]


def focus(field: ui.element) -> None:
    """Give a field the keyboard focus at once.

    Quasar's own method waits until open lists have closed. If their panel is left meanwhile, it waits until another
    list closes, and then takes the focus from the page, whose keys no longer act.
    """
    field.client.run_javascript(f"getElement({field.id}).$el.querySelector('input').focus()")
