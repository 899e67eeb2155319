"""What a command says of itself while its user waits: a package that is imported says nothing."""

from __future__ import annotations

import sys

attended = False  # whether we are a command


def note(message: str) -> None:
    """One line to stderr, of what is no fault: for whoever sits before a terminal."""
    if sys.stderr.isatty():
        print(f"skysim: {message}", file=sys.stderr, flush=True)
