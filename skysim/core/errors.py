"""Errors for the user, and text that is safe to print on a terminal."""

from __future__ import annotations

import sys

attended = False  # whether skysim runs as a command, with a user at the terminal


def note(message: str) -> None:
    """Print an informational line to stderr if it is a terminal."""
    if sys.stderr.isatty():
        print(f"skysim: {message}", file=sys.stderr, flush=True)


def printable(text: object) -> str:
    """Text from outside on one line, with ? for control characters and others that a terminal cannot show."""
    return "".join(one if one.isprintable() else "?" for one in " ".join(str(text).split()))


class InputError(ValueError):
    """The user's input is wrong. The message is one line: what, where, what is allowed."""
