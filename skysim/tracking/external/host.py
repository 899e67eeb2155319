"""The process in which an entry point's tracker runs: `python -m skysim.tracking.external.host NAME`.

It speaks the protocol of docs/howto/external_tracker.md. Frames come on standard input and answers go to the
original standard output; what the tracker itself prints goes to standard error.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import IO, Any

import numpy as np

from skysim.core.errors import printable
from skysim.tracking.external.interface import FAILED, Answer, Picture, Setup, Tracker, checked, entry_points


def picture(header: dict[str, Any], frames: IO[bytes]) -> Picture:
    """Read a frame: its header is given, its pixels follow on the stream."""
    count = header["bytes"]
    image = np.frombuffer(frames.read(count), header["dtype"]).reshape(
        header["height_px"], header["width_px"]
    )
    streak = header["streak_px"]
    told = (header["frame"], header["t_s"], header["exposure_s"])
    return Picture(image, *told, None if streak is None else tuple(streak))


def why(error: Exception) -> str:
    """An exception as one line."""
    return printable(f"{type(error).__name__}: {error}")


def solved(tracker: Tracker, sight: Picture) -> Answer:
    """The tracker's answer; an exception or an invalid answer becomes an answer with status "failed: ..."."""
    begin_s = time.perf_counter()
    try:
        answer = tracker.solve(sight)
        spent_s = time.perf_counter() - begin_s
        told = checked(answer)
    except Exception as error:
        return Answer(checked(Answer(FAILED + why(error))).status)
    return Answer(told.status, told.cam_from_ref_xyzw, told.covariance_rad2, told.centroids_px, spent_s)


def made(name: str, setup: Setup) -> Tracker:
    """Load an entry point and build its tracker."""
    tracker = entry_points()[name].load()(setup)
    if not callable(getattr(tracker, "solve", None)):
        raise TypeError(f"a {type(tracker).__name__} has no method solve")
    return tracker


def main(name: str) -> None:
    """Set up the tracker, then answer each frame until the input ends."""
    frames, answers = sys.stdin.buffer, os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def say(told: dict[str, Any]) -> None:
        answers.write(json.dumps(told) + "\n")
        answers.flush()

    try:
        tracker = made(name, Setup.of_tree(json.loads(frames.readline())))
    except Exception as error:
        say({"ready": False, "status": why(error)})
        return
    say({"ready": True})
    while line := frames.readline():
        header = json.loads(line)
        answer = solved(tracker, picture(header, frames))
        say({"frame": header["frame"], **answer.as_tree()})


if __name__ == "__main__":
    main(sys.argv[1])
