"""A scene sent to its sinks: made in time or left out, counted either way."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skysim.apps.stream.pacing import Pace
from skysim.apps.stream.packet import Packet, packet
from skysim.apps.stream.sinks import Sink
from skysim.simulation import run, testbed
from skysim.simulation.closed_loop import CapturedFrame
from skysim.simulation.testbed import Testbed

KEPT = 10_000  # delays of the newest frames, for their quantiles


@dataclass
class Tally:
    """What became of the frames.

    made, dropped : by the scene; late_ms: from a frame's exposure to its being there, of the newest
    """

    made: int = 0
    dropped: int = 0
    late_ms: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))

    def note(self, late_ms: float, left_out: int) -> None:
        """A frame was made after so many that were not."""
        self.made, self.dropped = self.made + 1, left_out
        if self.made > 1:  # the first starts the clock
            self.late_ms.append(late_ms)

    def figures(self, sinks: list[Sink]) -> dict[str, Any]:
        """Everything in numbers."""
        late = np.array(self.late_ms or [np.nan])
        return {
            **{"made": self.made, "dropped": self.dropped},
            **{
                f"late_ms_{name}": float(np.quantile(late, q)) for name, q in (("median", 0.5), ("p99", 0.99))
            },
            "late_ms_worst": float(late.max()),
            "sinks": {
                one.name: {"sent": one.sent, "dropped": one.dropped, "fault": one.fault} for one in sinks
            },
        }


def send(
    lab: Testbed,
    pace: Pace,
    sinks: list[Sink],
    tally: Tally,
    post: Callable[[Packet], None] | None = None,
) -> None:
    """Fly a lab that stands on the ground, and send every frame when it is due; until the last, or nobody takes any.

    A frame is left out if there is no time for it, unless the scene steers by its frames or runs as fast as it can.
    """
    watched = lab.scene.filter is None
    for look in run.live(lab, None, pace.in_time if watched else None):
        closed_s = closes_s(lab, look)
        if pace.zero_s is None:
            pace.start(closed_s)
        pace.wait(closed_s)
        due_s, now_s = pace.due_s(closed_s), time.monotonic()
        left_out = look.frame.index - tally.made
        told = packet(look, due_s + pace.offset_s, now_s + pace.offset_s, left_out)
        for sink in sinks:
            sink.offer(told, patient=not pace.speed)
        if post:
            post(told)
        tally.note(1e3 * (now_s - due_s), left_out)
        if sinks and not post and all(sink.fault for sink in sinks):
            return
    tally.dropped = lab.scene.exposure.frames - tally.made  # with those after the last that was made


def closes_s(lab: Testbed, look: CapturedFrame) -> float:
    """When the exposure of a frame ends, and its last row is read."""
    frame = look.frame
    when = testbed.window(lab.scene, frame.index, frame.exposure_s)
    return when.close_s(lab.scene.camera.height_px)
