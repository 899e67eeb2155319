"""Real-time pacing: when a frame is due on the wall clock, and which frames are too late to render."""

from __future__ import annotations

import time


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
        return (
            self.zero_s is None
            or not self.speed
            or self.late_s(t_s) < 1 / (self.rate_hz * self.speed)
        )

    def wait(self, t_s: float) -> None:
        remaining_s = -self.late_s(t_s)
        if remaining_s > 0:
            time.sleep(remaining_s)
