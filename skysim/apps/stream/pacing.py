"""The clock on the wall beside the scene's: when a frame is due, and which come too late to be made at all."""

from __future__ import annotations

import time


class Pace:
    """Frames come when they would in the laboratory, or `speed` times as fast; 0: as fast as they can be made.

    The clock starts with the first frame: what is compiled before it is nobody's delay. A frame that cannot be begun
    before the one after it is due is left out.
    """

    def __init__(self, speed: float, rate_hz: float) -> None:
        self.speed, self.rate_hz = speed, rate_hz
        self.zero_s: float | None = None  # on the monotonic clock, when the scene began
        self.offset_s = time.time() - time.monotonic()  # to the clock that everybody has

    def start(self, t_s: float) -> None:
        """The scene's time is t_s now."""
        self.zero_s = time.monotonic() - (t_s / self.speed if self.speed else 0.0)

    def due_s(self, t_s: float) -> float:
        """When the scene's time is t_s, on the monotonic clock; now, where nobody waits."""
        if self.zero_s is None or not self.speed:
            return time.monotonic()
        return self.zero_s + t_s / self.speed

    def late_s(self, t_s: float) -> float:
        """By how much the scene's time t_s has passed."""
        return time.monotonic() - self.due_s(t_s)

    def in_time(self, _: int, t_s: float) -> bool:
        """Whether a frame whose exposure ends at t_s is worth while to be made."""
        return self.zero_s is None or not self.speed or self.late_s(t_s) < 1 / (self.rate_hz * self.speed)

    def wait(self, t_s: float) -> None:
        """Until t_s."""
        left_s = -self.late_s(t_s)
        if left_s > 0:
            time.sleep(left_s)
