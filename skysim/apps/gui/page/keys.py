"""The map of keys: PTASE's where it had one (Fialho & Saotome 2005, section 3.1)."""

from __future__ import annotations

from typing import NamedTuple


class Key(NamedTuple):
    """Keys as the browser names them, the action that they are, and what the map on the screen says."""

    keys: tuple[str, ...]
    shown: str
    action: str
    told: str


MOVES = {  # fields right, fields up, turns clockwise: of the step of a key
    "ArrowLeft": (-1, 0, 0),
    "ArrowRight": (1, 0, 0),
    "ArrowUp": (0, 1, 0),
    "ArrowDown": (0, -1, 0),
    "e": (0, 0, -1),
    "r": (0, 0, 1),
}
KEYS = (
    Key(tuple(MOVES)[:4], "← ↑ ↓ →", "move", "move"),
    Key(("e", "r"), "E R", "move", "roll"),
    Key(("Shift",), "⇧", "coarse", "coarse"),
    Key(("1",), "1", "identify", "identify"),
    Key(("2",), "2", "monte_carlo", "Monte Carlo"),
    Key(("F5",), "F5", "attitude", "attitude"),
    Key(("F6",), "F6", "sensor", "sensor"),
    Key(("F7",), "F7", "identifier", "identifier"),
    Key(("F8",), "F8", "runs", "runs, field"),
    Key(("F10",), "F10", "log", "log"),
    Key(("F1",), "F1", "help", "help"),
    Key(("Escape",), "Esc", "close", "close"),
)
ACTION = {key: one.action for one in KEYS for key in one.keys}

# What was chosen from, a list or a tab, would else go on to take the keys.
LEAVE = (
    "() => document.activeElement.closest('.q-select__focus-target, .q-tab') && document.activeElement.blur()"
)

# The browser has uses of its own for these; while no field is being typed in, the page has them. F keys and Esc leave a
# field first (before the page's own listener, which hears nothing from a field).
TAKEN = """
document.addEventListener("keydown", event => {
  const typing = event.target.closest && event.target.closest("input, textarea, [contenteditable], .q-menu, .q-tab");
  const ours = %s, named = /^F\\d/.test(event.key);
  if (typing && ((named && ours.includes(event.key)) || event.key === "Escape")) document.activeElement.blur();
  if (ours.includes(event.key) && (named || !typing)) event.preventDefault();
}, true);
""" % [key for one in KEYS for key in one.keys if key.startswith(("F", "Arrow"))]
