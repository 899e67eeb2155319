"""A star tracker: from a frame alone to an attitude, or an honest refusal."""

from typing import Any


class BadImage(ValueError):
    """The image or the calibration cannot be used. The message is one line: what, and what is allowed."""


# What most users need, by the room it lives in; loaded when it is asked for, so that importing the package is quick.
_ROOMS = {
    "Camera": "camera",
    "Follower": "follow",
    "Settings": "stages",
    "StarTracker": "tracker",
    "radecroll_rad": "attitude",
}
__all__ = ["BadImage", *_ROOMS]


def __getattr__(name: str) -> Any:
    """A name of `_ROOMS` from its room."""
    if name not in _ROOMS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_ROOMS[name]}"), name)
