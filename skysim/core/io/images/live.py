"""Frames of a live camera or a video stream, and OpenCV's own messages."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError


class LiveCamera:
    """An open camera or video stream, read frame by frame."""

    def __init__(self, source: str) -> None:
        self.source, self.frame_count = source, 0
        with silent_opencv():
            self.capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
            self.capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest frame, not a buffered one

    def frame(self) -> NDArray:
        """The next frame, (H, W) or (H, W, 3). Raises InputError if there is none."""
        with silent_opencv():
            ok, frame = self.capture.read()
        if not ok or frame is None:
            if self.frame_count:
                raise InputError(self.source, f"ends after {self.frame_count} frames")
            raise InputError(self.source, "no camera found", "an index such as 0, a video file, a URL")
        self.frame_count += 1
        return np.asarray(frame)

    def close(self) -> None:
        """Release the camera."""
        self.capture.release()


def grab_frame(source: str) -> NDArray:
    """One frame of a camera, (H, W) or (H, W, 3). Raises InputError if there is none."""
    with contextlib.closing(LiveCamera(source)) as camera:
        return camera.frame()


@contextlib.contextmanager
def silent_opencv() -> Iterator[None]:
    """Suppress OpenCV's own messages, for example about a missing camera."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Suppress output of C libraries: libpng and OpenCV write their messages directly to file descriptor 2."""
    sys.stderr.flush()
    saved, devnull = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(devnull, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(devnull)
