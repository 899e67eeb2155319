"""The process in which an entry point's tracker runs: `python -m skysim.tracking.tracker_host NAME`.

It speaks the protocol of docs/howto/external_tracker.md.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import IO

import numpy as np

from skysim.core.plugins import Respond, describe_error, serve
from skysim.core.types import Record
from skysim.tracking.tracker_interface import (
    FAILED,
    TRACKERS,
    Answer,
    Picture,
    Setup,
    Tracker,
    check_answer,
)


def receive_picture(header: Record, frames: IO[bytes]) -> Picture:
    """The frame of a header, with its pixels read from the stream."""
    image = np.frombuffer(frames.read(header["bytes"]), header["dtype"]).reshape(
        header["height_px"], header["width_px"]
    )
    streak = header["streak_px"]
    fields = (header["frame"], header["t_s"], header["exposure_s"])
    return Picture(image, *fields, None if streak is None else tuple(streak))


def respond_by(tracker: Tracker) -> Respond:
    """The function with which `serve` answers frames. Raises TypeError for a tracker without a method `solve`.

    An exception or an invalid answer becomes an answer with status "failed: ...".
    """
    if not callable(getattr(tracker, "solve", None)):
        raise TypeError(f"{type(tracker).__name__} has no method solve")

    def respond(header: Record, frames: IO[bytes]) -> Record:
        picture = receive_picture(header, frames)
        begin_s = time.perf_counter()
        try:
            answer = tracker.solve(picture)
            spent_s = time.perf_counter() - begin_s
            answer = replace(check_answer(answer), seconds=spent_s)
        except Exception as error:
            answer = Answer(check_answer(Answer(FAILED + describe_error(error))).status)
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
    serve_tracker(TRACKERS.entry_points()[sys.argv[1]].load())
