"""Errors for the user, and text that is safe to print on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable

running_as_command = False  # whether skysim runs as a command, with a user at the terminal


def note(message: str) -> None:
    """Print an informational line to stderr if it is a terminal."""
    if sys.stderr.isatty():
        print(f"skysim: {message}", file=sys.stderr, flush=True)


def printable(text: object) -> str:
    """Text from outside on one line, with ? for control characters and others that a terminal cannot show."""
    return "".join(character if character.isprintable() else "?" for character in " ".join(str(text).split()))


def unknown_name(kind: str, name: object, allowed: Iterable[object]) -> str:
    """Message for a name that is not allowed: `unknown solver 'magic'; allowed: quest, svd`."""
    return f"unknown {kind} {name!r}; allowed: {', '.join(map(str, allowed))}"


class InputError(ValueError):
    """The user's input is wrong. The message is one printable line: what, where, what is allowed."""

    def __init__(self, message: object) -> None:
        super().__init__(printable(message))  # it may quote a file, and a file may hold anything
