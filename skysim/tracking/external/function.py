"""A Python function as a star tracker: in this process, from a frame's image to an attitude."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Report
from skysim.core.errors import InputError
from skysim.core.plugins import describe_error
from skysim.core.types import Frame
from skysim.tracking.external.adapter import to_report
from skysim.tracking.external.interface import FAILED, OWN, SOLVED, Answer, check_answer

NO_ATTITUDE = "no attitude"  # status where the function returned None


class FunctionTracker:
    """A tracker that is a function. Every failure there becomes the status of a frame.

    function : takes the image (H, W) and returns an Answer, the attitude cam_from_ref as a Rotation or as a unit
        quaternion (4,) scalar last, or None for no attitude
    """

    def __init__(self, name: str, function: Callable[[NDArray[Any]], Any]) -> None:
        self.name = name
        self.function = function

    def solve_frame(self, frame: Frame, streak_px: tuple[float, float] | None = None) -> Report:
        """The tracker's report on a frame; the function gets a copy of its image."""
        begin_s = time.perf_counter()
        try:
            answer = check_answer(to_answer(self.function(np.array(frame.image_dn))))
        except Exception as error:
            return Report(Attitude(f"{FAILED}{describe_error(error)}"), Centroids.empty())
        report = to_report(answer)
        report.seconds.setdefault("solve", time.perf_counter() - begin_s)
        return report

    def solve_centroids(self, centroids: Centroids) -> Attitude:
        """Not supported: a function takes an image. Raises InputError."""
        raise InputError("tracker.name", f"{self.name} solves frames, not centroids", OWN)


def to_answer(value: Any) -> Any:
    """What a function may return, as an Answer; other values unchanged, for `check_answer` to refuse."""
    if value is None:
        return Answer(NO_ATTITUDE)
    if isinstance(value, Rotation):
        return Answer(SOLVED, value.as_quat())
    if isinstance(value, np.ndarray | list | tuple):
        return Answer(SOLVED, value)
    return value
