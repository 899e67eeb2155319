"""A star tracker's laboratory in software."""

import os

# Threads of compiled loops that have nothing to do shall sleep: on a machine with other work, spinning ones take the
# very core that the others wait for, and a frame takes three times as long (measured). Read when the first loop runs.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"


def printable(text: object) -> str:
    """On one line, and with ? for what a terminal obeys or cannot show: text from outside goes through here."""
    return "".join(one if one.isprintable() else "?" for one in " ".join(str(text).split()))


class BadInput(ValueError):
    """The user's input is wrong. The message is one line: what, where, what is allowed."""
