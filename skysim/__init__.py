"""A star tracker's laboratory in software."""

__version__ = "0.1.0"


class BadInput(ValueError):
    """The user's input is wrong. The message is one line: what, where, what is allowed."""
