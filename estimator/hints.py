"""What a detector and a centroider may be told beyond the frame itself."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Hints:
    """What is known of a frame before it is looked at.

    streak_px  : (dx, dy) that stars move over the sensor during the exposure, from the gyro; None where unknown.
        Its sign does not matter: the light is the same either way
    saturation : least value of a pixel that is full
    """

    streak_px: tuple[float, float] | None = None
    saturation: float = float("inf")


NO_HINTS = Hints()
