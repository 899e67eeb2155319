"""The process in which an entry point's tracker runs: `python -m skysim.tracking.external.host NAME`.

It speaks the protocol of docs/howto/external_tracker.md. Frames come on standard input and answers go to the
original standard output; what the tracker itself prints goes to standard error.
"""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace
from typing import IO, Any

import numpy as np

from skysim.core.errors import printable
from skysim.tracking.external.interface import (
    FAILED,
    Answer,
    Picture,
    Setup,
    Tracker,
    check_answer,
    entry_points,
)


def receive_picture(header: dict[str, Any], frames: IO[bytes]) -> Picture:
    """Read the pixels of a frame whose header has been read."""
    count = header["bytes"]
    image = np.frombuffer(frames.read(count), header["dtype"]).reshape(header["height_px"], header["width_px"])
    streak = header["streak_px"]
    fields = (header["frame"], header["t_s"], header["exposure_s"])
    return Picture(image, *fields, None if streak is None else tuple(streak))


def describe_error(error: Exception) -> str:
    """An exception as one line."""
    return printable(f"{type(error).__name__}: {error}")


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
    """Load an entry point and build its tracker."""
    tracker = entry_points()[name].load()(setup)
    if not callable(getattr(tracker, "solve", None)):
        raise TypeError(f"{type(tracker).__name__} has no method solve")
    return tracker


def main(name: str) -> None:
    """Set up the tracker, then answer each frame until the input ends."""
    frames, answers = sys.stdin.buffer, os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def send(reply: dict[str, Any]) -> None:
        answers.write(json.dumps(reply) + "\n")
        answers.flush()

    try:
        tracker = create_tracker(name, Setup.of_tree(json.loads(frames.readline())))
    except Exception as error:
        send({"ready": False, "status": describe_error(error)})
        return
    send({"ready": True})
    while line := frames.readline():
        header = json.loads(line)
        answer = solve_picture(tracker, receive_picture(header, frames))
        send({"frame": header["frame"], **answer.as_tree()})


if __name__ == "__main__":
    main(sys.argv[1])
