"""A live camera, as OpenCV opens it: an index, a video file or an address."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.types import BadInput


class LiveCamera:
    """An open camera, frame after frame."""

    def __init__(self, source: str) -> None:
        self.source, self.taken = source, 0
        with silent_opencv():
            self.capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
            self.capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest frame, not one of a while ago

    def frame(self) -> NDArray:
        """The next frame, (H, W) or (H, W, 3). Raises BadInput where none comes."""
        with silent_opencv():
            there, frame = self.capture.read()
        if not there or frame is None:
            if self.taken:
                raise BadInput(f"{self.source}: ends after {self.taken} frames")
            raise BadInput(
                f"{self.source}: no camera answers there; allowed: an index such as 0, a video file, an address"
            )
        self.taken += 1
        return np.asarray(frame)

    def close(self) -> None:
        """Leave it to others."""
        self.capture.release()


def grab(source: str) -> NDArray:
    """One frame of a camera, (H, W) or (H, W, 3). Raises BadInput where there is none."""
    with contextlib.closing(LiveCamera(source)) as camera:
        return camera.frame()


@contextlib.contextmanager
def silent_opencv() -> Iterator[None]:
    """Without what OpenCV says by itself of a camera that is not there."""
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)
