"""Errors for the user, and text that is safe to print on a terminal."""

from __future__ import annotations

import sys

attended = False  # whether we are a command


def note(message: str) -> None:
    """One line to stderr, of what is no fault: for whoever sits before a terminal."""
    if sys.stderr.isatty():
        print(f"skysim: {message}", file=sys.stderr, flush=True)


def printable(text: object) -> str:
    """On one line, and with ? for what a terminal obeys or cannot show: text from outside goes through here."""
    return "".join(one if one.isprintable() else "?" for one in " ".join(str(text).split()))


class InputError(ValueError):
    """The user's input is wrong. The message is one line: what, where, what is allowed."""
