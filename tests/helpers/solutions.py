"""Solutions of frames without a tracker, and rows of a flight, for tests of the page."""

import math
from dataclasses import asdict
from typing import Any

from skysim.apps.gui.messages import Detection, FlightRow, TrackerResult
from skysim.apps.gui.worker.tasks import Worker
from skysim.results.scoring import FrameRow


def flown(worker: Worker) -> list[FlightRow]:
    """The rows of the open scene's flight."""
    steps = [worker.begin_flight()]
    while not steps[-1].is_done:
        steps.append(worker.advance_flight(10.0))
    return [row for step in steps for row in step.rows]


def solution(
    detections: tuple[Detection, ...], status: str = "solved", **fields: Any
) -> TrackerResult:
    """A frame's solution; without angles unless its status is solved. Further fields are those of FrameRow."""
    values = {
        "frame": 0,
        "t_s": 0.0,
        "rate_deg_s": 0.0,
        "status": status,
        "truth_deg": (0.0, 0.0, 0.0),
        "estimate_deg": (0.0, 0.0, 0.0) if status == "solved" else None,
        "cross_arcsec": math.nan,
        "roll_arcsec": math.nan,
        "detected": len(detections),
        "matched": sum(spot.id >= 0 for spot in detections),
        "rms_px": math.nan,
        "time_ms": 1.0,
        "wrong": False,
    }
    return TrackerResult(FrameRow(**(values | fields)), detections)


def numbers(row: FrameRow) -> dict[str, Any]:
    """A row's fields for a comparison: without the computing time, and texts, so that NaN equals NaN."""
    fields = asdict(row)
    del fields["time_ms"]
    return {name: repr(value) for name, value in fields.items()}
