"""Attitude during a smooth change of the rate, during which its axis may move: rate + change (3x^2 - 2x^3)."""

from __future__ import annotations

import math

import numpy as np

from skysim.core import quaternion
from skysim.core.jit import jit
from skysim.core.types import Floats


@jit
def rate_at(t_s: float, duration_s: float, rate_rad_s: Floats, change_rad_s: Floats) -> Floats:
    """(3,) rate + change (3x^2 - 2x^3), x = t / duration."""
    x = t_s / duration_s
    return rate_rad_s + x**2 * (3 - 2 * x) * change_rad_s


@jit
def magnus_rotvec(
    begin_s: float, step_s: float, duration_s: float, rate_rad_s: Floats, change_rad_s: Floats
) -> Floats:
    """(3,) rotation vector of the motion in a short step: Magnus' expansion to fourth order, two Gauss points.

        phi = h (w1 + w2) / 2 + sqrt(3) / 12 h^2 w1 x w2

    (Iserles & Norsett 1999, `assumed`; the sign is that of rates in moving axes). The first term is exact here, the
    rate being a cubic of time; if the axis is fixed, the second term is zero for any step.
    """
    middle = begin_s + step_s / 2
    offset = step_s / math.sqrt(12.0)
    early = rate_at(middle - offset, duration_s, rate_rad_s, change_rad_s)
    late = rate_at(middle + offset, duration_s, rate_rad_s, change_rad_s)
    return step_s / 2 * (early + late) + math.sqrt(3.0) / 12 * step_s**2 * quaternion.cross(
        early, late
    )


@jit
def integrate_knots(
    lab_from_start_wxyz: Floats,
    count: int,
    duration_s: float,
    rate_rad_s: Floats,
    change_rad_s: Floats,
) -> Floats:
    """(count, 4) attitudes at 0, 1, ... count - 1 times duration / count."""
    lab_from_knot_wxyz = np.empty((count, 4))
    attitude = lab_from_start_wxyz
    step_s = duration_s / count
    for k in range(count):
        lab_from_knot_wxyz[k] = attitude
        rotvec = magnus_rotvec(k * step_s, step_s, duration_s, rate_rad_s, change_rad_s)
        attitude = quaternion.multiply(attitude, quaternion.from_rotvec(rotvec))
        attitude = attitude / math.sqrt(
            (attitude**2).sum()
        )  # prevents drift of the norm, 1e-16 a step
    return lab_from_knot_wxyz


@jit
def rate_change_state(
    lab_from_knot_wxyz: Floats,
    duration_s: float,
    rate_rad_s: Floats,
    change_rad_s: Floats,
    t_s: float,
) -> tuple[Floats, Floats, Floats]:
    """The state within a change of rate, integrated from the previous knot by the rule that made the knots."""
    step_s = duration_s / len(lab_from_knot_wxyz)
    k = min(int(t_s / step_s), len(lab_from_knot_wxyz) - 1)
    rotvec = magnus_rotvec(k * step_s, t_s - k * step_s, duration_s, rate_rad_s, change_rad_s)
    x = t_s / duration_s
    return (
        quaternion.multiply(lab_from_knot_wxyz[k], quaternion.from_rotvec(rotvec)),
        rate_at(t_s, duration_s, rate_rad_s, change_rad_s),
        6 * x * (1 - x) / duration_s * change_rad_s,
    )
