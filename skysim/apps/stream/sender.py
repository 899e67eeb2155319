"""Real-time sender: renders a scene's frames when they are due, drops late ones, and sends them to sinks."""

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

KEPT = 10_000  # newest delays from which the quantiles are computed


@dataclass
class Tally:
    """Counters of the sender.

    made, dropped : number of frames rendered and left out
    late_ms       : delay from the end of the exposure to the frame being ready, of the newest KEPT frames
    """

    made: int = 0
    dropped: int = 0
    late_ms: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))

    def note(self, late_ms: float, left_out: int) -> None:
        """Record a rendered frame; left_out : number of frames dropped so far."""
        self.made, self.dropped = self.made + 1, left_out
        if self.made > 1:  # the first frame starts the clock, so it has no delay
            self.late_ms.append(late_ms)

    def figures(self, sinks: list[Sink]) -> dict[str, Any]:
        """Counts, delay statistics in ms, and the counters of each sink."""
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
    """Simulate a testbed and send each frame when it is due, until the last frame or until all sinks have failed.

    Late frames are dropped, unless pacing is off or the scene has a filter: then the loop needs every frame.
    lab : as built, before its motion is simulated;  post : also called with each packet
    """
    watched = lab.scene.filter is None
    for look in run.live(lab, None, pace.in_time if watched else None):
        closed_s = closes_s(lab, look)
        if pace.zero_s is None:
            pace.start(closed_s)  # so that the first frame has no delay
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
    tally.dropped = lab.scene.exposure.frames - tally.made  # and those after the last rendered


def closes_s(lab: Testbed, look: CapturedFrame) -> float:
    """Scene time at which a frame's exposure ends, with a rolling shutter that of its last row."""
    frame = look.frame
    when = testbed.window(lab.scene, frame.index, frame.exposure_s)
    return when.close_s(lab.scene.camera.height_px)
