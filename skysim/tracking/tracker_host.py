"""The process in which an entry point's tracker runs: `python -m skysim.tracking.tracker_host NAME`.

It speaks the protocol of docs/howto/external_tracker.md.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import IO, Any

import numpy as np

from skysim.core.plugins import Respond, describe_error, serve
from skysim.tracking.tracker_interface import (
    FAILED,
    TRACKERS,
    Answer,
    Picture,
    Setup,
    Tracker,
    check_answer,
)


def receive_picture(header: dict[str, Any], frames: IO[bytes]) -> Picture:
    """The frame of a header, with its pixels read from the stream."""
    count = header["bytes"]
    image = np.frombuffer(frames.read(count), header["dtype"]).reshape(
        header["height_px"], header["width_px"]
    )
    streak = header["streak_px"]
    fields = (header["frame"], header["t_s"], header["exposure_s"])
    return Picture(image, *fields, None if streak is None else tuple(streak))


def solve_picture(tracker: Tracker, picture: Picture) -> Answer:
    """The tracker's answer; an exception or an invalid answer becomes an answer with status "failed: ..."."""
    begin_s = time.perf_counter()
    try:
        answer = tracker.solve(picture)
        spent_s = time.perf_counter() - begin_s
        return replace(check_answer(answer), seconds=spent_s)
    except Exception as error:
        return Answer(check_answer(Answer(FAILED + describe_error(error))).status)


def create_tracker(name: str, setup: Setup) -> Tracker:
    """The tracker of an entry point. Raises TypeError if it has no method `solve`."""
    tracker = TRACKERS.entry_points()[name].load()(setup)
    if not callable(getattr(tracker, "solve", None)):
        raise TypeError(f"{type(tracker).__name__} has no method solve")
    return tracker


def respond_by(tracker: Tracker) -> Respond:
    """The function with which `serve` answers frames."""

    def respond(header: dict[str, Any], frames: IO[bytes]) -> dict[str, Any]:
        answer = solve_picture(tracker, receive_picture(header, frames))
        return {"frame": header["frame"], **answer.as_tree()}

    return respond


def serve_tracker(make: Callable[[Setup], Tracker]) -> None:
    """Serve a tracker as a program that skysim starts: the set-up comes once, then every frame.

    Parameters
    ----------
    make
        Class or function that makes the tracker from its set-up
    """
    serve(lambda tree: respond_by(make(Setup.of_tree(tree))))


if __name__ == "__main__":
    serve_tracker(partial(create_tracker, sys.argv[1]))
