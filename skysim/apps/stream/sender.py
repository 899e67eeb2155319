"""Real-time sender: renders a scene's frames when they are due, drops late ones, and sends them to sinks."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skysim.apps.stream.sinks import Packet, Sink, build_packet
from skysim.simulation.flight import Flight
from skysim.simulation.timing import exposure_window

# Real-time pacing: when a frame is due on the wall clock, and which frames are too late to render.


class Pace:
    """Maps scene time to wall-clock time: t_wall = zero_s + t_scene / speed. A speed of 0 disables pacing.

    The clock starts when the first frame is ready, so that compilation before it is not counted as delay. A frame that
    is late by a frame period or more before rendering starts is dropped.
    """

    def __init__(self, speed: float, rate_hz: float) -> None:
        self.speed = speed
        self.rate_hz = rate_hz
        self.zero_s: float | None = None  # monotonic time at which scene time is 0
        self.offset_s = time.time() - time.monotonic()  # from monotonic to Unix time

    def start(self, t_s: float) -> None:
        """Start the clock: scene time is t_s now."""
        self.zero_s = time.monotonic() - (t_s / self.speed if self.speed else 0.0)

    def due_s(self, t_s: float) -> float:
        """Monotonic time at which scene time is t_s; the present if the clock has not started or pacing is off."""
        if self.zero_s is None or not self.speed:
            return time.monotonic()
        return self.zero_s + t_s / self.speed

    def late_s(self, t_s: float) -> float:
        """Delay: wall-clock seconds since scene time t_s; negative if t_s is still to come."""
        return time.monotonic() - self.due_s(t_s)

    def is_on_time(self, _: int, t_s: float) -> bool:
        """Return True if a frame whose exposure ends at t_s is less than one frame period late, so worth rendering."""
        return self.late_s(t_s) * self.speed * self.rate_hz < 1

    def wait(self, t_s: float) -> None:
        time.sleep(max(-self.late_s(t_s), 0.0))


DELAY_WINDOW = 10_000  # newest delays from which the quantiles are computed


@dataclass
class Sender:
    """Sends the frames of the main camera of a flight, and counts them.

    Attributes
    ----------
    rendered, dropped
        Numbers of rendered and of dropped frames
    late_ms
        Delays from the end of the exposure until the frame is ready, for the newest DELAY_WINDOW
        frames
    """

    flight: Flight
    pace: Pace
    sinks: list[Sink]
    rendered: int = 0
    dropped: int = 0
    late_ms: deque[float] = field(default_factory=lambda: deque(maxlen=DELAY_WINDOW))

    def run(self, publish: Callable[[Packet], None] | None = None) -> None:
        """Fly and send each frame when it is due, until the last one or until all sinks have failed.

        Late frames are dropped, unless pacing is off or the scene has a filter: then the loop needs every frame.

        Parameters
        ----------
        publish
            Function that is also called with each packet
        """
        pace = self.pace
        scene = self.flight.lab.scene
        may_drop = scene.filter is None
        for shot in self.flight.shots(
            cameras=[0], solves=False, selects=pace.is_on_time if may_drop else None
        ):
            frame = shot.frame
            window = exposure_window(scene, frame.index, frame.exposure_s)
            end_s = window.close_s(
                scene.camera.height_px
            )  # with a rolling shutter, the end of the last row's exposure
            if pace.zero_s is None:
                pace.start(end_s)  # so that the first frame has no delay
            pace.wait(end_s)
            due_s = pace.due_s(end_s)
            now_s = time.monotonic()
            self.dropped = frame.index - self.rendered
            packet = build_packet(
                shot, due_s + pace.offset_s, now_s + pace.offset_s, self.dropped
            )
            for sink in self.sinks:
                sink.offer(packet, patient=not pace.speed)
            if publish:
                publish(packet)
            self.rendered += 1
            if self.rendered > 1:  # the first frame starts the clock, so it has no delay
                self.late_ms.append(1e3 * (now_s - due_s))
            if self.sinks and not publish and all(sink.fault for sink in self.sinks):
                return
        # Including those after the last rendered one.
        self.dropped = scene.exposure.frames - self.rendered

    def statistics(self) -> dict[str, Any]:
        """Counts, delay statistics in ms, and the counters of each sink."""
        late = np.array(self.late_ms or [np.nan])
        return {
            "made": self.rendered,
            "dropped": self.dropped,
            "late_ms_median": float(np.quantile(late, 0.5)),
            "late_ms_p99": float(np.quantile(late, 0.99)),
            "late_ms_worst": float(late.max()),
            "sinks": {
                sink.name: {"sent": sink.sent, "dropped": sink.dropped, "fault": sink.fault}
                for sink in self.sinks
            },
        }
